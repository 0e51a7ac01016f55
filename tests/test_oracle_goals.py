"""Goals, fixed variables, prices, sensitivities and trade-offs of a case, against independent computations."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import control
import numpy as np
import optimise_kit as kit
import pytest
from scipy import optimize

from maxq import LoopValues, ScenarioError, point_of_matrices
from maxq.control.kernel.records import Array
from maxq.design.case.goals import GoalSection
from maxq.design.case.schema import Case, LoadedCase, read_case
from maxq.design.laws.schedule import UnsolvableError
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop
from maxq.design.margins.measure import margins
from maxq.design.margins.measured_loop import measure_loop
from maxq.design.model.vehicle_at import StabilityDerivatives
from maxq.design.optimise.at_nodes import make_problem
from maxq.design.optimise.pareto import aims_of, trade_off
from maxq.design.optimise.plants import make_plant, make_plants
from maxq.design.optimise.response_goals import function_of, registered
from maxq.design.optimise.robust import deviated, modes_off, ranges_of
from maxq.design.optimise.solve import solve
from maxq.design.optimise.way_out import prices
from maxq.design.quantities import STEPS
from maxq.design.verify.goal_checks import goal_value, transfers
from maxq.design.verify.outcome import judge_solution

FEW = ("nodes_s=[20.0,50.0]", "loop=sampled", "filter.structure=F2", "search.starts=1", "search.leaps=0")
TEMPLATES = (
    "goal=[{quantity='S',most_db=[[0.1,-20],[1,2],[10,4]]},{quantity='S',least_db=[[0.2,-9],[3,-2]]},"
    "{quantity='T',most_db=[[0.5,6],[5,0],[20,-20]]},{quantity='KS',most_db=[[0.5,-6],[30,-20]]},"
    "{quantity='L',least_db=[[0.05,20],[0.3,3]]},{quantity='L',most_db=[[15,-8],[45,-15]]}]"
)
MARGINS = (
    "goal=[{quantity='delay_ms',limit=30},{quantity='gain_up_db',limit=7},{quantity='gain_down_db',limit=8},"
    "{quantity='modulus_db',limit=-5,at_s=[50.0]}]"
)
STEP_GOALS = (
    "goal=[{quantity='overshoot_pct',limit=25,until_s=5},{quantity='settling_pct',after_s=3,limit=5,until_s=5},"
    "{quantity='gimbal_peak',limit=1.0,until_s=5},{quantity='offset_peak',limit=2.0,until_s=5}]"
)
SOFT = (
    "goal=[{quantity='first_mode_db',weight=1},{quantity='S',most_db=[[0.1,-20],[1,2],[10,4]],weight=2.5},"
    "{quantity='band',weight=0.3,function='band',limit=2.0}]"
).replace("'band',weight", "'function',weight")


def band(loop: LoopValues) -> float:
    """Return the mean square of |L| from 1 to 2 Hz."""
    inside = (loop.frequency_hz > 1.0) & (loop.frequency_hz < 2.0)
    return (loop.re[inside] ** 2 + loop.im[inside] ** 2).mean()


def problem_of(*overrides: str):
    both = (*overrides, *FEW)
    return make_problem(kit.case(*both).case, kit.plants(*both))


def is_of_goal(p, rows) -> Array:
    own = [k for k, kind in enumerate(p.kinds) if getattr(kind, "goal", None) is not None]
    return np.isin(rows.what, own)


@pytest.mark.parametrize("overrides", [(TEMPLATES,), (MARGINS,), (STEP_GOALS,), ("objective.kind=goals", SOFT)])
def test_gradients_and_curvature_of_goals_are_differences(overrides: tuple[str, ...]) -> None:
    """First derivatives of values, and second derivatives of gradients."""
    with registered({"band": band}):
        p = problem_of(*overrides)
        x, step = kit.some_point(p), 1e-5
        here = p.evaluate(x)
        mine = is_of_goal(p, here.rows)
        assert mine.sum() >= 7
        weights = np.where(mine, np.random.default_rng(3).uniform(0.0, 1.0, len(mine)), 0.0)
        ours = p.curvature(here, weights)
        for j in range(p.size):
            move = step * np.eye(p.size)[j]
            ahead, back = p.evaluate(x + move), p.evaluate(x - move)
            assert (ahead.rows.what == here.rows.what).all()
            slope = (ahead.rows.excess_db - back.rows.excess_db) / (2.0 * step)
            np.testing.assert_allclose(here.gradient[mine, j], slope[mine], rtol=1e-4, atol=2e-4)
            bend = weights @ (ahead.gradient - back.gradient) / (2.0 * step)
            np.testing.assert_allclose(ours[:, j], bend, rtol=1e-3, atol=1e-3 * np.abs(ours).max())


def loops_of(*overrides: str) -> tuple:
    p, both = problem_of(*overrides), (*overrides, *FEW)
    x, plants = kit.some_point(p), kit.plants(*both)
    loops = [Loop(plant.path, law) for plant, law in zip(plants.each, p.law.controllers(x), strict=True)]
    return p, p.evaluate(x, complete=True), loops


def test_templates_are_assessed_as_by_python_control() -> None:
    """|S|, |T|, |KS| and |L| of python-control: equal at the worst frequency, and nowhere else worse."""
    p, here, loops = loops_of(TEMPLATES)
    goals = kit.case(TEMPLATES, *FEW).case.goal
    grid_hz = np.geomspace(0.05, 49.9, 1200)
    for k, loop in enumerate(loops):
        what = len(p.criteria) - len(goals) + np.arange(len(goals))
        rows = [here.rows.taken((here.rows.what == w) & (here.rows.plant == k)) for w in what]
        worst = [int(np.argmax(row.excess_db)) for row in rows]
        hz = np.append(grid_hz, [row.frequency_hz[i] for row, i in zip(rows, worst, strict=True)])
        plant, z = loop.fixed.measured(("rate_radps",)), np.exp(2j * np.pi * hz * loop.sample_s)
        path = control.StateSpace(plant.a, plant.b, plant.c, plant.d, loop.sample_s)(z)
        value = loop.to_state_space()(z)
        whole = {"S": 1 / (1 + value), "T": value / (1 + value), "L": value, "KS": value / path / (1 + value)}
        for n, goal in enumerate(goals):
            points, sign = goal.template
            bound = np.interp(np.log(hz), np.log([f for f, _ in points]), [db for _, db in points])
            theirs = sign * (20.0 * np.log10(np.abs(whole[goal.quantity])) - bound)
            ours, inside = rows[n].excess_db[worst[n]], (hz >= points[0][0]) & (hz <= points[-1][0])
            assert ours == pytest.approx(theirs[len(grid_hz) + n], abs=1e-4), goal.quantity
            assert ours > theirs[inside].max() - 1e-4, goal.quantity


def test_step_goals_are_those_of_python_control() -> None:
    """Overshoot, deviation, gimbal command and attitude per offset, from responses of interconnected systems."""
    p, here, loops = loops_of(STEP_GOALS)
    goals = kit.case(STEP_GOALS, *FEW).case.goal
    for k, loop in enumerate(loops):
        inputs, period = loop.law.inputs, loop.sample_s
        path, law = loop.fixed.measured(inputs), loop.law.state_space()
        vehicle = control.StateSpace(path.a, path.b, path.c, path.d, period)
        own = control.StateSpace(law.a, law.b, law.c, law.d, period)
        only = np.zeros((2, 1))
        only[inputs.index("angle_rad")] = 1.0  # the commanded attitude is subtracted from the measured one
        by_command = own * control.ss([], [], [], only, period)
        angle = control.feedback(vehicle, own)[inputs.index("angle_rad"), 0]
        sensitivity = control.feedback(control.ss([], [], [], [[1.0]], period), own * vehicle)
        time_s = np.arange(0.0, 5.0 + 1e-9, period)
        y, gimbal, offset = (
            control.forced_response(system, time_s, 1.0).outputs
            for system in (angle * by_command, sensitivity * by_command, angle)
        )
        late = time_s >= 3.0 - 1e-9
        theirs = {
            "overshoot_pct": 100.0 * (y.max() - 1.0),
            "settling_pct": 100.0 * np.abs(y[late] - 1.0).max(),
            "gimbal_peak": np.abs(gimbal).max(),
            "offset_peak": np.abs(offset).max(),
        }
        for n, goal in enumerate(goals):
            what = len(p.kinds) - len(goals) + n
            ours = here.rows.value[(here.rows.what == what) & (here.rows.plant == k)].max()
            assert ours == pytest.approx(theirs[goal.quantity], rel=1e-6), goal.quantity
            judged = type("Judged", (), {"loop": loop, "margins": margins(loop), "time_s": 0.0})()
            assert goal_value(judged, goal) == pytest.approx(theirs[goal.quantity], rel=1e-9)
    assert {goal.quantity for goal in goals} == set(STEPS)


@pytest.fixture(scope="module")
def preset():
    """Return the case that minimises the peak of mode 1, at two points, and its solution."""
    loaded = kit.case(*FEW)
    return loaded, solve(loaded, kit.plants(*FEW))


def test_the_published_problem_is_one_set_of_goals(preset: tuple) -> None:
    """Objective and limits as goals give the optimum of the preset to 1e-6 dB, by the same number of evaluations."""
    goals = (
        "objective.kind=goals",
        "goal=[{quantity='first_mode_db',weight=1},{quantity='phase_margin_deg',limit=30},"
        "{quantity='gain_margin_db',limit=6},{quantity='second_mode_db',limit=-6}]",
        "limits.without=['phase_margin_deg','gain_margin_db','second_mode_db']",
    )
    found = solve(kit.case(*goals, *FEW), kit.plants(*goals, *FEW))
    assert found.objective_db == pytest.approx(preset[1].objective_db, abs=1e-6)
    assert found.feasible
    outcome = judge_solution(kit.case(*goals, *FEW), found)
    assert [check.key for check in outcome.found if check.key.startswith("goal")] == ["goal_1", "goal_2", "goal_3"]
    assert all(check.passed for check in outcome.found)


def test_a_weighted_sum_with_a_template_is_no_better_by_another_optimiser() -> None:
    """SciPy's Nelder-Mead, with a penalty for missed limits, finds nothing better."""
    goals = (
        "objective.kind=goals",
        "goal=[{quantity='first_mode_db',weight=1},{quantity='modulus_db',weight=2,at_s=[50.0]},"
        "{quantity='T',most_db=[[0.5,4],[3,1],[8,-6]]}]",
    )
    loaded, plants = kit.case(*goals, *FEW), kit.plants(*goals, *FEW)
    s = solve(loaded, plants)
    assert s.status == "optimal"
    outcome = judge_solution(loaded, s)
    assert all(check.passed for check in outcome.found)
    (template,) = (check for check in outcome.found if check.key == "goal_1")
    assert template.values.max() == pytest.approx(0.0, abs=2e-4)  # on the template, as judged on a grid
    p = make_problem(loaded.case, plants)
    worst = [j.margins.modulus for j in outcome.judged if j.time_s == 50.0]
    modulus_db = 20.0 * math.log10(worst[0])
    assert s.levels_db[1] == pytest.approx(-2.0 * modulus_db, abs=1e-3)
    assert s.objective_db == pytest.approx(s.levels_db.sum())

    def cost(x: Array) -> float:
        at = p.evaluate(np.clip(x, p.lower, p.upper))
        return at.objective_db + 50.0 * at.violation_db + 1e3 * at.unstable

    found = optimize.minimize(cost, s.variables, method="Nelder-Mead", options={"maxfev": 120})
    assert found.fun > s.objective_db - 1e-3


