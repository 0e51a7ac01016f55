"""The mass, CG and inertia of a layout over a stage's burn, and the masses that load the beam."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from scipy.interpolate import PchipInterpolator

from maxq.control.kernel.records import Array
from maxq.design.model.node_times import LONG_TAIL_S
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.world.constants import STANDARD_GRAVITY_mps2
from maxq.tools.vehicle.layout import (
    DryMass,
    Grain,
    Layout,
    LayoutBooster,
    LayoutEngines,
    LayoutStage,
    LayoutTank,
    LayoutThrust,
)
from maxq.tools.vehicle.linear_curve import LinearCurve

_RAMP_ROWS, _STEADY_ROWS = 9, 20
_LEAST_LENGTH_m = 1e-4  # least length of a burned grain
_BEFORE_S = 0.01  # from the last operating point with boosters to their separation


@dataclass(frozen=True)
class Rod:
    """A mass spread evenly between two stations, with the squared radii of gyration of its cross-section."""

    mass_kg: float
    front_station_m: float
    rear_station_m: float
    roll_m2: float  # Ixx / m
    across_m2: float  # transverse inertia / m, without L^2 / 12
    place_m: tuple[float, float] = (0.0, 0.0)  # y and z of its axis

    @property
    def station_m(self) -> float:
        return 0.5 * (self.front_station_m + self.rear_station_m)

    @property
    def inertia_kgm2(self) -> float:
        """Return the transverse moment of inertia about the CG of the rod."""
        length = self.rear_station_m - self.front_station_m
        return self.mass_kg * (length**2 / 12.0 + self.across_m2)


def ring(mass_kg: float, front_m: float, rear_m: float, radius_m: float) -> Rod:
    """Return the mass of a thin ring or tube."""
    return Rod(mass_kg, front_m, rear_m, radius_m**2, 0.5 * radius_m**2)


@dataclass(frozen=True)
class MassProperties:
    """The mass properties in body axes about the CG, which is on the body axis.

    Liquids are frozen: they do not slosh. Only the share `roll_share` of a liquid rotates about the roll axis.
    """

    mass_kg: float
    x_cg_m: float
    roll_kgm2: float
    pitch_kgm2: float
    yaw_kgm2: float


@dataclass(frozen=True)
class ThrustCurve:
    """The thrust in vacuum and the propellant flow of all engines of a stage over its clock.

    Both are PCHIP interpolations of the rows. `thrust_vacuum_N` is linear between the rows of a computed curve, which
    are close together.

    The unit of `flow` is arbitrary, because its integral is the usable propellant; without it, the flow is proportional
    to the thrust. `used_shares` are the shares of the usable propellant burned before this curve and at its end.
    """

    times_s: Array
    thrust_N: Array
    usable_kg: float
    start_s: float
    full_s: tuple[float, float]  # begin and end of full thrust
    used_shares: tuple[float, float] = (0.0, 1.0)
    flow: Array | None = None
    given: bool = False  # True for a table of the layout, whose rows may be far apart

    @cached_property
    def _thrust(self) -> PchipInterpolator:
        return PchipInterpolator(self.times_s, self.thrust_N)

    @cached_property
    def _line(self) -> LinearCurve:
        return LinearCurve(self.times_s, self.thrust_N)

    @cached_property
    def _impulse(self) -> PchipInterpolator:
        return self._thrust.antiderivative()

    @cached_property
    def _spent(self) -> PchipInterpolator:
        return self._impulse if self.flow is None else PchipInterpolator(self.times_s, self.flow).antiderivative()

    @property
    def end_s(self) -> float:
        return float(self.times_s[-1])

    @property
    def burned_kg(self) -> float | None:
        """Return the integral of the given flow, linear between its rows: the propellant in kg if the flow is in
        kg/s.
        """
        return None if self.flow is None else float(np.trapezoid(self.flow, self.times_s))

    @property
    def impulse_Ns(self) -> float:
        return self.impulse_until_Ns(self.end_s)

    def impulse_until_Ns(self, t: float) -> float:
        """Return the impulse in vacuum up to time `t` (s)."""
        return float(self._impulse(np.clip(t, 0.0, self.end_s)))

    def thrust_vacuum_N(self, t: float) -> float:
        if not 0.0 <= t <= self.end_s:
            return 0.0
        if self.given and t < self.end_s:  # at the end, rounding would leave a thrust of 1e-11 N
            return float(self._thrust(t))
        return self._line(t)

    def used(self, t: float) -> float:
        """Return the share of the usable propellant burned by time `t` (s), from 0 to exactly 1."""
        share = float(np.clip(self._spent(np.clip(t, 0.0, self.end_s)) / self._spent(self.end_s), 0.0, 1.0))
        before, after = self.used_shares
        return before * (1.0 - share) + after * share

    def split(self, t: float) -> tuple[ThrustCurve, ThrustCurve]:
        """Return the curve up to time `t` (s), and its remainder on a clock that starts at `t`."""
        at, early, late = float(self._thrust(t)), self.times_s < t - 1e-6, self.times_s > t + 1e-6
        first = np.append(self.times_s[early], t), np.append(self.thrust_N[early], at)
        rest = np.insert(self.times_s[late] - t, 0, 0.0).round(6), np.insert(self.thrust_N[late], 0, at)
        (begin, end), (before, after), used = self.full_s, self.used_shares, self.used(t)
        flows: tuple[Array | None, Array | None] = (None, None)
        if self.flow is not None:
            now = float(PchipInterpolator(self.times_s, self.flow)(t))
            flows = np.append(self.flow[early], now), np.insert(self.flow[late], 0, now)
        return (
            ThrustCurve(*first, self.usable_kg, self.start_s, (begin, t), (before, used), flows[0], self.given),
            ThrustCurve(*rest, self.usable_kg, 0.0, (0.0, end - t), (used, after), flows[1], self.given),
        )


def burn_of(stage: LayoutStage | LayoutBooster, ignition_s: float) -> ThrustCurve:
    """Return the thrust curve of a burn that starts at `ignition_s` of the clock.

    A table in the layout defines it. Otherwise the thrust rises and falls in smooth steps and, between them, decreases
    linearly to `thrust_end_share` of its initial value. The duration follows from the impulse of the usable propellant.
    Raises ValueError if the propellant lasts for less than the two steps.
    """
    e, usable = stage.engine, stage.usable_kg
    if e.thrust is not None:
        return _burn_of_table(e.thrust, len(e.positions_m), usable, ignition_s)
    assert e.thrust_vacuum_N is not None
    assert e.isp_vacuum_s is not None
    full = e.thrust_vacuum_N * len(e.positions_m)
    impulse = usable * STANDARD_GRAVITY_mps2 * e.isp_vacuum_s
    x, share = np.linspace(0.0, 1.0, _RAMP_ROWS), e.thrust_end_share
    step = x * x * (3.0 - 2.0 * x)
    ramps = 0.5 * full * (e.ramp_s + share * e.tail_off_s)
    steady_s = (impulse - ramps) / (0.5 * full * (1.0 + share))
    if steady_s <= 0.0:
        raise ValueError(f"stage {stage.name}: {usable:g} kg of propellant last for less than ramp and tail-off")
    fall_s, rows = e.ramp_s + steady_s, np.arange(1, _STEADY_ROWS) / _STEADY_ROWS
    times = [e.ramp_s * x, e.ramp_s + steady_s * rows, fall_s + e.tail_off_s * x]
    thrust = [full * step, full * (1.0 - (1.0 - share) * rows), share * full * step[::-1]]
    rest = [np.zeros(1)] * (ignition_s != 0.0)  # a row for the time before ignition
    clock_s = np.round(np.concatenate([*rest, *(ignition_s + t for t in times)]), 6)
    full_s = ignition_s + e.ramp_s, ignition_s + fall_s
    return ThrustCurve(clock_s, np.concatenate([*rest, *thrust]), usable, ignition_s, full_s)


def _burn_of_table(table: CsvTable, engines: int, usable_kg: float, ignition_s: float) -> ThrustCurve:
    """Return the thrust curve of a table over the time from ignition. Full thrust is the part above half the mean."""
    times, thrust = ignition_s + table["time_s"] - table["time_s"][0], engines * table["thrust_vacuum_N"]
    flow = None
    if "isp_vacuum_s" in table:
        flow = thrust / (STANDARD_GRAVITY_mps2 * table["isp_vacuum_s"])
    elif "mass_flow_kgps" in table:
        flow = engines * table["mass_flow_kgps"]
    high = np.flatnonzero(thrust > 0.5 * np.trapezoid(thrust, times) / (times[-1] - times[0]))
    full = (float(times[high[0]]), float(times[high[-1]]))
    if times[0] > 0.0:
        times, thrust = np.insert(times, 0, 0.0), np.insert(thrust, 0, 0.0)
        flow = None if flow is None else np.insert(flow, 0, 0.0)
    return ThrustCurve(times, thrust, usable_kg, ignition_s, full, flow=flow, given=True)


@dataclass(frozen=True)
class Strapped:
    """A set of equal boosters of a stack, with the burn of a single booster on the clock of the stage."""

    booster: LayoutBooster
    burn: ThrustCurve

    @property
    def leave_s(self) -> float:
        """Return the time of their separation on the stage's clock."""
        return self.burn.end_s + self.booster.separation_after_s

    @cached_property
    def dry(self) -> list[Rod]:
        return _dry(self.booster)

    def liquid_kg(self, tank: LayoutTank, t: float) -> float:
        """Return the mass of the liquid in a tank at time `t` (s). All tanks drain in proportion."""
        return tank.liquid_mass_kg - (tank.liquid_mass_kg - tank.residual_kg) * self.burn.used(t)

    def rods(self, t: float) -> list[Rod]:
        """Return all masses of one booster at time `t` (s)."""
        left, radius = 1.0 - self.burn.used(t), 0.5 * self.booster.diameter_m
        liquids = [_column(tank, self.liquid_kg(tank, t)) for tank in self.booster.tank]
        return [*self.dry, *liquids, *(_grain(g, left, radius) for g in self.booster.grain)]

    def mass_properties(self, t: float) -> MassProperties:
        """Return the mass properties of one booster about its own CG at time `t` (s)."""
        return properties_of(self.rods(t))


