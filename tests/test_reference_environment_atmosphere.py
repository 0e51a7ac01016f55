"""The US Standard Atmosphere 1976 equals the published one, and that of five tools of the NESC check cases."""

from __future__ import annotations

import numpy as np
import pytest

from maxq.control.kernel.records import pack
from maxq.control.kernel.tables import Pool
from maxq.sim.world.atmosphere import Atmosphere, air
from maxq.sim.world.thermosphere import number_densities, upper_air

GEOPOTENTIAL_RADIUS_m = 6356766.0

_pool = Pool()
STANDARD = pack([Atmosphere(table=_pool.add(upper_air()))])[0]
POOL = _pool.array()
NO_POOL = np.zeros(1)


def geometric(geopotential_m: float) -> float:
    return GEOPOTENTIAL_RADIUS_m * geopotential_m / (GEOPOTENTIAL_RADIUS_m - geopotential_m)


# NOAA-S/T 76-1562, table 4: bases of the layers (geopotential km, K, Pa)
BASES = [
    (0, 288.15, 101325.0),
    (11, 216.65, 22632.06),
    (20, 216.65, 5474.889),
    (32, 228.65, 868.0187),
    (47, 270.65, 110.9063),
    (51, 270.65, 66.93887),
    (71, 214.65, 3.956420),
]


@pytest.mark.parametrize(("km", "temperature", "pressure"), BASES)
def test_bases_of_the_layers(km, temperature, pressure):
    _, p, t, _ = air(STANDARD, NO_POOL, geometric(1e3 * km))
    assert t == pytest.approx(temperature, rel=1e-12)
    assert p == pytest.approx(pressure, rel=1e-6)


# table I: geometric altitude m; K, Pa, kg/m3, m/s as printed (so: half a unit of the last digit)
TABLE = [
    (-5000, 320.676, 1.7776e5, 1.9311, 359.0),
    (0, 288.150, 1.01325e5, 1.2250, 340.29),
    (1000, 281.651, 8.9876e4, 1.1117, 336.43),
    (5000, 255.676, 5.4048e4, 7.3643e-1, 320.55),
    (10000, 223.252, 2.6500e4, 4.1351e-1, 299.53),
    (15000, 216.650, 1.2112e4, 1.9476e-1, 295.07),
    (25000, 221.552, 2.5492e3, 4.0084e-2, 298.39),
    (40000, 250.350, 2.8714e2, 3.9957e-3, 317.19),
    (50000, 270.650, 7.9779e1, 1.0269e-3, 329.80),
    (60000, 247.021, 2.1959e1, 3.0968e-4, 315.07),
    (70000, 219.585, 5.2209, 8.2829e-5, 297.06),
    (80000, 198.639, 1.0525, 1.8458e-5, 282.54),
]


@pytest.mark.parametrize("row", TABLE)
def test_published_table(row):
    altitude, temperature, pressure, density, sound = row
    got = air(STANDARD, NO_POOL, altitude)
    assert got[2] == pytest.approx(temperature, abs=6e-4)
    assert got[1] == pytest.approx(pressure, rel=5e-5)
    assert got[0] == pytest.approx(density, rel=5e-5)
    assert got[3] == pytest.approx(sound, abs=2e-2)


# table I above 86 km: altitude km; kinetic temperature K, Pa, kg/m3 as printed
THERMOSPHERE = [
    (86, 186.87, 3.7338e-1, 6.958e-6),
    (90, 186.87, 1.8359e-1, 3.416e-6),
    (100, 195.08, 3.2011e-2, 5.604e-7),
    (110, 240.00, 7.1042e-3, 9.708e-8),
    (120, 360.00, 2.5382e-3, 2.222e-8),
    (130, 469.27, 1.2505e-3, 8.152e-9),
    (140, 559.63, 7.2028e-4, 3.831e-9),
    (150, 634.39, 4.5422e-4, 2.076e-9),
    (160, 696.29, 3.0395e-4, 1.233e-9),
    (180, 790.07, 1.5271e-4, 5.194e-10),
    (200, 854.56, 8.4736e-5, 2.541e-10),
    (250, 941.33, 2.4767e-5, 6.073e-11),
    (300, 976.01, 8.7704e-6, 1.916e-11),
    (400, 995.83, 1.4518e-6, 2.803e-12),
    (500, 999.24, 3.0236e-7, 5.215e-13),
    (600, 999.85, 8.2130e-8, 1.137e-13),
    (700, 999.97, 3.1908e-8, 3.070e-14),
    (800, 999.99, 1.7036e-8, 1.136e-14),
    (900, 1000.00, 1.0873e-8, 5.759e-15),
    (1000, 1000.00, 7.5138e-9, 3.561e-15),
]


@pytest.mark.parametrize("row", THERMOSPHERE)
def test_published_table_above_86_km(row):
    """Values agree within a unit of the last printed digit, due to rounding and the standard's own integration."""
    km, temperature, pressure, density = row
    got = air(STANDARD, POOL, 1e3 * km)
    assert got[2] == pytest.approx(temperature, abs=1e-2)
    assert got[1] == pytest.approx(pressure, rel=1e-4)
    assert got[0] == pytest.approx(density, rel=5e-4)


# table VIII: altitude km; number densities of N2, O, O2, Ar, He, H, 1/m3 as printed
NUMBERS = [
    (100, 9.210e18, 4.298e17, 2.151e18, 9.501e16, 1.133e14, 0.0),
    (200, 2.925e15, 4.050e15, 1.918e14, 1.938e12, 1.310e13, 1.630e11),
    (500, 2.592e11, 1.836e13, 4.607e9, 3.445e6, 3.215e12, 8.000e10),
    (1000, 4.626e5, 9.562e9, 1.251e3, 2.188e-2, 4.850e11, 4.967e10),
]


@pytest.mark.parametrize("row", NUMBERS)
def test_published_number_densities(row):
    altitudes = np.arange(86e3, 1e6 + 50.0, 50.0)
    at = int(np.searchsorted(altitudes, 1e3 * row[0]))
    for species, published in zip(number_densities(altitudes)[0], row[1:], strict=True):
        assert species[at] == pytest.approx(published, rel=1e-3)


SLUG, FT, LBF = 14.593902937206364, 0.3048, 4.4482216152605
# NESC cases 06 and 09, SIM 4: altitude ft, density slug/ft3, pressure lbf/ft2, temperature degR, sound ft/s
NESC = [
    (30000.0, 8.90685451211e-4, 629.673709538, 411.838873082, 994.849493459),
    (23727.1674789, 0.00111491706795, 830.897621838, 434.151280679, 1021.44328557),
    (10423.9541769, 0.0017323055177, 1431.85239088, 481.515082241, 1075.71856079),
    (0.0, 0.00237689282456, 2116.23841715, 518.67, 1116.45000305),
]


@pytest.mark.parametrize("row", NESC)
def test_nesc_air(row):
    """The tolerances are the spread of SIM 4 and SIM 5, whose pounds and slugs differ by some millionths."""
    altitude, density, pressure, temperature, sound = row
    got = air(STANDARD, NO_POOL, altitude * FT)
    assert got[2] * 1.8 == pytest.approx(temperature, rel=1e-11)
    assert got[3] / FT == pytest.approx(sound, rel=1e-6)
    assert got[1] / (LBF / FT**2) == pytest.approx(pressure, rel=1.1e-5)
    assert got[0] / (SLUG / FT**3) == pytest.approx(density, rel=2e-6)
