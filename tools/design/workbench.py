"""A design whose gains and filter are changed by hand: the trial, its loop at an operating point, and its limits.

`Workbench` computes what the page of `simdesign open` shows (tools/design/serve.py). It has no state of its own except
caches: a request contains the changes and the operating point, so that undo and several pages need nothing here.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np
from threadpoolctl import ThreadpoolController

from maxq.design.laws.design_file import design_text
from maxq.design.loop.fixed_path import KINDS, FixedPath, LoopKind, fixed_path
from maxq.design.loop.loop import law_at
from maxq.design.loop.root_locus import root_locus
from maxq.design.loop.time_response import gust_response, step_response
from maxq.design.model.given import GivenPoint
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.verify.judging import JudgedLoop, Wanted, checks
from maxq.sim.files import FileError, write_whole
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.scenario.schema_design import Design, FilterPoint, FilterSection, FirstOrder, Quadratic, StageLaw
from maxq.tools.design import figures as drawn
from maxq.tools.design.analysed_loop import AnalysedLoop
from maxq.tools.design.page import check_row
from maxq.tools.design.report import GAIN_HEADS
from maxq.tools.plots.figures import Panel, Plot, Series, limit, line, points

FIXED_GAINS = ("percussion_m", "accel_per_incidence_mps2")  # columns of a gain table that describe the vehicle
GAIN_RANGE, HZ_RANGE, MOST_ZETA = 4.0, 4.0, 1.5  # factors about the value, and upper end of damping ratios
WINDOW_S = 8.0  # of step and gust
LOCUS_GAINS = np.geomspace(0.1, 4.0, 20)
GUST_MPS, GUST_M = 9.0, 300.0
_NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,80}\.toml")
_LATEST_PATHS = 32


@dataclass(frozen=True)
class Slider:
    """A number of the design that a trial changes.

    `value` is the value in the opened design. A gain has a factor on its whole schedule; `shown` is the value that
    belongs to a factor of 1 at each operating point, or None.
    """

    key: str
    group: str
    label: str
    unit: str
    value: float
    low: float
    high: float
    log: bool
    shown: tuple[float, ...] | None = None


@dataclass(frozen=True)
class DeviatingVehicle:
    """Deviations of the vehicle: factors on bending frequencies and slopes, and a further delay in ms."""

    bending_frequency: float = 1.0
    bending_slope: float = 1.0
    delay_ms: float = 0.0

    def of(self, node: OperatingPoint) -> OperatingPoint:
        """Return an operating point with the deviations. Raises ValueError for a point that does not have them."""
        if self == DeviatingVehicle():
            return node
        if isinstance(node, Node):
            modes = {"bending_frequency": self.bending_frequency, "bending_slope": self.bending_slope}
            return node.with_(delay_s=1e-3 * self.delay_ms, **modes)
        assert isinstance(node, GivenPoint)
        own = dict[str, float]()
        if node.coefficients is not None:
            for n in range(1, 1 + len(node.coefficients.modes)):
                own |= {f"mode_{n}_omega_radps": self.bending_frequency, f"mode_{n}_slope_gyro_1pm": self.bending_slope}
        return node.with_(delay_s=1e-3 * self.delay_ms, **own)


VEHICLE_RANGES = {"bending_frequency": (0.7, 1.3), "bending_slope": (0.5, 2.0), "delay_ms": (0.0, 30.0)}


class RequestError(ValueError):
    """A request that cannot be met. The text gives the reason on one line."""


@dataclass
class Workbench:
    """A design at operating points of one or both planes.

    `nodes` maps each plane to its operating points, in the same order. `also` are designs to compare with, by name.
    `folder` is where trials are saved, and `opened` the file of the design, which is never replaced.
    """

    name: str
    design: Design
    nodes: Mapping[Plane, Sequence[OperatingPoint]]
    kind: LoopKind = "sampled"
    also: Mapping[str, Design] = field(default_factory=dict)
    folder: Path = Path()
    opened: Path | None = None
    saved: list[Path] = field(default_factory=list)
    _paths: dict[Any, FixedPath] = field(default_factory=dict)
    _libraries: ThreadpoolController = field(default_factory=ThreadpoolController)

    def setting(self) -> dict[str, Any]:
        """Return what the page needs once: sliders by stage, operating points, planes and kinds."""
        first = next(iter(self.nodes.values()))
        stages = sorted({node.stage for node in first})
        sampled = first[0].instruments.sample_s > 0.0
        return {
            "name": self.name,
            "points": [{"label": node.label or f"{node.time_s:g} s", "stage": node.stage} for node in first],
            "planes": list(self.nodes),
            "kinds": [kind for kind in KINDS if sampled or kind != "sampled"],
            "kind": self.kind,
            "sliders": {str(n): [asdict(s) for s in sliders(self.design, n, first)] for n in stages},
            "vehicle": {key: [getattr(DeviatingVehicle(), key), *ends] for key, ends in VEHICLE_RANGES.items()},
            "first": self._least_margin,
            "saves_as": self._free_name(),
        }

    @cached_property
    def _least_margin(self) -> int:
        """Return the index of the operating point with the least gain margin in the first plane."""
        plane = next(iter(self.nodes))
        measured = [
            self._loop(self.design, plane, n, self.kind, DeviatingVehicle()).margins()
            for n in range(len(self.nodes[plane]))
        ]
        return int(np.argmin([m.gain_db if m.stable else -1.0 for m in measured]))

    def trial(self, edits: Mapping[str, float]) -> Design:
        """Return the design with the values of sliders by key. Raises RequestError for an unknown key or value."""
        first = next(iter(self.nodes.values()))
        known = {s.key: s for n in sorted({node.stage for node in first}) for s in sliders(self.design, n, first)}
        for key, value in edits.items():
            if key not in known:
                raise RequestError(f"{key}: no such value in this design")
            slider = known[key]
            if (
                not isinstance(value, int | float)
                or not slider.low - 1e-9 <= value <= slider.high * (1.0 + 1e-9) + 1e-9
            ):
                raise RequestError(f"{key} = {value}: allowed is a number from {slider.low:g} to {slider.high:g}")
        return changed(self.design, {k: float(v) for k, v in edits.items() if float(v) != known[k].value})

    def show(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return curves and limits of the trial at an operating point, and of the opened design if requested.

        `request` has the keys `point`, `plane`, `kind`, `vehicle` (fields of `DeviatingVehicle`), `edits` and
        `reference`. Raises RequestError.
        """
        begun = time.perf_counter()
        point, plane, kind = request.get("point", 0), request.get("plane", "pitch"), request.get("kind", self.kind)
        if plane not in self.nodes or kind not in get_args(LoopKind):
            raise RequestError(
                f"plane = {plane!r}, kind = {kind!r}: allowed are {', '.join(self.nodes)}; {', '.join(KINDS)}"
            )
        if not isinstance(point, int) or not 0 <= point < len(self.nodes[plane]):
            raise RequestError(f"point = {point!r}: allowed are 0 to {len(self.nodes[plane]) - 1}")
        try:
            vehicle = _vehicle(request.get("vehicle", {}))
            edits = request.get("edits", {})
            if not isinstance(edits, dict):
                raise RequestError("edits: allowed is an object of numbers")
            design = self.trial(edits)
            with self._libraries.limit(limits=1, user_api="blas"):  # threads only wait for small matrices
                trial = self._drawn(design, plane, point, kind, vehicle, "trial", "blue", True)
                out: dict[str, Any] = {"trial": trial}
                if request.get("reference", False):
                    out["references"] = [
                        self._drawn(one, plane, point, kind, vehicle, name, colour, False)
                        for (name, one), colour in zip(
                            [("as opened", self.design), *self.also.items()],
                            ("orange", "green", "purple", "sky"),
                            strict=False,
                        )
                    ]
        except RequestError:
            raise
        except ValueError as problem:
            raise RequestError(str(problem)) from None
        return out | {"ms": 1e3 * (time.perf_counter() - begun)}

    def save(self, edits: Mapping[str, float], name: str, replace_file: bool = False) -> Path:
        """Save the trial as a design file in the folder, written completely or not at all. Return its path.

        Raises RequestError for a name that is no plain file name, for the file of the opened design, and for an
        existing file unless `replace_file` is True.
        """
        if not _NAME.fullmatch(name):
            raise RequestError(
                f"{name!r}: allowed is a file name of letters, digits, '.', '-' and '_' that ends in .toml"
            )
        path = self.folder / name
        if self.opened is not None and path.resolve() == self.opened.resolve():
            raise RequestError(f"{name} is the opened design, which is not replaced: give another name")
        if path.exists() and not replace_file and path not in self.saved:
            raise RequestError(f"{path} exists: give another name")
        design = self.trial(edits)
        count = sum(1 for key, value in edits.items() if value != self._opened_value(key))
        head = [f"Written by simdesign open: {self.name} with {count} value{'s' * (count != 1)} changed by hand."]
        try:
            write_whole(path, design_text(design, head))
        except FileError as problem:
            raise RequestError(str(problem)) from None
        if path not in self.saved:
            self.saved.append(path)
        return path

    def _opened_value(self, key: str) -> float:
        stage = int(key.partition("/")[0])
        return next(s.value for s in sliders(self.design, stage, next(iter(self.nodes.values()))) if s.key == key)

    def _free_name(self) -> str:
        stem = re.sub(r"[^\w-]+", "-", self.name).strip("-") or "design"
        return next(n for k in range(1, 10_000) if not (self.folder / (n := f"{stem}-trial-{k}.toml")).exists())

    def _loop(
        self, design: Design, plane: Plane, point: int, kind: LoopKind, vehicle: DeviatingVehicle
    ) -> AnalysedLoop:
        key = plane, point, kind, vehicle
        if key not in self._paths:
            while len(self._paths) >= _LATEST_PATHS:
                self._paths.pop(next(iter(self._paths)))
            self._paths[key] = fixed_path(vehicle.of(self.nodes[plane][point]), kind)
        law = law_at(design, self._paths[key].node, kind)
        self._paths[key] = self._paths[key].with_inputs(law.inputs)
        return AnalysedLoop(self._paths[key], law)

    def _drawn(
        self,
        design: Design,
        plane: Plane,
        point: int,
        kind: LoopKind,
        vehicle: DeviatingVehicle,
        name: str,
        colour: str,
        judged: bool,
    ) -> dict[str, Any]:
        """Return the curves of a design, and with `judged` its margins as marks and its limits."""
        loop = self._loop(design, plane, point, kind, vehicle)
        node, adaptive = loop.fixed.node, design.of_stage(loop.fixed.node.stage).adaptive
        one = JudgedLoop(loop, loop.margins(), adaptive)
        wanted = Wanted.stated_by(self.design, node.stage)
        look: Series = {"colour": colour, "label": name, "dash": "" if judged else "5 3", "live": judged}
        curve = drawn.open_loop(one, drawn.lobe_colours([one]), name, text=drawn.margins_text(one), **look)
        if judged:
            curve["limits"] = drawn.limits_of_planes(wanted)
        else:
            curve |= {"marks": [], "under": True}
        return {
            "name": name,
            "curve": curve,
            "text": drawn.margins_text(one),
            "stable": one.margins.stable,
            "locus": self._locus(loop, look, judged),
            "step": self._step(loop, look),
            "gust": self._gust(loop, look),
            "rows": [check_row(c) for c in checks([one], design, wanted)] if judged else [],
            "gains": {key: float(value) for key, value in loop.law.gains.items()},
        }

    def _locus(self, loop: AnalysedLoop, look: Series, judged: bool) -> list[Series]:
        now = loop.margins().curve.closed_poles / (2.0 * np.pi)
        now, own = now[now.imag >= 0.0], {"colour": look["colour"], "live": look["live"]}
        out = [points(now.real, now.imag, f"poles, {look['label']}", hollow=[not judged] * len(now), **own)]
        if not judged:
            return out
        rational = loop
        if loop.fixed.kind == "exact":
            path = fixed_path(loop.fixed.node, "pade").with_inputs(loop.law.inputs)
            rational = AnalysedLoop(path, loop.law)
        found = root_locus(rational, LOCUS_GAINS)
        hz = np.vstack([found.poles, np.full(found.poles.shape[1], np.nan + 0j)]) / (2.0 * np.pi)
        hz = hz[:, np.nanmax(hz.imag, axis=0, initial=-1.0) >= 0.0]
        hz = np.where(hz.imag >= -1e-9, hz, np.nan).T.ravel()
        start = found.open_poles[found.open_poles.imag >= 0.0] / (2.0 * np.pi)
        branches = line(hz.real, hz.imag, "gain from -20 to 12 dB", faint=True, width=1.0, **own)
        return [branches, points(start.real, start.imag, "open loop", mark="x", colour="grey", live=True), *out]

    def _step(self, loop: AnalysedLoop, look: Series) -> list[Series]:
        found = step_response(loop, "attitude", WINDOW_S)
        k = _thin(len(found.time_s))
        named: Series = {key: look[key] for key in ("colour", "dash", "live")}
        return [
            line(found.time_s[k], values[k], look["label"], **named)
            for values in (found.attitude_rad, found.gimbal_rad)
        ]

    def _gust(self, loop: AnalysedLoop, look: Series) -> list[Series]:
        """Return angle of attack and gimbal angle in the gust, or nothing for an operating point without wind."""
        try:
            found = gust_response(loop, GUST_MPS, GUST_M, WINDOW_S)
        except ValueError:
            return []
        k = _thin(len(found.time_s))
        named: Series = {key: look[key] for key in ("colour", "dash", "live")}
        return [
            line(found.time_s[k], np.degrees(values[k]), look["label"], **named)
            for values in (found.alpha_rad, found.gimbal_rad)
        ]

    def plots(self, shown: Mapping[str, Any]) -> list[Plot]:
        """Return the figures of a result of `show` that has references, for the first drawing of the page."""
        every = [shown["trial"], *shown["references"]]
        curves = [one["curve"] for one in every]
        panels = drawn.loop_panels(curves)
        for panel in panels:
            panel.series = [*curves[1:], curves[0]]
        named = [
            h for m in shown["trial"]["curve"]["marks"] for h in [m["x"]] if m["what"] == "lobe" and "mode" in m["name"]
        ]
        top = 1.3 * max([*named[:1], 2.0])
        locus = Panel("Root locus", [], "Re s / 2 pi, Hz", "Im s / 2 pi, Hz", (-0.5 * top, 0.15 * top), (0.0, top))
        locus.height = 300
        times = [
            Panel("Step of the commanded attitude", [], "time, s", "rad/rad"),
            Panel("Gimbal angle after the step", [], "time, s", "rad/rad"),
            Panel(f"Angle of attack in a gust of {GUST_MPS:g} m/s", [], "time, s", "deg"),
            Panel("Gimbal angle in the gust", [], "time, s", "deg"),
        ]
        times = times if shown["trial"]["gust"] else times[:2]
        for one in reversed(every):
            locus.series += one["locus"]
            for panel, series in zip(times, (*one["step"], *one["gust"]), strict=True):
                panel.series.append(series)
        locus.series.append({"kind": "at", "colour": "grey", "name": "", "value": 0.0})
        times[0].series.append(limit(1.0, "", colour="grey"))
        about = "Red: the margins of the trial. Nichols and Nyquist as on the page of simdesign."
        loop = Plot("loop", "Open loop", panels, about, 2, 175, split=3)
        said = "Upper half plane. Crosses: open loop; dots: closed loop. A sampled pole z is drawn at log(z) / T."
        gust = f"Gust: 1 - cos over {GUST_M:g} m of the path, equal along the vehicle."
        return [
            loop,
            Plot("locus", "Root locus", [locus], said, 1, 300),
            Plot("time", "Time responses", times, gust, 2, 150),
        ]


