"""Known faults of other simulators are absent, and neutral changes leave a flight bit-identical.

Slosh damping and spin drift are in test_invariants_dynamics.py and test_oracle_closed_forms_motion.py.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from flightkit import COMPUTER, Parts, Rig, flown, load, merged, rig, rig_of, scenario_of, with_stage
from scipy.integrate import quad

from maxq import FlightRun, LoadedScenario
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle import schedule
from maxq.sim.vehicle import state as layout

SHORT = ("run.duration_s=0.5", "run.stop_at=[]")


# --- propellant: depleted once, and by what flows out
def powered() -> Rig:
    """Return the nominal vehicle, held in the air so that its schedule can be read at any time."""
    return rig_of(load_scenario("nominal", ["initial.held=false"]))


def column(made: Rig, time_s: float, index: int | slice) -> np.ndarray:
    made.derivative(made.y, time_s)
    return np.atleast_1d(made.props[index]).copy()


def burn_end_s(made: Rig) -> float:
    return 1e-9 * int(made.timeline.burnout_ns)


def breaks_s(made: Rig) -> np.ndarray:
    table = made.vehicle.schedule
    return np.array(made.packed.pool[table.offset : table.offset + table.n_breaks])


def test_expelled_mass_is_the_integral_of_mass_flow() -> None:
    made = powered()
    made.held.burning = 1
    ends = [t for t in breaks_s(made) if t < burn_end_s(made)] + [burn_end_s(made) - 1e-6]
    expelled = 0.0
    for start, end in itertools.pairwise(ends):
        flow = lambda t: float(column(made, t, schedule.MASS_FLOW)[0])  # noqa: E731  - an integrand
        expelled += quad(flow, start, end, epsabs=1e-9, epsrel=1e-12)[0]
    before = column(made, ends[0], schedule.TOTAL_MASS)[0]
    after = column(made, ends[-1], schedule.TOTAL_MASS)[0]
    assert before - after > 3000.0
    assert np.isclose(expelled, before - after, rtol=1e-10)


def test_core_and_bobs_make_the_whole() -> None:
    """The sloshing masses are subtracted from the core once: mass and first moment agree at and between breakpoints."""
    made = powered()
    made.held.burning = 1
    tanks = [schedule.N_CONSTANT + schedule.TANK_WIDTH * k for k in range(2)]
    table = load_scenario("nominal").vehicle.stage[0].mass.table
    assert table is not None
    for k, time_s in enumerate(table["time_s"]):
        if time_s >= burn_end_s(made):
            break
        made.derivative(made.y, float(time_s))
        bobs = [(made.props[t], made.props[t + 2] + made.props[t + 1]) for t in tanks]
        core = made.props[schedule.CORE_MASS]
        assert np.isclose(core + sum(m for m, _ in bobs), table["mass_kg"][k], rtol=1e-9)
        moment = core * made.props[schedule.CORE_CG] + sum(m * x for m, x in bobs)
        assert np.isclose(moment, table["mass_kg"][k] * table["x_cg_m"][k], rtol=1e-6)
        point = sum(m * (x - table["x_cg_m"][k]) ** 2 for m, x in bobs)
        shift = core * (made.props[schedule.CORE_CG] - table["x_cg_m"][k]) ** 2
        assert np.isclose(made.props[schedule.CORE_INERTIA + 1] + point + shift, table["Iyy_kgm2"][k], rtol=1e-6)
        assert np.isclose(made.props[schedule.CORE_INERTIA], table["Ixx_kgm2"][k], rtol=1e-6)


def test_rates_of_cg_and_inertia_are_finite_differences() -> None:
    made = powered()
    made.held.burning = 1
    rng = np.random.default_rng(3)
    properties = slice(schedule.CORE_CG, schedule.CG_RATE)
    rates = slice(schedule.CG_RATE, schedule.TOTAL_MASS)
    h = 1e-4
    checked = 0
    for time_s in rng.uniform(1.0, burn_end_s(made) - 1.0, 40):
        if np.min(np.abs(breaks_s(made) - time_s)) < 2 * h:
            continue
        difference = (column(made, time_s + h, properties) - column(made, time_s - h, properties)) / (2 * h)
        ours = column(made, time_s, rates)
        assert np.allclose(ours, difference, rtol=1e-6, atol=1e-7)
        assert np.abs(ours[0]) + np.abs(ours[4]) > 1e-3
        checked += 1
    assert checked > 30


def test_nothing_flows_once_the_engine_is_out() -> None:
    made = powered()
    made.held.burning = 0
    made.derivative(made.y, burn_end_s(made) + 10.0)
    assert np.all(made.props[schedule.CG_RATE : schedule.TOTAL_MASS] == 0.0)
    assert made.props[schedule.MASS_FLOW] == 0.0
    assert made.props[schedule.THRUST_VACUUM] == 0.0


# --- causality
def closed_loop(start_s: float, amplitude_Nm: float) -> Rig:
    """Return a loop with a step of rate command at 0.2 s, and a torque that begins at `start_s`."""
    injection = [
        {"at": "rate_command", "axis": "pitch", "kind": "step", "amplitude_degps": 2.0, "start_s": 0.2},
        {"at": "body_torque", "axis": "y", "kind": "step", "amplitude_Nm": amplitude_Nm, "start_s": start_s},
    ]
    tree = scenario_of(Parts(thrust_N=1.0e5), injection=injection)
    tree["design"] = {"gains": {"table": [{"time_s": 0.0, "k_p": 1.0, "k_d_s": 0.5}]}}
    return rig(tree)


@pytest.mark.parametrize("start_s", [0.45, 0.4501, 0.453])
def test_command_knows_nothing_of_the_future(start_s: float) -> None:
    """A disturbance changes no state before it begins, no command before a sample, no engine before the delay."""
    disturbed, calm = closed_loop(start_s, 5.0e4), closed_loop(start_s, 0.0)  # both split their steps there
    run, other = disturbed.run(), calm.run()
    sample_s = np.ceil(start_s / 0.01 + 1e-9) * 0.01  # the first sample after the disturbance has begun
    seen_command = seen_effect = False
    for k in range(1, 500):
        now = 1e-3 * k
        run.fly_segment(1_000_000)
        other.fly_segment(1_000_000)
        a, b = run.memory, other.memory
        if now <= start_s:
            assert np.array_equal(disturbed.y, calm.y)
        pending = (float(a.clock.pending_rad[0]), float(b.clock.pending_rad[0]))
        held = (float(a.held.command_rad[0]), float(b.held.command_rad[0]))
        if now <= sample_s + 1e-9:  # a segment ends before the sample at its end is taken
            assert pending[0] == pending[1]
        elif pending[0] != pending[1]:
            seen_command = True
        if now <= sample_s + 0.003 + 1e-9:
            assert held[0] == held[1]
            engine = slice(layout.ACTUATOR, layout.ACTUATOR + 6)
            assert np.array_equal(disturbed.y[engine], calm.y[engine])
        elif held[0] != held[1]:
            seen_effect = True
    assert seen_command
    assert seen_effect


def test_first_command_comes_after_the_first_sample_and_its_delay() -> None:
    """The first command is sampled at 10 ms and in effect at 13 ms, whatever the integrator's step."""
    for step_s in (0.001, 0.004, 0.0007):
        injection = [{"at": "gimbal_command", "axis": "yaw", "kind": "step", "amplitude_deg": 1.0}]
        made = rig(scenario_of(Parts(), injection=injection, run={"step_s": step_s}))
        run = made.run()
        while 1e-9 * int(run.memory.clock.now_ns) < 0.0999:
            before = made.y[layout.ACTUATOR + 6 + 1]
            run.fly_segment(100_000)
            now = int(run.memory.clock.now_ns)
            assert (made.y[layout.ACTUATOR + 6 + 1] != 0.0) == (now > 13_000_000)
        assert before != 0.0


