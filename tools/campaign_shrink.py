"""`simrun --from DIR --run N --shrink`: what a failed run really needs to fail."""

from __future__ import annotations

import sys
from pathlib import Path

from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.runner import cores
from maxq.sim.campaign.shrink import shrink_run
from maxq.sim.campaign.store import campaign_in
from maxq.sim.campaign.targets import Refused
from maxq.sim.files import write_whole
from maxq.tools.cli.terminal import aligned, printable

_PASSED, _FAILED = 0, 1


def shrink(folder: Path, run: int, workers: int | None) -> int:
    """Find, tell, and leave the scenario in DIR/shrunk/run-000417.toml. Exit code 1: it fails, as it should."""
    campaign = campaign_in(folder)
    terminal = sys.stderr.isatty()

    def watch(left: int, flights: int) -> None:
        if terminal:
            print(f"\r{left} dispersions left, {flights} flights   ", end="", file=sys.stderr, flush=True)

    try:
        found = shrink_run(campaign, run, workers=workers or cores(), watch=watch)
    except Refused as refused:
        raise CampaignError(f"run {run} of {folder} has no scenario: {refused}") from None
    if terminal:
        print("\r" + " " * 50 + "\r", end="", file=sys.stderr, flush=True)
    if found is None:
        print(f"run {run} of {folder} does not fail: there is nothing to shrink")
        return _PASSED
    path = folder / "shrunk" / f"run-{run:06d}.toml"
    write_whole(path, found.scenario.as_flown, CampaignError)
    labels = {d.name: d.label for d in campaign.plan.draws}
    recorded = campaign.inputs(run).recorded
    count = len(campaign.input_names)
    print(f"run {run} fails in: {printable(found.failure)}")
    if not found.inputs:
        print(f"it does so without any of its {count} dispersions ({found.flights} flights)")
    else:
        print(f"{len(found.inputs)} of {count} dispersions are enough ({found.flights} flights); none of them can go:")
        rows = [(printable(labels.get(n, "")), n, _value(recorded.get(n))) for n in found.inputs]
        print("\n".join(aligned(rows, "  ")))
    for verdict in found.flight.verdicts:
        if verdict.name == found.failure:
            print(f"{verdict.requirement.metric} is then {verdict.value:.6g}")
    print(path)
    return _FAILED


def _value(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else "" if value is None else str(value)
