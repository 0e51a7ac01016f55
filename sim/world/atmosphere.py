"""The air at rest: density, pressure, temperature and speed of sound over geometric altitude.

The model is the US Standard Atmosphere 1976 (NOAA-S/T 76-1562), with its own constants (R* = 8314.32 N m/(kmol K), M =
28.9644 kg/kmol, gamma = 1.4, r0 = 6356.766 km):

- Up to 86 km, its closed formulas apply. Temperature is the molecular-scale temperature, which exceeds the kinetic
  temperature by up to 0.08 K between 80 and 86 km. Below sea level the equations of the first layer extend to -5 km,
  the lower end of the standard's tables. Below -5 km the values are constant.
- From 86 to 1000 km, cubics through the solution of its equations (`thermosphere.upper_air`) apply, with the kinetic
  temperature. At 86 km density and pressure jump by 1e-5. The standard contains no speed of sound above 86 km; here it
  is sqrt(gamma p / rho), so that a Mach number exists.
- Above 1000 km, where the standard ends, there is no air.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import NO_TABLE, Cubics, Method, TableRef, find_interval, fit, interpolate

VACUUM, US1976, TABLE, CONSTANT = 0, 1, 2, 3  # Atmosphere.model

GAS_CONSTANT_Jpkg_K = 8314.32 / 28.9644  # of air
HEAT_RATIO = 1.4
SEA_LEVEL_PRESSURE_Pa = 101325.0
SEA_LEVEL_TEMPERATURE_K = 288.15
SEA_LEVEL_DENSITY_kgpm3 = SEA_LEVEL_PRESSURE_Pa / (GAS_CONSTANT_Jpkg_K * SEA_LEVEL_TEMPERATURE_K)
GEOPOTENTIAL_RADIUS_m = 6356766.0
LOWEST_m = -5000.0  # geometric altitude
TOP_m = 86000.0  # geometric altitude of the top of the closed formulas

_G0_OVER_R_Kpm = 9.80665 / GAS_CONSTANT_Jpkg_K  # [K/m]; pressure falls by exp(-g0 dH / (R T))


def _layers() -> tuple[Array, Array, Array, Array]:
    """Return the bases of the standard's layers.

    The arrays are geopotential altitude [m], lapse rate [K/m], temperature [K] and pressure [Pa]. Temperature and
    pressure are computed from the other two, layer by layer, so that they are continuous.
    """
    base = np.array([0.0, 11e3, 20e3, 32e3, 47e3, 51e3, 71e3])
    lapse = np.array([-6.5e-3, 0.0, 1.0e-3, 2.8e-3, 0.0, -2.8e-3, -2.0e-3])
    temperature, pressure = np.empty(7), np.empty(7)
    t, p = SEA_LEVEL_TEMPERATURE_K, SEA_LEVEL_PRESSURE_Pa
    for i in range(7):
        temperature[i], pressure[i] = t, p
        if i < 6:
            rise = float(base[i + 1] - base[i])
            if lapse[i] == 0.0:
                p *= math.exp(-_G0_OVER_R_Kpm * rise / t)
            else:
                p *= (1.0 + lapse[i] * rise / t) ** (-_G0_OVER_R_Kpm / lapse[i])
                t += lapse[i] * rise
    return base, lapse, temperature, pressure


_base, _lapse, _temperature, _pressure = _layers()
_BASE_m = tuple(map(float, _base))
_LAPSE_Kpm = tuple(map(float, _lapse))
_TEMPERATURE_K = tuple(map(float, _temperature))
_PRESSURE_Pa = tuple(map(float, _pressure))
_INVERSE_TEMPERATURE = tuple(map(float, 1.0 / _temperature))
# The factor of dH in the exponential (isothermal layers), or the power of T / T_base (other layers).
_EXPONENT = tuple(
    -_G0_OVER_R_Kpm / lapse if lapse else -_G0_OVER_R_Kpm / t
    for lapse, t in zip(_LAPSE_Kpm, _TEMPERATURE_K, strict=True)
)
# Geometric altitudes between which the formula of a layer is valid.
_FLOOR_m = (LOWEST_m, *(GEOPOTENTIAL_RADIUS_m * h / (GEOPOTENTIAL_RADIUS_m - h) for h in _BASE_m[1:]))
_CEILING_m = (*_FLOOR_m[1:], TOP_m)


@dataclass(frozen=True)
class Atmosphere:
    """The parameter record of the atmosphere.

    `model`: VACUUM, US1976 (`table`: `thermosphere.upper_air`), TABLE (`table`: `air_table`), or CONSTANT (the three
    values). `density_factor` multiplies only the density of any model: it is a dispersion, and not consistent with the
    gas law.
    """

    model: int = US1976
    table: TableRef = NO_TABLE
    density_kgpm3: float = SEA_LEVEL_DENSITY_kgpm3
    pressure_Pa: float = SEA_LEVEL_PRESSURE_Pa
    temperature_K: float = SEA_LEVEL_TEMPERATURE_K
    density_factor: float = 1.0


def pressure_altitude(pressure_Pa: Array) -> Array:
    """Return the geometric altitudes (n,), m, of pressures (n,) in the standard atmosphere.

    Valid up to 86 km. nan gives nan.
    """
    i = np.clip(np.searchsorted(-_pressure, -pressure_Pa, side="right") - 1, 0, len(_pressure) - 1)
    lapse, fall = _lapse[i], pressure_Pa / _pressure[i]
    with np.errstate(divide="ignore", invalid="ignore"):
        linear = _temperature[i] * (fall ** (-lapse / _G0_OVER_R_Kpm) - 1.0) / lapse
    isothermal = -np.log(fall) * _temperature[i] / _G0_OVER_R_Kpm
    geopotential = _base[i] + np.where(lapse == 0.0, isothermal, linear)
    return np.asarray(GEOPOTENTIAL_RADIUS_m * geopotential / (GEOPOTENTIAL_RADIUS_m - geopotential))


def air_table(
    altitude_m: ArrayLike,
    density_kgpm3: ArrayLike,
    pressure_Pa: ArrayLike,
    temperature_K: ArrayLike,
    method: Method = "pchip",
) -> Cubics:
    """Return the table for `Atmosphere.table`: columns ln(density), ln(pressure), temperature over geometric altitude.

    The logarithms are interpolated because density and pressure fall almost exponentially. Rows every 2 km then agree
    with the standard atmosphere within 0.3 % midway between them, or 1 % if a row steps over the tropopause. No
    interpolated value can be negative. Raises ValueError for fewer than two rows, values that are not positive, or
    altitudes that do not increase.
    """
    columns = [np.atleast_1d(np.asarray(c, float)) for c in (density_kgpm3, pressure_Pa, temperature_K)]
    if len(columns[0]) < 2:
        raise ValueError("an atmosphere table needs at least two rows")
    if not all((c > 0.0).all() for c in columns):
        raise ValueError("density, pressure and temperature of an atmosphere table must be positive")
    density, pressure, temperature = columns
    return fit(altitude_m, np.stack([np.log(density), np.log(pressure), temperature], axis=1), method)


@kernel
def air(atmosphere: Atmosphere, pool: Array, altitude_m: float) -> tuple[float, float, float, float]:
    """Return (density [kg/m3], pressure [Pa], temperature [K], speed of sound [m/s]) at a geometric altitude [m].

    Temperature and speed of sound are positive everywhere, so that a Mach number always exists; a vacuum has those of
    sea level. Below a table, the values of its first row apply; above it, the air is isothermal.
    """
    if atmosphere.model == US1976:
        if altitude_m >= TOP_m:
            density, pressure, temperature, sound = _upper_air(pool, atmosphere.table, altitude_m)
            return atmosphere.density_factor * density, pressure, temperature, sound
        pressure, temperature = us1976(altitude_m)
        density = pressure / (GAS_CONSTANT_Jpkg_K * temperature)
    elif atmosphere.model == TABLE:
        density, pressure, temperature = _table_air(pool, atmosphere.table, altitude_m)
    elif atmosphere.model == CONSTANT:
        density, pressure, temperature = atmosphere.density_kgpm3, atmosphere.pressure_Pa, atmosphere.temperature_K
    else:
        density, pressure, temperature = 0.0, 0.0, SEA_LEVEL_TEMPERATURE_K
    return atmosphere.density_factor * density, pressure, temperature, speed_of_sound(temperature)


@kernel
def speed_of_sound(temperature_K: float) -> float:
    """Return the speed of sound in air, m/s."""
    return math.sqrt(HEAT_RATIO * GAS_CONSTANT_Jpkg_K * temperature_K)


@kernel
def us1976(altitude_m: float) -> tuple[float, float]:
    """Return (pressure [Pa], temperature [K]) of the standard below 86 km.

    A call evaluates one power or one exponential.
    """
    h = max(altitude_m, LOWEST_m)
    geopotential = GEOPOTENTIAL_RADIUS_m * h / (GEOPOTENTIAL_RADIUS_m + h)
    i = _layer(geopotential)
    rise = geopotential - _BASE_m[i]
    if _LAPSE_Kpm[i] == 0.0:
        return _PRESSURE_Pa[i] * math.exp(_EXPONENT[i] * rise), _TEMPERATURE_K[i]
    temperature = _TEMPERATURE_K[i] + _LAPSE_Kpm[i] * rise
    return _PRESSURE_Pa[i] * (temperature * _INVERSE_TEMPERATURE[i]) ** _EXPONENT[i], temperature


@kernel
def _layer(geopotential_m: float) -> int:
    i = 0
    while i < 6 and geopotential_m >= _BASE_m[i + 1]:
        i += 1
    return i


@kernel
def us1976_about(altitude_m: float, temperature_K: float) -> tuple[float, float, float, float, float]:
    """Return the arguments of `us1976_nearby` at an altitude with this temperature from `us1976`.

    These are geopotential metres per metre, the curvature of this relation [1/m], the lapse rate [K/m], and the
    distances [m] to the layer's ends, down (negative) and up.
    """
    h = max(altitude_m, LOWEST_m)
    inverse = 1.0 / (GEOPOTENTIAL_RADIUS_m + h)
    i = _layer(GEOPOTENTIAL_RADIUS_m * h * inverse)
    scale = GEOPOTENTIAL_RADIUS_m * inverse
    return scale * scale, inverse, _LAPSE_Kpm[i], _FLOOR_m[i] - altitude_m, _CEILING_m[i] - altitude_m


@kernel
def us1976_nearby(
    pressure_Pa: float, inverse_temperature: float, lapse_Kpm: float, geopotential_rise_m: float
) -> tuple[float, float]:
    """Return the pressure [Pa] and the ratio of the temperatures after a rise within a layer.

    Valid for a rise of about ten geopotential metres. The power series of both formulas of the standard have the same
    terms: p'/p = -g0/(R T), T' = lapse. They are truncated before the fourth power, with a relative error of 3e-13 at
    10 m.
    """
    lapse = lapse_Kpm * inverse_temperature
    first = -_G0_OVER_R_Kpm * inverse_temperature
    second = 0.5 * first * (first - lapse)
    third = second * (first - 2.0 * lapse) * (1.0 / 3.0)
    d = geopotential_rise_m
    return pressure_Pa * (1.0 + d * (first + d * (second + d * third))), 1.0 + d * lapse


@kernel
def _upper_air(pool: Array, table: TableRef, altitude_m: float) -> tuple[float, float, float, float]:
    """Return (density, pressure, temperature, speed of sound) of the standard above 86 km.

    Density and pressure are zero above its end.
    """
    k = find_interval(pool, table, altitude_m)
    log_density = interpolate(pool, table, k, altitude_m, 0)
    log_pressure = interpolate(pool, table, k, altitude_m, 1)
    temperature = interpolate(pool, table, k, altitude_m, 2)
    sound = math.sqrt(HEAT_RATIO * math.exp(log_pressure - log_density))
    if altitude_m > pool[table.offset + table.n_breaks - 1]:
        return 0.0, 0.0, temperature, sound
    return math.exp(log_density), math.exp(log_pressure), temperature, sound


@kernel
def _table_air(pool: Array, table: TableRef, altitude_m: float) -> tuple[float, float, float]:
    """Return (density, pressure, temperature) of an `air_table`."""
    k = find_interval(pool, table, altitude_m)
    log_density = interpolate(pool, table, k, altitude_m, 0)
    log_pressure = interpolate(pool, table, k, altitude_m, 1)
    temperature = interpolate(pool, table, k, altitude_m, 2)
    top = pool[table.offset + table.n_breaks - 1]
    if altitude_m > top:
        # Geopotential difference: r0 h / (r0 + h) at both ends, on a common denominator.
        rise = (altitude_m - top) / ((1.0 + altitude_m / GEOPOTENTIAL_RADIUS_m) * (1.0 + top / GEOPOTENTIAL_RADIUS_m))
        fall = _G0_OVER_R_Kpm * rise / temperature
        log_density -= fall
        log_pressure -= fall
    return math.exp(log_density), math.exp(log_pressure), temperature
