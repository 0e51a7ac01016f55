"""Attitude control laws with load relief: PD plus a feedback of lateral acceleration, then the bending filter (pd.py).

    delta = -k_p theta_e - k_d q_g + k_a a_f,      a_f = a_f + (1 - exp(-2 pi f T)) (a - a_f)

Wind from below accelerates the body upwards (a_z < 0). A positive k_a then lowers the nose into the wind and reduces
the load q alpha. The cost is drift, and margin at low frequency (Greensite, Analysis and Design of Space Vehicle Flight
Control Systems, NASA CR-820, 1967, ch. 3). In yaw the sign of a is reversed, because a positive gimbal angle produces a
force to -y. The lag of the accelerometer attenuates bending. The linear model is design/laws/load_relief.py.

The law `incidence-relief` feeds back an estimate of the angle of attack:

    delta = -k_p theta_e - k_d q_g - k_alpha alpha,    alpha = lag(a - p q') / b,    q' = (q_g - previous q_g) / T

Thrust changes both the acceleration and the angular acceleration, with the ratio p = (da/d delta) / (dq'/d delta).
Hence a - p q' is the acceleration of the centre of percussion, which is independent of the gimbal angle, with b = da/d
alpha - p dq'/d alpha. The parameters p (percussion_m) and b (accel_per_incidence_mps2, negative) are columns of the
gain table, with the values of the rigid body in nominal air.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import DEG, PitchYaw
from maxq.control.kernel.tables import look_up
from maxq.control.laws.pd import LawInputs, PdRecord, PdState, filtered, proportional_derivative


@dataclass(frozen=True)
class LoadRelief:
    """The parameters of the load-relief laws in addition to the gains."""

    share: float  # 1 - exp(-2 pi f T), the weight of a new sample in the filtered acceleration


@dataclass
class LoadReliefState:
    """The state of load relief, per gimbal axis (pitch, yaw).

    - `k_a_s2pm`: gain in use, k_a or -k_alpha / b.
    - `accel_mps2`: filtered acceleration, a_z and a_y, or with `incidence-relief` that of the centre of percussion
      along +z and -y.
    - `relief_rad`: contribution to the command.
    - `incidence_rad`: estimated angle of attack.
    - `rate_radps`: rate at the last sample.
    """

    k_a_s2pm: Annotated[Array, (2,)]
    accel_mps2: Annotated[Array, (2,)]
    relief_rad: Annotated[Array, (2,)]
    incidence_rad: Annotated[Array, (2,)]
    rate_radps: Annotated[Array, (2,)]


def lag_share(corner_hz: float, sample_s: float) -> float:
    """Return the weight of a new sample in a first-order lag, exact for an input that is constant over a sample."""
    return -math.expm1(-2.0 * math.pi * corner_hz * sample_s)


@kernel
def start_load_relief(state: LoadReliefState) -> None:
    for gimbal in range(2):
        state.k_a_s2pm[gimbal], state.accel_mps2[gimbal], state.relief_rad[gimbal] = 0.0, 0.0, 0.0
        state.incidence_rad[gimbal], state.rate_radps[gimbal] = 0.0, 0.0


@kernel
def tick_load_relief(
    law: PdRecord, relief: LoadRelief, pool: Array, state: PdState, filters: LoadReliefState, given: LawInputs
) -> float:
    """Compute a tick as `tick_pd` does and add load relief. The lag also runs while `on` is 0.

    The gain table has three columns for each axis.
    """
    law_rad, gimbal, sign = 0.0, given.gimbal, 1.0 - 2.0 * given.gimbal
    filters.accel_mps2[gimbal] += relief.share * (given.lateral_mps2 - filters.accel_mps2[gimbal])
    if given.on != 0 and law.gains.n_breaks != 0:
        filters.k_a_s2pm[gimbal] = look_up(pool, law.gains, given.at, 3 * gimbal + 2)
        filters.relief_rad[gimbal] = sign * filters.k_a_s2pm[gimbal] * filters.accel_mps2[gimbal]
        pd_rad = proportional_derivative(law, pool, state, given, 3)
        law_rad = pd_rad + filters.relief_rad[gimbal]
    return filtered(law, state, gimbal, law_rad)


@kernel
def tick_incidence_relief(
    law: PdRecord, relief: LoadRelief, pool: Array, state: PdState, filters: LoadReliefState, given: LawInputs
) -> float:
    """Compute a tick as `tick_load_relief` does, but feed back the estimated angle of attack.

    The gain table has five columns for each axis.
    """
    law_rad, gimbal, sign, at = 0.0, given.gimbal, 1.0 - 2.0 * given.gimbal, given.at
    if law.gains.n_breaks != 0:
        percussion_m, slope = look_up(pool, law.gains, at, 5 * gimbal + 3), look_up(pool, law.gains, at, 5 * gimbal + 4)
        turn_radps2 = (given.rate_radps - filters.rate_radps[gimbal]) / given.sample_s
        there = sign * given.lateral_mps2 - percussion_m * turn_radps2
        filters.accel_mps2[gimbal] += relief.share * (there - filters.accel_mps2[gimbal])
        filters.incidence_rad[gimbal] = filters.accel_mps2[gimbal] / slope
        if given.on != 0:
            k_alpha = look_up(pool, law.gains, at, 5 * gimbal + 2)
            filters.k_a_s2pm[gimbal] = -k_alpha / slope
            filters.relief_rad[gimbal] = -k_alpha * filters.incidence_rad[gimbal]
            pd_rad = proportional_derivative(law, pool, state, given, 5)
            law_rad = pd_rad + filters.relief_rad[gimbal]
    filters.rate_radps[gimbal] = given.rate_radps
    return filtered(law, state, gimbal, law_rad)


class LoadReliefRow(NamedTuple):
    """The log row of the load relief."""

    k_a_axis_s2pm: Annotated[PitchYaw, "s2/m", "gain of the lateral acceleration; 0 without load relief"]
    relief_axis_deg: Annotated[PitchYaw, "deg", "load relief's share of the law's output"]
    incidence_estimate_axis_deg: Annotated[
        PitchYaw, "deg", "estimated angle of attack; 0 without the law incidence-relief"
    ]


@kernel
def load_relief_row(state: LoadReliefState) -> LoadReliefRow:
    k_a, share, alpha = state.k_a_s2pm, state.relief_rad, state.incidence_rad
    return LoadReliefRow(
        k_a_axis_s2pm=PitchYaw(k_a[0], k_a[1]),
        relief_axis_deg=PitchYaw(DEG * share[0], DEG * share[1]),
        incidence_estimate_axis_deg=PitchYaw(DEG * alpha[0], DEG * alpha[1]),
    )
