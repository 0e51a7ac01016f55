"""Compiled code and its Python source fly the same flight bit for bit, so tests in Python cover the compiled code."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

SEGMENT = """
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
start = 20.0
overrides = [
    f"run.start_s={start}", "run.duration_s=0.1", "holddown.release=time", f"holddown.release_s={start}",
    "wind.speed_mps=20", "wind.from_deg=300", "wind.turbulence.exceedance=moderate",
    "vehicle.stage.0.gyro.noise_deg_rt_h=0.01", "vehicle.stage.0.actuator.backlash_deg=0.02",
]
flight = fly(load_scenario("nominal", overrides))
print(flight.steps, flight.state_hash, repr(flight["q_alpha_Padeg"][-1]), repr(flight["slosh_lox_pitch_deg"][-1]))
"""


def _fly(disable_jit: str) -> str:
    environment = os.environ | {"NUMBA_DISABLE_JIT": disable_jit}
    done = subprocess.run(
        [sys.executable, "-c", SEGMENT], env=environment, capture_output=True, text=True, check=True, timeout=300
    )
    return done.stdout


@pytest.mark.slow
def test_a_flight_without_compiler_is_the_same_to_the_bit() -> None:
    plain, compiled = _fly("1"), _fly("0")
    assert plain.startswith("100 ")
    assert plain == compiled
