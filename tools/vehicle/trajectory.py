"""The point-mass ascent of a layout in the launch plane over a spherical, rotating Earth.

A vertical rise, a pitch-over and a gravity turn follow each other. The upper stages reach an orbit by a linear tangent
law. There is no wind, and the air rotates with the Earth.

Speed and path angle are relative to the Earth, the path angle in rad above the local horizon. Gravity includes the J2
term along the vertical. The Earth's rotation adds a velocity component across the plane, which affects only the orbit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve, minimize

from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import Array
from maxq.sim.world import earth
from maxq.sim.world.atmosphere import HEAT_RATIO, GAS_CONSTANT_Jpkg_K, TOP_m, us1976
from maxq.sim.world.thermosphere import upper_air
from maxq.tools.vehicle.aerodynamics import Aerodynamics
from maxq.tools.vehicle.layout import Layout
from maxq.tools.vehicle.linear_curve import LinearCurve
from maxq.tools.vehicle.masses import Stack, without_fairing

STEERING_BLEND_s = 15.0  # from the attitude of the gravity turn to that of the tangent law
_LEAST_SPEED_mps = 1.0
_LEAST_SHARE = 0.02  # least share of a burn flown with the fairing, so that it has operating points
_STEP_s = 10.0
_KICK_STEP = 0.0025  # step of the scaled pitch-over: 0.25 mrad
TrajectoryState = tuple[float, float, float, float]  # range m, altitude m, speed m/s, path angle rad


@dataclass(frozen=True)
class TrajectoryPoint:
    """A point of the ascent: its stack, the time on the stack's clock and in flight, the state, and the forces."""

    number: int
    clock_s: float
    time_s: float
    range_m: float
    altitude_m: float
    speed_mps: float
    path_rad: float
    thrust_N: float
    steered_N: float  # thrust of the gimballed engines
    dynamic_pressure_Pa: float
    mach: float
    incidence_rad: float  # attitude above the path, from steering
    excess_radps: float  # turn rate of the path by the pitch-over, in addition to gravity's
    horizon_rad: float  # turn of the local horizon since liftoff, in inertial space

    @property
    def pitch_rad(self) -> float:
        """Return the attitude above the horizon of the launch site at liftoff."""
        return self.path_rad + self.incidence_rad - self.horizon_rad


class Orbit(NamedTuple):
    """The altitudes of perigee and apogee above the equatorial radius, m. The apogee of an escape is infinite."""

    perigee_m: float
    apogee_m: float

    @staticmethod
    def of(radius_m: float, horizontal_mps: float, vertical_mps: float) -> Orbit:
        """Return the orbit from the radius and the horizontal and vertical components of the inertial velocity."""
        momentum = radius_m * horizontal_mps
        energy = 0.5 * (horizontal_mps**2 + vertical_mps**2) - earth.WGS84_MU_m3ps2 / radius_m
        e = math.sqrt(max(1.0 + 2.0 * energy * (momentum / earth.WGS84_MU_m3ps2) ** 2, 0.0))
        p = momentum**2 / earth.WGS84_MU_m3ps2
        return Orbit(
            p / (1.0 + e) - earth.WGS84_RADIUS_m, p / (1.0 - e) - earth.WGS84_RADIUS_m if e < 1.0 else math.inf
        )


@dataclass(frozen=True)
class Ascent:
    """The points along the powered flight, the stacks that fly it, and the flight time of each clock's zero, s.

    `kick_rad` is the angle of the pitch-over. `tangents` are those of the tangent law at its begin and end.
    """

    points: list[TrajectoryPoint]
    stacks: list[Stack]
    begins_s: list[float]
    kick_rad: float
    tangents: tuple[float, float] | None
    orbit: Orbit


class _StackPlace(NamedTuple):
    """The constants of the launch site and plane: local radius, rotation, and direction to the poles.

    `spin_radps` is the Earth's rate about the normal of the plane. `across_mps` is the velocity of the ground across
    the plane.
    """

    radius_m: float
    spin_radps: float
    across_mps: float
    sin_latitude: float
    cos_north: float  # cos(latitude) cos(azimuth)

    @staticmethod
    def of(layout: Layout) -> _StackPlace:
        latitude, azimuth = math.radians(layout.site.latitude_deg), math.radians(layout.azimuth_deg)
        radius = earth.WGS84_RADIUS_m * (1.0 - earth.WGS84_FLATTENING * math.sin(latitude) ** 2)
        turning = earth.WGS84_RATE_radps * math.cos(latitude)
        return _StackPlace(
            radius,
            turning * math.sin(azimuth),
            turning * math.cos(azimuth) * radius,
            math.sin(latitude),
            math.cos(latitude) * math.cos(azimuth),
        )

    def gravity_mps2(self, radius_m: float, angle_rad: float) -> float:
        """Return the gravitational acceleration at a radius and at `angle_rad` from the site along the plane."""
        sin_latitude = self.sin_latitude * math.cos(angle_rad) + self.cos_north * math.sin(angle_rad)
        flattened = 1.0 - 1.5 * earth.WGS84_J2 * (earth.WGS84_RADIUS_m / radius_m) ** 2 * (3.0 * sin_latitude**2 - 1.0)
        return earth.WGS84_MU_m3ps2 / radius_m**2 * flattened


