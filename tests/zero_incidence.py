"""Provide the state along which linear models are compared: flight along the velocity, everything else at rest."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from maxq.control.kernel.records import Array
from maxq.sim.packing.flight import Packed
from maxq.sim.packing.initial import quaternion, rotation
from maxq.sim.vehicle import state as layout
from maxq.sim.vehicle.state import MAX_STATE


def zero_incidence(packed: Packed, y: Array) -> Array:
    """Return the state `y` (MAX_STATE,) with modes and pendulums at rest and the body along its velocity over ground.

    Position and velocity are kept, the attitude is rotated by the smallest angle, body rates relative to I are zero,
    and the pendulums point aft. Raises ValueError at rest, where the direction is undefined.
    """
    sizes = packed.parameters[int(packed.memory[0].clock.stage)].vehicle.sizes
    spin = np.array([0.0, 0.0, float(packed.parameters[0].environment.earth.rate_radps)])
    out = np.zeros(MAX_STATE)
    out[: layout.W_BI_B] = y[: layout.W_BI_B]
    attitude = rotation(y[layout.Q_BI : layout.Q_BI + 4])
    over_ground = attitude.T @ (y[layout.V_I : layout.V_I + 3] - np.cross(spin, y[layout.R_I : layout.R_I + 3]))
    speed = float(np.linalg.norm(over_ground))
    if speed == 0.0:
        raise ValueError("a vehicle at rest has no direction of flight")
    axis = np.cross([1.0, 0.0, 0.0], over_ground)
    sine = float(np.linalg.norm(axis))
    angle = math.atan2(sine, float(over_ground[0]))
    turn = axis * (angle / sine) if sine > 0.0 else np.array([0.0, angle, 0.0])
    out[layout.Q_BI : layout.Q_BI + 4] = quaternion(attitude @ Rotation.from_rotvec(turn).as_matrix())
    for tank in range(int(sizes.pendulums)):
        out[int(layout.pendulum_index(sizes, tank))] = -1.0
    return out