def sliders(design: Design, stage: int, nodes: Sequence[OperatingPoint]) -> list[Slider]:
    """Return the sliders of a stage of a design: a factor on each gain, and each number of its filters."""
    own, out = design.of_stage(stage), list[Slider]()
    for name in own.gain_names:
        if name in FIXED_GAINS:
            continue
        values = [
            float(np.interp(_at(node, own), own.gains.table[own.gains.over], own.gains.table[name])) for node in nodes
        ]
        label, _, unit = GAIN_HEADS[name].partition(", ")
        ends = 1.0 / GAIN_RANGE, GAIN_RANGE
        out.append(Slider(f"{stage}/gains/{name}", "gains", label, unit, 1.0, *ends, True, tuple(values)))
    forms: list[tuple[str, str, FilterSection | None]] = [("filter", "filter", own.filter)]
    if own.loop_filters is not None:
        forms += [
            (f"loop_filters.{k}", f"{k} filter", getattr(own.loop_filters, k))
            for k in type(own.loop_filters).model_fields
        ]
    for path, group, form in forms:
        if form is None:
            continue
        first, moves = (form.schedule[0], True) if form.schedule else (form, False)
        for kind, sections in (("quadratic", first.quadratic), ("first_order", first.first_order)):
            for n, section in enumerate(sections):
                for name in type(section).model_fields:
                    key, value = f"{stage}/{path}/{kind}/{n}/{name}", float(getattr(section, name))
                    quantity = name.removesuffix("_hz").replace("zeta", "damping ratio").replace("_", " ")
                    label = f"{kind.replace('_', ' ')} {n + 1}: {quantity}"
                    out.append(_slider(key, group, label, name, value, moves))
    return out


