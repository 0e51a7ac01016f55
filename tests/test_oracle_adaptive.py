"""Adaptive augmenting control equals its equations written again, closed forms and flights.

| quantity | oracle |
|---|---|
| command and total gain, sample by sample | plain Python on SciPy's zero-order hold, Butterworth filter and `lfilter` |
| steady total gain under a constant error, under an oscillation; leakage | closed forms |
| margins at the limits of the total gain | the loop of a design whose gains are scaled |
| flights | a weak loop recovers; a loop unstable in bending stops oscillating |
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import petrelkit
import pytest
from scipy.signal import butter, cont2discrete, lfilter

import maxq
from maxq import Flight, LoadedScenario, ScenarioError, margins
from maxq.control.computer import ComputerState, build_computer, computer_tick, start_computer
from maxq.control.kernel.records import Array, blank, pack
from maxq.control.kernel.tables import Pool
from maxq.control.laws.adaptive import make_adaptive
from maxq.control.laws.pd import GainSchedule, gains_table
from maxq.design.certificate.certificate import certify_node
from maxq.design.verify.certified import certificate_requirements
from maxq.design.verify.judging import Wanted, checks, judge
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

T = 0.01
GIVEN: dict[str, Any] = {
    "least_gain": 0.5,
    "most_gain": 2.5,
    "reference_hz": 0.5,
    "reference_zeta": 0.6,
    "error_gain": 300.0,
    "damper_gain": 2e4,
    "leakage_ps": 0.2,
    "high_pass_hz": 3.0,
    "low_pass_hz": 0.3,
}
GAINS = GainSchedule([0.0, 10.0], [1.2, 0.8], [0.5, 0.4])


def flown(turns: Array, commanded: Array, **changes: Any) -> tuple[Array, Array]:
    """Return commands and total gains, (samples, 2), for angle increments and commanded rates (samples, 3)."""
    pool = Pool()
    integral = changes.get("with_integral", False)
    gains = dataclasses.replace(GAINS, k_i_ps=[0.3, 0.1]) if integral else GAINS
    built = build_computer(
        pool,
        sample_ns=10_000_000,
        law="pid" if integral else "pd",
        gains=gains_table(gains),
        attitude="rate-integral",
        adaptive=make_adaptive(T, **{**GIVEN, **changes}),
    )
    computer, state, tables = pack([built])[0], blank(ComputerState)[0], pool.array()
    start_computer(computer, tables, state, 0.0)
    out, replaced, none2 = [], np.ones(3, np.int64), np.zeros(2, np.int64)
    for n, turn in enumerate(turns):
        computer_tick(computer, tables, state, T * (n + 1), turn, commanded[n], replaced, np.zeros(2), none2)
        out.append((state.command_rad.copy(), state.adaptive.total.copy()))
    return np.array([c for c, _ in out]), np.array([k for _, k in out])


def expected(turns: Array, commanded: Array, law: Array, integral: bool) -> tuple[Array, Array]:
    """Return the published equations for one axis; `law` (samples,) is the command at total gain 1."""
    w, zeta = 2.0 * np.pi * GIVEN["reference_hz"], GIVEN["reference_zeta"]
    model = np.array([[0.0, 1.0], [-w * w, -2.0 * zeta * w]])
    driven = np.array([[-1.0], [2.0 * zeta * w if integral else 0.0]])
    a, b, *_ = cont2discrete((model, driven, np.eye(2), np.zeros((2, 1))), T)
    error, rate = np.cumsum(turns) - T * np.cumsum(commanded), turns / T
    num, den = butter(2, GIVEN["high_pass_hz"], "highpass", fs=1.0 / T)
    kept = np.exp(-2.0 * np.pi * GIVEN["low_pass_hz"] * T)
    x, k_max, k_a, total, y_s = np.array([error[0], rate[0]]), GIVEN["most_gain"] - 0.5, 0.5, 1.0, 0.0
    commands, gains = [], []
    for n in range(len(turns)):
        x = a @ x + b[:, 0] * commanded[n] if n else x
        e_r = error[n] - x[0]
        rise = GIVEN["error_gain"] * (k_max - k_a) / k_max * e_r**2
        k_a += T * (rise - GIVEN["damper_gain"] * k_a * y_s - GIVEN["leakage_ps"] * (total - 1.0))
        k_a = float(np.clip(k_a, 0.0, k_max))
        total = 0.5 + k_a
        commands.append(total * law[n])
        gains.append(total)
        y_s = kept * y_s + (1.0 - kept) * float(lfilter(num, den, commands)[-1]) ** 2
    return np.array(commands), np.array(gains)


@pytest.mark.parametrize("integral", [False, True])
def test_total_gain_and_command_are_those_of_the_published_equations(integral: bool) -> None:
    rng, n = np.random.default_rng(1), 400
    time_s = T * np.arange(1, n + 1)
    turns = T * (0.4 * np.sin(1.7 * time_s)[:, None] + rng.normal(scale=0.1, size=(n, 3)))
    turns[250:330] += 4e-3 * (-1.0) ** np.arange(80)[:, None]  # an oscillation
    commanded = np.repeat([[0.0, 0.1, -0.05], [0.0, -0.02, 0.2]], n // 2, axis=0)
    commands, gains = flown(turns, commanded, with_integral=integral)
    k_p, k_d = (np.interp(time_s, GAINS.at, k) for k in (GAINS.k_p, GAINS.k_d_s))
    for gimbal in (0, 1):
        turn, rate = turns[:, gimbal + 1], commanded[:, gimbal + 1]
        error = np.cumsum(turn) - T * np.cumsum(rate)
        law = -k_p * error - k_d * turn / T
        if integral:
            law = law - np.cumsum(T * np.interp(time_s, GAINS.at, [0.3, 0.1]) * error)
        wanted, total = expected(turn, rate, law, integral)
        np.testing.assert_allclose(gains[:, gimbal], total, rtol=1e-9)
        np.testing.assert_allclose(commands[:, gimbal], wanted, rtol=1e-9, atol=1e-12)
        assert total.max() > 1.1
        assert total.min() < 0.9


def test_steady_gains_are_the_closed_forms() -> None:
    """Steady gains are the closed forms.

    For a constant e_r: (1 - k_a / k_max) a e_r^2 = beta (k_T - 1). For a command that oscillates with amplitude A:
    alpha k_a A^2 / 2 = beta (1 - k_T), with A of the command with that k_T. Without both: (1 - beta T)^n.
    """
    n, beta, still = 400, 4.0, np.zeros((400, 3))
    fast = {"leakage_ps": beta, "low_pass_hz": 3.0}
    off = still.copy()
    off[1] = 0.1  # an error that stays; the reference model does not know of it
    _, gains = flown(off, still, damper_gain=0.0, **fast)
    push, span = GIVEN["error_gain"] * 0.1**2, 2.0
    k_a = (push + beta * 0.5) / (push / span + beta)
    assert gains[-1] == pytest.approx(np.full(2, 0.5 + k_a), rel=1e-6)
    _, gains = flown(off, still, damper_gain=0.0, **{**fast, "error_gain": 1e12})
    assert gains.max() == pytest.approx(2.5)
    swing = np.zeros((n, 3))
    swing[:200, 1] = swing[:200, 2] = 1e-3 * np.cos(2.0 * np.pi * 20.0 * T * np.arange(200))
    commands, gains = flown(swing, still, error_gain=0.0, damper_gain=2e5, leakage_ps=beta, low_pass_hz=3.0)
    k_t, square = float(gains[150:200, 0].mean()), float((commands[150:200, 0] ** 2).mean())
    assert k_t < 0.9
    assert 2e5 * (k_t - 0.5) * square == pytest.approx(beta * (1.0 - k_t), rel=0.02)
    left = (1.0 - gains[[300, 320], 0]) / (1.0 - gains[280, 0])  # the low-pass has emptied, and leakage remains
    np.testing.assert_allclose(left, (1.0 - beta * T) ** np.array([20, 40]), rtol=0.01)


# --- designs
ADAPTIVE = "reference_hz=0.45,reference_zeta=0.8,error_gain_pdeg2s={},damper_gain_pdeg2s=30.0,high_pass_hz={}"


def adaptive(error_gain: float, high_pass_hz: float) -> str:
    return f"design.adaptive={{{ADAPTIVE.format(error_gain, high_pass_hz)}}}"


def with_gains(loaded: LoadedScenario, factor: float) -> LoadedScenario:
    """Return the scenario with all gains of the first stage's design times a factor."""
    design = loaded.scenario.design
    assert design is not None
    columns = {k: v if k == "time_s" else factor * v for k, v in design.gains.table.columns.items()}
    gains = design.gains.model_copy(update={"table": CsvTable("", columns)})
    changed = loaded.scenario.model_copy(update={"design": design.model_copy(update={"gains": gains})})
    return LoadedScenario(changed, loaded.label, loaded.files)


