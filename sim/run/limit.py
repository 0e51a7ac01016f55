"""The search for the largest value of a scenario's quantity at which the flight meets all requirements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.flight import Flight

_INTERVALS = 8
_DOUBLINGS = 20  # up to a million times the first step
_BISECTIONS = 40
_DIGITS = 6  # significant digits of a value, so that a command line can repeat it exactly


@dataclass(frozen=True)
class FoundLimit:
    """The result of `find_limit`.

    - `flown`: flights by value, in order of the distance from the first value.
    - `met`: last value before the first miss; None if the first value misses.
    - `missed`: first value whose flight misses a requirement; None if there is none.
    - `refused`: message for a value that ended the search because the scenario does not allow it.
    """

    flown: dict[float, Flight]
    met: float | None
    missed: float | None
    refused: str = ""


def find_limit(
    fly_at: Callable[[float], Flight],
    first: float,
    last: float | None = None,
    share: float = 0.01,
    stop: Callable[[], bool] = lambda: False,
) -> FoundLimit:
    """Search from `first` towards `last` for the first value whose flight misses a requirement.

    `fly_at` returns the flight at a value and raises ScenarioError for a value that is not allowed. Without `last`, the
    value is increased by doubling steps, the first of which is a quarter of `first` (1 if `first` is 0), until a
    requirement is missed. The range from `first` to this value, or to `last`, is then divided into eight intervals,
    whose ends are flown in turn. The first interval with a miss at its end is halved until its length is at most
    `share` of the distance of its end from `first`. A miss between two values that both meet the requirements is not
    detected.

    `stop` is called before each flight after the first. If it returns True, or if `fly_at` raises KeyboardInterrupt
    after the first flight, the result is based on the completed flights. Raises ScenarioError if `first` is not
    allowed.
    """
    flown: dict[float, Flight] = {}

    def meets(value: float) -> bool:
        value = _rounded(value)
        if value not in flown:
            flown[value] = fly_at(value)
        return flown[value].passed

    refused = ""
    try:
        if meets(first):
            try:
                end = _far_end(meets, first, stop) if last is None else last
            except ScenarioError as error:
                refused, end = str(error), max(flown)
            _bracket(meets, first, end, share, stop)
    except KeyboardInterrupt:
        if not flown:
            raise
    ordered = dict(sorted(flown.items(), key=lambda item: abs(item[0] - first)))
    met = missed = None
    for value, flight in ordered.items():
        if not flight.passed:
            missed = value
            break
        met = value
    return FoundLimit(ordered, met, missed, refused)


def _far_end(meets: Callable[[float], bool], first: float, stop: Callable[[], bool]) -> float:
    """Return the first value with a missed requirement, found by doubling steps, or the last value tried."""
    step, end = abs(first) / 4.0 or 1.0, first
    for k in range(1, _DOUBLINGS + 1):
        if stop():
            break
        end = first + step * (2.0**k - 1.0)
        if not meets(end):
            break
    return end


def _bracket(meets: Callable[[float], bool], first: float, end: float, share: float, stop: Callable[[], bool]) -> None:
    """Fly the ends of the intervals from `first` to `end` up to the first miss, and bisect the last interval."""
    below = first
    for i in range(1, _INTERVALS + 1):
        if stop():
            return
        above = first + i * (end - first) / _INTERVALS
        if not meets(above):
            break
        below = above
    else:
        return
    for _ in range(_BISECTIONS):
        middle = _rounded(0.5 * (below + above))
        if stop() or abs(above - below) <= share * abs(above - first) or middle in (below, above):
            return
        below, above = (middle, above) if meets(middle) else (below, middle)


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
