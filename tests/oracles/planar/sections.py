"""Compute the bending moment at cuts of the body axis, of the vehicle as a linear system (plant.py).

As in docs/model.md, section 13, it is the moment of all forces forward of the cut, including inertial ones, about +y
(pitch; in yaw about -z, the plane's mirror image). A force f_z at a station x <= s adds -(s - x) f_z; a force f_x at a
point that bending displaces by w from the cut adds w f_x. Linear about a straight body in axial flight, with the forces
of plant.py:

    M = int m (s - x) (a_z - (x_cg - x) q' + phi~ eta'') dx + couple
        - a int m (phi - phi_s) dx eta + D phi_s eta           the axial load, and the drag on the body axis
        - sum (s - x_k) F_k - int (s - x) f dx                 lifting parts; the rest of the air, linear in x
        - sum m_p a [(s - x_h) G + (phi_h - phi_s) eta] - sum (s - x_b) R     rods; dampers at the bobs

The masses are the line mass of the simulator's packed section loads. Its equations are written again here:
tests/test_oracle_wind_bending.py compares the two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.sim.vehicle.loads import columns as packed_loads


@dataclass(frozen=True)
class Cuts:
    """The stations of the cuts, (cuts,), and the contributions forward of each, for the modes of one plane."""

    station_m: Array
    whole: Array  # (3,): mass, first and second moment of the line mass about the nose, kg m^n
    forward: Array  # (cuts, 3): of what is forward
    modal_arm_kgm: Array  # (cuts, modes): int m (s - x) phi~, the shape free of rigid motion
    aside_kg: Array  # (cuts, modes): int m (phi - phi_s) of what hangs forward
    phi: Array  # (cuts, modes)
    ends_m: tuple[float, float]  # of the body that the rest of the air is spread over
    bottom_m: Array  # (tanks,): where a tank's liquid hangs
    axial: tuple[tuple[float, float], ...]  # station and share of the axial aerodynamic force


def cuts_of(pool: Array, row: Any, clock_s: float, pitch: bool) -> Cuts | None:
    """Return the cuts of a packed stage at an instant of its clock; None without loads or with spatial modes."""
    loads, sizes = row.loads, row.vehicle.sizes
    count = int(loads.stations)
    if count == 0 or int(sizes.spatial_modes) > 0:
        return None
    columns = table_in(pool, loads.table)(clock_s)
    width = int(packed_loads.station_width(sizes, loads.alike))
    at = columns[packed_loads.STATIONS : packed_loads.STATIONS + count * width].reshape(count, width)
    padded, n = max(int(sizes.pitch_modes), int(sizes.yaw_modes)), int(sizes.pitch_modes if pitch else sizes.yaw_modes)
    first = packed_loads.STATION_MODES + (0 if pitch or loads.alike else packed_loads.MODE_ROWS * padded)
    rows = at[:, first : first + packed_loads.MODE_ROWS * padded].reshape(count, packed_loads.MODE_ROWS, padded)
    points = int(loads.axial_points)
    return Cuts(
        station_m=np.array(loads.station_m[:count]),
        whole=columns[: packed_loads.STATIONS].copy(),
        forward=at[:, [packed_loads.MASS, packed_loads.FIRST, packed_loads.SECOND]],
        modal_arm_kgm=rows[:, packed_loads.INERTIA_MOMENT, :n],
        aside_kg=rows[:, packed_loads.AXIAL_MOMENT, :n],
        phi=rows[:, packed_loads.DISPLACEMENT, :n],
        ends_m=(float(loads.nose_m), float(loads.tail_m)),
        bottom_m=np.array(loads.bottom_m[: int(sizes.pendulums)]),
        axial=tuple(zip(loads.axial_m[:points].tolist(), loads.axial_share[:points].tolist(), strict=True)),
    )


def bending_moments(e: Any, cuts: Cuts, lateral: Array, turning: Array, bending: Array) -> list[Array]:
    """Return the bending moments (N m), one row per cut, from the accelerations of body and modes."""
    total, first, second = cuts.whole
    scale, cg = e.mass / total, e.cg
    # the flow's Coriolis force acts where the propellant flows: spread as the mass is
    lateral = lateral - e.outflow[0] / e.mass
    lever, spin = scale * (total * cg - first), scale * (total * cg * cg - 2.0 * cg * first + second)
    # what of the rate of angular momentum the line mass does not hold, per kilogram of it
    couple = (e.outflow[1] - e.inertia * turning - lever * lateral + spin * turning) / total
    air = e.vehicle.aerodynamics
    drag = e.condition.dynamic_pressure_Pa * air.area_m2 * air.axial
    parts, spread = _air(e, cuts)
    out = []
    for n, station in enumerate(cuts.station_m):
        mass, moment, square = cuts.forward[n]
        arm, spun = station * mass - moment, station * cg * mass - (station + cg) * moment + square
        row = scale * (arm * lateral - spun * turning) + couple * mass
        row = row + scale * (cuts.modal_arm_kgm[n] @ bending - e.specific_force * (cuts.aside_kg[n] @ e.eta))
        here = cuts.phi[n] @ e.eta
        row = row + sum(share for at, share in cuts.axial if at <= station) * drag * here
        for k in range(e.tanks):
            row = row + _of_tank(e, k, station, cuts.bottom_m[k], here)
        for at, force, about_nose in parts:
            if at <= station:
                row = row - station * force + about_nose
        constant, slope = spread
        x = np.clip(station - cuts.ends_m[0], 0.0, cuts.ends_m[1] - cuts.ends_m[0])
        beyond = station - cuts.ends_m[0] - x
        row = row - (0.5 * constant + slope * x / 6.0) * x * x - beyond * (constant + 0.5 * slope * x) * x
        out.append(row)
    return out


def _of_tank(e: Any, k: int, station: float, bottom_m: float, here: Array) -> Array:
    """Return the moments of the rod's axial pull at the tank bottom, and of the damper."""
    bobs, phi = e.vehicle.pendulums, e.vehicle.modes.phi_hinge[:, k]
    hinge, bob, row = e.hinge_station_m[k], e.hinge_station_m[k] + bobs.length_m[k], 0.0 * here
    if hinge <= station:
        row = row - (station - hinge) * e.rod[k]
    if max(hinge, bottom_m) <= station:
        row = row - bobs.mass_kg[k] * e.specific_force * (phi @ e.eta - here)
    if bob <= station:
        row = row - (station - bob) * e.damper[k]
    return row


