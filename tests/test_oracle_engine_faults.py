"""Propellant and thrust of stopped, weakened and throttled engines equal sums and integrals written here.

| case | expected |
|---|---|
| an engine of nine off at once | closed form: the tables' clock then runs at 8/9 of the time |
| tail-off, loss and return, throttle ramps, unlike engines with their own flows | SciPy's integral of the flows |
| expelled mass | integral of the mass flow in every case |
| burnout | when the remaining propellant is spent; at once where the last engine is off |
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from maxq import ScenarioError
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle import schedule
from maxq.sim.vehicle.engine.burn import stage_burns

NINE = "tests/data/nine-engines/flight.toml"
OFF = "fault=[{kind='engine-off',engine=8,at_s=20.0}]"
LOST = ("thrust_N", "mass_flow_kgps")
NO_SLOSH = "switches.slosh=false"  # with it the core's interpolation is fitted again on the tanks' breakpoints


def packed(*overrides: str) -> Packed:
    return pack_flight(load_scenario(NINE, list(overrides)).scenario)


def table_of(made: Packed):
    return table_in(made.pool, made.parameters[0].vehicle.schedule)


def thrust_N(made: Packed, time_s: float) -> float:
    """Return the vacuum thrust of all engines."""
    row, e = table_of(made)(time_s), made.parameters[0].vehicle.engine
    sizes = made.parameters[0].vehicle.sizes
    first = len(row) - int(sizes.thrust_curves) + 1
    columns = [schedule.THRUST_VACUUM, *range(first, len(row))]
    return float(sum(e.thrust_factor[k] * row[columns[int(e.curve[k])]] for k in range(int(sizes.engines))))


def test_one_of_nine_off_slows_the_clock_of_the_tables_to_eight_ninths() -> None:
    nominal, made = packed(), packed(OFF)
    assert int(made.parameters[0].vehicle.sizes.engines) == 2
    before, after = table_of(nominal), table_of(made)
    for time_s in (0.3, 12.3, 20.0, 47.1, 120.0, 160.0):
        clock_s = time_s if time_s <= 20.0 else 20.0 + (time_s - 20.0) * 8.0 / 9.0
        rate = 1.0 if time_s < 20.0 else 8.0 / 9.0
        a, b = before(clock_s), after(time_s)
        values = [schedule.CORE_MASS, schedule.CORE_CG, schedule.CORE_INERTIA + 1, schedule.TOTAL_MASS]
        np.testing.assert_allclose(b[values], a[values], rtol=1e-12)
        rates = [schedule.CG_RATE, schedule.INERTIA_RATE, schedule.MASS_FLOW, schedule.tank_column(0) + 3]
        np.testing.assert_allclose(b[rates], rate * a[rates], rtol=1e-9, atol=1e-12)
        modes = int(schedule.mode_column(made.parameters[0].vehicle.sizes, 0, 0))
        np.testing.assert_allclose(b[modes : modes + 20], a[modes : modes + 20], rtol=1e-10)
    assert thrust_N(made, 19.9) == pytest.approx(9 * 400e3, rel=1e-12)
    assert thrust_N(made, 20.1) == pytest.approx(8 * 400e3, rel=1e-12)
    scenario = load_scenario(NINE, [OFF]).scenario
    burn = stage_burns(scenario.vehicle.stage, scenario.fault)[0]
    assert burn.burnout_s == pytest.approx(20.0 + 131.0 * 9.0 / 8.0, rel=1e-12)
    assert int(made.parameters[0].timeline.burnout_ns) == round(1e9 * burn.burnout_s)


UNLIKE = [
    "vehicle.stage.0.interpolation='linear'",
    "vehicle.stage.0.engine.0.table=[{time_s=0.0,thrust_vacuum_N=5e5,mass_flow_kgps=120.0},"
    "{time_s=100.0,thrust_vacuum_N=3e5,mass_flow_kgps=100.0},{time_s=151.0,thrust_vacuum_N=0.0,mass_flow_kgps=0.0}]",
    *[
        f"vehicle.stage.0.engine.{k}.table=[{{time_s=0.0,thrust_vacuum_N=0.0,mass_flow_kgps=0.0}},"
        "{time_s=0.5,thrust_vacuum_N=4e5,mass_flow_kgps=136.0},{time_s=150.0,thrust_vacuum_N=4e5,mass_flow_kgps=136.0},"
        "{time_s=151.0,thrust_vacuum_N=0.0,mass_flow_kgps=0.0}]"
        for k in range(1, 9)
    ],
    "vehicle.stage.0.engine.3.throttle=[{time_s=0.0,throttle=1.0},{time_s=30.0,throttle=1.0},"
    "{time_s=36.0,throttle=0.6},{time_s=70.0,throttle=0.6},{time_s=72.0,throttle=1.05}]",
    "vehicle.stage.0.engine.5.mass_flow_factor=1.02",
    "fault=[{kind='engine-off',engine=7,at_s=25.0,tail_off=[{time_s=0.0,share=1.0},{time_s=1.5,share=0.2},"
    "{time_s=4.0,share=0.0}]},{kind='thrust-loss',engine=0,at_s=40.0,until_s=55.0,loss=0.35}]",
]


def unlike_clock(times_s: Array) -> Array:
    """Return the clock of the tables at given times, integrated by SciPy from flows written out here."""

    def flow(k: int, s: float) -> float:
        if k == 0:
            return float(np.interp(s, [0.0, 100.0, 151.0], [120.0, 100.0, 0.0]))
        return float(np.interp(s, [0.0, 0.5, 150.0, 151.0], [0.0, 136.0, 136.0, 0.0]))

    def share(k: int, t: float) -> float:
        if k == 0:
            return 0.65 if 40.0 <= t < 55.0 else 1.0
        if k == 3:
            return float(np.interp(t, [30.0, 36.0, 70.0, 72.0], [1.0, 0.6, 0.6, 1.05]))
        if k == 5:
            return 1.02
        return float(np.interp(t - 25.0, [0.0, 1.5, 4.0], [1.0, 0.2, 0.0])) if k == 7 else 1.0

    def rate(t: float, s: Any) -> list[float]:
        flows = [flow(k, float(s[0])) for k in range(9)]
        return [sum(f * share(k, t) for k, f in enumerate(flows)) / sum(flows)]

    stops = [0.0, 25.0, 26.5, 29.0, 30.0, 36.0, 40.0, 55.0, 70.0, 72.0, 140.0]
    s, out = 0.0, {}
    for begin, end in pairwise(stops):
        inside = [t for t in times_s if begin < t <= end]
        found = solve_ivp(rate, (begin, end), [s], rtol=1e-11, atol=1e-11, t_eval=[*inside, end], max_step=0.2)
        out |= dict(zip(inside, found.y[0], strict=False))
        s = float(found.y[0, -1])
    return np.array([out[t] for t in times_s])


def test_tail_off_loss_and_throttle_spend_what_they_burn() -> None:
    times_s = np.array([10.0, 25.7, 27.0, 33.3, 38.0, 47.0, 60.0, 71.0, 100.0, 139.0])
    made, nominal = packed(*UNLIKE, NO_SLOSH), packed(*UNLIKE[:10], NO_SLOSH)
    clock_s = unlike_clock(times_s)
    ours, theirs = table_of(made), table_of(nominal)
    for t, s in zip(times_s, clock_s, strict=True):
        assert ours(t)[schedule.TOTAL_MASS] == pytest.approx(theirs(s)[schedule.TOTAL_MASS], rel=2e-8)
    # the thrust of each engine at what is left, times its own share
    # engines 1, 2, 4, 6, 8 as ever, 3 throttled, 5 hot, 7 off, the first without what it lost
    by_hand = (5 + 0.6 + 1.02) * 4e5 + 0.65 * np.interp(clock_s[5], [0.0, 100.0], [5e5, 3e5])
    assert thrust_N(made, 47.0) == pytest.approx(by_hand, rel=1e-8)


@pytest.mark.parametrize("overrides", [[], [OFF], UNLIKE], ids=["nominal", "one off", "unlike"])
def test_expelled_mass_is_the_integral_of_the_flow(overrides: list[str]) -> None:
    made = packed(*overrides)
    table = table_of(made)
    nodes, weights = np.polynomial.legendre.leggauss(3)  # exact on each cubic
    breaks = table.breaks[(table.breaks >= 0.0) & (table.breaks < 150.0)]
    spent = 0.0
    for a, b in pairwise(breaks):
        at = 0.5 * (a + b) + 0.5 * (b - a) * nodes
        spent += 0.5 * (b - a) * float(weights @ table.at(at)[:, schedule.MASS_FLOW])
    lost = table(breaks[0])[schedule.TOTAL_MASS] - table(breaks[-1])[schedule.TOTAL_MASS]
    assert spent == pytest.approx(lost, rel=1e-11)


def test_all_engines_off_is_burn_out_and_leaves_the_propellant() -> None:
    made = packed("fault=[{kind='engine-off',at_s=30.0}]")
    assert int(made.parameters[0].timeline.burnout_ns) == 30_000_000_000
    table = table_of(made)
    assert table(45.0)[schedule.TOTAL_MASS] == table(30.0)[schedule.TOTAL_MASS] > 2.4e5
    assert table(45.0)[schedule.MASS_FLOW] == 0.0


def test_a_tail_off_ends_where_its_table_does() -> None:
    """Burnout is at 45.3 s to the nanosecond, although 45.0 + 0.3 - 45.0 is less than 0.3 in floating point."""
    tail = "tail_off=[{time_s=0.0,share=1.0},{time_s=0.3,share=0.0}]"
    made = packed(f"fault=[{{kind='engine-off',at_s=45.0,{tail}}}]")
    assert int(made.parameters[0].timeline.burnout_ns) == 45_300_000_000


def test_burn_rate_speeds_up_all_that_flows() -> None:
    """With an engine at 1.1 times its flow, every rate is 1.1 times the nominal one at the same clock of the tables."""
    nominal, made = (
        pack_flight(load_scenario("nominal", [f"vehicle.stage.0.engine.mass_flow_factor={k}"]).scenario)
        for k in (1.0, 1.1)
    )
    rates = [*range(schedule.CG_RATE, schedule.TOTAL_MASS), schedule.MASS_FLOW]
    rates += [schedule.tank_column(k) + column for k in (0, 1) for column in (3, 4)]
    for clock_s in (3.3, 27.9, 51.0):
        a, b = table_of(nominal)(clock_s), table_of(made)(clock_s)
        np.testing.assert_allclose(b[rates], 1.1 * a[rates], rtol=1e-14)
        assert b[schedule.MASS_FLOW] > 0.0
        assert (np.delete(b, rates) == np.delete(a, rates)).all()


def test_an_engine_that_returns_burns_as_before() -> None:
    made = packed("fault=[{kind='engine-off',engine=0,at_s=30.0,until_s=39.0}]")
    delayed, nominal = table_of(made)(80.0), table_of(packed())(79.0)
    assert delayed[schedule.TOTAL_MASS] == pytest.approx(nominal[schedule.TOTAL_MASS], rel=1e-13)
    assert thrust_N(made, 80.0) == pytest.approx(9 * 400e3, rel=1e-12)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("{kind='engine-off',engine=9,at_s=1.0}", "fault.0.engine"),
        ("{kind='engine-off',engine=4,at_s=1.0,loss=0.5}", "kind = thrust-loss"),
        ("{kind='thrust-loss',engine=4,at_s=1.0}", "required key is missing"),
        ("{kind='engine-off',at_s=1.0,tail_off=[{time_s=1.0,share=0.0}]}", "tail_off"),
    ],
)
def test_wrong_faults_are_refused(fault: str, said: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(NINE, [f"fault=[{fault}]"])
    assert said in str(caught.value)


@pytest.mark.slow
def test_a_flight_with_an_engine_off_weighs_what_it_has_left() -> None:
    flight = fly(load_scenario(NINE, [OFF, "run.duration_s=30.0"]))
    spent_s = 20.0 + 10.0 * 8.0 / 9.0
    nominal = fly(load_scenario(NINE, ["run.duration_s=30.0"]))
    at = float(np.interp(spent_s, nominal.time_s("mass_kg"), nominal["mass_kg"]))
    assert flight["mass_kg"][-1] == pytest.approx(at, rel=1e-9)
    assert [e.name for e in flight.events].count("fault") == 1
    # from liftoff on, which is an event of the flight: the tables know its instant beforehand
    since = "fault=[{kind='engine-off',engine=8,at_s=0.5,since='liftoff'}]"
    flight = fly(load_scenario(NINE, [since, "run.duration_s=2.0"]))
    fault_s = next(e.time_s for e in flight.events if e.name == "fault")
    assert fault_s == flight.event_s("liftoff") + 0.5
    thrust_N, flow = (np.interp(fault_s + np.array([-0.01, 0.01]), flight.time_s(n), flight[n]) for n in LOST)
    assert thrust_N[1] / thrust_N[0] == pytest.approx(8.0 / 9.0, rel=2e-3)
    assert flow[1] / flow[0] == pytest.approx(8.0 / 9.0, rel=2e-3)  # which grows by 7 % a second
