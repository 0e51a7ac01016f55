"""The linear model of a cluster of nine engines (canted, in groups, at two stations) equals the linearised simulator.

Both planes are tested, with commands through the columns of the allocation. The two share only the packed tables.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.optimize
from oracles.planar.engine import GimballedEngine, TvcLoad
from oracles.planar.equations import inputs_of
from oracles.planar.plant import vehicle_plant
from oracles.planar.vehicle_at import stability_derivatives, vehicle_at

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.design.loop.fixed_path import ExactFixedPath, fixed_path
from maxq.design.model.dispersion import Dispersion
from maxq.design.model.held import FlightCondition
from maxq.design.model.instruments import DERIVATIVES
from maxq.design.model.linearised import linearise
from maxq.design.model.node import disperse, node_of
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.state import tvc_load_index

NINE = "tests/data/nine-engines/flight.toml"
# at a row of the mass table: between them the total mass is not quite that of core and bobs
TIME_S, SPEED_MPS, PATH_DEG, GRAVITY_MPS2 = 60.0, 220.0, 70.0, 9.80665
TOLERANCE = 1e-8
MODES, TANKS = 2, 2
FREQUENCIES_HZ = np.geomspace(0.05, 50.0, 61)


def cluster(cant_deg: float, *more: str) -> Packed:
    """Return the ring canted outwards, opposite engines grouped, the centre engine further forward and heavier."""
    path = np.radians(PATH_DEG)
    velocity = [float(SPEED_MPS * np.cos(path)), 0.0, float(-SPEED_MPS * np.sin(path))]
    changes = [
        "earth.shape='flat'",
        "earth.rotating=false",
        "earth.gravity='uniform'",
        f"run.start_s={TIME_S}",
        "initial.geodetic.latitude_deg=0",
        "initial.geodetic.longitude_deg=0",
        "initial.geodetic.altitude_m=3000.0",
        f"initial.euler_deg=[0, {PATH_DEG!r}, 0]",
        f"initial.ned_mps={velocity!r}",
        "vehicle.stage.0.engine.8.group='middle'",
        "vehicle.stage.0.engine.8.gimbal_station_m=38.0",
        "vehicle.stage.0.engine.8.gimballed_mass_kg=450.0",
        "vehicle.stage.0.engine.8.inertia_about_gimbal_kgm2=400.0",
        "vehicle.stage.0.engine.8.exit_station_m=40.0",
    ]
    for k in range(8):
        angle = 2.0 * np.pi * k / 8
        cant = [float(cant_deg * np.sin(angle)), float(-cant_deg * np.cos(angle))]
        changes += [
            f"vehicle.stage.0.engine.{k}.group='{'ab'[k % 2]}'",
            f"vehicle.stage.0.engine.{k}.cant_deg={cant!r}",
        ]
    return pack_flight(load_scenario(NINE, [*changes, *more]).scenario)


def condition_of(packed: Packed) -> FlightCondition:
    air = evaluate_at(packed, packed.state, TIME_S).aux.air
    values = [float(x) for x in (air.density_kgpm3, air.pressure_Pa, air.mach)]
    return FlightCondition(TIME_S, SPEED_MPS, *values, float(np.radians(PATH_DEG)), GRAVITY_MPS2)


def follow_of(packed: Packed) -> tuple[Array, Array]:
    """Return the angles per command of the law (groups, 2), and those of the other groups relative to the first."""
    a = packed.parameters[0].computer.allocation
    matrix = table_in(packed.pool, a.matrix)(TIME_S).reshape(-1, 3)
    gains = np.array([[matrix[2 * g, 0], matrix[2 * g + 1, 1]] for g in range(int(a.groups))])
    return gains, gains[1:] / gains[0]


def together(model, follow: Array):
    """Return the model with the actuators of further groups at multiples `follow` (groups, 2) of the first's."""
    a, c, first = model.a.copy(), model.c.copy(), model.states.index("actuator_pitch_1")
    for group, multiples in enumerate(follow):
        theirs = model.states.index(f"group_{group + 1}_actuator_pitch_1")
        for k, multiple in enumerate(np.repeat(multiples, 6)):
            a[:, first + k] += multiple * a[:, theirs + k]
            c[:, first + k] += multiple * c[:, theirs + k]
    return replace(model, a=a, c=c)


