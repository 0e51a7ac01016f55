"""Bending filters that change during the flight agree with these oracles.

| case | oracle |
|---|---|
| kernel at constant parameters | python-control's prewarped transfer function, SciPy's `lfilter` |
| kernel with moving parameters | SciPy's `solve_ivp` on the continuous equations; order 2 in the period |
| constant input, any change | the input, to the last bit |
| no input, any change | the energy of the integrators does not grow |
| law at an instant, held design, certificate's loop | python-control, with parameters by `numpy.interp` |
| variables of the optimiser, with their derivatives | NumPy in complex arithmetic; differences |
| change of the response by the motion | the continuous equations, demodulated |
| separation: the moving filter fades out, frozen | `lfilter` on the response so far |
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import control
import numpy as np
import optimise_kit as kit
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from maxq.control.computer import ComputerState, build_computer, computer_tick, start_computer, take_over
from maxq.control.filter_schedule import (
    FilterSchedule,
    MovingFilterState,
    make_moving_filter,
    move_filter,
    moving_sample,
    settle_moving,
    start_moving_filter,
)
from maxq.control.filters import BendingFilter, FirstOrderSection, QuadraticSection
from maxq.control.kernel.records import Array, blank, pack
from maxq.control.kernel.tables import Pool
from maxq.control.laws.pd import GainSchedule, gains_table
from maxq.control.loop_filters import make_loop_filters
from maxq.design.case.schema import read_case
from maxq.design.laws.design_file import design_text
from maxq.design.laws.pd import PdDesign
from maxq.design.laws.pd_variables import PdVariables
from maxq.design.loop.filter_motion import change_by_motion, moves_near
from maxq.design.operating_points import nodes
from maxq.design.optimise.at_nodes import make_problem
from maxq.design.optimise.solve import solve
from maxq.design.verify.judging import Wanted, checks, judge, motion_checks
from maxq.design.verify.linear import MarginCase, MarginStudy, margin_requirements
from maxq.design.verify.suite import LinearMargins
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.scenario.schema_design import Design, FilterSection
from maxq.tools import simdesign
from maxq.tools.design.report import design_table

PREWARP_HZ = 9.0
FIRST = BendingFilter(
    (QuadraticSection(9.0, 0.2, 7.0, 0.6), QuadraticSection(22.0, 0.1, 12.0, 0.9)), (FirstOrderSection(30.0, 5.0),)
)
LAST = BendingFilter(
    (QuadraticSection(14.0, 0.1, 9.0, 0.5), QuadraticSection(30.0, 0.2, 20.0, 0.8)), (FirstOrderSection(20.0, 8.0),)
)
RISING = FilterSchedule((1.0, 3.0), (FIRST, LAST))


class Moving:
    """A moving filter in one axis, processed sample by sample."""

    def __init__(self, schedule: FilterSchedule, sample_s: float) -> None:
        pool = Pool()
        self.record = pack([make_moving_filter(pool, schedule, sample_s, "prewarped", PREWARP_HZ)])[0]
        self.pool, self.state = pool.array(), blank(MovingFilterState)[0]
        start_moving_filter(self.state)

    def __call__(self, at: Array, given: Array) -> Array:
        out = []
        for x, value in zip(at, given, strict=True):
            move_filter(self.record, self.pool, self.state, x)
            out.append(moving_sample(self.record, self.state, 0, value))
        return np.array(out)


def transfer_function(filter_: BendingFilter) -> control.TransferFunction:
    s, out = control.tf("s"), control.tf(1, 1)
    for q in filter_.quadratic:
        z, p = 2 * np.pi * q.zero_hz, 2 * np.pi * q.pole_hz
        out *= (s**2 / z**2 + 2 * q.zero_zeta * s / z + 1) / (s**2 / p**2 + 2 * q.pole_zeta * s / p + 1)
    for f in filter_.first_order:
        out *= (s / (2 * np.pi * f.zero_hz) + 1) / (s / (2 * np.pi * f.pole_hz) + 1)
    return out


def sampled(filter_: BendingFilter, sample_s: float) -> control.TransferFunction:
    return control.sample_system(
        transfer_function(filter_), sample_s, "tustin", prewarp_frequency=2 * np.pi * PREWARP_HZ
    )


def between(at: float) -> BendingFilter:
    """Return the filter of `RISING` at a value, interpolated by NumPy."""

    def mixed(a: Any, b: Any, key: str) -> float:
        return float(np.interp(at, [1.0, 3.0], [getattr(a, key), getattr(b, key)]))

    keys = ("zero_hz", "zero_zeta", "pole_hz", "pole_zeta")
    quadratic = [[mixed(a, b, k) for k in keys] for a, b in zip(FIRST.quadratic, LAST.quadratic, strict=True)]
    first_order = [
        [mixed(a, b, k) for k in keys[::2]] for a, b in zip(FIRST.first_order, LAST.first_order, strict=True)
    ]
    return BendingFilter(
        tuple(QuadraticSection(*row) for row in quadratic), tuple(FirstOrderSection(*row) for row in first_order)
    )


@pytest.mark.parametrize("at", [0.5, 1.7, 4.0])
def test_a_filter_at_rest_has_the_response_of_python_control(at: float) -> None:
    given = np.random.default_rng(1).standard_normal(200)
    found = Moving(RISING, 0.01)(np.full(200, at), given)
    (num,), (den,) = (part[0] for part in (sampled(between(at), 0.01).num, sampled(between(at), 0.01).den))
    np.testing.assert_allclose(found, lfilter(num, den, given), rtol=1e-9, atol=1e-9)


def derivative(t: float, x: Array, drive: Any) -> tuple[Array, float]:
    """Return the continuous equations at time t: rates of the states, and output."""
    filter_, u, dx = between(t), drive(t), []
    for i, q in enumerate(filter_.quadratic):
        w, r = 2 * np.pi * q.pole_hz, q.pole_hz / q.zero_hz
        x1, x2 = x[2 * i], x[2 * i + 1]
        e = u - 2 * q.pole_zeta * x1 - x2
        dx += [w * e, w * x1]
        u = r * r * e + 2 * q.zero_zeta * r * x1 + x2
    for i, f in enumerate(filter_.first_order, 2 * len(filter_.quadratic)):
        dx.append(2 * np.pi * f.pole_hz * (u - x[i]))
        u = x[i] + f.pole_hz / f.zero_hz * (u - x[i])
    return np.array(dx), u


def test_a_moving_filter_follows_the_continuous_equations_with_order_two() -> None:
    """The error is of order two in the period; parameters move over 2 s instead of a mode's minute."""

    def drive(t: float) -> float:
        return float(np.sin(2 * np.pi * 3.0 * t) ** 3)

    end_s, size = 3.5, 2 * len(FIRST.quadratic) + len(FIRST.first_order)
    true = solve_ivp(
        lambda t, x: derivative(t, x, drive)[0], (0.0, end_s), np.zeros(size), rtol=1e-9, atol=1e-10, dense_output=True
    )
    errors = []
    for sample_s in (0.004, 0.002):
        time = np.arange(0.0, end_s, sample_s)
        pool = Pool()
        moving = Moving(RISING, sample_s)
        moving.record = pack([make_moving_filter(pool, RISING, sample_s, "bilinear", None)])[0]
        moving.pool = pool.array()
        found = moving(time, np.array([drive(t) for t in time]))
        at = np.flatnonzero(time > 1.0)[:: round(0.04 / sample_s)]
        wanted = np.array([derivative(time[k], true.sol(time[k]), drive)[1] for k in at])
        errors.append(float(np.abs(found[at] - wanted).max()))
    assert errors[0] < 0.02
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_no_change_alters_the_output_at_a_constant_input() -> None:
    moving = Moving(RISING, 0.01)
    settle_moving(moving.record, moving.state, 0, 0.7)
    jumps = np.random.default_rng(2).uniform(0.0, 4.0, 300)
    assert (moving(jumps, np.full(300, 0.7)) == 0.7).all()


