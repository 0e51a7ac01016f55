"""Point-mass ascent of a layout: straight up, pitched over, gravity turn through all stages, over a round Earth that
stands still, without wind. Angles in rad; the path angle is above the local horizon.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import Array
from maxq.sim.world.atmosphere import HEAT_RATIO, GAS_CONSTANT_Jpkg_K, TOP_m, us1976
from maxq.sim.world.thermosphere import upper_air
from maxq.tools.vehicle.aerodynamics import MACH, Aerodynamics
from maxq.tools.vehicle.layout import Layout
from maxq.tools.vehicle.masses import Stack, STANDARD_GRAVITY_mps2

EARTH_RADIUS_m = 6_371_000.0
_LEAST_SPEED_mps = 1.0


@dataclass(frozen=True)
class Point:
    """An instant of the ascent: stage and its clock, flight time, and what acts."""

    number: int
    clock_s: float
    time_s: float
    range_m: float
    altitude_m: float
    speed_mps: float
    path_rad: float
    thrust_N: float
    dynamic_pressure_Pa: float
    mach: float

    @property
    def pitch_rad(self) -> float:
        """Attitude above the launch site's horizon, no incidence."""
        return self.path_rad - self.range_m / EARTH_RADIUS_m


@dataclass(frozen=True)
class Ascent:
    """Points along the powered flight, and when each stage begins, s of flight time."""

    points: list[Point]
    begins_s: tuple[float, ...]
    kick_rad: float


@dataclass
class _Model:
    layout: Layout
    stacks: Sequence[Stack]
    aero: Sequence[Aerodynamics]
    masses: list[tuple[Array, Array]]  # of each stage: clock, mass
    kick_rad: float = 0.0

    def acts(self, n: int, t: float, altitude: float, speed: float) -> tuple[float, float, float, float]:
        """Thrust N, drag N, dynamic pressure Pa, Mach number."""
        density, pressure, sound = air(altitude)
        mach, q = speed / sound, 0.5 * density * speed**2
        burn, e, aero = self.stacks[n].burn, self.layout.stage[n].engine, self.aero[n]
        vacuum = burn.thrust_vacuum_N(t)
        thrust = max(vacuum - pressure * e.exit_area_m2 * len(e.positions_m), 0.0) if vacuum > 0.0 else 0.0
        coefficient = float(np.interp(mach, MACH, aero.axial if vacuum > 0.0 else aero.axial_coast))
        return thrust, q * aero.area_m2 * coefficient, q, mach

    def rate(self, n: int, begin_s: float, t: float, y: Array) -> list[float]:
        _, altitude, speed, path = y
        thrust, drag, _, _ = self.acts(n, t, altitude, speed)
        mass = float(np.interp(t, *self.masses[n]))
        radius = EARTH_RADIUS_m + altitude
        gravity = STANDARD_GRAVITY_mps2 * (EARTH_RADIUS_m / radius) ** 2
        free = (speed / radius - gravity / max(speed, _LEAST_SPEED_mps)) * math.cos(path)
        push, share = self._pitch_over(begin_s + t)
        accel = (thrust - drag) / mass - gravity * math.sin(path)
        if n == 0 and speed <= 0.0 and accel < 0.0:
            accel = 0.0  # on the pad
        return [speed * math.cos(path) * EARTH_RADIUS_m / radius, speed * math.sin(path), accel, push + share * free]

    def _pitch_over(self, time_s: float) -> tuple[float, float]:
        """Turn by the pitch-over, rad/s (a raised cosine), and the share of gravity's turn, 1 behind it."""
        wanted = self.layout.trajectory
        x = (time_s - wanted.pitch_over_start_s) / wanted.pitch_over_s
        push = -self.kick_rad / wanted.pitch_over_s * (1.0 - math.cos(2.0 * math.pi * x)) if 0.0 < x < 1.0 else 0.0
        late = min(max(2.0 * x - 1.0, 0.0), 1.0)
        return push, late * late * (3.0 - 2.0 * late)

    def fly(self, kick_rad: float, points: int) -> Ascent:
        """All stages; `points` of each burn are kept."""
        self.kick_rad = kick_rad
        y, time_s, kept, begins = np.array([0.0, self.layout.site.altitude_m, 0.0, 0.5 * math.pi]), 0.0, [], []
        for n, stage in enumerate(self.layout.stage):
            burn = self.stacks[n].burn
            begins.append(time_s)
            last = n == len(self.layout.stage) - 1
            end = burn.end_s + (0.0 if last else stage.separation_after_s)
            at = np.linspace(0.0 if n == 0 else burn.start_s, burn.end_s, points)
            found = solve_ivp(
                partial(self.rate, n, time_s), (0.0, end), y, t_eval=at if last else np.append(at, end),
                rtol=1e-6, atol=[1.0, 1.0, 1e-3, 1e-6], max_step=1.0,
            )  # fmt: skip  # five more lines otherwise
            for t, state in zip(found.t[:points], found.y.T, strict=False):
                reach, altitude, speed, path = (float(v) for v in state)
                thrust, _, q, mach = self.acts(n, float(t), altitude, speed)
                kept.append(Point(n, float(t), time_s + float(t), reach, altitude, speed, path, thrust, q, mach))
            y, time_s = found.y[:, -1], time_s + end
        return Ascent(kept, tuple(begins), kick_rad)


