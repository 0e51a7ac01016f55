"""The flight loop on a CUDA GPU: one thread flies one flight.

State and arena of 32 flights lie interleaved, (blocks, length, 32): the same number of neighbouring flights lies side
by side, so that the threads of a warp, which do the same at the same time, read and write one stretch of memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import NDArray

from maxq.control.kernel.jit import LANES, on_device
from maxq.control.kernel.records import Array, IntArray, pack
from maxq.sim.flight.arena import ARENA_SIZE
from maxq.sim.flight.loop import Logged, advance
from maxq.sim.vehicle.state import MAX_STATE, Sizes

_OF_MEMORY = 0.8  # share of the GPU's free memory that flights may take


def _fly_on(
    parameters: Any, pool: Array, memory: Any, state: Array, arena: Array, segment_ns: IntArray, finished: IntArray,
    logged: Any, times: IntArray, rows: Array, counts: IntArray,
) -> None:  # fmt: skip
    """Every thread: its flight to the next multiple of its segment; `finished` is 1 where the flight has ended."""
    flight = cuda.grid(1)
    if flight < len(segment_ns):
        block, lane = flight // LANES, flight % LANES
        own = memory[flight : flight + 1]
        until_ns = (own[0].clock.now_ns // segment_ns[flight] + 1) * segment_ns[flight]
        advance(
            parameters[flight], pool, own, state[block, :, lane], arena[block, :, lane], until_ns, logged, times,
            rows, times, rows, counts,
        )  # fmt: skip
        finished[flight] = own[0].clock.finished


fly_on = on_device(_fly_on)


def room(stages: int, parameters_bytes: int, memory_bytes: int) -> int:
    """How many flights the GPU's free memory holds, at least one block of them."""
    free_bytes, _ = cuda.current_context().get_memory_info()
    each = stages * parameters_bytes + memory_bytes + 8 * (MAX_STATE + ARENA_SIZE + 2)
    lent_bytes = int(min(_OF_MEMORY * free_bytes, 1e18))  # the simulator says that it has no end of memory
    return max(lent_bytes // each // LANES * LANES, LANES)


def fly_together(
    parameters: NDArray[Any], pool: Array, memory: NDArray[Any], state: Array, segment_ns: IntArray,
    stop: Callable[[], bool],
) -> bool:  # fmt: skip
    """Fly all flights to their end, side by side, on the GPU; `memory` and `state` (flights, MAX_STATE) are written.

    False where `stop`, asked after every segment, has said so: then nothing is written.
    """
    flights = len(memory)
    blocks = -(-flights // LANES)
    laid = np.zeros((blocks * LANES, MAX_STATE))
    laid[:flights] = state
    laid = np.ascontiguousarray(laid.reshape(blocks, LANES, MAX_STATE).transpose(0, 2, 1))
    lent = [cuda.to_device(a) for a in (parameters, pool, memory, laid, np.zeros((blocks, ARENA_SIZE, LANES)))]
    finished = cuda.to_device(np.zeros(flights, np.int64))
    no_log = cuda.to_device(pack([Logged(0, Sizes(0, 0, 0, 0))]))
    nothing = [cuda.to_device(a) for a in (np.zeros(1, np.int64), np.zeros((1, 1)), np.zeros(2, np.int64))]
    periods = cuda.to_device(segment_ns)
    while not finished.copy_to_host().all():
        if stop():
            return False
        # one warp a block: a thread fills its registers, and small blocks spread a batch over the whole GPU
        fly_on[blocks, LANES](*lent, periods, finished, no_log, *nothing)
    memory[:] = lent[2].copy_to_host()
    state[:] = lent[3].copy_to_host().transpose(0, 2, 1).reshape(-1, MAX_STATE)[:flights]
    return True
