"""The one place that knows how kernels are compiled.

A kernel is a plain Python function over floats, flat arrays and records. `@kernel` marks the small pieces,
`@routine` the large ones, `@entry` the few that Python calls: their machine code is kept in a cache folder whose name
holds a hash of all of maxq's sources. Numba itself looks only at the file of the function that is called, so that
without this an edited callee would keep its old machine code.

`NUMBA_DISABLE_JIT=1` runs the same functions as plain Python.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import gc
import hashlib
import inspect
import io
import os
import secrets
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import llvmlite.binding
import numba
import numpy as np
from numba import types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, compile_result
from numba.core.compiler_machinery import PassManager
from numba.core.funcdesc import FunctionDescriptor
from numba.core.runtime import rtsys
from numba.core.typed_passes import (
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.types.functions import BaseFunction
from numba.core.typing import signature
from numba.core.untyped_passes import FixupArgs, GenericRewrites, IRProcessing, ReconstructSSA, TranslateByteCode
from numba.extending import intrinsic, overload
from numba.np import numpy_support
from numpy.typing import NDArray

from maxq.control.kernel.records import constants_in

if sys.platform != "win32":
    import fcntl

Function = TypeVar("Function", bound=Callable[..., object])
Array = TypeVar("Array", NDArray[np.float64], NDArray[np.int64])


_KERNEL_FREE = {
    "scenario",
    "log",
    "packing",
    "run",
    "campaign",
    "api.py",
}  # of sim/: what no kernel takes anything from


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _source_files() -> tuple[Path, ...]:
    """Python sources that may hold a kernel or a constant that one uses, wherever they are installed."""
    layers = Path(__file__).resolve().parents[2]
    held = (sorted((layers / layer).rglob("*.py")) for layer in ("control", "sim"))
    alone = sorted((layers / "design/margins").glob("many*.py"))  # design/ and tools/ hold no others
    of_layers = (p for paths in held for p in paths if not _KERNEL_FREE.intersection(p.relative_to(layers).parts))
    return (*alone, *of_layers)


def source_hash() -> str:
    """First 16 hex digits of the SHA-256 of all sources that may hold a kernel."""
    digest = hashlib.sha256()
    for path in _source_files():
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def own_cache(name: str) -> Path:
    """A folder for machine code or results, made where it is missing: in `$MAXQ_CACHE`, else the user's cache folder.

    Raises PermissionError where another user owns it or may write to it: what lies there is run and believed.
    """
    base = os.environ.get("MAXQ_CACHE") or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "maxq"
    )
    for folder in (Path(base), Path(base) / name):
        with contextlib.suppress(OSError):  # where nothing can be kept, everything is worked out anew
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if hasattr(os, "getuid") and folder.exists():
            status = folder.stat()
            advice = "give a cache folder of your own to which no one else may write (chmod go-w)"
            if status.st_uid != os.getuid():
                raise PermissionError(errno.EACCES, f"this cache belongs to another user; {advice}", str(folder))
            if status.st_mode & 0o022:
                raise PermissionError(errno.EACCES, f"other users may write to this cache; {advice}", str(folder))
    return Path(base) / name


def cache_folder() -> Path:
    """Folder of the compiled kernels."""
    return own_cache(f"kernels-{source_hash()}")


_FOLDER, _SOURCES = str(cache_folder()), frozenset(map(str, _source_files()))


class _CheckedFile(IndexDataCacheFile):  # type: ignore[misc]  # Numba has no types
    """Numba's files of one function's machine code, each with its SHA-256 at the end: a damaged one is made anew.

    Numba reads neither file to its end, and takes the index as empty and code as missing where that is returned here.
    """

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(content.getvalue() + hashlib.sha256(content.getvalue()).digest())

    def _load_index(self) -> dict[Any, str]:
        return super()._load_index() if _is_whole(self._index_path) else {}

    def _load_data(self, name: str) -> Any:
        path = self._data_path(name)
        if not _is_whole(path):
            raise OSError(errno.EIO, "this machine code is damaged", path)
        return super()._load_data(name)


class _Place:
    """Where an entry's machine code is kept and for how long it is good, as Numba asks for it.

    That of maxq's own sources, whose hash is the folder's name, holds wherever they are installed and whenever they
    were written; that of other files by their path, size and age.
    """

    def __init__(self, function: Any, path: str) -> None:
        self._line, own = function.__code__.co_firstlineno, os.path.realpath(path) in _SOURCES
        name = function.__module__ if own else hashlib.sha256(os.path.abspath(path).encode()).hexdigest()[:16]
        self._folder = os.path.join(_FOLDER, name)
        status = os.stat(path)
        self._stamp = () if own else (status.st_size, status.st_mtime_ns)

    @classmethod
    def from_function(cls, function: Any, path: str) -> _Place | None:
        """None where nothing can be kept."""
        try:
            place = cls(function, path)
            place.ensure_cache_path()
        except OSError:
            return None
        return place

    def ensure_cache_path(self) -> None:
        os.makedirs(self._folder, exist_ok=True)
        if not os.access(self._folder, os.W_OK):
            raise PermissionError(errno.EACCES, "this folder cannot be written", self._folder)

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> tuple[int, ...]:
        return self._stamp

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Kept(CompileResultCacheImpl):  # type: ignore[misc]  # Numba has no types
    """What is kept of an entry: machine code without the LLVM code that it was made from, which no other one links."""

    _locator_classes = (_Place,)

    def reduce(self, result: Any) -> Any:
        return result.library.objects, super().reduce(result)

    def rebuild(self, context: Any, kept: Any) -> Any:
        _load_objects(context.codegen(), kept[0])
        result = super().rebuild(context, kept[1])
        result.library._shared_module = None  # Numba refuses to link what has none
        return result


class _EntryCache(FunctionCache):  # type: ignore[misc]  # Numba has no types
    _impl_class = _Kept
    _turn: int | None = None  # descriptor of the locked file while this process compiles

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        self._cache_file.__class__ = _CheckedFile

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Machine code from disk, without Numba's implementations of NumPy, which load SciPy's linear algebra: a
        compilation loads them; what has been compiled needs no more than the reference counts of arrays.

        Where there is none, this process compiles: workers that start together wait for the first of them.
        """
        rtsys.initialize(target)
        for _ in range(2):
            with self._guard_against_spurious_io_errors():
                found = self._load_overload(signature, target)
                if found is not None or self._turn is not None:
                    break
            self._await_turn(repr(self._index_key(signature, target.codegen())))
        if found is not None:
            self._end_turn()
        return found

    def save_overload(self, signature: Any, data: Any) -> None:
        try:
            super().save_overload(signature, data)
        finally:
            self._end_turn()

    def _await_turn(self, key: str) -> None:
        name = hashlib.sha256(f"{self._cache_file._index_path}{key}".encode()).hexdigest()[:16]
        if sys.platform != "win32":
            with contextlib.suppress(OSError):  # where nothing can be kept or locked, each compiles for itself
                self._turn = os.open(Path(_FOLDER, f"{name}.lock"), os.O_RDWR | os.O_CREAT, 0o600)
                fcntl.flock(self._turn, fcntl.LOCK_EX)

    def _end_turn(self) -> None:
        if self._turn is not None:  # nor may a process that was forked meanwhile keep others waiting
            with contextlib.suppress(OSError):
                fcntl.flock(self._turn, fcntl.LOCK_UN)
            os.close(self._turn)
            self._turn = None


