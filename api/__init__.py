"""The Python interface of maxq: functions that correspond to the commands.

::

    import maxq

    flight = maxq.fly("nominal", "wind.profile=winds/anheung-november.csv")
    maxq.plot(flight, "alpha_total_deg", "gimbal_pitch_angle_deg")
    flight.to_pandas("/truth"), flight.to_csv("flight.csv", "altitude_m"), flight.metrics

    made = maxq.optimise("ksr3-relaxed")
    made.bode(40.0), made.save("mine.toml")
    made.loop(40.0, plane="yaw").step().plot()
    maxq.verify("mine.toml", "quick").judgement

The names in ``__all__`` are the public API; docs/python.md states which changes are possible and when. The modules of
a function are imported when it is first called. Invalid input raises a :class:`ScenarioError`, :class:`CampaignError`
or :class:`LogError` with a message of one line, which names the file, the key, the value and the permitted values.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for type checkers and editors; the interpreter finds these names by _HOMES
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from distributed import Client
    from matplotlib.figure import Figure

    from maxq.design.laws.design_file import load_design
    from maxq.design.loop.fixed_path import Cut, LoopKind
    from maxq.design.loop.loop import Loop
    from maxq.design.loop.multiloop import multiloops
    from maxq.design.margins.measure import Margins, margins
    from maxq.design.margins.multiloop import multiloop_margins
    from maxq.design.model.given import GivenPoint, point_of_matrices
    from maxq.design.model.given_file import given_points
    from maxq.design.model.given_system import point_of_system
    from maxq.design.model.instruments import Plane
    from maxq.design.model.node import Node
    from maxq.design.model.operating_point import OperatingPoint
    from maxq.design.operating_points import PlantKind, nodes
    from maxq.design.optimise.response_goals import LoopValues
    from maxq.design.paper.errata import Errata
    from maxq.design.verify.verify import Verification
    from maxq.design.verify.worst_given import WorstPoint, worst_point
    from maxq.sim.campaign.analysis import DataSet
    from maxq.sim.campaign.error import CampaignError
    from maxq.sim.campaign.read import LoadedCampaign
    from maxq.sim.input.errors import ScenarioError
    from maxq.sim.input.files import builtin_names
    from maxq.sim.log.head import LogError
    from maxq.sim.log.reader import Log
    from maxq.sim.run.flight import Flight
    from maxq.sim.run.fly import FlightRun
    from maxq.sim.run.impact_channels import WithImpacts
    from maxq.sim.run.record import record
    from maxq.sim.scenario.loader import LoadedScenario
    from maxq.sim.scenario.schema_design import Design
    from maxq.tools.design.analysed_loop import (
        AnalysedLoop,
        BodeCurves,
        LocusCurves,
        NicholsCurves,
        SensitivityCurves,
        TimeCurves,
        loops,
    )
    from maxq.tools.design.designed import Designed
    from maxq.tools.design.serve import WorkbenchServer

__all__ = [
    "AnalysedLoop",
    "BodeCurves",
    "CampaignError",
    "DataSet",
    "Designed",
    "Flight",
    "FlightRun",
    "GivenPoint",
    "LoadedCampaign",
    "LoadedScenario",
    "LocusCurves",
    "Log",
    "LogError",
    "Loop",
    "LoopValues",
    "Margins",
    "NicholsCurves",
    "Node",
    "OperatingPoint",
    "ScenarioError",
    "SensitivityCurves",
    "TimeCurves",
    "Verification",
    "WithImpacts",
    "WorkbenchServer",
    "WorstPoint",
    "bode",
    "builtin_names",
    "campaign",
    "fly",
    "from_rocketpy",
    "given_points",
    "impacts",
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
    "point_of_system",
    "read",
    "record",
    "replay",
    "vehicle",
    "verify",
    "workbench",
    "worst_point",
]
_HOMES = {
    "maxq.design.laws.design_file": ("load_design",),
    "maxq.design.loop.loop": ("Loop",),
    "maxq.design.loop.multiloop": ("multiloops",),
    "maxq.design.margins.measure": ("Margins", "margins"),
    "maxq.design.margins.multiloop": ("multiloop_margins",),
    "maxq.design.model.given": ("GivenPoint", "point_of_matrices"),
    "maxq.design.model.given_file": ("given_points",),
    "maxq.design.model.given_system": ("point_of_system",),
    "maxq.design.model.node": ("Node",),
    "maxq.design.model.operating_point": ("OperatingPoint",),
    "maxq.design.optimise.response_goals": ("LoopValues",),
    "maxq.design.operating_points": ("nodes",),
    "maxq.design.verify.verify": ("Verification",),
    "maxq.design.verify.worst_given": ("WorstPoint", "worst_point"),
    "maxq.sim.campaign.analysis": ("DataSet",),
    "maxq.sim.campaign.error": ("CampaignError",),
    "maxq.sim.campaign.read": ("LoadedCampaign",),
    "maxq.sim.log.head": ("LogError",),
    "maxq.sim.log.reader": ("Log",),
    "maxq.sim.run.flight": ("Flight",),
    "maxq.sim.run.fly": ("FlightRun",),
    "maxq.sim.run.impact_channels": ("WithImpacts",),
    "maxq.sim.run.record": ("record",),
    "maxq.sim.input.errors": ("ScenarioError",),
    "maxq.sim.input.files": ("builtin_names",),
    "maxq.sim.scenario.loader": ("LoadedScenario",),
    "maxq.tools.design.analysed_loop": (
        "AnalysedLoop",
        "BodeCurves",
        "LocusCurves",
        "NicholsCurves",
        "SensitivityCurves",
        "TimeCurves",
        "loops",
    ),
    "maxq.tools.design.designed": ("Designed",),
    "maxq.tools.design.serve": ("WorkbenchServer",),
}
"""The modules that define the names which this module only exports."""

if not os.path.isdir(os.path.join(__path__[0], "control")):
    # in an editable installation, the layers are next to this folder and not below it
    __path__.append(os.path.dirname(__path__[0]))


def load(path: str | Path, *overrides: str) -> LoadedScenario | LoadedCampaign:
    """Load a scenario or a campaign with all files that it names, and check it.

    :param path: TOML file, or the name of a built-in scenario or campaign.
    :param overrides: Changes of keys, such as ``"run.duration_s=10"``; ``"KEY="`` removes a key.
    :returns: The campaign if the file has a table [campaign], else the scenario.
    :raises ScenarioError: If a file or an override is invalid.
    """
    from maxq.sim.campaign.read import load_campaign
    from maxq.sim.scenario.loader import is_campaign, load_scenario

    if is_campaign(path):
        return load_campaign(path, overrides)
    return load_scenario(path, overrides).telling(overrides)


def fly(scenario: LoadedScenario | str | Path, *overrides: str, folder: str | Path | None = None) -> Flight:
    """Fly a scenario.

    The first flight of an installation compiles the simulator, which takes about twenty seconds.

    :param scenario: Loaded scenario, TOML file, or the name of a built-in scenario.
    :param overrides: Changes of keys, such as ``"wind.speed_mps=5"``. For a loaded scenario, give them to :func:`load`.
    :param folder: Folder for the log and the summary of the flight. By default, nothing is written.
    :returns: The flight with its events, metrics and verdicts. Its channels over time are in memory or, with `folder`,
        in the log only (:func:`read`).
    :raises ScenarioError: If the scenario is invalid.
    :raises LogError: If the log or the summary cannot be written.
    :raises ValueError: If overrides are given for a loaded scenario.
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
    """Fly a campaign of dispersed flights, or those of its runs that are missing in its folder.

    The data set is the same, bit by bit, for any number of workers.

    :param of: Loaded campaign, TOML file, or the name of a built-in campaign.
    :param folder: Folder of the data set. The default is runs/NAME, with the name of the campaign.
    :param runs: Number of runs, in place of that of the campaign.
    :param seed: Seed of all draws, in place of that of the campaign.
    :param workers: Number of threads of this process. The default is one for each core.
    :param cluster: Client of dask.distributed, or the address of a scheduler (``tcp://head:8786``), whose workers fly
        the runs in place of threads. A client remains open.
    :returns: The data set of the campaign.
    :raises ScenarioError: If the campaign file is invalid.
    :raises CampaignError: If the folder is in use, cannot be written, or contains other data.
    :raises ValueError: If both `workers` and `cluster` are given.
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
    """Read the results of a flight or a campaign.

    :param path: Log, folder of a flight, or folder of a campaign.
    :returns: The data set if the folder contains a campaign, else the log.
    :raises LogError: If the log cannot be read. A truncated log is read up to its last intact part.
    :raises CampaignError: If the data set cannot be read.
    """
    from pathlib import Path

    from maxq.sim.campaign.analysis import DataSet
    from maxq.sim.campaign.store import MANIFEST, campaign_in
    from maxq.sim.log.reader import read_log
    from maxq.sim.run.record import LOG_NAME

    place = Path(path)
    if (place / MANIFEST).is_file():
        return DataSet(place, campaign_in(place))
    return read_log(place / LOG_NAME if place.is_dir() else place)


def impacts(of: Flight | Log, ballistic_kgpm2: float | None = None) -> WithImpacts:
    """Return a flight with the channels of its instantaneous impact points, and with the drop points of its stages.

    The channels are ``impact_latitude_deg``, ``impact_longitude_deg`` and ``impact_fall_s`` in vacuum, on a Kepler
    ellipse without J2. The method ``drop_points()`` lists the points of dropped stages, boosters and fairings.

    :param of: Flight with log rows, or log.
    :param ballistic_kgpm2: m / (C_D A), kg/m2: adds channels ``impact_drag_...`` with drag, J2 and wind.
    :raises LogError: If a log contains no scenario.
    """
    from maxq.sim.run.impact_channels import WithImpacts

    return WithImpacts(of, ballistic_kgpm2)


def plot(of: Flight | Log, *names: str) -> Figure:
    """Draw channels over time, with a panel for each unit and the events of the flight as dotted lines.

    :param of: Flight or log.
    :param names: Channels or topics, such as ``"mach"`` or ``"/truth"``. Without names, the key channels are drawn.
    :returns: A Matplotlib figure, which a notebook shows and `.savefig(path)` writes.
    :raises KeyError: If a name is unknown.
    """
    from maxq.tools.plots.channels import channel_plot

    return channel_plot(of, names)


def replay(*places: str | Path, save: str | Path | None = None) -> None:
    """Show flights in the Rerun viewer, or save them as a Rerun recording.

    :param places: Logs, folders of flights, or folders of campaigns.
    :param save: File (.rrd) for the recording. By default, a window is opened; the function returns when it is closed.
    :raises maxq.tools.replay.viewer.ReplayError: If no flight can be read, or if there is no viewer or no display.
    """
    from maxq.tools import simreplay

    simreplay.show([str(place) for place in places] + (["--save", str(save)] if save is not None else []))


def vehicle(layout: str | Path, folder: str | Path | None = None) -> Path:
    """Build a vehicle from a layout.

    The folder contains `scenario.toml` to fly, `case.toml` to optimise, `suite.toml` to verify and `campaign.toml`. In
    contrast to the command `simvehicle`, the first gains are not checked along their own flight.

    :param layout: TOML file, or the name of a built-in layout.
    :param folder: Folder of the vehicle. The default is runs/NAME, with the name of the layout.
    :returns: The folder.
    :raises ScenarioError: If the layout is invalid.
    :raises ValueError: If the vehicle cannot fly.
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