@dataclass
class _Model:
    layout: Layout
    stacks: Sequence[Stack]
    aero: Sequence[Aerodynamics]
    kick_rad: float = 0.0
    tangents: tuple[float, float] | None = None

    @cached_property
    def place(self) -> _StackPlace:
        return _StackPlace.of(self.layout)

    @cached_property
    def masses(self) -> list[tuple[Array, Array]]:
        """Return the times on the clock of each stack, and its mass at each of them."""
        out = []
        for stack in self.stacks:
            clock = np.linspace(stack.begins_s, stack.end_s, 201)
            dry = sum(rod.mass_kg for rod in stack.dry)
            liquid, grain = (sum(t.liquid_mass_kg for t in stack.stage.tank), sum(g.mass_kg for g in stack.stage.grain))
            full = dry + liquid + grain
            full += sum(len(s.booster.positions_m) * s.mass_properties(0.0).mass_kg for s in stack.boosters)
            out.append((clock, np.array([full - stack.used_kg(float(t)) for t in clock])))
        return out

    @cached_property
    def _mass(self) -> list[LinearCurve]:
        return [LinearCurve(*table) for table in self.masses]

    @cached_property
    def _axial(self) -> list[tuple[LinearCurve, LinearCurve]]:
        """Return the axial coefficients of each stack over Mach number, under thrust and without."""
        return [(LinearCurve(a.mach, a.axial), LinearCurve(a.mach, a.axial_coast)) for a in self.aero]

    @cached_property
    def steering_s(self) -> tuple[float, float]:
        """Return the flight times at which the steering of the upper stages begins and ends."""
        first, *upper = [s for s in self.stacks if s.leave_s is None]  # the last part of each stage
        begin = first.burn.end_s + first.stage.separation_after_s
        ends = [s.burn.end_s + s.stage.separation_after_s for s in upper]
        return begin + upper[0].burn.start_s, begin + sum(ends) - self.stacks[-1].stage.separation_after_s

    def acts(self, n: int, t: float, altitude: float, speed: float) -> tuple[float, float, float, float, float]:
        """Return the thrust, the thrust of the gimballed engines and the drag (N), the dynamic pressure (Pa) and the
        Mach number.
        """
        density, pressure, sound = air(altitude)
        mach, q = speed / sound, 0.5 * density * speed**2
        stack, aero = self.stacks[n], self.aero[n]
        burns = stack.burn.thrust_vacuum_N(t) > 0.0
        thrust, steered = stack.thrusts_N(t, pressure)
        powered, coasting = self._axial[n]
        coefficient = powered(mach) if burns else coasting(mach)
        return thrust, steered, q * aero.area_m2 * coefficient, q, mach

    def incidence(self, n: int, time_s: float, path: float) -> float:
        """Return the angle from the path to the attitude, rad. It is 0 except where the tangent law steers."""
        if self.tangents is None or self.stacks[n].number == 0:
            return 0.0
        begin, end = self.steering_s
        wanted = math.atan(float(np.interp(time_s, (begin, end), self.tangents)))
        x = min(max((time_s - begin) / STEERING_BLEND_s, 0.0), 1.0)
        return x * x * (3.0 - 2.0 * x) * (wanted - path)

    def rate(self, n: int, begin_s: float, dropped_kg: float, t: float, y: Sequence[float]) -> TrajectoryState:
        reach, altitude, speed, path = y
        thrust, _, drag, _, _ = self.acts(n, t, altitude, speed)
        mass = self._mass[n](t) - dropped_kg
        place, incidence = self.place, self.incidence(n, begin_s + t, path)
        radius = place.radius_m + altitude
        gravity = place.gravity_mps2(radius, reach / place.radius_m) - place.spin_radps**2 * radius
        accel = (thrust * math.cos(incidence) - drag) / mass - gravity * math.sin(path)
        if n == 0 and speed <= 0.0 and accel < 0.0:
            accel = 0.0  # on the pad
        fast = max(speed, _LEAST_SPEED_mps)
        push, share = self._commanded_turn(n, begin_s + t, altitude)
        turn = push + share * self._free(radius, fast, path, gravity) + thrust * math.sin(incidence) / (mass * fast)
        return speed * math.cos(path) * place.radius_m / radius, speed * math.sin(path), accel, turn

    def _free(self, radius: float, speed: float, path: float, gravity: float) -> float:
        """Return the turn rate of the path by gravity, the Earth's curvature and its rotation (Coriolis), rad/s."""
        return (speed / radius - gravity / speed) * math.cos(path) + 2.0 * self.place.spin_radps

    def _commanded_turn(self, n: int, time_s: float, altitude: float) -> tuple[float, float]:
        """Return the turn rate by the pitch-over, rad/s, and the share of the free turn that acts: none on a rail."""
        if (rail := self.layout.rail) is not None:
            rise_m = rail.length_m * math.sin(self.launch_path_rad)
            return 0.0, 0.0 if altitude - self.layout.site.altitude_m < rise_m else 1.0
        return self._pitch_over(time_s) if self.stacks[n].number == 0 else (0.0, 1.0)

    @cached_property
    def launch_path_rad(self) -> float:
        """Return the path angle at liftoff: that of the rail, or vertical."""
        return 0.5 * math.pi if self.layout.rail is None else math.radians(self.layout.rail.elevation_deg)

    def _pitch_over(self, time_s: float) -> tuple[float, float]:
        """Return the turn rate of the pitch-over (a raised cosine, rad/s), and the share of the free turn that acts.

        The share rises from 0 to 1 in the second half of the pitch-over.
        """
        wanted = self.layout.trajectory
        x = (time_s - wanted.pitch_over_start_s) / wanted.pitch_over_s
        push = -self.kick_rad / wanted.pitch_over_s * (1.0 - math.cos(2.0 * math.pi * x)) if 0.0 < x < 1.0 else 0.0
        late = min(max(2.0 * x - 1.0, 0.0), 1.0)
        return push, late * late * (3.0 - 2.0 * late)

    def point(self, n: int, begin_s: float, t: float, y: TrajectoryState) -> TrajectoryPoint:
        reach, altitude, speed, path = y
        thrust, steered, _, q, mach = self.acts(n, t, altitude, speed)
        time_s, radius = begin_s + t, self.place.radius_m + altitude
        push, share = self._commanded_turn(n, time_s, altitude)
        gravity = self.place.gravity_mps2(radius, reach / self.place.radius_m) - self.place.spin_radps**2 * radius
        excess = push + (share - 1.0) * self._free(radius, max(speed, _LEAST_SPEED_mps), path, gravity)
        if time_s <= self.layout.trajectory.pitch_over_start_s:
            excess = 0.0  # on the pad and during the vertical rise
        horizon = reach / self.place.radius_m + self.place.spin_radps * time_s
        incidence = self.incidence(n, time_s, path)
        forces = thrust, steered, q, mach
        return TrajectoryPoint(n, t, time_s, reach, altitude, speed, path, *forces, incidence, excess, horizon)

    def fly(self, points: int) -> tuple[list[TrajectoryPoint], list[float], tuple[int, float] | None]:
        """Fly all stages with `points` points per burn.

        Return the points, the flight time of each clock's zero (s), and the stack and clock (s) of the fairing
        separation, if there is one.
        """
        fairing, wanted = self.layout.fairing, self.layout.trajectory
        jettison_m = math.inf if fairing is None else fairing.jettison_altitude_m
        y: TrajectoryState = (0.0, self.layout.site.altitude_m, 0.0, self.launch_path_rad)
        time_s, kept, begins, dropped = 0.0, list[TrajectoryPoint](), list[float](), None

        def above(_: float, y: Array) -> float:
            return float(y[1]) - jettison_m

        above.terminal, above.direction = True, 1.0  # type: ignore[attr-defined]  # SciPy ends the integration there
        for n, stack in enumerate(self.stacks):
            burn, stage = stack.burn, stack.stage
            begins.append(time_s)
            end = burn.end_s + (0.0 if n == len(self.stacks) - 1 else stage.separation_after_s)
            end, begin, last = stack.leave_s or end, stack.begins_s, stack.end_s
            start, lowest = wanted.pitch_over_start_s, stack.number == 0
            kinks = [start, start + 0.5 * wanted.pitch_over_s, start + wanted.pitch_over_s] if lowest else []
            kinks += [x for s in stack.boosters for x in (s.burn.start_s, *s.burn.full_s, s.burn.end_s)]
            given = [each for each in (burn, *(s.burn for s in stack.boosters)) if each.given]
            kinks += [float(x) for each in given for x in each.times_s]  # else `_steer_to` differentiates step errors
            inside = [x for x in (0.0, burn.start_s, *burn.full_s, burn.end_s, *kinks) if begin < x < end]
            edges = np.unique([begin, *inside, end])
            at = np.linspace(begin if lowest else burn.start_s, last, points)[:-1]  # and the end, below
            spans = list(pairwise(float(edge) for edge in edges))
            while spans:
                a, b = spans.pop(0)
                can_drop = (
                    not lowest and fairing is not None and dropped is None and burn.full_s[0] <= a < burn.full_s[1]
                )
                if can_drop and y[1] >= jettison_m:
                    early_s = max(1.0, _LEAST_SHARE * (burn.full_s[1] - burn.full_s[0]))
                    dropped, can_drop = (n, max(a, burn.full_s[0] + early_s)), False
                gone = fairing.mass_kg if fairing is not None and dropped is not None else 0.0
                found = solve_ivp(
                    partial(self.rate, n, time_s, gone),
                    (a, b),
                    y,
                    t_eval=np.unique([*at[(at >= a) & (at < b)], b]),
                    rtol=1e-7,
                    atol=[1.0, 1.0, 1e-4, 1e-7],
                    max_step=_STEP_s,
                    events=above if can_drop else None,
                )
                rows = np.reshape(found.y, (4, -1)).T
                for t, row in zip(found.t, rows, strict=True):
                    if t < b or b == last:
                        kept.append(self.point(n, time_s, float(t), _state(row)))
                if (
                    found.y_events and found.t_events and len(found.y_events[0])
                ):  # at the fairing's altitude: continue without it
                    reach, _, speed, path = _state(found.y_events[0][0])
                    y = (reach, jettison_m, speed, path)
                    spans.insert(0, (float(found.t_events[0][0]), b))
                else:
                    y = _state(rows[-1])
            time_s += 0.0 if stack.leave_s is not None else end
        return kept, begins, dropped

    def orbit(self, last: TrajectoryPoint) -> Orbit:
        radius = self.place.radius_m + last.altitude_m
        along = last.speed_mps * math.cos(last.path_rad) + self.place.spin_radps * radius
        across = self.place.across_mps * radius / self.place.radius_m
        return Orbit.of(radius, math.hypot(along, across), last.speed_mps * math.sin(last.path_rad))


