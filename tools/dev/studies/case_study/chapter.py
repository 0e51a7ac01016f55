"""Tables and pictures of docs/case-study.md, all anew: `python -m maxq.tools.dev.studies.case_study.chapter`.

Solves the sixty problems of the paper's table (docs/case-study.json keeps their parameters), judges and flies the
designs in scenarios/designs, and writes what comes of it between the marks of docs/case-study.md and into
docs/pictures/case-study/. Prose is written by people. Campaigns are flown and verdicts found by other commands
(dispersed.py, judgement.py) and taken out of docs/case-study-campaigns.json and -verdicts.json. With --keep the optima
of docs/case-study.json are taken as they are; with --only NAME ... just these tables and pictures are made.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

from maxq.control.filters import BendingFilter, FirstOrderSection, QuadraticSection
from maxq.design import api
from maxq.design.loop.errata_effects import EXPLAINED
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.scenario.schema_design import Design
from maxq.tools.design import album, pictures_design, pictures_margins
from maxq.tools.design.design_file import builtin_designs, design_of
from maxq.tools.design.errata_table import effects
from maxq.tools.design.judging import Wanted, judge
from maxq.tools.design.pictures_loop import draw_loop, picture_of
from maxq.tools.dev.documents.derivatives_table import PAPER
from maxq.tools.dev.studies.case_study import (
    dispersed,
    dispersed_page,
    judgement,
    judgement_page,
    optima,
    optima_tables,
    robustness,
)
from maxq.tools.dev.studies.case_study.flights import flights_table, fly_design
from maxq.tools.dev.studies.case_study.page import filled, places
from maxq.tools.dev.studies.case_study.relaxing import relaxing_table
from maxq.tools.plots.style import drawing

DOCS = Path(__file__).resolve().parents[4] / "docs"
PAGE, PICTURES = DOCS / "case-study.md", DOCS / "pictures" / "case-study"
SHOWN = ("ksr3-two-phase", "ksr3-linear", "ksr3-sampled", "ksr3-robust")
NOVEMBER = "winds/anheung-november.csv"
FORMATS = ("png",)


@cache
def design(name: str) -> Design:
    """A built-in design."""
    return api.load_design(f"designs/{name}")


@cache
def known_optima() -> optima_tables.Optima:
    return optima_tables.Optima(optima.read())


def optimum_design(o: optima.Optimum) -> Design:
    """An entry of the table as a design, to be drawn."""
    flt = BendingFilter(
        tuple(QuadraticSection(*row) for row in o.quadratic), tuple(FirstOrderSection(*row) for row in o.first_order)
    )
    return design_of(
        name=o.structure, description="", vehicle="", time_s=o.time_s, k_p=o.k_p, k_d_s=o.k_d_s, flt=flt,
        discretization="prewarped", prewarp_hz=9.7,
    )  # fmt: skip


# tables


def flights() -> list[str]:
    flown = []
    for name in builtin_designs():
        flown.append(fly_design(f"designs/{name}.toml"))
        flown.append(fly_design(f"designs/{name}.toml", [f"wind.profile={NOVEMBER}"], "November jet"))
    return flights_table(flown)


def errata() -> list[str]:
    """The largest change of each over the nodes."""
    found = effects(api.nodes("nominal"), design("ksr3-default"))
    lines = ["| nr | erratum, as printed | mode 1, dB | mode 2, dB | gain margin, dB | phase margin, deg |"]
    lines.append("|---|---|---:|---:|---:|---:|")
    for name in dict.fromkeys(e.erratum for e in found):
        mine = [e for e in found if e.erratum == name]
        lost = sum(e.printed.get("unstable", 0.0) > 0.0 for e in mine)
        cells = [_largest([e.change(key) for e in mine]) for key in ("peak 1", "peak 2")]
        for key in ("gain", "phase"):
            cells.append(f"unstable at {lost} nodes" if lost else _largest([e.change(key) for e in mine]))
        about = EXPLAINED[name]
        printed = about.printed if about.printed != "none" else f"left out: {about.corrected}"
        lines.append(f"| {about.number} | {printed} | " + " | ".join(cells) + " |")
    return lines


def _largest(changes: list[float]) -> str:
    known = [c for c in changes if not math.isnan(c)]
    return f"{max(known, key=abs):+.2f}" if known else "-"


def robust() -> list[str]:
    return robustness.side_by_side({name: design(name) for name in ("ksr3-default", *SHOWN)})


TABLES: dict[str, Callable[[], list[str]]] = {
    "limits": optima_tables.limits_table,
    "errata": errata,
    "claims": lambda: optima_tables.claims_table(known_optima()),
    "relaxing": lambda: relaxing_table(known_optima()),
    "peaks": lambda: optima_tables.peaks_table(known_optima()),
    "parameters": lambda: optima_tables.parameters_table(known_optima(), "flown", "identical"),
    "parameters-relaxed": lambda: optima_tables.parameters_table(known_optima(), "flown", "relaxed"),
    "robust": robust,
    "flights": flights,
    "campaigns": lambda: dispersed_page.verdicts_table(dispersed.read(), "moderate"),
    "campaigns-light": lambda: dispersed_page.verdicts_table(dispersed.read(), "light"),
    "campaigns-baffles": lambda: dispersed_page.verdicts_table(dispersed.read(), "baffles"),
    "campaigns-smooth": lambda: dispersed_page.verdicts_table(dispersed.read(), "smooth"),
    "verdicts": lambda: judgement_page.ranking_table(judgement.read()["designs"]),
    "verdicts-orders": lambda: judgement_page.ranking_table(judgement.read()["orders"]),
    "verdicts-limits": lambda: judgement_page.limits_table(judgement.read()),
    "verdicts-both": lambda: judgement_page.side_by_side_table(judgement.read()),
    "verdicts-changes": lambda: judgement_page.changes_table(judgement.read()),
}


# pictures


def vehicle_pictures() -> None:
    scenario = load_scenario("nominal")
    nodes = api.nodes(scenario, [5.0 + 0.5 * k for k in range(101)])
    tanks = [tank.name for tank in scenario.vehicle.stage[0].tank]
    for stem, draw in album.vehicle_sheets(nodes, tanks, PAPER):
        draw(PICTURES / stem)


def optima_pictures() -> None:
    """The paper's Figs 7 to 9 and 11 to 14."""
    found, nodes = known_optima(), api.nodes("nominal")
    bands = album.mode_bands_hz(nodes)
    for limits in optima.LIMITS:
        series: dict[str, Mapping[str, float]] = {
            name: {f: found.peak("flown", limits, schedule, f) for f in optima.STRUCTURES}
            for schedule, name in zip(optima.SCHEDULES, ("two-phase", "Subcase 1", "Subcase 2"), strict=True)
        }
        pictures_design.peaks_over_order(series, PICTURES / f"peaks-{limits}", optima_tables.LIMIT_NAMES[limits])
    for schedule in optima.SCHEDULES:
        limits = "identical"
        each = {f: optimum_design(found.all["flown", limits, schedule, f]) for f in optima.STRUCTURES}
        gains = {"two-phase": each["F4"]} if schedule == "two-phase" else each
        pictures_design.gains(gains, PICTURES / f"gains-{schedule}")
        pictures_design.filters(each, PICTURES / f"filters-{schedule}", nodes[0].instruments.sample_s, bands)


