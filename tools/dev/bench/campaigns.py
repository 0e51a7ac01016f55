"""Benchmarks of campaigns: flights per second on one worker and on all cores, overhead of a campaign, memory, and Dask.

The runs are full powered ascents with all dispersions of campaigns/ksr3. The overhead is the processor time of the
process minus the time inside the kernel. Processor time is used because other work on the machine affects it least.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

from maxq.control.kernel.machine import cores
from maxq.sim.campaign import runs as campaign_runs
from maxq.sim.campaign.own_kernels import OwnKernels, load_kernels
from maxq.sim.campaign.plan import Plan
from maxq.sim.campaign.read import LoadedCampaign, load_campaign
from maxq.sim.campaign.runner import CampaignProgress, run_campaign
from maxq.sim.campaign.store import Store
from maxq.sim.flight import loop
from maxq.sim.packing.flight import pack_for_one_vehicle
from maxq.sim.run import fly

RUNS = 1000  # a typical number for an interactive campaign; with the kernels of the vehicle
SHORT = ("run.duration_s=0.02", "run.stop_at=[]", "campaign.keep=[]", "campaign.batch=256")
_FLOWN, _ROWS = 4000, 100_000


def _ksr3(*overrides: str) -> LoadedCampaign:
    return load_campaign("campaigns/ksr3", ["campaign.keep=[]", *overrides])


def local(runs: int = RUNS) -> dict[str, float]:
    """Return the rates, the efficiency and the overhead of campaigns on threads."""
    campaign = _ksr3().with_campaign(runs=runs)
    load_kernels(campaign, pack_for_one_vehicle)
    workers = cores()
    with tempfile.TemporaryDirectory() as scratch:
        spent = {"kernel": 0.0}
        start, cpu = time.perf_counter(), time.process_time()
        with patch.object(fly, "advance", _timed(spent, "kernel", loop.advance)):
            run_campaign(campaign, Path(scratch) / "one", workers=1)
        one_s, cpu_s = time.perf_counter() - start, time.process_time() - cpu
        start = time.perf_counter()
        run_campaign(campaign, Path(scratch) / "all", workers=workers)
        all_s = time.perf_counter() - start
    return {
        "runs": runs,
        "workers": workers,
        "kernel_cpu_s": round(spent["kernel"] / runs, 4),
        "campaign_cpu_s": round(cpu_s / runs, 4),
        "overhead_percent": round(100.0 * (cpu_s / spent["kernel"] - 1.0), 1),
        "one_per_s": round(runs / one_s, 2),
        "all_per_s": round(runs / all_s, 2),
        "efficiency_percent": round(100.0 * one_s / all_s / workers, 1),
    }


def _timed(spent: dict[str, float], name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that calls `function` and adds its processor time to `spent[name]`."""

    def call(*arguments: Any, **named: Any) -> Any:
        start = time.thread_time()
        try:
            return function(*arguments, **named)
        finally:
            spent[name] += time.thread_time() - start

    return call


PARTS: dict[str, tuple[Any, str]] = {
    "draws of a batch": (Plan, "draw"),
    "scenario: changed, checked": (LoadedCampaign, "inputs"),
    "packing": (OwnKernels, "pack"),
    "start": (campaign_runs, "_begun_flight"),
    "flight": (campaign_runs._Run, "fly"),
    "metrics, verdicts, row": (campaign_runs._Run, "recorded"),
    "Arrow tables, Parquet files": (Store, "write"),
}
"""The parts of a campaign's time: functions that are called one after the other, each with one task."""


