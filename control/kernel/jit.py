"""Decorators that compile kernels.

A kernel is a plain Python function of floats, flat arrays and records. `@kernel` marks small functions, `@routine`
large functions, and `@entry` the few that Python calls. The machine code of entries is stored on disk (kept_code.py).

`NUMBA_DISABLE_JIT=1` runs the same functions as plain Python.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
from numba import types
from numba.core.compiler import CompilerBase
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from maxq.control.kernel.compilers import BesideCompiler, DisjointCompiler, EntryCompiler, KernelCompiler, RareCompiler
from maxq.control.kernel.kept_code import EntryCache
from maxq.control.kernel.records import constants_in

Function = TypeVar("Function", bound=Callable[..., object])
Array = TypeVar("Array", NDArray[np.float64], NDArray[np.int64])


def kernel(function: Function) -> Function:
    """Compile `function` as an inlined part of its callers (nogil, IEEE arithmetic as written, no fastmath).

    Division by zero gives inf or nan as in C (`error_model="numpy"`); the flight loop checks the state for them. A
    kernel is not cached, because its machine code is part of the entry that calls it. LLVM is instructed to inline it,
    because passing arguments took a fifth of a flight's time in measurements.
    """
    return _for_kernels(function, forceinline=True)


def formula(function: Function) -> Function:
    """Compile as `kernel` does, for index and size arithmetic and for operations on single vectors.

    Python calls the plain function, which is faster than loading machine code.
    """
    return _for_kernels(function, kind=_Formula, forceinline=True)


def routine(function: Function) -> Function:
    """Compile as `kernel` does, without inlining, for large functions called from several places.

    `forceinline=False` is explicit, because Numba otherwise passes the `forceinline` of a kernel on to its callees.
    """
    return _for_kernels(function, forceinline=False)


def disjoint_routine(function: Function) -> Function:
    """Compile as `routine` does, for functions whose written arguments overlap no other argument.

    The compiled code need not read values again after a write to another argument. Measured saving: one sixteenth of a
    flight's time.
    """
    return _for_kernels(function, DisjointCompiler, forceinline=False)


def routine_beside(function: Function) -> Function:
    """Compile as `disjoint_routine` does, on Linux in a parallel process.

    The function must be large and return nothing, and its arguments must not overlap. Measured saving: a third of the
    compilation time before a first flight.
    """
    return _for_kernels(function, BesideCompiler, forceinline=False)


def rare_routine(function: Function) -> Function:
    """Compile as `disjoint_routine` does and never inline, for code that few flights execute."""
    return _for_kernels(function, RareCompiler, forceinline=False)


class _Kernel:
    """A kernel that compiled functions and Python can call.

    A compiled caller compiles it without the wrappers for calls from Python and C, which take a quarter of the
    compilation time before a first flight. A call from Python compiles it again, as an entry. A process that only loads
    stored machine code creates no dispatcher.
    """

    def __init__(self, function: Callable[..., object], compiler: type[CompilerBase], options: dict[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self.py_func, self._compiler = function, compiler
        self._options = {"nogil": True, "error_model": "numpy", **options}
        self.is_inlined, self.is_apart = bool(options.get("forceinline")), compiler is BesideCompiler

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self._complete(*arguments, **named)

    @functools.cached_property
    def _complete(self) -> Any:
        return _kept(numba.njit(_signed(self.py_func), pipeline_class=EntryCompiler, **self._options))

    @property
    def _numba_type_(self) -> Any:
        """Return the Numba type of the kernel, which Numba reads when it compiles a caller."""
        return self._bare._numba_type_

    @functools.cached_property
    def _bare(self) -> Any:
        bare = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "pipeline_class": self._compiler}
        dispatcher = numba.njit(_signed(self.py_func), **bare, **self._options)

        def keep(result: Any) -> None:  # as in Numba, but without a registration in C code
            dispatcher.overloads[tuple(result.signature.args)] = result

        dispatcher.add_overload = keep
        if self.is_inlined or self.is_apart:
            _compile_for_all_integers(dispatcher)
        return dispatcher


class _Formula(_Kernel):
    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self.py_func(*arguments, **named)


def _for_kernels(
    function: Function, compiler: type[CompilerBase] = KernelCompiler, kind: type[_Kernel] = _Kernel, **options: Any
) -> Function:
    return function if numba.config.DISABLE_JIT else kind(function, compiler, options)  # type: ignore[return-value]  # called like the function


def _compile_for_all_integers(compiled: Any) -> None:
    """Compile once for all integer literals of callers; Numba would compile once for each.

    In an inlined kernel, LLVM still uses the values. Measured saving: a quarter of the compilation time before a first
    flight.
    """
    template_for = compiled.get_call_template

    def widened(of: Any) -> Any:
        return types.unliteral(of) if isinstance(of, types.IntegerLiteral) else of

    def template(args: tuple[Any, ...], named: dict[str, Any]) -> Any:
        return template_for(tuple(map(widened, args)), {name: widened(of) for name, of in named.items()})

    compiled.get_call_template = template


def _signed(function: Function) -> Function:
    """Attach its signature to a function, and return the function.

    Numba otherwise determines the signature three times, which takes a tenth of a second for all kernels.
    """
    function.__dict__["__signature__"] = inspect.signature(function)
    return function


def entry(function: Function) -> Function:
    """Compile as `kernel` does, for the few functions that Python calls.

    The machine code, with that of all callees, is stored on disk.
    """
    return _kept(numba.njit(_signed(function), nogil=True, error_model="numpy", pipeline_class=EntryCompiler))  # type: ignore[no-any-return]  # Numba has no types


def _kept(compiled: Any) -> Any:
    """Return the compiled function with a cache of its machine code on disk."""
    if not numba.config.DISABLE_JIT:
        with contextlib.suppress(RuntimeError):  # Numba raises it if no cache folder is writable
            compiled._cache = EntryCache(compiled.py_func)
    return compiled


def from_python(function: Function) -> Function:
    """Compile a kernel as a separate entry, for callers in Python.

    In contrast to a call of the kernel itself, this leaves the choice of inlining to the compiler.
    """
    return entry(getattr(function, "py_func", function))


@intrinsic  # type: ignore[untyped-decorator]  # Numba has no types
def _address(context: Any, array: Any) -> Any:
    """Return a pointer to the first element of a contiguous array (Numba intrinsic)."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.make_array(signature.args[0])(context, builder, arguments[0]).data

    return types.CPointer(array.dtype)(array), build


