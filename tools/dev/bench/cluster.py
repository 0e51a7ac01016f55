"""Campaigns on a Dask scheduler: with eight worker processes that fly, and with a thousand simulated workers.

A simulated worker is an ordinary worker of Dask, with many of them per process. It receives real tasks, draws their
runs, and sleeps for the time of their flights on a separate core. One batch in fifty takes ten times as long. It then
returns real rows. Scheduler, client, data set and verdicts thus work as with this number of cores. In one case, a
quarter of the workers is killed during the campaign.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from maxq.sim.campaign import runner
from maxq.sim.campaign.read import load_campaign
from maxq.sim.campaign.runs import Row, fly_rows

FLYING = 8
SIMULATED, PROCESSES = 1000, 4
FLIGHT_S = 0.04  # time of a flight on the core of a simulated worker
SLOW_SHARE, SLOW_FACTOR = 0.02, 10.0


def _simulate(flight_s: float) -> None:
    """Make tasks of this process sleep instead of flying. Their rows are copies of the first run flown."""
    fly, chance = runner.fly_batch, random.Random(os.getpid())
    known: list[Row] = []
    at_once = threading.Lock()

    def waited(packed: bytes, first: int, size: int) -> runner.FlownBatch:
        campaign, _ = runner._unpacked(packed)
        with at_once:
            if not known:
                fly(packed, 0, 1)  # loads the kernels
                known.extend(fly_rows(campaign, [(campaign.plan.draw(0, 1), 0)]))
            campaign.plan.draw(first, size)
            flown = runner.evaluated(campaign, [replace(known[0], run=run) for run in range(first, first + size)])
        time.sleep(size * flight_s * (SLOW_FACTOR if chance.random() < SLOW_SHARE else 1.0))
        return flown

    runner.fly_batch = waited


_QUIET = {  # for many workers per process, each of which would, for example, sample its stack a hundred times a second
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "60s",
    "distributed.admin.system-monitor.interval": "60s",
}


async def _workers(address: str, count: int) -> None:
    import dask  # noqa: PLC0415  # an extra
    from distributed import Worker  # noqa: PLC0415  # an extra

    if count > 1:
        dask.config.set(_QUIET)
    workers = [Worker(address, nthreads=1, memory_limit=0, dashboard=False, validate=False) for _ in range(count)]
    await asyncio.gather(*workers)
    await asyncio.gather(*(worker.finished() for worker in workers))


def _measured(workers: int, processes: int, runs: int, flight_s: float | None, kill: bool) -> dict[str, Any]:
    """Return the rates of a campaign on `workers` Dask workers in the given number of processes.

    With `flight_s`, the processes only sleep for this time in place of each flight. If `kill` is True, one process is
    killed after a third of the flights.
    """
    from distributed import Client  # noqa: PLC0415  # an extra

    campaign = load_campaign("campaigns/ksr3", ["campaign.keep=[]"]).with_campaign(runs=runs)
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        where = scratch / "scheduler.json"
        command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard", "--port", "0"]
        head = subprocess.Popen([*command, "--scheduler-file", str(where)], stderr=subprocess.DEVNULL)
        stack.callback(head.kill)
        while not where.exists():
            time.sleep(0.05)
        address = json.loads(where.read_text())["address"]
        serve = [sys.executable, "-m", "maxq.tools.dev.bench.cluster", "--serve", address]
        serve += ["--workers", str(workers // processes), "--flight-s", str(flight_s or 0.0)]
        hosts = [subprocess.Popen(serve, stderr=subprocess.DEVNULL) for _ in range(processes)]
        for host in hosts:
            stack.callback(host.kill)
        client = stack.enter_context(Client(address, set_as_default=False, timeout=60))
        client.wait_for_workers(workers, timeout=600)
        warm = campaign.with_campaign(runs=4 * workers, batch=1)
        runner.run_campaign(warm, scratch / "warm", cluster=client)
        lost = threading.Event()

        def watch(progress: runner.CampaignProgress) -> None:
            if kill and not lost.is_set() and progress.flown > runs // 3:
                lost.set()
                hosts[0].kill()

        before, own, wall = _cpu_s(head.pid), time.process_time(), time.perf_counter()
        done = runner.run_campaign(campaign, scratch / "out", cluster=client, watch=watch)
        wall, own = time.perf_counter() - wall, time.process_time() - own
        scheduler_s, batches = _cpu_s(head.pid) - before, len(list((scratch / "out" / "runs").iterdir()))
        if done.flown != runs:
            raise RuntimeError(f"{done.flown} of {runs} runs came back")
    return {
        "workers": workers,
        "processes": processes,
        "lost": workers // processes if kill else 0,
        "runs": runs,
        "batches": batches,
        "per_s": round(runs / wall, 1),
        "client_ms": round(1e3 * own / runs, 3),
        "scheduler_ms_a_batch": round(1e3 * scheduler_s / batches, 2),
    }


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure() -> list[dict[str, Any]]:
    flown = [_measured(FLYING, FLYING, 800, None, kill) for kill in (False, True)]
    simulated = [_measured(SIMULATED, PROCESSES, 20_000, FLIGHT_S, kill) for kill in (False, True)]
    return [*flown, *simulated]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--serve", metavar="ADDRESS")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--flight-s", type=float, default=0.0)
    choice = parser.parse_args()
    if choice.serve is None:
        print(json.dumps(measure()))
        return
    if choice.flight_s > 0.0:
        _simulate(choice.flight_s)
    asyncio.run(_workers(choice.serve, choice.workers))


if __name__ == "__main__":
    main()
