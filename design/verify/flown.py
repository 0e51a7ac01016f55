"""The flights of a suite: scenarios, assessed by their requirements, and campaigns, assessed with a confidence."""

from __future__ import annotations

import json
import math
import random
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.verify import suite
from maxq.design.verify.memory import PartsOnDisk, code_hash, content_hash, counted
from maxq.design.verify.suite import CampaignWanted, JudgedRequirement, LoadedSuite, SuiteFlight, judgement_of
from maxq.sim.campaign.analysis import DataSet, Judged, Lost, finer_runs, judged, lost
from maxq.sim.campaign.availability import Month, availability
from maxq.sim.campaign.investigation import differing
from maxq.sim.campaign.read import LoadedCampaign, description_of, load_campaign
from maxq.sim.campaign.runner import CampaignProgress, run_campaign
from maxq.sim.campaign.runs import fly_rows, schema_of, table_of
from maxq.sim.campaign.statistics import Shown
from maxq.sim.files import plain_name
from maxq.sim.flight.metric_table import unit_of
from maxq.sim.run.flight import Flight
from maxq.sim.run.fly import fly
from maxq.sim.run.metrics import Verdict
from maxq.sim.run.quantities import number_text, sign_of
from maxq.sim.scenario.flight_code import flight_code_key
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.schema_scenario import LogSection, Scenario

KEPT = ("gimbal_pitch_angle_deg", "gimbal_yaw_angle_deg", "error_pitch_deg", "error_yaw_deg")
KEPT_HZ = 20.0
_POLL_S = 0.2
LAW_SHARE, LAW_LEAST_DEG = 0.05, 1.0
"""The allowed difference between the gimbal angles of flight code and of its design, relative to the largest angle.

The reference angle is at least `LAW_LEAST_DEG`. A gain error of 0.2 dB, which a certificate permits, gives 2.3 %.
"""


@dataclass(frozen=True)
class FlownResult:
    """The result of a flight of the suite.

    `time_s` and `histories` (by channel) cover the flight under thrust and are decimated. `law_share` is the largest
    difference between gimbal angles of flight code and of a flight with its design, relative to the largest angle
    (`LAW_SHARE`). It is nan without code or design, and with faults.
    """

    name: str
    why: str
    outcome: str
    failures: tuple[str, ...]
    verdicts: tuple[Verdict, ...]
    metrics: dict[str, float]
    state_hash: str
    counts: bool
    again: str
    time_s: Array = field(repr=False)
    histories: dict[str, Array] = field(repr=False)
    law_share: float = math.nan

    @property
    def passed(self) -> bool:
        return not self.failures and all(v.met for v in self.verdicts)

    @property
    def tightest(self) -> Verdict | None:
        """Return the requirement with the least margin."""
        return min(self.verdicts, key=lambda v: (v.met, _room(v)), default=None)


def _room(v: Verdict) -> float:
    """Return the relative margin to the bound. For a bound of zero, return 1 if it is met and -1 otherwise."""
    kind, bound = v.bound
    if bound == 0.0:
        return 1.0 if v.met else -1.0
    left = suite.room_left(v.value, bound, sign_of(kind))
    return left if math.isfinite(left) else -math.inf


def design_changes(design: str, vehicle: str | None) -> list[str]:
    """Return the changes of a scenario or campaign that select the design, and optionally another vehicle.

    `design` may be flight code (`flight_code_key`), which flies without a design.
    """
    key = flight_code_key(design)
    flown = [f'design="{design}"']
    if key:
        flown = ["design=", "vehicle.computer.law=external", f'vehicle.computer.{key}="{design}"']
    return flown + ([f'vehicle="{vehicle}"'] if vehicle is not None else [])


def load_flight(
    loaded_suite: LoadedSuite, flown: SuiteFlight, design: str, vehicle: str | None
) -> tuple[LoadedScenario, list[str]]:
    """Load the scenario of one flight with the design and the changes. Return it with all changes.

    Raises ScenarioError.
    """
    name, changes = flown.scenario or loaded_suite.suite.scenario, [*design_changes(design, vehicle), *flown.set]
    loaded = load_scenario(name, changes)
    more = suite.limit_changes(loaded_suite, flown.limits, loaded.scenario)
    return (load_scenario(name, [*changes, *more]) if more else loaded), [*changes, *more]


