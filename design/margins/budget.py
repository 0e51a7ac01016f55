"""Margin budget: what each part of a loop does to its gain and phase at one frequency, adding up to the whole.

Parts in series multiply, so their decibels and degrees add. What is not in series - aerodynamics, slosh, engine
inertia, bending act on one another - is switched on one after the other in a stated order, and each is charged the
ratio of L with it to L without it, all before it being on, all after it off. The ratios telescope: whatever the order,
the sum is L. The order says who is charged for what two of them do together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.margins.objectives import DB
from maxq.design.model.state_space import ComplexArray

Response = Callable[[Array], ComplexArray]

_PATH = 400  # points from far below up to the frequency along which a series part's phase is followed
_DECADES = 4.0


@dataclass(frozen=True)
class Share:
    """Of one part; degrees below 0 are lag. A series part's phase is followed up from low frequency (a delay may eat
    more than 180 deg); that of a part switched on is the short way round."""

    part: str
    gain_db: float
    phase_deg: float


@dataclass(frozen=True)
class Budget:
    """At one frequency. `left_db` and `left_deg` are L, measured at once, less the sum of the shares: rounding."""

    frequency_hz: float
    shares: tuple[Share, ...]
    left_db: float
    left_deg: float

    @property
    def gain_db(self) -> float:
        """Sum: |L|."""
        return float(sum(share.gain_db for share in self.shares))

    @property
    def phase_deg(self) -> float:
        """Sum: the phase of L, up to turns."""
        return float(sum(share.phase_deg for share in self.shares))

    @property
    def phase_margin_deg(self) -> float:
        """The sum beyond -180 + 360 k degrees, in [-180, 180)."""
        return _short(self.phase_deg + 180.0)

    def share(self, part: str) -> Share:
        """By name. Raises KeyError, naming those that there are."""
        for share in self.shares:
            if share.part == part:
                return share
        raise KeyError(f"no part {part!r}: there are {', '.join(share.part for share in self.shares)}")


def split(
    whole: Response,
    frequency_hz: float,
    series: Sequence[tuple[str, Response]],
    stages: Sequence[tuple[str, Response]] = (),
) -> Budget:
    """Budget of `whole` = product of `series` times the last of `stages`.

    A stage is the response with that part and all before it switched on; the first is what all others add to.
    Raises ValueError where a part is zero or not finite at the frequency.
    """
    path = frequency_hz * 10.0 ** np.linspace(-_DECADES, 0.0, _PATH)
    here = path[-1:]
    shares = []
    for part, response in series:
        values = _checked(part, response(path), frequency_hz)
        phase = np.unwrap(np.angle(values))
        shares.append(Share(part, _db(values[-1]), float(np.degrees(phase[-1]))))
    before = 1.0 + 0j
    for part, response in stages:
        with_it = complex(_checked(part, response(here), frequency_hz)[-1])
        shares.append(Share(part, _db(with_it / before), float(np.degrees(np.angle(with_it / before)))))
        before = with_it
    value = complex(_checked("the whole", whole(here), frequency_hz)[-1])
    found = Budget(float(frequency_hz), tuple(shares), 0.0, 0.0)
    left_deg = _short(float(np.degrees(np.angle(value))) - found.phase_deg)
    return Budget(found.frequency_hz, found.shares, _db(value) - found.gain_db, left_deg)


def _checked(part: str, values: ComplexArray, frequency_hz: float) -> ComplexArray:
    v = np.asarray(values, np.complex128)
    if not np.isfinite(v[-1]) or v[-1] == 0.0:
        raise ValueError(f"budget at {frequency_hz:.6g} Hz: {part} is {v[-1]} there")
    return v


def _db(value: complex) -> float:
    return float(DB * np.log(abs(value)))


def _short(deg: float) -> float:
    return float((deg + 180.0) % 360.0 - 180.0)