def _slider(key: str, group: str, label: str, name: str, value: float, moves: bool) -> Slider:
    if moves:  # a factor on all points of the schedule
        return Slider(key, group, label, "of its schedule", 1.0, 0.5, 2.0, True)
    if name.endswith("_hz"):
        unit = "Hz"
        low, high = sorted((value / HZ_RANGE, value * HZ_RANGE))
        return Slider(key, group, label, unit, value, low, high, value > 0.0)
    low = 0.01 if name == "pole_zeta" else min(0.0, 2.0 * value)
    return Slider(key, group, label, "", value, min(low, value), max(MOST_ZETA, 1.5 * value), False)


def _at(node: OperatingPoint, design: Design) -> float:
    try:
        return node.scheduled(design.gains.over)
    except ValueError:
        return math.nan


def changed(design: Design, edits: Mapping[str, float]) -> Design:
    """Return a design with the values of sliders by key (`sliders`). Raises ValueError for a value that is invalid."""
    by_stage: dict[int, dict[str, float]] = {}
    for key, value in edits.items():
        number, _, rest = key.partition("/")
        by_stage.setdefault(int(number), {})[rest] = value
    for stage, values in by_stage.items():
        own = design.of_stage(stage)
        gains, update = {k.partition("/")[2]: v for k, v in values.items() if k.startswith("gains/")}, dict[str, Any]()
        if gains:
            tables = {"table": own.gains.table, "yaw_table": own.gains.yaw_table}
            scaled = {key: _scaled(table, gains) for key, table in tables.items() if table is not None}
            update["gains"] = own.gains.model_copy(update=scaled)
        of_filter = _of(values, "filter/")
        if of_filter:
            update["filter"] = _filter(own.filter, of_filter)
        if own.loop_filters is not None:
            each = {k: _of(values, f"loop_filters.{k}/") for k in type(own.loop_filters).model_fields}
            new = {k: _filter(getattr(own.loop_filters, k), v) for k, v in each.items() if v}
            if new:
                update["loop_filters"] = own.loop_filters.model_copy(update=new)
        if not design.stage:
            design = design.model_copy(update=update)
            continue
        stages = [*design.stage, *(StageLaw() for _ in range(stage + 1 - len(design.stage)))]
        stages[stage] = stages[stage].model_copy(update=update)
        design = design.model_copy(update={"stage": tuple(stages)})
    return design