def fly_suite(
    loaded_suite: LoadedSuite,
    loaded: Sequence[tuple[LoadedScenario, list[str]]],
    memory: PartsOnDisk,
    watch: Callable[[int, int], None],
    workers: int,
) -> list[FlownResult]:
    """Fly all flights in the order of the suite. `loaded` contains the result of `load_flight` for each."""
    flights = loaded_suite.suite.flight

    def one(flown: SuiteFlight, job: tuple[LoadedScenario, list[str]]) -> FlownResult:
        scenario, changes = job
        text = (scenario.as_flown, flown.name, flown.why, flown.design_must_keep)
        again = shlex.join(["simrun", flown.scenario or loaded_suite.suite.scenario, *suite.set_words(changes)])
        return memory.recall("flight", (*text, again), lambda: fly_alone(flown, scenario, again), flown.name)

    with ThreadPoolExecutor(max_workers=workers) as pool:
        return list(pool.map(counted(one, watch, len(loaded)), flights, loaded))


def fly_alone(flown: SuiteFlight, loaded: LoadedScenario, again: str) -> FlownResult:
    """Fly one flight of a suite. `again` is the command that repeats it."""
    log = LogSection(fast_hz=KEPT_HZ, slow_hz=KEPT_HZ, transform_hz=1.0)
    scenario = loaded.scenario.model_copy(update={"log": log})
    flight = fly(LoadedScenario(scenario, loaded.label, loaded.files))
    under_thrust, histories = _histories(flight)
    twin, share = _by_design(scenario), math.nan
    if twin is not None:
        times_s, other = _histories(fly(LoadedScenario(twin, loaded.label, loaded.files)))
        n = min(len(times_s), len(under_thrust))
        angles = [(histories[name][:n], other[name][:n]) for name in KEPT[:2]]
        largest = max(float(np.abs(theirs).max(initial=0.0)) for _, theirs in angles)
        difference = max(float(np.abs(mine - theirs).max(initial=0.0)) for mine, theirs in angles)
        share = difference / max(largest, LAW_LEAST_DEG)
    return FlownResult(
        flown.name,
        flown.why,
        flight.outcome,
        flight.failures,
        flight.verdicts,
        flight.metrics,
        flight.state_hash,
        flown.design_must_keep,
        again,
        under_thrust,
        histories,
        share,
    )


def _histories(flight: Flight) -> tuple[Array, dict[str, Array]]:
    """Return the decimated times under thrust, s, and the kept channels at these times."""
    times = flight.time_s(KEPT[0])
    under_thrust = times[times <= np.nanmin([flight.event_s("burnout"), flight.end_s])]
    return under_thrust, {n: np.round(np.interp(under_thrust, flight.time_s(n), flight[n]), 6) for n in KEPT}


def _by_design(scenario: Scenario) -> Scenario | None:
    """Return a scenario with the law of its design in place of flight code, or None without code or design.

    The result is also None for a scenario with faults, since code may change its law when it detects a fault. Code that
    commands the sequence has its own guidance, so that its commands cannot be compared either.
    """
    computer = scenario.vehicle.computer
    if scenario.design is None or scenario.fault or computer is None or computer.law != "external":
        return None
    if computer.sequences:
        return None
    law = computer.model_copy(update={"law": "design", "library": None, "python": None, "address": None})
    return scenario.model_copy(update={"vehicle": scenario.vehicle.model_copy(update={"computer": law})})


def _said(v: Verdict) -> str:
    """Return the name, value and unit of a flight's requirement as text."""
    unit = unit_of(v.requirement.metric)
    return f"{v.name} {number_text(v.value)}" + (f" {unit}" if unit != "1" else "")


def flight_requirements(results: Sequence[FlownResult]) -> list[JudgedRequirement]:
    """Return one requirement for each flight that counts: the flight meets all requirements of its scenario.

    A comparison of flight code with its design is added where it exists.
    """
    out = []
    for r in results:
        worst = r.tightest
        wanted, found, where, left = "control kept", "flown to its end", "", math.nan
        missed = [v for v in r.verdicts if not v.met]
        if r.failures:
            found, left = "; ".join(r.failures), -1.0
        elif len(missed) > 1:
            wanted, left = "all limits", _room(worst) if worst is not None else -1.0
            found = "; ".join(f"{_said(v)}, required {v.wanted}" for v in missed)
        elif worst is not None:
            wanted, found, left = worst.wanted, _said(worst), _room(worst)
            where = f"at {worst.time_s:.2f} s" if math.isfinite(worst.time_s) else ""
        judgement = suite.ACCEPTED if r.passed else suite.REJECTED
        if r.counts:
            out.append(JudgedRequirement("scenarios", r.name, wanted, found, judgement, left, where, again=r.again))
    return [*out, *_law_requirement(results)]


