"""Order of convergence of the whole closed-loop flight, step halving, and agreement with another integrator.

The nominal vehicle with its design, in flight at 25 s, flies five seconds through a gust with everything on: bending,
slosh, actuators, gyros, computer. Quantisation is off, so that the flight depends smoothly on its steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from flightkit import Rig, flown, rig_of
from maxq.control.records import Array
from maxq.sim.dynamics import state as layout
from maxq.sim.scenario.loader import load_scenario
from oracles.reference_flight import fly

DURATION_S = 5.0
START_S = 25.0


def nominal(step_s: float, *more: str) -> Rig:
    """In flight, with wind and a gust ahead."""
    changes = [
        f"run.step_s={step_s!r}",
        f"run.start_s={START_S}",
        "run.duration_s=100.0",
        "switches.converter='ideal'",
        "vehicle.computer.dac_step_deg=0.0",
        "initial.geodetic={latitude_deg=36.7, longitude_deg=126.47, altitude_m=4500.0}",
        "initial.ned_mps=[-46.6, -128.0, -306.0]",  # along the body axis: the rate limit has a kink, and is not met
        "initial.euler_deg=[250.0, 66.0, 180.0]",
        "wind.speed_mps=6.0",
        "wind.from_deg=300.0",
        "wind.gust=[{kind='one-minus-cosine', altitude_m=4600.0, thickness_m=600.0, edge_m=300.0, speed_mps=4.0, "
        "from_deg=200.0}]",
        *more,
    ]
    return rig_of(load_scenario("nominal", changes))


GROUPS = {
    "position": slice(layout.R_I, layout.R_I + 3),
    "velocity": slice(layout.V_I, layout.V_I + 3),
    "attitude": slice(layout.Q_BI, layout.Q_BI + 4),
    "rates": slice(layout.W_BI_B, layout.W_BI_B + 3),
    "actuators": slice(layout.ACTUATOR, layout.ACTUATOR + 12),
    "gyros": slice(layout.GYRO, layout.GYRO + 6),
    "bending": slice(34, 46),
    "slosh": slice(46, 58),
}


@dataclass(frozen=True)
class Flights:
    steps_s: tuple[float, ...]
    ends: tuple[Array, ...]
    finest: Array

    def errors(self, group: str) -> Array:
        return np.array([np.linalg.norm((y - self.finest)[GROUPS[group]]) for y in self.ends])


@pytest.fixture(scope="module")
def flights() -> Flights:
    steps = (0.002, 0.001, 0.0005)
    ends = tuple(flown(nominal(step), DURATION_S)[-1] for step in steps)
    return Flights(steps, ends, flown(nominal(0.000125), DURATION_S)[-1])


def test_flight_moves_everything(flights: Flights) -> None:
    """Otherwise the order would be that of nothing."""
    y = flights.finest
    assert len(y) == 58
    assert np.linalg.norm(y[GROUPS["rates"]]) > 1e-3
    assert np.linalg.norm(y[GROUPS["actuators"]]) > 1e-3
    assert np.max(np.abs(y[GROUPS["bending"]])) > 1e-4


@pytest.mark.parametrize("group", sorted(GROUPS))
def test_closed_loop_flight_converges_with_order_four(flights: Flights, group: str) -> None:
    errors = flights.errors(group)
    order = float(np.polyfit(np.log(flights.steps_s), np.log(errors), 1)[0])
    assert 3.7 < order < 4.6, errors


@pytest.mark.parametrize("group", sorted(GROUPS))
def test_halving_the_step_divides_the_error_by_sixteen(flights: Flights, group: str) -> None:
    errors = flights.errors(group)
    assert np.all(errors[:-1] / errors[1:] > 12.0), errors


def test_reference_integrator_agrees(flights: Flights) -> None:
    """DOP853 at 1e-11 over the same five seconds, against steps of 1/8 ms."""
    theirs = fly(nominal(0.001), DURATION_S)
    ours = flights.finest
    limits = {
        "position": 1e-6, "velocity": 1e-7, "attitude": 1e-9, "rates": 1e-8, "actuators": 1e-7, "gyros": 1e-5,
        "bending": 1e-7, "slosh": 1e-7,
    }  # fmt: skip
    for group, where in GROUPS.items():
        assert np.linalg.norm((ours - theirs)[where]) < limits[group], group


def test_default_step_error_is_what_it_is_said_to_be(flights: Flights) -> None:
    """The default step of 1 ms after five seconds of powered closed-loop flight."""
    error = {group: float(flights.errors(group)[1]) for group in GROUPS}
    assert error["position"] < 1e-4  # m
    assert error["attitude"] < 1e-7  # half radians
    assert error["bending"] < 1e-4  # m, m/s
    assert error["slosh"] < 1e-5
