"""Measure the rates at which the harness accepts vehicles that fail too often, or rejects others:
`python -m maxq.tools.dev.verification.false_verdicts` writes the table of docs/verification.md (some minutes).

The vehicles are synthetic, with a known probability of failure p. A formula replaces the loop and the flight. It shifts
the drawn deviations so that exactly the share p of the phase margins and metrics misses the limit. All else is the
harness with the standard suite: draws by seed, limits, verdicts on random vehicles and campaign, and their union.

There are three users. The first runs the suite once. The second follows the advice "N more would settle it" at most
`MOST_STEPS` times. The third verifies four designs and takes any that is accepted (`simdesign --verify`, which shares
the risk among them).
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri

from maxq.design.quantities import SWEPT, LoopLimits
from maxq.design.verify.flown import CampaignResult, campaign_requirements
from maxq.design.verify.linear import MarginCase, MarginStudy, margin_requirements
from maxq.design.verify.suite import (
    ACCEPTED,
    REJECTED,
    UNDECIDED,
    JudgedRequirement,
    LinearMargins,
    overall,
    read_suite,
    shared_risk,
)
from maxq.sim.campaign.analysis import DataSet, judged
from maxq.sim.campaign.read import LoadedCampaign, load_campaign
from maxq.tools.dev.verification.section import VERIFICATION, rewrite

MOST_STEPS, MOST_VEHICLES, MOST_RUNS = 6, 30_000, 100_000
LIMIT_DEG, LIMIT_ALPHA_DEG = 15.0, 1.0  # limits of the phase margin and of the angle of attack
SHARES = ((0.0, 0.0), (0.1, 0.1), (0.5, 0.5), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0), (0.0, 2.0), (2.0, 0.0), (2.0, 2.0))
"""The probabilities of failure divided by the allowed ones, for linear vehicles and for flights."""
CAMPAIGN = """\
schema = 1
extends = "nominal.toml"
unset = ["requirement"]
[campaign]
runs = 1
success = 0.9973
[[disperse]]
key = "vehicle.stage.0.engine.thrust_factor"
distribution = "normal"
three_sigma = 0.03
"""
REQUIREMENT = """\
[[requirement]]
metric = "{}"
limit = {}
"""


class Formula(DataSet):
    """A data set without files: `values` are by metric, and all flights are complete."""

    def __init__(self, campaign: LoadedCampaign, values: Mapping[str, np.ndarray]) -> None:
        super().__init__(Path(), campaign)
        missed = np.array([values[r.metric] > r.limit for r in campaign.base.scenario.requirement])
        self.passed = np.asarray(~missed.any(axis=0))
        self.runs, self.void = np.arange(len(self.passed)), np.zeros(len(self.passed), bool)
        self.kept, self.values = ~self.void, values

    def read(self, names: Any) -> None:
        pass

    def numbers(self, name: str) -> np.ndarray:
        return self.values.get(name, self.runs)  # a time


@cache
def campaign(metrics: Sequence[str] = ("max_alpha_deg",), limit: float = LIMIT_ALPHA_DEG) -> LoadedCampaign:
    """Return a campaign with a limit on each of `metrics`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "synthetic.toml"
        path.write_text(CAMPAIGN + "".join(REQUIREMENT.format(metric, limit) for metric in metrics))
        return load_campaign(path)


def threshold(p: float) -> float:
    """Return the value that a standard normal number exceeds with probability p."""
    return float(ndtri(1.0 - p)) if p > 0.0 else 99.0


@lru_cache(maxsize=8)
def drawn(seed: int, count: int) -> np.ndarray:
    """Return the deviations of the thrust, in sigma, of the first `count` runs."""
    plan = campaign().with_campaign(seed=seed).plan
    return np.asarray((plan.draw(0, count).draws["vehicle.stage.0.engine.thrust_factor"] - 1.0) / 0.01)


def thrust_sigmas(loaded: LoadedCampaign, count: int) -> np.ndarray:
    """Return the deviations of the thrust for the seed of a campaign. The runs of a seed are drawn only once."""
    return drawn(loaded.campaign.seed, MOST_RUNS)[:count]