def test_no_change_makes_energy() -> None:
    moving = Moving(RISING, 0.01)
    moving(np.full(50, 1.0), np.random.default_rng(3).standard_normal(50))
    energies = []
    for at in np.random.default_rng(4).uniform(0.0, 4.0, 200):
        before = moving.state.memory[0].copy()
        moving(np.array([at]), np.zeros(1))
        # of the first section, which has no input
        energies.append(np.sum(moving.state.memory[0, 0] ** 2) / np.sum(before[0] ** 2))
    assert max(energies) <= 1.0 + 1e-12
    assert np.prod(energies) < 1e-3


class Flown:
    """A computer with ideal converters, ticked with rotations of the gyro about pitch and yaw."""

    def __init__(self, **filters: Any) -> None:
        self.pool = Pool()
        self.computer = self.built(**filters)
        self.state, self.time_s = blank(ComputerState)[0], 0.0
        start_computer(self.computer, self.pool.array(), self.state, 0.0)

    def built(self, schedule: FilterSchedule | None = None, **more: Any) -> Any:
        moving = None
        if schedule is not None:
            moving = make_moving_filter(self.pool, schedule, 0.01, "prewarped", PREWARP_HZ)
        gains = gains_table(GainSchedule([0.0], [1.2], [0.5]))
        return pack(
            [
                build_computer(
                    self.pool, sample_ns=10_000_000, attitude="rate-integral", gains=gains, moving_filter=moving, **more
                )
            ]
        )[0]

    def __call__(self, turns: Array) -> Array:
        pool, out, still = self.pool.array(), [], np.zeros(3, np.int64)
        for turn in turns:
            self.time_s += 0.01
            both = np.array([0.0, turn, -0.5 * turn])
            computer_tick(
                self.computer, pool, self.state, self.time_s, both, np.zeros(3), still, np.zeros(2), still[:2]
            )
            out.append(self.state.command_rad.copy())
        return np.array(out)