def profile(runs: int = RUNS // 2) -> dict[str, float]:
    """Return the processor time of a campaign on one worker by part, ms per run.

    "other" is the remainder of the process's time.
    """
    campaign = _ksr3().with_campaign(runs=runs)
    load_kernels(campaign, pack_for_one_vehicle)
    spent = dict.fromkeys(PARTS, 0.0)
    with ExitStack() as stack, tempfile.TemporaryDirectory() as scratch:
        for name, (owner, function) in PARTS.items():
            stack.enter_context(patch.object(owner, function, _timed(spent, name, getattr(owner, function))))
        start = time.process_time()
        run_campaign(campaign, Path(scratch) / "one", workers=1)
        total = time.process_time() - start
    spent["other"] = total - sum(spent.values())
    return {name: round(1e3 * seconds / runs, 3) for name, seconds in spent.items()}


def memory(runs: int = _FLOWN, rows: int = _ROWS) -> dict[str, float]:
    """Return the peak memory (MB) after flying very short flights, and after judging and reporting `rows` runs.

    The judged data set repeats the flown rows under new numbers.
    """
    from maxq.sim.campaign.analysis import DataSet, judged, lost  # noqa: PLC0415  # part of the measured memory
    from maxq.tools.campaign_report import write_report  # noqa: PLC0415  # part of the measured memory

    campaign = load_campaign("campaigns/ksr3", SHORT).with_campaign(runs=runs)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "out"
        half: list[float] = []

        def watch(progress: CampaignProgress) -> None:
            if progress.done >= runs // 2 and not half:
                half.append(_peak_MB())

        run_campaign(campaign, folder, watch=watch)
        flown = _peak_MB()
        _repeat(folder, runs, rows)
        data = DataSet(folder, campaign)
        write_report(data, judged(data), lost(data), rows)
    return {
        "runs": runs,
        "half_MB": round(half[0]),
        "flown_MB": round(flown),
        "growth_MB": round(1000.0 * (flown - half[0]) / (runs - runs // 2), 2),
        "rows": rows,
        "judged_MB": round(_peak_MB()),
    }


def _peak_MB() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def _repeat(folder: Path, runs: int, rows: int) -> None:
    """Repeat the runs under new numbers until there are `rows`. A separate process does this, because of its memory."""
    script = (
        "import sys, pyarrow as pa, pyarrow.parquet as pq; from pathlib import Path\n"
        "from maxq.sim.campaign.store import parts_in\n"
        "folder, runs, rows = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])\n"
        "parts = [(p, pq.read_table(p.path)) for p in parts_in(folder)]\n"
        "for shift in range(runs, rows, runs):\n"
        "    for p, t in parts:\n"
        "        numbers = pa.array(range(p.first + shift, p.last + shift + 1), pa.int64())\n"
        "        t = t.set_column(0, t.schema.field(0), numbers)\n"
        "        name = f'runs-{p.first + shift:010d}-{p.last + shift:010d}.parquet'\n"
        "        pq.write_table(t, folder / 'runs' / name, compression='zstd')\n"
    )
    subprocess.run([sys.executable, "-c", script, str(folder), str(runs), str(rows)], check=True)


def dask(runs: int = RUNS) -> dict[str, float]:
    """Return the times of a campaign on Dask worker processes of one thread each, and on the same number of threads."""
    from distributed import Client, LocalCluster  # noqa: PLC0415  # an extra

    workers = cores()
    campaign = _ksr3().with_campaign(runs=runs)
    load_kernels(campaign, pack_for_one_vehicle)
    with (
        tempfile.TemporaryDirectory() as scratch,
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as machines,
        Client(machines) as client,
    ):
        run_campaign(campaign.with_campaign(runs=16 * workers), Path(scratch) / "warm", cluster=client)
        start = time.perf_counter()
        run_campaign(campaign, Path(scratch) / "threads", workers=workers)
        threads_s = time.perf_counter() - start
        start = time.perf_counter()
        run_campaign(campaign, Path(scratch) / "dask", cluster=client)
        dask_s = time.perf_counter() - start
    return {
        "threads_s": round(threads_s, 2),
        "dask_s": round(dask_s, 2),
        "overhead_percent": round(100.0 * (dask_s / threads_s - 1.0), 1),
    }


def cold(runs: int = 200) -> dict[str, float]:
    """Return the time of the command for a campaign from its start to its end, with kernels from the cache."""
    with tempfile.TemporaryDirectory() as scratch:
        for attempt in ("first", "second"):
            command = [sys.executable, "-m", "maxq.tools.simrun", "campaigns/ksr3", "--runs", str(runs)]
            command += ["--set", "campaign.keep=[]", "--no-report", "--out", str(Path(scratch) / attempt)]
            start = time.perf_counter()
            subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)  # 1: missed
            wall_s = time.perf_counter() - start
    return {"runs": runs, "wall_s": round(wall_s, 2), "per_s": round(runs / wall_s, 1)}


def measure() -> dict[str, Any]:
    """Return the results of all benchmarks of this module, each measured in a separate process."""
    return {name: _own(f"{name}()") for name in ("local", "profile", "cold", "memory", "dask")}


def _own(call: str) -> Any:
    script = (
        "import json; from maxq.tools.dev.bench.campaigns import *\n"
        + f"if __name__ == '__main__': print(json.dumps({call}))"
    )
    environment = {**os.environ, "MPLBACKEND": "Agg"}
    with tempfile.NamedTemporaryFile("w", suffix=".py") as file:  # a file, from which Dask workers can start
        file.write(script)
        file.flush()
        done = subprocess.run([sys.executable, file.name], env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{call}: {done.stderr.strip().splitlines()[-1:]}")
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    print(json.dumps(measure()))
