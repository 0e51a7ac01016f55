"""The review pack: one HTML file with all in it, readable by someone who was not in the room; and as PDF."""

from __future__ import annotations

import base64
import html
import math
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from maxq.design.verify.verdict import ACCEPTED
from maxq.design.verify.verify import Verification
from maxq.sim.campaign.analysis import Judged
from maxq.sim.files import write_whole
from maxq.tools.verify import text

PAGE_NAME, PDF_NAME = "review.html", "review.pdf"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_PRINT_S = 60.0

_STYLE = """
:root { --ink:#1a1a1a; --soft:#666; --line:#d8d8d8; --good:#00714f; --bad:#b3261e; --open:#8a5a00; }
* { box-sizing:border-box } body { font:14px/1.45 "DejaVu Sans",Verdana,Arial,sans-serif; color:var(--ink);
margin:0 auto; max-width:60rem; padding:1.5rem } h1 { font-size:1.6rem; margin:.2rem 0 } h2 { font-size:1.15rem;
border-bottom:2px solid var(--ink); margin:2rem 0 .6rem; padding-bottom:.15rem } p { max-width:46rem }
table { border-collapse:collapse; width:100%; font-size:.82rem; margin:.5rem 0 } th,td { text-align:left;
padding:.22rem .5rem; border-bottom:1px solid var(--line); vertical-align:top } th { color:var(--soft);
font-weight:600 }
td.n,th.n { text-align:right; font-variant-numeric:tabular-nums }
td.n { white-space:nowrap } img { width:100%; height:auto } code,pre {
font-family:"DejaVu Sans Mono",Consolas,monospace; font-size:.8rem } pre { background:#f4f4f4; padding:.6rem;
white-space:pre-wrap; word-break:break-word } .accepted { color:var(--good) } .rejected { color:var(--bad) }
.undecided { color:var(--open) } .verdict { border:3px solid currentColor; padding:.5rem 1rem; font-size:1.35rem;
font-weight:700; display:inline-block; margin:.4rem 0 } .soft { color:var(--soft) } td.accepted,td.rejected,
td.undecided { font-weight:600 } figure { margin:.6rem 0; break-inside:avoid } figcaption { color:var(--soft);
font-size:.82rem; max-width:46rem } tr { break-inside:avoid } @page { size:A4; margin:14mm }
@media print { html { font-size:12px } body {
max-width:none; padding:0; font-size:11px } h2 { break-after:avoid } }
"""


def write_page(folder: Path, found: Verification, command: str) -> list[Path]:
    """Write review.html, and review.pdf where a browser is there that prints. Raises FileError."""
    from maxq.tools.verify.pictures import pictures  # noqa: PLC0415  # lazy: matplotlib comes with it

    page = write_whole(folder / PAGE_NAME, page_of(found, command, pictures(found)))
    printed = print_page(page, folder / PDF_NAME)
    return [page, printed] if printed is not None else [page]


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
        ]  # fmt: skip
        try:
            subprocess.run(command, capture_output=True, timeout=_PRINT_S, check=True)
            part.replace(pdf)
        except (OSError, subprocess.SubprocessError):
            part.unlink(missing_ok=True)
            return None
    return pdf


def page_of(found: Verification, command: str, drawn: dict[str, bytes]) -> str:
    """The page as text."""
    parts = [
        _first(found, command), _requirements(found), _flights(found), _margins(found, drawn),
        _certificate(found, drawn), _campaigns(found), _envelopes(found, drawn), _basis(found, command),
    ]  # fmt: skip
    title = html.escape(f"{found.design_name or found.design}: {found.judgement}")
    body = "\n".join(part for part in parts if part).replace("&lt;= ", "≤\u00a0").replace("&gt;= ", "≥\u00a0")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{_STYLE}</style></head>\n'
        f"<body>\n{body}\n</body></html>\n"
    )


