"""The control law that flies, chosen by a field: parameters, states, start and tick of all laws of this folder.

The flight computer (control/computer.py) holds one `FlownLaw` and one `LawStates`. A new law adds its name and its
gains to control/structures.py, its module to this folder, and its state, start and tick here.
"""

from __future__ import annotations

from dataclasses import dataclass

from maxq.control.filter_schedule import MovingFilter
from maxq.control.filters import DiscreteFilter
from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import TableRef
from maxq.control.laws.drift import DriftState, navigate_drift, start_drift, tick_drift
from maxq.control.laws.load_relief import (
    LoadRelief,
    LoadReliefState,
    lag_share,
    start_load_relief,
    tick_incidence_relief,
    tick_load_relief,
)
from maxq.control.laws.own import OwnLaw, OwnState, start_own, tick_own
from maxq.control.laws.pd import LawInputs, PdRecord, PdState, make_pd, start_pd, tick_pd
from maxq.control.laws.pid import Pid, PidState, start_pid, tick_pid
from maxq.control.structures import DRIFT, INTEGRAL, LAWS, RELIEF, Law

_LOAD_RELIEF, _INCIDENCE_RELIEF = map(LAWS.index, RELIEF)
_OWN = LAWS.index("own")


@dataclass(frozen=True)
class FlownLaw:
    """The parameters of the law that flies, and those of its parts.

    - `kind`: index into `LAWS` of structures.py.
    - `accelerometer`, `integral`, `drift`: 1 if the law has this part (`RELIEF`, `INTEGRAL` and `DRIFT` there).
    - `pd`: gains and bending filters of every law.
    """

    kind: int
    accelerometer: int
    integral: int
    drift: int
    pd: PdRecord
    pid: Pid
    relief: LoadRelief
    own: OwnLaw


@dataclass
class LawStates:
    """The states of all laws; a law updates those of its parts."""

    pd: PdState
    pid: PidState
    relief: LoadReliefState
    drift: DriftState
    own: OwnState


def make_law(
    law: Law,
    gains: TableRef,
    sample_ns: int,
    *filters: DiscreteFilter | None,
    moving: MovingFilter | None = None,
    integral_limit_rad: float,
    relief_hz: float,
    own: OwnLaw | None = None,
) -> FlownLaw:
    """Return the parameters of `law` with its `gains` and its bending filters in pitch and yaw.

    `moving` is a filter that changes over the flight. `integral_limit_rad` bounds an integral; `relief_hz` is the
    corner frequency of the accelerometer lag of a load-relief law. `own` is the code of the law of that name. Raises
    ValueError as `make_pd` does.
    """
    return FlownLaw(
        kind=LAWS.index(law),
        accelerometer=int(law in (*RELIEF, *DRIFT)),
        integral=int(law in INTEGRAL),
        drift=int(law in DRIFT),
        pd=make_pd(gains, sample_ns, *filters, moving=moving),
        pid=Pid(integral_limit_rad),
        relief=LoadRelief(lag_share(relief_hz, sample_ns / 1.0e9)),
        own=own or OwnLaw(),
    )


@kernel
def start_laws(law: FlownLaw, state: LawStates) -> None:
    """Set the states of all laws to those before the first sample."""
    start_pd(law.pd, state.pd)
    start_pid(state.pid)
    start_load_relief(state.relief)
    start_drift(state.drift)
    start_own(state.own)


@kernel
def navigate_law(
    law: FlownLaw,
    state: LawStates,
    gimbal: int,
    lateral_mps2: float,
    axial_mps2: float,
    error_rad: float,
    sample_s: float,
) -> None:
    """Integrate the specific force of a sample for a law with feedback of the drift (`navigate_drift`)."""
    if law.drift == 1:
        navigate_drift(state.drift, gimbal, lateral_mps2, axial_mps2, error_rad, sample_s)


@kernel
def tick_law(law: FlownLaw, pool: Array, state: LawStates, given: LawInputs) -> float:
    """Return the filtered command of the law that flies for one gimbal axis, rad."""
    if law.kind == _LOAD_RELIEF:
        return tick_load_relief(law.pd, law.relief, pool, state.pd, state.relief, given)
    if law.kind == _INCIDENCE_RELIEF:
        return tick_incidence_relief(law.pd, law.relief, pool, state.pd, state.relief, given)
    if law.kind == _OWN:
        return tick_own(law.own, law.pd, pool, state.own, state.pd, given)
    if law.drift == 1:
        return tick_drift(law.pd, law.pid, pool, state.pd, state.pid, state.drift, given, law.integral)
    if law.integral == 1:
        return tick_pid(law.pd, law.pid, pool, state.pd, state.pid, given)
    return tick_pd(law.pd, pool, state.pd, given)
