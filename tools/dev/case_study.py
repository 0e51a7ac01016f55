"""The tables of docs/case-study/, made by the shipped commands: `python -m maxq.tools.dev.case_study [TABLE...]`.

The module runs simdesign, simrun and simverify, stores their results under runs/case-study, and uses existing results.
It writes each table between its marks in docs/case-study. All tables take about two hours on two cores, most of them
for campaigns and verdicts. `--pictures` copies the pictures of simdesign into docs/pictures/case-study.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from maxq.design import operating_points
from maxq.design.case.basis import Robust
from maxq.design.case.schema import read_case
from maxq.design.laws.design_file import load_design
from maxq.design.model.deviations import deviations_of
from maxq.design.model.node import Node
from maxq.design.model.spread import campaign_of
from maxq.design.optimise.robust import Ranges, deviated
from maxq.design.quantities import MEASURED, SWEPT
from maxq.design.verify.judging import judge
from maxq.design.verify.linear import meet_limits, percentiles, study
from maxq.design.verify.memory import PartsOnDisk
from maxq.design.verify.suite import LinearMargins, WorstWanted, read_suite
from maxq.design.verify.worst import distance, search_node
from maxq.sim.campaign.read import LoadedCampaign, load_campaign
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.scenario.schema_design import Design
from maxq.tools.dev.pictures.tour import save_small

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGES, PARAMETERS, PICTURES = DOCS / "case-study", DOCS / "case-study.json", DOCS / "pictures" / "case-study"
RUNS = Path("runs/case-study")
COMPARED = ("ksr3-two-phase", "ksr3-robust")
FLOWN = ("ksr3-default", *COMPARED)
ROBUST = (
    "ksr3-robust",
    "ksr3-robust-ascent",
)  # with one sign for both tanks and one for all modes, and with independent signs
STRUCTURES, SCHEDULES = ("F2", "F3", "F4", "F5", "F6"), ("two-phase", "linear", "free")
SHOWN = ("F2", "F4", "F6")  # structures in tables with a row for each structure and schedule
LIMITS, PLANTS = ("identical", "relaxed"), {"flown": "the reconstructed vehicle", "table2": "the plant of Table 2"}
CLAIMS = ("3 to 5 dB on the two-phase design", "a further 0.33 to 0.57 dB")  # the paper's claims on Subcases 1 and 2
RELAXED_BY = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)  # shares of the way from 0.5 Hz and 0.7 to 0.4 Hz and 0.55
_LOAD, _ACTUATOR = "vehicle.stage.0.tvc_load={frequency_hz=15.6, damping_ratio=0.042}", "vehicle.stage.0.actuator."
ON_COMPLIANCE: dict[str, tuple[str, ...]] = {
    "following": (),
    "[28] as piston": (_LOAD,),
    "H1 H2 as piston": (
        _LOAD,
        f"{_ACTUATOR}model='fourth-order'",
        f"{_ACTUATOR}omega_hz=[5.8, 7.2]",
        f"{_ACTUATOR}zeta=[0.87, 0.49]",
    ),
}
ON_LOAD = 1000  # random vehicles
MARGINS = ("gain, dB", "phase, deg", "least \\|1+L\\|")
CORNERS, CORNER_SIGMAS = 40, Robust().corner_sigmas
POINTS_S = (1.0, 22.0, 45.0, 65.0, 85.0)  # of the launcher with boosters: a fifth of the points that a case chooses
BOOSTERS: dict[str, tuple[str, ...]] = {  # changes of the case that simvehicle writes
    "two-phase": ("gains.schedule='two-phase'", "objective.kind='first-mode-peak'"),
    "integrated": ("gains.schedule='linear'", "objective.kind='first-mode-peak'"),
    "robust": ("gains.schedule='linear'", "objective.kind='least-margin'", "robust={}"),
}
BOOSTERS_FLOWN: dict[str, tuple[str, ...]] = {
    "limit wind": ("wind.profile=vehicle/limit_wind.csv",),
    "burn rates 1.02, 0.98": (
        "vehicle.stage.0.booster.0.engine.mass_flow_factor=1.0212",
        "vehicle.stage.0.booster.1.engine.mass_flow_factor=0.9788",
    ),
}
TextRows = Sequence[Sequence[str]]


def kept(file: str, command: str, *arguments: str, folder: str = "") -> Any:
    """Return the JSON that a command writes into its folder under RUNS. Run the command if the file is missing.

    Raises SystemExit if the command does not write the file.
    """
    path = RUNS / file
    if not path.exists():
        line = [command, *arguments, "--out", str(RUNS / folder if folder else path.parent)]
        print(" ".join(line), file=sys.stderr)
        records = os.environ | {"MAXQ_LEDGER": str(RUNS / "attempts")}  # not those of the user
        program = Path(sys.executable).with_name(command)
        done = subprocess.run([program, *line[1:]], check=False, stdout=subprocess.PIPE, env=records)
        if not path.exists():
            raise SystemExit(f"{' '.join(line)}: exit code {done.returncode}")
    return json.loads(path.read_text(encoding="utf-8"))


def set_(changes: Iterable[str]) -> list[str]:
    return list(itertools.chain.from_iterable(("--set", change) for change in changes))


def table(head: Sequence[str], rows: TextRows) -> list[str]:
    """Return a Markdown table as lines. Columns of numbers are aligned to the right."""
    numeric = [all(re.match(r"[-+]?\d|$", row[k]) for row in rows) for k in range(len(head))]
    rule = "|" + "".join("---:|" if n else "---|" for n in numeric)
    return ["| " + " | ".join(head) + " |", rule, *("| " + " | ".join(row) + " |" for row in rows)]


# Optima


def solve_optima() -> None:
    """Solve the sixty problems and write docs/case-study.json, the source of several tables."""
    every = []
    for plant, name in itertools.product(PLANTS, LIMITS):
        arguments = [f"ksr3-{name}", "--orders", "--plots", *set_([f"plant={plant}"])]
        found = kept(f"optima-{plant}-{name}/design.json", "simdesign", *arguments)["orders"]
        every += [{"plant": plant, "limits": name} | o for o in found]
    PARAMETERS.write_text(json.dumps({"optima": every}, separators=(",", ":")) + "\n", encoding="utf-8")


@functools.cache
def orders(plant: str, limits: str) -> Mapping[tuple[str, str], Any]:
    """Return fifteen optima by structure and schedule."""
    every = json.loads(PARAMETERS.read_text(encoding="utf-8"))["optima"]
    return {(o["structure"], o["schedule"]): o for o in every if (o["plant"], o["limits"]) == (plant, limits)}


def peak(optimum: Any) -> float:
    """Return the objective of an optimum, dB, or NaN if limits are missed."""
    return float(optimum["objective_db"]) if optimum["status"] == "optimal" else math.nan


def gained(plant: str, limits: str) -> tuple[list[float], list[float]]:
    """Return the gains of Subcase 1 over the two-phase design and of Subcase 2 over Subcase 1, dB, by structure."""
    peaks = [[peak(orders(plant, limits)[f, s]) for f in STRUCTURES] for s in SCHEDULES]
    return tuple([a - b for a, b in zip(*pair, strict=True)] for pair in itertools.pairwise(peaks))  # type: ignore[return-value]  # a pair


def peaks() -> list[str]:
    """Return the tables of the optima for the reconstructed vehicle."""
    lines = []
    for plant, limits in itertools.product(("flown",), LIMITS):
        found, rows = orders(plant, limits), []
        for f in SHOWN:
            first, second = (g[STRUCTURES.index(f)] for g in gained(plant, limits))
            agree = ", ".join(f"{o['near_best']}/{o['starts']}" for o in (found[f, s] for s in SCHEDULES))
            two, one, free = (_n(peak(found[f, s])) for s in SCHEDULES)
            rows.append((f, two, one, _n(first), free, _n(second), agree))
        head = ("filter", "two-phase", "Subcase 1", "gained", "Subcase 2", "gained further", "starts at the best")
        title = f"**{PLANTS[plant].capitalize()}, {limits} limits** (largest peak of mode 1, dB)"
        lines += ["", title, "", *table(head, rows)]
    return lines[1:]


def claims() -> list[str]:
    pairs = list(itertools.product(PLANTS, LIMITS))
    rows = [
        [f"Subcase {n + 1} gains {claim}", *(_span(gained(*pair)[n]) for pair in pairs)]
        for n, claim in enumerate(CLAIMS)
    ]
    falls = []
    for pair in pairs:
        steps = [
            peak(orders(*pair)[a, s]) - peak(orders(*pair)[b, s])
            for s in SCHEDULES
            for a, b in itertools.pairwise(STRUCTURES)
        ]
        falls.append(f"yes, by at least {min(steps):.2f} dB" if min(steps) > 0.0 else f"no: {min(steps):.2f} dB")
    rows.append(["the peak falls with every order of the filter", *falls])
    return table(["claim of the paper", *(f"{plant}, {limits}" for plant, limits in pairs)], rows)


def between() -> list[str]:
    """Return a table of the optima's least margins between their eleven operating points.

    Its last columns are the peak with limits imposed between the points, and the cost of this.
    """
    folder, at_nodes, rows = RUNS / "optima-flown-identical", orders("flown", "identical"), []
    kept(f"{folder.name}/design.json", "simdesign", "ksr3-identical", "--orders", "--plots", *set_(["plant=flown"]))
    changes = set_(["between_nodes=hold"])
    record = kept("between/design.json", "simdesign", "ksr3-identical", "--orders", "--no-pictures", *changes)
    held = {(o["structure"], o["schedule"]): o for o in record["orders"]}
    nodes = operating_points.nodes("nominal", np.arange(5.0, 55.01, 0.25))
    for (f, s), o in at_nodes.items():
        if f not in SHOWN:
            continue
        found = judge(nodes, load_design(folder / f"{f}-{s}" / "design.toml"), "pade")
        gain, phase = ([j.gain_margin_db for j in found], [j.margins.phase_deg.value for j in found])
        least = [f"{min(v):.{d}f} at {nodes[int(np.argmin(v))].time_s:g} s" for v, d in ((gain, 2), (phase, 1))]
        cost = peak(held[f, s]) - peak(o)
        rows.append((f, s, _n(peak(o)), *least, _n(peak(held[f, s])), _n(cost)))
    head = (
        "filter",
        "gains",
        "peak, dB",
        "least gain margin, dB",
        "least phase margin, deg",
        "peak held, dB",
        "cost, dB",
    )
    return table(head, rows)


def relaxing() -> list[str]:
    """Return a table of the gain of Subcase 1, with relaxed rigid-body limits, over the two-phase design without
    relaxation.
    """
    reference, rows = orders("flown", "identical"), []
    for share in RELAXED_BY:
        hz, zeta = 0.5 - 0.1 * share, 0.7 - 0.15 * share
        changes = set_([f"limits.rigid_hz={hz!r}", f"limits.rigid_zeta={zeta!r}"])
        record = kept(
            f"relaxed-{share}/design.json", "simdesign", "ksr3-identical", "--orders", "--no-pictures", *changes
        )
        found = {o["structure"]: o for o in record["orders"] if o["schedule"] == "linear"}
        cells = [_n(peak(reference[f, "two-phase"]) - peak(found[f])) for f in STRUCTURES]
        rows.append((f"{hz:.3f} Hz, {zeta:.4f}", f"{20.0 * math.log10(hz * zeta / 0.35):.1f} dB", *cells))
    return table(("rigid-body limits", "k_d", *STRUCTURES), rows)


def limits() -> list[str]:
    """Return a table of the two sets of limits."""
    cases = [read_case(f"ksr3-{name}").case for name in LIMITS]
    names = {
        "gain_margin_db": "GM_R (44), dB",
        "phase_margin_deg": "PM_R (45), deg",
        "second_mode_db": "P2_UL (43), dB",
        "filter_gain_at_infinity": "P^F (46)",
        "rigid_hz": "omega_RB,min (47), Hz",
        "rigid_zeta": "zeta_RB,min (48)",
    }
    rows = [(text, *(f"{getattr(c.limits, key):g}" for c in cases)) for key, text in names.items()]
    for key in type(cases[0].filter.bounds).model_fields:
        spans = (getattr(c.filter.bounds, key) for c in cases)
        rows.append((f"bounds of {key} (50)", *(f"{low:g} to {high:g}" for low, high in spans)))
    return table(("limit", *LIMITS), rows)


# Robustness and flights


def robust() -> list[str]:
    """Return the worst margins on the sampled loop: nominal, and at forty random corners of all ranges."""
    nodes, ranges, rows = operating_points.nodes("nominal", range(5, 60, 5)), Ranges(_ranges(), CORNER_SIGMAS), []
    for name in ("ksr3-default", "ksr3-two-phase", "ksr3-linear", "ksr3-sampled", "ksr3-robust"):
        design = load_design(f"designs/{name}")
        stable, least = at_corners(nodes, design, ranges)
        rows.append((name, *_three(worst(nodes, design)), str(stable), *_three(least)))
    head = ("design", *MARGINS, f"stable, of {CORNERS} corners", *(f"{w}, corners" for w in MARGINS))
    return table(head, rows)


def at_corners(nodes: Sequence[Node], design: Design, ranges: Ranges) -> tuple[int, tuple[float, float, float]]:
    """Return the number of random corners at which the design is stable, and the least of `worst` (NaN: unstable)."""
    ends = np.random.default_rng(2002).choice([-1, 1], (CORNERS, len(deviations_of(ranges.campaign, nodes[0]).places)))
    off = [worst([deviated(n, ranges, [int(e) for e in row]) for n in nodes], design) for row in ends]
    stable = sum(not math.isnan(w[0]) for w in off)
    gain, phase, least = ((min(v) if stable == CORNERS else math.nan) for v in zip(*off, strict=True))
    return stable, (gain, phase, least)


def _three(margins: tuple[float, float, float]) -> list[str]:
    return ["unstable" if math.isnan(w) else f"{w:.{digits}f}" for w, digits in zip(margins, (2, 1, 3), strict=True)]


def vehicles() -> list[str]:
    """Return a table of the random vehicles of the standard suite at seven operating points in pitch.

    Its last column is the worst vehicle found within three sigma of all deviations together.
    """
    wanted, nodes = _margins_wanted(), operating_points.nodes("nominal", (0.3, 10.0, 20.0, 35.0, 45.0, 53.5, 58.0))
    rows, share, flown = [], 1.0 - wanted.success, load_campaign("campaigns/ksr3")
    for name in ROBUST:
        design = load_design(f"designs/{name}")
        random = study(nodes, design, wanted, flown, PartsOnDisk(None)).random
        searched = [search_node(node, design, flown, wanted.worst or WorstWanted())[0] for node in nodes]
        k = int(np.argmin(searched))
        shown = []
        for key in SWEPT:
            unit, sense = MEASURED[key].unit, MEASURED[key].sense
            bound = percentiles(random, key, wanted.confidence, (share,))[0]
            worst_of_all = bound.min() if sense == ">=" else bound.max()
            shown.append(f"{worst_of_all:.1f} {unit}" if math.isfinite(worst_of_all) else "free")
        lost = int(np.isnan(random).all(axis=-1).any(axis=-1).sum())
        bad = int((~meet_limits(random, wanted.dispersed)).sum())
        least = f"{max(searched[k], 0.0):.3f} at {nodes[k].time_s:g} s"
        rows.append((name, str(lost), f"{bad} of {len(random)}", *shown, least))
    head = (MEASURED[key].label for key in SWEPT)
    return table(("design", "unstable", "miss a dispersed limit", *head, "least \\|1+L\\| found"), rows)


def corners() -> list[str]:
    """Return a table of the least |1 + L| of both robust designs at the worst corners that a search finds for
    either.
    """
    designs, rows = [load_design(f"designs/{name}") for name in ROBUST], []
    for node in operating_points.nodes("nominal", (0.3, 35.0, 45.0, 58.0)):
        cells = [f"{w:.3f}" for w in (worst([node], design)[2] for design in designs)]
        for sigmas in (2.0, 3.0):
            wanted = WorstWanted(region="box", sigmas=sigmas, seed=2)
            found = [search_node(node, design, _ranges(), wanted)[1] for design in designs]
            least = [min(distance(node, design, _ranges())(u)[0] for u in found) for design in designs]
            cells += [f"{x:.3f}" if x > 0.0 else f"unstable ({-x:.3f})" for x in least]
        rows.append((f"{node.time_s:g}", *cells))
    about = ("as designed", "2 sigma each", "3 sigma each")
    return table(("at, s", *(f"{what}, {name}" for what in about for name in ROBUST)), rows)


@functools.cache
def _ranges() -> LoadedCampaign:
    """Return the campaign of deviations of a robust case of KSR-III."""
    return campaign_of(Robust(), load_scenario("nominal"))


def _margins_wanted() -> LinearMargins:
    wanted = read_suite("standard").suite.margins
    assert wanted is not None
    return wanted


def tvc_load() -> list[str]:
    """Return a table of the worst margins in both planes, with the engine following its actuators and on a compliance.

    It includes the number of random vehicles, in pitch, that miss a dispersed limit of the standard suite.
    """
    wanted = _margins_wanted().model_copy(update={"cases": ON_LOAD})
    times = (0.4, 3.0, *range(5, 60, 5), 58.0)
    plants = []
    for set_to in ON_COMPLIANCE.values():
        loaded = load_scenario("load-relief", (*set_to, "design='designs/ksr3-robust.toml'"))  # the flight of nominal
        deviating = campaign_of(wanted.three_sigma, loaded)
        pitch, yaw = operating_points.nodes(loaded, times), operating_points.nodes(loaded, times, plane="yaw")
        plants.append((pitch, yaw, deviating))
    rows = []
    for name in FLOWN:
        design, row = load_scenario("load-relief", (f"design='designs/{name}.toml'",)).design, [name]
        assert design is not None
        for pitch, yaw, deviating in plants:
            row += [f"{w:.{digits}f}" for w, digits in zip(worst([*pitch, *yaw], design), (2, 1, 3), strict=True)]
            random = study(pitch, design, wanted, deviating, PartsOnDisk(None)).random
            row.append(str(int((~meet_limits(random, wanted.dispersed)).sum())))
        rows.append(row)
    what = ("dB", "deg", "\\|1+L\\|", f"miss, of {ON_LOAD:,}")
    return table(("design", *(f"{of}, {name}" for name in ON_COMPLIANCE for of in what)), rows)


def worst(nodes: Sequence[Node], design: Design) -> tuple[float, float, float]:
    """Return the least gain margin (dB), phase margin (deg) and |1 + L|, or NaN if an operating point is unstable."""
    judged = judge(nodes, design, "sampled")
    if not all(j.margins.stable for j in judged):
        return math.nan, math.nan, math.nan
    return (
        min(j.gain_margin_db for j in judged),
        min(j.margins.phase_deg.value for j in judged),
        min(j.margins.modulus for j in judged),
    )


SHOWN_IN_FLIGHT = {
    "max_q_alpha_Padeg": ("q alpha, kPa deg", 1e-3, 1),
    "max_attitude_error_deg": ("attitude error, deg", 1.0, 2),
    "max_gimbal_deg": ("gimbal angle, deg", 1.0, 2),
    "max_gimbal_rate_degps": ("gimbal rate, deg/s", 1.0, 2),
    "max_slosh_deg": ("slosh angle, deg", 1.0, 2),
}


def in_flight(scenario: str, flights: Mapping[tuple[str, str], Sequence[str]]) -> list[str]:
    """Return the peak values of flights by design and conditions."""
    rows = []
    for (name, where), changes in flights.items():
        flight = fly(load_scenario(scenario, changes), log=False)
        cells = [f"{flight.metrics[m] * factor:.{digits}f}" for m, (_, factor, digits) in SHOWN_IN_FLIGHT.items()]
        missed = [v.name for v in flight.verdicts if not v.met] + list(flight.failures)
        rows.append((name, where, *cells, ", ".join(missed) or "none"))
    return table(("design", "flight", *(text for text, _, _ in SHOWN_IN_FLIGHT.values()), "limits missed"), rows)


def flights() -> list[str]:
    """Fly each design through the nominal ascent, without wind and through a November jet."""
    winds = {"none": [], "November jet": ["wind.profile=winds/anheung-november.csv"]}
    return in_flight(
        "nominal",
        {
            (name, wind): [f'design="designs/{name}.toml"', *profile]
            for name, (wind, profile) in itertools.product(FLOWN, winds.items())
        },
    )


# A launcher with boosters
def built_folder(name: str) -> Path:
    """Return the folder of a vehicle that `simvehicle` builds from its layout."""
    folder = RUNS / name
    if not (folder / "case.toml").exists():
        subprocess.run([Path(sys.executable).with_name("simvehicle"), name, "--out", folder], check=True)
    return folder


def boosters_designed() -> dict[str, Any]:
    """Return design.json of each design of the first stage, with boosters, for five operating points."""
    limits = (
        "stages=[1]",
        f"nodes_s={list(POINTS_S)}",
        "between_nodes='ignore'",
        "limits.gain_margin_db=6.0",
        "limits.phase_margin_deg=30.0",
        "limits.first_mode_phase_deg=30.0",
        "limits.second_mode_db=-6.0",
        "limits.modes_from_3_db=-6.0",
        "limits.rigid_hz=0.28",
        "reference.rigid_hz=0.28",
        "reference.rigid_zeta=0.5",
    )
    case = str(built_folder("heron") / "case.toml")
    return {
        name: kept(f"heron-{name}/design.json", "simdesign", case, "--no-pictures", *set_((*limits, *changes)))
        for name, changes in BOOSTERS.items()
    }


def boosters_points(times_s: Sequence[float]) -> dict[str, tuple[Design, Sequence[Node]]]:
    """Return each design with operating points of its own flight."""
    boosters_designed()
    out: dict[str, tuple[Design, Sequence[Node]]] = {}
    for name in BOOSTERS:
        loaded = load_scenario(str(built_folder("heron") / "scenario.toml"), [f'design="{_of(name)}"'])
        assert loaded.scenario.design is not None
        out[name] = loaded.scenario.design, operating_points.nodes(loaded, times_s)
    return out


def _of(name: str) -> str:
    return str((RUNS / f"heron-{name}" / "design.toml").resolve())


def boosters() -> list[str]:
    """Compare the peak of mode 1 and the margins: at the operating points, every 2 s, and at random corners."""
    deviating = campaign_of(Robust(), load_scenario(str(built_folder("heron") / "scenario.toml")))
    between, rows = boosters_points(np.arange(2.0, 85.0, 2.0).tolist()), []
    for name, (design, nodes) in boosters_points(POINTS_S).items():
        peak_db = max(j.mode_peak_db(1, 1) for j in judge(nodes, design, "sampled"))
        stable, least = at_corners(nodes, design, Ranges(deviating, CORNER_SIGMAS))
        nominal = (*_three(worst(nodes, design)), *_three(worst(between[name][1], design)))
        rows.append((name, f"{peak_db:.2f}", *nominal, str(stable), *_three(least)))
    nominal = (*MARGINS, *(f"{what}, every 2 s" for what in MARGINS))
    head = (
        "design",
        "mode 1, dB",
        *nominal,
        f"stable, of {CORNERS} corners",
        *(f"{what}, corners" for what in MARGINS),
    )
    return table(head, rows)


def boosters_flown() -> list[str]:
    """Fly the designs until the boosters leave."""
    boosters_designed()
    return in_flight(
        str(built_folder("heron") / "scenario.toml"),
        {
            (name, where): [f'design="{_of(name)}"', "run.duration_s=85.5", *changes]
            for name, (where, changes) in itertools.product(BOOSTERS, BOOSTERS_FLOWN.items())
        },
    )


def campaigns() -> list[str]:
    """Return a table of the requirements of both compared designs in a campaign with turbulence and gusts."""
    flown = []
    for design in COMPARED:
        changes = set_([f"design=designs/{design}.toml", "campaign.keep=[]"])
        file = f"campaigns-{design}/summary.json"
        flown.append(kept(file, "simrun", "campaigns/ksr3", "--runs", "2000", *changes)["requirements"])
    rows = []
    for of_both in zip(*flown, strict=True):
        for design, r in zip(COMPARED, of_both, strict=True):
            shown, first = r["shown"], design == COMPARED[0]
            met = [100.0 * shown[key] for key in ("success", "success_least", "success_most")]
            worst_run: dict[str, Any] = r["worst"][0] if r["worst"] else {"value": None}
            numbers = [_g(v) for v in (r["median"], worst_run["value"])]
            cells = (*numbers, str(shown["failures"]), "{:.2f} ({:.2f} to {:.2f})".format(*met))
            limit = f"{r['bound']:g} {r['unit']}" if r["metric"] else ""
            both = (r["name"], limit) if first else ("", "")
            rows.append((*both, design.removeprefix("ksr3-"), *cells, f"**{shown['judgement']}**"))
    head = ("requirement", "limit", "design", "median", "worst", "failed, of 2000")
    return table((*head, "met by, % of flights (90 % bounds)", "verdict"), rows)


# Verdicts


def judged() -> dict[str, dict[str, Any]]:
    """Return verdict.json of both robust designs for the standard suite. They share its risk."""
    first = kept(f"verdicts/{ROBUST[0]}/verdict.json", "simverify", *ROBUST, "--no-pack", folder="verdicts")
    return {ROBUST[0]: first, **{name: kept(f"verdicts/{name}/verdict.json", "simverify") for name in ROBUST[1:]}}


def verdicts() -> list[str]:
    """Return a table of every requirement that a robust design does not meet."""
    return lacking(judged())


def lacking(every: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a table of every requirement that a design does not meet; yaw is listed only if it differs from pitch.

    `every` contains verdict.json of each design for one suite.
    """
    of_each = [v["requirements"] for v in every.values()]
    by_name = [{r["name"]: r for r in reversed(of)} for of in of_each]  # pitch, if both planes have the requirement
    mark = {"accepted": "", "rejected": " ✗", "undecided": " ?"}
    rows = [("**verdict**", "", *(f"**{v['verdict'].upper()}**" for v in every.values()))]
    counts = ((sum(r["verdict"] == "accepted" for r in of), len(of)) for of in of_each)
    rows.append(("requirements met", "", *("{} of {}".format(*n) for n in counts)))
    shown = set[tuple[str, ...]]()
    for name, r in reversed(by_name[0].items()):
        mine = [of.get(name, {"found": "-", "verdict": ""}) for of in by_name]
        found = [re.sub(r", wanted [<>]=[^;]*| of \d+(?= failed)", "", m["found"]) for m in mine]
        if name.startswith("least |1 + L|"):
            found = [text.partition(";")[0] for text in found]
        key = (re.sub(", (pitch|yaw)(?=$|, stage)", "", name), *found)
        if key in shown:
            continue
        shown.add(key)
        if any(m["verdict"] != "accepted" for m in mine):
            cells = (text + mark.get(m["verdict"], "") for text, m in zip(found, mine, strict=True))
            rows.append((name.replace("|", "\\|"), r["wanted"].removesuffix(", 99.73 % with 95 %"), *cells))
    return [*table(("requirement", "limit", *every), rows), "", "✗ missed, ? undecided, - not required."]


