"""The mass and the modes along the body as the columns of the section loads (sim/vehicle/loads/columns.py)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from maxq.control.kernel.limits import MAX_BOOSTERS, MAX_ENGINES, MAX_LOAD_STATIONS, MAX_PENDULUMS, MAX_SURFACES
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import NO_TABLE, Cubics, Method, Pool, fit
from maxq.sim.input.remembered import cached_by_identity
from maxq.sim.input.values import to_ns
from maxq.sim.vehicle.air.packing import surface_bodies
from maxq.sim.vehicle.engine.burn import Burn
from maxq.sim.vehicle.engine.packing import on_clock
from maxq.sim.vehicle.loads import columns as columns_of
from maxq.sim.vehicle.loads import section as schema
from maxq.sim.vehicle.loads.columns import Loads
from maxq.sim.vehicle.modes.shapes import ModeShapes, SpatialShapes, on_body, shapes_over, spatial_over
from maxq.sim.vehicle.modes.tables import ModeTable, SpatialModeTable
from maxq.sim.vehicle.slosh.packing import pendulum_curves, pendulums
from maxq.sim.vehicle.slosh.section import Tank
from maxq.sim.vehicle.state import Sizes

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_booster import Booster
    from maxq.sim.scenario.schema_scenario import Scenario
    from maxq.sim.scenario.schema_vehicle import Stage

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)  # exact to degree 7; mass times shape has degree 5


class CarriedBoosters(NamedTuple):
    """The mass properties of the boosters without bobs: over the clock of their tables, and of the schedule."""

    nominal: Sequence[Cubics] = ()
    flown: Sequence[Cubics] = ()


def pack_loads(
    scenario: Scenario, stage: Stage, burn: Burn, sizes: Sizes, pool: Pool, boosters: CarriedBoosters
) -> Loads:
    """Return the section loads of a stage, or none unless they are switched on."""
    given = stage.loads
    stations, bottoms = np.zeros(MAX_LOAD_STATIONS), np.full(MAX_PENDULUMS, -np.inf)
    places, shares = np.zeros(MAX_SURFACES), np.zeros(MAX_SURFACES)
    carried = _carried(stage, sizes)
    if given is None or not scenario.switches.section_loads:
        none: dict[str, Any] = {"boosters": 0, "booster_table": NO_TABLE, "booster_axial": NO_TABLE}
        return Loads(0, 1, 0, 1, NO_TABLE, 0.0, 1.0, stations, bottoms, 0, places, shares, **none, **carried)
    stations[: len(given.stations_m)] = given.stations_m
    tanks = stage.tank if sizes.pendulums > 0 else ()
    below = [
        q.bottom_station_m for q, t in zip(_liquids_of(given, tanks), tanks, strict=True) for _ in range(t.pendulums)
    ]
    bottoms[: len(below)] = below
    points = 1
    places[0], shares[0] = given.nose_station_m, 1.0
    if given.axial_force is not None:
        points = len(given.axial_force)
        places[:points], shares[:points] = given.axial_force["station_m"], given.axial_force["share"]
    bending = stage.bending
    pitch = bending.pitch_modes if bending is not None and sizes.pitch_modes else None
    alike = bending is None or bending.pitch == bending.yaw
    yaw = pitch if alike else bending.yaw_modes if bending is not None and sizes.yaw_modes else None
    spatial = stage.spatial_modes.modes if stage.spatial_modes is not None and sizes.spatial_modes else None
    tables: dict[str, Any] = {"booster_table": NO_TABLE, "booster_axial": NO_TABLE}
    if not stage.booster:
        columns = _table(given, tanks, pitch, yaw, spatial, stage.interpolation)
    else:
        bearers = _bearers(stage, boosters.nominal)
        columns, shapes = _columns(given, tanks, pitch, yaw, spatial, stage.interpolation, bearers)
        tables["booster_table"] = pool.add(*boosters.flown, on_clock(shapes, burn))
        tables["booster_axial"] = pool.add(*(_axial(stage, booster) for booster in stage.booster))
    ends = [engine.gimbal_station_m for engine in stage.own_engines] or given.line_mass["rear_station_m"].tolist()
    return Loads(
        stations=len(given.stations_m),
        period_ns=to_ns(given.period_s),
        coast=int(given.coast),
        alike=int(alike),
        table=pool.add(on_clock(columns, burn)),
        nose_m=given.nose_station_m,
        tail_m=min(ends) if stage.own_engines else max(ends),
        station_m=stations,
        bottom_m=bottoms,
        axial_points=points,
        axial_m=places,
        axial_share=shares,
        boosters=len(stage.booster),
        **tables,
        **carried,
    )


def _carried(stage: Stage, sizes: Sizes) -> dict[str, Any]:
    """Return the places of the boosters, and the booster of each engine, pendulum and surface (-1: the core)."""
    out: dict[str, Any] = {}
    for name in ("held_m", "second_m", "axis_y_m", "axis_z_m"):
        out[name] = np.zeros(MAX_BOOSTERS)
    for b, booster in enumerate(stage.booster[:MAX_BOOSTERS]):
        out["held_m"][b], out["second_m"][b] = booster.attachments_m[0], booster.attachments_m[-1]
        out["axis_y_m"][b], out["axis_z_m"][b] = booster.position_m
    out["engine_y_m"], out["engine_z_m"] = np.zeros(MAX_ENGINES), np.zeros(MAX_ENGINES)
    for n, engine in enumerate(stage.engines):
        out["engine_y_m"][n], out["engine_z_m"][n] = engine.offset_m
    of_tanks = [pendulum.body for pendulum in pendulums(stage)[: sizes.pendulums]]
    for name, bodies, size in (
        ("engine_booster", stage.engine_bodies, MAX_ENGINES),
        ("tank_booster", of_tanks, MAX_PENDULUMS),
        ("surface_booster", surface_bodies(stage), MAX_SURFACES + 1),
    ):
        out[name] = np.full(size, -1, np.int64)
        out[name][: len(bodies)] = np.array(bodies, np.int64) - 1
    return out


def _axial(stage: Stage, booster: Booster) -> Cubics:
    """Return CA of a booster over Mach number, as the stage's table interpolates it."""
    if booster.aero is None or stage.aero is None:
        return fit([0.0], [[0.0]])
    table = booster.aero.table
    return fit(table["mach"], table.get("CA")[:, None], stage.aero.interpolation)


