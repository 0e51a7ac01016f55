"""The table of the differences between the paper's continuous loop and the sampled loop, by operating point.

    python -m maxq.tools.dev.documents.departure_table [FILE]

compares both for the design `ksr3-default` along the flight `nominal`, and writes the result into FILE (default:
docs/flights/nominal-departure.md) and to the terminal.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from maxq.design import operating_points
from maxq.design.loop.loop import Loop, loops
from maxq.design.margins.measure import Margins, margins
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.dev.documents.departure import PARTS, Departure, DeparturePart, departure

SCENARIO, DESIGN = "nominal", "designs/ksr3-default.toml"
DEFAULT_FILE = Path(__file__).resolve().parents[3] / "docs" / "flights" / "nominal-departure.md"
MODES = ("bending 2", "bending 3")
NAMES: dict[DeparturePart, str] = {
    "total": "all",
    "pade": "Padé approximants (30 to 32)",
    "aliasing": "images omitted",
    "integrator": "integrator 1/s",
    "filter": "continuous filter",
}


def table_text(found: list[Departure], measured: list[tuple[Margins, Margins]]) -> str:
    """Return the page, with every second operating point."""
    found, measured = found[::2], measured[::2]
    lines = [
        "# Continuous and sampled loop",
        "",
        "<!-- Written by `python -m maxq.tools.dev.documents.departure_table`: run it again, do not edit. -->",
        "",
        "The tables give the ratio of the paper's continuous loop (kind `pade`) to the loop of the flight computer",
        "(kind `sampled`), for the design `ksr3-default` in pitch. `tools/dev/documents/departure.py` splits it into",
        "four ratios whose decibels and degrees add up. Every second operating point of the paper is listed.",
        "",
    ]
    smallest = [value for d in found for value in d.at(_resonance(d, "bending 1")).values()]
    db, deg = (max(abs(value[k]) for value in smallest) for k in (0, 1))
    lines += [f"At mode 1, every part is at most {db:.2f} dB and {deg:.1f}°."]
    for label in MODES:
        lines += ["", f"## At {label.replace('bending', 'mode')}", "", "Each part: dB, deg.", ""]
        lines += ["| time, s | Hz | sampled peak, dB | " + " | ".join(NAMES[p] for p in PARTS) + " |"]
        lines += ["|---" * (3 + len(PARTS)) + "|"]
        for d in found:
            hz = _resonance(d, label)
            k = int(np.argmin(np.abs(d.frequency_hz - hz)))
            cells = [f"{db:+.2f}, {deg:+.1f}" for db, deg in d.at(hz).values()]
            row = [f"{d.node.time_s:g}", f"{hz:.2f}", f"{d.sampled_db[k]:.2f}", *cells]
            lines.append("| " + " | ".join(row) + " |")
    lines += ["", "## Margins", "", "Each margin: sampled, continuous.", ""]
    lines += ["| time, s | lower gain margin, dB | upper gain margin, dB | phase margin, deg | least \\|1+L\\| |"]
    lines += ["|---|---|---|---|---|"]
    for d, (sampled, pade) in zip(found, measured, strict=True):
        pairs = [
            (sampled.aero_gain_db.value, pade.aero_gain_db.value, 2),
            (sampled.rigid_gain_db.value, pade.rigid_gain_db.value, 2),
            (sampled.rigid_phase_deg.value, pade.rigid_phase_deg.value, 2),
            (sampled.modulus, pade.modulus, 3),
        ]
        lines.append(f"| {d.node.time_s:g} | " + " | ".join(f"{a:.{n}f}, {b:.{n}f}" for a, b, n in pairs) + " |")
    return "\n".join(lines) + "\n"


def _resonance(d: Departure, label: str) -> float:
    """Return the frequency of a resonance of the sampled loop, Hz."""
    return next(r.frequency_hz for r in d.resonances if r.label == label)


def compare() -> tuple[list[Departure], list[tuple[Margins, Margins]]]:
    """Return the departures and the margins (sampled, Padé) at the paper's operating points."""
    loaded = load_scenario(SCENARIO, [f'design="{DESIGN}"'])
    design = loaded.design
    assert design is not None
    found, measured = [], []
    for node in operating_points.nodes(loaded, range(5, 60, 5)):
        [sampled], [pade] = loops([node], design), loops([node], design, kind="pade")
        found.append(departure(node, pade.law, sampled.law))
        measured.append((_margins(sampled), _margins(pade)))
    return found, measured


def _margins(loop: Loop) -> Margins:
    return margins(loop, resonances=loop.fixed.resonances())


def main(arguments: list[str] | None = None) -> int:
    """Compare the loops, and write and print the page. The exit code is 2 for unknown arguments."""
    given = sys.argv[1:] if arguments is None else arguments
    if len(given) > 1 or any(item.startswith("-") for item in given):
        print((__doc__ or "").strip(), file=sys.stderr)
        return 2
    file = Path(given[0]) if given else DEFAULT_FILE
    text = table_text(*compare())
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")
    print(text)
    print(f"written to {file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