def _law_requirement(results: Sequence[FlownResult]) -> list[JudgedRequirement]:
    """Return the requirement that flight code and its design have the same gimbal angles.

    It applies to every flight without a fault. These flights contain no excitation. In a certificate, flight code could
    recognise the excitation.
    """
    compared = [r for r in results if math.isfinite(r.law_share)]
    if not compared:
        return []
    worst = max(compared, key=lambda r: r.law_share)
    judgement = suite.ACCEPTED if worst.law_share <= LAW_SHARE else suite.REJECTED
    wanted = f"<= {100.0 * LAW_SHARE:g} % of the largest"
    found = f"{100.0 * worst.law_share:.2g} % in {len(compared)} flights"
    room = suite.room_left(worst.law_share, LAW_SHARE, "<=")
    name = "gimbal angles of the code, difference from its design"
    return [JudgedRequirement("scenarios", name, wanted, found, judgement, room, worst.name, again=worst.again)]


@dataclass(frozen=True)
class CampaignResult:
    """The result of a flown campaign, and its verdict on each requirement.

    The first requirement is that control is kept, and the last that a flight meets all requirements.
    """

    name: str
    file: str
    folder: Path
    runs: int
    stopped: bool
    success: float
    confidence: float
    verdicts: tuple[Judged, ...]
    why: str
    first_lost: Lost | None  # first run that lost control or did not reach its end
    months: tuple[Month, ...] = ()
    availability: float | None = None  # required availability in each month
    fixed: bool = True  # True if the number of runs was recorded beforehand
    finer: Mapping[int, int] = field(default_factory=dict)  # halvings of the step by run (`finer_runs`)
    recalled: int = 0  # runs from earlier verifications
    reflown: tuple[int, ...] = ()  # recalled runs that were flown again for comparison
    differing: tuple[str, ...] = ()


def load_wanted(loaded_suite: LoadedSuite, wanted: CampaignWanted, design: str, vehicle: str | None) -> LoadedCampaign:
    """Load the campaign with the design, and with the numbers and limits of the suite. Raises ScenarioError."""
    changes = [*design_changes(design, vehicle), *wanted.set]
    loaded = load_campaign(wanted.file, changes)
    more = suite.limit_changes(loaded_suite, wanted.limits, loaded.base.scenario)
    loaded = load_campaign(wanted.file, [*changes, *more]) if more else loaded
    given = {key: getattr(wanted, key) for key in ("runs", "seed", "success", "confidence")}
    return loaded.with_campaign(**{key: value for key, value in given.items() if value is not None})


def campaign_folder(loaded: LoadedCampaign, parts: Path) -> Path:
    """Return the folder of the campaign's runs, named by a hash of all inputs so that no run is flown twice."""
    said = description_of(loaded)
    drawn = {
        key: loaded.file.campaign.model_dump(mode="json")[key]
        for key in ("seed", "test", "sampling", "noise", "outside")
    }
    stratum = loaded.campaign.stratum or 0
    key = content_hash(code_hash(), json.dumps({**said, "campaign": drawn}, sort_keys=True), stratum)
    return parts / f"campaign-{plain_name(loaded.name, 'unnamed')}-{key[:16]}"


def fly_campaign(
    loaded_suite: LoadedSuite,
    wanted: CampaignWanted,
    design: str,
    vehicle: str | None,
    parts: Path,
    watch: Callable[[CampaignProgress], None],
    stop: Callable[[], bool],
    afresh: bool,
    sample: int = 0,
    wait: Callable[[str], None] = lambda who: None,
) -> CampaignResult:
    """Fly the missing runs of a campaign, or all runs into a new folder if `afresh` is True.

    If another process flies the same campaign, its runs are shared. `wait` is then called with the name of that process
    a few times per second. `sample` is the number of earlier runs that are flown again and compared. Raises
    ScenarioError and CampaignError.
    """
    loaded = load_wanted(loaded_suite, wanted, design, vehicle)
    folder = known = campaign_folder(loaded, parts)
    count = 1
    while afresh and folder.exists():
        folder = known.with_name(f"{known.name}-{(count := count + 1)}")

    def waiting(who: str) -> None:
        wait(who)
        time.sleep(_POLL_S)

    elsewhere = "fly it again with simverify --afresh"
    shared = None if afresh else waiting
    outcome = run_campaign(loaded, folder, watch=watch, stop=stop, elsewhere=elsewhere, wait=shared)
    result = result_of(wanted, loaded, folder, outcome.stopped)
    data = DataSet(folder, loaded, loaded.campaign.runs)
    mine = {run for first, size in outcome.missing for run in range(first, first + size)}
    earlier = [run for run in data.runs.tolist() if run not in mine]
    again = sorted(random.SystemRandom().sample(earlier, min(sample, len(earlier))))
    wrong = tuple(f"run {run}" for run in again if not same_run(data, run))
    return replace(result, recalled=len(earlier), reflown=tuple(again), differing=wrong)


