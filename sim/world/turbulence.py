"""Continuous turbulence by the Dryden and von Karman models, or by a spectrum over altitude.

Source: MIL-F-8785C (1980), section 3.7. The vehicle flies through a frozen field of gusts. In the Dryden model, their
one-sided spectra over the circular frequency w are

    longitudinal     S_u = sigma^2 2 L / (pi V) / (1 + (L w / V)^2)
    lateral, normal  S_v = sigma^2 L / (pi V) (1 + 3 (L w / V)^2) / (1 + (L w / V)^2)^2

with airspeed V, intensity sigma and scale length L. They are scaled white noise through 1/(1 + p) and (1 + sqrt(3) p)/
(1 + p)^2, p the Laplace variable of the dimensionless time theta = V t / L. In theta the filters have constant
coefficients and an output of unit variance. Hence airspeed, scale length and intensity may vary over the flight, and
each tick is an exact discretisation for any length of the tick. For V -> 0 the gust is constant.

The von Karman spectra, with x = 1.339 L w / V,

    S_u = sigma^2 2 L / (pi V) (1 + x^2)^(-5/6),   S_v = sigma^2 L / (pi V) (1 + 8/3 x^2) (1 + x^2)^(-11/6)

are sums of Dryden fields of several scale lengths. (1 + x^2)^(-5/6) is a Stieltjes function of x^2, and hence a mixture
of 1 / (k^2 + x^2) with positive weights. In both models the lateral spectrum follows from the longitudinal spectrum by
S_v = (S_u - w dS_u/dw) / 2. Six lengths approximate both spectra within 0.8 % up to x = 1500 (VON_KARMAN).

In the frame BODY the components are along the body axes x (u), y (v), z (w), as for an aircraft that flies in the
direction of its nose. In the frame HORIZONTAL, intensities and lengths refer to the horizon, and spectra to the
direction of flight e (relative to the air). Three independent components of unit variance, the longitudinal component
along e, are transformed into north, east, down by the shortest rotation from up to e. They are then multiplied by
sigma_u, sigma_v, sigma_w. The variances are those of the horizontal axes in any attitude. The length of a component is
that of its direction: L_w by the square of its vertical part, L_u or L_v by the rest. A rising vehicle meets the
longitudinal spectrum vertically and lateral spectra in both horizontal axes, all with the intensities of the horizontal
axes. At high altitude these are equal, and both frames are equivalent except for roll and angle of attack. In vertical
descent the rotation is not defined, and half a turn about north is used.

A spectrum over altitude is a fixed field of horizontal wind, the sum of SPECTRAL_LINES cosines of altitude with random
phases. Handbooks (NASA-HDBK-1001) specify the small-scale wind on a rising launch vehicle in this form.

Rotary gusts are omitted, because their share is of the order of the span over the scale length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.noise import TURBULENCE_STREAM, standard_normal, standard_normal_pair, uniform_pair
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import NO_TABLE, Cubics, TableRef, find_interval, fit, interpolate
from maxq.control.kernel.vectors import Vector, add, cross, scaled

BODY, HORIZONTAL = 0, 1  # Turbulence.frame
MOST_SCALES, SPECTRAL_LINES = 6, 64
DRYDEN = ((1.0, 1.0),)
VON_KARMAN = (
    (0.74338, 1.0728),
    (0.16136, 3.2928),
    (0.060757, 14.068),
    (0.022563, 62.429),
    (0.0083847, 278.99),
    (0.0035554, 1365.5),
)
"""The share of the variance, and 1.339 L over the Dryden length: a minimax fit of both spectra, x = 0 .. 1500."""
_VON_KARMAN_LENGTH = math.gamma(1 / 3) / (math.sqrt(math.pi) * math.gamma(5 / 6))  # 1.339, which makes the variance 1
FOOT_m = 0.3048
KNOT_mps = 1852.0 / 3600.0
Exceedance = Literal["light", "moderate", "severe"]


@dataclass(frozen=True)
class Turbulence:
    """The parameter record of turbulence.

    The gust is the sum of `scales` Dryden fields, each with its `amplitude` and a scale length divided by `shorter`. If
    `lines` is not 0, it is the sum of this number of cosines of altitude instead. `intensity`: place of an
    `intensity_table`. `tick_ns`: period of `turbulence_tick`.
    """

    on: int = 0
    intensity: TableRef = NO_TABLE
    seed: int = 0
    tick_ns: int = 10_000_000
    frame: int = BODY
    scales: int = 1
    amplitude: Annotated[Array, (MOST_SCALES,)] = field(default_factory=lambda: np.ones(MOST_SCALES))
    shorter: Annotated[Array, (MOST_SCALES,)] = field(default_factory=lambda: np.ones(MOST_SCALES))
    lines: int = 0
    line_radpm: Annotated[Array, (SPECTRAL_LINES,)] = field(default_factory=lambda: np.zeros(SPECTRAL_LINES))
    line_mps: Annotated[Array, (SPECTRAL_LINES,)] = field(default_factory=lambda: np.zeros(SPECTRAL_LINES))
    phase_north_rad: Annotated[Array, (SPECTRAL_LINES,)] = field(default_factory=lambda: np.zeros(SPECTRAL_LINES))
    phase_east_rad: Annotated[Array, (SPECTRAL_LINES,)] = field(default_factory=lambda: np.zeros(SPECTRAL_LINES))


@dataclass
class TurbulenceState:
    """The state record of turbulence, changed in place.

    - `ticks`: number of ticks.
    - `filters`: filter states of u (1), v (2), w (2) of each scale.
    - `before_mps`, `now_mps`: the last two gusts.
    """

    ticks: int
    filters: Annotated[Array, (5 * MOST_SCALES,)]
    before_mps: Annotated[Array, (3,)]
    now_mps: Annotated[Array, (3,)]


def intensity_table(altitude_m: ArrayLike, sigma_mps: ArrayLike, scale_length_m: ArrayLike) -> Cubics:
    """Return the table for `Turbulence.intensity`, linear in altitude.

    Its columns are sigma_u, sigma_v, sigma_w [m/s], L_u, L_v, L_w [m]. `sigma_mps` and `scale_length_m` have the shape
    (n, 3) for n altitudes, or broadcast to this shape; a single number is a constant. L is the length in the spectra of
    this module (MIL-HDBK-1797 writes 2 L for L_v and L_w). The end values apply outside the altitudes. Raises
    ValueError unless sigma >= 0 and L > 0.
    """
    altitude = np.atleast_1d(np.asarray(altitude_m, float))
    shape = (len(altitude), 3)
    sigma = np.broadcast_to(np.asarray(sigma_mps, float), shape)
    length = np.broadcast_to(np.asarray(scale_length_m, float), shape)
    if not ((sigma >= 0.0).all() and (length > 0.0).all()):
        raise ValueError("turbulence needs intensities of at least 0 and scale lengths above 0")
    return fit(altitude, np.concatenate([sigma, length], axis=1), "linear")


# MIL-F-8785C figure 7, in ft and ft/s as tabulated by JSBSim (FGWinds.cpp): intensities with probabilities of
# exceedance of 1e-2 (light), 1e-3 (moderate) and 1e-5 (severe). Above the last row the last value applies.
_FIGURE_7_ft = (2000, 3750, 7500, 15000, 25000, 35000, 45000, 55000, 65000, 75000, 80000)
_FIGURE_7_ftps = {
    "light": (6.9625, 7.4, 6.7, 4.6, 2.7, 0.4, 0.0, 0.0, 0.0, 0.0, 0.0),
    "moderate": (9.725, 10.6, 10.1, 8.0, 6.6, 5.0, 4.2, 2.7, 0.0, 0.0, 0.0),
    "severe": (18.275, 23.0, 23.6, 22.1, 20.0, 16.0, 15.1, 12.1, 7.9, 6.2, 5.1),
}
_WIND_AT_20_FT_kt = {"light": 15.0, "moderate": 30.0, "severe": 45.0}  # figure 9


@lru_cache(maxsize=8)
def exceedance_table(level: Exceedance, ground_altitude_m: float = 0.0) -> Cubics:
    """Return the standard's intensities and scale lengths over altitude, for `Turbulence.intensity`.

    Up to 1000 ft above the ground (3.7.3, figures 10 and 11, never below 10 ft): sigma_w = 0.1 of the wind at 20 ft,
    L_w = h, sigma_u = sigma_v = sigma_w / k^0.4, L_u = L_v = h / k^1.2 with k = 0.177 + 0.000823 h/ft. From 2000 ft up
    (3.7.2, figure 7): all intensities equal, L = 1750 ft. The values are linear in between. `ground_altitude_m` shifts
    the lower part only. Raises KeyError for another level.
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


