"""Several engines agree with Newton's and Euler's laws body by body, and with one engine of n-fold size.

The oracle sums momentum and angular momentum of the core without engines and of each engine. It contains no equivalent
engines, no mass matrix of docs/model.md (7.1), and no workspace of the kernels.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sympy as sp
from flightkit import Mode, Parts, Rig, Tree, gimbal_motions, rig, scenario_of, with_stage

from maxq import ScenarioError
from maxq.control.kernel.records import Array
from maxq.sim.scenario.loader import load_scenario, load_scenario_text
from maxq.sim.vehicle import state as layout

NINE = "tests/data/nine-engines/flight.toml"
PARTS = Parts(
    core_cg=(7.0, 0.02, -0.03),
    core_inertia=((900.0, 30.0, -20.0), (30.0, 5.2e4, 40.0), (-20.0, 40.0, 5.21e4)),
    stations_m=(0.0, 3.0, 10.0, 11.5, 12.0, 14.0),
    mass_forward_kg=(0.0, 600.0, 3200.0, 3700.0, 3800.0, 4200.0),
)
SHAPES = ((1.0, 0.4, -0.3, 0.5, 0.7, 1.2), (-0.2, -0.15, 0.1, 0.3, 0.35, 0.4))
OTHER = (tuple(-2.0 * x for x in SHAPES[0]), tuple(-1.5 * x for x in SHAPES[1]))
PITCH = (Mode(9.0, 1700.0, *SHAPES), Mode(23.0, 900.0, *OTHER))
BENT = replace(PARTS, pitch=PITCH, yaw=PITCH)


def engine(thrust_N: float = 2.0e4, **more: Any) -> Tree:
    return {
        "table": [{"time_s": 0.0, "thrust_vacuum_N": thrust_N}],
        "gimbal_station_m": 12.0,
        "exit_station_m": 13.0,
        "gimballed_mass_kg": 60.0,
        "cg_from_gimbal_m": 0.5,
        "inertia_about_gimbal_kgm2": 22.0,
    } | more


UNLIKE = [
    engine(3.0e4, offset_m=[0.4, -0.1], group="a"),
    engine(2.0e4, offset_m=[-0.5, 0.3], group="b", cant_deg=[4.0, -7.0], gimballed_mass_kg=80.0),
    engine(1.5e4, offset_m=[0.1, 0.6], group="a", gimbal="yaw", cant_deg=[-3.0, 2.0]),
    engine(2.5e4, offset_m=[-0.2, -0.6], group="c", gimbal="pitch", gimbal_station_m=11.5, misalignment_deg=[1.0, 2.0]),
    engine(1.0e4, offset_m=[0.7, 0.2], gimbal="fixed", cant_deg=[2.0, 5.0]),
]


LOADS = [
    {"group": "c", "frequency_hz": 11.0, "damping_ratio": 0.05},
    {"group": "a", "stiffness_Nmprad": 2.0e5, "damping_ratio": 0.02, "friction_Nm": 40.0},
]
SWINGING = (0, 2, 3)  # of UNLIKE: the groups a and c


def with_engines(parts: Parts, engines: list[Tree], **more: Any) -> Rig:
    tree = scenario_of(replace(parts, engine=True))
    tree["vehicle"]["stage"][0] |= {"engine": engines} | more
    return rig(tree)


def moving(made: Rig, seed: int, rate: float = 0.6) -> Array:
    """Return a state with all actuators in motion; motions are equal within a plane if `seed` is even."""
    rng = np.random.default_rng(seed)
    y = made.y.copy()
    y[layout.W_BI_B : layout.W_BI_B + 3] = rate * rng.normal(size=3)
    same = 0.1 * rng.normal(size=12)
    for group in range(1 + int(made.sizes.further_groups)):
        i = int(layout.actuator_index(made.sizes, group))
        y[i : i + 12] = same if seed % 2 == 0 else 0.1 * rng.normal(size=12)
    loads = y[int(layout.tvc_load_index(made.sizes)) :].reshape(-1, 2, 3)  # load, plane; angle, rate, friction
    loads[:, :, :2] = rng.normal(0.0, (0.1, 0.1 + rate), (len(loads), 2, 2))
    for load, engine in zip(loads, SWINGING, strict=False):  # an engine does not leave its plane
        load[[UNLIKE[engine].get("gimbal") == "yaw", UNLIKE[engine].get("gimbal") == "pitch"]] = 0.0
    return y


def motions(made: Rig, given: list[Tree]) -> list[tuple[Array, ...]]:
    """Return each engine's thrust axis at rest and now, its two derivatives, and its change per pitch and yaw."""
    dp, dy, t = (sp.Function("dp"), sp.Function("dy"), sp.Symbol("t"))
    axis = sp.Matrix([sp.cos(dp(t)) * sp.cos(dy(t)), -sp.sin(dy(t)), sp.sin(dp(t)) * sp.cos(dy(t))])
    names = sp.symbols("p p1 p2 y y1 y2")
    known = {dp(t).diff(t, 2): names[2], dy(t).diff(t, 2): names[5], dp(t).diff(t): names[1], dy(t).diff(t): names[4]}
    known_last = {dp(t): names[0], dy(t): names[3]}
    rows = [axis, axis.diff(t), axis.diff(t, 2), axis.diff(dp(t)), axis.diff(dy(t))]
    numeric = sp.lambdify(names, [list(row.subs(known).subs(known_last)) for row in rows])
    groups = list(dict.fromkeys(e.get("group", "") for e in given if e.get("gimbal") != "fixed"))
    out = []
    for number, e in enumerate(given):
        planes = e.get("gimbal", "both")
        group = groups.index(e.get("group", "")) if planes != "fixed" else 0
        channels, at = made.aux.engines.channel, 2 * group
        if made.sizes.tvc_loads > 0 and number in SWINGING:
            channels, at = made.aux.tvc_loads.swing, 2 * SWINGING.index(number)
        angles = gimbal_motions(channels[at : at + 2]).ravel()
        angles[:3] *= planes in ("both", "pitch")
        angles[3:] *= planes in ("both", "yaw")
        cant, error = np.radians(e.get("cant_deg", [0, 0])), np.radians(e.get("misalignment_deg", [0, 0]))
        rest = np.array(numeric(cant[0], 0, 0, cant[1], 0, 0)[0], float)
        angles[0] += cant[0] + error[0]
        angles[3] += cant[1] + error[1]
        out.append((rest, *(np.array(row, float) for row in numeric(*angles))))
    return out