def linear_part(wanted: LinearMargins, loaded: LoadedCampaign, p: float) -> list[JudgedRequirement]:
    """Judge random vehicles whose phase margin misses its limit with probability p, if the drawn thrust is large."""
    cases = np.full((wanted.cases, 1, len(SWEPT)), np.inf)
    cases[:, 0, SWEPT.index("rigid_phase_deg")] = LIMIT_DEG + threshold(p) - thrust_sigmas(loaded, wanted.cases)
    nominal = MarginCase("", ({"rigid_phase_deg": 40.0},))
    return margin_requirements(MarginStudy("", "pitch", (40.0,), nominal, (), cases), wanted)


def flown_part(loaded: LoadedCampaign, p: float) -> list[JudgedRequirement]:
    """Judge flights that miss their limit with probability p, if the drawn thrust is large."""
    values = LIMIT_ALPHA_DEG + thrust_sigmas(loaded, loaded.campaign.runs) - threshold(p)
    return judged_runs(Formula(loaded, {"max_alpha_deg": values}))


def judged_runs(data: Formula) -> list[JudgedRequirement]:
    """Judge the flights of a data set as those of a campaign in a suite."""
    asked = data.campaign.campaign
    level = asked.success, asked.confidence
    return campaign_requirements(
        CampaignResult("", "", Path(), len(data.runs), False, *level, tuple(judged(data)), "", None)
    )


def settled(changes: list[str], seed: int, shares: tuple[float, float], steps: int) -> str:
    """Return the verdict of the standard suite on a vehicle, after at most `steps` requests for more runs."""
    suite = read_suite("standard", changes).suite
    margins, flights = suite.margins, suite.campaign[0]
    assert margins is not None
    limits = LoopLimits(rigid_phase_deg=LIMIT_DEG)
    wanted = margins.model_copy(update={"nominal": limits, "dispersed": limits, "corner_sigmas": 0.0})
    level = {k: getattr(flights, k) or getattr(campaign().campaign, k) for k in ("runs", "success", "confidence")}
    loaded = campaign().with_campaign(**level, seed=(flights.seed or 0) + 1000 * seed + 500)
    p = [share * (1.0 - success) for share, success in zip(shares, (wanted.success, level["success"]), strict=True)]
    for step in range(steps + 1):
        linear, flown = linear_part(wanted, loaded, p[0]), flown_part(loaded, p[1])
        more = max(r.more_runs for r in linear), max(r.more_runs for r in flown)
        verdict = overall([*linear, *flown])
        if (
            verdict != UNDECIDED
            or step == steps
            or wanted.cases + more[0] > MOST_VEHICLES
            or loaded.campaign.runs + more[1] > MOST_RUNS
        ):
            break
        wanted = wanted.model_copy(update={"cases": wanted.cases + more[0]})
        loaded = loaded.with_campaign(runs=loaded.campaign.runs + more[1])
    return verdict


def once(seed: int, shares: tuple[float, float]) -> str:
    return settled([], seed, shares, 0)


def advised(seed: int, shares: tuple[float, float]) -> str:
    return settled([], seed, shares, MOST_STEPS)


def best_of_four(seed: int, shares: tuple[float, float]) -> str:
    loaded = read_suite("standard")
    found = [
        settled(shared_risk(loaded, [campaign().campaign], 4, number), 10_000 + seed, shares, MOST_STEPS)
        for number in range(4)
    ]
    return ACCEPTED if ACCEPTED in found else UNDECIDED if UNDECIDED in found else REJECTED


USERS = {"once": once, "follows the advice": advised, "takes any of four designs": best_of_four}


def rows(suites: int) -> list[str]:
    heads = [f"{user}: accepted | rejected" for user in USERS]
    count = Counter[tuple[Any, ...]]()
    for seed in range(suites):  # the runs of a seed are drawn once for all rows
        count.update((shares, user, judge(seed, shares)) for user, judge in USERS.items() for shares in SHARES)
        print(f"suite {seed + 1} of {suites}", end="\r", flush=True)
    out = [f"| p / allowed, linear | flown | {' | '.join(heads)} |", "|---" * (2 + 2 * len(USERS)) + "|"]
    for shares in SHARES:
        cells = [
            f"{100.0 * count[shares, user, word] / suites:.1f} %" for user in USERS for word in (ACCEPTED, REJECTED)
        ]
        out.append(f"| {shares[0]:g} | {shares[1]:g} | {' | '.join(cells)} |")
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suites", type=int, default=200, help="suites per row and user, each with its own draws")
    rewrite(VERIFICATION, "verdicts", "\n".join(rows(parser.parse_args().suites)))


if __name__ == "__main__":
    main()
