"""A layout from a rocket of another program: its text with remarks, and its table for the terminal."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tomli_w
from pydantic import ValidationError

from maxq.control.kernel.limits import MAX_SURFACES
from maxq.control.kernel.records import Array
from maxq.sim.files import write_whole
from maxq.sim.input.documents import Source, Text
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.files import Reading, shown
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.input.values import Section
from maxq.sim.vehicle.air.section import AERO_COLUMNS
from maxq.tools.cli.terminal import aligned
from maxq.tools.vehicle.aerodynamics import CROSSFLOW, MACH, Surface, body_lift, fin_lift
from maxq.tools.vehicle.airframe import Airframe, Body, FinSet, Piece, Remark
from maxq.tools.vehicle.layout import LayoutFins, read_layout

_CORNER = 0.02  # share of the interval between two rows of a thrust curve in which its corner is rounded
_MOST_FINS = 8  # of a layout
_TAPER = 6  # sections of the beam in a body with a changing radius
_LEAST_m = 1e-4  # length of a point mass, and least radius of a section
_KINDS = {"taken": 0, "assumed": 1, "missing": 2}
_WIDTH = 118


class _DragFile(Section):
    """The axial force coefficient over Mach number."""

    table: Annotated[CsvTable, AERO_COLUMNS]


def write_layout(airframe: Airframe, folder: Path) -> Path:
    """Write the layout of a rocket into a folder, and return its path. Raises ScenarioError if it is invalid."""
    path = write_whole(folder / "layout.toml", layout_text(airframe))
    try:
        read_layout(path)
    except Exception:
        path.unlink()
        raise
    return path


def with_drag(airframe: Airframe, path: Path) -> Airframe:
    """Return the rocket with the axial force coefficient of a file, with and without thrust. Raises ScenarioError.

    The file has lines of a Mach number and a coefficient, or the columns `mach` and `CA` or `CD`, and `CA_coast`.
    """
    label = shown(path)
    try:
        name = Text.of(path.name, Source(label, (path.absolute().parent,)))
        table = _DragFile.model_validate({"table": name}, context=Reading()).table
    except ValidationError as error:
        found = error.errors()[0].get("ctx", {})
        raise ScenarioError(label, found["problem"], found["place"], allowed=found["allowed"]) from None
    if "CA" not in table and "CD" not in table:
        raise ScenarioError(label, "has no axial force", allowed="a column CA or CD")
    powered = table["CA"] if "CA" in table else table["CD"]
    coast = table.columns.get("CA_coast", powered)
    remarks = [r for r in airframe.remarks if r.subject != "drag"] + [Remark("taken", "drag", label)]
    return replace(airframe, axial=(table["mach"], powered, coast), remarks=remarks)


def table_text(airframe: Airframe) -> str:
    """Return what was taken, assumed and missing as a table."""
    rows = [(r.kind, r.subject, r.text) for r in _in_order(airframe)]
    return "\n".join(aligned([("data", "of", "value"), *rows], "  "))


def _in_order(airframe: Airframe) -> list[Remark]:
    """Return the remarks by kind, each once."""
    return sorted(dict.fromkeys(airframe.remarks), key=lambda r: _KINDS[r.kind])


def layout_text(airframe: Airframe) -> str:
    """Return the layout as TOML, with the remarks as comments."""
    head = [f"{airframe.name}: imported from {airframe.source} by simvehicle."]
    head += [f"{r.kind}: {r.subject}: {r.text}" for r in _in_order(airframe)]
    lines = [line for text in head for line in textwrap.wrap(_plain(text), _WIDTH, subsequent_indent="  ")]
    return "".join(f"# {line}\n" for line in lines) + tomli_w.dumps(layout_document(airframe))


def _plain(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)


def layout_document(airframe: Airframe) -> dict[str, Any]:
    """Return the layout of a rocket as the keys of its file. The stages are in the order of flight."""
    from_top = airframe.stages
    nose = from_top[0].bodies[0]
    diameter = max(s.diameter_m for s in from_top)
    stages = [_stage(airframe, n, diameter) for n in reversed(range(len(from_top)))]
    return {
        "schema": 1,
        "name": airframe.name,
        "description": f"imported from {Path(airframe.source).name}",
        "nose": airframe.nose,
        "nose_length_m": nose.length_m,
        "site": {
            "latitude_deg": airframe.latitude_deg,
            "longitude_deg": airframe.longitude_deg,
            "altitude_m": airframe.altitude_m,
            "azimuth_deg": airframe.azimuth_deg,
        },
        "rail": {"length_m": airframe.rail_m, "elevation_deg": airframe.elevation_deg},
        "control": {
            "gyro_station_m": 0.5 * (from_top[0].bodies[0].front_station_m + from_top[0].bodies[-1].rear_station_m)
        },
        "stage": stages,
    }


def _stage(airframe: Airframe, n: int, diameter_m: float) -> dict[str, Any]:
    stage, m = airframe.stages[n], airframe.stages[n].motor
    front, rear = stage.bodies[0].front_station_m, stage.bodies[-1].rear_station_m
    case = (m.case_kg * m.count, m.front_station_m, m.rear_station_m, m.radius_m)
    grain_ends = m.grain or (m.front_station_m, m.rear_station_m)
    times = _with_corners(m.time_s)
    newton = m.count * np.interp(times, m.time_s, m.thrust_N)
    thrust = {"time_s": (times - times[0]).tolist(), "thrust_vacuum_N": newton.tolist()}
    nozzle_m = min(m.rear_station_m, rear)
    grain: dict[str, Any] = {
        "front_station_m": grain_ends[0],
        "rear_station_m": grain_ends[1],
        "mass_kg": m.count * m.propellant_kg,
        "radius_m": m.radius_m,
    }
    if m.port_radius_m:
        grain |= {"burns": "port", "port_radius_m": m.port_radius_m}
    parts = [_part(p) for p in stage.pieces if p.mass_kg > 0.0]
    if case[0] > 0.0:
        parts.append(
            {
                "name": f"case of {m.name}",
                "mass_kg": case[0],
                "front_station_m": case[1],
                "rear_station_m": case[2],
                "radius_m": case[3],
            }
        )
    out: dict[str, Any] = {
        "name": stage.name,
        "front_station_m": front,
        "rear_station_m": rear,
        "diameter_m": stage.diameter_m,
        "part": parts,
        "shell": [section for body in stage.bodies for section in _shell(body)],
        "grain": [grain],
        "engine": {
            "gimbal": "fixed",
            "thrust": thrust,
            "exit_area_m2": m.count * m.exit_area_m2,
            "gimbal_station_m": nozzle_m,
            "exit_station_m": max(m.rear_station_m, nozzle_m + _LEAST_m),
            "mass_kg": 0.0,
        },
        "aero": _aero(airframe, n, diameter_m),
    }
    if len(stage.fins) == 1 and (f := stage.fins[0]).sweep_m >= 0.0 and 3 <= f.count <= _MOST_FINS:  # for the drawing
        out["fins"] = {key: getattr(f, key) for key in LayoutFins.model_fields}
    if airframe.rigid:
        out["modes"] = 0
    if n > 0:
        out["separation_after_s"] = stage.separation_after_s
    if n + 1 < len(airframe.stages):
        out["ignition_after_s"] = airframe.stages[n + 1].ignition_after_s
    return out


def _with_corners(times: Array) -> Array:
    """Return times with further ones next to each, between which a PCHIP curve of a polygon is a straight line."""
    near = _CORNER * np.diff(times)
    return np.unique(np.concatenate([times, times[:-1] + near, times[1:] - near]).round(9))


def _part(piece: Piece) -> dict[str, Any]:
    """Return a piece as a rod with its mass, CG and moments of inertia."""
    half = max(0.5 * math.sqrt(12.0 * piece.axial_m2), 0.5 * _LEAST_m)
    return {
        "name": piece.name,
        "mass_kg": piece.mass_kg,
        "front_station_m": piece.station_m - half,
        "rear_station_m": piece.station_m + half,
        "gyration_m": [math.sqrt(piece.roll_m2), math.sqrt(piece.across_m2)],
    }


def _shell(body: Body) -> list[dict[str, Any]]:
    """Return the sections of the beam in a body: one for a tube, more for a changing radius."""
    count = 1 if body.front_radius_m == body.rear_radius_m else _TAPER
    edges = np.linspace(body.front_station_m, body.rear_station_m, count + 1)
    radii = np.linspace(body.front_radius_m, body.rear_radius_m, count + 1)
    out = []
    for k in range(count):
        outer = max(0.5 * float(radii[k] + radii[k + 1]), _LEAST_m)
        inner = 0.0 if body.wall_m is None else max(outer - body.wall_m, 0.0)
        if outer == inner:  # a wall without thickness
            inner = 0.99 * outer
        stiffness = 0.25 * math.pi * body.modulus_Pa * (outer**4 - inner**4)
        out.append({"front_station_m": float(edges[k]), "rear_station_m": float(edges[k + 1]), "EI_Nm2": stiffness})
    return out


def _aero(airframe: Airframe, n: int, diameter_m: float) -> dict[str, Any]:
    """Return the aerodynamics of the stack that flies with stage `n` at its rear."""
    flying = airframe.stages[: n + 1]
    bodies, fins = [b for s in flying for b in s.bodies], [f for s in flying for f in s.fins]
    surfaces, roll, areas = _surfaces(bodies, fins, diameter_m)
    areas += [(b.side_m2, b.side_station_m) for b in bodies]
    total = sum(a for a, _ in areas)
    mach, columns = MACH, dict[str, Array]()
    if airframe.axial is not None:
        given, powered, coast = airframe.axial
        mach = np.unique(np.concatenate([MACH, given]).round(9))
        share = ((airframe.reference_diameter_m or diameter_m) / diameter_m) ** 2
        columns = {"CA": share * np.interp(mach, given, powered), "CA_coast": share * np.interp(mach, given, coast)}
    crossflow = CROSSFLOW * total / (0.25 * math.pi * diameter_m**2)
    columns |= {"Clp": np.interp(mach, MACH, roll), "C_crossflow": np.full(len(mach), crossflow)}
    return {
        "table": {"mach": mach.tolist(), **{name: column.tolist() for name, column in columns.items()}},
        **({"interpolation": "linear"} if airframe.axial is not None else {}),
        "crossflow_station_m": sum(a * x for a, x in areas) / total,
        "surface": surfaces,
    }


def _surfaces(
    bodies: Sequence[Body], fins: Sequence[FinSet], diameter_m: float
) -> tuple[list[dict[str, Any]], Array, list[tuple[float, float]]]:
    """Return the lifting parts, Clp over `MACH`, and the area and station of the fins in the planform.

    If maxq cannot have all of them, the bodies are joined, and then the fins.
    """
    reference_m2 = 0.25 * math.pi * diameter_m**2
    lifting = [b for b in bodies if abs(b.lift_area_m2) > 1e-12]
    found = [body_lift(b.name, 2.0 * b.lift_area_m2 / reference_m2, b.lift_station_m) for b in lifting]
    for ahead, behind in pairwise(bodies):
        step_m2 = math.pi * (behind.front_radius_m**2 - ahead.rear_radius_m**2)
        if abs(step_m2) > 1e-9 * reference_m2:
            found.append(body_lift(f"step to {behind.name}", 2.0 * step_m2 / reference_m2, behind.front_station_m))
    roll, areas, on_fins = np.zeros(len(MACH)), list[tuple[float, float]](), list[Surface]()
    for f in fins:
        shape = LayoutFins.model_construct(
            count=f.count,
            root_chord_m=f.root_chord_m,
            tip_chord_m=f.tip_chord_m,
            semispan_m=f.semispan_m,
            leading_edge_station_m=f.leading_edge_station_m,
            sweep_m=f.sweep_m,
        )
        surface, damping, area = fin_lift(shape, f.name, f.body_radius_m, diameter_m)
        on_fins.append(surface)
        roll = roll + damping
        areas.append((2.0 * area, float(surface.station_m[0])))
    if len(found) + len(on_fins) > MAX_SURFACES:
        found = [_joined("bodies", found)]
    if len(found) + len(on_fins) > MAX_SURFACES:
        on_fins = [_joined("fins", on_fins)]
    tables = [
        {"mach": MACH.tolist(), "CN_alpha_pr": s.slope_pr.tolist(), "station_m": s.station_m.tolist()}
        for s in (*found, *on_fins)
    ]
    named = [{"name": s.name, "table": table} for s, table in zip((*found, *on_fins), tables, strict=True)]
    return named, roll, areas


def _joined(name: str, surfaces: Sequence[Surface]) -> Surface:
    """Return the sum of lifting parts, with the same moment on a rigid vehicle."""
    slope = sum((s.slope_pr for s in surfaces), np.zeros(len(MACH)))
    moment = sum((s.slope_pr * s.station_m for s in surfaces), np.zeros(len(MACH)))
    return Surface(name, slope, moment / slope)
