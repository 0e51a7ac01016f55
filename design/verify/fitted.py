"""A suite fitted to a vehicle, with numbers in place of marks for quantities of the vehicle and of its flight.

A suite for any vehicle contains no number of a tank, mode or engine and no time in seconds. `*` in a key represents
each element of a list (vehicle.stage.*.tank.*.damping_ratio). `scale` and `add` change values of the vehicle. Marks
represent quantities that are known after a flight of the vehicle: ${max_q_s + 0.2}. The result is a suite of plain
`key=value` changes. A flight that requires a part that the vehicle does not have is omitted and reported.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from maxq.design import operating_points
from maxq.design.model.node import Node
from maxq.design.model.powered import powered_spans
from maxq.design.verify.memory import PartsOnDisk
from maxq.design.verify.suite import LoadedSuite, SuiteFlight
from maxq.sim.input.documents import index_in
from maxq.sim.input.errors import ScenarioError, suggestion
from maxq.sim.input.values import Section
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_scenario import LogSection

_TUNED = ("mode_1", "mode_2", "slosh")
_PLACES = ("max_q", "before_max_q", "after_max_q")
NAMES = (
    # time and altitude of the largest dynamic pressure under thrust, and of 0.8 times it before and after (the last
    # burnout if thrust ends earlier); gust lengths: height climbed in a period of mode or slosh
    *(f"{at}_{what}" for at in _PLACES for what in ("s", "altitude_m", *(f"{x}_gust_m" for x in _TUNED))),
    "limit_wind",  # wind profile of the suite's key
    "stage",  # number of the stage, from 0; stage marks and those after ignition only with each_stage
    "outer_engine",  # number of the core engine farthest from the axis, if there are several; only with each_stage
    "outer_booster",  # number of the booster farthest from the axis
    "booster_stage",  # number of the stage, if boosters leave at its end
    "burnout_s",  # burnout of the last stage
    "sample_s",  # sample period of the first stage's computer
    "longer_s",  # half of the sample, or less if the computer's delay requires it
    "gimbal_limit_deg",  # least angle limit of all actuators and computers
    "gimbal_rate_limit_degps",  # least rate limit of all actuators
    "ignition_s",  # ignition of the stage, or liftoff
    "early_s",  # a fifth of the stage's burn
    "strongest_s",  # largest dynamic pressure in the stage's burn
    "late_s",  # three quarters of the stage's burn
    "stage_burnout_s",  # end of the stage's burn
    "gimbal_moment_Nm",  # moment of one degree of all gimbals, at strongest_s
)
"""The marks that a suite may contain."""
_MARK = re.compile(r"\$\{\s*([\w.]+)\s*(?:([+*-])\s*([0-9.eE+-]+)\s*)?\}|\$(\w+)")
_LONGEST_M = 1000.0  # longest gust; longer ones belong to the wind profile
_STRONG = 0.8  # fraction of the largest dynamic pressure
_EARLY, _LATE = 0.2, 0.75  # fractions of a burn
_CLEAR_S = 1.0  # least distance of a failure from the ends of a burn

Marks = dict[str, float | int | str]


class _Missing(Exception):
    """A part that the vehicle does not have."""


def fit(loaded: LoadedSuite, base: LoadedScenario, memory: PartsOnDisk) -> LoadedSuite:
    """Return the suite for the vehicle of `base`, which is flown if a mark is used.

    A fitted suite is returned unchanged. Raises ScenarioError for an unknown mark, and for a mark in a place where it
    has no value for any vehicle.
    """
    suite = loaded.suite
    texts = [str(d.limit) for d in suite.dispersed_limit]
    for f in suite.flight:
        texts += [f.name, *f.set, *(str(text) for table in (f.scale, f.add) for text in (*table, *table.values()))]
    plain = not any(f.each_stage or f.scale or f.add or "*" in "".join(f.set) for f in suite.flight)
    if plain and not suite.every and not any(_MARK.search(text) for text in texts):
        return loaded
    flown = any(f.each_stage for f in suite.flight) or any(_MARK.search(text) for text in texts)
    whole, stages = memory.recall("marks", base.as_flown, lambda: _marks(base)) if flown else ({}, [])
    if suite.limit_wind is not None:
        whole = {**whole, "limit_wind": suite.limit_wind}
    flights, left_out = [], []
    for given in suite.flight:
        every = given.model_copy(update={"set": (*suite.every, *given.set)})
        missed: list[tuple[str, str]] = []  # stage and reason
        places = [{**whole, **stage} for stage in stages] if given.each_stage else [whole]
        for marks in places:
            try:
                flights.append(_fitted(every, base, marks, loaded.label, len(stages)))
            except _Missing as missing:
                stage = f", stage {int(marks['stage']) + 1}" if given.each_stage and len(stages) > 1 else ""
                missed.append((stage, str(missing)))
        if len(missed) == len(places) and len({reason for _, reason in missed}) == 1:
            missed = [("", missed[0][1])]
        left_out += [f"{given.name}{stage}: {reason}" for stage, reason in missed]
    limits, asked = [], [r.name or r.metric for r in base.scenario.requirement]
    for one in suite.dispersed_limit:
        if one.requirement in asked or suggestion(one.requirement, asked):
            limit = _number(one.limit, whole, loaded.label, f"dispersed_limit {one.requirement}")
            limits.append(one.model_copy(update={"limit": limit}))
        else:
            left_out.append(f"dispersed limit of {one.requirement}: the scenario does not limit it")
    update: dict[str, Any] = {"flight": tuple(flights), "dispersed_limit": tuple(limits), "every": ()}
    return replace(loaded, suite=suite.model_copy(update=update), left_out=tuple(dict.fromkeys(left_out)))


def named(loaded: LoadedSuite, base: LoadedScenario) -> LoadedSuite:
    """Return the suite with the flight names that `fit` would assign, without a flight."""
    stages, flights = range(len(base.vehicle.stage)), []
    for flown in loaded.suite.flight:
        names = [flown.name, *(f"{flown.name}, {_called(base, n)}" for n in stages if flown.each_stage)]
        flights += [flown.model_copy(update={"name": name}) for name in names]
    return replace(loaded, suite=loaded.suite.model_copy(update={"flight": tuple(flights)}))


def _called(base: LoadedScenario, number: int) -> str:
    return base.vehicle.stage[number].name or f"stage {number + 1}"


def _fitted(flown: SuiteFlight, base: LoadedScenario, marks: Marks, label: str, stages: int) -> SuiteFlight:
    where, name = f"flight {flown.name}", flown.name
    if flown.each_stage and stages > 1:
        name += f", {_called(base, int(marks['stage']))}"
    changes, wanted = [], []
    for change in flown.set:
        key, equals, value = _filled(change, marks, label, where).partition("=")
        found = [path for path, _ in _places(base.scenario, key.split("."))] if "*" in key else [key]
        wanted += [] if found else [key]
        changes += [f"{path}{equals}{value}" for path in found]
    for table, how in ((flown.scale, operator.mul), (flown.add, operator.add)):
        for pattern, given in table.items():
            key = _filled(pattern, marks, label, where)
            by = _number(given, marks, label, where)
            places = [(path, value) for path, value in _places(base.scenario, key.split(".")) if value is not None]
            wanted += [] if places else [key]
            for path, value in places:
                changes.append(f"{path}={_changed(value, by, how)!r}".replace("(", "[").replace(")", "]"))
    if wanted and not any(change not in flown.set for change in changes):
        raise _Missing(f"the vehicle has no {', no '.join(wanted)}")
    update = {"name": name, "set": tuple(changes), "scale": {}, "add": {}, "each_stage": False}
    return flown.model_copy(update=update)


def _changed(value: Any, by: float, how: Callable[[float, float], float]) -> Any:
    """Return a number of the vehicle, or each number of a list, changed by `how`."""
    return [_changed(one, by, how) for one in value] if isinstance(value, tuple) else round(how(float(value), by), 9)


def _places(at: Any, parts: list[str], path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the keys and values that match a pattern.

    `*` at a section that could also be a list matches the section itself.
    """
    if not parts:
        yield path, at
        return
    part, *rest = parts
    if isinstance(at, tuple):
        known = range(len(at)) if part == "*" else (index_in(part, len(at)),)
        for n, one in ((n, at[n]) for n in known if n is not None):
            yield from _places(one, rest, f"{path}.{n}")
    elif isinstance(at, Section) and part == "*":
        yield from _places(at, rest, path)
    elif isinstance(at, Section):
        name = next((n for n, f in type(at).model_fields.items() if part in (n, f.alias)), None)
        if name is not None:
            yield from _places(getattr(at, name), rest, f"{path}.{part}" if path else part)