def test_fixed_gains_and_fixed_filters_reach_the_same_optimum(preset: tuple) -> None:
    """With the gains of the optimum, the filter is found again, and the reverse. A changed value is kept."""
    loaded, s = preset
    names, p = make_problem(loaded.case, kit.plants(*FEW)).law.names, kit.plants(*FEW)
    gains = [f"{{name='{n}',value={math.exp(x)!r}}}" for n, x in zip(names, s.variables, strict=True) if n[:2] == "k_"]
    fixed = solve(kit.case(f"variable=[{','.join(gains)}]", *FEW), p)
    assert fixed.objective_db == pytest.approx(s.objective_db, abs=1e-4)
    zeta = next(x for n, x in zip(names, s.variables, strict=True) if n == "quadratic[0].zero_zeta")
    off = solve(kit.case(f"variable=[{{name='quadratic[0].zero_zeta',value={float(zeta) + 0.05!r}}}]", *FEW), p)
    assert off.law.record()["filter"]["quadratic"][0]["zero_zeta"] == pytest.approx(zeta + 0.05, abs=1e-12)
    # the price of the bound at which the damping ratio was, per 0.1
    (bound,) = (b for b in s.bounds if b.variable == "quadratic[0].zero_zeta")
    assert off.objective_db - s.objective_db > 0.3 * 0.05 * bound.multiplier
    with pytest.raises(UnsolvableError, match=r"variable.name = 'k_q'.*allowed are gains, filter, blend, quadratic"):
        solve(kit.case("variable=[{name='k_q',value=1.0}]", *FEW), p)