def newton_euler(made: Rig, given: list[Tree], w: Array) -> tuple[Array, Array]:
    """Return the specific force at the core CG and the angular acceleration, from sums over all bodies."""
    x, y, z = PARTS.core_cg
    rest = []
    for e, (d0, *_) in zip(given, motions(made, given), strict=True):
        gimbal = np.array([x - e["gimbal_station_m"], e["offset_m"][0] - y, e["offset_m"][1] - z])
        rest.append((gimbal, gimbal - e["cg_from_gimbal_m"] * d0))
    masses = np.array([e["gimballed_mass_kg"] for e in given])
    own = [e["inertia_about_gimbal_kgm2"] - e["gimballed_mass_kg"] * e["cg_from_gimbal_m"] ** 2 for e in given]
    total = PARTS.core_mass_kg
    hull_mass = total - masses.sum()
    hull_cg = -sum(m * r for m, (_, r) in zip(masses, rest, strict=True)) / hull_mass
    point = lambda m, r: m * (r @ r * np.eye(3) - np.outer(r, r))  # noqa: E731  # a formula
    hull = np.array(PARTS.core_inertia)  # about the core CG, engines taken out
    for m, i, (_, r) in zip(masses, own, rest, strict=True):
        hull = hull - point(m, r) - i * np.eye(3)
    matrix, known = np.zeros((6, 6)), np.zeros(6)
    force, moment = np.zeros(3), np.zeros(3)
    skew = lambda r: np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])  # noqa: E731  # a formula

    def body(m: float, r: Array, v: Array, a: Array) -> None:
        """Add a mass at r that moves with v and a relative to the body."""
        accel = a + 2.0 * np.cross(w, v) + np.cross(w, np.cross(w, r))
        matrix[:3, :3] += m * np.eye(3)
        matrix[:3, 3:] -= m * skew(r)
        matrix[3:, :3] += m * skew(r)
        matrix[3:, 3:] -= m * skew(r) @ skew(r)
        known[:3] += m * accel
        known[3:] += m * np.cross(r, accel)

    # the hull's inertia is about the core CG already: first moment and mass only from its CG
    matrix[:3, :3] += hull_mass * np.eye(3)
    matrix[:3, 3:] -= hull_mass * skew(hull_cg)
    matrix[3:, :3] += hull_mass * skew(hull_cg)
    matrix[3:, 3:] += hull
    known[:3] += hull_mass * np.cross(w, np.cross(w, hull_cg))
    known[3:] += np.cross(w, hull @ w)
    for e, i, (gimbal, _), (_, d, d1, d2, *_) in zip(given, own, rest, motions(made, given), strict=True):
        arm = e["cg_from_gimbal_m"]
        body(e["gimballed_mass_kg"], gimbal - arm * d, -arm * d1, -arm * d2)
        spin, spin_rate = np.cross(d, d1), np.cross(d, d2)
        matrix[3:, 3:] += i * np.eye(3)
        known[3:] += i * (spin_rate + np.cross(w, spin))
        thrust = e["table"][0]["thrust_vacuum_N"] * d
        force, moment = force + thrust, moment + np.cross(gimbal, thrust)
    solution = np.linalg.solve(matrix, np.concatenate([force, moment]) - known)
    return solution[:3], solution[3:]


