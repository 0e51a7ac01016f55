"""Common parts of all sections of a scenario: strictness, kinds of numbers with their bounds, time in whole ns."""

from __future__ import annotations

import math
import re
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)

from maxq.sim.input.errors import refuse
from maxq.sim.input.ranges import LONGEST_S, first_beyond, range_of

NS_PER_S = 1_000_000_000
_LONGEST_NAME, _LONGEST_TEXT = 200, 20_000
_ACTS = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Control characters except tabs and line ends, and characters that change the direction of writing."""


def is_whole_ns(seconds: float) -> bool:
    """Return True if `seconds` is a whole number of nanoseconds, apart from the rounding of its decimal notation."""
    ns = seconds * NS_PER_S
    return abs(seconds) <= LONGEST_S and abs(ns - round(ns)) <= 4.0 * math.ulp(ns)


def to_ns(seconds: float) -> int:
    """Return `seconds` in nanoseconds. Raises ValueError unless that is a whole number."""
    if not is_whole_ns(seconds):
        raise ValueError(f"{seconds!r} s is not a whole number of nanoseconds")
    return round(seconds * NS_PER_S)


def period_ns(rate_hz: float) -> int:
    """Return the period of `rate_hz` in nanoseconds. Raises ValueError unless that is a whole number."""
    if not is_whole_period(rate_hz):
        raise ValueError(f"the period of {rate_hz!r} Hz is not a whole number of nanoseconds")
    return round(NS_PER_S / rate_hz)


def is_whole_period(rate_hz: float) -> bool:
    """Return True if the period of `rate_hz` is a whole number of nanoseconds."""
    ns = NS_PER_S / rate_hz
    return 1.0 <= ns <= LONGEST_S * NS_PER_S and abs(ns - round(ns)) <= 4.0 * math.ulp(ns)


TABLE_FORM, LIST_FORM = "<table>", "<list>"
"""The tags of a key whose value is a table or a list of tables; they are not part of a key path."""


class Section(BaseModel):
    """A table of a TOML file, immutable.

    It rejects unknown keys, numbers as text, NaN, infinity, values outside the range of a key (ranges.py), and texts
    that would control a terminal.
    """

    model_config = ConfigDict(defer_build=True, strict=True, extra="forbid", frozen=True, allow_inf_nan=False)
    renamed: ClassVar[dict[str, str]] = {}
    """The current names of keys by their earlier names; "" for an obsolete key."""
    earlier: ClassVar[dict[str, str]] = {}
    """The default values of the previous version, for keys whose current default differs."""

    @field_validator("*")
    @classmethod
    def _can_be_meant(cls, value: Any, info: ValidationInfo) -> Any:
        kind = type(value)
        if kind in (float, int, tuple) and (found := first_beyond(info.field_name or "", value)):
            raise refuse("is out of range", range_of(info.field_name or "").allowed(), found[0], value=found[1])
        if kind is str:
            if _ACTS.search(value):
                raise refuse("holds a control character", "text")
            longest = _LONGEST_NAME if info.field_name == "name" else _LONGEST_TEXT
            if len(value) > longest:
                raise refuse(f"has {len(value)} characters", f"a text of at most {longest}")
        return value

    @model_validator(mode="after")
    def _checked(self) -> Self:
        self._check()
        return self

    def _check(self) -> None:
        """Check the keys against each other, after each key has been validated separately."""

    def at_most_one(self, *keys: str) -> None:
        """Reject two of `keys` that exclude each other."""
        given = [key for key in keys if getattr(self, key) is not None]
        if len(given) > 1:
            raise refuse(f"cannot be combined with {given[0]}", f"one of {', '.join(keys)}", given[1])

    def needs(self, key: str, because: str, allowed: str = "") -> Any:
        """Return the value of an optional key that another key requires; reject a missing value."""
        value = getattr(self, key)
        if value is None:
            raise refuse(f"required key is missing: {because}", allowed, key)
        return value

    def only_with(self, keys: tuple[str, ...], condition: bool, when: str) -> None:
        """Reject `keys` that have no meaning unless `condition` is true; `when` is the condition in words."""
        for key in keys:
            if not condition and getattr(self, key) is not None:
                raise refuse("has no meaning here", f"this key with {when} only", key)


def _whole_ns(seconds: float) -> float:
    if abs(seconds) > LONGEST_S:
        raise refuse("is longer than any flight", f"times up to {LONGEST_S:g} s, which are three years")
    if not is_whole_ns(seconds):
        raise refuse("is not a whole number of nanoseconds", "multiples of 1e-9 s")
    return seconds


def _whole_period(rate_hz: float) -> float:
    if rate_hz * LONGEST_S < 1.0:
        raise refuse("has a period longer than any flight", f"a period of at most {LONGEST_S:g} s")
    if not is_whole_period(rate_hz):
        raise refuse("its period is not a whole number of nanoseconds", "rates that divide 1e9, e.g. 50, 100, 1000")
    return rate_hz


def _channel_part(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_]{0,40}", name):
        raise refuse("cannot be part of a channel's name", "at most 40 letters a-z, digits and underscores")
    return name


ChannelPart = Annotated[str, AfterValidator(_channel_part)]
"""A name that becomes part of the names of log channels."""

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Latitude = Annotated[float, Field(ge=-90.0, le=90.0)]
Longitude = Annotated[float, Field(ge=-360.0, le=360.0)]
Angle = Annotated[float, Field(ge=-360.0, le=360.0)]
Seconds = Annotated[float, Field(ge=0.0), AfterValidator(_whole_ns)]
Period = Annotated[float, Field(gt=0.0), AfterValidator(_whole_ns)]
Rate = Annotated[float, Field(gt=0.0), AfterValidator(_whole_period)]


class OverTime(Section):
    """A number over the vehicle clock, linear between the times, with the end values applied outside."""

    time_s: tuple[float, ...] = Field(min_length=1, description="rising, s")
    value: tuple[Positive, ...] = Field(description="one at each time")

    def _check(self) -> None:
        if any(b <= a for a, b in pairwise(self.time_s)):
            raise refuse("does not rise", "rising times, s", "time_s")
        if len(self.value) != len(self.time_s):
            raise refuse(f"has {len(self.value)} numbers", f"{len(self.time_s)}, as time_s", "value")


PositiveOverTime = Annotated[
    Annotated[Positive, Tag(LIST_FORM)] | Annotated[OverTime, Tag(TABLE_FORM)],
    Discriminator(lambda value: TABLE_FORM if isinstance(value, dict | OverTime) else LIST_FORM),
]
"""A single number, or a table of numbers over time."""


def at_time(value: float | OverTime, time_s: Any) -> NDArray[np.float64]:
    """Return the value of a number or a table at vehicle times (s)."""
    if isinstance(value, OverTime):
        return np.asarray(np.interp(time_s, value.time_s, value.value))
    return np.full(np.shape(time_s), value)


Pair = tuple[float, float]
Triple = tuple[float, float, float]
FourNumbers = tuple[float, float, float, float]
ThreeRows = tuple[Triple, Triple, Triple]


def optional(description: str, default: Any = None, **constraints: Any) -> Any:
    """Return a key that may be absent."""
    return Field(default=default, description=description, **constraints)