def test_the_computer_flies_the_schedule_and_fades_it_out_frozen() -> None:
    """After the separation, the filter keeps its last parameters and fades out over 20 samples."""
    schedule, n, cut = FilterSchedule((0.5, 1.5), (FIRST, LAST)), 20, 100
    flown = Flown(schedule=schedule)
    turns = 0.01 * np.random.default_rng(5).standard_normal(200)
    law = -1.2 * np.cumsum(turns) - 0.5 * turns / 0.01
    found = flown(turns[:cut])
    time = 0.01 * np.arange(1, 201)
    alone = Moving(schedule, 0.01)
    np.testing.assert_allclose(found[:, 0], alone(time[:cut], law[:cut]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found[:, 1], -0.5 * found[:, 0], rtol=1e-9, atol=1e-12)
    after = flown.built(loops=make_loop_filters((), n))
    take_over(flown.computer, after, flown.state)
    flown.computer = after
    found = flown(turns[cut:])[:, 0]
    old = alone(np.full(200 - cut, time[cut - 1]), law[cut:])
    share = np.clip(np.arange(1, 200 - cut + 1) / (n + 1.0), 0.0, 1.0)
    np.testing.assert_allclose(found, old + share * (law[cut:] - old), rtol=1e-9, atol=1e-10)
    # and a stage with a schedule begins settled
    before = Flown()
    before(np.array([0.02, 0.0]))
    later = before.built(schedule=schedule)
    take_over(before.computer, later, before.state)
    before.computer = later
    still = before(np.zeros(60))[:, 0]
    np.testing.assert_allclose(still, -1.2 * 0.02, rtol=1e-12)


POINT = {"zero_hz": 9.0, "zero_zeta": 0.2, "pole_hz": 7.0, "pole_zeta": 0.6}
ROWS = "[{time_s = 2.0, k_p = 1.1, k_d_s = 0.47}, {time_s = 50.0, k_p = 0.7, k_d_s = 0.37}]"


def section(*points: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"structure": "F2", "prewarp_hz": 9.0, "schedule": points, **more}


def design(filter_: dict[str, Any], over: str = "time_s", **more: Any) -> Design:
    gains = {"table": {over: (0.0, 50.0), "k_p": (1.2, 0.8), "k_d_s": (0.5, 0.4)}}
    return Design.model_validate({"schema": 2, "gains": gains, "filter": filter_, **more})


MOVING = section(
    {"time_s": 10.0, "quadratic": (POINT,)},
    {"time_s": 40.0, "quadratic": (POINT | {"zero_hz": 15.0, "pole_zeta": 0.3},)},
)


def test_the_law_of_an_instant_is_that_of_python_control() -> None:
    own = design(MOVING)
    law = PdDesign.of(own)
    hz = np.geomspace(0.1, 45.0, 20)
    for at, zero_hz, pole_zeta in ((0.0, 9.0, 0.6), (20.0, 11.0, 0.5), (60.0, 15.0, 0.3)):
        wanted = sampled(BendingFilter((QuadraticSection(zero_hz, 0.2, 7.0, pole_zeta),)), 0.01)
        np.testing.assert_allclose(
            law.at(at, "yaw", 0.01).filter_response(hz), wanted(np.exp(2j * np.pi * hz * 0.01)), rtol=1e-9
        )
        held = PdDesign.frozen(own, at)
        assert held.filter.schedule == ()
        assert held.filter.quadratic[0].zero_hz == pytest.approx(zero_hz, rel=1e-14)
        assert held.filter.quadratic[0].pole_zeta == pytest.approx(pole_zeta, rel=1e-14)
    again = Design.model_validate({"schema": 2, **law.tables()})
    assert again.filter == own.filter
    assert law.record()["filter"]["schedule"][1]["time_s"] == 40.0


def test_a_schedule_is_written_and_read_again(tmp_path: Path) -> None:
    from maxq.design.laws.design_file import load_design  # noqa: PLC0415  # one test needs it

    constant = {"structure": "F2", "prewarp_hz": 9.0, "quadratic": (POINT,)}
    own = design(MOVING, vehicle="KSR-III (reconstruction)", loop_filters={"rate": constant})
    text = design_text(own)
    assert "= []" not in text
    (tmp_path / "d.toml").write_text(text)
    again = load_design(tmp_path / "d.toml")
    assert (again.filter, again.loop_filters) == (own.filter, own.loop_filters)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (section({"quadratic": (POINT,)}), "has no variable.*one of time_s, speed_mps"),
        (section({"time_s": 1.0, "mass_kg": 2.0, "quadratic": (POINT,)}), "has time_s and mass_kg"),
        (section({"time_s": 1.0, "quadratic": (POINT,)}, {"time_s": 1.0, "quadratic": (POINT,)}), "does not rise"),
        (
            section({"time_s": 1.0, "quadratic": (POINT,)}, {"mass_kg": 2.0, "quadratic": (POINT,)}),
            "first point is over time_s",
        ),
        (section({"time_s": 1.0}), "0 sections do not make F2.*1 sections.*schedule"),
        (
            section({"time_s": 1.0, "quadratic": (POINT,)}, {"time_s": 2.0}),
            "has 0 sections, the first point 1.*'schedule', 1, 'quadratic'",
        ),
        (section({"time_s": 1.0, "quadratic": (POINT,)}, quadratic=(POINT,)), "cannot be combined with schedule"),
        (section({"time_s": 1.0, "quadratic": (POINT,)}, discretization="zoh"), "not available for a schedule"),
        (section({"time_s": 1.0, "quadratic": (POINT | {"pole_hz": -1.0},)}), "makes an unstable pole"),
    ],
)
def test_wrong_schedules(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError) as refused:
        FilterSection.model_validate(given)
    assert re.search(words, str(refused.value.errors()))