class _Bearer(NamedTuple):
    """A booster on the core: its attachments, and its mass properties over the time since its ignition."""

    attachments_m: tuple[float, ...]
    ignition_s: float
    mass: Cubics

    def at(self, times: Array) -> tuple[Array, Array, Array]:
        """Return mass, station of the CG and mean transverse inertia (T,) at times of the stage clock."""
        rows = self.mass.at(times - self.ignition_s)
        return rows[:, 0], rows[:, 1], 0.5 * (rows[:, 5] + rows[:, 6])

    def shapes(self, core: ModeShapes) -> tuple[Array, Array]:
        """Return the shape at the first attachment and the slope of the booster (T, M) (docs/model.md, 4.12)."""
        own, first = on_body(core, self.attachments_m), self.attachments_m[0]
        return own.value(first)[0], own.slope(first)[0]

    def in_space(self, core: SpatialShapes) -> Array:
        """Return the rows ATTACHED to LEAN_Z (6, T, M) of the spatial modes."""
        x, y, z, about_x, about_y, about_z = core.at(self.attachments_m[0], self.attachments_m)[0]
        return np.stack([x, y, z, about_x, -about_z, about_y])

    def of_cg(self, rows: Array, times: Array) -> Array:
        """Return the displacements x, y, z (3, T, M) of the CG by the rows of `in_space`."""
        aft, y, z = (self.mass.at(times - self.ignition_s)[:, 1:4] - [self.attachments_m[0], 0.0, 0.0]).T[:, :, None]
        twist, lean_y, lean_z = rows[3:]
        return np.asarray(
            rows[:3] + np.stack([lean_y * y + lean_z * z, aft * lean_y - twist * z, aft * lean_z + twist * y])
        )


class _InSpace(NamedTuple):
    """The motion of a booster's CG by spatial modes along one axis, with its slope and the motion along x (T, M).

    `offset_m` (T,): its distance from the axis of the core along the same axis.
    """

    lateral: Array
    slope: Array
    axial: Array
    offset_m: Array