def states_of(plane: str) -> list[str]:
    bend, motion = ("eta", ["w_mps", "q_radps", "theta_rad"])
    if plane == "yaw":
        bend, motion = "xi", ["v_mps", "r_radps", "psi_rad"]
    names = motion + [f"{bend}_{i + 1}{what}" for what in ("_m", "_rate_mps") for i in range(MODES)]
    names += [f"slosh_{k + 1}_{plane}{what}" for what in ("_rad", "_rate_radps") for k in range(TANKS)]
    return names + [f"actuator_{plane}_{k + 1}" for k in range(6)]


LOST = "fault=[{kind='engine-off',engine=1,at_s=20.0}]"


@pytest.mark.slow
@pytest.mark.parametrize(("cant_deg", "fault"), [(0.0, ()), (5.0, ()), (0.0, (LOST,)), (5.0, (LOST,))])
def test_plant_of_a_cluster_is_the_linearised_simulator(cant_deg: float, fault: tuple[str, ...]) -> None:
    """The plant agrees, also with a diagonal engine off between the rows of the mass table."""
    packed = cluster(cant_deg, *fault)
    sizes = packed.parameters[0].vehicle.sizes
    assert (int(sizes.further_groups), int(sizes.gimbals)) == (2, 2)
    gains, follow = follow_of(packed)
    simulated = together(linearise(packed, packed.state, TIME_S), follow)
    n = 3 + 2 * (MODES + TANKS)
    mirror = np.ones(n)  # yaw: w -> v, q -> -r, theta -> -psi, delta -> -delta
    mirror[1:3] = -1.0
    for axis, plane in enumerate(("pitch", "yaw")):
        vehicle = vehicle_at(packed, TIME_S, condition_of(packed).mach, plane)
        model = vehicle_plant(vehicle, condition_of(packed))
        plant = node_of(packed, TIME_S, 0, plane).plant
        assert (plant.states, plant.inputs, plant.outputs) == (model.states, model.inputs, model.outputs)
        for matrix in "abcd":
            np.testing.assert_allclose(getattr(plant, matrix), getattr(model, matrix), rtol=TOLERANCE, atol=1e-8)
        core_and_bobs = vehicle.body.core_mass_kg + vehicle.pendulums.mass_kg.sum()
        assert (abs(core_and_bobs / vehicle.body.total_mass_kg - 1.0) > 1e-5) == bool(fault)
        i = [simulated.states.index(name) for name in states_of(plane)]
        a = simulated.a[np.ix_(i, i)]
        signs = mirror if plane == "yaw" else np.ones(n)
        ours = signs[:, None] * model.a * signs
        np.testing.assert_allclose(a[:n, :n], ours, rtol=TOLERANCE, atol=1e-8)
        own, angle = a[n:, n:], simulated.c[axis, i[n:]]
        motion = np.stack([angle, angle @ own, angle @ own @ own], axis=1)
        through = np.linalg.lstsq(motion, a[:n, n:].T, rcond=None)[0].T
        per_command = signs[:, None] * model.b * (1.0 if plane == "pitch" else -1.0)
        np.testing.assert_allclose(through[:, [0, 2]] * gains[0, axis], per_command, rtol=TOLERANCE, atol=2e-8)
        np.testing.assert_allclose(through[:, 1], 0.0, atol=1e-7)


def test_stability_derivatives_count_every_engine_with_its_gain() -> None:
    packed = cluster(0.0)
    vehicle, condition = vehicle_at(packed, TIME_S, condition_of(packed).mach), condition_of(packed)
    d = stability_derivatives(vehicle, condition)
    thrust = 9 * (4e5 - 0.6 * condition.pressure_Pa)
    assert vehicle.thrust_N(condition.pressure_Pa) == pytest.approx(thrust, rel=1e-12)
    arm = d.m_delta_1ps2 * vehicle.total_inertia_kgm2 / (d.z_delta_1ps * vehicle.body.total_mass_kg * SPEED_MPS)
    cg = vehicle.total_cg_station_m
    assert 38.0 - cg < arm < 38.6 - cg


UNLIKE = (
    "vehicle.stage.0.actuator=["
    "{group='a',model='second-order',omega_hz=[8.0],zeta=[0.8],angle_limit_deg=6.0,rate_limit_degps=20.0},"
    "{group='middle',model='fourth-order',omega_hz=[5.0,20.0],zeta=[0.9,0.4],angle_limit_deg=6.0,rate_limit_degps=20.0},"
    "{group='b',omega_hz=[5.8,7.2,52.6,15.6],zeta=[0.87,0.49,0.15,0.042],angle_limit_deg=4.0,rate_limit_degps=25.0}]"
)
SOME = (
    "vehicle.stage.0.tvc_load=[{group='a',frequency_hz=12.0,damping_ratio=0.03},"
    "{group='middle',stiffness_Nmprad=3e6,damping_ratio=0.02}]"
)