@dataclass(frozen=True)
class Stack:
    """The vehicle during one part of a burn: the burning stage and everything ahead of it.

    A burn during which the fairing is dropped has two stacks. A stage with boosters has a further stack for each of
    their separations; its stacks share one burn and its clock. `boosters` are those attached, the last to separate
    first. The stack flies from `begins_s` to `end_s` of its clock.
    """

    layout: Layout
    number: int  # index of the stage
    burn: ThrustCurve
    fairing: bool
    name: str
    drops_fairing: bool = False  # at the end of this part of the burn
    boosters: tuple[Strapped, ...] = ()
    begins_s: float = 0.0
    leave_s: float | None = None  # end of this part by the separation of boosters

    @property
    def end_s(self) -> float:
        """Return the end of this part on its clock: burnout, or the separation of boosters."""
        return self.burn.end_s if self.leave_s is None else self.leave_s

    @property
    def full_s(self) -> tuple[float, float]:
        """Return the times between which the core has full thrust in this part, before any boosters separate."""
        begin, end = self.burn.full_s
        return max(begin, self.begins_s), end if self.leave_s is None else min(end, self.leave_s - _BEFORE_S)

    def tail_share(self, t: float) -> float:
        """Return the core's thrust relative to the start of a long tail-off, at most 1. It is 1 outside a long
        tail-off.
        """
        end_s = self.full_s[1]
        if t <= end_s or not self.has_long_tail:
            return 1.0
        return min(self.burn.thrust_vacuum_N(t) / self.burn.thrust_vacuum_N(end_s), 1.0)

    @property
    def has_long_tail(self) -> bool:
        """Return True if the tail-off in this part is long enough for operating points."""
        return self.leave_s is None and self.burn.end_s - self.full_s[1] >= LONG_TAIL_S

    @property
    def impulse_Ns(self) -> float:
        """Return the impulse in vacuum of all engines, boosters included, in this part of the burn."""
        curves = [(self.burn, 1), *((s.burn, len(s.booster.positions_m)) for s in self.boosters)]
        ends = self.begins_s, self.end_s
        return sum(n * float(np.diff([curve.impulse_until_Ns(t) for t in ends])[0]) for curve, n in curves)

    @property
    def largest_thrust_N(self) -> float:
        """Return the largest thrust in vacuum of all engines, boosters included, in this part of the burn."""
        rows = np.concatenate([self.burn.times_s, *(s.burn.times_s for s in self.boosters)])
        inside = rows[(rows >= self.begins_s) & (rows <= self.end_s)].tolist()
        return max(self.thrusts_N(t, 0.0)[0] for t in (self.begins_s, *inside))

    def thrusts_N(self, t: float, pressure_Pa: float) -> tuple[float, float]:
        """Return the thrust of all engines at ambient pressure, and that of gimballed ones.

        Gimballed boosters count as thrust with the same moment at the core's gimbal.
        """
        own = _net_N(self.burn, self.stage.engine, t, pressure_Pa)
        total, steered = own, own
        for s in self.boosters:
            e = s.booster.engine
            thrust = len(s.booster.positions_m) * _net_N(s.burn, e, t, pressure_Pa)
            total += thrust
            if e.gimbal == "both":
                cg_m = self.mass_properties(t).x_cg_m
                steered += thrust * (e.gimbal_station_m - cg_m) / (self.stage.engine.gimbal_station_m - cg_m)
        return total, steered

    @property
    def moving_boosters(self) -> tuple[str, ...]:
        """Return the names of the boosters with gimballed engines."""
        return tuple(name for s in self.boosters if s.booster.engine.gimbal == "both" for name in s.booster.names)

    def used_kg(self, t: float) -> float:
        """Return the propellant burned by the stage and its attached boosters until time `t` (s)."""
        others = sum(len(s.booster.positions_m) * s.booster.usable_kg * s.burn.used(t) for s in self.boosters)
        return self.stage.usable_kg * self.burn.used(t) + others

    @property
    def stage(self) -> LayoutStage:
        return self.layout.stage[self.number]

    @property
    def tail_m(self) -> float:
        """Return the station of the beam's aft end, which is the gimbal of the burning engines."""
        return self.stage.engine.gimbal_station_m

    @cached_property
    def dry(self) -> list[Rod]:
        """Return the masses that do not burn: fairing, structure and engines, and the full tanks and grains of upper
        stages.
        """
        rods = []
        if self.fairing and (f := self.layout.fairing) is not None:
            rods.append(ring(f.mass_kg, f.front_station_m, f.rear_station_m, 0.5 * self.layout.stage[-1].diameter_m))
        for stage in self.layout.stage[self.number :]:
            rods += _dry(stage)
        for stage in self.layout.stage[self.number + 1 :]:
            rods += [_column(tank, tank.liquid_mass_kg) for tank in stage.tank]
            rods += [_grain(grain, 1.0, 0.5 * stage.diameter_m) for grain in stage.grain]
        return rods

    def liquid_kg(self, tank: LayoutTank, t: float) -> float:
        """Return the mass of the liquid in a tank of the burning stage at time `t` (s). All tanks drain in
        proportion.
        """
        return tank.liquid_mass_kg - (tank.liquid_mass_kg - tank.residual_kg) * self.burn.used(t)

    def liquids(self, t: float) -> list[Rod]:
        return [_column(tank, self.liquid_kg(tank, t)) for tank in self.stage.tank]

    def grains(self, t: float) -> list[Rod]:
        left = 1.0 - self.burn.used(t)
        return [_grain(grain, left, 0.5 * self.stage.diameter_m) for grain in self.stage.grain]

    @cached_property
    def mass_properties(self) -> Callable[[float], MassProperties]:
        """Return a cached function of the stage's clock (s) to the mass properties, boosters included."""
        return cache(self._mass_properties)

    def core_properties(self, t: float) -> MassProperties:
        """Return the mass properties without the boosters."""
        return properties_of([*self.dry, *self.liquids(t), *self.grains(t)])

    def _mass_properties(self, t: float) -> MassProperties:
        core = self.core_properties(t)
        bodies = [(core, (0.0, 0.0))]
        bodies += [(s.mass_properties(t), place) for s in self.boosters for place in s.booster.positions_m]
        if len(bodies) == 1:
            return core
        mass = sum(b.mass_kg for b, _ in bodies)
        cg = sum(b.mass_kg * b.x_cg_m for b, _ in bodies) / mass
        roll = sum(b.roll_kgm2 + b.mass_kg * (y * y + z * z) for b, (y, z) in bodies)
        pitch = sum(b.pitch_kgm2 + b.mass_kg * ((b.x_cg_m - cg) ** 2 + z * z) for b, (_, z) in bodies)
        yaw = sum(b.yaw_kgm2 + b.mass_kg * ((b.x_cg_m - cg) ** 2 + y * y) for b, (y, _) in bodies)
        return MassProperties(mass, cg, roll, pitch, yaw)


