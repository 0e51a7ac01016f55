"""The schedule of a stage: a table of its mass, thrust, pendulums and modes over time, on common breakpoints.

Sloshing masses are subtracted from the core here. Mass, CG and inertia of the remainder are computed at every
breakpoint and then interpolated. Rates are the exact derivatives of the interpolated curves, so that the engines expel
exactly the mass that the vehicle loses (docs/model.md, section 8).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Cubics, Method, fit, merge, union
from maxq.sim.scenario.schema_scenario import Switches
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle import schedule as columns_of
from maxq.sim.vehicle.air.packing import surface_bodies, surface_stations
from maxq.sim.vehicle.body.section import joined, squares
from maxq.sim.vehicle.engine.burn import NOMINAL, Burn, burn_rate, table_time_s
from maxq.sim.vehicle.engine.packing import (
    Mount,
    cluster_of,
    engine_mounts,
    hung_engines,
    on_clock,
    swinging,
    thrust_curves,
)
from maxq.sim.vehicle.loads.packing import CarriedBoosters
from maxq.sim.vehicle.modes.masses import turning
from maxq.sim.vehicle.modes.packing import Carried, Hung, Places, mode_values, spatial_values
from maxq.sim.vehicle.modes.tables import ModeTable, SpatialModeTable
from maxq.sim.vehicle.slosh.packing import Pendulum, pendulums
from maxq.sim.vehicle.state import Sizes

_INTERVAL_S = 2.0  # longest interval of interpolated CG and inertia of several bodies


def stage_sizes(stage: Stage, switches: Switches, burn: Burn = NOMINAL) -> Sizes:
    """Return the numbers of modes, pendulums, surfaces, engines and sensors that are simulated with these switches."""
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
        max(len(cluster.mounts), 1) + len(stage.acted_stations_m) + len(stage.sensors),
        max(len(cluster.curves), 1),
        len(swinging(stage, cluster, switches)),
        len(stage.sensors),
        len(stage.buffet.stations_m) if stage.buffet is not None else 0,
        len(stage.feed_line),
        int(pitch + yaw > 0 and stage.aero is not None and stage.aero.lag_m is not None and switches.aerodynamics),
    )


def vehicle_schedule(stage: Stage, burn: Burn, sizes: Sizes, switches: Switches, frozen: bool) -> list[Cubics]:
    """Return all columns of sim/vehicle/schedule.py as tables in that order.

    Their argument is the clock of the stage's tables, or the stage clock if the clocks of its tables differ. With
    `frozen`, the schedule is stopped, and the CG does not move.
    """
    method: Method = stage.interpolation
    hanging = pendulums(stage)[: sizes.pendulums]
    thrust, *further_thrusts = thrust_curves(stage, burn, method)
    parts = [_core(stage, burn, hanging, method, switches.moving_cg and not frozen), thrust]
    for pendulum in hanging:
        own = burn.of(pendulum.body)
        tank = on_clock(pendulum.joined, own)
        rates = _tank_rates(tank, _pace(stage, own), switches.jet_damping, switches.jet_damping and not frozen)
        parts += [tank, rates, on_clock(pendulum.waves, own)]
    if stage.bending is not None:
        bending = stage.bending
        pitch = _modes(stage, burn, bending.pitch_modes if sizes.pitch_modes > 0 else None, sizes, hanging, method)
        alike = sizes.yaw_modes == sizes.pitch_modes and bending.yaw == bending.pitch
        yaw_table = bending.yaw_modes if sizes.yaw_modes > 0 and not alike else None
        parts += [pitch, pitch if alike else _modes(stage, burn, yaw_table, sizes, hanging, method)]
    if sizes.spatial_modes > 0:
        parts.append(_spatial_modes(stage, burn, sizes, hanging, method))
    parts += further_thrusts
    assert sum(part.n_columns for part in parts) == columns_of.schedule_width(sizes)
    return parts


def mass_at(stage: Stage, burn: Burn, time_s: float) -> tuple[float, ...]:
    """Return mass, kg, CG station, y and z, m, and roll inertia, kg m2, of the vehicle at an instant of a stage."""
    times, rows = stage.mass_over_time()
    at_s = time_s if stage.booster else table_time_s(stage, burn, time_s)
    return tuple(float(np.interp(at_s, times, column)) for column in rows[:, :5].T)


def _core(stage: Stage, burn: Burn, hanging: Sequence[Pendulum], method: Method, moving_cg: bool) -> Cubics:
    """Return the columns CORE_MASS to MASS_FLOW of the schedule."""
    cores, totals = [], []
    for b in range(len(stage.bodies)):
        core, total = _body(stage, b, hanging, method)
        cores.append(on_clock(core, burn.of(b)))
        totals.append(on_clock(total, burn.of(b)))
    core, total = cores[0], totals[0]
    if stage.booster:
        places = [(0.0, 0.0), *(booster.position_m for booster in stage.booster)]
        core, total = _together(cores, places), _together(totals, places)
    rates = _derivative(core, _pace(stage, burn))
    if not moving_cg:
        rates.coefficients[:, :, 1:4] = 0.0
    flow = _derivative(total, _pace(stage, burn))
    mass, outflow = _columns(total, [0]), _columns(flow, [0])
    outflow.coefficients[:] *= -1.0
    # order: core mass, CG, inertia | rates of CG and inertia | total mass, mass flow
    return merge([core, _columns(rates, list(range(1, 10))), mass, outflow])


def _body(stage: Stage, b: int, hanging: Sequence[Pendulum], method: Method) -> tuple[Cubics, Cubics]:
    """Return mass, CG and inertia of a body without and with its bobs, over the clock of its tables."""
    body, own = stage.bodies[b], [pendulum for pendulum in hanging if pendulum.body == b]
    tanks, beside = [pendulum.joined for pendulum in own], [pendulum.tank.position_m for pendulum in own]
    total = fit(*body.mass.rows(body.ignition_s if b == 0 else 0.0), method)
    core = merge([total])
    if tanks:
        breaks = union(total, *tanks)
        core = fit(breaks, without_bobs(total.at(breaks), [tank.at(breaks) for tank in tanks], beside), method)
    return core, total


def carried_boosters(stage: Stage, burn: Burn, sizes: Sizes) -> CarriedBoosters:
    """Return the mass properties of the boosters without their bobs; y and z are from the axis of the vehicle."""
    hanging, nominal = pendulums(stage)[: sizes.pendulums], []
    for b, booster in enumerate(stage.booster, start=1):
        own = _body(stage, b, hanging, stage.interpolation)[0]
        coefficients = own.coefficients.copy()
        coefficients[:, 0, 2:4] += np.array(booster.position_m)
        nominal.append(Cubics(own.breaks, coefficients))
    return CarriedBoosters(nominal, [on_clock(own, burn.of(b)) for b, own in enumerate(nominal, start=1)])


def _together(bodies: Sequence[Cubics], places: Sequence[tuple[float, float]]) -> Cubics:
    """Return mass, CG and inertia of several bodies combined, in the columns of `without_bobs`.

    Mass is exact. CG and inertia are cubics with exact values and slopes at both ends of intervals of at most
    `_INTERVAL_S`. `places` are y and z of each body's axis, m.
    """
    breaks = union(*bodies)
    fine = [np.linspace(a, b, max(1, math.ceil((b - a) / _INTERVAL_S)), endpoint=False) for a, b in pairwise(breaks)]
    at = np.append(np.concatenate(fine), breaks[-1])
    merged = merge([*bodies, fit(at, np.zeros((len(at), 1)))])
    c, h = merged.coefficients, np.diff(merged.breaks)[:, None]
    ends = []
    for s in (0.0 * h, h):
        values = c[:, 0] + s * (c[:, 1] + s * (c[:, 2] + s * c[:, 3]))
        slopes = c[:, 1] + s * (2.0 * c[:, 2] + s * 3.0 * c[:, 3])
        parts = [(values[:, k : k + 10], slopes[:, k : k + 10]) for k in range(0, 10 * len(bodies), 10)]
        now = joined([(value, place) for (value, _), place in zip(parts, places, strict=True)])
        ends.append((now, _joined_rates(now, parts, places)))
    (v_0, d_0), (v_1, d_1) = ends
    secant = (v_1 - v_0) / h
    bend = (d_0 + d_1 - 2.0 * secant) / h
    return Cubics(merged.breaks, np.stack([v_0, d_0, (secant - d_0) / h - bend, bend / h], axis=1))


def _joined_rates(total: Array, parts: Sequence[tuple[Array, Array]], places: Sequence[tuple[float, float]]) -> Array:
    """Return the rates (n, 10) of the rows `total` (n, 10) of `joined`, from the values and rates of its parts."""
    first, second = np.zeros((len(total), 3)), np.zeros((len(total), 6))
    flow = np.zeros(len(total))
    for (value, rate), place in zip(parts, places, strict=True):
        mass, r = value[:, :1], value[:, 1:4] + np.array([0.0, *place])
        first += rate[:, :1] * r + mass * rate[:, 1:4]
        second += rate[:, 4:] + rate[:, :1] * squares(*r.T) + mass * _squares_rate(r, rate[:, 1:4])
        flow += rate[:, 0]
    mass, r = total[:, :1], total[:, 1:4]
    moving = (first - flow[:, None] * r) / mass
    second -= flow[:, None] * squares(*r.T) + mass * _squares_rate(r, moving)
    return np.column_stack([flow, moving, second])


def _squares_rate(r: Array, rate: Array) -> Array:
    """Return the rates (n, 6) of `squares` at places `r` (n, 3), station, y and z, that move at `rate` (n, 3)."""
    (x, y, z), (u, v, w) = r.T * np.array([[-1.0], [1.0], [1.0]]), rate.T * np.array([[-1.0], [1.0], [1.0]])
    xx, yy, zz = 2.0 * x * u, 2.0 * y * v, 2.0 * z * w
    return np.stack([yy + zz, xx + zz, xx + yy, u * y + x * v, u * z + x * w, v * z + y * w], axis=1)


def without_bobs(total: Array, bobs: list[Array], places: Sequence[tuple[float, float]]) -> Array:
    """Return rows (n, 10) of mass, CG and inertia of the vehicle without its bobs, which hang aft of their hinges.

    `total` (n, 10) includes the bobs. `bobs` are rows (n, 3) of mass, pendulum length and hinge station for each bob,
    and `places` are y and z of each hinge, m. Sums are written out, because the order of additions in a linear-algebra
    library depends on the processor.
    """
    mass, station, y, z = total[:, :4].T
    nothing = np.zeros_like(mass)
    moved = [
        (-bob[:, 0], np.stack([station - (bob[:, 2] + bob[:, 1]), at_y - y, at_z - z]))
        for bob, (at_y, at_z) in zip(bobs, places, strict=True)
    ]
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
    """Return the rates of a bob's mass (0 unless it `shrinks`) and station (0 unless it `travels`)."""
    derivative = _derivative(tank, pace)
    rates = derivative.coefficients
    out = np.zeros((*rates.shape[:2], 2))
    if shrinks:
        out[:, :, 0] = rates[:, :, 0]
    if travels:
        out[:, :, 1] = rates[:, :, 1] + rates[:, :, 2]
    return Cubics(derivative.breaks, out)