def command_to_gyro(packed: Packed, y: Array, plane: str) -> tuple[Array, Array]:
    """Return the responses at FREQUENCIES_HZ of the simulator with all its states, and of the loop's fixed path."""
    model, axis = linearise(packed, y, TIME_S), int(plane == "yaw")
    gains = follow_of(packed)[0]
    drive = sum(gain[axis] * model.b[:, 2 * group + axis] for group, gain in enumerate(gains))
    out, eye = model.states.index(f"gyro_{plane}_radps"), np.eye(len(model.a))
    theirs = [np.linalg.solve(2j * np.pi * f * eye - model.a, drive)[out] for f in FREQUENCIES_HZ]
    path = fixed_path(node_of(packed, TIME_S, 0, plane), "exact")
    assert isinstance(path, ExactFixedPath)
    states = path.continuous
    ours = path.plant_at(2j * np.pi * FREQUENCIES_HZ)
    np.testing.assert_allclose(states.response(FREQUENCIES_HZ)[:, 0, 0], ours, rtol=1e-9)
    return np.array(theirs), ours


@pytest.mark.slow
@pytest.mark.parametrize(("cant_deg", "more"), [(0.0, [UNLIKE]), (5.0, [UNLIKE]), (0.0, [UNLIKE, SOME])])
def test_unlike_actuators_and_loads_by_group(cant_deg: float, more: list[str]) -> None:
    """Three groups with actuators of order two, four and six agree, two of them on a TVC load."""
    packed = cluster(cant_deg, *more)
    assert int(packed.parameters[0].vehicle.sizes.tvc_loads) == (2 if SOME in more else 0)
    for plane in ("pitch", "yaw"):
        theirs, ours = command_to_gyro(packed, packed.state, plane)
        np.testing.assert_allclose(theirs, ours, rtol=TOLERANCE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("off", "low", "high"),
    [
        ({0: 1.08, 4: 1.08, 2: 0.92, 6: 0.92}, 1e-9, 1e-9),  # within a group
        ({0: 1.08, 4: 1.08, 1: 0.92, 5: 0.92}, 1e-9, 1e-9),  # one group against another
        ({0: 1.08, 3: 0.92}, 2e-2, 1e-4),  # static moments: roll and the other plane join in, below 1 Hz
    ],
)
def test_engines_and_actuators_that_deviate_each_by_itself(off: dict[int, float], low: float, high: float) -> None:
    """Thrusts of single engines and actuators of single groups deviate, and the simulator flies the same allocation."""
    omega, groups = (5.8, 7.2, 52.6), {"a": 1.12, "b": 0.9, "middle": 1.05}

    def actuators(factors: dict[str, float]) -> str:
        each = "{{group='{}',omega_hz={},zeta=[0.87,0.49,0.15,0.042],angle_limit_deg=4.0,rate_limit_degps=25.0}}"
        lists = {group: [*(x * by for x in omega), 15.6] for group, by in factors.items()}
        return f"vehicle.stage.0.actuator=[{','.join(each.format(g, given) for g, given in lists.items())}]"

    base = cluster(0.0, actuators(dict.fromkeys(groups, 1.0)))
    thrust = tuple(off.get(k, 1.0) for k in range(9))
    flown = [f"vehicle.stage.0.engine.{k}.thrust_factor={by!r}" for k, by in off.items()]
    packed = cluster(0.0, actuators(groups), *flown)
    for plane in ("pitch", "yaw"):
        theirs, _ = command_to_gyro(packed, packed.state, plane)
        node = disperse(
            node_of(base, TIME_S, 0, plane), Dispersion(actuator_frequency=(1.12, 0.9, 1.05), thrust=thrust)
        )
        path = fixed_path(node, "exact")
        assert isinstance(path, ExactFixedPath)
        apart = np.abs(theirs / path.plant_at(2j * np.pi * FREQUENCIES_HZ) - 1.0)
        assert apart[FREQUENCIES_HZ < 1.0].max() < low
        assert apart[FREQUENCIES_HZ > 1.0].max() < high


