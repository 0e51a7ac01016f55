"""Attitude control law: proportional and derivative terms, then a bending filter (Lee, Ahn & Roh eqs 33, 37 to 41).

    delta_pd = -k_p theta_e - k_d q_g,    theta_e = integral of (q_g - q_c)

A positive error gives a negative command, because a positive gimbal angle rotates the body in the positive sense. The
linear model is in design/laws/pd.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np

from maxq.control.filter_schedule import (
    MovingFilter,
    MovingFilterState,
    moving_sample,
    settle_moving,
    start_moving_filter,
)
from maxq.control.filters import DiscreteFilter, filter_sample, settle_filter
from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.rows import DEG, PitchYaw
from maxq.control.kernel.tables import Cubics, TableRef, fit, look_up, merge
from maxq.control.structures import GAIN_NAMES, MAX_SECTIONS, Over


@dataclass(frozen=True)
class GainSchedule:
    """The gains of one axis at values `at` (n,) of `over`, linear between these values and constant beyond them.

    Each gain has the shape (n,), or is empty if the law does not use it:

    - `k_p`, `k_d_s` (s); with an integral term, `k_i_ps` (1/s);
    - with load relief, `k_a_s2pm` (s2/m);
    - with `incidence-relief`, `k_alpha` and the parameters of the estimate of the angle of attack
      (laws/load_relief.py);
    - with feedback of the drift, `k_zd_radspm` (rad s/m) and `k_z_radpm` (rad/m) (laws/drift.py).

    `own` contains the columns of a law of the user (laws/own.py), which has no other gains.
    """

    at: Sequence[float]
    k_p: Sequence[float] = ()
    k_d_s: Sequence[float] = ()
    k_i_ps: Sequence[float] = ()
    k_a_s2pm: Sequence[float] = ()
    k_alpha: Sequence[float] = ()
    percussion_m: Sequence[float] = ()
    accel_per_incidence_mps2: Sequence[float] = ()
    k_zd_radspm: Sequence[float] = ()
    k_z_radpm: Sequence[float] = ()
    over: Over = "time_s"
    own: Mapping[str, Sequence[float]] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Sequence[float]:
        """Return the values of a gain."""
        return self.own[name] if name in self.own else getattr(self, name)

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the names of the gains."""
        return (*(name for name in GAIN_NAMES if len(getattr(self, name)) > 0), *self.own)

    @property
    def table(self) -> dict[str, Sequence[float]]:
        """Return the columns by name, the variable of the schedule first."""
        return {self.over: self.at, **{name: self[name] for name in self.columns}}


@dataclass(frozen=True)
class PdRecord:
    """The parameters of PD; pairs are per gimbal axis (pitch, yaw).

    - `gains`: table of k_p, k_d in pitch, then in yaw (`gains_table`); with `NO_TABLE` the law returns 0.
    - `sections` (2, MAX_SECTIONS, 5), `n_sections` (2,): b0, b1, b2, a1, a2 of each section of the bending filters.
    - `moving`: bending filter that changes over the flight, upstream of these sections.
    """

    gains: TableRef
    sections: Annotated[Array, (2, MAX_SECTIONS, 5)]
    n_sections: Annotated[IntArray, (2,)]
    moving: MovingFilter = field(default_factory=MovingFilter)


@dataclass
class PdState:
    """The state of PD; pairs are per gimbal axis (pitch, yaw).

    - `k_p`, `k_d_s`: gains in use.
    - `pd_rad`: output of the law before the bending filter (delta_pd for PD).
    - `filtered_rad`: output of the bending filter.
    - `filter_memory`: memory of each section.
    - `moving`: state of a bending filter that changes.
    """

    k_p: Annotated[Array, (2,)]
    k_d_s: Annotated[Array, (2,)]
    pd_rad: Annotated[Array, (2,)]
    filtered_rad: Annotated[Array, (2,)]
    filter_memory: Annotated[Array, (2, MAX_SECTIONS, 2)]
    moving: MovingFilterState


def gains_table(pitch: GainSchedule, yaw: GainSchedule | None = None) -> Cubics:
    """Return the table of the gains in pitch, then in yaw, over their common variable.

    The columns of an axis are those of `GainSchedule.columns`. Without `yaw`, the gains of pitch are used for both
    axes. Raises ValueError for columns of different lengths, for axes with different variables, and as `tables.fit`
    does.
    """
    if yaw is not None and yaw.over != pitch.over:
        raise ValueError(f"gains of yaw over {yaw.over}: allowed is {pitch.over}, as in pitch")
    tables = []
    for axis, schedule in (("pitch", pitch), ("yaw", yaw or pitch)):
        for key in pitch.columns:
            given, wanted = len(schedule[key]), len(schedule.at)
            if given != wanted or wanted == 0:
                raise ValueError(f"gains of {axis}: {key} has {given} values: allowed is {max(wanted, 1)}")
        columns = np.column_stack([schedule[key] for key in pitch.columns])
        tables.append(fit(schedule.at, columns, "linear"))
    return merge(tables)


