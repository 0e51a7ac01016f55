"""Maps of a flight as KML (OGC 2.2) and GeoJSON (RFC 7946): trajectory, trace of impact points, and drop points.

Longitude and latitude are geodetic, in degrees on WGS 84. Altitudes are ellipsoidal. KML readers take them as altitudes
above the geoid, which differs from the ellipsoid by up to 107 m.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.campaign.drop_zones import LEVEL, DropZone, radii_m
from maxq.sim.files import whole_file, write_whole
from maxq.sim.log.head import LogError
from maxq.sim.run.impact_channels import VACUUM_TOPIC, DropPoint, WithImpacts

_KML = "http://www.opengis.net/kml/2.2"
_PERIOD_s = 1.0
_DECIMALS = 7, 3  # of degrees (1 cm) and metres
_COLOURS = {"trajectory": "ff00a5ff", "impact": "ff0000ff", "impact with drag": "ffff00ff"}  # aabbggrr


@dataclass(frozen=True)
class Feature:
    """A line, a point or an area of a map.

    `places` (n, 2) or (n, 3) has longitude, latitude (deg) and, in the air, altitude (m). An area has its corners,
    anticlockwise, the last equal to the first.
    """

    name: str
    kind: str
    places: Array
    about: dict[str, Any]
    is_area: bool = False

    @property
    def is_point(self) -> bool:
        return len(self.places) == 1


def features_of(flight: WithImpacts) -> list[Feature]:
    """Return the trajectory, the traces of impact points, the events and the drop points of a flight.

    Lines have a point per second. Raises LogError on a flat Earth, and for a log without positions.
    """
    if VACUUM_TOPIC not in flight.topics:
        raise LogError("a map needs a round Earth with central gravitation: earth.shape = 'wgs84' or 'sphere'")
    place = np.stack([flight[name] for name in ("longitude_deg", "latitude_deg", "altitude_m")], axis=1)
    times = flight.time_s("longitude_deg")
    found = [_line("trajectory", "trajectory", times, place, {"altitude": "above the WGS 84 ellipsoid, m"})]
    kinds = [("impact", "impact_", "vacuum, Kepler ellipse")]
    if flight.ballistic_kgpm2 is not None:
        kinds.append(("impact with drag", "impact_drag_", f"m / (C_D A) = {flight.ballistic_kgpm2:g} kg/m2"))
    for name, prefix, model in kinds:
        trace = np.stack([flight[f"{prefix}{axis}_deg"] for axis in ("longitude", "latitude")], axis=1)
        line = _line(f"{name} points", name, flight.time_s(f"{prefix}latitude_deg"), trace, {"model": model})
        found += [line] if len(line.places) > 1 else []
    for event in flight.source.events:
        time_s = event.time_ns / 1e9
        at = [[np.interp(time_s, times, _continuous(column)) for column in place.T]]
        about = {"time_s": time_s, "event": event.text}
        found.append(Feature(event.text.partition(":")[0], "event", np.array(at), about))
    found += [_drop(point) for point in flight.drop_points() if math.isfinite(point.fall_s)]
    return found


def zone_features(zones: Sequence[DropZone]) -> list[Feature]:
    """Return the drop points of the runs of a campaign, and the ellipse of each zone."""
    found = []
    for zone in zones:
        start = np.array([zone.longitude_deg, zone.latitude_deg])
        east_m, north_m = radii_m(zone.earth.equatorial_radius_m, zone.earth.flattening, math.radians(start[1]))
        scale = np.degrees([1.0 / east_m, 1.0 / north_m])
        major, minor = (round(axis, 1) for axis in zone.axes_m)
        about = {"model": zone.model, "runs": len(zone.runs), "probability": LEVEL, "semi_axes_m": [major, minor]}
        if math.isfinite(major):
            ring = start + scale * zone.outline_m()[::-1]
            found.append(Feature(f"drop zone of {zone.name}", "zone", ring, about, is_area=True))
        for run, east, north in zip(zone.runs.tolist(), zone.east_m, zone.north_m, strict=True):
            place = start + scale * [east, north]
            found.append(Feature(f"{zone.name}, run {run}", "drop", place[None, :], {"run": run, "model": zone.model}))
    return found


def _line(name: str, kind: str, times: Array, places: Array, about: dict[str, Any]) -> Feature:
    k = np.flatnonzero(np.diff(np.floor(times / _PERIOD_s), prepend=-1.0))
    k = np.union1d(k, [len(times) - 1]) if len(times) else k
    k = k[np.isfinite(places[k]).all(axis=1)]
    span = {"start_s": float(times[k[0]]), "end_s": float(times[k[-1]])} if len(k) else {}
    return Feature(name, kind, places[k], about | span)


def _drop(point: DropPoint) -> Feature:
    body = point.body
    model = "vacuum" if body.ballistic_kgpm2 is None else f"m / (C_D A) = {body.ballistic_kgpm2:g} kg/m2"
    about = {"time_s": body.time_s, "fall_s": point.fall_s, "model": model}
    return Feature(f"drop of {body.name}", "drop", np.array([[point.longitude_deg, point.latitude_deg]]), about)


def _continuous(column: Array) -> Array:
    return np.unwrap(column, period=360.0)


def write_geojson(path: Path, features: Sequence[Feature]) -> None:
    """Write features as a FeatureCollection; lines that cross the antimeridian are cut there (RFC 7946, 3.1.9)."""
    collection = {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "properties": {"name": feature.name, "kind": feature.kind, **feature.about},
                "geometry": _geometry(feature),
            }
            for feature in features
        ],
    }
    write_whole(path, json.dumps(collection, indent=1) + "\n")


def _geometry(feature: Feature) -> dict[str, Any]:
    if feature.is_point:
        return {"type": "Point", "coordinates": _rounded(feature.places)[0]}
    if feature.is_area:
        return {"type": "Polygon", "coordinates": [_rounded(feature.places)]}
    parts = [_rounded(part) for part in _cut(feature.places)]
    if len(parts) == 1:
        return {"type": "LineString", "coordinates": parts[0]}
    return {"type": "MultiLineString", "coordinates": parts}


def _cut(places: Array) -> Iterator[Array]:
    """Yield the parts of a line (n, 2 or 3) on each side of the antimeridian, with a point on it at both ends."""
    longitude = _continuous(places[:, 0])
    whole = np.column_stack([longitude, places[:, 1:]])
    sheet = np.floor((longitude + 180.0) / 360.0)
    start: list[Array] = []
    first = 0
    for k in np.flatnonzero(np.diff(sheet)):
        edge = 360.0 * max(sheet[k], sheet[k + 1]) - 180.0
        share = (edge - longitude[k]) / (longitude[k + 1] - longitude[k])
        at = whole[k] + share * (whole[k + 1] - whole[k])
        yield np.vstack([*start, whole[first : k + 1], at]) - np.eye(whole.shape[1])[0] * 360.0 * sheet[k]
        start, first = [at], int(k) + 1
    yield np.vstack([*start, whole[first:]]) - np.eye(whole.shape[1])[0] * 360.0 * sheet[-1]


def _rounded(places: Array) -> list[list[float]]:
    degrees, metres = _DECIMALS
    return [[round(float(x), metres if i == 2 else degrees) for i, x in enumerate(row)] for row in places]


def write_kml(path: Path, name: str, features: Sequence[Feature]) -> None:
    """Write features as a KML document: absolute altitudes in the air, and points and traces on the ground."""
    root = ElementTree.Element("kml", xmlns=_KML)
    document = _child(root, "Document")
    _child(document, "name", name)
    for kind, colour in _COLOURS.items():
        style = _child(document, "Style", id=kind.replace(" ", "-"))
        line = _child(style, "LineStyle")
        _child(line, "color", colour)
        _child(line, "width", "2")
    for feature in features:
        mark = _child(document, "Placemark")
        _child(mark, "name", feature.name)
        _child(mark, "description", "; ".join(f"{key}: {value}" for key, value in feature.about.items()))
        if feature.kind in _COLOURS:
            _child(mark, "styleUrl", f"#{feature.kind.replace(' ', '-')}")
        kind = "Polygon" if feature.is_area else "Point" if feature.is_point else "LineString"
        shape = _child(mark, kind)
        in_air = feature.places.shape[1] == 3
        if not feature.is_point and not in_air:
            _child(shape, "tessellate", "1")
        _child(shape, "altitudeMode", "absolute" if in_air else "clampToGround")
        if feature.is_area:
            shape = _child(_child(shape, "outerBoundaryIs"), "LinearRing")
        _child(shape, "coordinates", " ".join(",".join(map(repr, row)) for row in _rounded(feature.places)))
    ElementTree.indent(root)
    with whole_file(path) as part:
        ElementTree.ElementTree(root).write(part, "utf-8", xml_declaration=True)


def _child(parent: ElementTree.Element, tag: str, text: str = "", **attributes: str) -> ElementTree.Element:
    child = ElementTree.SubElement(parent, tag, attributes)
    child.text = text or None
    return child