def _pace(stage: Stage, burn: Burn) -> float:
    """Return the rate of the schedule's clock relative to the flight time."""
    return burn_rate(stage) if burn.clock is None else 1.0


def _derivative(table: Cubics, pace: float) -> Cubics:
    """Return the exact derivative of a table with respect to the flight time.

    It is zero outside the table, where the end values hold.
    """
    n, _, columns = table.coefficients.shape
    breaks = np.concatenate([[table.breaks[0] - 1.0], table.breaks, [table.breaks[-1] + 1.0]])
    out = np.zeros((n + 2, 4, columns))
    for power in range(3):
        out[1:-1, power] = pace * (power + 1) * table.coefficients[:, power + 1]
    return Cubics(breaks, out)


def _columns(table: Cubics, columns: list[int]) -> Cubics:
    return Cubics(table.breaks, table.coefficients[:, :, columns].copy())


def _modes(
    stage: Stage, burn: Burn, table: ModeTable | None, sizes: Sizes, tanks: Sequence[Pendulum], method: Method
) -> Cubics:
    """Return the columns of all modes of a plane, or zeros without a table."""
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
        if gimbal < columns_of.first_acted(sizes):
            factors[row : row + 2, : table.modes] = bending.gimbal_shape_factor[: table.modes]
        elif gimbal >= sizes.gimbals - sizes.sensors:
            factors[row : row + 2, : table.modes] = bending.gyro_slope_factor[: table.modes]
    return on_clock(Cubics(joined.breaks, joined.coefficients * factors.ravel()), burn)


