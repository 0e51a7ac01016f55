"""The law of a user: a class in a Python file that a design or a case names as `plug_in`.

The class has these attributes. `v` are the values of the variables, in their order.

- `variables`: start, lower and upper bound of each variable by its name; all are positive.
- `constant`: optional, names of the variables that are constant over the flight. Others are scheduled as gains are.
- `matrices(v, sample_s)`: A (n, n), B (n, 2), C (1, n) and D (1, 2) of the discrete law from attitude error (rad) and
  rate (rad/s) to the command (rad), as flown. `v` may be complex, for derivatives by complex steps.
- `step(v, memory, error_rad, rate_radps, sample_s)`: the command of a sample. `memory` (MAX_MEMORY,) is 0 at the start.
  Numba compiles the function. A function of ctypes is called as it is, with the arguments of control/laws/own.py.

The law must be stable: an integral of the attitude would be a pole at z = 1. Reading a design or a case does not run
the code.
"""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.control.laws.own import MAX_MEMORY, MAX_VALUES, OwnLaw
from maxq.control.structures import OWN
from maxq.sim.input.errors import ScenarioError
from maxq.sim.scenario.flight_code import CodeFile, announce, code_hash
from maxq.sim.scenario.python_file import ImportFailure, described, imported

SMALL_RAD, SAMPLES, SAME = 1e-4, 40, 1e-9
"""The amplitude and the number of samples of the comparison of `step` with `matrices`, and its tolerance."""
STEP, DIFFERENCE, ALIKE = 1e-30, 1e-5, 1e-4  # complex step; relative step and tolerance of the differences

LawMatrices = tuple[Array, Array, Array, Array]
_C_FUNCTION: Any = type(ctypes.CFUNCTYPE(None)()).__mro__[1]  # the base of all functions of ctypes


