"""Measure how often tails are withheld, and how often the bounds of the others cover the true value:
`python -m maxq.tools.dev.verification.tail_bounds` writes the table of docs/verdicts.md (some minutes).

A row is a distribution with a known quantile, from which `RUNS` values are drawn repeatedly. A mixture consists of
normal numbers and a share of runs with a second mechanism, whose values have another normal distribution.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from maxq.control.kernel.records import Array
from maxq.sim.campaign.tails import tail_of
from maxq.tools.dev.verification.section import DOCS, rewrite

RUNS, SUCCESS, CONFIDENCE, RARE = 1000, 0.9973, 0.9, 1e-4


class KnownLaw(NamedTuple):
    """A distribution: a function that draws values, and the value that a flight exceeds with a given probability."""

    draw: Callable[[np.random.Generator], Array]
    exceeded: Callable[[float], float]


def single(law: Any) -> KnownLaw:
    """Return a distribution of SciPy."""
    return KnownLaw(lambda rng: law.rvs(size=RUNS, random_state=rng), lambda p: float(law.isf(p)))


def mixture(share: float, sigmas: float, sigma: float = 1.0) -> KnownLaw:
    """Return normal numbers, a share of which comes from a mechanism at `sigmas` with its own standard deviation."""
    second = stats.norm(sigmas, sigma)

    def draw(rng: np.random.Generator) -> Array:
        other = rng.random(RUNS) < share
        return np.where(other, second.rvs(size=RUNS, random_state=rng), rng.normal(size=RUNS))

    def exceeded(p: float) -> float:
        return float(brentq(lambda x: (1.0 - share) * stats.norm.sf(x) + share * second.sf(x) - p, 0.0, 50.0))

    return KnownLaw(draw, exceeded)


LAWS = {
    "normal": single(stats.norm()),
    "exponential": single(stats.expon()),
    "uniform": single(stats.uniform()),
    "Gumbel": single(stats.gumbel_r()),
    "Student (5)": single(stats.t(5)),
    "log-normal (0.5)": single(stats.lognorm(0.5)),
} | {
    f"second mechanism in {share:.1%}, at {sigmas:g} sigma": mixture(share, sigmas)
    for share, sigmas in ((0.01, 6.0), (0.004, 10.0), (0.004, 6.0), (0.004, 4.0), (0.001, 6.0))
}


def row(name: str, repetitions: int) -> str:
    """Return the row of the table for a distribution."""
    law = LAWS[name]
    quantile, limit = law.exceeded(1.0 - SUCCESS), law.exceeded(RARE)
    found = []
    for seed in range(repetitions):
        print(f"{name}: {seed + 1} of {repetitions}", end="\r", flush=True)
        found.append(tail_of(law.draw(np.random.default_rng([7, seed])), limit, SUCCESS, CONFIDENCE))
    printed = [tail for tail in found if not tail.problem]
    wrong = [sum(t.quantile_bound < quantile for t in printed), sum(t.beyond_bound < RARE for t in printed)]
    cells = [f"{1.0 - len(printed) / repetitions:.0%}"]
    cells += [f"{1.0 - count / len(printed):.0%}" if printed else "-" for count in wrong]
    cells += [f"{count / repetitions:.0%}" for count in wrong]
    return f"| {name} | {' | '.join(cells)} |"


def main() -> None:
    """Measure the coverage and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=60, help="repetitions of each distribution")
    repetitions = parser.parse_args().repetitions
    head = "| distribution | withheld | quantile bound covers | probability bound covers "
    head += "| wrong quantile bounds of all | wrong probability bounds of all |"
    rewrite(DOCS / "verdicts.md", "tails", "\n".join([head, "|---" * 6 + "|", *(row(n, repetitions) for n in LAWS)]))


if __name__ == "__main__":
    main()