def _places(stage: Stage, burn: Burn, table: ModeTable | SpatialModeTable, tanks: Sequence[Pendulum]) -> Places:
    mounts = engine_mounts(stage, burn, table.time_s) or (Mount(float(table.station_m[-1]), 1.0),)
    gyro_m = stage.gyro.station_m if stage.gyro else float(table.station_m[0])
    hinges_m = tuple(tank.joined.at(burn.of(tank.body).over(table.time_s))[:, 2].tobytes() for tank in tanks)
    sensors_m = (*stage.acted_stations_m, *(sensor.station_m for sensor in stage.sensors))
    carried = Carried(
        tuple((b.attachments_m, b.position_m) for b in stage.booster),
        tuple(tank.body for tank in tanks),
        surface_bodies(stage),
    )
    return Places(
        mounts, gyro_m, hinges_m, surface_stations(stage), sensors_m, carried, *_axial(stage, burn, table, tanks)
    )


def _axial(
    stage: Stage, burn: Burn, table: ModeTable | SpatialModeTable, tanks: Sequence[Pendulum]
) -> tuple[tuple[float, ...], tuple[Hung, ...]]:
    """Return the mass of the vehicle at the times of a table, and the masses that hang from the core.

    The bobs of a booster hang from their hinges.
    """
    times, rows = stage.mass_over_time()
    hung = [Hung(station_m, (moment_kgm,)) for station_m, moment_kgm in hung_engines(stage, burn)]
    for b, booster in enumerate(stage.booster, start=1):
        first, at_s = booster.attachments_m[0], burn.of(b).over(table.time_s)
        dry = _body(stage, b, tanks, stage.interpolation)[0].at(at_s)
        moment = dry[:, 0] * (dry[:, 1] - first)
        for pendulum in (each for each in tanks if each.body == b):
            bob = pendulum.joined.at(at_s)
            moment = moment + bob[:, 0] * (bob[:, 2] - first)
        hung.append(Hung(first, tuple(moment.tolist()), booster.attachments_m))
    return tuple(np.interp(table.time_s, times, rows[:, 0]).tolist()), tuple(hung)


