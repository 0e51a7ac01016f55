"""maxq from Python: what the commands do, as functions.

    from maxq.tools.api import load, fly, campaign, read, design, bode, verify, replay

    flight = fly("nominal", "wind.profile=winds/anheung-november.csv")
    flight.plot("alpha_total_deg", "gimbal_pitch_angle_deg")
    flight.to_pandas("/truth"), flight.to_csv("flight.csv", "altitude_m"), flight.metrics
    made = design("ksr3-relaxed")
    made.bode(40.0), made.save("mine.toml")
    verify("mine.toml", "quick").judgement

These names and their arguments are stable. What is below them: `maxq.sim.api` (flights segment by segment, recording),
`maxq.design.api` (linear models and loops). Wrong input raises ScenarioError, CampaignError, LogError or FileError, one
line each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from maxq.design import api
from maxq.design.case.schema import read_case
from maxq.design.laws.design_file import design_path, design_text
from maxq.design.model.vehicle_at import Plane
from maxq.design.optimise.solution import Solution
from maxq.design.optimise.solve import solve
from maxq.design.verify import memory
from maxq.design.verify.judging import Judged, Outcome, Wanted, judge, judge_solution, objective_text
from maxq.design.verify.suite import read_suite
from maxq.design.verify.verify import Verification
from maxq.design.verify.verify import verify as verify_design
from maxq.sim.campaign.analysis import DataSet
from maxq.sim.campaign.read import LoadedCampaign, load_campaign
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.campaign.store import MANIFEST, campaign_in
from maxq.sim.files import plain_name, write_whole
from maxq.sim.log.reader import Log, read_log
from maxq.sim.log.tabular import html_table
from maxq.sim.run import fly as flying
from maxq.sim.run.fly import Flight, FlightRun
from maxq.sim.run.metrics import METRIC_NAMES
from maxq.sim.run.record import LOG_NAME, record
from maxq.sim.scenario.loader import LoadedScenario, is_campaign, load_scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Designed", "bode", "campaign", "design", "fly", "load", "read", "replay", "verify"]


def load(path: str | Path, *overrides: str) -> LoadedScenario | LoadedCampaign:
    """A scenario or campaign: a file, or the name of a built-in one; `overrides` as "run.duration_s=10"."""
    if is_campaign(path):
        return load_campaign(path, overrides)
    return load_scenario(path, overrides, METRIC_NAMES)


def fly(scenario: LoadedScenario | str | Path, *overrides: str, folder: str | Path | None = None) -> Flight:
    """Fly a scenario. With `folder`: log and summary are written there, and the channels are in the log (`read`).

    The first flight of an installation compiles the simulator (about half a minute).
    """
    if isinstance(scenario, LoadedScenario) and overrides:
        raise ValueError("overrides go with a scenario's name; load(name, *overrides) takes them")
    loaded = scenario if isinstance(scenario, LoadedScenario) else load_scenario(scenario, overrides, METRIC_NAMES)
    return flying.fly(loaded) if folder is None else record(FlightRun(loaded), folder)


def campaign(
    of: LoadedCampaign | str | Path,
    folder: str | Path | None = None,
    *,
    runs: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
) -> DataSet:
    """Fly a campaign into its folder (None: runs/NAME), or what is missing there; `runs`, `seed`: not the file's."""
    loaded = of if isinstance(of, LoadedCampaign) else load_campaign(of)
    changes = {name: value for name, value in (("runs", runs), ("seed", seed)) if value is not None}
    loaded = loaded.with_campaign(**changes)
    place = Path(folder) if folder is not None else Path("runs") / plain_name(loaded.name, "campaign")
    run_campaign(loaded, place, workers=workers)
    return DataSet(place, loaded)


def read(path: str | Path) -> Log | DataSet:
    """What was flown: a log, the folder of a flight, or that of a campaign."""
    place = Path(path)
    if (place / MANIFEST).is_file():
        return DataSet(place, campaign_in(place))
    return read_log(place / LOG_NAME if place.is_dir() else place)


@dataclass(frozen=True, repr=False)
class Designed:
    """A design for a case. `outcome.design` is what flies, `outcome.judged` its margins node by node."""

    outcome: Outcome
    solution: Solution

    @property
    def meets_limits(self) -> bool:
        """All limits of the case."""
        return self.outcome.feasible and self.solution.feasible

    def bode(self, time_s: float | None = None) -> Figure:
        """Bode, Nichols and Nyquist plot at the node of that time (None: of the least gain margin)."""
        nodes = self.outcome.judged
        if time_s is None:
            one = min(nodes, key=lambda j: j.gain_margin_db)
        else:
            one = min(nodes, key=lambda j: abs(j.time_s - time_s))
        loaded = self.outcome.loaded
        return _drawn(one, f"{loaded.scenario.vehicle.name}: {loaded.name}", self.outcome.wanted)

    def save(self, path: str | Path) -> Path:
        """As a design file, for `fly(name, "design=path")` and `verify(path)`."""
        return write_whole(Path(path), design_text(self.outcome.design, [f"Written for {self.outcome.loaded.name}."]))

    def __repr__(self) -> str:
        missed = "all limits met" if self.meets_limits else f"INFEASIBLE: {'; '.join(self.outcome.missed)}"
        return f"<Designed {self.outcome.loaded.name}: {objective_text(self.solution)}, {missed}>"

    def _repr_html_(self) -> str:
        rows = [
            (c.text, "met" if c.passed else "MISSED", f"{c.values[c.worst]:.4g}", f"{c.sense} {c.limit:g} {c.unit}")
            for c in self.outcome.found
        ]
        return html_table(repr(self).strip("<>"), ("limit", "", "worst", "wanted"), rows)


def design(case: str | Path, *overrides: str) -> Designed:
    """Optimise gain schedules and bending filter of a case: a file, or the name of a built-in one."""
    loaded = read_case(str(case), overrides)
    solution = solve(loaded)
    return Designed(judge_solution(loaded, solution), solution)


def bode(design: str | Path, time_s: float, scenario: str | Path = "nominal", plane: Plane = "pitch") -> Figure:
    """Bode, Nichols and Nyquist plot of a design's sampled loop at a vehicle time of a scenario's flight."""
    flown = load_scenario(scenario)
    found = api.load_design(design_path(str(design)), flown)
    judged: Sequence[Judged] = judge(api.nodes(flown, [time_s], plane=plane), found)
    title = f"{flown.vehicle.name}: {found.name or design}"
    return _drawn(judged[0], title, Wanted.of(found.limits) if found.limits else Wanted())


def verify(design: str | Path, suite: str | Path = "standard", *overrides: str) -> Verification:
    """Judge a design by a suite; parts that were worked out before are not worked out again."""
    return verify_design(design_path(str(design)), read_suite(str(suite), overrides), memory=memory.default_folder())


def replay(*places: str | Path, save: str | Path | None = None) -> None:
    """Show flights (logs, folders of flights or campaigns) in the viewer, or `save` them as a Rerun recording."""
    from maxq.tools import simreplay  # noqa: PLC0415  # lazy: rerun takes half a second

    simreplay.show([str(place) for place in places] + (["--save", str(save)] if save is not None else []))


def _drawn(judged: Judged, name: str, wanted: Wanted) -> Figure:
    from maxq.tools.design.pictures import loop_picture  # noqa: PLC0415  # lazy: Matplotlib
    from maxq.tools.plots.style import drawing  # noqa: PLC0415  # lazy

    with drawing():
        return loop_picture(judged, name, wanted)
