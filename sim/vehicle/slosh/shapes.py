"""Lateral slosh modes of an axisymmetric tank as pendulums, from its shape and the depth of its liquid.

The problem is that of linear potential flow. The velocity potential phi = f(r, z) cos(theta) is harmonic in the liquid
and has no normal derivative on the wall. On the surface at rest d(phi)/dz = kappa phi, with omega^2 = kappa a under the
axial load a. Ritz's method solves it by stationary values of (int |grad phi|^2 dV) / (int phi^2 dS) over polynomials in
r and z (Legendre's, f = r p(r^2, z)). They converge fast, because phi is smooth except at the contact line. Liquid
deeper than five radii has no effect and is omitted.

With sigma = int x phi dS and tau = int phi^2 dS over the surface, a mode acts on its tank like a pendulum of

    length  1 / kappa,    mass  rho kappa sigma^2 / tau,    bob at  z_b = int (z phi_x - x phi_z) dV / (kappa sigma)

(force and moment of the mode's pressure under lateral and angular acceleration of the tank; Abramson (ed.), NASA
SP-106, ch. 6; Faltinsen & Timokha, Sloshing, 2009, ch. 5). The mass of the bob times its displacement L sin(swing) is
the first moment of the liquid's displacement. Hence the highest point of the surface above rest is sigma max|f| / tau
times the sine of the swing. For an upright cylinder these are the closed forms of SP-106; in a sphere every hinge is at
the centre.

The damping of a smooth wall is that of a laminar layer on it,

    zeta = sqrt(nu / (8 omega)) int_wall |grad phi|^2 dS / int |grad phi|^2 dV,

times 1.42, the ratio of measured to theoretical damping in cylinders (0.79 against 0.557 times sqrt(nu / sqrt(a R^3));
Mikishev & Dorozhkin 1961; Stephens, NASA TN D-1367; Dodge 2000, ch. 2).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from threadpoolctl import threadpool_limits

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Cubics, hermite
from maxq.sim.vehicle.slosh.section import Profile

DEEPEST = 5.0  # radii below the surface: tanh(5 xi) is 1 within 1e-8
MEASURED_OVER_LAMINAR = 1.42
FULLEST = 0.98  # share of the height of a top dome above which the length and the wave per swing are constant
_FLATTEST = 0.25  # depth in radii below which the length over a flat bottom, which would be unbounded, is constant
_SHALLOWEST = 0.01  # depth in radii at which the tables begin
_DIGITS = 9  # number of digits: a linear-algebra library rounds the last digits differently on each processor
_RADIAL = 7  # number of polynomials


class SloshMode(NamedTuple):
    """A slosh mode at one depth; lengths in radii, mass in density times the cube of the radius."""

    kappa: float
    mass: float
    bob: float  # below the surface
    wave: float  # height of the highest point of the surface per sine of the pendulum's swing
    wall_loss: float  # int_wall |grad phi|^2 dS / int |grad phi|^2 dV

    def viscous(self, radius_m: float, viscosity_m2ps: float) -> float:
        """Return the damping ratio of a smooth wall times the fourth root of the axial load, (m/s2)^(1/4)."""
        laminar = math.sqrt(viscosity_m2ps / 8.0) * math.sqrt(math.sqrt(radius_m / self.kappa)) * self.wall_loss
        return MEASURED_OVER_LAMINAR * laminar / radius_m


def slosh_modes(
    profile: Profile, depth: float, modes: int, radial: int = _RADIAL, vertical: int = 0
) -> list[SloshMode]:
    """Return the lowest lateral modes at `depth` (radii, above 0 and below the height of a tank with a top dome).

    `radial` and `vertical`: numbers of polynomials in each direction. The defaults give an accuracy of 1e-5 for mode 1
    and 1e-3 for mode 2, up to a top dome filled to 9/10, and of one percent at `FULLEST`.
    """
    low = max(depth - DEEPEST, 0.0)
    vertical = vertical or 9 + round(2.2 * (depth - low))
    place, share = np.polynomial.legendre.leggauss(2 * radial + 2)
    z, r, dz, ds = _wall(profile, low, depth, vertical + 8)
    surface = float(profile.surface_radius(np.array(depth)))
    widest = max(float(r.max()), surface)
    out, inward = 0.5 * (place + 1.0), 0.5 * share

    def basis(radius: Array, height: Array) -> tuple[Array, Array, Array, Array]:
        """Return f, its derivatives along r and z, and f / r, (points, polynomials) each."""
        across, up = radius / widest, 2.0 * (height - low) / (depth - low) - 1.0
        p, p_slope = _legendre(2.0 * across**2 - 1.0, radial)
        q, q_slope = _legendre(up, vertical)
        per_r = (p + 4.0 * across[:, None] ** 2 * p_slope) / widest
        whole, rise = across[:, None] * p, q_slope * (2.0 / (depth - low))

        def product(a: Array, b: Array) -> Array:
            return np.asarray((a[:, :, None] * b[:, None, :]).reshape(len(radius), -1))

        return product(whole, q), product(per_r, q), product(whole, rise), product(p / widest, q)

    radii, heights = np.outer(r, out).ravel(), np.repeat(z, len(out))
    volume = np.pi * (np.outer(dz * r, inward).ravel() * radii)
    _, along_r, along_z, over_r = basis(radii, heights)
    energy = sum((d * volume[:, None]).T @ d for d in (along_r, along_z, over_r))
    on_surface, _, _, _ = basis(surface * out, np.full(len(out), depth))
    area = np.pi * surface**2 * inward * out
    scale = 1.0 / np.sqrt(np.diag(energy))
    size, axes = np.linalg.eigh(energy * np.outer(scale, scale))
    kept = size > 1e-12 * size[-1]
    reduced = scale[:, None] * axes[:, kept] / np.sqrt(size[kept])  # unit energy, independent
    squares, shapes = np.linalg.eigh(reduced.T @ (on_surface * area[:, None]).T @ on_surface @ reduced)
    rim, _, _, _ = basis(np.linspace(0.0, surface, 101), np.full(101, depth))
    _, *wall_slopes = basis(r, z)
    weights = np.pi * ds * r
    if low == 0.0 and profile.bottom == 0.0:
        _, *floor = basis(out, np.zeros(len(out)))
        wall_slopes = [np.concatenate(pair) for pair in zip(wall_slopes, floor, strict=True)]
        weights = np.concatenate([weights, np.pi * inward * out])
    found = []
    for n in range(modes):
        c, tau = reduced @ shapes[:, -1 - n], float(squares[-1 - n])
        kappa, sigma = 1.0 / tau, float((area * surface * out) @ (on_surface @ c))
        turning = volume @ ((heights - depth) * ((along_r + over_r) @ c) - radii * (along_z @ c))
        found.append(
            SloshMode(
                kappa=kappa,
                mass=kappa * sigma**2 / tau,
                bob=-float(turning) / (kappa * sigma),
                wave=abs(sigma) * float(np.abs(rim @ c).max()) / tau,
                wall_loss=float(weights @ sum((d @ c) ** 2 for d in wall_slopes)),
            )
        )
    return found


def _legendre(x: Array, count: int) -> tuple[Array, Array]:
    """Return Legendre polynomials at `x` and their derivatives, (points, count) each."""
    values, slopes, unit = np.empty((len(x), count)), np.zeros((len(x), count)), np.eye(count)
    values[:] = legendre.legvander(x, count - 1)
    for n in range(1, count):
        slopes[:, n] = legendre.legval(x, legendre.legder(unit[n]))
    return values, slopes


def _wall(profile: Profile, low: float, high: float, points: int) -> tuple[Array, Array, Array, Array]:
    """Return Gauss points on the tank wall from height `low` to `high`.

    The arrays are height, radius, and the weights of integrals over height and over arc length.
    """
    x, w = np.polynomial.legendre.leggauss(points)
    rows: list[tuple[Array, Array, Array, Array]] = []

    def dome(centre: float, height: float, below: float, above: float) -> None:
        """Add the points of a dome, z = centre - height cos(t), r = sin(t)."""
        start, end = (math.acos(min(max((centre - z) / height, -1.0), 1.0)) for z in (below, above))
        t, dt = 0.5 * (start + end) + 0.5 * (end - start) * x, 0.5 * (end - start) * w
        rise, spread = height * np.sin(t), np.cos(t)
        rows.append((centre - height * np.cos(t), np.sin(t), rise * dt, np.hypot(rise, spread) * dt))

    shoulder = profile.bottom + profile.wall
    if low < profile.bottom:
        dome(profile.bottom, profile.bottom, low, min(high, profile.bottom))
    start, end = max(low, profile.bottom), min(high, shoulder)
    if end > start:
        dz = 0.5 * (end - start) * w
        rows.append((0.5 * (start + end) + 0.5 * (end - start) * x, np.ones(points), dz, dz))
    if high > shoulder and profile.top:
        dome(shoulder, profile.top, max(low, shoulder), high)
    z, r, dz, ds = (np.asarray(np.concatenate(column)) for column in zip(*rows, strict=True))
    return z, r, dz, ds


class ModeAt(NamedTuple):
    """A slosh mode over many depths, with the fields of `SloshMode` and its length; (depths,) each."""

    length: Array
    mass: Array
    bob: Array
    wave: Array
    wall_loss: Array


def modes_over(profile: Profile, depths: Array, modes: int) -> list[ModeAt]:
    """Return the lowest modes at `depths` (radii).

    They are interpolated between solutions at about thirty depths, to 1e-3 of each value. In shallow liquid over a flat
    bottom the length of mode n would be unbounded; below a depth of R/4 it is constant. In a top dome filled beyond
    `FULLEST`, length and wave per swing are constant, while the mass goes to zero.
    """
    knots, tables = _solutions(profile, modes)
    inside = np.clip(depths, knots[0], knots[-1])
    surface, held = profile.surface_radius(inside), profile.surface_radius(depths)
    volume = np.maximum(profile.volume(depths), 1e-300)
    out: list[ModeAt] = []
    left = profile.volume(depths)  # volume of the liquid, which bounds the sum of the masses interpolated separately
    for table in tables:
        kappa, mass, bob, wave, loss = table.at(inside).T
        steady = np.clip(depths, _FLATTEST, None) if profile.bottom == 0.0 else depths
        at = np.clip(steady, knots[0], knots[-1])
        kappa = table.at(at)[:, 0] / _narrowing(profile, at)
        mass = mass / (1.0 / volume + 1.0 / (np.pi * np.maximum(held, 1e-12) ** 3))
        mass = np.minimum(np.where((depths > 0.0) & (held > 0.0), mass, 0.0), left)
        left = left - mass
        bob = bob * np.minimum(1.0, depths / inside)
        out.append(ModeAt(1.0 / kappa, mass, bob, wave * surface, loss * (1.0 + 1.0 / inside)))
    return out


def _narrowing(profile: Profile, depth: Array) -> Array:
    """Return the radius of the surface in a top dome, and 1 below it.

    Its product with kappa is smooth up to the full tank.
    """
    return np.where(depth > profile.bottom + profile.wall, profile.surface_radius(depth), 1.0)


@lru_cache(maxsize=32)
def _solutions(profile: Profile, modes: int) -> tuple[Array, tuple[Cubics, ...]]:
    """Return depths, and for each mode cubics over them of quantities without singularities at the ends."""
    ends = 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, 16)))
    shallow = [0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4]
    above = profile.bottom + np.concatenate([shallow, np.geomspace(0.5, max(profile.wall, 1.0), 12)])
    shoulder = profile.bottom + profile.wall
    top = shoulder + FULLEST * profile.top * np.sin(0.5 * np.pi * ends)
    parts: list[Array] = [profile.bottom * ends, above[above < shoulder], np.array([shoulder]), top]
    knots = np.unique(np.maximum(np.concatenate(parts).round(12), _SHALLOWEST))
    columns = np.empty((modes, len(knots), 5))
    with threadpool_limits(1):  # the matrices are small, so that threads would only wait for each other
        for k, depth in enumerate(knots):
            at = np.array(depth)
            volume, surface = float(profile.volume(at)), float(profile.surface_radius(at))
            for n, mode in enumerate(slosh_modes(profile, float(depth), modes)):
                columns[n, k] = (
                    mode.kappa * float(_narrowing(profile, at)),
                    mode.mass * (1.0 / volume + 1.0 / (math.pi * surface**3)),
                    mode.bob,
                    mode.wave / surface,
                    mode.wall_loss / (1.0 + 1.0 / depth),
                )
    digits = 10.0 ** (_DIGITS - 1 - np.floor(np.log10(np.abs(columns) + 1e-300)))
    columns = np.round(columns * digits) / digits
    return knots, tuple(hermite(knots, rows, np.gradient(rows, knots, axis=0, edge_order=2)) for rows in columns)
