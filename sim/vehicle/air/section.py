"""The schema of the aerodynamics of a stage in the vehicle file."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from maxq.control.kernel.limits import MAX_SURFACES
from maxq.sim.input.errors import refuse
from maxq.sim.input.foreign import DRAG_CURVE
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import NotNegative, Positive, Section, optional
from maxq.sim.vehicle.air.tables import COEFFICIENT_COLUMNS, GridTable, grid_table

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


AERO_COLUMNS = Columns(
    "mach", optional=COEFFICIENTS, not_negative=("mach", "CA", "CA_coast", "CD", "C_crossflow"), foreign=DRAG_CURVE
)


SURFACE_COLUMNS = Columns("mach", sets=(("CN_alpha_pr", "station_m"),), not_negative=("mach",))


REFERENCE_OVER_TIME = Columns("time_s", sets=(("station_m",),), begins_by=0.0)


REFERENCE_OVER_MASS = Columns("mass_kg", sets=(("station_m",),), positive=("mass_kg",))


def _nothing() -> CsvTable:
    """Return a table without coefficients."""
    return CsvTable("", {"mach": np.zeros(1)})


class AeroSurface(Section):
    """A lifting part, with its local angle of attack on the bent body."""

    name: str = optional("name of the part", "")
    table: Annotated[CsvTable, SURFACE_COLUMNS] = Field(
        description="normal force slope (1/rad) and its station, over Mach number"
    )


class Coefficients(Section):
    """A table of coefficients over Mach number and angle of attack; all tables and the slopes are summed."""

    name: str = optional("name of the table", "")
    table: Annotated[CsvTable, COEFFICIENT_COLUMNS] = Field(
        description="a row for each combination of up to three of: mach; total_deg, the angle between x axis and "
        "flow, with roll_deg, atan2(v, w), or alpha_deg = atan2(w, u) and beta_deg = asin(v/V); end values hold "
        "outside. Forces CA = -CX, CY, CN = -CZ, or drag CD and lift CL (rotated by the angle of attack); moments "
        "Cl, Cm, Cn (span, chord, yaw chord) about the moment reference; Clp ... CNq per p span/2V, q chord/2V, r yaw "
        "chord/2V"
    )
    axes: Literal["body", "aeroballistic"] | None = optional(
        "axes of forces and moments; aeroballistic: CN and Cm in the plane of the total angle of attack, CY and Cn "
        "across it (default with total_deg, else body)"
    )
    power: Literal["always", "on", "off"] = optional("on: with burning engine; off: without", "always")
    interpolation: Literal["linear", "pchip"] | None = optional(
        "multilinear, or with continuous slopes in all variables (default: that of [stage.aero])"
    )
    station_m: float | None = optional(
        "station for the coupling with bending and wind, m aft of the nose (default: the mean moment reference)"
    )

    @property
    def grid(self) -> GridTable:
        """Return the table as arrays."""
        return grid_table(self.table, ("table",))

    @property
    def aeroballistic(self) -> bool:
        return self.axes == "aeroballistic" or (self.axes is None and "total_deg" in self.table)

    def _check(self) -> None:
        grid, table = self.grid, self.table
        if self.axes == "aeroballistic" and "total_deg" not in grid.axes:
            raise refuse("aeroballistic axes need a table over total_deg", "'body'", "axes")
        along_wind = [name for name in ("CD", "CL") if name in grid.names]
        for alike in (("CA", "CX"), ("CN", "CZ"), *((w, b) for w in along_wind for b in ("CA", "CX", "CN", "CZ"))):
            if all(name in grid.names for name in alike):
                problem = f"column {alike[1]} cannot be combined with {alike[0]}"
                raise table.refusal(problem, "two tables, or one of them", at=("table",))
        if self.aeroballistic:
            self._check_axis(grid)

    def _check_axis(self, grid: GridTable) -> None:
        """Check the coefficients at the angles at which the flow is along the axis.

        Lateral coefficients must be zero there, and none may depend on the roll angle.
        """
        k = grid.axes.index("total_deg")
        total = grid.breaks[k]
        if total[0] > 0.0:
            raise self.table.refusal(
                f"total_deg begins at {total[0]:g}: forces in the plane of total angle of attack must vanish with it",
                "a first total_deg = 0",
                at=("table",),
            )
        for c, name in enumerate(grid.names):
            for end in (0, -1) if total[-1] == 180.0 else (0,):
                there = np.moveaxis(grid.values[..., c], k, 0)[end]
                if name in ("CY", "CN", "CZ", "CL", "Cm", "Cn") and (there != 0.0).any():
                    raise self.table.refusal(
                        f"{name} is not zero at total_deg = {total[end]:g}, where it has no direction",
                        "0",
                        at=("table",),
                    )
                if "roll_deg" in grid.axes and np.ptp(there, axis=grid.axes.index("roll_deg") - 1).max() > 0.0:
                    raise self.table.refusal(
                        f"{name} depends on roll_deg at total_deg = {total[end]:g}, where it is undefined",
                        "one value",
                        at=("table",),
                    )


class AeroSection(Section):
    """The coefficients over Mach number and angle of attack; the end values apply outside the table."""

    table: Annotated[CsvTable, AERO_COLUMNS] = Field(
        default_factory=_nothing,
        description="optional with coefficients; absent columns are 0 (CA_coast, engine off: as CA); CD acts along "
        "the relative wind; CN_alpha_pr acts at x_cp_m, or Cm_alpha_pr is given about the moment reference; Cmq, Cnr, "
        "Clp damp rates",
    )
    interpolation: Literal["pchip", "linear"] = optional("interpolation between the rows", "pchip")
    moment_reference_m: float = optional("reference station of the moments, m aft of the nose", 0.0)
    moment_reference_over_time: Annotated[CsvTable, REFERENCE_OVER_TIME] | None = optional(
        "moment reference over the stage clock, m aft of the nose, instead of moment_reference_m"
    )
    moment_reference_over_mass: Annotated[CsvTable, REFERENCE_OVER_MASS] | None = optional(
        "moment reference over the vehicle's total mass"
    )
    airspeed_floor_mps: NotNegative = optional("airspeed below which aerodynamic forces are zero, m/s", 0.0)
    crossflow_station_m: float | None = optional(
        "station of the cross-flow drag, m aft of the nose (default: half the length)"
    )
    force_factor: NotNegative = optional("factor on normal force and cross-flow drag", 1.0)
    axial_factor: NotNegative = optional("factor on axial force and drag (CA, CD)", 1.0)
    damping_factor: NotNegative = optional("factor on damping by body rates (Cmq, Cnr, Clp)", 1.0)
    lag_m: Positive | None = optional(
        "length over which the air lags behind the first bending mode of each plane, m (default: no lag)"
    )
    centre_shift_m: float = optional("aft shift of every lifting part's centre, m", 0.0)
    rate_reference: Literal["inertial", "earth"] = optional("reference of the damped body rates", "inertial")
    surface: tuple[AeroSurface, ...] = optional(
        "lifting parts; their sum is CN_alpha if the table has none", (), max_length=MAX_SURFACES
    )
    coefficients: tuple[Coefficients, ...] = optional(
        "tables over Mach number and angle of attack", (), max_length=MAX_SURFACES
    )

    @property
    def moment_reference(self) -> tuple[str, CsvTable]:
        """Return the variable of the moment reference ("", "time_s", "mass_kg"), and the table of its station."""
        for key, table in (("time_s", self.moment_reference_over_time), ("mass_kg", self.moment_reference_over_mass)):
            if table is not None:
                return key, table
        return "", CsvTable("", {"": np.zeros(1), "station_m": np.array([self.moment_reference_m])})

    def _check(self) -> None:
        table = self.table
        if not (self.model_fields_set & {"table", "surface", "coefficients"}):
            raise refuse("required key is missing", AERO_COLUMNS.allowed(), "table")
        if len(self.surface) + len(self.coefficients) > MAX_SURFACES:
            raise refuse(f"more than {MAX_SURFACES} surfaces and tables", f"{MAX_SURFACES} in all", ("coefficients",))
        self.at_most_one("moment_reference_over_time", "moment_reference_over_mass")
        if self.moment_reference[0] and "moment_reference_m" in self.model_fields_set:
            raise refuse("cannot be combined with a moment reference that moves", "one of them", "moment_reference_m")
        if "x_cp_m" in table and "Cm_alpha_pr" in table:
            raise table.refusal(
                "column Cm_alpha_pr cannot be combined with x_cp_m", "one of x_cp_m, Cm_alpha_pr", at=("table",)
            )
        if "x_cp_m" in table and "CN_alpha_pr" not in table:
            raise table.refusal("column x_cp_m needs a column CN_alpha_pr", at=("table",))
        placed = "x_cp_m" in table or "Cm_alpha_pr" in table or self.surface
        if "CN_alpha_pr" in table and not placed:
            raise table.refusal(
                "the normal force has no point of application", "x_cp_m or Cm_alpha_pr with CN_alpha_pr", at=("table",)
            )
