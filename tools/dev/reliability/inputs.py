"""Broken inputs of every kind, given to the functions that the commands call, in one process.

Each mutant of a file (mutants.py) must be used, or rejected with exit code 2 and one line of at most 2,500 characters
that leaves no output. Anything else is a fault: an internal error, a traceback, more than `LONGEST_S`, a warning of
NumPy, or output of a rejected input. Flights last 20 ms; kernels are not compiled for another structure, and searches
of designs, suites and layouts end before their computation.
"""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import io
import itertools
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numba.core.dispatcher
from pydantic_core import PydanticCustomError

from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.read import load_campaign
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.campaign.targets import Refused
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.foreign import read_datcom
from maxq.sim.log.head import LogError
from maxq.sim.packing.flight import pack_flight
from maxq.sim.vehicle.modes.nastran import read_nastran, spatial_columns
from maxq.tools import simdesign, simreplay, simrun, simvehicle, simverify
from maxq.tools.dev.reliability.mutants import TESTS, mutants, of_tests
from maxq.tools.vehicle.layout import read_layout
from maxq.tools.verify.records import RESULTS_NAME
from maxq.tools.verify.report import VERDICT_NAME

LONGEST_S = 20.0
MOST_GB = 3.0
SHIPPED = TESTS.parent / "scenarios"
SHORT = ("--set", "run.duration_s=0.02")
_LARGE = ("advance", "begin")
"""The kernels of a flight, which take about a minute to compile for another structure."""
CODES = {0, 1, 2, 3}


class _Accepted(BaseException):
    """The end of a command whose input has been read, when its computation would begin."""


class _TooLong(BaseException):
    """The end of an input that takes too long."""


@dataclass(frozen=True)
class InputKind:
    """A kind of input: files below a folder, and the command that reads a mutant of one of them.

    `run` takes the path of the file and returns the exit code. `share` is the part of all inputs.
    """

    name: str
    files: tuple[str, ...]
    run: Callable[[str], int]
    share: float
    steady: Callable[[], object] = lambda: None
    """Called after each input, to restore other files that the command has changed."""


@dataclass
class InputCounts:
    """The outcomes of one kind: numbers of inputs, and the faults with their files."""

    number: int = 0
    used: int = 0
    rejected: int = 0
    faults: list[tuple[str, bytes]] = field(default_factory=list)
    seconds: float = 0.0


def _main(module: Any, *words: str) -> int:
    try:
        return int(module.main([*words]))
    except SystemExit as end:
        return int(end.code or 0)
    except _Accepted:
        return 0


def answer(kind: InputKind, file: str) -> tuple[int, str]:
    """Return the exit code of an input, and its fault or an empty string."""
    before, said, code, what = set(_files()), io.StringIO(), -1, ""
    signal.setitimer(signal.ITIMER_PROF, LONGEST_S)  # of the processor, since the machine may be busy
    try:
        with (
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(record=True) as warned,
        ):
            warnings.simplefilter("always")
            code = kind.run(file)
    except _TooLong:
        what = f"takes more than {LONGEST_S:g} s"
    except Exception as error:  # a fault that no command reports
        what = f"{type(error).__name__}: {error}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    lines = [line for line in said.getvalue().splitlines() if "note: " not in line]
    numeric = [
        f"{w.message} ({Path(w.filename).name}, line {w.lineno})"
        for w in warned
        if issubclass(w.category, RuntimeWarning)
    ]
    left = sorted(set(_files()) - before)
    if what:
        pass
    elif code not in CODES:
        what = f"exit code {code}: {' | '.join(lines)[-400:]}"
    elif code == 2 and (len(lines) != 1 or len(lines[0]) > 2500):
        what = f"{len(lines)} lines: {' | '.join(lines)[:300]}"
    elif numeric:
        what = f"RuntimeWarning: {numeric[0]}"
    elif code == 2 and left:
        what = f"leaves {left[0]}: {lines[0][:200]}"
    elif resource.getrusage(resource.RUSAGE_SELF).ru_maxrss > MOST_GB * 1e6:
        what = f"more than {MOST_GB:g} GB"
    for name in left:
        with contextlib.suppress(OSError):
            Path(name).unlink()
    if Path("out").exists():
        shutil.rmtree("out")
    return code, what


def _files() -> Iterator[str]:
    for place, folders, names in os.walk("."):
        yield from (os.path.join(place, name) for name in names)
        yield from (os.path.join(place, name) for name in folders)


def run(kinds: list[InputKind], number: int, seed: int, shown: Callable[[str], object]) -> dict[str, InputCounts]:
    """Give `number` inputs in all to the commands, and return the outcomes by kind."""
    out, total = dict[str, InputCounts](), sum(kind.share for kind in kinds)
    for kind in kinds:
        chance, count = random.Random(f"{kind.name} {seed}"), InputCounts()
        sources = {name: mutants(name, Path(name).read_bytes(), chance) for name in kind.files}
        began = time.process_time()
        for name in itertools.islice(itertools.cycle(kind.files), round(number * kind.share / total)):
            original, content = Path(name).read_bytes(), next(sources[name])
            Path(name).write_bytes(content)
            try:
                code, fault = answer(kind, name)
            finally:
                Path(name).write_bytes(original)
                kind.steady()
            count.number += 1
            count.used += not fault and code != 2
            count.rejected += not fault and code == 2
            if fault:
                count.faults.append((f"{name}: {fault}", content))
                shown(f"{kind.name}: {name}: {fault}")
        count.seconds = time.process_time() - began
        out[kind.name] = count
        shown(f"{kind.name}: {count.number} inputs, {len(count.faults)} faults, {count.seconds:.1f} s")
    return out


def _end(number: int, frame: object) -> None:
    raise _TooLong


def summary(found: dict[str, InputCounts]) -> Counter[str]:
    """Return the numbers of faults by kind and text, without the numbers in the texts."""
    return Counter(
        f"{name}: {re.sub('[0-9]+', 'N', text)[:160]}" for name, counts in found.items() for text, _ in counts.faults
    )


# --- the kinds


def _fly(scenario: str, *overrides: str) -> int:
    words = [word for change in overrides for word in ("--set", change)]
    return _main(simrun, "fly", scenario, *SHORT, *words, "--no-log", "--out", "out")


def _by(read: Callable[[], object]) -> int:
    """Return the exit code of a command for what a function raises."""
    try:
        read()
    except _Accepted:
        return 0
    except (PydanticCustomError, ScenarioError, CampaignError, LogError, Refused) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _nastran(file: str) -> int:
    """Read modes, and put them into a table."""
    return _by(lambda: spatial_columns({0.0: read_nastran("beam.f06" if file.endswith(".bdf") else file)}))


def _datcom(file: str) -> int:
    return _by(lambda: read_datcom(Path(file).read_text(encoding="latin-1"), file, file))


def _campaign(file: str) -> int:
    """Draw and pack two runs."""

    def read() -> None:
        loaded = load_campaign("ksr3/campaigns/ksr3.toml")
        for run in (0, 1):
            pack_flight(loaded.inputs(run).loaded.scenario)

    return _by(read)


def _points(file: str) -> int:
    words = ("greensite-zavoli", "--points", "points/greensite.toml", "--at", "60", "--no-pictures", "--out", "out")
    return _main(simdesign, "analyse", *words)


def _layout(file: str) -> int:
    return _by(lambda: read_layout(file))


def _accept(*_: Any, **__: Any) -> Any:
    raise _Accepted


@contextlib.contextmanager
def stand_ins() -> Iterator[None]:
    """Replace the computations that take seconds by the acceptance of the input, within a block."""
    places = ("maxq.tools.design.run_case.design_case", "maxq.tools.verify.run.verify")
    compiler = numba.core.dispatcher._FunctionCompiler
    compile_function = compiler.compile

    def compile_small(self: Any, *given: Any) -> Any:
        if self.py_func.__name__ in _LARGE:
            raise _Accepted
        return compile_function(self, *given)

    with contextlib.ExitStack() as stack:
        for place in places:
            stack.enter_context(mock.patch(place, _accept))
        stack.enter_context(mock.patch.object(compiler, "compile", compile_small))
        stack.enter_context(mock.patch("maxq.tools.vehicle.build.MODE_ROWS", 2))
        signal.signal(signal.SIGPROF, _end)
        yield


def _pack(file: str) -> int:
    """Check a pack whose results are `results.json`, with their hashes corrected, as a forger would do."""
    folder = Path(file).parent
    if file.endswith("results.json"):
        forged = gzip.compress(Path(file).read_bytes(), 1, mtime=0)
        (folder / RESULTS_NAME).write_bytes(forged)
        _rehash(folder, {RESULTS_NAME: forged})
    elif not file.endswith("verdict.json"):
        _rehash(folder, {Path(file).relative_to(folder).as_posix(): Path(file).read_bytes()})
    return _main(simverify, "--check", str(folder), "--sample", "0")


def _rehash(folder: Path, contents: dict[str, bytes]) -> None:
    record = json.loads((folder / VERDICT_NAME).read_text())
    record["files"] |= {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    (folder / VERDICT_NAME).write_text(json.dumps(record))


def _options(seed: int) -> Iterator[list[str]]:
    """Yield words of command lines without end: options of every command with values that they do not expect."""
    chance, fuzzer = random.Random(seed), of_tests("file_fuzzer")
    while True:
        module = chance.choice((simrun, simdesign, simverify, simreplay, simvehicle))
        root = module._parser()
        parser = chance.choice((root, *root._commands.values()))
        words = [parser.prog.split()[1]] if parser is not root else []
        known = [name for name in parser._option_string_actions if name not in _ENDLESS]
        for _ in range(chance.choice((1, 1, 2, 2, 3, 5))):
            words.append(chance.choice((*known, *known, "nominal", "ksr3-default", "nofile", "--", "-x", "--nonsense")))
            if chance.random() < 0.7:
                values = (*map(str, fuzzer.NUMBERS), *fuzzer.TEXTS, "1/2", "2/1", "a,b", "worst:5", "0,3", "run.seed=1")
                words.append(chance.choice(values).replace("\0", ""))
        yield [module.__name__.rpartition(".")[2], *words]


_ENDLESS = ("--web", "--view", "--view-port", "--screenshot", "--pace", "--realtime", "--port", "--dask", "--sync")
"""Options that open a window, a port or another machine, or wait."""


def make_files(folder: Path, only: Collection[str] = ()) -> list[InputKind]:
    """Write intact files below `folder`, which becomes the working folder, and return the kinds, or those of `only`."""
    os.chdir(folder)
    fuzzer, soundings, foreign = map(of_tests, ("file_fuzzer", "test_usage_soundings", "test_reference_foreign_tables"))
    gridded, campaigns, packs = map(of_tests, ("test_usage_gridded_winds", "campaignkit", "test_usage_verify_records"))
    for name in ("nominal", "ksr3-ringed", "tvc-load", "load-relief", "checkcases/nesc-17", "campaigns/ksr3"):
        assert _main(simrun, "copy", name, name.rpartition("/")[2]) == 0, name
    scenarios = {
        **{name: f"{name}/{name}.toml" for name in ("nominal", "ksr3-ringed", "tvc-load", "load-relief")},
        "nesc-17": "nesc-17/checkcases/nesc-17.toml",
    }

    def fly(file: str) -> int:
        return _fly(scenarios[Path(file).parts[0]])

    def fly_with(key: str) -> Callable[[str], int]:
        return lambda file: _fly("checkcases/two-stage", f"{key}={file}")

    texts = {
        "wyoming.txt": soundings.WYOMING,
        "igra.txt": soundings.IGRA.split("#KSM00047138 2002 11 28 12")[0],
        "balloon.csv": "# date: 2002-11-28\nALT (ft),direction (deg),wind speed [kts]\n3000,210,31\n0,180,9\n",
        "model.csv": "pressure_hPa,u_m/s,v_m/s\n54.7489,30,-4\n226.3206,20,3\n1013.25,5,0\n",
        "motor.eng": foreign.MOTOR,
        "motor.rse": foreign.ROCKSIM,
        "for006.dat": foreign.FOR006,
        "drag.csv": "0.0,0.42\n0.9,0.45\n2.0,0.5\n",
    }
    for name, text in texts.items():
        Path(name).write_text(text)
    for path in (TESTS / "data/nastran").glob("beam.*"):
        shutil.copy(path, path.name)
    grid = gridded._data(("u", "v", "z"), latitudes=[40.0, 30.0], longitudes=[120.0, 130.0])
    gridded._file(Path(), grid)
    for name in ("points", "suites", "designs/cases", "layouts"):
        shutil.copytree(SHIPPED / name, Path(name).name)
    fuzzer.write_files(Path())
    if not only or "data of campaigns" in only:
        run_campaign(campaigns.small(Path(), runs=20), Path("kept"), workers=1)
        shutil.copytree("kept", "intact-kept")
    if not only or "logs" in only:
        assert _main(simrun, "fly", "nominal", "--set", "run.duration_s=0.3", "--out", "flown") in (0, 1)
    if not only or "review packs" in only:
        packs._make(Path())
        with gzip.open(Path("pack") / RESULTS_NAME) as results:
            Path("pack/results.json").write_bytes(results.read())
        shutil.copytree("pack", "intact-pack")
    words = _options(1)
    tables = tuple(sorted(str(p) for name in ("nominal", "ksr3-ringed", "nesc-17") for p in Path(name).rglob("*.csv")))
    vehicles = ("nominal", "ksr3-ringed", "tvc-load", "nesc-17")

    def again(place: str) -> Callable[[], object]:
        def restore() -> None:
            shutil.rmtree(place, ignore_errors=True)
            shutil.copytree(f"intact-{place}", place)

        return restore

    def option(_: str) -> int:
        module, *given = next(words)
        return _main(sys.modules[f"maxq.tools.{module}"], *given)

    kinds = [
        InputKind("scenarios", tuple(scenarios.values()), fly, 3),
        InputKind("vehicles", tuple(str(next(Path(v).rglob("vehicle.toml"))) for v in vehicles), fly, 3),
        InputKind("tables of vehicles", tables, fly, 4),
        InputKind("designs", ("nominal/designs/ksr3-robust.toml", "load-relief/designs/ksr3-load-relief.toml"), fly, 2),
        InputKind("soundings", tuple(texts)[:4], lambda f: _fly("nominal", f"wind.profile={f}"), 6),
        InputKind(
            "winds in NetCDF", ("era5.nc",), lambda f: _main(simrun, "winds", f, "--at", "35,125", "--out", "out"), 4
        ),
        InputKind("RASP, RockSim", ("motor.eng", "motor.rse"), fly_with("vehicle.stage.0.engine.table"), 10),
        InputKind("drag curves", ("drag.csv",), fly_with("vehicle.stage.0.aero.table"), 3),
        InputKind("DATCOM", ("for006.dat",), _datcom, 8),
        InputKind("NASTRAN", ("beam.op2", "beam.f06", "beam.bdf"), _nastran, 15),
        InputKind(
            "published derivatives",
            ("points/greensite.toml", "points/greensite.csv", "points/greensite-mode.csv"),
            _points,
            2,
        ),
        InputKind(
            "campaigns", ("ksr3/campaigns/ksr3.toml", "ksr3/winds/anheung-november-dispersion.csv"), _campaign, 1.5
        ),
        InputKind(
            "cases",
            tuple(map(str, sorted(Path("cases").glob("ksr3*.toml")))),
            lambda f: _main(simdesign, "optimise", f, "--no-pictures", "--out", "out"),
            12,
        ),
        InputKind(
            "suites",
            ("suites/quick.toml", "suites/standard.toml", "suites/ksr3-board.toml"),
            lambda f: _main(simverify, "ksr3-robust", "--suite", f, "--no-pack", "--out", "out"),
            8,
        ),
        InputKind(
            "layouts",
            ("layouts/petrel.toml", "layouts/gannet.toml", "layouts/heron.toml", "layouts/ksr3.toml"),
            _layout,
            8,
        ),
        InputKind("small layouts, built", ("layout.toml",), lambda f: _main(simvehicle, f, "--out", "out"), 0.1),
        InputKind(
            "data of campaigns",
            ("kept/campaign.json", *map(str, sorted(Path("kept/runs").glob("*")))),
            lambda f: _main(simrun, "report", "kept", "--no-report"),
            1,
            again("kept"),
        ),
        InputKind("review packs", ("pack/verdict.json", "pack/results.json"), _pack, 0.2, again("pack")),
        InputKind(
            "logs", ("flown/flight.mcap", "flown/summary.json"), lambda _: _main(simreplay, "flown", "--summary"), 1
        ),
        InputKind("options", ("nominal/nominal.toml",), option, 15),
    ]
    return [kind for kind in kinds if not only or kind.name in only]
