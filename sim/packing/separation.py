"""The transfer of modal motion at a separation to the remaining part of the vehicle.

Displacements and velocities of the remaining part's bent axis are approximated by a rigid motion and the modes of this
part. The approximation is that of least squares, weighted with the masses of the part (docs/model.md, section 4). The
transfer is linear in the modal displacements, so that a matrix describes each separation.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Method, fit
from maxq.sim.input.remembered import cached_by_identity
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.engine.burn import Burn, table_time_s
from maxq.sim.vehicle.modes.masses import products, solved
from maxq.sim.vehicle.modes.packing import gauss
from maxq.sim.vehicle.modes.shapes import ModeShapes, SpatialShapes
from maxq.sim.vehicle.modes.tables import ModeTable, SpatialModeTable
from maxq.sim.vehicle.state import Sizes

RIGID = 6  # rows of the matrix before those of the modes: displacement of the nose along x, y, z of B, and rotation


class StageModes(NamedTuple):
    """The modes of a stage that are simulated, and an instant on the tables' clock."""

    pitch: ModeTable | None
    yaw: ModeTable | None
    spatial: SpatialModeTable | None
    time_s: float
    method: Method

    @property
    def sets(self) -> tuple[ModeTable | SpatialModeTable | None, ...]:
        """Return the mode tables in the order of the state vector."""
        return self.pitch, self.yaw, self.spatial


def part_at(stage: Stage, burn: Burn, sizes: Sizes, time_s: float) -> StageModes:
    """Return the simulated modes of a stage at an instant of its clock."""
    bending, spatial = stage.bending, stage.spatial_modes
    sets = (
        bending.pitch_modes if bending is not None and sizes.pitch_modes > 0 else None,
        bending.yaw_modes if bending is not None and sizes.yaw_modes > 0 else None,
        spatial.modes if spatial is not None and sizes.spatial_modes > 0 else None,
    )
    last_s = max((float(modes.time_s[-1]) for modes in sets if modes is not None), default=0.0)
    return StageModes(*sets, min(table_time_s(stage, burn, time_s), last_s), stage.interpolation)


@cached_by_identity
def modal_transfer(before: StageModes, after: StageModes, mass_kg: float, gyration_m2: float) -> Array:
    """Return the matrix (RIGID + modes after, modes before) from old modes to rigid motion and new modes.

    The weights are the masses of the new modes. Without new modes, they are the masses of the old modes forward of the
    station at which the cumulative mass from the nose is `mass_kg`. `gyration_m2` is the roll inertia per mass, m2.
    """
    points, mass = _masses(before, after, mass_kg)
    old, new = _shapes(before, points), _shapes(after, points)
    rigid = np.zeros((RIGID, 4, len(points)))
    for k in range(4):
        rigid[k, k] = 1.0
    rigid[4, 2], rigid[5, 1] = points, -points
    weight = np.concatenate([mass, mass, mass, gyration_m2 * mass])
    basis, bent = (shapes.reshape(len(shapes), -1) for shapes in (np.concatenate([rigid, new]), old))
    return solved(products(basis, basis, weight), products(basis, bent, weight))[0]


def _masses(before: StageModes, after: StageModes, mass_kg: float) -> tuple[Array, Array]:
    """Return the stations (points,), m, of integration points along the remaining part, and their masses (points,)."""
    own = next((modes for modes in after.sets if modes is not None), None)
    modes = own or next(modes for modes in before.sets if modes is not None)
    x, at_s = modes.station_m, (after if own else before).time_s
    forward = fit(modes.time_s, modes.mass_forward_kg, "linear")(at_s)
    if own is None and forward[0] < mass_kg < forward[-1]:
        cut_m = float(np.interp(mass_kg, forward, x))
        x, forward = np.append(x[x < cut_m], cut_m), np.append(forward[x < cut_m], mass_kg)
    points, weights = gauss(x)
    lengths, between = np.diff(x), np.maximum(np.diff(forward), 0.0)
    density = between / lengths if between.any() else np.ones(len(lengths))  # equal weights for unknown masses
    return points, weights * np.tile(density, len(points) // len(lengths))


def _shapes(part: StageModes, points: Array) -> Array:
    """Return the shapes (modes, 4, points) of all modes: displacements along x, y, z of B, and rotation about x."""
    out = []
    for modes, at in zip(part.sets, (2, 1, None), strict=True):
        if modes is None:
            continue
        then = _then(modes, part)
        if isinstance(then, SpatialModeTable):
            out.append(SpatialShapes(then).at(points)[:, :4, 0].transpose(2, 1, 0))
        else:
            shapes = np.zeros((then.modes, 4, len(points)))
            shapes[:, at] = ModeShapes(then).value(points)[:, 0].T
            out.append(shapes)
    return np.concatenate(out) if out else np.zeros((0, 4, len(points)))


def _then(modes: ModeTable | SpatialModeTable, part: StageModes) -> ModeTable | SpatialModeTable:
    """Return the table with its shapes at the instant of `part` only."""
    names = ("phi", "slope_pm") if isinstance(modes, ModeTable) else ("displacement", "rotation_pm")
    shapes: dict[str, Any] = {}
    for name in names:
        values = getattr(modes, name)
        shapes[name] = fit(modes.time_s, values, part.method)(part.time_s).reshape(1, *values.shape[1:])
    return replace(modes, time_s=np.array([part.time_s]), **shapes)
