"""The linear model of the proportional-derivative law with its bending filter (Lee, Ahn & Roh, eqs 33, 37 to 41).

    C = F(s) (k_p, k_d, k_i)  on  (angle_rad, rate_radps, angle_integral_rads)

with k_i = 0 here. pid.py adds the integral, load_relief.py the lateral acceleration, and drift.py the drift. The rate
may be blended from several gyros (control/sensors.py); each gyro then has the gain k_d times its weight. The kernel of
the law is control/laws/pd.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from maxq.control.filter_schedule import FilterSchedule
from maxq.control.filters import BendingFilter, DiscreteFilter, Discretization
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Cubics
from maxq.control.laws.pd import GainSchedule, gains_table
from maxq.control.structures import Over, structure_of
from maxq.design.laws.bending_filter import AnyFilter, Lag, check_period, filter_poles, filter_state_space
from maxq.design.laws.law import DRIFTS
from maxq.design.model.instruments import ACCELERATION, Plane, further_rate
from maxq.design.model.state_space import ComplexArray, StateSpace, chain
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.packing.computer import bending_filter, gain_schedules
from maxq.sim.scenario.schema_design import Design, FilterSection

LoopFilter = tuple[BendingFilter, Discretization, float | None]
"""The continuous filter of a single loop, its discretisation, and its prewarping frequency in Hz."""
BANKS = ("attitude", "rate", "acceleration")


@dataclass(frozen=True)
class Pd:
    """The law at one instant (`law.Controller`).

    `filter` of None is a response of 1. `blend` contains the weights of the first gyro and of the further gyros. `lag`
    filters the acceleration and is used with a gain k_a or k_alpha. The gain k_alpha also needs `percussion_m` and
    `accel_per_incidence_mps2` (control/laws/load_relief.py). `loops` contains separate filters of attitude error, rate
    and acceleration. Raises ValueError for gains that are not finite.
    """

    k_p: float
    k_d_s: float
    filter: AnyFilter = None
    k_i_ps: float = 0.0
    k_a_s2pm: float = 0.0
    blend: tuple[float, ...] = (1.0,)
    lag: Lag | None = None
    k_alpha: float = 0.0
    percussion_m: float = 0.0
    accel_per_incidence_mps2: float = -1.0
    loops: tuple[AnyFilter, ...] = (None, None, None)
    k_zd_radspm: float = 0.0
    k_z_radpm: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(list(self.gains.values())).all():
            raise ValueError(", ".join(f"{k} = {v}" for k, v in self.gains.items()) + ": allowed are finite numbers")

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(n for n, gain in self._static.items() if n == "rate_radps" or gain != 0.0)

    @property
    def gains(self) -> Mapping[str, float]:
        names = ("k_i_ps", "k_a_s2pm", "k_alpha", "k_zd_radspm", "k_z_radpm")
        return {"k_p": self.k_p, "k_d_s": self.k_d_s, **{n: k for n in names if (k := getattr(self, n)) != 0.0}}

    def check(self, sample_s: float | None) -> None:
        for each in (self.filter, *self.loops):
            check_period(each, sample_s)

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        f = np.asarray(frequencies_hz)
        loops = [on_axis(each, f) for each in self.loops]
        lag, change = np.ones(f.shape, np.complex128), np.zeros(f.shape, np.complex128)
        if self.lag is not None:
            lag, change = self.lag.with_slopes(np.log(f))[0], self.lag.change_with_slopes(np.log(f))[0]
        return np.asarray(self.filter_response(f)[..., None] * self._of_inputs(loops, lag, change))

    def filter_response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        return on_axis(self.filter, np.asarray(frequencies_hz))

    @property
    def _per_mps2(self) -> float:
        """Return k_alpha per unit of acceleration, rad s2/m."""
        return self.k_alpha / self.accel_per_incidence_mps2

    @property
    def _weights(self) -> dict[str, float]:
        """Return the blending weight of each rate measurement by its name."""
        return {"rate_radps": self.blend[0], **{further_rate(k): w for k, w in enumerate(self.blend[1:], 2)}}

    def _of_inputs(self, loops: Sequence[Any], lag: Any, change: Any) -> ComplexArray:
        """Return C without the bending filter, (..., inputs).

        `loops` are the responses of the loop filters, `lag` that of the lag, and `change` that of lag and
        differentiation in series.
        """
        attitude, rate, acceleration = loops
        turning = (self.k_d_s - self._per_mps2 * self.percussion_m * change) * rate
        found = {name: weight * turning for name, weight in self._weights.items()}
        found |= {"angle_rad": self.k_p * attitude, "angle_integral_rads": self.k_i_ps * attitude}
        found |= {name: self.static_gain(name) for name in DRIFTS}
        found[ACCELERATION] = self.static_gain(ACCELERATION) * lag * acceleration
        return np.stack([found[name] + 0.0 * lag for name in self.inputs], axis=-1)

    @property
    def _static(self) -> dict[str, float]:
        """Return the gain at zero frequency by measurement, with the acceleration last."""
        rates = {name: self.k_d_s * weight for name, weight in self._weights.items()}
        own = {"angle_rad": self.k_p, "rate_radps": rates.pop("rate_radps"), "angle_integral_rads": self.k_i_ps}
        drifts = dict(zip(DRIFTS, (-self.k_zd_radspm, -self.k_z_radpm), strict=True))
        return {**own, **rates, **drifts, ACCELERATION: self._per_mps2 - self.k_a_s2pm}

    def static_gain(self, name: str) -> float:
        return self._static.get(name, 0.0)

    def poles(self) -> ComplexArray:
        poles = np.concatenate([filter_poles(each) for each in (self.filter, *self.loops)])
        return poles if self.lag is None else np.append(poles, self.lag.pole_radps)

    def state_space(self) -> StateSpace:
        attitude, rate, acceleration = (filter_state_space(each) for each in self.loops)
        change = -self._per_mps2 * self.percussion_m
        rows = []
        for name in self.inputs:
            gain, own = self.static_gain(name), filter_state_space(None) if name in DRIFTS else attitude
            none = (np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)))
            one = StateSpace(*none, np.array([[gain]]), (), (name,), ("law_rad",))
            if name in self._weights:
                own = rate
                if change != 0.0 and self.lag is not None:
                    one = self.lag.with_change(gain, change * self._weights[name])
            elif name == ACCELERATION:
                own = acceleration if self.lag is None else chain(acceleration, self.lag.state_space())
            rows.append(chain(own, one))
        states = tuple(f"{name}_{k}" for name, row in zip(self.inputs, rows, strict=True) for k in range(len(row.a)))
        a, b = (block_diag(*(getattr(row, part) for row in rows)) for part in ("a", "b"))
        c, d = (np.concatenate([getattr(row, part) for row in rows], axis=1) for part in ("c", "d"))
        return chain(StateSpace(a, b, c, d, states, self.inputs, ("law_rad",)), filter_state_space(self.filter))

    def scaled(self, factor: float) -> Pd:
        names = ("k_p", "k_d_s", "k_i_ps", "k_a_s2pm", "k_alpha", "k_zd_radspm", "k_z_radpm")
        return replace(self, **{name: factor * getattr(self, name) for name in names})


def on_axis(filter_: AnyFilter, frequencies_hz: Array) -> ComplexArray:
    if filter_ is None:
        return np.ones(frequencies_hz.shape, np.complex128)
    return filter_.frequency_response(2.0 * np.pi * frequencies_hz)


@dataclass(frozen=True)
class PdDesign:
    """The law of a design file (`law.DesignedLaw`): schedules of the gains in pitch and yaw, and of the filter.

    The filter is stored in continuous form. It is scheduled over the same quantity as the gains.
    """

    pitch: GainSchedule
    yaw: GainSchedule
    filter: FilterSchedule
    discretization: Discretization = "prewarped"
    prewarp_hz: float | None = None
    name: str = "pd"
    blend: tuple[tuple[float, ...], tuple[float, ...]] = ((1.0,), (1.0,))
    relief_hz: float | None = None
    loops: tuple[LoopFilter | None, ...] = (None, None, None)

    @staticmethod
    def of(design: Design) -> PdDesign:
        """Return the law of a design file."""
        form, filter_ = design.filter, bending_filter(design)
        return PdDesign(
            *gain_schedules(design.gains),
            filter_,
            form.discretization,
            form.prewarp_hz,
            design.law,
            design.blend.axes if design.blend is not None else ((1.0,), (1.0,)),
            design.load_relief.corner_hz if design.load_relief is not None else None,
            tuple(
                None if f is None else (f.continuous(), f.discretization, f.prewarp_hz)
                for f in (design.loop_filters.each if design.loop_filters is not None else (None,) * len(BANKS))
            ),
        )

    @property
    def over(self) -> Over:
        return self.pitch.over

    @cached_property
    def _table(self) -> Cubics:
        """Return the gain table with the interpolation of the flight computer."""
        return gains_table(self.pitch, self.yaw)

    @staticmethod
    def frozen(design: Design, at: float) -> Design:
        """Return the design with its gains and filter frozen at one instant, and without adaptation of the total gain.

        `at` is a value of the scheduling quantity, as in `law.DesignedLaw`.
        """
        law, planes = PdDesign.of(design), get_args(Plane)
        pitch, yaw = (
            CsvTable("", {law.over: np.array([at])} | {k: np.array([x]) for k, x in law.gains_at(at, plane).items()})
            for plane in planes
        )
        gains = design.gains.model_copy(update={"table": pitch, "yaw": None, "yaw_table": yaw})
        held = _section((law.filter(at), law.discretization, law.prewarp_hz))
        filter_ = FilterSection.model_validate(held) if law.filter.moves else design.filter
        return design.model_copy(update={"gains": gains, "filter": filter_, "adaptive": None})

    def gains_at(self, at: float, plane: Plane) -> dict[str, float]:
        """Return the gains of a plane by column, at a value of the scheduling quantity."""
        names = self.pitch.columns
        first = 0 if plane == "pitch" else len(names)
        return dict(zip(names, self._table(at)[first : first + len(names)].tolist(), strict=True))

    def parts_at(self, at: float, plane: Plane, sample_s: float | None) -> tuple[Any, tuple[float, ...], Any]:
        """Return the bending filter, the weights of the gyros and the loop filters, as `at` does for the law."""
        held = self.filter(at), self.discretization, self.prewarp_hz
        filter_, *loops = (own and as_flown(own, sample_s) for own in (held, *self.loops))
        return filter_, self.blend[0 if plane == "pitch" else 1], tuple(loops)

    def at(self, at: float, plane: Plane, sample_s: float | None) -> Pd:
        lag = None if self.relief_hz is None else Lag(self.relief_hz, sample_s)
        filter_, blend, loops = self.parts_at(at, plane, sample_s)
        return Pd(**self.gains_at(at, plane), filter=filter_, blend=blend, lag=lag, loops=loops)

    def continuous_at(self, at: float, plane: Plane, sample_s: float) -> Pd:
        del sample_s  # filters are stored in continuous form
        return self.at(at, plane, None)

    def tables(self) -> dict[str, Any]:
        def rows(schedule: GainSchedule) -> tuple[dict[str, float], ...]:
            columns = [[float(x) for x in column] for column in schedule.table.values()]
            return tuple(dict(zip(schedule.table, row, strict=True)) for row in zip(*columns, strict=True))

        gains: dict[str, Any] = {"table": rows(self.pitch)}
        gains |= {"yaw": "pitch"} if self.yaw is self.pitch else {"yaw_table": rows(self.yaw)}
        pitch, yaw = self.blend
        more: dict[str, Any] = {} if self.relief_hz is None else {"load_relief": {"corner_hz": self.relief_hz}}
        if len(pitch) > 1:
            more["blend"] = {"pitch": pitch} if yaw == pitch else {"pitch": pitch, "yaw": yaw}
        loops = {name: _section(own) for name, own in zip(BANKS, self.loops, strict=True) if own is not None}
        more |= {"loop_filters": loops} if loops else {}
        return {"law": self.name, "gains": gains, "filter": self._filter_section(), **more}

    def record(self) -> dict[str, Any]:
        gains = {name: [float(x) for x in column] for name, column in self.pitch.table.items()}
        more: dict[str, Any] = {} if self.relief_hz is None else {"relief_hz": self.relief_hz}
        more |= {"blend": [list(weights) for weights in self.blend]} if len(self.blend[0]) > 1 else {}
        loops = {name: asdict(own[0]) for name, own in zip(BANKS, self.loops, strict=True) if own is not None}
        more |= {"loop_filters": loops} if loops else {}
        points = [asdict(one) for one in self.filter.filters]
        form = points[0]
        if self.filter.moves:
            form = {"schedule": [{self.over: at, **one} for at, one in zip(self.filter.at, points, strict=True)]}
        return {"gains": gains, "filter": form | {"prewarp_hz": self.prewarp_hz}, **more}

    def _filter_section(self) -> dict[str, Any]:
        """Return the bending filter as the section of a design file."""
        each = [_section((one, self.discretization, self.prewarp_hz)) for one in self.filter.filters]
        if not self.filter.moves:
            return each[0]
        points = tuple(
            {self.over: float(at)} | {key: one[key] for key in ("quadratic", "first_order") if one[key]}
            for at, one in zip(self.filter.at, each, strict=True)
        )
        return {key: x for key, x in each[0].items() if key not in ("quadratic", "first_order")} | {"schedule": points}


def as_flown(own: LoopFilter, sample_s: float | None) -> BendingFilter | DiscreteFilter:
    """Return the filter as the flight computer runs it at a period, or in continuous form for a period of None."""
    form, discretization, prewarp_hz = own
    return form if sample_s is None else form.discretize(sample_s, discretization, prewarp_hz)


def _section(own: LoopFilter) -> dict[str, Any]:
    """Return a filter as the section of a design file."""
    form, discretization, prewarp_hz = own
    out: dict[str, Any] = {
        "structure": structure_of(len(form.quadratic), len(form.first_order)),
        "discretization": discretization,
        "quadratic": tuple(asdict(q) for q in form.quadratic),
        "first_order": tuple(asdict(f) for f in form.first_order),
    }
    return out | ({"prewarp_hz": prewarp_hz} if prewarp_hz is not None and out["structure"] != "none" else {})
