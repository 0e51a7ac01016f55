"""Slosh modes of tanks from their shape equal closed forms, published numbers and a second method.

| case | against |
|---|---|
| upright cylinder: length, mass, bob, wave, damping of the wall; two modes, four depths | closed forms of NASA SP-106 |
| sphere: eigenvalues of the half-full one | 1.56016, 5.27555, 8.50444 (McIver, J. Fluid Mech. 201, 1989) |
| hemisphere by an expansion in solid harmonics, least squares on the wall | eigenvalue and mass |
| sphere: hinge | its centre, at every depth and of every mode: pressure on a sphere has no moment about it |
| nearly empty bowl, nearly full sphere | kappa a = 1, all liquid sloshes; kappa r = 2.7547, the ice-fishing problem |
| all shapes, all depths | sloshing mass within the liquid, zero when empty and full |
| interpolation over the depth | solutions between the knots |
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import lpmv
from threadpoolctl import threadpool_limits

from maxq.sim.vehicle.slosh.packing import WAVE_PER_SWING, XI
from maxq.sim.vehicle.slosh.section import Profile
from maxq.sim.vehicle.slosh.shapes import MEASURED_OVER_LAMINAR, modes_over, slosh_modes

SPHERE = Profile(1.0, 0.0, 1.0)


@pytest.mark.parametrize("depth", [0.3, 1.0, 2.5, 4.5])
def test_cylinder_has_its_closed_forms(depth: float) -> None:
    for n, (mode, xi) in enumerate(zip(slosh_modes(Profile(0.0, 9.0, 0.0), depth, 2), XI, strict=True)):
        assert mode.kappa == pytest.approx(xi * math.tanh(xi * depth), rel=2e-6)
        assert mode.mass == pytest.approx(2.0 * math.pi * math.tanh(xi * depth) / (xi * (xi * xi - 1.0)), rel=2e-5)
        assert mode.bob == pytest.approx(2.0 / xi * math.tanh(0.5 * xi * depth), rel=1e-4)
        assert mode.wave == pytest.approx(WAVE_PER_SWING[n], rel=1e-4)
    assert WAVE_PER_SWING[0] == pytest.approx(2.0 / (XI[0] ** 2 - 1.0))


def test_damping_of_the_wall_of_a_deep_cylinder() -> None:
    """The damping is that of Case & Parkinson's laminar layer, and the measured 0.79 sqrt(nu / sqrt(a R^3))."""
    mode, radius, nu, load = slosh_modes(Profile(0.0, 9.0, 0.0), 4.0, 1)[0], 0.7, 2e-6, 15.0
    assert mode.wall_loss == pytest.approx((XI[0] ** 2 + 1.0) / (XI[0] ** 2 - 1.0), rel=1e-3)
    zeta = mode.viscous(radius, nu) * load**-0.25
    assert zeta == pytest.approx(0.79 * math.sqrt(nu / math.sqrt(load * radius**3)), rel=5e-3)
    omega = math.sqrt(XI[0] * load / radius)
    laminar = math.sqrt(nu / (8.0 * omega)) * (XI[0] ** 2 + 1.0) / (XI[0] ** 2 - 1.0) / radius
    assert zeta == pytest.approx(MEASURED_OVER_LAMINAR * laminar, rel=1e-3)


def test_half_full_sphere_has_the_published_eigenvalues() -> None:
    found = [mode.kappa for mode in slosh_modes(SPHERE, 1.0, 3, radial=10, vertical=14)]
    np.testing.assert_allclose(found, [1.56016, 5.27555, 8.50444], atol=1.5e-5)


def test_hemisphere_by_solid_harmonics() -> None:
    """Each rho^n P_n^1 cos(theta) satisfies Laplace's equation; least squares fit the wall and the surface.

    The eigenvalue minimises the smallest singular value of both conditions together.
    """
    terms = np.arange(1, 31)
    polar = np.linspace(0.5 * math.pi, math.pi, 241)[1:-1]  # of the wall, from the surface to the bottom
    out = np.linspace(0.0, 1.0, 242)[1:-1]
    on_wall = np.stack([n * lpmv(1, n, np.cos(polar)) for n in terms], axis=1) * np.sqrt(np.sin(polar))[:, None]
    at = np.stack([lpmv(1, n, np.zeros(1))[0] * out**n for n in terms], axis=1)
    # d/dz at z = 0: rho^(n-1) times d/d(cos) of P_n^1, which is (n + 1) P_(n-1)^1 there up to its sign
    up = np.stack([(n + 1) * lpmv(1, n - 1, np.zeros(1))[0] * out ** (n - 1) for n in terms], axis=1)
    scale = 1.0 / np.sqrt((on_wall**2).sum(axis=0) + (at**2).sum(axis=0))

    def misfit(kappa: float) -> float:
        rows = np.concatenate([on_wall, (up - kappa * at) * np.sqrt(out)[:, None]]) * scale
        inside = at * scale
        _, _, v = np.linalg.svd(rows, full_matrices=False)
        return float(np.linalg.norm(rows @ v[-1]) / np.linalg.norm(inside @ v[-1]))

    grid = np.linspace(1.55, 1.57, 41)
    with threadpool_limits(1):  # small matrices: threads only wait for each other
        best = float(grid[int(np.argmin([misfit(k) for k in grid]))])
    assert slosh_modes(SPHERE, 1.0, 1)[0].kappa == pytest.approx(best, abs=1e-3)