def heron() -> list[str]:
    """Return the verdict of heron's own suite on its design of all stages."""
    folder, made = built_folder("heron"), RUNS / "heron-every"
    kept("heron-every/design.json", "simdesign", str(folder / "case.toml"), "--no-pictures")
    found = kept("verdicts/heron/verdict.json", "simverify", str(made), "--suite", str(folder / "suite.toml"))
    return lacking({"heron": found})


def _n(value: float) -> str:
    return "infeasible" if math.isnan(value) else f"{value:.2f}"


def _g(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


def _span(values: Sequence[float]) -> str:
    good = [v for v in values if not math.isnan(v)]
    return f"{min(good):.2f} to {max(good):.2f}" if good else "infeasible"


TABLES: dict[str, Callable[[], list[str]]] = {
    "limits": limits,
    "claims": claims,
    "peaks": peaks,
    "relaxing": relaxing,
    "between": between,
    "robust": robust,
    "vehicles": vehicles,
    "corners": corners,
    "tvc-load": tvc_load,
    "flights": flights,
    "campaigns": campaigns,
    "verdicts": verdicts,
    "heron": heron,
    "boosters": boosters,
    "boosters-flown": boosters_flown,
}


def copy_pictures() -> None:
    """Copy the pictures of `simdesign` under the names that the chapter uses."""
    drawn = RUNS / "optima-flown-identical"
    _copy(drawn / "orders-peaks.png", PICTURES / "peaks-identical.png")
    _copy(RUNS / "optima-flown-relaxed" / "orders-peaks.png", PICTURES / "peaks-relaxed.png")
    for kind, schedule in itertools.product(("gains", "filters"), SCHEDULES):
        _copy(drawn / f"orders-{kind}-{schedule}.png", PICTURES / f"{kind}-{schedule}.png")
    for name in COMPARED:
        kept(f"analysis-{name}/analysis.json", "simdesign", "analyse", name, "--kind", "sampled", "--plots")
        folder = RUNS / f"analysis-{name}"
        _copy(folder / "loop-040.0s.png", PICTURES / f"loop-{name}.png")
        _copy(folder / "lobes.png", PICTURES / f"lobes-{name}.png")
        _copy(folder / "margins.png", PICTURES / f"margins-{name}.png")
    for path in drawn.glob("vehicle-*.png"):
        _copy(path, PICTURES / path.name)


def _copy(drawn: Path, target: Path) -> None:
    with Image.open(drawn) as picture:
        save_small(picture.convert("RGB"), target)


def page_of(name: str) -> Path:
    """Return the page that contains the marks of a table."""
    return next(page for page in PAGES.glob("*.md") if f"<!-- begin {name} -->" in page.read_text(encoding="utf-8"))


def fill(page: str, name: str, lines: Sequence[str]) -> str:
    """Return the page with `lines` between `<!-- begin name -->` and `<!-- end name -->`.

    Raises ValueError unless the page contains this pair of marks once.
    """
    filled, count = re.subn(
        rf"(<!-- begin {name} -->\n).*?(<!-- end {name} -->)",
        lambda marks: "\n".join([marks[1], *lines, "", marks[2]]),
        page,
        flags=re.DOTALL,
    )
    if count != 1:
        raise ValueError(f"the page has {count} places for {name}")
    return filled


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tables", nargs="*", choices=[*TABLES, []], metavar="TABLE", help=", ".join(TABLES))
    parser.add_argument("--pictures", action="store_true", help="copy the pictures, too")
    given = parser.parse_args()
    if not given.tables:
        solve_optima()
    for name in given.tables or TABLES:
        page = page_of(name)
        page.write_text(fill(page.read_text(encoding="utf-8"), name, TABLES[name]()), encoding="utf-8")
    if given.pictures:
        copy_pictures()
    return 0


if __name__ == "__main__":
    sys.exit(main())
