"""US Standard Atmosphere 1976 as published, and as five tools of the NESC check cases have it."""

from __future__ import annotations

import numpy as np
import pytest

from maxq.control.kernel.records import pack
from maxq.sim.world.atmosphere import Atmosphere, GEOPOTENTIAL_RADIUS_m, air

STANDARD = pack([Atmosphere()])[0]
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


# the isothermal extension: density of table I and how far off the module says it is
@pytest.mark.parametrize(
    ("altitude", "density", "ratio"),
    [(86e3, 6.958e-6, 1.0), (91e3, 2.860e-6, 1.0), (100e3, 5.604e-7, 1.034), (120e3, 2.222e-8, 0.763)],
)
def test_above_the_equations(altitude, density, ratio):
    assert air(STANDARD, NO_POOL, altitude)[0] / density == pytest.approx(ratio, abs=1e-3)


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
    """Tolerances: the spread of SIM 4 and SIM 5, whose pounds and slugs differ by some millionths."""
    altitude, density, pressure, temperature, sound = row
    got = air(STANDARD, NO_POOL, altitude * FT)
    assert got[2] * 1.8 == pytest.approx(temperature, rel=1e-11)
    assert got[3] / FT == pytest.approx(sound, rel=1e-6)
    assert got[1] / (LBF / FT**2) == pytest.approx(pressure, rel=1.1e-5)
    assert got[0] / (SLUG / FT**3) == pytest.approx(density, rel=2e-6)