def from_rocketpy(
    rocket: Any, flight: Any = None, *, environment: Any = None, name: str = "rocket", folder: str | Path | None = None
) -> Path:
    """Build an unguided vehicle from a RocketPy rocket with a solid motor.

    The folder contains `scenario.toml`, a flight to the apogee, and `layout.toml`. Its comments state which data were
    taken, assumed and missing. The drag is that of the rocket; the normal force of nose, tails and fins is computed.

    :param rocket: `rocketpy.Rocket` with a `SolidMotor`, a nose, and tails, trapezoidal or elliptical fins.
    :param flight: `rocketpy.Flight`, whose rail and environment are used (default: a vertical rail of 5 m).
    :param environment: `rocketpy.Environment`, whose place is used instead of that of the flight.
    :param name: Name of the vehicle.
    :param folder: Folder of the vehicle (default: runs/NAME).
    :returns: The folder.
    :raises ScenarioError: If the rocket cannot be imported.
    :raises ValueError: If the vehicle cannot fly.
    """
    from pathlib import Path

    from maxq.sim.files import plain_name
    from maxq.tools.vehicle.airframe_layout import write_layout
    from maxq.tools.vehicle.rocketpy_objects import read_rocketpy

    place = Path(folder) if folder is not None else Path("runs") / plain_name(name, "vehicle")
    return vehicle(write_layout(read_rocketpy(rocket, flight, environment, name=name), place), place)