# --- what must not change a flight
def end_of(loaded: LoadedScenario, log: bool, segment_ns: int = 1_000_000_000) -> tuple[str, np.ndarray]:
    run = FlightRun(loaded, log=log)
    while not run.finished:
        run.fly_segment(segment_ns)
    return run.state_hash(), run.packed.state.copy()


def test_logging_changes_no_bit() -> None:
    base, _ = end_of(load_scenario("nominal", SHORT), log=True)
    for more, log in (((), False), (("log.fast_hz=100.0", "log.slow_hz=10.0"), True), (("log.fast_hz=500.0",), True)):
        again, _ = end_of(load_scenario("nominal", [*SHORT, *more]), log=log)
        assert again == base
    assert fly(load_scenario("nominal", SHORT)).state_hash == base


@pytest.mark.parametrize("segment_ns", [1_000_000, 7_000_000, 100_000_000, 2_000_000_000])
def test_how_a_flight_is_cut_into_segments_changes_no_bit(segment_ns: int) -> None:
    """Segments that are multiples of the step change no bit, from the pad through liftoff."""
    loaded = load_scenario("nominal", ["run.duration_s=6.0", "run.stop_at=[]"])
    base, _ = end_of(loaded, log=False)
    assert end_of(loaded, log=False, segment_ns=segment_ns)[0] == base


