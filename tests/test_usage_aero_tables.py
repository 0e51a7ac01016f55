"""Wrong tables of coefficients over angle of attack are rejected with a one-line error and the values allowed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aero_tables import OVER_TOTAL, PARTS, REFERENCE
from flightkit import Tree, load, scenario_of, toml, with_stage

from maxq import ScenarioError
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.air.tables import grid_table

SMALL = {"mach": [0.0, 0.0, 1.0, 1.0], "alpha_deg": [-5.0, 5.0, -5.0, 5.0], "CN": [-1.0, 1.0, -2.0, 2.0]}


def tree_of(aero: Tree) -> Tree:
    return with_stage(scenario_of(PARTS, vehicle={"reference": REFERENCE}), aero=aero)


def said(aero: Tree) -> str:
    with pytest.raises(ScenarioError) as caught:
        load(tree_of(aero))
    return str(caught.value)


def total(**columns: Any) -> Tree:
    return {"total_deg": [0.0, 10.0], "CN": [0.0, 1.0]} | columns


@pytest.mark.parametrize(
    ("table", "problem", "allowed"),
    [
        (SMALL | {"alpha_deg": [-5.0, 5.0, -5.0, 6.0]}, "has no row for mach = 0, alpha_deg = 6", "2 x 3 combinations"),
        (SMALL | {"mach": [0.0, 0.0, 1.0, 0.0]}, "appears twice", "one row for each combination"),
        (SMALL | {"alpha_deg": [-5.0, 5.0, -5.0, 200.0]}, "is outside -180 .. 180", "-180 .. 180"),
        (SMALL | {"roll_deg": [0.0] * 4}, "roll_deg has no meaning without total_deg", "total_deg with roll_deg"),
        (SMALL | {"total_deg": [0.0] * 4}, "cannot be combined with alpha_deg", "one or the other"),
        (SMALL | {"beta_deg": [0.0] * 4, "total_deg": [0.0] * 4}, "has 4 axes", "at most 3"),
        ({"CN": [1.0]}, "no column of an axis", "mach, total_deg, roll_deg"),
        ({"mach": [1.0]}, "no column of a coefficient", "CA, CX"),
        (SMALL | {"CM": [1.0] * 4}, 'unknown column "CM"', "columns mach"),
        (SMALL | {"CZ": [1.0] * 4}, "column CZ cannot be combined with CN", "two tables"),
        (SMALL | {"CD": [1.0] * 4}, "column CN cannot be combined with CD", "two tables"),
        (total(total_deg=[5.0, 10.0]), "total_deg begins at 5", "a first total_deg = 0"),
        (total(CN=[0.1, 1.0]), "CN is not zero at total_deg = 0, where it has no direction", "0"),
        (total(total_deg=[0.0, 180.0]), "CN is not zero at total_deg = 180", "0"),
    ],
)  # fmt: skip  # a table
def test_a_wrong_table_is_refused(table: Tree, problem: str, allowed: str) -> None:
    line = said({"coefficients": [{"table": table}]})
    assert "\n" not in line
    assert "aero.coefficients.0.table" in line or "aero.coefficients[0].table" in line, line
    assert problem in line, line
    assert allowed in line, line


def test_roll_must_close_and_not_matter_along_the_axis() -> None:
    rows = [(t, r) for t in (0.0, 10.0) for r in (0.0, 180.0, 360.0)]
    table = {"total_deg": [t for t, _ in rows], "roll_deg": [r for _, r in rows]}
    assert "differs between roll_deg = 0 and 360" in said(
        {"coefficients": [{"table": table | {"CN": [0, 0, 0, 1, 2, 3]}}]}
    )
    assert "covers 400 deg" in said(
        {"coefficients": [{"table": table | {"roll_deg": [-40.0, 180.0, 360.0] * 2, "CN": [0, 0, 0, 1, 2, 1]}}]}
    )
    along = said({"coefficients": [{"table": table | {"CA": [1, 2, 1, 1, 2, 1]}}]})
    assert "CA depends on roll_deg at total_deg = 0" in along


def test_keys_that_do_not_go_together() -> None:
    one = {"coefficients": [{"table": SMALL}]}
    assert "required key is missing" in said({"interpolation": "linear"})
    moving = {"time_s": [0.0, 1.0], "station_m": [1.0, 2.0]}
    assert "cannot be combined with a moment reference that moves" in said(
        one | {"moment_reference_over_time": moving, "moment_reference_m": 1.0}
    )
    assert "need a table over total_deg" in said({"coefficients": [{"table": SMALL, "axes": "aeroballistic"}]})
    assert "surfaces and tables" in said(
        {
            "coefficients": [{"table": SMALL}] * 8,
            "surface": [{"table": {"mach": [0.0], "CN_alpha_pr": [1.0], "station_m": [1.0]}}],
        }
    )
    assert "lies beyond the mode shapes" in said({"coefficients": [{"table": SMALL, "station_m": 99.0}]})


def test_a_file_is_named_with_its_line(tmp_path: Path) -> None:
    table = tmp_path / "cn.csv"
    table.write_text("mach,total_deg,CA,CN\n0,0,0.3,0\n0,10,0.3,1.2\n# faster\n2,0,0.4,0\n2,10,0.4,oops\n")
    text = "\n".join(f"{k} = {toml(v)}" for k, v in tree_of({"coefficients": [{"table": "cn.csv"}]}).items())
    scenario = tmp_path / "a.toml"
    scenario.write_text(text)
    with pytest.raises(ScenarioError, match=r'cn\.csv: line 6, CN = "oops": is not a number'):
        load_scenario(scenario)
    table.write_text(table.read_text().replace("oops", "1.5"))
    grid = load_scenario(scenario).scenario.vehicle.stage[0].aero.coefficients[0].grid
    assert grid.axes == ("mach", "total_deg")
    np.testing.assert_array_equal(grid.values[..., 1], [[0.0, 1.2], [0.0, 1.5]])


def test_rows_may_stand_in_any_order() -> None:
    turned = {name: list(reversed(column)) for name, column in OVER_TOTAL.items()}
    ours, theirs = (
        grid_table(load(tree_of({"coefficients": [{"table": t}]})).scenario.vehicle.stage[0].aero.coefficients[0].table)
        for t in (OVER_TOTAL, turned)
    )
    np.testing.assert_array_equal(ours.values, theirs.values)
    assert ours.breaks[2][-1] == ours.breaks[2][0] + 360.0
