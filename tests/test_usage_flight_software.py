"""External flight code gives clear messages when it fails and when a log is flown again."""

from __future__ import annotations

import hashlib
import importlib.util
import marshal
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from flight_code import EXAMPLES, compiled, flies, needs_compiler

import maxq
from maxq.control.external import HEADER
from maxq.design.verify import certified as judge
from maxq.design.verify.verify import _hashes
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run import guard
from maxq.sim.run.flight_software import checked
from maxq.sim.run.fly import fly as fly_once
from maxq.sim.scenario.flight_code import CodeFile, code_hash
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.python_file import imported
from maxq.tools import simrun

Printed = pytest.CaptureFixture[str]

WRONG = """
#include "maxq_fsw.h"
#include <math.h>
#ifndef MISSING
int32_t maxq_fsw_abi(void) { return ABI; }
#endif
int64_t maxq_fsw_bytes(void) { return 8; }
int32_t maxq_fsw_init(void *self, const maxq_fsw_setup *setup) { (void)self; (void)setup; return INIT; }
int32_t maxq_fsw_step(void *self, const maxq_fsw_inputs *in, maxq_fsw_outputs *out)
{
    volatile int64_t *nowhere = (volatile int64_t *)0;
    (void)self, (void)out;
    if (in->time_s > 1.205) { STEP; }
    return nowhere == (volatile int64_t *)1;
}
void maxq_fsw_close(void *self) { (void)self; CLOSE; }
"""
SOUND = {"ABI": "1", "INIT": "0", "STEP": "(void)out", "CLOSE": ""}


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def fly(*overrides: str) -> int:
    given = ["run.duration_s=2", "requirement=", *overrides]
    return simrun.main(["nominal", "--out", "out", *(word for change in given for word in ("--set", change))])


def wrong(folder: Path, **macros: str) -> Path:
    source = folder / "wrong.c"
    source.write_text(WRONG)
    flags = [f"-D{name}={text}" for name, text in (SOUND | macros).items()]
    return compiled(folder, source, "wrong", *flags)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    ("macros", "said"),
    [
        ({"STEP": "return 7"}, "its step returned 7"),
        ({"STEP": "out->gimbal_rad[1]=sqrt(-1.0)"}, "gave gimbal_rad[1], yaw: not a finite number"),
        ({"STEP": "out->roll_thruster=2"}, "gave roll_thruster = 2"),
        ({"STEP": "*nowhere=1"}, "crashed in its step: SIGSEGV"),
        ({"STEP": "for(;;){}"}, "did not return within 0.5 s in its step"),
    ],
)
def test_code_that_fails_in_flight_ends_it_with_a_closed_log(
    tmp_path: Path, capsys: Printed, macros: dict[str, str], said: str
) -> None:
    assert fly(*flies(library=wrong(tmp_path, **macros), timeout_s=0.5)) == 1
    printed = capsys.readouterr().out
    assert f"FAILED: flight software at 1.210 s: {said}" in printed.splitlines()[-1]
    log = maxq.read("out/flight.mcap")
    assert log.complete
    assert log.end["outcome"] == "flight_software"
    assert log.time_s("gyro_pitch_rate_degps")[-1] == pytest.approx(1.21, abs=0.0011)


@needs_compiler
@pytest.mark.parametrize("way", [-1, 1])
def test_thrusters_are_fired_either_way(tmp_path: Path, way: int) -> None:
    assert fly(*flies(library=wrong(tmp_path, STEP=f"out->roll_thruster={way}"))) == 0