@pytest.mark.parametrize("depth", [0.1, 0.6, 1.0, 1.5, 1.9])
def test_pendulums_of_a_sphere_hang_in_its_centre(depth: float) -> None:
    for mode in slosh_modes(SPHERE, depth, 2):
        assert depth - mode.bob + 1.0 / mode.kappa == pytest.approx(1.0, abs=2e-6)


def test_empty_and_full_sphere() -> None:
    """Shallow liquid in a bowl has a lowest mode like a bob on a rod of the radius of curvature (Lamb's paraboloid).

    The half space with a round hole has 2.7547 (Henrici, Troesch & Wuytack, ZAMP 21, 1970).
    """
    shallow = slosh_modes(SPHERE, 0.002, 1)[0]
    assert shallow.kappa == pytest.approx(1.0, abs=1e-3)
    assert shallow.mass == pytest.approx(float(SPHERE.volume(np.array(0.002))), rel=2e-3)
    hole = [
        slosh_modes(SPHERE, d, 1, radial=12, vertical=18)[0].kappa * float(SPHERE.surface_radius(np.array(d)))
        for d in (1.9, 1.95)
    ]
    assert 0.9 * 2.7547 < hole[0] < hole[1] < 2.7547
    bowl = slosh_modes(Profile(2.0, 0.0, 2.0), 0.004, 1)[0]
    assert bowl.kappa == pytest.approx(2.0, rel=2e-3)  # radius of curvature R^2 / b


def test_sloshing_mass_never_exceeds_the_liquid_and_falls_to_zero() -> None:
    for profile in (SPHERE, Profile(0.5, 0.0, 0.5), Profile(2.0, 0.0, 2.0), Profile(0.7, 3.0, 0.7)):
        depths = np.linspace(0.0, profile.height, 200)
        first, second = modes_over(profile, depths, 2)
        volume = profile.volume(depths)
        assert (first.mass + second.mass <= volume * (1.0 + 1e-3) + 1e-12).all()
        assert first.mass[0] == first.mass[-1] == 0.0
        assert (np.diff(np.sign(np.diff(first.mass[1:]))) <= 0).sum() >= len(depths) - 6  # rises, then falls
        assert (first.length > 0.0).all()
        assert (first.length < 4.1).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "profile", [SPHERE, Profile(0.7, 3.0, 0.7), Profile(0.0, 4.0, 0.0)], ids=["sphere", "domes", "flat"]
)
def test_interpolation_over_the_depth(profile: Profile) -> None:
    top = 0.5 if profile.top else 0.0
    depths = np.linspace(0.3, profile.height - top * profile.top - 0.02, 9) + 0.0123
    between = modes_over(profile, depths, 1)[0]
    for k, depth in enumerate(depths):
        mode = slosh_modes(profile, float(depth), 1, radial=9, vertical=20)[0]
        wanted = (1.0 / mode.kappa, mode.mass, mode.bob, mode.wave)
        np.testing.assert_allclose([column[k] for column in between[:4]], wanted, rtol=4e-3)


def test_volume_and_depth_are_inverse() -> None:
    for profile in (SPHERE, Profile(0.7, 3.0, 0.4), Profile(0.0, 2.0, 0.0)):
        depths = np.linspace(0.0, profile.height, 50)
        np.testing.assert_allclose(profile.depth(profile.volume(depths)), depths, atol=1e-7)
    assert float(SPHERE.volume(np.array(2.0))) == pytest.approx(4.0 / 3.0 * math.pi)
    assert float(SPHERE.volume(np.array(0.5))) == pytest.approx(math.pi * 0.25 * (1.0 - 0.5 / 3.0))