def _is_whole(path: str) -> bool:
    try:
        content = Path(path).read_bytes()
    except OSError:
        return False
    return hashlib.sha256(content[:-32]).digest() == content[-32:]


# LLVM joins like operations that stand side by side into vector instructions: the same arithmetic, bit by bit;
# measured, a twentieth of a flight's time. Numba looks at this whenever it compiles, so that it holds for all of the
# process.
numba.config.SLP_VECTORIZE = 1


class _KernelCode(JITCodeLibrary):  # type: ignore[misc]  # Numba has no types
    """Code of one kernel as it was translated, for the entry that it ends up in; Python has no way to call it.

    Numba would link each function with all that it calls, optimise that, and emit machine code, at every level of the
    calls again.
    """

    @property
    def codegen(self) -> _KernelCode:
        return self

    def set_env(self, name: str, environment: object) -> None:
        """Only a wrapper for Python reads a function's environment."""

    def get_pointer_to_function(self, name: str) -> int:
        return 0  # as Numba's own, where there is no such function

    def finalize(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def by_itself(self) -> Any:
        """LLVM module of the kernel without what it calls."""
        return super()._get_module_for_linking()

    def _get_module_for_linking(self) -> Any:
        """The kernel with all that it calls: for functions that know of Numba only."""
        whole = self.by_itself().clone()
        _link_into(whole, self._linking_libraries)
        return whole


class _EntryCode(JITCodeLibrary):  # type: ignore[misc]  # Numba has no types
    """Code of an entry with all that it calls, directly or not: linked and optimised once, but for routines whose
    machine code is made in another process: `objects`, object files.
    """

    objects: tuple[bytes, ...] = ()

    def finalize(self) -> None:
        self._late = _link_into(self._final_module, self._linking_libraries, apart=True)
        self._linking_libraries.clear()
        super().finalize()

    def _finalize_final_module(self) -> None:
        if not self.objects:
            self.objects = tuple(late.machine_code() for late in self._late)
            _load_objects(self._codegen, self.objects)
        super()._finalize_final_module()

    def serialize_using_object_code(self) -> tuple[str, str, tuple[bytes, bytes]]:
        named = (f'@"{f.name}"' for f in self._final_module.functions if not f.is_declaration)
        names = llvmlite.binding.parse_assembly("".join(f"define void {name}() {{ ret void }}\n" for name in named))
        return self.name, "object", (self._get_compiled_object(), names.as_bitcode())


def _load_objects(codegen: Any, objects: tuple[bytes, ...]) -> None:
    for code in objects:
        codegen._engine._ee.add_object_file(llvmlite.binding.ObjectFileRef.from_data(code))


def _link_into(module: Any, libraries: list[Any], apart: bool = False) -> list[_LateCode]:
    """Link what a module calls into it, callers first: LLVM takes only what has been referred to by then.

    `apart`: without routines that another process compiles; returns these.
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


_find_type = BaseFunction.get_call_type


def _known_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """What Numba's own function returns for these arguments, looked for once: it tries its templates anew at every
    addition. Measured, a fifth of a compilation.
    """
    if kws:
        return _find_type(self, context, args, kws)
    known = self.__dict__.setdefault("maxq_known", {})
    if args not in known:
        known[args] = _find_type(self, context, args, kws)
    return known[args]


BaseFunction.get_call_type = _known_type  # type: ignore[method-assign]  # of all of the process: a pure function

# A record handed over from Python is typed by its layout, field by field, at every call: 2 ms for a flight computer's.
numpy_support.from_struct_dtype = functools.cache(numpy_support.from_struct_dtype)  # a pure function, too

_PASSES = (
    TranslateByteCode, FixupArgs, IRProcessing, GenericRewrites, ReconstructSSA,
    NopythonTypeInference, PreLowerStripPhis,
    IRLegalization, NativeLowering, NoPythonBackend,
)  # fmt: skip  # untyped, typed, lowering
"""Numba's, without those for what kernels have not: closures, `with`, exceptions, array expressions, parallel loops,
inlining on this level."""


class _EntryCompiler(CompilerBase):  # type: ignore[misc]  # Numba has no types
    """Numba's compiler into other code, without collecting garbage: a tenth of the time, and there is next to none."""

    code: type[JITCodeLibrary] = _EntryCode

    def define_pipelines(self) -> list[Any]:
        passes = PassManager("kernel")
        for each in _PASSES:
            passes.add_pass(each, each.__name__)
        passes.finalize()
        return [passes]

    def _compile_core(self) -> Any:
        self.state.library = self.code(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        self.state.library.enable_object_caching()
        collecting = gc.isenabled()
        gc.disable()
        try:
            return super()._compile_core()
        finally:
            if collecting:
                gc.enable()


class _KernelCompiler(_EntryCompiler):
    code = _KernelCode


class _DisjointCompiler(_KernelCompiler):
    def _compile_core(self) -> Any:
        self.state.flags.noalias = True
        return super()._compile_core()


class _LateCode(_KernelCode):
    """Code of a routine that a process of its own compiles: waited for when the entry is ready but for it."""

    def __init__(self, compiler: _BesideCompiler, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self._finalized = True
        self._compiler, self._code = compiler, b""
        pipe, write = os.pipe()
        with warnings.catch_warnings():  # of Python 3.12, that another thread may hold a lock: none that is asked for
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
                self._code = pipe.read()
            if os.waitpid(self._child, 0)[1] != 0:
                self._code = self._compiler.machine_code_here(self.name)
        return self._code


class _BesideCompiler(_DisjointCompiler):
    """Compiles in a process beside this one, which goes on with the caller: nothing of a routine that returns nothing
    has to be known before the entry is loaded.
    """

    allowed = sys.platform == "linux" and cores() > 1

    def _compile_core(self) -> Any:
        if not self.allowed or threading.current_thread() is not threading.main_thread():
            return self.here()
        state, function = self.state, self.state.func_id
        state.flags.noalias = True  # a part of the name; so is a number: each entry has machine code of its own
        described = FunctionDescriptor(
            True, function.modname, function.func_qualname, function.unique_name, "", {}, types.none, {},
            function.arg_names, (), mangler=state.targetctx.mangler, argtypes=tuple(state.args),
            noalias=True, abi_tags=[state.flags.get_mangle_string(), secrets.token_hex(8)], uid=function.unique_id,
        )  # fmt: skip  # a line each otherwise
        try:
            library = _LateCode(self, state.targetctx.codegen(), described.llvm_func_name)
        except OSError:  # no further process, or no pipe, to be had
            return self.here()
        compiled = object()
        state.targetctx.insert_user_function(compiled, described, [library])
        return compile_result(
            typing_context=state.typingctx, target_context=state.targetctx, entry_point=compiled, library=library,
            signature=signature(types.none, *state.args), objectmode=False, fndesc=described,
        )  # fmt: skip  # a line each otherwise

    def here(self) -> Any:
        return super()._compile_core()

    def module_here(self, name: str) -> Any:
        """LLVM module of the routine as `name`, with all that it calls.

        What else is in it has no name in machine code: the loader takes equal names of several objects, local ones
        too, for one function, and that of another object may take other arguments by now.
        """
        result = self.here()
        module = result.library._get_module_for_linking()
        module.get_function(result.fndesc.llvm_func_name).name = name
        for each in (*module.functions, *module.global_variables):
            if not each.is_declaration:
                each.linkage = "external" if each.name == name else "private"
        return module

    def machine_code_here(self, name: str) -> bytes:
        codegen = self.state.targetctx.codegen()
        library = JITCodeLibrary(codegen, name)
        library._final_module = self.module_here(name)
        library._optimize_final_module()
        return bytes(codegen._tm.emit_object(library._final_module))

    def compile_and_leave(self, name: str, write: int) -> None:
        """In the other process: write the routine's machine code, and end."""
        status = 1
        try:
            _BesideCompiler.allowed = False
            with os.fdopen(write, "wb") as pipe:
                pipe.write(self.machine_code_here(name))
            status = 0
        finally:
            os._exit(status)


def kernel(function: Function) -> Function:
    """Compile `function` into the kernel that calls it (nogil, IEEE arithmetic as written: no fastmath).

    Division by zero gives inf or nan as in C (`error_model="numpy"`); the flight loop checks the state for it.
    Not cached by itself: its machine code is part of the entry that calls it. LLVM is told to inline it; measured, a
    fifth of a flight's time was spent on passing arguments.
    """
    return _for_kernels(function, forceinline=True)


def routine(function: Function) -> Function:
    """As `kernel`, for what is large and called from several places: compiled once and called.

    `forceinline=False` is explicit: Numba passes `forceinline` on from a kernel to its callees.
    """
    return _for_kernels(function, forceinline=False)


def disjoint_routine(function: Function) -> Function:
    """As `routine`, for arguments of which none is written where another one lies: what has been read of one need not
    be read again after a write to another. Measured, a sixteenth of a flight's time.
    """
    return _for_kernels(function, _DisjointCompiler, forceinline=False)


def routine_beside(function: Function) -> Function:
    """As `disjoint_routine`, for what is large, has arguments without aliases and returns nothing: on Linux compiled by
    a process beside this one. Measured, a third of the wait for a first flight.
    """
    return _for_kernels(function, _BesideCompiler, forceinline=False)


class _Kernel:
    """A kernel as compiled callers and Python know it: compiled with its first caller, without the wrappers that Python
    and C would call through, which are a quarter of the wait for a first flight, and a second time where Python calls
    it. What loads kept machine code only makes no dispatcher for it.
    """

    def __init__(self, function: Callable[..., object], compiler: type[CompilerBase], options: dict[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self.py_func, self._compiler = function, compiler
        self._options = {"nogil": True, "error_model": "numpy", **options}

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self._complete(*arguments, **named)

    @functools.cached_property
    def _complete(self) -> Any:
        return numba.njit(self.py_func, pipeline_class=_EntryCompiler, **self._options)

    @property
    def _numba_type_(self) -> Any:
        """What Numba asks a global for where it compiles a caller."""
        return self._bare._numba_type_

    @functools.cached_property
    def _bare(self) -> Any:
        bare = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "pipeline_class": self._compiler}
        dispatcher = numba.njit(_signed(self.py_func), **bare, **self._options)

        def keep(result: Any) -> None:  # as Numba's own, but for telling the dispatcher's C code of the machine code
            dispatcher.overloads[tuple(result.signature.args)] = result

        dispatcher.add_overload = keep
        if self._options["forceinline"] or self._compiler is _BesideCompiler:
            _compile_for_all_integers(dispatcher)
        return dispatcher


def _for_kernels(function: Function, compiler: type[CompilerBase] = _KernelCompiler, **options: Any) -> Function:
    return function if numba.config.DISABLE_JIT else _Kernel(function, compiler, options)  # type: ignore[return-value]


def _compile_for_all_integers(compiled: Any) -> None:
    """Compile once, whatever integers a caller writes out: Numba compiles anew for each. Where the kernel is inlined,
    LLVM knows them all the same. Measured, a quarter of the wait for a first flight.
    """
    template_for = compiled.get_call_template

    def widened(of: Any) -> Any:
        return types.unliteral(of) if isinstance(of, types.IntegerLiteral) else of

    def template(args: tuple[Any, ...], named: dict[str, Any]) -> Any:
        return template_for(tuple(map(widened, args)), {name: widened(of) for name, of in named.items()})

    compiled.get_call_template = template


def _signed(function: Function) -> Function:
    """With its signature written down: Numba asks for it three times, a tenth of a second for all kernels."""
    function.__dict__["__signature__"] = inspect.signature(function)
    return function


def entry(function: Function) -> Function:
    """As `kernel`, for the few that Python calls: the machine code is kept on disk, with all that it calls."""
    compiled = numba.njit(_signed(function), nogil=True, error_model="numpy", pipeline_class=_EntryCompiler)
    if not numba.config.DISABLE_JIT:
        with contextlib.suppress(RuntimeError):  # of Numba, where nothing can be kept
            compiled._cache = _EntryCache(compiled.py_func)
    return compiled  # type: ignore[no-any-return]  # Numba has no types


def from_python(function: Function) -> Function:
    """A kernel for callers in Python: an entry of its own. A bare kernel is compiled anew in every process."""
    return entry(getattr(function, "py_func", function))


@intrinsic  # type: ignore[untyped-decorator]  # Numba has no types
def _address(context: Any, array: Any) -> Any:
    """Numba intrinsic: pointer to the first element of a contiguous array."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.make_array(signature.args[0])(context, builder, arguments[0]).data

    return types.CPointer(array.dtype)(array), build


def bare_pointer(array: Array) -> Array:
    """The array's elements without the array, for use inside an entry only: its caller keeps the array alive.

    Numba counts references to an array, atomically, at every call it is passed to, and looks at the sign of every
    index; measured, both were half of a flight's time. A bare pointer supports one non-negative
    index and nothing else. In plain Python it is just the array.
    """
    return array


@overload(bare_pointer, target="cpu")
def _bare_pointer(array):  # type: ignore[no-untyped-def]  # Numba compares both signatures, annotations included
    return lambda array: _address(array)  # noqa: PLW0108  # Numba compiles this body: it cannot be the intrinsic itself


def integer(record: Any, name: str) -> int:
    """An integer of a record, for kernels: a constant to the compiler where the record's type tells it.

    `records.with_constants` makes such types. `name` is written out where this is called.
    """
    return int(record[name])


@overload(integer, prefer_literal=True)
def _integer(record, name):  # type: ignore[no-untyped-def]  # Numba compares both signatures, annotations included
    name = getattr(name, "literal_value", None)
    if name is None:
        return None  # Numba asks again with the name itself
    known = constants_in(record.fields)
    if name in known:
        value = known[name]
        return lambda record, name: value
    return lambda record, name: record[name]
