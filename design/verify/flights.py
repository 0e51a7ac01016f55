"""The flights of a suite: each scenario flown with the design, and judged by its requirements."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.verify.limits import limit_changes
from maxq.design.verify.memory import Memory
from maxq.design.verify.suite import Flown, Suite
from maxq.design.verify.verdict import ACCEPTED, REJECTED, Requirement
from maxq.sim.run.fly import fly
from maxq.sim.run.judgement import METRIC_NAMES
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.schema_scenario import Log

PART = "scenarios"
KEPT = (
    "dynamic_pressure_Pa", "alpha_total_deg", "gimbal_pitch_angle_deg", "gimbal_yaw_angle_deg", "error_pitch_deg",
    "error_yaw_deg",
)  # fmt: skip
KEPT_HZ = 20.0


@dataclass(frozen=True)
class Asked:
    """A requirement of a scenario, and the flight's value."""

    name: str
    metric: str
    kind: str  # limit, minimum
    bound: float
    value: float
    time_s: float
    met: bool

    @property
    def room(self) -> float:
        """Share of the bound that is left."""
        if self.bound == 0.0:
            return 1.0 if self.met else -1.0
        room = 1.0 - self.value / self.bound if self.kind == "limit" else self.value / self.bound - 1.0
        return room if math.isfinite(room) else -math.inf


@dataclass(frozen=True)
class FlownResult:
    """One flight of the suite. `time_s` and `histories` (by channel) are those under thrust, thinned out."""

    name: str
    why: str
    outcome: str
    failures: tuple[str, ...]
    asked: tuple[Asked, ...]
    metrics: dict[str, float]
    state_hash: str
    counts: bool
    again: str
    time_s: Array = field(repr=False)
    histories: dict[str, Array] = field(repr=False)

    @property
    def passed(self) -> bool:
        return not self.failures and all(a.met for a in self.asked)

    @property
    def tightest(self) -> Asked | None:
        """The requirement with the least room."""
        return min(self.asked, key=lambda a: (a.met, a.room), default=None)


def load_flight(
    suite: Suite, flown: Flown, design: str, vehicle: str | None, label: str = "suite"
) -> tuple[LoadedScenario, list[str]]:
    """The scenario of one flight with the design in it, and what is changed in it. Raises ScenarioError."""
    name, changes = flown.scenario or suite.scenario, _changes(flown, design, vehicle)
    loaded = load_scenario(name, changes, METRIC_NAMES)
    more = limit_changes(suite, flown.limits, loaded.scenario, label)
    return (load_scenario(name, [*changes, *more], METRIC_NAMES) if more else loaded), [*changes, *more]


def _changes(flown: Flown, design: str, vehicle: str | None) -> list[str]:
    changes = [f'design="{design}"']
    if vehicle is not None:
        changes.append(f'vehicle="{vehicle}"')
    return [*changes, *flown.set]


def fly_suite(
    suite: Suite,
    design: str,
    vehicle: str | None,
    memory: Memory,
    watch: Callable[[int, int], None] = lambda done, of: None,
    workers: int = 2,
    label: str = "suite",
) -> list[FlownResult]:
    """All flights, in the suite's order. Raises ScenarioError before any is flown where one cannot be."""
    loaded = [load_flight(suite, flown, design, vehicle, label) for flown in suite.flight]
    done = [0]

    def one(job: tuple[Flown, tuple[LoadedScenario, list[str]]]) -> FlownResult:
        flown, (scenario, changes) = job
        text = (scenario.as_flown, flown.name, flown.why, flown.design_must_keep)
        command = ["simrun", flown.scenario or suite.scenario]
        command += [x for change in changes for x in ("--set", change)]
        again = shlex.join(command)
        result = memory.recall("flight", (*text, again), lambda: _fly(flown, scenario, again))
        done[0] += 1
        watch(done[0], len(loaded))
        return result

    with ThreadPoolExecutor(max_workers=workers) as pool:
        return list(pool.map(one, zip(suite.flight, loaded, strict=True)))


def _fly(flown: Flown, loaded: LoadedScenario, again: str) -> FlownResult:
    log = Log(fast_hz=KEPT_HZ, slow_hz=KEPT_HZ, transform_hz=1.0)
    scenario = loaded.scenario.model_copy(update={"log": log})
    flight = fly(LoadedScenario(scenario, loaded.label, loaded.files))
    asked = tuple(
        Asked(v.name, v.requirement.metric, v.bound[0], v.bound[1], v.value, v.time_s, v.met) for v in flight.verdicts
    )
    burnout = (
        min(flight.event_s("burnout"), flight.end_s) if not math.isnan(flight.event_s("burnout")) else flight.end_s
    )
    times = flight.time_s(KEPT[0])
    until = times <= burnout
    histories = {}
    for name in KEPT:
        values = np.interp(times[until], flight.time_s(name), flight[name])
        histories[name] = np.round(values, 6)
    return FlownResult(
        flown.name, flown.why, flight.outcome, flight.failures, asked, flight.metrics, flight.state_hash,
        flown.design_must_keep, again, times[until], histories,
    )  # fmt: skip


def flight_requirements(results: Sequence[FlownResult]) -> list[Requirement]:
    """A requirement a flight: that it meets all of its own."""
    out = []
    for r in results:
        if not r.counts:
            continue
        worst = r.tightest
        found = "; ".join(r.failures) or (f"{worst.name} {worst.value:.4g}" if worst else "flown to its end")
        wanted = (
            "control kept"
            if r.failures or worst is None
            else f"{'<=' if worst.kind == 'limit' else '>='} {worst.bound:g}"
        )
        where = (
            f"at {worst.time_s:.2f} s" if worst is not None and not r.failures and math.isfinite(worst.time_s) else ""
        )
        room = -1.0 if r.failures else (worst.room if worst is not None else math.nan)
        judgement = ACCEPTED if r.passed else REJECTED
        out.append(Requirement(PART, r.name, wanted, found, judgement, room, where, again=r.again))
    return out
