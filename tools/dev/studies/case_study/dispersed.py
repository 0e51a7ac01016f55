"""The campaigns of docs/case-study.md flown and boiled down: `python -m maxq.tools.dev.studies.case_study.dispersed`.

Flies campaigns/ksr3 with each of two designs, as it is and in smooth air, goes on where it was stopped, and leaves what
the chapter tells in docs/case-study-campaigns.json, so that it can be made anew without flying. The whole data sets and
reports stay in the folder given (default: runs/case-study).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.campaign.analysis import DataSet, judged, lost
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.read import load_campaign
from maxq.sim.campaign.runner import Progress, run_campaign
from maxq.tools.campaign_page import SUMMARY, write_report

RESULTS = Path(__file__).resolve().parents[4] / "docs" / "case-study-campaigns.json"
CAMPAIGN = "campaigns/ksr3"
DESIGNS = ("ksr3-two-phase", "ksr3-robust")
SMOOTH = ("wind.turbulence=", "wind.gust.0.speed_mps=0.0")
LIGHT = ('wind.turbulence.exceedance="light"',)
BAFFLES = tuple(f"vehicle.stage.0.tank.{tank}.damping_ratio=0.08" for tank in (0, 1))
AIRS: dict[str, tuple[tuple[str, ...], int]] = {
    "moderate": ((), 2000),
    "light": (LIGHT, 1000),
    "smooth": (SMOOTH, 1000),
    "baffles": (BAFFLES, 1000),  # the air of the first, and four times the damping of the liquid
}
"""Overrides and runs: with 2000 two failures are allowed, with 1000 none."""
ENVELOPES = ("q_alpha_Padeg", "error_pitch_deg", "gimbal_pitch_angle_deg", "gimbal_yaw_angle_deg")
_LEVELS = 60
_DRIVERS = 5


@dataclass(frozen=True)
class Case:
    """A design in one kind of air."""

    design: str
    air: str

    @property
    def name(self) -> str:
        return f"{self.design}-{self.air}"

    @property
    def overrides(self) -> list[str]:
        return [f'design="designs/{self.design}.toml"', "campaign.keep=[]", *AIRS[self.air][0]]

    def campaign(self) -> LoadedCampaign:
        return load_campaign(CAMPAIGN, self.overrides).with_campaign(runs=AIRS[self.air][1])


CASES = tuple(Case(design, air) for air in AIRS for design in DESIGNS)


def exceedance(values: Array) -> list[list[float]]:
    """[share of runs, value that this share reaches or exceeds] from the largest value on, ranks in equal ratios."""
    ordered = np.sort(values[np.isfinite(values)])[::-1]
    if not len(ordered):
        return []
    ranks = np.unique(np.rint(np.geomspace(1, len(ordered), _LEVELS)).astype(int))
    return [[_round(rank / len(values)), _round(ordered[rank - 1])] for rank in ranks]


def _round(value: float) -> float:
    return float(f"{value:.6g}")


def boiled_down(folder: Path, campaign: LoadedCampaign, overrides: Sequence[str]) -> dict[str, Any]:
    """What the chapter needs of a data set whose report has been written."""
    data = DataSet(folder, campaign, limit=campaign.campaign.runs)  # a folder may hold more
    summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    requirements = []
    for r in summary["requirements"]:
        kept = {
            k: r[k] for k in ("name", "metric", "unit", "kind", "bound", "shown", "median", "quantile", "tolerance")
        }
        kept["worst"] = r["worst"][0] if r["worst"] else None
        kept["exceedance"] = exceedance(data.numbers(r["metric"])[~data.void]) if r["metric"] else []
        requirements.append(kept)
    labels = {d.name: d.label for d in campaign.plan.draws}
    drivers = {
        name: [{"input": labels.get(d["name"], d["name"]), "rank": _round(d["rank"]), "noise": _round(d["noise"])}
               for d in found[:_DRIVERS]]
        for name, found in summary["drivers"].items()
    }  # fmt: skip
    return {
        "command": f"simrun {CAMPAIGN} --runs {summary['runs']} " + " ".join(f"--set '{o}'" for o in overrides),
        **{key: summary[key] for key in ("runs", "seed", "sampling", "success", "confidence", "outcomes")},
        **{key: summary[key] for key in ("failed_runs", "redraws")},
        "requirements": requirements,
        "drivers": drivers,
        "envelopes": [band for band in summary["envelopes"] if band["channel"] in ENVELOPES],
    }


def fly_case(case: Case, folder: Path, workers: int | None, as_flown: bool) -> dict[str, Any]:
    """Fly what is missing unless `as_flown`, write the report, and boil it down."""
    campaign = case.campaign()

    def watch(progress: Progress) -> None:
        print(f"\r{case.name}: {progress.done} of {campaign.campaign.runs} runs", end="", file=sys.stderr, flush=True)

    if not as_flown:
        run_campaign(campaign, folder, workers=workers, watch=watch)
        print(file=sys.stderr)
    data = DataSet(folder, campaign, limit=campaign.campaign.runs)  # a folder may hold more
    write_report(data, judged(data), lost(data), len(data.runs), {}, pictures=True)
    return boiled_down(folder, campaign, case.overrides)


def read() -> dict[str, Any]:
    """What was flown, by name of the case."""
    found: dict[str, Any] = json.loads(RESULTS.read_text(encoding="utf-8"))
    return found


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/case-study"), help="where the data sets are")
    parser.add_argument("--workers", type=int, help="threads (default: all cores)")
    parser.add_argument("--as-flown", action="store_true", help="fly nothing: data sets that an earlier version left")
    names = [case.name for case in CASES]
    parser.add_argument("--only", nargs="+", choices=names, metavar="CASE", default=names, help=", ".join(names))
    given = parser.parse_args(arguments)
    results = read() if RESULTS.exists() else {}
    for case in [c for c in CASES if c.name in given.only]:
        results[case.name] = fly_case(case, given.out / case.name, given.workers, given.as_flown)
        ordered = {name: results[name] for name in names if name in results}
        RESULTS.write_text(json.dumps(ordered, indent=None, separators=(",", ":")) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
