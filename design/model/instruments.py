"""Actuator, gyro and the flight computer's timing: their parameters, and the linear systems (28) and (29)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import StateSpace
from maxq.design.model.vehicle_at import Plane
from maxq.sim.vehicle.actuator import Actuator
from maxq.sim.vehicle.gyro import Gyro

ACTUATOR_OUTPUTS = ("delta_rad", "delta_rate_radps", "delta_accel_radps2")


@dataclass(frozen=True)
class Instruments:
    """Actuator, gyro and timing of the flight computer in one plane; `ideal` actuators and gyros have no dynamics."""

    actuator: Actuator
    gyro: Gyro
    sample_s: float  # period of the computer: tau_VF of the converter (30), tau_DZ of the hold (32)
    delay_s: float  # tau_D (31), from sample to command


def instruments_of(row: Any, plane: Plane = "pitch") -> Instruments:
    """Instruments of a packed stage."""
    record = row.vehicle.actuator_pitch if plane == "pitch" else row.vehicle.actuator_yaw
    return Instruments(
        actuator=Actuator(**{f.name: record[f.name].item() for f in dataclasses.fields(Actuator)}),
        gyro=Gyro(**{f.name: row.vehicle.gyro[f.name].item() for f in dataclasses.fields(Gyro)}),
        sample_s=1e-9 * int(row.computer.sample_ns),
        delay_s=1e-9 * int(row.computer.delay_ns),
    )


def actuator(record: Any) -> StateSpace:
    """Command -> angle, rate and acceleration of the engine (28), six states; `record` is a packed `Actuator`.

    A chain of second-order sections, each with its position and rate as states. The denominator of (28) is four
    orders above its numerator: C B = C A B = 0, so rate and acceleration are C A x, C A^2 x.
    """
    omega = np.array([record.omega_1_radps, record.omega_2_radps, record.omega_3_radps])
    zeta = np.array([record.zeta_1, record.zeta_2, record.zeta_3])
    a, b = np.zeros((6, 6)), np.zeros((6, 1))
    for k in range(3):
        i = 2 * k
        a[i, i + 1] = 1.0
        a[i + 1, i], a[i + 1, i + 1] = -(omega[k] ** 2), -2.0 * zeta[k] * omega[k]
        if k == 0:
            b[1, 0] = omega[0] ** 2
        else:
            a[i + 1, i - 2] = omega[k] ** 2
    # the last numerator, s^2 + 2 z w s + w^2 over w^2, acts on its section's state: s^2 is that rate's row
    omega_4, zeta_4 = float(record.omega_4_radps), float(record.zeta_4)
    angle = a[5] / omega_4**2
    angle[4] += 1.0
    angle[5] += 2.0 * zeta_4 / omega_4
    c = np.stack([angle, angle @ a, angle @ a @ a])
    states = tuple(f"actuator_{k + 1}{what}" for k in range(3) for what in ("", "_rate"))
    return StateSpace(a, b, c, np.zeros((3, 1)), states, ("command_rad",), ACTUATOR_OUTPUTS)


def gyro(record: Any) -> StateSpace:
    """Local angular rate -> sensed rate (29), two states; `record` is a packed `Gyro`, whose errors are left out."""
    w, zeta = float(record.omega_radps), float(record.zeta)
    a: Array = np.array([[0.0, 1.0], [-w * w, -2.0 * zeta * w]])
    return StateSpace(
        a, np.array([[0.0], [w * w]]), np.array([[1.0, 0.0]]), np.zeros((1, 1)),
        ("gyro_radps", "gyro_rate_radps2"), ("local_rate_radps",), ("gyro_radps",),
    )  # fmt: skip
