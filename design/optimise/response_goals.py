"""Goals on step responses, and goals that are functions in Python.

Both follow from the response of the law at fixed points of each plant, together with its derivatives with respect to
the own parameters. A function receives the real and the imaginary part of L. Its gradient is found by complex steps:
the function is evaluated for parts that are complex, with the derivative of each part times a small step as imaginary
part.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.design.case.goals import GoalSection
from maxq.design.laws.law import LawVariables, LimitValues
from maxq.design.laws.task import DB
from maxq.design.loop.step import StepPaths
from maxq.design.model.state_space import ComplexArray
from maxq.design.optimise.features import Mask, maxima
from maxq.design.quantities import STEPS, Sense

MOST_PEAKS = 4  # peaks of a response with rows of their own
MOST_KNOWN = 64  # responses kept
STEP = 1e-30  # complex step
DB_PER_DEG = 0.2  # of a function in degrees: 6 dB for 30 deg


@dataclass(frozen=True)
class LoopValues:
    """The open loop L at an operating point, as the argument of a function of a goal.

    `re` and `im` are the parts of L at `frequency_hz`, (points,). They are complex in a complex step. A function may
    therefore use analytic operations (sums, products, quotients, roots, logarithms, `phase_rad`), and max, min or an
    index to select points, but neither abs nor conjugates. The properties of this class comply.
    """

    time_s: float
    frequency_hz: Array
    re: Any
    im: Any

    @property
    def gain_db(self) -> Any:
        """Return the magnitude of L, dB."""
        return 0.5 * DB * np.log(self.re**2 + self.im**2)

    @property
    def sensitivity_db(self) -> Any:
        """Return the magnitude of S = 1 / (1 + L), dB."""
        return -0.5 * DB * np.log((1.0 + self.re) ** 2 + self.im**2)

    @property
    def closed_db(self) -> Any:
        """Return the magnitude of T = L S, dB."""
        return self.gain_db + self.sensitivity_db

    @property
    def phase_rad(self) -> Any:
        """Return the phase of L, rad, in (-pi, pi]."""
        angle = np.arctan2(np.real(self.im), np.real(self.re))
        turn = np.imag(self.im) * np.real(self.re) - np.imag(self.re) * np.real(self.im)
        return angle + 1j * turn / np.real(self.re**2 + self.im**2) if np.iscomplexobj(self.re) else angle


GoalFunction = Callable[[LoopValues], Any]
REGISTERED: dict[str, GoalFunction] = {}
"""Functions of Python callers, by the name that a case gives in place of FILE.py:NAME."""


@contextmanager
def registered(functions: Mapping[str, GoalFunction]) -> Iterator[None]:
    """Make functions known by their names while the context is active."""
    before = dict(REGISTERED)
    REGISTERED.update(functions)
    try:
        yield
    finally:
        REGISTERED.clear()
        REGISTERED.update(before)


def function_of(name: str) -> GoalFunction:
    """Return the function that a goal names as FILE.py:NAME. Raises ValueError if it cannot be loaded."""
    if name in REGISTERED:
        return REGISTERED[name]
    file, _, attribute = name.rpartition(":")
    path = Path(file)
    spec = importlib.util.spec_from_file_location(f"maxq_goal_{path.stem}", path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise ValueError(f"goal.function = {name!r}: there is no such file; allowed is FILE.py:NAME")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # a fault of the user's file, whatever it is
        raise ValueError(f"goal.function = {name!r}: {type(error).__name__}: {error}") from None
    found = getattr(module, attribute, None)
    if not callable(found):
        raise ValueError(f"goal.function = {name!r}: the file defines no function {attribute}")
    REGISTERED[name] = found
    return found  # type: ignore[no-any-return]  # callable


@dataclass(frozen=True)
class FunctionPaths:
    """The measurements of a plant (F, inputs) per gimbal command at the frequencies exp(x) of a function."""

    x: Array
    paths: ComplexArray


@dataclass(frozen=True)
class GoalData:
    """The data of a plant for its goals: `steps` for step responses, and `functions` by the name of a function."""

    steps: StepPaths | None
    functions: dict[str, FunctionPaths]


@dataclass(frozen=True)
class ResponseGoal:
    """A goal on a step response, or a function, in the form of a `law.LawLimit`.

    `applies` (plants,) selects the plants, and `term` is its term in the objective, or -1.
    """

    goal: GoalSection
    applies: Mask
    term: int
    linear = False

    @property
    def text(self) -> str:
        return self.goal.about.label

    @property
    def unit(self) -> str:
        return self.goal.about.unit

    @property
    def sense(self) -> Sense:
        return self.goal.about.sense

    @property
    def weight(self) -> float:
        return self.goal.weight or 1.0

    @property
    def objective(self) -> bool:
        return self.term >= 0


class _LawAtPoints:
    """A law at points x = ln f (real or complex) with the own parameters of one plant."""

    def __init__(self, law: LawVariables, x: ComplexArray | Array, own: Array) -> None:
        self.law, self.axis = law, law.axis(x)  # type: ignore[arg-type]  # complex points
        self.own = np.broadcast_to(own, (len(x), len(own)))
        self.common, self.gains = law.at_points(own, self.axis)

    def sum(self, parts: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the sum of C times `parts` (points, inputs), and the gradient of its logarithm (points, own)."""
        total = (self.gains * parts).sum(axis=1)
        by = self.law.gradient(self.own, self.axis, parts / total[:, None])
        return np.asarray(self.common * total), by


