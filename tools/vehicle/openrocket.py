"""OpenRocket designs (.ork): a zipped rocket.ork, or in old versions the same XML with or without gzip.

Lengths are in m, masses in kg, angles in deg. The masses of components follow from their shapes and densities; walls
of noses and transitions are normal to the surface. Sources: the file format's documentation and example files of
OpenRocket 0.9 to 24.12; shapes of noses after G. A. Crowell, The Descriptive Geometry of Nose Cones (1996).
"""

from __future__ import annotations

import gzip
import io
import math
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn
from xml.etree.ElementTree import Element

import numpy as np
from scipy.optimize import brentq

from maxq.control.kernel.records import Array
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.files import Reading, shown
from maxq.sim.input.xml_tree import MOST_BYTES, XmlError, xml_tree
from maxq.tools.vehicle.airframe import (
    Airframe,
    AirframeStage,
    Body,
    FinSet,
    Motor,
    Piece,
    Planform,
    RadiusProfile,
    RealOrComplex,
    Remark,
    Solid,
    equivalent_trapezoid,
    joined_solids,
    polygon,
    revolved,
    tube,
)
from maxq.tools.vehicle.motor_file import SUFFIXES, MotorFile, read_motor

_BODIES = ("nosecone", "bodytube", "transition")
_FINS = ("trapezoidfinset", "ellipticalfinset", "freeformfinset")
_RINGS = ("innertube", "tubecoupler", "centeringring", "bulkhead", "engineblock")
_LOOSE = ("masscomponent", "shockcord", "parachute", "streamer", "launchlug", "railbutton", "tubefinset")
_KNOWN = (*_BODIES, *_FINS, *_RINGS, *_LOOSE)
_UNSUPPORTED = {
    "parallelstage": "boosters side by side are not imported; write them as [[stage.booster]] of a layout",
    "podset": "pods are not imported",
}
_FILLED = {"square": 1.0, "rounded": 0.99, "airfoil": 0.85, "double wedge": 0.5, "triangular": 0.5}
"""Shares of a fin's volume, span by chord by thickness, by its cross-section, as OpenRocket has them."""
_CLUSTERS = {"single": 1, "double": 2, "9-star": 9, "9-grid": 9}
_MODULUS_GPa = {
    "alumin": 69.0,
    "steel": 200.0,
    "titanium": 110.0,
    "carbon": 70.0,
    "kevlar": 30.0,
    "glass": 20.0,
    "g10": 20.0,
    "phenolic": 7.0,
    "ply": 9.0,
    "birch": 9.0,
    "spruce": 9.0,
    "bass": 9.0,
    "pine": 9.0,
    "balsa": 3.0,
}
_OTHER_GPa = 2.5  # cardboard, paper and most plastics
_MOST_INSTANCES = 200
_MOST = 1e6  # of any number, in the unit of the file
_LEAST_POINTS = 4  # of a drag curve from a stored simulation


def read_openrocket(path: Path, motors: Sequence[str] = (), configuration: str | None = None) -> Airframe:
    """Return the rocket of an OpenRocket design.

    `motors` are files of motors, FILE or DESIGNATION=FILE. Those next to the design are used, too, and thrust curves
    that the design contains. `configuration` is the identifier or name of a flight configuration (default: that of
    the design). Raises ScenarioError.
    """
    label = shown(path)
    root = _root(path, label)
    design = _Design(label, root, configuration)
    return design.airframe(_Motors(path, motors))


def _root(path: Path, label: str) -> Element:
    """Return the root element of a design. Raises ScenarioError for another file."""
    content = Reading().content(path, label)
    allowed = "an OpenRocket design (.ork)"
    try:
        if content[:2] == b"PK":
            content = _unzipped(content)
        elif content[:2] == b"\x1f\x8b":
            with gzip.GzipFile(fileobj=io.BytesIO(content)) as packed:
                content = packed.read(MOST_BYTES + 1)
        root = xml_tree(content)
    except XmlError as error:
        place = f"line {error.line}: " if error.line else ""
        raise ScenarioError(label, f"{place}{error}", allowed=f"{allowed} without a document type") from None
    except (zipfile.BadZipFile, OSError, EOFError, zlib.error, NotImplementedError, RuntimeError) as error:
        raise ScenarioError(label, f"cannot be unpacked ({error})", allowed=allowed) from None
    if root.tag != "openrocket" or root.find("rocket") is None:
        raise ScenarioError(label, f"holds <{root.tag}>, not a rocket", allowed=allowed)
    return root


