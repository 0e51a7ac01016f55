"""Many flights as arrays, flown without a log on the CPU or on a CUDA GPU by the same kernel.

    batch = batch_of(flights)              # packed and begun, as `FlightRun` leaves them
    fly_batch(batch, "cuda")
    hand_back(batch, flights)

On the CPU every flight is bit for bit that of `fly`. On a GPU results differ by rounding: products and sums are fused,
and sin, cos, exp, log, pow are CUDA's own (docs/performance.md says by how much).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, pack
from maxq.control.kernel.tables import TableRef
from maxq.sim.flight.arena import ARENA_SIZE
from maxq.sim.flight.loop import Logged, advance
from maxq.sim.packing.flight import Packed
from maxq.sim.vehicle.state import Sizes

Device = Literal["cpu", "cuda"]
SEGMENT_NS = 1_000_000_000  # between two of them a batch can be stopped

_TABLE = tuple(TableRef.__dataclass_fields__)


class DeviceError(Exception):
    """No flight is possible on the device asked for: one line that says why and what to do."""


@dataclass(frozen=True)
class Batch:
    """`parameters` (flights, stages) of Parameters, `pool` with the tables of all.

    `memory` (flights,) of Memory, `state` (flights, MAX_STATE).
    """

    parameters: NDArray[Any]
    pool: Array
    memory: NDArray[Any]
    state: Array


def batch_of(flights: Sequence[Packed]) -> Batch:
    """Flights of equally many stages as one batch, copied; equal pools of tables are held once.

    Raises ValueError for none, and where the numbers of stages differ.
    """
    stages = {len(flight.parameters) for flight in flights}
    if len(stages) != 1:
        raise ValueError(f"a batch has flights of one number of stages, not {sorted(stages)}")
    parameters = np.stack([flight.parameters for flight in flights])
    begins: dict[bytes, int] = {}
    pools: list[Array] = []
    for row, flight in zip(parameters, flights, strict=True):
        content = flight.pool.tobytes()
        if content not in begins:
            begins[content] = sum(map(len, pools))
            pools.append(flight.pool)
        _shift_tables(row, begins[content])
    return Batch(
        parameters,
        np.concatenate(pools),
        np.concatenate([flight.memory for flight in flights]),
        np.stack([flight.state for flight in flights]),
    )


def _shift_tables(rows: NDArray[Any], by: int) -> None:
    """Add `by` to where every table of these records lies."""
    names = rows.dtype.names or ()
    if names == _TABLE:
        rows["offset"] += by
        return
    for name in names:
        if rows.dtype[name].names:
            _shift_tables(rows[name], by)


def hand_back(batch: Batch, flights: Sequence[Packed]) -> None:
    """Memory and state of each flight into what it was packed as."""
    for i, flight in enumerate(flights):
        flight.memory[0], flight.state[:] = batch.memory[i], batch.state[i]


def fly_batch(batch: Batch, device: Device = "cpu", stop: Callable[[], bool] = lambda: False) -> bool:
    """Fly every flight of a batch, begun before, to its end; its `memory` and `state` hold what became of it.

    `stop` is asked after every second of flight (on the GPU: of all flights). False: it has said so, and flights that
    have not ended are as they were. Raises DeviceError.
    """
    step_ns = batch.parameters["course"]["step_ns"][:, 0]
    segment_ns = np.maximum(SEGMENT_NS // step_ns, 1) * step_ns
    if device == "cpu":
        return _fly_in_turn(batch, segment_ns, stop)
    require_gpu()
    from maxq.sim.flight import on_gpu  # noqa: PLC0415  # lazy: only who flies on a GPU has its compiler

    parameters = batch.parameters
    most = on_gpu.room(parameters.shape[1], parameters.dtype.itemsize, batch.memory.dtype.itemsize)
    for first in range(0, len(parameters), most):
        part = slice(first, first + most)
        if not on_gpu.fly_together(
            parameters[part], batch.pool, batch.memory[part], batch.state[part], segment_ns[part], stop
        ):
            return False
    return True


def _fly_in_turn(batch: Batch, segment_ns: NDArray[np.int64], stop: Callable[[], bool]) -> bool:
    arena, no_log = np.zeros(ARENA_SIZE), pack([Logged(0, Sizes(0, 0, 0, 0))])
    times, rows, counts = np.zeros(1, np.int64), np.zeros((1, 1)), np.zeros(2, np.int64)
    for i, period_ns in enumerate(map(int, segment_ns)):
        memory, state = batch.memory[i : i + 1].copy(), batch.state[i].copy()
        while memory["clock"]["finished"][0] == 0:
            if stop():
                return False
            until_ns = (int(memory["clock"]["now_ns"][0]) // period_ns + 1) * period_ns
            advance(
                batch.parameters[i], batch.pool, memory, state, arena, until_ns, no_log, times, rows, times, rows,
                counts,
            )  # fmt: skip
        batch.memory[i], batch.state[i] = memory[0], state
    return True


def require_gpu() -> None:
    """Raises DeviceError unless flights can fly on a CUDA GPU here, or in Numba's simulator of one."""
    if numba.config.ENABLE_CUDASIM:
        if not numba.config.DISABLE_JIT:
            raise DeviceError("device cuda: Numba's simulator (NUMBA_ENABLE_CUDASIM=1) needs NUMBA_DISABLE_JIT=1 too")
        return
    if importlib.util.find_spec("numba_cuda") is None:
        raise DeviceError("device cuda: numba-cuda is not installed; pip install 'maxq[gpu]', or fly with device cpu")
    from numba import cuda  # noqa: PLC0415  # lazy: as above

    if not cuda.is_available():
        raise DeviceError("device cuda: no CUDA GPU with a driver here (see nvidia-smi); fly with device cpu")