def _filled(text: str, marks: Marks, label: str, where: str) -> str:
    """Return a text with its marks replaced by values. Raises _Missing if the vehicle has no such quantity."""

    def value(found: re.Match[str]) -> str:
        name = found[1] or found[4]
        number = re.fullmatch(r"[0-9.]+", name) is not None
        if name not in NAMES and not number:
            hint = suggestion(name, NAMES)
            allowed = "" if hint else ", ".join(NAMES)
            raise ScenarioError(label, f"no such mark{'; ' + hint if hint else ''}", where, value=name, allowed=allowed)
        if name not in marks and not number:
            raise _Missing(f"no {name.replace('_', ' ')}")
        known = float(name) if number else marks[name]
        if not isinstance(known, float):
            return str(known)
        by = float(found[3] or 0.0)
        result = known * by if found[2] == "*" else known - by if found[2] == "-" else known + by
        return repr(round(result, 6))

    return _MARK.sub(value, text)


def _number(given: float | str, marks: Marks, label: str, where: str) -> float:
    if isinstance(given, float):
        return given
    try:
        return float(_filled(given, marks, label, where))
    except (ValueError, _Missing) as problem:
        raise ScenarioError(label, f"is no number: {problem}", where, value=given) from None


def _marks(base: LoadedScenario) -> tuple[Marks, list[Marks]]:
    """Return the marks of the whole flight, and those of the first burn of each stage."""
    log = LogSection(fast_hz=10.0, slow_hz=10.0, transform_hz=1.0)
    quiet = base.scenario.model_copy(update={"log": log, "fault": ()})
    flight, spans = fly(LoadedScenario(quiet, base.label, base.files)), powered_spans(base)
    t, q, altitude = flight.time_s("dynamic_pressure_Pa"), flight["dynamic_pressure_Pa"], flight["altitude_m"]
    altitude = np.interp(t, flight.time_s("altitude_m"), altitude)
    out = _computers(base)
    stages: list[Marks] = []
    if not spans:
        return out, stages
    end_s, burns = spans[-1].end_s, [(t >= span.begin_s) & (t <= span.end_s) for span in spans]
    top = int(np.argmax(np.where(np.any(burns, axis=0), q, -1.0)))
    strong = np.flatnonzero(q >= _STRONG * q[top])
    places = (top, int(strong[0]), int(strong[-1]) if t[strong[-1]] <= end_s else int(np.searchsorted(t, end_s)) - 1)
    for name, k in zip(_PLACES, places, strict=True):
        out |= {f"{name}_s": round(float(t[k]), 1), f"{name}_altitude_m": float(round(altitude[k], -2))}
    burning = [(name, at_s) for name in _PLACES if any(span.holds(at_s := float(out[f"{name}_s"])) for span in spans)]
    for name, at_s in burning:
        (node,) = operating_points.nodes(base, [at_s])
        climb_mps = float(np.interp(at_s, t, np.gradient(altitude, t)))
        for tone, hz in _tones_hz(node).items():
            out[f"{name}_{tone}_gust_m"] = min(float(f"{climb_mps / hz:.3g}"), _LONGEST_M)
    out["burnout_s"] = round(end_s, 3)
    strongest, first = [], [k for k, span in enumerate(spans) if k == 0 or spans[k - 1].stage != span.stage]
    for k in first:
        at = float(t[int(np.argmax(np.where(burns[k], q, -1.0)))])
        strongest.append(min(max(at, spans[k].begin_s + _CLEAR_S), spans[k].end_s - _CLEAR_S))
    for k, at_s, node in zip(first, strongest, operating_points.nodes(base, strongest), strict=True):
        span = spans[k]
        burn = span.end_s - span.begin_s
        mine: Marks = {
            "stage": span.stage,
            "ignition_s": round(span.begin_s, 3),
            "stage_burnout_s": round(span.end_s, 3),
            "early_s": round(span.begin_s + _EARLY * burn, 1),
            "late_s": round(span.begin_s + _LATE * burn, 1),
            "strongest_s": round(at_s, 1),
        }
        moment = abs(node.derivatives.m_delta_1ps2) * node.vehicle.total_inertia_kgm2
        mine["gimbal_moment_Nm"] = float(f"{math.radians(1.0) * moment:.3g}")
        engines = base.vehicle.stage[span.stage].own_engines  # the loss of a booster is not an engine-out of the core
        if len(engines) > 1:
            off = [math.hypot(*engine.offset_m) for engine in engines]
            mine["outer_engine"] = int(np.argmax(off))
        mine |= _of_boosters(base, span.stage)
        stages.append(mine)
    return out, stages


