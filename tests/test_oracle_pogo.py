"""Feed lines that couple with axial modes (pogo), against a derivation by SymPy that shares no code with maxq.

The textbook model (S. Rubin, J. Spacecraft 3, 1966) has a structure of axial modes and a tank whose bottom pressure
follows the acceleration. An inert line with losses leads to a compliant bubble, a pump with gain and a chamber with a
lag.

| what | against |
|---|---|
| linear model of one line, two lines of an engine, two engines | SymPy's Jacobian, and its eigenvalues |
| growth and decay in flight | the eigenvalue |
| an accumulator at the pump of an unstable line | the same two |
| plant of a plane | the same eigenvalues |
| throttle by flight code | the slope of a quadratic pressure drop |
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import sympy
from flightkit import Parts, Rig, Tree, flown, load, merged, rig, scenario_of, with_stage
from test_oracle_spatial_modes import AIR, spatial_section

from maxq import ScenarioError
from maxq.control.kernel.records import Array
from maxq.design.model.linearised import at_rest, linearise
from maxq.design.model.node import node_of
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import fly
from maxq.sim.vehicle import state as layout

LENGTH_M, MASS_KG, GIMBAL_M = 14.0, 4000.0, 14.0
STATIONS = np.linspace(0.0, LENGTH_M, 57)
MODES_HZ, MODE_KG, ZETA = (10.3, 22.0), 1500.0, 0.01
Line = dict[str, float]
LINE: Line = {
    "head_kgpm2": 4.6e3,
    "inertance_Pas2pkg": 500.0,
    "resistance_Paspkg": 800.0,
    "compliance_kgpPa": 4.5e-7,
    "mass_flow_gain_s": 2e-4,
    "pump_gain": 1.6,
    "discharge_inertance_Pas2pkg": 250.0,
    "discharge_resistance_Paspkg": 3.0e4,
    "chamber_gain_Paspkg": 6.0e4,
}
KEYS: Line = {"bottom_station_m": 10.0, "chamber_lag_s": 0.004, "thrust_gain_m2": 0.05, "line_area_m2": 0.008}
FUEL = LINE | {"head_kgpm2": 2.4e3, "inertance_Pas2pkg": 300.0, "compliance_kgpPa": 2e-7, "mass_flow_gain_s": 0.0}
ACCUMULATOR = LINE | {"accumulator_kgpPa": 1e-5}


def section(line: Line, **keys: Any) -> Tree:
    return {"table": {"time_s": [0.0], **{key: [value] for key, value in line.items()}}, **(KEYS | keys)}


def shape(k: int, station_m: float) -> float:
    """Return the axial shape of mode k, along +x."""
    return float(np.cos((k + 1) * np.pi * station_m / LENGTH_M))


def tree_of(*lines: Tree, engines: int = 1, **sections: Any) -> Tree:
    modes = []
    for k, hz in enumerate(MODES_HZ):
        form = np.zeros((len(STATIONS), 6))
        form[:, 0] = [shape(k, x) for x in STATIONS]
        modes.append((hz, MODE_KG, ZETA, form))
    parts = Parts(gimbal_station_m=GIMBAL_M, thrust_N=1e5 / engines, core_mass_kg=MASS_KG)
    tree = scenario_of(parts, **sections)
    modal = spatial_section(STATIONS, MASS_KG * STATIONS / LENGTH_M, modes)
    tree = with_stage(tree, spatial_modes=modal, feed_line=list(lines))
    if engines == 2:
        one = tree["vehicle"]["stage"][0]["engine"]
        tree["vehicle"]["stage"][0]["engine"] = [one | {"offset_m": (0.4 * side, 0.0)} for side in (1, -1)]
    return tree


def derived(*lines: Tree) -> Array:
    """Return SymPy's Jacobian over (eta_1, eta_2, rates, then flow, inlet, pump and chamber of each line)."""
    n, count = len(MODES_HZ), len(lines)
    eta, rate = sympy.symbols(f"eta:{n}"), sympy.symbols(f"rate:{n}")
    states = [sympy.symbols(f"q{k} p{k} w{k} c{k}") for k in range(count)]
    force = 0
    for (q, p, _, c), line in zip(states, lines, strict=True):
        resistance = line["table"].get("resistance_Paspkg", [0.0])[0]
        force += line["thrust_gain_m2"] * c - line["line_area_m2"] * (p + resistance * q)
    accel = [
        -((2 * np.pi * hz) ** 2) * eta[k] - 4 * np.pi * hz * ZETA * rate[k] + shape(k, GIMBAL_M) * force / MODE_KG
        for k, hz in enumerate(MODES_HZ)
    ]
    out = [*rate, *accel]
    for (q, p, w, c), line in zip(states, lines, strict=True):
        of = {key: column[0] for key, column in line["table"].items()}
        a = force / MASS_KG + sum(shape(k, line["bottom_station_m"]) * accel[k] for k in range(n))
        back = sum(s[3] for s, other in zip(states, lines, strict=True) if other.get("engine") == line.get("engine"))
        flow, inlet, pump, chamber = sympy.symbols("flow inlet pump chamber")  # the time derivatives
        compliance = of["compliance_kgpPa"] + of.get("accumulator_kgpPa", 0.0)
        solved = sympy.solve(
            [
                of["inertance_Pas2pkg"] * flow + of.get("resistance_Paspkg", 0.0) * q + p - of["head_kgpm2"] * a,
                compliance * inlet + of.get("mass_flow_gain_s", 0.0) * flow - q + w,
                of["discharge_inertance_Pas2pkg"] * pump
                + of["discharge_resistance_Paspkg"] * w
                + back
                - of["pump_gain"] * p,
                line["chamber_lag_s"] * chamber + c - of["chamber_gain_Paspkg"] * w,
            ],
            [flow, inlet, pump, chamber],
            dict=True,
        )[0]
        out += [solved[x] for x in (flow, inlet, pump, chamber)]
    every = [*eta, *rate, *(x for s in states for x in s)]
    return np.array(sympy.Matrix(out).jacobian(every).evalf(20), dtype=float)


