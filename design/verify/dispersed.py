"""Linear margins of the exact sampled loop, as designed, at the corners of what is uncertain, and of random vehicles.

A dispersed vehicle deviates in the same way at every node. Corners: a two-level screening design (Plackett & Burman,
Biometrika 33, 1946) of twelve runs and their mirror images, so that every factor meets every other at either sign.
Random vehicles: independent normal deviations, three sigma as the suite says.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design import api
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop
from maxq.design.margins.measure import Margins, margins
from maxq.design.model.dispersion import NOMINAL, Dispersion, disperse
from maxq.design.model.node import Node
from maxq.design.verify.memory import Memory
from maxq.design.verify.suite import LinearMargins, MarginLimits, Spread
from maxq.design.verify.verdict import ACCEPTED, REJECTED, UNDECIDED, Judgement, Requirement
from maxq.sim.campaign.statistics import judge_failures
from maxq.sim.scenario.schema_design import Design

MEASURES = (
    "gain_up_db", "aero_gain_db", "phase_deg", "delay_ms", "slosh_phase_deg", "first_mode_phase_deg",
    "higher_modes_db",
)  # fmt: skip
TITLES = {
    "gain_up_db": ("gain margin up, all crossings", "dB", ">="),
    "aero_gain_db": ("aerodynamic gain margin", "dB", ">="),
    "phase_deg": ("phase margin, rigid body", "deg", ">="),
    "delay_ms": ("delay margin", "ms", ">="),
    "slosh_phase_deg": ("slosh: phase margin", "deg", ">="),
    "first_mode_phase_deg": ("first mode: phase margin", "deg", ">="),
    "higher_modes_db": ("modes 2 and above: peak", "dB", "<="),
}
_GENERATOR = (1, 1, -1, 1, 1, 1, -1, -1, -1, 1, -1)  # first row of the Plackett-Burman design of twelve runs
_FACTORS = (
    "bending_frequency", "bending_slope", "bending_damping", "slosh_frequency", "slosh_mass", "slosh_damping",
    "actuator_frequency", "delay_s", "normal_force", "centre_of_pressure_m", "inertia",
)  # fmt: skip


@dataclass(frozen=True)
class Measured:
    """Margins of one loop, those of `MEASURES` in their order; NaN where the loop is unstable, infinite where free."""

    stable: bool
    values: tuple[float, ...]

    def of(self, name: str) -> float:
        return self.values[MEASURES.index(name)]


@dataclass(frozen=True)
class Deviated:
    """What a vehicle deviates by; the computer's delay (s) may be shorter, too, which `Dispersion` does not know."""

    dispersion: Dispersion = NOMINAL
    delay_s: float = 0.0


@dataclass(frozen=True)
class MarginCase:
    """A vehicle at all nodes, (nodes,)."""

    vehicle: Deviated
    nodes: tuple[Measured, ...]

    @property
    def label(self) -> str:
        return self.vehicle.dispersion.label

    @property
    def stable(self) -> bool:
        return all(n.stable for n in self.nodes)


@dataclass(frozen=True)
class MarginStudy:
    """Margins of a design: as designed, at the corners, and of random vehicles; one plane."""

    plane: str
    times_s: tuple[float, ...]
    nominal: MarginCase
    corners: tuple[MarginCase, ...]
    random: tuple[MarginCase, ...]


def measured(loop: Loop, slosh_peak_db: float) -> Measured:
    """The margins of `MEASURES` of a loop."""
    found: Margins = margins(loop, resonances=loop.fixed.resonances())
    if not found.stable:
        return Measured(False, (math.nan,) * len(MEASURES))
    slosh = [x.phase_deg for x in found.lobes if x.kind == "slosh" and x.peak_db > slosh_peak_db]
    first = [x.phase_deg for x in found.lobes if x.label == "bending 1" and x.peak_db > 0.0]
    higher = [x.peak_db for x in found.lobes if x.kind == "bending" and x.label != "bending 1"]
    values = (
        found.gain_up_db.value,
        min(found.aero_gain_db.value, found.gain_down_db.value),
        found.rigid_phase_deg.value,
        1e3 * found.delay_s.value,
        min(slosh, default=math.inf),
        min(first, default=math.inf),
        max(higher, default=-math.inf),
    )
    return Measured(True, tuple(float(v) for v in values))


