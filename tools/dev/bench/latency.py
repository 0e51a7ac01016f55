"""The benchmark of the response time of `simrun` and of the memory of a flight.

This module loads only the standard library, since the peak memory that the system reports for a child process starts
with that of its parent.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

FLOWN_CODES = (0, 1)  # exit codes: flown; flown, with a requirement missed
REPETITIONS = 5
IN_MEMORY = "maxq.tools.dev.bench.fly_in_memory"


def _run(command: list[str], environment: dict[str, str], codes: tuple[int, ...]) -> dict[str, float]:
    """Return the wall-clock time (s), the CPU time including children (s), and the peak memory (MB) of a command.

    Raises RuntimeError if the exit code is not in `codes`.
    """
    with tempfile.TemporaryFile() as said:
        start = time.perf_counter()
        process = subprocess.Popen(command, env=environment, stdout=said, stderr=said)
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode not in codes:
            said.seek(0)
            last = said.read().decode(errors="replace").strip().splitlines()
            raise RuntimeError(f"exit code {process.returncode}: {last[-1] if last else 'nothing said'}")
    return {
        "wall_s": round(wall, 3),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 3),
        "peak_MB": round(usage.ru_maxrss / 1024, 1),
    }


def _typical(runs: list[dict[str, float]]) -> dict[str, float]:
    return {
        "wall_s": statistics.median(r["wall_s"] for r in runs),
        "wall_s_min": min(r["wall_s"] for r in runs),
        "cpu_s": statistics.median(r["cpu_s"] for r in runs),
        "peak_MB": max(r["peak_MB"] for r in runs),
        "runs": len(runs),
    }


def measure(repetitions: int = REPETITIONS) -> dict[str, Any]:
    """Return the `wall_s`, `cpu_s` and `peak_MB` of each command, or the reason for which it was skipped."""
    results: dict[str, Any] = {}
    simrun = Path(sys.executable).with_name("simrun")
    missing = None
    if find_spec("maxq.tools.simrun") is None:
        missing = "tools/simrun.py is not there"
    elif not simrun.exists():
        missing = "simrun is not installed in this environment"
    with tempfile.TemporaryDirectory(prefix="maxq-bench-") as scratch:
        environment = {**os.environ, "MAXQ_CACHE": str(Path(scratch) / "cache")}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # Python's bytecode cache is used, as by every user
        nominal = [str(simrun), "nominal", "--out", str(Path(scratch) / "flight")]
        cases: tuple[tuple[str, list[str], tuple[int, ...], int], ...] = (
            ("help", [str(simrun), "--help"], (0,), repetitions + 1),
            ("list", [str(simrun), "--list"], (0,), repetitions + 1),
            ("api", [sys.executable, "-c", "import maxq"], (0,), repetitions + 1),
            ("first", nominal, FLOWN_CODES, 1),
            ("second", nominal, FLOWN_CODES, 3 * repetitions),
            ("no_log", [*nominal, "--no-log"], FLOWN_CODES, repetitions),
            ("orbit", [str(simrun), "checkcases/exo-06a", *nominal[2:]], FLOWN_CODES, repetitions),
            ("in_memory", [sys.executable, "-m", IN_MEMORY], (0,), 2),
        )
        for key, command, codes, times in cases:
            if missing is not None and key != "in_memory":
                results[key] = {"skipped": missing}
                continue
            try:
                runs = [_run(command, environment, codes) for _ in range(times)]
            except RuntimeError as error:
                results[key] = {"skipped": str(error)}
                continue
            results[key] = _typical(runs[1:] if times > 1 else runs)  # the first run reads files from disk
    return results
