"""The results that `simdesign` prints and writes: limits, margins and lobes; for a case also gains, filter and
search.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.structures import OWN
from maxq.design.loop.fixed_path import LoopKind
from maxq.design.margins.lobes import Lobe
from maxq.design.margins.measure import Margins
from maxq.design.margins.multiloop import MultiloopMargins
from maxq.design.model.instruments import Plane
from maxq.design.model.powered import loss_text
from maxq.design.operating_points import PlantKind
from maxq.design.quantities import RigidBody
from maxq.design.verify.judging import Check, JudgedLoop
from maxq.design.verify.names import stage_name
from maxq.design.verify.uncovered import Uncovered
from maxq.sim.files import write_whole
from maxq.sim.packing.computer import bending_filter
from maxq.sim.run.flight import Event
from maxq.sim.run.quantities import number_text
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_vehicle import Vehicle
from maxq.tools.cli.terminal import aligned, printable

if TYPE_CHECKING:
    from maxq.design.optimise.solution import Solution
    from maxq.design.verify.dispersed_limits import WorstOfBasis
    from maxq.design.verify.outcome import DesignOutcome
    from maxq.design.verify.own_flight import CaseDesign


class GainHeads(dict[str, str]):
    """The headings of the columns of a gain table. That of a variable of the law `own` is its name."""

    def __missing__(self, name: str) -> str:
        return name.removeprefix(OWN)


GAIN_HEADS = GainHeads(
    {
        "time_s": "time, s",
        "speed_mps": "speed, m/s",
        "mass_kg": "mass, kg",
        "dynamic_pressure_Pa": "q, Pa",
        "k_p": "k_p",
        "k_d_s": "k_d, s",
        "k_i_ps": "k_i, 1/s",
        "k_a_s2pm": "k_a, s2/m",
        "k_alpha": "k_alpha",
        "percussion_m": "percussion, m",
        "accel_per_incidence_mps2": "per angle of attack, m/s2",
        "k_zd_radspm": "k_zd, rad s/m",
        "k_z_radpm": "k_z, rad/m",
    }
)
DRIFT_GAINS = ("k_zd_radspm", "k_z_radpm")  # orders of magnitude smaller than the other gains
MET, MISSED = "met", "MISSED"
SENSITIVITIES = "Change of the worst values for +1 % of a frequency or gain, or +0.01 of a damping ratio or weight"
MOST_SENSITIVE = 3  # variables of a quantity in a table
KINDS = {"sampled": "sampled, as it flies", "pade": "the paper's Pade approximants", "exact": "without aliasing"}
_PARTS = {"rigid body": "rigid", "aerodynamics": "aero", "engine inertia": "engine"}


@dataclass(frozen=True)
class AnalysisOrder:
    """The options of `simdesign analyse` and `simdesign errata`. The latter has no kind, axis or page."""

    design: str = "ksr3-default"
    scenario: str = "nominal"
    vehicle: str | None = None
    times_s: tuple[float, ...] = ()
    every_s: float = 5.0
    kind: LoopKind = "sampled"
    axis: Plane = "pitch"
    errata: str = "corrected"
    plant: PlantKind = "flown"
    faults: bool = False
    given: tuple[str, ...] = ()  # names of the options that the user gave
    out: str | None = None
    page: bool = True
    plots: bool = False  # also draw pictures of every operating point
    points: str | None = None  # file of published derivatives instead of a scenario


@dataclass(frozen=True)
class Group:
    """The results of a stage. `stage` is its name for texts, "" for a single stage.

    `found` are the checks of its limits, `together` and `coupled` the margins of all axes together and their checks.
    `worst` and `dispersed` are the worst dispersed vehicles found and the checks of the limits on them.
    """

    stage: str
    judged: Sequence[JudgedLoop]
    found: Sequence[Check]
    together: Sequence[MultiloopMargins]
    coupled: Sequence[Check]
    worst: WorstOfBasis | None
    dispersed: Sequence[Check]

    @property
    def checks(self) -> list[Check]:
        return [*self.found, *self.coupled, *self.dispersed]


def analysis_report(
    name: str, order: AnalysisOrder, design: Design, groups: Sequence[Group], judged_by: str, loss: Event | None = None
) -> str:
    """Return the report of `simdesign analyse`.

    `judged_by` is the text of `judged_by_text`. `loss` is the event by which the design's flight is lost.
    """
    way = "at" if order.points is not None else "along"
    where = f"{way} {order.scenario}, {order.axis}; loop opened at the gimbal command; {KINDS[order.kind]}"
    if order.errata != "corrected" or order.plant != "flown":
        where += f"; errata: {order.errata}; plant: {order.plant}"
    parts: list[Sequence[str]] = [
        [printable(f"{name}: {design.name}" if design.name not in ("", name) else name), where, judged_by]
    ]
    if loss is not None:
        parts[0] = [*parts[0], f"the flight is lost: {loss_text(loss)}; no operating point is after that"]
    for group in groups:
        judged, found = group.judged, group.found
        parts += [
            [f"--- {group.stage}"] if group.stage else [],
            limits_table([*found, *group.coupled]),
            limits_table(group.dispersed, f"limits of dispersed vehicles: {group.worst.text}") if group.worst else [],
            margins_table(judged),
            lobes_table(judged),
            budget_table(judged, "phase margin", "phase_deg"),
            budget_table(judged, "upper gain margin", "gain_db"),
            multiloop_table(group.together),
            nodes_table(found, judged) if len(found) > 1 else [],
        ]
    return _joined(*parts)


def analysis_verdict(groups: Sequence[Group], loss: Event | None = None) -> str:
    """Return the last line. A design whose own flight is lost has failed, whatever its margins before the loss."""
    words = {
        "unstable_poles": "unstable", "coupled_unstable": "unstable with all axes",
        "dispersed_unstable_poles": "a dispersed vehicle is unstable",
    }  # fmt: skip  # a table
    missed = [] if loss is None else [loss_text(loss)]
    missed += [
        (f"{group.stage}: " if group.stage else "") + words.get(c.key, f"{c.text} missed")
        for group in groups
        for c in group.checks
        if not c.passed
    ]
    if missed:
        return "FAILED: " + ", ".join(missed)
    asked = sum(c.key not in words for group in groups for c in group.checks)
    return f"PASSED: stable{f', all {asked} limits met' if asked else '; the design states no limits'}"


def case_report(outcome: DesignOutcome, solution: Solution) -> str:
    """Return the report of `simdesign CASE`."""
    from maxq.tools.design.way_out import way_out_table  # noqa: PLC0415  # lazy, as below: an analysis has no search

    loaded, case = outcome.loaded, outcome.loaded.case
    design = outcome.design.of_stage(outcome.judged[0].node.stage)
    where = f"along {case.scenario}" if case.points is None else f"at the points of {case.points}"
    head = [
        printable(f"{loaded.name}: {case.description}" if case.description else loaded.name),
        f"{case.filter.structure}, {case.gains.schedule} gains; {where}, {case.plane}; "
        f"{KINDS[case.loop]}; errata: {case.errata}; plant: {case.plant}",
    ]
    off, flown = outcome.dispersed_found, outcome.flown_found
    return _joined(
        head,
        limits_table([*outcome.found, *outcome.coupled_found]),
        limits_table(off, f"limits of {len(off[0].values)} dispersed plants") if off else [],
        limits_table(flown, "the same design as it flies (sampled)") if outcome.flies_otherwise else [],
        way_out_table(solution),
        design_table(design),
        search_table(solution),
        sensitivity_table(solution),
        wind_table(outcome),
        margins_table(outcome.judged),
        lobes_table(outcome.judged),
        nodes_table(outcome.found, outcome.judged),
    )


def _joined(*parts: Sequence[str]) -> str:
    return "\n\n".join("\n".join(part) for part in parts if part)


def comments(made: CaseDesign) -> list[str]:
    """Return the lines at the head of the design file: the case that made it, and the limits that it misses."""
    from maxq.tools.design.way_out import way_out_comments  # noqa: PLC0415

    lines = []
    for outcome, solution in made.results:
        case = outcome.loaded.case
        state = "INFEASIBLE: the best effort misses limits of the case:"
        if outcome.feasible and solution.feasible:
            state = f"{solution.met[0].upper()}{solution.met[1:]}."
        form = f"{case.filter.structure}, {case.gains.schedule} gains"
        head = f"Written by simdesign for the case {outcome.loaded.name} ({form})."
        lines += [head, *([] if made.interrupted else [state]), *(f"  {line}" for line in outcome.missed)]
        lines += [f"  {line}" for line in way_out_comments(solution)]
    if made.interrupted:
        lines.append(f"INTERRUPTED: the best so far; {made.claim}.")
    elif made.loss is not None:
        lines.append(f"LOST: the flight of this design is lost ({loss_text(made.loss)}); {made.claim}.")
    vehicle = made.results[0][0].loaded.scenario.vehicle
    return [*lines, *(f"not covered: {line}" for line in uncovered_lines(vehicle, made.uncovered))]


def uncovered_lines(vehicle: Vehicle, found: Sequence[Uncovered]) -> list[str]:
    """Return a line for each interval of a design's flight without operating points, with the name of the stage."""
    names = [stage_name(vehicle, one.stage) for one in found]
    return [f"{f'{name}, ' if name else ''}{one.text}" for name, one in zip(names, found, strict=True)]