def _unzipped(content: bytes) -> bytes:
    """Return the design in a zip archive, at most one byte more than XML may have."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        names = [name for name in archive.namelist() if name.lower().endswith(".ork")]
        if not names:
            raise zipfile.BadZipFile("the archive holds no rocket.ork")
        with archive.open("rocket.ork" if "rocket.ork" in names else names[0]) as packed:
            return packed.read(MOST_BYTES + 1)


class _Motors:
    """The motor files that may be used, by designation."""

    def __init__(self, design: Path, given: Sequence[str]) -> None:
        self.only: MotorFile | None = None
        self.named: dict[str, MotorFile] = {}
        for text in given:
            name, _, file = text.rpartition("=")
            found = read_motor(Path(file))
            if name:
                self.named[_plain(name)] = found
            else:
                self.named.setdefault(_plain(found.name), found)
                self.only = found if len(given) == 1 else None
        self._beside: dict[str, MotorFile] = {}
        self.unread = list[str]()
        for path in sorted(design.parent.iterdir()) if not given else []:
            if path.suffix.lower() in SUFFIXES and path.is_file():
                try:
                    found = read_motor(path)
                except ScenarioError as error:
                    self.unread.append(str(error))
                    continue
                self._beside.setdefault(_plain(found.name), found)

    def find(self, designation: str) -> MotorFile | None:
        """Return the motor of a designation, or the only one given."""
        name = _plain(designation)
        return self.named.get(name) or self.only or self._beside.get(name)


def _plain(designation: str) -> str:
    return re.sub(r"[^a-z0-9]", "", designation.lower())


@dataclass
class _Part:
    """A component with its station and length, and its radii if it is a body."""

    element: Element
    front_m: float
    length_m: float
    fore_m: float = 0.0
    aft_m: float = 0.0
    wall_m: float | None = 0.0
    parent: _Part | None = None
    children: list[_Part] = field(default_factory=list)

    @property
    def tag(self) -> str:
        return self.element.tag

    @property
    def name(self) -> str:
        return (self.element.findtext("name") or self.tag).strip()

    @property
    def inner_m(self) -> float:
        """Return the inner radius of a tube."""
        return 0.0 if self.wall_m is None else max(self.aft_m - self.wall_m, 0.0)

    def walk(self) -> Iterator[_Part]:
        yield self
        for child in self.children:
            yield from child.walk()


class _Design:
    """The components of a design in one flight configuration."""

    def __init__(self, label: str, root: Element, configuration: str | None) -> None:
        self.label, self.root = label, root
        found = root.find("rocket")
        assert found is not None
        self.rocket, self.remarks = found, list[Remark]()
        self.configuration = self._configuration(configuration)

    def refuse(self, element: Element, problem: str, key: str = "", *, allowed: str = "") -> NoReturn:
        """Raise the error for a component, or for one of its values."""
        name = (element.findtext("name") or "").strip()
        place = f"{element.tag} '{name}'" if name else element.tag
        raise ScenarioError(self.label, problem, f"{place}{', ' + key if key else ''}", allowed=allowed)

    def _configuration(self, wanted: str | None) -> str | None:
        every = self.rocket.findall("motorconfiguration")
        names = {e.get("configid", ""): (e.findtext("name") or "").strip() for e in every}
        if wanted is not None:
            for key, name in names.items():
                if wanted in (key, name):
                    return key
            allowed = ", ".join(f"{key} ({name})" if name else key for key, name in names.items()) or "none"
            raise ScenarioError(self.label, f"has no configuration {wanted}", allowed=allowed)
        chosen = [e.get("configid") for e in every if e.get("default") == "true"] or list(names)
        return chosen[0] if chosen else None

    # values

    def number(
        self, element: Element, key: str, default: float | None = None, *, least: float = 0.0, above: bool = False
    ) -> float:
        """Return the value of a child, which may be `auto VALUE`. Raises ScenarioError unless it is in its range."""
        text = (element.findtext(key) or "").strip()
        if not text and default is not None:
            return default
        try:
            value = float(text.removeprefix("auto").strip() or "nan")
        except ValueError:
            value = math.nan
        if not abs(value) <= _MOST or value < least or (above and value <= least):
            low = max(least, -_MOST)
            allowed = f"a number {'above' if above else 'from'} {low:g}, up to {_MOST:g}"
            self.refuse(element, f"is {text or 'missing'}", key, allowed=allowed)
        return value

    def length(self, element: Element, key: str, default: float | None = None) -> float:
        return self.number(element, key, default, above=default is None)

    def is_auto(self, element: Element, key: str) -> bool:
        return (element.findtext(key) or "").strip().startswith("auto")

    def stated(self, element: Element, key: str) -> float | None:
        """Return the number that `auto NUMBER` states, or None."""
        text = (element.findtext(key) or "").strip().removeprefix("auto").strip()
        try:
            return float(text) if text else None
        except ValueError:
            self.refuse(element, f"is {text}", key, allowed="a number, or auto")

    def density(self, element: Element, key: str = "material") -> float:
        material = element.find(key)
        if material is None:
            self.refuse(element, "is missing", key)
        try:
            value = float(material.get("density", "nan"))
        except ValueError:
            value = math.nan
        if not 0.0 <= value <= _MOST:
            self.refuse(element, f"has the density {material.get('density')}", key, allowed=f"0 to {_MOST:g}")
        return value

    # components and stations

    def parts(self) -> list[list[_Part]]:
        """Return the bodies of each stage from the top, with their components."""
        out, front = list[list[_Part]](), 0.0
        for stage in _children(self.rocket):
            if stage.tag != "stage":
                self.refuse(stage, _UNSUPPORTED.get(stage.tag, "is not a known component"), allowed="stage")
            bodies = []
            for element in _children(stage):
                if element.tag in _UNSUPPORTED:
                    self.refuse(element, _UNSUPPORTED[element.tag])
                if element.tag not in _BODIES:
                    self.refuse(element, "is not a known part of a stage", allowed=", ".join(_BODIES))
                part = _Part(element, front, self.length(element, "length"))
                front += part.length_m
                bodies.append(part)
            if not bodies:
                self.refuse(stage, "has no body", allowed=", ".join(_BODIES))
            out.append(bodies)
        every = [part for bodies in out for part in bodies]
        if not every:
            raise ScenarioError(self.label, "has no stage")
        if every[0].tag != "nosecone":
            self.refuse(every[0].element, "is the first component", allowed="a nosecone")
        self._radii(every)
        for part in every:
            self._inside(part)
        return out

    def _radii(self, every: Sequence[_Part]) -> None:
        """Set the radii and walls of the bodies. Automatic radii are those of the neighbours."""
        keys = [_radius_keys(part.element) for part in every]
        known = [[self._radius(part.element, key) for key in pair] for part, pair in zip(every, keys, strict=True)]
        for _ in every:
            for k, part in enumerate(every):
                before = known[k - 1][1] if k else None
                after = known[k + 1][0] if k + 1 < len(every) else None
                if known[k][0] is None:
                    known[k][0] = before if before is not None or part.tag != "bodytube" else after
                if known[k][1] is None:
                    known[k][1] = after if part.tag != "bodytube" else known[k][0]
        for part, (fore, aft), pair in zip(every, known, keys, strict=True):
            stated = [self.stated(part.element, key) if key else 0.0 for key in pair]
            front, rear = (stated[k] if r is None else r for k, r in enumerate((fore, aft)))
            if front is None or rear is None or max(front, rear) <= 0.0:
                self.refuse(part.element, "no neighbour gives its automatic radius", "radius", allowed="a number")
            part.fore_m, part.aft_m = front, rear
            part.wall_m = self._wall(part.element)
            if part.wall_m is not None and part.wall_m > max(front, rear):
                part.wall_m = None

    def _radius(self, element: Element, key: str) -> float | None:
        if not key:
            return 0.0
        return None if self.is_auto(element, key) else self.number(element, key)

    def _wall(self, element: Element) -> float | None:
        """Return the thickness of the wall, or None if the body is filled."""
        text = (element.findtext("thickness") or "").strip()
        return None if text == "filled" else self.number(element, "thickness")

    def _inside(self, parent: _Part) -> None:
        """Add the components in and on a part, with their stations."""
        for element in _children(parent.element):
            if element.tag in _UNSUPPORTED:
                self.refuse(element, _UNSUPPORTED[element.tag])
            if element.tag not in _KNOWN or element.tag in _BODIES:
                self.refuse(
                    element, "is not a known component", allowed=", ".join(k for k in _KNOWN if k not in _BODIES)
                )
            part = _Part(element, 0.0, self._length_inside(element), parent=parent)
            part.front_m = self._station(part, parent)
            parent.children.append(part)
        for part in parent.children:
            self._radii_inside(part, parent)
            self._inside(part)

    def _length_inside(self, element: Element) -> float:
        if element.tag in ("trapezoidfinset", "ellipticalfinset"):
            return self.length(element, "rootchord")
        if element.tag == "freeformfinset":
            return float(self.points(element)[-1, 0])
        if element.tag == "railbutton":
            return self.length(element, "outerdiameter")
        key = "packedlength" if element.tag in ("masscomponent", "shockcord", "parachute", "streamer") else "length"
        return self.number(element, key)

    def points(self, element: Element) -> Array:
        """Return the points (n, 2) of a freeform fin: aft of the root's leading edge, and from the root."""
        found = element.find("finpoints")
        try:
            rows = [(float(p.get("x", "nan")), float(p.get("y", "nan"))) for p in (found if found is not None else ())]
        except ValueError:
            rows = []
        if len(rows) < 3 or not (np.abs(rows) <= _MOST).all() or rows[-1][0] <= 0.0:
            self.refuse(element, "is not a list of three points or more", "finpoints", allowed="numbers")
        return np.array(rows)

    def _station(self, part: _Part, parent: _Part) -> float:
        """Return the station of the front of a component by its offset from its parent."""
        key, attribute = "axialoffset", "method"
        if part.element.find(key) is None:
            key, attribute = "position", "type"
        if (found := part.element.find(key)) is None:
            return parent.front_m
        how, offset = found.get(attribute, "top"), self.number(part.element, key, 0.0, least=-math.inf)
        room = parent.length_m - part.length_m
        starts = {"top": 0.0, "middle": 0.5 * room, "bottom": room, "after": parent.length_m}
        if how == "absolute":
            return offset
        if how not in starts:
            self.refuse(part.element, f"is {how}", f"{key} {attribute}", allowed=", ".join((*starts, "absolute")))
        return parent.front_m + starts[how] + offset

    def _radii_inside(self, part: _Part, parent: _Part) -> None:
        """Set the outer radius and wall of a ring or tube inside a part."""
        e = part.element
        if part.tag not in _RINGS:
            return
        auto = self.is_auto(e, "outerradius") or e.find("outerradius") is None
        stated = self.stated(e, "outerradius") if auto else None
        outer = (parent.inner_m if stated is None else stated) if auto else self.number(e, "outerradius")
        if part.tag == "bulkhead":
            inner = 0.0
        elif part.tag == "centeringring":
            stated = self.stated(e, "innerradius")
            held = [p.aft_m for p in parent.children if p.tag == "innertube" and _overlap(p, part)]
            inner = max(held, default=0.0) if stated is None else stated
        else:
            inner = max(outer - self.number(e, "thickness"), 0.0)
        part.fore_m = part.aft_m = outer
        part.wall_m = max(outer - inner, 0.0)

    # masses

    def pieces(self, part: _Part) -> list[Piece]:
        """Return the masses of a component and of those in it, with overrides."""
        inside = [piece for child in part.children for piece in self.pieces(child)]
        return self._overridden(part, self._own(part), inside)

    def _own(self, part: _Part) -> list[Piece]:
        e = part.element
        if part.tag in _BODIES:
            own = self._body_pieces(part)
        elif part.tag in _FINS:
            own = self._fin_pieces(part)
        elif part.tag in _RINGS:
            solid = tube(part.length_m, part.aft_m, part.inner_m, part.front_m)
            own = [_piece(part.name, self.density(e), solid)]
        else:
            own = [self._loose(part)]
        own = [piece for piece in own if piece.mass_kg > 0.0]
        away = self.number(e, "radialposition", 0.0)
        if away > 0.0:
            own = [replace(p, roll_m2=p.roll_m2 + away**2, across_m2=p.across_m2 + 0.5 * away**2) for p in own]
            self.remarks.append(Remark("assumed", part.name, f"balanced at {away:g} m from the axis"))
        count = round(self.number(e, "instancecount", 1.0, least=1.0)) if part.tag not in (*_FINS, "tubefinset") else 1
        if count > _MOST_INSTANCES:
            self.refuse(e, f"is {count}", "instancecount", allowed=f"up to {_MOST_INSTANCES}")
        count *= self._cluster(e) if part.tag == "innertube" else 1
        apart = self.number(e, "instanceseparation", 0.0, least=-math.inf) if part.tag != "innertube" else 0.0
        return [p.moved(k * apart) for k in range(count) for p in own]

    def _cluster(self, element: Element) -> int:
        """Return the number of tubes of a cluster."""
        name = (element.findtext("clusterconfiguration") or "single").strip()
        found = re.fullmatch(r"([2-9])-(?:row|ring|star)", name)
        count = _CLUSTERS.get(name) or (int(found[1]) if found else 0)
        if not count:
            allowed = ", ".join((*_CLUSTERS, "N-row, N-ring or N-star"))
            self.refuse(element, f"is {name}", "clusterconfiguration", allowed=allowed)
        return count

    def _body_pieces(self, part: _Part) -> list[Piece]:
        e, density = part.element, self.density(part.element)
        solids = [self._shape(part)[0]]
        for side, direction in (("aft", 1.0), ("fore", -1.0)):
            length = self.number(e, f"{side}shoulderlength", 0.0)
            if length <= 0.0:
                continue
            outer = self.number(e, f"{side}shoulderradius", 0.0)
            wall = self.number(e, f"{side}shoulderthickness", 0.0)
            begin = part.length_m if direction > 0.0 else -length
            inner = max(outer - wall, 0.0)
            solids.append(tube(length, outer, inner, begin))
            if (e.findtext(f"{side}shouldercapped") or "").strip() == "true":
                solids.append(tube(wall, inner, 0.0, begin + length - wall if direction > 0.0 else begin))
        return [_piece(part.name, density, joined_solids(solids), part.front_m)]

    def _shape(self, part: _Part) -> tuple[Solid, Solid, float, float]:
        """Return the wall and volume of a body from its front, and the area and centroid of its silhouette."""
        length = part.length_m
        if part.tag == "bodytube":
            inner = part.inner_m
            area = 2.0 * part.aft_m * length
            return tube(length, part.aft_m, inner), tube(length, part.aft_m, 0.0), area, 0.5 * length
        return revolved(self._profile(part), length, part.wall_m)

    def _profile(self, part: _Part) -> RadiusProfile:
        e, length = part.element, part.length_m
        small, large = sorted((part.fore_m, part.aft_m))
        name = (e.findtext("shape") or "ogive").strip()
        parameter = self.number(e, "shapeparameter", _DEFAULTS.get(name, 0.0))
        if name not in SHAPES:
            self.refuse(e, f"is {name}", "shape", allowed=", ".join(SHAPES))
        if parameter > 1.0:
            self.refuse(e, f"is {parameter:g}", "shapeparameter", allowed="0 to 1")
        shape, before = SHAPES[name], 0.0
        if small > 0.0 and (e.findtext("shapeclipped") or "").strip() == "true":

            def excess(extra: float) -> float:
                return float(shape(np.array([extra + 0j]), large, extra + length, parameter).real[0]) - small

            most = length
            while excess(most) < 0.0 and most < 1e6 * length:
                most *= 2.0
            if excess(most) <= 0.0:
                self.refuse(e, f"the shape {name} does not begin at {small:g} m", "foreradius")
            before = float(brentq(excess, 0.0, most, xtol=1e-14))
            base, gain = 0.0, large
        else:
            base, gain = small, large - small
        flipped = part.fore_m > part.aft_m

        def profile(x: RealOrComplex) -> RealOrComplex:
            at = (length - x if flipped else x) + before
            return base + (shape(at, gain, length + before, parameter) if gain > 0.0 else 0.0 * at)

        return profile

    def _fin_pieces(self, part: _Part) -> list[Piece]:
        e = part.element
        body, count = self._fin_body(part), self._fin_count(e)
        plan, thickness = self._planform(part), self.number(e, "thickness")
        section = (e.findtext("crosssection") or "square").strip().replace("_", " ")
        if section not in _FILLED:
            self.refuse(e, f"is {section}", "crosssection", allowed=", ".join(_FILLED))
        mass = count * plan.area_m2 * thickness * _FILLED[section] * self.density(e)
        roll = body**2 + 2.0 * body * plan.y_m + plan.span_m2
        out = [Piece(part.name, mass, part.front_m + plan.x_m, plan.along_m2, roll, 0.5 * roll)]
        height, length = self.number(e, "tabheight", 0.0), self.number(e, "tablength", 0.0)
        if height > 0.0 and length > 0.0:
            middle = max(body - 0.5 * height, 0.0)
            roll = middle**2 + height**2 / 12.0
            mass = count * height * length * thickness * self.density(e)
            front = self._tab(e, part.length_m, length) + part.front_m
            out.append(Piece(f"{part.name}, tabs", mass, front + 0.5 * length, length**2 / 12.0, roll, 0.5 * roll))
        if (fillet := self.number(e, "filletradius", 0.0)) > 0.0:
            area = 2.0 * (1.0 - 0.25 * math.pi) * fillet**2  # both sides, on a flat wall
            mass = count * area * part.length_m * self.density(e, "filletmaterial")
            middle = part.front_m + 0.5 * part.length_m
            out.append(Piece(f"{part.name}, fillets", mass, middle, part.length_m**2 / 12.0, body**2, 0.5 * body**2))
            self.remarks.append(Remark("assumed", part.name, "fillets on a flat wall"))
        return out

    def _tab(self, e: Element, root_m: float, length_m: float) -> float:
        """Return the distance of the front of a fin's tab from the front of its root."""
        places = {
            "front": "top",
            "top": "top",
            "center": "middle",
            "middle": "middle",
            "end": "bottom",
            "bottom": "bottom",
        }
        for found in e.findall("tabposition"):
            how = places.get(found.get("relativeto", "top"))
            if how is not None:
                try:
                    offset = float(found.text or "nan")
                except ValueError:
                    break
                return {"top": 0.0, "middle": 0.5 * (root_m - length_m), "bottom": root_m - length_m}[how] + offset
        return 0.5 * (root_m - length_m)

    def _fin_count(self, e: Element) -> int:
        key = "fincount" if e.find("fincount") is not None else "instancecount"
        return round(self.number(e, key, 1.0, least=1.0))

    def _fin_body(self, part: _Part) -> float:
        """Return the radius of the body at the middle of a fin's root."""
        body = part.parent
        assert body is not None
        x = min(max(part.front_m + 0.5 * part.length_m - body.front_m, 0.0), body.length_m)
        if body.tag == "bodytube":
            return body.aft_m
        return float(self._profile(body)(np.array([x + 0j])).real[0])

    def _planform(self, part: _Part) -> Planform:
        e = part.element
        if part.tag == "ellipticalfinset":
            root, height = part.length_m, self.length(e, "height")
            area = 0.25 * math.pi * root * height
            return Planform(area, 0.5 * root, 4.0 * height / (3.0 * math.pi), root**2 / 16.0, 0.25 * height**2)
        if part.tag == "trapezoidfinset":
            sweep, tip, height = (
                self.number(e, "sweeplength", least=-math.inf),
                self.number(e, "tipchord"),
                self.length(e, "height"),
            )
            return polygon(np.array([(0.0, 0.0), (sweep, height), (sweep + tip, height), (part.length_m, 0.0)]))
        return polygon(self.points(e))

    def _loose(self, part: _Part) -> Piece:
        """Return the mass of a component without a fixed shape, as a rod."""
        e, tag = part.element, part.tag
        middle, variance = part.front_m + 0.5 * part.length_m, part.length_m**2 / 12.0
        if tag == "tubefinset":
            count, outer = self._fin_count(e), self._tube_fin_radius(part)
            inner = max(outer - self.number(e, "thickness"), 0.0)
            solid, at = tube(part.length_m, outer, inner), self._fin_body(part) + outer
            roll = at**2 + 0.5 * (outer**2 + inner**2)
            self.remarks.append(Remark("missing", part.name, "normal force of tube fins"))
            return Piece(part.name, count * self.density(e) * solid.volume_m3, middle, variance, roll, 0.5 * roll)
        if tag == "launchlug":
            outer = self.number(e, "radius")
            return _piece(
                part.name,
                self.density(e),
                tube(part.length_m, outer, max(outer - self.number(e, "thickness"), 0.0), part.front_m),
            )
        if tag == "railbutton":
            return self._button(part)
        radius = 0.0 if self.is_auto(e, "packedradius") else self.number(e, "packedradius", 0.0)
        roll = 0.5 * radius**2
        return Piece(part.name, self._packed_kg(e), middle, variance, roll, 0.5 * roll)

    def _packed_kg(self, e: Element) -> float:
        if e.tag == "masscomponent":
            return self.number(e, "mass")
        if e.tag == "shockcord":
            return self.number(e, "cordlength") * self.density(e)
        if e.tag == "streamer":
            return self.number(e, "striplength") * self.number(e, "stripwidth") * self.density(e)
        cloth = 0.25 * math.pi * self.number(e, "diameter") ** 2 * self.density(e)
        lines = self.number(e, "linecount", 0.0) * self.number(e, "linelength", 0.0)
        return cloth + (lines * self.density(e, "linematerial") if lines > 0.0 else 0.0)

    def _tube_fin_radius(self, part: _Part) -> float:
        e = part.element
        if not self.is_auto(e, "radius"):
            return self.number(e, "radius")
        stated = self.stated(e, "radius")
        if stated is not None:
            return stated
        share = math.sin(math.pi / self._fin_count(e))  # tubes that touch each other
        return self._fin_body(part) * share / (1.0 - share)

    def _button(self, part: _Part) -> Piece:
        e = part.element
        outer, inner = 0.5 * part.length_m, 0.5 * self.number(e, "innerdiameter")
        height, base, flange = (self.number(e, key, 0.0) for key in ("height", "baseheight", "flangeheight"))
        volume = math.pi * (outer**2 * (base + flange) + inner**2 * max(height - base - flange, 0.0))
        mass = self.density(e) * volume + sum(self.number(e, key, 0.0) for key in ("screwmass", "nutmass"))
        assert part.parent is not None
        away = part.parent.aft_m + 0.5 * height
        return Piece(part.name, mass, part.front_m + outer, 0.25 * outer**2, away**2, 0.5 * away**2)

    def _overridden(self, part: _Part, own: list[Piece], inside: list[Piece]) -> list[Piece]:
        """Return the masses of a component and of those in it after its overrides of mass and CG."""
        e = part.element
        mass, cg = e.find("overridemass") is not None, e.find("overridecg") is not None
        both_kg, both_cg = (self._of_subcomponents(e, key) for key in ("mass", "cg"))
        if mass:
            wanted = self.number(e, "overridemass")
            if both_kg:
                own, inside = _scaled(part, own, inside, wanted)
            else:
                own = _scaled(part, own, [], wanted)[0]
        if cg:
            wanted = part.front_m + self.number(e, "overridecg", least=-math.inf)
            moved = [*own, *inside] if both_cg else own
            total = sum(p.mass_kg for p in moved)
            by = wanted - sum(p.mass_kg * p.station_m for p in moved) / total if total > 0.0 else 0.0
            own = [p.moved(by) for p in own]
            inside = [p.moved(by) for p in inside] if both_cg else inside
        if mass or cg:
            what = " and ".join(w for w, given in (("mass", mass), ("centre of mass", cg)) if given)
            self.remarks.append(Remark("taken", part.name, f"override of {what}"))
        return [*own, *inside]

    def _of_subcomponents(self, e: Element, what: str) -> bool:
        """Return True if an override is that of a component with all components in it."""
        text = e.findtext(f"overridesubcomponents{what}") or e.findtext("overridesubcomponents") or ""
        return text.strip() == "true"

    # the rocket

    def airframe(self, motors: _Motors) -> Airframe:
        every = self.parts()
        stages, elements, mounts = list[AirframeStage](), _children(self.rocket), list[tuple[Element, Element]]()
        for n, (bodies, element) in enumerate(zip(every, elements, strict=True)):
            pieces = [piece for body in bodies for piece in self.pieces(body)]
            holder = _Part(element, bodies[0].front_m, sum(b.length_m for b in bodies))
            pieces = self._overridden(holder, [], pieces)
            found = self._mount(bodies, element)
            motor = self._motor(*found, element, motors)
            mounts.append(found[1:])
            fins = tuple(self._fins(part) for body in bodies for part in body.walk() if part.tag in _FINS)
            staging = self._staging(element, mounts[n], mounts[n - 1][0]) if n else (0.0, 0.0)
            shapes = tuple(self._body(part) for part in bodies)
            name = re.sub(r"[^A-Za-z0-9_]+", "_", holder.name).strip("_").lower()[:40] or f"stage_{n + 1}"
            stages.append(AirframeStage(name, tuple(pieces), shapes, fins, motor, *staging))
        whole = _Part(self.rocket, 0.0, 0.0)
        if self.rocket.find("overridemass") is not None or self.rocket.find("overridecg") is not None:
            pieces = self._overridden(whole, [], [p for s in stages for p in s.pieces])
            counts = np.cumsum([0, *(len(s.pieces) for s in stages)])
            stages = [
                replace(s, pieces=tuple(pieces[a:b])) for s, a, b in zip(stages, counts, counts[1:], strict=False)
            ]
        return self._with_site(self._named(stages), every)

    def _named(self, stages: list[AirframeStage]) -> tuple[AirframeStage, ...]:
        """Return the stages with a name of its own each."""
        names = [s.name for s in stages]
        twice = {name for name in names if names.count(name) > 1}
        return tuple(replace(s, name=f"{s.name}_{n + 1}" if s.name in twice else s.name) for n, s in enumerate(stages))

    def _with_site(self, stages: tuple[AirframeStage, ...], every: list[list[_Part]]) -> Airframe:
        nose = every[0][0]
        shape = (nose.element.findtext("shape") or "ogive").strip()
        masses = sum(p.mass_kg for s in stages for p in s.pieces)
        count = sum(len(list(body.walk())) for bodies in every for body in bodies)
        total = f"{len(stages)} stage{'s' * (len(stages) > 1)}, {count} components, {masses:.6g} kg without motors"
        simulation = self._simulation()
        axial = self._drag(simulation, len(stages))
        found = list(self.remarks)
        bodies = "; ".join(f"{b.name} {b.modulus_Pa / 1e9:g} GPa" for s in stages for b in s.bodies)
        first = [Remark("taken", "components", total)]
        first += [
            Remark("taken", f"motor of {s.name}", f"{s.motor.name}, {s.motor.propellant_kg:.4g} kg of propellant")
            for s in stages
        ]
        last = [
            Remark("assumed", "stiffness", f"Young's modulus by the name of the material: {bodies}"),
            Remark(
                "assumed",
                "motors",
                "grain and case are uniform over the length of the motor; thrust is linear and that in vacuum",
            ),
        ]
        if any(s.motor.count > 1 for s in stages):
            last.append(Remark("assumed", "clusters", "all motors of a cluster are on the axis"))
        if axial is None:
            last.append(Remark("missing", "drag", "no curve: an assumed one of a clean launcher; give one by --drag"))
        last.append(Remark("missing", "recovery", "the flight ends at the apogee"))
        conditions = simulation.find("conditions") if simulation is not None else None
        site, remark = self._site(conditions)
        return Airframe(
            name=(self.rocket.findtext("name") or "rocket").strip() or "rocket",
            source=self.label,
            stages=stages,
            nose="cone" if shape == "conical" else "ogive",
            axial=axial,
            reference_diameter_m=None,
            remarks=[*first, *found, *last, remark],
            **site,
        )

    def _site(self, conditions: Element | None) -> tuple[dict[str, Any], Remark]:
        if conditions is None:
            out = {"latitude_deg": 45.0, "longitude_deg": 0.0, "altitude_m": 0.0}
            remark = Remark(
                "missing", "launch site", "no simulation: 45 deg north, 0 deg east, a rail of 1 m, vertical"
            )
            return out | {"azimuth_deg": 90.0, "rail_m": 1.0, "elevation_deg": 90.0}, remark

        def value(key: str, otherwise: float, least: float = -math.inf) -> float:
            return self.number(conditions, key, otherwise, least=least)

        angle = value("launchrodangle", 0.0)
        azimuth = value("launchroddirection", 90.0) + (180.0 if angle < 0.0 else 0.0)
        out = {
            "latitude_deg": value("launchlatitude", 45.0),
            "longitude_deg": value("launchlongitude", 0.0),
            "altitude_m": value("launchaltitude", 0.0),
            "azimuth_deg": azimuth % 360.0,
            "rail_m": value("launchrodlength", 1.0, 0.0) or 1.0,
            "elevation_deg": 90.0 - abs(angle),
        }
        return out, Remark("taken", "launch site and rail", "those of the first simulation; its wind is not")

    def _simulation(self) -> Element | None:
        """Return the first simulation of the configuration, or None."""
        for simulation in self.root.iterfind("simulations/simulation"):
            for key in ("conditions/configid", "configid"):
                if (simulation.findtext(key) or "").strip() == (self.configuration or ""):
                    return simulation
        return None

    def _drag(self, simulation: Element | None, stages: int) -> tuple[Array, Array, Array] | None:
        """Return the axial force coefficients over Mach number of a stored simulation of a single stage, or None.

        The first is that under thrust, the second that of the coast to the apogee.
        """
        branch = simulation.find("flightdata/databranch") if simulation is not None and stages == 1 else None
        if branch is None or simulation is None:
            return None
        names = branch.get("types", "").split(",")
        wanted = ("Time", "Mach number", "Axial drag coefficient", "Thrust", "Altitude")
        if any(name not in names for name in wanted):
            return None
        try:
            rows = np.array([[float(v) for v in p.text.split(",")] for p in branch.iter("datapoint") if p.text])
        except ValueError:
            return None
        if rows.ndim != 2 or rows.shape[1] != len(names):
            return None
        _, mach, axial, thrust, height = rows[:, [names.index(name) for name in wanted]].T
        top = int(np.argmax(height))
        early = np.arange(len(mach)) <= top
        usable = np.isfinite(axial) & (axial > 0.0) & early
        coast = _curve(mach, axial, usable & (thrust <= 0.0))
        if coast is None:
            return None
        powered = _curve(mach, axial, usable & (thrust > 0.0)) or coast
        grid = np.unique(np.concatenate([coast[0], powered[0]]))
        name = (simulation.findtext("name") or "").strip()
        self.remarks.append(Remark("taken", "drag", f"axial force coefficient of the stored simulation {name}"))
        return grid, np.interp(grid, *powered), np.interp(grid, *coast)

    def _mount(self, bodies: list[_Part], stage: Element) -> tuple[_Part, Element, Element]:
        """Return the component that holds the motor of a stage in the configuration, its mount and the motor."""
        found = []
        for part in (p for body in bodies for p in body.walk()):
            mount = part.element.find("motormount")
            if mount is not None:
                found += [(part, mount, m) for m in mount.findall("motor") if self._is_chosen(m)]
        if len(found) != 1:
            problem = f"has {len(found)} mounts with a motor in configuration {self.configuration or 'none'}"
            self.refuse(
                stage, problem if found else problem.replace("0 mounts", "no mount"), allowed="one in each stage"
            )
        return found[0]

    def _motor(self, part: _Part, mount: Element, element: Element, stage: Element, motors: _Motors) -> Motor:
        designation = (element.findtext("designation") or "").strip()
        curve = self._embedded(element) if not motors.named else None
        file = motors.find(designation)
        if file is None and curve is None:
            allowed = "--motor FILE (.eng or .rse), or such a file next to the design"
            unread = f" ({motors.unread[0]})" if motors.unread else ""
            self.refuse(stage, f"there is no thrust curve of its motor {designation}{unread}", allowed=allowed)
        length = self.number(element, "length", file.length_m if file else None, above=True)
        radius = 0.5 * self.number(element, "diameter", file.diameter_m if file else None, above=True)
        rear = part.front_m + part.length_m + self.number(mount, "overhang", 0.0, least=-math.inf)
        count = self._cluster(part.element) if part.tag == "innertube" else 1
        if file is not None:
            times, thrust, propellant, total = file.time_s, file.thrust_N, file.propellant_kg, file.total_kg
            self.remarks.append(Remark("taken", f"thrust of {designation or file.name}", file.shown))
            if _plain(file.name) != _plain(designation):
                self.remarks.append(Remark("assumed", f"motor {designation}", f"is {file.name} of {file.shown}"))
        else:
            assert curve is not None
            times, thrust, propellant, total = curve
            self.remarks.append(Remark("taken", f"thrust of {designation}", "curve in the design"))
        name = designation or (file.name if file else "motor")
        return Motor(name, times, thrust, propellant, total - propellant, rear - length, rear, radius, count)

    def _is_chosen(self, motor: Element) -> bool:
        return self.configuration is None or motor.get("configid") == self.configuration

    def _embedded(self, motor: Element) -> tuple[Array, Array, float, float] | None:
        """Return the times, thrusts, propellant and total mass of the curve in a design, or None."""
        texts = [p.text or "" for p in motor.findall("thrustcurvepoint")]
        if not texts:
            return None
        try:
            rows = np.array([[float(v) for v in text.split(",")] for text in texts])
            times, thrust, _, mass = rows.T
        except ValueError:
            self.refuse(motor, "is not a time, thrust, centre of mass and mass", "thrustcurvepoint")
        if len(rows) < 3 or (np.diff(times) <= 0.0).any() or not mass[0] > mass[-1] >= 0.0:
            self.refuse(motor, "is not a burn", "thrustcurvepoint", allowed="rising times and a falling mass")
        return times, thrust, float(mass[0] - mass[-1]), float(mass[0])

    def _staging(self, stage: Element, lower: tuple[Element, Element], upper: Element) -> tuple[float, float]:
        """Return the times from the burnout of a stage to its separation, and from there to the next ignition, s.

        `lower` is the mount of the stage with its motor, `upper` the mount of the stage above. OpenRocket ignites it by
        default at the ejection charge of the lower motor, and separates the stages at the ignition.
        """
        charge_s = (
            0.0 if (lower[1].findtext("delay") or "none").strip() == "none" else self.number(lower[1], "delay", 0.0)
        )

        def event_s(element: Element, kind: str, default: str, at: Mapping[str, float]) -> float:
            configured = element.find(f"{kind}configuration[@configid='{self.configuration}']")
            of = element if configured is None else configured
            event = (of.findtext(f"{kind}event") or default).strip()
            if event not in at:
                self.refuse(stage, f"is {event}", f"{kind}event", allowed=", ".join(at))
            return at[event] + self.number(of, f"{kind}delay", 0.0)

        ignition = {"automatic": charge_s, "ejectioncharge": charge_s, "burnout": 0.0}
        ignition_s = event_s(upper, "ignition", "automatic", ignition)
        separation = {"upperignition": ignition_s, "ejection": charge_s, "burnout": 0.0}
        separation_s = min(event_s(stage, "separation", "upperignition", separation), ignition_s)
        return separation_s, ignition_s - separation_s

    def _fins(self, part: _Part) -> FinSet:
        e, radius, count = part.element, self._fin_body(part), self._fin_count(part.element)
        if count < 3:
            self.remarks.append(Remark("assumed", part.name, f"{count} fins: mean of all planes"))
        if self.number(e, "cant", 0.0, least=-math.inf) != 0.0:
            self.remarks.append(Remark("missing", part.name, "roll torque of canted fins"))
        if part.tag == "trapezoidfinset":
            tip, height = self.number(e, "tipchord"), self.length(e, "height")
            sweep = self.number(e, "sweeplength", least=-math.inf)
            return FinSet(part.name, count, part.length_m, tip, height, sweep, part.front_m, radius)
        if part.tag == "ellipticalfinset":
            height = self.length(e, "height")
            y = height * np.sin(np.linspace(0.0, 0.5 * math.pi, 2001))
            chord = part.length_m * np.sqrt(np.maximum(1.0 - (y / height) ** 2, 0.0))
            leading = 0.5 * (part.length_m - chord)
        else:
            y, leading, chord = self._strips(e)
        root, tip, sweep, shift = equivalent_trapezoid(y, leading, chord)
        self.remarks.append(Remark("assumed", part.name, "trapezoid of the same area, span and mean chord"))
        return FinSet(part.name, count, root, tip, float(y[-1]), sweep, part.front_m + shift, radius)

    def _strips(self, e: Element) -> tuple[Array, Array, Array]:
        """Return distances from the root, and leading edge and chord of a freeform fin there."""
        points = self.points(e)
        highest = float(points[:, 1].max())
        if highest <= 0.0:
            self.refuse(e, "has no point off the root", "finpoints")
        y = np.linspace(0.0, highest, 2001)
        leading, chord = np.zeros_like(y), np.zeros_like(y)
        for k, at in enumerate(np.clip(y, 1e-9 * highest, (1.0 - 1e-9) * highest)):
            (x0, y0), (x1, y1) = points[:-1].T, points[1:].T
            crossed = (y0 - at) * (y1 - at) < 0.0
            xs = np.sort(x0[crossed] + (at - y0[crossed]) / (y1 - y0)[crossed] * (x1 - x0)[crossed])
            leading[k] = xs[0] if len(xs) else 0.0
            chord[k] = float((xs[1::2] - xs[::2][: len(xs) // 2]).sum())
        return y, leading, chord

    def _body(self, part: _Part) -> Body:
        _, volume, side, middle = self._shape(part)
        material = part.element.find("material")
        name = (material.text or "").lower() if material is not None else ""
        modulus = next((gpa for word, gpa in _MODULUS_GPa.items() if word in name), _OTHER_GPa)
        rear = part.front_m + part.length_m
        ends = part.front_m, rear, part.fore_m, part.aft_m
        return Body(part.name, *ends, volume.volume_m3, side, part.front_m + middle, part.wall_m, 1e9 * modulus)


def _children(element: Element) -> list[Element]:
    """Return the components in a component."""
    found = element.find("subcomponents")
    return [] if found is None else list(found)


def _radius_keys(element: Element) -> tuple[str, str]:
    """Return the keys of a body's radii at its front and rear; empty for the tip of a nose."""
    if element.tag == "bodytube":
        return "radius", "radius"
    if element.tag == "nosecone":
        flipped = (element.findtext("isflipped") or "").strip() == "true"
        return ("aftradius", "") if flipped else ("", "aftradius")
    return "foreradius", "aftradius"


def _overlap(a: _Part, b: _Part) -> bool:
    return a.front_m < b.front_m + b.length_m and b.front_m < a.front_m + a.length_m


def _piece(name: str, density: float, solid: Solid, front_m: float = 0.0) -> Piece:
    across = 0.5 * solid.roll_m2
    return Piece(name, density * solid.volume_m3, front_m + solid.centroid_m, solid.axial_m2, solid.roll_m2, across)


def _scaled(part: _Part, own: list[Piece], inside: list[Piece], wanted_kg: float) -> tuple[list[Piece], list[Piece]]:
    """Return masses scaled to a total, which acts at the middle of the component if there are none."""
    total = sum(p.mass_kg for p in (*own, *inside))
    if total <= 0.0:
        point = Piece(part.name, wanted_kg, part.front_m + 0.5 * part.length_m, part.length_m**2 / 12.0)
        return ([point] if wanted_kg > 0.0 else []), []
    factor = wanted_kg / total
    scaled = [[replace(p, mass_kg=p.mass_kg * factor) for p in each] for each in (own, inside)]
    return ([], []) if wanted_kg == 0.0 else (scaled[0], scaled[1])


def _curve(mach: Array, axial: Array, usable: Array) -> tuple[Array, Array] | None:
    """Return means of a coefficient in intervals of Mach number, or None if there are too few values."""
    if usable.sum() < _LEAST_POINTS:
        return None
    width = max(0.02, float(mach[usable].max()) / 60.0)
    number = np.floor(mach[usable] / width).astype(int)
    bins = np.unique(number)
    means = [(float(mach[usable][number == k].mean()), float(axial[usable][number == k].mean())) for k in bins]
    x, y = np.array(means).T
    return x, y


def _ogive(x: RealOrComplex, radius: float, length: float, share: float) -> RealOrComplex:
    """Return an ogive: tangent for a share of 1, a cone for 0."""
    if length < radius:
        x, length = x * (radius / length), radius
    if share < 0.001:
        return x * (radius / length)
    rho = math.sqrt(
        (length**2 + radius**2)
        * (((2.0 - share) * length) ** 2 + (share * radius) ** 2)
        / (4.0 * (share * radius) ** 2)
    )
    at = length / share
    return np.asarray(np.sqrt(rho**2 - (at - x) ** 2) - math.sqrt(rho**2 - at**2))


def _haack(x: RealOrComplex, radius: float, length: float, c: float) -> RealOrComplex:
    angle = np.arccos(1.0 - 2.0 * x / length)
    return np.asarray(radius * np.sqrt((angle - 0.5 * np.sin(2.0 * angle) + c * np.sin(angle) ** 3) / math.pi))


SHAPES: Mapping[str, Callable[[RealOrComplex, float, float, float], RealOrComplex]] = {
    "conical": lambda x, r, length, _: r * x / length,
    "ogive": _ogive,
    "ellipsoid": lambda x, r, length, _: r * np.sqrt(2.0 * x / length - (x / length) ** 2),
    "power": lambda x, r, length, n: r * (x / length) ** n,
    "parabolic": lambda x, r, length, k: r * (2.0 * x / length - k * (x / length) ** 2) / (2.0 - k),
    "haack": _haack,
}
_DEFAULTS = {"ogive": 1.0, "power": 0.5, "parabolic": 1.0, "haack": 0.0}
