"""Compiled code and its Python source fly the same flight bit for bit, so tests in Python cover the compiled code."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import pytest

from maxq.control.kernel.jit import from_python, kernel, routine
from maxq.control.kernel.records import Array, IntArray, blank

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


@pytest.mark.long
def test_a_flight_without_compiler_is_the_same_to_the_bit() -> None:
    plain, compiled = _fly("1"), _fly("0")
    assert plain.startswith("100 ")
    assert plain == compiled


@dataclass
class Part:
    """A part with arrays of both types."""

    value: Annotated[Array, (3,)]
    number: Annotated[IntArray, (2,)]
    grid: Annotated[Array, (2, 2)]


@dataclass
class Whole:
    """A record with an array of records."""

    mass_kg: float
    part: Annotated[tuple[Part, ...], (4,)]


@kernel
def add_up(values: Any, count: int) -> float:
    """Return the sum of the first `count` values of an array in a record, or of any other array."""
    total = 0.0
    for k in range(count):
        total += values[k]
    return total


def fill(whole: Any, other: Any) -> float:
    for p in range(4):
        part = whole[0].part[p]
        for k in range(3):
            part.value[k] = 10.0 * p + k
        part.number[p % 2] = p
        part.number[1 - p % 2] += 2
        part.grid[1, 0] = part.value[2] + part.number[0]
        part.grid[0, p % 2] = -1.0
    last = whole[0].part[whole[0].part[2].number[0]]
    return add_up(last.value, 2) + 1000.0 * add_up(other, 3) + whole[0].part[3].grid[1, 0]


def test_arrays_in_records_are_the_same_in_compiled_code() -> None:
    """Compare scalars, integers and records, read and written, with a kernel that also takes an array of NumPy."""
    records, others = (blank(Whole), blank(Whole)), np.array([1.0, 2.0, 4.0])
    plain = fill(records[0], others)
    assert from_python(fill)(records[1], others) == plain
    assert plain == 20.0 + 21.0 + 7000.0 + 32.0 + 2.0
    assert records[0].tobytes() == records[1].tobytes()
    assert records[0]["part"]["value"][0].tolist() == [[0, 1, 2], [10, 11, 12], [20, 21, 22], [30, 31, 32]]


@routine
def make_room(count: int) -> int:
    return len(np.empty(count))


@kernel
def room_for(count: int) -> int:
    return make_room(count - 1) + 1


def test_an_error_in_a_called_kernel_reaches_python() -> None:
    """Numba's own code for arrays raises; the status of each call passes the error on."""
    compiled = from_python(room_for)
    assert compiled(4) == 4
    with pytest.raises(ValueError, match="negative dimensions"):
        compiled(0)
