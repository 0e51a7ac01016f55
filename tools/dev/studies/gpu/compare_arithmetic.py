"""By how much do flights differ that a GPU's arithmetic flies? Asked without a GPU (device_code.py).

    python -m maxq.tools.dev.studies.gpu.compare_arithmetic LIBDEVICE FOLDER RUNS [KEY=VALUE ...]

LIBDEVICE: libdevice.10.bc from the package nvidia-cuda-nvcc-cu12. Flies dispersed nominal flights by the CPU's kernel
and by the GPU's, twice: without fused products and sums, so that CUDA's own sin, cos, exp, log and pow are all that
differs, and with them.
"""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

import numpy as np

from maxq.control.kernel.records import pack
from maxq.sim.api import FlightRun, load_scenario
from maxq.sim.flight.arena import ARENA_SIZE
from maxq.sim.flight.loop import Logged
from maxq.sim.flight.metrics import METRICS
from maxq.sim.run.batch import SEGMENT_NS, Batch, batch_of, fly_batch
from maxq.sim.vehicle.state import MAX_STATE, Sizes
from maxq.tools.dev.studies.gpu.device_code import build, device_code

LANES = 32


def begun(number: int, overrides: list[str]) -> FlightRun:
    rng = np.random.default_rng(number)
    dispersed = [
        f"wind.speed_mps={rng.uniform(0.0, 25.0)}", f"wind.from_deg={rng.uniform(0.0, 360.0)}",
        "wind.turbulence.exceedance=moderate", f"run.seed={number}",
        "vehicle.stage.0.gyro.noise_deg_rt_h=0.01", "vehicle.stage.0.actuator.backlash_deg=0.02",
    ]  # fmt: skip
    return FlightRun(load_scenario("nominal", [*dispersed, *overrides]), log=False)


def fly_by_library(library: Path, kernel: str, batch: Batch) -> None:
    """What `on_gpu.fly_together` does, thread after thread."""
    loaded = ctypes.CDLL(str(library))
    function = getattr(loaded, kernel)
    block, lane = (ctypes.c_int32.in_dll(loaded, name) for name in ("block", "lane"))
    flights = len(batch.memory)
    blocks = -(-flights // LANES)
    state = np.zeros((blocks * LANES, MAX_STATE))
    state[:flights] = batch.state
    state = np.ascontiguousarray(state.reshape(blocks, LANES, MAX_STATE).transpose(0, 2, 1))
    finished = np.zeros(flights, np.int64)
    arrays = (
        batch.parameters, batch.pool, batch.memory, state, np.zeros((blocks, ARENA_SIZE, LANES)),
        np.full(flights, SEGMENT_NS), finished, pack([Logged(0, Sizes(0, 0, 0, 0))]), np.zeros(1, np.int64),
        np.zeros((1, 1)), np.zeros(2, np.int64),
    )  # fmt: skip
    arguments: list[ctypes.c_void_p | ctypes.c_int64] = []
    for array in arrays:  # as Numba hands over an array: owner, parent, items, item size, data, shape, strides
        arguments += [
            ctypes.c_void_p(0),
            ctypes.c_void_p(0),
            ctypes.c_int64(array.size),
            ctypes.c_int64(array.itemsize),
        ]
        arguments += [ctypes.c_void_p(array.ctypes.data), *map(ctypes.c_int64, (*array.shape, *array.strides))]
    while not finished.all():
        for flight in np.flatnonzero(finished == 0):
            block.value, lane.value = divmod(int(flight), LANES)
            function(*arguments)
    batch.state[:] = state.transpose(0, 2, 1).reshape(-1, MAX_STATE)[:flights]


def differences(name: str, batch: Batch, reference: Batch) -> None:
    value, expected = (b.memory["extremes"]["value"] for b in (batch, reference))
    largest = np.maximum(np.abs(expected), np.finfo(float).tiny)
    relative = np.where(value == expected, 0.0, np.abs(value - expected) / largest)
    counts, events = (b.memory["computer"]["converter"]["total_counts"] for b in (batch, reference)), "event_ns"
    same = (next(counts) == next(counts)).all(axis=1)
    late = np.abs(batch.memory["clock"][events] - reference.memory["clock"][events]).max()
    print(f"\n{name}: {len(same)} flights; {np.count_nonzero(~same)} end with another number of gyro counts")
    print(
        f"events differ by at most {late} ns, numbers of steps: {'the same' if _same_steps(batch, reference) else 'no'}"
    )
    for which, chosen in (("same counts", same), ("others", ~same)):
        if chosen.any():
            print(f"largest relative difference of each metric, {which}:")
            for metric, difference in zip(METRICS, relative[chosen].max(axis=0), strict=True):
                print(f"  {metric.name:34s}{difference:.1e}")


def _same_steps(batch: Batch, reference: Batch) -> bool:
    return bool((batch.memory["clock"]["steps"] == reference.memory["clock"]["steps"]).all())


def main(libdevice: str, folder: str, runs: str, *overrides: str) -> None:
    kernel, texts = device_code()
    packed = [begun(number, list(overrides)).packed for number in range(int(runs))]
    reference = batch_of(packed)
    fly_batch(reference)
    for name, fused in (("CUDA's functions", False), ("and fused products and sums", True)):
        library = Path(folder) / f"kernel-{'fused' if fused else 'plain'}.so"
        build(kernel, texts, Path(libdevice), library, fused)
        batch = batch_of(packed)
        fly_by_library(library.resolve(), kernel, batch)
        differences(name, batch, reference)


if __name__ == "__main__":
    main(*sys.argv[1:])
