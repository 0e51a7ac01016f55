"""A design made from Python, with methods to show, draw and save it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from maxq.design import operating_points
from maxq.design.case.schema import Case, LoadedCase, read_case
from maxq.design.laws.design_file import design_path, design_text, load_design
from maxq.design.loop.fixed_path import LoopKind
from maxq.design.loop.loop import loops
from maxq.design.model.given import GivenPoint
from maxq.design.model.given_file import PointList
from maxq.design.model.instruments import Plane
from maxq.design.optimise.solution import Solution
from maxq.design.verify.judging import JudgedLoop, Wanted, judge
from maxq.design.verify.outcome import DesignOutcome, objective_text
from maxq.design.verify.own_flight import design_case
from maxq.sim.files import write_whole
from maxq.sim.input.files import Reading, locate
from maxq.sim.log.tabular import html_table
from maxq.sim.scenario.loader import load_file, load_scenario, read_design
from maxq.tools.design.analysed_loop import AnalysedLoop, analysed
from maxq.tools.design.points import designed_at_points

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class Designed:
    """The design of a case.

    `outcome.design` is the flown design, and `outcome.judged` its loops and margins at the operating points of its own
    flight. If there are several stages, these are the points of the first stage designed.
    """

    outcome: DesignOutcome
    solution: Solution
    meets_limits: bool  # True if all stages meet all limits of the case, and the flight of the design is not lost

    def bode(self, time_s: float | None = None) -> Figure:
        """Draw the Bode, Nichols and Nyquist plots at the operating point nearest to `time_s`.

        By default, it is the operating point with the least gain margin.
        """
        nodes = self.outcome.judged
        if time_s is None:
            one = min(nodes, key=lambda j: j.gain_margin_db)
        else:
            one = min(nodes, key=lambda j: abs(j.time_s - time_s))
        loaded = self.outcome.loaded
        vehicle = loaded.scenario.vehicle.name if loaded.points is None else loaded.points.name
        return _drawn(one, f"{vehicle}: {loaded.name}", self.outcome.wanted)

    def loop(
        self, time_s: float | None = None, *, plane: Plane | None = None, kind: LoopKind | None = None
    ) -> AnalysedLoop:
        """Return the loop at a vehicle time, with its margins, responses and plots as methods.

        The default is the operating point with the least gain margin, in the plane and with the kind of the case.
        Raises ValueError for a time outside the powered flight or the points, and for the other plane of given points.
        """
        case, loaded = self.outcome.loaded.case, self.outcome.loaded
        worst = min(self.outcome.judged, key=lambda j: j.gain_margin_db)
        wanted_s = worst.time_s if time_s is None else time_s
        own = worst.node.plane
        known = [j.node for j in self.outcome.judged if j.time_s == wanted_s and plane in (None, own)]
        if known:
            (node, *_) = known
        elif loaded.points is not None:
            if plane not in (None, own):
                raise ValueError(f"plane = {plane!r}: the points are of the plane {own}")
            node = loaded.points.point(wanted_s)
        else:
            (node,) = operating_points.nodes(
                loaded.along, [wanted_s], plane=plane or own, errata=case.errata, plant=case.plant
            )
        return analysed(loops([node], self.outcome.design, kind=kind or case.loop)[0])

    def save(self, path: str | Path) -> Path:
        """Save the design as a file for `fly(name, "design=path")` and `verify(path)`. Return the path."""
        return write_whole(Path(path), design_text(self.outcome.design, [f"Written for {self.outcome.loaded.name}."]))

    def __repr__(self) -> str:
        missed = "all limits met" if self.meets_limits else f"INFEASIBLE: {'; '.join(self.outcome.missed)}"
        return f"<Designed {self.outcome.loaded.name}: {objective_text(self.solution)}, {missed}>"

    def _repr_html_(self) -> str:
        rows = [
            (c.text, "met" if c.passed else "MISSED", f"{c.values[c.worst]:.4g}", f"{c.sense} {c.limit:g} {c.unit}")
            for c in (*self.outcome.found, *self.outcome.coupled_found)
        ]
        return html_table(repr(self).strip("<>"), ("requirement", "", "value", "limit"), rows)


def designed(case: str | Path, overrides: Sequence[str], points: Sequence[GivenPoint] | None = None) -> Designed:
    """Return the design of a case: gain schedules and bending filter, optimised along their own flight.

    `points` replace the operating points of the case.
    """
    if points is not None:
        given = PointList(tuple(points))
        changes = [*overrides, f'points="{given.name}"', f'plane="{given.plane}"']
        if "scenario" in Reading().document(*locate(str(case), "case"), "case"):
            changes.append("scenario=")
        own, _, _, label, _ = load_file(Case, "case", str(case), changes)
        start = own.search.start_design
        loaded = LoadedCase(own, label, None, None if start is None else read_design(start), points=given)
    else:
        loaded = read_case(str(case), overrides)
    if loaded.points is not None:
        found, of_points = designed_at_points(loaded)
        return Designed(found, of_points, found.feasible and of_points.feasible)
    made = design_case(loaded)
    outcome, solution = made.results[0]
    return Designed(replace(outcome, design=made.design), solution, made.feasible)


def loop_figure(design: str, time_s: float, scenario: str | Path, plane: Plane, kind: LoopKind) -> Figure:
    """Draw the Bode, Nichols and Nyquist plots of a design's loop at a vehicle time of a scenario's flight."""
    flown = load_scenario(scenario)
    found = load_design(design_path(design), flown)
    judged: Sequence[JudgedLoop] = judge(operating_points.nodes(flown, [time_s], plane=plane), found, kind)
    title = f"{flown.vehicle.name}: {found.name or design}"
    return _drawn(judged[0], title, Wanted.stated_by(found))


def _drawn(judged: JudgedLoop, name: str, wanted: Wanted) -> Figure:
    from maxq.tools.design.pictures import loop_picture  # noqa: PLC0415  # lazy: Matplotlib
    from maxq.tools.plots.style import drawing  # noqa: PLC0415  # lazy

    with drawing():
        return loop_picture(judged, name, wanted)