def _state(row: Array) -> TrajectoryState:
    reach, altitude, speed, path = (float(v) for v in row)
    return reach, altitude, speed, path


_standard, _upper = from_python(us1976), upper_air()


def air(altitude_m: float) -> tuple[float, float, float]:
    """Return the density, pressure and speed of sound of the US Standard Atmosphere 1976, in SI units.

    Above 1000 km, the values at the upper end apply.
    """
    if altitude_m >= TOP_m:
        log_density, log_pressure, _ = _upper(min(altitude_m, 999e3))
        density, pressure = math.exp(log_density), math.exp(log_pressure)
        return density, pressure, math.sqrt(HEAT_RATIO * pressure / density)
    pressure, temperature = _standard(altitude_m)
    density = pressure / (GAS_CONSTANT_Jpkg_K * temperature)
    return density, pressure, math.sqrt(HEAT_RATIO * GAS_CONSTANT_Jpkg_K * temperature)


def ascent(layout: Layout, stacks: Sequence[Stack], aero: Sequence[Aerodynamics], points: int = 241) -> Ascent:
    """Return the ascent that ends as the layout requires, with `points` points per burn.

    Raises ValueError if the first stage does not lift off, or if no pitch-over leads to the required end.
    """
    model, wanted = _Model(layout, stacks, aero), layout.trajectory
    weight = float(model.masses[0][1][0]) * model.place.gravity_mps2(model.place.radius_m, 0.0)
    begin, end = stacks[0].full_s
    thrust = model.acts(0, 0.5 * (begin + end), layout.site.altitude_m, 0.0)[0]
    if thrust <= 1.02 * weight:
        raise ValueError(f"the first stage pushes {thrust:.4g} N at the ground and weighs {weight:.4g} N")
    if layout.unguided:
        pass
    elif wanted.orbit_altitude_m is None:
        _turn_to(model, math.radians(wanted.final_path_angle_deg))
    else:
        _steer_to(model, wanted.orbit_altitude_m)
    kept, begins, dropped = model.fly(points)
    flown, orbit = list(stacks), model.orbit(kept[-1])
    if dropped is not None:
        n, clock_s = dropped[0], round(dropped[1], 3)
        flown = without_fairing(flown, n, clock_s)
        begins.insert(n + 1, begins[n] + clock_s)
        kept = [
            p
            if p.number < n or (p.number == n and p.clock_s < clock_s)
            else replace(p, number=p.number + 1, clock_s=p.clock_s - (clock_s if p.number == n else 0.0))
            for p in kept
        ]
    return Ascent(kept, flown, begins, model.kick_rad, model.tangents, orbit)