def test_a_zero_keeps_its_half_plane_and_the_variable_is_that_of_the_gains() -> None:
    ends = [{"zero_hz": z, "pole_hz": 5.0} for z in (9.0, -9.0)]
    points = [{"time_s": float(n), "first_order": (end,)} for n, end in enumerate(ends)]
    with pytest.raises(ValidationError, match=r"changes the half plane of the zero"):
        FilterSection.model_validate({"structure": "sections", "prewarp_hz": 9.0, "schedule": tuple(points)})
    with pytest.raises(ValidationError, match=r"the gains are over speed_mps"):
        design(MOVING, over="speed_mps")
    with pytest.raises(ValidationError, match=r"the filter of a loop is constant"):
        design({"structure": "none"}, loop_filters={"rate": MOVING})


@pytest.mark.slow  # two flights
def test_a_schedule_of_equal_filters_flies_like_the_constant_one() -> None:
    """Only rounding differs, after which the gimbal's converter may take the neighbouring step."""
    first = {"zero_hz": 9.3, "zero_zeta": 0.3, "pole_hz": 6.5, "pole_zeta": 0.6}
    text = "{" + ", ".join(f"{key} = {value}" for key, value in first.items()) + "}"
    common = ["run.duration_s=20", "wind.speed_mps=8.0", "wind.from_deg=200", "design.filter.structure=F2"]
    forms = (
        [f"design.filter.quadratic=[{text}]"],
        [
            "design.filter.quadratic=[]",
            f"design.filter.schedule=[{{time_s=5.0, quadratic=[{text}]}}, {{time_s=12.0, quadratic=[{text}]}}]",
        ],
    )
    constant, moving = (fly(load_scenario("nominal", [*common, *form])) for form in forms)
    for channel in ("filtered_pitch_deg", "filtered_yaw_deg"):
        np.testing.assert_allclose(moving[channel], constant[channel], rtol=0, atol=0.005)
        assert np.abs(constant[channel]).max() > 0.1


