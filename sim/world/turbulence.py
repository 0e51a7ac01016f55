"""Continuous turbulence: the Dryden model of MIL-F-8785C (1980), section 3.7.

The vehicle flies through a frozen field of gusts whose spectra over the circular frequency w, one-sided, are

    longitudinal     S_u = sigma^2 2 L / (pi V) / (1 + (L w / V)^2)
    lateral, normal  S_v = sigma^2 L / (pi V) (1 + 3 (L w / V)^2) / (1 + (L w / V)^2)^2

with airspeed V, intensity sigma and scale length L. They are scaled white noise through 1/(1 + p) and (1 + sqrt(3)
p)/(1 + p)^2, p the Laplace variable of the dimensionless time theta = V t / L. In theta the filters have constant
coefficients and an output of unit variance, so airspeed, scale length and intensity may vary over the flight, and each
tick is an exact discretisation whatever its length. With V -> 0 the gust is constant.

Approximations: the components are taken along the body axes x (u), y (v), z (w) instead of along the relative wind,
which differ by the angle of incidence; below 1000 ft the standard's axes are horizontal and vertical, which is ignored;
rotary gusts are left out, because their share is of the order of the span over the scale length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.noise import TURBULENCE_STREAM, standard_normal, standard_normal_pair
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import NO_TABLE, Cubics, TableRef, find_interval, fit, interpolate

FOOT_m = 0.3048
KNOT_mps = 1852.0 / 3600.0
Exceedance = Literal["light", "moderate", "severe"]


@dataclass(frozen=True)
class Turbulence:
    """Parameter record. `intensity`: see `intensity_table`; `tick_ns`: period of `turbulence_tick`."""

    on: int = 0
    intensity: TableRef = NO_TABLE
    seed: int = 0
    tick_ns: int = 10_000_000


@dataclass
class TurbulenceState:
    """State record, changed in place: number of ticks, filter states of u (1), v (2), w (2), the last two gusts."""

    ticks: int
    filters: Annotated[Array, (5,)]
    before_mps: Annotated[Array, (3,)]
    now_mps: Annotated[Array, (3,)]


def intensity_table(altitude_m: ArrayLike, sigma_mps: ArrayLike, scale_length_m: ArrayLike) -> Cubics:
    """Table for `Turbulence.intensity`: columns sigma_u, sigma_v, sigma_w [m/s], L_u, L_v, L_w [m], linear in altitude.

    `sigma_mps` and `scale_length_m` are (n, 3) for n altitudes, or anything that broadcasts to it: one number is a
    constant. L is the length in the spectra above (MIL-HDBK-1797 writes 2 L for L_v and L_w). Outside the altitudes the
    end values hold. Raises ValueError unless sigma >= 0 and L > 0.
    """
    altitude = np.atleast_1d(np.asarray(altitude_m, float))
    shape = (len(altitude), 3)
    sigma = np.broadcast_to(np.asarray(sigma_mps, float), shape)
    length = np.broadcast_to(np.asarray(scale_length_m, float), shape)
    if not ((sigma >= 0.0).all() and (length > 0.0).all()):
        raise ValueError("turbulence needs intensities of at least 0 and scale lengths above 0")
    return fit(altitude, np.concatenate([sigma, length], axis=1), "linear")


# MIL-F-8785C figure 7, in ft and ft/s as tabulated by JSBSim (FGWinds.cpp): intensity that is exceeded with a
# probability of 1e-2 (light), 1e-3 (moderate), 1e-5 (severe). Above the last row the last value holds.
_FIGURE_7_ft = (2000, 3750, 7500, 15000, 25000, 35000, 45000, 55000, 65000, 75000, 80000)
_FIGURE_7_ftps = {
    "light": (6.9625, 7.4, 6.7, 4.6, 2.7, 0.4, 0.0, 0.0, 0.0, 0.0, 0.0),
    "moderate": (9.725, 10.6, 10.1, 8.0, 6.6, 5.0, 4.2, 2.7, 0.0, 0.0, 0.0),
    "severe": (18.275, 23.0, 23.6, 22.1, 20.0, 16.0, 15.1, 12.1, 7.9, 6.2, 5.1),
}
_WIND_AT_20_FT_kt = {"light": 15.0, "moderate": 30.0, "severe": 45.0}  # figure 9


@lru_cache(maxsize=8)
def exceedance_table(level: Exceedance, ground_altitude_m: float = 0.0) -> Cubics:
    """The standard's intensities and scale lengths over altitude, for `Turbulence.intensity`.

    To 1000 ft above the ground (3.7.3, figures 10 and 11, never below 10 ft): sigma_w = 0.1 of the wind at
    20 ft, L_w = h, sigma_u = sigma_v = sigma_w / k^0.4, L_u = L_v = h / k^1.2 with k = 0.177 + 0.000823
    h/ft. From 2000 ft up (3.7.2, figure 7): all equal, L = 1750 ft. Linear in between. `ground_altitude_m`
    shifts the lower part only. Raises KeyError for another level.
    """
    low = np.array([10.0, 20.0, 40.0, 70.0, 100.0, 150.0, 200.0, 300.0, 400.0, 600.0, 800.0, 1000.0])
    k = 0.177 + 0.000823 * low
    sigma_w = np.full_like(low, 0.1 * _WIND_AT_20_FT_kt[level] * KNOT_mps / FOOT_m)
    sigma_u, length_u = sigma_w / k**0.4, low / k**1.2
    low_sigma = np.stack([sigma_u, sigma_u, sigma_w], axis=1)
    low_length = np.stack([length_u, length_u, low], axis=1)
    low_altitude = low + ground_altitude_m / FOOT_m
    high_altitude, high_sigma = np.array(_FIGURE_7_ft, float), np.array(_FIGURE_7_ftps[level])
    keep = high_altitude > low_altitude[-1]
    high_sigma = np.repeat(high_sigma[keep, None], 3, axis=1)
    return intensity_table(
        np.concatenate([low_altitude, high_altitude[keep]]) * FOOT_m,
        np.concatenate([low_sigma, high_sigma]) * FOOT_m,
        np.concatenate([low_length, np.full_like(high_sigma, 1750.0)]) * FOOT_m,
    )


_ROOT_3 = math.sqrt(3.0)


@routine
def turbulence_start(turbulence: Turbulence, pool: Array, state: TurbulenceState, altitude_m: float) -> None:
    """Draw the filters' states from their stationary distribution and set the gust: there is no spin-up."""
    if turbulence.on == 0:
        return
    seed = turbulence.seed
    state.ticks = 0
    state.filters[0] = standard_normal(seed, TURBULENCE_STREAM, 0)
    for i in range(2):
        # the two stages have the covariance [[1/2, 1/4], [1/4, 1/4]]; this is its Cholesky factor
        first, second = standard_normal_pair(seed, TURBULENCE_STREAM, 1 + i)
        state.filters[1 + 2 * i] = math.sqrt(0.5) * first
        state.filters[2 + 2 * i] = math.sqrt(0.125) * (first + second)
    _set_gust(turbulence, pool, state, altitude_m)
    for j in range(3):
        state.before_mps[j] = state.now_mps[j]