def _turn_to(model: _Model, path_rad: float) -> None:
    """Set the pitch-over of the model to that of a gravity turn which ends at this path angle.

    Raises ValueError if there is none.
    """

    def beyond(kick_rad: float) -> float:
        model.kick_rad = kick_rad
        return model.fly(2)[0][-1].path_rad - path_rad

    low, high = 1e-4, 0.9
    if beyond(low) < 0.0 or beyond(high) > 0.0:
        raise ValueError(
            f"no pitch-over ends at a path angle of {math.degrees(path_rad):g} deg: one of "
            f"{math.degrees(low):.2g} deg ends at {math.degrees(beyond(low) + path_rad):.1f}, one of "
            f"{math.degrees(high):.2g} deg at {math.degrees(beyond(high) + path_rad):.1f} deg"
        )
    model.kick_rad = float(brentq(beyond, low, high, xtol=1e-7))


def _level(ends: Callable[[Array], Array], x: Array) -> Array:
    """Return a level ascent near `x` (pitch-over and tangents, scaled) that is the same on every processor.

    At the end of the search, `x`, the speed hardly depends on the pitch-over. Because processors round differently,
    searches end up to 0.03 mrad apart. Therefore, the pitch-over is rounded, and the tangents follow from it.
    """
    kick = _KICK_STEP * round(float(x[0]) / _KICK_STEP)

    def missed(tangents: Array) -> Array:
        return ends(np.array([kick, *tangents]))[:2]

    return np.array([kick, *fsolve(missed, x[1:], xtol=1e-8, epsfcn=1e-10)])


