"""The parameter record of a stage's engines, with equal engines of a group combined, and their thrust curves."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from maxq.control.kernel.jit import from_python
from maxq.control.kernel.limits import MAX_ENGINES
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Cubics, Method, fit, merge
from maxq.sim.input.remembered import cached_by_identity
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.vehicle.engine.burn import Burn, EngineFault
from maxq.sim.vehicle.engine.kernel import Engine, thrust_axis_motion
from maxq.sim.vehicle.engine.section import EngineSection as Given

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_scenario import Switches
    from maxq.sim.scenario.schema_vehicle import Stage

_thrust_axis_motion = from_python(thrust_axis_motion)


@dataclass(frozen=True)
class Alike:
    """Engines that move together and differ only in their lateral position.

    - `numbers`: numbers of the engines in the stage.
    - `one`: one of these engines.
    - `faults`: faults of the engines.
    - `body`: the first of several equal bodies.
    - `attachments_m`: stations of the core to which the booster of these engines is attached.
    """

    numbers: tuple[int, ...]
    one: Given
    faults: tuple[EngineFault, ...]
    body: int
    attachments_m: tuple[float, ...]

    @property
    def curve(self) -> tuple[CsvTable, CsvTable | None, tuple[EngineFault, ...], int]:
        """Return the quantities that determine the thrust over time: table, throttle, faults and body."""
        return self.one.table, self.one.throttle, self.faults, self.body

    @property
    def mount(self) -> tuple[float, tuple[float, ...]]:
        """Return the station of the gimbal, and the stations to which the booster is attached."""
        return self.one.gimbal_station_m, self.attachments_m


@dataclass(frozen=True)
class Cluster:
    """The description of a stage's engines for the kernels."""

    alike: tuple[Alike, ...]
    groups: tuple[str, ...]
    mounts: tuple[tuple[float, tuple[float, ...]], ...]  # see `Alike.mount`
    curves: tuple[Alike, ...]  # one representative for each thrust curve


@cached_by_identity
def cluster_of(stage: Stage, faults: tuple[EngineFault, ...]) -> Cluster:
    """Return the cluster of a stage, which is empty without an engine."""
    alike: list[Alike] = []
    bodies = _first_of_equal_bodies(stage, faults)
    for n, (engine, b) in enumerate(zip(stage.engines, stage.engine_bodies, strict=True)):
        same = engine.model_copy(update={"offset_m": (0.0, 0.0), "name": ""})
        own = tuple(fault for fault in faults if fault.affects(n))
        attached = stage.booster[b - 1].attachments_m if b > 0 else ()
        wanted = same, own, bodies[b], attached
        found = (k for k, x in enumerate(alike) if (x.one, x.faults, x.body, x.attachments_m) == wanted)
        k = next(found, None)
        if k is None:
            alike.append(Alike((n,), *wanted))
        else:
            alike[k] = replace(alike[k], numbers=(*alike[k].numbers, n))
    curves: list[Alike] = []
    for each in alike:
        if all(each.curve != known.curve for known in curves):
            curves.append(each)
    mounts = tuple(dict.fromkeys(each.mount for each in alike))
    return Cluster(tuple(alike), stage.engine_groups, mounts, tuple(curves))


def _first_of_equal_bodies(stage: Stage, faults: tuple[EngineFault, ...]) -> list[int]:
    """Return for each body the first body that burns in the same way, or itself if it has a fault."""
    numbers, out = stage.engine_bodies, [0]
    failed = {numbers[n] for n in range(len(numbers)) if any(fault.affects(n) for fault in faults)}
    for b, booster in enumerate(stage.booster, start=1):
        burns = booster.ignition_s, booster.own_engines
        others = [k for k in range(1, b) if k not in failed] if b not in failed else []
        kin = (k for k in others if (stage.booster[k - 1].ignition_s, stage.booster[k - 1].own_engines) == burns)
        out.append(next(kin, b))
    return out


def thrust_curves(stage: Stage, burn: Burn, method: Method) -> list[Cubics]:
    """Return the curves of vacuum thrust over the clock of the schedule, N; one zero curve without an engine."""
    curves = []
    bodies = stage.engine_bodies
    for each in cluster_of(stage, burn.faults).curves:
        nominal, n = fit(each.one.table["time_s"], each.one.table["thrust_vacuum_N"], method), each.numbers[0]
        own = burn.of(bodies[n])
        curve = on_clock(nominal, own, n - bodies.index(bodies[n]))
        if stage.gated:
            begin_s = stage.bodies[bodies[n]].ignition_s
            curve = during(curve, begin_s, own.burnout_s if own.burnout_s > begin_s else math.inf)
        curves.append(curve)
    return curves or [fit([0.0], [[0.0]])]


