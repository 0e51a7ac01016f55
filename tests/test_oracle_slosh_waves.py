"""Damping that grows with the wave, second modes and tanks given by their shape agree with these references.

| quantity | against |
|---|---|
| decay of a swing with ring baffles, with a smooth wall | closed forms of the averaged oscillator, law of SP-106 |
| the same in a circle | rings damp a conical swing more, by the ratio of peak to mean drag |
| cylinder by its shape | KSR-III's tables, which are closed forms of SP-106 |
| two modes, smooth walls, a sphere: linear model | linearised simulator, 1e-8 |
| rings in small waves | no first-order term |
| breaking wave | first row of the log with such a wave; no influence on the flight |
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flightkit import Parts, Rig, Tank, flown, rig, scenario_of, with_stage
from oracles.planar.plant import vehicle_plant
from oracles.planar.vehicle_at import vehicle_at
from test_oracle_linear_model import TOLERANCE, flat_earth

from maxq import Flight
from maxq.control.kernel.records import Array
from maxq.design.model.held import state_names
from maxq.design.model.linearised import linearise
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle import state as layout
from maxq.sim.vehicle.slosh.packing import pendulums
from maxq.tools.flight_report import verdict_line

RADIUS_M, LENGTH_M, GRAVITY_MPS2, START = 0.5, 0.27, 9.80665, 0.08
OMEGA = math.sqrt(GRAVITY_MPS2 / LENGTH_M)


def swinging(start: tuple[float, float], **tank: Any) -> Rig:
    """Return a pendulum on the pad, at `start` (rad): its swing in the pitch plane, its speed in the yaw plane."""
    parts = Parts(tanks=(Tank(400.0, LENGTH_M, 5.0),), engine=False)
    tree = scenario_of(
        parts,
        earth={"gravity": "uniform"},
        initial={"held": True, "euler_deg": [0.0, 90.0, 0.0]},
        holddown={"release": "time", "release_s": 1000.0},
    )
    table = {
        "time_s": 0.0,
        "slosh_mass_kg": 400.0,
        "pendulum_length_m": LENGTH_M,
        "hinge_station_m": 5.0,
        "liquid_height_m": 1.0,
    }
    made = rig(with_stage(tree, tank=[{"table": [table], "radius_m": RADIUS_M, "bottom_station_m": 6.0} | tank]))
    i = int(layout.pendulum_index(made.sizes, 0))
    pitch, yaw = start
    made.y[i : i + 3] = [-math.cos(pitch), 0.0, math.sin(pitch)]
    made.y[i + 3 : i + 6] = [0.0, yaw * OMEGA, 0.0]
    return made


def amplitudes(made: Rig, duration_s: float) -> tuple[float, float]:
    """Return the swing at the start and at the end, from position and rate."""
    i = int(layout.pendulum_index(made.sizes, 0))
    states = flown(made, duration_s)
    out = [math.hypot(*y[i + 1 : i + 3], *(y[i + 4 : i + 6] / OMEGA)) for y in states]
    return out[0], out[-1]


def test_ring_baffles_damp_a_plane_swing_by_their_law() -> None:
    """With zeta = k sqrt(A),  dA/dt = -omega k A^(3/2)  and  A = A0 / (1 + omega k sqrt(A0) t / 2)^2."""
    width, depth = 0.06, 0.1
    made = swinging((START, 0.0), baffles={"width_m": width, "station_m": [6.0 - 1.0 + depth, 4.5]})  # one is dry
    cover = 1.0 - (1.0 - width / RADIUS_M) ** 2
    k = 2.83 * math.exp(-4.6 * depth / RADIUS_M) * cover**1.5 * math.sqrt(2.0 / (1.84118**2 - 1.0))
    duration = 20.0
    before, after = amplitudes(made, duration)
    assert before == pytest.approx(START, rel=2e-3)
    wanted = START / (1.0 + 0.5 * OMEGA * k * math.sqrt(START) * duration) ** 2
    assert wanted < 0.5 * START
    assert after == pytest.approx(wanted, rel=0.015)


def test_ring_baffles_damp_a_conical_swing_more() -> None:
    """In a steady circle the drag is always at its peak: zeta is RING_DRAG = 1.0925 times that of a plane swing."""
    made = swinging((START, START), baffles={"width_m": 0.06, "station_m": [5.1]})
    cover = 1.0 - (1.0 - 0.06 / RADIUS_M) ** 2
    k = 2.83 * math.exp(-0.92) * cover**1.5 * math.sqrt(2.0 / (1.84118**2 - 1.0))
    k *= 0.5 * math.sqrt(math.pi) * math.gamma(2.25) / math.gamma(1.75)
    before, after = (a / math.sqrt(2.0) for a in amplitudes(made, 20.0))
    assert before == pytest.approx(START, rel=3e-3)
    assert after == pytest.approx(START / (1.0 + 10.0 * OMEGA * k * math.sqrt(START)) ** 2, rel=0.015)


def test_smooth_wall_damps_by_its_formula() -> None:
    nu, h = 1e-4, 1.0 / RADIUS_M
    made = swinging((START, 0.0), viscosity_m2ps=nu)
    zeta = 0.79 * math.sqrt(nu / math.sqrt(GRAVITY_MPS2 * RADIUS_M**3))
    zeta *= 1.0 + 0.318 / math.sinh(1.84 * h) * (1.0 + (1.0 - h) / math.cosh(1.84 * h))
    before, after = amplitudes(made, 20.0)
    assert math.log(before / after) / (20.0 * OMEGA) == pytest.approx(zeta, rel=5e-3)


DENSITY = 1141.0


def cylinder(**more: Any) -> str:
    """Return KSR-III's LOX tank by its shape, in TOML."""
    stage = load_scenario("nominal").vehicle.stage[0]
    table = stage.tank[0].table
    masses = DENSITY * math.pi * 0.49**2 * table["liquid_height_m"]
    rows = slice(None, None, 20)
    entries = {"time_s": [*table["time_s"][rows], 70.0], "liquid_mass_kg": [*masses[rows], masses[-1]]}
    columns = ", ".join(f"{k} = [{', '.join(repr(float(x)) for x in v)}]" for k, v in entries.items())
    keys = {"radius_m": 0.49, "height_m": 3.2, "bottom_station_m": 11.1, "density_kgpm3": DENSITY} | more
    written = ", ".join(f"{k} = {v!r}".replace("'", '"') for k, v in keys.items())
    return f'{{name = "lox", shape = "cylinder", table = {{{columns}}}, {written}}}'


