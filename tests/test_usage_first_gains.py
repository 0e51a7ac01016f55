"""First gains of a layout are stable along their flight, or the build names the failures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import layoutkit
import numpy as np
import pytest

import maxq
from maxq.design.model.powered import powered_flight
from maxq.sim.run.flight import Event
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simvehicle
from maxq.tools.vehicle import files, first_gains
from maxq.tools.vehicle.build import build
from maxq.tools.vehicle.first_gains import FirstGains, checked
from maxq.tools.vehicle.layout import read_layout


def fastest_growth_1ps(folder: Path, count: int = 37) -> float:
    """Return the largest real part of the sampled loop's closed poles, by eigenvalues, along the powered flight."""
    scenario = load_scenario(folder / "scenario.toml")
    (span,), loss = powered_flight(scenario)
    assert loss is None
    times = np.linspace(span.begin_s + 1.0, span.end_s - 1.0, count).round(3)
    return max(
        float(loop.closed_poles().real.max()) for loop in maxq.loops(maxq.nodes(scenario, times), scenario.design)
    )


@pytest.mark.long
@pytest.mark.parametrize(("name", "code"), [("heavy", 0), ("student", 1)])
def test_first_gains_that_do_not_hold_their_flight_are_replaced(
    name: str, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By formula the heavy launcher is unstable at three of nine times, and the student rocket loses control.

    After the replacement, its gimbals remain too weak for 5 deg of angle of attack.
    """
    formula = checked(layoutkit.folder(name))
    assert not formula.hold
    assert formula.unstable_s
    assert (formula.loss is not None) == (name == "student")
    assert simvehicle.main([str(layoutkit.LAYOUTS / f"{name}.toml"), "--out", str(tmp_path)]) == code
    text = capsys.readouterr().out
    assert "first gains: by search, stable at 15 operating points of their own flight; least gain margin " in text
    assert fastest_growth_1ps(tmp_path) < 1e-6  # the slowest root is 0 to rounding where no air acts
    assert checked(tmp_path).gain_margin_db > 3.0
    assert fly(load_scenario(tmp_path / "scenario.toml"), log=False).failures == ()


@pytest.mark.slow
def test_gains_that_hold_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simvehicle.main(["ksr3", "--out", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "first gains: stable at 15 operating points of their own flight; least gain margin 6.9" in text
    built = build(read_layout("ksr3"))
    table = load_scenario(tmp_path / "scenario.toml").design.gains.table
    np.testing.assert_allclose(table["k_p"], [k_p for _, k_p, _ in built.gains], rtol=1e-5)


def test_gains_that_are_not_found_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = Event("control_lost", int(18.74e9))
    bad = FirstGains(15, (14.0, 16.2), lost, 0.68, 11.9)
    monkeypatch.setattr(first_gains, "checked", lambda folder: bad)

    def nothing(*_: object, **__: object) -> None:
        raise ValueError("no operating point")

    monkeypatch.setattr(first_gains, "design_case", nothing)
    assert simvehicle.main(["ksr3", "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().out.splitlines()[-1]
    where = "first gains: unstable at 14.0, 16.2 s; the flight is lost: control lost at 18.740 s"
    assert said.startswith(
        f"UNSTABLE: {read_layout('ksr3').name}; {where}; design it with: simdesign {tmp_path}/case.toml"
    )


def test_a_value_that_only_the_vehicle_rejects_is_an_error_of_the_layout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The layout's own checks are switched off by an edit of the vehicle that is made from it."""
    made = files._vehicle

    def edited(*given: Any) -> dict[str, Any]:
        vehicle: dict[str, Any] = made(*given)
        vehicle["reference"]["length_m"] = -1.0
        return vehicle

    monkeypatch.setattr(files, "_vehicle", edited)
    assert simvehicle.main(["ksr3", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said == (
        "simvehicle: ksr3: the vehicle made from it is not valid: vehicle/vehicle.toml: "
        "reference.length_m = -1.0: is out of range; allowed: a number > 0 (and 3 more)"
    )
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.long
def test_an_interrupted_build_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(folder: Path) -> FirstGains:
        assert (folder / "scenario.toml").exists()  # in a temporary folder
        raise KeyboardInterrupt

    monkeypatch.setattr("maxq.tools.vehicle.build.MODE_ROWS", 2)
    monkeypatch.setattr(first_gains, "checked", interrupted)
    built = build(read_layout(layoutkit.LAYOUTS / "stub.toml"))
    with pytest.raises(KeyboardInterrupt):
        first_gains.write_with_first_gains(built, tmp_path / "new")
    assert not (tmp_path / "new").exists()
