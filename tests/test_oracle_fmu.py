"""Units for co-simulation (`simrun export --fmu`) against FMPy: its validator, and flights with it as the master."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest
from flight_code import EXAMPLES, flies

from maxq.control.external import FswInputs, FswOutputs
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simrun
from maxq.tools.fmu.export import UNITS, described_fields

CHANGES = ["run.duration_s=1", "requirement="]
needs_extra = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("pythonfmu", "pythonfmu3", "fmpy")),
    reason="the extra maxq[fmu] or FMPy is not installed",
)


def export(fmu: Path, *more: str) -> int:
    return simrun.main(["export", "nominal", "--fmu", str(fmu), *(w for c in CHANGES for w in ("--set", c)), *more])


@needs_extra
@pytest.mark.slow
@pytest.mark.parametrize("version", ["3.0", "2.0"])
def test_a_unit_is_valid_and_flies_to_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str
) -> None:
    """Python flight code flies the unit with FMPy as the master; the same code in a process of maxq is the oracle."""
    from fmpy import read_model_description  # noqa: PLC0415  # an extra
    from fmpy.validation import validate_fmu  # noqa: PLC0415  # an extra

    unit = tmp_path / "rocket.fmu"
    assert export(unit, "--fmi", version) == 0
    assert validate_fmu(str(unit)) == []
    variables = {v.name: v for v in read_model_description(str(unit)).modelVariables}
    for schema, causality in ((FswInputs, "output"), (FswOutputs, "input")):
        for name, kind, unit_name, text in described_fields(schema):
            found = variables.pop(name)
            assert (found.causality, found.description) == (causality, text)
            assert found.type == ({"d": "Float64", "q": "Int64"}[kind] if version == "3.0" else "Real")
            assert (found.unit or "") == (unit_name if kind == "d" else "")
    assert set(variables) - {"time"} == {"finished", "log_folder"}

    monkeypatch.setenv("MAXQ_SIMRUN", str(Path(sys.executable).with_name("simrun")))
    monkeypatch.syspath_prepend(str(EXAMPLES.parent / "fmu"))
    from master import fly as fly_unit  # noqa: PLC0415  # the example

    steps, last = fly_unit(str(unit), str(tmp_path / "log"))
    assert steps == 100
    assert last.time_s == pytest.approx(0.99)
    flown = json.loads((tmp_path / "log" / "summary.json").read_text())
    wanted = fly(load_scenario("nominal", [*CHANGES, *flies(python=f"{EXAMPLES}/pd_law.py:Autopilot")]))
    assert flown["outcome"] == wanted.outcome == "duration"
    assert flown["state_hash"] == wanted.state_hash
    idle = fly(load_scenario("nominal", [*CHANGES, "vehicle.computer.command_limit_deg=1e-6"]))
    assert idle.state_hash != wanted.state_hash  # the commands matter within this second


def test_every_number_of_the_structs_has_a_description_and_its_unit() -> None:
    fields = {name: rest for struct in (FswInputs, FswOutputs) for name, *rest in described_fields(struct)}
    assert all(text for _, _, text in fields.values())
    assert {unit for _, unit, _ in fields.values()} <= {"", *UNITS}
    assert fields["further_rate_radps[3,2]"] == ["d", "rad/s", "rate gyros beyond the first, mean over the sample"]
    assert fields["gimbal_rad[1]"][:2] == ["d", "rad"]
    assert fields["magnetic_B_T[2]"][:2] == ["d", "T"]
    assert "attitude commanded by this code" in fields["out_commanded_q_BR[3]"][2]
    assert fields["commanded_q_BR[3]"][2] == "of the guidance"
    assert fields["tick"][:2] == ["q", ""]
    assert fields["dynamic_pressure_Pa"][:2] == ["d", "Pa"]
    assert fields["delta_velocity_mps[0]"][:2] == ["d", "m/s"]


def test_a_unit_that_cannot_be_exported_is_rejected_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(tmp_path / "rocket.zip") == 2
    assert "rocket.zip: the name of a unit for co-simulation ends with .fmu" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "pythonfmu3", None)
    assert export(tmp_path / "rocket.fmu") == 2
    assert "pip install 'maxq[fmu]'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
