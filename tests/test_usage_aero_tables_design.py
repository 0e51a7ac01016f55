"""KSR-III with its slopes as tables over Mach number and total angle of attack flies, linearises and designs alike."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from oracles.hand_model import planar_of

from maxq import LoadedScenario, Node
from maxq.design.model.node import nodes_along
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simdesign

TOTAL_DEG = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 20.0, 30.0, 45.0, 60.0, 90.0, 135.0, 180.0)


@pytest.fixture
def tabulated(tmp_path: Path) -> Path:
    """Return a vehicle file with each surface as CN = CN_alpha sin cos at its station, with Cm about the nose."""
    vehicle = load_scenario("nominal").scenario.vehicle
    aero, chord = vehicle.stage[0].aero, vehicle.reference.chord_m
    assert aero is not None
    entries = []
    for surface in aero.surface:
        rows = ["mach,total_deg,CN,Cm"]
        for mach, slope, station in zip(*(surface.table[k] for k in ("mach", "CN_alpha_pr", "station_m")), strict=True):
            for angle in TOTAL_DEG:
                t = np.radians(angle)
                cn = 0.0 if angle == 180.0 else float(slope * np.sin(t) * abs(np.cos(t)))
                rows.append(f"{float(mach)!r},{angle!r},{cn!r},{-cn * float(station) / chord!r}")
        (tmp_path / f"{surface.name}.csv").write_text("\n".join(rows) + "\n")
        station_m = float(surface.table["station_m"].mean())
        entries.append(f'{{table = "{surface.name}.csv", station_m = {station_m!r}}}')
    file = tmp_path / "nominal-tables.toml"
    file.write_text(
        'schema = 1\nextends = "nominal.toml"\n[vehicle_overrides]\nstage.0.aero.surface = []\n'
        f"stage.0.aero.coefficients = [{', '.join(entries)}]\n"
    )
    return file


def loaded(file: Path | str) -> LoadedScenario:
    return load_scenario(file, ["run.duration_s=60"])


def along_the_axis(node: Node) -> Node:
    """Return the operating point without effects of the flown angle of attack outside the tables, mainly cross-flow."""
    assert abs(planar_of(node).aerodynamics.slope_pr[-1]) > 1e-3, (
        "a vehicle without tables is taken at zero angle of attack"
    )
    return dataclasses.replace(node, trim=(0.0, 0.0))


@pytest.mark.slow
def test_derivatives_and_flight_are_those_of_the_slopes(tabulated: Path) -> None:
    """Derivatives and flight agree within the table's resolution.

    The tolerances cover the curvature of CN between points and the slopes of pchip.
    """
    for plane in ("pitch", "yaw"):
        both = [nodes_along(loaded(name), [10.0, 30.0, 50.0], plane) for name in (tabulated, "nominal")]  # type: ignore[arg-type]  # one of the two planes
        for ours, theirs in zip(*both, strict=True):
            alike = along_the_axis(ours), theirs
            a, b = (dataclasses.astuple(n.derivatives) for n in alike)
            np.testing.assert_allclose(a, b, rtol=5e-3)
            poles = (np.sort_complex(n.plant.poles()) for n in alike)
            np.testing.assert_allclose(*poles, rtol=5e-3, atol=5e-3)
    ours, theirs = (fly(loaded(name), log=False).metrics for name in (tabulated, "nominal"))
    for name in ("max_dynamic_pressure_Pa", "max_q_alpha_Padeg", "max_attitude_error_deg"):
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-2)


@pytest.mark.slow
def test_a_design_is_analysed_on_tables(tabulated: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["analyse", "ksr3-robust", "--scenario", str(tabulated), "--no-pictures", "--at", "30", "--at", "45"]
    assert simdesign.main(arguments) == 0
    assert capsys.readouterr().out.count("stable") >= 2