def test_values_of_a_start_design_are_fixed_in_its_own_form() -> None:
    """All variables from a design: the solution is that design."""
    given = ("variable=[{name='gains',from_start=true},{name='filter',from_start=true}]", *FEW[:2], *FEW[3:])
    loaded = kit.case("search.start_design=ksr3-linear", *given)
    assert loaded.start is not None
    s = solve(loaded, kit.plants(*FEW[:2], *FEW[3:]))
    own = loaded.start.filter
    found = s.law.record()
    assert found["filter"]["prewarp_hz"] == own.prewarp_hz
    for ours, theirs in zip(found["filter"]["quadratic"], own.quadratic, strict=True):
        assert ours["zero_hz"] == pytest.approx(theirs.zero_hz, rel=1e-12)
        assert ours["pole_zeta"] == pytest.approx(theirs.pole_zeta, rel=1e-12)


def test_prices_are_what_limits_cost(preset: tuple) -> None:
    """The optimum moves by the price when a limit is moved by 0.05 dB either way."""
    loaded, s = preset
    dearest = prices(s)[0]
    keys: dict[str, Callable[[float], str]] = {
        "rigid-body damping ratio": lambda db: f"limits.rigid_zeta={0.7 * 10 ** (db / 20.0)!r}",
        "rigid-body frequency": lambda db: f"limits.rigid_hz={0.5 * 10 ** (db / 20.0)!r}",
        "phase margin": lambda db: f"limits.phase_margin_deg={30.0 + 5.0 * db!r}",
        "peak of mode 2": lambda db: f"limits.second_mode_db={-6.0 - db!r}",
    }
    moved = [solve(kit.case(keys[dearest.what](db), *FEW), kit.plants(*FEW)).objective_db for db in (-0.05, 0.05)]
    assert (moved[1] - moved[0]) / 0.1 == pytest.approx(dearest.gains_db, rel=0.03)
    assert dearest.gains_db > 0.1
    assert dearest.by in ("5 deg", "11 %", "12 %", "1 dB")
    del loaded