def uncovered_table(vehicle: Vehicle, found: Sequence[Uncovered]) -> list[str]:
    """Return the lines of `uncovered_lines` below a title, or none without such intervals."""
    return ["not covered by operating points", *(f"  {line}" for line in uncovered_lines(vehicle, found))] * bool(found)


def uncovered_record(found: Sequence[Uncovered]) -> list[dict[str, Any]]:
    """Return the intervals without operating points for JSON, with stages numbered from 1."""
    return [asdict(one) | {"stage": one.stage + 1} for one in found]


# Tables


def limits_table(checks: Sequence[Check], title: str = "limits") -> list[str]:
    """Return a row for each limit, with its worst value and the place."""
    rows = [("requirement", "outcome", "limit", "value", "at")]
    for check in checks:
        k, unit = check.worst, f" {check.unit}" if check.unit else ""
        at = f"{check.time_s[k]:g} s" if math.isfinite(check.time_s[k]) else "filter"
        digits = 4 if check.passed else 7  # after rounding, a miss may look like the limit
        value = float(check.values[k])
        worst = "-" if math.isinf(value) else number_text(value, digits) + unit  # infinite: no quantity there
        limit = f"{check.sense} {check.wanted:g}{unit}"
        rows.append((check.text, MET if check.passed else MISSED, limit, worst, at))
    return [title, *aligned(rows, "  ", right=(3, 4))]


