"""Measure the rates at which a vehicle of known quality ends accepted or rejected:
`python -m maxq.tools.dev.verification.error_rates` writes the table of docs/verification.md (some minutes).

No flight is flown. A flight misses a requirement if its uniform number is in an interval of the required length. All
else is the harness: verdicts on campaigns and their union, the rule of the ledger for seeds, and subset simulation.

- Campaigns begin with `RUNS` runs. The user adds the runs that the verdicts state, at most `MOST_STEPS` times.
- Out of `SEEDS` seeds, the user takes any that is accepted. The first is the declared seed. The user registers each of
  the others before its flights, as far as the ledger permits.
- Rare events are allowed with probability `RARE`. Their limit states are those of `rare_bounds`.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from maxq.design.verify.ledger import BEGUN, Line
from maxq.design.verify.seeds import BY_HAND, DECLARED, Seed, chosen, missing, registered
from maxq.design.verify.suite import ACCEPTED, REJECTED, UNDECIDED, judgement_of, overall
from maxq.sim.campaign.rare import subset_simulation
from maxq.sim.flight.metric_table import MetricIndex
from maxq.tools.dev.verification.false_verdicts import MOST_RUNS, MOST_STEPS, Formula, campaign, judged_runs
from maxq.tools.dev.verification.rare_bounds import CONFIDENCE, POPULATION, LimitState, decoy, discrete, noisy, plane
from maxq.tools.dev.verification.section import VERIFICATION, rewrite

SHARES = (0.5, 1.0, 1.05, 1.5)  # probability of a miss / allowed probability
RUNS, SEEDS, SUCCESS, RARE = 1200, 20, 0.9973, 1e-4
TEN = MetricIndex._fields[:10]
OF = "campaign.0"


def missed_alone(uniform: np.ndarray, each: float, metrics: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the values of metrics, each of which exceeds a limit of 0 in a share `each` of the flights.

    No two metrics exceed it in the same flight.
    """
    which = uniform // each
    return {name: np.where(which == k, 1.0, -1.0) for k, name in enumerate(metrics)}


def settled(seed: Sequence[int], each: float, metrics: Sequence[str], steps: int = MOST_STEPS) -> str:
    """Return the verdict on a campaign after at most `steps` extensions by the runs that its verdicts state.

    Each of `metrics` misses its limit in a share `each` of the flights.
    """
    runs = RUNS
    for step in range(steps + 1):
        uniform = np.random.default_rng(seed).random(runs)  # a longer sequence has the same beginning
        loaded = campaign(tuple(metrics), 0.0).with_campaign(runs=runs, success=SUCCESS)
        rows = judged_runs(Formula(loaded, missed_alone(uniform, each, metrics)))
        verdict, more = overall(rows), max(row.more_runs for row in rows)
        if verdict != UNDECIDED or step == steps or runs + more > MOST_RUNS:
            break
        runs += more
    return verdict


def lacking(attempts: int) -> list[list[str]]:
    """Return the evidence that each of `attempts` attempts with other seeds lacks, by the rule of the ledger."""
    hashes, lines, out = {"vehicle": "v", "design": "d"}, list[Line](), []
    for value in range(attempts):
        seed = Seed(OF, value, 0, BY_HAND if value else DECLARED)
        with contextlib.suppress(ValueError):  # if the ledger permits no other seed
            lines.append(registered([seed], lines, "v") | {"date": "today"})
        out.append(missing(chosen([seed], lines, "d")))
        lines.append({"state": BEGUN, "hashes": hashes, "seeds": {OF: value}, "candidate": 0, "part": ""})
    return out


def best_of_seeds(number: int, share: float, lack: Sequence[Sequence[str]]) -> str:
    """Return the verdict of attempts with different seeds. Attempts that lack evidence cannot be accepted."""
    found = []
    for attempt in (n for n, lacks in enumerate(lack) if not lacks):
        found.append(settled((number, attempt), share * (1.0 - SUCCESS), TEN[:1]))
        if found[-1] == ACCEPTED:
            break
    return next(word for word in (ACCEPTED, REJECTED, UNDECIDED) if word in found)


def rare(state: Callable[[float], LimitState], number: int, share: float) -> str:
    """Return the verdict of subset simulation on a limit state."""
    made = state(share * RARE)
    found = subset_simulation(made.value, made.scores, POPULATION, CONFIDENCE, number)
    return judgement_of(found.judgement(RARE))


ROWS: Mapping[str, Callable[[int, float], str]] = {
    "one requirement, once": lambda n, share: settled((n,), share * (1.0 - SUCCESS), TEN[:1], 0),
    "one requirement, extended": lambda n, share: settled((n,), share * (1.0 - SUCCESS), TEN[:1]),
    "ten requirements, p in all, extended": lambda n, share: settled((n,), 0.1 * share * (1.0 - SUCCESS), TEN),
    "ten requirements, p each, extended": lambda n, share: settled((n,), share * (1.0 - SUCCESS), TEN),
    f"any of {SEEDS} seeds, without the ledger": partial(best_of_seeds, lack=[[]] * SEEDS),
    f"any of {SEEDS} seeds, with the ledger": partial(best_of_seeds, lack=lacking(SEEDS)),
    "rare, hyperplane in 20": partial(rare, lambda p: plane(p, 20)),
    "rare, noise of 0.5 sigma": partial(rare, lambda p: noisy(0.5, p)),
    "rare, noise of 0.95 sigma": partial(rare, lambda p: noisy(0.95, p)),
    "rare, sudden": partial(rare, discrete),
    "rare, saturating decoy": partial(rare, decoy),
}


def row(name: str, repetitions: int) -> str:
    """Return the row of a vehicle and user: accepted | rejected at each share."""
    cells = []
    for share in SHARES:
        print(f"{name}, {share:g}", end="\r", flush=True)
        found = [ROWS[name](number, share) for number in range(repetitions)]
        cells.append(" | ".join(f"{found.count(word) / repetitions:.1%}" for word in (ACCEPTED, REJECTED)))
    return f"| {name} | {' | '.join(cells)} |"


def main() -> None:
    """Measure the rates and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=200, help="vehicles per row and probability")
    repetitions = parser.parse_args().repetitions
    heads = " | ".join(f"{share:g} p0: accepted | rejected" for share in SHARES)
    lines = [f"| vehicle and user | {heads} |", "|---" * (1 + 2 * len(SHARES)) + "|"]
    rewrite(VERIFICATION, "rates", "\n".join([*lines, *(row(name, repetitions) for name in ROWS)]))


if __name__ == "__main__":
    main()
