"""Bending moments of the linear plant equal the simulator's section loads.

| quantity | oracle |
|---|---|
| every coefficient of the moment by states and engine, both planes | the simulator's section loads, linearised: 1e-8 |
| the same with tables at a trim, liquid that moves to the core, an inconsistent line mass | likewise |
| by the wind | the simulator's section loads in constant side winds |
| rms in turbulence with the loop closed | 24 flights through it |
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from design_nodes import frozen
from flightkit import Rig
from oracles.planar.plant import vehicle_plant
from oracles.planar.vehicle_at import vehicle_at
from test_oracle_aero_tables_linear import inclined, symmetric
from test_oracle_linear_model import flat_earth, plane_states
from zero_incidence import zero_incidence

import maxq
from maxq import Flight, LoadedScenario
from maxq.control.kernel.records import Array
from maxq.design.laws.wind import MOMENTS, Spectrum
from maxq.design.loop.wind import wind_response
from maxq.design.model.instruments import actuator
from maxq.design.model.linearised import linearise
from maxq.design.model.node import node_of, with_cuts
from maxq.design.model.state_space import StateSpace
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.loads.columns import MOMENT_Z

TOLERANCE = 1e-8
ON = "switches.section_loads=true"


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly(load_scenario("nominal", ["run.duration_s=56"]))


def simulated(model, plane: str, names: list[str]) -> Array:
    """Return the moments by states of a plane, in its mirrored axes: (stations, names)."""
    rows = [k for k, name in enumerate(model.outputs) if name.startswith(f"bending_{plane}")]
    turned = ("r_radps", "psi_rad", "actuator_yaw")
    sign = np.array([-1.0 if name.startswith(turned) else 1.0 for name in names])
    by = model.c[np.ix_(rows, [model.states.index(name) for name in names])]
    return np.asarray((1.0 if plane == "pitch" else -1.0) * by * sign)


def with_engine(body: StateSpace, packed: Packed, plane: str) -> Array:
    """Return the moments of the model by its states and those of the actuator."""
    row = packed.parameters[0].vehicle
    moves = actuator(row.actuator_pitch if plane == "pitch" else row.actuator_yaw)
    rows = [k for k, name in enumerate(body.outputs) if name.startswith("bending")]
    drives = [moves.outputs.index(name) for name in body.inputs]
    return np.concatenate([body.c[rows], body.d[rows] @ moves.c[drives]], axis=1)


def agree(theirs: Array, ours: Array) -> None:
    """Check each coefficient to 1e-8 of itself and 1e-9 of the largest over all stations by the same state."""
    assert (np.abs(ours - theirs) <= TOLERANCE * np.abs(theirs) + 1e-9 * np.abs(ours).max(axis=0) + 1e-6).all()


@pytest.mark.parametrize(("time_s", "more"), [(15, ()), (40, ()), (55, ("switches.slosh_exchange=true",))])
def test_every_coefficient_is_the_simulators(flight: Flight, time_s: float, more: tuple[str, ...]) -> None:
    packed, condition = flat_earth(flight, time_s, ON, *more)
    model = linearise(packed, packed.state, time_s)
    for plane in ("pitch", "yaw"):
        body = vehicle_plant(vehicle_at(packed, time_s, condition.mach, plane), condition)
        ours = with_engine(body, packed, plane)
        assert ours.shape == (16, ours.shape[1])
        agree(simulated(model, plane, plane_states(plane)[: ours.shape[1]]), ours)


def loaded() -> dict[str, Any]:
    """Return a line mass unlike the vehicle's, with shares of drag; all liquid is in the pendulum bob."""
    line = [{"front_station_m": 0.0, "rear_station_m": 11.5, "mass_kg": 3000.0}]
    liquid = [
        {"tank": "1", "bottom_station_m": 6.0, "table": {"time_s": [0.0], "mass_kg": [700.0], "front_station_m": [4.5]}}
    ]
    return {
        "stations_m": [2.0, 4.2, 5.5, 7.0, 9.0, 10.9],
        "line_mass": line,
        "liquid": liquid,
        "tolerance": 1.0,
        "axial_force": {"station_m": [0.5, 8.0], "share": [0.7, 0.3]},
    }


