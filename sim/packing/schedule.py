"""The vehicle over time, as one table: mass, thrust, pendulums and modes of a stage on common breakpoints.

Sloshing masses are taken out of the core here: mass, CG and inertia of what stays are computed at every breakpoint
and then joined. Rates are the exact derivatives of the joined curves, so that what the engine expels is what the mass
loses (docs/model.md, section 8).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Cubics, Method, fit, merge, union
from maxq.sim.scenario.schema_scenario import Switches
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle import schedule as columns_of
from maxq.sim.vehicle.air.packing import surface_stations
from maxq.sim.vehicle.engine.burn import NOMINAL, Burn, burn_rate
from maxq.sim.vehicle.engine.packing import Mount, cluster_of, engine_mounts, on_clock, swinging, thrust_curves
from maxq.sim.vehicle.modes.packing import Places, mode_values, spatial_values
from maxq.sim.vehicle.modes.tables import ModeTable, SpatialModeTable
from maxq.sim.vehicle.slosh.packing import pendulums
from maxq.sim.vehicle.state import Sizes


def stage_sizes(stage: Stage, switches: Switches, burn: Burn = NOMINAL) -> Sizes:
    """Return the numbers of modes, pendulums and surfaces that are flown with these switches."""
    pitch = yaw = 0
    if stage.bending is not None and switches.bending:
        pitch_table, yaw_table = stage.bending.pitch_modes, stage.bending.yaw_modes
        pitch = pitch_table.modes if pitch_table else 0
        yaw = yaw_table.modes if yaw_table else 0
    bobs = len(stage.pendulum_names) if switches.slosh else 0
    tables = 0 if stage.aero is None else len(stage.aero.coefficients)
    spatial = stage.spatial_modes.modes.modes if stage.spatial_modes is not None and switches.bending else 0
    cluster = cluster_of(stage, burn.faults)
    return Sizes(
        pitch,
        yaw,
        bobs,
        len(surface_stations(stage)),
        tables,
        spatial,
        len(cluster.groups) - 1,
        max(len(cluster.alike), 1),
        max(len(cluster.gimbals_m), 1) + len(stage.sensors),
        max(len(cluster.curves), 1),
        len(swinging(stage, cluster, switches)),
        len(stage.sensors),
    )


def vehicle_schedule(stage: Stage, burn: Burn, sizes: Sizes, switches: Switches, frozen: bool) -> list[Cubics]:
    """All columns of vehicle/schedule.py, tables side by side, over the clock of the stage's tables or, where they
    differ, the stage's own.

    `frozen`: the CG does not wander (the schedule stands still).
    """
    method: Method = stage.interpolation
    hanging = pendulums(stage)[: sizes.pendulums]
    tanks = [pendulum.joined for pendulum in hanging]
    thrust, *further_thrusts = thrust_curves(stage, burn, method)
    parts = [_core(stage, burn, tanks, method, switches.moving_cg and not frozen), thrust]
    for pendulum in hanging:
        tank = on_clock(pendulum.joined, burn)
        rates = _tank_rates(tank, _pace(stage, burn), switches.jet_damping, switches.jet_damping and not frozen)
        parts += [tank, rates, on_clock(pendulum.waves, burn)]
    if stage.bending is not None:
        bending = stage.bending
        pitch = _modes(stage, burn, bending.pitch_modes if sizes.pitch_modes > 0 else None, sizes, tanks, method)
        alike = sizes.yaw_modes == sizes.pitch_modes and bending.yaw == bending.pitch
        yaw_table = bending.yaw_modes if sizes.yaw_modes > 0 and not alike else None
        parts += [pitch, pitch if alike else _modes(stage, burn, yaw_table, sizes, tanks, method)]
    if sizes.spatial_modes > 0:
        parts.append(_spatial_modes(stage, burn, sizes, tanks, method))
    parts += further_thrusts
    assert sum(part.n_columns for part in parts) == columns_of.schedule_width(sizes)
    return parts


def mass_table(stage: Stage) -> tuple[Array, Array]:
    """Times and rows of total mass, CG (3) and inertia integrals (6)."""
    mass = stage.mass
    if mass.table is not None:
        table = mass.table
        names = ("y_cg_m", "z_cg_m"), ("Ixy_kgm2", "Ixz_kgm2", "Iyz_kgm2")
        rows = [table["mass_kg"], table["x_cg_m"], *[table.get(n) for n in names[0]]]
        rows += [table["Ixx_kgm2"], table["Iyy_kgm2"], table["Izz_kgm2"], *[table.get(n) for n in names[1]]]
        return table["time_s"], np.stack(rows, axis=1)
    assert mass.mass_kg is not None
    assert mass.x_cg_m is not None
    j = np.array(mass.inertia_kgm2)
    row = np.array(
        [
            *(mass.mass_kg, mass.x_cg_m, mass.y_cg_m or 0.0, mass.z_cg_m or 0.0),
            *(j[0, 0], j[1, 1], j[2, 2], -j[0, 1], -j[0, 2], -j[1, 2]),
        ]
    )
    if not mass.mass_flow_kgps or not mass.burn_s:
        return np.array([0.0]), row[None]
    end = row.copy()
    end[0] -= mass.mass_flow_kgps * mass.burn_s
    begin_s = stage.ignition_s
    return np.array([begin_s, begin_s + mass.burn_s]), np.stack([row, end])


def _core(stage: Stage, burn: Burn, tanks: Sequence[Cubics], method: Method, moving_cg: bool) -> Cubics:
    """Columns CORE_MASS to MASS_FLOW."""
    total = fit(*mass_table(stage), method)
    core = merge([total])
    if tanks:
        breaks = union(total, *tanks)
        core = fit(breaks, without_bobs(total.at(breaks), [tank.at(breaks) for tank in tanks]), method)
    core, total = on_clock(core, burn), on_clock(total, burn)
    rates = _derivative(core, _pace(stage, burn))
    if not moving_cg:
        rates.coefficients[:, :, 1:4] = 0.0
    flow = _derivative(total, _pace(stage, burn))
    mass, outflow = _columns(total, [0]), _columns(flow, [0])
    outflow.coefficients[:] *= -1.0
    # order: core mass, CG, inertia | rates of CG and inertia | total mass, mass flow
    return merge([core, _columns(rates, list(range(1, 10))), mass, outflow])


def without_bobs(total: Array, bobs: list[Array]) -> Array:
    """Rows (n, 10) of mass, CG and inertia of the vehicle less its bobs, each at rest below its hinge.

    Sums are written out: a linear-algebra library adds in an order that depends on the processor.
    """
    mass, station, y, z = total[:, :4].T
    nothing = np.zeros_like(mass)
    moved = [(-bob[:, 0], np.stack([station - (bob[:, 2] + bob[:, 1]), -y, -z])) for bob in bobs]
    core_mass, cg = mass.copy(), np.stack([nothing, nothing, nothing])
    for m, r in moved:
        core_mass += m
        cg += m * r
    cg /= core_mass
    integrals = total[:, 4:10].copy()
    for m, r in [*moved, (-core_mass, cg)]:
        x_, y_, z_ = r
        squares = [y_ * y_ + z_ * z_, x_ * x_ + z_ * z_, x_ * x_ + y_ * y_, x_ * y_, x_ * z_, y_ * z_]
        integrals += (m * np.stack(squares)).T
    return np.stack([core_mass, station - cg[0], y + cg[1], z + cg[2], *integrals.T], axis=1)


def _tank_rates(tank: Cubics, pace: float, shrinks: bool, travels: bool) -> Cubics:
    """Rates of a bob's mass and of its station."""
    derivative = _derivative(tank, pace)
    rates = derivative.coefficients
    out = np.zeros((*rates.shape[:2], 2))
    if shrinks:
        out[:, :, 0] = rates[:, :, 0]
    if travels:
        out[:, :, 1] = rates[:, :, 1] + rates[:, :, 2]
    return Cubics(derivative.breaks, out)