def _spatial_modes(stage: Stage, burn: Burn, sizes: Sizes, tanks: Sequence[Pendulum], method: Method) -> Cubics:
    """Return the columns of all spatial modes."""
    given = stage.spatial_modes
    assert given is not None
    table, n = given.modes, sizes.spatial_modes
    mass, _, inertia = np.split(stage.mass_over_time()[1][0], [1, 4])
    shares = turning(table, stage.engine_masses, float(inertia[0] / mass[0]))
    rows = np.concatenate([spatial_values(table, _places(stage, burn, table, tanks)), shares], axis=1)
    values = rows.reshape(len(table.time_s), -1)
    joined = fit(table.time_s, values, method)
    factors = np.ones((values.shape[1] // n, n))
    gyro, gimbal = (
        columns_of.SPATIAL_FIRST + 6 * p for p in (columns_of.GYRO_PLACE, columns_of.gimbal_place(sizes, 0))
    )
    factors[gyro + 3 : gyro + 6] = given.gyro_slope_factor
    end = gimbal + 6 * sizes.gimbals
    factors[gimbal : gimbal + 6 * columns_of.first_acted(sizes)] = given.gimbal_shape_factor
    factors[end - 6 * sizes.sensors : end] = given.gyro_slope_factor
    return on_clock(Cubics(joined.breaks, joined.coefficients * factors.ravel()), burn)