def nodes_table(checks: Sequence[Check], judged: Sequence[JudgedLoop]) -> list[str]:
    """Return a table with a row for each operating point and a column for each limit.

    A value that misses its limit is marked by !, and its row by FAIL.
    """
    shown = [check for check in checks if math.isfinite(check.time_s[0]) and check.key != "unstable_poles"]
    stable = next((check for check in checks if check.key == "unstable_poles"), None)
    rows = [
        ("time, s", "", "loop", *(f"{c.heading} " for c in shown)),
        ("", "", "", *(_bound(check) for check in shown)),
    ]
    for n, j in enumerate(judged):
        good = stable is None or bool(stable.met()[n])
        met = [bool(c.met()[n]) for c in shown]
        cells = [number(float(c.values[n]), 3) + (" " if m else "!") for c, m in zip(shown, met, strict=True)]
        passed = "pass" if good and all(met) else "FAIL"
        rows.append((f"{j.time_s:g}", passed, "stable" if good else "UNSTABLE", *cells))
    return ["at the operating points", *aligned(rows, "  ", right=(0, *range(3, 3 + len(shown))))]


def _bound(check: Check) -> str:
    """Return the limit, or its least and greatest values if it changes over time."""
    ends = dict.fromkeys(f"{end(check.limit):g}" for end in (np.min, np.max))
    return f"{check.sense} {'..'.join(ends)} "


def margins_table(judged: Sequence[JudgedLoop]) -> list[str]:
    """Return a row for each operating point, with its margins and the distances to -1.

    For an adaptive law, further tables contain the margins at both limits of the total gain.
    """
    out = _margins_rows("margins over all crossings", [(j.time_s, j.margins) for j in judged])
    for end in (0, 1):
        found = [(j.time_s, *list(j.at_total_gains.items())[end]) for j in judged if j.at_total_gains]
        if found:
            title = f"margins at a total gain of {found[0][1]:g}, to which adaptation may go"
            out += ["", *_margins_rows(title, [(time_s, m) for time_s, _, m in found])]
    return out


