"""Units of measured data: their spellings in the headings of files, and their conversion to the units of log channels.

to_unit("ft", "m")            # (0.3048, 0.0): value in m = factor * value in ft + offset
"""

from __future__ import annotations

import math
from functools import cache

from maxq.sim.world.constants import STANDARD_GRAVITY_mps2

Conversion = tuple[float, float]
"""Factor and offset of a conversion: new value = factor * value + offset."""

_FOOT_m, _POUND_kg = 0.3048, 0.45359237
_DIMENSIONS: dict[str, dict[str, float | Conversion]] = {
    "time": {
        "s": 1.0,
        "sec": 1.0,
        "seconds": 1.0,
        "ms": 1e-3,
        "us": 1e-6,
        "µs": 1e-6,
        "ns": 1e-9,
        "min": 60.0,
        "h": 3600.0,
    },
    "length": {
        "m": 1.0,
        "km": 1e3,
        "cm": 1e-2,
        "mm": 1e-3,
        "ft": _FOOT_m,
        "in": _FOOT_m / 12.0,
        "yd": 3.0 * _FOOT_m,
        "mi": 5280.0 * _FOOT_m,
        "nmi": 1852.0,
    },
    "speed": {
        "m/s": 1.0,
        "km/s": 1e3,
        "km/h": 1.0 / 3.6,
        "ft/s": _FOOT_m,
        "mph": 5280.0 * _FOOT_m / 3600.0,
        "kt": 1852.0 / 3600.0,
        "knots": 1852.0 / 3600.0,
    },
    "acceleration": {"m/s2": 1.0, "g": STANDARD_GRAVITY_mps2, "ft/s2": _FOOT_m},
    "angle": {"deg": 1.0, "°": 1.0, "degrees": 1.0, "rad": math.degrees(1.0)},
    "angular rate": {"deg/s": 1.0, "°/s": 1.0, "rad/s": math.degrees(1.0), "r/s": 360.0, "rpm": 6.0},
    "angular acceleration": {"deg/s2": 1.0, "°/s2": 1.0, "rad/s2": math.degrees(1.0)},
    "rate": {"1/s": 1.0, "hz": 1.0},
    "pressure": {
        "pa": 1.0,
        "hpa": 1e2,
        "kpa": 1e3,
        "MPa": 1e6,
        "mbar": 1e2,
        "bar": 1e5,
        "atm": 101325.0,
        "psi": _POUND_kg * STANDARD_GRAVITY_mps2 / (_FOOT_m / 12.0) ** 2,
        "inhg": 3386.389,
        "mmhg": 133.322387415,
    },
    "pressure times angle": {"pa deg": 1.0, "pa rad": math.degrees(1.0), "kpa deg": 1e3},
    "force": {"n": 1.0, "kn": 1e3, "MN": 1e6, "lbf": _POUND_kg * STANDARD_GRAVITY_mps2, "kgf": STANDARD_GRAVITY_mps2},
    "moment": {"n m": 1.0, "kn m": 1e3, "ft lbf": _FOOT_m * _POUND_kg * STANDARD_GRAVITY_mps2},
    "mass": {"kg": 1.0, "g": 1e-3, "t": 1e3, "lb": _POUND_kg, "lbm": _POUND_kg, "oz": _POUND_kg / 16.0},
    "mass flow": {"kg/s": 1.0, "g/s": 1e-3, "lb/s": _POUND_kg},
    "moment of inertia": {"kg m2": 1.0, "lb ft2": _POUND_kg * _FOOT_m**2},
    "density": {"kg/m3": 1.0, "g/cm3": 1e3},
    "temperature": {
        "k": 1.0,
        "°c": (1.0, 273.15),
        "c": (1.0, 273.15),
        "degc": (1.0, 273.15),
        "°f": (5.0 / 9.0, 459.67 * 5.0 / 9.0),
    },
    "flux density": {"nt": 1.0, "ut": 1e3, "µt": 1e3, "gauss": 1e5},
    "number": {"1": 1.0, "": 1.0, "-": 1.0, "%": 0.01},
}
"""Units by dimension, each with its value in the first unit. A unit in capitals differs from its lower case."""
_SIGNS = {"²": "2", "³": "3", "^": "", "·": " ", "*": " ", "μ": "µ", "\u200b": "", "⁻¹": "-1"}


def _spelled(unit: str) -> str:
    """Return a unit with one spelling of powers and products, in lower case unless its capitals have a meaning."""
    for sign, plain in _SIGNS.items():
        unit = unit.replace(sign, plain)
    unit = " ".join(unit.split())
    return unit if any(unit in units for units in _DIMENSIONS.values()) else unit.lower()


def to_unit(unit: str, wanted: str) -> Conversion | None:
    """Return the conversion of a unit in any known spelling to the unit of a log channel, or None if there is none."""
    given, target = _spelled(unit), _spelled(wanted)
    for units in _DIMENSIONS.values():
        if given in units and target in units:
            factor, offset = _pair(units[given])
            per, zero = _pair(units[target])
            return factor / per, (offset - zero) / per
    return (1.0, 0.0) if given == target else None


def units_like(wanted: str) -> list[str]:
    """Return the spellings of the units that can be converted to the unit of a log channel."""
    target = _spelled(wanted)
    return next(([u for u in units if u] for units in _DIMENSIONS.values() if target in units), [wanted])


@cache
def name_suffixes() -> dict[str, str]:
    """Return the units by the suffix of a name: "mps" -> "m/s", "ft" -> "ft"."""
    known = [unit for units in _DIMENSIONS.values() for unit in units if unit not in ("", "-", "1", "%")]
    return {unit.replace("/", "p").replace(" ", "").lower(): unit for unit in reversed(known)}


def _pair(value: float | Conversion) -> Conversion:
    return value if isinstance(value, tuple) else (value, 0.0)