def _bearers(stage: Stage, nominal: Sequence[Cubics]) -> tuple[_Bearer, ...]:
    return tuple(_Bearer(b.attachments_m, b.ignition_s, mass) for b, mass in zip(stage.booster, nominal, strict=True))


def _liquids_of(loads: schema.LoadsSection, tanks: Sequence[Tank]) -> list[schema.Liquid]:
    """Return the liquid of each tank."""
    by_name = {liquid.tank: liquid for liquid in loads.liquid}
    return [by_name[tank.name or str(n + 1)] for n, tank in enumerate(tanks)]


@cached_by_identity
def _table(
    loads: schema.LoadsSection,
    tanks: tuple[Tank, ...],
    pitch: ModeTable | None,
    yaw: ModeTable | None,
    spatial: SpatialModeTable | None,
    method: Method,
) -> Cubics:
    """Return all columns over the stage's clock, of a core without boosters."""
    return _columns(loads, tanks, pitch, yaw, spatial, method, ())[0]


def _columns(
    loads: schema.LoadsSection,
    tanks: tuple[Tank, ...],
    pitch: ModeTable | None,
    yaw: ModeTable | None,
    spatial: SpatialModeTable | None,
    method: Method,
    boosters: tuple[_Bearer, ...],
) -> tuple[Cubics, Cubics]:
    """Return all columns over the stage's clock, and those of the shapes of boosters."""
    planes = [pitch] if pitch is yaw else [pitch, yaw]
    modes = max((table.modes for table in planes if table is not None), default=0)
    sources = [liquid.table["time_s"] for liquid in loads.liquid]
    sources += [table.time_s for table in (*planes, spatial) if table is not None]
    if loads.limits is not None:
        sources.append(schema.limit_times_s(loads.limits))
    sources += [booster.mass.breaks + booster.ignition_s for booster in boosters]
    times = np.unique(np.concatenate([np.zeros(1), *sources]))
    body = _Body(loads, tanks, (*planes, spatial), times, method, boosters)
    stations = np.array(loads.stations_m)
    rigid, limits = body.rigid(stations), _limits(loads, stations, times)
    per_station = [np.stack([*rigid, *limits], axis=2)]  # (times, stations, columns)
    shapes = np.zeros((len(times), len(boosters), 2, columns_of.BOOSTER_ROWS, modes))
    for plane, table in enumerate((pitch, yaw)):
        if table is not None and boosters:
            shapes[:, :, plane, :, : table.modes] = body.carried(table)
    for table in planes:
        if modes == 0:
            continue
        rows = np.zeros((len(times), len(stations), columns_of.MODE_ROWS, modes))
        if table is not None:
            rows[:, :, :, : table.modes] = body.modal(table, stations)
        per_station.append(rows.reshape(len(times), len(stations), -1))
    if spatial is not None:
        along_y, along_z = (
            body.modal(plane, stations, body.in_space(spatial, along))
            for along, plane in enumerate(spatial.lateral(), start=1)
        )
        rows = np.concatenate([along_z, along_y, body.axial(spatial, stations)[:, :, None]], axis=2)
        per_station.append(rows.reshape(len(times), len(stations), -1))
    of_boosters = [shapes.reshape(len(times), -1)]
    if spatial is not None and boosters:
        of_boosters.append(body.carried_in_space(spatial).reshape(len(times), -1))
    columns = np.concatenate(per_station, axis=2).reshape(len(times), -1)
    whole = fit(times, np.concatenate([np.stack(body.totals, axis=1), columns], axis=1), method)
    return whole, fit(times, np.concatenate(of_boosters, axis=1), method)


class _Part(NamedTuple):
    """The masses at the nodes of a quadrature, at T times in n intervals (or points)."""

    x: Array  # stations (T, n, nodes), m
    mass: Array  # masses in the same shape, kg
    rear: Array  # rear ends of the intervals (n,), increasing, m
    hangs: Array  # stations at which the body supports their weight (n,), increasing, m
    held: Array  # stations whose axial motion they follow (T, n, nodes), m


