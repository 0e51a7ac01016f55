"""Define a second control law for tests: PID without a filter, with the minimum that design/laws requires of a law.

    C = (k_d, k_p + k_i / s)  on  (rate_radps, angle_rad)

with s on the bilinear axis in a sampled loop. It differs from PD by the order of inputs, a gain that depends on
frequency, a pole at zero and three gain schedules.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array, IntArray
from maxq.design.laws.bending_filter import laplace_axis
from maxq.design.laws.law import Axis, Controller, DesignedLaw, LawLimit, LimitValues, LogResponse
from maxq.design.laws.registry import LawKind
from maxq.design.laws.schedule import GainSchedules, interpolation_weights
from maxq.design.laws.task import Task
from maxq.design.model.state_space import StateSpace
from maxq.sim.scenario.schema_design import Design

WARP_HZ = 1.0
INPUTS = ("rate_radps", "angle_rad")
KEYS = ("k_d_s", "k_p", "k_i_1ps")


@dataclass(frozen=True)
class Pid:
    """The law at one instant; `sample_s` None: continuous."""

    k_d_s: float
    k_p: float
    k_i_1ps: float
    sample_s: float | None

    @property
    def inputs(self) -> tuple[str, ...]:
        return INPUTS

    @property
    def gains(self) -> Mapping[str, float]:
        return {key: getattr(self, key) for key in KEYS}

    def check(self, sample_s: float | None) -> None:
        if sample_s != self.sample_s:
            raise ValueError(f"law of sample_s = {self.sample_s}: the loop's period is {sample_s}")

    def response(self, frequencies_hz: ArrayLike) -> np.ndarray:
        return self.at(laplace_axis(np.log(np.asarray(frequencies_hz, float)), self.sample_s, WARP_HZ)[0])

    def filter_response(self, frequencies_hz: ArrayLike) -> np.ndarray:
        return np.ones(np.shape(frequencies_hz), np.complex128)

    def at(self, s: np.ndarray) -> np.ndarray:
        return np.stack([np.full(np.shape(s), self.k_d_s), self.k_p + self.k_i_1ps / s], axis=-1)

    def static_gain(self, name: str) -> float:
        return {"rate_radps": self.k_d_s, "angle_rad": math.inf}.get(name, 0.0)

    def poles(self) -> np.ndarray:
        return np.zeros(1, np.complex128)

    def state_space(self) -> StateSpace:
        held, step, through = 0.0, 1.0, 0.0  # 1 / s, or (z + 1) / (z - 1) / c = 1 / c + 2 / c / (z - 1)
        if self.sample_s is not None:
            c = 2 * math.pi * WARP_HZ / math.tan(math.pi * WARP_HZ * self.sample_s)
            held, step, through = 1.0, 2.0 / c, 1.0 / c
        gains = [[self.k_d_s, self.k_p + through * self.k_i_1ps]]
        a, b, c_row = [[held]], [[0.0, step]], [[self.k_i_1ps]]
        return StateSpace(*(np.array(m) for m in (a, b, c_row, gains)), ("integral",), INPUTS, ("command_rad",))

    def scaled(self, factor: float) -> Pid:
        return replace(self, **{key: factor * value for key, value in self.gains.items()})


@dataclass(frozen=True)
class PidDesign:
    """The gains (3, nodes) over time."""

    nodes_s: Array
    gains: Array
    over = "time_s"

    @staticmethod
    def of(_: Design) -> PidDesign:
        """Return fixed gains, since the file has no keys for this law."""
        return PidDesign(np.array([0.0]), np.array([[0.5], [1.0], [0.05]]))

    def at(self, time_s: float, plane: str, sample_s: float | None) -> Pid:
        k_d, k_p, k_i = (float(np.interp(time_s, self.nodes_s, k)) for k in self.gains)
        return Pid(k_d, k_p, k_i, sample_s)

    def continuous_at(self, time_s: float, plane: str, sample_s: float) -> Pid:
        return self.at(time_s, plane, None)

    def tables(self) -> dict[str, Any]:
        return {}

    def record(self) -> dict[str, Any]:
        return {"gains": dict(zip(KEYS, self.gains.tolist(), strict=True))}


class PidVariables:
    """The variables: ln of the three gains at the first and the last operating point."""

    inputs, poles_at_zero, own_size = INPUTS, 1, 3
    limits: tuple[LawLimit, ...] = ()

    def __init__(self, task: Task, like: object = None) -> None:
        self.task = task
        nodes = np.unique(task.times_s)[[0, -1]]
        self.gains = GainSchedules(KEYS, nodes, interpolation_weights(task.times_s, nodes))
        self.lower, self.upper = (np.repeat(np.log(ends), 2) for ends in ((0.05, 0.05, 0.02), (5.0, 10.0, 3.0)))

    @property
    def names(self) -> tuple[str, ...]:
        return self.gains.names

    def own(self, variables: Array) -> Array:
        return np.log(self.gains.at_plants(variables)).T

    def jacobian(self, variables: Array) -> Array:
        return self.gains.log_gradients(variables).transpose(1, 0, 2)

    def bend(self, variables: Array, slopes: Array) -> Array:
        return self.gains.log_curvature(variables, slopes.T)

    def axis(self, x: Array) -> Axis:
        return laplace_axis(x, self.task.sample_s, WARP_HZ)

    def response(self, variables: Array, plant: IntArray, axis: Axis) -> tuple[np.ndarray, np.ndarray]:
        k_d, k_p, k_i = self.gains.at_plants(variables)[:, plant]
        return np.ones(len(plant), np.complex128), np.stack([k_d, k_p + k_i / axis[0]], axis=1)

    def log_response(self, own: Array, axis: Axis) -> LogResponse:
        s, s1, s2 = axis
        none, zero = np.zeros(len(s), np.complex128), np.zeros((len(s), 2), np.complex128)
        k_d, k_p, k_i = np.exp(own).T
        value, first, second = zero.copy(), zero.copy(), zero.copy()
        value[:, 0], value[:, 1] = k_d, k_p + k_i / s
        first[:, 1], second[:, 1] = -k_i * s1 / s**2, k_i * (2.0 * s1**2 / s**3 - s2 / s**2)
        return LogResponse((none, none, none), (value, first, second))

    def gradient(self, own: Array, axis: Axis, weights: np.ndarray) -> np.ndarray:
        k_d, k_p, k_i = np.exp(own).T
        return np.stack([k_d * weights[:, 0], k_p * weights[:, 1], k_i / axis[0] * weights[:, 1]], axis=1)

    def limit_values(self, own: Array) -> list[LimitValues]:
        return []

    def controllers(self, variables: Array) -> list[Controller]:
        return [Pid(*(float(k) for k in gains), self.task.sample_s) for gains in self.gains.at_plants(variables).T]

    def designed(self, variables: Array) -> PidDesign:
        return PidDesign(self.gains.nodes, self.gains.at_nodes(variables))

    def variables_of(self, law: DesignedLaw) -> Array | None:
        return self.gains.from_nodes(law.nodes_s, law.gains) if isinstance(law, PidDesign) else None

    def starts(self, count: int, seed: int) -> list[Array]:
        rng = np.random.default_rng(seed)
        middle = np.repeat(np.log([0.6, 1.0, 0.1]), 2)
        return [middle + 0.3 * rng.standard_normal(6) for _ in range(count)]

    def leap_size(self, number: int) -> Array:
        return np.full(6, 0.2)

    def simpler(self) -> tuple[PidVariables, Callable[[Array], Array]] | None:
        return None


PID = LawKind(PidVariables, INPUTS, PidDesign.of, lambda design, _: design)
