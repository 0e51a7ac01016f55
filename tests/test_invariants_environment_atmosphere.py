"""The air has hydrostatic equilibrium, the gas law and continuity, and the models keep within their limits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from maxq.control.kernel.records import pack
from maxq.control.kernel.tables import Pool
from maxq.sim.world.atmosphere import Atmosphere, air, air_table, us1976
from maxq.sim.world.thermosphere import upper_air

VACUUM, TABLE, CONSTANT = 0, 2, 3  # model of an atmosphere

GEOPOTENTIAL_RADIUS_m = 6356766.0
GAS_CONSTANT_Jpkg_K = 8314.32 / 28.9644

_pool = Pool()
STANDARD = pack([Atmosphere(table=_pool.add(upper_air()))])[0]
POOL = _pool.array()
NO_POOL = np.zeros(1)
EDGES_m = [GEOPOTENTIAL_RADIUS_m * h / (GEOPOTENTIAL_RADIUS_m - h) for h in (11e3, 20e3, 32e3, 47e3, 51e3, 71e3)]


@pytest.mark.parametrize("altitude", [-4e3, 500.0, 9e3, 15e3, 26e3, 40e3, 49e3, 60e3, 80e3])
def test_hydrostatic_equilibrium(altitude):
    """d(ln p)/dh = -g / (R T) with g proportional to 1/r^2; the module never computes this integral."""
    step = 1.0
    above, below = air(STANDARD, NO_POOL, altitude + step)[1], air(STANDARD, NO_POOL, altitude - step)[1]
    slope = (math.log(above) - math.log(below)) / (2 * step)
    g = 9.80665 * (GEOPOTENTIAL_RADIUS_m / (GEOPOTENTIAL_RADIUS_m + altitude)) ** 2
    temperature = air(STANDARD, NO_POOL, altitude)[2]
    assert slope == pytest.approx(-g / (GAS_CONSTANT_Jpkg_K * temperature), rel=1e-8)


@pytest.mark.parametrize("altitude", [105e3, 118e3, 140e3, 250e3, 450e3, 800e3])
def test_each_species_is_hydrostatic_where_nothing_mixes_or_flows(altitude):
    """In diffusive equilibrium, the weights of all species carry the sum of their pressures: dp/dh = -g rho.

    Thermal diffusion of helium, escaping hydrogen and the transport terms are excepted.
    """
    above, below = air(STANDARD, POOL, altitude + 50.0)[1], air(STANDARD, POOL, altitude - 50.0)[1]
    g = 9.80665 * (GEOPOTENTIAL_RADIUS_m / (GEOPOTENTIAL_RADIUS_m + altitude)) ** 2
    assert (above - below) / 100.0 == pytest.approx(-g * air(STANDARD, POOL, altitude)[0], rel=2e-2)


@pytest.mark.parametrize("altitude", [-9e3, 0.0, 12e3, 33e3, 80e3])
def test_gas_law_and_speed_of_sound(altitude):
    density, pressure, temperature, sound = air(STANDARD, NO_POOL, altitude)
    assert pressure == pytest.approx(density * GAS_CONSTANT_Jpkg_K * temperature, rel=1e-14)
    assert sound == pytest.approx(math.sqrt(1.4 * pressure / density), rel=1e-14)


@pytest.mark.parametrize("edge", [*EDGES_m, -5e3])
def test_continuous_at_the_edges_of_the_layers(edge):
    below, above = us1976(edge - 1e-6), us1976(edge + 1e-6)
    assert below == pytest.approx(above, rel=1e-9)


def test_the_two_parts_of_the_standard_meet_as_its_own_numbers_do():
    below, above = air(STANDARD, POOL, 86e3 - 1e-6), air(STANDARD, POOL, 86e3)
    assert above[:2] == pytest.approx(below[:2], rel=2e-5)
    assert below[2] - above[2] == pytest.approx(0.08, abs=5e-3)  # molecular-scale and kinetic temperature
    assert above[3] == pytest.approx(below[3], rel=1e-5)


def test_density_and_pressure_fall_monotonically_to_the_end_of_the_standard():
    altitudes = np.concatenate([np.arange(-5e3, 200e3, 50.0), np.arange(200e3, 1e6 + 1.0, 500.0)])
    columns = np.array([air(STANDARD, POOL, h) for h in altitudes])
    assert (np.diff(columns[:, :2], axis=0) < 0.0).all()
    assert (columns[:, 2] > 180.0).all()
    end, beyond = air(STANDARD, POOL, 1e6), air(STANDARD, POOL, 1e6 + 1e-3)
    assert end[0] == pytest.approx(3.561e-15, rel=5e-4)
    assert beyond == (0.0, 0.0, *end[2:])
    assert air(STANDARD, POOL, 1e9) == beyond


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
