"""Provide operating points of the nominal flight, which is flown once for all tests."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import scipy.optimize

import maxq
from maxq import Flight, LoadedScenario, Loop, Node
from maxq.design.loop.fixed_path import folded
from maxq.design.model.held import FlightCondition, hold_stage, table_clock_s
from maxq.design.model.instruments import instruments_of
from maxq.design.model.vehicle_at import without_bending
from maxq.design.operating_points import published_nodes
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.scenario.schema_design import Design
from maxq.sim.vehicle import schedule

TIMES_S = tuple(float(t) for t in range(5, 60, 5))  # the paper's


@cache
def nominal(*overrides: str) -> LoadedScenario:
    """Return the vehicle with the hand-made design, so that numbers in tests are independent of the optimiser."""
    return load_scenario("nominal", ['design="designs/ksr3-default.toml"', *overrides])


@cache
def flown(plane: str = "pitch", *overrides: str) -> tuple[Node, ...]:
    return tuple(maxq.nodes(nominal(*overrides), TIMES_S, plane=plane))


@cache
def published(plane: str = "pitch", *overrides: str) -> tuple:
    """Return the operating points with the published equations of design/paper."""
    return tuple(published_nodes(nominal(*overrides), TIMES_S, plane=plane))


def published_at(time_s: float, plane: str = "pitch", *overrides: str):
    return published(plane, *overrides)[TIMES_S.index(time_s)]


def node_at(time_s: float, plane: str = "pitch", *overrides: str) -> Node:
    return flown(plane, *overrides)[TIMES_S.index(time_s)]


def design() -> Design:
    found = nominal().design
    assert found is not None
    return found


def without(node: Node, *, modes: bool = False, tanks: bool = False) -> Node:
    """Return the operating point without its bending modes, or without its pendulums and their mass."""
    held = without_bending(node.held) if modes else node.held.copied()
    for k in range(len(held.swing_rad) if tanks else 0):
        column = schedule.tank_column(k)
        held.properties[:, [column + schedule.TANK_MASS, column + schedule.TANK_MASS_RATE]] = 0.0
    return dataclasses.replace(node, held=held)


def ideal(node: Node, *, actuator: bool = False, gyro: bool = False) -> Node:
    """Return the operating point with an ideal actuator or gyro."""
    i = node.instruments
    changed = dataclasses.replace(
        i,
        actuators=tuple(dataclasses.replace(a, ideal=1) for a in i.actuators) if actuator else i.actuators,
        gyro=dataclasses.replace(i.gyro, ideal=1) if gyro else i.gyro,
    )
    return dataclasses.replace(node, instruments=changed)


def closed_damping(loop: Loop) -> dict[str, float]:
    """Return the damping ratio of each lightly damped bending and slosh pole of the closed loop, by label.

    The poles are followed from the open loop while both gains rise together from zero.
    """
    followed = [r for r in loop.fixed.resonances() if r.kind in ("bending", "slosh")]
    if not followed:
        return {}
    period = loop.sample_s
    poles = np.array([r.pole_radps for r in followed])
    if period is not None:
        poles = folded(poles, period)
        poles = poles.real + 1j * np.abs(poles.imag)
    for share in np.linspace(0.0, 1.0, 31)[1:] ** 2:
        now = dataclasses.replace(loop, law=loop.law.scaled(share)).closed_poles()
        _, nearest = scipy.optimize.linear_sum_assignment(np.abs(poles[:, None] - now[None, :]))
        poles = now[nearest]
    return {r.label: float(-p.real / abs(p)) for r, p in zip(followed, poles, strict=True)}


def frozen(time_s: float, *overrides: str, plane: str = "pitch") -> tuple[LoadedScenario, Node]:
    """Return a scenario that starts at a point of the nominal flight with the vehicle's clock stopped, and the point.

    The Earth is flat.
    """
    node = node_at(time_s)
    path, speed = node.condition.pitch_rad, node.condition.airspeed_mps
    altitude = {5.0: 172.0, 40.0: 7200.0, 55.0: 16000.0}[time_s]
    velocity = [float(speed * np.cos(path)), 0.0, float(-speed * np.sin(path))]
    loaded = load_scenario(
        "nominal",
        [
            'design="designs/ksr3-default.toml"',
            "earth.shape='flat'",
            "earth.rotating=false",
            "earth.gravity='uniform'",
            f"run.start_s={time_s}",
            f"run.freeze_vehicle_at_s={time_s}",
            "run.duration_s=1.0",
            "switches.converter='ideal'",
            "switches.actuator='linear'",
            "switches.guidance=false",
            "vehicle.computer.dac_step_deg=0",
            "log.fast_hz=1000",
            "initial.geodetic.latitude_deg=0",
            "initial.geodetic.longitude_deg=0",
            f"initial.geodetic.altitude_m={altitude}",
            f"initial.euler_deg=[0, {float(np.degrees(path))!r}, 0]",
            f"initial.ned_mps={velocity!r}",
            *overrides,
        ],
    )
    packed = pack_flight(loaded.scenario)
    air = evaluate_at(packed, packed.state, time_s).aux.air
    condition = FlightCondition(
        time_s,
        float(air.airspeed_mps),
        float(air.density_kgpm3),
        float(air.pressure_Pa),
        float(air.mach),
        path,
        9.80665,
    )
    held = hold_stage(packed, table_clock_s(packed.parameters[0], time_s))
    instruments = instruments_of(packed.parameters[0], plane)
    return loaded, Node(time_s=time_s, held=held, condition=condition, instruments=instruments, plane=plane)


def agrees_with_a_kick(loop: Loop, plain: Flight, kicked: Flight, command: str, node_s: float, kick_deg: float) -> None:
    """Check that two flights, of which one has a kick in one command sample, differ as the sampled loop predicts.

    Fifty samples of the command after the kick are compared.
    """
    t = plain.time_s(command) - node_s
    at = [int(np.argmin(np.abs(t - (0.01 * (k + 1) + 0.0045)))) for k in range(50)]
    difference = (kicked[command] - plain[command])[at]
    s = loop.state_space()
    x, ours = np.zeros(len(s.a)), np.zeros(50)
    for k in range(50):
        ours[k] = ((kick_deg if k == 0 else 0.0) - s.c[0] @ x) / (1.0 + s.d[0, 0])
        x = s.a @ x + s.b[:, 0] * ours[k]
    np.testing.assert_allclose(difference, ours, atol=0.02 * np.abs(ours[1:]).max())
