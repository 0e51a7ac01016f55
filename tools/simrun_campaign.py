"""`simrun CAMPAIGN` and `simrun --from DIR`: fly, resume, judge, report; fly one run of it again."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maxq.sim.scenario.errors import ScenarioError
from maxq.tools.cli.interruption import Interruption
from maxq.tools.cli.terminal import printable
from maxq.tools.replay.error import ReplayError

if TYPE_CHECKING:
    from maxq.sim.campaign.loaded import LoadedCampaign
    from maxq.sim.campaign.runner import Outcome, Progress
    from maxq.tools.replay.flown import FlownView

PASSED, FAILED, BAD_INPUT, OPEN, INTERRUPTED = 0, 1, 2, 3, 130


@dataclass(frozen=True)
class Order:
    """What the command line asks for: a campaign to fly (`scenario`), or one that was flown (`folder`)."""

    scenario: str | None = None
    folder: str | None = None
    overrides: tuple[str, ...] = ()
    out: str | None = None
    no_log: bool = False
    runs: int | None = None
    seed: int | None = None
    workers: int | None = None
    keep: tuple[str, ...] = ()
    until_settled: bool = False
    no_report: bool = False
    dask: str | None = None
    run: int | None = None
    view: bool = False
    view_port: int | None = None
    shrink: bool = False
    search: str | None = None


def execute(order: Order) -> int:
    """Do it; returns the exit code. Whatever is wrong with the input is one line on stderr."""
    from maxq.sim.campaign.error import CampaignError  # noqa: PLC0415  # lazy: --help is quick
    from maxq.sim.log.head import LogError  # noqa: PLC0415  # lazy

    try:
        if order.scenario is not None:
            return _fly(order)
        if order.shrink:
            return _shrink(order)
        if order.run is not None:
            return _refly(order)
        if order.search is not None:
            return _search(order)
        return _report_again(order)
    except (ScenarioError, CampaignError, LogError, ReplayError) as error:
        print(f"simrun: {printable(str(error))}", file=sys.stderr)
        return BAD_INPUT
    except MemoryError:
        print("simrun: not enough memory; use fewer --workers", file=sys.stderr)
        return BAD_INPUT


def _fly(order: Order) -> int:
    from maxq.sim.campaign.read import load_campaign  # noqa: PLC0415  # lazy
    from maxq.sim.campaign.store import RUNS  # noqa: PLC0415  # lazy
    from maxq.tools.campaign_progress import CampaignProgress, duration  # noqa: PLC0415  # lazy

    start_s = time.perf_counter()
    assert order.scenario is not None
    campaign = _with_options(load_campaign(order.scenario, order.overrides), order)
    folder = Path(order.out) if order.out else default_folder(campaign.name)
    if order.dask is None:
        _announce_compilation()
    shown = CampaignProgress()
    with Interruption() as interruption:
        try:
            outcome = _flown(order, campaign, folder, shown.show, lambda: interruption.requested)
        except KeyboardInterrupt:
            shown.end()
            print("simrun: interrupted twice; whole batches are safe, the same command goes on", file=sys.stderr)
            return INTERRUPTED
        finally:
            shown.end()
        for note in outcome.notes:
            print(f"simrun: {printable(note)}", file=sys.stderr)
        if not outcome.stopped:
            _keep(campaign, folder, (*campaign.campaign.keep, *order.keep), lambda: interruption.requested)
    flown = f"{outcome.flown} runs flown in {duration(outcome.wall_s)} ({_rate(outcome)})"
    if outcome.flown == 0 and not outcome.stopped:
        flown = f"all {outcome.total} runs were flown before; --runs N with a larger number flies more"
    code = _tell(campaign, folder, outcome.total, flown, order, start_s, outcome.settled)
    if outcome.stopped:
        print(f"INTERRUPTED: the data set in {folder / RUNS} is whole; the same command goes on")
        return INTERRUPTED
    return code


def _with_options(campaign: LoadedCampaign, order: Order) -> LoadedCampaign:
    changes: dict[str, Any] = {}
    if order.runs is not None:
        changes["runs"] = order.runs
    if order.seed is not None:
        changes["seed"] = order.seed
    return campaign.with_campaign(**changes) if changes else campaign


def _flown(
    order: Order,
    campaign: LoadedCampaign,
    folder: Path,
    watch: Callable[[Progress], None],
    stop: Callable[[], bool],
) -> Outcome:
    if order.dask is not None:
        from maxq.sim.campaign.cluster import run_on_cluster  # noqa: PLC0415  # lazy: an extra

        return run_on_cluster(campaign, folder, order.dask, watch=watch, stop=stop, until_settled=order.until_settled)
    from maxq.sim.campaign.runner import run_campaign  # noqa: PLC0415  # lazy

    return run_campaign(
        campaign,
        folder,
        workers=order.workers,
        watch=watch,
        stop=stop,
        until_settled=order.until_settled,
    )


def _rate(outcome: Outcome) -> str:
    return f"{outcome.flown / outcome.wall_s:.1f} flights/s" if outcome.wall_s > 0.0 else "at once"


def _tell(
    campaign: LoadedCampaign, folder: Path, total: int, flown: str, order: Order, start_s: float, settled: bool
) -> int:
    """Summary, pictures and report into the folder; what a person wants to know onto the terminal."""
    from maxq.sim.campaign.analysis import DataSet, failed_runs, judged, lost  # noqa: PLC0415  # lazy
    from maxq.tools import campaign_text as text  # noqa: PLC0415  # lazy
    from maxq.tools.campaign_page import write_report  # noqa: PLC0415  # lazy
    from maxq.tools.campaign_progress import duration  # noqa: PLC0415  # lazy

    data = DataSet(folder, campaign)
    verdicts, losses = judged(data), lost(data)
    failed = len(failed_runs(data)) if len(data.runs) else 0
    files = write_report(data, verdicts, losses, total, {"sequential": settled}, pictures=not order.no_report)
    print("\n".join(text.report(data, verdicts, losses, failed)))
    print(f"\n{flown}; {duration(time.perf_counter() - start_s)} in all")
    for file in files:
        print(file)
    level = campaign.campaign.success, campaign.campaign.confidence
    if settled:
        print("\nstopped early: every verdict is settled by a test that allows looking at any time")
    print("\n" + text.headline(verdicts, len(data.runs), *level, failed))
    judgements = {v.shown.judgement for v in verdicts}
    if "not met" in judgements:
        return FAILED
    return PASSED if judgements == {"met"} else OPEN


def _keep(campaign: LoadedCampaign, folder: Path, keep: tuple[str, ...], stop: Callable[[], bool]) -> None:
    """Fly the chosen runs again, with a full log."""
    if not keep:
        return
    from maxq.sim.campaign.analysis import DataSet, selected  # noqa: PLC0415  # lazy
    from maxq.sim.campaign.refly import flight_folder, refly  # noqa: PLC0415  # lazy
    from maxq.sim.run.record import LOG_NAME, SUMMARY_NAME  # noqa: PLC0415  # lazy

    runs = selected(DataSet(folder, campaign), keep)
    for n, run in enumerate(runs):
        there = flight_folder(folder, run)
        if (there / SUMMARY_NAME).exists() and (there / LOG_NAME).exists():
            continue
        if stop():
            return
        if sys.stderr.isatty():
            print(f"\rkeeping run {run} ({n + 1} of {len(runs)})   ", end="", file=sys.stderr, flush=True)
        again = refly(folder, run, campaign=campaign, stop=stop)
        if again.same is False:
            print(f"simrun: run {run} differs from the data set: {again.differences[0]}", file=sys.stderr)
    if sys.stderr.isatty() and runs:
        print("\r" + " " * 60 + "\r", end="", file=sys.stderr, flush=True)


def _refly(order: Order) -> int:
    from maxq.sim.campaign.refly import refly  # noqa: PLC0415  # lazy
    from maxq.sim.run import record  # noqa: PLC0415  # lazy
    from maxq.tools.cli.terminal import Progress  # noqa: PLC0415  # lazy
    from maxq.tools.flight_report import report  # noqa: PLC0415  # lazy
    from maxq.tools.simrun_fly import show_flight  # noqa: PLC0415  # lazy

    assert order.folder is not None
    assert order.run is not None
    start_s = time.perf_counter()
    view = _view(order)
    _announce_compilation()
    out = Path(order.out) if order.out else None
    with Interruption() as interruption, Progress() as progress:
        again = refly(
            Path(order.folder), order.run, out,
            log=not order.no_log, watch=lambda run: show_flight(progress, run), stop=lambda: interruption.requested,
        )  # fmt: skip
    names = [record.LOG_NAME] * (not order.no_log) + [record.SUMMARY_NAME]
    print(report(again.flight, [again.folder / name for name in names], time.perf_counter() - start_s))
    if again.flight.outcome == "interrupted":
        return INTERRUPTED
    of = f"run {order.run} of {order.folder}"
    if again.same is None:
        print(f"not compared: {of} has not been flown")
    elif again.same:
        print(f"SAME as {of}: inputs, metrics and final state are equal, bit by bit ({again.flight.state_hash[:16]})")
    else:
        print(f"DIFFERENT from {of}: {printable(again.differences[0])} ({len(again.differences)} columns differ)")
    if view is not None:
        _show(view, again.folder / record.LOG_NAME)
    return PASSED if again.flight.passed and again.same is not False else FAILED


def _view(order: Order) -> FlownView | None:
    """Where the flight will be shown, found before it is flown. Raises ReplayError where there is no viewer."""
    if not order.view:
        return None
    try:
        from maxq.tools.replay.flown import FlownView  # noqa: PLC0415  # lazy: rerun takes half a second

        return FlownView(order.view_port)
    except ReplayError as error:
        raise ReplayError(f"--view: {error}") from error
    except ImportError as error:
        raise ReplayError(f"--view: a package is missing or broken: {error}") from error


def _show(view: FlownView, log: Path) -> None:
    """The flight is flown and its log is written: a viewer that fails changes nothing of the verdict."""
    try:
        view.show(log)
    except ReplayError as error:
        print(f"simrun: --view: {printable(str(error))}", file=sys.stderr)


def _report_again(order: Order) -> int:
    from maxq.sim.campaign.analysis import DataSet  # noqa: PLC0415  # lazy
    from maxq.sim.campaign.store import campaign_in  # noqa: PLC0415  # lazy

    assert order.folder is not None
    start_s = time.perf_counter()
    folder = Path(order.folder)
    campaign = campaign_in(folder)
    _keep(campaign, folder, order.keep, lambda: False)
    total = len(DataSet(folder, campaign).runs)
    return _tell(campaign, folder, total, f"{total} runs in {folder}", order, start_s, False)


def _shrink(order: Order) -> int:
    from maxq.tools.campaign_shrink import shrink  # noqa: PLC0415  # lazy

    assert order.folder is not None
    if order.run is None:
        print("simrun: --shrink needs --run N: the run that fails", file=sys.stderr)
        return BAD_INPUT
    _announce_compilation()
    return shrink(Path(order.folder), order.run, order.workers)


def _search(order: Order) -> int:
    from maxq.tools.campaign_search import search  # noqa: PLC0415  # lazy

    assert order.folder is not None
    assert order.search is not None
    _announce_compilation()
    return search(Path(order.folder), order.search, order.workers, order.runs)


def default_folder(name: str) -> Path:
    return Path("runs") / (re.sub(r"[^\w.-]+", "-", name).strip(".-") or "campaign")


def _announce_compilation() -> None:
    from maxq.tools.simrun_fly import announce_compilation  # noqa: PLC0415  # lazy

    announce_compilation()