def during(table: Cubics, begin_s: float, end_s: float) -> Cubics:
    """Return a table that is zero before `begin_s` and from `end_s` on."""
    marks = [begin_s - 1.0, begin_s, *([end_s, end_s + 1.0] if math.isfinite(end_s) else [])]
    merged = merge([table, fit(marks, np.zeros((len(marks), 1)))])
    out = merged.coefficients[:, :, :-1].copy()
    out[(merged.breaks[:-1] < begin_s) | (merged.breaks[:-1] >= end_s)] = 0.0
    return Cubics(merged.breaks, out)


def on_clock(table: Cubics, burn: Burn, engine: int | None = None) -> Cubics:
    """Convert a table from the tables' clock to the schedule's clock, times the thrust share of an `engine`, if given.

    The two clocks differ if engines are throttled or fail. Each interval has the cubic with the values and slopes at
    both ends. The result is exact where the rate of the clock and the share are constant, and otherwise accurate to the
    fourth order of the interval's length (`burn.table_clock`).
    """
    clock = burn.clock
    if clock is None:
        return table
    reached = clock.when(table.breaks)
    breaks = np.unique(np.concatenate([clock.time_s, reached[np.isfinite(reached)]]))
    breaks = breaks[np.append(True, np.diff(breaks) > 1e-9)]
    if len(breaks) == 1:
        breaks = np.append(breaks, breaks[0] + 1.0)
    begin, length = breaks[:-1], np.diff(breaks)
    k, middle_s, _ = clock.at(begin + 0.5 * length)
    slope = clock.slopes()[k]
    piece = np.clip(np.searchsorted(table.breaks, middle_s, side="right") - 1, 0, len(table.breaks) - 2)
    inside = (middle_s > table.breaks[0]) & (middle_s < table.breaks[-1])
    c, ends = table.coefficients[piece], []
    for dt in (begin - clock.time_s[k], begin - clock.time_s[k] + length):
        s = clock.table_s[k] + dt * (clock.rate[k, 0] + 0.5 * slope * dt)
        x = (np.clip(s, table.breaks[0], table.breaks[-1]) - table.breaks[piece])[:, None]
        value = c[:, 0] + x * (c[:, 1] + x * (c[:, 2] + x * c[:, 3]))
        change = c[:, 1] + x * (2.0 * c[:, 2] + x * 3.0 * c[:, 3])
        change = change * ((clock.rate[k, 0] + slope * dt) * inside)[:, None]
        if engine is not None:
            share = clock.share[engine, k]
            grows = ((share[:, 1] - share[:, 0]) / np.append(np.diff(clock.time_s), np.inf)[k])[:, None]
            left = share[:, :1] + grows * dt[:, None]
            value, change = value * left, change * left + value * grows
        ends.append((value, change))
    (v_0, d_0), (v_1, d_1), h = *ends, length[:, None]
    secant = (v_1 - v_0) / h
    bend = (d_0 + d_1 - 2.0 * secant) / h
    return Cubics(breaks, np.stack([v_0, d_0, (secant - d_0) / h - bend, bend / h], axis=1))


class Mount(NamedTuple):
    """A station of gimbals, and its share of the thrust: constant, or at each time of a table.

    `attachments_m`: stations of the core to which the booster of these engines is attached.
    """

    station_m: float
    thrust_share: float | tuple[float, ...]
    attachments_m: tuple[float, ...] = ()

    @property
    def enters_m(self) -> float:
        """Return the station at which the thrust enters the core."""
        return self.attachments_m[0] if self.attachments_m else self.station_m