def vehicles(wanted: LinearMargins) -> tuple[list[Deviated], list[Deviated]]:
    """Corners and random vehicles."""
    corners = []
    if wanted.corner_sigmas > 0.0:
        rows = [np.roll(_GENERATOR, k) for k in range(len(_GENERATOR))] + [-np.ones(len(_GENERATOR))]
        for n, row in enumerate(np.array([*rows, *[-np.asarray(r) for r in rows]], float)):
            corners.append(_vehicle(wanted.three_sigma, _Corner(row * (wanted.corner_sigmas / 3.0)), f"corner {n + 1}"))
    drawn = [_vehicle(wanted.three_sigma, _Normal(wanted.seed, n), f"vehicle {n + 1}") for n in range(wanted.cases)]
    return corners, drawn


class _Corner:
    """Deviations by name; thrust goes with the last factor."""

    def __init__(self, row: Array) -> None:
        self._signs = dict(zip(_FACTORS, (float(x) for x in row), strict=True)) | {"thrust": float(row[-1])}

    def __call__(self, name: str) -> float:
        return self._signs[name]


class _Normal:
    """Normal deviates in units of three sigma, in the order in which they are asked for."""

    def __init__(self, seed: int, number: int) -> None:
        self._generator = np.random.default_rng([seed, number])

    def __call__(self, name: str) -> float:
        return float(self._generator.normal() / 3.0)


def _vehicle(spread: Spread, draw: Callable[[str], float], label: str) -> Deviated:
    """Deviations; `draw` gives each in units of three sigma."""

    def factor(name: str, size: float) -> float:
        return max(1.0 + size * draw(name), 0.05)

    by = Dispersion(
        bending_frequency=tuple(factor("bending_frequency", size) for size in spread.bending_frequency),
        bending_slope=factor("bending_slope", spread.bending_slope),
        bending_damping=factor("bending_damping", spread.bending_damping),
        slosh_frequency=factor("slosh_frequency", spread.slosh_frequency),
        slosh_mass=factor("slosh_mass", spread.slosh_mass),
        slosh_damping=factor("slosh_damping", spread.slosh_damping),
        actuator_frequency=factor("actuator_frequency", spread.actuator_frequency),
        thrust=factor("thrust", spread.thrust),
        normal_force=factor("normal_force", spread.normal_force),
        centre_of_pressure_m=spread.centre_of_pressure_m * draw("centre_of_pressure_m"),
        inertia=factor("inertia", spread.inertia),
        label=label,
    )
    return Deviated(by, spread.delay_s * draw("delay_s"))


def study(
    nodes: Sequence[Node],
    design: Design,
    wanted: LinearMargins,
    memory: Memory,
    watch: Callable[[int, int], None] = lambda done, of: None,
    workers: int = 2,
) -> MarginStudy:
    """Margins at all nodes of one plane, of the vehicle as it is, at the corners and of random ones."""
    corners, drawn = vehicles(wanted)
    every = [Deviated(), *corners, *drawn]
    done = [0]

    def at_node(node: Node) -> list[Measured]:
        flt = api.filter_of(design, node.instruments.sample_s)
        k_p, k_d = api.gains_at(design, node.time_s, node.plane)
        peak_db = wanted.dispersed.slosh_peak_db

        def work_out() -> list[Measured]:
            out = []
            for by in every:
                delay = max(by.delay_s, -node.instruments.delay_s)
                weak = _delayed(disperse(node, by.dispersion), delay)
                out.append(measured(Loop(fixed_path(weak), k_p, k_d, flt), peak_db))
                done[0] += 1
                if done[0] % 50 == 0:
                    watch(done[0], len(every) * len(nodes))
            return out

        return memory.recall("margins", (node, k_p, k_d, flt, every, peak_db), work_out)

    with ThreadPoolExecutor(max_workers=workers) as pool:
        table = list(pool.map(at_node, nodes))
    cases = [MarginCase(by, tuple(row[k] for row in table)) for k, by in enumerate(every)]
    first = 1 + len(corners)
    return MarginStudy(
        nodes[0].plane, tuple(n.time_s for n in nodes), cases[0], tuple(cases[1:first]), tuple(cases[first:])
    )