class ResponseGoals:
    """All goals of a case on step responses, and its functions, with the data of all plants."""

    def __init__(
        self, goals: Sequence[ResponseGoal], law: LawVariables, each: Sequence[GoalData], times_s: Array
    ) -> None:
        self.limits, self.law, self.each, self.times_s = goals, law, each, times_s
        self._known: dict[tuple[int, bytes], dict[str, tuple[Array, ComplexArray]]] = {}

    def values(self, own: Array) -> list[LimitValues]:
        """Return the values of all goals at the own parameters of each plant, (plants, own).

        A `LimitValues` has the number of its goal. A response has a row for each of its largest peaks.
        """
        rows: list[list[tuple[int, int, float, float, Array]]] = [[] for _ in self.limits]
        for plant, mine in enumerate(own):
            steps = [k for k, g in enumerate(self.limits) if g.applies[plant] and g.goal.quantity in STEPS]
            found = self._stepped(plant, mine) if steps else {}
            for k in steps:
                rows[k] += [(plant, *row) for row in _peaks(self.limits[k].goal, found, self._steps(plant))]
            for k, one in enumerate(self.limits):
                if one.applies[plant] and one.goal.quantity == "function":
                    rows[k].append((plant, 0, *self._function(one.goal, plant, mine)))
        return [self._as_values(k, each, own.shape[1]) for k, each in enumerate(rows)]

    def again(self, number: int, own: Array, plant: IntArray, index: IntArray) -> Array:
        """Return the gradients of the excess of goal `number` at the same peaks of the same plants, (rows, own)."""
        goal, out = self.limits[number].goal, np.zeros((len(plant), own.shape[1]))
        for p in np.unique(plant):
            mine = np.flatnonzero(plant == p)
            if goal.quantity == "function":
                out[mine] = self._function(goal, int(p), own[p])[2]
            else:
                found = self._stepped(int(p), own[p])
                out[mine] = _at_samples(goal, found, self._steps(int(p)), index[mine])[2]
        return out

    def _as_values(self, number: int, rows: Sequence[tuple[int, int, float, float, Array]], size: int) -> LimitValues:
        goal = self.limits[number].goal
        plant, index, value, excess = (np.array([row[k] for row in rows]) for k in range(4))
        gradient = np.array([row[4] for row in rows]).reshape(len(rows), size)
        limit = np.full(len(rows), np.nan if goal.limit is None else goal.limit)
        plant, index = plant.astype(np.int64), index.astype(np.int64)
        return LimitValues(number, plant, value.astype(float), limit, excess.astype(float), gradient, index)

    def _steps(self, plant: int) -> StepPaths:
        steps = self.each[plant].steps
        assert steps is not None
        return steps

    def _stepped(self, plant: int, own: Array) -> dict[str, tuple[Array, ComplexArray]]:
        """Return the samples of each response, and the derivatives of its transform (F, own), by quantity.

        They are the attitude and the gimbal command after a unit step of the commanded attitude, and the attitude after
        a unit step of the gimbal offset. The latest results are kept, since several goals use them.
        """
        key = plant, own.tobytes()
        if key not in self._known:
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            self._known[key] = self._new_stepped(plant, own)
        return self._known[key]

    def _new_stepped(self, plant: int, own: Array) -> dict[str, tuple[Array, ComplexArray]]:
        data = self._steps(plant)
        law = _LawAtPoints(self.law, data.x, own)
        loop, loop_by = law.sum(data.paths)
        commanded, commanded_by = law.sum(np.stack([self._of_command(name, data) for name in self.law.inputs], axis=1))
        s = 1.0 / (1.0 + loop)
        by_s = -(loop * s)[:, None] * loop_by  # of ln S
        gimbal, offset = commanded * s * data.step(), data.angle * s * data.step()
        gimbal_by = gimbal[:, None] * (commanded_by + by_s)
        attitude = data.response(gimbal * data.angle), gimbal_by * data.angle[:, None]
        return {
            "overshoot_pct": attitude,
            "settling_pct": attitude,
            "gimbal_peak": (data.response(gimbal), gimbal_by),
            "offset_peak": (data.response(offset), offset[:, None] * by_s),
        }

    @staticmethod
    def _of_command(name: str, data: StepPaths) -> ComplexArray:
        """Return the part of a commanded attitude in a measurement, with the sign of the command."""
        ones = np.ones(len(data.x), np.complex128)
        return {"angle_rad": ones, "angle_integral_rads": data.sums}.get(name, 0.0 * ones)

    def _function(self, goal: GoalSection, plant: int, own: Array) -> tuple[float, float, Array]:
        """Return value, excess and gradient of the excess of a function at a plant."""
        assert goal.function is not None
        assert goal.limit is not None
        data = self.each[plant].functions[goal.function]
        loop, by = _LawAtPoints(self.law, data.x, own).sum(data.paths)
        slopes = (loop[:, None] * by).T
        function, hz = function_of(goal.function), np.exp(data.x)
        time_s = float(self.times_s[plant])
        value = float(np.real(function(LoopValues(time_s, hz, loop.real, loop.imag))))
        gradient = [
            np.imag(function(LoopValues(time_s, hz, loop.real + 1j * STEP * d.real, loop.imag + 1j * STEP * d.imag)))
            / STEP
            for d in slopes
        ]
        sign = 1.0 if goal.about.sense == "<=" else -1.0
        scale = {"dB": 1.0, "deg": DB_PER_DEG}.get(goal.unit, DB / abs(goal.limit or 1.0)) * sign
        return value, scale * (value - goal.limit), scale * np.array(gradient, float)


