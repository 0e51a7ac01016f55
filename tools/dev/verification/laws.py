"""Design, certify and fly every law on both shipped vehicles: `python -m maxq.tools.dev.verification.laws DIR`.

Each row is a case of simdesign with other keys. Its design is certified in flight at operating points of its stage, in
both planes, and flown without wind and in the vehicle's limit wind. Existing rows in DIR are not repeated, so that the
program can be stopped and continued. `--only WORD` selects the rows that contain the word. The exit code is 1 if a
limit is missed or a certificate disagrees.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from maxq.design import operating_points
from maxq.design.certificate.certificate import PLANES, certify_node
from maxq.design.model.node_times import node_times
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.tools import simvehicle
from maxq.tools.design import run_case
from maxq.tools.dev.verification.section import VERIFICATION, rewrite

DOCUMENT = VERIFICATION.parent / "flights" / "results.md"
NODES = 3  # operating points of a certificate
NAMES = {"ksr3": "KSR-III", "petrel": "petrel"}
UNSHOWN = ("pd F2", "pd F3", "pd F5", "pd F6", "pd sections")  # designed and certified, but not in the table
HEAD = r"""| law | vehicle | least \|1 + L\| | margins apart, dB; % of delay | still air | limit wind |
|---|---|---|---|---|---|"""
LIMIT_WIND = {"ksr3": "winds/anheung-september-limit.csv", "petrel": "vehicle/limit_wind.csv"}
GYRO = "omega_hz = 60.0, zeta = 0.65"
CASES = {
    "ksr3": """
