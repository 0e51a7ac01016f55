"""The sensors for navigation, which the computer reads at each sample: GNSS receiver, barometer, magnetometer.

Flight code receives them. They belong to the vehicle and not to a stage.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, NamedTuple

from maxq.control.external import HEALTH_BAROMETER, HEALTH_GNSS, HEALTH_MAGNETOMETER
from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import Xyz
from maxq.control.kernel.vectors import rotation_from_quaternion
from maxq.sim.vehicle.block import Q_BI, R_I
from maxq.sim.vehicle.environment import Environment, climb_rate
from maxq.sim.vehicle.faults import BAROMETER_DEAD, MAGNETOMETER_DEAD
from maxq.sim.vehicle.sensor.barometer import Barometer, measured_pressure, pack_barometer
from maxq.sim.vehicle.sensor.gnss import Gnss, GnssMemory, GnssRow, gnss_row, measure_gnss, pack_gnss
from maxq.sim.vehicle.sensor.magnetometer import Magnetometer, dipole_field, measure_field, pack_magnetometer
from maxq.sim.world.atmosphere import air
from maxq.sim.world.earth import FLAT, earth_rotation, inertial_to_earth

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_vehicle import Vehicle


@dataclass(frozen=True)
class Receivers:
    """The parameters of the sensors for navigation. `on`: 0 without any."""

    on: int = 0
    gnss: Gnss = field(default_factory=Gnss)
    barometer: Barometer = field(default_factory=Barometer)
    magnetometer: Magnetometer = field(default_factory=Magnetometer)


@dataclass
class ReceiverMemory:
    """The outputs of the sensors for navigation at the last sample."""

    health: int  # bits HEALTH_GNSS, HEALTH_BAROMETER, HEALTH_MAGNETOMETER
    gnss: GnssMemory
    pressure_Pa: float
    magnetic_B_T: Annotated[Array, (3,)]


def pack_receivers(vehicle: Vehicle) -> Receivers:
    given = vehicle.gnss, vehicle.barometer, vehicle.magnetometer
    if not any(section is not None for section in given):
        return Receivers()
    return Receivers(1, pack_gnss(given[0]), pack_barometer(given[1]), pack_magnetometer(given[2]))


@routine
def measure(
    receivers: Receivers,
    memory: ReceiverMemory,
    environment: Environment,
    pool: Array,
    seed: int,
    sample: int,
    now_ns: int,
    properties: Array,
    faults: Array,
    y: Array,
) -> None:
    """Write the outputs of all sensors for navigation at a sample."""
    earth, memory.health = environment.earth, 0
    if receivers.gnss.period_ns > 0:
        measure_gnss(receivers.gnss, memory.gnss, earth, seed, now_ns, properties, faults, y)
        age_ns = now_ns - memory.gnss.valid_ns
        if memory.gnss.number > 0 and age_ns <= receivers.gnss.period_ns + receivers.gnss.latency_ns:
            memory.health += HEALTH_GNSS
    if receivers.barometer.on == 1:
        true_Pa = air(environment.atmosphere, pool, climb_rate(earth, y)[0])[1]
        b, before_Pa = receivers.barometer, memory.pressure_Pa
        memory.pressure_Pa = measured_pressure(b, before_Pa, true_Pa, seed, sample, faults)
        if faults[BAROMETER_DEAD] == 0.0:
            memory.health += HEALTH_BAROMETER
    if receivers.magnetometer.on == 1 and earth.figure != FLAT:
        cos, sin = earth_rotation(earth, 1e-9 * now_ns)
        there = inertial_to_earth(cos, sin, y[R_I], y[R_I + 1], y[R_I + 2])
        field_T = dipole_field(there[0], there[1], there[2])
        inertial_T = inertial_to_earth(cos, -sin, field_T[0], field_T[1], field_T[2])
        rotation = rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3])
        measure_field(receivers.magnetometer, inertial_T, rotation, seed, sample, faults, memory.magnetic_B_T)
        if faults[MAGNETOMETER_DEAD] == 0.0:
            memory.health += HEALTH_MAGNETOMETER


class ReceiverRow(NamedTuple):
    """The log row of the sensors for navigation; a missing sensor has zeros."""

    gnss: GnssRow
    barometer_Pa: Annotated[float, "Pa", "output of the barometer"]
    magnetometer_axis_nT: Annotated[Xyz, "nT", "output of the magnetometer"]


@kernel
def receiver_row(memory: ReceiverMemory) -> ReceiverRow:
    b = memory.magnetic_B_T
    return ReceiverRow(gnss_row(memory.gnss), memory.pressure_Pa, Xyz(1e9 * b[0], 1e9 * b[1], 1e9 * b[2]))