def scale_mixture(mixture: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Return the fields of `Turbulence` for DRYDEN or VON_KARMAN."""
    amplitude, shorter = np.ones(MOST_SCALES), np.ones(MOST_SCALES)
    total = sum(share for share, _ in mixture)
    for k, (share, pole) in enumerate(mixture):
        amplitude[k] = math.sqrt(share / total)
        shorter[k] = pole if len(mixture) == 1 else pole / _VON_KARMAN_LENGTH
    return {"scales": len(mixture), "amplitude": amplitude, "shorter": shorter}


def spectral_lines(wave_number_pm: Array, density_m3ps2: Array, seed: int) -> dict[str, Any]:
    """Return the fields of `Turbulence` for a power spectrum over the vertical wave number.

    The spectrum is one-sided and that of each horizontal component. `wave_number_pm` (n,) is in cycles per m,
    increasing; `density_m3ps2` (n,) is in (m/s)^2 per (cycle per m). Both are > 0. The logarithms are interpolated
    between the rows, and the spectrum is zero outside them. The range is divided into cells of equal ratio, one per
    line. Each line has the variance of its cell, at a random place in the cell, with random phases.
    """
    ends = np.geomspace(wave_number_pm[0], wave_number_pm[-1], SPECTRAL_LINES + 1)
    inside = np.geomspace(ends[:-1], ends[1:], 33)
    density = np.exp(np.interp(np.log(inside), np.log(wave_number_pm), np.log(density_m3ps2)))
    variance = (0.5 * (density[1:] + density[:-1]) * np.diff(inside, axis=0)).sum(axis=0)
    drawn = np.array(
        [[uniform_pair(seed, TURBULENCE_STREAM, 2 * k + j) for j in (0, 1)] for k in range(SPECTRAL_LINES)]
    )
    return {
        "lines": SPECTRAL_LINES,
        "frame": HORIZONTAL,
        "line_radpm": 2.0 * math.pi * ends[:-1] * (ends[1:] / ends[:-1]) ** drawn[:, 0, 0],
        "line_mps": np.sqrt(2.0 * variance),
        "phase_north_rad": 2.0 * math.pi * drawn[:, 0, 1],
        "phase_east_rad": 2.0 * math.pi * drawn[:, 1, 0],
    }


@routine
def turbulence_start(
    turbulence: Turbulence, pool: Array, state: TurbulenceState, altitude_m: float, along_N: Vector
) -> None:
    """Draw the filters' states from their stationary distribution, which needs no spin-up, and set the gust.

    `along_N`: direction of flight relative to the air, north, east, down; used only in the frame HORIZONTAL.
    """
    if turbulence.on == 0:
        return
    seed = turbulence.seed
    state.ticks = 0
    for scale in range(turbulence.scales):
        first_state, index = 5 * scale, 3 * scale
        state.filters[first_state] = standard_normal(seed, TURBULENCE_STREAM, index)
        for i in range(2):
            # The two stages have the covariance [[1/2, 1/4], [1/4, 1/4]], of which this is the Cholesky factor.
            first, second = standard_normal_pair(seed, TURBULENCE_STREAM, index + 1 + i)
            state.filters[first_state + 1 + 2 * i] = math.sqrt(0.5) * first
            state.filters[first_state + 2 + 2 * i] = math.sqrt(0.125) * (first + second)
    _set_gust(turbulence, pool, state, altitude_m, along_N)
    for j in range(3):
        state.before_mps[j] = state.now_mps[j]


@routine
def turbulence_tick(
    turbulence: Turbulence, pool: Array, state: TurbulenceState, airspeed_mps: float, altitude_m: float, along_N: Vector
) -> None:
    """Advance the gust by one tick at the current airspeed [m/s] and altitude [m].

    The function must be called every `tick_ns`. `along_N` is that of `turbulence_start`.
    """
    if turbulence.on == 0:
        return
    state.ticks += 1
    if turbulence.lines == 0:
        way = airspeed_mps * 1e-9 * turbulence.tick_ns
        lengths = _lengths(turbulence, pool, altitude_m, along_N)
        for scale in range(turbulence.scales):
            index = 3 * (state.ticks * turbulence.scales + scale)
            _advance(turbulence.shorter[scale] * way, lengths, turbulence.seed, index, 5 * scale, state)
    for j in range(3):
        state.before_mps[j] = state.now_mps[j]
    _set_gust(turbulence, pool, state, altitude_m, along_N)


@kernel
def _lengths(turbulence: Turbulence, pool: Array, altitude_m: float, along_N: Vector) -> Vector:
    """Return the scale length of each component, m."""
    k = find_interval(pool, turbulence.intensity, altitude_m)
    u = interpolate(pool, turbulence.intensity, k, altitude_m, 3)
    v = interpolate(pool, turbulence.intensity, k, altitude_m, 4)
    w = interpolate(pool, turbulence.intensity, k, altitude_m, 5)
    if turbulence.frame == BODY:
        return u, v, w
    north, east, down = along_N  # the vertical parts of the rotated north and east axes are those of e along them
    return u + (w - u) * down * down, v + (w - v) * north * north, v + (w - v) * east * east


@kernel
def _advance(way: float, lengths: Vector, seed: int, index: int, f: int, state: TurbulenceState) -> None:
    """Advance the filters of one scale, from state.filters[f] on, by `way` metres."""
    theta = way / lengths[0]
    state.filters[f] = math.exp(-theta) * state.filters[f] + math.sqrt(-math.expm1(-2.0 * theta)) * standard_normal(
        seed, TURBULENCE_STREAM, index
    )
    for i in range(2):
        theta = way / lengths[1 + i]
        decay, l_11, l_21, l_22 = second_order_step(theta)
        first, second = standard_normal_pair(seed, TURBULENCE_STREAM, index + 1 + i)
        z_1, z_2 = state.filters[f + 1 + 2 * i], state.filters[f + 2 + 2 * i]
        state.filters[f + 1 + 2 * i] = decay * z_1 + l_11 * first
        state.filters[f + 2 + 2 * i] = decay * (z_2 + theta * z_1) + l_21 * first + l_22 * second


@kernel
def turbulence_at(state: TurbulenceState, fraction: float) -> tuple[float, float, float]:
    """Return the velocity of the air [m/s] in the turbulence's frame, at `fraction` (0..1) of the way to the next tick.

    The frame is body x, y, z, or north, east, down. The velocity is linear between the last two ticks: continuous for
    the integrator, and one tick late, because the line ends at the last gust drawn. The delay is equivalent to a field
    shifted by `airspeed * tick` and changes no statistics. Interpolation reduces the variance slightly above a quarter
    of the tick rate. The result is zero before `turbulence_start`.
    """
    u, v, w = state.before_mps[0], state.before_mps[1], state.before_mps[2]
    return (
        u + fraction * (state.now_mps[0] - u),
        v + fraction * (state.now_mps[1] - v),
        w + fraction * (state.now_mps[2] - w),
    )


@kernel
def second_order_step(theta: float) -> tuple[float, float, float, float]:
    """Return the exact step of z_1' = -z_1 + white noise, z_2' = -z_2 + z_1 over the dimensionless time `theta` >= 0.

    The result is (decay, l_11, l_21, l_22): z_1 -> decay z_1 + l_11 a, z_2 -> decay (z_2 + theta z_1) + l_21 a + l_22 b
    with independent unit normals a, b. The l are the Cholesky factor of integral(exp(-2 s) [[1, s], [s, s^2]] ds).
    """
    decay = math.exp(-theta)
    q_11 = -0.5 * math.expm1(-2.0 * theta)
    if theta < 0.05:
        # The closed forms lose theta^3 among numbers of order one; the power series (relative error 1e-9) does not.
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
def _set_gust(turbulence: Turbulence, pool: Array, state: TurbulenceState, altitude_m: float, along_N: Vector) -> None:
    """Set the gust to the filters' outputs of unit variance times the intensities, or to that of the spectral lines."""
    if turbulence.lines > 0:
        state.now_mps[0], state.now_mps[1], state.now_mps[2] = 0.0, 0.0, 0.0
        for line in range(turbulence.lines):
            turns = turbulence.line_radpm[line] * altitude_m
            state.now_mps[0] += turbulence.line_mps[line] * math.cos(turns + turbulence.phase_north_rad[line])
            state.now_mps[1] += turbulence.line_mps[line] * math.cos(turns + turbulence.phase_east_rad[line])
        return
    u, v, w = 0.0, 0.0, 0.0
    for scale in range(turbulence.scales):
        amplitude, f = turbulence.amplitude[scale], 5 * scale
        u += amplitude * state.filters[f]
        v += amplitude * (_ROOT_3 * state.filters[f + 1] + (1.0 - _ROOT_3) * state.filters[f + 2])
        w += amplitude * (_ROOT_3 * state.filters[f + 3] + (1.0 - _ROOT_3) * state.filters[f + 4])
    unit = (u, v, w)
    if turbulence.frame == HORIZONTAL:
        unit = turned_from_up(along_N, (v, w, -u))
    k = find_interval(pool, turbulence.intensity, altitude_m)
    for j in range(3):
        state.now_mps[j] = interpolate(pool, turbulence.intensity, k, altitude_m, j) * unit[j]


@kernel
def turned_from_up(along_N: Vector, vector: Vector) -> Vector:
    """Return `vector` (north, east, down), rotated by the shortest rotation from up to the unit vector `along_N`.

    The result is v + a x v + a x (a x v) / (1 + c) with a = up x e, c = up . e (Rodrigues). For e downwards, the
    rotation is half a turn about north.
    """
    north, east, down = along_N
    if 1.0 - down < 1e-9:
        return vector[0], -vector[1], -vector[2]
    axis = (east, -north, 0.0)
    once = cross(axis, vector)
    return add(add(vector, once), scaled(1.0 / (1.0 - down), cross(axis, once)))