def _at_samples(
    goal: GoalSection, found: dict[str, tuple[Array, ComplexArray]], data: StepPaths, index: IntArray
) -> tuple[Array, Array, Array]:
    """Return value, excess and gradient of a response at samples `index`."""
    assert goal.limit is not None
    samples, transform_by = found[goal.quantity]
    value, sign = _deviation(goal, samples)
    by = (data.weights(index.astype(float)) @ transform_by).real * sign[index, None]
    scale = DB / goal.limit
    return value[index], scale * (value[index] - goal.limit), scale * by


def _deviation(goal: GoalSection, samples: Array) -> tuple[Array, Array]:
    """Return the limited quantity at each sample, and its derivative with respect to the sample."""
    if goal.quantity == "overshoot_pct":
        return 100.0 * (samples - 1.0), np.full(len(samples), 100.0)
    if goal.quantity == "settling_pct":
        return 100.0 * np.abs(samples - 1.0), 100.0 * np.sign(samples - 1.0)
    return np.abs(samples), np.sign(samples)


def _peaks(
    goal: GoalSection, found: dict[str, tuple[Array, ComplexArray]], data: StepPaths
) -> list[tuple[int, float, float, Array]]:
    """Return sample, value, excess and gradient of the largest peaks of a response."""
    first = 0 if goal.after_s is None else int(np.ceil(goal.after_s / data.sample_s - 1e-9))
    last = min(int(goal.until_s / data.sample_s + 1e-9), data.count - 1)
    value = _deviation(goal, found[goal.quantity][0])[0][first : last + 1]
    if not len(value):
        return []
    top = maxima(value, np.array([0]), np.array([len(value) - 1]))
    index = first + top[np.argsort(-value[top], kind="stable")[:MOST_PEAKS]]
    return list(zip(index.tolist(), *_at_samples(goal, found, data, index), strict=True))
