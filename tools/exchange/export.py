"""The subcommand `simrun export LOG`: a flown flight as tables, maps and orbit messages."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path

from maxq.sim.campaign.analysis import DataSet
from maxq.sim.campaign.drop_zones import drop_zones
from maxq.sim.campaign.store import MANIFEST, campaign_in
from maxq.sim.files import check_writable
from maxq.sim.log.head import LogError
from maxq.sim.log.reader import Log, read_log
from maxq.sim.run.impact_channels import WithImpacts
from maxq.sim.run.record import LOG_NAME
from maxq.tools.cli.frame import CommandError, Exit
from maxq.tools.cli.terminal import tell
from maxq.tools.exchange.maps import Feature, features_of, write_geojson, write_kml, zone_features
from maxq.tools.exchange.orbit_messages import MessageFrame, OrbitMessages

KINDS = ("csv", "mat", "hdf5", "kml", "geojson", "oem", "opm")
"""The options that write a file of a flight, and the ends of the files' names."""


def execute(
    place: str,
    *,
    channels: tuple[str, ...] = (),
    ballistic: float | None = None,
    utc: str = "",
    frame: MessageFrame = "TEME",
    **files: str,
) -> int:
    """Write the files of KINDS given in `files`, and print a line for each.

    Raises CommandError for a place that is no log or a channel that the log lacks, and LogError for an unusable log.
    """
    paths = {kind: _checked(kind, files[kind]) for kind in KINDS if kind in files}
    if (Path(place) / MANIFEST).is_file():
        return _zones(place, paths)
    log = logged_flight(place, "export")
    for note in log.notes:
        tell(f"warning: {place}: {note}")
    flight = WithImpacts(log, ballistic)
    found: list[Feature] = []
    writers: dict[str, Callable[[Path], str]] = {
        "csv": lambda path: _table(flight, path, channels, flight.to_csv),
        "mat": lambda path: _table(flight, path, channels, flight.to_mat),
        "hdf5": lambda path: _table(flight, path, channels, flight.to_hdf5),
        "kml": lambda path: _map(found, flight, lambda: write_kml(path, log.metadata.get("scenario", ""), found)),
        "geojson": lambda path: _map(found, flight, lambda: write_geojson(path, found)),
        "oem": lambda path: _ephemeris(flight, utc, frame, path),
        "opm": lambda path: _insertion(flight, utc, frame, path),
    }
    for kind, path in paths.items():
        try:
            tell(f"{path}: {writers[kind](path)}")
        except KeyError as error:
            raise CommandError(f"{place}: {error.args[0]}") from None
        except ImportError as error:
            raise CommandError(f"--{kind} needs the extra hdf5 ({error}): pip install 'maxq[hdf5]'") from None
    return Exit.OK


def _zones(place: str, paths: dict[str, Path]) -> int:
    """Write the map of a campaign's drop zones. Raises CommandError for other files, and without drop points."""
    if others := [kind for kind in paths if kind not in ("kml", "geojson")]:
        raise CommandError(
            f"--{others[0]}: {place} is a campaign, whose drop zones are exported by --kml and --geojson"
        )
    data = DataSet(Path(place), campaign_in(Path(place)))
    zones = drop_zones(data)
    if not zones:
        raise CommandError(f"{place}: no run has a drop point: the vehicle drops nothing that reaches the ground")
    features = zone_features(zones)
    for kind, path in paths.items():
        if kind == "kml":
            write_kml(path, data.campaign.name, features)
        else:
            write_geojson(path, features)
        tell(f"{path}: {', '.join(zone.name for zone in zones)}: {len(data.runs)} runs")
    return Exit.OK


def _checked(kind: str, name: str) -> Path:
    path = Path(name)
    if path.suffix.lower() != f".{kind}":
        raise CommandError(f"--{kind} {name}: the name of this file ends with .{kind}")
    check_writable(path.parent)
    return path


def logged_flight(place: str, task: str) -> Log:
    """Return the log at a path or in a folder. Raises CommandError for another file, and LogError.

    `task` is the word for what is to be done with the log, in messages.
    """
    path = Path(place) / LOG_NAME if Path(place).is_dir() else Path(place)
    if path.suffix != ".mcap":
        fly = f"simrun fly {shlex.quote(place)}"
        raise CommandError(f"{place} is no log: fly the scenario first ({fly}), then {task} its {LOG_NAME}")
    if not path.exists():
        raise LogError(f"{path}: the log cannot be read: no such file")
    return read_log(path)


def _table(flight: WithImpacts, path: Path, channels: tuple[str, ...], write: Callable[..., Path]) -> str:
    write(path, *channels)
    count = len(flight.channels_in(channels)) if channels else len(flight.channels)
    return f"{count} channel{'s' * (count != 1)}"


def _map(found: list[Feature], flight: WithImpacts, write: Callable[[], None]) -> str:
    if not found:
        found += features_of(flight)
    write()
    drops = [feature for feature in found if feature.kind == "drop"]
    lines = ", ".join(feature.name for feature in found if not feature.is_point)
    return f"{lines}; {len(drops)} drop point{'s' * (len(drops) != 1)}"


def _ephemeris(flight: WithImpacts, utc: str, frame: MessageFrame, path: Path) -> str:
    OrbitMessages(flight, utc or flight.loaded.scenario.site.utc, frame).write_oem(path)
    return f"ephemeris in {frame}"


def _insertion(flight: WithImpacts, utc: str, frame: MessageFrame, path: Path) -> str:
    at_s = OrbitMessages(flight, utc or flight.loaded.scenario.site.utc, frame).write_opm(path)
    return f"state at {at_s:.3f} s in {frame}"
