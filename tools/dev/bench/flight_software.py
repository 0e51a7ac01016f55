"""The benchmark of external flight code against the built-in law: its cost, and a bitwise comparison of exported C.

Flights of KSR-III of 59 s alternate between the built-in law, the law exported as C (`simdesign export --c`) and
examples/flight_software/pd_law.py. Batches of runs of campaigns/ksr3 on one core alternate in the same way. Their rate
is per second of CPU time of the simulator and its workers. `--bits N` instead flies N dispersed flights of 70 s for
each law and filter structure with the built-in and with the exported law, and compares their state hashes.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from maxq.sim.campaign.own_kernels import load_kernels
from maxq.sim.campaign.read import load_campaign
from maxq.sim.campaign.runs import fly_rows
from maxq.sim.run.fly import fly
from maxq.sim.run.guard import end_workers
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.design.export import export_c

PYTHON_LAW = Path(__file__).resolve().parents[3] / "examples/flight_software/pd_law.py"
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off")
SENSORS = (
    "vehicle.stage.0.accelerometer={station_m=3.05, omega_hz=60.0, zeta=0.65, count_mps=0.001}",
    "vehicle.stage.0.rate_gyro=[{station_m=9.2, omega_hz=60.0, zeta=0.65}]",
)
QUADRATIC = (
    "{zero_hz=28.48, zero_zeta=0.315, pole_hz=13.7, pole_zeta=1.2}",
    "{zero_hz=3.77, zero_zeta=1.2, pole_hz=5.73, pole_zeta=0.3}",
)
BATCH = 24  # runs
FIRST_ORDER = ("{zero_hz=9.0, pole_hz=9.5}", "{zero_hz=30.0, pole_hz=33.0}")
SECTIONS = {"none": (0, 0), "F2": (1, 0), "F3": (1, 1), "F4": (2, 0), "F5": (2, 1), "F6": (2, 2), "sections": (2, 1)}
MORE_GAINS = {
    "pd": ("", ""),
    "pid": (", k_i_ps=0.2", ", k_i_ps=0.1"),
    "load-relief": (", k_a_s2pm=0.004", ", k_a_s2pm=0.01"),
    "incidence-relief": (
        ", k_alpha=0.2, percussion_m=4.0, accel_per_incidence_mps2=-20.0",
        ", k_alpha=0.4, percussion_m=5.0, accel_per_incidence_mps2=-60.0",
    ),
    "drift": (", k_zd_radspm=0.001, k_z_radpm=1e-4", ", k_zd_radspm=0.002, k_z_radpm=2e-4"),
    "pid-drift": (", k_i_ps=0.1, k_zd_radspm=0.001, k_z_radpm=1e-4", ", k_i_ps=0.2, k_zd_radspm=0.002, k_z_radpm=2e-4"),
}
OPTIONS = {
    "gains over mass": "",
    "blended gyros": "[blend]\npitch = [0.7, 0.3]\n",
    "adaptation": "adaptive = {reference_hz=0.4, error_gain_pdeg2s=0.2, damper_gain_pdeg2s=300.0, high_pass_hz=2.0}\n",
    "a filter in each loop": "".join(
        f"[loop_filters.{loop}]\nstructure = 'F2'\nquadratic = [{QUADRATIC[0]}]\nprewarp_hz = 9.5\n"
        for loop in ("attitude", "rate")
    ),
}


def design_text(law: str, structure: str, option: str) -> str:
    """Return a design file with round numbers near those of ksr3-robust."""
    quadratic, first_order = SECTIONS[structure]
    over = ("mass_kg", 3500.0, 5500.0) if option == "gains over mass" else ("time_s", 5.0, 50.0)
    rows = [
        f"{{{over[0]}={at}, k_p={k_p}, k_d_s={k_d}{more}}}"
        for at, k_p, k_d, more in zip(over[1:], (1.1, 0.7), (0.47, 0.37), MORE_GAINS[law], strict=True)
    ]
    relief = "[load_relief]\ncorner_hz = 1.3\n" if law.endswith("relief") else ""
    own = OPTIONS.get(option, "")
    above, below = (own, "") if own.startswith("adaptive") else ("", own)
    return (
        f"schema = 1\nlaw = '{law}'\n{above}[gains]\ntable = [{', '.join(rows)}]\n[filter]\nstructure = '{structure}'\n"
        f"quadratic = [{', '.join(QUADRATIC[:quadratic])}]\nfirst_order = [{', '.join(FIRST_ORDER[:first_order])}]\n"
        f"prewarp_hz = 9.5\n{relief}{below}"
    )


def built(folder: Path, *changes: str) -> list[str]:
    """Compile the law of a scenario, exported as C, to a library, and return the overrides that fly it."""
    export_c(load_scenario("nominal", changes), folder)
    sources = [str(folder / name) for name in ("flight_law.c", "flight_law_tables.c", "flight_law_fsw.c")]
    subprocess.run(["cc", *FLAGS, "-shared", "-fPIC", "-o", str(folder / "libfsw.so"), *sources], check=True)
    return ["vehicle.computer.law=external", f"vehicle.computer.library={folder / 'libfsw.so'}"]


def campaign_rates(kinds: dict[str, list[str]], batches: int) -> dict[str, list[float]]:
    """Return the runs per second of CPU time of each kind, in batches that alternate between the kinds."""
    rates: dict[str, list[float]] = {kind: [] for kind in kinds}
    campaigns = {}
    for kind, own in kinds.items():
        campaigns[kind] = load_campaign("campaigns/ksr3", ["campaign.keep=[]", *own]).with_campaign(runs=BATCH)
        load_kernels(campaigns[kind])
    for number in range(batches + 1):
        for kind, campaign in campaigns.items():
            start = sum(os.times()[:4])
            drawn = campaign.plan.draw(0, BATCH)
            fly_rows(campaign, [(drawn, run) for run in range(BATCH)])
            end_workers()  # because the time of a process counts once it has ended
            if number > 0:  # the first batches load code
                rates[kind].append(BATCH / (sum(os.times()[:4]) - start))
    return rates


def costs(rounds: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as scratch:
        library = built(Path(scratch))
        python = ["vehicle.computer.law=external", f"vehicle.computer.python={PYTHON_LAW}:Autopilot"]
        kinds = {"built-in": [], "C": library, "Python": python}
        loaded = {kind: load_scenario("nominal", ["run.duration_s=59", *own]) for kind, own in kinds.items()}
        spent: dict[str, dict[bool, list[float]]] = {kind: {True: [], False: []} for kind in kinds}
        for number in range(rounds + 1):
            for kind, scenario in loaded.items():
                for log in (False, True):
                    start = time.perf_counter()
                    fly(scenario, log=log)
                    if number > 0:  # the first flights compile
                        spent[kind][log].append(time.perf_counter() - start)
        rates = campaign_rates({kind: kinds[kind] for kind in ("built-in", "C")}, rounds)
    middle = {kind: {log: statistics.median(v) for log, v in by.items()} for kind, by in spent.items()}
    return {
        "wall_s": {
            kind: {"without log": round(v[False], 4), "with log": round(v[True], 4)} for kind, v in middle.items()
        },
        "c_over_built_in": [round(middle["C"][log] / middle["built-in"][log], 3) for log in (False, True)],
        "campaign_per_cpu_s": {kind: round(statistics.median(v), 2) for kind, v in rates.items()},
        "campaign_c_over_built_in": round(
            statistics.median(c / own for c, own in zip(rates["C"], rates["built-in"], strict=True)), 3
        ),
    }


def bits(runs: int) -> dict[str, int]:
    """Return the number of dispersed flights, out of `runs`, with equal state hashes for each law and structure."""
    chosen = [("pd", structure, "") for structure in SECTIONS]
    chosen += [(law, "F4", "") for law in MORE_GAINS if law != "pd"] + [("pd", "F4", option) for option in OPTIONS]
    out = {}
    for law, structure, option in chosen:
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "design.toml"
            path.write_text(design_text(law, structure, option))
            sensors = SENSORS if law.endswith(("relief", "drift")) or option == "blended gyros" else ()
            changes = [f"design={path}", *sensors]
            library, hashes = built(Path(scratch) / "law", *changes), []
            for own in ([], library):
                campaign = load_campaign("campaigns/ksr3", ["run.duration_s=70", "campaign.keep=[]", *changes, *own])
                drawn = campaign.with_campaign(runs=runs).plan.draw(0, runs)
                hashes.append([row.state_hash for row in fly_rows(campaign, [(drawn, run) for run in range(runs)])])
            name = ", ".join(part for part in (law, structure, option) if part)
            out[name] = sum(a == b for a, b in zip(*hashes, strict=True))
            assert len(set(hashes[0])) == runs, "the flights are alike"
            print(f"{name}: {out[name]} of {runs} the same", file=sys.stderr, flush=True)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=9, help="flights and batches of runs of each kind (default 9)")
    parser.add_argument("--bits", type=int, default=0, help="dispersed flights of each law and structure")
    choice = parser.parse_args()
    print(json.dumps(bits(choice.bits) if choice.bits else costs(choice.rounds), indent=1))


if __name__ == "__main__":
    main()
