"""Designs for Greensite's launcher at 72 s, by two courses and by maxq: the table of docs/howto/derivatives.md.

python -m maxq.tools.dev.greensite           write the table (a second)
python -m maxq.tools.dev.greensite --search  also optimise the built-in case again (half a minute of CPU)
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from maxq.design.case.schema import read_case
from maxq.design.laws.design_file import design_text
from maxq.design.verify.judging import InWind, JudgedLoop, in_wind, judge
from maxq.sim.files import write_whole
from maxq.sim.input.files import scenarios_folder
from maxq.sim.scenario.loader import read_design
from maxq.sim.scenario.schema_design import Design
from maxq.tools.design import points
from maxq.tools.dev.verification.section import DOCS, rewrite

PAGE = DOCS / "howto" / "derivatives.md"
DESIGNS = {
    "HM3 (published)": "greensite-hm3",
    "Zavoli (published)": "greensite-zavoli",
    "maxq, least load": "greensite",
}
HEAD = (
    "| design | lower, upper gain margin, dB | phase margin, deg | least abs(1 + L) | mode 1, dB | q alpha, Pa deg | "
    "drift, m/s |\n|---|---|---|---|---|---|---|"
)


def measured(design: Design) -> tuple[JudgedLoop, Sequence[InWind]]:
    """Return the loop of a design at the point of the built-in case, and its rms responses to the wind of the case."""
    loaded = read_case("greensite")
    assert loaded.points is not None
    nodes = [loaded.points.point(t) for t in loaded.case.times_s]
    return judge(nodes, design, loaded.case.loop)[0], in_wind(loaded.case, nodes, design, None)


def row(name: str, design: Design) -> str:
    """Return the row of the table for a design."""
    loop, wind = measured(design)
    m = loop.margins
    load, drift = (float(np.max(one.rms)) for one in wind)
    gains_db = f"{m.gain_down_db.value:.2f}, {m.gain_up_db.value:.2f}"
    return (
        f"| {name} | {gains_db} | {m.phase_deg.value:.1f} | {m.modulus:.3f} | "
        f"{loop.mode_peak_db(1, 1):.1f} | {load:,.0f} | {drift:.3f} |"
    )


def main(arguments: Sequence[str]) -> None:
    """Write the table. With --search, first optimise the case and write its design."""
    if "--search" in arguments:
        outcome, _ = points.designed_at_points(read_case("greensite"))
        text = design_text(outcome.design, ["Written by `python -m maxq.tools.dev.greensite --search`."])
        write_whole(scenarios_folder() / "designs" / "greensite.toml", text)
    table = [HEAD, *(row(name, read_design(design)) for name, design in DESIGNS.items())]
    rewrite(PAGE, "greensite", "\n".join(table))


if __name__ == "__main__":
    main(sys.argv[1:])
