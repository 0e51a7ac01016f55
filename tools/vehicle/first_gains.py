"""First gains that control their own flight.

`build` sets the frequency and damping of the rigid body, without regard to the phase of slosh and bending modes. This
module checks the sampled loop along the flight with these gains. If it is unstable at operating points, the case of the
vehicle is solved for the stages concerned; if the flight is lost, for all stages. The search uses few operating points,
few starts and one round along a flight that keeps control. Its gains, filters and leads of the pitch programme are used
whether or not they meet the limits of the case.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from maxq.design import operating_points
from maxq.design.case.schema import read_case
from maxq.design.model.node_times import node_times
from maxq.design.model.powered import loss_text, powered_flight
from maxq.design.verify.judging import judge
from maxq.design.verify.own_flight import CaseDesign, design_case
from maxq.sim.run.flight import Event
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.cli.frame import Interruption
from maxq.tools.vehicle.build import Built, dozen
from maxq.tools.vehicle.files import write

POINTS = 15  # operating points of each stage at which first gains are checked
SEARCH = ("nodes_per_stage=11", "search.starts=2", "search.leaps=0", "between_nodes='ignore'", "gains.schedule='free'")
SHOWN = 6  # most times named in a message


@dataclass(frozen=True)
class FirstGains:
    """The result of checking first gains in pitch along their own flight.

    `unstable_s` are the times of operating points with an unstable loop. `gain_margin_db` is the least gain margin of
    the others, at `at_s`. `loss` is the loss of the flight, after which there are no points. `searched` is True if the
    optimiser has found the gains.
    """

    points: int
    unstable_s: tuple[float, ...]
    loss: Event | None
    gain_margin_db: float
    at_s: float
    searched: bool = False
    unstable_stages: tuple[int, ...] = ()  # numbered from 0

    @property
    def hold(self) -> bool:
        """Return True if the loop is stable at every point and the flight is not lost."""
        return not self.unstable_s and self.loss is None

    @property
    def text(self) -> str:
        """Return the result in one sentence."""
        by = " by search," if self.searched else ""
        if self.hold:
            least = f"least gain margin {self.gain_margin_db:.2f} dB at {self.at_s:.1f} s"
            return f"first gains:{by} stable at {self.points} operating points of their own flight; {least}"
        times = ", ".join(f"{t:.1f}" for t in self.unstable_s[:SHOWN])
        more = f" and {len(self.unstable_s) - SHOWN} more" if len(self.unstable_s) > SHOWN else ""
        parts = [f"unstable at {times} s{more}"] if self.unstable_s else []
        parts += [f"the flight is lost: {loss_text(self.loss)}"] if self.loss is not None else []
        return f"first gains:{by} {'; '.join(parts)}"


def write_with_first_gains(
    built: Built, folder: Path, progress: Callable[[str, int, int], None] = lambda *_: None
) -> tuple[Built, list[Path], FirstGains]:
    """Check the first gains of a vehicle along the flight that they control, search for others if they fail, and write
    the vehicle.

    Return the vehicle, the paths of its files, and the check of its gains. Nothing is written to the folder before the
    gains are found.
    """
    with tempfile.TemporaryDirectory(prefix="maxq-vehicle-") as trial:
        built, gains = _held(built, Path(trial), progress)
    with Interruption():  # all files of the vehicle, even if Ctrl-C is pressed now
        return built, write(built, folder), gains


def _held(built: Built, trial: Path, progress: Callable[[str, int, int], None]) -> tuple[Built, FirstGains]:
    """Return a vehicle with gains that hold its flight, if any are found, and their check.

    Gains from the search are discarded if they leave more operating points unstable. The vehicle is written to the
    folder `trial`.
    """
    write(built, trial)
    progress("flying the first gains", 0, 0)
    found = checked(trial)
    if found.hold:
        return built, found
    some = () if found.loss is not None else (f"stages={[n + 1 for n in found.unstable_stages]}",)
    try:
        made = design_case(
            read_case(trial / "case.toml", (*SEARCH, *some)),
            lambda stage, number: lambda done, of, best_db, what: progress("searching first gains", done, of),
            rounds_most=1,
        )
    except ValueError:  # no operating point: lost immediately
        return built, found
    changed = with_design(built, made)
    write(changed, trial)
    again = replace(checked(trial), searched=True)
    return (built, found) if len(again.unstable_s) > len(found.unstable_s) and not again.hold else (changed, again)


def checked(folder: Path) -> FirstGains:
    """Fly the vehicle in a folder with its own design, and check its sampled loops along that flight."""
    scenario = load_scenario(folder / "scenario.toml")
    assert scenario.design is not None
    loss = powered_flight(scenario)[1]
    try:
        judged = judge(operating_points.nodes(scenario, node_times(scenario, POINTS)), scenario.design)
    except ValueError:  # lost before the first point
        return FirstGains(0, (), loss, math.nan, math.nan)
    unstable = tuple(j.time_s for j in judged if not j.margins.stable)
    stable = [j for j in judged if j.margins.stable]
    least = min(stable, key=lambda j: j.gain_margin_db, default=None)
    gain, at = (math.nan, math.nan) if least is None else (least.gain_margin_db, least.time_s)
    stages = tuple(sorted({j.node.stage for j in judged if not j.margins.stable}))
    return FirstGains(len(judged), unstable, loss, gain, at, unstable_stages=stages)


def with_design(built: Built, made: CaseDesign) -> Built:
    """Return the vehicle with the gains and filters of a design. Stages outside the design keep theirs."""
    design, done = made.design, {solution.nodes[0].stage for _, solution in made.results}
    rows = {row[0]: row for p, row in zip(dozen(built), built.gains, strict=True) if p.number not in done}
    for _, solution in made.results:
        table = design.of_stage(solution.nodes[0].stage).gains.table
        for row in zip(table["time_s"], table["k_p"], table["k_d_s"], strict=True):
            rows[float(row[0])] = (float(row[0]), float(row[1]), float(row[2]))
    named = design.model_copy(update={"name": f"{built.layout.name}, first gains"})
    said = [line for line in built.assumed if not line.startswith("first gains")]
    said.append("first gains: searched for the case's limits, since those of a rigid body do not hold the flight")
    return replace(built, gains=[rows[t] for t in sorted(rows)], design=named, assumed=said)
