"""A dispersed scenario is packed to the same bits as a file with the changed values that is loaded from scratch."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import campaignkit
import numpy as np
import pytest

import maxq
from maxq import LoadedCampaign, LoadedScenario
from maxq.sim.campaign.targets import Dispersed, Refused, TargetChange, find_target
from maxq.sim.input.remembered import cached_by_identity
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.scenario.loader import load_scenario, load_scenario_text

ACCURACY = 0.05


def packed_bytes(loaded: LoadedScenario) -> bytes:
    packed: Packed = pack_flight(loaded.scenario)
    return b"".join(a.tobytes() for a in (packed.parameters, packed.pool, packed.memory, packed.state))


@pytest.fixture(scope="module")
def ksr3() -> LoadedCampaign:
    return maxq.load("campaigns/ksr3")


@pytest.mark.slow
def test_of_the_whole_set_read_back_from_text(ksr3: LoadedCampaign) -> None:
    seen = set()
    for run in range(5):
        loaded = ksr3.scenario_of(run)
        again = load_scenario_text(loaded.as_flown)
        assert again.scenario == loaded.scenario
        assert packed_bytes(again) == packed_bytes(loaded)
        seen.add(packed_bytes(loaded))
    assert len(seen) == 5


def test_of_scalars_as_overrides() -> None:
    """A run of dispersed scalars equals a single flight with the values as overrides on the command line."""
    campaign = maxq.load("campaigns/first")
    # an element of a list that the files leave to its default cannot be overridden alone
    names = [d.name for d in campaign.plan.draws if d.targets[0].kind == "number" and not d.name[-1].isdecimal()]
    inputs = campaign.inputs(3)
    assert len(names) >= 5
    overrides = [f"{name}={inputs.recorded[name]!r}" for name in (*names, "run.seed")] + [f"run.accuracy={ACCURACY}"]
    base = load_scenario("campaigns/first", [*overrides, "campaign=", "disperse="])
    kept = [name for name in campaign.input_names if name in (*names, "run.seed")]
    alone = campaign.mixed(campaign.plan.draw(3, 1), 3, kept)
    assert packed_bytes(base) == packed_bytes(alone)


@pytest.mark.parametrize("key", ["bending.pitch.slope_pm", "tank.0.table.hinge_station_m", "aero.table.CA"])
def test_of_scaled_columns(key: str) -> None:
    """Scaled columns equal a table that NumPy scales and the reader loads as a file."""
    base = load_scenario("nominal")
    target = find_target(base.scenario, f"vehicle.stage.0.{key}")
    scenario = Dispersed(base.scenario, [TargetChange(target, "scale", "x")])({"x": 1.03})
    section, table, column = key.rsplit(".", 2)
    named = getattr(_at(base.scenario, f"vehicle.stage.0.{section}"), table)
    lists = {name: (np.array(c) * (1.03 if name == column else 1.0)).tolist() for name, c in named.columns.items()}
    text = "{" + ", ".join(f"{name} = {values!r}" for name, values in lists.items()) + "}"
    other = load_scenario("nominal", [f"vehicle.stage.0.{section}.{table}={text}"])
    assert packed_bytes(LoadedScenario(scenario, "", ())) == packed_bytes(other)


def _at(value: object, path: str) -> object:
    for part in path.split("."):
        value = value[int(part)] if part.isdecimal() else getattr(value, part)  # type: ignore[index]  # the path says what it is
    return value


def test_rows_that_where_names() -> None:
    base = load_scenario("nominal")
    target = find_target(base.scenario, "vehicle.stage.0.bending.pitch.slope_pm")
    scenario = Dispersed(base.scenario, [TargetChange(target, "scale", "x", (("mode", 2.0),))])({"x": 2.0})
    before, after = (s.vehicle.stage[0].bending.pitch for s in (base.scenario, scenario))  # type: ignore[union-attr]  # nominal bends
    assert before is not None
    assert after is not None
    second = before["mode"] == 2.0
    assert (after["slope_pm"][second] == 2.0 * before["slope_pm"][second]).all()
    assert (after["slope_pm"][~second] == before["slope_pm"][~second]).all()


@pytest.mark.slow
def test_what_was_packed_before_changes_nothing(ksr3: LoadedCampaign) -> None:
    """Cached fits of tables change nothing: a process that has packed nothing else gives the same bits."""
    for run in range(20):
        packed_bytes(ksr3.scenario_of(run))
    script = (
        "import hashlib, sys; sys.path.insert(0, 'tests'); import test_invariants_campaign_packing as t;"
        "import maxq;"
        "print(hashlib.sha256(t.packed_bytes(maxq.load('campaigns/ksr3').scenario_of(7))).hexdigest())"
    )
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run([sys.executable, "-c", script], cwd=root, capture_output=True, text=True, check=True)
    import hashlib  # noqa: PLC0415  # as in the script

    assert done.stdout.strip() == hashlib.sha256(packed_bytes(ksr3.scenario_of(7))).hexdigest()


def test_no_dispersion_is_the_scenario_itself(tmp_path: Path) -> None:
    campaign = campaignkit.small(tmp_path, inputs="", campaign='noise = "as-scenario"')
    assert campaign.scenario_of(3).scenario == campaign.base.scenario
    everything = campaignkit.small(tmp_path, "all")
    assert everything.changed({}).scenario == everything.base.scenario


GUST = "wind.gust=[{kind='one-minus-cosine',altitude_m=9e3,thickness_m=180.0,edge_m=30.0,speed_mps=7.0,from_deg=0.0}]"


@pytest.mark.parametrize(
    ("override", "key", "how", "value"),
    [
        ("wind.profile=winds/anheung-november.csv", "wind.profile.speed_mps", "scale", 0.5),
        (GUST, "wind.gust.0.altitude_m", "set", 8e3),
    ],
)
def test_a_draw_of_a_scenario_with_wind_flies_in_still_air(override: str, key: str, how: Any, value: float) -> None:
    """The worst vehicle of a campaign with wind or gusts flies the windless scenario of its design."""
    windy, still = load_scenario("nominal", [override]), load_scenario("nominal")
    wind = TargetChange(find_target(windy.scenario, key), how, "wind")
    thrust = TargetChange(find_target(windy.scenario, "vehicle.stage.0.engine.thrust_factor"), "set", "thrust")
    dispersed = Dispersed(still.scenario, [wind, thrust])
    expected = load_scenario("nominal", ["vehicle.stage.0.engine.thrust_factor=1.02"])
    assert packed_bytes(LoadedScenario(dispersed({"thrust": 1.02}), "", ())) == packed_bytes(expected)
    with pytest.raises(Refused, match=rf"{re.escape(key)}: the scenario has no such section"):
        dispersed({"wind": value})


def test_integrator_and_noise_settings_reach_every_run(tmp_path: Path) -> None:
    """Integrator and noise settings reach every worker."""

    campaign = maxq.load(campaignkit.write_campaign(tmp_path), "run.step_s=0.0005", "earth.gravity=inverse_square")
    seeds = set()
    for run in range(4):
        packed = pack_flight(campaign.scenario_of(run).scenario)
        course = packed.parameters[0].timeline
        assert int(course.step_ns) == 500_000
        assert int(packed.parameters[0].environment.earth.gravity) == int(
            pack_flight(campaign.base.scenario).parameters[0].environment.earth.gravity
        )
        seeds.add(int(course.seed))
    assert len(seeds) == 4


def test_answers_are_remembered_by_identity() -> None:
    asked: list[tuple[object, float]] = []

    @cached_by_identity
    def measure(table: list[float], names: tuple[object, ...], at: float) -> int:
        asked.append((names, at))
        return len(table)

    table, alike = [1.0], [1.0]
    assert measure(table, ("a", table), 1.0) == measure(table, ("a", table), 1.0) == 1
    assert len(asked) == 1
    measure(alike, ("a", table), 1.0)  # equal is not the same
    measure(table, ("b", table), 1.0)
    measure(table, ("a", table), 2.0)
    assert len(asked) == 4
    for n in range(200):  # arguments of another identity, none of which may meet an answer to one that is gone
        assert measure([0.0] * (n % 7), (), 0.0) == n % 7