def _margins_rows(title: str, found: Sequence[tuple[float, Margins]]) -> list[str]:
    return [title, *aligned(margins_rows(found), "  ", right=(0, *range(2, 12)))]


def margins_rows(found: Sequence[tuple[float, Margins]]) -> list[tuple[str, ...]]:
    """Return the rows of a table of margins over time (s), beginning with two rows of heads."""
    rows: list[tuple[str, ...]] = [
        ("time, s", "loop", "gain up", "down", "phase", "delay", "least", "diamond", "aero", "rigid", "rigid", "cross"),
        ("", "", "dB", "dB", "deg", "ms", "|1+L|", "clear", "dB", "dB", "deg", "Hz"),
    ]
    for time_s, m in found:
        rows.append(
            (
                f"{time_s:g}",
                "stable" if m.stable else "UNSTABLE",
                number(m.gain_up_db.value, 2),
                number(m.gain_down_db.value, 2),
                number(m.phase_deg.value, 1),
                number(1e3 * m.delay_s.value, 1),
                number(m.modulus, 3),
                number(m.clearances[0].value, 2) if m.clearances else "-",
                number(m.aero_gain_db.value, 2),
                number(m.rigid_gain_db.value, 2),
                number(m.rigid_phase_deg.value, 1),
                number(m.crossover_hz, 3),
            )
        )
    return rows


def multiloop_table(together: Sequence[MultiloopMargins]) -> list[str]:
    """Return a row for each operating point: gain and phase margin of each axis, and the disk margin of all loops.

    The gain margin is the lesser of the upper and the lower gain margin.
    """
    if not together:
        return []
    axes = together[0].axes
    rows = [
        ("time, s", "loops", *(x for axis in axes for x in (axis, "phase")), "all", "phase", "at"),
        ("", "", *(x for _ in axes for x in ("gain dB", "deg")), "gain dB", "deg", "Hz"),
    ]
    for m in together:
        each = [x for one in m.each for x in (number(one.gain_db, 2), number(one.phase_deg.value, 1))]
        disk = number(m.disk.gain_up_db, 2), number(m.disk.phase_deg, 1), number(m.disk.frequency_hz, 3)
        rows.append((f"{m.time_s:g}", "stable" if m.stable else "UNSTABLE", *each, *disk))
    head = ["all axes together: margins of each loop with the others closed; all: disk margin of all loops"]
    head += [] if "roll" in axes else ["  roll has no linear loop: its rate is free"]
    return [*head, *aligned(rows, "  ", right=(0, *range(2, len(rows[0]))))]


def lobes_table(judged: Sequence[JudgedLoop]) -> list[str]:
    """Return a row for each operating point and a column for each lobe.

    A cell contains the peak, and G for gain-stabilised, or P and the phase margin for phase-stabilised.
    """
    rows = lobes_rows(judged)
    if not rows:
        return []
    head = "lobes: peak in dB; G gain-stabilised, P phase-stabilised with its phase margin"
    return [head, *aligned(rows, "  ", right=tuple(range(len(rows[0]))))]


def lobes_rows(judged: Sequence[JudgedLoop]) -> list[tuple[str, ...]]:
    """Return the rows of `lobes_table`, beginning with the head, or none without lobes."""
    labels = list(dict.fromkeys(lobe.label for j in judged for lobe in j.lobes))
    heads = (label.replace("bending", "mode") for label in labels)
    rows: list[tuple[str, ...]] = [("time, s", *heads)] * bool(labels)
    for j in judged if labels else ():
        by_label = {lobe.label: lobe for lobe in j.lobes}
        rows.append((f"{j.time_s:g}", *(_lobe(by_label.get(label), j.margins.stable) for label in labels)))
    return rows


def budget_table(judged: Sequence[JudgedLoop], crossing: str, column: Literal["gain_db", "phase_deg"]) -> list[str]:
    """Return a row for each operating point: the contributions to gain or phase at the crossing that sets a margin.

    The last column is the remaining margin.
    """
    rows, unit = budget_rows(judged, crossing, column), "deg" if column == "phase_deg" else "dB"
    if not rows:
        return []
    return [f"margin budget at the {crossing}, {unit}", *aligned(rows, "  ", right=tuple(range(len(rows[0]))))]


