"""US Standard Atmosphere 1976 up to 71 km geopotential, for the point-mass fit."""

from __future__ import annotations

from math import exp, sqrt
from typing import NamedTuple

from maxq.tools.dev.ksr3.assumptions import EARTH_RADIUS_M, STANDARD_GRAVITY_MPS2

GAS_CONSTANT = 287.053  # J/(kg K)
# base geopotential altitude m, temperature K, pressure Pa, lapse rate K/m
LAYERS = (
    (0.0, 288.15, 101325.0, -0.0065),
    (11000.0, 216.65, 22632.06, 0.0),
    (20000.0, 216.65, 5474.889, 0.001),
    (32000.0, 228.65, 868.0187, 0.0028),
    (47000.0, 270.65, 110.9063, 0.0),
    (51000.0, 270.65, 66.93887, -0.0028),
    (71000.0, 214.65, 3.95642, -0.002),
)


class Air(NamedTuple):
    density_kgpm3: float
    pressure_Pa: float
    sound_speed_mps: float


def air_at(altitude_m: float) -> Air:
    """Still air at a geometric altitude (ground level below zero)."""
    h = max(altitude_m, 0.0)
    geopotential = EARTH_RADIUS_M * h / (EARTH_RADIUS_M + h)
    base, base_temperature, base_pressure, lapse = next(layer for layer in reversed(LAYERS) if geopotential >= layer[0])
    rise = geopotential - base
    temperature = base_temperature + lapse * rise
    if lapse:
        exponent = STANDARD_GRAVITY_MPS2 / (GAS_CONSTANT * lapse)
        pressure = base_pressure * (base_temperature / temperature) ** exponent
    else:
        pressure = base_pressure * exp(-STANDARD_GRAVITY_MPS2 * rise / (GAS_CONSTANT * temperature))
    return Air(pressure / (GAS_CONSTANT * temperature), pressure, sqrt(1.4 * GAS_CONSTANT * temperature))
