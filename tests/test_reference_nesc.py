"""NASA's NESC check cases as ordinary scenarios meet the strict tolerances of tests/data/nesc."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import pytest

from maxq import Flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.dev.verification import nesc
from maxq.tools.dev.verification.nesc_cases import ALL_CASES, LargestDifference, fly_case, read_tolerances

ATMOSPHERIC = "01", "02", "04", "05", "06", "07", "09"


@cache
def flown(scenario: str) -> Flight:
    return fly_case(scenario)


@cache
def differences(case: str) -> list[LargestDifference]:
    scenario, compare = ALL_CASES[case]
    return compare(flown(scenario))


def outside(found: list[LargestDifference]) -> list[str]:
    """Return the variables that miss their tolerance; nan also misses it."""
    return [f"{d.variable}: {d.largest:.3g} > {d.tolerance:.3g}" for d in found if not d.ratio <= 1.0]


@pytest.mark.parametrize("case", ALL_CASES)
def test_check_case_meets_the_strict_tolerances(case):
    assert outside(differences(case)) == []


@pytest.mark.parametrize("case", ATMOSPHERIC)
def test_every_variable_of_the_table_of_tolerances_is_compared(case):
    expected = [row["variable"] for row in read_tolerances() if row["case"] == case]
    assert [d.variable for d in differences(case)] == expected
    assert len(expected) == 32
    assert {d.tolerance for d in differences(case)} == {
        float(row["strict"]) for row in read_tolerances() if row["case"] == case
    }


WRONG = {
    "rate of the Earth": ("01", "earth.rate_radps=7.2921159e-5"),
    "oblateness": ("01", "earth.j2=1.0827e-3"),
    "size of the Earth": ("09", "earth.equatorial_radius_m=6378138.0"),
    "inertia": (
        "02",
        "vehicle.stage.0.mass.inertia_kgm2=[[0.002568, 0.0, 0.0], [0.0, 0.008422, 0.0], [0.0, 0.0, 0.009755]]",
    ),
    "radius of the sphere": ("04", "earth.sphere_radius_m=6371008.8"),
    "rotation of the sphere": ("05", "earth.rotating=false"),
    "drag": ("06", "vehicle.stage.0.aero.table.CD=[0.1001]"),
    "direction of the wind": ("07", "wind.from_deg=90.0"),
    "density": ("09", "atmosphere.density_factor=1.001"),
    "frame of the rates": ("09", "initial.rate_BE_degps=[0.0, 0.0, 0.00418]"),
    "drag in orbit": ("exo 6A C", "atmosphere.density_kgpm3=1.4001e-12"),
    "gravitational parameter": ("exo 8A", "earth.mu_m3ps2=3.986004418e14"),
    "torque": ("exo 9B", "injection.0.stop_s=2000.001"),
    "gravity gradient": ("exo 10D", "earth.gravity_gradient=false"),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_tolerances_resolve_a_small_mistake(mistake):
    """The comparison detects a small mistake."""
    case, override = WRONG[mistake]
    scenario, compare = ALL_CASES[case]
    assert outside(compare(fly(load_scenario(f"checkcases/{scenario}", [override]))))


def test_a_difference_that_is_no_number_misses():
    assert outside([LargestDifference("", "x", "", math.nan, 1.0, 0.0)])


def test_table_goes_between_the_markers(tmp_path):
    document = tmp_path / "verification.md"
    document.write_text("before\n<!-- nesc: begin -->\nold\n<!-- nesc: end -->\nafter\n")
    nesc.insert("new\n", document)
    nesc.insert("new\n", document)
    assert document.read_text() == "before\n<!-- nesc: begin -->\nnew\n<!-- nesc: end -->\nafter\n"


def test_published_table_names_every_case_and_no_miss():
    text = (Path(__file__).parents[1] / "docs" / "verification.md").read_text()
    table = text.partition("<!-- nesc: begin -->")[2].partition("<!-- nesc: end -->")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.strip().splitlines()[2:]]
    assert [row[0] for row in rows] == list(ALL_CASES)
    assert {row[4] for row in rows} == {"0"}
