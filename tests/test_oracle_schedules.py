"""Gains over speed, mass and dynamic pressure agree in computer, flight, linear loop and optimiser.

| quantity | oracle |
|---|---|
| gains of the computer | `np.interp` at its inputs |
| gains of a flight in wind | `np.interp` at speed, mass and pressure from the log and a separate atmosphere |
| law of an operating point | `np.interp` at its speed, mass, density |
| laws of the optimiser, and their gradient | `np.interp`, complex step |
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import optimise_kit as kit
import pytest

import maxq
from maxq import ScenarioError
from maxq.control.computer import ComputerState, build_computer, computer_tick, start_computer
from maxq.control.kernel.records import blank, pack
from maxq.control.kernel.tables import Pool
from maxq.control.laws.pd import GainSchedule, gains_table
from maxq.design.laws.pd_variables import PdVariables
from maxq.design.loop.loop import law_at
from maxq.design.optimise.at_nodes import make_problem
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

OVER = "time_s", "speed_mps", "mass_kg", "dynamic_pressure_Pa"

ROWS = {
    "speed_mps": [20.0, 60.0, 90.0],
    "mass_kg": [5400.0, 5800.0, 6000.0],
    "dynamic_pressure_Pa": [50.0, 900.0, 4000.0],
}
K_P, K_D = [1.2, 0.9, 0.6], [0.5, 0.4, 0.3]


def design(folder: Path, over: str) -> Path:
    rows = ", ".join(f"{{{over}={x}, k_p={p}, k_d_s={d}}}" for x, p, d in zip(ROWS[over], K_P, K_D, strict=True))
    path = folder / f"{over}.toml"
    path.write_text(f"schema = 2\n[gains]\ntable = [{rows}]\n")
    return path


@pytest.mark.parametrize("over", OVER)
def test_computer_takes_its_gains_at_what_it_is_given(over: str) -> None:
    at, pool = [10.0, 20.0, 40.0], Pool()
    made = build_computer(
        pool, sample_ns=10_000_000, gains=gains_table(GainSchedule(at, K_P, K_D, over=over)), over=over
    )
    computer, state, tables = pack([made])[0], blank(ComputerState)[0], pool.array()
    start_computer(computer, tables, state, 0.0)
    none3, none2 = np.zeros(3, np.int64), np.zeros(2, np.int64)
    for k, values in enumerate(np.random.default_rng(1).uniform(5.0, 45.0, (20, 4))):
        state.navigation[:] = values[1:]
        computer_tick(computer, tables, state, values[0], np.zeros(3), np.zeros(3), none3, np.zeros(2), none2)
        wanted = np.interp(values[OVER.index(over)], at, K_P), np.interp(values[OVER.index(over)], at, K_D)
        assert (state.law.pd.k_p[1], state.law.pd.k_d_s[1]) == pytest.approx(wanted, rel=1e-12), k


def density_kgpm3(altitude_m: float) -> float:
    """Return the density of the US Standard Atmosphere 1976 below 11 km."""
    h = 6356766.0 * altitude_m / (6356766.0 + altitude_m)
    t = 288.15 - 0.0065 * h
    return 101325.0 * (t / 288.15) ** (9.80665 / (287.0528 * 0.0065)) / (287.0528 * t)


@pytest.mark.parametrize("over", OVER[1:])
def test_flight_schedules_over_what_it_flies(tmp_path: Path, over: str) -> None:
    changes = [
        f"design={design(tmp_path, over)}",
        "run.duration_s=9",
        "wind.speed_mps=9.0",
        "wind.from_deg=200",
        "requirement=",
    ]
    out = fly(load_scenario("nominal", changes))
    time_s = out.time_s("k_p_pitch")
    speed, altitude, mass = (
        np.interp(time_s, out.time_s(name), out[name]) for name in ("speed_mps", "altitude_m", "mass_kg")
    )
    pressure = 0.5 * np.array([density_kgpm3(h) for h in altitude]) * speed**2
    value = {"speed_mps": speed, "mass_kg": mass, "dynamic_pressure_Pa": pressure}[over]
    late = time_s > 1.5  # rows over time are interpolated, and a gain is that of the sample at the row or before
    wanted = np.interp(value, ROWS[over], K_P)[late]
    assert np.ptp(wanted) > 0.2
    assert out["k_p_pitch"][late] == pytest.approx(wanted, abs=6e-3)


@pytest.mark.parametrize("over", OVER[1:])
def test_law_of_a_node_is_that_of_its_instant(tmp_path: Path, over: str) -> None:
    node = kit.plants().each[0].node
    at = {
        "speed_mps": node.condition.airspeed_mps,  # no wind
        "mass_kg": node.vehicle.total_mass_kg,
        "dynamic_pressure_Pa": node.condition.dynamic_pressure_Pa,
    }[over]
    assert node.scheduled(over) == pytest.approx(at, rel=1e-9)
    assert node.scheduled("time_s") == node.time_s
    path = tmp_path / "d.toml"
    path.write_text(
        f"[gains]\ntable=[{{{over}={0.9 * at}, k_p=1.5, k_d_s=0.3}}, {{{over}={1.2 * at}, k_p=0.6, k_d_s=0.9}}]\n"
    )
    gains = law_at(maxq.load_design(path), node).gains
    assert gains["k_p"] == pytest.approx(1.2, rel=1e-9)
    assert gains["k_d_s"] == pytest.approx(0.5, rel=1e-9)


CASE = ("gains.over=dynamic_pressure_Pa", "gains.schedule=nodes", "gains.nodes=[2000.0, 30000.0, 60000.0]")


def test_optimiser_schedules_over_pressure() -> None:
    plants = kit.plants(*CASE)
    law: Any = make_problem(kit.case(*CASE).case, plants).law
    assert isinstance(law, PdVariables)
    pressure = np.array([plant.node.condition.dynamic_pressure_Pa for plant in plants.each])
    n, u = law.filter.size, np.log([1.2, 0.9, 0.7, 0.5, 0.45, 0.3])
    variables = np.concatenate([law.starts(1, 1)[0][:n], u])

    def gains(u: Any) -> Any:
        """Return the scheduled gains (plants, 2); `u` may be complex."""
        nodes, k = np.array([2000.0, 30000.0, 60000.0]), np.exp(u).reshape(2, 3)
        i = np.clip(np.searchsorted(nodes, pressure) - 1, 0, 1)
        share = np.clip((pressure - nodes[i]) / (nodes[i + 1] - nodes[i]), 0.0, 1.0)
        return (k[:, i] * (1.0 - share) + k[:, i + 1] * share).T

    np.testing.assert_allclose(np.exp(law.own(variables)[:, n:]), gains(u), rtol=1e-12)
    slopes = law.jacobian(variables)[:, n:, n:]
    for j in range(6):
        stepped = u.astype(complex)
        stepped[j] += 1e-30j
        np.testing.assert_allclose(slopes[:, :, j], np.log(gains(stepped)).imag * 1e30, rtol=1e-9, atol=1e-12)
    made = law.designed(variables)
    assert made.tables()["gains"]["table"][1]["dynamic_pressure_Pa"] == 30000.0
    np.testing.assert_allclose(law.variables_of(made), variables, rtol=1e-9)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("{time_s=1.0, speed_mps=3.0, k_p=1.0, k_d_s=0.5}", "column time_s cannot be combined with speed_mps"),
        ("{k_p=1.0, k_d_s=0.5}", "column time_s is missing"),
        ("{mass_kg=2.0, k_p=1, k_d_s=1}, {mass_kg=1.0, k_p=1, k_d_s=1}", "mass_kg must increase strictly"),
    ],
)
def test_wrong_tables_are_told(rows: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        load_scenario("nominal", [f"design.gains.table=[{rows}]"])
    with pytest.raises(ScenarioError, match="is not over what pitch is over"):
        load_scenario("nominal", ["design.gains.yaw=", "design.gains.yaw_table=[{mass_kg=2.0, k_p=1, k_d_s=1}]"])