@routine
def turbulence_tick(
    turbulence: Turbulence, pool: Array, state: TurbulenceState, airspeed_mps: float, altitude_m: float
) -> None:
    """Advance the gust by one tick at the present airspeed [m/s] and altitude [m]; called every `tick_ns`."""
    if turbulence.on == 0:
        return
    k = find_interval(pool, turbulence.intensity, altitude_m)
    way = airspeed_mps * 1e-9 * turbulence.tick_ns
    seed = turbulence.seed
    state.ticks += 1
    index = 3 * state.ticks

    theta = way / interpolate(pool, turbulence.intensity, k, altitude_m, 3)
    state.filters[0] = math.exp(-theta) * state.filters[0] + math.sqrt(-math.expm1(-2.0 * theta)) * standard_normal(
        seed, TURBULENCE_STREAM, index
    )
    for i in range(2):
        theta = way / interpolate(pool, turbulence.intensity, k, altitude_m, 4 + i)
        decay, l_11, l_21, l_22 = second_order_step(theta)
        first, second = standard_normal_pair(seed, TURBULENCE_STREAM, index + 1 + i)
        z_1, z_2 = state.filters[1 + 2 * i], state.filters[2 + 2 * i]
        state.filters[1 + 2 * i] = decay * z_1 + l_11 * first
        state.filters[2 + 2 * i] = decay * (z_2 + theta * z_1) + l_21 * first + l_22 * second

    for j in range(3):
        state.before_mps[j] = state.now_mps[j]
    _set_gust(turbulence, pool, state, altitude_m)


