"""The comparison of other programs with maxq: their flights alternate in one run, each in a separate process."""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from maxq.tools.dev.bench.steps import IDEAL


@dataclass(frozen=True)
class ProgramFlight:
    """A flight of a program: its description, and the worker that flies it."""

    key: str
    what: str
    module: str
    ours: bool = False
    arguments: tuple[str, ...] = ()
    rounds: int | None = None  # rounds in which it flies; None: all
    needed: float | None = None  # required ratio of its time to that of maxq


CASES = (
    ProgramFlight("maxq", "nominal, 59 s at 1 kHz, everything on", "fly_maxq", ours=True),
    ProgramFlight("maxq_own", "the same, by a campaign's kernels", "fly_maxq", ours=True, arguments=("--own-kernels",)),
    ProgramFlight(
        "maxq_nine", "its engine as nine, moved separately", "fly_maxq", ours=True, arguments=("--nine-engines",)
    ),
    ProgramFlight("jsbsim", "rigid, J2461.xml, 60 s at 1 kHz", "fly_jsbsim", needed=3.5),
    ProgramFlight("basilisk", "hub, 3 slosh, 2 panels, RK4, 60 s at 1 kHz", "fly_basilisk", needed=20.0),
    ProgramFlight("rocketpy", "rigid, 60 s, LSODA, 100 Hz controller on interpolated points", "fly_rocketpy"),
    ProgramFlight(
        "rocketpy_causal",
        "rigid, 60 s, RK23, steps end at the 100 Hz controller",
        "fly_rocketpy",
        arguments=("--causal",),
        rounds=2,
    ),
)


@dataclass
class _Worker:
    case: ProgramFlight
    process: subprocess.Popen[str]
    about: dict[str, Any]
    flights: list[dict[str, Any]] = field(default_factory=list)

    def fly(self) -> dict[str, Any]:
        assert self.process.stdin is not None
        self.process.stdin.write("fly\n")
        self.process.stdin.flush()
        answer: dict[str, Any] = json.loads(_line(self.process))
        return answer


def _line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        assert process.stderr is not None
        last = process.stderr.read().strip().splitlines()
        raise RuntimeError(last[-1] if last else f"the worker ended with {process.wait()}")
    return line


@dataclass(frozen=True)
class Refined:
    """A program with refined steps: the names of its methods with the arguments of the worker, the reference last."""

    program: str
    module: str
    methods: tuple[tuple[str, tuple[str, ...]], ...]
    ours: bool = False


def _steps(*steps_ms: float) -> tuple[tuple[str, tuple[str, ...]], ...]:
    return tuple((f"{ms:g} ms", (repr(ms / 1e3),)) for ms in steps_ms)


REFINED = (
    Refined(
        "maxq", "fly_maxq",
        tuple(
            (name, ("--own-kernels", *IDEAL, f"run.{method}"))
            for name, method in (
                ("accuracy 0.1", "accuracy=0.1"), ("accuracy 0.01", "accuracy=0.01"),
                ("accuracy 0.001", "accuracy=0.001"), ("accuracy 0.0001", "accuracy=0.0001"),
                ("RK4, 1 ms", "step_s=0.001"), ("RK4, 0.5 ms", "step_s=0.0005"), ("RK4, 0.2 ms", "step_s=0.0002"),
            )
        ),
        ours=True,
    ),
    Refined("JSBSim", "fly_jsbsim", _steps(8.0, 4.0, 2.0, 1.0, 0.5, 0.25, 0.1)),
    Refined("Basilisk", "fly_basilisk", _steps(20.0, 10.0, 5.0, 1.0, 0.5)),
    Refined("RocketPy", "fly_rocketpy", tuple((f"LSODA, rtol {r:g}", (repr(r),)) for r in (1e-4, 1e-6, 1e-8, 1e-10))),
)  # fmt: skip  # a table


def accuracy(peers_python: Path, flights: int = 3) -> list[dict[str, Any]]:
    """Return, for each program and method, the least CPU time of `flights` flights and the error at their end.

    The errors `position_m` and `attitude_deg` are relative to the program's finest method. The row of a
    program that cannot run has the reason in `skipped`.
    """
    return [
        row for each in REFINED for row in _refined(each, Path(sys.executable) if each.ours else peers_python, flights)
    ]


def _refined(of: Refined, python: Path, flights: int) -> list[dict[str, Any]]:
    rows, exact = [], None
    for name, arguments in reversed(of.methods):
        try:
            worker = _start(ProgramFlight(of.program, name, of.module, of.ours, arguments), python)
            try:
                worker.fly()  # compiles and fills caches
                flown = [worker.fly() for _ in range(flights)]
            finally:
                worker.process.terminate()
        except (OSError, RuntimeError) as error:
            return [{"program": of.program, "method": name, "skipped": str(error)}]
        end = np.array(flown[-1]["state"])
        exact = end if exact is None else exact
        q, q_exact = end[3:] / np.linalg.norm(end[3:]), exact[3:] / np.linalg.norm(exact[3:])
        rows.append(
            {
                "program": of.program,
                "method": name,
                "cpu_s": min(flight["cpu_s"] for flight in flown),
                "position_m": float(np.linalg.norm(end[:3] - exact[:3])),
                "attitude_deg": math.degrees(2.0 * min(np.linalg.norm(q - q_exact), np.linalg.norm(q + q_exact))),
            }
        )
    return rows[:0:-1]


def _start(case: ProgramFlight, python: Path) -> _Worker:
    process = subprocess.Popen(
        [str(python), "-m", f"maxq.tools.dev.bench.{case.module}", *case.arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    return _Worker(case, process, json.loads(_line(process)))


def measure(peers_python: Path, rounds: int) -> dict[str, Any]:
    """Return the times of each program in `rounds` rounds, in which maxq flies before each other program.

    The first flight of a program does not count. The times are the lists `cpu_s`, `wall_s` and `set_up_s`, with `steps`
    and `flown_s`. A skipped program has the reason in `skipped`.
    """
    results: dict[str, Any] = {}
    workers: list[_Worker] = []
    try:
        for case in CASES:
            try:
                worker = _start(case, Path(sys.executable) if case.ours else peers_python)
                workers.append(worker)
                if case.rounds is None:
                    worker.fly()  # compiles and fills caches
            except (OSError, RuntimeError) as error:
                results[case.key] = {"what": case.what, "skipped": str(error)}
        working = [w for w in workers if w.case.key not in results]
        ours = next((w for w in working if w.case.ours), None)
        for number in range(rounds):
            for worker in working:
                if worker is ours or number >= (worker.case.rounds or rounds):
                    continue
                if ours is not None:
                    ours.flights.append(ours.fly())
                worker.flights.append(worker.fly())
            if ours is not None and len(working) == 1:
                ours.flights.append(ours.fly())
        for worker in working:
            results[worker.case.key] = _summary(worker)
    finally:
        for worker in workers:
            worker.process.terminate()
    return {case.key: results[case.key] for case in CASES}


def _summary(worker: _Worker) -> dict[str, Any]:
    columns = {key: [f[key] for f in worker.flights] for key in ("cpu_s", "wall_s", "set_up_s")}
    return {
        "what": worker.case.what,
        "needed": worker.case.needed,
        **worker.about,
        "steps": worker.flights[-1]["steps"],
        **{key: [round(value, 5) for value in values] for key, values in columns.items()},
        **{f"{key}_median": round(statistics.median(values), 5) for key, values in columns.items()},
        **{f"{key}_min": round(min(values), 5) for key, values in columns.items()},
    }