def test_sensitivities_are_differences_of_margins(preset: tuple) -> None:
    """+1 % of each gain and frequency, and +0.01 of each damping ratio, measured by the margins engine."""
    loaded, s = preset
    plants = kit.plants(*FEW)
    p = make_problem(loaded.case, plants)
    by_name = {one.what: one for one in s.sensitivities}
    assert s.sensitivities[0].what == "peak of mode 1"
    one = by_name["phase margin"]
    k = next(k for k, plant in enumerate(plants.each) if plant.node.time_s == one.time_s)

    def phase_deg(x: Array) -> float:
        return margins(Loop(plants.each[k].path, p.law.controllers(x)[k])).phase_deg.value

    assert phase_deg(s.variables) == pytest.approx(one.value, abs=1e-3)
    for j, name in enumerate(p.law.names):
        move = np.eye(p.size)[j] * (math.log(1.01) if name[:2] == "k_" or name.endswith("_hz") else 0.01)
        change = (phase_deg(s.variables + 0.1 * move) - phase_deg(s.variables - 0.1 * move)) / 0.2
        assert one.by[name] == pytest.approx(change, rel=0.02, abs=2e-3), name
    assert one.changes_in == "deg"


@pytest.mark.long
def test_a_trade_off_is_traced_between_its_ends(preset: tuple) -> None:
    """The curve falls, its slope is that of neighbouring optima, and its first end is the optimum of the peak."""
    aims = aims_of("peak,margin")
    plants, count = kit.plants(*FEW), 4
    points = trade_off(preset[0], plants, aims, count=count)
    peaks, margins_db = np.array([point.values_db for point in points]).T
    assert len(points) == count
    assert peaks[0] == pytest.approx(preset[1].objective_db, abs=1e-4)
    assert (np.diff(peaks) > 0.0).all()
    np.testing.assert_allclose(np.diff(margins_db, 2), 0.0, atol=1e-6)  # equal steps
    few = ("search.starts=1", "search.leaps=0")
    ends = [
        f"limits.modulus_db={-(margins_db[2] + by)!r}".replace("np.float64(", "").rstrip(")") for by in (-0.02, 0.02)
    ]
    law = [points[2].solution.law]
    beside = [solve(kit.case(end, *few, *FEW[:3]), plants, law).objective_db for end in ends]
    sides = (beside[1] - peaks[2]) / 0.02, (peaks[2] - beside[0]) / 0.02
    assert min(sides) - 0.05 < points[2].slope < max(sides) + 0.05
    with pytest.raises(ValueError, match="allowed are two of peak, margin, load"):
        aims_of("peak,speed")