def _of(values: Mapping[str, float], start: str) -> dict[str, float]:
    return {key.removeprefix(start): value for key, value in values.items() if key.startswith(start)}


def _scaled(table: CsvTable, factors: Mapping[str, float]) -> CsvTable:
    columns = {name: np.array(column) for name, column in table.columns.items()}
    columns |= {name: columns[name] * factor for name, factor in factors.items() if name in columns}
    return CsvTable("", columns)


def _filter(form: FilterSection, values: Mapping[str, float]) -> FilterSection:
    """Return a filter with values, or factors on the points of its schedule, by `quadratic/0/zero_hz`."""

    def sections(held: FilterSection | FilterPoint, factors: bool) -> dict[str, Any]:
        out: dict[str, Any] = {}
        kinds: tuple[tuple[str, type[Quadratic] | type[FirstOrder]], ...]
        kinds = (("quadratic", Quadratic), ("first_order", FirstOrder))
        for kind, of in kinds:
            rows = []
            for n, section in enumerate(getattr(held, kind)):
                row = {name: getattr(section, name) for name in type(section).model_fields}
                given = {name: values[f"{kind}/{n}/{name}"] for name in row if f"{kind}/{n}/{name}" in values}
                row |= {name: row[name] * value if factors else value for name, value in given.items()}
                rows.append(of(**row))
            out[kind] = tuple(rows)
        return out

    if form.schedule:
        return form.model_copy(
            update={"schedule": tuple(p.model_copy(update=sections(p, True)) for p in form.schedule)}
        )
    return form.model_copy(update=sections(form, False))


def _vehicle(given: Any) -> DeviatingVehicle:
    if not isinstance(given, dict) or not set(given) <= set(VEHICLE_RANGES):
        raise RequestError(f"vehicle: allowed is an object of {', '.join(VEHICLE_RANGES)}")
    for key, value in given.items():
        low, high = VEHICLE_RANGES[key]
        if not isinstance(value, int | float) or not low <= value <= high:
            raise RequestError(f"vehicle.{key} = {value}: allowed is a number from {low:g} to {high:g}")
    return DeviatingVehicle(**given)


def _thin(count: int) -> np.ndarray:
    """Return the indices of at most 250 of `count` points, with the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, 250)).round().astype(int))