def properties_of(rods: Sequence[Rod]) -> MassProperties:
    """Return the mass properties of masses that balance each other about the axis."""
    mass = sum(r.mass_kg for r in rods)
    cg = sum(r.mass_kg * r.station_m for r in rods) / mass
    across = sum(r.inertia_kgm2 + r.mass_kg * (r.station_m - cg) ** 2 for r in rods)
    roll = sum(r.mass_kg * r.roll_m2 for r in rods)
    along_y, along_z = (sum(r.mass_kg * r.place_m[k] ** 2 for r in rods) for k in (0, 1))
    return MassProperties(mass, cg, roll + along_y + along_z, across + along_z, across + along_y)


def _net_N(burn: ThrustCurve, e: LayoutThrust, t: float, pressure_Pa: float) -> float:
    """Return the thrust of engines at ambient pressure, not below 0. `burn` has the thrust of all of them in vacuum."""
    vacuum = burn.thrust_vacuum_N(t)
    return max(vacuum - pressure_Pa * e.exit_area_m2 * len(e.positions_m), 0.0) if vacuum > 0.0 else 0.0


def _dry(stage: LayoutStage | LayoutBooster) -> list[Rod]:
    """Return the parts, the structure and the engines of a stage or booster."""
    rods = []
    radius, e = 0.5 * stage.diameter_m, stage.engine
    rods += [_part(p, p.radius_m or radius) for p in stage.part]
    for s in stage.shell:
        r = s.radius_m or radius
        wall = 2.0 * math.pi * r * (s.wall_m or 0.0) * s.density_kgpm3
        mass = wall * (s.rear_station_m - s.front_station_m)
        rods += [ring(mass, s.front_station_m, s.rear_station_m, r)] if mass > 0.0 else []
    spread = float(np.mean([y * y + z * z for y, z in e.positions_m])) + 0.05
    mass = e.mass_kg * len(e.positions_m)
    rods.append(Rod(mass, e.gimbal_station_m, e.rear_station_m or e.exit_station_m, spread, 0.5 * spread))
    return rods


