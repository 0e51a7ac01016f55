"""Slender-body and fin aerodynamics over Mach number: first estimates, to be replaced by a wind tunnel's.

Normal force: slender-body theory for nose and changes of diameter (2 / rad on the area gained), Barrowman's method for
fins with body interference (J. S. Barrowman, NARAM-8, 1966), both over Mach by a factor that peaks at 1.1. Cross-flow
drag 1.2 on the planform. Rate damping by strips. The axial force is an assumed curve of a clean launcher.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from maxq.control.kernel.records import Array
from maxq.tools.vehicle.layout import Fins
from maxq.tools.vehicle.masses import Stack

MACH = np.array([0.0, 0.5, 0.8, 0.95, 1.1, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 5.0, 8.0])
_FIN_LIFT = np.array([1.0, 1.02, 1.08, 1.13, 1.16, 1.13, 1.02, 0.91, 0.81, 0.67, 0.56, 0.33, 0.21])
_FIN_SHIFT = 0.25 * np.array([0.0, 0.0, 0.0, 0.1, 0.4, 0.8, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])  # of the mean chord
_BODY_LIFT = 1.0 + 0.15 * np.exp(-(((MACH - 1.1) / 0.5) ** 2))
_AXIAL = np.array([0.30, 0.29, 0.31, 0.45, 0.55, 0.54, 0.49, 0.44, 0.40, 0.33, 0.28, 0.21, 0.18])
_BASE = np.interp(MACH, [0.0, 0.9, 1.1, 2.0, 5.0], [0.10, 0.13, 0.18, 0.10, 0.02])  # when no jet fills it
CROSSFLOW = 1.2
NOSE_CENTRE = {"ogive": 0.466, "cone": 2.0 / 3.0}  # of the nose's length


@dataclass(frozen=True)
class Surface:
    """A lifting part: normal force slope (1/rad, on the reference area) and station, over MACH."""

    name: str
    slope_pr: Array
    station_m: Array


@dataclass(frozen=True)
class Aerodynamics:
    """Of a stack, over MACH; the reference is the largest diameter of the whole vehicle."""

    diameter_m: float
    surfaces: tuple[Surface, ...]
    crossflow: float
    crossflow_station_m: float
    roll_damping: Array
    axial: Array
    axial_coast: Array

    @property
    def area_m2(self) -> float:
        return 0.25 * math.pi * self.diameter_m**2

    def normal(self, mach: float) -> tuple[float, float]:
        """Slope, 1/rad, and centre of pressure, m aft of the nose."""
        slopes = [float(np.interp(mach, MACH, s.slope_pr)) for s in self.surfaces]
        stations = [float(np.interp(mach, MACH, s.station_m)) for s in self.surfaces]
        return sum(slopes), float(np.dot(slopes, stations)) / sum(slopes)

    def pitch_damping(self, x_cg_m: float) -> Array:
        """Cmq about a CG, per q d / (2 U), over MACH."""
        moment = sum((s.slope_pr * (s.station_m - x_cg_m) ** 2 for s in self.surfaces), np.zeros(len(MACH)))
        return np.asarray(-2.0 * moment / self.diameter_m**2)


def aerodynamics(stack: Stack) -> Aerodynamics:
    """Of what flies while a stage burns."""
    layout, stages = stack.layout, list(reversed(stack.layout.stage[stack.number :]))
    diameter = max(s.diameter_m for s in layout.stage)
    nose = Surface(
        "nose", 2.0 * (stages[0].diameter_m / diameter) ** 2 * _BODY_LIFT,
        np.full(len(MACH), NOSE_CENTRE[layout.nose] * layout.nose_length_m),
    )  # fmt: skip  # two more lines otherwise
    surfaces = [nose]
    for ahead, behind in pairwise(stages):
        gained = (behind.diameter_m**2 - ahead.diameter_m**2) / diameter**2
        if gained != 0.0:
            at = np.full(len(MACH), behind.front_station_m)
            surfaces.append(Surface(f"step_{behind.name}", 2.0 * gained * _BODY_LIFT, at))
    planform = [(2.0 / 3.0 * layout.nose_length_m * stages[0].diameter_m, 0.6 * layout.nose_length_m)]
    for stage in stages:
        front = max(stage.front_station_m, layout.nose_length_m)
        planform.append((stage.diameter_m * (stage.rear_station_m - front), 0.5 * (stage.rear_station_m + front)))
    roll = np.zeros(len(MACH))
    for stage in stages:
        if stage.fins is not None:
            fins, roll_damping, area = _fins(stage.fins, stage.name, 0.5 * stage.diameter_m, diameter)
            surfaces.append(fins)
            roll = roll + roll_damping
            planform.append((2.0 * area, float(fins.station_m[0])))
    total = sum(a for a, _ in planform)
    share = (max(s.diameter_m for s in stages) / diameter) ** 2
    axial = layout.axial_factor * share * _AXIAL
    return Aerodynamics(
        diameter, tuple(surfaces), CROSSFLOW * total / (0.25 * math.pi * diameter**2),
        sum(a * x for a, x in planform) / total, roll, axial, axial + share * _BASE,
    )  # fmt: skip  # four more lines otherwise


def _fins(fins: Fins, name: str, radius_m: float, reference_m: float) -> tuple[Surface, Array, float]:
    """Surface, Clp and the area of one fin, by Barrowman (equations 3-57, 3-31 and strip theory in roll)."""
    s, root, tip = fins.semispan_m, fins.root_chord_m, fins.tip_chord_m
    middle = math.hypot(s, fins.sweep_m + 0.5 * (tip - root))  # length of the mid-chord line
    interference = 1.0 + radius_m / (s + radius_m)
    alone = 4.0 * fins.count * (s / reference_m) ** 2 / (1.0 + math.sqrt(1.0 + (2.0 * middle / (root + tip)) ** 2))
    centre = fins.sweep_m / 3.0 * (root + 2.0 * tip) / (root + tip)
    centre += (root + tip - root * tip / (root + tip)) / 6.0
    y = np.linspace(radius_m, radius_m + s, 201)
    chord = np.interp(y, [radius_m, radius_m + s], [root, tip])
    square = float(np.trapezoid(chord * y * y, y) / np.trapezoid(chord, y))
    # a pair of fins lifts with count / 2 of them: in roll all of them do
    roll = -2.0 * 2.0 * alone * _FIN_LIFT * square / reference_m**2
    shift = _FIN_SHIFT * 0.5 * (root + tip)
    surface = Surface(f"fins_{name}", interference * alone * _FIN_LIFT, fins.leading_edge_station_m + centre + shift)
    return surface, roll, 0.5 * (root + tip) * s