def engine_mounts(stage: Stage, burn: Burn, time_s: Array) -> tuple[Mount, ...]:
    """Return the mounts in the order of `Cluster.mounts`, with the shares of the largest thrusts.

    With boosters, the shares at `time_s` (T,) are those of the impulse between the middles to the adjacent times, or of
    the next second if there is one time.
    """
    cluster = cluster_of(stage, burn.faults)
    most = [_strength(a) * float(a.one.table["thrust_vacuum_N"].max()) for a in cluster.alike]
    constant = [sum(most[k] for k in there) / sum(most) if sum(most) > 0.0 else 1.0 for there in _together(cluster)]
    shares: list[float | tuple[float, ...]] = [1.0] if len(constant) == 1 else [*constant]
    if stage.booster and len(constant) > 1:
        middle_s = 0.5 * (time_s[1:] + time_s[:-1])
        edges_s = np.array([time_s[0], *middle_s, time_s[-1] if len(time_s) > 1 else time_s[0] + 1.0])
        gained = np.array(
            [_strength(a) * np.diff(_impulse_Ns(a.one, burn.of(a.body).over(edges_s))) for a in cluster.alike]
        )
        total = gained.sum(axis=0)
        for m, there in enumerate(_together(cluster)):
            own = gained[there].sum(axis=0)
            shares[m] = tuple(np.where(total > 0.0, own / np.where(total > 0.0, total, 1.0), constant[m]).tolist())
    return tuple(Mount(mount[0], share, mount[1]) for mount, share in zip(cluster.mounts, shares, strict=True))


def hung_engines(stage: Stage, burn: Burn) -> tuple[tuple[float, float], ...]:
    """Return the station and the first moment (kg m) of the engines behind each mount of the core."""
    cluster = cluster_of(stage, burn.faults)
    moments = [len(a.numbers) * _hanging_kgm(a.one) for a in cluster.alike]
    of_mounts = zip(cluster.mounts, _together(cluster), strict=True)
    return tuple((mount[0], sum(moments[k] for k in there)) for mount, there in of_mounts if not mount[1])


def _together(cluster: Cluster) -> list[list[int]]:
    """Return the indices of the engines in `Cluster.alike` at each mount."""
    return [[k for k, a in enumerate(cluster.alike) if a.mount == mount] for mount in cluster.mounts]


def _strength(alike: Alike) -> float:
    return len(alike.numbers) * alike.one.thrust_factor


def _impulse_Ns(e: Given, until_s: Array) -> Array:
    """Return the impulse in vacuum from the beginning of the table to times on its clock; its end values hold."""
    time_s, thrust_N = e.table["time_s"], e.table["thrust_vacuum_N"]
    begin_s, at_N = np.maximum(until_s, time_s[0]), np.interp(until_s, time_s, thrust_N)
    k = np.clip(np.searchsorted(time_s, begin_s, side="right") - 1, 0, len(time_s) - 1)
    known = np.append(0.0, np.cumsum(0.5 * (thrust_N[1:] + thrust_N[:-1]) * np.diff(time_s)))
    return np.asarray(known[k] + 0.5 * (thrust_N[k] + at_N) * (begin_s - time_s[k]))


def _hanging_kgm(e: Given) -> float:
    cos_pitch, cos_yaw = (math.cos(math.radians(angle)) for angle in e.cant_deg)
    return e.gimballed_mass_kg * e.cg_from_gimbal_m * (cos_pitch * cos_yaw)


def swinging(stage: Stage, cluster: Cluster, switches: Switches) -> tuple[int, ...]:
    """Return the indices of the engines in `Cluster.alike` that have a TVC load."""
    if not (switches.tvc_load and switches.engine_inertia):
        return ()
    loads = stage.tvc_loads
    return tuple(k for k, a in enumerate(cluster.alike) if a.one.gimbal != "fixed" and a.one.group in loads)


def pack_engines(stage: Stage, burn: Burn, switches: Switches) -> Engine:
    """Return the record of all engines; without an engine it is zero except for the thrust axis."""
    columns: dict[str, Any] = {f.name: np.zeros(MAX_ENGINES) for f in fields(Engine)}
    for name in ("curve", "group", "gimbal", "taken_as", "swings"):
        columns[name] = np.zeros(MAX_ENGINES, np.int64)
    columns["rest_x"][:], columns["swings"][:] = 1.0, -1
    cluster = cluster_of(stage, burn.faults)
    for n, k in enumerate(swinging(stage, cluster, switches)):
        columns["swings"][k] = n
    for k, alike in enumerate(cluster.alike):
        for name, value in _columns(stage, cluster, alike, switches).items():
            columns[name][k] = value
        for number in alike.numbers:
            columns["taken_as"][number], columns["parts"][number] = k, len(alike.numbers)
    return Engine(**columns)


