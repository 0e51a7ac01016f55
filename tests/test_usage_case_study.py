"""docs/case-study.md says what docs/case-study.json and the designs in scenarios/designs say."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from maxq.design import api
from maxq.tools.design.design_file import builtin_designs
from maxq.tools.design.judging import Wanted, checks, judge
from maxq.tools.dev.studies.case_study import chapter, optima
from maxq.tools.dev.studies.case_study.designs import DESIGNS
from maxq.tools.dev.studies.case_study.page import filled, places

PAGE = chapter.PAGE.read_text(encoding="utf-8")
CHEAP = (
    "limits",
    "claims",
    "peaks",
    "parameters",
    "parameters-relaxed",
    "campaigns",
    "campaigns-light",
    "campaigns-smooth",
    "campaigns-baffles",
    "verdicts",
    "verdicts-limits",
    "verdicts-both",
    "verdicts-changes",
)


@pytest.mark.parametrize("name", CHEAP)
def test_tables_are_those_of_the_optima(name: str) -> None:
    assert filled(PAGE, name, chapter.TABLES[name]()) == PAGE, (
        "python -m maxq.tools.dev.studies.case_study.chapter --keep"
    )


def test_every_table_has_its_place_and_every_picture_is_there() -> None:
    assert set(places(PAGE)) == set(chapter.TABLES)
    pictures = [part.split(")")[0] for part in PAGE.split("](pictures/")[1:]]
    for picture in pictures:
        assert (chapter.DOCS / "pictures" / picture).is_file(), picture
    shown = {Path(picture).name for picture in pictures}
    assert {path.name for path in chapter.PICTURES.iterdir()} == shown


def test_a_page_without_a_place_is_refused() -> None:
    with pytest.raises(ValueError, match="the page has no place for limits"):
        filled("nothing here", "limits", [])


def test_sixty_optima_of_which_more_freedom_is_never_worse() -> None:
    found = chapter.known_optima()
    assert len(found.all) == 60
    for plant in optima.PLANTS:
        for limits in optima.LIMITS:
            first, second = found.gains(plant, limits)
            assert min(*first, *second) > -0.05
            for schedule in optima.SCHEDULES:
                peaks = [found.peak(plant, limits, schedule, f) for f in optima.STRUCTURES]
                assert all(b < a + 0.05 for a, b in itertools.pairwise(peaks))


@pytest.mark.parametrize("name", sorted(DESIGNS))
def test_shipped_designs_meet_what_they_state(name: str) -> None:
    """Judged by what the optimiser does not use, on the loop of their case; conditions are those of the flight now."""
    assert name in builtin_designs()
    design = api.load_design(f"designs/{name}")
    kind = "sampled" if name in ("ksr3-robust", "ksr3-sampled") else "pade"
    judged = judge(api.nodes("nominal", [5.0, 30.0, 50.0, 55.0]), design, kind)
    assert all(j.margins.stable for j in judged)
    for check in checks(judged, design, Wanted.of(design.limits)):
        slack = check.values[check.worst] - check.limit
        assert check.passed or abs(slack) < {"dB": 0.05, "deg": 0.3}.get(check.unit, 0.002), check.text