def result_of(wanted: CampaignWanted, loaded: LoadedCampaign, folder: Path, stopped: bool = False) -> CampaignResult:
    """Return the result of a suite's campaign from the runs in a folder. Raises CampaignError."""
    data = DataSet(folder, loaded, loaded.campaign.runs)
    return CampaignResult(
        wanted.name or loaded.name,
        wanted.file,
        folder,
        len(data.runs),
        stopped,
        loaded.campaign.success,
        loaded.campaign.confidence,
        tuple(judged(data)),
        wanted.why,
        next(iter(lost(data, 1)), None),
        tuple(availability(data)),
        wanted.availability,
        data.planned is not None and data.planned == data.in_order,
        finer_runs(data),
    )


def same_run(data: DataSet, run: int) -> bool:
    """Fly a run of a data set again, and return True if every recorded value is bit-identical."""
    before, now = data.row(run), fly_rows(data.campaign, [(data.campaign.plan.draw(run, 1), run)])
    return before is not None and not differing(before, table_of(now, schema_of(data.campaign)).to_pylist()[0])


def _of_campaign(
    result: CampaignResult, name: str, wanted: str, found: str, shown: Shown, room: float, run: int | None
) -> JudgedRequirement:
    """Return a requirement of a campaign. `run` is the run that shows the result, or None if there is none."""
    judgement, name = judgement_of(shown.judgement), f"{result.name}: {name}"
    if run is None:
        return JudgedRequirement("campaign", name, wanted, found, judgement, room, more_runs=shown.more)
    again = shlex.join(["simrun", "refly", str(result.folder), "--run", str(run)])
    return JudgedRequirement("campaign", name, wanted, found, judgement, room, f"run {run}", shown.more, again)


def availability_requirements(result: CampaignResult, wanted: float) -> list[JudgedRequirement]:
    """Return a requirement for each month of a campaign's winds. Without any month, availability is undecided."""
    asked, out = f">= {100.0 * wanted:g} % with {100.0 * result.confidence:g} %", list[JudgedRequirement]()
    for month in result.months:
        shown, room = month.judged(wanted, result.confidence, result.fixed), suite.room_left(month.share, wanted, ">=")
        ends = f"{100.0 * month.least:.1f} .. {100.0 * month.most:.1f} %"
        found = f"{100.0 * month.share:.1f} % of {month.runs} flights ({ends})"
        name = f"availability in {month.name}"
        out.append(_of_campaign(result, name, asked, found, shown, room, month.first_missed))
    name, found = f"{result.name}: availability", "no run has a month"
    return out or [JudgedRequirement("campaign", name, asked, found, suite.UNDECIDED, math.nan)]


def campaign_requirements(result: CampaignResult) -> list[JudgedRequirement]:
    """Return a requirement for each requirement of the campaign and for all of them together.

    If availability is required, return a requirement for each month instead.
    """
    if result.availability is not None:
        return availability_requirements(result, result.availability)
    level = f"{100.0 * result.success:g} % with {100.0 * result.confidence:g} %"
    out = []
    for v in result.verdicts:
        sense, (most, limit, unit) = sign_of(v.kind), v.worst_text
        bound = f"{sense} {limit} {unit}".rstrip() + ", " if v.metric else ""
        worst = v.worst[0] if v.worst else None
        found = f"{v.shown.failures} of {v.shown.runs} failed" + (f", worst {most} {unit}".rstrip() if worst else "")
        left = suite.room_left(worst.value, v.bound, sense) if worst is not None else math.nan
        run, gone = worst.run if worst else v.first_missed, result.first_lost
        if not (v.metric or v.joint) and gone is not None:
            run, found = gone.run, f"{found}, first: {gone.cause or gone.outcome}"
        out.append(_of_campaign(result, v.name, bound + level, found, v.shown, left, run))
    return out