@pytest.mark.long
def test_a_tutorial_of_a_tuning_tool_is_met() -> None:
    """The digital motion control system of MATLAB's tuning examples, set up from its documentation.

    Two inertias on a flexible shaft (mode near 350 rad/s), with a response time of 0.5 s and minimum overshoot, and the
    default margins of looptune: 7.6 dB and 45 deg. The angle is that of the load; its rate is measured too. The period
    of 2 ms, 5 % of overshoot and 2 % after 0.5 s are ours. (Tuning of a Digital Motion Control System; Robust Tuning of
    Positioning System: inertias, damping and stiffness.)
    """
    j1, j2, b, b12, k = 1e-6, 1.15e-7, 1e-6, 5e-7, 0.013
    a = [[0, 1, 0, 0], [-k / j1, -(b + b12) / j1, k / j1, b12 / j1]]
    a += [[0, 0, 0, 1], [k / j2, b12 / j2, -k / j2, -(b + b12) / j2]]
    assert np.sqrt(k * (1 / j1 + 1 / j2)) == pytest.approx(355.0, abs=0.5)  # "near 350 rad/s"
    system = point_of_matrices(a, [[0], [1e-3 / j1], [0], [0]], [[0, 0, 0, 1]], sample_s=0.002)  # per mN m
    rigid = StabilityDerivatives(0.0, 0.0, 0.0, 1e-3 / (j1 + j2), -2 * b / (j1 + j2))
    given = {
        "points": "matrices",
        "nodes_s": (0.0,),
        "between_nodes": "ignore",
        "filter": {"structure": "F2", "prewarp_hz": 20.0, "bounds": {"zero_hz": (1.0, 200.0), "pole_hz": (1.0, 200.0)}},
        "objective": {"kind": "least-margin"},
        "search": {"starts": 1, "leaps": 0},
        "limits": {
            "without": ("rigid_hz", "rigid_zeta", "second_mode_db"),
            "gain_margin_db": 7.6,
            "phase_margin_deg": 45.0,
        },
        "goal": (
            {"quantity": "overshoot_pct", "limit": 5.0, "until_s": 1.5},
            {"quantity": "settling_pct", "limit": 2.0, "after_s": 0.5, "until_s": 1.5},
        ),
    }
    loaded = LoadedCase(Case.model_validate(given), "motion", None)
    plants = make_plants([make_plant(dataclasses.replace(system, of_rigid=rigid), loaded.case)])
    s = solve(loaded, plants)
    assert s.feasible
    found = measure_loop(Loop(plants.each[0].path, s.law.at(0.0, "pitch", 0.002)))
    assert found.margins.gain_db > 7.6
    assert found.margins.phase_deg.value > 45.0
    overshoot, settled = (goal_value(found, goal) for goal in loaded.case.goal)
    assert overshoot <= 5.0 + 1e-3
    assert settled <= 2.0 + 1e-3
    assert 5.0 < 2.0 * math.pi * found.margins.crossover_hz < 10.0  # bandwidth of about 5 rad/s


