"""The map of a campaign's drop zones: an overview from the launch site, and each zone to scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from maxq.sim.campaign.drop_zones import LEVEL, DropZone
from maxq.sim.scenario.schema_environment import Site
from maxq.sim.scenario.schema_scenario import Geodetic, Scenario
from maxq.tools.plots.campaign import replay
from maxq.tools.plots.figures import Panel, Plot, line, points, shape


def zone_cells(zone: DropZone) -> tuple[str, ...]:
    """Return a zone as cells of a table."""
    major, minor = zone.axes_m
    ellipse = f"{major / 1e3:.3g} by {minor / 1e3:.3g} km" if math.isfinite(major) else ""
    azimuth = f"{zone.azimuth_deg:.0f} deg" if math.isfinite(major) else ""
    place = f"{zone.latitude_deg:.4f} deg", f"{zone.longitude_deg:.4f} deg"
    return zone.name, zone.model, str(len(zone.runs)), *place, ellipse, azimuth


def drop_plots(zones: Sequence[DropZone], scenario: Scenario, folder: Path) -> list[Plot]:
    """Return the map of drop zones as a list with one figure, or an empty list without zones."""
    if not zones:
        return []
    place = scenario.initial.geodetic if scenario.initial is not None else None
    panels = [_overview(zones, place or scenario.site), *(_zone(zone) for zone in zones)]
    caption = (
        "Overview: mean drop points, and straight lines from the start of the flight. Other panels are to scale "
        f"about the mean point; the ellipse contains the next point with a probability of {100 * LEVEL:.0f} %."
    )
    return [Plot("drops", "Drop zones", panels, caption, columns=2, height=260, command=replay(folder, "{}"))]


def _overview(zones: Sequence[DropZone], site: Site | Geodetic) -> Panel:
    series = []
    for zone in zones:
        near = site.longitude_deg + (zone.longitude_deg - site.longitude_deg + 180.0) % 360.0 - 180.0
        way = [site.longitude_deg, near], [site.latitude_deg, zone.latitude_deg]
        series += [
            line(*way, faint=True, colour="grey"),
            points([near], [zone.latitude_deg], zone.name, colour="red", labels=[zone.name]),
        ]
    start = points([site.longitude_deg], [site.latitude_deg], "start", colour="ink", labels=["start"])
    return Panel("overview", [*series, start], "longitude, deg", "latitude, deg")


def _zone(zone: DropZone) -> Panel:
    east, north = zone.east_m / 1e3, zone.north_m / 1e3
    series = [points(east, north, "runs", runs=zone.runs.tolist())]
    if math.isfinite(zone.axes_m[0]):
        outline = shape(zone.outline_m() / 1e3, f"{100 * LEVEL:.0f} %", colour="red")
        series.append(outline)
    reach = 1.1 * max(float(np.abs([east, north]).max()), (zone.axes_m[0] if series[1:] else 0.0) / 1e3, 1e-3)
    ends = (-reach, reach)
    return Panel(zone.name, series, "east, km", "north, km", ends, ends, equal=True)
