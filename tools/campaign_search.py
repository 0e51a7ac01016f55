"""`simrun --from DIR --search METRIC`: the worst flight within 3 sigma, beside the worst of the campaign."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from maxq.sim.campaign.analysis import DataSet
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.runner import cores
from maxq.sim.campaign.search import search_worst
from maxq.sim.campaign.store import campaign_in
from maxq.sim.files import write_whole
from maxq.sim.run.metrics import METRIC_NAMES, unit_of
from maxq.sim.scenario.errors import suggestion
from maxq.tools.cli.interruption import Interruption
from maxq.tools.cli.terminal import aligned, printable

_PASSED, _FAILED = 0, 1
_FLIGHTS = 2000


def search(folder: Path, metric: str, workers: int | None, flights: int | None) -> int:
    """Search, tell, and leave the scenario in DIR/worst/METRIC.toml. Exit code 1: it misses a requirement."""
    if metric not in METRIC_NAMES:
        hint = suggestion(metric, METRIC_NAMES)
        raise CampaignError(f"--search {metric}: there is no such metric; {hint or ', '.join(METRIC_NAMES)}")
    campaign = campaign_in(folder)
    limits = [r for r in campaign.base.scenario.requirement if r.metric == metric]
    largest = not (limits and limits[0].minimum is not None)
    data = DataSet(folder, campaign)
    values = data.numbers(metric)
    good = np.flatnonzero(np.isfinite(values) & ~data.void)
    start, worst = None, float("nan")
    if len(good):
        at = int(good[np.argmax(values[good]) if largest else np.argmin(values[good])])
        start, worst = int(data.runs[at]), float(values[at])
    terminal = sys.stderr.isatty()

    def watch(best: float, flown: int) -> None:
        if terminal:
            print(f"\r{flown} flights, worst {best:.6g}   ", end="", file=sys.stderr, flush=True)

    with Interruption() as interruption:
        try:
            found = search_worst(
                campaign, metric, largest=largest, flights=flights or _FLIGHTS, start=start,
                workers=workers or cores(), watch=watch, stop=lambda: interruption.requested,
            )  # fmt: skip
        except ValueError as error:
            raise CampaignError(f"{folder}: {error}") from None
    if terminal:
        print("\r" + " " * 60 + "\r", end="", file=sys.stderr, flush=True)
    path = folder / "worst" / f"{metric}.toml"
    write_whole(path, found.scenario.as_flown, CampaignError)
    unit = "" if unit_of(metric) == "1" else f" {unit_of(metric)}"
    print(f"worst {metric} within 3 sigma: {found.value:.6g}{unit} ({found.flights} flights)")
    if start is not None:
        more = f"{100.0 * (found.value / worst - 1.0):+.1f} %" if worst else f"{found.value - worst:+.4g}{unit}"
        print(f"worst of the campaign's {len(data.runs)} runs: {worst:.6g}{unit} (run {start}): {more};")
        print("the search has that run's wind and noise")
    boxes, labels = campaign.boxes(), {d.name: d.label for d in campaign.plan.draws}
    share = {n: _place(x, *boxes[n]) for n, x in found.draws.items()}
    rows = [(printable(labels.get(n, n)), n, f"{found.draws[n]:.6g}", f"{share[n]:+.2f}") for n in share]
    print("draws, and where they lie in the box (-1 .. 1):")
    print("\n".join(aligned(rows, "  ", right=(2, 3))))
    print(f"{path}: fly it with simrun {path}")
    return _PASSED if found.flight.passed else _FAILED


def _place(x: float, low: float, high: float) -> float:
    return 2.0 * (x - low) / (high - low) - 1.0 if high > low else 0.0