def _of_boosters(base: LoadedScenario, number: int) -> Marks:
    """Return the marks of a stage with boosters, and of one that boosters leave at its end."""
    stage, following = base.vehicle.stage[number], base.vehicle.stage[number + 1 : number + 2]
    out: Marks = {}
    if stage.booster:
        out["outer_booster"] = int(np.argmax([math.hypot(*booster.position_m) for booster in stage.booster]))
    if following and stage.leaving(following[0]):
        out["booster_stage"] = number
    return out


def _tones_hz(node: Node) -> dict[str, float]:
    """Return the frequencies (Hz) of the first two bending modes and of the slowest slosh mode, if they exist."""
    modes = np.sort(np.abs(node.vehicle.omega_radps)) / (2.0 * math.pi)
    out = {f"mode_{k + 1}": float(hz) for k, hz in enumerate(modes[:2])}
    bobs = node.vehicle.pendulums
    if len(bobs.mass_kg):
        load_mps2 = node.axial_load_mps2
        out["slosh"] = float(np.sqrt(load_mps2 / bobs.length_m).min()) / (2.0 * math.pi)
    return out


def _computers(base: LoadedScenario) -> Marks:
    """Return the marks of computers and gimbals.

    They are the sample period of the first computer, half of it or the remainder that every computer's delay permits,
    and the least gimbal limits.
    """
    vehicle = base.vehicle
    computers = [c for n in range(len(vehicle.stage)) if (c := vehicle.computer_of(n)) is not None]
    actuators = [actuator for stage in vehicle.stage for actuator in stage.actuators]
    sample_s = computers[0].sample_s if computers else 0.01
    longer_s = min([0.5 * sample_s, *(round(c.sample_s - c.delay_s, 9) for c in computers)])
    angles_deg = [*(c.command_limit_deg for c in computers), *(a.angle_limit_deg for a in actuators)]
    limits = {
        "gimbal_limit_deg": min(angles_deg, default=math.inf),
        "gimbal_rate_limit_degps": min((a.rate_limit_degps for a in actuators), default=math.inf),
    }
    return {"sample_s": sample_s, "longer_s": longer_s, **{k: x for k, x in limits.items() if math.isfinite(x)}}