def names(count: int) -> list[str]:
    modal = [f"spatial_{k + 1}_{what}" for what in ("m", "rate_mps") for k in range(len(MODES_HZ))]
    return modal + [
        f"feed_{k + 1}_{what}" for k in range(count) for what in ("flow_kgps", "inlet_Pa", "pump_kgps", "chamber_Pa")
    ]


def least_stable(a: Array) -> complex:
    poles = np.linalg.eigvals(a)
    poles = poles[poles.imag > 1.0]
    return complex(poles[np.argmax(poles.real)])


CASES = {
    "one line": ((section(LINE),), 1),
    "an accumulator": ((section(ACCUMULATOR),), 1),
    "two lines of an engine": ((section(LINE), section(FUEL, bottom_station_m=6.0)), 1),
    "two engines": ((section(LINE, engine=0), section(FUEL, engine=1, thrust_gain_m2=0.03)), 2),
    "least": ((section({k: v for k, v in LINE.items() if k[:4] not in ("resi", "mass")}, line_area_m2=0.0),), 1),
}


@pytest.mark.parametrize("case", CASES)
def test_the_linear_model_is_that_of_sympy(case: str) -> None:
    lines, engines = CASES[case]
    made = rig(tree_of(*lines, engines=engines))
    model = linearise(*at_rest(made.packed, 0.0), 0.0)
    at = [model.states.index(name) for name in names(len(lines))]
    ours, theirs = model.a[np.ix_(at, at)], derived(*lines)
    assert (np.abs(ours - theirs) / np.abs(theirs).max(axis=1, keepdims=True)).max() < 1e-9
    assert np.sort_complex(np.linalg.eigvals(ours)) == pytest.approx(
        np.sort_complex(np.linalg.eigvals(theirs)), rel=1e-7
    )
    others = np.delete(model.a[at], at, axis=1)
    assert np.abs(others).max() < 1e-9  # nothing else moves modes and lines


