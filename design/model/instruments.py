"""The actuators, gyro and further sensors of a stage with their timing, and their linear models (28) and (29)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.linalg

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.design.model.state_space import ComplexArray, StateSpace
from maxq.sim.vehicle.actuator.kernel import Actuator
from maxq.sim.vehicle.sensor.further import ACCELEROMETER
from maxq.sim.vehicle.sensor.gyro import Gyro

Plane = Literal["pitch", "yaw"]

ACCELERATION = "accel_mps2"  # lateral specific force at the accelerometer
DERIVATIVES = ("delta_rad", "delta_rate_radps", "delta_accel_radps2")
"""The actuator angle and its derivatives, which are inputs of the vehicle."""


def further_rate(number: int) -> str:
    """Return the name of a further gyro's measurement. Numbers begin at 2."""
    return f"rate_{number}_radps"


def sensed(sensors: Sequence[Any]) -> tuple[str, ...]:
    """Return the names of the measurements of a stage's sensors after the first gyro.

    The first accelerometer, which the laws use, follows the gyros.
    """
    gyros = sum(sensor.kind != ACCELEROMETER for sensor in sensors)
    forces = [ACCELERATION, *(f"accel_{n}_mps2" for n in range(2, len(sensors) - gyros + 1))]
    return (*(further_rate(number + 2) for number in range(gyros)), *forces[: len(sensors) - gyros])


@dataclass(frozen=True)
class Instruments:
    """The actuators, sensors and timing of the flight computer in one plane.

    Actuators and gyros with `ideal` set have no dynamics.
    """

    actuators: tuple[Actuator, ...]  # one for each drive; engine groups with equal actuators share a drive
    gyro: Gyro
    sample_s: float  # period of the computer: tau_VF of the converter (30), tau_DZ of the hold (32)
    delay_s: float  # tau_D (31), from sample to command
    groups: tuple[tuple[int, ...], ...] = ((0,),)  # engine groups that each drive moves
    sensors: tuple[tuple[str, Gyro, int], ...] = ()  # further sensors: measured quantity, dynamics, latency in samples

    @property
    def actuator(self) -> Actuator:
        """Return the actuator of the first drive."""
        return self.actuators[0]

    @property
    def rows_late(self) -> int:
        """Return the number of log rows, one per sample, between the inputs of a command and the command itself."""
        return 1 if self.delay_s > 0.0 else 0


def instruments_of(row: Any, plane: Plane = "pitch") -> Instruments:
    """Return the instruments of a packed stage in one plane."""
    drives, of_group = drives_of(row, plane)
    sensors = row.vehicle.sensors[: int(row.vehicle.sizes.sensors)]
    return Instruments(
        actuators=tuple(drives),
        groups=tuple(tuple(g for g, d in enumerate(of_group) if d == drive) for drive in range(len(drives))),
        gyro=_gyro(row.vehicle.gyro),
        sensors=tuple(
            (name, _gyro(each.triad), int(late))
            for name, each, late in zip(sensed(sensors), sensors, row.computer.sensors.latency, strict=False)
        ),
        sample_s=1e-9 * int(row.computer.sample_ns),
        delay_s=1e-9 * int(row.computer.delay_ns),
    )


def _gyro(record: Any) -> Gyro:
    return Gyro(**{f.name: record[f.name].item() for f in dataclasses.fields(Gyro)})


def drives_of(row: Any, plane: Plane) -> tuple[list[Actuator], list[int]]:
    """Return the distinct actuators of a plane, and the index of the actuator of each engine group."""
    vehicle, axis = row.vehicle, 0 if plane == "pitch" else 1
    records = [vehicle.actuator_yaw if axis else vehicle.actuator_pitch]
    records += [vehicle.further_actuators[2 * k + axis] for k in range(int(vehicle.sizes.further_groups))]
    unlike: list[Actuator] = []
    of_group = []
    for record in records:
        actuator = Actuator(**{f.name: record[f.name].item() for f in dataclasses.fields(Actuator)})
        if actuator not in unlike:
            unlike.append(actuator)
        of_group.append(unlike.index(actuator))
    return unlike, of_group


def allocation_at(pool: Array, row: Any, now_s: float, plane: Plane) -> tuple[tuple[float, float], ...]:
    """Return the angles of each engine group per command of the law, in the law's plane and in the other plane.

    The angle in the other plane is assumed to pass through the actuators of the law's plane.
    """
    a, axis = row.computer.allocation, 0 if plane == "pitch" else 1
    if a.groups == 1:
        return ((1.0, 0.0),)
    matrix = table_in(pool, a.matrix)(now_s).reshape(-1, 3)
    groups = range(int(a.groups))
    return tuple((float(matrix[2 * g + axis, axis]), float(matrix[2 * g + 1 - axis, axis])) for g in groups)


def of_drive(name: str, drive: int) -> str:
    """Return the name of an angle or derivative of drive number `drive`, from 0."""
    return name if drive == 0 else f"{name}_{drive + 1}"


