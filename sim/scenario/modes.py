"""Mode tables: from the long format (one row per time, mode and station) to arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.limits import MAX_MODES
from maxq.sim.scenario.errors import Path
from maxq.sim.scenario.tables_csv import Columns, CsvTable

MODE_COLUMNS = Columns(
    "time_s",
    sets=(("mode", "frequency_hz", "generalized_mass_kg", "station_m", "phi", "slope_pm", "mass_forward_kg"),),
    positive=("mode", "frequency_hz", "generalized_mass_kg"),
    not_negative=("mass_forward_kg",),
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


def mode_table(table: CsvTable, at: Path = ()) -> ModeTable:
    """The arrays of a mode table whose columns have been checked; `at` is its key.

    Raises the schema's refusal unless modes are numbered 1, 2, ... (8 at most), each time has each mode at
    each station exactly once, and frequency and generalised mass do not change along the stations.
    """
    made = table.derived
    if not isinstance(made, ModeTable):
        made = _mode_table(table, at)
        table.keep(made)
    return made


def _mode_table(table: CsvTable, at: Path) -> ModeTable:
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
    for name in ("frequency_hz", "generalized_mass_kg", "phi", "slope_pm", "mass_forward_kg"):
        full[name] = np.empty(shape)
        full[name][time_at, mode_at, station_at] = table[name]
    for name in ("frequency_hz", "generalized_mass_kg"):
        differs = table[name] != full[name][time_at, mode_at, 0]
        table.refuse_where(differs, name, "changes along the stations of one mode", "one value for each mode", at=at)
    name = "mass_forward_kg"
    differs = table[name] != full[name][time_at, 0, station_at]
    table.refuse_where(differs, name, "differs between modes", "one value for each station", at=at)
    return ModeTable(
        times,
        stations,
        full["frequency_hz"][:, :, 0],
        full["generalized_mass_kg"][:, :, 0],
        full["phi"],
        full["slope_pm"],
        full[name][:, 0, :],
    )