def optimise(
    case: str | Path,
    *overrides: str,
    points: Sequence[GivenPoint] | None = None,
    functions: Mapping[str, Callable[[LoopValues], Any]] | None = None,
) -> Designed:
    """Optimise the gain schedules and the bending filter of a case (`simdesign`).

    :param case: TOML file, or the name of a built-in case.
    :param overrides: Changes of keys, such as ``"limits.gain_margin_db=7"``.
    :param points: Operating points in place of the scenario or the points of the case (:func:`point_of_system`).
    :param functions: Functions of a loop by the names that goals of the case state as `function`. Each is called with
        the `LoopValues` of a loop, returns a number, and is differentiated by complex steps.
    :returns: The design with its limits and margins. `meets_limits` is False if it misses a limit of the case.
    :raises ScenarioError: If the case is invalid.
    :raises ValueError: If no design of the case can be computed, for example without an operating point.
    """
    from maxq.design.optimise.response_goals import registered
    from maxq.tools.design.designed import designed

    with registered(functions or {}):
        return designed(case, overrides, points)


def verify(design: str | Path, suite: str | Path = "standard", *overrides: str) -> Verification:
    """Judge a design by a suite (`simverify`).

    Parts with results from an earlier call are recalled, and a sample of them is computed again and compared.

    :param design: Design file, folder with a design.toml, or the name of a built-in design.
    :param suite: TOML file, or the name of a built-in suite.
    :param overrides: Changes of keys of the suite, such as ``"margins.cases=1000"``.
    :returns: The verification, with the verdict in `judgement` and the judged requirements.
    :raises ScenarioError: If the design or the suite is invalid. Nothing is flown in this case.
    :raises maxq.sim.files.FileError: If the ledger cannot be written, or if a recalled result differs from its
        computation.
    """
    from maxq.design.laws.design_file import design_path
    from maxq.design.verify import memory
    from maxq.design.verify.suite import read_suite
    from maxq.design.verify.verify import verify as verify_design

    return verify_design(design_path(str(design)), read_suite(str(suite), overrides), memory=memory.default_folder())


