"""Measure how often the bounds of `simrun rare` cover the true probability:
`python -m maxq.tools.dev.verification.rare_bounds` writes the table of docs/verdicts.md (some minutes).

The limit states have a known probability of failure. A bound that is not given (undecided) is counted as covering.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, ndtr, ndtri

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.campaign.rare import SHARE_OF_FLIGHTS, Rare, subset_simulation
from maxq.tools.dev.verification.section import DOCS, rewrite

CONFIDENCE = 0.9
POPULATION = round(10_000 * SHARE_OF_FLIGHTS)  # the default of `simrun rare`
_NOISES = 2.0**62  # noise numbers are uniform integers below this number


class LimitState(NamedTuple):
    """A limit state of `scores` standard normal numbers and noise. It fails if `value` > 0, with `probability`."""

    scores: int
    probability: float
    value: Callable[[Array, IntArray], Array]


def above(p: float) -> float:
    """Return the number that a standard normal number exceeds with probability p."""
    return float(-ndtri(p))


def plane(p: float, scores: int) -> LimitState:
    """Return a limit state whose limit is a hyperplane at equal angles to all axes."""
    return LimitState(scores, p, lambda z, _: z.sum(axis=1) / math.sqrt(scores) - above(p))


def sphere(radius: float, scores: int) -> LimitState:
    """Return a limit state that fails outside a sphere."""
    return LimitState(scores, float(chdtrc(scores, radius**2)), lambda z, _: np.linalg.norm(z, axis=1) - radius)


def two_ways(sigmas: float) -> LimitState:
    """Return a limit state that fails beyond either of two opposite hyperplanes."""
    return LimitState(4, 2.0 * float(ndtr(-sigmas)), lambda z, _: np.abs(z[:, 1]) - sigmas)


def discrete(p: float) -> LimitState:
    """Return a limit state that fails without an approach: its value is -1 or 1."""
    return LimitState(5, p, lambda z, _: np.where(z[:, 0] > above(p), 1.0, -1.0))


def cliff(smooth: float, sudden: float) -> LimitState:
    """Return a limit state with a smooth approach to a rare failure, and a sudden failure that is less rare."""
    p = smooth + sudden - smooth * sudden
    return LimitState(5, p, lambda z, _: np.where(z[:, 1] > above(sudden), 1.0, z[:, 0] - above(smooth)))


def noisy(share: float, p: float) -> LimitState:
    """Return a limit state with a hyperplane, in whose value noise has the given share of the standard deviation."""

    def value(z: Array, noise: IntArray) -> Array:
        return np.asarray(math.sqrt(1.0 - share**2) * z[:, 0] + share * ndtri((noise + 0.5) / _NOISES) - above(p))

    return LimitState(5, p, value)


def decoy(p: float) -> LimitState:
    """Return a limit state whose value rises towards a saturation below the limit, and which fails in another
    direction.
    """
    return LimitState(
        5, p, lambda z, _: np.maximum(np.minimum(z[:, 0], 2.0) - 2.5, np.where(z[:, 1] > above(p), 1.0, -9.0))
    )


STATES = {
    "hyperplane in 20": plane(1e-4, 20),
    "hyperplane in 20, rarer": plane(1e-5, 20),
    "hyperplane in 5, 1e-6": plane(1e-6, 5),
    "outside of a sphere": sphere(5.0, 3),
    "two opposite hyperplanes": two_ways(3.5),
    "sudden, 1 %": discrete(0.01),
    "sudden, 0.4 %": discrete(0.004),
    "sudden, 0.1 %": discrete(0.001),
    "smooth 1e-5 and sudden 0.1 %": cliff(1e-5, 1e-3),
} | {
    f"noise of {share:g} sigma, {p:.0e}": noisy(share, p) for share in (0.3, 0.5, 0.8, 0.95) for p in (1e-3, 1e-4, 1e-5)
}
STATES |= {f"saturating decoy, {p:.0e}": decoy(p) for p in (1e-4, 1e-5)}


def row(name: str, repetitions: int) -> str:
    """Return the row of the table for a limit state."""
    state = STATES[name]
    found: list[Rare] = []
    for seed in range(repetitions):
        print(f"{name}: {seed + 1} of {repetitions}", end="\r", flush=True)
        found.append(subset_simulation(state.value, state.scores, POPULATION, CONFIDENCE, seed))
    decided = [one for one in found if not one.undecided]
    above_it = sum(one.high >= state.probability for one in found) / repetitions
    below_it = sum(one.low <= state.probability for one in found) / repetitions
    ratio = f"{np.median([one.probability for one in decided]) / state.probability:.2f}" if decided else "-"
    undecided = 1.0 - len(decided) / repetitions
    flights = np.mean([one.flights for one in found])
    shares = " | ".join(f"{share:.0%}" for share in (undecided, above_it, below_it))
    shown = name.removesuffix(f", {state.probability:.0e}")  # the next column gives the probability
    return f"| {shown} | {state.probability:.1e} | {shares} | {ratio} | {flights:.0f} |"


def main() -> None:
    """Measure the coverage and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=200, help="repetitions of each limit state")
    repetitions = parser.parse_args().repetitions
    head = "| limit state | probability | undecided | upper bound covers | lower covers | median / true | flights |"
    rewrite(DOCS / "verdicts.md", "rare", "\n".join([head, "|---" * 7 + "|", *(row(n, repetitions) for n in STATES)]))


if __name__ == "__main__":
    main()
