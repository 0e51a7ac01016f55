"""What stands beside the pictures in words: what flew, how it ended, what is drawn larger than it is."""

from __future__ import annotations

from collections.abc import Sequence

from maxq.sim.flight.channels import ChannelTable
from maxq.tools.replay.earth_frame import LaunchSite
from maxq.tools.replay.flight import ReplayFlight, Requirement
from maxq.tools.replay.scene import Exaggeration

_VERDICTS = {"passed": "passed", "failed": "FAILED", "unknown": "no verdict: there is no summary.json beside the log"}


def about_flight(flight: ReplayFlight, exaggeration: Exaggeration | None, place: LaunchSite | None = None) -> str:
    """A Markdown page on one flight."""
    data = flight.log.metadata
    lines = [f"# {flight.label}", "", data.get("description", ""), ""]
    lines += [f"**Outcome:** {flight.outcome} at {flight.span_s[1]:.1f} s, {_VERDICTS[flight.verdict]}", ""]
    lines += _facts(flight) + _notes(flight.notes) + _requirements(flight.requirements)
    if exaggeration is not None:
        lines += drawn_text(exaggeration, place)
    return "\n".join(lines)


def about_flights(flights: Sequence[ReplayFlight], exaggeration: Exaggeration | None) -> str:
    """A Markdown page on several flights."""
    lines = [f"# {len(flights)} flights", "", "| flight | outcome | verdict |", "|---|---|---|"]
    lines += [f"| {f.label} | {f.outcome} at {f.span_s[1]:.1f} s | {f.verdict} |" for f in flights]
    notes = [f"{f.label}: {note}" for f in flights for note in f.damage]
    lines += ["", "Green: passed. Red: failed. Blue: no verdict known. Purple: the nominal.", ""]
    lines += _notes(notes)
    return "\n".join(lines + (drawn_text(exaggeration) if exaggeration is not None else []))


def _facts(flight: ReplayFlight) -> list[str]:
    data = flight.log.metadata
    facts = [
        ("vehicle", data.get("vehicle", "")),
        ("design", data.get("design", "")),
        ("seed", data.get("seed", "")),
        ("T0", data.get("t0_utc", "")),
        ("site", f"{data.get('site_latitude_deg', '?')} N, {data.get('site_longitude_deg', '?')} E"),
        ("maxq", f"{data.get('maxq', '?')}, log schema {data.get('schema', '?')}"),
        ("log", flight.path.name),
    ]
    return ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in facts if value), ""]


def _notes(notes: Sequence[str]) -> list[str]:
    return ["## What is missing", "", *(f"- {note}" for note in notes), ""] if notes else []


def _requirements(requirements: Sequence[Requirement]) -> list[str]:
    if not requirements:
        return []
    lines = ["## Requirements", ""]
    for r in requirements:
        bound = f"{r.limit:g} at most" if r.limit is not None else f"{r.minimum:g} at least"
        unit = "" if r.unit == "1" else f" {r.unit}"
        value = f"{plain(r.value)}{unit}, " if isinstance(r.value, float | int) else ""
        met = "" if r.met is None else ": met" if r.met else ": **MISSED**"
        lines.append(f"- {r.name}{met} ({value}{bound})")
    return [*lines, ""]


def plain(value: float) -> str:
    """Four digits that count, without powers of ten."""
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"


def factors_text(exaggeration: Exaggeration, table: ChannelTable) -> str:
    """The factors in a few words, of what the vehicle has."""
    parts = [f"bending x{exaggeration.bending:g}"] if any(name.startswith("eta_") for name in table.names) else []
    parts += [f"slosh x{exaggeration.slosh:g}"] if any(name.startswith("slosh_") for name in table.names) else []
    return ", ".join(parts)


def drawn_text(exaggeration: Exaggeration, place: LaunchSite | None = None) -> list[str]:
    """How true the picture is."""
    moved = ["- Axes: east, north, up where the flight began, which is far from the site."]
    return [
        "## How it is drawn",
        "",
        f"- Bending is drawn **{exaggeration.bending:g} times** as large as it is, "
        f"at most {exaggeration.most_m:.2g} m of it.",
        f"- Slosh angles are drawn **{exaggeration.slosh:g} times** as large; a surface stands across its pendulum.",
        "- The gimbal's angle, attitude and trajectory are true to scale.",
        "- Thrust pushes at the nozzle, its length goes by the root of the force. Green: direction of flight over the "
        "ground. Blue: the wind, a vehicle's length for 60 m/s and for more.",
        *(moved if place is not None and place.moved else []),
        "- The ground is drawn under the vehicle; the simulation begins with the CG at the site's altitude.",
        "- Red, green and blue axes: x, y and z of the body, from its CG.",
        "- Skin, nose and fins follow the file of the vehicle; what it does not say has customary proportions.",
        "",
    ]
