"""What must hold for the air: hydrostatic equilibrium, gas law, continuity, the models and their limits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from maxq.control.kernel.records import pack
from maxq.control.kernel.tables import Pool
from maxq.sim.world.atmosphere import (
    CONSTANT,
    TABLE,
    VACUUM,
    Atmosphere,
    GAS_CONSTANT_Jpkg_K,
    GEOPOTENTIAL_RADIUS_m,
    air,
    air_table,
    us1976,
)

STANDARD = pack([Atmosphere()])[0]
NO_POOL = np.zeros(1)
EDGES_m = [GEOPOTENTIAL_RADIUS_m * h / (GEOPOTENTIAL_RADIUS_m - h) for h in (11e3, 20e3, 32e3, 47e3, 51e3, 71e3)]


@pytest.mark.parametrize("altitude", [-4e3, 500.0, 9e3, 15e3, 26e3, 40e3, 49e3, 60e3, 80e3, 95e3, 300e3])
def test_hydrostatic_equilibrium(altitude):
    """d(ln p)/dh = -g / (R T) with g falling as 1/r^2: an integral the module never forms."""
    step = 1.0
    above, below = air(STANDARD, NO_POOL, altitude + step)[1], air(STANDARD, NO_POOL, altitude - step)[1]
    slope = (math.log(above) - math.log(below)) / (2 * step)
    g = 9.80665 * (GEOPOTENTIAL_RADIUS_m / (GEOPOTENTIAL_RADIUS_m + altitude)) ** 2
    temperature = air(STANDARD, NO_POOL, altitude)[2]
    assert slope == pytest.approx(-g / (GAS_CONSTANT_Jpkg_K * temperature), rel=1e-8)


@pytest.mark.parametrize("altitude", [-9e3, 0.0, 12e3, 33e3, 90e3])
def test_gas_law_and_speed_of_sound(altitude):
    density, pressure, temperature, sound = air(STANDARD, NO_POOL, altitude)
    assert pressure == pytest.approx(density * GAS_CONSTANT_Jpkg_K * temperature, rel=1e-14)
    assert sound == pytest.approx(math.sqrt(1.4 * pressure / density), rel=1e-14)


@pytest.mark.parametrize("edge", [*EDGES_m, 86e3, -5e3])
def test_continuous_at_the_edges_of_the_layers(edge):
    below, above = us1976(edge - 1e-6), us1976(edge + 1e-6)
    assert below == pytest.approx(above, rel=1e-9)


def test_density_and_pressure_fall_monotonically_to_zero():
    altitudes = np.concatenate([np.arange(-5e3, 200e3, 50.0), np.geomspace(200e3, 1e9, 200)])
    columns = np.array([air(STANDARD, NO_POOL, h) for h in altitudes])
    assert (np.diff(columns[:, :2], axis=0) <= 0.0).all()
    assert (np.diff(columns[altitudes < 1e6, :2], axis=0) < 0.0).all()
    assert columns[-1, 0] < 1e-300
    assert (columns[:, 2] > 180.0).all()


def test_held_below_five_kilometres_under_the_sea():
    assert air(STANDARD, NO_POOL, -6e3) == air(STANDARD, NO_POOL, -5e3)
    assert air(STANDARD, NO_POOL, -6.4e6) == air(STANDARD, NO_POOL, -5e3)


def test_vacuum_still_has_a_mach_number():
    density, pressure, temperature, sound = air(pack([Atmosphere(VACUUM)])[0], NO_POOL, 1e3)
    assert (density, pressure, temperature) == (0.0, 0.0, 288.15)
    assert sound == pytest.approx(340.294, abs=1e-3)


def test_constant_air_ignores_altitude():
    row = pack([Atmosphere(CONSTANT, density_kgpm3=1.4e-12, pressure_Pa=2.0, temperature_K=250.0)])[0]
    assert air(row, NO_POOL, 0.0) == air(row, NO_POOL, 4e5)
    assert air(row, NO_POOL, 0.0)[:3] == (1.4e-12, 2.0, 250.0)


def test_density_factor_multiplies_density_only():
    dispersed = air(pack([Atmosphere(density_factor=1.1)])[0], NO_POOL, 12e3)
    nominal = air(STANDARD, NO_POOL, 12e3)
    assert dispersed[0] == pytest.approx(1.1 * nominal[0], rel=1e-15)
    assert dispersed[1:] == nominal[1:]


def table_of(altitudes):
    rows = np.array([air(STANDARD, NO_POOL, h) for h in altitudes])
    pool = Pool()
    ref = pool.add(air_table(altitudes, rows[:, 0], rows[:, 1], rows[:, 2]))
    return pack([Atmosphere(TABLE, table=ref)])[0], pool.array()


def test_table_of_the_standard_gives_the_standard_back():
    row, pool = table_of(np.arange(0.0, 60e3 + 1, 2e3))
    for altitude in np.arange(0.0, 60e3, 2e3):
        assert air(row, pool, altitude) == pytest.approx(air(STANDARD, NO_POOL, altitude), rel=1e-12)
    for altitude in np.arange(1e3, 60e3, 2e3):
        # rows at 10 and 12 km cannot know the tropopause between them; the other cells hold what is promised
        bound = 1.2e-2 if altitude == 11e3 else 3e-3
        assert air(row, pool, altitude)[:2] == pytest.approx(air(STANDARD, NO_POOL, altitude)[:2], rel=bound)


def test_table_continues_isothermally_above_and_holds_below():
    row, pool = table_of([12e3, 14e3, 15e3])  # all isothermal: the extension must be the standard itself
    assert air(row, pool, 15e3 + 1e-6) == pytest.approx(air(row, pool, 15e3 - 1e-6), rel=1e-8)
    assert air(row, pool, 19e3) == pytest.approx(air(STANDARD, NO_POOL, 19e3), rel=1e-12)
    assert air(row, pool, 3e3) == air(row, pool, 12e3)


@pytest.mark.parametrize("columns", [([0.0], [1.0], [1.0], [1.0]), ([0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [1.0, 1.0])])
def test_impossible_tables_are_refused(columns):
    with pytest.raises(ValueError, match="atmosphere table"):
        air_table(*columns)
