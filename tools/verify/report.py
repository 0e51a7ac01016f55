"""What `simverify` prints and writes: tables of requirements, ranking, verdict.json and the review pack."""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from maxq.design.certificate.certificate import NodeCertificate
from maxq.design.certificate.measured_only import MeasuredNode
from maxq.design.verify.suite import ACCEPTED, REJECTED, SCREENED, UNDECIDED
from maxq.design.verify.verify import Verification, tank_name
from maxq.design.verify.worst import WorstVehicle
from maxq.sim.campaign.statistics import MET
from maxq.sim.files import plain_name, write_whole
from maxq.tools.cli.terminal import aligned, printable
from maxq.tools.design.report import write_record
from maxq.tools.pages.render import render

VERDICT_NAME, PAGE_NAME, PDF_NAME = "verdict.json", "review.html", "review.pdf"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PRINT_S = 60.0
_RANKED = ("gain margin up", "phase margin", "first mode: phase margin")
WORDS = {ACCEPTED: MET, REJECTED: REJECTED, UNDECIDED: UNDECIDED}  # of a single requirement
_KEYS = {"judgement": "verdict"}  # of a requirement, as verdict.json has them
_FLIGHT = ("name", "outcome", "passed", "failures", "metrics", "state_hash", "again")
_LINE = (
    "difference_db", "difference_deg", "unrounded_db", "unrounded_deg", "coherence", "error", "nonlinear_db", "reason",
)  # fmt: skip  # seven more lines otherwise


def write_pack(found: Verification, folder: Path, command: str, pack: bool) -> list[Path]:
    """Write verdict.json and, with `pack`, the review as HTML and PDF (where a browser can print). Raises FileError."""
    files = [write_record(folder / VERDICT_NAME, verdict_record(found, command))]
    for w in found.worst:
        name = plain_name("-".join(filter(None, ("worst", w.plane, w.stage))), "worst")
        files.append(write_whole(folder / f"{name}.toml", w.text))
    if pack:
        from maxq.tools.verify.pictures import pictures  # noqa: PLC0415  # lazy: matplotlib comes with it

        files.append(write_whole(folder / PAGE_NAME, page_of(found, command, pictures(found))))
        printed = print_page(files[-1], folder / PDF_NAME)
        files += [printed] if printed is not None else []
    return files


def page_of(found: Verification, command: str, pictures: dict[str, bytes]) -> str:
    """The review as HTML."""
    return render(
        "review.html.j2", found=found, command=command, pictures=pictures, headline=headline(found),
        tank_name=tank_name,
    )  # fmt: skip  # five more lines otherwise


def print_page(page: Path, pdf: Path) -> Path | None:
    """The page as PDF by a headless browser; None where there is none, or it fails."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        return None
    part = pdf.with_name(f".{pdf.name}.part")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [
            browser, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
            "--disable-component-update", "--disable-sync", f"--user-data-dir={profile}", "--no-pdf-header-footer",
            f"--print-to-pdf={part.resolve()}", page.resolve().as_uri(),
        ]  # fmt: skip  # nine more lines otherwise
        try:
            subprocess.run(command, capture_output=True, timeout=_PRINT_S, check=True)
            part.replace(pdf)
        except (OSError, subprocess.SubprocessError):
            part.unlink(missing_ok=True)
            return None
    return pdf


def report(found: Verification, title: str) -> list[str]:
    """Every requirement, a row each, by part."""
    rows = [("", "requirement", "verdict", "wanted", "found", "room", "where")]
    last = ""
    for r in found.requirements:
        part = r.part if r.part != last else ""
        last = r.part
        room = f"{100.0 * r.room:.0f} %" if math.isfinite(r.room) else ""
        rows.append((part, printable(r.name), _mark(WORDS[r.judgement]), r.wanted, printable(r.found), room, r.where))
    return [title, *aligned(rows, "  ", right=(5,), drop=(6,))]


def _mark(judgement: str) -> str:
    return judgement if judgement in (ACCEPTED, SCREENED, MET) else judgement.upper()


def reasons(found: Verification) -> list[str]:
    """Why a design is not accepted, a line each, and the command that shows it."""
    out = []
    for r in (*found.of(REJECTED), *found.of(UNDECIDED)):
        out += [f"  {r.judgement}: {printable(r.reason)}", *([f"      {r.again}"] if r.again else [])]
    return out


def headline(found: Verification, name: str = "") -> str:
    """The verdict; `name` is the design's for people."""
    counts = [f"{len(found.of(j))} {WORDS[j]}" for j in (ACCEPTED, REJECTED, UNDECIDED) if found.of(j)]
    more = f", {found.more_runs} more runs would settle it" if found.judgement == UNDECIDED and found.more_runs else ""
    said = f"of {len(found.requirements)} requirements {', '.join(counts)}{more}"
    lacks = f"{', '.join(found.suite.lacks)}; " if found.suite.lacks else ""
    word = f"{found.judgement.upper()}{' AT THE SCREENING' if lacks and found.judgement != SCREENED else ''}"
    return f"{word}: {lacks}{printable(name or found.design)}; {said}"


