"""Roll control by on/off thrusters: a switching line with dead band, hysteresis and a minimum on time.

The switching function is s = phi_e + k_rate p, with roll error phi_e and roll rate p about body x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from maxq.control.kernel.jit import kernel


@dataclass(frozen=True)
class Roll:
    """The parameters of roll control.

    Thrusters switch on at |s| > dead_band_rad and off at |s| <= dead_band_rad - hysteresis_rad. `k_rate_s`: weight of
    the rate in s. `minimum_on_ticks`: shortest firing, samples.
    """

    k_rate_s: float
    dead_band_rad: float
    hysteresis_rad: float
    minimum_on_ticks: int


@dataclass
class RollState:
    """The state of roll control.

    - `switching_rad`: switching function s.
    - `demand`: sign of the demanded torque about body x, -1, 0 or +1.
    - `ticks_on`: duration of the current firing, samples.
    - `firings`: number of firings begun.
    """

    switching_rad: float
    demand: int
    ticks_on: int
    firings: int


def make_roll(
    sample_ns: int, k_rate_s: float, dead_band_rad: float, hysteresis_rad: float, minimum_on_s: float
) -> Roll:
    """Return the roll parameters, with the minimum on time rounded up to whole samples.

    Raises ValueError with key, value and allowed values.
    """
    for key, value, holds, allowed in (
        ("k_rate_s", k_rate_s, k_rate_s >= 0, "a finite number from 0"),
        ("dead_band_rad", dead_band_rad, dead_band_rad > 0, "a finite number above 0"),
        ("hysteresis_rad", hysteresis_rad, 0 <= hysteresis_rad <= dead_band_rad, "from 0 to dead_band_rad"),
        ("minimum_on_s", minimum_on_s, minimum_on_s >= 0, "a finite number from 0"),
    ):
        if not (holds and math.isfinite(value)):
            raise ValueError(f"{key} = {value}: allowed is {allowed}")
    # 1e-9 absorbs the rounding of the quotient: 0.02 s are two samples of 0.01 s, not three.
    ticks = math.ceil(minimum_on_s * 1e9 / sample_ns - 1e-9)
    return Roll(k_rate_s, dead_band_rad, hysteresis_rad, max(ticks, 0))


@kernel
def update_roll(roll: Roll, state: RollState, phi_e_rad: float, p_radps: float) -> None:
    """Update the demand for the next sample from the roll error and rate of the last sample.

    A positive s demands a negative torque. A firing continues in its direction until its minimum on time has passed,
    independently of s.
    """
    s = phi_e_rad + roll.k_rate_s * p_radps
    state.switching_rad = s
    if state.demand != 0 and state.ticks_on < roll.minimum_on_ticks:
        state.ticks_on += 1
        return
    off_rad = roll.dead_band_rad - roll.hysteresis_rad
    demand = 0
    if s > roll.dead_band_rad or (state.demand < 0 and s > off_rad):
        demand = -1
    elif s < -roll.dead_band_rad or (state.demand > 0 and s < -off_rad):
        demand = 1
    if demand == 0:
        state.ticks_on = 0
    elif demand == state.demand:
        state.ticks_on += 1
    else:
        state.ticks_on = 1
        state.firings += 1
    state.demand = demand


@kernel
def silence_roll(state: RollState) -> None:
    """Switch the thrusters off at once."""
    state.demand = 0
    state.ticks_on = 0


@kernel
def start_roll(state: RollState) -> None:
    """Set the thrusters off and the number of firings to 0."""
    state.switching_rad = 0.0
    state.firings = 0
    silence_roll(state)