# --- the transient of the change


def demodulated(schedule_s: float, hz: float) -> complex:
    """Return the response of the continuous equations to exp(2 pi i hz t) in the middle of a change."""
    start, middle = 2.0 - 0.5 * schedule_s, 2.0

    def at(t: float) -> float:  # of RISING, which changes from 1 to 3
        return 1.0 + (t - start) / schedule_s * 2.0

    def drive(t: float) -> complex:
        return complex(np.exp(2j * np.pi * hz * t))

    def rates(t: float, x: Array) -> Array:
        return derivative(at(t), x, lambda _: drive(t))[0]

    size = 2 * len(FIRST.quadratic) + len(FIRST.first_order)
    found = solve_ivp(rates, (middle - 1.0, middle), np.zeros(size, complex), rtol=1e-8, atol=1e-10)
    return derivative(at(middle), found.y[:, -1], lambda _: drive(middle))[1] / drive(middle)


@pytest.mark.parametrize("hz", [2.0, 11.0])
def test_the_change_of_the_response_is_that_of_the_continuous_equations(hz: float) -> None:
    """The first-order change agrees: at a quarter of the rate, the remainder is a sixteenth."""
    frozen, rest = between(2.0).frequency_response(2 * np.pi * hz), []
    for schedule_s in (4.0, 16.0):
        slope = RISING.slope(2.0) * 2.0 / schedule_s
        change = change_by_motion(between(2.0), slope, np.array([2j * np.pi * hz]))[0]
        measured = demodulated(schedule_s, hz) - frozen
        assert abs(measured - change) < 0.05 * abs(change)
        rest.append(abs(measured - change))
    assert rest[0] / rest[1] == pytest.approx(16.0, rel=0.15)


def ascent(change_s: float) -> dict[str, Any]:
    """Return a notch that follows KSR-III's first mode and changes only within `change_s` before 40 s."""
    first, last = ({"zero_hz": hz, "zero_zeta": 0.3, "pole_hz": 0.7 * hz, "pole_zeta": 0.6} for hz in (9.3, 11.0))
    return section({"time_s": 40.0 - change_s, "quadratic": (first,)}, {"time_s": 40.0, "quadratic": (last,)})


def test_a_schedule_that_is_too_fast_is_rejected() -> None:
    """A change that begins and ends between two operating points is rejected at both."""
    where = nodes("nominal", [10.0, 30.0, 45.0, 55.0])
    slow, fast = design(ascent(35.0)), design(ascent(0.05))
    by_slow, by_fast = (motion_checks(judge(where, own), own) for own in (slow, fast))
    assert by_slow[0].passed
    assert 0.01 < by_slow[0].values.max() < 1.0
    assert not by_fast[0].passed
    assert by_fast[0].met().tolist() == [True, False, False, True]
    assert by_fast[0].values[0] == by_fast[0].values[3] == 0.0
    # to first order, the change is inversely proportional to the time that it takes
    loop = judge(where[1:2], slow)[0].loop
    assert by_fast[0].values.max() / by_slow[0].values.max() == pytest.approx(700.0, rel=0.3)
    # and at one frequency, it is |dL| / |1 + L| with the continuous law's change
    rates = np.array([1.7, 0.0, 1.19, 0.0]) / 35.0
    ((_, moves),) = moves_near(PdDesign.of(slow).filter, where[1:2], "time_s")
    flt = PdDesign.of(slow).filter(30.0)
    hz = np.geomspace(1.0, 8.0, 200)
    filtered = loop.law.filter_response(hz)
    share = np.abs(loop.response(hz) / filtered * change_by_motion(flt, rates, 2j * np.pi * hz)) / np.abs(
        1.0 + loop.response(hz)
    )
    assert [at for at, _ in moves] == [30.0, 5.0, 40.0]
    np.testing.assert_allclose(moves[0][1], rates, rtol=1e-9, atol=1e-12)
    assert 100.0 * share.max() <= 1.05 * by_slow[0].values[1]
    found = checks(judge(where, fast), fast, Wanted())
    assert [c.key for c in found if not c.passed] == ["filter_motion"]