def _first(found: Verification, command: str) -> str:
    design = found.scenario.design
    assert design is not None
    bad = [r for r in found.requirements if r.judgement != ACCEPTED]
    said = "".join(f'<li class="{r.judgement}">{html.escape(r.reason)}</li>' for r in bad)
    why = f"<p>What stands against it:</p><ul>{said}</ul>" if bad else "<p>Every requirement is met.</p>"
    gains = design.gains.table
    rows = [("time, s", "k_p", "k_d, s")]
    rows += [
        (f"{t:g}", f"{p:.4g}", f"{d:.4g}")
        for t, p, d in zip(gains["time_s"], gains["k_p"], gains["k_d_s"], strict=True)
    ]
    sections = [("section", "zeros, Hz", "damping", "poles, Hz", "damping")]
    sections += [
        ("quadratic", f"{q.zero_hz:.4g}", f"{q.zero_zeta:.3g}", f"{q.pole_hz:.4g}", f"{q.pole_zeta:.3g}")
        for q in design.filter.quadratic
    ]
    sections += [("first order", f"{f.zero_hz:.4g}", "", f"{f.pole_hz:.4g}", "") for f in design.filter.first_order]
    stage, computer = found.scenario.vehicle.stage[0], found.scenario.vehicle.computer
    first = stage.mass.table
    mass = f"{first['mass_kg'][0]:.0f} kg at lift-off" if first is not None else f"{stage.mass.mass_kg or 0:.0f} kg"
    vehicle = [
        f"{html.escape(found.vehicle)}, {mass}, {len(stage.tank)} tanks that slosh, "
        f"{len(stage.bending.damping_ratio) if stage.bending else 0} bending modes",
        f"computer: {1e3 * computer.sample_s:g} ms sample, {1e3 * computer.delay_s:g} ms delay, gimbal command up to "
        f"{computer.command_limit_deg:g} deg" if computer else "no computer",
    ]  # fmt: skip
    listed = "".join(f"<li>{line}</li>" for line in vehicle)
    return f"""<p class="soft">Design review, {html.escape(found.suite.name)} suite</p>
<h1>{html.escape(found.design_name or found.design)}</h1>
<div class="verdict {found.judgement}">{found.judgement.upper()}</div>
<p>{html.escape(text.headline(found))}.</p>{why}
<p>All of this again, with one command:</p><pre>{html.escape(command)}</pre>
<h2>Vehicle and design</h2><ul>{listed}</ul><p>{html.escape(design.description)}</p>
{_table(rows, numbers=(0, 1, 2))}{_table(sections, numbers=(1, 2, 3, 4)) if len(sections) > 1 else ""}
<p class="soft">Filter made discrete: {design.filter.discretization}{
        f", exact at {design.filter.prewarp_hz:g} Hz" if design.filter.prewarp_hz else ""
    }.</p>"""


def _requirements(found: Verification) -> str:
    rows = []
    for r in found.requirements:
        room = f"{100.0 * r.room:.0f} %" if math.isfinite(r.room) else ""
        rows.append(
            f"<tr><td>{r.part}</td><td>{html.escape(r.name)}</td><td>{html.escape(r.wanted)}</td>"
            f'<td>{html.escape(r.found)}</td><td class="n">{room}</td><td>{html.escape(r.where)}</td>'
            f'<td class="{r.judgement}">{r.judgement}</td></tr>'
        )
    titles = "<th></th><th>requirement</th><th>wanted</th><th>found</th><th class=n>room</th><th>where</th><th></th>"
    head = f"<tr>{titles}</tr>"
    return (
        f"<h2>Requirements</h2><p>Room is the share of the limit that is left.</p><table>{head}{''.join(rows)}</table>"
        + _dispersed_limits(found)
    )


def _dispersed_limits(found: Verification) -> str:
    stated = found.suite.dispersed_limit
    own = [f.name for f in found.suite.flight if f.limits == "own"]
    if not stated:
        return ""
    rows = [("limit off the nominal flight", "at most", "why")]
    rows += [(x.requirement, f"{x.limit:g}", x.why) for x in stated]
    kept = f" These flights keep the scenario's own: {html.escape(', '.join(own))}." if own else ""
    return f"<p>Flights off the nominal one are held to limits of the suite.{kept}</p>{_table(rows, numbers=(1,))}"


