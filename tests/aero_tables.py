"""Provide a vehicle with coefficient tables over angle of attack, as ordinary scenario keys."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from flightkit import Mode, Parts, Rig, Tree, merged, rig, scenario_of, with_stage

MODES = (
    Mode(6.0, 900.0, (1.0, 0.3, -0.2, -0.7, 0.1, 1.0), (-0.25, -0.22, -0.2, 0.1, 0.45, 0.5)),
    Mode(15.0, 700.0, (1.0, -0.4, -0.7, 0.5, 0.2, -1.0), (-0.6, -0.3, 0.1, 0.2, -0.4, -0.7)),
)
PARTS = Parts(core_cg=(7.0, 0.03, -0.05), pitch=MODES, yaw=MODES, engine=False)
REFERENCE = {"length_m": 14.0, "diameter_m": 1.0, "area_m2": 0.8, "chord_m": 1.3, "span_m": 0.9, "yaw_chord_m": 1.1}
AIR = {"model": "constant", "density_kgpm3": 0.9, "pressure_Pa": 7e4, "temperature_K": 270.0}


def table(axes: dict[str, list[float]], seed: int, *names: str) -> Tree:
    """Return a long-format table of columns `names` with random values that are zero where they must be, at total_deg =
    0 and 180.
    """
    made = np.random.default_rng(seed)
    points = np.array(list(itertools.product(*axes.values())))
    columns: dict[str, Any] = dict(zip(axes, points.T, strict=True))
    for name in names:
        values = made.uniform(-2.0, 2.0, len(points))
        if "total_deg" in axes:
            ends = (columns["total_deg"] == 0.0) | (columns["total_deg"] == 180.0)
            values[ends] = 0.0 if name not in ("CA", "CX", "CD") else 0.4
        columns[name] = values
    return columns


MACHS = [0.0, 0.3, 0.9, 1.6]
OVER_TOTAL = table(
    {"mach": MACHS, "total_deg": [0.0, 5.0, 20.0, 60.0, 180.0], "roll_deg": [-180.0, -70.0, 10.0, 90.0]},
    1,
    "CA",
    "CY",
    "CN",
    "Cl",
    "Cm",
    "Cn",
)
OVER_ALPHA_BETA = table(
    {"mach": MACHS, "alpha_deg": [-180.0, -40.0, 0.0, 15.0, 180.0], "beta_deg": [-90.0, -10.0, 25.0, 90.0]},
    2,
    "CX",
    "CY",
    "CZ",
    "Cl",
    "Cm",
    "Cn",
)
STABILITY = table({"alpha_deg": [-180.0, -10.0, 0.0, 12.0, 180.0]}, 3, "CD", "CL", "CY", "Cm")
WIND_PLANE = table({"mach": MACHS, "total_deg": [0.0, 8.0, 30.0, 180.0]}, 4, "CD", "CL", "Cm")
RATES = table(
    {"mach": MACHS, "alpha_deg": [-90.0, 0.0, 90.0]}, 5, "Clp", "Clr", "Cmq", "Cnr", "Cnp", "CYp", "CYr", "CNq"
)


def flying(aero: Tree, velocity_B_mps: list[float], **changes: Any) -> Rig:
    """Return the vehicle over a flat Earth at `velocity_B_mps` in a constant atmosphere, axes north, east, down."""
    return burning({"aero": aero}, {}, velocity_B_mps, **changes)


def burning(stage: Tree, mass: Tree, velocity_B_mps: list[float], **changes: Any) -> Rig:
    """Return the same vehicle with changed keys of the stage and of its mass."""
    start = {"euler_deg": [0.0, 0.0, 0.0], "ned_mps": velocity_B_mps}
    tree = scenario_of(PARTS, initial=start, atmosphere=AIR, vehicle={"reference": REFERENCE})
    return rig(merged(with_stage(tree, mass=mass, **stage), changes))
