"""The benchmark of the replay: `simreplay` from command to picture, conversion, memory, size, and many flights, as
JSON.

The pictures are those of the headless viewer. Without a graphics card, they are drawn in software, which is slower.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import psutil  # type: ignore[import-untyped]  # it has no stubs; comes with rerun

ROUNDS, FLIGHTS = 3, 100
_SIMRUN, _SIMREPLAY = "maxq.tools.simrun", "maxq.tools.simreplay"


def _memory_of(process: subprocess.Popen[bytes]) -> float:
    """Return the largest memory of a process and its children together, MB, sampled every 0.05 s until its end."""
    most = 0.0
    whole = psutil.Process(process.pid)
    while process.poll() is None:
        total = 0
        try:
            for each in [whole, *whole.children(recursive=True)]:
                total += each.memory_info().rss
        except psutil.Error:
            pass
        most = max(most, total / 1e6)
        time.sleep(0.05)
    return most


def _timed(*arguments: str) -> dict[str, float]:
    """Return the least wall-clock and processor times (s) and the largest memory (MB) of a command in several rounds.

    Children are included. Raises RuntimeError if the command fails.
    """
    walls, cpus, peaks = [], [], []
    for _ in range(ROUNDS):
        start, before = time.perf_counter(), os.times()
        process = subprocess.Popen(
            [sys.executable, "-m", *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        peak: list[float] = []
        watcher = threading.Thread(target=lambda p=process, out=peak: out.append(_memory_of(p)))
        watcher.start()
        _, said = process.communicate()
        walls.append(time.perf_counter() - start)
        watcher.join()
        after = os.times()
        cpus.append(after.children_user + after.children_system - before.children_user - before.children_system)
        peaks += peak
        if process.returncode != 0:
            raise RuntimeError(said.decode(errors="replace").strip() or f"exit code {process.returncode}")
    return {"wall_s": min(walls), "cpu_s": min(cpus), "peak_MB": max(peaks)}


def _conversion(log: Path, folder: Path) -> dict[str, float]:
    """Return the times of reading and converting a log alone, in a process with loaded modules."""
    from maxq.tools.replay.convert import Options, save  # noqa: PLC0415  # loads rerun
    from maxq.tools.replay.flight import open_flight  # noqa: PLC0415  # lazy

    reads, converts = [], []
    target = folder / "one.rrd"
    for _ in range(ROUNDS + 1):
        start = time.perf_counter()
        flight = open_flight(log)
        reads.append(time.perf_counter() - start)
        start = time.perf_counter()
        save([flight], Options(), target)
        converts.append(time.perf_counter() - start)
    return {"read_s": min(reads), "convert_s": min(converts), "rrd_MB": target.stat().st_size / 1e6}


def _many(folder: Path) -> dict[str, float]:
    """Return the times and sizes of a recording of many dispersed ascents, with families of curves in one window."""
    coarse = ["--set", "log.fast_hz=100", "--set", "log.slow_hz=20"]
    kept = ["--runs", str(FLIGHTS), "--keep", ",".join(map(str, range(FLIGHTS))), "--no-report"]
    command = [sys.executable, "-m", _SIMRUN, "campaigns/first", *kept, *coarse, "--out", str(folder / "campaign")]
    done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode
    if done not in (0, 1, 3):  # exit codes: the verdicts may be open or missed
        raise RuntimeError(f"simrun campaigns/first ended with code {done}")
    result = _timed(_SIMREPLAY, str(folder / "campaign"), "--save", str(folder / "many.rrd"))
    size = (folder / "many.rrd").stat().st_size / 1e6
    shot = _picture(folder / "many.rrd", 43.0)
    return {"save_s": result["wall_s"], "save_peak_MB": result["peak_MB"], "rrd_MB": size, **shot}


def _picture(rrd: Path, time_s: float) -> dict[str, float]:
    """Return the times to open a recording with a settled picture, to lay out the window, and to move the cursor.

    The result includes the memory of the viewer.
    """
    from maxq.tools.replay import viewer  # noqa: PLC0415  # loads rerun

    start = time.perf_counter()
    with viewer.headless() as connected:
        client = connected()
        viewer.open_whole(client, rrd)
        client.pause_at("sim_time", duration=time_s)
        viewer.steady_picture(client)
        opened = time.perf_counter() - start
        memory = sum(c.memory_info().rss for c in psutil.Process().children()) / 1e6
        start = time.perf_counter()
        for step in range(5):
            client.pause_at("sim_time", duration=time_s + step)
            client.get_state()
        laid_out = (time.perf_counter() - start) / 5.0
        start = time.perf_counter()
        for step in range(5):
            client.pause_at("sim_time", duration=time_s + step)
            viewer.steady_picture(client)
        moved = (time.perf_counter() - start) / 5.0
    return {"picture_s": opened, "viewer_MB": memory, "layout_s": laid_out, "move_s": moved}


def measure() -> dict[str, Any]:
    """Return all figures of the benchmark. For those that cannot be measured here, `skipped` states the reason."""
    from maxq.tools.replay.viewer import ReplayError  # noqa: PLC0415  # lazy

    folder = Path(tempfile.mkdtemp(prefix="maxq-bench-"))
    try:
        command = [sys.executable, "-m", _SIMRUN]
        subprocess.run([*command, "nominal", "--out", str(folder / "nominal")], check=True, stdout=subprocess.DEVNULL)
        log = str(folder / "nominal" / "flight.mcap")
        result: dict[str, Any] = {"help": _timed(_SIMREPLAY, "--help")}
        result["conversion"] = _conversion(Path(log), folder)
        result["save"] = _timed(_SIMREPLAY, log, "--save", str(folder / "out.rrd"))
        result["summary"] = _timed(_SIMREPLAY, log, "--summary")
        result["plots"] = _timed(_SIMREPLAY, log, "--plots", str(folder / "plots"))
        try:
            shot = str(folder / "shot.png")
            result["screenshot"] = _timed(_SIMREPLAY, log, "--screenshot", shot, "--at", "43")
            result["many"] = _many(folder)
        except (RuntimeError, ReplayError, TimeoutError) as error:
            result["skipped"] = str(error)
        return result
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    print(json.dumps(measure()))
