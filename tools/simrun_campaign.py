"""The subcommands of `simrun` on campaigns: fly, resume, judge, report, and repeat, reduce or search from one run.

`simrun` imports this module only for a campaign.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import numpy as np

from maxq.control.kernel.machine import cores
from maxq.sim.campaign.analysis import DataSet, judged, lost, selected
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.investigation import flight_folder, refly, search_worst, shrink_run
from maxq.sim.campaign.objects import ObjectFolder, folders_at, is_address
from maxq.sim.campaign.rare import rare_failure
from maxq.sim.campaign.read import LoadedCampaign, load_campaign
from maxq.sim.campaign.runner import Outcome, run_campaign
from maxq.sim.campaign.shards import Shard, checked_shards, merge, shard_from, shard_in
from maxq.sim.campaign.statistics import MET, NOT_MET
from maxq.sim.campaign.store import RUNS, campaign_in
from maxq.sim.campaign.targets import Refused
from maxq.sim.files import check_writable, plain_name, write_whole
from maxq.sim.flight.metric_table import METRIC_NAMES, title_of, unit_of
from maxq.sim.input.errors import suggestion
from maxq.sim.run.quantities import number_text, quantity_text, unit_text
from maxq.sim.run.record import LOG_NAME, SUMMARY_NAME
from maxq.tools import campaign_report as text
from maxq.tools.cli.frame import Exit, Interruption, say
from maxq.tools.cli.terminal import Progress, aligned, announce, printable, tell
from maxq.tools.exchange.junit import checked_path, suite_of_campaign, write_junit
from maxq.tools.flight_report import report
from maxq.tools.replay.viewer import ReplayError
from maxq.tools.simrun_fly import show_flight, viewer_needed

_LINE_S = 30.0  # interval between lines of progress in the log of a batch system
_SEARCH_FLIGHTS = 2000
_RARE_FLIGHTS = 10_000

Stop = Callable[[], bool]


def fly_campaign(
    campaign: str,
    *,
    runs: int | None = None,
    seed: int | None = None,
    overrides: tuple[str, ...] = (),
    out: str | None = None,
    workers: int | None = None,
    dask: str | None = None,
    sync: str | None = None,
    until_settled: bool = False,
    shard: str | None = None,
    keep: tuple[str, ...] = (),
    no_report: bool = False,
    junit: str | None = None,
) -> int:
    """Fly, resume or enlarge a campaign or a shard of it, and return the exit code.

    All functions for a subcommand return the exit code, and raise the errors that `cli.frame.run` reports on one line.
    The arguments are the options of the subcommand.
    """
    start_s = time.perf_counter()
    junit_path = _junit_path(junit)
    changes = {name: value for name, value in (("runs", runs), ("seed", seed)) if value is not None}
    announce(f"reading {campaign}")
    loaded = load_campaign(campaign, overrides).with_campaign(**changes)
    part = None if shard is None else shard_from(shard)
    name = plain_name(loaded.name, "campaign") + ("" if part is None else f"-{part.number}-of-{part.of}")
    folder = Path(out) if out else Path("runs") / name
    with Interruption() as stop:
        try:
            with Progress(_LINE_S) as progress:
                outcome = run_campaign(
                    loaded,
                    folder,
                    workers=workers,
                    cluster=dask,
                    watch=text.watcher(progress),
                    stop=stop,
                    until_settled=until_settled,
                    shard=part,
                    sync=sync,
                )
        except KeyboardInterrupt:
            say("simrun", "interrupted twice; whole batches are safe, the same command resumes the campaign")
            return Exit.INTERRUPTED
        for note in outcome.notes:
            say("simrun", note)
        if part is not None:
            return _tell_shard(part, folder, outcome)
        if not outcome.stopped:
            _keep(loaded, folder, (*loaded.campaign.keep, *keep), stop)
        rate = f"{outcome.flown / outcome.wall_s:.1f} flights/s" if outcome.wall_s > 0.0 else "at once"
        flown = f"{outcome.flown} runs flown in {text.duration(outcome.wall_s)} ({rate})"
        if outcome.flown == 0 and not outcome.stopped:
            flown = f"all {outcome.total} runs were flown before; --runs N with a larger number flies more"
        data = DataSet(folder, loaded)
        code = _tell(
            data, outcome.total, flown, not no_report, start_s, outcome.settled, not outcome.stopped, junit_path
        )
        if sync is not None:
            ObjectFolder(sync).push(folder)  # also the report
        if outcome.stopped:
            tell(f"INTERRUPTED: the data set in {folder / RUNS} is whole; the same command resumes the campaign")
            return Exit.INTERRUPTED
        return code


def _tell_shard(shard: Shard, folder: Path, outcome: Outcome) -> int:
    """Print the state of a shard, which has no verdict, and return the exit code."""
    flown = f"{outcome.flown} runs flown in {text.duration(outcome.wall_s)}"
    if outcome.stopped:
        tell(f"INTERRUPTED: shard {shard}: {flown}; the same command resumes it")
        return Exit.INTERRUPTED
    tell(f"shard {shard}: all {outcome.total} runs are in {folder / RUNS}; {flown}")
    tell("next, with the folders of all shards: simrun merge DIR...")
    return Exit.OK


def _shard_folders(given: str, stack: ExitStack) -> list[Path]:
    """Return a folder, or temporary copies of the folders at an address, which `stack` removes."""
    if not is_address(given):
        return [Path(given)]
    scratch, found = Path(stack.enter_context(TemporaryDirectory(prefix="maxq-"))), []
    for folder in folders_at(given):
        found.append(scratch / PurePosixPath(folder.address).name)
        folder.pull(found[-1])
    return found


def merge_shards(
    folders: tuple[str, ...],
    *,
    out: str | None = None,
    keep: tuple[str, ...] = (),
    no_report: bool = False,
    junit: str | None = None,
) -> int:
    """Merge the shards of a campaign, judge it, write its report, and return the exit code."""
    start_s, junit_path = time.perf_counter(), _junit_path(junit)
    announce("merging")
    with ExitStack() as stack:
        there = [folder for given in folders for folder in _shard_folders(given, stack)]
        campaign, parts = checked_shards(there)
        place = Path(out) if out else Path("runs") / plain_name(campaign.name, "campaign")
        merge(campaign, parts, place)
    with Interruption() as stop:
        _keep(campaign, place, (*campaign.campaign.keep, *keep), stop)
        data = DataSet(place, campaign)
        total = len(data.runs)
        flown = f"{total} runs of {len(there)} shards merged in {place}"
        return _tell(data, total, flown, not no_report, start_s, False, True, junit_path)


def _junit_path(name: str | None) -> Path | None:
    """Return the path of --junit. Raises CommandError for a wrong name, and FileError if it cannot be written."""
    if name is None:
        return None
    path = checked_path(name)
    check_writable(path.parent)
    return path


def _tell(
    data: DataSet,
    total: int,
    flown: str,
    pictures: bool,
    start_s: float,
    settled: bool,
    complete: bool,
    junit: Path | None,
) -> int:
    """Write the summary and the report, print the results, and return the exit code.

    `total` is the number of runs of the campaign. `flown` is a text on the flights of this call. The next step is
    printed only if the campaign is `complete`; otherwise, the caller prints how to resume it. `junit` is a file for the
    verdicts as JUnit XML.
    """
    announce("writing the report")
    verdicts, losses = judged(data), lost(data)
    tails = text.tails_of(data, verdicts)
    files = text.write_report(data, verdicts, losses, total, tails, settled=settled, pictures=pictures)
    tell(*text.report(data, verdicts, losses, tails))
    tell(f"\n{flown}; {text.duration(time.perf_counter() - start_s)} in all", *files)
    if complete:
        tell(text.next_step(data, verdicts))
    if settled:
        tell("\nstopped early: every verdict was settled")
    headline = text.headline(data, verdicts)
    tell("\n" + headline)
    if junit is not None:
        write_junit(junit, [suite_of_campaign(data, verdicts, headline, time.perf_counter() - start_s)])
    judgements = {v.shown.judgement for v in verdicts}
    if NOT_MET in judgements:
        return Exit.FAILED
    return Exit.OK if judgements == {MET} else Exit.UNDECIDED


def report_again(folder: str, *, keep: tuple[str, ...] = (), no_report: bool = False, junit: str | None = None) -> int:
    """Judge a flown campaign, write its report again, and return the exit code. The runs `keep` are flown with a full
    log.
    """
    start_s = time.perf_counter()
    place = Path(folder)
    if (shard := shard_in(place)) is not None:
        raise CampaignError(f"{place}: holds shard {shard} of a campaign; simrun merge makes the report of all shards")
    junit_path = _junit_path(junit)
    data = DataSet(place, campaign_in(place))
    total = len(data.runs)
    with Interruption() as stop:
        _keep(data.campaign, place, keep, stop)
        return _tell(data, total, f"{total} runs in {place}", not no_report, start_s, False, True, junit_path)


def _keep(campaign: LoadedCampaign, folder: Path, keep: tuple[str, ...], stop: Stop) -> None:
    """Fly the selected runs again with a full log. Runs that already have a log are skipped."""
    runs = selected(DataSet(folder, campaign), keep) if keep else []
    with Progress() as progress:
        for n, run in enumerate(runs):
            there = flight_folder(folder, run)
            if (there / SUMMARY_NAME).exists() and (there / LOG_NAME).exists():
                continue
            if stop():
                return
            progress.show("logs of kept runs", n, len(runs), f"run {run}")
            again = refly(folder, run, campaign=campaign, stop=stop)
            if again.same is False:
                say("simrun", f"run {run} differs from the data set: {again.differences[0]}")


def fly_run(
    folder: str,
    run: int,
    *,
    out: str | None = None,
    no_log: bool = False,
    view: bool = False,
    view_port: int | None = None,
) -> int:
    """Fly a run of a campaign again, compare it with the data set, and show its log on request. Return the exit
    code.
    """
    start_s = time.perf_counter()
    seen = None
    if view or view_port is not None:
        if no_log:
            raise CampaignError("--view shows the log of --run N: not with --no-log")
        with viewer_needed():
            from maxq.tools.replay.live import FlownView  # noqa: PLC0415  # lazy: rerun takes half a second

            seen = FlownView(view_port)
    place, into = Path(folder), Path(out) if out else None
    with Interruption() as stop, Progress() as progress:
        again = refly(place, run, into, log=not no_log, watch=partial(show_flight, progress), stop=stop)
    names = [LOG_NAME] * (not no_log) + [SUMMARY_NAME]
    tell(report(again.flight, [again.folder / name for name in names], time.perf_counter() - start_s))
    if again.flight.outcome == "interrupted":
        return Exit.INTERRUPTED
    of = f"run {run} of {place}"
    if again.same is None:
        tell(f"not compared: {of} has not been flown")
    elif again.same:
        tell(f"SAME as {of}: inputs, metrics and final state are equal, bit by bit ({again.flight.state_hash[:16]})")
    else:
        tell(f"DIFFERENT from {of}: {printable(again.differences[0])} ({len(again.differences)} columns differ)")
    if seen is not None:
        try:
            seen.show(again.folder / LOG_NAME)
        except ReplayError as error:  # the flight is complete and its log is written, so the verdict remains
            say("simrun", f"--view: {error}")
    return Exit.OK if again.flight.passed and again.same is not False else Exit.FAILED


def shrink(folder: str, run: int, *, workers: int | None = None) -> int:
    """Find the fewest dispersions with which a run fails, and write them to a file such as DIR/shrunk/run-000417.toml.

    The exit code is 1 if the run fails, and 0 if it does not.
    """
    place = Path(folder)
    campaign = campaign_in(place)
    count = len(campaign.input_names)
    with Interruption(), Progress() as progress:
        try:
            found = shrink_run(
                campaign,
                run,
                workers=workers or cores(),
                watch=lambda left, flights: progress.show(
                    "reducing", count - left, count, f"{left} dispersions left, {flights} flights"
                ),
            )
        except Refused as refused:
            raise CampaignError(f"run {run} of {place} has no scenario: {refused}") from None
    if found is None:
        tell(f"run {run} of {place} does not fail: there is nothing to shrink")
        return Exit.OK
    path = place / "shrunk" / f"run-{run:06d}.toml"
    write_whole(path, found.scenario.as_flown, CampaignError)
    tell(f"run {run} fails in: {printable(found.failure)}")
    if not found.inputs:
        tell(f"it does so without any of its {count} dispersions ({found.flights} flights)")
    else:
        tell(f"{len(found.inputs)} of {count} dispersions are enough ({found.flights} flights); none of them can go:")
        labels, recorded = text.labels_of(campaign), campaign.inputs(run).recorded
        rows = [(printable(labels.get(n, "")), n, text.value_text(recorded.get(n))) for n in found.inputs]
        tell(*aligned(rows, "  "))
    for verdict in found.flight.verdicts:
        if verdict.name == found.failure:
            metric = verdict.requirement.metric
            tell(f"{title_of(metric)}: {quantity_text(verdict.value, unit_of(metric))}")
    tell(path)
    return Exit.FAILED


def search(folder: str, metric: str, *, runs: int = _SEARCH_FLIGHTS, workers: int | None = None) -> int:
    """Find the worst flight within 3 sigma, and write it to DIR/worst/METRIC.toml.

    The exit code is 1 if this flight fails.
    """
    if metric not in METRIC_NAMES:
        hint = suggestion(metric, METRIC_NAMES)
        raise CampaignError(f"{metric}: there is no such metric; {hint or ', '.join(METRIC_NAMES)}")
    place, most = Path(folder), runs or _SEARCH_FLIGHTS
    campaign = campaign_in(place)
    limits = [r for r in campaign.base.scenario.requirement if r.metric == metric]
    largest = not limits or limits[0].bound[0] == "limit"
    data = DataSet(place, campaign)
    values = data.numbers(metric)
    good = np.flatnonzero(np.isfinite(values) & ~data.void)
    at = int(good[np.argmax(values[good]) if largest else np.argmin(values[good])]) if len(good) else None
    start = None if at is None else int(data.runs[at])
    unit = unit_of(metric)
    with Interruption() as stop, Progress() as progress:
        found = search_worst(
            campaign,
            metric,
            largest=largest,
            flights=most,
            start=start,
            workers=workers or cores(),
            stop=stop,
            watch=lambda best, flown: progress.show("searching", flown, most, f"worst {quantity_text(best, unit)}"),
        )
    path = place / "worst" / f"{metric}.toml"
    write_whole(path, found.scenario.as_flown, CampaignError)
    if at is not None:
        worst = float(values[at])
        change = f"{100.0 * (found.value / worst - 1.0):+.1f} %" if worst else quantity_text(found.value - worst, unit)
        tell(f"worst of the campaign's {len(data.runs)} runs: {quantity_text(worst, unit)} (run {start})")
        tell(f"the search, with the wind and noise of that run: {change}")
    boxes, labels = campaign.boxes(), text.labels_of(campaign)
    rows = []
    for name, value in found.draws.items():
        low, high = boxes[name]
        in_box = 2.0 * (value - low) / (high - low) - 1.0 if high > low else 0.0
        rows.append((printable(labels.get(name, name)), name, number_text(value), f"{in_box:+.2f}"))
    tell("draws, and their places within the bounds (-1 .. 1):", *aligned(rows, "  ", right=(2, 3)))
    tell(f"next: simrun {path}")
    how, worst_text = "PASSED" if found.flight.passed else "FAILED", quantity_text(found.value, unit)
    tell(f"{how}: {title_of(metric)} at worst {worst_text} within 3 sigma, in {found.flights} flights")
    return Exit.OK if found.flight.passed else Exit.FAILED


def rare(folder: str, metric: str, *, runs: int = _RARE_FLIGHTS, workers: int | None = None) -> int:
    """Estimate the probability of missing a requirement by subset simulation. The exit codes are as for a campaign."""
    place, start_s = Path(folder), time.perf_counter()
    campaign = campaign_in(place)
    asked = [r for r in campaign.base.scenario.requirement if r.metric == metric]
    if not asked:
        known = [r.metric for r in campaign.base.scenario.requirement]
        hint = suggestion(metric, known) or f"allowed: {', '.join(known)}"
        raise CampaignError(f"{metric}: the campaign has no requirement of that metric; {hint}")
    kind, limit = asked[0].bound
    largest, most = kind == "limit", runs or _RARE_FLIGHTS
    with Interruption() as stop, Progress() as progress:
        found = rare_failure(
            campaign,
            metric,
            limit,
            largest=largest,
            flights=most,
            workers=workers or cores(),
            stop=stop,
            watch=lambda number, level, flights: progress.show(
                "sampling", min(flights, most), most, f"population {number + 1}, level {level}"
            ),
        )
    unit = f" {unit_text(unit_of(metric))}".rstrip()
    level, allowed = 100.0 * campaign.campaign.confidence, 1.0 - campaign.campaign.success
    tell(f"P({metric} {'>' if largest else '<'} {limit:g}{unit}) = {found.probability:.2g}")
    if found.undecided:
        tell(f"no bound is known: {found.undecided}")
    else:
        tell(f"at least {found.low:.2g} and at most {found.high:.2g}, each with {level:g} % confidence")
    spent = f"{found.flights} flights in {len(found.each)} populations, {time.perf_counter() - start_s:.0f} s"
    tell(spent + (f"; by plain sampling {found.crude:.2g} flights for the same error" if found.crude > 0.0 else ""))
    sign = 1.0 if largest else -1.0
    rows = [
        (f"population {n + 1}", f"{one.probability:.2g}", ", ".join(f"{limit + sign * v:.4g}" for v in one.levels))
        for n, one in enumerate(found.each)
    ]
    tell("populations, and the levels that one flight in ten exceeds in turn:", *aligned(rows, "  ", right=(1,)))
    if any(one.stuck for one in found.each):
        tell("a population reached a value that no flight exceeded: the lower bound is not known")
    if found.nearest is not None:
        tell(*_nearest(campaign, place, metric, found.nearest))
    verdict = found.judgement(allowed)
    bounds = f"probability of a miss {found.low:.2g} to {found.high:.2g}, {allowed:.2g} allowed"
    tell(f"{verdict.upper()}: {bounds} (estimate; it covers only the failure modes found)")
    return {MET: Exit.OK, NOT_MET: Exit.FAILED}.get(verdict, Exit.UNDECIDED)


def _nearest(campaign: LoadedCampaign, folder: Path, metric: str, point: tuple[np.ndarray, int]) -> list[str]:
    """Write the most probable of the flights that missed, and return lines on its largest deviations.

    `point` contains the standard normal scores and the noise number of this flight.
    """
    z, noise = point
    drawn, _ = campaign.plan.of_scores(z[None], np.array([noise]))
    path = folder / "rare" / f"{metric}.toml"
    write_whole(path, campaign.mixed(drawn, 0).as_flown, CampaignError)
    labels, names = text.labels_of(campaign), campaign.plan.score_names
    largest = np.argsort(-np.abs(z), kind="stable")[:5]
    said = ", ".join(f"{printable(labels.get(names[k], names[k]))} {z[k]:+.1f}" for k in largest)
    return [f"likeliest miss found, {float(np.linalg.norm(z)):.1f} sigma in all: {said}", f"next: simrun {path}"]