SPHERE = (
    '{name = "jeta1", shape = "sphere", radius_m = 0.49, bottom_station_m = 5.45, density_kgpm3 = 800.0, modes = 2, '
    "viscosity_m2ps = 1.5e-5, second_damping_ratio = 0.01, "
    "table = {time_s = [0.0, 60.0], liquid_mass_kg = [300.0, 20.0]}}"
)


def test_cylinder_by_its_shape_has_the_pendulum_of_the_closed_forms() -> None:
    plain = load_scenario("nominal").vehicle.stage[0]
    override = f"vehicle.stage.0.tank=[{cylinder(damping_ratio=0.02)}, {SPHERE}]"
    shaped = pendulums(load_scenario("nominal", [override]).vehicle.stage[0])[0]
    table = plain.tank[0].table
    full = DENSITY * math.pi * 0.49**2
    for time_s in (0.0, 10.0, 30.0, 50.0, 54.0):
        mass, length, hinge = shaped.joined.at([time_s])[0]
        height = float(np.interp(time_s, table["time_s"], table["liquid_height_m"]))
        share = 2.0 * math.tanh(1.84118 * height / 0.49) * 0.49 / (1.84118 * height * (1.84118**2 - 1.0))
        assert mass == pytest.approx(full * height * share, rel=3e-3)
        assert length == pytest.approx(np.interp(time_s, table["time_s"], table["pendulum_length_m"]), rel=3e-3)
        assert hinge == pytest.approx(np.interp(time_s, table["time_s"], table["hinge_station_m"]), abs=3e-3)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly(load_scenario("nominal", ["run.duration_s=56"]))


