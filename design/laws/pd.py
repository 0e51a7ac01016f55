"""The proportional-derivative law with its bending filter, linear side (Lee, Ahn & Roh eqs 33, 37 to 41).

    C = F(s) (k_p, k_d)  on  (angle_rad, rate_radps)

Its kernel is control/laws/pd.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.filters import BendingFilter, Discretization
from maxq.control.kernel.tables import Cubics
from maxq.design.laws.bending_filter import AnyFilter, check_period, filter_poles, filter_state_space
from maxq.design.model.state_space import ComplexArray, StateSpace, chain
from maxq.design.model.vehicle_at import Plane
from maxq.sim.packing.computer import bending_filter, gains_of
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.tables_csv import CsvTable


@dataclass(frozen=True)
class Pd:
    """The law at one instant (`law.Controller`); `filter` None is 1. Raises ValueError for gains not finite."""

    k_p: float
    k_d_s: float
    filter: AnyFilter = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.k_p) and np.isfinite(self.k_d_s)):
            raise ValueError(f"k_p = {self.k_p}, k_d_s = {self.k_d_s}: allowed are finite numbers")

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("angle_rad", "rate_radps") if self.k_p != 0.0 else ("rate_radps",)

    @property
    def gains(self) -> Mapping[str, float]:
        return {"k_p": self.k_p, "k_d_s": self.k_d_s}

    def check(self, sample_s: float | None) -> None:
        check_period(self.filter, sample_s)

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        return np.asarray(self.filter_response(frequencies_hz)[..., None] * self._gains())

    def filter_response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        f = np.asarray(frequencies_hz, float)
        if self.filter is None:
            return np.ones(f.shape, np.complex128)
        return self.filter.frequency_response(2.0 * np.pi * f)

    def at(self, s: ComplexArray) -> ComplexArray:
        out = np.ones(np.shape(s), np.complex128)
        for n, d in () if not isinstance(self.filter, BendingFilter) else self.filter.polynomials():
            out = out * (n[0] + s * (n[1] + s * n[2])) / (d[0] + s * (d[1] + s * d[2]))
        return np.asarray(out[..., None] * self._gains())

    def static_gain(self, name: str) -> float:
        return {"angle_rad": self.k_p, "rate_radps": self.k_d_s}.get(name, 0.0)

    def poles(self) -> ComplexArray:
        return filter_poles(self.filter)

    def state_space(self) -> StateSpace:
        n = len(self.inputs)
        gains = StateSpace(
            np.zeros((0, 0)), np.zeros((0, n)), np.zeros((1, 0)), self._gains()[None], (), self.inputs, ("law_rad",)
        )
        return chain(gains, filter_state_space(self.filter))

    def scaled(self, factor: float) -> Pd:
        return replace(self, k_p=factor * self.k_p, k_d_s=factor * self.k_d_s)

    def _gains(self) -> np.ndarray:
        return np.array([self.static_gain(name) for name in self.inputs])


@dataclass(frozen=True)
class PdDesign:
    """The law of a design file (`law.DesignedLaw`). `gains`: table of the flight computer (`pd.gains_table`)."""

    gains: Cubics
    filter: BendingFilter
    discretization: Discretization = "prewarped"
    prewarp_hz: float | None = None

    @staticmethod
    def of(design: Design) -> PdDesign:
        """From a design file."""
        return PdDesign(
            gains_of(design), bending_filter(design), design.filter.discretization, design.filter.prewarp_hz
        )

    @staticmethod
    def frozen(design: Design, time_s: float) -> Design:
        """The design with the gains of one instant at all times."""
        law = PdDesign.of(design)
        laws = [law.at(time_s, "pitch", None), law.at(time_s, "yaw", None)]
        pitch, yaw = (
            CsvTable("", {"time_s": np.array([time_s]), "k_p": np.array([x.k_p]), "k_d_s": np.array([x.k_d_s])})
            for x in laws
        )
        gains = design.gains.model_copy(update={"table": pitch, "yaw": None, "yaw_table": yaw})
        return design.model_copy(update={"gains": gains})

    def at(self, time_s: float, plane: Plane, sample_s: float | None) -> Pd:
        column = 0 if plane == "pitch" else 2
        k_p, k_d_s = self.gains(time_s)[column : column + 2]
        return Pd(float(k_p), float(k_d_s), self.filter_at(sample_s))

    def filter_at(self, sample_s: float | None) -> AnyFilter:
        """The filter, continuous or as the flight computer runs it at a period."""
        if sample_s is None:
            return self.filter
        return self.filter.discretize(sample_s, self.discretization, self.prewarp_hz)