@pytest.mark.slow
@pytest.mark.parametrize("loads", [[], LOADS], ids=["locked", "swinging"])
@pytest.mark.parametrize("seed", [1, 3])
def test_unlike_engines_obey_newton_and_euler_body_by_body(seed: int, loads: list[Tree]) -> None:
    made = with_engines(PARTS, UNLIKE, **({"tvc_load": loads} if loads else {}))
    assert (int(made.sizes.engines), int(made.sizes.further_groups), int(made.sizes.gimbals)) == (5, 2, 2)
    y = moving(made, seed)
    dy = made.derivative(y)
    w = y[layout.W_BI_B : layout.W_BI_B + 3]
    accel, alpha = newton_euler(made, UNLIKE, w)
    np.testing.assert_allclose(made.aux.specific_force_B_mps2, accel, rtol=1e-11)
    np.testing.assert_allclose(dy[layout.W_BI_B : layout.W_BI_B + 3], alpha, rtol=1e-10)
    if loads:
        still = [(np.zeros(3), np.zeros(3))] * len(UNLIKE)
        check_hinges(made, y, w, accel, alpha, still)


def check_hinges(made: Rig, y: Array, w: Array, accel: Array, alpha: Array, bend: list[tuple[Array, Array]]) -> None:
    """Check each engine on its load: the work of its inertia on a turn about the hinge equals that of the hinge moment.

    `bend`: acceleration and angular acceleration of the gimbal due to the modes. Thrust acts through the gimbal and
    does no work.
    """
    x, cg_y, cg_z = PARTS.core_cg
    states = y[int(layout.tvc_load_index(made.sizes)) :].reshape(-1, 2, 3)
    assert len(states) == len(SWINGING)
    for n, number in enumerate(SWINGING):
        e, (d0, d, d1, d2, *by) = UNLIKE[number], motions(made, UNLIKE)[number]
        mass, arm = e["gimballed_mass_kg"], e["cg_from_gimbal_m"]
        own = e["inertia_about_gimbal_kgm2"] - mass * arm**2
        gimbal = np.array([x - e["gimbal_station_m"], e["offset_m"][0] - cg_y, e["offset_m"][1] - cg_z])
        at, v = gimbal - arm * d, -arm * d1
        shift, turn = bend[number]
        felt = accel + np.cross(alpha, at) + np.cross(w, np.cross(w, at)) + 2.0 * np.cross(w, v) - arm * d2
        lever = np.array([0.0, *e["offset_m"]]) if any(e.get("cant_deg", [0, 0])) else np.zeros(3)
        felt = felt + shift + np.cross(turn, lever - arm * d0)
        turning = alpha + turn + np.cross(d, d2) + np.cross(w, np.cross(d, d1))
        for plane in range(2):
            if e.get("gimbal", "both") not in ("both", ("pitch", "yaw")[plane]):
                assert made.aux.tvc_loads.swing[2 * n + plane].accel_radps2 == 0.0
                continue
            work = mass * felt @ (-arm * by[plane]) + own * turning @ np.cross(d, by[plane])
            # what the axial load does through the gimbal's slope is left to the caller
            assert made.aux.tvc_loads.hinge_moment_Nm[2 * n + plane] == pytest.approx(work, rel=1e-9)
            assert abs(made.aux.tvc_loads.swing[2 * n + plane].accel_radps2) > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("loads", [[], LOADS], ids=["locked", "swinging"])
