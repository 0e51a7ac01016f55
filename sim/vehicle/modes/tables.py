"""Mode tables: conversion from the long format to arrays, and checks of the shapes.

The long format has one row per time, mode and station. Impossible mode shapes are rejected, and unlikely shapes cause a
warning. The limits are derived from a good table (44 stations, 3 modes, 25 times, from a finite-element beam). In this
table, slopes deviate from the derivatives of the shapes by at most 0.8 %. Successive times agree to a modal assurance
criterion of 0.997 and in frequency to 2 %. The mass forward gives 0.77 to 0.88 of the generalised masses, because it
does not include the engine's inertia.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.limits import MAX_MODES
from maxq.sim.input.errors import Path
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.vehicle.modes.nastran import NASTRAN

Floats = NDArray[np.float64]

SLOPE_DEVIATION, ASSURANCE, FREQUENCY_STEP, MASS_RATIO, ORTHOGONALITY = 0.2, 0.8, 0.3, 3.0, 0.1
"""The limits beyond which a table causes a warning; see `mode_warnings`."""

OVER_MASS = "total_mass_kg"
"""The column that may replace time_s: the total mass of the vehicle while the stage flies, decreasing."""

MODE_COLUMNS = Columns(
    "time_s",
    other_axes=(OVER_MASS,),
    falling=(OVER_MASS,),
    sets=(("mode", "frequency_hz", "generalized_mass_kg", "station_m", "phi", "slope_pm", "mass_forward_kg"),),
    positive=("mode", "frequency_hz", "generalized_mass_kg"),
    not_negative=("mass_forward_kg",),
    begins_by=0.0,
    repeats=True,
)


class PointMass(NamedTuple):
    """A mass behind the gimbal of an engine.

    - `attachments_m`: stations of the core that carry the booster of this engine, none for engines of the core.
    - `arm_m`: from the body axis at the station of the gimbal to the CG of the engine at rest, B.
    - `inertia_kgm2`: about that CG, taken as isotropic.
    """

    station_m: float
    attachments_m: tuple[float, ...]
    mass_kg: float
    inertia_kgm2: float
    arm_m: tuple[float, float, float]


SPATIAL_SHAPES = ("phi_x", "phi_y", "phi_z", "theta_x_pm", "theta_y_pm", "theta_z_pm")

SPATIAL_COLUMNS = replace(
    MODE_COLUMNS,
    sets=(("mode", "frequency_hz", "generalized_mass_kg", "station_m", *SPATIAL_SHAPES, "mass_forward_kg"),),
    optional=("mass_kg", "roll_inertia_kgm2"),
    not_negative=("mass_forward_kg", "mass_kg", "roll_inertia_kgm2"),
    foreign=NASTRAN,
)


@dataclass(frozen=True, eq=False)
class _Modes:
    """The common arrays of mode tables with T times, M modes and S stations (metres aft of the nose).

    Instances are compared by identity, so that derived results can be cached.
    """

    time_s: Floats  # (T,)
    station_m: Floats  # (S,)
    frequency_hz: Floats  # (T, M)
    generalized_mass_kg: Floats  # (T, M)

    @property
    def modes(self) -> int:
        return int(self.frequency_hz.shape[1])


@dataclass(frozen=True, eq=False)
class ModeTable(_Modes):
    """The bending modes of one plane over time.

    `mass_forward_kg`: mass forward of a station, the same for all modes.
    """

    phi: Floats  # (T, M, S)
    slope_pm: Floats  # (T, M, S), d(phi)/d(x_n)
    mass_forward_kg: Floats  # (T, S)
    mass_kg: ClassVar[None] = None  # no masses are given at the stations

    @property
    def moved(self) -> Floats:
        return self.phi

    displaced = moved

    @property
    def bent(self) -> tuple[tuple[Floats, Floats], ...]:
        return ((self.phi, self.slope_pm),)


@dataclass(frozen=True, eq=False)
class SpatialModeTable(_Modes):
    """The spatial modes over time: displacements and rotations (T, M, S, 3) along and about x, y, z of B.

    `mass_kg` and `roll_inertia_kgm2` (T, S) are lumped at the stations, or None if the file does not contain them.
    """

    displacement: Floats
    rotation_pm: Floats
    mass_forward_kg: Floats
    mass_kg: Floats | None
    roll_inertia_kgm2: Floats | None

    @property
    def moved(self) -> Floats:
        """Return the displacements of each mode, followed by those due to rotations about the axis, (T, M, 4 S)."""
        span = self.station_m[-1] - self.station_m[0]
        return np.concatenate([self.displaced, span * self.rotation_pm[..., 0]], axis=2)

    @property
    def displaced(self) -> Floats:
        """Return the displacements of each mode without those due to rotations, (T, M, 3 S)."""
        return np.concatenate([*np.moveaxis(self.displacement, -1, 0)], axis=2)

    @property
    def bent(self) -> tuple[tuple[Floats, Floats], ...]:
        """Return the lateral displacement (T, M, S) of each plane, and its nominal derivative over the stations."""
        return tuple((plane.phi, plane.slope_pm) for plane in self.lateral())

    def lateral(self) -> tuple[ModeTable, ModeTable]:
        """Return the motion of the modes along y and along z, as that of a yaw plane and of a pitch plane."""
        phi, theta = self.displacement, self.rotation_pm
        given = self.time_s, self.station_m, self.frequency_hz, self.generalized_mass_kg
        return (
            ModeTable(*given, phi[..., 1], -theta[..., 2], self.mass_forward_kg),
            ModeTable(*given, phi[..., 2], theta[..., 1], self.mass_forward_kg),
        )


def mode_table(table: CsvTable, at: Path = ()) -> ModeTable:
    """Return the arrays of a mode table whose columns have been checked; `at` is the path of its key.

    Raises the refusal of the schema unless modes are numbered 1, 2, ... (at most 12), and each time has each mode at
    each station exactly once. Also raises it if frequency or generalised mass changes along the stations, or if the
    shapes are impossible.
    """
    made = table.derived
    if not isinstance(made, ModeTable):
        times, stations, full = _arrays(table, ("phi", "slope_pm"), ("mass_forward_kg",), at)
        made = ModeTable(times, stations, *full)
        refuse_impossible(table, made, at)
        table.keep(made)
    return made


def spatial_mode_table(table: CsvTable, at: Path = ()) -> SpatialModeTable:
    """Return the arrays of a table of spatial modes, as `mode_table` does."""
    made = table.derived
    if not isinstance(made, SpatialModeTable):
        lumped = tuple(name for name in ("mass_kg", "roll_inertia_kgm2") if name in table)
        times, stations, full = _arrays(table, SPATIAL_SHAPES, ("mass_forward_kg", *lumped), at)
        frequency, mass, *rest = full
        shapes, forward, given = np.stack(rest[:6], axis=-1), rest[6], dict(zip(lumped, rest[7:], strict=True))
        made = SpatialModeTable(
            times,
            stations,
            frequency,
            mass,
            shapes[..., :3],
            shapes[..., 3:],
            forward,
            given.get("mass_kg"),
            given.get("roll_inertia_kgm2"),
        )
        refuse_impossible(table, made, at)
        table.keep(made)
    return made


_SLACK = 1e-3
"""The relative tolerance of a mass outside the range of the stage's masses."""