def _part(part: DryMass, radius_m: float) -> Rod:
    if part.gyration_m is None:
        return ring(part.mass_kg, part.front_station_m, part.rear_station_m, radius_m)
    roll, across = part.gyration_m
    return Rod(part.mass_kg, part.front_station_m, part.rear_station_m, roll**2, across**2)


def _grain(grain: Grain, left: float, radius_m: float) -> Rod:
    """Return the remaining share `left` of a grain as a hollow cylinder. `radius_m` is the radius of the stage.

    A port of radius r_0 in a grain of radius R grows to r^2 = R^2 - left (R^2 - r_0^2). An end-burning grain becomes
    shorter from its aft face.
    """
    outside = (grain.radius_m or radius_m) ** 2
    inside = outside - left * (outside - (grain.port_radius_m or 0.0) ** 2) if grain.burns == "port" else 0.0
    length = (left if grain.burns == "end" else 1.0) * (grain.rear_station_m - grain.front_station_m)
    rear_m = grain.front_station_m + max(length, _LEAST_LENGTH_m)
    square = 0.5 * (outside + inside)
    return Rod(left * grain.mass_kg, grain.front_station_m, rear_m, square, 0.5 * square)


def _column(tank: LayoutTank, mass_kg: float) -> Rod:
    """Return a liquid as a rod with its centroid and depth. In a dome, the rod is shortened to keep the centroid."""
    profile, r = tank.profile, tank.radius_m
    depth = float(profile.depth(np.array(mass_kg / (tank.density_kgpm3 * r**3))))
    z = np.linspace(0.0, depth, 201)
    area = profile.surface_radius(z) ** 2
    total = float(np.trapezoid(area, z))
    centroid = float(np.trapezoid(area * z, z)) / total if total > 0.0 else 0.0
    middle = tank.bottom_station_m - r * centroid
    half = r * min(centroid, depth - centroid)
    ends, roll = (middle - max(half, 1e-4), middle + max(half, 1e-4)), 0.5 * tank.roll_share * r * r
    return Rod(mass_kg, *ends, roll, 0.25 * r * r, tank.position_m)


