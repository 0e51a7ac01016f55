"""Seconds that a person writes and whole nanoseconds, in which the flight keeps time."""

from __future__ import annotations

import math

NS_PER_S = 1_000_000_000
LONGEST_S = 9.0e9
"""About 285 years: more does not fit into 64 bits of nanoseconds."""


def is_whole_ns(seconds: float) -> bool:
    """Whether `seconds` is a whole number of nanoseconds, but for the rounding of the decimal it was written
    as.
    """
    ns = seconds * NS_PER_S
    return abs(seconds) <= LONGEST_S and abs(ns - round(ns)) <= 4.0 * math.ulp(ns)


def to_ns(seconds: float) -> int:
    """`seconds` in nanoseconds; ValueError unless that is a whole number."""
    if not is_whole_ns(seconds):
        raise ValueError(f"{seconds!r} s is not a whole number of nanoseconds")
    return round(seconds * NS_PER_S)


def period_ns(rate_hz: float) -> int:
    """Period of `rate_hz` in nanoseconds; ValueError unless that is a whole number."""
    if not is_whole_period(rate_hz):
        raise ValueError(f"the period of {rate_hz!r} Hz is not a whole number of nanoseconds")
    return round(NS_PER_S / rate_hz)


def is_whole_period(rate_hz: float) -> bool:
    """Whether the period of `rate_hz` is a whole number of nanoseconds."""
    ns = NS_PER_S / rate_hz
    return 1.0 <= ns <= LONGEST_S * NS_PER_S and abs(ns - round(ns)) <= 4.0 * math.ulp(ns)