def test_same_scenario_same_bits_and_other_seed_other_bits() -> None:
    noisy = [*SHORT, "vehicle.stage.0.gyro.noise_deg_rt_h=1.0", "wind.turbulence={exceedance='moderate'}"]
    noisy += ["initial.geodetic={latitude_deg=36.7, longitude_deg=126.47, altitude_m=2000.0}"]
    noisy += ["initial.ned_mps=[0.0, 0.0, -200.0]", "run.start_s=20.0"]
    first = end_of(load_scenario("nominal", noisy), log=False)[0]
    assert end_of(load_scenario("nominal", noisy), log=False)[0] == first
    assert end_of(load_scenario("nominal", [*noisy, "run.seed=2"]), log=False)[0] != first


def test_packing_twice_flies_alike() -> None:
    """A flight changes nothing in the scenario that it was packed from."""
    loaded = load_scenario("nominal", SHORT)
    first = pack_flight(loaded.scenario)
    once = FlightRun(loaded, first, log=False)
    while not once.finished:
        once.fly_segment()
    second = pack_flight(loaded.scenario)
    assert np.array_equal(first.parameters, second.parameters)
    assert np.array_equal(first.pool, second.pool)


def test_sample_period_is_kept_for_any_step() -> None:
    """A step that does not divide the sample period gives the same number of samples."""
    counts = []
    for step_s in (0.001, 0.0007, 0.003):
        tree = merged(scenario_of(Parts(), run={"step_s": step_s}), {"vehicle": {"computer": COMPUTER}})
        made = rig(tree)
        flown(made, 2.1)
        counts.append(int(made.packed.memory[0].clock.samples))
    assert counts[0] == counts[1] == counts[2]


# --- the schedule's own instants
def burning_parts(rows: list[dict[str, float]], thrust: list[dict[str, float]], **sections: object) -> LoadedScenario:
    tree = scenario_of(Parts(), initial={"rate_BI_radps": [0.0, 0.2, 0.0]}, **sections)
    tree = with_stage(tree, interpolation="linear", engine={"table": thrust})
    stage = dict(tree["vehicle"]["stage"][0])
    stage["mass"] = {"table": rows}
    tree["vehicle"]["stage"] = [stage]
    return load(tree)


def mass_row(time_s: float, mass_kg: float, lateral_kgm2: float) -> dict[str, float]:
    return {
        "time_s": time_s,
        "mass_kg": mass_kg,
        "x_cg_m": 7.0,
        "Ixx_kgm2": 900.0,
        "Iyy_kgm2": lateral_kgm2,
        "Izz_kgm2": lateral_kgm2,
    }


