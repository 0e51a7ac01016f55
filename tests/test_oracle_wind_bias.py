"""`simdesign bias` agrees with the geometry of velocity, wind and attitude by SciPy's rotations.

| quantity | oracle |
|---|---|
| angle between axis and air in the biased flight | that of still air, from velocity, attitude and wind |
| reported bias | integral of the difference between the programmes |
| half the bias | half of the angle of attack that the wind adds |
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.spatial.transform import Rotation

from maxq import Flight, ScenarioError
from maxq.control.kernel.records import Array
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simdesign
from maxq.tools.design.bias import wind_biased

ALTITUDE_M = [0.0, 3000.0, 7000.0, 10000.0, 18000.0, 30000.0]
SPEED_MPS, FROM_DEG = [0.0, 5.0, 35.0, 45.0, 5.0, 5.0], 120.0
PROFILE = {"altitude_m": ALTITUDE_M, "speed_mps": SPEED_MPS, "from_deg": [FROM_DEG] * 6}
WINDY = ["wind.profile={" + ", ".join(f"{name}={values}" for name, values in PROFILE.items()) + "}"]
FLOWN = ["run.duration_s=59", "requirement="]
AT_S = np.arange(25.0, 55.0, 0.5)  # above a third of the largest dynamic pressure


@cache
def biased(share: float = 1.0):
    return wind_biased(load_scenario("nominal", [*FLOWN, *WINDY]), share)


def off_axis_rad(flight: Flight, windy: bool) -> Array:
    """Return the angles (2, times) of the relative wind above and to the right of the axis."""

    def at(name: str) -> Array:
        return np.interp(AT_S, flight.time_s(name), flight[name])

    body = Rotation.from_quat(np.stack([at(f"q_BI_{k}") for k in "xyzw"], axis=1))
    position = np.stack([at(f"r_I_{k}_m") for k in "xyz"], axis=1)
    velocity = np.stack([at(f"v_I_{k}_mps") for k in "xyz"], axis=1)
    velocity -= np.cross([0.0, 0.0, 7.292115e-5], position)
    up = position / np.array([1.0, 1.0, (1.0 - 1.0 / 298.257) ** 2])
    up /= np.linalg.norm(up, axis=1)[:, None]
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east, axis=1)[:, None]
    towards = np.radians(FROM_DEG + 180.0)
    speed = windy * np.interp(at("altitude_m"), ALTITUDE_M, SPEED_MPS)[:, None]
    air = speed * (np.cos(towards) * np.cross(up, east) + np.sin(towards) * east)
    u, v, w = body.inv().apply(velocity - air).T
    return np.stack([np.arctan2(-w, u), np.arctan2(v, u)])


def rms_deg(angles_rad: Array) -> float:
    return float(np.degrees(np.sqrt((angles_rad**2).sum(axis=0).mean())))


@pytest.mark.slow
def test_biased_flight_meets_the_air_as_in_still_air() -> None:
    guided = load_scenario("nominal", [*FLOWN, *WINDY])
    calm_flight, before_flight = fly(load_scenario("nominal", FLOWN)), fly(guided)
    guidance = guided.scenario.guidance.model_copy(update={"programme": biased().table})
    biased_flight = fly(type(guided)(guided.scenario.model_copy(update={"guidance": guidance}), "", ()))
    calm = off_axis_rad(calm_flight, False)
    left = [off_axis_rad(flight, True) - calm for flight in (before_flight, biased_flight)]
    assert rms_deg(left[0]) > 0.4
    assert rms_deg(left[1]) < 0.25 * rms_deg(left[0])
    for axis in range(2):  # both planes have their part
        assert np.degrees(np.abs(left[0][axis]).max()) > 0.35
        assert np.degrees(np.abs(left[1][axis]).max()) < 0.2
    still, before, after = (each.load_Padeg.max() for each in (biased().still, biased().before, biased().after))
    assert abs(after - still) < 0.3 * abs(before - still)


def test_reported_bias_is_the_integral_of_what_the_programmes_differ_by() -> None:
    made, old = biased(), load_scenario("nominal", FLOWN).scenario.guidance.programme
    assert old is not None
    t, n = made.table["time_s"], made.bias_rad.shape[1]
    for row, name in enumerate(("pitch_rate_degps", "yaw_rate_degps")):
        more = made.table[name] - np.interp(t, old["time_s"], old.get(name))
        turned = np.array([trapezoid(more[: k + 1], t[: k + 1]) for k in range(n)])
        assert turned == pytest.approx(np.degrees(made.bias_rad[row]), abs=0.15)
    assert np.degrees(np.abs(made.bias_rad[:, 0])).max() < 1e-9  # none at liftoff


@pytest.mark.long
def test_half_the_share_leaves_half() -> None:
    loads = [biased(share).after for share in (1.0, 0.5)]
    where = np.isin(loads[1].time_s, AT_S)
    added = [np.stack([x.alpha_rad, -x.beta_rad])[:, where] for x in (biased().before, *loads)]
    whole, half = (rms_deg(x - added[1]) for x in (added[0], added[2]))
    assert half == pytest.approx(0.5 * whole, rel=0.15)


@pytest.mark.slow
def test_the_command_writes_what_simrun_flies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "w.csv").write_text("altitude_m,speed_mps,from_deg\n0,5,300\n5000,20,300\n30000,30,280\n")
    out = tmp_path / "p.csv"
    assert simdesign.main(["bias", "nominal", "--wind", str(tmp_path / "w.csv"), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "rms of q alpha" in said
    assert f"--set guidance.programme={out}" in said
    assert simdesign.main(["bias", "nominal", "--wind", "winds/nosuch.csv", "--out", str(out)]) == 2
    assert "winds/nosuch.csv" in capsys.readouterr().err
    changes = [f"guidance.programme={out}", f"wind.profile={tmp_path / 'w.csv'}", "run.duration_s=20", "requirement="]
    assert fly(load_scenario("nominal", changes), log=False).outcome == "duration"


def test_what_cannot_be_biased_is_told() -> None:
    for changes, said in (
        (FLOWN, "there is no wind to bias for"),
        ([*FLOWN, *WINDY, "guidance.programme="], "there is no programme to bias"),
        ([*FLOWN, *WINDY, "guidance.method=step"], "a bias is linear between rows"),
    ):
        with pytest.raises(ScenarioError, match=said):
            wind_biased(load_scenario("nominal", changes))
