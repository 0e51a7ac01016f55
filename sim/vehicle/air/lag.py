"""Aeroelastic lag: the air meets the first bending mode of each plane as it was a short time ago.

The flow at the parts of the body has the displacement and rate of the first mode behind a first-order lag,

    eta_L' = V (eta - eta_L) / L,    nu_L = eta_L' + p xi_L    (yaw: xi_L' - p eta_L),

with the airspeed V and a length L. At constant V and density, the force of the mode's motion follows with the time
constant L / V (R. L. Bisplinghoff, H. Ashley & R. L. Halfman, Aeroelasticity, ch. 6: the growth of lift on a body that
bends). There are no other lags, of rigid motion or of higher modes.
"""

from __future__ import annotations

from maxq.control.kernel.jit import rare_routine
from maxq.control.kernel.records import Array
from maxq.sim.vehicle.block import StateBlock
from maxq.sim.vehicle.modes.planar import PlanarMotion, of_plane
from maxq.sim.vehicle.schedule import PITCH, YAW

AIR_LAGS = StateBlock(
    {"air_lag_{}_pitch_m": "m", "air_lag_{}_yaw_m": "m"},
    "air_lags",
    bound=10.0,
    excess="the air's lag diverges: aero.lag_m is too short for run.step_s",
)


@rare_routine
def lag_first_modes(
    length_m: float,
    airspeed_mps: float,
    roll_rate: float,
    y: Array,
    first: int,
    dy: Array,
    modes: PlanarMotion,
    late: Array,
) -> None:
    """Write the derivative of the lagged coordinates at y[first:], and the differences to the modes to `late`.

    `late` (4,): lagged less present displacement and quasi-velocity in pitch, then in yaw.
    """
    p, q, rate = of_plane(PITCH), of_plane(YAW), airspeed_mps / length_m
    dy[first] = rate * (modes.eta_m[p] - y[first])
    dy[first + 1] = rate * (modes.eta_m[q] - y[first + 1])
    late[0], late[1] = y[first] - modes.eta_m[p], dy[first] + roll_rate * y[first + 1] - modes.nu_mps[p]
    late[2], late[3] = y[first + 1] - modes.eta_m[q], dy[first + 1] - roll_rate * y[first] - modes.nu_mps[q]