def stacks(layout: Layout) -> list[Stack]:
    """Return the stacks in the order of flight, all with the fairing.

    Each stage has a stack, and a further stack for each separation of boosters. Raises ValueError for too short a burn,
    and for boosters that separate after the full thrust of their stage.
    """
    out = []
    for n, stage in enumerate(layout.stage):
        burn, begins_s = burn_of(stage, stage.ignition_after_s if n else 0.0), 0.0
        whole = Stack(layout, n, burn, layout.fairing is not None, stage.name)
        strapped = [Strapped(b, burn_of(b, b.ignition_after_s)) for b in stage.booster]
        strapped.sort(key=lambda each: -each.leave_s)
        for leave_s in sorted({each.leave_s for each in strapped}):
            if leave_s >= burn.full_s[1]:
                raise ValueError(f"boosters leave at {leave_s:.1f} s, after stage {stage.name} has burned out")
            attached = tuple(each for each in strapped if each.leave_s >= leave_s)
            name = f"{stage.name} with {' and '.join(each.booster.name for each in attached)}"
            out.append(replace(whole, name=name, boosters=attached, begins_s=begins_s, leave_s=leave_s))
            begins_s = leave_s
        out.append(replace(whole, begins_s=begins_s))
    return out


def without_fairing(every: Sequence[Stack], number: int, clock_s: float) -> list[Stack]:
    """Return the stacks with the fairing dropped at `clock_s` of the burn of stack `number`, which becomes two
    stacks.
    """
    out = list(every[:number])
    first, rest = every[number].burn.split(clock_s)
    out.append(replace(every[number], burn=first, drops_fairing=True))
    out.append(replace(every[number], burn=rest, fairing=False, name=f"{every[number].name}, fairing off"))
    return out + [replace(stack, fairing=False) for stack in every[number + 1 :]]