@pytest.mark.slow  # two analyses
def test_commands_report_the_motion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ends = []
    for change_s in (35.0, 0.05):
        path = tmp_path / f"{change_s}.toml"
        path.write_text(design_text(design(ascent(change_s))))
        ends.append(
            (
                simdesign.main(
                    ["analyse", str(path), "--at", "30", "--no-pictures", "--out", str(tmp_path / f"out-{change_s}")]
                ),
                capsys.readouterr().out,
            )
        )
    (slow_code, slow), (fast_code, fast) = ends
    assert (slow_code, fast_code) == (0, 1)
    assert "motion %" in slow
    assert re.search(r"change of L by filter motion, of \|1 \+ L\|.* 10 %", fast)


def test_the_table_of_a_design_lists_the_points() -> None:
    rows = [line.split() for line in design_table(design(ascent(35.0)))]
    assert rows[-3:] == [
        ["time,", "s", "section", "zero", "Hz", "zeta", "pole", "Hz", "zeta"],
        ["5", "quadratic", "9.300", "0.3000", "6.510", "0.6000"],
        ["40", "quadratic", "11.000", "0.3000", "7.700", "0.6000"],
    ]


def test_a_verdict_requires_slow_motion() -> None:
    node = ({"gain_up_db": 9.0},)
    found = [
        margin_requirements(
            MarginStudy("", "pitch", (40.0,), MarginCase("", node), (), np.zeros((0, 1, 7)), motion=(percent,)),
            LinearMargins(),
        )
        for percent in (0.4, 12.0)
    ]
    (slow,), (fast,) = ([r for r in each if r.name.startswith("change of L by filter motion")] for each in found)
    assert (slow.judgement, fast.judgement) == ("accepted", "rejected")
    assert (fast.wanted, fast.found, fast.where) == ("<= 10 %", "12.00 %", "40 s, pitch")
    assert fast.room == pytest.approx(-0.2)


# --- variables of the optimiser
NODES_S = (10.0, 35.0, 58.0)
SCHEDULED = ("filter.structure=F3", f"filter.nodes_s={list(NODES_S)}", "gains.schedule=linear", "loop=sampled")


