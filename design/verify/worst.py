"""The worst vehicle within the dispersions: a search at each operating point for the least distance of L from -1.

Each draw of the campaign that changes the vehicle deviates independently, within an ellipsoid or a box. In an
ellipsoid, all deviations together are no less likely than a single one at the given number of sigma. In a box, each
deviation extends to this number. The coordinates are the independent scores of the deviations (`deviations.py`), in
which a uniform draw remains within its bounds.

From each start, the search follows the gradient to the point of that region with the least linearised distance. It
moves back towards the start until the distance has decreased, and repeats (Frank & Wolfe, Nav. Res. Logist. Q. 3,
1956). In a box, it continues to a corner that no single deviation makes worse. The gradient is that of L at the
frequency nearest to -1, by finite differences of the vehicle's continuous response, without closing the loop. A local
descent on measured distances, inside the region and along its surface (descent.py), begins at the best point of an
operating point. Trials are measured together (margins/dispersed.py). An unstable loop counts as beyond -1 by its
distance.

At every operating point, one search starts at the nominal vehicle. The `FURTHER` points with the worst results have all
other starts too. The worst vehicles are then measured at instants between the operating points and along dispersed
trajectories, and the descent is repeated where they are worst. The search gives no lower bound. It shows only that this
number of searches found no worse vehicle.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.laws.law import DRIFTS, MEASUREMENTS
from maxq.design.laws.navigated import navigated
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop, law_at
from maxq.design.margins.crossings import growing_count
from maxq.design.margins.curve import lowest_hz_of
from maxq.design.margins.dispersed import ManyLoops, NotServedError
from maxq.design.margins.many import DONE, HANDED_BACK
from maxq.design.margins.measure import margins
from maxq.design.model.deviations import deviations_of
from maxq.design.model.dispersion import deviated, disperse_instruments, stacked
from maxq.design.model.instruments import per_command
from maxq.design.model.node import Node, disperse, with_drives_apart
from maxq.design.model.state_space import ComplexArray
from maxq.design.optimise.descent import Region, descend, to_corner
from maxq.design.verify.memory import counted
from maxq.design.verify.named_mu import stable_together, stable_within
from maxq.design.verify.suite import ACCEPTED, REJECTED, JudgedRequirement, WorstWanted, room_left
from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_design import Design

_LOWEST_HZ, _HIGHEST_HZ, _GRID = 1e-3, 1e3, 200  # the second for a continuous loop
_AROUND = np.array(
    [-8.0, -4.0, -2.0, -1.2, -0.6, -0.2, 0.2, 0.6, 1.2, 2.0, 4.0, 8.0]
)  # points about a resonance, in half widths
_MINIMA, _GOALS = 8, 2  # minima over frequency that are refined, and number of goals per step
FURTHER = 6  # operating points of a plane and stage with searches from all starts
INSTANTS_S, _MOST_INSTANTS = (0.5, 0.05), 300
"""The steps between instants, along the stage and about its worst instant, and the largest number of instants."""
_STEP = 1e-4  # step of the gradient relative to the region; at a fixed frequency, a mode must not move by its width
_ROUNDS = 12
_SHARES = (1.0, 0.5, 0.25, 0.1, 0.03)


@dataclass(frozen=True)
class WorstVehicle:
    """The worst vehicle found in a plane of a stage, with its deviations and the outcome of its flight.

    `sigmas` are the scores of its deviations by name. `modulus` is its least |1 + L|, or 0 if it is unstable.
    `searches` is the number over all operating points. `text` is its scenario (TOML).
    """

    stage: str
    plane: str
    time_s: float
    sigmas: dict[str, float]
    modulus: float
    searches: int
    loops: int
    flown: str = ""
    kept_control: bool = True
    text: str = ""
    within_sigmas: float = (
        math.nan
    )  # bound of each deviation at that node up to which no vehicle is unstable (named_mu.py)
    within_hz: float = math.nan
    within_tried: int = 0  # number of frequencies
    together_sigmas: float = math.nan  # the same bound for pitch, yaw and roll together
    trajectory: int = 0  # number of the dispersed flight for speed and air, or 0 for the flight as designed

    @property
    def label(self) -> str:
        """Return the operating point and the largest deviations as text."""
        largest = sorted(self.sigmas.items(), key=lambda item: -abs(item[1]))[:5]
        words = [f"{name} {value:+.1f}" for name, value in largest]
        along = f", trajectory {self.trajectory}" if self.trajectory else ""
        return f"{self.time_s:g} s, {self.plane}{along}; sigmas: {', '.join(words)}, ..."


Looks = list[tuple[float, Array]]


def distances(node: Node, design: Design, campaign: LoadedCampaign) -> Callable[[Sequence[Array]], Looks]:
    """Return a function of scores (places,), in units of 3 sigma, that measures loops.

    It returns the distance of each loop from -1 and the frequencies (Hz) of its minima, the least first. The distance
    of an unstable loop is negative.
    """
    one, deviations = distance(node, design, campaign), deviations_of(campaign, node)
    try:
        loops = ManyLoops(node, law_at(design, node))
    except NotServedError:
        return lambda every: [one(u) for u in every]

    def at(every: Sequence[Array]) -> Looks:
        values, status = loops.measure(deviations.of_scores(every), 0.0, distances=True)
        near, hz = values["distance"], values["distance_hz"]
        out = list[tuple[float, Array]]()
        for u, at_hz, least, verdict in zip(every, hz, near[:, 0], status, strict=True):
            sign = 1.0 if verdict == DONE else -1.0
            out.append(one(u) if verdict == HANDED_BACK else (sign * float(least), at_hz[np.isfinite(at_hz)]))
        return out

    return at


def distance(node: Node, design: Design, campaign: LoadedCampaign) -> Callable[[Array], tuple[float, Array]]:
    """Return the function for one loop that corresponds to `distances`, with an individual measurement."""
    deviations, law = deviations_of(campaign, node), law_at(design, node)

    return lambda u: least_distance(Loop(fixed_path(disperse(node, deviations.at(u))), law))


def least_distance(loop: Loop) -> tuple[float, Array]:
    """Return the distance of a loop from -1 and the frequencies (Hz) of its minima, the least first.

    The distance of an unstable loop is negative. A grid about each resonance is refined at the deepest minima.
    """
    end = min(loop.highest_hz, _HIGHEST_HZ)
    hz = [np.geomspace(_LOWEST_HZ, end, _GRID)]
    hz += [r.frequency_hz + max(r.half_width_hz, 1e-3) * _AROUND for r in loop.fixed.resonances()]
    grid = np.unique(np.clip(np.concatenate(hz), _LOWEST_HZ, end))
    near = np.abs(1.0 + loop.response(grid))
    low = near <= np.minimum(np.append(near[1:], np.inf), np.append(np.inf, near[:-1]))
    deepest = np.flatnonzero(low)[np.argsort(near[low])[:_MINIMA]]
    before, after = grid[np.maximum(deepest - 1, 0)], grid[np.minimum(deepest + 1, len(grid) - 1)]
    fine = np.concatenate([grid[deepest][None], np.linspace(before, after, 21)])
    near = np.abs(1.0 + loop.response(fine))
    k, each = near.argmin(axis=0), np.arange(len(deepest))
    order = np.argsort(near[k, each])
    least = float(near[k, each][order[0]])
    drift_radps = 2.0 * np.pi * lowest_hz_of(np.asarray(loop.open_poles()))  # slower poles are drift, not unstable
    return -least if growing_count(loop.closed_poles(), drift_radps) else least, fine[k, each][order]


def slope(node: Node, design: Design, campaign: LoadedCampaign) -> Callable[[Array, Array, Array], tuple[Array, Array]]:
    """Return a function for |1 + L| at frequencies (Hz) and its derivatives with respect to scores.

    The derivatives have the shape (frequencies, places). The derivatives are finite differences with `steps` (places,).
    L changes with actuator, vehicle and delay, separately for each sensor. The effect of sampling changes little and is
    held constant; the search measures the loop at its end points.
    """
    deviations, law, node = deviations_of(campaign, node), law_at(design, node), with_drives_apart(node)
    if any(name in DRIFTS for name in law.inputs):
        node = node.held_still()
        law = navigated(law, node.axial_load_mps2, node.instruments.sample_s)
    plant, ideal = node.plant, bool(node.actuator.ideal)
    inputs = tuple(x for x in plant.inputs if not ideal or x.startswith("delta_rad"))
    columns = [plant.inputs.index(x) for x in inputs]
    seen = ["local_rate_radps" if name in MEASUREMENTS else name for name in law.inputs]
    rows = [plant.outputs.index(name) for name in seen]

    def paths(every: Sequence[Array], s: ComplexArray) -> ComplexArray:
        """Return the response from the command to each input of the law, (vehicles, frequencies, inputs)."""
        vehicles = deviations.of_scores(every)
        held = deviated(node.held, node.plane, stacked(vehicles), len(vehicles))
        a, b, c, d, _ = held.plants(node.condition, node.trim, node.plane, node.drives, in_place=True)
        turning = s[:, None, None] * np.eye(a.shape[-1]) - a[:, None]
        response = c[:, None, rows] @ np.linalg.solve(turning, b[:, None][..., columns])
        response = response + d[:, None][:, :, rows][..., columns]
        out = []
        for vehicle, mine in zip(vehicles, response, strict=True):
            there = disperse_instruments(node.instruments, vehicle)
            out.append(per_command(s[:, None], mine, inputs, there.actuators) * np.exp(-s * there.delay_s)[:, None])
        return np.array(out)

    def at(u: Array, hz: Array, steps: Array) -> tuple[Array, Array]:
        s = np.asarray(2j * np.pi * hz, np.complex128)
        loop = Loop(fixed_path(disperse(node, deviations.at(u))), law)
        fixed, by_law = loop.fixed, law.response(hz) * loop.fixed.response(hz)[:, None]
        here = np.stack([by_law[:, i] * fixed.ratio(name, hz) for i, name in enumerate(law.inputs)], axis=-1)
        first, *moved = paths([u, *(u + step * unit for step, unit in zip(steps, np.eye(len(u)), strict=True))], s)
        near = np.array([np.abs(1.0 + (here * (path / first)).sum(axis=1)) for path in moved]).T
        now = np.abs(1.0 + here.sum(axis=1))
        return now, (near - now[:, None]) / steps

    return at


def search_node(
    node: Node, design: Design, campaign: LoadedCampaign, wanted: WorstWanted, starts: Sequence[int] | None = None
) -> tuple[float, Array, int]:
    """Return the least distance found at an operating point, its scores in units of 3 sigma, and the number of loops.

    `starts` are the numbers of the starts, with 0 for the nominal vehicle. The default is all starts. A local descent
    begins at the best point.
    """
    region, count = Region(wanted.region, wanted.sigmas / 3.0), len(deviations_of(campaign, node).places)
    look = _Look(distances(node, design, campaign))
    change = slope(node, design, campaign)

    best, worst_u = math.inf, np.zeros(count)
    for start in range(wanted.starts) if starts is None else starts:
        rng = np.random.default_rng([wanted.seed, round(1e3 * node.time_s), start])
        u = np.zeros(count) if start == 0 else region.farthest(rng.normal(size=count)) * rng.uniform(0.3, 1.0)
        ((value, hz),) = look([u])
        for _ in range(_ROUNDS):
            steps = np.where(u > 0.0, -_STEP, _STEP) * region.reach
            near, slopes = change(u, hz, steps)
            # moves an unstable loop further beyond -1, and a stable one towards the minima with the least prediction
            goals = [region.farthest(-by) for by in slopes] if value > 0.0 else [region.farthest(slopes[0])]
            promised = [at + by @ (goal - u) for at, by, goal in zip(near, slopes, goals, strict=False)]
            likely = [goals[k] for k in np.argsort(promised)[:_GOALS]]
            trials = [_towards(u, goal, share, region) for goal in likely for share in _SHARES]
            found = look(trials)
            k = int(np.argmin([distance for distance, _ in found]))
            if found[k][0] > value - 1e-4:
                break
            u, (value, hz) = trials[k], found[k]
        if wanted.region == "box":
            u, value = to_corner(look.values, u, region)
        if value < best:
            best, worst_u = value, u
    worst_u, best = descend(look.values, worst_u, best, region)
    return best, worst_u, look.loops


def refine_at(
    node: Node, design: Design, campaign: LoadedCampaign, wanted: WorstWanted, points: Sequence[Array]
) -> tuple[float, Array, int]:
    """Return the result of `search_node` for a descent from the worst of `points`, with scores in units of 3 sigma."""
    look = _Look(distances(node, design, campaign))
    values = look.values(points)
    k = int(np.argmin(values))
    u, best = descend(look.values, points[k], values[k], Region(wanted.region, wanted.sigmas / 3.0))
    return best, u, look.loops


@dataclass
class _Look:
    """The measurement of distances, with a count of the loops."""

    measure: Callable[[Sequence[Array]], Looks]
    loops: int = 0

    def __call__(self, every: Sequence[Array]) -> Looks:
        self.loops += len(every)
        return self.measure(every)

    def values(self, every: Sequence[Array]) -> list[float]:
        return [value for value, _ in self(every)]


def _towards(u: Array, goal: Array, share: float, region: Region) -> Array:
    """Return the point at a fraction of the way to a goal, moved to the surface of an ellipsoidal region.

    The worst point is rarely inside an ellipsoid.
    """
    there = u + share * (goal - u)
    return there if region.shape == "box" else region.farthest(there)


def search_plane(
    nodes: Sequence[Node],
    design: Design,
    campaign: LoadedCampaign,
    wanted: WorstWanted,
    base: LoadedScenario,
    stage: str = "",
    watch: Callable[[int, int], None] = lambda done, of: None,
    workers: int = 2,
    nodes_at: Callable[[Sequence[float]], Sequence[Node]] | None = None,
    trajectories: Sequence[Sequence[Node]] = (),
) -> WorstVehicle:
    """Return the worst vehicle over the operating points of a plane and stage, measured exactly and flown.

    `nodes_at` returns operating points at instants between those given, for a search between them. `trajectories` are
    the operating points in other flights, (flights, nodes).
    """
    further = min(FURTHER, len(nodes)) if wanted.starts > 1 else 0

    def search(node: Node, starts: Sequence[int]) -> tuple[float, Array, int]:
        return search_node(node, design, campaign, wanted, starts)

    one = counted(search, watch, len(nodes) + further)
    with ThreadPoolExecutor(max_workers=workers) as pool:
        results = list(pool.map(one, nodes, itertools.repeat([0])))
        at = [*nodes, *(nodes[k] for k in np.argsort([value for value, _, _ in results])[:further])]
        results += pool.map(one, at[len(nodes) :], itertools.repeat(range(1, wanted.starts)))
    searched, loops = [*zip(at, results, strict=True)], sum(n for _, _, n in results)
    searches, flight_of = len(nodes) + further * (wanted.starts - 1), dict[int, int]()
    if nodes_at is not None and len(nodes) > 1:
        in_burns = (list(mine) for _, mine in itertools.groupby(nodes, lambda node: node.stage_start_s))
        burns = [(mine[0].time_s, mine[-1].time_s) for mine in in_burns]
        for step_s in INSTANTS_S:
            if step_s < max(INSTANTS_S):
                best_s = min(searched, key=lambda each: each[1][0])[0].time_s
                a, b = best_s - max(INSTANTS_S), best_s + max(INSTANTS_S)
                burns = [(max(begin, a), min(end, b)) for begin, end in burns if begin <= best_s <= end]
            known_s, instants = {node.time_s for node, _ in searched}, list[float]()
            for begin, end in burns:
                step = max(step_s, (end - begin) / _MOST_INSTANTS)
                instants += np.arange(begin, end, step).round(6).tolist() if end > begin else []
            found, count = _refined_beside(
                nodes_at([t for t in instants if t not in known_s]), searched, design, campaign, wanted, workers
            )
            searched, loops, searches = [*searched, *found], loops + count, searches + len(found)
    for number, flown in enumerate(trajectories, 1):
        found, count = _refined_beside(flown, searched, design, campaign, wanted, workers, 1)
        searched, loops, searches = [*searched, *found], loops + count, searches + len(found)
        flight_of |= {id(node): number for node, _ in found}
    node, (_, u, _) = min(searched, key=lambda each: each[1][0])
    number = flight_of.get(id(node), 0)
    sigmas = dict(zip(deviations_of(campaign, node).places, (3.0 * u).tolist(), strict=True))
    return measure_worst(node, design, campaign, wanted, base, stage, sigmas, (searches, loops), number)


def measure_worst(
    node: Node,
    design: Design,
    campaign: LoadedCampaign,
    wanted: WorstWanted,
    base: LoadedScenario,
    stage: str,
    sigmas: Mapping[str, float],
    counts: tuple[int, int],
    trajectory: int,
) -> WorstVehicle:
    """Measure a vehicle exactly at an operating point, and fly it.

    `sigmas` are the scores of its deviations by name. `counts` are the numbers of searches and loops that found it.
    """
    deviations, u = deviations_of(campaign, node), np.array(list(sigmas.values())) / 3.0
    loop = Loop(fixed_path(disperse(node, deviations.at(u, "worst"))), law_at(design, node))
    exact = margins(loop, resonances=loop.fixed.resonances())
    scenario = deviations.scenario(base, u)
    lost = fly(scenario, log=False).failures
    within = stable_within(node, design, campaign) if wanted.bound else None
    together = stable_together(base, design, node, campaign) if wanted.together else None
    return WorstVehicle(
        stage,
        node.plane,
        node.time_s,
        dict(sigmas),
        exact.modulus if exact.stable else 0.0,
        counts[0],
        counts[1],
        "; ".join(lost) or "control kept",
        not lost,
        scenario.as_flown,
        *((within.sigmas, within.at_hz, within.tried) if within is not None else (math.nan, math.nan, 0)),
        together.sigmas if together is not None else math.nan,
        trajectory,
    )


Searched = tuple[Node, tuple[float, Array, int]]


def _refined_beside(
    nodes: Sequence[Node],
    searched: Sequence[Searched],
    design: Design,
    campaign: LoadedCampaign,
    wanted: WorstWanted,
    workers: int,
    most: int = FURTHER,
) -> tuple[list[Searched], int]:
    """Return descents at the `most` operating points where the known worst vehicles have the least distances.

    The number of loops is returned too. At each operating point, the known worst vehicles are those of the two searched
    points nearest in time, and the worst of all.
    """
    worst_u = min(searched, key=lambda each: each[1][0])[1][1]

    def points(node: Node) -> list[Array]:
        near = sorted(searched, key=lambda each: abs(each[0].time_s - node.time_s))[:2]
        return [*(u for _, (_, u, _) in near), worst_u]

    def value(node: Node) -> float:
        return min(value for value, _ in distances(node, design, campaign)(points(node)))

    def refine(node: Node) -> Searched:
        return node, refine_at(node, design, campaign, wanted, points(node))

    with ThreadPoolExecutor(max_workers=workers) as pool:
        order = np.argsort(list(pool.map(value, nodes)), kind="stable")[:most]
        found = list(pool.map(refine, [nodes[k] for k in order]))
    return found, 3 * len(nodes) + sum(count for _, (_, _, count) in found)


def modulus_name(wanted: WorstWanted) -> str:
    """Return the name of the requirement on the worst vehicle, without plane and stage."""
    return f"least |1 + L| within {wanted.sigmas:g} sigma"


def worst_requirements(found: WorstVehicle, wanted: WorstWanted, again: str) -> list[JudgedRequirement]:
    """Return the requirements on the distance of the worst vehicle, if it is limited, and on its control in flight."""
    whose = ", ".join(filter(None, (found.plane, found.stage)))
    said = f"{found.modulus:.3f}" if found.modulus else "unstable"
    said += f"; no worse vehicle found in {found.searches} searches ({found.loops} loops)"
    if found.within_tried:
        said += f"; mu, to first order: none unstable within {found.within_sigmas:.2g} sigma each "
        said += f"({found.within_tried} frequencies, {found.within_hz:.3g} Hz)"
    if not math.isnan(found.together_sigmas):
        said += f"; pitch, yaw and roll together within {found.together_sigmas:.2g} sigma each"
    bounds = [found.within_sigmas] * bool(found.within_tried) + [found.together_sigmas]
    if any(bound < wanted.sigmas for bound in bounds):
        said += f"; a bound below {wanted.sigmas:g} sigma proves nothing at {wanted.sigmas:g} sigma"
    rows = [(f"that vehicle flown, {whose}", "control kept", found.flown, found.kept_control, math.nan)]
    if wanted.modulus is not None:
        met, room = found.modulus >= wanted.modulus, room_left(found.modulus, wanted.modulus, ">=")
        name = f"{modulus_name(wanted)}, {whose}"
        rows.insert(0, (name, f">= {wanted.modulus:g}", said, met, room))
    return [
        JudgedRequirement("worst", name, asked, text, ACCEPTED if met else REJECTED, room, found.label, again=again)
        for name, asked, text, met, room in rows
    ]
