"""Adaptation of Numba's compilation pipeline to kernels.

The pipeline has fewer passes than Numba's. An entry is linked and optimised once with all its callees, and parallel
processes compile large routines.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import os
import secrets
import select
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import llvmlite.binding
import numba
from numba.core import types
from numba.core.base import BaseContext
from numba.core.callconv import RETCODE_NONE, RETCODE_OK, CPUCallConv
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, compile_result
from numba.core.funcdesc import FunctionDescriptor
from numba.core.typed_passes import (
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.types.functions import BaseFunction
from numba.core.typing import signature
from numba.core.typing.arraydecl import RecordAttribute
from numba.core.untyped_passes import FixupArgs, GenericRewrites, IRProcessing, ReconstructSSA, TranslateByteCode

from maxq.control.kernel import progress
from maxq.control.kernel.fields import field_pointer, read_pointer
from maxq.control.kernel.kept_code import is_own, keep_routine, kept_routine, load_objects
from maxq.control.kernel.machine import cores

_REPORT_S = 0.2  # interval of progress reports while this process waits for another, s


class _KernelCode(JITCodeLibrary):  # type: ignore[misc]  # Numba has no types
    """The LLVM code of one kernel, to be linked into the entry that calls it; Python cannot call it.

    By default, Numba links each function with all its callees, optimises the result and emits machine code at every
    level of the calls.
    """

    @property
    def codegen(self) -> _KernelCode:
        return self

    def set_env(self, name: str, environment: object) -> None:
        """Do nothing, because only a Python wrapper reads a function's environment."""

    def get_pointer_to_function(self, name: str) -> int:
        return 0  # Numba returns 0 for a missing function

    def finalize(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def _optimize_functions(self, module: Any) -> None:
        module.data_layout = self._codegen._data_layout  # LLVM optimises the kernel with its callers

    def by_itself(self) -> Any:
        """Return the LLVM module of the kernel without its callees."""
        return super()._get_module_for_linking()

    def _get_module_for_linking(self) -> Any:
        """Return the LLVM module of the kernel with all its callees, for functions that Numba compiles itself."""
        whole = self.by_itself().clone()
        _link_into(whole, self._linking_libraries)
        return whole


class _WholeCode(JITCodeLibrary):  # type: ignore[misc]  # as above
    """Code that LLVM optimises once. Numba's own passes before that take an eighth of the compilation time."""

    _optimize_functions = _KernelCode._optimize_functions

    def _optimize_final_module(self) -> None:
        made = self._codegen._module_pass_manager()
        passes, *builder = made if isinstance(made, tuple) else (made,)  # without a builder before Numba 0.62
        passes.run(self._final_module, *builder)


class _EntryCode(_WholeCode):
    """The code of an entry with all its direct and indirect callees, linked and optimised once.

    Routines compiled by another process are excluded. `objects` maps their names to their object files.
    """

    objects: dict[str, bytes]

    def finalize(self) -> None:
        self._late = _link_into(self._final_module, self._linking_libraries, apart=True)
        self._linking_libraries.clear()
        progress.current().translated()
        super().finalize()

    def _finalize_final_module(self) -> None:
        self.objects = {late.name: late.machine_code() for late in self._late}
        load_objects(self._codegen, self.objects)
        super()._finalize_final_module()

    def serialize_using_object_code(self) -> tuple[str, str, tuple[bytes, bytes]]:
        named = (f'@"{f.name}"' for f in self._final_module.functions if not f.is_declaration)
        names = llvmlite.binding.parse_assembly("".join(f"define void {name}() {{ ret void }}\n" for name in named))
        return self.name, "object", (self._get_compiled_object(), names.as_bitcode())


def _link_into(module: Any, libraries: list[Any], apart: bool = False) -> list[_LateCode]:
    """Link the callees into `module`, callers first, because LLVM links only symbols that are already referenced.

    With `apart`, routines that another process compiles are not linked. Returns those routines.
    """
    backwards: dict[int, Any] = {}

    def visit(library: Any) -> None:
        if id(library) not in backwards:
            if isinstance(library, _KernelCode):
                for called in reversed(library._linking_libraries):
                    visit(called)
            backwards[id(library)] = library

    for library in reversed(libraries):
        visit(library)
    late = [library for library in backwards.values() if apart and isinstance(library, _LateCode)]
    for library in reversed(backwards.values()):
        if library not in late:
            is_kernel = isinstance(library, _KernelCode)
            module.link_in(library.by_itself() if is_kernel else library._get_module_for_linking(), preserve=True)
    return late


_LONG_NAME = 200


@functools.cache
def _mangled(kind: str, name: str) -> tuple[str, tuple[int]]:
    return kind, (int.from_bytes(hashlib.sha256(name.encode()).digest()[:7], "big"),)


class _Status:
    """The status that a call returns. Code for an attribute is made when it is read; Numba makes it for all of them."""

    def __init__(self, code: Any, excinfoptr: Any, builder: Any, whole: Callable[[], Any]) -> None:
        self.code, self.excinfoptr, self._builder, self._whole = code, excinfoptr, builder, whole

    @property
    def is_error(self) -> Any:
        unlike = [self._builder.icmp_signed("!=", self.code, passed) for passed in (RETCODE_OK, RETCODE_NONE)]
        return self._builder.and_(*unlike)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._whole(), name)


