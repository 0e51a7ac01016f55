"""Load relief agrees with SciPy's filters, complex-step gradients and closed systems in wind.

| quantity | oracle |
|---|---|
| command of the computer in pitch and yaw | `scipy.signal.lfilter` of lag and bending filter |
| gradient by the law's parameters, blend weights among them | complex step through pairs of real numbers |
| wind's column of the linear plant | the simulator's derivative in constant side winds |
| rms of load, drift and a bending moment | all equations of the closed loop solved at once at each frequency |
| gradient of these | complex step through pairs of real numbers |
| the wind's spectrum | its integral is the variance, less the part outside the band |
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import optimise_kit as kit
import pytest
from complex_step import Pair, filter_f3
from design_nodes import frozen
from scipy.integrate import quad
from scipy.signal import lfilter
from zero_incidence import zero_incidence

import maxq
from maxq import ScenarioError
from maxq.control.computer import ComputerState, build_computer, computer_tick, start_computer
from maxq.control.filters import BendingFilter, FirstOrderSection, QuadraticSection
from maxq.control.kernel.records import Array, blank, pack
from maxq.control.kernel.tables import Pool
from maxq.control.laws.pd import GainSchedule, gains_table
from maxq.control.sensors import make_sensors
from maxq.design.laws.design_file import design_text
from maxq.design.laws.pd import PdDesign
from maxq.design.laws.pd_variables import PdVariables
from maxq.design.laws.wind import DRIFT, LOAD, MOMENTS, Spectrum
from maxq.design.model.instruments import actuator_response, lag
from maxq.design.optimise.at_nodes import make_problem
from maxq.design.optimise.solve import solve
from maxq.design.verify.outcome import with_law
from maxq.sim.packing.flight import pack_flight
from maxq.sim.packing.initial import rotation
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.vehicle.state import Q_BI, V_I, W_BI_B

T = 0.01
GAINS = GainSchedule([0.0, 10.0], [1.2, 0.8], [0.5, 0.4], k_a_s2pm=[0.01, 0.03])
F3 = BendingFilter((QuadraticSection(9.0, 0.3, 7.0, 0.7),), (FirstOrderSection(30.0, 5.0),))
OWN = np.array([np.log(9.0), 0.3, np.log(6.5), 0.5, np.log(20.0), np.log(9.0), 0.1, -0.8, -4.5, 0.35])


def test_command_is_pd_and_the_filtered_acceleration_behind_the_filter() -> None:
    corner_hz, discrete = 1.5, F3.discretize(T, "prewarped", 9.0)
    pool = Pool()
    built = build_computer(
        pool,
        sample_ns=10_000_000,
        law="load-relief",
        gains=gains_table(GAINS),
        attitude="rate-integral",
        pitch_filter=discrete,
        sensors=make_sensors((0.0,), (0,), accelerometers=1),
        relief_hz=corner_hz,
    )
    computer, state, tables = pack([built])[0], blank(ComputerState)[0], pool.array()
    start_computer(computer, tables, state, 0.0)
    rng = np.random.default_rng(1)
    turns, pushes = rng.normal(scale=1e-3, size=(500, 3)), rng.normal(scale=2e-2, size=(500, 3))
    flown, none3, none2 = [], np.zeros(3, np.int64), np.zeros(2, np.int64)
    for n in range(500):
        state.sensors.increment[0] = pushes[n]
        computer_tick(computer, tables, state, T * (n + 1), turns[n], np.zeros(3), none3, np.zeros(2), none2)
        flown.append(state.command_rad.copy())
    time_s = T * np.arange(1, 501)
    k_p, k_d, k_a = (np.interp(time_s, GAINS.at, k) for k in (GAINS.k_p, GAINS.k_d_s, GAINS.k_a_s2pm))
    kept = np.exp(-2.0 * np.pi * corner_hz * T)
    for gimbal, side in ((0, pushes[:, 2] / T), (1, -pushes[:, 1] / T)):
        angle = np.cumsum(turns[:, gimbal + 1])
        wanted = -k_p * angle - k_d * turns[:, gimbal + 1] / T + k_a * lfilter([1.0 - kept], [1.0, -kept], side)
        for b0, b1, b2, a1, a2 in discrete.sections:
            wanted = lfilter([b0, b1, b2], [1.0, a1, a2], wanted)
        np.testing.assert_allclose(np.array(flown)[:, gimbal], wanted, rtol=1e-9, atol=1e-12)


# --- design
CASE = ("filter.structure=F3", "nodes_s=[25.0, 45.0]", "gains.nodes_s=[25.0, 45.0]")
STATION_M = 8.1
MORE = (
    "limits.q_alpha_Padeg=3000",
    "limits.drift_mps=5",
    "wind.band_hz=[0.02,30.0]",
    f"limits.bending_moment=[{{station_m={STATION_M},rms_Nm=900}}]",
)


@cache
def problem(loop: str) -> Any:
    given = (*CASE, *MORE, f"loop={loop}")
    plants = kit.plants(*given, name="ksr3-load-relief")
    return make_problem(kit.case(*given, name="ksr3-load-relief").case, plants), plants


def log_abs_and_phase(own: Any, s: complex, paths: list[complex], lag_: complex) -> tuple[Any, Any]:
    """Return ln|L| and arg L; own = filter, ln k_p, ln k_d, ln k_a, weight of the second gyro."""
    k_p, k_d, k_a = np.exp(own[6]), np.exp(own[7]), np.exp(own[8])
    angle, rate, accel, second = (Pair(p.real, p.imag) for p in paths)
    pushed = accel * Pair(lag_.real, lag_.imag) * (-1.0 * k_a)
    whole = angle * k_p + rate * (k_d * (1.0 - own[9])) + second * (k_d * own[9]) + pushed
    return (whole * filter_f3(own, s)).log()


@pytest.mark.slow
@pytest.mark.parametrize("loop", ["pade", "sampled"])
def test_gradients_by_the_complex_step(loop: str) -> None:
    made, plants = problem(loop)
    law, path = made.law, plants.each[0].path
    assert law.inputs == ("angle_rad", "rate_radps", "accel_mps2", "rate_2_radps")
    x = np.log(np.geomspace(0.1, 30.0, 7))
    f, axis = np.exp(x), law.axis(x)
    ratios = np.stack([path.ratio(name, f) for name in law.inputs], axis=1)
    kept, z = np.exp(-2.0 * np.pi * T), np.exp(-2j * np.pi * f * T)
    lags = (1.0 - kept) / (1.0 - kept * z) if loop == "sampled" else 1.0 / (1.0 + 1j * f)
    k_p, k_d, k_a, weight = *np.exp(OWN[6:9]), OWN[9]
    gains = np.stack([k_p + 0 * f, k_d * (1 - weight) + 0 * f, -k_a * lags, k_d * weight + 0 * f], axis=1)
    own = np.tile(OWN, (7, 1))
    given = law.gradient(own, axis, ratios / (ratios * gains).sum(axis=1)[:, None])
    for point in range(7):
        for k in range(len(OWN)):
            stepped = OWN.astype(complex)
            stepped[k] += 1e-30j
            amplitude, phase = log_abs_and_phase(stepped, complex(axis[0][point]), list(ratios[point]), lags[point])
            wanted = complex(amplitude.imag, phase.imag) * 1e30
            assert given[point, k] == pytest.approx(wanted, rel=1e-9, abs=1e-12)
    out, h = law.log_response(own, axis), 1e-5
    ahead, behind = (law.log_response(own, law.axis(x + side * h)) for side in (1.0, -1.0))
    np.testing.assert_allclose(out.gains[0], gains, rtol=1e-12)
    np.testing.assert_allclose(out.gains[1], (ahead.gains[0] - behind.gains[0]) / (2 * h), atol=1e-9)


def excess_db(own: Any, wind, output: int, s: Any, limit: float) -> Any:
    """Return the excess over a limit in dB, with C rewritten for complex steps and the loop closed in wind."""
    z = np.exp(-2j * np.pi * np.exp(wind.x) * T)
    kept, shaped = np.exp(-2.0 * np.pi * T), filter_f3(own, s)
    lags = (1.0 - kept) / (1.0 - kept * z)
    k_p, k_d, k_a = np.exp(own[6]), np.exp(own[7]), np.exp(own[8])
    gains = [Pair(k_p), Pair(k_d * (1.0 - own[9])), Pair(lags.real, lags.imag) * (-1.0 * k_a), Pair(k_d * own[9])]
    loop, felt = Pair(1.0), Pair(0.0)
    for i, gain in enumerate(gains):
        of_path, of_wind = wind.paths[:, i], wind.measured[:, i]
        loop = loop + shaped * gain * Pair(of_path.real, of_path.imag)
        felt = felt + shaped * gain * Pair(of_wind.real, of_wind.imag)
    by, direct = wind.by_command[output], wind.by_wind[output]
    t = Pair(direct.real, direct.imag) + felt * loop.inverse() * Pair(-by.real, -by.imag)
    return 10.0 * np.log10((wind.weights * (t.x * t.x + t.y * t.y)).sum()) - 20.0 * np.log10(limit)


def test_limits_in_wind_by_the_complex_step() -> None:
    made, plants = problem("sampled")
    law, own = made.law, np.tile(OWN, (2, 1))
    first = len(law.limits) - 3
    assert [limit.unit for limit in law.limits[first:]] == ["Pa deg", "m/s", "N m"]
    found = [v for v in law.limit_values(own) if v.number >= first]
    for values, output, limit in zip(found, (LOAD, DRIFT, MOMENTS), (3000.0, 5.0, 900.0), strict=True):
        for k, plant in enumerate(plants.each):
            s = law.axis(plant.wind.x)[0]  # prewarped
            assert values.excess_db[k] == pytest.approx(excess_db(OWN, plant.wind, output, s, limit), rel=1e-9)
            for j in range(len(OWN)):
                stepped = OWN.astype(complex)
                stepped[j] += 1e-30j
                wanted = excess_db(stepped, plant.wind, output, s, limit).imag * 1e30
                assert values.gradient[k, j] == pytest.approx(wanted, rel=1e-9, abs=1e-10)


def test_only_what_a_case_asks_for_is_a_limit_in_wind() -> None:
    """Without other settings, the case limits the load, not the drift."""
    case = kit.case(*CASE, "loop=pade", name="ksr3-load-relief").case
    made = make_problem(case, problem("pade")[1])
    assert [limit.unit for limit in made.law.limits][3:] == ["Pa deg"]


def rms_of(wind, output: int, law: Any, measurements: tuple[str, ...]) -> float:
    gains = law.response(np.exp(wind.x))[:, [law.inputs.index(name) for name in measurements]]
    return float(wind.rms([output], gains, np.zeros((*gains.shape, 0)))[0][0])


SLOW = (
    "loop=sampled",
    "filter.structure=F2",
    "nodes_s=[15.0, 45.0]",
    "search.starts=3",
    "search.leaps=1",
    "wind={sigma_mps=10.0, length_v_m=3000.0, band_hz=[0.02, 0.3]}",
)


@pytest.mark.long
def test_least_load_against_margins_and_drift() -> None:
    """No design of 3,000 near the optimum meets the limits with less load; a softer one has less load."""
    least = (*SLOW, "objective.kind=load", "limits.drift_mps=9.0")
    plants = kit.plants(*least)
    made, found = make_problem(kit.case(*least).case, plants), solve(kit.case(*least), plants)
    assert found.feasible
    law = made.law.controllers(found.variables)
    rms = [
        rms_of(plant.wind, LOAD, one, plant.path.measurements)
        for plant, one in zip(plants.each, law, strict=True)
        if plant.wind is not None
    ]
    assert 20.0 * np.log10(max(rms)) == pytest.approx(found.objective_db, abs=1e-6)
    rng = np.random.default_rng(1)
    for scale in (0.3, 0.03, 0.003):
        for _ in range(1000):
            tried = np.clip(found.variables + scale * rng.normal(size=made.size), made.lower, made.upper)
            there = made.evaluate(tried)
            if there.violation_db < 1e-4 and there.unstable == 0:
                assert there.objective_db > found.objective_db - 1e-3
    steady = solve(kit.case(*SLOW, "objective.kind=least-margin"), plants)
    assert steady.feasible
    assert made.evaluate(steady.variables).objective_db > found.objective_db - 1e-3
    softer = solve(kit.case(*least, "limits.rigid_hz=0.35"), plants)  # fins turn it into the wind
    assert softer.feasible
    assert softer.objective_db < found.objective_db - 0.1


def test_load_as_an_objective_needs_a_wind_and_no_limit() -> None:
    wind, bending = SLOW[5], "objective.kind=bending-moment"
    at = "limits.bending_moment=[{station_m=8.1,rms_Nm=900}]"
    for changes, said in (
        (["objective.kind=load"], "needs a wind"),
        ([bending], "needs a wind"),
        ([wind, "objective.kind=load", "limits.q_alpha_Padeg=100"], "is the objective"),
        ([wind, bending, at], "is the objective"),
        ([wind, bending, "errata=paper"], "has no bending moments"),
    ):
        with pytest.raises(ScenarioError, match=said):
            kit.case(*changes)
    given = (wind, bending, "objective.stations_m=[6.0]", at, "nodes_s=[40.0]")
    made = make_problem(kit.case(*given).case, kit.plants(*given))
    assert [(limit.text[:22], limit.objective) for limit in made.law.limits[3:]] == [
        ("bending moment at 6 m ", True),
        ("bending moment at 8.1 ", False),
    ]
    said = r"operating point at 40 s: bending moment at 6.1 m: allowed are .* 1, 2, 3, 3.6, 4.5, "
    with pytest.raises(ValueError, match=said):
        kit.plants(wind, bending, "objective.stations_m=[6.1]", "nodes_s=[40.0]")


def test_load_and_drift_are_those_of_the_closed_equations() -> None:
    """Load and drift equal those of engine, vehicle, sensors and law solved as one linear system at each frequency."""
    made, plants = problem("sampled")
    variables = np.concatenate([OWN[:6], np.repeat(OWN[6:9], 2), OWN[9:]])
    law = made.law.controllers(variables)[0]
    assert isinstance(made.law, PdVariables)
    wind = kit.case(*CASE, *MORE, "loop=sampled", name="ksr3-load-relief").case.wind
    assert wind is not None
    plant, spectrum = plants.each[0], Spectrum(**dict(wind) | {"band_hz": (0.02, 30.0)})
    node, f = plant.node, np.exp(plant.wind.x)
    body = node.plant_in_wind()
    moment = body.outputs.index(f"bending_{STATION_M:g}_Nm")
    speed, n, s = node.condition.airspeed_mps, len(body.states), 2j * np.pi * f
    delta, accel, gust = (body.inputs.index(name) for name in ("delta_rad", "delta_accel_radps2", "wind_mps"))
    held = (1.0 - np.exp(-s * T)) / (s * T)
    sensors = {name: (g, late) for name, g, late in node.instruments.sensors}
    loads, drifts, moments = [], [], []
    for k, at in enumerate(s):
        moved = actuator_response(node.actuator, at)
        # unknowns: states, then the command
        system = np.zeros((n + 1, n + 1), complex)
        system[:n, :n] = at * np.eye(n) - body.a
        driven = (
            (body.b[:, delta] + at**2 * body.b[:, accel]) * moved * held[k] * np.exp(-at * node.instruments.delay_s)
        )
        system[:n, n], right = -driven, np.append(body.b[:, gust].astype(complex), 0.0)
        system[n, n] = 1.0
        gains = law.response(f[k : k + 1])[0]
        z = np.exp(at * T)
        for gain, name in zip(gains, law.inputs, strict=True):
            row = body.outputs.index(name if name in sensors else "local_rate_radps")
            record, late = sensors.get(name, (node.instruments.gyro, 0))
            seen = gain * lag(at, record.omega_radps, record.zeta) * held[k] * z**-late
            seen *= T * z / (z - 1.0) if name == "angle_rad" else 1.0
            system[n, :n] += seen * body.c[row]
            by_engine = (body.d[row, delta] + at**2 * body.d[row, accel]) * moved * held[k]
            system[n, n] += seen * by_engine * np.exp(-at * node.instruments.delay_s)
            right[n] -= seen * body.d[row, gust]
        x = np.linalg.solve(system, right)
        w, theta = x[body.states.index("w_mps")], x[body.states.index("theta_rad")]
        loads.append(180.0 / np.pi * node.condition.dynamic_pressure_Pa * (w - 1.0) / speed)
        drifts.append(w - speed * theta)
        by_engine = (body.d[moment, delta] + at**2 * body.d[moment, accel]) * moved * held[k]
        engine = by_engine * np.exp(-at * node.instruments.delay_s) * x[n]
        moments.append(body.c[moment] @ x[:n] + engine + body.d[moment, gust])
    weights = spectrum.weights(speed)
    for output, values in ((LOAD, loads), (DRIFT, drifts), (MOMENTS, moments)):
        wanted = np.sqrt(weights @ np.abs(values) ** 2)
        # the loop's own path has the images that the continuous equations lack
        assert rms_of(plant.wind, output, law, plant.path.measurements) == pytest.approx(wanted, rel=1e-4)
    assert any(np.abs(body.d[:, gust]) > 1e-4)  # the accelerometer feels a gust at once


def test_a_stage_that_is_not_designed_keeps_its_gains_under_the_other_law(tmp_path: Path) -> None:
    own = maxq.load_design("designs/ksr3-robust.toml")
    other = maxq.load_design("designs/ksr3-load-relief.toml", "load-relief")
    made = with_law(own, other).model_copy(update={"law": other.law})
    (tmp_path / "d.toml").write_text(design_text(made))
    read = maxq.load_design(tmp_path / "d.toml", "load-relief")
    f = np.array([0.1, 1.0, 10.0])
    for time_s in (10.0, 30.0):
        laws = [PdDesign.of(each).at(time_s, "yaw", T) for each in (own, read)]
        assert laws[1].inputs == ("angle_rad", "rate_radps")
        np.testing.assert_allclose(laws[0].response(f), laws[1].response(f), rtol=1e-12)
    with pytest.raises(ScenarioError, match="stages that the case does not design"):
        with_law(other, own)


@pytest.mark.parametrize("model", ["dryden", "von-karman"])
def test_spectrum_is_the_standards(model: str) -> None:
    """The spectrum is that of MIL-F-8785C, lateral: it integrates to the variance, in the band to the weights."""
    sigma, length, speed = 2.0, 533.0, 400.0

    def density(w: float) -> float:
        x = length * w / speed
        if model == "dryden":
            return sigma**2 * length / (np.pi * speed) * (1.0 + 3.0 * x * x) / (1.0 + x * x) ** 2
        y = 1.339 * x
        return sigma**2 * length / (np.pi * speed) * (1.0 + 8.0 / 3.0 * y * y) * (1.0 + y * y) ** (-11.0 / 6.0)

    assert quad(density, 0.0, np.inf, limit=500)[0] == pytest.approx(sigma**2, rel=2e-3)
    for top_hz in (5.0, 45.0):
        made = Spectrum(sigma, length, model, (0.02, top_hz))
        low, high = 2.0 * np.pi * np.exp(made.frequencies()[[0, -1]])
        assert high == pytest.approx(2.0 * np.pi * top_hz)
        assert made.weights(speed).sum() == pytest.approx(quad(density, low, high, limit=500)[0], rel=1e-3)


def test_winds_column_is_the_simulators() -> None:
    node, both = frozen(40.0, plane="yaw")[1], []
    for from_deg in (270.0, 90.0):
        wind = ["wind.speed_mps=0.0002", f"wind.from_deg={from_deg}"]
        packed = pack_flight(frozen(40.0, *wind)[0].scenario)
        y = zero_incidence(packed, packed.state)
        rate = evaluate_at(packed, y, 40.0).rate
        sideways = rotation(y[Q_BI : Q_BI + 4]).T @ rate[V_I : V_I + 3]
        both.append(np.array([sideways[1], rate[W_BI_B + 2]]))
    v_rate, r_rate = (both[0] - both[1]) / 4e-4
    body = node.plant_in_wind()
    column: Array = body.b[:, body.inputs.index("wind_mps")]
    assert v_rate == pytest.approx(column[body.states.index("w_mps")], rel=1e-5)
    assert r_rate == pytest.approx(-column[body.states.index("q_radps")], rel=1e-5)