def test_loads_on_the_modes_are_the_virtual_work_of_thrust_and_reaction(loads: list[Tree]) -> None:
    """At rest and straight, the modal load is each force times the modal displacement of its point."""
    made = with_engines(BENT, UNLIKE, **({"tvc_load": loads} if loads else {}))
    y = moving(made, 5, rate=0.0)
    dy = made.derivative(y)
    load = made.aux.axial_load_mps2
    bend = [(np.zeros(3), np.zeros(3)) for _ in UNLIKE]
    for plane, lateral in (("pitch", 2), ("yaw", 1)):
        for number, mode in enumerate(PITCH):
            work = 0.0
            for e, (d0, d, _, d2, *_) in zip(UNLIKE, motions(made, UNLIKE), strict=True):
                at = BENT.stations_m.index(e["gimbal_station_m"])
                turn = np.zeros(3)  # rotation of the section for a unit of the modal coordinate
                turn[3 - lateral] = mode.slope_pm[at] * (1.0 if plane == "pitch" else -1.0)
                shift = np.zeros(3)
                shift[lateral] = mode.phi[at]
                off, arm = np.array([0.0, *e["offset_m"]]), e["cg_from_gimbal_m"]
                mass = e["gimballed_mass_kg"]
                own = e["inertia_about_gimbal_kgm2"] - mass * arm**2
                work += e["table"][0]["thrust_vacuum_N"] * d @ (shift + np.cross(turn, off))
                lever = off if any(e.get("cant_deg", [0, 0])) else np.zeros(3)  # without cant of second order
                carried = np.cross([dy[layout.W_BI_B], 0.0, 0.0], arm * (d - d0))  # the displaced mass, rolling
                work += mass * (arm * d2 + carried) @ (shift + np.cross(turn, lever - arm * d0))
                work -= own * np.cross(d, d2) @ turn
                # the weight under the axial load, of the displaced engine less that at rest
                work += -mass * load * np.array([1.0, 0, 0]) @ np.cross(turn, -arm * (d - d0))
            i = int((layout.eta_index if plane == "pitch" else layout.xi_index)(made.sizes)) + 2 + number
            assert dy[i] == pytest.approx(work / mode.mass_kg, rel=1e-9)
            for (shift, turn), e in zip(bend, UNLIKE, strict=True):
                at = BENT.stations_m.index(e["gimbal_station_m"])
                shift[lateral] += mode.phi[at] * dy[i]
                turn[3 - lateral] += mode.slope_pm[at] * (1.0 if plane == "pitch" else -1.0) * dy[i]
    if loads:
        accel, alpha = made.aux.specific_force_B_mps2, dy[layout.W_BI_B : layout.W_BI_B + 3]
        check_hinges(made, y, np.zeros(3), accel, alpha, bend)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_n_engines_on_the_axis_are_one_of_n_fold_size(seed: int) -> None:
    four = with_engines(BENT, [engine(offset_m=[0.0, 0.0], group=name) for name in "abcd"])
    single = engine(8.0e4, gimballed_mass_kg=240.0, inertia_about_gimbal_kgm2=88.0)
    one = rig(with_stage(scenario_of(BENT), engine=single))
    assert int(four.sizes.engines) == 4
    y, of_one = moving(four, seed), moving(one, seed)
    np.testing.assert_array_equal(y[: one.n], of_one)
    many = four.derivative(y)[: one.n]
    np.testing.assert_allclose(many, one.derivative(of_one), rtol=1e-12, atol=1e-10)
    assert four.aux.engines.axial_thrust_N == pytest.approx(8.0e4)


