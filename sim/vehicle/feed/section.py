"""The schema of a stage's feed lines in the vehicle file."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from maxq.control.kernel.limits import MAX_ENGINES
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import NotNegative, Positive, Section, optional

REQUIRED = (
    "head_kgpm2",
    "inertance_Pas2pkg",
    "compliance_kgpPa",
    "pump_gain",
    "discharge_inertance_Pas2pkg",
    "discharge_resistance_Paspkg",
    "chamber_gain_Paspkg",
)
OPTIONAL = ("resistance_Paspkg", "accumulator_kgpPa", "mass_flow_gain_s")
FEED_COLUMNS = Columns(
    "time_s",
    sets=(REQUIRED,),
    optional=OPTIONAL,
    positive=("inertance_Pas2pkg", "compliance_kgpPa", "discharge_inertance_Pas2pkg"),
    not_negative=("head_kgpm2", "pump_gain", "chamber_gain_Paspkg", "resistance_Paspkg", "accumulator_kgpPa"),
    begins_by=0.0,
)


class FeedLineSection(Section):
    """A feed line from a tank to an engine: small oscillations of flow and pressure that couple with axial modes."""

    engine: int = optional("number of the engine that it feeds, from 0", 0, ge=0, lt=MAX_ENGINES)
    bottom_station_m: float = Field(description="station of the tank's bottom, m aft of the nose")
    table: Annotated[CsvTable, FEED_COLUMNS] = Field(
        description="over the stage clock: density times height of the liquid above the pump; inertance and "
        "resistance of the line; compliance of cavitation and of an accumulator at the pump; its mass-flow gain; gain "
        "of the pump's pressure; inertance and resistance from pump to chamber; chamber pressure per flow"
    )
    chamber_lag_s: Positive = Field(description="time constant of the chamber pressure, s")
    thrust_gain_m2: Positive = Field(description="thrust per chamber pressure, m2")
    line_area_m2: NotNegative = optional(
        "cross-section of the line, m2, on which its pressures act back (default: no reaction)", 0.0
    )

    @property
    def fastest(self) -> tuple[float, float]:
        """Return the highest frequency (Hz) of the pressure at the pump, between its two sides, and its damping ratio.

        The damping ratio is that of the side that decays more slowly.
        """
        t = self.table
        compliance = t["compliance_kgpPa"] + t.get("accumulator_kgpPa")
        line, discharge = t["inertance_Pas2pkg"], t["discharge_inertance_Pas2pkg"]
        omega = np.sqrt((1.0 / line + t["pump_gain"] / discharge) / compliance)
        decay = np.minimum(t.get("resistance_Paspkg") / line, t["discharge_resistance_Paspkg"] / discharge)
        k = int(np.argmax(omega))
        return float(omega[k]) / (2.0 * np.pi), float(np.clip(0.5 * decay[k] / omega[k], 0.0, 0.99))
