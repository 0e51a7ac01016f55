"""What the core can do: rates of the simplest kernels, compiled as the flight is (no fused multiply-add, no
fastmath).
"""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np

from maxq.control.kernel.jit import entry
from maxq.control.kernel.records import Array

TURNS = 4_000_000
REPETITIONS = 5
BLOCK = 512  # numbers that a vector kernel works on: they stay in the first-level cache


@entry
def one_chain(turns: int, a: float, b: float) -> float:
    """Multiply and add, each waiting for the one before: two operations a turn."""
    x = a
    for _ in range(turns):
        x = x * a + b
    return x


@entry
def many_chains(turns: int, a: float, b: float) -> float:
    """Twelve such chains side by side, more than the core has to wait for: 24 operations a turn."""
    c, d, e, f, g, h = 1.0, 2.0, 3.0, 4.0, 5.0, 6.0
    i, j, k, m, n, o = 7.0, 8.0, 9.0, 10.0, 11.0, 12.0
    for _ in range(turns):
        c, d, e, f, g, h = c * a + b, d * a + b, e * a + b, f * a + b, g * a + b, h * a + b
        i, j, k, m, n, o = i * a + b, j * a + b, k * a + b, m * a + b, n * a + b, o * a + b
    return c + d + e + f + g + h + i + j + k + m + n + o


@entry
def vectors(turns: int, values: Array, a: float, b: float) -> None:
    """Sixteen operations on every number of a block in turn: the compiler puts several into one register."""
    for _ in range(turns):
        for i in range(values.size):
            x = values[i]
            x = x * a + b
            x = x * a + b
            x = x * a + b
            x = x * a + b
            x = x * a + b
            x = x * a + b
            x = x * a + b
            x = x * a + b
            values[i] = x


@entry
def divisions(turns: int, a: float, b: float) -> float:
    """Divisions that wait for one another: one a turn."""
    x = a
    for _ in range(turns):
        x = b / (x + a)
    return x


def _best(call: Any) -> float:
    call()
    times = []
    for _ in range(REPETITIONS):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return min(times)


def measure() -> dict[str, float]:
    """Rates in 1e9 operations a second, and how long a dependent addition plus division takes (ns)."""
    a, b, block = 0.999, 0.001, np.ones(BLOCK)
    blocks = TURNS // BLOCK
    return {
        "chain_gflops": round(2e-9 * TURNS / _best(lambda: one_chain(TURNS, a, b)), 2),
        "scalar_gflops": round(24e-9 * TURNS / _best(lambda: many_chains(TURNS, a, b)), 2),
        "vector_gflops": round(16e-9 * BLOCK * blocks / _best(lambda: vectors(blocks, block, a, b)), 2),
        "add_divide_ns": round(1e9 * _best(lambda: divisions(TURNS, a, b)) / TURNS, 2),
    }


if __name__ == "__main__":
    print(json.dumps(measure()))