def actuators(records: Sequence[Any]) -> StateSpace:
    """Return the state space from command to angle, rate and acceleration of every drive (see `actuator`)."""
    each = [actuator(record) for record in records]
    states = tuple(of_drive(name, k) for k, one in enumerate(each) for name in one.states)
    outputs = tuple(of_drive(name, k) for k, one in enumerate(each) for name in one.outputs)
    b, d = (np.concatenate([getattr(one, name) for one in each]) for name in ("b", "d"))
    a, c = (scipy.linalg.block_diag(*(getattr(one, name) for one in each)) for name in ("a", "c"))
    return StateSpace(a, b, c, d, states, each[0].inputs, outputs)


def actuator_response(record: Any, s: ComplexArray) -> ComplexArray:
    """Return the ratio of angle to command at complex s, rad/s, as a product of factors."""
    out: ComplexArray = np.ones(np.shape(s), np.complex128)
    for omega, zeta in actuator_poles(record):
        out = out * lag(s, omega, zeta)
    return out / lag(s, record.omega_4_radps, record.zeta_4) if record.order == 6 else out


def lag(s: ComplexArray, omega: Array | float, zeta: Array | float) -> ComplexArray:
    """Return the response omega^2 / (s^2 + 2 zeta omega s + omega^2) at complex s, rad/s."""
    x = np.asarray(s) / omega
    return np.asarray(1.0 / (1.0 + x * (2.0 * zeta + x)))


def actuator_poles(record: Any) -> list[tuple[float, float]]:
    """Return the frequency (rad/s) and damping ratio of each pole pair of a packed `Actuator`."""
    return [
        (getattr(record, f"omega_{k}_radps"), getattr(record, f"zeta_{k}")) for k in range(1, record.order // 2 + 1)
    ]


def actuator(record: Any) -> StateSpace:
    """Return the state space from command to angle, rate and acceleration of the engine.

    `record` is a packed `Actuator`; the number of states is its order. The system is a chain of second-order sections
    with position and rate as states. The order of the sections affects only the limits. A system of order six is (28),
    with four more poles than zeros.
    """
    poles = actuator_poles(record)
    n = 2 * len(poles)
    a, b = np.zeros((n, n)), np.zeros((n, 1))
    for k, (omega, zeta) in enumerate(poles):
        i = 2 * k
        a[i, i + 1] = 1.0
        a[i + 1, i], a[i + 1, i + 1] = -(omega**2), -2.0 * zeta * omega
        if k == 0:
            b[1, 0] = omega**2
        else:
            a[i + 1, i - 2] = omega**2
    angle = np.eye(n)[n - 2]
    if record.order == 6:
        # numerator (s^2 + 2 z w s + w^2) / w^2 of the last section, with s^2 from the row of its rate
        omega_4, zeta_4 = float(record.omega_4_radps), float(record.zeta_4)
        angle = a[5] / omega_4**2
        angle[4] += 1.0
        angle[5] += 2.0 * zeta_4 / omega_4
    c = np.stack([angle, angle @ a, angle @ a @ a])
    d = np.stack([np.zeros(1), angle @ b, angle @ a @ b])
    states = tuple(f"actuator_{k + 1}{what}" for k in range(len(poles)) for what in ("", "_rate"))
    return StateSpace(a, b, c, d, states, ("command_rad",), DERIVATIVES)


def gyro(record: Any) -> StateSpace:
    """Return the state space from local angular rate to sensed rate (29), with two states.

    `record` is a packed `Gyro`. Its errors are not included.
    """
    w, zeta = float(record.omega_radps), float(record.zeta)
    a: Array = np.array([[0.0, 1.0], [-w * w, -2.0 * zeta * w]])
    return StateSpace(
        a,
        np.array([[0.0], [w * w]]),
        np.array([[1.0, 0.0]]),
        np.zeros((1, 1)),
        ("gyro_radps", "gyro_rate_radps2"),
        ("local_rate_radps",),
        ("gyro_radps",),
    )


def per_actuator_angle(s: ComplexArray, response: ComplexArray, inputs: tuple[str, ...]) -> list[ComplexArray]:
    """Return the response per actuator angle of each drive.

    `response` (..., inputs) is the response of a plant whose `inputs` are angles and their derivatives.
    """
    out: dict[str, ComplexArray] = {}
    for k, name in enumerate(inputs):
        order = next(n for n, of in enumerate(DERIVATIVES) if name.startswith(of))
        drive = name.removeprefix(DERIVATIVES[order])
        out[drive] = np.asarray(out.get(drive, 0.0) + s**order * response[..., k])
    return list(out.values())


def per_command(
    s: ComplexArray, response: ComplexArray, inputs: tuple[str, ...], actuators: Sequence[Actuator]
) -> ComplexArray:
    """Return the response per common command, summed over all drives in series with their actuators."""
    drives = zip(per_actuator_angle(s, response, inputs), actuators, strict=True)
    first, *others = (per_angle if a.ideal else per_angle * actuator_response(a, s) for per_angle, a in drives)
    return np.asarray(sum(others, first))