def _columns(stage: Stage, cluster: Cluster, alike: Alike, switches: Switches) -> dict[str, float]:
    e, n = alike.one, len(alike.numbers)
    places = np.array([stage.engines[number].offset_m for number in alike.numbers])
    offset_y, offset_z = (float(x) for x in places.mean(axis=0))
    cant = np.radians(e.cant_deg)
    rest = _thrust_axis_motion(float(cant[0]), 0.0, 0.0, float(cant[1]), 0.0, 0.0)[0]
    moves = 1.0 if switches.engine_inertia else 0.0
    on = 1.0 if switches.thrust else 0.0
    mass, arm = e.gimballed_mass_kg, e.cg_from_gimbal_m
    exits = np.zeros((n, 2))
    if isinstance(stage.engine, tuple) or alike.body > 0:  # the exhaust of a single engine is on the body axis
        behind = e.exit_station_m - e.gimbal_station_m
        exits = places - behind / rest[0] * np.array(rest[1:])
    centre = exits.mean(axis=0)
    spread = (exits - centre).T @ (exits - centre) / n
    canted = any(e.cant_deg)
    return {
        "exit_area_m2": n * e.exit_area_m2,
        "thrust_factor": n * (on * e.thrust_factor * e.burn_factor),
        "curve": [known.curve for known in cluster.curves].index(alike.curve),
        "group": cluster.groups.index(e.group) if e.gimbal != "fixed" else 0,
        "follows_pitch": float(e.gimbal in ("both", "pitch")),
        "follows_yaw": float(e.gimbal in ("both", "yaw")),
        "gimbal": cluster.mounts.index(alike.mount),
        "gimbal_station_m": e.gimbal_station_m,
        "gimbal_offset_y_m": offset_y,
        "gimbal_offset_z_m": offset_z,
        "turned_pitch_rad": math.radians(e.misalignment_deg[0]) + float(cant[0]),
        "turned_yaw_rad": math.radians(e.misalignment_deg[1]) + float(cant[1]),
        "rest_x": rest[0],
        "rest_y": rest[1],
        "rest_z": rest[2],
        "gimballed_mass_kg": n * mass * moves,
        "cg_from_gimbal_m": arm,
        "inertia_kgm2": n * (e.inertia_about_gimbal_kgm2 - mass * arm * arm) * moves,
        "lever_x_m": arm * rest[0],
        "lever_y_m": offset_y - arm * rest[1] if canted else 0.0,
        "lever_z_m": offset_z - arm * rest[2] if canted else 0.0,
        "exit_station_m": e.exit_station_m,
        "exit_y_m": centre[0],
        "exit_z_m": centre[1],
        "exit_yy_m2": spread[0, 0],
        "exit_zz_m2": spread[1, 1],
        "exit_yz_m2": spread[0, 1],
        "roll_arm_m": e.roll_arm_m,
        "flow_weight": n * e.burn_factor * _flow_per_newton(e) * _flow_of_body(stage, alike.body),
    }


def thrust_slopes(e: Given) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the change of the thrust direction (B) per radian of pitch and of yaw angle, for the engine at rest."""
    pitch, yaw = (math.radians(angle) for angle in e.cant_deg)
    return _thrust_axis_motion(pitch, 1.0, 0.0, yaw, 0.0, 0.0)[1], _thrust_axis_motion(pitch, 0.0, 0.0, yaw, 1.0, 0.0)[
        1
    ]


@cached_by_identity
def _flow_of_body(stage: Stage, body: int) -> float:
    """Return the mass that a body expels divided by the impulse of its engines, weighted with `_flow_per_newton`.

    This factor divides the flow of a stage with boosters between the bodies. It is 1 without boosters.
    """
    if not stage.booster:
        return 1.0
    given, impulse = stage.bodies[body], 0.0
    for e in given.own_engines:
        time_s, thrust_N = e.table["time_s"], e.table["thrust_vacuum_N"]
        impulse += _flow_per_newton(e) * float(np.sum(0.5 * (thrust_N[1:] + thrust_N[:-1]) * np.diff(time_s)))
    kg = given.mass.rows(0.0)[1][:, 0]
    return float(kg[0] - kg[-1]) / impulse if impulse > 0.0 else 0.0


def _flow_per_newton(e: Given) -> float:
    """Return the mean mass flow per newton of mean thrust, kg/(N s).

    It is 1 if the engine's table has no flow, which then follows the thrust.
    """
    thrust: Array = e.table["thrust_vacuum_N"]
    if "mass_flow_kgps" not in e.table or not thrust.any():
        return 1.0
    return float(e.table["mass_flow_kgps"].mean() / thrust.mean())
