"""Point-mass flight in a vertical plane over a round Earth that stands still, no wind: held down, straight
up, pitched over, gravity turn, coast to impact; and its fit to Table 1.

Angles in rad, path angle above the local horizontal. The pitch-over is a raised-cosine turn rate, and the
gravity turn's own rate is blended in over its last seconds, so that the incidence it needs ends at zero
without a jump.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, least_squares

from maxq.control.kernel.records import Array
from maxq.tools.dev.ksr3 import assumptions as a
from maxq.tools.dev.ksr3.atmosphere import air_at
from maxq.tools.dev.ksr3.drag import Drag
from maxq.tools.dev.ksr3.propulsion import Burn, make_burn


@dataclass(frozen=True)
class Ascent:
    """What the fit may choose."""

    burn: Burn
    drag: Drag
    turn_rad: float  # path angle taken off by the raised cosine


class Forces(NamedTuple):
    """Along the path at one instant."""

    thrust_N: float
    drag_N: float
    dynamic_pressure_Pa: float
    mach: float
    mass_kg: float
    gravity_mps2: float


@dataclass(frozen=True)
class Flight:
    """A flown trajectory: times (n,), states (n, 4) = range m, altitude m, speed m/s, path angle rad."""

    ascent: Ascent
    times_s: Array
    states: Array
    release_s: float

    def state_at(self, t: float) -> Array:
        """State between rows 0.05 s apart in the burn."""
        return np.array([np.interp(t, self.times_s, column) for column in self.states.T])


def forces(ascent: Ascent, t: float, altitude_m: float, speed_mps: float) -> Forces:
    air = air_at(altitude_m)
    mach = speed_mps / air.sound_speed_mps
    pressure = air.density_kgpm3 * speed_mps**2 / 2
    burning = t < ascent.burn.end_s
    drag = pressure * a.AREA_M2 * ascent.drag.coefficient(mach, engine_on=burning)
    gravity = a.STANDARD_GRAVITY_MPS2 * (a.EARTH_RADIUS_M / (a.EARTH_RADIUS_M + altitude_m)) ** 2
    thrust = ascent.burn.thrust_N(t, air.pressure_Pa)
    return Forces(thrust, drag, pressure, mach, float(ascent.burn.mass_kg(t)), gravity)


def gravity_turn_rate(speed_mps: float, path_angle: float, gravity_mps2: float, radius_m: float) -> float:
    """Turn of a vehicle at zero incidence, rad/s; the path angle is to the turning local horizontal."""
    return (speed_mps / radius_m - gravity_mps2 / max(speed_mps, 1.0)) * cos(path_angle)


def turn_rate(ascent: Ascent, t: float, free_radps: float) -> float:
    """Turn of the path in rad/s: straight up, pitch-over, gravity turn, whose own rate is `free_radps`."""
    return pitch_over_rate(ascent, t) + gravity_share(t) * free_radps


def gravity_share(t: float) -> float:
    """How much of the gravity turn's rate the path follows: 0 until late in the pitch-over, 1 after it."""
    x = (t - (a.PITCH_OVER_START_S + a.PITCH_OVER_S - a.BLEND_S)) / a.BLEND_S
    x = min(max(x, 0.0), 1.0)
    return x * x * (3 - 2 * x)


def pitch_over_rate(ascent: Ascent, t: float) -> float:
    """Turn by the pitch-over alone, rad/s."""
    phase = (t - a.PITCH_OVER_START_S) / a.PITCH_OVER_S
    if not 0 < phase < 1:
        return 0.0
    return -ascent.turn_rad / a.PITCH_OVER_S * (1 - cos(2 * pi * phase))


def derivative(ascent: Ascent, t: float, state: Array) -> list[float]:
    _, altitude, speed, angle = state
    f = forces(ascent, t, altitude, speed)
    radius = a.EARTH_RADIUS_M + altitude
    turn = turn_rate(ascent, t, gravity_turn_rate(speed, angle, f.gravity_mps2, radius))
    acceleration = (f.thrust_N - f.drag_N) / f.mass_kg - f.gravity_mps2 * sin(angle)
    return [speed * cos(angle) * a.EARTH_RADIUS_M / radius, speed * sin(angle), acceleration, turn]


def release_time_s(burn: Burn) -> float:
    """When thrust first exceeds weight on the pad."""
    pressure = air_at(a.PAD_ALTITUDE_M).pressure_Pa

    def surplus(t: float) -> float:
        weight = float(burn.mass_kg(t)) * a.STANDARD_GRAVITY_MPS2
        return burn.thrust_N(t, pressure) - weight

    return float(brentq(surplus, 0.0, a.IGNITION_RAMP_S))


class _Ground:
    """The event that ends a flight: altitude falls through zero."""

    terminal = True
    direction = -1.0

    def __call__(self, _: float, state: Array) -> float:
        return float(state[1])


def coast_to_impact(ascent: Ascent, start_s: float, state: Array) -> tuple[Array, Array]:
    """Times and states from burn-out to the ground."""
    return _integrate(ascent, (start_s, start_s + 400.0), state, 0.25, _Ground())