def growth(made: Rig, duration_s: float, since_s: float) -> complex:
    """Return growth rate and frequency (1/s, rad/s) of the first mode's rate in flight, from its peaks."""
    period_s = 0.0005
    i = int(layout.spatial_index(made.sizes)) + len(MODES_HZ)
    y = flown(made, duration_s, period_s)[round(since_s / period_s) :, i]
    inner = np.flatnonzero((y[1:-1] > y[:-2]) & (y[1:-1] >= y[2:])) + 1
    before, here, after = y[inner - 1], y[inner], y[inner + 1]
    bend, slope = before - 2.0 * here + after, 0.5 * (after - before)
    peak, at_s = here - slope**2 / (2.0 * bend), period_s * (inner - slope / bend)
    cycles = len(inner) - 1
    rate = np.log(peak[-1] / peak[0]) / (at_s[-1] - at_s[0])
    return complex(rate, 2.0 * np.pi * cycles / (at_s[-1] - at_s[0]))


@pytest.mark.parametrize(
    ("line", "stable", "until_s"), [(LINE, False, 4.0), (ACCUMULATOR, True, 6.0)], ids=["without", "with"]
)
def test_an_accumulator_stabilises_an_unstable_line_in_flight(line: Line, stable: bool, until_s: float) -> None:
    """After the other motions have died out, the mode grows or decays with its eigenvalue, to 1 %."""
    made = rig(tree_of(section(line), run={"step_s": 0.0005}))
    pole = least_stable(derived(section(line)))
    assert (pole.real < 0.0) == stable
    assert 0.3 < abs(pole.real) < 4.0
    _, start = at_rest(made.packed, 0.0)
    made.y[:] = start[: made.n]
    made.y[int(layout.spatial_index(made.sizes)) + len(MODES_HZ)] += 1e-6
    found = growth(made, until_s, 0.5 * until_s)
    assert found.real == pytest.approx(pole.real, rel=0.01)
    assert found.imag == pytest.approx(pole.imag, rel=1e-3)


def test_the_plant_of_a_plane_contains_the_oscillation() -> None:
    tree = merged(
        tree_of(section(LINE), **AIR), {"initial": {"ned_mps": [200.0, 0.0, 0.0]}, "earth": {"gravity": "uniform"}}
    )
    poles = node_of(pack_flight(load(tree).scenario), 0.0).plant.poles()
    for pole in np.linalg.eigvals(derived(section(LINE))):
        assert np.abs(poles - pole).min() < 1e-6 * abs(pole)


def deviated(made: Rig) -> Array:
    y, i = made.y.copy(), int(layout.feed_index(made.sizes))
    y[i : i + 4] = 2.0, 3.0e4, 1.5, 4.0e4
    return y


def test_the_body_is_pushed_by_thrust_and_pressures() -> None:
    made = rig(tree_of(section(LINE)))
    rate = made.derivative(deviated(made))
    thrust = 1e5 + 0.05 * 4.0e4
    assert made.aux.engines.thrust_N[0] == pytest.approx(thrust, rel=1e-14)
    assert rate[layout.V_I] * MASS_KG == pytest.approx(thrust - 0.008 * (3.0e4 + 800.0 * 2.0), rel=1e-12)


def test_a_combined_pair_of_engines_has_the_sum_of_both_deviations() -> None:
    lines, engines = CASES["two engines"]
    made = rig(tree_of(*lines, engines=engines))
    y, i = deviated(made), int(layout.feed_index(made.sizes))
    y[i + 7] = 1.0e4
    made.derivative(y)
    assert made.aux.engines.axial_thrust_N == pytest.approx(1e5 + 0.05 * 4e4 + 0.03 * 1e4, rel=1e-14)


def test_without_thrust_the_deviations_decay() -> None:
    made = rig(tree_of(section(LINE)))
    made.held.burning = 0
    y, i = deviated(made), int(layout.feed_index(made.sizes))
    rate = made.derivative(y)
    assert made.aux.engines.thrust_N[0] == 0.0
    assert rate[i : i + 4] == pytest.approx(-y[i : i + 4] / 0.004, rel=1e-15)
    assert rate[layout.V_I] == 0.0


