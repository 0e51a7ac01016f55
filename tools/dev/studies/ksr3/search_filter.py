"""Searches a bending filter F4 for the least gains: `python -m maxq.tools.dev.studies.ksr3.search_filter`
(minutes).

Raises the least distance of L from -1 over all nodes, and over the nodes with bending 10 % off, whose
distance counts for more. A filter that leaves an unstable pole or amplifies noise too much scores nothing.
Prints the sections.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.optimize import Bounds, differential_evolution

from maxq.control.kernel.records import Array
from maxq.tools.dev.studies.ksr3.build import VEHICLE_FOLDER
from maxq.tools.dev.studies.ksr3.cases import Case, all_cases
from maxq.tools.dev.studies.ksr3.gains import LinearGains, least_gains
from maxq.tools.dev.studies.ksr3.margins import Response, unstable_closed_loop_poles
from maxq.tools.dev.studies.ksr3.sampled_loop import Quadratic, filter_polynomials, law_polynomials

PREWARP_HZ = 9.2
NOMINAL_AIM, DISPERSED_AIM = 0.52, 0.35  # distances from -1; 0.52 is 30 deg, and more than 6 dB
LARGEST_FILTER_GAIN = 10 ** (8 / 20)
# zero Hz, zero zeta, pole Hz, pole zeta of a lead section, then of a notch section
BOUNDS = [
    (2.0, 15.0),
    (0.3, 1.2),
    (4.0, 40.0),
    (0.3, 1.2),
    (15.0, 45.0),
    (0.05, 1.0),
    (4.0, 45.0),
    (0.3, 1.2),
]


def sections(x: Array) -> list[Quadratic]:
    values = [float(v) for v in x]
    return [Quadratic(*values[:4]), Quadratic(*values[4:])]


class Problem:
    """Everything about the cases that does not change with the filter."""

    def __init__(self, cases: list[Case], gains: LinearGains) -> None:
        self.cases = cases
        self.period_s = cases[0].period_s
        self.z = [np.exp(2j * np.pi * c.frequency_hz * self.period_s) for c in cases]
        self.unfiltered = [
            c.response * _ratio(law_polynomials(*gains.at(c.time_s), self.period_s), z)
            for c, z in zip(cases, self.z, strict=True)
        ]

    def score(self, x: Array) -> float:
        """Larger is better; 1 means that every aim is met. Negative, and graded, where it will not do."""
        filter_ = filter_polynomials(sections(x), self.period_s, PREWARP_HZ)
        noise = float(np.abs(_ratio(filter_, self.z[0])).max()) / LARGEST_FILTER_GAIN
        worst, unstable = np.inf, 0.0
        for case, z, base in zip(self.cases, self.z, self.unfiltered, strict=True):
            loop = base * _ratio(filter_, z)
            unstable += unstable_closed_loop_poles(loop, case.unstable_poles)
            aim = NOMINAL_AIM if case.bending_factor == 1.0 else DISPERSED_AIM
            worst = min(worst, float(np.abs(1 + loop).min()) / aim)
        if unstable > 0.5:
            return -unstable
        return worst if noise <= 1 else 1 - noise


def _ratio(polynomials: tuple[Array, Array], z: Response) -> Response:
    numerator, denominator = polynomials
    return np.asarray(np.polyval(numerator, z) / np.polyval(denominator, z))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=VEHICLE_FOLDER)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--generations", type=int, default=120)
    arguments = parser.parse_args()
    cases = all_cases(arguments.folder)
    gains = least_gains(np.array([c.snapshot.m_delta_ps2 for c in cases if c.bending_factor == 1.0]))
    problem = Problem(cases, gains)

    def cost(x: Array) -> float:
        return -problem.score(x)

    low, high = np.array(BOUNDS).T
    found = differential_evolution(
        cost, Bounds(low, high), rng=arguments.seed, maxiter=arguments.generations, popsize=8, tol=1e-4
    )
    print(f"score {-found.fun:.3f}", gains, *sections(np.round(found.x, 3)), sep="\n")


if __name__ == "__main__":
    main()