def _pace(stage: Stage, burn: Burn) -> float:
    """Seconds of the schedule's clock per second of flight."""
    return burn_rate(stage) if burn.clock is None else 1.0


def _derivative(table: Cubics, pace: float) -> Cubics:
    """Exact derivative by the time of flight; zero outside the table, where its end values hold."""
    n, _, columns = table.coefficients.shape
    breaks = np.concatenate([[table.breaks[0] - 1.0], table.breaks, [table.breaks[-1] + 1.0]])
    out = np.zeros((n + 2, 4, columns))
    for power in range(3):
        out[1:-1, power] = pace * (power + 1) * table.coefficients[:, power + 1]
    return Cubics(breaks, out)


def _columns(table: Cubics, columns: list[int]) -> Cubics:
    return Cubics(table.breaks, table.coefficients[:, :, columns].copy())


def _modes(
    stage: Stage, burn: Burn, table: ModeTable | None, sizes: Sizes, tanks: Sequence[Cubics], method: Method
) -> Cubics:
    """Columns of all modes of one plane; zeros without a table."""
    rows, padded_modes = columns_of.mode_rows(sizes), columns_of.padded_modes(sizes)
    if table is None or rows * padded_modes == 0:
        return fit([0.0], np.zeros((1, rows * padded_modes)))
    bending = stage.bending
    values = mode_values(table, (rows, padded_modes), _places(stage, burn, table, tanks))
    joined = fit(table.time_s, values, method)
    assert bending is not None
    factors = np.ones((rows, padded_modes))
    factors[columns_of.MODE_SLOPE_GYRO, : table.modes] = bending.gyro_slope_factor[: table.modes]
    for gimbal in range(sizes.gimbals):
        row = columns_of.gimbal_row(sizes, gimbal)
        of_engine = gimbal < sizes.gimbals - sizes.sensors
        given = bending.gimbal_shape_factor if of_engine else bending.gyro_slope_factor
        factors[row : row + 2, : table.modes] = given[: table.modes]
    return on_clock(Cubics(joined.breaks, joined.coefficients * factors.ravel()), burn)