class _AdaptedNumba:
    """The changes to Numba that apply while a kernel compiles, under Numba's own compilation lock.

    Other code of the process is not affected.

    - `SLP_VECTORIZE`: LLVM joins adjacent equal operations into vector instructions. The results are bit-identical.
      Measured saving: one twentieth of a flight's time.
    - `get_call_type`: the type of a call is cached by its arguments. Without the cache, Numba tries all templates at
      every addition. Measured saving: one fifth of a compilation.
    - `mangling_args`: symbols in machine code contain a hash of a record's layout. Numba uses a counter of the records
      in a process instead, so code that other processes stored for other layouts can have the same name. For a tuple
      with records, Numba writes all their fields, which takes 17,000 characters.
    - `generic_resolve`, `get_getattr`: an array in a record is read as a pointer (fields.py).
    - `_get_return_status`, `return_status_propagate`: kernels contain no `try`, so that a caller passes an error of a
      call on without a test of its kind.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._before: list[tuple[Any, str, Any]] = []

    @staticmethod
    def _changes() -> tuple[tuple[Any, str, Any], ...]:
        """Return owner, name and value of each change; call types are cached until the change is undone."""
        find_type, known = BaseFunction.get_call_type, dict[tuple[int, Any, Any], Any]()

        def known_type(function: Any, context: Any, args: Any, named: Any) -> Any:
            if named:
                return find_type(function, context, args, named)
            key = id(function), context, args
            if key not in known:
                # The entry contains `function`, so that its id stays unique.
                known[key] = function, find_type(function, context, args, named)
            return known[key][1]

        find_status, propagate = CPUCallConv._get_return_status, CPUCallConv.return_status_propagate
        find_field, find_reader = RecordAttribute.generic_resolve, BaseContext.get_getattr

        def pointer_to_field(template: Any, record: Any, name: str) -> Any:
            return field_pointer(find_field(template, record, name))

        def pointer_reader(context: Any, record: Any, name: str) -> Any:
            if isinstance(record, types.Record) and field_pointer(record.typeof(name)) is not record.typeof(name):
                return read_pointer
            return find_reader(context, record, name)

        def lean_status(of: Any, builder: Any, code: Any, where: Any) -> Any:
            return _Status(code, where, builder, functools.partial(find_status, of, builder, code, where))

        def pass_on(of: Any, builder: Any, status: Any) -> None:
            if isinstance(status, _Status):
                builder.store(status.excinfoptr, of._get_excinfo_argument(builder.function))
                builder.ret(status.code)
            else:
                propagate(of, builder, status)

        layout = property(lambda record: _mangled("Record", record.name))
        plain = vars(types.Type)["mangling_args"].fget
        short = property(lambda of: plain(of) if len(of.name) < _LONG_NAME else _mangled(type(of).__name__, of.name))
        return (
            (numba.config, "SLP_VECTORIZE", 1),
            (BaseFunction, "get_call_type", known_type),
            (types.Record, "mangling_args", layout),
            (types.Type, "mangling_args", short),
            (CPUCallConv, "_get_return_status", lean_status),
            (CPUCallConv, "return_status_propagate", pass_on),
            (RecordAttribute, "generic_resolve", pointer_to_field),
            (BaseContext, "get_getattr", pointer_reader),
        )

    def __enter__(self) -> None:
        self._depth += 1
        if self._depth == 1:
            changes = self._changes()
            self._before = [(owner, name, vars(owner)[name]) for owner, name, _ in changes]
            for owner, name, value in changes:
                setattr(owner, name, value)

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._depth == 0:
            for owner, name, value in self._before:
                setattr(owner, name, value)


adapted_numba = _AdaptedNumba()

_PASSES = (
    TranslateByteCode,
    FixupArgs,
    IRProcessing,
    GenericRewrites,
    ReconstructSSA,
    NopythonTypeInference,
    PreLowerStripPhis,
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
)
"""The passes of Numba that kernels need.