def workbench(
    design: str | Path,
    scenario: str | Path | None = None,
    times_s: Sequence[float] = (),
    *,
    points: str | None = None,
    also: Sequence[str] = (),
    folder: str | Path = ".",
    port: int = 0,
) -> WorkbenchServer:
    """Serve a page on which gains and filter of a design are changed by hand (`simdesign open`).

    A notebook shows the page if its browser runs on the machine of its kernel.

    :param design: Design file, folder with a design.toml, or the name of a built-in design.
    :param scenario: Scenario whose flight contains the operating points. The default is the scenario of the design.
    :param times_s: Vehicle times of the operating points, s. The default is the times of the design.
    :param points: File of published derivatives in place of a scenario.
    :param also: Further designs to draw.
    :param folder: Folder in which trials are saved.
    :param port: Port on this machine. The default is a free one.
    :returns: The server, with the address in `url` and the design last shown in `trial`. It runs until `close()`.
    :raises ScenarioError: If a design, the scenario or the file is invalid.
    """
    from maxq.tools.design.report import AnalysisOrder
    from maxq.tools.design.serve import WorkbenchServer, workbench_of

    given = {"scenario": scenario and str(scenario), "times_s": tuple(map(float, times_s)), "points": points}
    chosen: dict[str, Any] = {key: value for key, value in given.items() if value}
    order = AnalysisOrder(design=str(design), given=tuple(chosen), **chosen)
    return WorkbenchServer(workbench_of(order, tuple(map(str, also)), str(folder)), port)


