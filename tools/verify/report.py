"""The printed and written results of `simverify`: tables of requirements, ranking, verdict.json and the review pack."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, cast

from maxq.design.certificate.certificate import NodeCertificate
from maxq.design.certificate.measured_only import MeasuredNode
from maxq.design.verify.compared import against_basis
from maxq.design.verify.flown import FlownResult
from maxq.design.verify.names import tank_name
from maxq.design.verify.suite import ACCEPTED, REJECTED, SCREENED, UNDECIDED, JudgedRequirement
from maxq.design.verify.verify import Verification
from maxq.design.verify.worst import WorstVehicle
from maxq.sim.campaign.analysis import finer_text
from maxq.sim.campaign.statistics import MET, NOT_MET
from maxq.sim.files import plain_name, write_whole
from maxq.sim.flight.metric_table import unit_of
from maxq.sim.run.metrics import Verdict
from maxq.sim.run.quantities import engineering_unit, unit_text
from maxq.tools.cli.terminal import aligned, printable
from maxq.tools.design.report import GAIN_HEADS, uncovered_lines, uncovered_record, uncovered_table, write_record
from maxq.tools.pages.render import render
from maxq.tools.plots.figures import Plot, as_csv
from maxq.tools.verify.board import board_record, board_tables, waiver_lines
from maxq.tools.verify.outcome import headline
from maxq.tools.verify.record_model import FlightRecord, RequirementRecord, VerdictRecord
from maxq.tools.verify.records import RESULTS_NAME, file_hashes, record_lines, records, write_attempts, write_runs
from maxq.tools.verify.signing import SUFFIX

VERDICT_NAME, PAGE_NAME, PDF_NAME, FIGURES_NAME = "verdict.json", "review.html", "review.pdf", "figures"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PRINT_S = 60.0
_RANKED = ("upper gain margin", "phase margin", "phase margin at mode 1")
_HEADINGS = ("gain dB", "phase deg", "mode 1 deg")  # headings of these margins in the ranking
WORDS = {ACCEPTED: MET, REJECTED: NOT_MET, UNDECIDED: UNDECIDED}  # outcomes of a single requirement
_KEYS = {"judgement": "verdict"}  # keys of a requirement that verdict.json renames
FLIGHT = ("name", "outcome", "passed", "failures", "metrics", "state_hash", "again")
_LINE = (
    "difference_db",
    "difference_deg",
    "unrounded_db",
    "unrounded_deg",
    "coherence",
    "error",
    "nonlinear_db",
    "reason",
)


@dataclass(frozen=True)
class Signed:
    """The title block of a review: its responsible author, revision and date. An empty `date` means today."""

    author: str = ""
    revision: str = ""
    date: str = ""


def write_pack(found: Verification, folder: Path, command: str, pack: bool, signed: Signed = Signed()) -> list[Path]:
    """Write verdict.json and the other files of the pack, whose hashes it contains. Return their paths, verdict.json
    first.

    The other files are a copy of the ledger and the worst vehicles. With `pack`, they include the results, the runs of
    the campaigns, the figures as CSV, and the review as HTML and, if a browser can print it, as PDF. An earlier
    verdict.json is removed first, so that it never stands for other files. Raises FileError.
    """
    for earlier in (VERDICT_NAME, f"{VERDICT_NAME}{SUFFIX}"):
        (folder / earlier).unlink(missing_ok=True)
    files = [write_attempts(found, folder), *(write_runs(found, folder) if pack else [])]
    files += [write_whole(folder / RESULTS_NAME, found.results.to_bytes())] if pack else []
    for w in found.results.worst:
        files.append(write_whole(folder / worst_name(w), w.text))
    if pack:
        from maxq.tools.verify.figures import plots  # noqa: PLC0415  # lazy: SciPy comes with it

        drawn = plots(found, command)
        files += [write_whole(folder / FIGURES_NAME / f"{plot.name}.csv", as_csv(plot)) for plot in drawn]
        page = write_whole(folder / PAGE_NAME, page_of(found, command, drawn, signed))
        printed = print_page(page, folder / PDF_NAME)
        files += [page] if printed is None else [page, printed]
    record = verdict_record(found, command)
    record["files"] = file_hashes(folder, files)
    return [write_record(folder / VERDICT_NAME, dict(record)), *files]


def worst_name(w: WorstVehicle) -> str:
    """Return the file name of a worst vehicle."""
    return plain_name("-".join(filter(None, ("worst", w.plane, w.stage))), "worst") + ".toml"


def page_of(found: Verification, command: str, plots: Sequence[Plot], signed: Signed = Signed()) -> str:
    """Return the review as HTML."""
    dated = {"date": signed.date} if signed.date else {}
    return render(
        "review.html.j2",
        plots,
        found=found,
        command=command,
        headline=headline(found),
        outcomes=WORDS,
        board_tables=board_tables(found),
        record_lines=record_lines(found),
        tank_name=tank_name,
        finer_text=finer_text,
        signed=signed,
        gain_heads=GAIN_HEADS,
        summary=_summary(found),
        limiting=_limiting(found),
        repeats=list(
            dict.fromkeys((r.name, r.again) for r in found.requirements if r.judgement != ACCEPTED and r.again)
        ),
        matrix=_matrix(found.results.flights),
        loop=_loop(found),
        not_covered=uncovered_lines(found.scenario.vehicle, found.results.uncovered),
        **dated,
    )


def _summary(found: Verification) -> list[dict[str, Any]]:
    """Return for each part a description of its requirements, and the numbers met, rejected and undecided."""
    suite, margins = found.suite, found.suite.margins
    flights = len(found.results.flights)
    asked = {"scenarios": f"{flights} flight{'s' * (flights != 1)}, {'each ' * (flights != 1)}within its limits"}
    if margins is not None:
        nodes = sum(len(m.times_s) for m in found.results.margins)
        points = f"{nodes} operating point{'s' * (nodes != 1)}"
        asked["margins"] = f"linear margins of the design at {points}, {' and '.join(margins.planes)}"
        vehicles = next((len(m.random) + len(m.corners) for m in found.results.margins), 0)
        asked["dispersed"] = f"the same of {vehicles} {found.deviations or 'dispersed vehicles'}"
        if (worst := margins.worst) is not None:
            asked["worst"] = f"search for the worst vehicle within {worst.sigmas:g} sigma"
    if suite.certificate is not None:
        nodes = len(found.results.certificates)
        asked["certificate"] = f"linear loop and flight agree at {nodes} operating point{'s' * (nodes != 1)}"
        if found.results.measured:
            asked["certificate"] = "flight code responds in the ascent as at frozen points"
    nodes = len(found.results.measured)
    asked["measured only"] = f"margins of flight code, measured at {nodes} operating point{'s' * (nodes != 1)}"
    asked["campaign"] = "; ".join(
        f"{c.runs} flights, {100.0 * c.success:g} % with {100.0 * c.confidence:g} % confidence" for c in found.campaigns
    )
    parts: dict[str, Counter[str]] = {}
    for r in found.requirements:
        parts.setdefault(r.part, Counter())[r.judgement] += 1
    order = (ACCEPTED, REJECTED, UNDECIDED)
    return [{"name": p, "asked": asked.get(p, ""), "counts": [n[j] for j in order]} for p, n in parts.items()]


def _limiting(found: Verification) -> list[JudgedRequirement]:
    """Return the requirement with the least margin in each part, the tightest part first."""
    nearest: dict[str, JudgedRequirement] = {}
    for r in sorted((r for r in found.requirements if math.isfinite(r.room)), key=lambda r: r.room):
        nearest.setdefault(r.part, r)
    return list(nearest.values())


def _matrix(flights: Sequence[FlownResult]) -> dict[str, Any]:
    """Return the values of all flights in engineering units, with a column for each requirement.

    `used` is the utilisation of the limit in percent.
    """
    units = dict[str, tuple[str, float]]()

    def bound_text(v: Verdict) -> str:
        return f"{'<=' if v.bound[0] == 'limit' else '>='} {units[v.name][1] * v.bound[1]:g}"

    def cell(f: FlownResult, v: Verdict) -> dict[str, Any]:
        (kind, bound), text = v.bound, bound_text(v)
        share = (v.value / bound if kind == "limit" else bound / v.value) if bound and v.value else float(not v.met)
        used, own = min(max(100.0 * share, 0.0), 100.0), text if text != common[v.name] else ""
        return {
            "value": units[v.name][1] * v.value,
            "met": v.met,
            "used": used,
            "tightest": v is f.tightest,
            "bound": own,
        }

    heads, common = [], dict[str, str]()
    for name in dict.fromkeys(v.name for f in flights for v in f.verdicts):
        every = [v for f in flights for v in f.verdicts if v.name == name]
        ends = (abs(x) for v in every for x in (v.value, v.bound[1]) if math.isfinite(x))
        units[name] = engineering_unit(unit_of(every[0].requirement.metric), max(ends, default=0.0))
        common[name] = Counter(map(bound_text, every)).most_common(1)[0][0]
        heads.append({"name": name, "unit": unit_text(units[name][0]), "bound": common[name]})
    rows = []
    for f in flights:
        of = {v.name: cell(f, v) for v in f.verdicts}
        rows.append({"flight": f, "cells": [of.get(name) for name in common]})
    return {"heads": heads, "rows": rows}


def _loop(found: Verification) -> dict[str, Any]:
    """Return the texts of the blocks in the diagram of the control loop, those of the first stage if stages differ."""
    vehicle, design = found.scenario.vehicle, found.scenario.design
    computer, stage = vehicle.computer_of(0), vehicle.stage[0]
    if computer is None:
        return {}
    own = design.of_stage(0) if design is not None else None
    quadratic, first_order = own.filter.counts if own is not None else (0, 0)
    sections = 2 * quadratic + first_order
    actuators = stage.actuators
    first = actuators[0] if actuators else None
    modes = len(stage.bending.damping_ratio) if stage.bending is not None else 0
    return {
        "computer": f"flight computer: {1e3 * computer.sample_s:g} ms sample, {1e3 * computer.delay_s:g} ms delay",
        "programme": ("programme", ["attitude over time"]),
        "law": (
            "flight code" if computer.law == "external" else f"{design.law.upper()} law" if design else "law",
            ["gains over time", f"error up to {computer.angle_error_limit_deg:g} deg"],
        ),
        "filter": ("bending filter", [f"order {sections}", f"command up to {computer.command_limit_deg:g} deg"]),
        "actuator": (
            "actuator",
            ["none"]
            if first is None
            else [first.model, f"{first.angle_limit_deg:g} deg, {first.rate_limit_degps:g} deg/s"],
        ),
        "vehicle": (
            "vehicle",
            [f"engines: {len(stage.engines)}", f"bending modes: {modes}", f"tanks that slosh: {len(stage.tank)}"],
        ),
        "gyro": ("rate gyro", [f"at {stage.gyro.station_m:g} m" if stage.gyro is not None else "ideal"]),
        "attitude": ("attitude and rate", [computer.attitude]),
    }


def print_page(page: Path, pdf: Path) -> Path | None:
    """Print a page to PDF with a headless browser. Return the path of the PDF, or None if no browser succeeds."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        return None
    part = pdf.with_name(f".{pdf.name}.part")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            f"--user-data-dir={profile}",
            "--no-pdf-header-footer",
            "--generate-pdf-document-outline",
            "--window-size=900,1200",
            f"--print-to-pdf={part.resolve()}",
            page.resolve().as_uri(),
        ]
        try:
            subprocess.run(command, capture_output=True, timeout=_PRINT_S, check=True)
            part.replace(pdf)
        except (OSError, subprocess.SubprocessError):
            part.unlink(missing_ok=True)
            return None
    return pdf


