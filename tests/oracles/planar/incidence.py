"""Compute the slopes of aerodynamic coefficients over angle of attack, at the flown trim.

The tables are the simulator's, but its equations are not used. Forces are written again over numbers that carry their
derivatives with respect to the velocity relative to the air. A slope is therefore that of the interpolant, including
Mach number and dynamic pressure. All quantities are per rho S V / 2 and computed with V = 1: the slopes depend only on
the Mach number and the direction of the flow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from maxq.control.kernel.grids import grid_in
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.sim.vehicle import schedule
from maxq.sim.vehicle.air import incidence
from maxq.sim.vehicle.air import kernel as aero

_ALONG = 1e-10  # sine of the total angle of attack below which its plane is undefined


@dataclass(frozen=True)
class TableSlopes:
    """The slopes of a vehicle's table, per rho S V / 2 (force; m: moment), moments about `reference_m`.

    Rows x, y, z of B; columns u, v, w (m/s) or p, q, r (rad/s). `force` is per rho S V^2 / 2. `by_mach`: part of the
    slopes by the flow that is due to the Mach number, which is that at the CG whatever the flow at the table.
    """

    force: Array  # (3,)
    force_by_flow: Array  # (3, 3)
    couple_by_flow_m: Array
    force_by_rate_m: Array
    couple_by_rate_m2: Array
    by_mach: tuple[Array, Array]  # of force (3, 3) and couple
    reference_m: float  # station of the moment reference, with the shift of the centre of pressure
    station_m: float  # where modes meet it

    def plane(self, plane: str) -> tuple[float, float, float, float]:
        """Return CN_alpha, CN_alpha times station (m), and the same by the turning rate (m, m2) of a planar model.

        In the pitch plane they are Fz and My by w and q, in yaw Fy and Mz by v and -r. The flow in the other plane and
        along the axis and rotation about x are omitted. The slopes are by the flow at the table.
        """
        _, turn, sign = axes = _axes_of(plane)
        slope, moment = self._slopes(
            axes, self.force_by_flow - self.by_mach[0], self.couple_by_flow_m - self.by_mach[1]
        )
        by_rate = -sign * self.force_by_rate_m[axes[0], turn]
        rate_moment = by_rate * self.reference_m - self.couple_by_rate_m2[turn, turn]
        return slope, moment, float(by_rate), float(rate_moment)

    def plane_by_mach(self, plane: str) -> tuple[float, float]:
        """Return the changes of CN_alpha and CN_alpha times station due to the Mach number at the CG."""
        return self._slopes(_axes_of(plane), *self.by_mach)

    def across(self, plane: str) -> tuple[float, float, float, float]:
        """Return the first two values of `plane` by the other plane's flow: at the table, then by the Mach number."""
        axes = _axes_of(plane)
        local = self.force_by_flow - self.by_mach[0], self.couple_by_flow_m - self.by_mach[1]
        return *self._slopes(axes, *local, 3 - axes[0]), *self._slopes(axes, *self.by_mach, 3 - axes[0])

    def _slopes(
        self, axes: tuple[int, int, float], force: Array, couple: Array, flow: int | None = None
    ) -> tuple[float, float]:
        across, turn, sign = axes
        flow = across if flow is None else flow
        slope = -force[across, flow]
        return float(slope), float(slope * self.reference_m - sign * couple[turn, flow])


def _axes_of(plane: str) -> tuple[int, int, float]:
    """Return the lateral axis and the rotation axis of a plane, and its sign."""
    return (2, 1, 1.0) if plane == "pitch" else (1, 2, -1.0)


class Gradient:
    """A number and its derivatives with respect to u, v, w."""

    def __init__(self, value: float, slopes: Array) -> None:
        self.value, self.slopes = float(value), slopes

    def __add__(self, other: Gradient) -> Gradient:
        return Gradient(self.value + other.value, self.slopes + other.slopes)

    def __sub__(self, other: Gradient) -> Gradient:
        return self + -1.0 * other

    def __mul__(self, other: Gradient) -> Gradient:
        return Gradient(self.value * other.value, self.value * other.slopes + other.value * self.slopes)

    def __rmul__(self, factor: float) -> Gradient:
        return Gradient(factor * self.value, factor * self.slopes)

    def __truediv__(self, other: Gradient) -> Gradient:
        ratio = self.value / other.value
        return Gradient(ratio, (self.slopes - ratio * other.slopes) / other.value)