The passes for closures, `with`, exceptions, array expressions, parallel loops and inlining of Python code are omitted.
"""


class _Passes:
    """The pipeline of `_PASSES`, without the analysis, timing and reports that Numba adds to each pass."""

    pipeline_name = "kernel"
    exec_times: ClassVar = dict[str, Any]()

    @staticmethod
    def run(state: Any) -> None:
        for each in _PASSES:
            each().run_pass(state)


class EntryCompiler(CompilerBase):  # type: ignore[misc]  # Numba has no types
    """A Numba compiler that creates code of class `code` and suspends garbage collection.

    Garbage collection takes a tenth of the compilation time and frees almost nothing.
    """

    code: type[JITCodeLibrary] = _EntryCode

    def define_pipelines(self) -> list[Any]:
        return [_Passes]

    def _compile_core(self) -> Any:
        self.state.library = self.code(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        self.state.library.enable_object_caching()
        collecting = gc.isenabled()
        gc.disable()
        function = self.state.func_id.func
        try:
            with adapted_numba, self._counted(function):
                result = super()._compile_core()
            progress.current().translated(function)
            return result
        finally:
            if collecting:
                gc.enable()

    @contextlib.contextmanager
    def _counted(self, function: Any) -> Iterator[None]:
        """Count the function as part of the compilation in progress, or as a separate compilation."""
        with progress.compilation("", function), progress.current().part(function):
            yield


class KernelCompiler(EntryCompiler):
    code = _KernelCode

    @contextlib.contextmanager
    def _counted(self, function: Any) -> Iterator[None]:
        yield


class DisjointCompiler(KernelCompiler):
    def _compile_core(self) -> Any:
        self.state.flags.noalias = True
        return super()._compile_core()


class _RareCode(_KernelCode):
    """The code of a routine that LLVM never inlines."""

    def add_ir_module(self, module: Any) -> None:
        for function in module.functions:
            if not function.is_declaration:
                function.attributes.add("noinline")
        super().add_ir_module(module)


class RareCompiler(DisjointCompiler):
    code = _RareCode


class _LateCode(_KernelCode):
    """The code of a routine that a separate process compiles; the entry collects it last."""

    def __init__(self, compiler: BesideCompiler, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self._finalized = True
        self._compiler, self._code = compiler, kept_routine(name) if compiler.is_kept else b""
        if self._code:
            progress.current().loaded(compiler.function)
            return
        pipe, write = os.pipe()
        with warnings.catch_warnings():  # Python 3.12 warns of locks held by other threads; the child takes none
            warnings.simplefilter("ignore", DeprecationWarning)
            self._child = os.fork()
        if self._child == 0:
            os.close(pipe)
            compiler.compile_and_leave(name, write)
        os.close(write)
        self._pipe = os.fdopen(pipe, "rb")

    def by_itself(self) -> Any:
        return self._compiler.module_here(self.name)

    def machine_code(self) -> bytes:
        if not self._code:
            with self._pipe as pipe:
                while not select.select([pipe], [], [], _REPORT_S)[0]:
                    progress.current().report()
                self._code = pipe.read()
            if os.waitpid(self._child, 0)[1] != 0:
                self._code = self._compiler.machine_code_here(self.name)
        return self._code


class BesideCompiler(DisjointCompiler):
    """A compiler that runs in a parallel process while this process compiles the caller.

    It is restricted to routines without a return value, which the caller needs only when the entry is loaded.
    """

    allowed = sys.platform == "linux" and cores() > 1

    def _compile_core(self) -> Any:
        if not self.allowed or threading.current_thread() is not threading.main_thread():
            return self._part_here()
        state, function = self.state, self.state.func_id
        state.flags.noalias = True  # part of the name, as is the number: routines are stored by name
        known = (*map(str, state.args), *state.targetctx.codegen().magic_tuple(), numba.__version__)
        number = hashlib.sha256(repr(known).encode()).hexdigest()[:16] if self.is_kept else secrets.token_hex(8)
        described = FunctionDescriptor(
            True,
            function.modname,
            function.func_qualname,
            function.func_qualname,
            "",
            {},
            types.none,
            {},
            function.arg_names,
            (),
            mangler=state.targetctx.mangler,
            argtypes=tuple(state.args),
            noalias=True,
            abi_tags=[state.flags.get_mangle_string(), number],
        )
        try:
            library = _LateCode(self, state.targetctx.codegen(), described.llvm_func_name)
        except OSError:  # no further process or no pipe is available
            return self._part_here()
        compiled = object()
        state.targetctx.insert_user_function(compiled, described, [library])
        return compile_result(
            typing_context=state.typingctx,
            target_context=state.targetctx,
            entry_point=compiled,
            library=library,
            signature=signature(types.none, *state.args),
            objectmode=False,
            fndesc=described,
        )

    @property
    def is_kept(self) -> bool:
        return is_own(self.state.func_id.filename)

    @property
    def function(self) -> Any:
        return self.state.func_id.func

    def here(self) -> Any:
        return super()._compile_core()

    def _part_here(self) -> Any:
        with progress.current().part(self.function):
            return self.here()

    def module_here(self, name: str) -> Any:
        """Return the LLVM module of the routine with all its callees, under the symbol `name`.

        All other symbols of the module are made private. The loader takes equal names in several objects, even local
        names, for one function, and the function of another object may have other arguments.
        """
        result = self.here()
        progress.current().translated()
        module = result.library._get_module_for_linking()
        module.get_function(result.fndesc.llvm_func_name).name = name
        for each in (*module.functions, *module.global_variables):
            if not each.is_declaration:
                each.linkage = "external" if each.name == name else "private"
        return module

    def machine_code_here(self, name: str) -> bytes:
        codegen = self.state.targetctx.codegen()
        library = _WholeCode(codegen, name)
        with progress.current().part(self.function):
            library._final_module = self.module_here(name)
            library._optimize_final_module()
            code = bytes(codegen._tm.emit_object(library._final_module))
        if self.is_kept:
            keep_routine(name, code)
        return code

    def compile_and_leave(self, name: str, write: int) -> None:
        """Write the routine's machine code to the pipe `write` in the child process, and end that process."""
        status = 1
        try:
            BesideCompiler.allowed = False
            progress.watchers.clear()
            with os.fdopen(write, "wb") as pipe:
                pipe.write(self.machine_code_here(name))
            status = 0
        finally:
            os._exit(status)
