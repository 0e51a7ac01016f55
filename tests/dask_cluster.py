"""Start a scheduler and worker processes on this machine, like those of a cluster."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Machines:
    address: str
    folder: Path
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def worker(self) -> subprocess.Popen[bytes]:
        """Start another worker process with one thread."""
        command = [
            sys.executable,
            "-m",
            "distributed.cli.dask_worker",
            self.address,
            "--nthreads",
            "1",
            "--no-nanny",
            "--no-dashboard",
            "--host",
            "127.0.0.1",
            "--local-directory",
            str(self.folder / "dask"),
        ]
        with open(self.folder / f"worker-{len(self.processes)}.log", "wb") as log:
            self.processes.append(subprocess.Popen(command, stdout=log, stderr=log))
        return self.processes[-1]


@contextmanager
def machines(folder: Path, workers: int) -> Iterator[Machines]:
    file = folder / "scheduler.json"
    command = [
        sys.executable,
        "-m",
        "distributed.cli.dask_scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--no-dashboard",
        "--no-show",
        "--scheduler-file",
        str(file),
    ]
    with open(folder / "scheduler.log", "wb") as log:
        scheduler = subprocess.Popen(command, stdout=log, stderr=log)
    made = Machines("", folder, [scheduler])
    try:
        made.address = _address(file, scheduler)
        for _ in range(workers):
            made.worker()
        yield made
    finally:
        for process in reversed(made.processes):
            with suppress(OSError):
                process.terminate()
        for process in reversed(made.processes):
            with suppress(subprocess.TimeoutExpired):
                process.wait(20)
            process.kill()


def _address(file: Path, scheduler: subprocess.Popen[bytes]) -> str:
    import json  # noqa: PLC0415  # only here
    import time  # noqa: PLC0415  # only here

    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline and scheduler.poll() is None:
        with suppress(OSError, ValueError):
            return str(json.loads(file.read_text())["address"])
        time.sleep(0.1)
    raise RuntimeError("no scheduler")
