"""The Python interface of maxq: functions that correspond to the commands.

::

    import maxq

    flight = maxq.fly("nominal", "wind.profile=winds/anheung-november.csv")
    maxq.plot(flight, "alpha_total_deg", "gimbal_pitch_angle_deg")
    flight.to_pandas("/truth"), flight.to_csv("flight.csv", "altitude_m"), flight.metrics

    made = maxq.optimise("ksr3-relaxed")
    made.bode(40.0), made.save("mine.toml")
    maxq.verify("mine.toml", "quick").judgement

The names in ``__all__`` are the public API; docs/python.md states which changes are possible and when. Their
dependencies are imported at first use. Invalid input raises a :class:`ScenarioError`, :class:`CampaignError` or
:class:`LogError` of one line, which names file, key, value and the permitted values.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for type checkers and editors; _HOMES provides the same to the interpreter
    from pathlib import Path

    from distributed import Client
    from matplotlib.figure import Figure

    from maxq.design.laws.design_file import load_design
    from maxq.design.loop.fixed_path import Cut, LoopKind
    from maxq.design.loop.loop import Loop, loops
    from maxq.design.loop.multiloop import multiloops
    from maxq.design.margins.measure import Margins, margins
    from maxq.design.margins.multiloop import multiloop_margins
    from maxq.design.model.given import GivenPoint, point_of_matrices
    from maxq.design.model.given_file import given_points
    from maxq.design.model.instruments import Plane
    from maxq.design.model.node import Node
    from maxq.design.model.operating_point import OperatingPoint
    from maxq.design.operating_points import PlantKind, nodes
    from maxq.design.paper.errata import Errata
    from maxq.design.verify.verify import Verification
    from maxq.sim.campaign.analysis import DataSet
    from maxq.sim.campaign.error import CampaignError
    from maxq.sim.campaign.read import LoadedCampaign
    from maxq.sim.input.errors import ScenarioError
    from maxq.sim.input.files import builtin_names
    from maxq.sim.log.head import LogError
    from maxq.sim.log.reader import Log
    from maxq.sim.run.flight import Flight
    from maxq.sim.run.fly import FlightRun
    from maxq.sim.run.record import record
    from maxq.sim.scenario.loader import LoadedScenario
    from maxq.sim.scenario.schema_design import Design
    from maxq.tools.design.designed import Designed

__all__ = [
    "CampaignError",
    "DataSet",
    "Designed",
    "Flight",
    "FlightRun",
    "GivenPoint",
    "LoadedCampaign",
    "LoadedScenario",
    "Log",
    "LogError",
    "Loop",
    "Margins",
    "Node",
    "OperatingPoint",
    "ScenarioError",
    "Verification",
    "bode",
    "builtin_names",
    "campaign",
    "fly",
    "given_points",
    "load",
    "load_design",
    "loop",
    "loops",
    "margins",
    "multiloop_margins",
    "multiloops",
    "nodes",
    "optimise",
    "plot",
    "point_of_matrices",
    "read",
    "record",
    "replay",
    "vehicle",
    "verify",
]
_HOMES = {
    "maxq.design.laws.design_file": ("load_design",),
    "maxq.design.loop.loop": ("Loop", "loops"),
    "maxq.design.loop.multiloop": ("multiloops",),
    "maxq.design.margins.measure": ("Margins", "margins"),
    "maxq.design.margins.multiloop": ("multiloop_margins",),
    "maxq.design.model.given": ("GivenPoint", "point_of_matrices"),
    "maxq.design.model.given_file": ("given_points",),
    "maxq.design.model.node": ("Node",),
    "maxq.design.model.operating_point": ("OperatingPoint",),
    "maxq.design.operating_points": ("nodes",),
    "maxq.design.verify.verify": ("Verification",),
    "maxq.sim.campaign.analysis": ("DataSet",),
    "maxq.sim.campaign.error": ("CampaignError",),
    "maxq.sim.campaign.read": ("LoadedCampaign",),
    "maxq.sim.log.head": ("LogError",),
    "maxq.sim.log.reader": ("Log",),
    "maxq.sim.run.flight": ("Flight",),
    "maxq.sim.run.fly": ("FlightRun",),
    "maxq.sim.run.record": ("record",),
    "maxq.sim.input.errors": ("ScenarioError",),
    "maxq.sim.input.files": ("builtin_names",),
    "maxq.sim.scenario.loader": ("LoadedScenario",),
    "maxq.tools.design.designed": ("Designed",),
}
"""The modules that define the names which this module only exports."""

if not os.path.isdir(os.path.join(__path__[0], "control")):
    # an editable installation: the layers are not below this folder, but next to it
    __path__.append(os.path.dirname(__path__[0]))


def load(path: str | Path, *overrides: str) -> LoadedScenario | LoadedCampaign:
    """Load a scenario or a campaign: a file, or the name of a built-in one; `overrides` as "run.duration_s=10"."""
    from maxq.sim.campaign.read import load_campaign
    from maxq.sim.scenario.loader import is_campaign, load_scenario

    if is_campaign(path):
        return load_campaign(path, overrides)
    return load_scenario(path, overrides).telling(overrides)


def fly(scenario: LoadedScenario | str | Path, *overrides: str, folder: str | Path | None = None) -> Flight:
    """Fly a scenario. With `folder`, log and summary are written there, and the channels are in the log (`read`).

    The first flight of an installation compiles the simulator (about twenty seconds).
    """
    from maxq.sim.run import fly as flying
    from maxq.sim.run.record import record
    from maxq.sim.scenario.loader import LoadedScenario, load_scenario

    if isinstance(scenario, LoadedScenario) and overrides:
        raise ValueError("overrides go with a scenario's name; load(name, *overrides) takes them")
    loaded = scenario if isinstance(scenario, LoadedScenario) else load_scenario(scenario, overrides)
    loaded = loaded.telling(overrides)
    return flying.fly(loaded) if folder is None else record(flying.FlightRun(loaded), folder)


def campaign(
    of: LoadedCampaign | str | Path,
    folder: str | Path | None = None,
    *,
    runs: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
    cluster: Client | str | None = None,
) -> DataSet:
    """Fly a campaign into its folder (None: runs/NAME), or the runs that are missing there.

    `runs` and `seed` replace those of the file. `workers` is the number of threads of this process, by default one per
    core. `cluster` is a client of dask.distributed, or the address of a scheduler (``tcp://head:8786``), whose workers
    fly the runs instead; a client remains open. The data set is the same, bit for bit. Raises CampaignError, and
    ValueError for `workers` together with `cluster`.
    """
    from pathlib import Path

    from maxq.sim.campaign.analysis import DataSet
    from maxq.sim.campaign.read import LoadedCampaign, load_campaign
    from maxq.sim.campaign.runner import run_campaign
    from maxq.sim.files import plain_name

    if workers is not None and cluster is not None:
        raise ValueError(f"workers = {workers} is the number of threads of this process; a cluster has its own workers")
    loaded = of if isinstance(of, LoadedCampaign) else load_campaign(of)
    changes = {name: value for name, value in (("runs", runs), ("seed", seed)) if value is not None}
    loaded = loaded.with_campaign(**changes)
    place = Path(folder) if folder is not None else Path("runs") / plain_name(loaded.name, "campaign")
    run_campaign(loaded, place, workers=workers, cluster=cluster, elsewhere="give another folder")
    return DataSet(place, loaded)


def read(path: str | Path) -> Log | DataSet:
    """Read the results of a flight: a log, the folder of a flight, or that of a campaign."""
    from pathlib import Path

    from maxq.sim.campaign.analysis import DataSet
    from maxq.sim.campaign.store import MANIFEST, campaign_in
    from maxq.sim.log.reader import read_log
    from maxq.sim.run.record import LOG_NAME

    place = Path(path)
    if (place / MANIFEST).is_file():
        return DataSet(place, campaign_in(place))
    return read_log(place / LOG_NAME if place.is_dir() else place)


def plot(of: Flight | Log, *names: str) -> Figure:
    """Draw channels over time, one panel per unit, with the events of the flight as dotted lines.

    `names` are channels or topics ("/truth"). Without names, the key channels are drawn. Returns a Matplotlib figure,
    which a notebook shows and `.savefig(path)` writes. Raises KeyError for an unknown name.
    """
    from maxq.tools.plots.channels import channel_plot

    return channel_plot(of, names)


def replay(*places: str | Path, save: str | Path | None = None) -> None:
    """Show flights (logs, folders of flights or campaigns) in the viewer, or `save` them as a Rerun recording."""
    from maxq.tools import simreplay

    simreplay.show([str(place) for place in places] + (["--save", str(save)] if save is not None else []))


def vehicle(layout: str | Path, folder: str | Path | None = None) -> Path:
    """Build a vehicle from a layout, a file or a built-in one, in its folder (None: runs/NAME). Return the folder.

    The folder contains `scenario.toml` to fly, `case.toml` to optimise, `suite.toml` to verify and `campaign.toml`.
    Raises ScenarioError, and ValueError for a layout that cannot fly.
    """
    from pathlib import Path

    from maxq.sim.files import plain_name
    from maxq.tools.vehicle.build import build
    from maxq.tools.vehicle.files import write
    from maxq.tools.vehicle.layout import read_layout

    read = read_layout(layout)
    place = Path(folder) if folder is not None else Path("runs") / plain_name(read.name, "vehicle")
    write(build(read), place)
    return place


def optimise(case: str | Path, *overrides: str) -> Designed:
    """Optimise gain schedules and bending filter of a case: a file, or the name of a built-in one (`simdesign`)."""
    from maxq.tools.design.designed import designed

    return designed(case, overrides)


def verify(design: str | Path, suite: str | Path = "standard", *overrides: str) -> Verification:
    """Judge a design by a suite (`simverify`). Parts with results from an earlier call are not computed again."""
    from maxq.design.laws.design_file import design_path
    from maxq.design.verify import memory
    from maxq.design.verify.suite import read_suite
    from maxq.design.verify.verify import verify as verify_design

    return verify_design(design_path(str(design)), read_suite(str(suite), overrides), memory=memory.default_folder())


def bode(design: str | Path, time_s: float, scenario: str | Path = "nominal", plane: Plane = "pitch") -> Figure:
    """Draw the Bode, Nichols and Nyquist plots of a design's sampled loop at a vehicle time of a scenario's flight."""
    from maxq.tools.design.designed import loop_figure

    return loop_figure(str(design), time_s, scenario, plane)


def loop(
    where: OperatingPoint | LoadedScenario | str | Path,
    design: Design | str | Path | None = None,
    time_s: float | None = None,
    *,
    plane: Plane = "pitch",
    kind: LoopKind = "sampled",
    cut: Cut = "gimbal_command",
    errata: Errata | str = "corrected",
    plant: PlantKind = "flown",
) -> Loop:
    """Return a design's loop at one operating point.

    `where` is an operating point (`nodes`, `given_points`, `point_of_matrices`) with its own time and plane, or a
    scenario, flown up to `time_s`. The `design` is loaded, a file, a built-in name, or None for the scenario's own. The
    other arguments are those of `nodes` and `loops`. Raises ScenarioError, and ValueError for arguments that
    are missing or not allowed.
    """
    from pathlib import Path

    from maxq.design.laws.design_file import load_design
    from maxq.design.loop.loop import loops
    from maxq.design.model.given import GivenPoint
    from maxq.design.model.operating_point import OperatingPoint
    from maxq.design.operating_points import nodes
    from maxq.sim.scenario.loader import load_scenario, read_design
    from maxq.sim.scenario.schema_design import Design

    node, scenario = (where, None) if isinstance(where, OperatingPoint) else (None, where)
    if isinstance(scenario, str | Path):
        scenario = load_scenario(scenario)
    if design is None:
        design = scenario.design if scenario is not None else None
        if design is None:
            raise ValueError("no design is given, and there is no scenario that has one")
    elif not isinstance(design, Design) and isinstance(node, GivenPoint):
        design = read_design(design)
    elif not isinstance(design, Design):
        design = load_design(design, scenario if scenario is not None else "nominal")
    if node is None:
        if time_s is None:
            raise ValueError("time_s is missing: when along the flight?")
        assert scenario is not None
        node = nodes(scenario, [time_s], plane=plane, errata=errata, plant=plant)[0]
    return loops([node], design, kind=kind, cut=cut)[0]


if not TYPE_CHECKING:  # a type checker would accept any name there

    def __getattr__(name: str) -> Any:
        for module, names in _HOMES.items():
            if name in names:
                return getattr(import_module(module), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