@needs_compiler
@pytest.mark.parametrize(
    ("macros", "said"),
    [
        ({"MISSING": "1"}, "has no function maxq_fsw_abi"),
        ({"ABI": "9"}, "is made for version 9 of maxq_fsw.h, allowed are versions 1 to 2"),
        ({"INIT": "3"}, "maxq_fsw_init returned 3"),
        ({"INIT": "(int32_t)*(volatile char*)setup->bytes"}, "crashed at its start: SIGSEGV"),
    ],
)
def test_code_that_cannot_be_started_is_bad_input(
    tmp_path: Path, capsys: Printed, macros: dict[str, str], said: str
) -> None:
    assert fly(*flies(library=wrong(tmp_path, **macros))) == 2
    errors = capsys.readouterr().err
    assert said in errors.splitlines()[-1]
    assert "vehicle.computer.library" in errors
    assert not Path("out/flight.mcap").exists()


@needs_compiler
def test_code_that_does_not_close_is_left_behind(tmp_path: Path) -> None:
    assert fly(*flies(library=wrong(tmp_path, CLOSE="for(;;){}"), timeout_s=0.3)) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "code", "said"),
    [
        ("class Autopilot:\n  def __init__(self, s): self.n = 0\n  def step(self, i): return {1: 1 / 0}", 1, "line 3"),
        ("class Autopilot:\n  def __init__(self, s): pass\n  def step(self, i): return {'gimbal': 1}", 1, "gimbal"),
        ("class Autopilot:\n  def __init__(self, s): pass\n  def step(self, i): raise SystemExit(3)", 1, "SystemExit"),
        ("class Autopilot:\n  def __init__(self, s): raise ValueError('no')\n  def step(self, i): pass", 2, "no"),
        ("class Other: pass", 2, "has no class Autopilot"),
        ("class Autopilot: pass", 2, "has no method step"),
        ("import nothing_of_the_sort", 2, "ModuleNotFoundError"),
    ],
)
@pytest.mark.parametrize("guard", ["true", "false"])
def test_wrong_python_is_told_in_a_line(capsys: Printed, text: str, code: int, said: str, guard: str) -> None:
    Path("my_fsw.py").write_text(text)
    assert fly(*flies(python="my_fsw.py:Autopilot", guard=guard)) == code
    printed = capsys.readouterr()
    assert said in (printed.out if code == 1 else printed.err).splitlines()[-1]


MEDDLING = """
import hashlib
import importlib.util
import marshal
import os
import sys
import maxq.design.verify.certified as judge

judge.measured_requirements = lambda *given: []
with open("imported.txt", "a") as file:
    file.write(f"{os.getpid()}\\n")


class Autopilot:
    def __init__(self, setup):
        pass

    def step(self, inputs):
        return {"gimbal_rad": (0.0, 0.0)}
"""
"""A law that never moves the gimbal, and replaces a judge where it is imported."""


def test_python_code_is_imported_by_none_but_the_process_that_flies_it() -> None:
    Path("my_fsw.py").write_text(MEDDLING)
    before, modules = judge.measured_requirements, set(sys.modules)
    loaded = load_scenario("nominal", ["design=", "run.duration_s=1.0", *flies(python="my_fsw.py:Autopilot")])
    for _ in range(2):
        assert fly_once(loaded).outcome == "duration"
    assert judge.measured_requirements is before
    assert not [name for name in set(sys.modules) - modules if name.startswith("maxq_flight_code_")]
    processes = Path("imported.txt").read_text().split()
    assert len(set(processes)) == 2  # a process of its own for each flight
    assert str(os.getpid()) not in processes


ENDLESS = """
import time
from pathlib import Path

class Autopilot:
    def __init__(self, setup):
        pass

    def step(self, inputs):
        Path("inside").touch()
        time.sleep(3600.0)
"""


def test_code_that_does_not_return_ends_with_the_process_that_flies_it() -> None:
    """A command that ends at once kills its workers, which ignore the signals that it received."""
    Path("endless.py").write_text(ENDLESS)
    code = flies(python="endless.py:Autopilot", timeout_s=3600.0)
    with ThreadPoolExecutor(1) as pool:
        flight = pool.submit(fly_once, load_scenario("nominal", ["design=", *code]))
        until = time.monotonic() + 300.0
        while not Path("inside").exists():
            assert not flight.done()
            assert time.monotonic() < until
            time.sleep(0.05)
        guard.kill_workers()
        assert "SIGKILL" in flight.result(timeout=300.0).failures[0]