def _root(square: Gradient) -> Gradient:
    root = math.sqrt(square.value)
    return Gradient(root, square.slopes / (2.0 * root) if root > 0.0 else 0.0 * square.slopes)


def _atan2(y: Gradient, x: Gradient) -> Gradient:
    square = x.value * x.value + y.value * y.value
    return Gradient(math.atan2(y.value, x.value), (x.value * y.slopes - y.value * x.slopes) / square)


def table_slopes(
    pool: Array, vehicle: Any, properties: Array, clock_s: float, mach: float, alpha_rad: float, beta_rad: float
) -> list[TableSlopes]:
    """Return the slopes of each table of a packed, burning stage, in the order of the packed tables.

    `properties` are the schedule's columns at `clock_s`. At zero angle of attack, where the plane of the total angle of
    attack is undefined, the slopes are the mean of those on both sides. A table for the engine off has zeros.
    """
    direction = np.array(
        [math.cos(alpha_rad) * math.cos(beta_rad), math.sin(beta_rad), math.sin(alpha_rad) * math.cos(beta_rad)]
    )
    return [
        _of_table(
            pool,
            vehicle.aero,
            j,
            int(vehicle.sizes.surfaces) - int(vehicle.sizes.tables) + j,
            reference_station_m(pool, vehicle.aero, properties, clock_s),
            mach,
            direction,
        )
        for j in range(int(vehicle.sizes.tables))
    ]


def reference_station_m(pool: Array, a: Any, properties: Array, clock_s: float) -> float:
    """Return the station of the moment reference."""
    x = properties[schedule.TOTAL_MASS] if a.reference_moves == aero.OVER_MASS else clock_s
    return float(table_in(pool, a.reference)(x)[0])


def _of_table(pool: Array, a: Any, j: int, s: int, reference_m: float, mach: float, direction: Array) -> TableSlopes:
    tables = a.tables
    made = _Table(grid_in(pool, tables.grid.at[j]), a, j, mach)
    factor = 0.0 if tables.power[j] == incidence.POWER_OFF else 1.0
    force, couple = _sloped(made, direction)
    made.mach_moves = 0.0
    still = _sloped(made, direction)
    by_rate = made.rates(direction)
    return TableSlopes(
        force=factor * np.array([f.value for f in force]),
        force_by_flow=factor * np.array([f.slopes for f in force]),
        couple_by_flow_m=factor * np.array([m.slopes for m in couple]),
        force_by_rate_m=factor * by_rate[0],
        couple_by_rate_m2=factor * by_rate[1],
        by_mach=(factor * _apart(force, still[0]), factor * _apart(couple, still[1])),
        reference_m=reference_m + float(a.centre_shift_m),
        station_m=float(a.station_m[s]),
    )


def _apart(moved: list[Gradient], still: list[Gradient]) -> Array:
    """Return the differences of slopes, (3, 3)."""
    return np.array([whole.slopes - part.slopes for whole, part in zip(moved, still, strict=True)])


def _sloped(table: _Table, direction: Array) -> tuple[list[Gradient], list[Gradient]]:
    """Return force and couple with their slopes; on the axis, the mean of both sides."""
    force, couple = table.static(direction)
    if math.hypot(direction[1], direction[2]) < _ALONG:
        for column in (1, 2):
            offset = _ALONG * np.eye(3)[column]
            sides = [table.static(direction + offset), table.static(direction - offset)]
            for k in range(3):
                force[k].slopes[column] = np.mean([side[0][k].slopes[column] for side in sides])
                couple[k].slopes[column] = np.mean([side[1][k].slopes[column] for side in sides])
    return force, couple