def test_a_goal_holds_for_dispersed_plants_if_it_says_so() -> None:
    """Values of a template and of a margin at a dispersed vehicle are those of its own loop."""
    goals = "goal=[{quantity='S',most_db=[[0.5,-10],[5,2]],dispersed=%s},{quantity='delay_ms',limit=30,dispersed=%s}]"
    for told in ("true", "false"):
        loaded = kit.case(goals % (told, told), "robust={}", *FEW)
        case, node = loaded.case, kit.plants(*FEW).each[0].flown
        ranges = ranges_of(loaded, [node])
        assert ranges is not None
        off = deviated(node, ranges, modes_off(node, ranges, 1))
        plants = make_plants([make_plant(node, case), make_plant(off, case, dispersed=True)])
        p = make_problem(case, plants)
        x = kit.some_point(p)
        rows = p.evaluate(x, complete=True).rows
        law = p.law.controllers(x)[1]
        judged = measure_loop(Loop(fixed_path(off), law))
        of_goal = [k for k, kind in enumerate(p.kinds) if getattr(kind, "goal", None) is not None]
        assert len(of_goal) == 2
        for k, goal in zip(of_goal, case.goal, strict=True):
            mine = rows.excess_db[(rows.what == k) & (rows.plant == 1)]
            assert (len(mine) > 0) == (told == "true")
            if told == "true" and goal.quantity == "S":
                assert mine.max() == pytest.approx(goal_value(judged, goal), abs=2e-3)
            elif told == "true":
                value_ms = rows.value[(rows.what == k) & (rows.plant == 1)].min()
                assert value_ms == pytest.approx(goal_value(judged, goal), rel=1e-4)


@pytest.mark.parametrize(
    ("goal", "said"),
    [
        ("{quantity='S'}", "has no template, or two"),
        ("{quantity='S',most_db=[[1,0],[0.5,3]]}", "does not rise in frequency"),
        ("{quantity='gain_margin_db'}", "required key is missing: the goal is hard"),
        ("{quantity='modulus_db',weight=1.0}", "does not include the soft goals"),
        ("{quantity='settling_pct',limit=5}", "required key is missing: the quantity is settling_pct"),
        ("{quantity='q_alpha_Padeg',limit=5}", "is hard, or not at all operating points"),
        ("{quantity='overshoot_pct',limit=-5}", "is not positive"),
    ],
)
def test_goals_without_a_meaning_are_refused(goal: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        kit.case(f"goal=[{goal}]", "loop=sampled")


def test_a_function_is_named_by_its_file(tmp_path: Path) -> None:
    (tmp_path / "goals.py").write_text("def at_1_hz(loop):\n    return loop.gain_db[0]\n")
    case = 'scenario = "nominal"\n[[goal]]\nquantity = "function"\nfunction = "goals.py:at_1_hz"\n'
    (tmp_path / "case.toml").write_text(f'{case}limit = 3.0\nunit = "dB"\n')
    (goal,) = read_case(tmp_path / "case.toml").case.goal
    assert goal.function == f"{tmp_path / 'goals.py'}:at_1_hz"
    loop = LoopValues(0.0, np.array([1.0]), np.array([0.0]), np.array([-2.0]))
    assert function_of(goal.function)(loop) == pytest.approx(20.0 * math.log10(2.0))
    assert loop.phase_rad == pytest.approx(-0.5 * math.pi)
    assert loop.closed_db == pytest.approx(20.0 * math.log10(2.0 / math.sqrt(5.0)))
    for name, said in (("goals.py:none", "no such file"), (f"{tmp_path / 'goals.py'}:none", "no function none")):
        with pytest.raises(ValueError, match=said):
            function_of(name)


def test_a_step_goal_needs_the_sampled_loop() -> None:
    with pytest.raises(ScenarioError, match="which only the sampled loop has"):
        kit.case("goal=[{quantity='overshoot_pct',limit=5}]")
    assert GoalSection(quantity="KS", most_db=((1.0, 0.0), (2.0, 1.0))).about.label == "|KS| over its template"
    assert set(transfers(loops_of()[2][0], np.array([1.0]))) == {"S", "T", "KS", "L"}