def test_python_code_that_does_not_return_at_its_start_is_ended(
    monkeypatch: pytest.MonkeyPatch, capsys: Printed
) -> None:
    monkeypatch.setattr(guard, "IMPORT_S", 0.5)
    Path("my_fsw.py").write_text("while True: pass\n")
    assert fly(*flies(python="my_fsw.py:Autopilot", timeout_s=0.1)) == 2
    assert "did not return within 0.6 s at its start" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("computer", "said"),
    [
        ({}, "names no flight code"),
        ({"library": "none.so"}, "no such file"),
        ({"python": "my_fsw.py"}, "names no class"),
        ({"python": "none.py:A", "address": "tcp://127.0.0.1:1"}, "no such file"),
        ({"address": "tcp://10.0.0.1:5000"}, "is not on this machine"),
        ({"address": "127.0.0.1"}, "is not an address"),
        ({"address": "tcp://127.0.0.1:1"}, "connection refused"),
    ],
)
def test_a_wrong_name_is_told_in_a_line(capsys: Printed, computer: dict[str, str], said: str) -> None:
    assert fly(*flies(**computer)) == 2
    assert said in capsys.readouterr().err.splitlines()[-1]


def test_the_hash_covers_all_files_of_the_code(tmp_path: Path) -> None:
    """The hash covers modules that a file can import, or all files of a package or sources."""
    law, helper, other = tmp_path / "law.py", tmp_path / "gains" / "__init__.py", tmp_path / "notes.txt"
    law.write_text("class Autopilot: ...\n", encoding="utf-8")

    def python() -> CodeFile:
        found = load_scenario("nominal", ["design=", *flies(python=f"{law}:Autopilot")]).vehicle.computer
        assert found is not None
        assert found.python is not None
        return found.python

    alone = python()
    assert (alone.sha256, alone.files) == (hashlib.sha256(law.read_bytes()).hexdigest(), ())
    helper.parent.mkdir()
    helper.write_text("GAIN = 1.0\n", encoding="utf-8")
    before = python()
    assert before.files == ("law.py", "gains/__init__.py")
    other.write_text("not code", encoding="utf-8")
    assert python() == before
    helper.write_text("GAIN = 1.8\n", encoding="utf-8")
    assert python().sha256 != before.sha256
    (tmp_path / "__init__.py").touch()
    assert python().files == ("__init__.py", "law.py", "notes.txt", "gains/__init__.py")

    library = tmp_path / "libfsw.so"
    library.write_bytes(b"code")
    named = load_scenario("nominal", ["design=", *flies(library=library, sources=tmp_path / "gains")])
    assert named.vehicle.computer is not None
    assert named.vehicle.computer.sources is not None
    assert named.vehicle.computer.sources.files == ("__init__.py",)
    under_test = [name for name in _hashes(named, {}, ()) if name.startswith("code under test")]
    assert [name.removeprefix("code under test: ").replace(f"{tmp_path}/", "") for name in under_test] == [
        "libfsw.so",
        "gains (1 file: __init__.py)",
    ]


def test_the_hash_covers_linked_folders_and_compiled_modules(tmp_path: Path) -> None:
    """A folder behind a symbolic link, and a module without source, are imported like any other."""
    law, linked = tmp_path / "code" / "law.py", tmp_path / "elsewhere"
    for folder in (law.parent, linked):
        folder.mkdir()
    law.write_text("import gains\n", encoding="utf-8")
    (law.parent / "gains").symlink_to(linked)
    (linked / "__init__.py").write_text("GAIN = 1.0\n", encoding="utf-8")
    (law.parent / "limits.pyc").write_bytes(b"compiled")
    before, files = code_hash(law)
    assert files == ("law.py", "limits.pyc", "gains/__init__.py")
    (linked / "__init__.py").write_text("GAIN = 1.8\n", encoding="utf-8")
    assert code_hash(law)[0] != before