def _flights(found: Verification) -> str:
    if not found.flights:
        return ""
    rows = [("scenario", "what it shows", "tightest requirement", "value", "limit", "")]
    for f in found.flights:
        worst = f.tightest
        bound = f"{'<=' if worst.kind == 'limit' else '>='} {worst.bound:g}" if worst else ""
        state = "passed" if f.passed else "; ".join(f.failures) or "MISSED"
        rows.append((f.name, f.why, worst.name if worst else "", f"{worst.value:.4g}" if worst else "", bound, state))
    again = "".join(f"<tr><td>{html.escape(f.name)}</td><td><code>{html.escape(f.again)}</code></td></tr>"
                    for f in found.flights)  # fmt: skip
    folded = f"<details><summary>commands that fly them</summary><table>{again}</table></details>"
    return f"<h2>Scenarios flown</h2>{_table(rows, numbers=(3,))}{folded}"


def _margins(found: Verification, drawn: dict[str, bytes]) -> str:
    if not found.margins:
        return ""
    return (
        "<h2>Margins over the flight</h2>"
        + _picture(drawn, "margins", "Exact sampled loop, pitch. Each grey line is a vehicle with random deviations.")
        + _picture(drawn, "nichols", "Open loop at each node in the Nichols plane, lobes named; the red cross is -1.")
    )


def _certificate(found: Verification, drawn: dict[str, bytes]) -> str:
    if not found.certificates:
        return ""
    rows: list[tuple[str, ...]] = [
        ("time, s", "plane", "margin", "continuous", "sampled", "where held", "in flight", "difference", "reason")
    ]
    for c in found.certificates:
        for e in c.edges:
            unit, scale = ("ms", 1e3) if e.unit == "s" else (e.unit, 1.0)
            digits = 4 if e.unit == "1/s" else 2
            cells = [f"{scale * x:.{digits}f}" for x in (e.pade, e.sampled, e.held, e.measured)]
            rows.append(
                (
                    f"{c.time_s:g}",
                    c.plane,
                    f"{e.what.replace('_', ' ')}, {unit}",
                    *cells,
                    f"{scale * e.difference:+.{max(digits, 3)}f}",
                    e.reason,
                )
            )
        if not c.stable:
            rows.append((f"{c.time_s:g}", c.plane, "unstable", "", "", "", "", "", "; ".join(c.unexplained)))
    through = [("time, s", "plane", "lines", "largest difference, dB", "by time variation", "unexplained")]
    for f in found.flown_through:
        through.append(
            (
                f"{f.time_s:g}", f.plane, str(len(f.lines_hz)), f"{abs(f.difference_db).max():.2f}",
                str(f.reason.count("time variation")), str(f.reason.count("unexplained")),
            )
        )  # fmt: skip
    passing = "<p>In the real ascent, while everything changes:</p>" + _table(through, numbers=(0, 2, 3, 4, 5))
    return f"""<h2>Margin certificate</h2><p>The loop measured in the nonlinear, sampled simulator with time held still
at each node, and broken there: gain raised, gain lowered, delay added until a kicked flight neither grows nor decays.
"Held gravity": a flight that keeps its airspeed feels its axial load as gravity, which moves the slowest root; the
margin at the flown instant stands under "sampled". Where that root grows in a held loop, "drift" is its rate of
growth.</p>
{_picture(drawn, "certificate", "Differences at all nodes; red: what is allowed without a reason.")}
{_table(rows, numbers=(0, 3, 4, 5, 6, 7))}
{passing if len(through) > 1 else ""}"""


def _campaigns(found: Verification) -> str:
    out = []
    for c in found.campaigns:
        head = ("requirement", "limit", "median", "worst", "failed", "success at least", "verdict")
        rows: list[tuple[str, ...]] = [head]
        rows += [_judged(v) for v in c.verdicts]
        worst = {w.run for v in c.verdicts for w in v.worst[:1]}
        again = "\n".join(f"simrun --from {c.folder} --run {run}" for run in sorted(worst))
        out.append(
            f"<h2>Campaign {html.escape(c.name)}</h2><p>{c.runs} flights; a requirement is met where "
            f"{100 * c.success:g} % of all flights meet it, shown with {100 * c.confidence:g} % confidence.</p>"
            f"{_table(rows, numbers=(1, 2, 3, 4, 5))}"
            f"<p>The worst flights again:</p><pre>{html.escape(again)}</pre>"
        )
    return "".join(out)