def _headings(part: Sequence[JudgedRequirement]) -> list[str]:
    """Return for each requirement of a part the end of its heading, which names the plane.

    A requirement without a plane takes the plane of the next requirement that has one, else of the previous one. If
    more than half of the requirements have no plane, all ends are empty.
    """
    planes = [(r.where.rpartition(", ")[2] if r.where.endswith((", pitch", ", yaw")) else "") for r in part]
    if 2 * sum(map(bool, planes)) < len(planes):
        return [""] * len(planes)
    for n in reversed(range(len(planes) - 1)):
        planes[n] = planes[n] or planes[n + 1]
    for n in range(1, len(planes)):
        planes[n] = planes[n] or planes[n - 1]
    return [f", {plane}" for plane in planes]


def report(found: Verification, title: str) -> list[str]:
    """Return the lines of the report: its records, then each requirement in a row below the name of its part and
    plane.
    """
    measured = found.results.certificates or found.results.measured
    rows: list[tuple[str, ...]] = [("requirement", "outcome", "limit", "value", "margin to limit", "at")]
    headed = [(_headings(list(group)), part) for part, group in groupby(found.requirements, lambda r: r.part)]
    every = zip(found.requirements, (f"{part}{h}" for own, part in headed for h in own), strict=True)
    for heading, group in groupby(every, lambda pair: pair[1]):
        rows += [("",) * 6, (f"{heading}:", *("",) * 5)]
        for r, _ in group:
            room = f"{100.0 * r.room:.0f} %" if math.isfinite(r.room) else ""
            verdict = _mark(WORDS[r.judgement]) + (", waived" if r.waived else "")
            rows.append((printable(r.name), verdict, r.wanted, printable(r.found), room, r.where))
    return [
        title,
        *map(printable, (*record_lines(found), *waiver_lines(found))),
        *(f"{printable(c.name)}: {text}" for c in found.campaigns if (text := finer_text(c.finer))),
        *baseline_lines(found),
        *([printable(from_here(found.deviations))] if found.deviations else []),
        "",
        *aligned(rows, "  ", right=(4,), drop=(5, 4)),
        *(["", *uncovered_table(found.scenario.vehicle, found.results.uncovered)] if found.results.uncovered else []),
        *_listed("below the floor of an acceptance", found.missing_evidence),
        *(["", *measured_lines(found)] if found.part and measured else []),
    ]


