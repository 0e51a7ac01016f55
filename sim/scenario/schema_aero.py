"""Aerodynamics of a stage: tables over Mach number."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from maxq.control.kernel.limits import MAX_SURFACES
from maxq.sim.scenario.schema_values import NotNegative, Section
from maxq.sim.scenario.tables_csv import Columns, CsvTable

COEFFICIENTS = (
    "CA",
    "CA_coast",
    "CD",
    "CN_alpha_pr",
    "x_cp_m",
    "Cm_alpha_pr",
    "Cm0",
    "Cmq",
    "Cnr",
    "Clp",
    "C_crossflow",
)
AERO_COLUMNS = Columns("mach", optional=COEFFICIENTS, not_negative=("mach", "CA", "CA_coast", "CD", "C_crossflow"))
SURFACE_COLUMNS = Columns("mach", sets=(("CN_alpha_pr", "station_m"),), not_negative=("mach",))


class AeroSurface(Section):
    """A lifting part, with its own incidence where the body bends."""

    name: str = Field(default="", description="name of the part")
    table: Annotated[CsvTable, SURFACE_COLUMNS] = Field(
        description="normal force slope (1/rad) and its station over Mach"
    )


class Aero(Section):
    """Coefficients over Mach number; outside the table the end values hold."""

    table: Annotated[CsvTable, AERO_COLUMNS] = Field(
        description="absent columns are 0 (CA_coast, engine off: as CA); CD acts along the relative wind; "
        "CN_alpha_pr acts at x_cp_m, or gives Cm_alpha_pr about moment_reference_m; Cmq, Cnr, Clp damp rates"
    )
    interpolation: Literal["pchip", "linear"] = Field(default="pchip", description="between the rows")
    moment_reference_m: float = Field(
        default=0.0, description="station about which Cm_alpha_pr and Cm0 act, m aft of the nose"
    )
    crossflow_station_m: float | None = Field(
        default=None, description="station of the cross-flow drag, m aft of the nose (default: half the length)"
    )
    force_factor: NotNegative = Field(default=1.0, description="multiplies normal force and cross-flow drag")
    axial_factor: NotNegative = Field(default=1.0, description="multiplies axial force and drag (CA, CD)")
    damping_factor: NotNegative = Field(default=1.0, description="multiplies the damping by body rates (Cmq, Cnr, Clp)")
    centre_shift_m: float = Field(default=0.0, description="moves the centre of every lifting part aft, m")
    rate_reference: Literal["inertial", "earth"] = Field(default="inertial", description="which body rates damp")
    surface: tuple[AeroSurface, ...] = Field(
        default=(), max_length=MAX_SURFACES, description="lifting parts; their sum is CN_alpha where the table has none"
    )

    @model_validator(mode="after")
    def _check(self) -> Aero:
        table = self.table
        if "x_cp_m" in table and "Cm_alpha_pr" in table:
            raise table.refusal(
                "column Cm_alpha_pr cannot stand beside x_cp_m", "one of x_cp_m, Cm_alpha_pr", at=("table",)
            )
        if "x_cp_m" in table and "CN_alpha_pr" not in table:
            raise table.refusal("column x_cp_m needs a column CN_alpha_pr", at=("table",))
        placed = "x_cp_m" in table or "Cm_alpha_pr" in table or self.surface
        if "CN_alpha_pr" in table and not placed:
            raise table.refusal(
                "the normal force has no place to act at", "x_cp_m or Cm_alpha_pr beside CN_alpha_pr", at=("table",)
            )
        return self