def ranked(every: Sequence[Verification]) -> list[Verification]:
    """The best first."""
    return sorted(every, key=lambda v: v.merit, reverse=True)


def ranking(every: Sequence[Verification]) -> list[str]:
    """Designs side by side, the best first."""
    head = ("", "design", "verdict", "rejected", "undecided", "tightest", "room", "gain dB", "phase deg", "mode 1 deg")
    rows: list[tuple[str, ...]] = [head]
    for n, v in enumerate(ranked(every), 1):
        finite = [r for r in v.requirements if math.isfinite(r.room)]
        worst = min(finite, key=lambda r: r.room, default=None)
        nominal = {r.name.partition(",")[0]: r.found for r in v.requirements if r.part == "margins"}
        rows.append(
            (
                str(n), v.design, _mark(v.judgement), str(len(v.of(REJECTED))), str(len(v.of(UNDECIDED))),
                printable(worst.name) if worst else "", f"{100.0 * worst.room:.0f} %" if worst else "",
                *(nominal.get(key, "-").partition(" ")[0] for key in _RANKED),
            )
        )  # fmt: skip  # five more lines otherwise
    return ["ranking", *aligned(rows, "  ", right=(0, 3, 4, 6, 7, 8, 9))]


# verdict.json


def verdict_record(found: Verification, command: str) -> dict[str, Any]:
    """All but histories."""
    return {
        "schema": 1,
        "design": found.design,
        "design_name": found.scenario.design.name if found.scenario.design else "",
        "vehicle": found.scenario.vehicle.name,
        "suite": found.suite.name,
        "verdict": found.judgement,
        "lacks": found.suite.lacks,
        "more_runs": found.more_runs,
        "command": command,
        "requirements": [{_KEYS.get(key, key): value for key, value in vars(r).items()} for r in found.requirements],
        "flights": [{key: getattr(f, key) for key in _FLIGHT} for f in found.flights],
        "certificate": [_node(c) for c in found.certificates],
        "measured_only": [_measured(n) for n in found.measured],
        "authority": [vars(a) for a in found.authority],
        "worst": [_worst(w) for w in found.worst],
        "slosh": [vars(a) | {"in_band": a.in_band} for a in found.slosh],
        "campaigns": [{"name": c.name, "runs": c.runs, "folder": str(c.folder)} for c in found.campaigns],
        "hashes": found.hashes,
        "versions": found.versions,
        "parts": {"recalled": found.recalled, "worked_out": found.worked_out},
        "wall_s": found.wall_s,
        "walls_s": found.walls_s,
        "cpus_s": found.cpus_s,
    }


def _worst(w: WorstVehicle) -> dict[str, Any]:
    sigmas = {name if n < 0 else f"{name}.{n}": value for (name, n), value in w.sigmas.items()}
    return {key: value for key, value in vars(w).items() if key != "text"} | {"sigmas": sigmas}


def _measured(n: MeasuredNode) -> dict[str, Any]:
    """Of flight code without a linear model."""
    return {
        "time_s": n.time_s,
        "plane": n.plane,
        "stable": n.stable,
        "margins": [vars(m) for m in n.margins],
        "phase_deg": n.phase_deg if n.stable else math.nan,
        "slosh": [vars(c) for c in n.cycles],
        "lines": [
            {"hz": f, "db": _db(x), "deg": math.degrees(math.atan2(x.imag, x.real)), "error": e}
            for f, x, e in zip(n.lines_hz.tolist(), n.response.tolist(), n.error.tolist(), strict=True)
        ],
    }


def _node(c: NodeCertificate) -> dict[str, Any]:
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
    }


def _db(value: complex) -> float:
    return 20.0 * math.log10(max(abs(value), 1e-300))
