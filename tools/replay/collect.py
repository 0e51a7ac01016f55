"""Which flights a person means: logs, folders with one, and folders of campaigns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from maxq.tools.replay.error import ReplayError
from maxq.tools.replay.flight import LogShelf, ReplayFlight, open_flight

LOG_NAME = "flight.mcap"
KEPT = ("flights", "kept")  # folders of a campaign that hold whole flights
MOST = 200
"""Flights shown at once: more make a window nobody reads, and a lot of memory."""
FEW = 4
"""Flights of which every vehicle is drawn."""


def find_logs(places: Sequence[str]) -> list[tuple[Path, str]]:
    """Paths of logs with a label each. Raises ReplayError for a place that is none."""
    found: list[tuple[Path, str]] = []
    for place in places:
        path = Path(place)
        if path.is_dir():
            inside = _in_folder(path)
            if not inside:
                raise ReplayError(
                    f"{place}: no flight in this folder ({LOG_NAME}, {KEPT[0]}/run-.../{LOG_NAME}, or any .mcap)"
                )
            found += inside
        elif path.exists():
            found.append((path, ""))
        else:
            raise ReplayError(f"{place}: no such file or folder")
    unlike = {path.resolve(): (path, label) for path, label in reversed(found)}
    return list(reversed(unlike.values()))


def _in_folder(folder: Path) -> list[tuple[Path, str]]:
    """The nominal first, then the runs in the order of their names."""
    alone = folder / LOG_NAME
    kept = sorted(path for name in KEPT for path in (folder / name).glob(f"*/{LOG_NAME}"))
    if alone.is_file() and not kept:
        return [(alone, "")]
    logs = [*([alone] if alone.is_file() else []), *kept]
    if not kept:
        logs += sorted(folder.glob(f"*/{LOG_NAME}")) + sorted(p for p in folder.glob("*.mcap") if p != alone)
    logs.sort(key=lambda path: "nominal" not in _label(path, folder))
    return [(path, _label(path, folder)) for path in logs]


def _label(path: Path, folder: Path) -> str:
    """`run-000417` for kept/run-000417/flight.mcap, the file's stem for a bare log."""
    name = path.parent.name if path.name == LOG_NAME and path.parent != folder else path.stem
    return "nominal" if path == folder / LOG_NAME else name


def open_flights(places: Sequence[str], *, in_turn: bool = False) -> tuple[list[ReplayFlight], list[str]]:
    """All flights that can be read, and a complaint for each that cannot, or not whole.

    `in_turn`: the caller goes through them one after the other, so that the numbers of a few in memory will do.
    Raises ReplayError where none can be read.
    """
    logs = find_logs(places)
    flights: list[ReplayFlight] = []
    complaints: list[str] = []
    if len(logs) > MOST:
        complaints.append(f"{len(logs)} flights are too many to look at: the first {MOST} are shown")
        logs = logs[:MOST]
    shelf = LogShelf(FEW + 1 if in_turn else None)
    for path, label in logs:
        try:
            flights.append(open_flight(path, label, shelf))
        except ReplayError as error:
            complaints.append(str(error))
    if not flights:
        raise ReplayError("; ".join(complaints))
    flights = _unlike_labels(flights)
    near = closest(flights)
    for i, flight in enumerate(flights):
        complaints += [f"{flight.path}: {note}" for note in (flight.notes if i in near else flight.damage)]
    return flights, complaints


def is_nominal(flight: ReplayFlight) -> bool:
    """The undispersed flight that a campaign keeps among the others."""
    return "nominal" in flight.label.lower().split("/")[-1]


def closest(flights: Sequence[ReplayFlight]) -> set[int]:
    """Of which flights vehicle and limits are drawn: the nominal, those that failed, then the first ones."""

    def rank(i: int) -> tuple[bool, bool, int]:
        return not is_nominal(flights[i]), flights[i].verdict != "failed", i

    return set(sorted(range(len(flights)), key=rank)[:FEW])


def _unlike_labels(flights: list[ReplayFlight]) -> list[ReplayFlight]:
    """Labels that tell flights apart: with the folder's name where two are alike."""
    from dataclasses import replace  # noqa: PLC0415  # used here only

    labels = [flight.label for flight in flights]
    out = []
    for flight in flights:
        label = flight.label
        if labels.count(label) > 1:
            folder = flight.path.resolve().parent.name
            label = f"{folder}" if folder and folder != label else f"{label}, {flight.path}"
        out.append(replace(flight, label=label))
    seen: dict[str, int] = {}
    for i, flight in enumerate(out):
        seen[flight.label] = seen.get(flight.label, 0) + 1
        if seen[flight.label] > 1:
            out[i] = replace(flight, label=f"{flight.label} ({seen[flight.label]})")
    return out