def test_flight_code_runs_from_its_source_and_not_from_a_cache(tmp_path: Path) -> None:
    """A compiled module that claims validity for any source is not run instead of the hashed source."""
    law, gains = tmp_path / "law.py", tmp_path / "gains.py"
    law.write_text("import gains\nGAIN = gains.GAIN\n", encoding="utf-8")
    gains.write_text("GAIN = 1.0\n", encoding="utf-8")
    for path, text in ((law, "GAIN = 1.8"), (gains, "GAIN = 1.8")):
        forged = marshal.dumps(compile(text, str(path), "exec"))
        cached = Path(importlib.util.cache_from_source(str(path)))
        cached.parent.mkdir(exist_ok=True)
        cached.write_bytes(importlib.util.MAGIC_NUMBER + (1).to_bytes(4, "little") + bytes(8) + forged)
    try:
        assert imported(str(law), "0" * 64).GAIN == 1.0
    finally:
        imported.cache_clear()
        sys.modules.pop("gains", None)
    assert sys.pycache_prefix is None


def test_a_log_with_another_helper_module_is_not_flown_again(tmp_path: Path) -> None:
    for name in ("law", "gains"):
        (tmp_path / f"{name}.py").write_text("class Autopilot: ...\n", encoding="utf-8")
    flown = load_scenario("nominal", ["design=", *flies(python=f"{tmp_path / 'law.py'}:Autopilot")])
    (tmp_path / "gains.py").write_text("other = 1\n", encoding="utf-8")
    with pytest.raises(ScenarioError, match="is not the flight code that was flown"):
        checked(flown)


READING = """
import json
import os
import sqlite3
import sys


class Autopilot:
    def __init__(self, setup):
        how = setup.settings.decode()
        if how == "descriptor":
            os.close(os.open("gains/table.json", os.O_RDONLY))
        elif how == "database":
            sqlite3.connect("gains/table.json").close()
        elif how:
            self.gain = json.load(open("gains/table.json", how))
        with open("log.txt", "w") as file:
            file.write("started")

    def step(self, inputs):
        return {"gimbal_rad": (0.0, 0.0)}
"""


def test_python_code_reads_only_files_that_are_hashed() -> None:
    Path("reading.py").write_text(READING)
    Path("gains").mkdir()
    table = Path("gains/table.json")
    table.write_text("[1.0]")
    code = flies(python="reading.py:Autopilot")

    def loaded(*more: str) -> LoadedScenario:
        return load_scenario("nominal", ["design=", "run.duration_s=0.1", *code, *more])

    assert fly_once(loaded()).outcome == "duration"
    assert Path("log.txt").read_text() == "started"
    for how in ("r", "descriptor", "database"):
        with pytest.raises(
            ScenarioError, match=r"table\.json, which no hash covers; name it in vehicle\.computer\.data"
        ):
            fly_once(loaded(f"vehicle.computer.settings={how}"))
    declared = loaded("vehicle.computer.settings=r", "vehicle.computer.data=gains")
    assert fly_once(declared).outcome == "duration"
    assert [name for name in _hashes(declared, {}, ()) if name.endswith("gains (1 file: table.json)")]
    table.write_text("[1.8]")
    with pytest.raises(ScenarioError, match=r"data = \"gains\": is not the data that was flown"):
        checked(declared)


