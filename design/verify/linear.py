"""Linear measures of a design: margins of the exact sampled loop, nominal and dispersed, and gimbal authority.

Margins are measured for the nominal vehicle, at the corners of the dispersions, and for random vehicles. A dispersed
vehicle has the same deviations at every operating point. The corners are a two-level screening design (Plackett &
Burman, Biometrika 33, 1946) of twelve runs and their mirror images, in which every pair of factors is uncorrelated.
Random vehicle N is run N of the campaign (design/model/deviations.py), along one of a few dispersed trajectories
(`conditions_of`). The compiled margins of design/margins/dispersed.py measure these vehicles. Vehicles with a margin
within `NEAR` of a limit, and those that the compiled margins do not support, are measured again by `margins`.

Authority: in trim, the moment of the deflected engine balances that of the angle of attack,
delta = -(M_alpha / M_delta) alpha. A cross-wind W causes an angle of attack alpha = atan(W / U) before the vehicle has
drifted. The gimbal reaches its limit at a wind of U tan(delta_max |M_delta / M_alpha|). If |M_alpha / M_delta| exceeds
three, this happens before any stability margin is lost.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.design.loop.filter_motion import MOST_MOTION, motion_shares
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop, law_at
from maxq.design.margins.dispersed import ManyLoops, NotServedError
from maxq.design.margins.many import DONE, HANDED_BACK
from maxq.design.margins.measured_loop import measure_loop
from maxq.design.model.deviations import deviations_of
from maxq.design.model.dispersion import Dispersion, stacked
from maxq.design.model.held import FlightCondition, Trim
from maxq.design.model.node import Node, at_same_propellant_s, disperse, met_by, node_of
from maxq.design.model.powered import flown_run, flown_to
from maxq.design.quantities import MEASURED, QUANTITIES, SWEPT, Convention, LoopLimits
from maxq.design.verify import suite
from maxq.design.verify.memory import PartsOnDisk, counted
from maxq.design.verify.names import node_name
from maxq.design.verify.suite import AS_DESIGNED, JudgedRequirement, LinearMargins
from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.campaign.statistics import allowed_failures, judge_failures, tolerance_bound
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.values import at_time
from maxq.sim.scenario.loader import told
from maxq.sim.scenario.schema_design import Design

INSTANTS_S = (0.5, 0.05, 0.005)
"""The steps of the search for the worst instant between operating points, coarse to fine."""
NEAR = 0.01
"""The distance from its limit within which a margin is measured again, dB, deg or ms."""
WORSE = {"dB": 0.02, "deg": 0.1, "ms": 0.05, "Hz": 0.002, "": 0.005}
"""The amount by which an instant must be worse than all operating points to become one, by unit."""
AUTHORITY_NAME = "gimbal trims a steady cross-wind"
RANDOM_NAME = "random vehicles meet the dispersed limits"
_GENERATOR = (1, 1, -1, 1, 1, 1, -1, -1, -1, 1, -1)  # first row of the Plackett-Burman design of twelve runs
_FACTORS = (
    "bending_frequency",
    "bending_slope",
    "bending_damping",
    "slosh_frequency",
    "slosh_mass",
    "slosh_damping",
    "actuator_frequency",
    "delay_s",
    "normal_force",
    "centre_of_pressure_m",
    "inertia",
)
_WITH = {
    "bending_shape": "bending_slope",
    "slosh_damping_ratio": "slosh_damping",
    "actuator_sections": "actuator_frequency",
    "rate_damping": "normal_force",
    "centre_of_gravity_m": "centre_of_pressure_m",
    "axial_force": "inertia",
    "thrust": "inertia",
    "mass_flow": "inertia",
    "mass": "inertia",
    "mass_kg": "inertia",
    "roll_inertia": "inertia",
}
"""The factor that also determines a deviation without its own factor. All other deviations remain in the middle."""


Measured = dict[str, float]
"""The quantities of a loop by key (`MEASURED`), empty for an unstable loop. A margin without a bound is infinite."""


@dataclass(frozen=True)
class MarginCase:
    """The quantities of a vehicle, with its label, at all operating points, (nodes,)."""

    label: str
    nodes: tuple[Measured, ...]


@dataclass(frozen=True)
class MarginStudy:
    """The margins of a design in one plane of one stage: nominal vehicle, corners, and random vehicles.

    `stage` is the name of the stage, or "" for a single stage. `random` (vehicles, nodes, SWEPT) is NaN for an unstable
    loop, and infinite for a margin without a bound. Its first row is vehicle number `first`. `exact` is the number of
    loops that `margins` itself measured. `motion` (nodes,) is that of a scheduled filter, in %.
    """

    stage: str
    plane: str
    times_s: tuple[float, ...]
    nominal: MarginCase
    corners: tuple[MarginCase, ...]
    random: Array
    first: int = 0
    exact: int = 0
    motion: tuple[float, ...] = ()

    def case(self, k: int) -> MarginCase:
        """Return the k-th random vehicle."""
        rows = [dict(zip(SWEPT, row, strict=True)) for row in self.random[k].tolist()]
        stable = ~np.isnan(self.random[k]).all(axis=-1)
        return MarginCase(f"vehicle {self.first + k}", tuple(r if s else {} for r, s in zip(rows, stable, strict=True)))


def measured(loop: Loop, slosh_peak_db: float) -> Measured:
    """Return the quantities of a loop. The result is empty for an unstable loop."""
    found = measure_loop(loop)
    return found.quantities(Convention(slosh_peak_db=slosh_peak_db)) if found.margins.stable else {}


def worst_instants(
    nodes_at: Callable[[Sequence[float]], Sequence[Node]], design: Design, times_s: Sequence[float], limits: LoopLimits
) -> list[float]:
    """Return the instants (s) between operating points of a stage at which a required margin is worst.

    An instant is included if a margin there is worse than at every operating point by more than WORSE in its unit. The
    time axis is searched in steps of INSTANTS_S[0], then with smaller steps about the worst instants. Two minima within
    the first step count as one.
    """
    if len(times_s) < 2:
        return []
    known: dict[float, Measured] = {}

    def worse(name: str, t: float) -> float:
        """Return the margin with a sign such that larger is worse, or infinity for an unstable loop."""
        value = known[t].get(name, math.nan)
        if not known[t]:
            return math.inf
        return -math.inf if math.isnan(value) else MEASURED[name].badness(value)

    def measure(wanted_s: Iterable[float]) -> None:
        missing = sorted({float(t) for t in wanted_s if first <= t <= last} - known.keys())
        for t, node in zip(missing, nodes_at(missing) if missing else (), strict=True):
            known[t] = measured(Loop(fixed_path(node), law_at(design, node)), limits.slosh_peak_db)

    asked = [name for name in MEASURED if getattr(limits, name) is not None]
    first, last = min(times_s), max(times_s)
    measure([*times_s, *np.arange(first, last, INSTANTS_S[0]).round(6)])
    for coarse, fine in itertools.pairwise(INSTANTS_S):
        worst = {max(known, key=lambda t: worse(name, t)) for name in asked}
        measure(round(t + k * fine, 6) for t in worst for k in range(1 - round(coarse / fine), round(coarse / fine)))
    out = set()
    for name in asked:
        t = max(known, key=lambda t: worse(name, t))
        if worse(name, t) > max(worse(name, at) for at in times_s) + WORSE[MEASURED[name].unit]:
            out.add(t)
    return sorted(out)


Met = tuple[FlightCondition, Trim]
"""The air and path of a flight at an operating point, with the angles of attack and sideslip."""


def conditions_of(campaign: LoadedCampaign, nodes: Sequence[Node], count: int, workers: int = 2) -> list[list[Met]]:
    """Return speed, air and attitude of dispersed flights at the operating points, (flights, nodes).

    The flights are the first `count` runs of a campaign that are under thrust at all operating points. An operating
    point is reached with the propellant that remains there in the flight as designed. An engine that burns faster thus
    reaches it earlier. The vehicle of these flights does not deviate, since the random vehicles do. Raises
    ScenarioError if no run reaches all points.
    """
    flown = campaign.base.scenario.model_copy(update={"fault": ()})
    order = sorted(range(len(nodes)), key=lambda k: nodes[k].time_s)

    def fly_one(number: int) -> list[Met] | None:
        run, out = flown_run(campaign.scenario_of(number), faults=False), dict[int, Met]()
        for k in order:
            node = nodes[k]
            try:
                at_s = at_same_propellant_s(run, flown, node)
                met = met_by(node, node_of(run.packed, flown_to(run, at_s) / 1e9, node.stage, node.plane))
                out[k] = met.condition, met.trim
            except ValueError:
                return None
        return [out[k] for k in range(len(nodes))]

    found: list[list[Met]] = []
    with ThreadPoolExecutor(max_workers=workers) as pool:
        for number in range(0, 2 * count, workers):
            found += [one for one in pool.map(fly_one, range(number, number + workers)) if one is not None]
            if len(found) >= count:
                return found[:count]
    if not found:
        problem, allowed = (
            "none of its flights is under thrust at all operating points",
            "0, or a longer campaign flight",
        )
        raise ScenarioError(campaign.name, problem, "margins.trajectories", value=count, allowed=allowed)
    return found


def vehicles(wanted: LinearMargins, node: Node, campaign: LoadedCampaign) -> tuple[list[Dispersion], list[Dispersion]]:
    """Return the corners, at which all deviations of a factor change together, and random vehicles.

    The random vehicles are runs of the campaign. The corners assume independent scores, and remain equally probable if
    some scores are correlated. `node` is an operating point of the stage. If `wanted.only` names a vehicle, only this
    one is returned, whatever the number of random vehicles.
    """
    corners, deviations = [], deviations_of(campaign, node)
    if wanted.corner_sigmas > 0.0:
        rows = [np.roll(_GENERATOR, k) for k in range(len(_GENERATOR))] + [-np.ones(len(_GENERATOR))]
        for n, row in enumerate(np.array([*rows, *[-np.asarray(r) for r in rows]], float)):
            signs = dict(zip(_FACTORS, (row * (wanted.corner_sigmas / 3.0)).tolist(), strict=True))
            scores = np.array([signs.get(_WITH.get(field, field), 0.0) for field in deviations.fields])
            corners.append(deviations.at(scores, f"corner {n + 1}"))
    found = suite.VEHICLE_LABEL.fullmatch(wanted.only)
    numbers = range(0 if wanted.only else wanted.cases)
    if found is not None and found[1] is not None:
        numbers = range(int(found[1]), int(found[1]) + 1)
    return [c for c in corners if wanted.only in ("", c.label)], deviations.drawn(numbers)


def study(
    nodes: Sequence[Node],
    design: Design,
    wanted: LinearMargins,
    campaign: LoadedCampaign,
    memory: PartsOnDisk,
    watch: Callable[[int, int], None] = lambda done, of: None,
    workers: int = 2,
    stage: str = "",
    trajectories: Sequence[Sequence[Node]] = (),
) -> MarginStudy:
    """Return the margins at all operating points of one plane and stage.

    They are those of the nominal vehicle, the corners and the random vehicles. `trajectories` are the operating points
    in other flights. Vehicle n flies along trajectory n, modulo their number. `campaign` is that of `vehicles`.
    """
    corners, drawn = vehicles(wanted, nodes[0], campaign)
    dispersed_by = stacked([*corners, *drawn])
    first = int(drawn[0].label.removeprefix("vehicle ")) if drawn else 0
    loops = 1 + len(corners) + len(drawn)

    def at_node(k: int) -> tuple[Measured, Array, int]:
        node, law = nodes[k], law_at(design, nodes[k])
        peak_db = wanted.dispersed.slosh_peak_db
        flown = [trajectory[k] for trajectory in trajectories] or [node]

        def work_out() -> tuple[Measured, Array, int]:
            nominal = measured(Loop(fixed_path(node), law), peak_db)
            dispersed = SweptVehicles(node, design, wanted.dispersed)
            table, exact = np.full((len(corners) + len(drawn), len(SWEPT)), math.nan), 0
            for j, flight in enumerate(flown):
                mine = np.arange((j - first) % len(flown), len(drawn), len(flown)) + len(corners)
                exact += dispersed.measure(flight, [drawn[i - len(corners)] for i in mine], table, mine)
            exact += dispersed.measure(node, corners, table, np.arange(len(corners)))
            return nominal, table, exact

        depends = (node, law, flown, dispersed_by, first, len(corners), told(wanted.dispersed))
        return memory.recall("margins", depends, work_out, node_name(node))

    with ThreadPoolExecutor(max_workers=workers) as pool:
        table = list(pool.map(counted(at_node, watch, loops * len(nodes), loops), range(len(nodes))))
    values = np.stack([row for _, row, _ in table], axis=1)
    every = MarginStudy(
        stage,
        nodes[0].plane,
        tuple(n.time_s for n in nodes),
        MarginCase("", tuple(row for row, _, _ in table)),
        (),
        values,
        first,
        sum(exact for _, _, exact in table),
        tuple(motion_shares([Loop(fixed_path(n), law_at(design, n)) for n in nodes], design.of_stage(nodes[0].stage))),
    )
    known = tuple(replace(every.case(k), label=c.label) for k, c in enumerate(corners))
    return replace(every, corners=known, random=values[len(corners) :])


@dataclass(frozen=True)
class SweptVehicles:
    """The margins of dispersed vehicles at an operating point.

    Vehicles with a value within `NEAR` of one of the `limits`, and those that the compiled margins do not support, are
    measured individually.
    """

    node: Node
    design: Design
    limits: LoopLimits

    @cached_property
    def _loops(self) -> ManyLoops | None:
        """Return the compiled loops, or None if each loop must be measured individually."""
        try:
            return ManyLoops(self.node, law_at(self.design, self.node))
        except NotServedError:
            return None

    def measure(self, flight: Node, every: Sequence[Dispersion], table: Array, rows: IntArray) -> int:
        """Measure vehicles in a flight, and enter the values into the given rows of a table.

        `flight` is the operating point in that flight. Returns the number of individual measurements.
        """
        if not len(rows):
            return 0
        again = np.arange(len(rows))
        if self._loops is not None:
            values, status = self._loops.measure(every, self.limits.slosh_peak_db, flight)
            values = np.array([1e3 * values["delay_s"] if key == "delay_ms" else values[key] for key in SWEPT]).T
            table[rows] = np.where((status == DONE)[:, None], values, math.nan)
            limits = np.array([getattr(self.limits, name) for name in SWEPT], float)  # nan for no limit
            again = np.flatnonzero((status == HANDED_BACK) | (np.abs(values - limits) < NEAR).any(axis=1))
        law = law_at(self.design, self.node)
        for k in again.tolist():
            found = measured(Loop(fixed_path(disperse(flight, every[k])), law), self.limits.slosh_peak_db)
            table[rows[k]] = [found.get(name, math.nan) for name in SWEPT]
        return len(again)


def margin_requirements(
    found: MarginStudy, wanted: LinearMargins, again: Callable[[str], str] = lambda label: ""
) -> list[JudgedRequirement]:
    """Return the requirements on margins.

    These are nominal limits, dispersed limits at the corners, and the share of random vehicles that meet them. `again`
    returns the command that measures the vehicle with a given label alone.
    """
    out = []
    if wanted.only in ("", AS_DESIGNED):
        everywhere = "at every operating point"
        out += _limits("margins", everywhere, AS_DESIGNED, [found.nominal], wanted.nominal, found, again)
        out += _motion(found, again(AS_DESIGNED)) if found.motion else []
    if found.corners:
        out += _limits("dispersed", "at every corner", "corners", found.corners, wanted.dispersed, found, again)
    if len(found.random) and wanted.only:
        alone = [found.case(k) for k in range(len(found.random))]
        out += _limits("dispersed", "at every operating point", wanted.only, alone, wanted.dispersed, found, again)
    elif len(found.random):
        whose = f", {found.stage}" if found.stage else ""
        failures = [found.case(k) for k in np.flatnonzero(~meet_limits(found.random, wanted.dispersed)).tolist()]
        shown = judge_failures(len(failures), len(found.random), wanted.success, wanted.confidence)
        share = (shown.success - wanted.success) / (1.0 - wanted.success)
        missed = _limits("dispersed", "", "", failures, wanted.dispersed, found, again) if failures else []
        worst = min((r for r in missed if r.judgement == suite.REJECTED), key=lambda r: r.room, default=None)
        said = f"{len(found.random) - len(failures)} of {len(found.random)}"
        if worst is not None:
            said += f"; {worst.name}: {worst.found}, required {worst.wanted}"
        out.append(
            JudgedRequirement(
                "dispersed",
                f"{RANDOM_NAME}{whose}",
                f"{100.0 * wanted.success:g} % with {100.0 * wanted.confidence:g} % confidence",
                said,
                suite.judgement_of(shown.judgement),
                share,
                worst.where if worst else "",
                shown.more,
                worst.again if worst else "",
            )
        )
    return out


def _motion(found: MarginStudy, again: str) -> list[JudgedRequirement]:
    """Return the requirement on the motion of a scheduled filter."""
    about, worst = QUANTITIES["filter_motion"], int(np.argmax(found.motion))
    value = found.motion[worst]
    return [
        JudgedRequirement(
            "margins",
            ", ".join(filter(None, (about.label, AS_DESIGNED, found.stage))),
            f"{about.sense} {MOST_MOTION:g} {about.unit}",
            f"{value:.2f} {about.unit}",
            suite.REJECTED if about.violation(value, MOST_MOTION) > 0.0 else suite.ACCEPTED,
            suite.room_left(value, MOST_MOTION, about.sense, about.unit),
            f"{found.times_s[worst]:g} s, {found.plane}",
            again=again,
        )
    ]


def _limits(
    part: str,
    at: str,
    whose: str,
    cases: Sequence[MarginCase],
    limits: LoopLimits,
    found: MarginStudy,
    again: Callable[[str], str],
) -> list[JudgedRequirement]:
    """Return the requirements of stability and of the limits on the stable loops."""
    stage = f", {found.stage}" if found.stage else ""
    places = [
        (", ".join(filter(None, (c.label, f"{t:g} s", found.plane))), n, again(c.label or AS_DESIGNED), t)
        for c in cases
        for t, n in zip(found.times_s, c.nodes, strict=True)
    ]
    bad = [(where, command) for where, n, command, _ in places if not n]
    state = ("stable", suite.ACCEPTED, math.nan, "", 0, "")
    if bad:
        state = (f"{len(bad)} of {len(places)} loops unstable", suite.REJECTED, -1.0, bad[0][0], 0, bad[0][1])
    out = [JudgedRequirement(part, f"stable {at}{stage}", "stable", *state)]
    for name, about in MEASURED.items():
        asked = getattr(limits, name)
        known = [place for place in places if asked is not None and not math.isnan(place[1].get(name, math.nan))]
        if not known:
            continue
        rows = [(n[name], float(at_time(asked, t)), where, command) for where, n, command, t in known]
        value, limit, where, command = max(rows, key=lambda r: about.violation(r[0], r[1]))
        out.append(
            JudgedRequirement(
                part,
                ", ".join(filter(None, (about.label, whose, found.stage))),
                f"{about.sense} {limit:g} {about.unit}".rstrip(),
                f"{value:.2f} {about.unit}".rstrip() if math.isfinite(value) else "free",
                suite.REJECTED if about.violation(value, limit) > 0.0 else suite.ACCEPTED,
                suite.room_left(value, limit, about.sense, about.unit),
                where,
                again=command,
            )
        )
    return out


def meet_limits(values: Array, limits: LoopLimits) -> NDArray[np.bool_]:
    """Return True for the vehicles of (vehicles, nodes, SWEPT) that are stable and meet every limit at every node."""
    met = ~np.isnan(values).all(axis=-1)
    for column, name in enumerate(SWEPT):
        limit = getattr(limits, name)
        if limit is not None:  # a quantity that does not exist cannot miss its limit
            met &= ~(MEASURED[name].violation(values[..., column], limit) > 0.0)
    return np.asarray(met.all(axis=-1))


def percentiles(values: Array, name: str, confidence: float, shares: Sequence[float]) -> Array:
    """Return the values that at most the given `shares` of all vehicles exceed, (shares, nodes).

    They hold with the given confidence. The values are order statistics (tolerance_bound) of (vehicles, nodes, SWEPT),
    or NaN for too few vehicles. An unstable loop counts as worst.
    """
    column = values[..., SWEPT.index(name)]
    allowed = [allowed_failures(len(values), 1.0 - share, confidence) for share in shares]
    largest = MEASURED[name].sense == "<="
    return np.array([[tolerance_bound(at, k, largest) for at in column.T] for k in allowed])


@dataclass(frozen=True)
class Authority:
    """The gimbal authority at a vehicle time.

    `ratio` is the gimbal angle per angle of attack in trim, and `wind_mps` the steady cross-wind that needs the full
    gimbal angle.
    """

    time_s: float
    airspeed_mps: float
    dynamic_pressure_Pa: float
    ratio: float  # |M_alpha / M_delta|
    gimbal_limit_deg: float
    wind_mps: float  # infinite if the limit is not reached at any wind


def authority(nodes: Sequence[Node], command_limits_rad: Sequence[float]) -> list[Authority]:
    """Return the authority at the operating points.

    The gimbal limit is the smaller of those of the stage's computer and actuator.
    """
    out = []
    for node in nodes:
        d = node.derivatives
        limit = min(command_limits_rad[node.stage], node.angle_limit_rad)
        ratio = abs(d.m_alpha_1ps2 / d.m_delta_1ps2)
        incidence = limit / ratio if ratio > 0.0 else math.inf
        speed, pressure = node.condition.airspeed_mps, node.condition.dynamic_pressure_Pa
        wind = speed * math.tan(incidence) if incidence < 0.5 * math.pi else math.inf
        out.append(Authority(node.time_s, speed, pressure, ratio, math.degrees(limit), wind))
    return out


def authority_requirement(found: Sequence[Authority], wind_mps: float, again: str = "") -> JudgedRequirement:
    """Return the requirement that the gimbals trim a steady cross-wind at every time."""
    worst = min(found, key=lambda a: a.wind_mps)
    judgement = suite.ACCEPTED if worst.wind_mps >= wind_mps else suite.REJECTED
    return JudgedRequirement(
        "authority",
        AUTHORITY_NAME,
        f">= {wind_mps:g} m/s",
        f"{worst.wind_mps:.1f} m/s",
        judgement,
        worst.wind_mps / wind_mps - 1.0,
        f"{worst.time_s:g} s",
        again=again,
    )
