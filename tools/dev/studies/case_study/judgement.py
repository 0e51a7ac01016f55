"""All designs of the case study judged by the standard suite: `python -m maxq.tools.dev.studies.case_study.judgement`.

Verifies every design in scenarios/designs with a campaign of RUNS flights, then those that the paper's filters F2 to F6
and its three kinds of gain schedule give, flies that campaign again with what would have to change for two of them, and
leaves what the chapter tells in docs/case-study-verdicts.json. What was worked out before is not worked out again.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from maxq.design.case.read import read_case
from maxq.design.optimise.solve import nominal_plants
from maxq.design.verify.campaigns import campaign_requirements, fly_campaign
from maxq.design.verify.memory import default_folder
from maxq.design.verify.suite import LoadedSuite, read_suite
from maxq.design.verify.verdict import Requirement, overall
from maxq.design.verify.verify import Verification, verify
from maxq.tools.design.design_file import DESIGN_NAME, builtin_designs, design_path, design_text, write_whole
from maxq.tools.design.orders import solve_orders
from maxq.tools.design.outcome import make_design
from maxq.tools.verify.text import ranked

RESULTS = Path(__file__).resolve().parents[4] / "docs" / "case-study-verdicts.json"
RUNS = 300  # no failure in 230 shows 99 % with 90 %
COMPARED = ("ksr3-two-phase", "ksr3-robust")
ORDERS_OF = "ksr3-relaxed"  # the case whose filters and schedules are judged
TOLD_MARGINS = {
    "gain up, dB": "gain margin up, all crossings, as designed",
    "phase, deg": "phase margin, rigid body, as designed",
    "mode 1 phase, deg": "first mode: phase margin, as designed",
    "gain up at corners, dB": "gain margin up, all crossings, corners",
    "phase at corners, deg": "phase margin, rigid body, corners",
}
"""Requirements whose margins the chapter shows, by what it calls them."""
_DAMPING = tuple(f"vehicle.stage.0.tank.{k}.damping_ratio=0.1" for k in (0, 1))
_AIR = ("wind.turbulence.exceedance='light'", "wind.gust.0.speed_mps=0.0")
CHANGES: dict[str, tuple[str, ...]] = {
    "as it is": (),
    "baffles that damp 10 % instead of 2 %": _DAMPING,
    "light turbulence instead of moderate, and no gust on top": _AIR,
    "both": (*_DAMPING, *_AIR),
}


def suite(changes: tuple[str, ...] = ()) -> LoadedSuite:
    """The standard suite with fewer flights in the campaign, and changes to all of them."""
    listed = ", ".join(f'"{change}"' for change in changes)
    return read_suite("standard", [f"campaign.0.runs={RUNS}", f"campaign.0.set=[{listed}]"])


def requirement_record(r: Requirement) -> dict[str, Any]:
    return {
        "part": r.part, "name": r.name, "wanted": r.wanted, "found": r.found, "verdict": r.judgement,
        "room": round(r.room, 4) if math.isfinite(r.room) else None, "where": r.where,
    }  # fmt: skip


def verdict_record(found: Verification) -> dict[str, Any]:
    """What the chapter needs of a verification."""
    return {
        "verdict": found.judgement,
        "requirements": [requirement_record(r) for r in found.requirements],
        "limits": {x.requirement: [x.limit, x.why] for x in found.suite.dispersed_limit},
    }


def judge_all(designs: Mapping[str, str]) -> dict[str, Any]:
    """Verdicts by name of the design, the best first; `designs` says what a scenario calls it."""
    every = {}
    for name, path in designs.items():
        every[name] = verify(path, suite(), memory=default_folder(), watch=_watch(name))
        print(f"\r{name}: {every[name].judgement}, {every[name].wall_s:.0f} s" + 30 * " ", file=sys.stderr)
    best_first = ranked(list(every.values()))
    return {name: verdict_record(v) for v in best_first for name in designs if every[name] is v}


def judge_orders(folder: Path) -> dict[str, Any]:
    """Verdicts on F2 to F6 with each schedule, the best first, without what is accepted and not shown.

    They are designed as `simdesign ORDERS_OF --orders` does it; `folder` takes their files.
    """
    paths, peaks = {}, {}
    show, plants = _watch(ORDERS_OF), nominal_plants(read_case(ORDERS_OF))
    solved = solve_orders(ORDERS_OF, (), plants, lambda n, of: show("designs", n, of))
    for (structure, schedule), made in solved.items():
        name = f"{structure} {schedule}"
        file = folder / f"{structure}-{schedule}" / DESIGN_NAME
        paths[name] = str(write_whole(file, design_text(make_design(*made))))
        peaks[name] = round(made[1].objective_db, 3)
    found = judge_all(paths)
    for name, record in found.items():
        told = [r for r in record["requirements"] if r["verdict"] != "accepted" or r["name"] in TOLD_MARGINS.values()]
        found[name] = {"verdict": record["verdict"], "peak_db": peaks[name], "requirements": told}
    return found


def judge_changes() -> dict[str, Any]:
    """The campaign alone, with each of CHANGES, by design."""
    out: dict[str, Any] = {}
    for name in COMPARED:
        out[name] = {}
        for what, changes in CHANGES.items():
            loaded = suite(changes)
            flown = fly_campaign(loaded, loaded.suite.campaign[0], design_path(name), None, default_folder())
            found = campaign_requirements(flown)
            medians = {v.name: v.median for v in flown.verdicts if v.metric}
            out[name][what] = {
                "verdict": overall(found),
                "requirements": [
                    requirement_record(r)
                    | {"failed": v.shown.failures, "median": medians.get(v.name),
                       "worst": v.worst[0].value if v.worst else None}
                    for r, v in zip(found, flown.verdicts, strict=True)
                ],
            }  # fmt: skip
            print(f"{name}, {what}: {out[name][what]['verdict']}", file=sys.stderr)
    return out


def _watch(name: str) -> Any:
    def show(what: str, done: int, of: int) -> None:
        print(f"\r{name}: {what} {done} of {of}" + 20 * " ", end="", file=sys.stderr, flush=True)

    return show


def read() -> dict[str, Any]:
    """What was found."""
    found: dict[str, Any] = json.loads(RESULTS.read_text(encoding="utf-8"))
    return found


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.parse_args(arguments)
    designs = judge_all({name: design_path(name) for name in builtin_designs()})
    with tempfile.TemporaryDirectory() as folder:
        orders = judge_orders(Path(folder))
    results = {"runs": RUNS, "designs": designs, "orders": orders, "changes": judge_changes()}
    RESULTS.write_text(json.dumps(results, separators=(",", ":")) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
