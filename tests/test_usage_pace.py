"""Flights at the pace of the host's clock: equal bits, lateness of the cycles, overruns and errors."""

from __future__ import annotations

import csv
import json
import math
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from flight_code import EXAMPLES, compiled, flies, needs_compiler

from maxq.sim.run import paced
from maxq.sim.run.fly import FlightRun, fly
from maxq.sim.run.instances import Outputs, size_of
from maxq.sim.run.paced import PacedRun
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.tools import simrun

Printed = pytest.CaptureFixture[str]
SHORT = ("run.duration_s=0.3", "requirement=")


def peer(port: socket.socket) -> None:
    """Answer each datagram with outputs of 0."""
    while True:
        given, sender = port.recvfrom(65536)
        if given[4] == 3:
            return
        port.sendto(given[:16] + bytes(8 + (size_of(Outputs, 1) if given[4] == 2 else 0)), sender)


def flown(loaded: LoadedScenario, run: FlightRun) -> str:
    while not run.finished:
        run.fly_segment()
    assert run.outcome == "duration"
    return run.result().state_hash


@needs_compiler
def test_a_pace_does_not_change_a_bit_of_a_flight(tmp_path: Path) -> None:
    """Check a design, C code in its own process and in that of the flight, Python code, and a computer behind UDP."""
    library = compiled(tmp_path, EXAMPLES / "pd_law.c", "pd_law")
    codes = [[], flies(library=library), flies(library=library, guard="false")]
    codes += [flies(python=f"{EXAMPLES}/pd_law.py:Autopilot")]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 0))
        for code in [*codes, flies(address=f"udp://127.0.0.1:{port.getsockname()[1]}", timeout_s=20)]:
            loaded = load_scenario("nominal", [*SHORT, *code])
            hashes = []
            for factor in (None, 3.0):
                answering = threading.Thread(target=peer, args=(port,), daemon=True)
                if "address" in "".join(code):
                    answering.start()
                run = FlightRun(loaded) if factor is None else PacedRun(loaded, factor=factor)
                begun_s = time.monotonic()
                hashes.append(flown(loaded, run))
                if answering.is_alive():
                    answering.join(10.0)
                if isinstance(run, PacedRun):
                    assert time.monotonic() - begun_s >= 0.29 / 3.0
                    assert run.cycles.shape == (29, 3)
                    assert run.cycles[:, 0] == pytest.approx(np.arange(1, 30) * 0.01)
            assert hashes[0] == hashes[1]


class Clock:
    """A clock of a host whose sleeps are 0.2 ms too long, and which computes cycles in the given times."""

    def __init__(self, computing_s: list[float]) -> None:
        self.now_s, self.computing_s = 1000.0, computing_s

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, length_s: float) -> None:
        self.now_s += length_s + 2e-4


def on_clock(monkeypatch: pytest.MonkeyPatch, computing_s: list[float], limit_s: float = math.inf) -> PacedRun:
    clock, fly_until = Clock(computing_s), FlightRun.fly_until

    def computed(run: FlightRun, until_ns: int):  # type: ignore[no-untyped-def]
        clock.now_s += clock.computing_s[round(1e-7 * (until_ns - 10_000_000))]
        return fly_until(run, until_ns)

    monkeypatch.setattr(paced, "time", clock)
    monkeypatch.setattr(PacedRun, "fly_until", computed)
    loaded = load_scenario("nominal", ["run.duration_s=0.1", "requirement="])
    run = PacedRun(loaded, log=False, limit_s=limit_s)
    while not run.finished:
        run.fly_segment()
    return run


def test_lateness_and_overruns_are_those_of_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cycle k begins at 10 k ms, and takes 4 ms; the third takes 25 ms.

    Hence the fourth is due at 40 ms and begins at 55.2 ms, the fifth at 59.2 ms and the sixth at 63.2 ms; the seventh
    is in time again.
    """
    run = on_clock(monkeypatch, [0.004, 0.004, 0.004, 0.025, *(7 * [0.004])])
    expected_ms = [0.2, 0.2, 0.2, 15.2, 9.2, 3.2, 0.2, 0.2, 0.2]
    assert run.cycles[:, 1] == pytest.approx([1e-3 * late for late in expected_ms])
    assert list(run.cycles[:, 2]) == [0, 0, 0, 1, 1, 1, 0, 0, 0]
    late = run.lateness()
    assert (late.cycles, late.overruns) == (9, 3)
    assert late.late_mean_s == pytest.approx(1e-3 * sum(expected_ms) / 9)
    assert (late.late_max_s, late.late_max_at_s, late.overrun_max_s) == pytest.approx((0.0152, 0.04, 0.0152))
    assert run.outcome == "duration"


def test_a_limit_ends_the_flight_with_the_first_cycle_beyond_it(monkeypatch: pytest.MonkeyPatch) -> None:
    run = on_clock(monkeypatch, [0.004, 0.004, 0.004, 0.025, *(7 * [0.004])], limit_s=0.01)
    flight = run.result()
    assert (flight.outcome, flight.end_s) == ("overrun", 0.05)
    assert flight.failures == ("overrun at 0.040 s: a cycle began 15.2 ms late, at most 10 ms are allowed",)
    assert not flight.passed


def test_the_command_prints_and_logs_the_lateness(tmp_path: Path, capsys: Printed) -> None:
    given = [word for change in SHORT for word in ("--set", change)]
    plain = load_scenario("nominal", SHORT)
    assert simrun.main(["fly", "nominal", *given, "--out", str(tmp_path / "out"), "--pace", "5"]) == 0
    printed = capsys.readouterr().out
    line = next(line for line in printed.splitlines() if line.startswith("at 5 times real time: "))
    assert line.startswith("at 5 times real time: 29 cycles, late by ")
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    timing = summary["timing"]
    assert (timing["pace"], timing["pace_cycles"]) == (5.0, 29)
    assert f"{1e3 * timing['pace_late_max_s']:.3f} ms at most" in line
    rows = list(csv.DictReader((tmp_path / "out/pace.csv").open()))
    assert max(float(row["late_s"]) for row in rows) == pytest.approx(timing["pace_late_max_s"], abs=1e-6)
    assert sum(row["overrun"] == "1" for row in rows) == timing["pace_overruns"]
    assert summary["state_hash"] == fly(plain).state_hash


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["campaigns/first", "--pace"], "--pace is an option of simrun fly, not of simrun campaign"),
        (["nominal", "--pace", "--view"], "--view and --pace exclude each other"),
        (["nominal", "--pace-limit", "1"], "--pace-limit needs --pace"),
        (["nominal", "--pace", "--set", "vehicle.computer=", "--set", "design="], "has no [computer]"),
    ],
)
def test_a_pace_without_meaning_is_an_error(words: list[str], said: str, capsys: Printed) -> None:
    try:
        code = simrun.main(words)
    except SystemExit as end:
        code = int(end.code or 0)
    assert code == 2
    assert said in capsys.readouterr().err.splitlines()[-1]