@pytest.mark.slow
def test_engines_that_move_together_are_taken_together_exactly() -> None:
    """A ring in one group is one engine for the kernels; with a negligible misalignment each engine is separate."""
    places = [[0.6 * np.cos(a), 0.6 * np.sin(a) + 0.1] for a in np.arange(5) * 1.2566]
    together = with_engines(BENT, [engine(offset_m=place) for place in places])
    apart = [engine(offset_m=place, misalignment_deg=[1e-14 * k, 0.0]) for k, place in enumerate(places)]
    singly = with_engines(BENT, apart)
    assert (int(together.sizes.engines), int(singly.sizes.engines)) == (1, 5)
    y = moving(together, 7)
    np.testing.assert_allclose(together.derivative(y), singly.derivative(y), rtol=1e-11, atol=1e-11)


@pytest.mark.slow
def test_four_engines_make_a_roll_couple() -> None:
    """Tangential deflections delta at radius R give M_x = 4 T R sin(delta), no lateral force and no other moment."""
    radius, angle = 0.8, 0.05
    ring = [(radius, 0.0), (0.0, radius), (-radius, 0.0), (0.0, -radius)]
    core = replace(PARTS, core_cg=(7.0, 0.0, 0.0), core_inertia=((900.0, 0.0, 0.0), (0.0, 5e4, 0.0), (0.0, 0.0, 5e4)))
    engines = [
        engine(offset_m=list(r), group=str(k), gimballed_mass_kg=0.0, inertia_about_gimbal_kgm2=0.0)
        for k, r in enumerate(ring)
    ]
    tree = scenario_of(core, switches={"actuator": "ideal"})
    tree["vehicle"]["stage"][0]["engine"] = engines
    made = rig(tree)
    for group, (y, z) in enumerate(ring):  # M_x = y F_z - z F_y, F_z = T sin(pitch), F_y = -T sin(yaw)
        made.held["command_rad"][2 * group : 2 * group + 2] = angle * np.sign(y), angle * np.sign(z)
    alpha = made.derivative(made.y)[layout.W_BI_B : layout.W_BI_B + 3]
    np.testing.assert_allclose(alpha, [4 * 2.0e4 * radius * np.sin(angle) / 900.0, 0.0, 0.0], atol=1e-12)


def test_one_engine_in_a_list_is_the_engine_as_a_table() -> None:
    table = load_scenario("nominal").scenario.vehicle.stage[0]
    assert table.engines == (table.engine,)
    assert table.engine_key(0) == ("engine",)
    tree = scenario_of(PARTS, run={"duration_s": 0.1})
    single = tree["vehicle"]["stage"][0]["engine"]
    flown = []
    for form in (single, [single]):
        tree["vehicle"]["stage"][0]["engine"] = form
        made = rig(tree)
        flown.append(made.derivative(moving(made, 1)).tobytes())
    assert flown[0] == flown[1]
    nine = load_scenario(NINE).scenario.vehicle.stage[0]
    assert len(nine.engines) == 9
    assert nine.engine_key(3) == ("engine", 3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("vehicle.stage.0.engine.3.gimbal='sideways'", "stage.0.engine.3.gimbal"),
        ("vehicle.stage.0.engine.3.thrust=1.0", "stage.0.engine.3.thrust"),
        ("vehicle.stage.0.engine.3.name='E1'", "another engine has this name"),
        ("vehicle.stage.0.engine.3.gimballed_mass_kg=3e5", "engine.3.inertia_about_gimbal_kgm2"),
        ("vehicle.stage.0.engine.2.gimbal_station_m=45.0", "stage.0.engine.2.gimbal_station_m = 45.0: this station"),
        ("vehicle.stage.0.engine=[]", "has too few elements"),
    ],
)
def test_wrong_engines_are_refused_by_their_place_in_the_list(change: str, said: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(NINE, [change])
    assert said in str(caught.value)
    assert "<" not in str(caught.value).split(";", 1)[0]


def test_ten_engines_are_too_many_and_a_fixed_one_has_no_group() -> None:
    tree = scenario_of(PARTS)
    for engines, said in (([engine()] * 10, "at most 9"), ([engine(gimbal="fixed", group="a")], "moves with no group")):
        tree["vehicle"]["stage"][0]["engine"] = engines
        with pytest.raises(ScenarioError, match=said):
            rig(tree)


def test_a_list_survives_the_scenario_as_flown() -> None:
    loaded = load_scenario(NINE)
    again = load_scenario_text(loaded.as_flown)
    assert again == loaded