@pytest.mark.slow
def test_what_the_other_axes_do_to_one_plane_after_an_engine_has_gone() -> None:
    """The coefficients of a plane are exact; roll and the other plane couple as docs/model.md, 14, states."""
    packed = cluster(0.0, LOST)
    apart = []
    for plane in ("pitch", "yaw"):
        theirs, ours = command_to_gyro(packed, packed.state, plane)
        apart.append(np.abs(theirs / ours - 1.0))
    worst = np.max(apart, axis=0)
    for above_hz, bound in ((0.05, 8e-2), (0.5, 1e-4), (1.0, 2e-5), (6.0, 1e-6)):
        assert 0.1 * bound < worst[above_hz * (1.0 - 1e-9) <= FREQUENCIES_HZ].max() < bound


@pytest.mark.slow
@pytest.mark.parametrize("frequency_hz", [12.0, 120.0])
def test_canted_engines_on_loads_hang_under_the_axial_load(frequency_hz: float) -> None:
    """The sag S a sin(cant) / k moves thrust, mass and CG: 4e-4 of the response at 5 deg on 12 Hz."""
    packed = cluster(5.0, f"vehicle.stage.0.tvc_load={{frequency_hz={frequency_hz},damping_ratio=0.03}}")
    sizes, y = packed.parameters[0].vehicle.sizes, packed.state.copy()
    assert int(sizes.tvc_loads) == 9
    first = int(tvc_load_index(sizes))
    for _ in range(40):  # to where the engines hang still
        accel = evaluate_at(packed, y, TIME_S).rate[first + 1 : first + 54 : 3]
        y[first : first + 54 : 3] += 0.7 * accel / (2.0 * np.pi * frequency_hz) ** 2
    sag_deg = np.degrees(np.abs(y[first : first + 54 : 3]).max())
    assert sag_deg == pytest.approx(0.0118 * (12.0 / frequency_hz) ** 2, rel=0.01)
    for plane in ("pitch", "yaw"):
        theirs, ours = command_to_gyro(packed, y, plane)
        np.testing.assert_allclose(theirs, ours, rtol=TOLERANCE)


@pytest.mark.parametrize("stiffness_Nmprad", [1e7, 3e5, 2e4])
def test_sag_of_a_mount_of_any_stiffness_is_where_the_moments_balance(stiffness_Nmprad: float) -> None:
    """SciPy finds the sag from the potential k |angle|^2 / 2 - S a cos p cos y, also for a very soft mount."""
    axis = (np.cos(0.1) * np.cos(0.06), -np.sin(0.06), np.sin(0.1) * np.cos(0.06))
    engine = GimballedEngine(
        1e5,
        0.0,
        30.0,
        31.0,
        gimballed_mass_kg=300.0,
        cg_from_gimbal_m=0.9,
        inertia_about_gimbal_kgm2=400.0,
        follower=True,
        tvc_load=TvcLoad(stiffness_Nmprad, 1.0),
        axis=axis,
        across=1.0,
    )
    pull = 300.0 * 0.9 * 25.0

    def potential(angles: Array) -> float:
        bent = np.sum((angles - [0.1, 0.06]) ** 2)
        return float(0.5 * stiffness_Nmprad * bent - pull * np.cos(angles[0]) * np.cos(angles[1]))

    pitch, yaw = scipy.optimize.minimize(potential, [0.1, 0.06], tol=1e-14).x
    x, y, z = engine.hanging(25.0).axis
    np.testing.assert_allclose((np.arctan2(z, x), -np.arcsin(y)), (pitch, yaw), atol=2e-7)
    assert engine.hanging(0.0).axis == pytest.approx(axis, abs=1e-15)


@pytest.mark.parametrize(
    ("swinging", "gains", "felt"),
    [
        ((False, False), (1.0, 0.0), (0, 2)),
        ((True, True), (1.0, 1.0), (0, 1)),
        ((True, False), (1.0, 0.0), (0, 1)),
        ((True, False), (1.0, 1.0), (0, 1, 2)),
    ],
)
def test_engines_on_their_compliance_feel_rates_and_others_accelerations(
    swinging: tuple[bool, ...], gains: tuple[float, ...], felt: tuple[int, ...]
) -> None:
    """The inputs by a drive's angle are complete; an engine fixed in the plane has none of them.

    `felt`: the orders of the derivatives.
    """
    each = zip(swinging, gains, strict=True)
    engines = [SimpleNamespace(drive=0, tvc_load=object() if swings else None, gain=gain) for swings, gain in each]
    vehicle: Any = SimpleNamespace(engines=engines)
    assert inputs_of(vehicle) == tuple(DERIVATIVES[order] for order in felt)