def budget_rows(
    judged: Sequence[JudgedLoop], crossing: str, column: Literal["gain_db", "phase_deg"]
) -> list[tuple[str, ...]]:
    """Return the rows of `budget_table`, beginning with the head, or none without such a crossing."""
    have = [j for j in judged if crossing in j.budgets]
    if not have:
        return []
    parts = list(dict.fromkeys(share.part for j in have for share in j.budgets[crossing].shares))
    digits = 1 if column == "phase_deg" else 2
    rows = [("time, s", "at Hz", *(_PARTS.get(part, part) for part in parts), "sum", "left")]
    for j in have:
        budget = j.budgets[crossing]
        shares = {share.part: getattr(share, column) for share in budget.shares}
        left = abs(budget.phase_margin_deg) if column == "phase_deg" else abs(budget.gain_db)
        values = [*(shares.get(part, math.nan) for part in parts), getattr(budget, column), left]
        rows.append((f"{j.time_s:g}", f"{budget.frequency_hz:.3g}", *(number(value, digits) for value in values)))
    return rows


def design_table(design: Design) -> list[str]:
    """Return the lines of a table of the gains and the filter."""
    names = (design.gains.over, *design.gain_names)
    rows = [tuple(GAIN_HEADS[name] for name in names)]
    for at, *gains in zip(*(design.gains.table[name] for name in names), strict=True):
        named = zip(names[1:], gains, strict=True)
        rows.append((f"{at:g}", *(f"{g:.3g}" if name in DRIFT_GAINS else f"{g:.4f}" for name, g in named)))
    flown = bending_filter(design)
    sections = [
        (*([GAIN_HEADS[design.gains.over]] if flown.moves else []), "section", "zero Hz", "zeta", "pole Hz", "zeta")
    ]
    for at, form in zip(flown.at, flown.filters, strict=True):
        first = [f"{at:g}"] if flown.moves else []
        for q in form.quadratic:
            cells = (f"{q.zero_hz:.3f}", f"{q.zero_zeta:.4f}", f"{q.pole_hz:.3f}", f"{q.pole_zeta:.4f}")
            sections.append((*first, "quadratic", *cells))
        for f in form.first_order:
            sections.append((*first, "first order", f"{f.zero_hz:.3f}", "", f"{f.pole_hz:.3f}", ""))
    head = ["gains", *aligned(rows, "  ", right=tuple(range(len(names)))), f"filter {design.filter.structure}"]
    numbers = (0, 2, 3, 4, 5) if flown.moves else (1, 2, 3, 4)
    return [*head, *aligned(sections, "  ", right=numbers)]


def search_table(solution: Solution) -> list[str]:
    """Return the lines of a table on the search and the certainty of the optimum."""
    return ["search", *aligned(search_rows(solution), "  ")]


def search_rows(solution: Solution) -> list[tuple[str, str]]:
    """Return the names and texts of the rows on the search and the certainty of the optimum."""
    from maxq.design.optimise.way_out import prices  # noqa: PLC0415  # lazy, as in `case_report`

    c = solution.certificate
    counts = Counter(x.what for x in solution.constraints if x.active)
    active = [f"{what} ({n} points)" if n > 1 else what for what, n in counts.items()]
    active += [bound.text for bound in solution.bounds]
    costs = [f"{one.name} costs {one.gains_db:.2g} dB per dB ({one.by})" for one in prices(solution)]
    worse = f"{c.worst_instant_db:.2g} dB" if c.worst_instant_db > 0.0 else "no"
    between = f"{c.instants} instants tried; {worse} worse than the worst operating point at most"
    between = between if c.instants else solution.unchecked
    return [
        ("objective", f"{solution.objective_db:.4f} dB"),
        ("starts", c.statement()),
        ("ends, dB", ", ".join("-" if math.isnan(x) else f"{x:.2f}" for x in sorted(c.ends_db))),
        ("KKT residual", f"{c.kkt_residual:.1e}"),
        ("active", "; ".join(active) or "none"),
        *([("limits", "; ".join(costs))] if costs else []),
        *([("between", between)] if between else []),
        ("effort", f"{c.evaluations} evaluations, {c.seconds:.2f} s, seed {c.seed}"),
    ]


