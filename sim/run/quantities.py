"""The text of quantities for readers: engineering units, four significant digits, the utilisation of a limit."""

from __future__ import annotations

import math

_LARGER = {"Pa": "kPa", "Pa deg": "kPa deg", "N": "kN", "N m": "kN m"}  # from 1000 on
_LEAST_KM, _MOST_MM = 1e4, 0.1
_PROPELLANTS = {"lox": "LOX", "rp1": "RP-1", "jeta1": "Jet A-1", "lh2": "LH2"}
_EXACT = 9  # largest number of digits


def engineering_unit(unit: str, size: float) -> tuple[str, float]:
    """Return the engineering unit for a value of this size, and the factor to it, such as "kPa" and 0.001."""
    size = abs(size)
    if unit in _LARGER and 1e3 <= size < math.inf:
        return _LARGER[unit], 1e-3
    if unit == "m" and _LEAST_KM <= size < math.inf:
        return "km", 1e-3
    if unit == "m" and 1e-6 <= size < _MOST_MM:
        return "mm", 1e3
    return unit, 1.0


def number_text(value: float, digits: int = 4) -> str:
    """Return a value with `digits` significant digits; "0" for values below 1e-6, and "-" for nan."""
    if not math.isfinite(value):
        return "-" if math.isnan(value) else f"{value}"
    if abs(value) < 1e-6:
        return "0"
    text = f"{value:#.{digits}g}".rstrip(".")
    if "e" not in text:
        return text
    return f"{float(text):.0f}" if 1.0 <= abs(value) < 1e7 else f"{value:.{digits}g}"


def quantity(value: float, unit: str, digits: int = 4) -> tuple[str, str]:
    """Return a value and its engineering unit, such as ("109.1", "kPa"); the unit of a plain number is empty."""
    shown, factor = engineering_unit(unit, value)
    return number_text(factor * value, digits), unit_text(shown)


def quantity_text(value: float, unit: str, digits: int = 4) -> str:
    """Return a value with its engineering unit, such as "109.1 kPa"."""
    return " ".join(quantity(value, unit, digits)).rstrip()


def unit_text(unit: str) -> str:
    """Return the text of a unit, which is empty for "1"."""
    return "" if unit == "1" else unit


def against_limit(value: float, kind: str, bound: float, unit: str) -> tuple[str, str, str]:
    """Return a value, its limit, and the engineering unit of both, such as ("2.725", "4", "deg").

    `kind` is "limit" or "minimum". The value has four digits, or more if the rounded value would otherwise be on the
    wrong side of the limit.
    """
    shown, factor = engineering_unit(unit, bound or value)
    limit, met = f"{factor * bound:.6g}", meets(value, kind, bound)
    text = number_text(factor * value)
    for digits in range(5, _EXACT + 1):
        if not math.isfinite(value) or meets(float(text), kind, float(limit)) == met:
            break
        text = number_text(factor * value, digits)
    return text, limit, unit_text(shown)


def meets(value: float, kind: str, bound: float) -> bool:
    """Return True if a value meets a bound of this kind, "limit" or "minimum"; nan meets no bound."""
    return value <= bound if kind == "limit" else value >= bound


def propellant_text(tank: str) -> str:
    """Return the propellant that a tank's name denotes, such as "LOX" for lox; other names are unchanged."""
    return _PROPELLANTS.get(tank, tank)


def sign_of(kind: str) -> str:
    """Return the sign between a value and its bound: "<=" for a limit, ">=" for a minimum."""
    return "<=" if kind == "limit" else ">="


def utilisation(value: float, kind: str, bound: float) -> float:
    """Return the utilisation of a bound, which is above 1 if the bound is missed.

    It is value / limit, or minimum / value, and nan for a value of nan or a bound of 0 or less.
    """
    if not bound > 0.0 or math.isnan(value):
        return math.nan
    if kind == "limit":
        return max(value, 0.0) / bound
    return bound / value if value > 0.0 else math.inf


def share_text(share: float) -> str:
    """Return a share in percent, such as "68 %", with more digits near 100 %; empty if it is not finite."""
    if not math.isfinite(share):
        return ""
    percent = 100.0 * share
    for digits in range(3):
        text = f"{percent:.{digits}f}"
        if float(text) != 100.0 or percent == 100.0:
            return f"{text} %"
    return "over 100 %" if percent > 100.0 else "99.99 %"


def by_utilisation(met: bool, share: float) -> tuple[bool, float]:
    """Return the sort key of a requirement: missed requirements first, then in order of decreasing utilisation."""
    return met, -share if math.isfinite(share) else math.inf if met else -math.inf
