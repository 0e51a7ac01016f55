"""Calibration on synthetic measurements: known truth, SciPy's least squares of a separate model, interruption."""

from __future__ import annotations

import gzip
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import ndtr

from maxq.control.kernel.records import Array
from maxq.sim.campaign.calibration import (
    Calibration,
    CalibrationOptions,
    CalibrationStopped,
    calibrate,
    parameters_of,
    with_noise,
)
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.read import LoadedCampaign, load_campaign
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import fly, logged_channels
from maxq.sim.run.measured import MeasuredChannel, MeasuredSeries, read_measured
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simrun

FILE = """
schema = 1
extends = "checkcases/two-stage"
[campaign]
runs = 10
[run]
duration_s = 12.0
step_s = 0.01
[log]
slow_hz = 100.0
[[disperse]]
key = "vehicle.stage.0.engine.thrust_factor"
name = "thrust"
distribution = "normal"
three_sigma = 0.06
[[disperse]]
key = "vehicle.stage.0.engine.mass_flow_factor"
distribution = "normal"
three_sigma = 0.15
[[disperse]]
key = "atmosphere.density_factor"
distribution = "uniform"
low = 0.7
high = 1.3
[[disperse]]
key = "vehicle.stage.1.engine.thrust_factor"
name = "thrust of stage 2"
distribution = "normal"
three_sigma = 0.06
[[disperse]]
key = "wind.factor"
distribution = "choice"
values = [0.5, 2.0]
"""
KEYS = (
    "vehicle.stage.0.engine.thrust_factor",
    "vehicle.stage.0.engine.mass_flow_factor",
    "atmosphere.density_factor",
    "vehicle.stage.1.engine.thrust_factor",
)
TRUTH = np.array([0.8, -1.2, 0.9, 0.0])  # normal scores
SIGMA = {"altitude_m": 1.0, "speed_mps": 0.2}
TIMES, SHIFT_S, BIAS_m = np.arange(0.2, 11.0, 0.1), 0.15, 3.0


def values_of(z: Array) -> list[float]:
    a, b, c, d = z.tolist()
    return [1.0 + 0.02 * a, 1.0 + 0.05 * b, 0.7 + 0.6 * float(ndtr(c)), 1.0 + 0.02 * d]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("campaign") / "c.toml"
    path.write_text(FILE)
    return path


@pytest.fixture(scope="module")
def campaign(file: Path) -> LoadedCampaign:
    return load_campaign(file)


def flown(z: Array, shift_s: float = 0.0) -> dict[str, Array]:
    """Return the channels at the measured times by an own path from scores to a flight: overrides of the scenario."""
    changes = [f"{key}={value!r}" for key, value in zip(KEYS, values_of(z), strict=True)]
    run = ["run.duration_s=12", "run.step_s=0.01", "log.slow_hz=100", "log.fast_hz=10"]
    flight = fly(load_scenario("checkcases/two-stage", [*run, *changes]))
    return {name: np.interp(TIMES + shift_s, flight.time_s(name), flight[name]) for name in SIGMA}


@pytest.fixture(scope="module")
def measured() -> MeasuredSeries:
    rng, truth = np.random.default_rng(4), flown(TRUTH)
    series = []
    for name, sigma in SIGMA.items():
        values = truth[name] + rng.normal(0.0, sigma, len(TIMES))
        series.append(MeasuredChannel(name, name.rpartition("_")[2], name, TIMES, values, sigma))
    return MeasuredSeries("m.csv", tuple(series), ())