def bare_pointer(array: Array) -> Array:
    """Return a pointer to the elements of an array, for use inside an entry only; the caller must keep the array alive.

    Numba counts references to an array atomically at every call that passes the array, and checks the sign of every
    index. Together these took half of a flight's time in measurements. A bare pointer supports one non-negative index
    only. In plain Python, the array itself is returned.
    """
    return array


@overload(bare_pointer, target="cpu")
def _bare_pointer(array):  # type: ignore[no-untyped-def]  # Numba compares both signatures, annotations included
    return lambda array: _address(array)  # noqa: PLW0108  # Numba compiles this body: it cannot be the intrinsic itself


def address_of(array: Array) -> int:
    """Return the address of the first element of an array, for a call of C code with a pointer to the array."""
    return int(array.ctypes.data)


@intrinsic  # type: ignore[untyped-decorator]  # Numba has no types
def _as_integer(context: Any, pointer: Any) -> Any:
    """Return the address in a pointer (Numba intrinsic)."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ptrtoint(arguments[0], context.get_value_type(types.int64))

    return types.int64(pointer), build


@overload(address_of, target="cpu")
def _address_of(array):  # type: ignore[no-untyped-def]  # as above
    if isinstance(array, types.Array):
        return lambda array: _as_integer(_address(array))
    return lambda array: _as_integer(array)  # noqa: PLW0108  # as above


def integer(record: Any, name: str) -> int:
    """Return an integer of a record: a compile-time constant if the record's type contains its value.

    `records.with_constants` makes such types. `name` must be a literal. This function is for kernels.
    """
    return int(record[name])


@overload(integer, prefer_literal=True)
def _integer(record, name):  # type: ignore[no-untyped-def]  # Numba compares both signatures, annotations included
    name = getattr(name, "literal_value", None)
    if name is None:
        return None  # Numba calls again with the literal
    known = constants_in(record.fields)
    if name in known:
        value = known[name]
        return lambda record, name: value
    return lambda record, name: record[name]