@pytest.mark.slow
@pytest.mark.parametrize("plane", ["pitch", "yaw"])
def test_linear_model_of_two_modes_and_smooth_walls(flight: Flight, plane: str) -> None:
    """The model agrees for four pendulums: a cylinder's two with the wall's damping, and a sphere's two."""
    tanks = f"vehicle.stage.0.tank=[{cylinder(modes=2, viscosity_m2ps=1.9e-7, damping_ratio=0.004)}, {SPHERE}]"
    packed, condition = flat_earth(flight, 40, tanks)
    simulated = linearise(packed, packed.state, 40)
    vehicle = vehicle_at(packed, 40, condition.mach, "pitch" if plane == "pitch" else "yaw")
    assert len(vehicle.pendulums.mass_kg) == 4
    assert (vehicle.pendulums.viscous > 0.0).all()
    ours = vehicle_plant(vehicle, condition)
    bend, motion = (
        ("eta", ("w_mps", "q_radps", "theta_rad")) if plane == "pitch" else ("xi", ("v_mps", "r_radps", "psi_rad"))
    )
    names = [*motion, *(f"{bend}_{i}{w}" for w in ("_m", "_rate_mps") for i in (1, 2, 3))]
    names += [f"slosh_{k}_{plane}{w}" for w in ("_rad", "_rate_radps") for k in (1, 2, 3, 4)]
    assert len(names) == len(state_names(3, 4))
    at = [simulated.states.index(name) for name in names]
    sign = np.array([-1.0 if plane == "yaw" and name in motion[1:] else 1.0 for name in names])
    theirs = sign[:, None] * simulated.a[np.ix_(at, at)] * sign
    np.testing.assert_allclose(theirs, ours.a, rtol=TOLERANCE, atol=1e-8)
    less = replace(vehicle, pendulums=replace(vehicle.pendulums, viscous=0.0 * vehicle.pendulums.viscous))
    assert np.abs(vehicle_plant(less, condition).a - ours.a).max() > 1e-3  # the wall's damping is seen


def test_rings_do_nothing_in_small_waves() -> None:
    """Their part of the derivative falls with the power 3/2 of the swing's rate."""
    plain, ringed = (
        swinging((0.0, 0.0), damping_ratio=0.0),
        swinging((0.0, 0.0), baffles={"width_m": 0.06, "station_m": [5.1]}),
    )
    i = int(layout.pendulum_index(plain.sizes, 0))

    def part(rate: float) -> float:
        y = plain.y.copy()
        y[i + 5] = rate
        found: Array = ringed.derivative(y) - plain.derivative(y)
        return float(np.abs(found[i + 3 : i + 6]).max())

    assert part(1e-2) > 0.0
    assert part(1e-6) / part(1e-2) == pytest.approx(1e-6, rel=1e-3)


BREAKS = ("run.duration_s=30", "vehicle.stage.0.tank.1.breaking_height_m=0.02")


@pytest.mark.slow
def test_wave_that_breaks_is_reported_and_changes_nothing() -> None:
    calm = fly(load_scenario("nominal", BREAKS[:1]))
    broken = fly(load_scenario("nominal", [*BREAKS, "vehicle.stage.0.tank.1.viscosity_m2ps=1e-10"]))
    found = [e for e in broken.events if e.name == "wave_breaking"]
    assert [e.detail.split(":")[0] for e in found] == ["tank Jet A-1"]
    waves, time_s = broken["slosh_jeta1_wave_m"], broken.time_s("slosh_jeta1_wave_m")
    lifted = time_s >= broken.event_s("liftoff")
    first = float(time_s[lifted & (waves >= 0.02)][0])
    assert found[0].time_s == pytest.approx(first, abs=2e-3)
    swing = np.radians(np.hypot(broken["slosh_jeta1_pitch_deg"], broken["slosh_jeta1_yaw_deg"]))
    np.testing.assert_allclose(waves, 0.49 * 2.0 / (1.84118378**2 - 1.0) * np.sin(swing), rtol=2e-3, atol=1e-9)
    assert broken.metrics["max_wave_share"] == pytest.approx(np.nanmax(waves[lifted]) / 0.02, rel=1e-3)
    assert "beyond the model: wave breaks at" in verdict_line(broken)
    assert not calm.beyond_model
    assert 0.0 < calm.metrics["max_wave_share"] < 0.5
    marked = fly(load_scenario("nominal", BREAKS))
    assert marked.state_hash == calm.state_hash
    assert "slosh_jeta1_wave_m" not in marked.table.names