def loop_pictures() -> None:
    """The paper's kind of optimum beside the robust design, where dynamic pressure is largest."""
    nodes = api.nodes("nominal")
    for name in ("ksr3-two-phase", "ksr3-robust"):
        judged = judge(nodes, design(name))
        wanted = Wanted.of(design(name).limits)
        at = next(j for j in judged if j.time_s == 40.0)
        zones = [c.zone for c in at.margins.clearances]
        draw_loop(picture_of(at, f"{name} at 40 s, sampled", zones), PICTURES / f"loop-{name}")
        pictures_margins.lobes_over_time(judged, wanted, PICTURES / f"lobes-{name}")
    both = {name.removeprefix("ksr3-"): judge(nodes, design(name)) for name in ("ksr3-two-phase", "ksr3-robust")}
    pictures_margins.margins_over_time(both, Wanted.of(design("ksr3-robust").limits), PICTURES / "margins")


def sweep_pictures() -> None:
    nodes = api.nodes("nominal")
    swept = {name: robustness.bending_sweep(nodes, design(name)) for name in SHOWN}
    robustness.draw_sweep(swept, PICTURES / "sweep")


def campaign_pictures() -> None:
    results = dispersed.read()
    dispersed_page.exceedance_picture(results, PICTURES / "campaign-exceedance")
    dispersed_page.envelopes_picture(results, PICTURES / "campaign-envelopes")
    dispersed_page.drivers_picture(results, PICTURES / "campaign-drivers")


DRAWN: dict[str, Callable[[], None]] = {
    "pictures-vehicle": vehicle_pictures,
    "pictures-optima": optima_pictures,
    "pictures-loops": loop_pictures,
    "pictures-sweep": sweep_pictures,
    "pictures-campaigns": campaign_pictures,
}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--keep", action="store_true", help="the optima of docs/case-study.json as they are")
    parser.add_argument(
        "--only", nargs="+", choices=[*TABLES, *DRAWN], metavar="NAME", help=", ".join([*TABLES, *DRAWN])
    )
    given = parser.parse_args(arguments)
    wanted = given.only or [*TABLES, *DRAWN]
    if not given.keep and given.only is None:
        optima.write(optima.all_tables(), optima.DEFAULT_FILE)
    page = PAGE.read_text(encoding="utf-8")
    PICTURES.mkdir(parents=True, exist_ok=True)
    for name in [n for n in places(page) if n in wanted]:
        print(name, file=sys.stderr)
        page = filled(page, name, TABLES[name]())
        PAGE.write_text(page, encoding="utf-8")
    with drawing(FORMATS):
        for name in [n for n in DRAWN if n in wanted]:
            print(name, file=sys.stderr)
            DRAWN[name]()
    return 0


if __name__ == "__main__":
    sys.exit(main())
