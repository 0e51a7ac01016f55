"""Random layouts near the documented vehicles are rejected with one line, or built and flown.

A few run in every test run; `MAXQ_LAYOUTS=200 make test ARGS="-k fuzzed_layouts"` draws 200.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from file_fuzzer import LAYOUT
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import maxq
from maxq import ScenarioError
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.vehicle.build import build
from maxq.tools.vehicle.build import warnings as warnings_of
from maxq.tools.vehicle.files import write
from maxq.tools.vehicle.layout import read_layout
from maxq.tools.vehicle.report import report

WHOLE = int(os.environ.get("MAXQ_LAYOUTS", "0"))
G = 9.80665


def about(value: float, factor: float = 1.5) -> st.SearchStrategy[float]:
    """Return values within a factor of a value, to four digits."""
    return st.floats(value / factor, value * factor).map(lambda x: float(f"{x:.4g}"))


@st.composite
def layouts(draw: st.DrawFn) -> dict[str, Any]:
    """Draw one to three stages from the top down, each sized for those above it: thrust, propellant, structure."""
    stages: list[dict[str, Any]] = []
    front, above_kg = 0.0, 0.0
    for n in range(draw(st.integers(1, 3))):
        top = n == 0
        diameter = draw(about(0.8)) if top else max(stages[0]["diameter_m"], draw(about(stages[0]["diameter_m"], 1.2)))
        ratio = draw(st.floats(1.5, 3.5))  # of masses over the burn
        payload_kg = draw(about(150.0)) if top else 0.0
        dry_kg = draw(about(0.12, 1.4)) * (above_kg + payload_kg) * ratio + 60.0
        propellant_kg = (ratio - 1.0) * (above_kg + payload_kg + dry_kg)
        solid = draw(st.integers(0, 4)) == 0
        begin = front + (2.0 * diameter if top else 0.5)
        parts: list[dict[str, Any]] = []
        tanks: list[dict[str, Any]] = []
        at = begin
        shares = [("oxygen", 0.7, 1140.0), ("kerosene", 0.3, 810.0)][: draw(st.integers(1, 2))]
        whole = sum(share for _, share, _ in shares)
        for name, share, density in shares:
            kg = propellant_kg * share / whole
            radius = 0.47 * diameter
            height = kg / (density * np.pi * radius**2) * draw(st.floats(1.2, 1.6)) + 0.2 * radius
            dome = draw(st.sampled_from([0.0, 0.25, 0.5])) * radius
            height += 2.0 * dome
            at += float(height) + 0.3
            tanks.append(
                {
                    "name": name,
                    "liquid_mass_kg": kg,
                    "residual_kg": draw(st.sampled_from([0.0, 0.01])) * kg,
                    "density_kgpm3": density,
                    "radius_m": radius,
                    "height_m": float(height),
                    "dome_m": [dome, dome],
                    "bottom_station_m": at,
                    "damping_ratio": draw(st.sampled_from([0.005, 0.02])),
                }
            )
        grain = {"mass_kg": propellant_kg, "front_station_m": begin, "rear_station_m": at}
        rear = at + 0.6
        if top:
            parts.append({"name": "payload", "mass_kg": payload_kg, "front_station_m": 0.3, "rear_station_m": begin})
        parts.append({"name": "structure", "mass_kg": dry_kg, "front_station_m": front, "rear_station_m": rear})
        engines = draw(st.sampled_from([1, 1, 2, 3, 5, 9]))
        ring = [(2.0 * np.pi * k / max(engines - 1, 1)) for k in range(engines - 1)]
        places = [[0.0, 0.0], *([float(0.35 * diameter * f(a)) for f in (np.cos, np.sin)] for a in ring)]
        gross_kg = above_kg + payload_kg + dry_kg + propellant_kg
        thrust = gross_kg * G * draw(st.floats(1.2, 2.5) if draw(st.integers(0, 9)) else st.floats(0.3, 1.2)) / engines
        stage: dict[str, Any] = {
            "name": f"s{n}", "front_station_m": front, "rear_station_m": rear, "diameter_m": diameter,
            "modes": draw(st.integers(0, 5)), "part": parts,
            "shell": [{"front_station_m": front, "rear_station_m": rear, "wall_m": draw(about(0.003)),
                       "modulus_Pa": 7e10}],
            **({"grain": [grain]} if solid else {"tank": tanks}),
            "engine": {
                "positions_m": places, "thrust_vacuum_N": thrust, "isp_vacuum_s": draw(about(290.0, 1.2)),
                "exit_area_m2": 1.5e-6 * thrust, "gimbal_station_m": rear, "exit_station_m": rear + 0.5,
                "mass_kg": draw(about(0.001)) * thrust, "servo_hz": [draw(about(8.0))],
            },
            "separation_after_s": draw(st.sampled_from([0.0, 1.0])),
            "ignition_after_s": draw(st.sampled_from([0.0, 2.0])),
        }  # fmt: skip  # by subject
        stages.append(stage)
        front, above_kg = rear, gross_kg
    bottom = stages[-1]
    if draw(st.booleans()):
        bottom["fins"] = {
            "root_chord_m": 0.8,
            "tip_chord_m": 0.4,
            "semispan_m": draw(about(0.5 * bottom["diameter_m"])),
            "leading_edge_station_m": bottom["rear_station_m"] - 1.0,
            "sweep_m": 0.3,
        }
    top = stages[0]
    out: dict[str, Any] = {
        "schema": 1, "name": "drawn", "nose_length_m": draw(about(2.0 * top["diameter_m"], 1.3)),
        "nose": draw(st.sampled_from(["ogive", "cone"])),
        "site": {"latitude_deg": draw(st.floats(-80.0, 80.0)), "longitude_deg": 20.0,
                 "azimuth_deg": draw(st.floats(0.0, 350.0))},
        "trajectory": {"pitch_over_start_s": draw(about(5.0)),
                       "final_path_angle_deg": draw(st.floats(5.0, 70.0))},
        "control": {"gyro_station_m": draw(st.floats(0.1, 0.95)) * top["rear_station_m"],
                    "sample_s": draw(st.sampled_from([0.005, 0.01, 0.02]))},
        "stage": stages[::-1],
    }  # fmt: skip  # by subject
    if len(stages) > 1 and draw(st.booleans()):
        out["fairing"] = {"front_station_m": 0.0, "rear_station_m": 1.0, "mass_kg": 0.1 * above_kg / len(stages) ** 3}
    return out


def built_and_flown(document: dict[str, Any], folder: Path, whole: bool) -> str:
    """Return the error message for a rejected layout; else "", after a flight of finite numbers."""
    (folder / "drawn.toml").write_text(tomli_w.dumps(document))
    try:
        built = build(read_layout(folder / "drawn.toml"))
        write(built, folder / "out")
    except (ScenarioError, ValueError) as error:
        return str(error)
    assert "nan" not in report(built)
    assert all("nan" not in word for word in warnings_of(built))
    separation = [built.flight.begins_s[n] for n in range(1, len(built.stacks))]
    until = 6.0 if not whole else (separation[0] + 5.0 if separation else 60.0)
    loaded = load_scenario(folder / "out" / "scenario.toml", [f"run.duration_s={until}", "run.accuracy=0.05"])
    for stage, stack in zip(loaded.scenario.vehicle.stage, built.stacks, strict=True):
        most_N = max(float(engine.table["thrust_vacuum_N"].max()) for engine in stage.engines)
        assert stack.drops_fairing or most_N == pytest.approx(stack.stage.engine.thrust_vacuum_N)
    flight = fly(loaded, log=False)
    assert np.isfinite(flight.state).all() or flight.outcome == "diverged", flight.outcome
    return ""


@pytest.mark.long
def test_fuzzed_layouts_are_refused_in_words_or_fly(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("maxq.tools.vehicle.build.MODE_ROWS", 3)  # over a burn: quicker
    said: list[str] = []

    @settings(max_examples=WHOLE or 3, suppress_health_check=list(HealthCheck), phases=[Phase.generate])
    @given(layouts())
    def one(document: dict[str, Any]) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            said.append(built_and_flown(document, tmp_path_factory.mktemp("drawn"), bool(WHOLE)))
        assert "\n" not in said[-1]

    one()


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        # the gimbal lay behind the modes' last station, which is written with 12 digits
        {"11.0": "11.000000000000123"},
        # two rates at one instant: nan in the programme
        {"modes = 2\n": "modes = 2\nseparation_after_s = 0.0\n", "modes = 1\n": "modes = 1\nignition_after_s = 0.0\n"},
    ],
)
def test_what_once_was_written_and_could_not_be_flown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, str]
) -> None:
    monkeypatch.setattr("maxq.tools.vehicle.build.MODE_ROWS", 3)
    text = LAYOUT
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "layout.toml").write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        maxq.vehicle(tmp_path / "layout.toml", tmp_path)
    assert load_scenario(tmp_path / "scenario.toml").vehicle.stage