@pytest.mark.parametrize("trim_deg", [(0.0, 0.0), (4.0, -3.0)])
def test_with_tables_over_incidence(trim_deg: tuple[float, float]) -> None:
    """The moments agree with two such tables, and surfaces over Mach number, cross-flow and drag."""
    made: Rig = inclined(trim_deg, symmetric()["coefficients"], loads=loaded(), switches={"section_loads": True})
    model = linearise(made.packed, made.packed.state, 0.0)
    for plane, shape in (("pitch", "eta"), ("yaw", "xi")):
        node = node_of(made.packed, 0.0, plane=plane)
        body = node.plant
        names = ["w_mps", "q_radps", "theta_rad"] if plane == "pitch" else ["v_mps", "r_radps", "psi_rad"]
        names += [f"{shape}_{i}_m" for i in (1, 2)] + [f"{shape}_{i}_rate_mps" for i in (1, 2)]
        names += [f"slosh_1_{plane}_rad", f"slosh_1_{plane}_rate_radps"]
        rows = [k for k, name in enumerate(body.outputs) if name.startswith("bending")]
        agree(simulated(model, plane, names), body.c[rows])


def test_winds_column_is_the_simulators() -> None:
    both, node = [], frozen(40.0, ON, plane="yaw")[1]
    for from_deg in (270.0, 90.0):
        packed = pack_flight(frozen(40.0, ON, "wind.speed_mps=0.0002", f"wind.from_deg={from_deg}")[0].scenario)
        both.append(evaluate_at(packed, zero_incidence(packed, packed.state), 40.0).sections[:, MOMENT_Z])
    body = node.plant_in_wind()
    rows = [k for k, name in enumerate(body.outputs) if name.startswith("bending")]
    ours = -body.d[rows, body.inputs.index("wind_mps")]
    np.testing.assert_allclose((both[0] - both[1]) / 4e-4, ours, rtol=1e-5, atol=1e-5 * np.abs(ours).max())


# --- turbulence
SIGMA_MPS, LENGTH_M, FLIGHTS = 2.0, 533.0, 24
PICKED = (0, 3, 6, 9, 12)  # stations at 1, 3.6, 6, 8.1 and 11 m
TICK_S = 0.01


def through(*more: str) -> LoadedScenario:
    given = ('design="designs/ksr3-default.toml"', "run.duration_s=43", ON, "log.slow_hz=200")
    return load_scenario("nominal", [*given, *more])


def moments(scenario: LoadedScenario) -> Array:
    """Return the moments of both planes between 38 and 42 s, (2, stations, instants)."""
    flown = fly(scenario)
    names = [[f"section_{k + 1}_bending_{plane}_Nm" for k in PICKED] for plane in ("pitch", "yaw")]
    time_s = flown.time_s(names[0][0])
    return np.array([[flown[name][(time_s > 38.0) & (time_s < 42.0)] for name in of] for of in names])


@pytest.mark.long
@pytest.mark.slow  # 24 flights
def test_rms_is_that_of_flights_through_turbulence() -> None:
    """The rms agrees; the part below 5 Hz is at least a fifth smaller, because of the bending modes.

    The simulator's turbulence is drawn every tick and linear between ticks. For a spectrum proportional to 1 / f^2,
    images and interpolation give the spectrum times sinc^2.
    """
    sigmas = ", ".join(f"sigma_{axis}_mps=[{s}, {s}]" for axis, s in zip("uvw", (1e-3, 2.0, 2.0), strict=True))
    lengths = ", ".join(f"length_{axis}_m={LENGTH_M}" for axis in "uvw")
    turbulence = f"wind.turbulence={{{lengths}, table={{altitude_m=[0.0, 50000.0], {sigmas}}}}}"
    still = moments(through())
    squares = [
        ((moments(through(turbulence, f"run.seed={seed}")) - still) ** 2).mean(axis=2) for seed in range(1, FLIGHTS + 1)
    ]
    flown = np.sqrt(np.mean(squares, axis=0))
    assert flown[1] == pytest.approx(flown[0], rel=0.05)
    means: dict[float, list[Array]] = {5.0: [], 49.0: []}
    for node in with_cuts(maxq.nodes(through(), [38.5, 39.5, 40.5, 41.5]), through()):
        loop = maxq.loop(node, "designs/ksr3-default")
        loop.fixed.measurements = loop.law.inputs
        stations = tuple(node.vehicle.cut_stations_m[k] for k in PICKED)
        for top_hz, found in means.items():
            wind = wind_response(loop.fixed, Spectrum(SIGMA_MPS, LENGTH_M, "dryden", (0.001, top_hz)), stations)
            hz = np.exp(wind.x)
            wind = replace(wind, weights=wind.weights * np.sinc(hz * TICK_S) ** 2)
            law = loop.law.response(hz)
            found.append(wind.rms(range(MOMENTS, MOMENTS + len(PICKED)), law, np.zeros((*law.shape, 0)))[0])
    whole, slow = (np.sqrt(np.mean(np.square(found), axis=0)) for found in (means[49.0], means[5.0]))
    assert np.sqrt(np.mean(squares, axis=(0, 1))) == pytest.approx(whole, rel=0.04)
    assert (slow < 0.85 * whole).all()