_standard, _upper = from_python(us1976), upper_air()


def air(altitude_m: float) -> tuple[float, float, float]:
    """Density, pressure, speed of sound of US Standard Atmosphere 1976; its end values hold above 1000 km."""
    if altitude_m >= TOP_m:
        log_density, log_pressure, _ = _upper(min(altitude_m, 999e3))
        density, pressure = math.exp(log_density), math.exp(log_pressure)
        return density, pressure, math.sqrt(HEAT_RATIO * pressure / density)
    pressure, temperature = _standard(altitude_m)
    return (
        pressure / (GAS_CONSTANT_Jpkg_K * temperature),
        pressure,
        math.sqrt(HEAT_RATIO * GAS_CONSTANT_Jpkg_K * temperature),
    )


def ascent(layout: Layout, stacks: Sequence[Stack], aero: Sequence[Aerodynamics], points: int = 241) -> Ascent:
    """The ascent whose last burn-out has the path angle asked for. Raises ValueError where no pitch-over gives it."""
    masses = []
    for stack in stacks:
        clock = np.linspace(0.0, stack.burn.end_s, 101)
        masses.append((clock, np.array([stack.mass_properties(float(t)).mass_kg for t in clock])))
    model, wanted = _Model(layout, stacks, aero, masses), math.radians(layout.trajectory.final_path_angle_deg)
    weight = masses[0][1][0] * STANDARD_GRAVITY_mps2
    thrust = model.acts(
        0, float(stacks[0].burn.times_s[len(stacks[0].burn.times_s) // 2]), layout.site.altitude_m, 0.0
    )[0]
    if thrust <= 1.02 * weight:
        raise ValueError(f"the first stage pushes {thrust:.4g} N at the ground and weighs {weight:.4g} N")

    def beyond(kick_rad: float) -> float:
        return model.fly(kick_rad, 5).points[-1].path_rad - wanted

    low, high = 1e-4, 0.9
    if beyond(low) < 0.0 or beyond(high) > 0.0:
        raise ValueError(
            f"no pitch-over ends at a path angle of {layout.trajectory.final_path_angle_deg:g} deg: one of "
            f"{math.degrees(low):.2g} deg ends at {math.degrees(beyond(low) + wanted):.1f}, one of "
            f"{math.degrees(high):.2g} deg at {math.degrees(beyond(high) + wanted):.1f} deg"
        )
    return model.fly(float(brentq(beyond, low, high, xtol=1e-7)), points)
