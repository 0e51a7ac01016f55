"""Mode tables: from the long format (one row per time, mode and station) to arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.limits import MAX_MODES
from maxq.sim.scenario.errors import Path
from maxq.sim.scenario.mode_checks import refuse_impossible, twisting
from maxq.sim.scenario.nastran import ModeColumns
from maxq.sim.scenario.tables_csv import Columns, CsvTable

OVER_MASS = "total_mass_kg"
"""In place of time_s: the vehicle's total mass while the stage flies, falling."""

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


SPATIAL_SHAPES = ("phi_x", "phi_y", "phi_z", "theta_x_pm", "theta_y_pm", "theta_z_pm")
SPATIAL_COLUMNS = ModeColumns(
    "time_s",
    other_axes=(OVER_MASS,),
    falling=(OVER_MASS,),
    sets=(("mode", "frequency_hz", "generalized_mass_kg", "station_m", *SPATIAL_SHAPES, "mass_forward_kg"),),
    optional=("mass_kg", "roll_inertia_kgm2"),
    positive=("mode", "frequency_hz", "generalized_mass_kg"),
    not_negative=("mass_forward_kg", "mass_kg", "roll_inertia_kgm2"),
    begins_by=0.0,
    repeats=True,
)


@dataclass(frozen=True, eq=False)
class ModeTable:
    """Bending modes of one plane over time: T times, M modes, S stations (metres aft of the nose).

    `mass_forward_kg` is the mass forward of a station; it is the same for all modes. Compared by identity: what is
    derived from one can be kept for it.
    """

    time_s: NDArray[np.float64]  # (T,)
    station_m: NDArray[np.float64]  # (S,)
    frequency_hz: NDArray[np.float64]  # (T, M)
    generalized_mass_kg: NDArray[np.float64]  # (T, M)
    phi: NDArray[np.float64]  # (T, M, S)
    slope_pm: NDArray[np.float64]  # (T, M, S), d(phi)/d(x_n)
    mass_forward_kg: NDArray[np.float64]  # (T, S)

    @property
    def modes(self) -> int:
        return int(self.frequency_hz.shape[1])

    # as mode_checks.py sees it

    @property
    def moved(self) -> NDArray[np.float64]:
        return self.phi

    @property
    def displaced(self) -> NDArray[np.float64]:
        return self.phi

    @property
    def bent(self) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]:
        return ((self.phi, self.slope_pm),)

    @property
    def products(self) -> None:
        return None


@dataclass(frozen=True, eq=False)
class SpatialModeTable:
    """Spatial modes over time, as `ModeTable`: displacements and rotations (T, M, S, 3) along and about x, y, z of B.

    `mass_kg` and `roll_inertia_kgm2` (T, S) are lumped at the stations; None where the file does not give them.
    """

    time_s: NDArray[np.float64]
    station_m: NDArray[np.float64]
    frequency_hz: NDArray[np.float64]
    generalized_mass_kg: NDArray[np.float64]
    displacement: NDArray[np.float64]
    rotation_pm: NDArray[np.float64]
    mass_forward_kg: NDArray[np.float64]
    mass_kg: NDArray[np.float64] | None
    roll_inertia_kgm2: NDArray[np.float64] | None

    @property
    def modes(self) -> int:
        return int(self.frequency_hz.shape[1])

    # as mode_checks.py sees it

    @property
    def moved(self) -> NDArray[np.float64]:
        span = self.station_m[-1] - self.station_m[0]
        return np.concatenate([self.displaced, span * self.rotation_pm[..., 0]], axis=2)

    @property
    def displaced(self) -> NDArray[np.float64]:
        return np.concatenate([*np.moveaxis(self.displacement, -1, 0)], axis=2)

    @property
    def bent(self) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]:
        return tuple((plane.phi, plane.slope_pm) for plane in self.lateral())

    @property
    def products(self) -> NDArray[np.float64] | None:
        if self.mass_kg is None:
            return None
        products = np.einsum("ts,tmsk,tnsk->tmn", self.mass_kg, self.displacement, self.displacement)
        if self.roll_inertia_kgm2 is not None:
            twist = self.rotation_pm[..., 0]
            return np.asarray(products + np.einsum("ts,tms,tns->tmn", self.roll_inertia_kgm2, twist, twist))
        unknown = twisting(self)  # without their inertia nothing can be said of modes that twist
        own = np.einsum("tm,mn->tmn", self.generalized_mass_kg, np.eye(self.modes))
        return np.asarray(np.where(unknown[:, :, None] | unknown[:, None, :], own, products))

    def lateral(self) -> tuple[ModeTable, ModeTable]:
        """What the modes do along y and along z, as those of a yaw and of a pitch plane."""
        phi, theta = self.displacement, self.rotation_pm
        given = self.time_s, self.station_m, self.frequency_hz, self.generalized_mass_kg
        return (
            ModeTable(*given, phi[..., 1], -theta[..., 2], self.mass_forward_kg),
            ModeTable(*given, phi[..., 2], theta[..., 1], self.mass_forward_kg),
        )


