"""A batch of flights, on the CPU and in Numba's simulator of a CUDA GPU, is its flights one by one, bit by bit.

No GPU is needed: the simulator runs the GPU's kernel, thread for thread, as plain Python. What CUDA's own arithmetic
changes is in docs/performance.md.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from maxq.control.kernel.records import dtype_of
from maxq.control.kernel.tables import TableRef
from maxq.sim.api import FlightRun, load_scenario
from maxq.sim.run.batch import Batch, DeviceError, batch_of, fly_batch, hand_back
from maxq.sim.scenario.builtin import scenarios_folder
from maxq.tools.simrun import main

FLIGHTS = """
from maxq.sim.api import FlightRun, load_scenario
from maxq.sim.run.batch import batch_of, fly_batch, hand_back

def begun(number):
    start = 20.0
    overrides = [
        f"run.start_s={start}", "run.duration_s=0.021", "holddown.release=time", f"holddown.release_s={start}",
        f"wind.speed_mps={20 + number}", "wind.from_deg=300", "wind.turbulence.exceedance=moderate",
        f"run.seed={number}", "vehicle.stage.0.gyro.noise_deg_rt_h=0.01",
    ]
    return FlightRun(load_scenario("nominal", overrides), log=False)
"""
ON_GPU = f"""{FLIGHTS}
runs = [begun(number) for number in range(3)]
batch = batch_of([run.packed for run in runs])
assert fly_batch(batch, "cuda")
hand_back(batch, [run.packed for run in runs])
print(*(run.state_hash() for run in runs), sep="\\n")
"""
ONE_BY_ONE = f"""{FLIGHTS}
for run in map(begun, range(3)):
    while not run.finished:
        run.fly_segment()
    print(run.state_hash())
