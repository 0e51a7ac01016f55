"""The faults that are planted in the simulator, to test that the margin certificate finds them.

Each fault alters the packed flight: the table of the vehicle, the records of its components, or the computer. Nothing
is compiled again, and the linear model is unchanged. A fault is found if a line of the frequency response or a measured
margin differs by more than the tolerance without an explanation.

Faults with a magnitude are small. Signs and exchanged numbers have no magnitude.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.control.structures import MAX_SECTIONS
from maxq.design.certificate.held_flight import PackedChange
from maxq.sim.packing.flight import Packed
from maxq.sim.vehicle import schedule

PITCH = schedule.PITCH


@dataclass(frozen=True)
class PlantedFault:
    name: str
    plant: PackedChange


def _columns(packed: Packed, columns: slice | list[int], factor: float = 1.0, shift: float = 0.0) -> None:
    """Multiply columns of the vehicle's table by `factor`, then add `shift`."""
    table = table_in(packed.pool, packed.parameters[0].vehicle.schedule).coefficients
    table[:, :, columns] *= factor
    table[:, 0, columns] += shift


def _mode(row: int, modes: slice, factor: float) -> PackedChange:
    """Return a fault that multiplies a row of the pitch modes by `factor`."""

    def plant(packed: Packed) -> None:
        first = schedule.mode_column(packed.parameters[0].vehicle.sizes, PITCH, row)
        _columns(packed, slice(first + modes.start, first + modes.stop), factor)

    return plant


def _mode_at(kind: str, index: int, factor: float) -> PackedChange:
    """Return a fault that multiplies the pitch shapes at a tank, or the shapes or slopes at a surface, by `factor`."""

    def plant(packed: Packed) -> None:
        sizes = packed.parameters[0].vehicle.sizes
        row = schedule.MODE_FIRST + index if kind == "tank" else schedule.surface_row(sizes, index)
        row += 1 if kind == "slope" else 0
        first = schedule.mode_column(sizes, PITCH, row)
        _columns(packed, slice(first, first + int(sizes.pitch_modes)), factor)

    return plant


def _column(column: int, factor: float = 1.0, shift: float = 0.0) -> PackedChange:
    return lambda packed: _columns(packed, [column], factor, shift)


def _tank(column: int, factor: float = 1.0, shift: float = 0.0) -> PackedChange:
    """Return a fault that multiplies a column of every tank by `factor`, then adds `shift`."""

    def plant(packed: Packed) -> None:
        for k in range(int(packed.parameters[0].vehicle.sizes.pendulums)):
            _columns(packed, [schedule.tank_column(k) + column], factor, shift)

    return plant


def _set(path: str, change: Callable[[Any], Any]) -> PackedChange:
    """Return a fault that applies `change` to a number of the record `parameters[0]`, given by its path."""

    def plant(packed: Packed) -> None:
        *way, last = path.split(".")
        record: Any = packed.parameters[0]
        for name in way:
            record = record[name]
        record[last] = change(record[last])

    return plant


def _times(path: str, factor: float) -> PackedChange:
    return _set(path, lambda value: value * factor)


def _both(*faults: PackedChange) -> PackedChange:
    def plant(packed: Packed) -> None:
        for fault in faults:
            fault(packed)

    return plant


def _exchange_a3_a4(packed: Packed) -> None:
    a = packed.parameters[0].vehicle.actuator_pitch
    a.omega_3_radps, a.omega_4_radps = float(a.omega_4_radps), float(a.omega_3_radps)
    a.zeta_3, a.zeta_4 = float(a.zeta_4), float(a.zeta_3)


def _sections(packed: Packed) -> Array:
    filters = packed.parameters[0].computer.law.pd
    out: Array = filters.sections[0, : int(filters.n_sections[0])]
    return out


def _coefficient(section: int, place: int, factor: float) -> PackedChange:
    def plant(packed: Packed) -> None:
        _sections(packed)[section, place] *= factor

    return plant


def _one_sample_late(packed: Packed) -> None:
    filters = packed.parameters[0].computer.law.pd
    used = int(filters.n_sections[0])
    assert used < MAX_SECTIONS
    filters.sections[0, used] = [0.0, 1.0, 0.0, 0.0, 0.0]
    filters.n_sections[0] = used + 1