@pytest.fixture(scope="module")
def found(campaign: LoadedCampaign, measured: MeasuredSeries, tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    return calibrate(campaign, measured, tmp_path_factory.mktemp("flights"))


def test_the_truth_is_within_two_standard_deviations(found: Calibration) -> None:
    assert found.converged
    sigma = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.scores - TRUTH) < 2.0 * sigma).all()
    for p, z, wanted in zip(found.parameters, TRUTH, values_of(TRUTH), strict=True):
        assert abs(p.value - wanted) < 2.0 * (p.high - p.low) / 2.0 or z == 0.0
    assert [p.observed for p in found.parameters] == [True, True, True, False]
    last = found.parameters[3]
    assert (last.value, last.share) == (pytest.approx(1.0, abs=1e-6), pytest.approx(1.0, abs=1e-6))
    assert (last.low, last.high) == (pytest.approx(0.98, abs=1e-6), pytest.approx(1.02, abs=1e-6))
    for each in found.after:
        assert each.rms == pytest.approx(SIGMA[each.name], rel=0.15)
    assert all(b.rms > 5.0 * a.rms for a, b in zip(found.after, found.before, strict=True))


def test_estimate_and_covariance_are_those_of_scipy(found: Calibration, measured: MeasuredSeries) -> None:
    """The oracle's model shares neither the draws nor the sampling; the prior is a residual of its own."""

    def residuals(z: Array) -> Array:
        model = flown(z)
        parts = [(each.values - model[each.name]) / each.sigma for each in measured.channels]
        return np.concatenate([*parts, z])

    best = least_squares(residuals, found.scores, "3-point", diff_step=0.05, x_scale=1.0, xtol=1e-6, max_nfev=6)
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.abs(best.x - found.scores).max() < 0.02 * sigma.max()
    covariance = np.linalg.inv(best.jac.T @ best.jac)
    assert np.sqrt(np.diag(covariance)) == pytest.approx(sigma, rel=0.02)
    scale = np.sqrt(np.diag(covariance))
    assert found.correlation == pytest.approx(covariance / np.outer(scale, scale), abs=0.02)


def test_shift_and_constant_errors_are_estimated_as_well(
    campaign: LoadedCampaign, measured: MeasuredSeries, tmp_path: Path
) -> None:
    rng, truth = np.random.default_rng(6), flown(TRUTH, SHIFT_S)
    height = MeasuredChannel(
        "altitude_m", "m", "h", TIMES, truth["altitude_m"] + BIAS_m + rng.normal(0.0, 1.0, len(TIMES)), 1.0, 5.0
    )
    speed = MeasuredChannel("speed_mps", "m/s", "v", TIMES, truth["speed_mps"] + rng.normal(0.0, 0.2, len(TIMES)), 0.2)
    known = KEYS[:2]
    found = calibrate(campaign, MeasuredSeries("", (height, speed), ()), tmp_path, CalibrationOptions(known, 0.1, 0.2))
    (shift, _, shift_s, shift_sigma_s), (bias, unit, bias_m, bias_sigma_m) = found.nuisances
    assert (shift, bias, unit) == ("time shift", "bias of altitude_m", "m")
    assert abs(shift_s - SHIFT_S) < 3.0 * shift_sigma_s < 0.3
    assert abs(bias_m - BIAS_m) < 3.0 * bias_sigma_m < 9.0
    assert [p.name for p in found.parameters] == list(known)


def test_an_interrupted_calibration_continues_with_the_same_bits(
    campaign: LoadedCampaign, measured: MeasuredSeries, tmp_path: Path
) -> None:
    thrust = CalibrationOptions(KEYS[:1])
    found = calibrate(campaign, measured, tmp_path / "whole", thrust)
    calls = [0]

    def stop() -> bool:
        calls[0] += 1
        return calls[0] > 8

    with pytest.raises(CalibrationStopped):
        calibrate(campaign, measured, tmp_path / "part", thrust, stop=stop)
    stored = len(list((tmp_path / "part").glob("*.npy")))
    again = calibrate(campaign, measured, tmp_path / "part", thrust, workers=2)
    assert stored > 0
    assert again.flights == found.flights - stored
    assert again.scores.tobytes() == found.scores.tobytes()
    assert again.covariance.tobytes() == found.covariance.tobytes()


