"""US Standard Atmosphere 1976 from 86 to 1000 km: the equations that the standard integrates there.

Source: NOAA-S/T 76-1562 (NASA TM-X-74335), part 1, sections 1.2.4 and 1.3, with its constants (tables 3 to 8). From the
number densities at 86 km, each species follows its own balance of gravity, molecular and eddy diffusion, thermal
diffusion and vertical transport. Atomic hydrogen, which escapes, is integrated from 500 km in both directions:

    n_i = n_i,7 (T_7 / T) exp(-integral of (f + v_i / (D_i + K)) dz)                              (equations 31 to 38)
    f   = g / (R* T) (D_i M_i + K M + alpha_i D_i R* T' / g) / (D_i + K),    D_i = a_i / N (T / 273.15)^b_i
    n_H = (n_H,11 - integral of phi / D_H (T / T_11)^(1 + alpha) exp(tau) dz) (T_11 / T)^(1 + alpha) exp(-tau)   (39)

N and M in f and D_i are those of the heavier species computed before: nitrogen for O and O2, these three for Ar and He,
all five for H. Up to 100 km, M is that of sea level. N2 follows M g / (R* T) alone.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Cubics, hermite

BOTTOM_m, TOP_m = 86e3, 1000e3  # geometric altitude
_STEP_m = 50.0  # step of the midpoint rule; relative error of density 2e-6
_KINKS_m = (100e3, 150e3)  # altitudes at which the definition of M changes, and at which hydrogen begins
_NODES_m = np.setdiff1d(
    np.concatenate(
        [np.arange(86e3, 125e3, 500.0), np.arange(125e3, 200e3, 2.5e3), np.arange(200e3, 1001e3, 10e3)]
        + [[kink - _STEP_m, kink + _STEP_m] for kink in _KINKS_m]
    ),
    _KINKS_m,
)
_R0_m, _G0 = 6356766.0, 9.80665
_GAS_CONSTANT, _AVOGADRO, _BOLTZMANN = 8314.32, 6.022169e26, 1.380622e-23  # per kmol
_AIR_kgpkmol = 28.9644
_T7_K, _T11_K, _T_INFINITE_K = 186.8673, 999.2356, 1000.0
_HYDROGEN_500_pm3, _HYDROGEN_FLUX, _HYDROGEN_FROM_m, _HYDROGEN_AT_m = 8.0e10, 7.2e11, 150e3, 500e3


class _Species(NamedTuple):
    """The constants of a species of the air.

    - `mass`: molar mass, kg/kmol.
    - `number`: number density at 86 km, 1/m3.
    - `alpha`: thermal diffusion coefficient.
    - `a`, `b`: coefficients of D_i.
    - `q`, `u`, `w`: coefficients Q, U, W of the flux (km).
    """

    mass: float
    number: float
    alpha: float = 0.0
    a: float = 0.0
    b: float = 0.0
    q: float = 0.0
    u: float = 0.0
    w: float = 0.0


_N2 = _Species(28.0134, 1.129794e20)
_O = _Species(15.9994, 8.6e16, 0.0, 6.986e20, 0.750, -5.809644e-4, 56.90311, 2.706240e-5)
_O2 = _Species(31.9988, 3.030898e19, 0.0, 4.863e20, 0.750, 1.366212e-4, 86.0, 8.333333e-5)
_AR = _Species(39.948, 1.351400e18, 0.0, 4.487e20, 0.870, 9.434079e-5, 86.0, 8.333333e-5)
_HE = _Species(4.0026, 7.5817e14, -0.40, 1.700e21, 0.691, -2.457369e-4, 86.0, 6.666667e-4)
_H = _Species(1.00797, 0.0, -0.25, 3.305e21, 0.500)
_O_BELOW_97_km = -3.416248e-3, 97.0, 5.008765e-4  # q, u, w of the additional flux of O below 97 km


def temperature(z_m: Array) -> tuple[Array, Array]:
    """Return the kinetic temperature, K, and its gradient, K/m (equations 25, 27, 29, 31)."""
    rise = np.clip((z_m - 91e3) / 19942.9, 0.0, 0.99)
    ellipse = np.sqrt(1.0 - rise * rise)
    shrink = (_R0_m + 120e3) / (_R0_m + z_m)
    rest = (_T_INFINITE_K - 360.0) * np.exp(-1.875e-5 * (z_m - 120e3) * shrink)
    layers = z_m < 91e3, z_m < 110e3, z_m < 120e3
    degrees = np.select(
        layers, (_T7_K + 0.0 * z_m, 263.1905 - 76.3232 * ellipse, 240.0 + 0.012 * (z_m - 110e3)), _T_INFINITE_K - rest
    )
    slope = np.select(
        layers, (0.0 * z_m, 76.3232 * rise / (19942.9 * ellipse), 0.012 + 0.0 * z_m), 1.875e-5 * shrink**2 * rest
    )
    return degrees, slope


def _eddies(z_m: Array) -> Array:
    """Return the eddy diffusion, m2/s: constant to 95 km, decreasing to 115 km, zero above (equation 7)."""
    x = np.clip((z_m - 95e3) / 20e3, 0.0, 1.0 - 1e-9)
    return 120.0 * np.exp(1.0 - 1.0 / (1.0 - x * x))


def _flux(s: _Species, z_m: Array) -> Array:
    """Return the vertical transport v_i / (D_i + K), 1/m (equation 37)."""
    above = 1e-3 * z_m - s.u
    flux = s.q * above**2 * np.exp(-s.w * above**3)
    if s is _O:
        q, u, w = _O_BELOW_97_km
        below = np.maximum(u - 1e-3 * z_m, 0.0)
        flux += q * below**2 * np.exp(-w * below**3)
    return 1e-3 * flux


def number_densities(z_m: Array) -> tuple[list[Array], list[_Species]]:
    """Return the number densities, 1/m3, of N2, O, O2, Ar, He and H, and these species.

    `z_m` must increase from 86 km in equal steps.
    """
    step, middle = z_m[1] - z_m[0], 0.5 * (z_m[1:] + z_m[:-1])
    edge_K, (t, slope) = temperature(z_m)[0], temperature(middle)
    scale = _G0 * (_R0_m / (_R0_m + middle)) ** 2 / (_GAS_CONSTANT * t)  # g / (R* T)
    eddies = _eddies(middle)

    def integral(rate: Array) -> Array:
        return np.concatenate([[0.0], np.cumsum(rate) * step])

    def background(found: list[Array]) -> tuple[Array, Array]:
        total = np.sum(found, axis=0)
        mass = np.sum([s.mass * n for s, n in zip(species, found, strict=False)], axis=0) / total
        return total, np.where(middle < 100e3, _AIR_kgpkmol, mass)

    species = [_N2, _O, _O2, _AR, _HE, _H]
    edges: list[Array] = []
    inside: list[Array] = []
    for s, heavier in zip(species[:-1], (0, 1, 1, 3, 3), strict=True):
        if s is _N2:
            rate = scale * np.where(middle < 100e3, _AIR_kgpkmol, s.mass)
        else:
            total, mass = background(inside[:heavier])
            diffusion = s.a / total * (t / 273.15) ** s.b
            mixed = diffusion * (s.mass + s.alpha * slope / (scale * t)) + eddies * mass
            rate = scale * mixed / (diffusion + eddies) + _flux(s, middle)
        edges.append(s.number * _T7_K / edge_K * np.exp(-integral(rate)))
        inside.append(np.sqrt(edges[-1][1:] * edges[-1][:-1]))
    at_500 = int(np.searchsorted(z_m, _HYDROGEN_AT_m))
    tau = integral(scale * _H.mass)
    tau -= tau[at_500]
    diffusion = _H.a / np.sum(inside, axis=0) * (t / 273.15) ** _H.b
    escape = _HYDROGEN_FLUX / diffusion * (t / _T11_K) ** (1.0 + _H.alpha) * np.exp(0.5 * (tau[1:] + tau[:-1]))
    lost = integral(np.where(middle < _HYDROGEN_AT_m, escape, 0.0))
    hydrogen = (_HYDROGEN_500_pm3 - lost + lost[at_500]) * (_T11_K / edge_K) ** (1.0 + _H.alpha) * np.exp(-tau)
    edges.append(np.where(z_m < _HYDROGEN_FROM_m, 0.0, hydrogen))
    return edges, species


@lru_cache(maxsize=1)
def upper_air() -> Cubics:
    """Return ln(density), ln(pressure), kinetic temperature over geometric altitude.

    The layout is that of `atmosphere.air_table`. Between the nodes the cubics agree with density and pressure within
    7e-5. They agree with the standard's tables within a unit of the last printed digit (four digits of density, five of
    pressure).
    """
    z_m = np.arange(BOTTOM_m, TOP_m + _STEP_m, _STEP_m, dtype=np.float64)
    numbers, species = number_densities(z_m)
    degrees, slope = temperature(z_m)
    total = np.sum(numbers, axis=0)
    mass = np.sum([s.mass * n for s, n in zip(species, numbers, strict=True)], axis=0)
    columns = np.stack([np.log(mass / _AVOGADRO), np.log(total * _BOLTZMANN * degrees), degrees], axis=1)
    slopes = np.gradient(columns, _STEP_m, axis=0)
    slopes[:, 2] = slope
    columns, slopes = columns.round(8), slopes.round(11)  # processors differ in the last digits of an exponential
    nodes = np.rint((_NODES_m - BOTTOM_m) / _STEP_m).astype(int)
    return hermite(z_m[nodes], columns[nodes], slopes[nodes])