def test_a_held_vehicle_drives_the_line_by_its_modes_alone() -> None:
    """On the pad the body does not accelerate under the deviation of the thrust."""
    made = rig(tree_of(section(LINE, line_area_m2=0.0)))
    free, held = made.derivative(deviated(made)), None
    made.held.on_pad = 1
    held = made.derivative(deviated(made))
    i = int(layout.feed_index(made.sizes))
    apart = 4.6e3 / 500.0 * (0.05 * 4.0e4 / MASS_KG)
    assert free[i] - held[i] == pytest.approx(apart, rel=1e-9)


def test_parameters_follow_the_clock_of_the_stage() -> None:
    line = section(LINE)
    line["table"] = {key: [0.0, 10.0] if key == "time_s" else [v[0], v[0]] for key, v in line["table"].items()}
    line["table"]["head_kgpm2"] = [4.6e3, 2.6e3]
    made, y = rig(tree_of(line)), None
    y = deviated(made)
    i, n = int(layout.feed_index(made.sizes)), int(layout.spatial_index(made.sizes))
    rate = made.derivative(y, 2.5)
    accel = (0.05 * 4e4 - 0.008 * (3e4 + 1600.0)) / MASS_KG
    accel += sum(shape(k, 10.0) * rate[n + 2 + k] for k in range(2))
    assert rate[i] == pytest.approx((4.1e3 * accel - 1600.0 - 3e4) / 500.0, rel=1e-12)


def test_a_throttle_reduces_the_resistances_of_turbulent_flow() -> None:
    """The pressure drop k q^2 has the slope 2 k q: flight code that throttles to 0.6 leaves 0.6 of both resistances."""
    made = rig(tree_of(section(LINE)))
    made.packed.memory["clock"]["throttled"] = 0.4
    y = deviated(made)
    i, n = int(layout.feed_index(made.sizes)), int(layout.spatial_index(made.sizes))
    rate = made.derivative(y)
    lost = 3e4 + 0.6 * 1600.0
    accel = (0.05 * 4e4 - 0.008 * lost) / MASS_KG + sum(shape(k, 10.0) * rate[n + 2 + k] for k in range(2))
    assert made.aux.engines.thrust_N[0] == pytest.approx(0.6e5 + 0.05 * 4e4, rel=1e-14)
    assert rate[i] == pytest.approx((4.6e3 * accel - lost) / 500.0, rel=1e-12)
    assert rate[i + 2] == pytest.approx((1.6 * 3e4 - 0.6 * 3e4 * 1.5 - 4e4) / 250.0, rel=1e-12)


def test_the_log_contains_deviations_and_forces() -> None:
    """The logged thrust is that of the table plus the logged deviation. The forces are those of the logged times."""
    buffet: Tree = {
        "mach": [0.0] * 2,
        "frequency_hz": [1.0, 40.0],
        "station_m": [3.0] * 2,
        "force_psd_N2pHz": [90.0] * 2,
    }
    made = with_stage(tree_of(section(LINE), run={"duration_s": 0.3}), buffet={"table": buffet})
    flight, still = fly(load(made)), rig(made)
    slow = np.isin(flight.time_s("feed_1_chamber_Pa"), flight.time_s("thrust_N"))
    chamber = flight["feed_1_chamber_Pa"][slow]
    assert np.abs(chamber).max() > 1e3
    assert flight["thrust_N"] == pytest.approx(1e5 + 0.05 * chamber, rel=1e-12)
    for k in (0, 137, 299):
        still.derivative(still.y, float(flight.time_s("buffet_1_pitch_N")[k]))
        logged = [flight[f"buffet_1_{axis}_N"][k] for axis in ("pitch", "yaw")]
        assert logged == pytest.approx(still.aux.buffet_N[:2], rel=1e-9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"engine": 1}, "feed_line.0.engine = 1: the core has no such engine; allowed: 0 .. 0"),
        ({"bottom_station_m": 15.0}, "beyond the mode shapes"),
        ({"chamber_lag_s": 0.0}, "chamber_lag_s"),
        ({"table": {"time_s": [0.0]}}, "column head_kgpm2 is missing"),
    ],
)
def test_wrong_lines_are_rejected(changes: Tree, words: str) -> None:
    with pytest.raises(ScenarioError) as raised:
        load(tree_of(section(LINE) | changes))
    assert words in " ".join(str(raised.value).split())