@dataclass(frozen=True)
class OwnCode:
    """A law of a user. `lower` and `upper` (variables,) are the bounds, `start` (variables,) the first values."""

    title: str
    names: tuple[str, ...]
    start: Array
    lower: Array
    upper: Array
    constant: tuple[str, ...]
    matrices: Callable[[Any, float], Any]
    step: Any

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the names of the columns of a gain table."""
        return tuple(OWN + name for name in self.names)

    def system(self, values: Array | NDArray[np.complex128], sample_s: float) -> LawMatrices:
        """Return A, B, C, D of the law at values of its variables, real or complex. Raises ScenarioError."""
        try:
            given = self.matrices(values, sample_s)
        except Exception as error:  # a fault of the user's file, whatever it is
            raise self.error("matrices", described(error)) from None
        try:
            each: list[Any] = [np.atleast_2d(np.asarray(m, values.dtype)) for m in given]
            a, b, c, d = each
        except (TypeError, ValueError) as error:
            allowed = "four arrays A, B, C, D"
            raise self.error("matrices", f"returns another form ({error})", allowed) from None
        n = len(a) if a.size else 0
        a, b, c = a.reshape(n, n) if n == 0 else a, b.reshape(0, 2) if n == 0 else b, c.reshape(1, 0) if n == 0 else c
        wanted = ((n, n), (n, 2), (1, n), (1, 2))
        for name, matrix, shape in zip("ABCD", (a, b, c, d), wanted, strict=True):
            if matrix.shape != shape:
                raise self.error("matrices", f"{name} has the shape {matrix.shape}", f"{shape}")
            if not np.isfinite(matrix).all():
                raise self.error("matrices", f"{name} is not finite", "finite numbers")
        if n > 0 and not np.iscomplexobj(a) and np.abs(np.linalg.eigvals(a)).max() >= 1.0:
            largest = np.abs(np.linalg.eigvals(a)).max()
            raise self.error("matrices", f"the law has a pole of magnitude {largest:.6g}", "poles below 1")
        return a, b, c, d

    def slopes(self, values: Array, sample_s: float) -> list[LawMatrices]:
        """Return the derivatives of A, B, C, D with respect to each variable. Raises ScenarioError."""
        out = []
        for k in range(len(values)):
            moved = values.astype(np.complex128)
            moved[k] += 1j * STEP
            a, b, c, d = self.system(moved, sample_s)
            out.append((a.imag / STEP, b.imag / STEP, c.imag / STEP, d.imag / STEP))
        return out

    def check_slopes(self, sample_s: float) -> None:
        """Compare `slopes` at the start with differences. Raises ScenarioError if complex steps are lost."""
        for k, (name, slopes) in enumerate(zip(self.names, self.slopes(self.start, sample_s), strict=True)):
            moved = np.zeros(len(self.start))
            moved[k] = DIFFERENCE * self.start[k]
            ends = zip(*(self.system(self.start + s * moved, sample_s) for s in (1.0, -1.0)), strict=True)
            for slope, (up, down) in zip(slopes, ends, strict=True):
                by = (up - down) / (2.0 * moved[k])
                if (np.abs(by - slope) > ALIKE * np.abs(by).max(initial=1e-9)).any():
                    problem = f"the derivative with respect to {name} is lost in a complex step"
                    raise self.error("matrices", problem, "operations that keep complex numbers, not float or abs")

    def error(self, key: str, problem: str, allowed: str = "") -> ScenarioError:
        """Return the error of a part of the law, by the name of the part."""
        return ScenarioError(self.title, problem, key, allowed=allowed)


def own_code(file: CodeFile) -> OwnCode:
    """Return the law in a file. Raises ScenarioError if the file has changed, fails or lacks a part."""
    return _own_code(file.file, file.sha256, file.member, file.title)


@lru_cache(maxsize=16)
def _own_code(file: str, sha256: str, member: str, title: str) -> OwnCode:
    def error(problem: str, key: str = "", allowed: str = "") -> ScenarioError:
        return ScenarioError(title, problem, key, allowed=allowed)

    try:
        present, _ = code_hash(Path(file))
    except OSError as failure:
        raise error(f"cannot be read: {(failure.strerror or str(failure)).lower()}", "plug_in") from None
    if present != sha256:
        allowed = f"that with sha256 {sha256[:16]}; plug_in = 'FILE.py:LAW' names the present file"
        raise error("is not the law of the design", "plug_in", allowed)
    announce("runs a law", title, sha256)
    try:
        law = getattr(imported(file, sha256), member, None)
    except ImportFailure as failure:
        raise error(str(failure), "plug_in") from None
    if law is None:
        raise error(f"defines no {member}", "plug_in", "the name of a class in the file")
    for part in ("variables", "matrices", "step"):
        found = getattr(law, part, None)
        if found is None or (part != "variables" and not callable(found)):
            what = "a table of start, lower and upper bound by name" if part == "variables" else "a function"
            raise error("is missing" if found is None else "is not a function", part, what)
    names, (start, lower, upper) = _variables(law.variables, error)
    constant = tuple(getattr(law, "constant", ()))
    if strange := [name for name in constant if name not in names]:
        raise error(f"names {strange[0]!r}", "constant", ", ".join(names))
    return OwnCode(title, names, start, lower, upper, constant, law.matrices, law.step)


def _variables(given: Any, error: Callable[..., ScenarioError]) -> tuple[tuple[str, ...], Array]:
    allowed = "name: (start, lower, upper), with 0 < lower <= start <= upper"
    if not isinstance(given, dict) or not 1 <= len(given) <= MAX_VALUES:
        raise error("is not a table of variables", "variables", f"1 .. {MAX_VALUES} of {allowed}")
    for name, three in given.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise error(f"has the name {name!r}", "variables", "names of letters, digits and _")
        try:
            start, lower, upper = map(float, three)
        except (TypeError, ValueError):
            start, lower, upper = np.nan, np.nan, np.nan
        if not 0.0 < lower <= start <= upper < np.inf:
            raise error(f"is {three!r}", f"variables.{name}", allowed)
    return tuple(given), np.array([list(map(float, three)) for three in given.values()]).T


@lru_cache(maxsize=64)
def check_step(file: CodeFile, values: tuple[float, ...], sample_s: float) -> None:
    """Compare `step` with `matrices` for small random errors and rates. Raises ScenarioError for a difference.

    A function of ctypes is compared, too. A law that is not linear for small signals is rejected.
    """
    code, v = own_code(file), np.array(values)
    a, b, c, d = code.system(v, sample_s)
    given = SMALL_RAD * np.random.default_rng(1).standard_normal((SAMPLES, 2))
    memory, state, linear, flown = np.zeros(MAX_MEMORY), np.zeros(len(a)), np.zeros(SAMPLES), np.zeros(SAMPLES)
    call = _caller(code)
    for k, u in enumerate(given):
        linear[k] = float((c @ state)[0] + (d @ u)[0])
        state = a @ state + b @ u
        try:
            flown[k] = call(v, memory, float(u[0]), float(u[1]), sample_s)
        except Exception as error:  # a fault of the user's file, whatever it is
            raise code.error("step", described(error)) from None
    wrong = ~(np.abs(flown - linear) <= SAME * np.abs(linear).max() + 1e-300)
    if wrong.any():
        k = int(np.argmax(wrong))
        problem = f"differs from matrices at sample {k}: {flown[k]:.9g} rad, linear {linear[k]:.9g} rad"
        raise code.error("step", problem, f"the same commands for errors of {SMALL_RAD:g} rad")


def _caller(code: OwnCode) -> Callable[..., float]:
    """Return the function `step` for a call from Python."""
    if not isinstance(code.step, _C_FUNCTION):
        return lambda *given: float(code.step(*given))
    step = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 3)(_address(code.step))

    def call(v: Array, memory: Array, *sample: float) -> float:
        room = np.array([*sample, np.nan])
        failed = step(v.ctypes.data, memory.ctypes.data, room.ctypes.data)
        if failed != 0:
            raise ValueError(f"returned {failed}")
        return float(room[3])

    return call


def _address(function: Any) -> int:
    return ctypes.cast(function, ctypes.c_void_p).value or 0


def pack_own_law(file: CodeFile, values: tuple[float, ...], sample_s: float) -> OwnLaw:
    """Return the record of the law of a file, whose first row of the gain table is `values`. Raises ScenarioError."""
    code = own_code(file)
    check_step(file, values, sample_s)
    return OwnLaw(_compiled(file)[0], len(code.names))


@lru_cache(maxsize=16)
def _compiled(file: CodeFile) -> tuple[int, Any]:
    """Return the address of the compiled `step`, and the objects that keep it valid. Raises ScenarioError."""
    code = own_code(file)
    if isinstance(code.step, _C_FUNCTION):
        return _address(code.step), code.step
    count, room, own = len(code.names), MAX_MEMORY, code.step
    if numba.config.DISABLE_JIT:
        pointer = ctypes.POINTER(ctypes.c_double)

        def called(values: Any, memory: Any, sample: Any) -> int:
            v, m, x = (np.ctypeslib.as_array(p, (n,)) for p, n in ((values, count), (memory, room), (sample, 4)))
            try:
                x[3] = own(v, m, x[0], x[1], x[2])
            except Exception as error:  # it cannot pass through the flight, which ends by a command that is no number
                logging.getLogger("maxq").warning("maxq: %s: step: %s", code.title, described(error))
                return 1
            return 0

        kept = ctypes.CFUNCTYPE(ctypes.c_int, pointer, pointer, pointer)(called)
        return _address(kept), kept
    inner = numba.njit(error_model="numpy", boundscheck=True)(own)
    pointer_type = numba.types.CPointer(numba.types.float64)

    def compiled(values, memory, sample):  # type: ignore[no-untyped-def]  # Numba compiles it
        x = numba.carray(sample, 4)
        x[3] = inner(numba.carray(values, count), numba.carray(memory, room), x[0], x[1], x[2])
        return 0

    try:
        made = numba.cfunc(numba.types.int32(pointer_type, pointer_type, pointer_type))(compiled)
    except Exception as error:  # a fault of the user's file, whatever it is
        said = " ".join(line.strip() for line in str(error).splitlines() if line.strip())
        raise code.error("step", f"Numba cannot compile it: {said[:300]}") from None
    return int(made.address), made