@pytest.mark.parametrize("step_s", [0.1, 0.001])
def test_kinks_of_the_schedule_cost_no_accuracy(step_s: float) -> None:
    """Mass flow and inertia rate jump at a row of a linear table, and the step that begins there uses the new values.

    The closed form of jet damping in an interval is w = w0 (I / I0)^-(1 + mdot l^2 / I').
    """
    rows = [mass_row(0.0, 4000.0, 5.0e4), mass_row(2.0, 3000.0, 4.5e4), mass_row(4.0, 2900.0, 3.5e4)]
    rows += [mass_row(20.0, 2000.0, 3.0e4)]
    made = rig_of(burning_parts(rows, [{"time_s": 0.0, "thrust_vacuum_N": 0.0}], run={"step_s": step_s}))
    flown(made, 10.0)
    wanted = 0.2
    for a, b in itertools.pairwise(rows):
        lasts = b["time_s"] - a["time_s"]
        change, flow = (b["Iyy_kgm2"] - a["Iyy_kgm2"]) / lasts, (a["mass_kg"] - b["mass_kg"]) / lasts
        end = a["Iyy_kgm2"] + change * (min(10.0, b["time_s"]) - a["time_s"])
        wanted *= (end / a["Iyy_kgm2"]) ** -(1.0 + flow * 36.0 / change)
    assert np.isclose(made.y[layout.W_BI_B + 1], wanted, rtol=2e-10)


def test_vehicle_after_burnout_is_the_one_in_its_tables() -> None:
    """Tables may extend beyond the end of thrust: their interval continues to advance after burnout."""
    rows = [mass_row(0.0, 4000.0, 5.0e4), mass_row(2.0, 3000.0, 4.0e4), mass_row(8.0, 3000.0, 4.0e4)]
    thrust = [{"time_s": 0.0, "thrust_vacuum_N": 1.0e4}, {"time_s": 2.0, "thrust_vacuum_N": 0.0}]
    flight = fly(burning_parts(rows, thrust, run={"duration_s": 6.0}))
    assert flight.event_s("burnout") == 2.0
    time_s, mass, inertia = flight.time_s("mass_kg"), flight["mass_kg"], flight["Iyy_kgm2"]
    after = time_s > 2.0
    assert np.allclose(mass[~after], 4000.0 - 500.0 * time_s[~after], rtol=1e-12)
    assert np.allclose(mass[after], 3000.0, rtol=1e-12)
    assert np.allclose(inertia[after], 4.0e4, rtol=1e-12)


def test_vehicle_before_a_late_ignition_is_the_one_in_its_tables() -> None:
    rows = [mass_row(0.0, 4000.0, 5.0e4), mass_row(1.0, 4000.0, 4.0e4), mass_row(4.0, 3000.0, 3.0e4)]
    thrust = [{"time_s": 0.0, "thrust_vacuum_N": 1.0e4}, {"time_s": 4.0, "thrust_vacuum_N": 0.0}]
    loaded = burning_parts(rows, thrust, run={"duration_s": 3.9})
    tree_inertia = fly(loaded)["Iyy_kgm2"]
    late = loaded.scenario.vehicle.stage[0].model_copy(update={"ignition_s": 3.0})
    vehicle = loaded.scenario.vehicle.model_copy(update={"stage": (late,)})
    scenario = loaded.scenario.model_copy(update={"vehicle": vehicle})
    flight = fly(LoadedScenario(scenario, "late", ()))
    assert np.allclose(flight["Iyy_kgm2"], tree_inertia, rtol=1e-12)


def test_nominal_vehicle_keeps_its_tables_mass_all_the_way() -> None:
    loaded = load_scenario("nominal", ["run.duration_s=90.0"])
    table = loaded.vehicle.stage[0].mass.table
    assert table is not None
    flight = fly(loaded)
    time_s, mass = flight.time_s("mass_kg"), flight["mass_kg"]
    assert np.max(np.abs(mass - np.interp(time_s, table["time_s"], table["mass_kg"]))) < 2.0  # pchip between the rows
    at_rows = np.isin(np.round(time_s, 6), np.round(table["time_s"], 6))
    assert at_rows.sum() > 3
    wanted = np.interp(time_s[at_rows], table["time_s"], table["mass_kg"])
    assert np.allclose(mass[at_rows], wanted, rtol=1e-9)