class _Table:
    mach_moves = 1.0  # 0: the Mach number stands still under the flow

    def __init__(self, grid, a: Any, j: int, mach: float) -> None:
        self.grid, self.mach, self.aero = grid, mach, a
        self.kinds = [int(kind) for kind in a.tables.axis[j]]
        self.roles = [int(role) for role in a.tables.role[j, : grid.nodes.shape[4]]]
        self.first_roll = float(a.tables.first_roll_rad[j])
        self.aeroballistic = a.tables.axes[j] == incidence.AEROBALLISTIC
        self.along_wind = a.tables.along_wind[j] == 1
        self.lengths = np.array([a.span_m, a.chord_m, a.yaw_chord_m], float)

    def _coefficients(self, flow: list[Gradient]) -> list[Gradient]:
        """Return the coefficients by role; coefficients that depend on other states are zero."""
        u, v, w = flow
        lateral = _root(v * v + w * w)
        roll = _atan2(v, w) if lateral.value > 0.0 else 0.0 * u
        roll.value -= 2.0 * math.pi * math.floor((roll.value - self.first_roll) / (2.0 * math.pi))
        variables = {
            incidence.NO_AXIS: 0.0 * u,
            incidence.MACH_AXIS: Gradient(self.mach, self.mach_moves * self.mach * _root(u * u + v * v + w * w).slopes),
            incidence.TOTAL: _atan2(lateral, u),
            incidence.ROLL: roll,
            incidence.ALPHA: _atan2(w, u),
            incidence.BETA: _atan2(v, _root(u * u + w * w)),
        }
        at = [variables[kind] for kind in self.kinds]
        point = [x.value for x in at]
        values = self.grid(point)
        slopes = sum(
            np.outer(self.grid(point, np.eye(3, dtype=int)[k]), x.slopes) for k, x in enumerate(at)
        )  # (columns, 3)
        out = [0.0 * u] * incidence.N_ROLES
        for c, role in enumerate(self.roles):
            out[role] = Gradient(values[c], np.asarray(slopes)[c])
        return out

    def static(self, direction: Array) -> tuple[list[Gradient], list[Gradient]]:
        """Return the force and moment per rho S / 2 at V = 1."""
        u, v, w = flow = [Gradient(x, row) for x, row in zip(direction, np.eye(3), strict=True)]
        c = self._coefficients(flow)
        normal, axial = float(self.aero.force_factor), float(self.aero.axial_factor)
        x, y, z = axial * c[incidence.CX], normal * c[incidence.CY], normal * c[incidence.CZ]
        span, chord, yaw_chord = self.lengths
        moments = [
            normal * span * c[incidence.CL],
            normal * chord * c[incidence.CM],
            normal * yaw_chord * c[incidence.CN],
        ]
        lateral = _root(v * v + w * w)
        if self.along_wind:
            across = lateral if self.aeroballistic else w
            speed = _root(u * u + across * across)
            cosine, sine = u / speed, across / speed
            x, z = cosine * x - sine * z, sine * x + cosine * z
        if self.aeroballistic:
            moments[2] = normal * chord * c[incidence.CN]
            if lateral.value > 0.0:
                to_y, to_z = v / lateral, w / lateral
                y, z = y * to_z + z * to_y, z * to_z - y * to_y
                moments[1:] = [moments[1] * to_z + moments[2] * to_y, moments[2] * to_z - moments[1] * to_y]
            else:
                y, z, moments[1:] = 0.0 * u, 0.0 * u, [0.0 * u, 0.0 * u]
        square = u * u + v * v + w * w
        return [square * force for force in (x, y, z)], [square * moment for moment in moments]

    def rates(self, direction: Array) -> tuple[Array, Array]:
        """Return the force and moment per body rate and rho S V / 2."""
        c = [g.value for g in self._coefficients([Gradient(x, np.zeros(3)) for x in direction])]
        r = incidence
        force = np.array([[0.0, 0.0, 0.0], [c[r.CYP], 0.0, c[r.CYR]], [0.0, -c[r.CNQ], 0.0]])
        moment = np.array([[c[r.CLP], 0.0, c[r.CLR]], [0.0, c[r.CMQ], 0.0], [c[r.CNP], 0.0, c[r.CNR]]])
        half = 0.5 * float(self.aero.damping_factor)
        return half * force * self.lengths, half * moment * self.lengths * self.lengths[:, None]