def _without_prewarping(packed: Packed) -> None:
    """Discretise each section again without the prewarping at 9.2 Hz, so that its frequencies shift."""
    warp_hz, period_s = 9.2, 1e-9 * float(packed.parameters[0].computer.sample_ns)
    right = np.pi * warp_hz / np.tan(np.pi * warp_hz * period_s)
    wrong = 1.0 / period_s
    for section in _sections(packed):
        b, a = _to_continuous(section[:3], right), _to_continuous(np.array([1.0, *section[3:]]), right)
        top, bottom = _to_discrete(b, wrong), _to_discrete(a, wrong)
        section[:3], section[3:] = top / bottom[0], bottom[1:] / bottom[0]


def _to_continuous(z: Array, c: float) -> Array:
    """Return the coefficients in s of a polynomial in 1/z, without the common factor.

    The substitution is s = 2 c (z - 1) / (z + 1), with c = 1/T without prewarping.
    """
    b0, b1, b2 = z
    return np.array([b0 - b1 + b2, 4.0 * c * (b0 - b2), 4.0 * c * c * (b0 + b1 + b2)])


def _to_discrete(s: Array, c: float) -> Array:
    s2, s1, s0 = s
    k = 2.0 * c
    return np.array([s2 * k * k + s1 * k + s0, 2.0 * (s0 - s2 * k * k), s2 * k * k - s1 * k + s0])


def _gains(rows: Callable[[Array], Array]) -> PackedChange:
    """Return a fault that applies `rows` to the columns of the gain table: k_p pitch, k_d pitch, k_p yaw, k_d yaw."""

    def plant(packed: Packed) -> None:
        table = table_in(packed.pool, packed.parameters[0].computer.law.pd.gains).coefficients
        table[:, 0] = rows(table[:, 0])

    return plant


def _aero_moment_sign(packed: Packed) -> None:
    """Reflect the centre of pressure of every surface about the CG."""
    row = packed.parameters[0]
    of_vehicle, surfaces = table_in(packed.pool, row.vehicle.schedule), int(row.vehicle.sizes.surfaces)
    breaks = of_vehicle.breaks
    k = int(np.clip(np.searchsorted(breaks, float(row.timeline.frozen_s), side="right") - 1, 0, len(breaks) - 2))
    cg = of_vehicle.coefficients[k, 0, schedule.CORE_CG]
    table = table_in(packed.pool, row.vehicle.aero.table).coefficients
    for s in range(surfaces):
        slope = table.shape[2] - 2 * surfaces + 2 * s
        table[:, :, slope + 1] = 2.0 * cg * table[:, :, slope] - table[:, :, slope + 1]


FIRST, SECOND, THIRD = slice(0, 1), slice(1, 2), slice(2, 3)
ALL = slice(0, 3)