SHOT = """
schema = 1
extends = "checkcases/nesc-09"
[campaign]
runs = 10
[run]
step_s = 0.01
[[disperse]]
key = "vehicle.stage.0.aero.axial_factor"
distribution = "normal"
mean = 0.9
three_sigma = 0.6
[[disperse]]
key = "initial.ned_mps.2"
distribution = "normal"
mean = -300.0
three_sigma = 30.0
"""


def test_drag_and_speed_of_a_published_shot_are_found(tmp_path: Path) -> None:
    """NASA's series of check case 9: a sphere shot eastward and up at 1000 ft/s each, with drag. The prior is wrong."""
    with gzip.open(Path(__file__).parent / "data" / "nesc" / "nesc-09.csv.gz", "rt") as file:
        (tmp_path / "shot.csv").write_text(file.read())
    (tmp_path / "shot.toml").write_text(SHOT)
    campaign = load_campaign(tmp_path / "shot.toml")
    scenario = campaign.base.scenario
    table = logged_channels(scenario, pack_flight(scenario).sizes)
    aliases = {"altitudeMsl_ft": "altitude_m"}
    measured = read_measured(tmp_path / "shot.csv", table, None, aliases, {"altitude_m": 0.05, "mach": 1e-4})
    measured = replace(measured, channels=tuple(c for c in measured.channels if c.name in ("altitude_m", "mach")))
    found = calibrate(campaign, measured, tmp_path / "flights")
    drag, climb = found.parameters
    assert found.converged
    assert drag.value == pytest.approx(1.0, abs=1e-3)
    assert climb.value == pytest.approx(-304.8, abs=0.03)
    assert [each.rms for each in found.after] == pytest.approx([0.0, 0.0], abs=0.1)
    assert found.before[0].rms > 100.0 * found.after[0].rms


def test_noise_is_estimated_from_second_differences() -> None:
    values = 5.0 * np.arange(2000.0) + np.random.default_rng(8).normal(0.0, 0.7, 2000)
    (each,) = with_noise(
        MeasuredSeries("", (MeasuredChannel("altitude_m", "m", "h", np.arange(2000.0), values),), ())
    ).channels
    assert each.sigma == pytest.approx(0.7, rel=0.05)
    flat = MeasuredChannel("altitude_m", "m", "h", np.arange(5.0), np.zeros(5))
    with pytest.raises(CampaignError, match="its noise is unknown; give it by --sigma"):
        with_noise(MeasuredSeries("m.csv", (flat,), ()))


def test_draws_of_texts_and_choices_are_not_calibrated(campaign: LoadedCampaign) -> None:
    assert [d.name for d in parameters_of(campaign)] == list(KEYS)
    with pytest.raises(CampaignError, match=r"wind\.factor: the campaign has no such continuous draw; allowed: thrust"):
        parameters_of(campaign, ["wind.factor"])


def test_the_command_writes_a_scenario_that_flies_and_a_page(
    file: Path, measured: MeasuredSeries, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = [TIMES, *(each.values for each in measured.channels)]
    rows = [",".join(f"{x:.6f}" for x in row) for row in zip(*columns, strict=True)]
    series, out = tmp_path / "m.csv", tmp_path / "out"
    series.write_text("\n".join(["time_s,altitude_m,speed_mps", *rows]) + "\n")
    given = ["calibrate", str(file), str(series), "--fit", "thrust", "--out", str(out)]
    assert simrun.main([*given, "--sigma", "altitude_m=1", "--sigma", "speed_mps=0.2"]) == 0
    said = capsys.readouterr().out
    assert "CALIBRATED: 1 parameter, 1 observable" in said
    record = json.loads((out / "calibration.json").read_text())
    thrust = record["parameters"][0]
    assert (thrust["label"], thrust["observed"]) == ("thrust", True)
    fitted = load_scenario(str(out / "calibrated.toml")).scenario
    assert fitted.vehicle.stage[0].engine.thrust_factor == pytest.approx(thrust["value"], abs=1e-12)
    assert "Figure 2." in (out / "calibration.html").read_text()
    assert not (out / "flights").exists()