def make_pd(
    gains: TableRef, sample_ns: int, *filters: DiscreteFilter | None, moving: MovingFilter | None = None
) -> PdRecord:
    """Return the PD parameters with `filters` in pitch and yaw, where None is no filter.

    Raises ValueError for a filter with another sample period.
    """
    sections, n_sections = np.zeros((2, MAX_SECTIONS, 5)), np.zeros(2, np.int64)
    for gimbal, discrete in enumerate(filters):
        if discrete is None:
            continue
        if round(discrete.sample_s * 1e9) != sample_ns:
            raise ValueError(f"filter's sample_s = {discrete.sample_s}: allowed is {sample_ns / 1e9}, the computer's")
        sections[gimbal], n_sections[gimbal] = discrete.padded(), discrete.n_sections
    return PdRecord(gains, sections, n_sections, moving or MovingFilter())


@kernel
def start_pd(law: PdRecord, state: PdState) -> None:
    """Set gains and outputs to 0, and settle the filters at 0."""
    for gimbal in range(2):
        state.k_p[gimbal] = 0.0
        state.k_d_s[gimbal] = 0.0
        state.pd_rad[gimbal] = 0.0
        state.filtered_rad[gimbal] = 0.0
        settle_filter(law.sections[gimbal], law.n_sections[gimbal], state.filter_memory[gimbal], 0.0)
    start_moving_filter(state.moving)


@kernel
def settle_pd(law: PdRecord, state: PdState, gimbal: int) -> None:
    """Settle the filters at the law's last output, so that they cause no transient."""
    settle_filter(law.sections[gimbal], law.n_sections[gimbal], state.filter_memory[gimbal], state.pd_rad[gimbal])
    settle_moving(law.moving, state.moving, gimbal, state.pd_rad[gimbal])


class LawInputs(NamedTuple):
    """The inputs of a law for one axis at a sample."""

    gimbal: int  # 0 pitch, 1 yaw
    at: float  # argument of the gain table: flight time, or another variable of the schedule
    error_rad: float  # attitude error
    rate_radps: float
    lateral_mps2: float  # a_z (pitch) or a_y (yaw); 0 without load relief
    sample_s: float
    cut_rad: float  # the previous command if it exceeded the limit, otherwise 0
    on: int  # with 0, the law commands nothing


@kernel
def tick_pd(law: PdRecord, pool: Array, state: PdState, given: LawInputs) -> float:
    """Return the filtered command of an axis, rad (eq. 33).

    With `on` = 0 the input of the filter is 0. The filter always runs, so that it causes no transient when the law is
    switched on again.
    """
    pd_rad = 0.0
    if given.on != 0 and law.gains.n_breaks != 0:
        pd_rad = proportional_derivative(law, pool, state, given, 2)
    return filtered(law, state, given.gimbal, pd_rad)


@kernel
def proportional_derivative(law: PdRecord, pool: Array, state: PdState, given: LawInputs, columns: int) -> float:
    """Return -k_p theta_e - k_d q_g, rad; k_p and k_d are the first two of an axis's `columns` in the gain table."""
    gimbal, at = given.gimbal, given.at
    k_p = look_up(pool, law.gains, at, columns * gimbal)
    k_d_s = look_up(pool, law.gains, at, columns * gimbal + 1)
    state.k_p[gimbal], state.k_d_s[gimbal] = k_p, k_d_s
    pd_rad: float = -k_p * given.error_rad - k_d_s * given.rate_radps
    return pd_rad


@kernel
def filtered(law: PdRecord, state: PdState, gimbal: int, law_rad: float) -> float:
    """Return the output of the bending filter for a law's command, rad."""
    state.pd_rad[gimbal] = law_rad
    if law.moving.table.n_breaks != 0:
        law_rad = moving_sample(law.moving, state.moving, gimbal, law_rad)
    filtered_rad = filter_sample(law.sections[gimbal], law.n_sections[gimbal], state.filter_memory[gimbal], law_rad)
    state.filtered_rad[gimbal] = filtered_rad
    return filtered_rad


class LawRow(NamedTuple):
    """The log row of the law."""

    k_p_axis: Annotated[PitchYaw, "1", "proportional gain"]
    k_d_axis_s: Annotated[PitchYaw, "s", "rate gain"]
    law_axis_deg: Annotated[PitchYaw, "deg", "output of the law"]
    filtered_axis_deg: Annotated[PitchYaw, "deg", "output of the bending filter, with adaptation times the total gain"]


@kernel
def law_row(state: PdState) -> LawRow:
    return LawRow(
        k_p_axis=PitchYaw(state.k_p[0], state.k_p[1]),
        k_d_axis_s=PitchYaw(state.k_d_s[0], state.k_d_s[1]),
        law_axis_deg=PitchYaw(DEG * state.pd_rad[0], DEG * state.pd_rad[1]),
        filtered_axis_deg=PitchYaw(DEG * state.filtered_rad[0], DEG * state.filtered_rad[1]),
    )