def test_variables_are_the_filter_at_each_node_and_linear_in_between() -> None:
    plants = kit.plants(*SCHEDULED)
    problem = make_problem(kit.case(*SCHEDULED).case, plants)
    law: Any = problem.law
    assert isinstance(law, PdVariables)
    assert law.names[:3] == (
        "quadratic[0].zero_hz at 10 s",
        "quadratic[0].zero_zeta at 10 s",
        "quadratic[0].pole_hz at 10 s",
    )
    times = np.array([plant.node.time_s for plant in plants.each])
    rng, n = np.random.default_rng(1), law.filter.size
    first = law.starts(1, 1)[0]
    x = first + np.concatenate([0.1 * rng.standard_normal(3 * n), np.zeros(len(first) - 3 * n)])
    x = np.clip(x, law.lower, law.upper)
    logarithmic = np.array([True, False, True, False, True, True])
    i = np.clip(np.searchsorted(NODES_S, times) - 1, 0, 1)
    share = np.clip((times - np.take(NODES_S, i)) / np.diff(NODES_S)[i], 0.0, 1.0)[:, None]

    def own(y: Any) -> Any:
        """Return the parameters (plants, n) in complex arithmetic."""
        rows = y.reshape(3, n)
        value = np.where(logarithmic, np.exp(rows), rows)
        mixed = value[i] * (1.0 - share) + value[i + 1] * share
        return np.where(logarithmic, np.log(mixed), mixed)

    np.testing.assert_allclose(law.own(x)[:, :n], own(x[: 3 * n]), rtol=1e-12)
    jacobian = law.jacobian(x)
    for j in range(3 * n):
        stepped = x[: 3 * n].astype(complex)
        stepped[j] += 1e-30j
        np.testing.assert_allclose(jacobian[:, :n, j], own(stepped).imag * 1e30, rtol=1e-9, atol=1e-12)
    slopes = rng.standard_normal((len(times), law.own_size))
    bend, step = law.bend(x, slopes), 1e-5
    for j in range(3 * n):
        moved = [law.jacobian(x + sign * step * np.eye(len(x))[j]) for sign in (1.0, -1.0)]
        by = np.einsum("po,pov->v", slopes, moved[0] - moved[1]) / (2.0 * step)
        np.testing.assert_allclose(bend[j], by, rtol=1e-5, atol=1e-7)
    # the law at each plant, as written to the file and read back
    made = law.designed(x)
    again = PdDesign.of(Design.model_validate({"schema": 2, **made.tables()}))
    hz = np.geomspace(0.5, 40.0, 7)
    for k, (found, time_s) in enumerate(zip(law.controllers(x), times, strict=True)):
        wanted = again.at(float(time_s), "pitch", law.task.sample_s)
        np.testing.assert_allclose(found.filter_response(hz), wanted.filter_response(hz), rtol=1e-9)
        mesh = law.response(x, np.full(7, k), law.axis(np.log(hz)))[0]
        np.testing.assert_allclose(mesh, wanted.filter_response(hz), rtol=1e-9)
    np.testing.assert_allclose(law.variables_of(made), x, rtol=1e-9, atol=1e-12)
    # gradient of all rows by differences
    at = problem.evaluate(x, complete=True)
    for j in rng.choice(3 * n, 4, replace=False):
        rows = [problem.evaluate(x + sign * 1e-6 * np.eye(len(x))[j], complete=True).rows for sign in (1.0, -1.0)]
        assert rows[0].keys == rows[1].keys == at.rows.keys
        slope = (rows[0].excess_db - rows[1].excess_db) / 2e-6
        np.testing.assert_allclose(at.gradient[:, j], slope, rtol=2e-4, atol=2e-4)


def test_a_constant_filter_starts_a_schedule_and_the_reverse_does_not_fit() -> None:
    plants = kit.plants(*SCHEDULED)
    law: Any = make_problem(kit.case(*SCHEDULED).case, plants).law
    small, wider = law.simpler()
    assert (small.filter_nodes.size, law.filter_nodes.size) == (6, 18)
    x = small.starts(1, 1)[0]
    wide = wider(x)
    assert (wide[:18] == np.tile(x[:6], 3)).all()
    np.testing.assert_allclose(law.variables_of(small.designed(x)), wide, rtol=1e-12)
    assert small.variables_of(law.designed(wide)) is None


@pytest.mark.slow  # two searches
def test_a_schedule_is_at_least_as_good_as_the_constant_filter() -> None:
    few = ("nodes_s=[10.0, 35.0, 58.0]", "filter.structure=F2", "gains.schedule=linear", "search.starts=4")
    moving = (*few, f"filter.nodes_s={list(NODES_S)}")
    plants = kit.plants(*few)
    constant = solve(kit.case(*few), plants)
    scheduled = solve(kit.case(*moving), plants, (constant.law,))
    assert scheduled.objective_db < constant.objective_db - 0.5
    assert kit.designed(scheduled).filter.at == NODES_S
    assert not kit.designed(constant).filter.moves


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (("filter.nodes_s=[30.0, 10.0]",), "does not rise"),
        (("filter.nodes=[30.0, 40.0]",), "gains are over time_s.*nodes_s"),
        (("gains.over=speed_mps", "filter.nodes_s=[30.0, 40.0]"), "gains are over speed_mps.*nodes, over speed_mps"),
    ],
)
def test_wrong_nodes(changes: tuple[str, ...], words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        read_case("ksr3-identical", changes)