def measured_lines(found: Verification) -> list[str]:
    """Return a table of the margins measured at the frozen points and of those of the linear loop there."""
    rows: list[tuple[str, ...]] = [("at", "plane", "margin", "measured", "linear", "remark")]

    def row(
        at: NodeCertificate | MeasuredNode, what: str, unit: str, values: Sequence[float], remark: str = ""
    ) -> None:
        factor, shown_unit = (1e3, "ms") if unit == "s" else (1.0, unit)
        texts = [f"{factor * x:.2f} {shown_unit}" if math.isfinite(x) else "-" for x in values]
        rows.append((f"{at.time_s:g} s", at.plane, what.replace("_", " "), *texts, remark))

    for certificate in found.results.certificates:
        for m in certificate.margins:
            row(certificate, m.what, m.unit, (m.measured, m.held), m.reason)
    for node in found.results.measured:
        for measured in node.margins:
            row(node, measured.what, measured.unit, (measured.measured, measured.linear), measured.reason)
        if node.stable:
            row(node, "phase between lines", "deg", (node.phase_deg, math.nan))
    return ["margins measured in flight", *aligned(rows, "  ", right=(0, 3, 4))]


def _listed(title: str, lines: Sequence[str]) -> list[str]:
    return ["", title, *(f"  {printable(line)}" for line in lines)] if lines else []