def engine_inertia(e: LayoutEngines) -> tuple[float, float, float]:
    """Return the gimballed mass of one engine, its CG aft of the gimbal, and its transverse inertia about the
    gimbal.
    """
    length = e.exit_station_m - e.gimbal_station_m
    mass = 0.8 * e.mass_kg if e.gimballed_mass_kg is None else e.gimballed_mass_kg
    arm = 0.3 * length if e.cg_from_gimbal_m is None else e.cg_from_gimbal_m
    return mass, arm, e.inertia_about_gimbal_kgm2 or mass * (arm**2 + length**2 / 12.0)


def line_density_kgpm(rods: Sequence[Rod], edges_m: Array) -> tuple[Array, tuple[float, float, float]]:
    """Return the mass per length of the elements between `edges_m`, and the mass behind the last edge with its moments.

    The latter is the mass (kg), first moment (kg m) and moment of inertia (kg m2) about the last edge.
    """
    density, behind = np.zeros(len(edges_m) - 1), np.zeros(3)
    end, element = float(edges_m[-1]), np.diff(edges_m)
    for rod in rods:
        length = rod.rear_station_m - rod.front_station_m
        inside = np.minimum(edges_m[1:], rod.rear_station_m) - np.maximum(edges_m[:-1], rod.front_station_m)
        density += rod.mass_kg / length * np.maximum(inside, 0.0) / element
        a, b = max(rod.front_station_m, end) - end, max(rod.rear_station_m, end) - end
        per_m = rod.mass_kg / length
        behind += per_m * np.array([b - a, (b * b - a * a) / 2.0, (b**3 - a**3) / 3.0])
    return density, (float(behind[0]), float(behind[1]), float(behind[2]))