def _delayed(node: Node, delay_s: float) -> Node:
    """With the computer's delay longer, or shorter."""
    timing = dataclasses.replace(node.instruments, delay_s=node.instruments.delay_s + delay_s)
    return dataclasses.replace(node, instruments=timing)


def margin_requirements(found: MarginStudy, wanted: LinearMargins) -> list[Requirement]:
    """Nominal limits, dispersed limits at the corners, and the share of random vehicles that keep them."""
    out = [_stable("margins", "stable at every node", [found.nominal], found)]
    out += _limits("margins", "as designed", [found.nominal], wanted.nominal, found)
    if found.corners:
        out.append(_stable("dispersed", "stable at every corner", found.corners, found))
        out += _limits("dispersed", "corners", found.corners, wanted.dispersed, found)
    if found.random:
        out.append(_share(found, wanted))
    return out


def _stable(part: str, name: str, cases: Iterable[MarginCase], found: MarginStudy) -> Requirement:
    bad = [(c, t) for c in cases for t, n in zip(found.times_s, c.nodes, strict=True) if not n.stable]
    where = f"{bad[0][0].label + ', ' if bad[0][0].label else ''}{bad[0][1]:g} s, {found.plane}" if bad else ""
    text = "stable" if not bad else f"{len(bad)} unstable"
    return Requirement(
        part, name, "stable", text, REJECTED if bad else ACCEPTED, math.nan if not bad else -1.0, where
    )  # fmt: skip


def _limits(
    part: str, whose: str, cases: Sequence[MarginCase], limits: MarginLimits, found: MarginStudy
) -> list[Requirement]:  # fmt: skip
    out = []
    for name in MEASURES:
        limit = getattr(limits, name)
        if limit is None:
            continue
        title, unit, sense = TITLES[name]
        rows = [(n.of(name), c.label, t) for c in cases for t, n in zip(found.times_s, c.nodes, strict=True)]
        rows = [r for r in rows if not math.isnan(r[0])]  # of an unstable one that it is unstable has been said
        if not rows:
            continue
        values: Array = np.array([r[0] for r in rows])
        k = int(np.argmin(values if sense == ">=" else -values))
        value = float(values[k])
        met = value >= limit if sense == ">=" else value <= limit
        room = (value - limit) / abs(limit) if sense == ">=" else (limit - value) / abs(limit)
        where = f"{rows[k][1] + ', ' if rows[k][1] else ''}{rows[k][2]:g} s, {found.plane}"
        text = f"{value:.2f} {unit}" if math.isfinite(value) else "free"
        out.append(
            Requirement(
                part, f"{title}, {whose}", f"{sense} {limit:g} {unit}", text, ACCEPTED if met else REJECTED,
                room, where,
            )
        )  # fmt: skip
    return out


def keeps(case: MarginCase, limits: MarginLimits) -> bool:
    """Whether a vehicle keeps every limit at every node."""
    for name in MEASURES:
        limit = getattr(limits, name)
        if limit is None:
            continue
        for node in case.nodes:
            value = node.of(name)
            if not (value >= limit if TITLES[name][2] == ">=" else value <= limit):
                return False
    return case.stable


def _share(found: MarginStudy, wanted: LinearMargins) -> Requirement:
    failures = [c.label for c in found.random if not keeps(c, wanted.dispersed)]
    shown = judge_failures(len(failures), len(found.random), wanted.success, wanted.confidence)
    words: dict[str, Judgement] = {"met": ACCEPTED, "not met": REJECTED}
    return Requirement(
        "dispersed",
        "random vehicles keep the dispersed limits",
        f"{100.0 * wanted.success:g} % with {100.0 * wanted.confidence:g} % confidence",
        f"{len(found.random) - len(failures)} of {len(found.random)}",
        words.get(shown.judgement, UNDECIDED),
        (shown.success - wanted.success) / (1.0 - wanted.success),
        failures[0] if failures else "",
        shown.more,
    )
