"""Adaptive augmenting control: a total gain k_T on the output of any law, after its bending filter.

    k_T = k_0 + k_a,    k_a' = a (k_max - k_a) / k_max e_r^2 - alpha k_a y_s - beta (k_T - 1),    0 <= k_a <= k_max

The rate of k_a has three terms:

- e_r, the attitude error minus that of a reference model, raises the gain.
- y_s, the content of the command above the control band, lowers the gain. It is the output of the spectral damper: the
  high-passed command, squared and low-passed.
- Leakage returns the gain to 1.

The reference model is the rigid body with the desired law, driven by the commanded rate q_c:

    e' = q - q_c,    q' = -w^2 e - 2 zeta w q,    e_r = theta_e - e

For a law with an integral, whose error at a steady rate is zero, q - q_c replaces the last q.

Source: Orr & VanZwieten, Robust, Practical Adaptive Control for Launch Vehicles, AIAA 2012-4549; flown on the Space
Launch System. Here, Euler's method integrates the gain, and the reference model is exact for a rate that is constant
over the sample. The high-pass is a second-order Butterworth filter, discretised bilinearly and exact at its corner; the
low-pass is a first-order lag. At a constant k_T, the loop is that of the law with all gains scaled, so that the margins
at the two limits of k_T can be computed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np

from maxq.control.attitude import AttitudeError
from maxq.control.filters import filter_sample
from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.rows import DEG, PitchYaw
from maxq.control.laws.load_relief import lag_share


@dataclass(frozen=True)
class Adaptive:
    """The parameters of adaptive augmenting control.

    - `on`: 1 with adaptation.
    - `least`: k_0.
    - `span`: k_max.
    - `error_gain`: a, 1/(rad2 s).
    - `damper_gain`: alpha, 1/(rad2 s).
    - `leakage_ps`: beta.
    - `low_pass_share`: weight of a new sample in the low-pass.
    - `reference` (2, 3): matrix that gives e and q one sample later from e, q and q_c.
    - `high_pass` (1, 5): b0, b1, b2, a1, a2.
    """

    on: int = 0
    least: float = 1.0
    span: float = 1.0
    error_gain: float = 0.0
    damper_gain: float = 0.0
    leakage_ps: float = 0.0
    low_pass_share: float = 0.0
    reference: Annotated[Array, (2, 3)] = field(default_factory=lambda: np.zeros((2, 3)))
    high_pass: Annotated[Array, (1, 5)] = field(default_factory=lambda: np.zeros((1, 5)))


@dataclass
class AdaptiveState:
    """The state of adaptive augmenting control, per gimbal axis (pitch, yaw).

    - `begun`: 1 when the reference model has been initialised with the measured error and rate.
    - `k_a`, `total`: k_a and k_T.
    - `reference` (2, 2): error (rad) and rate (rad/s) of the reference model.
    - `error_rad`, `damper_rad2`: e_r and y_s.
    - `memory`: memory of the high-pass.
    """

    begun: Annotated[IntArray, (2,)]
    k_a: Annotated[Array, (2,)]
    total: Annotated[Array, (2,)]
    reference: Annotated[Array, (2, 2)]
    error_rad: Annotated[Array, (2,)]
    damper_rad2: Annotated[Array, (2,)]
    memory: Annotated[Array, (2, 1, 2)]


def make_adaptive(
    sample_s: float,
    *,
    least_gain: float,
    most_gain: float,
    reference_hz: float,
    reference_zeta: float,
    error_gain: float,
    damper_gain: float,
    leakage_ps: float,
    high_pass_hz: float,
    low_pass_hz: float,
    with_integral: bool = False,
) -> Adaptive:
    """Return the parameters of adaptive augmenting control.

    The limits of k_T are `least_gain` and `most_gain`. `error_gain` and `damper_gain` are in 1/(rad2 s).
    `with_integral` is True for a law with an integral. Raises ValueError for a high-pass frequency that is not between
    0 and half the sample rate.
    """
    if not 0.0 < high_pass_hz < 0.5 / sample_s:
        raise ValueError(f"high_pass_hz = {high_pass_hz:g}: allowed is above 0 and below {0.5 / sample_s:g}")
    k = math.tan(math.pi * high_pass_hz * sample_s)
    b = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    high_pass = [b, -2.0 * b, b, 2.0 * (k * k - 1.0) * b, (1.0 - math.sqrt(2.0) * k + k * k) * b]
    return Adaptive(
        on=1,
        least=least_gain,
        span=most_gain - least_gain,
        error_gain=error_gain,
        damper_gain=damper_gain,
        leakage_ps=leakage_ps,
        low_pass_share=lag_share(low_pass_hz, sample_s),
        reference=_reference(2.0 * math.pi * reference_hz, reference_zeta, sample_s, with_integral),
        high_pass=np.array([high_pass]),
    )


def _reference(omega: float, zeta: float, sample_s: float, with_integral: bool) -> Array:
    from scipy.linalg import expm  # noqa: PLC0415  # lazy: few designs adapt

    damper = 2.0 * zeta * omega
    forced = damper if with_integral else 0.0
    system = np.array([[0.0, 1.0, -1.0], [-omega * omega, -damper, forced], [0.0, 0.0, 0.0]])
    return np.asarray(expm(system * sample_s)[:2])


@kernel
def start_adaptive(adaptive: Adaptive, state: AdaptiveState) -> None:
    """Set k_T to 1 and clear the filters; the reference model begins at the error and rate of the first sample."""
    for gimbal in range(2):
        state.begun[gimbal] = 0
        state.k_a[gimbal] = 1.0 - adaptive.least
        state.total[gimbal] = 1.0
        state.error_rad[gimbal], state.damper_rad2[gimbal] = 0.0, 0.0
        for k in range(2):
            state.reference[gimbal, k] = 0.0
            state.memory[gimbal, 0, k] = 0.0


@kernel
def augmented(
    adaptive: Adaptive,
    state: AdaptiveState,
    error: AttitudeError,
    commanded_radps: Array,
    gimbal: int,
    sample_s: float,
    law_rad: float,
) -> float:
    """Return the law's command times the total gain of this sample, rad.

    `commanded_radps` (3,): commanded rate over the sample.
    """
    axis = gimbal + 1
    at, step = state.reference[gimbal], adaptive.reference
    if state.begun[gimbal] == 0:
        state.begun[gimbal] = 1
        at[0], at[1] = error.theta_e_rad[axis], error.rate_radps[axis]
    else:
        q_c = commanded_radps[axis]
        e_rad = step[0, 0] * at[0] + step[0, 1] * at[1] + step[0, 2] * q_c
        at[1] = step[1, 0] * at[0] + step[1, 1] * at[1] + step[1, 2] * q_c
        at[0] = e_rad
    e_r = error.theta_e_rad[axis] - at[0]
    k_a = state.k_a[gimbal]
    raised = adaptive.error_gain * (adaptive.span - k_a) / adaptive.span * (e_r * e_r)
    lowered = adaptive.damper_gain * k_a * state.damper_rad2[gimbal] + adaptive.leakage_ps * (state.total[gimbal] - 1.0)
    k_a = min(max(k_a + sample_s * (raised - lowered), 0.0), adaptive.span)
    state.k_a[gimbal], state.total[gimbal], state.error_rad[gimbal] = k_a, adaptive.least + k_a, e_r
    command_rad: float = state.total[gimbal] * law_rad
    high_rad = filter_sample(adaptive.high_pass, 1, state.memory[gimbal], command_rad)
    state.damper_rad2[gimbal] += adaptive.low_pass_share * (high_rad * high_rad - state.damper_rad2[gimbal])
    return command_rad


class AdaptiveRow(NamedTuple):
    """The log row of adaptive augmenting control."""

    total_gain_axis: Annotated[PitchYaw, "1", "total gain of adaptive augmenting control"]
    reference_error_axis_deg: Annotated[PitchYaw, "deg", "attitude error minus that of the reference model"]
    damper_axis_deg: Annotated[PitchYaw, "deg", "root of the spectral damper: rms of the command above the high-pass"]


@kernel
def adaptive_row(state: AdaptiveState) -> AdaptiveRow:
    e, y = state.error_rad, state.damper_rad2
    return AdaptiveRow(
        total_gain_axis=PitchYaw(state.total[0], state.total[1]),
        reference_error_axis_deg=PitchYaw(DEG * e[0], DEG * e[1]),
        damper_axis_deg=PitchYaw(DEG * math.sqrt(y[0]), DEG * math.sqrt(y[1])),
    )
