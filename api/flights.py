"""Flights, campaigns, vehicles: loaded, flown, read, shown."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from maxq.sim.campaign.analysis import DataSet
from maxq.sim.campaign.read import LoadedCampaign, load_campaign
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.campaign.store import MANIFEST, campaign_in
from maxq.sim.files import plain_name
from maxq.sim.log.reader import Log, read_log
from maxq.sim.run import fly as flying
from maxq.sim.run.flight import Flight
from maxq.sim.run.fly import FlightRun
from maxq.sim.run.record import LOG_NAME, record
from maxq.sim.scenario.loader import LoadedScenario, is_campaign, load_scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def load(path: str | Path, *overrides: str) -> LoadedScenario | LoadedCampaign:
    """A scenario or campaign: a file, or the name of a built-in one; `overrides` as "run.duration_s=10"."""
    if is_campaign(path):
        return load_campaign(path, overrides)
    return load_scenario(path, overrides).telling(overrides)


def fly(scenario: LoadedScenario | str | Path, *overrides: str, folder: str | Path | None = None) -> Flight:
    """Fly a scenario. With `folder`: log and summary are written there, and the channels are in the log (`read`).

    The first flight of an installation compiles the simulator (about twenty seconds).
    """
    if isinstance(scenario, LoadedScenario) and overrides:
        raise ValueError("overrides go with a scenario's name; load(name, *overrides) takes them")
    loaded = scenario if isinstance(scenario, LoadedScenario) else load_scenario(scenario, overrides)
    loaded = loaded.telling(overrides)
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


def plot(of: Flight | Log, *names: str) -> Figure:
    """Draw channels over time, those of one unit in one panel, with the events of the flight as dotted lines.

    `names`: channels or topics ("/truth"); none: the key channels. Returns a Matplotlib figure, which a notebook shows
    and `.savefig(path)` writes. Raises KeyError for an unknown name.
    """
    from maxq.tools.plots.channels import channel_plot  # noqa: PLC0415  # lazy: Matplotlib takes half a second

    return channel_plot(of, names)


def vehicle(layout: str | Path, folder: str | Path | None = None) -> Path:
    """Work out a vehicle from a layout, a file or a built-in one, into its folder (None: runs/NAME), which is returned.

    It holds `scenario.toml` to fly, `case.toml` to design, `suite.toml` to verify and `campaign.toml`. Raises
    ScenarioError, and ValueError for a layout that cannot fly.
    """
    from maxq.tools.vehicle.build import build  # noqa: PLC0415  # lazy: flights need none of it
    from maxq.tools.vehicle.files import write  # noqa: PLC0415  # lazy
    from maxq.tools.vehicle.layout import read_layout  # noqa: PLC0415  # lazy

    read = read_layout(layout)
    place = Path(folder) if folder is not None else Path("runs") / plain_name(read.name, "vehicle")
    write(build(read), place)
    return place


def replay(*places: str | Path, save: str | Path | None = None) -> None:
    """Show flights (logs, folders of flights or campaigns) in the viewer, or `save` them as a Rerun recording."""
    from maxq.tools import simreplay  # noqa: PLC0415  # lazy: rerun takes half a second

    simreplay.show([str(place) for place in places] + (["--save", str(save)] if save is not None else []))
