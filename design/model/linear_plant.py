"""Actuator, vehicle and gyro in a row: what the control law sees between its command and its measurement.

Pitch signs throughout. In the yaw plane the same system holds for the mirrored variables

    w -> v    q -> -r    theta -> -psi    eta -> xi    slosh pitch -> slosh yaw    delta -> -delta_yaw
    gyro -> -gyro,

because B's z axis turned into y takes the pitch axis y into -z: a positive angle moves the gimbal's thrust to
+z in pitch but to -y in yaw. From command to gyro both signs change and the transfer function stays.
"""

from __future__ import annotations

import numpy as np

from maxq.design.model.flight_condition import FlightCondition
from maxq.design.model.instruments import ACTUATOR_OUTPUTS, actuator, gyro
from maxq.design.model.plant import OUTPUTS, vehicle_plant
from maxq.design.model.state_space import StateSpace
from maxq.design.model.vehicle_at import Plane, vehicle_at
from maxq.sim.packing.flight import Packed


def linear_plant(packed: Packed, condition: FlightCondition, plane: Plane = "pitch", stage: int = 0) -> StateSpace:
    """Command (rad) -> gyro rate, engine motion and vehicle motion of a packed flight at a condition.

    States: those of `vehicle_plant`, then six of the actuator and two of the gyro. Raises ValueError where an
    ideal actuator or gyro is flown: then use `vehicle_plant`.
    """
    row = packed.parameters[stage].vehicle
    record = row.actuator_pitch if plane == "pitch" else row.actuator_yaw
    if record.ideal == 1 or row.gyro.ideal == 1:
        raise ValueError("an ideal actuator or gyro has no states: use vehicle_plant")
    vehicle = vehicle_at(packed, condition.time_s, condition.mach, plane, stage)
    return in_series(actuator(record), vehicle_plant(vehicle, condition), gyro(row.gyro))


def in_series(moves: StateSpace, body: StateSpace, senses: StateSpace) -> StateSpace:
    """Actuator `moves`, vehicle `body` and gyro `senses` as one system."""
    n, m, p = len(body.states), len(moves.states), len(senses.states)
    engine = moves.c[[0, 2]]  # angle and acceleration
    local = body.c[OUTPUTS.index("local_rate_radps")]
    a, b = np.zeros((n + m + p, n + m + p)), np.zeros((n + m + p, 1))
    a[:n, :n], a[:n, n : n + m] = body.a, body.b @ engine
    a[n : n + m, n : n + m] = moves.a
    a[n + m :, n + m :] = senses.a
    a[n + m :, :n] = np.outer(senses.b[:, 0], local)
    b[n : n + m] = moves.b
    outputs = (*senses.outputs, *ACTUATOR_OUTPUTS, *body.outputs)
    c = np.zeros((len(outputs), n + m + p))
    c[0, n + m :] = senses.c[0]
    c[1:4, n : n + m] = moves.c
    c[4:, :n] = body.c
    return StateSpace(
        a,
        b,
        c,
        np.zeros((len(outputs), 1)),
        (*body.states, *moves.states, *senses.states),
        moves.inputs,
        outputs,
    )