FAULTS: tuple[PlantedFault, ...] = (
    PlantedFault("mode 1 at the gyro, sign", _mode(schedule.MODE_SLOPE_GYRO, FIRST, -1.0)),
    PlantedFault("mode 2 at the gyro, sign", _mode(schedule.MODE_SLOPE_GYRO, SECOND, -1.0)),
    PlantedFault("mode 3 at the gyro, sign", _mode(schedule.MODE_SLOPE_GYRO, THIRD, -1.0)),
    PlantedFault("mode 1 at the gyro, 3 %", _mode(schedule.MODE_SLOPE_GYRO, FIRST, 1.03)),
    PlantedFault("displacement at the gimbal, sign", _mode(schedule.MODE_PHI_GIMBAL, ALL, -1.0)),
    PlantedFault("slope at the gimbal, sign", _mode(schedule.MODE_SLOPE_GIMBAL, ALL, -1.0)),
    PlantedFault("generalised mass of mode 1, 3 %", _mode(schedule.MODE_MASS, FIRST, 1.03)),
    PlantedFault("frequency of mode 1, 0.5 %", _mode(schedule.MODE_OMEGA, FIRST, 1.005)),
    PlantedFault("damping of the modes, 10 %", _times("vehicle.bending.zeta_pitch", 1.1)),
    PlantedFault("axial softening, sign", _times("vehicle.bending.softening_factor", -1.0)),
    PlantedFault("axial softening left out", _times("vehicle.bending.softening_factor", 0.0)),
    PlantedFault("mode shapes at the LOX hinge, sign", _mode_at("tank", 0, -1.0)),
    PlantedFault("mode shapes at the fuel hinge, sign", _mode_at("tank", 1, -1.0)),
    PlantedFault("mode slopes at the fins, sign", _mode_at("slope", 1, -1.0)),
    PlantedFault("mode shapes at the fins, sign", _mode_at("shape", 1, -1.0)),
    PlantedFault("local angle of attack left out", _set("vehicle.aero.local_incidence", lambda _: 0)),
    PlantedFault("thrust does not follow the bent gimbal", _set("vehicle.follower_thrust", lambda _: 0)),
    PlantedFault(
        "engine inertia left out",
        _both(_times("vehicle.engine.gimballed_mass_kg", 0.0), _times("vehicle.engine.inertia_kgm2", 0.0)),
    ),
    PlantedFault(
        "engine inertia, 5 %",
        _both(_times("vehicle.engine.gimballed_mass_kg", 1.05), _times("vehicle.engine.inertia_kgm2", 1.05)),
    ),
    PlantedFault("engine's CG forward of the gimbal", _times("vehicle.engine.cg_from_gimbal_m", -1.0)),
    PlantedFault("hinges 5 cm aft", _tank(schedule.TANK_HINGE, shift=0.05)),
    PlantedFault("sloshing mass, 5 %", _both(_tank(schedule.TANK_MASS, 1.05), _tank(schedule.TANK_MASS_RATE, 1.05))),
    PlantedFault("pendulum lengths, 1 %", _tank(schedule.TANK_LENGTH, 1.01)),
    PlantedFault("slosh damping, 10 %", _times("vehicle.slosh.damping_ratio", 1.1)),
    PlantedFault("aerodynamic moment, sign", _aero_moment_sign),
    PlantedFault("centre of pressure 10 cm aft", _set("vehicle.aero.centre_shift_m", lambda v: v + 0.1)),
    PlantedFault("normal force, 5 %", _times("vehicle.aero.force_factor", 1.05)),
    PlantedFault("rate damping, sign", _times("vehicle.aero.damping_factor", -1.0)),
    PlantedFault("jet damping left out", _set("vehicle.jet_damping", lambda _: 0)),
    PlantedFault("thrust, 3 %", _times("vehicle.engine.thrust_factor", 1.03)),
    PlantedFault("transverse inertia, 3 %", _column(schedule.CORE_INERTIA + 1, 1.03)),
    PlantedFault("CG 10 cm aft", _column(schedule.CORE_CG, shift=0.10)),
    PlantedFault("gimbal 10 cm forward", _set("vehicle.engine.gimbal_station_m", lambda v: v - 0.1)),
    PlantedFault("a3 and a4 of the actuator exchanged", _exchange_a3_a4),
    PlantedFault("damping ratio of the servo, 3 %", _times("vehicle.actuator_pitch.zeta_1", 1.03)),
    PlantedFault("gyro's damping ratio, 20 %", _times("vehicle.gyro.zeta", 1.2)),
    PlantedFault("gyro's scale, 3 %", _set("vehicle.gyro.scale_y", lambda v: v + 0.03)),
    PlantedFault("delay 1 ms longer", _set("computer.delay_ns", lambda v: v + 1_000_000)),
    PlantedFault("no delay", _set("computer.delay_ns", lambda _: 0)),
    PlantedFault("command one sample late", _one_sample_late),
    PlantedFault("filter not pre-warped", _without_prewarping),
    PlantedFault("b0 of the first section, 2 %", _coefficient(0, 0, 1.02)),
    PlantedFault("a2 of the second section, 2 %", _coefficient(1, 4, 1.02)),
    PlantedFault("second section left out", _set("computer.law.pd.n_sections", lambda v: v - 1)),
    PlantedFault("gains of the previous row", _gains(lambda g: g * (1.0 + 0.034 / 0.838))),
    PlantedFault("k_p and k_d exchanged", _gains(lambda g: g[:, [1, 0, 3, 2]])),
    PlantedFault("k_d, sign", _gains(lambda g: g * [1.0, -1.0, 1.0, 1.0])),
    PlantedFault("yaw's gains in pitch, 5 % apart", _gains(lambda g: g * [1.05, 1.05, 1.0, 1.0])),
)