def baseline_lines(found: Verification) -> list[str]:
    """Return the number of differences between the suite and its baseline, and a table of them.

    The differences from the shipped suite are included if the baseline is not shipped.
    """
    head = ("difference from the baseline", "of", "baseline", "here")
    every = found.compared.all_differences
    rows = [(d.kind, printable(d.what), printable(d.baseline), printable(d.here)) for d in every]
    return [f"baseline: {found.compared.title}", *(aligned([head, *rows], "  ") if rows else [])]


def _mark(judgement: str) -> str:
    return judgement if judgement in (ACCEPTED, SCREENED, MET) else judgement.upper()


def reasons(found: Verification) -> list[str]:
    """Return a line for each requirement that prevents acceptance, followed by the command that reproduces it."""
    out = []
    for r in (*found.of(REJECTED), *found.of(UNDECIDED)):
        out.append(f"  {WORDS[r.judgement]}: {printable(r.reason)}")
        out += [f"      {from_here(r.again)}"] if r.again else []
    return out


def from_here(text: str) -> str:
    """Return a text with all paths below the working folder relative to that folder."""
    return text.replace(f"{Path.cwd()}{os.sep}", "")


def ranked(every: Sequence[Verification]) -> list[Verification]:
    """Return the verifications in order of merit, the best first."""
    return sorted(every, key=lambda v: v.merit, reverse=True)


def ranking(every: Sequence[Verification]) -> list[str]:
    """Return a table of designs in order of merit, the best first."""
    head = ("", "design", "verdict", "rejected", "undecided", "tightest", "margin", *_HEADINGS)
    rows: list[tuple[str, ...]] = [head]
    for n, v in enumerate(ranked(every), 1):
        finite = [r for r in v.requirements if math.isfinite(r.room)]
        worst = min(finite, key=lambda r: r.room, default=None)
        nominal = {r.name.partition(",")[0]: r.found for r in v.requirements if r.part == "margins"}
        rows.append(
            (
                str(n),
                v.design,
                _mark(v.judgement),
                str(len(v.of(REJECTED))),
                str(len(v.of(UNDECIDED))),
                printable(worst.name) if worst else "",
                f"{100.0 * worst.room:.0f} %" if worst else "",
                *(nominal.get(key, "-").partition(" ")[0] for key in _RANKED),
            )
        )
    return ["ranking", *aligned(rows, "  ", right=(0, 3, 4, 6, 7, 8, 9))]


# verdict.json