"""


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    cleared = {k: v for k, v in os.environ.items() if k not in ("NUMBA_ENABLE_CUDASIM", "NUMBA_DISABLE_JIT")}
    return subprocess.run(
        [sys.executable, "-c", code],
        env=cleared | environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def short(number: int, *overrides: str) -> FlightRun:
    given = ("run.duration_s=1.5", f"run.seed={number}", "vehicle.stage.0.gyro.noise_deg_rt_h=0.01")
    return FlightRun(load_scenario("nominal", [*given, *overrides]), log=False)


def test_threads_of_a_gpu_fly_the_flights_of_the_compiled_kernel_to_the_bit() -> None:
    simulated = run_python(ON_GPU, NUMBA_ENABLE_CUDASIM="1", NUMBA_DISABLE_JIT="1")
    assert simulated.returncode == 0, simulated.stderr
    compiled = run_python(ONE_BY_ONE)
    hashes = simulated.stdout.split()
    assert len(set(hashes)) == 3
    assert hashes == compiled.stdout.split()


def test_a_batch_on_the_cpu_is_its_flights_one_by_one() -> None:
    runs, alone = ([short(n, f"wind.speed_mps={5 * n}", "wind.from_deg=300") for n in range(3)] for _ in range(2))
    batch = batch_of([run.packed for run in runs])
    assert fly_batch(batch)
    hand_back(batch, [run.packed for run in runs])
    for run in alone:
        while not run.finished:
            run.fly_segment()
    assert [run.state_hash() for run in runs] == [run.state_hash() for run in alone]
    assert runs[0].result().end_s == 1.5


def test_equal_tables_are_held_once_and_every_record_finds_its_own() -> None:
    packed = [short(0).packed, short(1).packed, short(2, "wind.profile=winds/anheung-november.csv").packed]
    batch = batch_of(packed)
    assert len(batch.pool) == len(packed[0].pool) + len(packed[2].pool)
    for row, flight in zip(batch.parameters, packed, strict=True):
        for ref, before in zip(tables(row[0]), tables(flight.parameters[0]), strict=True):
            length = int(before["n_breaks"])
            here = batch.pool[int(ref["offset"]) :][:length]
            np.testing.assert_array_equal(here, flight.pool[int(before["offset"]) :][:length])


def tables(record: np.void) -> list[np.void]:
    """All table references in a record, in order."""
    if record.dtype == dtype_of(TableRef):
        return [record]
    names = record.dtype.names or ()
    return [ref for name in names if record.dtype[name].names for ref in tables(record[name])]


def test_a_batch_that_is_stopped_leaves_its_flights_as_they_were() -> None:
    batch = batch_of([short(0).packed])
    before = Batch(batch.parameters, batch.pool, batch.memory.copy(), batch.state.copy())
    asked = iter((False, True))
    assert not fly_batch(batch, stop=lambda: next(asked))
    assert batch.memory.tobytes() == before.memory.tobytes()
    np.testing.assert_array_equal(batch.state, before.state)


def test_flights_of_different_stages_are_no_batch() -> None:
    with pytest.raises(ValueError, match="one number of stages"):
        batch_of([])


def test_without_gpu_or_compiler_the_error_says_what_to_do() -> None:
    """On a machine with a GPU and numba-cuda there is nothing to see: the message of the simulator is always there."""
    code = "from maxq.sim.run.batch import require_gpu; require_gpu()"
    half = run_python(code, NUMBA_ENABLE_CUDASIM="1")
    assert "NUMBA_DISABLE_JIT=1" in half.stderr.splitlines()[-1]
    none = run_python(code, CUDA_VISIBLE_DEVICES="")
    assert none.returncode != 0
    assert none.stderr.splitlines()[-1].startswith("maxq.sim.run.batch.DeviceError: device cuda: ")


def test_the_cpu_asks_for_no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise DeviceError("asked for")

    monkeypatch.setattr("maxq.sim.run.batch.require_gpu", refuse)
    batch = batch_of([short(0, "run.duration_s=0.01").packed])
    assert fly_batch(batch, "cpu")
    with pytest.raises(DeviceError, match="asked for"):
        fly_batch(batch, "cuda")


CAMPAIGN = """
schema = 1
extends = "nominal.toml"
unset = ["requirement"]
[run]
duration_s = 0.01
[campaign]
runs = 3
batch = 2
[campaign.envelope]
runs = 0
[[disperse]]
key = "vehicle.stage.0.engine.thrust_factor"
distribution = "normal"
three_sigma = 0.03
"""


def test_a_campaign_flies_in_the_simulator_as_on_the_cpu(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same rows; and a folder does not take runs of both."""
    (tmp_path / "nominal.toml").write_text((scenarios_folder() / "nominal.toml").read_text())
    file = tmp_path / "campaign.toml"
    file.write_text(CAMPAIGN)
    simulator = {"NUMBA_ENABLE_CUDASIM": "1", "NUMBA_DISABLE_JIT": "1"}
    on_gpu, on_cpu = tmp_path / "gpu", tmp_path / "cpu"

    def simrun(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        given = [str(file), "--no-report", *arguments]
        call = f"import sys; from maxq.tools.simrun import main; sys.exit(main({given}))"
        return run_python(call, **environment)

    simulated = simrun("--device", "cuda", "--out", str(on_gpu), **simulator)
    assert simulated.returncode == 3, simulated.stderr  # three runs settle nothing
    assert main([str(file), "--no-report", "--out", str(on_cpu)]) == 3
    tables = [pq.read_table(folder / "runs").to_pylist() for folder in (on_gpu, on_cpu)]
    assert len(tables[0]) == 3
    assert repr(tables[0]) == repr(tables[1])
    assert main([str(file), "--out", str(on_gpu)]) == 2
    assert "simulator.device was" in capsys.readouterr().err
    none = simrun("--device", "cuda", "--out", str(tmp_path / "none"), CUDA_VISIBLE_DEVICES="")
    assert none.returncode == 2
    assert none.stderr.splitlines()[-1].startswith("simrun: device cuda: ")
    assert not (tmp_path / "none").exists()
    with pytest.raises(SystemExit, match="2"):
        main([str(file), "--device", "cuda", "--dask", "tcp://nowhere:1"])
    assert "not with --device cuda" in capsys.readouterr().err