def _steer_to(model: _Model, altitude_m: float) -> None:
    """Set the pitch-over and the tangents of the model to those of the largest speed at a level end at this altitude.

    Raises ValueError if there are none, or if the perigee is more than 20 km below the altitude.
    """
    radius, flown = earth.WGS84_RADIUS_m + altitude_m, dict[tuple[float, ...], Array]()

    def ends(x: Array) -> Array:
        """Return the height above the required altitude, the path angle and the speed at the end, each divided by its
        scale.

        `x` is scaled in the same way.
        """
        given = tuple(float(v) for v in x)
        if given not in flown:
            model.kick_rad, model.tangents = 0.1 * given[0], (given[1], given[2])
            last = model.fly(2)[0][-1]
            height = model.place.radius_m + last.altitude_m - radius
            flown[given] = np.array([height / 1e5, 10.0 * last.path_rad, last.speed_mps / 1e3])
        return flown[given]

    def missed(x: Array) -> float:
        return float(np.abs(ends(x)[:2]).sum())

    def slowness(x: Array, *_: object) -> float:
        return -float(ends(x)[2])

    trials = [np.array([kick, tangent, -0.1]) for kick in (0.2, 0.4, 0.6, 0.8, 1.0, 1.5) for tangent in (0.3, 0.7, 1.2)]
    level: Any = [{"type": "eq", "fun": lambda x: ends(x)[:2]}]
    how: Any = {"ftol": 1e-5, "maxiter": 60, "eps": 1e-5}
    for start in sorted(trials, key=missed)[:3]:
        bounds = [(0.01, 9.0), (-2.0, 5.0), (-3.0, 2.0)]
        found = minimize(slowness, start, method="SLSQP", bounds=bounds, constraints=level, options=how)
        if missed(found.x) < 1e-2:
            break
    else:
        raise ValueError(f"no ascent of its stages ends level at {altitude_m / 1e3:g} km")
    x = _level(ends, found.x)
    model.kick_rad, model.tangents = 0.1 * float(x[0]), (float(x[1]), float(x[2]))
    last = model.fly(2)[0][-1]
    if (at := model.orbit(last)).perigee_m < altitude_m - 20e3:
        speed, circular = last.speed_mps, math.sqrt(earth.WGS84_MU_m3ps2 / radius)
        raise ValueError(
            f"level at {altitude_m / 1e3:g} km it flies {speed:.0f} m/s relative to the Earth, short of the "
            f"{circular:.0f} m/s (inertial) of an orbit: perigee {at.perigee_m / 1e3:.0f} km"
        )