def test_margins_at_the_limits_are_those_of_scaled_gains() -> None:
    loaded = load_scenario("nominal", [adaptive(0.003, 4.0)])
    assert loaded.design is not None
    nodes = maxq.nodes(loaded, [30.0])
    judged = judge(nodes, loaded.design)
    for factor, found in judged[0].at_total_gains.items():
        scaled = with_gains(loaded, factor).design
        assert scaled is not None
        wanted = margins(maxq.loops(nodes, scaled)[0])
        assert found.modulus == pytest.approx(wanted.modulus, rel=1e-9)
        assert found.phase_deg.value == pytest.approx(wanted.phase_deg.value, abs=1e-6)
    assert list(judged[0].at_total_gains) == [0.5, 2.0]
    asked = {c.key: c.passed for c in checks(judged, loaded.design, Wanted())}
    assert asked == {"unstable_poles": True, "total_least_gain": True, "total_most_gain": True}
    weak = with_gains(loaded, 1.5).design
    assert weak is not None
    asked = {c.key: c.passed for c in checks(judge(nodes, weak), weak, Wanted())}
    assert asked["total_most_gain"] == bool(judged[0].margins.gain_up_db.value > 20.0 * np.log10(3.0))


@pytest.mark.parametrize(
    ("given", "said"),
    [("least_gain=1.0", "least_gain"), ("most_gain=0.9", "most_gain"), ("reference_hz=9.0", "high_pass_hz")],
)
def test_wrong_limits_are_told(given: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        load_scenario("nominal", [adaptive(0.003, 4.0), f"design.adaptive.{given}"])


# --- flights
def largest(flight: Flight, name: str) -> float:
    return float(np.abs(flight[name]).max())


@pytest.mark.long
def test_flights_of_both_vehicles(tmp_path: Path) -> None:
    """On KSR-III the nominal gain stays, and a loop unstable in bending oscillates without adaptation.

    petrel is unstable: without adaptation, a loop too weak for its aerodynamics is lost in limit wind.
    """
    powered = ["run.duration_s=59", "requirement="]
    nominal = load_scenario("nominal", [*powered, adaptive(0.003, 4.0)])
    flight = fly(nominal)
    for plane in ("pitch", "yaw"):
        assert np.abs(flight[f"total_gain_{plane}"] - 1.0).max() < 0.05
    without, helped = (
        fly(with_gains(load_scenario("nominal", [*powered, *more]), 3.0)) for more in ([], [adaptive(0.003, 4.0)])
    )
    assert largest(without, "filtered_pitch_deg") > 2.0 * largest(helped, "filtered_pitch_deg")
    assert 0.5 <= helped["total_gain_pitch"].min() < 0.55
    folder = petrelkit.folder()
    windy = ["run.duration_s=100", "requirement=", f"wind.profile='{folder}/vehicle/limit_wind.csv'"]
    for factor, within_deg in ((0.4, 3.0), (3.0, 1.0)):
        errors, swings = [], []
        for more in ([], [adaptive(0.05, 3.0)]):
            flight = fly(with_gains(load_scenario(folder / "scenario.toml", [*windy, *more]), factor))
            errors.append(largest(flight, "error_pitch_deg"))
            swings.append(largest(flight, "filtered_pitch_deg"))
        assert errors[1] < within_deg
        assert swings[0] > 3.0 * swings[1]
    node = maxq.nodes(nominal, [30.0])[0]
    certificate = certify_node(nominal, node, bands=(), names=("gain_up", "gain_down"))
    assert certificate.agrees
    rows = {r.name: r for r in certificate_requirements([certificate], [])}
    up = next(m for m in certificate.margins if m.what == "gain_up")
    assert rows["stable at the most total gain"].found == f"{up.measured:.2f} dB"
    assert rows["stable at the most total gain"].judgement == "accepted"