def verdict_record(found: Verification, command: str) -> VerdictRecord:
    """Return the content of verdict.json: the whole verification without histories."""
    further, provenance = found.compared.from_shipped, records(found)
    requirements = [{_KEYS.get(key, key): value for key, value in vars(r).items()} for r in found.requirements]
    flights = [{key: getattr(f, key) for key in FLIGHT} for f in found.results.flights]
    record: VerdictRecord = {
        "schema": 2,
        "design": found.design,
        "design_name": found.scenario.design.name if found.scenario.design else "",
        "vehicle": found.scenario.vehicle.name,
        "suite": found.suite.name,
        "verdict": found.judgement,
        "missing_evidence": list(found.missing_evidence),
        "part": found.part,
        "left_out": list(found.left_out),
        "deviations": found.deviations,
        "not_covered": uncovered_record(found.results.uncovered),
        "more_runs": found.more_runs,
        "command": command,
        "asked": found.asked,
        "requirements": cast(list[RequirementRecord], requirements),
        "baseline": {
            "suite": found.compared.baseline,
            "shipped": found.compared.shipped,
            "differences": [vars(d) for d in found.compared.differences],
            "from_shipped": [vars(d) for d in further.differences] if further is not None else [],
        },
        "board": board_record(found),
        "against_basis": against_basis(found.suite, found.scenario),
        "flights": cast(list[FlightRecord], flights),
        "margins": [
            {"plane": m.plane, "stage": m.stage, "times_s": list(m.times_s), "as_designed": list(m.nominal.nodes)}
            for m in found.results.margins
        ],
        "certificate": [certificate_record(c) for c in found.results.certificates],
        "measured_only": [measured_record(n) for n in found.results.measured],
        "authority": [vars(a) for a in found.results.authority],
        "worst": [_worst(w) for w in found.results.worst],
        "slosh": [vars(a) | {"in_band": a.in_band} for a in found.results.slosh],
        "campaigns": [
            {
                "name": c.name,
                "runs": c.runs,
                "folder": str(c.folder),
                "finer_runs": {str(k): n for k, n in c.finer.items()},
            }
            for c in found.campaigns
        ],
        "hashes": found.hashes,
        "versions": found.versions,
        "parts": {"recalled": found.recalled, "worked_out": found.worked_out},
        "attempt": provenance["attempt"],
        "seeds": provenance["seeds"],
        "recalled": provenance["recalled"],
        "wall_s": found.wall_s,
        "walls_s": found.walls_s,
        "cpus_s": found.cpus_s,
    }
    return cast(VerdictRecord, _from_here(record))


def _from_here(value: Any) -> Any:
    """Return a record with all paths relative to the working folder, so that a copy of this folder gives the same
    record.
    """
    if isinstance(value, dict):
        return {key: _from_here(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_from_here(item) for item in value]
    return from_here(value) if isinstance(value, str) else value


def _worst(w: WorstVehicle) -> dict[str, Any]:
    return {key: value for key, value in vars(w).items() if key != "text"}


def measured_record(n: MeasuredNode) -> dict[str, Any]:
    """Return the entry of verdict.json for a measurement of flight code without a linear model."""
    return {
        "time_s": n.time_s,
        "plane": n.plane,
        "stable": n.stable,
        "clock_s": list(n.clock_s),
        "ended": n.ended,
        "differs": n.differs,
        "margins": [vars(m) for m in n.margins],
        "phase_deg": n.phase_deg if n.stable else math.nan,
        "slosh": [vars(c) for c in n.cycles],
        "lines": [
            {"hz": f, "db": _db(x), "deg": math.degrees(math.atan2(x.imag, x.real)), "error": e}
            for f, x, e in zip(n.lines_hz.tolist(), n.response.tolist(), n.error.tolist(), strict=True)
        ],
    }


def certificate_record(c: NodeCertificate) -> dict[str, Any]:
    """Return the entry of verdict.json for a certificate."""
    r = c.responses
    return {
        "time_s": c.time_s,
        "plane": c.plane,
        "agrees": c.agrees,
        "unexplained": list(c.unexplained),
        "margins": [vars(m) for m in c.margins],
        "lines": [
            {"hz": r.lines_hz[i], "sampled_db": _db(r.sampled[i]), "pade_db": _db(r.pade[i])}
            | {key: getattr(r, key)[i] for key in _LINE}
            for i in range(len(r.lines_hz))
        ],
        "rings": [
            {"hz": line.line_hz, "swing_deg": [math.degrees(swing) for swing in line.swing_rad], "reason": line.reason}
            | {key: getattr(line, key) for key in ("difference_db", "difference_deg", "rings_db")}
            for line in c.rings
        ],
    }


def _db(value: complex) -> float:
    return 20.0 * math.log10(max(abs(value), 1e-300))