def fly(ascent: Ascent) -> Flight:
    """From the ignition signal to impact."""
    release = release_time_s(ascent.burn)
    state = np.array([0.0, a.PAD_ALTITUDE_M, 0.0, pi / 2])
    times, states = [np.array([0.0])], [state[None]]
    turn_end = a.PITCH_OVER_START_S + a.PITCH_OVER_S
    blend = turn_end - a.BLEND_S
    # Phases end where the right-hand side has a kink, so that the adaptive step keeps its order.
    for start, stop in zip(
        (release, a.IGNITION_RAMP_S, a.PITCH_OVER_START_S, blend, turn_end, ascent.burn.tail_off_s),
        (a.IGNITION_RAMP_S, a.PITCH_OVER_START_S, blend, turn_end, ascent.burn.tail_off_s, ascent.burn.end_s),
        strict=True,
    ):
        t, y = _integrate(ascent, (start, stop), state, 0.05)
        times.append(t[:-1])
        states.append(y[:-1])
        state = y[-1]
    t, y = coast_to_impact(ascent, ascent.burn.end_s, state)
    return Flight(ascent, np.concatenate([*times, t]), np.concatenate([*states, y]), release)


def _integrate(
    ascent: Ascent, span_s: tuple[float, float], state: Array, spacing_s: float, event: _Ground | None = None
) -> tuple[Array, Array]:
    grid = np.append(np.arange(span_s[0], span_s[1] - 1e-9, spacing_s), span_s[1])

    def rates(t: float, y: Array) -> Array:
        return np.array(derivative(ascent, t, y))

    solution = solve_ivp(rates, span_s, state, rtol=1e-8, atol=1e-8, t_eval=grid, events=event, max_step=2.0)
    t, y = solution.t, solution.y.T
    if event is not None and solution.t_events is not None and solution.y_events is not None:
        t, y = np.append(t, solution.t_events[0]), np.vstack([y, solution.y_events[0]])
    return t, y


@dataclass(frozen=True)
class Summary:
    """The flight in the terms of Table 1."""

    max_speed_mps: float
    apogee_km: float
    range_km: float
    flight_s: float
    max_thrust_to_mass_g: float
    max_sensed_g: float
    max_dynamic_pressure_kPa: float
    burnout_mass_kg: float
    burnout_altitude_km: float
    burnout_path_angle_deg: float


def summarise(flight: Flight) -> Summary:
    burning = flight.times_s <= flight.ascent.burn.tail_off_s
    rows = [
        forces(flight.ascent, t, y[1], y[2])
        for t, y in zip(flight.times_s[burning], flight.states[burning], strict=True)
    ]
    end = int(np.searchsorted(flight.times_s, flight.ascent.burn.end_s))
    return Summary(
        max_speed_mps=float(flight.states[:, 2].max()),
        apogee_km=float(flight.states[:, 1].max()) / 1e3,
        range_km=float(flight.states[-1, 0]) / 1e3,
        flight_s=float(flight.times_s[-1]),
        max_thrust_to_mass_g=max(f.thrust_N / f.mass_kg for f in rows) / a.STANDARD_GRAVITY_MPS2,
        max_sensed_g=max((f.thrust_N - f.drag_N) / f.mass_kg for f in rows) / a.STANDARD_GRAVITY_MPS2,
        max_dynamic_pressure_kPa=max(f.dynamic_pressure_Pa for f in rows) / 1e3,
        burnout_mass_kg=flight.ascent.burn.burnout_mass_kg,
        burnout_altitude_km=float(flight.states[end, 1]) / 1e3,
        burnout_path_angle_deg=float(np.degrees(flight.states[end, 3])),
    )


def ascent_from(parameters: Array) -> Ascent:
    """Chamber pressure, last over first; vacuum Isp s; drag scale; turn rad; base drag in coast."""
    droop, isp, drag_scale, turn, coast_base = (float(p) for p in parameters)
    return Ascent(make_burn(droop, isp, a.NOZZLE_EXIT_AREA_M2), Drag(drag_scale, coast_base), turn)


def fit_to_table_1() -> Array:
    """Parameters of `ascent_from`: five against five numbers of Table 1 (with their tolerances) and two prior beliefs.

    Thrust over mass is asked to reach 4.25 g because then it and the sensed 3.6 g lie on either side of Table
    1's 4.1 g.
    """

    def residuals(p: Array) -> list[float]:
        s = summarise(fly(ascent_from(p)))
        return [
            (s.max_speed_mps - 852) / 4,
            (s.apogee_km - 42.8) / 0.3,
            (s.range_km - 79.0) / 0.6,
            (s.flight_s - 231) / 2,
            (s.max_thrust_to_mass_g - 4.25) / 0.03,
            (p[1] - 238) / 4,
            (p[4] - 0.1) / 0.3,
        ]

    fit = least_squares(
        residuals,
        [0.74, 234.0, 1.1, 0.24, 0.1],
        bounds=([0.5, 215, 0.4, 0.01, -0.1], [1.05, 270, 1.15, 0.5, 0.3]),
        diff_step=[1e-3] * 5,
        x_scale=[0.1, 10, 0.2, 0.05, 0.1],
    )
    return np.asarray(fit.x)