def bode(
    design: str | Path,
    time_s: float,
    scenario: str | Path = "nominal",
    plane: Plane = "pitch",
    kind: LoopKind = "sampled",
) -> Figure:
    """Draw the Bode, Nichols and Nyquist plots of a design's loop at one operating point on one sheet.

    :param design: Design file, folder with a design.toml, or the name of a built-in design.
    :param time_s: Vehicle time of the operating point, s.
    :param scenario: Scenario whose flight contains the operating point: TOML file, or the name of a built-in scenario.
    :param plane: ``"pitch"`` or ``"yaw"``.
    :param kind: Model of the computer, as in :func:`loop`.
    :returns: A Matplotlib figure, which a notebook shows and `.savefig(path)` writes.
    :raises ScenarioError: If the design or the scenario is invalid.
    :raises ValueError: If the time is outside the powered flight, or if a value is not allowed.
    """
    from maxq.tools.design.designed import loop_figure

    return loop_figure(str(design), time_s, scenario, plane, kind)


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
) -> AnalysedLoop:
    """Return the open loop of a design at one operating point.

    :param where: Operating point with its own time and plane (:func:`nodes`, :func:`given_points`,
        :func:`point_of_matrices`), or scenario: loaded, a TOML file, or the name of a built-in scenario.
    :param design: Loaded design, file, or the name of a built-in design. The default is the design of the scenario.
    :param time_s: Vehicle time of the operating point along the flight of the scenario, s.
    :param plane: ``"pitch"`` or ``"yaw"``, for a scenario.
    :param kind: Model of the computer: ``"sampled"`` as it runs, ``"pade"`` with the paper's continuous approximations,
        or ``"exact"`` with exact continuous factors and no aliasing.
    :param cut: Point at which the loop is opened: ``"gimbal_command"``, or the paper's ``"rate_command_to_q"`` and
        ``"rate_command_to_q_m"`` (eq. 42). The latter two give no information about stability.
    :param errata: Errata of the paper to correct, for a scenario: a preset (``"corrected"``, ``"paper"``) or switches.
    :param plant: Plant for a scenario: ``"flown"``, or ``"table2"`` with the derivatives of the paper's Table 2.
    :returns: The loop, with its margins, responses and plots as methods.
    :raises ScenarioError: If the scenario or the design is invalid.
    :raises ValueError: If `design` or `time_s` is missing, if the time is outside the powered flight, or if a value is
        not allowed.
    """
    from pathlib import Path

    from maxq.design.laws.design_file import load_design
    from maxq.design.model.given import GivenPoint
    from maxq.design.model.operating_point import OperatingPoint
    from maxq.design.operating_points import nodes
    from maxq.sim.scenario.loader import load_scenario, read_design
    from maxq.sim.scenario.schema_design import Design
    from maxq.tools.design.analysed_loop import loops

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