def _places(stage: Stage, burn: Burn, table: ModeTable | SpatialModeTable, tanks: Sequence[Cubics]) -> Places:
    mounts = engine_mounts(stage, burn) or (Mount(float(table.station_m[-1]), 1.0, 0.0),)
    gyro_m = stage.gyro.station_m if stage.gyro else float(table.station_m[0])
    hinges_m = tuple(tank.at(table.time_s)[:, 2].tobytes() for tank in tanks)
    sensors_m = tuple(sensor.station_m for sensor in stage.sensors)
    return Places(mounts, gyro_m, hinges_m, surface_stations(stage), sensors_m)


def _spatial_modes(stage: Stage, burn: Burn, sizes: Sizes, tanks: Sequence[Cubics], method: Method) -> Cubics:
    """Columns of all spatial modes."""
    given = stage.spatial_modes
    assert given is not None
    table, n = given.modes, sizes.spatial_modes
    mass, _, inertia = np.split(mass_table(stage)[1][0], [1, 4])
    values = spatial_values(table, _places(stage, burn, table, tanks), float(inertia[0] / mass[0]))
    joined = fit(table.time_s, values, method)
    factors = np.ones((values.shape[1] // n, n))
    gyro, gimbal = (
        columns_of.SPATIAL_FIRST + 6 * p for p in (columns_of.GYRO_PLACE, columns_of.gimbal_place(sizes, 0))
    )
    factors[gyro + 3 : gyro + 6] = given.gyro_slope_factor
    engines = 6 * (sizes.gimbals - sizes.sensors)
    factors[gimbal : gimbal + engines] = given.gimbal_shape_factor
    factors[gimbal + engines : gimbal + 6 * sizes.gimbals] = given.gyro_slope_factor
    return on_clock(Cubics(joined.breaks, joined.coefficients * factors.ravel()), burn)