def mode_table(table: CsvTable, at: Path = ()) -> ModeTable:
    """The arrays of a mode table whose columns have been checked; `at` is its key.

    Raises the schema's refusal unless modes are numbered 1, 2, ... (12 at most), each time has each mode at
    each station exactly once, frequency and generalised mass do not change along the stations, and the shapes are
    possible (mode_checks.py).
    """
    made = table.derived
    if not isinstance(made, ModeTable):
        times, stations, full = _arrays(table, ("phi", "slope_pm"), ("mass_forward_kg",), at)
        made = ModeTable(times, stations, *full)
        refuse_impossible(table, made, at)
        table.keep(made)
    return made


def spatial_mode_table(table: CsvTable, at: Path = ()) -> SpatialModeTable:
    """As `mode_table`, of a table of spatial modes."""
    made = table.derived
    if not isinstance(made, SpatialModeTable):
        lumped = tuple(name for name in ("mass_kg", "roll_inertia_kgm2") if name in table)
        times, stations, full = _arrays(table, SPATIAL_SHAPES, ("mass_forward_kg", *lumped), at)
        frequency, mass, *rest = full
        shapes, forward, given = np.stack(rest[:6], axis=-1), rest[6], dict(zip(lumped, rest[7:], strict=True))
        made = SpatialModeTable(
            times, stations, frequency, mass, shapes[..., :3], shapes[..., 3:], forward,
            given.get("mass_kg"), given.get("roll_inertia_kgm2"),
        )  # fmt: skip  # nine lines otherwise
        refuse_impossible(table, made, at)
        table.keep(made)
    return made


_SLACK = 1e-3
"""By which a mass may lie beyond those of the stage, relative."""


def over_time(table: CsvTable, times_s: NDArray[np.float64], mass_kg: NDArray[np.float64], at: Path) -> CsvTable:
    """A table of modes over mass as one over time: its rows at the instants at which the stage has these masses.

    `times_s`, `mass_kg` (n,): the stage's mass, finely; a mass that it keeps for long counts at the end of that time if
    it is the largest, else at its start. Raises the schema's refusal for masses that the stage never has.
    """
    given, most, least = table[OVER_MASS], float(mass_kg.max()), float(mass_kg.min())
    outside = (given > most * (1.0 + _SLACK)) | (given < least * (1.0 - _SLACK))
    table.refuse_where(outside, OVER_MASS, "the stage never has this mass", f"{least:g} .. {most:g}", at=at)
    mass_kg = np.minimum.accumulate(mass_kg)
    falls = np.diff(mass_kg, prepend=np.inf) < 0.0  # the first instants of the masses
    falls[0] = False
    falls[int(np.flatnonzero(mass_kg >= most)[-1])] = True
    when = np.interp(-np.clip(given, least, most), -mass_kg[falls], times_s[falls])
    if (given == given[0]).all():
        when = np.zeros(len(given))  # one state, at all times
    when.flags.writeable = False
    others = {name: column for name, column in table.columns.items() if name != OVER_MASS}
    return CsvTable(table.file, {"time_s": when, **others}, table.shown, table.lines)


def _arrays(
    table: CsvTable, shapes: tuple[str, ...], of_stations: tuple[str, ...], at: Path
) -> tuple[NDArray[np.float64], NDArray[np.float64], list[NDArray[np.float64]]]:
    """Times, stations, and arrays: frequency and generalised mass (T, M), shapes (T, M, S), `of_stations` (T, S)."""
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
