"""The schema of the buffet of a stage in the vehicle file."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from maxq.control.kernel.limits import MAX_BUFFETS
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import NotNegative, Section, optional

FORCE, AREA = "force_psd_N2pHz", "area_psd_m4pHz"
BUFFET_COLUMNS = Columns(
    "mach",
    sets=((FORCE, "frequency_hz", "station_m"), (AREA, "frequency_hz", "station_m")),
    positive=("frequency_hz",),
    not_negative=("mach", FORCE, AREA),
    repeats=True,
)
_MOST_MACH = 16


class BuffetSection(Section):
    """The buffet: random lateral forces of the separated flow at stations, equal in both planes."""

    table: Annotated[CsvTable, BUFFET_COLUMNS] = Field(
        description="one-sided spectrum of the force along y and along z, a row for each Mach number, frequency and "
        "station: of the force, N2/Hz, or of force over dynamic pressure, m4/Hz; linear between frequencies, zero "
        "outside them; its root is linear between Mach numbers, and end values hold outside them"
    )
    factor: NotNegative = optional("factor on the force", 1.0)

    @property
    def stations_m(self) -> tuple[float, ...]:
        return tuple(np.unique(self.table["station_m"]).tolist())

    @property
    def mach(self) -> NDArray[np.float64]:
        return np.unique(self.table["mach"])

    @property
    def frequency_hz(self) -> NDArray[np.float64]:
        return np.unique(self.table["frequency_hz"])

    @property
    def per_pressure(self) -> bool:
        """Return True if the spectrum is that of force over dynamic pressure."""
        return AREA in self.table

    @property
    def density(self) -> NDArray[np.float64]:
        """Return the spectra (Mach numbers, stations, frequencies)."""
        axes = (self.mach, np.array(self.stations_m), self.frequency_hz)
        places = tuple(
            np.searchsorted(axis, self.table[name])
            for axis, name in zip(axes, ("mach", "station_m", "frequency_hz"), strict=True)
        )
        out = np.full([len(axis) for axis in axes], np.nan)
        out[places] = self.table[AREA if self.per_pressure else FORCE]
        return out

    def _check(self) -> None:
        table, at = self.table, ("table",)
        for count, name, least, most in (
            (len(self.stations_m), "station_m", 1, MAX_BUFFETS),
            (len(self.mach), "mach", 1, _MOST_MACH),
            (len(self.frequency_hz), "frequency_hz", 2, 200),
        ):
            if not least <= count <= most:
                raise table.refusal(f"has {count} values of {name}", f"{least} to {most}", at=at)
        density = self.density
        if np.isnan(density).any() or density.size != len(table):
            raise table.refusal(
                f"has {len(table)} rows for {density.size} combinations of mach, frequency_hz and station_m",
                "each combination once",
                at=at,
            )
