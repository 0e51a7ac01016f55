"""docs/case-study/ agrees with docs/case-study.json and the designs in scenarios/designs."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path

import pytest

import maxq
from maxq.design.case.basis import stated_basis
from maxq.design.verify.judging import Wanted, checks, judge
from maxq.tools.dev import case_study

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = "\n".join(page.read_text(encoding="utf-8") for page in sorted((DOCS / "case-study").glob("*.md")))
OPTIMA = ("limits", "claims", "peaks")


@pytest.mark.parametrize("name", OPTIMA)
def test_tables_are_those_of_the_optima(name: str) -> None:
    page = case_study.page_of(name).read_text(encoding="utf-8")
    assert case_study.fill(page, name, case_study.TABLES[name]()) == page, "python -m maxq.tools.dev.case_study"


def test_every_table_has_its_place_and_every_picture_is_there() -> None:
    assert set(re.findall(r"<!-- begin (\S+) -->", PAGE)) == set(case_study.TABLES)
    pictures = [part.split(")")[0] for part in PAGE.split("](../pictures/")[1:]]
    for picture in pictures:
        assert (DOCS / "pictures" / picture).is_file(), picture
    shown = {Path(picture).name for picture in pictures}
    assert {path.name for path in (DOCS / "pictures" / "case-study").iterdir()} == shown


def test_a_page_without_a_place_is_refused() -> None:
    with pytest.raises(ValueError, match="the page has 0 places for limits"):
        case_study.fill("nothing here", "limits", [])


def test_sixty_optima_of_which_more_freedom_is_never_worse() -> None:
    optima = json.loads((DOCS / "case-study.json").read_text(encoding="utf-8"))["optima"]
    assert len(optima) == 60
    peaks = {
        tuple(o[key] for key in ("plant", "limits", "schedule", "structure")): o["objective_db"]
        for o in optima
        if o["status"] == "optimal"
    }
    assert len(peaks) == 60
    for problem in itertools.product(("flown", "table2"), ("identical", "relaxed")):
        by_schedule = [
            [peaks[*problem, schedule, f"F{order}"] for order in range(2, 7)]
            for schedule in ("two-phase", "linear", "free")
        ]
        for less, more in itertools.pairwise(by_schedule):
            assert all(b < a + 0.05 for a, b in zip(less, more, strict=True))
        for peaks_by_order in by_schedule:
            assert all(b < a + 0.05 for a, b in itertools.pairwise(peaks_by_order))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["ksr3-free", pytest.param("ksr3-linear", marks=pytest.mark.long), "ksr3-robust", "ksr3-sampled", "ksr3-two-phase"],
)
def test_shipped_designs_meet_what_they_state(name: str) -> None:
    """The limits hold by code that the optimiser does not use, on the loop of the case along the present flight."""
    design = maxq.load_design(f"designs/{name}")
    basis = stated_basis(design)
    assert basis is not None
    judged = judge(maxq.nodes("nominal", [5.0, 30.0, 50.0, 55.0]), design, basis.loop)
    assert all(j.margins.stable for j in judged)
    for check in checks(judged, design, Wanted.of(basis.limits)):
        slack = check.values[check.worst] - check.limit
        assert check.passed or abs(slack) < {"dB": 0.05, "deg": 0.3}.get(check.unit, 0.002), check.text