def _judged(v: Judged) -> tuple[str, ...]:
    bound = f"{'<=' if v.kind == 'limit' else '>='} {v.bound:g} {v.unit}" if v.metric else ""
    worst = f"{v.worst[0].value:.4g} (run {v.worst[0].run})" if v.worst else ""
    median = f"{v.median:.4g}" if math.isfinite(v.median) else ""
    failed, least = f"{v.shown.failures} of {v.shown.runs}", f"{100 * v.shown.success_least:.2f} %"
    return (v.name, bound, median, worst, failed, least, v.shown.judgement)


def _envelopes(found: Verification, drawn: dict[str, bytes]) -> str:
    out = "<h2>Gimbal and slosh</h2>" if {"gimbal", "authority", "slosh"} & set(drawn) else ""
    out += _picture(drawn, "gimbal", "All scenarios under thrust; the three with the largest gimbal angle are named.")
    out += _picture(drawn, "authority", "Where a degree of incidence costs several of gimbal, wind uses up the gimbal "
                    "before any margin is gone.")  # fmt: skip
    out += _picture(drawn, "slosh", "Right: damping ratio below which the closed loop would grow.")
    harm = [a for a in found.slosh if a.needed > 0.0]
    if harm:
        rows = [
            ("time, s", "tank", "damping needed", "has", "kick with just that, in flight, 1/s", "ring near: wave, mm",
             "ring midway: wave, mm", "its swing, deg", "swing in flight, deg")
        ]  # fmt: skip
        rows += [
            (f"{a.time_s:g}", str(a.tank + 1), f"{a.needed:.4f}", f"{a.damping:.4f}",
             _known(a.flown_growth_1ps, "+.4f"), f"{1e3 * a.wave_m:.2f}", f"{1e3 * a.midway_wave_m:.1f}",
             f"{a.midway_deg:.2f}", _known(a.flown_deg, ".2f"))
            for a in harm
        ]  # fmt: skip
        out += (
            "<p>Without the damping that is needed slosh grows until baffles give it, which is its limit cycle: the "
            "wave with a ring just below the surface, and with the surface midway between two rings a radius apart. "
            "The worst case is flown.</p>" + _table(rows, numbers=range(9))
        )
    return out


def _known(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else ""


def _basis(found: Verification, command: str) -> str:
    rows = [("", "")]
    rows += [(f"version of {k}", v) for k, v in found.versions.items()]
    rows += [
        ("design, hash", found.design_hash), ("scenario with vehicle, hash", found.vehicle_hash),
        ("source code, hash", found.code), ("suite", found.suite.name),
        ("parts known from before", str(found.recalled)),
        ("worked out now", str(found.worked_out)),
    ]  # fmt: skip
    rows += [
        (f"time for {k}", f"{v:.1f} s, {found.cpus_s[k]:.1f} s of processors") for k, v in found.walls_s.items()
    ]  # fmt: skip
    return f"""<h2>What this rests on</h2><ul>
<li>Equations of the paper corrected (switches of the errata as in the preset "corrected", docs/design.md, section 4);
labels of the actuator's zero and pole as the vehicle file has them.</li>
<li>The linear loop is the exact sampled one; dispersions are independent, normal, three sigma as the suite says.</li>
<li>Vehicle data are a reconstruction, not flight data. Not verified: what the data themselves leave out.</li>
<li>How simulator and linear model were checked: docs/verification.md.</li></ul>{_table(rows[1:], head=False)}
<pre>{html.escape(command)}</pre>"""


def _table(rows: Sequence[Sequence[str]], numbers: Iterable[int] = (), head: bool = True) -> str:
    right = set(numbers)
    out = []
    for n, row in enumerate(rows):
        tag = "th" if head and n == 0 else "td"
        cells = "".join(
            f"<{tag}{' class=n' if k in right else ''}>{html.escape(cell)}</{tag}>" for k, cell in enumerate(row)
        )
        out.append(f"<tr>{cells}</tr>")
    return f"<table>{''.join(out)}</table>"


def _picture(drawn: dict[str, bytes], name: str, caption: str) -> str:
    if name not in drawn:
        return ""
    data = base64.b64encode(drawn[name]).decode()
    return (
        f'<figure><img alt="{html.escape(name)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )
