"""`simrun SCENARIO` and `simrun --from LOG`: load, fly, write, compare, report."""

from __future__ import annotations

import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from maxq.sim.files import check_writable
from maxq.tools.cli.frame import CommandError, Exit, say

if TYPE_CHECKING:
    from maxq.sim.run.fly import FlightRun
    from maxq.sim.scenario.loader import LoadedScenario
    from maxq.tools.cli.terminal import Progress
    from maxq.tools.comparison import Comparison
    from maxq.tools.replay.live import LiveView


@dataclass(frozen=True)
class Order:
    """What the command line asks for: a scenario by name, or a log to be flown again."""

    scenario: str | None = None
    log: str | None = None
    overrides: tuple[str, ...] = ()
    out: str | None = None
    no_log: bool = False
    view: bool = False
    view_port: int | None = None
    realtime: float | None = None


def execute(order: Order, *, alone: bool = False) -> int:
    """Do it; returns the exit code. `alone`: nobody else uses Numba in this process."""
    start_s = time.perf_counter()  # the clock starts before the heavy imports
    if alone:
        _load_numba_without_blas()
    from maxq.sim.log.head import LogError  # noqa: PLC0415  # lazy
    from maxq.sim.packing.flight import pack_flight  # noqa: PLC0415  # lazy
    from maxq.sim.run import record  # noqa: PLC0415  # lazy
    from maxq.sim.run.fly import FlightRun  # noqa: PLC0415  # lazy
    from maxq.tools.cli.interruption import Interruption  # noqa: PLC0415  # lazy
    from maxq.tools.cli.terminal import Progress  # noqa: PLC0415  # lazy
    from maxq.tools.flight_report import report  # noqa: PLC0415  # lazy

    loaded, comparison = _load(order)
    packed = pack_flight(loaded.scenario)
    folder = _folder(order, loaded.name)
    if folder is not None:
        check_writable(folder, LogError)
    loaded_s = time.perf_counter()
    view = _view(order, loaded)
    announce_compilation()
    if view is None:
        run = FlightRun(loaded, packed, log=folder is not None and not order.no_log)
    else:
        run = view.run(packed, order.realtime)
    prepared_s = time.perf_counter()

    def timing() -> dict[str, float]:
        now_s = time.perf_counter()
        return {
            "load_s": loaded_s - start_s,
            "prepare_s": prepared_s - loaded_s,
            "total_s": now_s - start_s,
        }

    with Interruption() as interruption, Progress() as progress:
        if view is not None:
            view.stop = lambda: interruption.requested

        def watch(run: FlightRun) -> None:
            show_flight(progress, run)
            comparison.look(run)

        comparison.look(run)
        try:
            if folder is None:
                flight = record.fly_to_end(run, watch=watch, stop=lambda: interruption.requested)
            else:
                flight = record.record(
                    run,
                    folder,
                    log=not order.no_log,
                    watch=watch,
                    stop=lambda: interruption.requested,
                    timing=timing,
                )
        except KeyboardInterrupt:
            say("simrun", "interrupted twice: no summary, the log ends early")
            return Exit.INTERRUPTED
    files = []
    if folder is not None:
        files = [folder / record.LOG_NAME] * (not order.no_log) + [folder / record.SUMMARY_NAME]
    print(report(flight, files, timing()["total_s"]))
    same = comparison.verdict(flight)
    if flight.outcome == "interrupted":
        return Exit.INTERRUPTED
    return Exit.OK if flight.passed and same else Exit.FAILED


def show_flight(progress: Progress, run: FlightRun) -> None:
    """A flight's progress. Its end is the longest that the flight may take: most flights end before, by impact."""
    limits = run.loaded.scenario.run
    count = f"{run.now_s:.1f} s of at most {limits.start_s + limits.duration_s:g} s"
    progress.show("flying", run.now_s - limits.start_s, limits.duration_s, count=count)


def _view(order: Order, loaded: LoadedScenario) -> LiveView | None:
    """The viewer, opened before anything is flown. Raises CommandError where there is none."""
    if not order.view:
        return None
    from maxq.tools.replay.viewer import ReplayError  # noqa: PLC0415  # lazy

    try:
        from maxq.tools.replay.live import LiveView  # noqa: PLC0415  # lazy: rerun takes half a second

        return LiveView(loaded, order.view_port)
    except ReplayError as error:
        raise CommandError(f"--view: {error}") from error
    except ImportError as error:
        raise CommandError(f"--view: a package is missing or broken: {error}") from error


def _load_numba_without_blas() -> None:
    """Numba looks for BLAS where it first meets compiled code, by importing scipy.linalg: a fifth of a second.

    Kernels use no linear algebra (CONTRIBUTING.md), so this process, which flies and ends, tells it that there is none.
    """
    blas = "scipy.linalg.cython_blas"
    if blas in sys.modules:
        return
    sys.modules[blas] = None  # type: ignore[assignment]  # Python's way of saying "cannot be imported"
    try:
        import numba.np.arraymath  # noqa: F401, PLC0415  # its import is what looks
    finally:
        del sys.modules[blas]


def _load(order: Order) -> tuple[LoadedScenario, Comparison]:
    from maxq.sim.log.reader import read_run  # noqa: PLC0415  # lazy
    from maxq.sim.run.metrics import METRIC_NAMES  # noqa: PLC0415  # lazy
    from maxq.sim.scenario.loader import load_scenario, load_scenario_text  # noqa: PLC0415  # lazy
    from maxq.tools.comparison import Comparison, scenario_text  # noqa: PLC0415  # lazy

    if order.log is None:
        assert order.scenario is not None
        return load_scenario(order.scenario, order.overrides, METRIC_NAMES), Comparison(None)
    logged = read_run(order.log)
    loaded = load_scenario_text(scenario_text(logged), order.overrides, METRIC_NAMES, f"scenario in {order.log}")
    return loaded, Comparison(logged, changed=bool(order.overrides))


def _folder(order: Order, name: str) -> Path | None:
    """Where to write; a log that is flown again leaves nothing unless told where."""
    if order.out is None:
        return None if order.log else Path("runs") / (re.sub(r"[^\w.-]+", "-", name).strip(".-") or "flight")
    from maxq.sim.log.head import LogError  # noqa: PLC0415  # lazy
    from maxq.sim.run.record import LOG_NAME  # noqa: PLC0415  # lazy

    folder = Path(order.out)
    log = folder / LOG_NAME
    if order.log and log.exists() and log.samefile(order.log):
        raise LogError(f"{log}: is the log that is to be flown again; choose another folder for --out")
    return folder


def announce_compilation() -> None:
    """On a terminal, say why the first flight takes its time."""
    from maxq.control.kernel.jit import cache_folder  # noqa: PLC0415  # lazy

    if sys.stderr.isatty() and not any(cache_folder().rglob("loop.advance*.nbc")):
        print("compiling the simulator, once for this version of it: about half a minute ...", file=sys.stderr)