class _Body:
    """The line mass of the core at T times: uniform dry parts, point masses, and liquids between surface and bottom.

    The sloshing mass is not part of the core. The rest of a tank's liquid is spread over its column. The density is
    linear in the station, so that mass and CG are those of the column without its bobs.
    """

    def __init__(
        self,
        loads: schema.LoadsSection,
        tanks: tuple[Tank, ...],
        modes: Sequence[ModeTable | SpatialModeTable | None],
        times: Array,
        method: Method,
        boosters: tuple[_Bearer, ...],
    ) -> None:
        line = loads.line_mass
        front, rear, mass = line["front_station_m"], line["rear_station_m"], line["mass_kg"]
        of_modes = [table.station_m for table in modes if table is not None]
        columns = [[float(q.table["front_station_m"].min()), q.bottom_station_m] for q in loads.liquid]
        ends = np.unique(np.concatenate([front, rear, loads.stations_m, *columns, *of_modes]))
        spread = rear > front
        density = (
            (mass[spread] / (rear - front)[spread])[:, None]
            * (front[spread, None] <= ends[:-1])
            * (rear[spread, None] >= ends[1:])
        ).sum(axis=0)
        x, weights = _gauss(np.broadcast_to(ends[:-1], (len(times), len(ends) - 1)), ends[1:])
        self.parts = [_Part(x, weights * density[None, :, None], ends[1:], ends[1:], x)]
        at = front[~spread]
        points = [np.broadcast_to(column[~spread][:, None], (len(times), len(at), 1)) for column in (front, mass)]
        self.parts.append(_Part(points[0], points[1], at, at, points[0]))
        self.times, self.method, self.boosters = times, method, boosters
        bobs = dict(zip((tank.name or str(n + 1) for n, tank in enumerate(tanks)), tanks, strict=True))
        for liquid in loads.liquid:
            tank = bobs.get(liquid.tank)
            bobs_of_tank = [] if tank is None else [joined.at(times) for joined, _ in pendulum_curves(tank, method)]
            self._add_liquid(liquid, bobs_of_tank, ends)
        self.totals = [np.asarray(sum((p.mass * p.x**k).sum(axis=(1, 2)) for p in self.parts)) for k in range(3)]

    def _add_liquid(self, liquid: schema.Liquid, bobs: Sequence[Array], ends: Array) -> None:
        columns = np.stack([liquid.table["mass_kg"], liquid.table["front_station_m"]], axis=1)
        mass, surface = fit(liquid.table["time_s"], columns, self.method).at(self.times).T
        bottom = liquid.bottom_station_m
        middle, length = 0.5 * (surface + bottom), bottom - surface
        first = np.zeros_like(mass)  # moment of the rest about the middle of the column
        for bob in bobs:
            first = first - bob[:, 0] * (bob[:, 1] + bob[:, 2] - middle)
            mass = mass - bob[:, 0]
        inside = ends[ends <= bottom]
        x, weights = _gauss(*(np.maximum(edge, surface[:, None]) for edge in (inside[:-1], inside[1:])))
        safe = np.where(length > 0.0, length, 1.0)
        density = (mass / safe)[:, None, None] + (12.0 * first / safe**3)[:, None, None] * (x - middle[:, None, None])
        hangs = np.full(len(inside) - 1, bottom)
        self.parts.append(_Part(x, weights * density, inside[1:], hangs, np.full_like(x, bottom)))

    def _forward(self, values: Sequence[Array], stations: Array, hanging: bool = False) -> Array:
        """Return the sums (T, stations, ...) of values over the masses of each part forward of the stations.

        With `hanging`, masses are selected by the station that supports them.
        """
        total: Array | float = 0.0
        for part, value in zip(self.parts, values, strict=True):
            sums = np.cumsum(value.sum(axis=2), axis=1)
            sums = np.concatenate([np.zeros((len(sums), 1, *sums.shape[2:])), sums], axis=1)
            total = total + sums[:, np.searchsorted(part.hangs if hanging else part.rear, stations, side="right")]
        return np.asarray(total)

    def rigid(self, stations: Array) -> list[Array]:
        """Return the columns MASS to AXIAL_FIRST, (T, stations) each."""
        powers = [[p.mass * p.x**k for p in self.parts] for k in range(3)]
        forward = [self._forward(power, stations) for power in powers]
        return [*forward, *(self._forward(power, stations, hanging=True) for power in powers[:2])]

    def modal(self, table: ModeTable, stations: Array, in_space: Sequence[_InSpace] = ()) -> Array:
        """Return the rows INERTIA to DISPLACEMENT (T, stations, rows, modes) of one plane, also of spatial modes.

        In the inertial forces, the shapes exclude their rigid motion with respect to this line mass. Hence the modes do
        not change momentum and angular momentum, as in the equations of motion.
        """
        shapes = shapes_over(table, self.times, self.method)
        phi = [shapes.along(part.x) for part in self.parts]  # (T, n, nodes, M)
        cg, shift, turn = self._rigid_motion(shapes, phi, in_space)
        about_cg = [part.x - cg[:, None, None] for part in self.parts]
        force = [
            part.mass[..., None] * (p - shift[:, None, None] - turn[:, None, None] * r[..., None])
            for part, p, r in zip(self.parts, phi, about_cg, strict=True)
        ]
        inertia = self._forward(force, stations)
        moment = self._forward([f * part.x[..., None] for part, f in zip(self.parts, force, strict=True)], stations)
        here = shapes.along(np.broadcast_to(stations, (len(self.times), len(stations))))  # (T, stations, M)
        hung = [part.mass[..., None] * p for part, p in zip(self.parts, phi, strict=True)]
        mass = self._forward([part.mass for part in self.parts], stations, hanging=True)
        aside = self._forward(hung, stations, hanging=True) - mass[..., None] * here
        return np.stack([inertia, stations[:, None] * inertia - moment, aside, here], axis=2)

    def carried(self, table: ModeTable) -> Array:
        """Return the rows HELD to SLOPE_INERTIA (T, boosters, rows, modes) of one plane."""
        shapes = shapes_over(table, self.times, self.method)
        cg, shift, turn = self._rigid_motion(shapes, [shapes.along(part.x) for part in self.parts])
        out = []
        for booster in self.boosters:
            held, slope = booster.shapes(shapes)
            rigid = shift + turn * (booster.attachments_m[0] - cg)[:, None]
            out.append(np.stack([held, slope, held - rigid, slope - turn], axis=1))
        return np.stack(out, axis=1)

    def carried_in_space(self, table: SpatialModeTable) -> Array:
        """Return the rows ATTACHED to LEAN_Z_INERTIA (T, boosters, rows, modes) of spatial modes."""
        core, mean = SpatialShapes(spatial_over(table, self.times, self.method)), self._mean_axial(table)
        motions = []
        for along, plane in enumerate(table.lateral(), start=1):
            shapes = shapes_over(plane, self.times, self.method)
            phi = [shapes.along(part.x) for part in self.parts]
            motions.append(self._rigid_motion(shapes, phi, self.in_space(table, along)))
        out = []
        for booster in self.boosters:
            rows = booster.in_space(core)
            rigid = [mean, *(shift + turn * (booster.attachments_m[0] - cg)[:, None] for cg, shift, turn in motions)]
            lean = [rows[4 + k] - motions[k][2] for k in range(2)]
            out.append(np.concatenate([rows, rows[:3] - np.stack(rigid), np.stack(lean)]))
        return np.stack(out).transpose(2, 0, 1, 3)

    def in_space(self, table: SpatialModeTable, along: int) -> list[_InSpace]:
        """Return the motion of the CG of each booster by spatial modes, `along` y (1) or z (2)."""
        core, out = SpatialShapes(spatial_over(table, self.times, self.method)), []
        for booster in self.boosters:
            rows = booster.in_space(core)
            moved, offset = (
                booster.of_cg(rows, self.times),
                booster.mass.at(self.times - booster.ignition_s)[:, 1 + along],
            )
            out.append(_InSpace(moved[along], rows[3 + along], moved[0], offset))
        return out

    def _mean_axial(self, table: SpatialModeTable) -> Array:
        """Return the mean axial shapes (T, M) of line mass and boosters."""
        total, moved = self.totals[0], self._sum(self._axial_shapes(table))
        core = SpatialShapes(spatial_over(table, self.times, self.method))
        for booster in self.boosters:
            mass = booster.at(self.times)[0]
            total, moved = total + mass, moved + mass[:, None] * booster.of_cg(booster.in_space(core), self.times)[0]
        return np.asarray(moved / total[:, None])

    def _rigid_motion(
        self, shapes: ModeShapes, phi: list[Array], in_space: Sequence[_InSpace] = ()
    ) -> tuple[Array, Array, Array]:
        """Return the CG (T,) of line mass and boosters, and shift and slope (T, M) of the shapes `phi` there.

        Masses and transverse inertias are the weights. With spatial modes, `in_space` contains the motion of the
        boosters, whose axial motion at an offset counts.
        """
        total, first, second = self.totals
        moved = self._sum(phi)
        carried = []
        for k, booster in enumerate(self.boosters):
            mass, x, inertia = booster.at(self.times)
            held, slope = booster.shapes(shapes)
            lateral, along = held + (x - booster.attachments_m[0])[:, None] * slope, np.zeros_like(held)
            if in_space:
                lateral, slope, axial, offset = in_space[k]
                second, along = second + mass * offset**2, (mass * offset)[:, None] * axial
            carried.append((mass, x, inertia, lateral, slope, along))
            total, first, second = total + mass, first + mass * x, second + mass * x * x + inertia
            moved = moved + mass[:, None] * lateral
        cg = first / total
        about_cg = [part.x - cg[:, None, None] for part in self.parts]
        turned = self._sum([p * r[..., None] for p, r in zip(phi, about_cg, strict=True)])
        for mass, x, inertia, lateral, slope, along in carried:
            turned = turned + (mass * (x - cg))[:, None] * lateral + inertia[:, None] * slope + along
        return cg, moved / total[:, None], turned / (second - first * cg)[:, None]

    def axial(self, table: SpatialModeTable, stations: Array) -> Array:
        """Return mass times axial shape of the parts supported forward of the stations, (T, stations, modes).

        The shapes exclude their mean motion with respect to this line mass, as in `modal`.
        """
        at, mean = self._axial_shapes(table), self._mean_axial(table)[:, None, None]
        moved = [part.mass[..., None] * (values - mean) for part, values in zip(self.parts, at, strict=True)]
        return self._forward(moved, stations, hanging=True)

    def _axial_shapes(self, table: SpatialModeTable) -> list[Array]:
        """Return the axial shapes (T, n, nodes, M) of the masses of each part."""
        phi = table.displacement[..., 0]
        over_time = fit(table.time_s, phi.reshape(len(phi), -1), self.method).at(self.times)
        shapes = [fit(table.station_m, row.reshape(phi.shape[1:]).T) for row in over_time]
        return [
            np.stack([f.at(x.ravel()).reshape(*x.shape, table.modes) for f, x in zip(shapes, part.held, strict=True)])
            for part in self.parts
        ]

    def _sum(self, values: Sequence[Array]) -> Array:
        """Return the sums (T, M) of mass times value over all parts."""
        weighted = [(p.mass[..., None] * v).sum(axis=(1, 2)) for p, v in zip(self.parts, values, strict=True)]
        return np.asarray(sum(weighted))


def _gauss(low: Array, high: Array) -> tuple[Array, Array]:
    """Return nodes and weights (T, n, 4) between `low` and `high`, whose shapes broadcast to (T, n)."""
    half = 0.5 * (np.asarray(high) - low)
    x = (0.5 * (np.asarray(high) + low))[..., None] + half[..., None] * _NODES
    return x, np.maximum(half, 0.0)[..., None] * _WEIGHTS


def _limits(loads: schema.LoadsSection, stations: Array, times: Array) -> list[Array]:
    """Return the radius and the limit of each kind, (T, stations) each; 0 where there is none."""
    table, shape = loads.limits, (len(times), len(stations))
    if table is None:
        return [np.zeros(shape)] * (1 + len(schema.BORNE))
    places, known = np.unique(table["station_m"]), schema.limit_times_s(table)
    order = np.lexsort((table["station_m"], table.get("time_s")))
    out = []
    for name in ("radius_m", *schema.BORNE):
        grid = table.get(name)[order].reshape(len(known), len(places))
        at_stations = np.stack([np.interp(stations, places, row) for row in grid])
        out.append(np.stack([np.interp(times, known, column) for column in at_stations.T], axis=1))
    return out
