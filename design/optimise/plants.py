"""The plants of a design: operating points with fixed paths, bending bands and stability derivatives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design import operating_points
from maxq.design.case.basis import Basis
from maxq.design.case.schema import Case, LoadedCase
from maxq.design.laws.law import DRIFTS, MEASUREMENTS
from maxq.design.laws.registry import law_kind
from maxq.design.laws.task import PlantLimits, Rigid, Task
from maxq.design.laws.wind import Spectrum, WindResponse
from maxq.design.loop.fixed_path import FixedPath, fixed_path
from maxq.design.loop.own_part import NEAREST_NYQUIST, attribution, peak_band
from maxq.design.loop.step import step_paths
from maxq.design.loop.wind import wind_response
from maxq.design.margins.curve import lowest_hz_of
from maxq.design.model.given_file import given_points
from maxq.design.model.instruments import ACCELERATION
from maxq.design.model.node import Node, flown_point, with_cuts
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.model.state_space import ComplexArray
from maxq.design.model.vehicle_at import incidence_by_acceleration
from maxq.design.optimise.criteria import OBJECTIVES
from maxq.design.optimise.curves import BASE, HIGHEST_HZ, TOLERANCE, CurveIndices, Curves, PathMesh, mesh_of
from maxq.design.optimise.features import Bands, FeatureMode
from maxq.design.optimise.problem import bands_of
from maxq.design.optimise.response_goals import FunctionPaths, GoalData
from maxq.design.optimise.templates import corners_hz as corners_hz_of
from maxq.design.quantities import STEPS

FUNCTION_POINTS = 400  # frequencies of a function


@dataclass(frozen=True)
class Plant:
    """The fixed part of a loop, with data of its vehicle. `dispersed` selects the limits of the plant."""

    node: OperatingPoint
    path: FixedPath
    modes: tuple[FeatureMode, ...]
    m_delta: float
    m_alpha: float
    m_q: float
    dispersed: bool = False
    wind: WindResponse | None = None
    corners_hz: tuple[float, ...] = ()  # of the templates of the case
    goal_data: GoalData | None = None

    @property
    def flown(self) -> Node:
        """Return the operating point with its vehicle. Raises ValueError for an operating point without a vehicle."""
        return flown_point(self.node)

    @property
    def bands_hz(self) -> list[tuple[int, float, float]]:
        """Return the number of each mode and the band of its peak."""
        return [(mode.number, *mode.band_hz) for mode in self.modes]

    def without_drift(self, poles: ComplexArray) -> ComplexArray:
        """Return the poles of the open or closed loop (rad/s), except those below the range of its curve."""
        return np.asarray(poles[np.abs(poles) > 2.0 * np.pi * lowest_hz_of(self.path.poles())])


def make_plant(node: OperatingPoint, case: Case, dispersed: bool = False) -> Plant:
    """Return the plant of an operating point.

    Raises ValueError for a vehicle without a required sensor, and for a point without a first bending mode if the
    objective requires one.
    """
    measured = (*law_kind(case.law).inputs, *(_further_gyros(node) if case.blend is not None else ()))
    needed = tuple(ACCELERATION if name in DRIFTS else name for name in measured)
    for name in needed:
        if name not in MEASUREMENTS and name not in (sensed for sensed, _, _ in node.instruments.sensors):
            raise ValueError(
                f"operating point at {node.time_s:g} s: the vehicle has no accelerometer, which {case.law} requires"
            )
    path = fixed_path(node, case.loop).with_inputs(measured)
    path.measurements = measured
    wind = None if case.wind is None else wind_of(path, case)
    corners_hz, data = tuple(corners_hz_of(case.goal)), _goal_data(path, case)
    modes = modes_of(path)
    soft = any(one.quantity == "first_mode_db" and not one.hard for one in case.goal)
    if (OBJECTIVES[case.objective.kind].needs_mode or soft) and not any(mode.number == 1 for mode in modes):
        known = OBJECTIVES.items()
        others = " or ".join(f'"{name}"' for name, each in known if not each.needs_mode and name != "goals")
        raise ValueError(
            f"operating point at {node.time_s:g} s: there is no first bending mode whose peak could be made small; "
            f"allowed is objective.kind = {others}"
        )
    d = node.derivatives
    return Plant(node, path, modes, d.m_delta_1ps2, d.m_alpha_1ps2, d.m_q_1ps, dispersed, wind, corners_hz, data)


def _goal_data(path: FixedPath, case: Case) -> GoalData | None:
    """Return the data of a plant for goals on step responses and for functions, or None without such goals."""
    until_s = max((one.until_s for one in case.goal if one.quantity in STEPS), default=0.0)
    functions = {one.function: one.band_hz for one in case.goal if one.function is not None}
    if until_s == 0.0 and not functions:
        return None
    names, data = path.measurements, {}
    for name, (low_hz, high_hz) in functions.items():
        x = np.linspace(math.log(low_hz), math.log(min(high_hz, NEAREST_NYQUIST * path.highest_hz)), FUNCTION_POINTS)
        f = np.exp(x)
        each = [path.response(f) * (path.ratio(one, f) if one != BASE else 1.0) for one in names]
        data[name] = FunctionPaths(x, np.stack(each, axis=1))
    return GoalData(step_paths(path, names, until_s) if until_s > 0.0 else None, data)


def wind_of(path: FixedPath, case: Basis) -> WindResponse:
    """Return the wind response of a path in the case's wind, with the bending moments that the case requires.

    Raises ValueError, with the operating point, if a required bending moment does not exist.
    """
    assert case.wind is not None
    try:
        stations_m = case.bending_stations_m(path.node.cut_stations_m)
        return wind_response(path, Spectrum(**dict(case.wind)), stations_m)
    except ValueError as problem:
        raise ValueError(f"operating point at {path.node.time_s:g} s: {problem}") from None


def nodes_of(loaded: LoadedCase, times_s: Sequence[float]) -> Sequence[OperatingPoint]:
    """Return the operating points of a case with one stage, at vehicle times."""
    case = loaded.case
    if loaded.points is not None:
        return given_points(loaded.points, times_s)
    nodes = operating_points.nodes(loaded.along, times_s, plane=case.plane, errata=case.errata, plant=case.plant)
    return with_cuts(nodes, loaded.along) if case.bends else nodes


def modes_of(path: FixedPath) -> tuple[FeatureMode, ...]:
    """Return the bending modes in the frequency range of a path, with the bands of their peaks (`loop.own_part`)."""
    top_hz, out = min(NEAREST_NYQUIST * path.highest_hz, HIGHEST_HZ), []
    bending = [r for r in path.resonances() if r.kind == "bending" and r.centre_hz <= top_hz]
    for r in bending:
        gap_hz = min((abs(r.centre_hz - o.centre_hz) for o in bending if o is not r), default=math.inf)
        band_hz = peak_band(r.centre_hz, r.half_width_hz, r.part, gap_hz, top_hz)
        out.append(FeatureMode(r.number, r.centre_hz, r.half_width_hz, r.part, band_hz, attribution(r.part)))
    return tuple(out)


def _further_gyros(node: OperatingPoint) -> tuple[str, ...]:
    return tuple(name for name, _, _ in node.instruments.sensors if name.startswith("rate_"))


@dataclass(frozen=True)
class Plants:
    """The plants of a task and their curves."""

    each: tuple[Plant, ...]
    curves: Curves
    bands: Bands

    def __len__(self) -> int:
        return len(self.each)

    @property
    def times_s(self) -> Array:
        return np.array([p.node.time_s for p in self.each])

    @property
    def rigid(self) -> Rigid:
        return Rigid(*(np.array([getattr(p, name) for p in self.each]) for name in ("m_delta", "m_alpha", "m_q")))

    @property
    def unstable_open(self) -> CurveIndices:
        """Return the number of poles of each fixed path in the right half plane, without drift."""
        return np.array([int((p.without_drift(p.path.poles()).real > 1e-9).sum()) for p in self.each], np.int64)

    @property
    def sample_s(self) -> float | None:
        return self.each[0].path.sample_s

    @property
    def first_mode_hz(self) -> float:
        """Return the mean frequency of the first bending mode, or 10 Hz if no plant has one."""
        first = [mode.centre_hz for p in self.each for mode in p.modes if mode.number == 1]
        return float(np.mean(first)) if first else 10.0

    def task(self, case: Case) -> Task:
        """Return the task for the law's variables."""
        off = case.robust.limits if case.robust is not None else case.limits
        limits = PlantLimits([off if p.dispersed else case.limits for p in self.each], self.times_s)
        dispersed = np.array([p.dispersed for p in self.each], bool)
        further = len(_further_gyros(self.each[0].node)) if case.blend is not None else 0
        winds = tuple(p.wind for p in self.each if p.wind is not None)
        at = np.array([p.node.scheduled(case.gains.over) for p in self.each])
        told = np.zeros((0, 2))
        if case.law == "incidence-relief":
            told = np.array(
                [
                    incidence_by_acceleration(p.flown.vehicle, p.node.derivatives, p.node.condition.airspeed_mps)
                    for p in self.each
                ]
            )
        return Task(
            case,
            self.times_s,
            dispersed,
            self.rigid,
            limits,
            self.sample_s,
            self.first_mode_hz,
            further,
            at,
            told,
            winds,
        )

    def and_also(self, more: Sequence[Plant]) -> Plants:
        """Return these plants together with further plants."""
        return _with_curves((*self.each, *more), Curves([*self.curves.meshes, *_meshes(more)]))


def make_plants(plants: Sequence[Plant], tolerance: float = TOLERANCE) -> Plants:
    """Return the plants with their curves, for the given tolerance. Raises ValueError if there is no plant."""
    if not plants:
        raise ValueError("there is no operating point to design for")
    return _with_curves(tuple(plants), Curves(_meshes(plants, tolerance)))


def _meshes(plants: Sequence[Plant], tolerance: float = TOLERANCE) -> list[PathMesh]:
    kept = [
        np.array([*(hz for mode in p.modes for hz in (*mode.band_hz, mode.centre_hz)), *p.corners_hz]) for p in plants
    ]
    return [mesh_of(p.path, hz, tolerance) for p, hz in zip(plants, kept, strict=True)]


def _with_curves(plants: tuple[Plant, ...], curves: Curves) -> Plants:
    return Plants(plants, curves, bands_of(curves, [p.modes for p in plants]))