def sensitivity_table(solution: Solution) -> list[str]:
    """Return the variables to which the objective and the limits are most sensitive, as lines."""
    rows = []
    for one in solution.sensitivities:
        where = "" if one.time_s is None else f"{one.time_s:g} s"
        largest = sorted(one.by, key=lambda name: -abs(one.by[name]))[:MOST_SENSITIVE]
        said = (f"{name} {one.by[name]:+.3g} {one.changes_in}" for name in largest if one.by[name] != 0.0)
        rows.append((one.what, where, ", ".join(said) or "none"))
    return [SENSITIVITIES, *aligned(rows, "  ", right=(1,))] if rows else []


def sensitivity_rows(solution: Solution) -> list[tuple[str, ...]]:
    """Return the rows of a table of sensitivities: a row for each variable, and a column for each quantity."""
    found = solution.sensitivities
    heads = [one.what + ("" if one.time_s is None else f", {one.time_s:g} s") for one in found]
    rows = [("variable", *heads), ("", *(one.changes_in for one in found))]
    names = found[0].by if found else ()
    return rows + [(name, *(number(one.by[name], 3) for one in found)) for name in names]


def wind_table(outcome: DesignOutcome) -> list[str]:
    """Return the largest root mean squares in the case's wind, for the design and for the scenario's own design."""
    if not outcome.in_wind:
        return []
    times, rows = [j.time_s for j in outcome.judged], [("", "rms", "at", "before", "at")]
    for one in outcome.in_wind:
        text, unit = one.about.label, one.about.unit
        cells = [_worst(values, times, unit) if values is not None else ("-", "") for values in (one.rms, one.before)]
        rows.append((text.removesuffix(", rms"), *cells[0], *cells[1]))
    before = None if outcome.loaded.base is None else outcome.loaded.base.design
    named = f" (before: {before.name or 'design'}, the scenario's own design)" if before is not None else ""
    return [printable(f"in the case's wind{named}"), *aligned(rows, "  ", right=(1, 2, 3, 4))]


def _worst(values: Array, times_s: Sequence[float], unit: str) -> tuple[str, str]:
    """Return the largest value and its operating point, both as text. NaN denotes an unstable loop."""
    k = int(np.argmax(np.isnan(values) if np.isnan(values).any() else values))
    value = float(values[k])
    return "unstable" if math.isnan(value) else f"{number_text(value)} {unit}", f"{times_s[k]:g} s"


def _lobe(lobe: Lobe | None, stable: bool) -> str:
    if lobe is None:
        return "-"
    how = "G      " if lobe.stabilised == "gain" else f"P {number(lobe.phase_deg, 0):>4s}°"
    return f"{lobe.peak_db:.2f} {how if stable else '       '}"


def number(value: float, digits: int) -> str:
    """Return a value as the text of a cell, or `-` for NaN and minus infinity."""
    return "-" if math.isnan(value) or value == -math.inf else f"{value:z.{digits}f}"


# JSON

SCHEMA = 1
_BOUNDS = {
    "gain_up": "db",
    "gain_down": "db",
    "phase": "deg",
    "delay": "s",
    "aero_gain": "db",
    "rigid_gain": "db",
    "rigid_phase": "deg",
}
_NUMBERS = ("stable", "unstable_poles", "growth_1ps", "growth_hz", "crossover_hz", "modulus")


def margins_record(m: Margins) -> dict[str, Any]:
    """Return the stability of a loop, and its margins with their frequencies, for JSON."""
    record: dict[str, Any] = {key: getattr(m, key) for key in _NUMBERS}
    for key, unit in _BOUNDS.items():
        bound = getattr(m, f"{key}_{unit}")
        record[key] = {unit: bound.value, "at_hz": bound.frequency_hz}
    return record


_RIGID_BODIES: dict[str, RigidBody] = {"without_m_alpha": "paper", "with_m_alpha": "aerodynamic"}