@kernel
def turbulence_at(state: TurbulenceState, fraction: float) -> tuple[float, float, float]:
    """Velocity of the air (u, v, w) [m/s] along body x, y, z, at `fraction` (0..1) of the way to the next tick.

    Linear between the last two ticks: continuous for the integrator, and one tick late, because the line ends at the
    gust that the last tick drew. The delay is that of a field `airspeed * tick` further on and changes no statistics;
    the line takes a little of the variance above a quarter of the tick rate. Zero before `turbulence_start`.
    """
    u, v, w = state.before_mps[0], state.before_mps[1], state.before_mps[2]
    return (
        u + fraction * (state.now_mps[0] - u),
        v + fraction * (state.now_mps[1] - v),
        w + fraction * (state.now_mps[2] - w),
    )


@kernel
def second_order_step(theta: float) -> tuple[float, float, float, float]:
    """Exact step of z_1' = -z_1 + white noise, z_2' = -z_2 + z_1 over the dimensionless time `theta` >= 0.

    Returns (decay, l_11, l_21, l_22): z_1 -> decay z_1 + l_11 a, z_2 -> decay (z_2 + theta z_1) + l_21 a + l_22 b with
    independent unit normals a, b; the l are the Cholesky factor of integral(exp(-2 s) [[1, s], [s, s^2]] ds).
    """
    decay = math.exp(-theta)
    q_11 = -0.5 * math.expm1(-2.0 * theta)
    if theta < 0.05:
        # The closed forms lose theta^3 among numbers of order one; the power series (relative error 1e-9)
        # does not.
        u = -2.0 * theta
        q_12 = theta * theta * (1 / 2 + u * (1 / 3 + u * (1 / 8 + u * (1 / 30 + u * (1 / 144 + u / 840)))))
        q_22 = theta**3 * (1 / 3 + u * (1 / 4 + u * (1 / 10 + u * (1 / 36 + u * (1 / 168 + u / 960)))))
    else:
        e = decay * decay
        q_12 = 0.25 - e * (0.25 + 0.5 * theta)
        q_22 = 0.25 - e * (0.25 + 0.5 * theta + 0.5 * theta * theta)
    l_11 = math.sqrt(q_11)
    l_21 = q_12 / l_11 if l_11 > 0.0 else 0.0
    return decay, l_11, l_21, math.sqrt(max(q_22 - l_21 * l_21, 0.0))


@kernel
def _set_gust(turbulence: Turbulence, pool: Array, state: TurbulenceState, altitude_m: float) -> None:
    """The gust of the filters' present states: outputs of unit variance times the intensities."""
    k = find_interval(pool, turbulence.intensity, altitude_m)
    state.now_mps[0] = interpolate(pool, turbulence.intensity, k, altitude_m, 0) * state.filters[0]
    for i in range(2):
        unit = _ROOT_3 * state.filters[1 + 2 * i] + (1.0 - _ROOT_3) * state.filters[2 + 2 * i]
        state.now_mps[1 + i] = interpolate(pool, turbulence.intensity, k, altitude_m, 1 + i) * unit