scenario = "load-relief"
between_nodes = "hold"
nodes_s = [5.0, 12.0, 20.0, 30.0, 40.0, 50.0]
gains.schedule = "free"
filter.structure = "F4"
objective.kind = "least-margin"
limits.rigid_hz = 0.3
""",
    "petrel": 'extends = "case.toml"\nscenario = "sensors.toml"\n',
}
SENSORS = """schema = 1
extends = "scenario.toml"
[vehicle_overrides]
""" + "".join(  # an accelerometer and a second gyro, in upper stages at the station of the first
    f"stage.{n}.accelerometer = {{station_m = 6.8, count_mps = 0.001, {GYRO}}}\n"
    f"stage.{n}.rate_gyro = [{{station_m = {station_m}, {GYRO}}}]\n"
    for n, station_m in enumerate((14.5, 6.8, 6.8))
)
FIRST = "stages=[1]"  # for petrel; the other stages fly the design of the row "pd F4"
WIND = "wind={sigma_mps=10.0, length_v_m=3000.0, band_hz=[0.02, 0.3]}"
FEW = [FIRST, "nodes_per_stage=7", "search.starts=2", "search.leaps=1"]
RELIEF = {"ksr3": [WIND, "limits.q_alpha_Padeg=11800"], "petrel": [WIND, "limits.q_alpha_Padeg=50000", *FEW]}
PLAIN = {"ksr3": [], "petrel": FEW}
SMALL = ["between_nodes=ignore", "search.starts=2", "search.leaps=1"]
F2 = ".structure=F2"
ROWS: dict[str, tuple[list[str], Mapping[str, list[str]]]] = {  # keys of the case: for both vehicles, for each
    "pd F4": ([], {"ksr3": [], "petrel": []}),
    "pid F4": (["law=pid"], {"ksr3": [], "petrel": []}),
    "incidence-relief F4": (["law=incidence-relief"], RELIEF),
    "load-relief F4": (["law=load-relief"], RELIEF),
    "pd F4, loop filters of attitude and rate F2": (
        [*SMALL, f"loop_filters.attitude{F2}", f"loop_filters.rate{F2}"],
        PLAIN,
    ),
    "load-relief F4, loop filter of acceleration F2": (
        [*SMALL, "law=load-relief", f"loop_filters.acceleration{F2}"],
        RELIEF,
    ),
    "pd F4, blended gyros": ([*SMALL, "blend=[-0.5, 1.5]"], PLAIN),
    **{f"pd {structure}": ([*SMALL, f"filter.structure={structure}"], PLAIN) for structure in ("F2", "F3", "F5", "F6")},
    "pd sections": ([*SMALL, "filter.structure=sections", "filter.quadratic=3", "filter.first_order=1"], PLAIN),
}
ADAPTED, IN_LOOPS = "pd F4, adaptation", "pd F4, loop filters of attitude and rate F2"
FLOWN_WITH = {  # overrides with which a design is flown
    (name, ADAPTED): [
        f"design.adaptive={{reference_hz={hz}, reference_zeta=0.8, error_gain_pdeg2s={error}, "
        f"damper_gain_pdeg2s=30.0, high_pass_hz={high_pass_hz}}}"
    ]
    for name, hz, error, high_pass_hz in (("ksr3", 0.45, 0.003, 4.0), ("petrel", 0.45, 0.05, 3.0))
} | {("petrel", IN_LOOPS): ["design.stage.1.fade_s=1.0"]}


def make(vehicle: str, name: str, folder: Path) -> dict[str, Any]:
    """Design, certify and fly the control law of a table row, and return the record of the row.

    A row without a case uses the design of "pd F4" with the changes in `FLOWN_WITH`.
    """
    base = folder / vehicle
    out = base / _plain(name)
    out.mkdir(parents=True, exist_ok=True)
    own = ROWS.get(name)
    design = (out if own is not None else base / _plain("pd F4")) / "design.toml"
    keys = [*own[0], *own[1][vehicle]] if own is not None else []
    row: dict[str, Any] = {"keys": keys}
    if own is not None:
        if not design.exists():
            with (out / "report.txt").open("w") as report, contextlib.redirect_stdout(report):
                run_case.make(str(base / "sensed.toml"), overrides=tuple(keys), out=str(out), page=False)
        row["said"] = (out / "report.txt").read_text().splitlines()[-1]
    if vehicle == "petrel" and name == "pd F4":  # the design of the upper stages in the other rows
        (base / "design.toml").write_bytes(design.read_bytes())
    scenario = "load-relief" if vehicle == "ksr3" else str(base / "sensors.toml")
    changes = [f"design={design}", *FLOWN_WITH.get((vehicle, name), ())]
    loaded = load_scenario(scenario, changes)
    stages = 1 if vehicle == "ksr3" or FIRST in keys or own is None else 3
    times = [t for stage in range(stages) for t in node_times(loaded, NODES, stage)]
    row["certified"] = _certified(loaded, times, out / "certificates.json")
    for air, wind in (("still", []), ("wind", [f"wind.profile='{_wind(vehicle, base)}'"])):
        flown = fly(load_scenario(scenario, [*changes, *wind]), log=False)
        row[air] = {k: flown.metrics[k] for k in ("max_attitude_error_deg", "max_gimbal_deg", "max_q_alpha_Padeg")}
        row[air]["missed"] = [v.name for v in flown.verdicts if not v.met] + list(flown.failures)
    (out / "row.json").write_text(json.dumps(row, indent=1))
    return row


def _certified(loaded: LoadedScenario, times_s: list[float], kept: Path) -> dict[str, Any]:
    """Return the content of each operating point's certificate, by time and plane.

    Certificates in `kept` that agree are not repeated.
    """
    found = json.loads(kept.read_text()) if kept.exists() else {}
    for plane in PLANES:
        for node in operating_points.nodes(loaded, times_s, plane=plane):
            key = f"{node.time_s:g} s {plane}"
            if not found.get(key, {}).get("agrees"):
                c = certify_node(loaded, node)
                room = [c.total_gain_room_db(end) for end in (0, 1) if c.total_gain_db[end] != 0.0]
                margins = [[m.what, m.unit, m.held, m.measured, m.reason] for m in c.margins]
                found[key] = {"agrees": c.agrees, "said": c.unexplained, "margins": margins, "room_db": room}
                kept.write_text(json.dumps(found, indent=1))
    return found


def _wind(vehicle: str, base: Path) -> str:
    return LIMIT_WIND[vehicle] if vehicle == "ksr3" else str(base / LIMIT_WIND[vehicle])


def _plain(name: str) -> str:
    return name.replace(",", "").replace(" ", "-")


def line(vehicle: str, name: str, row: dict[str, Any]) -> str:
    """Return a row of the table."""
    found = row["certified"].values()
    off = {"dB": 0.0, "s": 0.0}  # gain margins in dB, delay margins as a share
    for _, unit, held, measured, _ in (m for c in found for m in c["margins"]):
        if unit in off and not math.isnan(measured):
            off[unit] = max(off[unit], abs(measured - held) / (1.0 if unit == "dB" else held))
    said = row.get("said", "that of pd F4, adapted").removeprefix("DESIGNED: ").replace("least |1 + L| ", "")
    said = said.removesuffix(", all limits met")
    flown = [
        f"{air['max_attitude_error_deg']:.2f}, {air['max_gimbal_deg']:.2f}, {air['max_q_alpha_Padeg']:,.0f}"
        + (f" ({' and '.join(air['missed'])} missed)" if air["missed"] else "")
        for air in (row["still"], row["wind"])
    ]
    apart, agreed = f"{off['dB']:.2f}; {100.0 * off['s']:.2f}", sum(c["agrees"] for c in found)
    apart += f" ({agreed} of {len(found)} agree)" if agreed < len(found) else ""
    cells = [name, NAMES[vehicle], said, apart, *flown]
    return f"| {' | '.join(cells)} |"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="rows with this word in vehicle or name")
    parser.add_argument("--write", action="store_true", help="write the rows into docs/flights/results.md")
    choice = parser.parse_args()
    folder = choice.folder.resolve()
    for vehicle, case in CASES.items():
        base = folder / vehicle
        if vehicle == "petrel" and not (base / "case.toml").exists():
            with contextlib.redirect_stdout(sys.stderr):
                simvehicle.main(["petrel", "--out", str(base)])
            (base / "sensors.toml").write_text(SENSORS)
        base.mkdir(parents=True, exist_ok=True)
        (base / "sensed.toml").write_text(f"schema = 1\n{case}")
    lines, good = [], True
    written = {tuple(row.split(" | ")[:2]): row for row in DOCUMENT.read_text().splitlines()}
    for name in (*ROWS, ADAPTED):
        for vehicle in CASES:
            kept = folder / vehicle / _plain(name) / "row.json"
            if choice.only in f"{vehicle} {name}" and not kept.exists():
                make(vehicle, name, folder)
            if kept.exists():
                row = json.loads(kept.read_text())
                print(text := line(vehicle, name, row), flush=True)
                lines += [text] if name not in UNSHOWN else []
                met = "all limits met" in row.get("said", "all limits met")
                good = good and met and all(c["agrees"] for c in row["certified"].values())
            elif (before := written.get((f"| {name}", NAMES[vehicle]))) is not None:
                lines.append(before)
    if choice.write:
        rewrite(DOCUMENT, "laws", "\n".join([HEAD, *lines]))
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