def test_a_log_is_flown_again_with_the_same_code_only(capsys: Printed, caplog: pytest.LogCaptureFixture) -> None:
    own = Path("own_fsw.py")
    own.write_text((EXAMPLES / "pd_law.py").read_text())
    assert fly(*flies(python="own_fsw.py:Autopilot")) == 0
    caplog.clear()
    assert simrun.main(["--from", "out/flight.mcap"]) == 0
    assert "SAME" in capsys.readouterr().out
    own.write_text(own.read_text() + "\n# changed\n")
    assert simrun.main(["--from", "out/flight.mcap"]) == 2
    assert "is not the flight code that was flown" in capsys.readouterr().err
    assert simrun.main(["--from", "out/flight.mcap", "--set", "vehicle.computer.python=own_fsw.py:Autopilot"]) == 0
    assert "own_fsw.py:Autopilot (sha256 " in caplog.text


def test_the_header_is_printed(capsys: Printed) -> None:
    assert simrun.main(["--schema", "flight-software"]) == 0
    assert capsys.readouterr().out == HEADER.read_text()


REMEMBERING = """
#include "maxq_fsw.h"
#include <pthread.h>
#include <unistd.h>
static int64_t steps;
static void *asleep(void *_) { for (;;) pause(); return _; }
int32_t maxq_fsw_abi(void) { return MAXQ_FSW_ABI; }
int64_t maxq_fsw_bytes(void) { return 0; }
int32_t maxq_fsw_init(void *self, const maxq_fsw_setup *setup)
{
    pthread_t thread;
    (void)self;
    return setup->settings[0] == 't' ? pthread_create(&thread, 0, asleep, 0) : 0;
}
int32_t maxq_fsw_step(void *self, const maxq_fsw_inputs *in, maxq_fsw_outputs *out)
{
    (void)self;
    out->monitor[0] = getpid();
    out->monitor[1] = ++steps;
    if (in->time_s > 0.055 && CRASHES) *(volatile int *)0 = 1;
    return 0;
}
void maxq_fsw_close(void *self) { (void)self; }
"""


@needs_compiler
def test_one_process_flies_flight_after_flight_and_each_begins_anew(tmp_path: Path) -> None:
    """The memory of a library ends with its flight; a thread or a crash of it ends the process."""
    (tmp_path / "own.c").write_text(REMEMBERING)
    sound, crashing = (
        compiled(tmp_path, tmp_path / "own.c", f"own{n}", f"-DCRASHES={n}", "-D_GNU_SOURCE", "-pthread") for n in (0, 1)
    )

    def flown(library: Path, settings: str = "") -> tuple[str, float, float]:
        wanted = flies(library=library, settings=settings or "none")
        flight = fly_once(load_scenario("nominal", ["run.duration_s=0.1", "requirement=", *wanted]))
        return flight.outcome, flight.final["monitor_1"], flight.final["monitor_2"]

    first = flown(sound)
    assert first[::2] == ("duration", 9.0)
    assert flown(crashing)[0] == "flight_software"
    assert flown(sound) == first
    assert flown(sound, "threaded") == first
    anew = flown(sound)
    assert anew[::2] == first[::2]
    assert anew[1] != first[1]


@pytest.mark.slow
@needs_compiler
def test_flights_on_threads_have_a_process_each(tmp_path: Path) -> None:
    """In sixteen flights, four at a time, every third crashes; the others equal single flights."""
    (tmp_path / "own.c").write_text(REMEMBERING)
    libraries = [compiled(tmp_path, tmp_path / "own.c", f"own{n}", f"-DCRASHES={n}", "-D_GNU_SOURCE") for n in (0, 1)]
    scenarios = [load_scenario("nominal", ["run.duration_s=0.1", *flies(library=library)]) for library in libraries]
    wrong = [int(n % 3 == 2) for n in range(16)]
    with ThreadPoolExecutor(4) as pool:
        flights = list(pool.map(lambda n: fly_once(scenarios[n]), wrong))
    assert [int(f.outcome == "flight_software") for f in flights] == wrong
    assert {(f.state_hash, f.final["monitor_2"]) for f, n in zip(flights, wrong, strict=True) if n == 0} == {
        (flights[0].state_hash, 9.0)
    }