def node_record(judged: JudgedLoop) -> dict[str, Any]:
    """Return the record of one operating point."""
    m = judged.margins
    record = {"time_s": judged.time_s, **judged.loop.law.gains, **margins_record(m)}
    return record | {
        "disks": asdict(m.disks),
        "zones": [asdict(c.zone) | {"clearance": c.value, "at_hz": c.frequency_hz} for c in m.clearances],
        "lobes": [asdict(lobe) for lobe in judged.lobes],
        "rigid_body": {
            name: dict(zip(("hz", "zeta"), judged.rigid(body), strict=True)) for name, body in _RIGID_BODIES.items()
        },
        "budgets": {name: asdict(budget) for name, budget in judged.budgets.items()},
    }


def checks_record(checks: Sequence[Check]) -> list[dict[str, Any]]:
    """Return the record of limits and the values reached."""
    return [
        {
            "key": c.key,
            "name": c.text,
            "unit": c.unit,
            "sense": c.sense,
            "limit": c.limit.tolist() if isinstance(c.limit, np.ndarray) else c.limit,
            "worst": c.values[c.worst],
            "at_s": c.time_s[c.worst],
            "met": c.passed,
            "values": c.values.tolist(),
        }
        for c in checks
    ]


def analysis_record(
    name: str, order: AnalysisOrder, groups: Sequence[Group], judged_by: str, loss: Event | None = None
) -> dict[str, Any]:
    """Return the record of `simdesign analyse`, with the arguments of `analysis_report`."""
    checks = [check for group in groups for check in group.checks]
    return {
        "schema": SCHEMA,
        "design": name,
        **{key: getattr(order, key) for key in ("scenario", "axis", "kind", "errata", "plant")},
        "judged_by": judged_by,
        "passed": loss is None and all(check.passed for check in checks),
        "lost": None if loss is None else loss_text(loss),
        "dispersed": [{"loops": g.worst.loops, "instants": g.worst.instants} for g in groups if g.worst is not None],
        "limits": checks_record(checks),
        "nodes": [node_record(j) for group in groups for j in group.judged],
        "all_axes": [
            {
                "time_s": m.time_s,
                **{axis: margins_record(one) for axis, one in zip(m.axes, m.each, strict=True)},
                "disk": asdict(m.disk),
            }
            for group in groups
            for m in group.together
        ],
    }


def case_record(outcome: DesignOutcome, solution: Solution) -> dict[str, Any]:
    """Return the record of `simdesign CASE`."""
    from maxq.tools.design.way_out import prices_record, way_out_record  # noqa: PLC0415

    case, c = outcome.loaded.case, solution.certificate
    return {
        "schema": SCHEMA,
        "name": outcome.loaded.name,
        "status": solution.status,
        "feasible": outcome.feasible and solution.feasible and solution.status != "interrupted",
        "missed": outcome.missed,
        "explanation": solution.explanation(),
        "objective_db": solution.objective_db,
        "nominal_objective_db": solution.nominal_objective_db,
        "case": case.model_dump(mode="json", by_alias=True),
        **solution.law.record(),
        "search": asdict(c),
        "constraints": [asdict(x) for x in solution.constraints],
        "bounds": [asdict(x) for x in solution.bounds],
        "way_out": way_out_record(solution) if solution.status == "infeasible" else None,
        "prices": prices_record(solution),
        "sensitivities": [asdict(x) | {"changes_in": x.changes_in} for x in solution.sensitivities],
        "limits": checks_record([*outcome.found, *outcome.coupled_found]),
        "limits_as_flown": checks_record(outcome.flown_found),
        "limits_dispersed": checks_record(outcome.dispersed_found),
        "in_wind": {
            one.name: {"rms": one.rms.tolist(), "before": None if one.before is None else one.before.tolist()}
            for one in outcome.in_wind
        },
        "nodes": [node_record(j) for j in outcome.judged],
    }


def write_record(path: Path, record: dict[str, Any]) -> Path:
    """Write a record as standard JSON: NaN as null, infinity as the text "inf". Return the path. Raises FileError."""
    return write_whole(path, json.dumps(plain_record(record), indent=1, allow_nan=False) + "\n")


def plain_record(value: Any) -> Any:
    """Return a value as `json` reads it back from a file of `write_record`."""
    if isinstance(value, dict):
        return {key: plain_record(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_record(item) for item in value]
    if isinstance(value, float):  # includes NumPy's float64
        return None if math.isnan(value) else float(value) if math.isfinite(value) else "inf" if value > 0 else "-inf"
    if hasattr(value, "item"):
        return plain_record(value.item())
    return value