def over_time(table: CsvTable, times_s: Floats, mass_kg: Floats, at: Path) -> CsvTable:
    """Return a table of modes over mass as a table over time.

    Its rows are at the instants at which the stage has these masses. `times_s`, `mass_kg` (n,): mass of the stage on a
    fine grid. If the mass is constant for some time, the instant is the end of that time for the largest mass, and its
    start for any other mass. Raises the refusal of the schema for masses that the stage never has.
    """
    given, most, least = table[OVER_MASS], float(mass_kg.max()), float(mass_kg.min())
    outside = (given > most * (1.0 + _SLACK)) | (given < least * (1.0 - _SLACK))
    table.refuse_where(outside, OVER_MASS, "the stage never has this mass", f"{least:g} .. {most:g}", at=at)
    mass_kg = np.minimum.accumulate(mass_kg)
    falls = np.diff(mass_kg, prepend=np.inf) < 0.0  # the first instant of each mass
    falls[0] = False
    falls[int(np.flatnonzero(mass_kg >= most)[-1])] = True
    when = np.interp(-np.clip(given, least, most), -mass_kg[falls], times_s[falls])
    if (given == given[0]).all():
        when = np.zeros(len(given))  # one state, at all times
    others = {name: column for name, column in table.columns.items() if name != OVER_MASS}
    return CsvTable(table.file, {"time_s": when, **others}, table.shown, table.lines)


def _arrays(
    table: CsvTable, shapes: tuple[str, ...], of_stations: tuple[str, ...], at: Path
) -> tuple[Floats, Floats, list[Floats]]:
    """Return times, stations and arrays of a table.

    The arrays are frequency and generalised mass (T, M), shapes (T, M, S), and `of_stations` (T, S).
    """
    mode = table["mode"]
    numbers = f"mode numbers 1 .. {MAX_MODES}"
    table.refuse_where(mode != np.floor(mode), "mode", "is not a whole number", numbers, at=at)
    table.refuse_where(mode > MAX_MODES, "mode", "too many modes", numbers, at=at)
    times, time_at = np.unique(table["time_s"], return_inverse=True)
    stations, station_at = np.unique(table["station_m"], return_inverse=True)
    count = int(mode.max())
    mode_at = mode.astype(np.int64) - 1
    shape = (len(times), count, len(stations))
    hits = np.zeros(shape, dtype=np.int64)
    np.add.at(hits, (time_at, mode_at, station_at), 1)
    twice = hits[time_at, mode_at, station_at] > 1
    table.refuse_where(twice, "station_m", "this time, mode and station appears twice", "one row for each", at=at)
    if (hits == 0).any():
        t, m, s = (int(i) for i in np.argwhere(hits == 0)[0])
        raise table.refusal(
            f"at time_s = {times[t]:g} mode {m + 1} has no row for station_m = {stations[s]:g}",
            "the same stations for all modes, and all modes at all times",
            at=at,
        )
    full = {}
    of_modes = ("frequency_hz", "generalized_mass_kg")
    for name in (*of_modes, *shapes, *of_stations):
        full[name] = np.empty(shape)
        full[name][time_at, mode_at, station_at] = table[name]
    for name in of_modes:
        differs = table[name] != full[name][time_at, mode_at, 0]
        table.refuse_where(differs, name, "changes along the stations of one mode", "one value for each mode", at=at)
    for name in of_stations:
        differs = table[name] != full[name][time_at, 0, station_at]
        table.refuse_where(differs, name, "differs between modes", "one value for each station", at=at)
    made = [full[name][:, :, 0] for name in of_modes] + [full[name] for name in shapes]
    return times, stations, made + [full[name][:, 0, :] for name in of_stations]


def refuse_impossible(table: CsvTable, modes: ModeTable | SpatialModeTable, at: Path) -> None:
    """Raise the refusal of the schema for impossible shapes.

    These are:

    - slopes with the opposite sign of the shapes' derivatives;
    - shapes that change number or sign between times;
    - shapes that are far from orthonormal with the masses at the stations.
    """
    slope, _ = _slopes(modes)
    if (slope < 0.0).any():
        t, m = (int(i) for i in np.argwhere(slope < 0.0)[0])
        raise table.refusal(
            f"slope of mode {m + 1} at time_s = {modes.time_s[t]:g} has the opposite sign of the shape's derivative "
            f"(correlation {slope[t, m]:.2f})",
            "d(phi)/d(station_m), station_m aft of the nose: slope_pm, theta_y_pm = d(phi_z), theta_z_pm = -d(phi_y)",
            at=at,
        )
    alike = _alike(modes)
    for t, matrix in enumerate(alike):
        span = f"between time_s = {modes.time_s[t]:g} and {modes.time_s[t + 1]:g}"
        for m, row in enumerate(np.abs(matrix)):
            other = int(np.argmax(row))
            if other != m and row[other] ** 2 > ASSURANCE:
                raise table.refusal(
                    f"mode {m + 1} becomes mode {other + 1} {span}", "one number for a shape at all times", at=at
                )
            if matrix[m, m] ** 2 > ASSURANCE and matrix[m, m] < 0.0:
                raise table.refusal(f"mode {m + 1} changes its sign {span}", "shapes that change continuously", at=at)


def mode_warnings(modes: ModeTable | SpatialModeTable) -> list[str]:
    """Return a sentence for each unlikely value of a table."""
    out = []
    slope, deviation = _slopes(modes)
    if (deviation > SLOPE_DEVIATION).any():
        t, m = _largest(deviation)
        out.append(
            f"slope of mode {m + 1} at {modes.time_s[t]:g} s deviates by {100 * deviation[t, m]:.0f} % from the "
            f"shape's derivative (correlation {slope[t, m]:.3f})"
        )
    if (np.diff(modes.frequency_hz, axis=1) < 0.0).any():
        t, m = (int(i) for i in np.argwhere(np.diff(modes.frequency_hz, axis=1) < 0.0)[0])
        out.append(f"frequencies of modes {m + 1} and {m + 2} at {modes.time_s[t]:g} s are not in rising order")
    jump = np.abs(np.diff(np.log(modes.frequency_hz), axis=0))
    if (jump > np.log(1.0 + FREQUENCY_STEP)).any():
        t, m = _largest(jump)
        out.append(
            f"frequency of mode {m + 1} changes from {modes.frequency_hz[t, m]:.3g} to "
            f"{modes.frequency_hz[t + 1, m]:.3g} Hz between {modes.time_s[t]:g} and {modes.time_s[t + 1]:g} s"
        )
    for t, matrix in enumerate(_alike(modes)):
        own = np.diag(matrix) ** 2
        if (own < ASSURANCE).any():
            m = int(np.argmin(own))
            out.append(
                f"shape of mode {m + 1} changes much between {modes.time_s[t]:g} and {modes.time_s[t + 1]:g} s "
                f"(modal assurance criterion {own[m]:.2f})"
            )
            break
    return out + _mass_warnings(modes)


def _mass_warnings(modes: ModeTable | SpatialModeTable) -> list[str]:
    if not modes.mass_forward_kg.any():
        return [
            "mass_forward_kg is 0 everywhere: the axial load does not soften these modes"
            + ("" if modes.mass_kg is not None else ", and their generalised masses and orthogonality are unchecked")
        ]
    given = modes.generalized_mass_kg
    if modes.mass_kg is not None:
        return []  # see masses.py
    between = np.maximum(np.diff(modes.mass_forward_kg, axis=1), 0.0)
    if not between.any():
        return []
    square = modes.displaced.reshape(*given.shape, -1, len(modes.station_m)) ** 2
    middle = 0.5 * (square[..., 1:] + square[..., :-1]).sum(axis=2)
    ratio = (middle * between[:, None, :]).sum(axis=-1) / given
    # the inertia about x of a twisting mode is unknown
    ratio = np.where(twisting(modes), np.maximum(ratio, 1.0), ratio)
    if ratio.max() > MASS_RATIO or ratio.min() < 1.0 / MASS_RATIO:
        t, m = _largest(np.abs(np.log(np.maximum(ratio, 1e-300))))
        return [
            f"generalised mass of mode {m + 1} at {modes.time_s[t]:g} s is {given[t, m]:.3g} kg, where shape and "
            f"mass_forward_kg give {given[t, m] * ratio[t, m]:.3g} kg"
        ]
    return []


def twisting(modes: ModeTable | SpatialModeTable) -> NDArray[np.bool_]:
    """Return True for modes that twist more than they displace, (T, M)."""
    return np.asarray(2.0 * (modes.displaced**2).sum(axis=2) < (modes.moved**2).sum(axis=2))


def _largest(values: Floats) -> tuple[int, int]:
    """Return the indices (time, mode) of the largest value."""
    t, m = np.unravel_index(int(np.argmax(values)), values.shape)
    return int(t), int(m)


_SHARE = 1e-4
"""The least share of a plane in the bending of a mode, squared; a plane with less is ignored."""


def _slopes(modes: ModeTable | SpatialModeTable) -> tuple[Floats, Floats]:
    """Return the correlation of slopes and differences of shapes, and their relative deviation, (T, M) each.

    They are 1 and 0 for a mode that does not bend. The correlation is the smaller of the two planes' correlations,
    because in a coupled mode the plane with the larger motion would hide a wrong sign in the other.
    """
    h = np.diff(modes.station_m)
    d, s = np.stack([(np.diff(p, axis=2) / h, 0.5 * (q[..., 1:] + q[..., :-1])) for p, q in modes.bent], axis=1)
    both, shape, slope, apart = ((h * x).sum(axis=-1) for x in (d * s, d * d, s * s, (d - s) ** 2))  # (planes, T, M)
    # the contribution of a displacement of one millionth of the largest
    least = (1e-6 * np.abs(modes.moved).max(axis=2)) ** 2 / max(float(h.sum()), 1e-300)
    bends = (shape > np.maximum(least, _SHARE * shape.sum(axis=0))) & (slope > 0.0)
    correlation = np.where(bends, both / np.sqrt(np.where(bends, shape * slope, 1.0)), 1.0)
    whole = np.where(bends.any(axis=0), shape.sum(axis=0), 1.0)
    return correlation.min(axis=0), np.where(bends.any(axis=0), np.sqrt(apart.sum(axis=0) / whole), 0.0)


def _alike(modes: ModeTable | SpatialModeTable) -> Floats:
    """Return the cosine between the shapes of successive times, (T - 1, M, M).

    Its square is the modal assurance criterion.
    """
    moved = modes.moved
    unit = moved / np.maximum(np.sqrt((moved**2).sum(axis=2, keepdims=True)), 1e-300)
    return np.asarray((unit[:-1, :, None, :] * unit[1:, None, :, :]).sum(axis=-1))
