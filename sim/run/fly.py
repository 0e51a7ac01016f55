"""The flight of a scenario from Python, in one call or segment by segment."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from maxq.control.kernel.kept_code import EntryCache
from maxq.control.kernel.limits import MAX_PENDULUMS
from maxq.control.kernel.progress import compilation
from maxq.control.kernel.records import Array, IntArray, Records, blank, duplicate, pack
from maxq.control.orbit_guidance import STEERING
from maxq.control.structures import DRIFT
from maxq.sim.flight.channels import ChannelTable
from maxq.sim.flight.loop import advance, begin
from maxq.sim.flight.metric_table import (
    METRIC_NAMES,
    CutoffMetrics,
    ImpactMetrics,
    LaunchMetrics,
    MetricIndex,
    StepMetrics,
    WaveMetrics,
)
from maxq.sim.flight.parameters import (
    BURNOUT,
    CONTROL_LOST,
    DIVERGED,
    ERRORS_SQUARED,
    EVENT_NAMES,
    LIFTOFF,
    NEVER,
    SEPARATION,
    Clock,
)
from maxq.sim.flight.step import Arena
from maxq.sim.flight.telemetry import FAST, SLOW, Logged, channel_table
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.values import to_ns
from maxq.sim.packing.environment import pack_earth
from maxq.sim.packing.flight import CONTROL_LOST_RAD, Packed, pack_flight
from maxq.sim.packing.integration import unstable
from maxq.sim.run.flight import WAVE_BREAKING_NAME, Event, Flight, GrowingRows, LoggedRows, SeparationState, copied
from maxq.sim.run.metrics import (
    ATTITUDE_METRICS,
    cutoff_metrics,
    end_metrics,
    judge,
    judged_requirements,
    orbit_metrics,
    section_extremes,
    section_metrics,
    step_failure,
)
from maxq.sim.run.quantities import propellant_text
from maxq.sim.run.range_safety import impact_metrics
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_launch import Cutoff
from maxq.sim.scenario.schema_scenario import MOST_HALVINGS, Scenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.sensor.receivers import pack_receivers
from maxq.sim.vehicle.state import CAUSES, R_I, V_I, Sizes, state_names
from maxq.sim.world.constants import STANDARD_GRAVITY_mps2
from maxq.sim.world.earth import Earth

if TYPE_CHECKING:
    from maxq.sim.run.flight_software import FlightSoftware
    from maxq.sim.run.held_code import CodeWindows

_SEGMENT_NS = 1_000_000_000  # a log chunk
_UNSEEN_NS = 60_000_000_000  # a tenth of a second of computing
_MOST_STEPS, _MOST_ROWS = 20_000, 20_000  # limits of a segment: tens of milliseconds of computing, 10 MB of rows
_BUILT_UP = 0.9  # share of the largest thrust
_FEW = 1_000  # steps or rows; a segment with fewer of both may be longer

IGNITION_NAME, FAULT_NAME, FAULT_END_NAME = "ignition", "fault", "fault_end"
CUTOFF_NAME, RESTART_NAME, RAIL_EXIT_NAME = "cutoff", "restart", "rail_exit"
BOOSTER_NAMES = ("booster_ignition", "booster_burnout")
_OF_STAGES = EVENT_NAMES[BURNOUT], EVENT_NAMES[SEPARATION]  # events of each stage
CONTROL_LOST_NAME, DIVERGED_NAME = EVENT_NAMES[CONTROL_LOST], EVENT_NAMES[DIVERGED]
SOFTWARE_NAME = "flight_software"  # external flight code has ended the flight
OVERRUN_NAME = "overrun"  # a flight in real time has been too late (sim/run/paced.py)
_FAILED = (CONTROL_LOST_NAME, DIVERGED_NAME, SOFTWARE_NAME, OVERRUN_NAME)
BROKEN_WAVE = "the wave breaks; from here on, the pendulum model is not valid"
CONTROL_LOST_CAUSE = f"the attitude error exceeds {math.degrees(CONTROL_LOST_RAD):.3g} deg under thrust"

_channel_table, _state_names = lru_cache(maxsize=8)(channel_table), lru_cache(maxsize=8)(state_names)


@lru_cache(maxsize=8)
def _logged(on: int, sizes: Sizes, *counts: int) -> Records:
    """Return the sizes of the log as a record, which the kernel does not change."""
    return pack([Logged(on, sizes, *counts)])


class FlightRun:
    """A flight in progress. Call `fly_segment` until it is `finished`, and then `result`.

    The constructor loads the compiled kernels, or compiles them (about half a minute, once). `packed` defaults to the
    packing of the scenario. Without `log`, no rows are kept. `segment_ns` is the length of a segment, a multiple of the
    step. By default, it is about 1 s, but less for many steps or log rows and more for few. With external flight code,
    it is about 4 s, to reduce exchanges with the other process. `held` contains the windows of a held flight with
    external flight code (held_code.py).
    """

    def __init__(
        self,
        loaded: LoadedScenario,
        packed: Packed | None = None,
        log: bool = True,
        segment_ns: int | None = None,
        held: CodeWindows | None = None,
    ) -> None:
        self.loaded = loaded
        if packed is None:
            refuse_unstable_steps(loaded)
        self.packed = packed or pack_flight(loaded.scenario)
        self.table = logged_channels(loaded.scenario, self.packed.sizes)
        stations = len(load_stations(loaded.scenario))
        waves = int(_logs_waves(loaded.scenario, self.packed.sizes))
        engines = len(engine_names(loaded.scenario))
        external = int(self.packed.parameters[0].computer.external)
        widths = (
            self.packed.sizes,
            stations,
            waves,
            engines,
            external,
            int(_adapts(loaded.scenario)),
            int(_drifts(loaded.scenario)),
            int(self.packed.parameters[0].receivers.on),
        )
        self._on, self._off = (_logged(on, *widths) for on in (1, 0))
        self._separations_ns = [int(t) for t in self.packed.parameters["timeline"]["separation_ns"][:-1] if t < NEVER]
        self._arena = blank(Arena)
        timeline = self.packed.parameters[0].timeline
        periods_ns = {FAST: int(timeline.fast_ns), SLOW: int(timeline.slow_ns)}
        step_ns = 1_000_000 if timeline.even == 1 else int(timeline.step_ns)
        longest_ns = _SEGMENT_NS * (4 if external else 1)
        self.segment_ns = segment_ns or _segment_ns(step_ns, min(periods_ns.values()), longest_ns)
        self._logged = self._on if log else self._off
        longest_ns = int(self.packed.parameters["timeline"]["step_ns"].max())  # a segment ends at the end of a step
        self._rows = {
            group: self._blank(group, (self.segment_ns + longest_ns) // period_ns + 4 if log else 1)
            for group, period_ns in periods_ns.items()
        }
        self.wall_s = 0.0
        self._separations: list[SeparationState] = []
        self._counts = np.zeros(2, np.int64)
        self._hold(self._arrays(self._logged, self._rows))
        with compilation(loaded.name, advance, begin):
            if self.packed.memory["held"]["clamped"][0] == 1 and self.packed.memory["clock"]["started"][0] == 0:
                from maxq.sim.run.standing import stand_still  # noqa: PLC0415  # lazy: rarely needed

                stand_still(self.packed)
            begin(self.packed.parameters, self.packed.pool, self.packed.memory, self.packed.state)
            self._advance(self._now_ns, self._logged, self._rows)
        self._software: FlightSoftware | None = None
        if external:
            from maxq.sim.run.flight_software import FlightSoftware  # noqa: PLC0415  # lazy: rarely needed

            self._software = FlightSoftware(loaded, held)
            self._own = self._arrays(self._logged, self._rows)
            self._hold(self._software.start(self._own))

    def _arrays(self, logged: Any, room: LoggedRows) -> tuple[Any, ...]:
        """Return the arguments of `advance` in order, except `until_ns`."""
        p, (fast_ns, fast), (slow_ns, slow) = self.packed, room[FAST], room[SLOW]
        return (
            p.parameters,
            p.pool,
            p.memory,
            p.state,
            self._arena,
            logged,
            fast_ns,
            fast,
            slow_ns,
            slow,
            self._counts,
        )

    def _hold(self, arrays: tuple[Any, ...]) -> None:
        """Use these arrays, in the order of `_arrays`, for the state of the flight and its buffers."""
        _, _, memory, state, self._arena, _, fast_ns, fast, slow_ns, slow, self._counts = arrays
        self.packed = replace(self.packed, memory=memory, state=state)
        self._rows = {FAST: (fast_ns, fast), SLOW: (slow_ns, slow)}

    def finds_kernels(self, packed: Packed) -> bool:
        """Return True if kernels for records like those of `packed`, a flight of this scenario, are stored on disk."""
        _, pool, memory, state, arena, *others = self._arrays(self._logged, self._rows)
        cache = getattr(advance, "_cache", None)  # another class if no folder can be written
        return isinstance(cache, EntryCache) and cache.holds(packed.parameters, pool, memory, state, arena, 0, *others)

    @property
    def clock(self) -> Clock:
        """Return the clock of the flight as Python numbers, because reading a record is slow."""
        return Clock(*self.packed.memory["clock"][0].item())

    @property
    def memory(self) -> Any:
        return self.packed.memory[0]

    @property
    def _now_ns(self) -> int:
        return int(self.packed.memory["clock"]["now_ns"][0])

    @property
    def finished(self) -> bool:
        return bool(self.packed.memory["clock"]["finished"][0] == 1)

    @property
    def now_s(self) -> float:
        return self._now_ns / 1e9

    @property
    def events(self) -> tuple[Event, ...]:
        """Return all events so far, in order of time."""
        clock, timelines = self.clock, self.packed.parameters["timeline"]
        start_ns = to_ns(self.loaded.scenario.run.start_s)
        found = []
        for index in range(clock.stage + 1):
            number = index + 1 if len(timelines) > 1 else 0
            ignition_ns, goes_on = int(timelines["burn_start_ns"][index]), timelines["continues"][index] > 0
            if goes_on and ignition_ns > timelines["separation_ns"][index - 1]:
                goes_on = False  # the core ignites after the separation of its boosters
            commanded = timelines["sequenced"][index] == 1  # then _burns yields the ignitions
            if start_ns <= ignition_ns <= clock.now_ns and ignition_ns < NEVER and not goes_on and not commanded:
                found.append(Event(IGNITION_NAME, ignition_ns, number))
            for name, times_ns in zip(_OF_STAGES, (clock.stage_burnout_ns, clock.stage_separation_ns), strict=True):
                if times_ns[index] >= 0 and not (name == _OF_STAGES[0] and self._is_no_burnout(clock, index)):
                    found.append(Event(name, int(times_ns[index]), number))
        for name, time_ns in zip(EVENT_NAMES, clock.event_ns, strict=True):
            if time_ns >= 0 and name not in _OF_STAGES:
                causes = {DIVERGED_NAME: CAUSES[clock.cause], CONTROL_LOST_NAME: CONTROL_LOST_CAUSE}
                found.append(Event(name, int(time_ns), detail=causes.get(name, "")))
        found += self._boosters(clock, start_ns)
        found += self._burns(clock)
        if (exit_ns := int(self.packed.memory["launch"]["rail_exit_ns"][0])) >= 0:
            found.append(Event(RAIL_EXIT_NAME, exit_ns))
        found += self._faults(clock, start_ns)
        found += self._broken_waves(clock)
        if self._software is not None and (said := self._software.complaint(self.memory.computer.external)):
            found.append(Event(SOFTWARE_NAME, clock.now_ns, detail=said))
        return tuple(sorted(found, key=lambda event: event.time_ns))

    def _boosters(self, clock: Clock, start_ns: int) -> Iterator[Event]:
        """Yield the ignitions and burnouts so far of boosters while they are attached."""
        several = len(self.packed.parameters) > 1
        for name, stage, *instants in self.packed.boosters:
            begins_ns = int(clock.stage_separation_ns[stage - 1]) if stage > 0 else start_ns
            ends_ns = int(clock.stage_separation_ns[stage])
            until_ns = clock.now_ns if ends_ns < 0 else min(ends_ns, clock.now_ns)
            for kind, time_ns in zip(BOOSTER_NAMES, instants, strict=True):
                if stage <= clock.stage and begins_ns <= time_ns <= until_ns:
                    yield Event(kind, time_ns, (stage + 1) * several, name)

    def _burns(self, clock: Clock) -> Iterator[Event]:
        """Yield the restarts and the ignitions by flight code so far, and the cutoffs before restarts."""
        several = len(self.packed.parameters) > 1
        for n in range(clock.restarts):
            name = IGNITION_NAME if self._is_first(clock, n) else RESTART_NAME
            yield Event(name, int(clock.restart_ns[n]), (int(clock.restart_stage[n]) + 1) * several)
        for time_ns in self._cutoffs_ns(clock):
            stage = sum(0 <= int(separated_ns) <= time_ns for separated_ns in clock.stage_separation_ns[: clock.stage])
            yield Event(CUTOFF_NAME, time_ns, (stage + 1) * several)

    def _cutoffs_ns(self, clock: Clock) -> list[int]:
        """Return the times of the cutoffs before restarts, ns."""
        cut_off_ns = clock.restart_cut_off_ns
        times_ns = [int(cut_off_ns[n]) for n in range(clock.restarts) if not self._is_first(clock, n)]
        return [*times_ns, clock.cut_off_ns] if self.awaits_restart else times_ns

    def _is_first(self, clock: Clock, n: int) -> bool:
        """Return True if an ignition is the first one of its engine, which flight code has commanded."""
        timelines, stage = self.packed.parameters["timeline"], int(clock.restart_stage[n])
        first = stage
        while timelines["continues"][first] > 0:
            first -= 1
        return bool(timelines["sequenced"][stage] == 1) and not any(
            first <= int(before) <= stage for before in clock.restart_stage[:n]
        )

    def _is_no_burnout(self, clock: Clock, index: int) -> bool:
        """Return True if the burnout of a stage is a cutoff before a restart, or that of the preceding stage."""
        time_ns, before_ns = (int(clock.stage_burnout_ns[k]) for k in (index, index - 1))
        return time_ns in self._cutoffs_ns(clock) or (index > 0 and time_ns == before_ns)

    @property
    def awaits_restart(self) -> bool:
        """Return True if the vehicle is in a coast before a restart."""
        clock = self.clock
        burns = self.packed.parameters[clock.stage].computer.burns
        return 0 < clock.cut_off_ns <= clock.now_ns and clock.restarts + 1 < burns.count

    def _broken_waves(self, clock: Clock) -> list[Event]:
        """Return the first breaking of a wave, for each slosh mode in which it has occurred, in the stages so far."""
        found = []
        broken_ns = self.packed.memory["waves"]["broke_ns"][0].tolist()
        for index, stage in enumerate(self.loaded.vehicle.stage[: clock.stage + 1]):
            broke_ns = broken_ns[index * MAX_PENDULUMS :]
            for name, time_ns in zip(stage.pendulum_names, broke_ns, strict=False):
                if time_ns >= 0:
                    number = index + 1 if len(self.packed.parameters) > 1 else 0
                    found.append(
                        Event(WAVE_BREAKING_NAME, time_ns, number, f"tank {propellant_text(name)}: {BROKEN_WAVE}")
                    )
        return found

    def _largest_wave(self) -> tuple[float, float]:
        """Return the metric `max_wave_share` and its time, s; nan without a tank radius."""
        if all(tank.radius_m is None for stage in self.loaded.vehicle.stage for tank in stage.tank):
            return math.nan, math.nan
        waves = self.packed.memory["waves"]
        k = int(np.argmax(waves["largest"][0]))
        at_ns = int(waves["largest_ns"][0, k])
        return float(waves["largest"][0, k]), at_ns / 1e9 if at_ns >= 0 else math.nan

    @property
    def _sequenced(self) -> bool:
        return bool(self.packed.parameters["timeline"]["sequenced"][0] == 1)

    @property
    def outcome(self) -> str:
        """Return the reason for the end of the flight, as in `Flight.outcome`."""
        clock, memory = self.clock, self.packed.memory
        if memory["computer"]["external"]["fault"][0] != 0:
            return SOFTWARE_NAME
        stop_mask = int(self.packed.parameters["timeline"]["stop_mask"][clock.stage])
        if clock.event_ns[DIVERGED] >= 0:
            return DIVERGED_NAME
        if not clock.finished:
            return "interrupted"
        for index, (name, time_ns) in enumerate(zip(EVENT_NAMES, clock.event_ns, strict=True)):
            if (stop_mask >> index) & 1 and time_ns == clock.now_ns:
                return name
        return "duration"

    def _faults(self, clock: Clock, start_ns: int) -> Iterator[Event]:
        """Yield the beginnings and ends of faults so far. A fault of a stage is limited to the flight of that stage."""
        stages = len(self.packed.parameters)
        left_ns = [int(t) if t >= 0 else NEVER for t in clock.stage_separation_ns[:stages]]
        for fault in self.loaded.scenario.fault:
            zero_ns = int(clock.event_ns[LIFTOFF]) if fault.since == "liftoff" else 0
            first, last = (0, stages - 1) if fault.stage is None else (fault.stage, fault.stage)
            begin_ns = max(zero_ns + to_ns(fault.at_s), left_ns[first - 1] if first > 0 else start_ns)
            end_ns = NEVER if fault.until_s is None else zero_ns + to_ns(fault.until_s)
            flies_until_ns = min(clock.now_ns, left_ns[last] - 1)
            if zero_ns < 0 or begin_ns >= end_ns or begin_ns > flies_until_ns:
                continue
            number = first + 1 if fault.stage is not None and stages > 1 else 0
            yield Event(FAULT_NAME, begin_ns, number, fault.text)
            if end_ns <= flies_until_ns:
                yield Event(FAULT_END_NAME, end_ns, number, fault.text)

    def fly_segment(self, length_ns: int | None = None) -> LoggedRows:
        """Fly to the next multiple of `length_ns`, a multiple of the step (default: `segment_ns`).

        Returns the log rows of the segment in logged units. They are views that the next segment overwrites.
        """
        length_ns = length_ns or self.segment_ns
        return self.fly_until((self._now_ns // length_ns + 1) * length_ns)

    def fly_until(self, until_ns: int) -> LoggedRows:
        """Fly to a time at most a segment ahead: a multiple of the step, or the next sample. Return rows as well."""
        start = time.perf_counter()
        rows = self._advance(until_ns, self._logged, self._rows, self._software)
        if self._software is not None and self.finished:
            rows = copied(rows)
            for own, flown in zip(self._own[2:5], self._arrays(self._logged, self._rows)[2:5], strict=True):
                # memory, state and arena, as bytes, because NumPy copies each field of a record alone; another flight
                # may use the shared arrays after `close`
                own.reshape(-1).view("u1")[:] = flown.reshape(-1).view("u1")
            self._hold(self._own)
            self._software.close()
        self.wall_s += time.perf_counter() - start
        return rows

    def present(self) -> dict[str, float]:
        """Return the value of every channel at this instant, in logged units, without a change of the flight."""
        kept, room = self.packed, {group: self._blank(group, 1) for group in self._rows}
        self.packed = replace(kept, memory=duplicate(kept.memory), state=kept.state.copy())
        clock = self.packed.memory["clock"]
        clock["finished"], clock["started"] = 1, 1  # as at the end of a flight, whose last instant is logged
        try:
            rows = self._advance(self._now_ns, self._on, room)
        finally:
            self.packed = kept
        return {
            channel.name: value
            for group, (_, values) in rows.items()
            for channel, value in zip(self.table.columns(group), values[0].tolist(), strict=True)
        }

    def result(self, rows: LoggedRows | None = None) -> Flight:
        """Return the result of the flight so far. `rows` are the log rows that the caller has kept."""
        clock, memory, scenario = self.clock, self.packed.memory, self.loaded.scenario
        events, final, outcome = self.events, self.present(), self.outcome
        times_s = [t / 1e9 if t >= 0 else math.nan for t in memory["extremes"]["time_ns"][0].tolist()]
        metric_times_s = dict.fromkeys(METRIC_NAMES, self.now_s) | dict(zip(MetricIndex._fields, times_s, strict=True))
        lift_off_s = next((e.time_s for e in events if e.name == "liftoff"), scenario.run.start_s)
        earth = self.packed.parameters[0].environment.earth
        end = end_metrics(final, earth, scenario.site, self.now_s - lift_off_s)
        wave, metric_times_s["max_wave_share"] = self._largest_wave()
        loads = section_extremes(self.packed.parameters, memory["sections"][0])
        of_sections, section_times = section_metrics(loads, memory["sections"][0])
        metrics = dict(zip(MetricIndex._fields, memory["extremes"]["value"][0].tolist(), strict=True))
        metrics |= of_sections._asdict() | end._asdict() | WaveMetrics(wave)._asdict()
        accuracy = scenario.run.accuracy
        errors = memory["errors"][0]
        turned, bent, swung = errors[:3] + np.sqrt(errors[ERRORS_SQUARED:])
        estimated = StepMetrics(turned, bent, swung, errors[3])._asdict()
        metrics |= {name: float(error) if accuracy is not None else math.nan for name, error in estimated.items()}
        r_I_m, v_I_mps = (tuple(self.packed.state[k : k + 3].tolist()) for k in (R_I, V_I))
        metrics |= orbit_metrics(earth, r_I_m, v_I_mps)._asdict()
        metrics |= self._of_launch(metric_times_s) | self._of_cutoff(earth, metric_times_s)
        metrics |= self._of_impact(metric_times_s)
        metric_times_s |= section_times._asdict()
        judged = judged_requirements(scenario)
        if scenario.design is None or scenario.vehicle.computer is None:
            metrics |= dict.fromkeys(ATTITUDE_METRICS, math.nan)
        inexact = step_failure(scenario.run, metrics, judged)
        failed = [e for e in events if e.name in _FAILED]
        return Flight(
            scenario=self.loaded,
            table=self.table,
            rows=rows or {},
            events=events,
            metrics=metrics,
            metric_times_s=metric_times_s,
            verdicts=tuple(judge(r, metrics, metric_times_s) for r in judged),
            section_extremes=loads,
            failures=(
                *(f"{e.name.replace('_', ' ')} at {e.time_s:.3f} s: {e.detail}" for e in failed),
                *([inexact] if inexact and not failed else []),
                *_above_the_wind(scenario, metrics["max_altitude_m"]),
                *(self._on_the_pad(final) if outcome != "interrupted" and not failed else ()),
                *self._missed_orbit(),
            ),
            inexact=bool(inexact and not failed),
            outcome=outcome,
            cause=next((e.detail for e in failed if e.name == outcome), ""),
            end_s=self.now_s,
            end_ns=clock.now_ns,
            steps=clock.steps,
            state=self.packed.state.copy(),
            final=final,
            state_hash=self.state_hash(),
            wall_s=self.wall_s,
            separations=tuple(self._separations),
        )

    def _of_launch(self, times_s: dict[str, float]) -> dict[str, float]:
        """Return the metrics of the launch, and write their times into `times_s`."""
        launch, scenario = self.packed.memory["launch"][0], self.loaded.scenario
        values = launch.clearance_m, launch.drift_m, launch.rail_exit_mps, math.degrees(launch.bending_radps)
        times_ns = launch.clearance_ns, launch.drift_ns, launch.rail_exit_ns, launch.bending_ns
        tower = scenario.tower is not None
        measured = tower, tower, launch.rail_exit_ns >= 0, launch.watched_ns >= 0
        found = {
            name: float(value) if known else math.nan
            for name, value, known in zip(LaunchMetrics._fields, values, measured, strict=True)
        }
        at_s = zip(LaunchMetrics._fields, times_ns, strict=True)
        times_s |= {name: time_ns / 1e9 if time_ns >= 0 else math.nan for name, time_ns in at_s}
        return found

    def _of_cutoff(self, earth: Earth, times_s: dict[str, float]) -> dict[str, float]:
        """Return the metrics of the last cutoff by the guidance, and write their times into `times_s`."""
        burnout, ends, clock = self.packed.memory["burnout"][0], self.loaded.scenario.guidance.ends, self.clock
        burning = int(self.packed.memory["held"]["burning"][0])
        happened = clock.restarts > 0 or 0 < clock.cut_off_ns <= burnout.time_ns  # a cutoff may be due after the end
        end = ends[max(clock.restarts - burning, 0)] if happened and not self._sequenced else None
        if (
            self._sequenced
            and clock.stage + 1 == len(self.packed.parameters)
            and burnout.time_ns >= clock.cut_off_ns > 0
        ):
            end = ends[-1]
        times_s |= dict.fromkeys(CutoffMetrics._fields, math.nan if end is None else burnout.time_ns / 1e9)
        if end is None:
            return dict.fromkeys(CutoffMetrics._fields, math.nan)
        return cutoff_metrics(earth, end, tuple(burnout.r_I_m.tolist()), tuple(burnout.v_I_mps.tolist()))._asdict()

    def _of_impact(self, times_s: dict[str, float]) -> dict[str, float]:
        """Return the metrics of the impact point, and write their times into `times_s`."""
        scenario, trail = self.loaded.scenario, self.packed.memory["trail"][0]
        if scenario.range_safety is None:
            times_s |= dict.fromkeys(ImpactMetrics._fields, math.nan)
            return dict.fromkeys(ImpactMetrics._fields, math.nan)
        n = int(trail["count"])
        at_s = np.append(trail["time_ns"][:n] / 1e9, self.now_s)  # with the last state of the flight
        r_I_m, v_I_mps = (
            np.vstack([trail[name][: 3 * n].reshape(n, 3), self.packed.state[k : k + 3]])
            for name, k in (("r_I_m", R_I), ("v_I_mps", V_I))
        )
        earth = pack_earth(scenario.earth)
        found, found_s = impact_metrics(earth, scenario.site, scenario.range_safety, at_s, r_I_m, v_I_mps)
        times_s |= found_s._asdict()
        return found._asdict()

    def _on_the_pad(self, final: dict[str, float]) -> tuple[str, ...]:
        """Return a failure with its reason if a vehicle in hold-down has not lifted off after its thrust has built up.

        `final` contains the channels at the end.
        """
        scenario, pad = self.loaded.scenario, self.loaded.scenario.holddown
        built_up_s = _built_up_s(scenario.vehicle.stage[0])
        if not scenario.held or self.clock.event_ns[LIFTOFF] >= 0 or self.now_s < built_up_s:
            return ()
        if pad.release == "time":
            why = f"the release is at {pad.release_s:g} s"
        else:
            weight_N = final["mass_kg"] * STANDARD_GRAVITY_mps2
            why = f"the thrust is {final['thrust_N']:.4g} N, the weight {weight_N:.4g} N"
        return (f"not lifted off at {self.now_s:.3f} s: {why}",)

    def _missed_orbit(self) -> tuple[str, ...]:
        """Return a failure if the last engine burned out before its cutoff by the guidance."""
        clock, ends = self.clock, self.loaded.scenario.guidance.ends
        burned_out = clock.stage_burnout_ns[len(self.packed.parameters) - 1] >= 0
        if self.packed.parameters[-1].computer.burns.count == 0 or not burned_out or clock.cut_off_ns > 0:
            return ()
        end, which = ends[clock.restarts], f" of burn {clock.restarts + 1}" if len(ends) > 1 else ""
        if end is None:
            return ()
        if isinstance(end, Cutoff):
            return (f"the engine burned out before the cutoff{which}",)
        if self.packed.memory["computer"]["orbit"]["phase"][0] < STEERING:
            return (f"closed-loop guidance{which} found no way to the orbit",)
        return (f"the engine burned out before closed-loop guidance{which} reached the orbit",)

    def state_hash(self) -> str:
        """Return the SHA-256 of the last state, time and event times, which is equal for bit-identical flights."""
        clock = self.clock
        flown = self.packed.state[: len(_state_names(self.packed.sizes))]  # without the unused entries
        digest = hashlib.sha256(flown.tobytes())
        digest.update(np.array([clock.now_ns, clock.steps, clock.stage]).tobytes())
        digest.update(np.asarray(clock.event_ns).tobytes())
        return digest.hexdigest()

    def _blank(self, group: str, room: int) -> tuple[IntArray, Array]:
        return np.zeros(room, np.int64), np.zeros((room, len(self.table.columns(group))))

    def _advance(
        self, until_ns: int, logged: Any, room: LoggedRows, software: FlightSoftware | None = None
    ) -> LoggedRows:
        """Fly until `until_ns`, and return the log rows as views of `room`."""
        self._counts[:] = 0
        if software is not None:
            software.advance(until_ns)
        else:
            parameters, pool, memory, state, arena, *others = self._arrays(logged, room)
            for stop_ns in self._stops_ns(until_ns):
                advance(parameters, pool, memory, state, arena, stop_ns, *others)
        (fast_ns, fast), (slow_ns, slow) = room[FAST], room[SLOW]
        n, m = self._counts
        return {FAST: (fast_ns[:n], fast[:n]), SLOW: (slow_ns[:m], slow[:m])}

    def _stops_ns(self, until_ns: int) -> Iterator[int]:
        """Yield the scheduled separations until `until_ns` and this time, and keep the state before each separation.

        A step ends there in any case, so that these stops do not change the flight. `advance` carries a separation out
        at the beginning of its next call.
        """
        clock = self.packed.memory["clock"]
        first = int(clock["stage"][0])
        for stage, at_ns in enumerate(self._separations_ns[first:], first):
            if not self._now_ns < at_ns <= until_ns:
                break
            yield at_ns
            if self._now_ns != at_ns or int(clock["stage"][0]) != stage or self.finished:
                break
            r_I_m, v_I_mps = (tuple(self.packed.state[k : k + 3].tolist()) for k in (R_I, V_I))
            self._separations.append(SeparationState(stage, at_ns, r_I_m, v_I_mps))
        yield until_ns


def fly(
    loaded: LoadedScenario, *, log: bool = True, watch: Callable[[FlightRun, LoggedRows], None] | None = None
) -> Flight:
    """Fly a scenario to its end, and return the flight. With `log=False`, no channels are kept, which is fastest.

    `watch` is called with the run and its rows after every segment (1 s of simulated time, or about a thousand steps).
    The divergence of a flight raises no exception; `outcome` and `cause` of the result report it.
    """
    run = FlightRun(loaded, log=log)
    if not log and watch is None:  # no observer between segments
        run.segment_ns *= max(_UNSEEN_NS // run.segment_ns, 1)
    kept = GrowingRows()
    while not run.finished:
        rows = run.fly_segment()
        if log:
            kept.add(rows)
        if watch is not None:
            watch(run, rows)
    return run.result(kept.rows() if log else None)


def with_half_step(flight: Flight) -> LoadedScenario | None:
    """Return the scenario of an inexact flight with half the step.

    The result is None for an exact or interrupted flight, and after MOST_HALVINGS. It depends only on the inputs of the
    flight, so that a repetition has the same step.
    """
    loaded, run = flight.scenario, flight.scenario.scenario.run
    if not flight.inexact or flight.outcome == "interrupted" or run.halvings >= MOST_HALVINGS:
        return None
    finer = run.model_copy(update={"halvings": run.halvings + 1})
    return replace(loaded, scenario=loaded.scenario.model_copy(update={"run": finer}))


def logged_channels(scenario: Scenario, sizes: Sizes) -> ChannelTable:
    """Return the channels of a scenario's flights. `sizes` are the largest sizes of all stages.

    A tank without a name is denoted by its number. A tank with different names in several stages is denoted by all of
    them (lox_or_hydrogen).
    """
    of_stages = zip_longest(*(stage.pendulum_names for stage in scenario.vehicle.stage), fillvalue="")
    names = tuple("_or_".join(dict.fromkeys(filter(None, each))) for each in of_stages)
    waves = _logs_waves(scenario, sizes)
    groups = max((stage.engine_groups for stage in scenario.vehicle.stage), key=len)
    groups = tuple(name or str(i + 1) for i, name in enumerate(groups)) if len(groups) > 1 else ()
    computer, tanks = scenario.vehicle.computer, names[: sizes.pendulums]
    external = computer is not None and computer.law == "external"
    senses = len(scenario.vehicle.stage[0].accelerometers)
    return _channel_table(
        sizes,
        tanks,
        load_stations(scenario),
        waves,
        groups,
        engine_names(scenario),
        external,
        senses,
        _adapts(scenario),
        _drifts(scenario),
        pack_receivers(scenario.vehicle).on == 1,
    )


def _flown_design(scenario: Scenario) -> Design | None:
    """Return the design that the computer runs, or None without a computer or with external flight code."""
    computer = scenario.vehicle.computer
    return None if computer is None or computer.law == "external" else scenario.design


def refuse_unstable_steps(loaded: LoadedScenario) -> None:
    """Raise ScenarioError if the integrator is unstable for an oscillation of the vehicle."""
    o = unstable(loaded.scenario)
    if o is None:
        return
    problem = f"the integrator is unstable for {o.name} ({o.frequency_hz:.4g} Hz)"
    allowed = f"at most about {2.8 / (2.0 * math.pi * o.frequency_hz):.2g} s, or run.accuracy"
    raise ScenarioError(loaded.label, problem, "run.step_s", value=loaded.scenario.run.step_s, allowed=allowed)


def _adapts(scenario: Scenario) -> bool:
    """Return True if adaptive augmenting control is used in any stage."""
    design = _flown_design(scenario)
    if design is None:
        return False
    return design.adaptive is not None or any(own.adaptive is not None for own in design.stage)


def _drifts(scenario: Scenario) -> bool:
    """Return True if the control law feeds back the drift."""
    design = _flown_design(scenario)
    return design is not None and design.law in DRIFT


def engine_names(scenario: Scenario) -> tuple[str, ...]:
    """Return a name or number for each engine of the stage with the most engines; empty for a single engine."""
    engines = max((stage.engines for stage in scenario.vehicle.stage), key=len)
    return tuple(e.name or str(i + 1) for i, e in enumerate(engines)) if len(engines) > 1 else ()


def load_stations(scenario: Scenario) -> tuple[str, ...]:
    """Return a description of each station of the section loads, with its position on all stages."""
    if not scenario.switches.section_loads:
        return ()
    of_stages = [stage.loads.stations_m for stage in scenario.vehicle.stage if stage.loads is not None]
    places = ([f"{s[i]:g} m" for s in of_stages if i < len(s)] for i in range(max(map(len, of_stages), default=0)))
    return tuple(f"station {i} at {' or '.join(dict.fromkeys(place))}" for i, place in enumerate(places, start=1))


def _logs_waves(scenario: Scenario, sizes: Sizes) -> bool:
    return sizes.pendulums > 0 and any(tank.shows_waves for stage in scenario.vehicle.stage for tank in stage.tank)


def _built_up_s(stage: Stage) -> float:
    """Return the time on the stage clock by which all engines have reached _BUILT_UP of their largest thrust, s."""
    out = 0.0
    for body in stage.bodies:
        for engine in body.own_engines:
            thrust_N = engine.thrust_factor * engine.table["thrust_vacuum_N"]
            row = int(np.argmax(thrust_N >= _BUILT_UP * thrust_N.max()))
            out = max(out, body.ignition_s + float(engine.table["time_s"][row]) / engine.burn_factor)
    return out


def _above_the_wind(scenario: Scenario, highest_m: float) -> tuple[str, ...]:
    """Return a failure if the flight rose above a wind profile that must cover it, with wind.outside = "error"."""
    wind = scenario.wind
    if wind.outside == "hold" or wind.profile is None:
        return ()
    top_m = float(wind.profile["altitude_m"][-1])
    if highest_m <= top_m:
        return ()
    return (f"the flight rose to {highest_m:.0f} m, the wind profile ends at {top_m:.0f} m (wind.outside = 'error')",)


def _segment_ns(step_ns: int, shortest_log_ns: int, longest_ns: int) -> int:
    """Return the length of a segment, ns: a multiple of the step, near `longest_ns`.

    It is less than `longest_ns` for many steps or rows, and more for few of both. Only between two segments can a
    flight be interrupted and are its rows written.
    """
    usual_ns = max(longest_ns, _FEW * min(step_ns, shortest_log_ns))
    longest = min(usual_ns, _MOST_STEPS * step_ns, _MOST_ROWS * shortest_log_ns)
    return max(longest // step_ns, 1) * step_ns