Lift = tuple[float, Array, Array]
"""Station of a lifting part, its force and that times its station, as rows."""


def _air(e: Any, cuts: Cuts) -> tuple[list[Lift], tuple[Array, Array]]:
    """Return the lifting parts, and the force per metre of the remaining air: constant and slope, from the nose."""
    air, (nose, tail) = e.vehicle.aerodynamics, cuts.ends_m
    flow = 0.5 * e.condition.density_kgpm3 * e.condition.airspeed_mps * air.area_m2
    force, first = e.air_force, e.cg * e.air_force + e.air_moment
    parts: list[Lift] = []
    for k, slope in enumerate(air.slope_pr):
        place, _ = air.met_by_modes(k)
        if place < 0:
            continue
        met, at = e.met_by(k, e)[1], air.couple_station_m[k]
        push = -flow * slope * met
        if np.isfinite(at):  # a table's: its moment about that is part of the rest
            by_rate = air.rate_slope_m[k] if k < len(air.rate_slope_m) else 0.0
            push = push - flow * by_rate * e.q
            at = min(max(at, nose), tail)
            about = at * push
        else:
            centre = air.moment_slope_mpr[place] / air.slope_pr[place] if air.slope_pr[place] != 0.0 else np.inf
            at = min(max(centre, nose), tail)
            about = -flow * air.moment_slope_mpr[k] * met if at == centre else at * push
        parts.append((at, push, about))
        force, first = force - push, first - about
    length, first = tail - nose, first - nose * force
    gradient = (12.0 * first / length - 6.0 * force) / length**2
    return parts, (force / length - 0.5 * gradient * length, gradient)
