"""Parts of a stage: mass and inertia, tanks, engine, actuators, roll thrusters, aerodynamics."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from maxq.control.kernel.limits import MAX_SURFACES
from maxq.sim.scenario.errors import refuse
from maxq.sim.scenario.foreign import RASP
from maxq.sim.scenario.grids import COEFFICIENT_COLUMNS, GridTable, grid_table
from maxq.sim.scenario.schema_values import (
    ChannelPart,
    Fraction,
    Matrix,
    NotNegative,
    Pair,
    Positive,
    Section,
    optional,
)
from maxq.sim.scenario.tables_csv import Columns, CsvTable

MASS_COLUMNS = Columns(
    "time_s",
    sets=(("mass_kg", "x_cg_m", "Ixx_kgm2", "Iyy_kgm2", "Izz_kgm2"),),
    optional=("y_cg_m", "z_cg_m", "Ixy_kgm2", "Ixz_kgm2", "Iyz_kgm2"),
    positive=("mass_kg", "Ixx_kgm2", "Iyy_kgm2", "Izz_kgm2"),
    begins_by=0.0,
)
RATE_DAMPING_COLUMNS = Columns(
    "time_s", sets=(("x_Nms", "y_Nms", "z_Nms"),), not_negative=("x_Nms", "y_Nms", "z_Nms"), begins_by=0.0
)
_SYMMETRY = 1e-9


class Mass(Section):
    """Mass properties of the whole vehicle while this stage flies: a table, or constants."""

    table: Annotated[CsvTable, MASS_COLUMNS] | None = optional(
        "whole vehicle, liquid included as if frozen, inertia about its CG, over the stage "
        "clock; x_cg_m is the station aft of the nose, y and z are body axes; products of inertia are "
        "integrals, Ixz = int x z dm"
    )
    mass_kg: Positive | None = optional("constant mass (at ignition, when it is expelled), kg")
    x_cg_m: float | None = optional("station of the CG aft of the nose, m")
    y_cg_m: float | None = optional("CG in body y, m (default 0)")
    z_cg_m: float | None = optional("CG in body z, m (default 0)")
    inertia_kgm2: Matrix | None = optional(
        "inertia tensor about the CG in B, kg m2: minus the products off the diagonal"
    )
    mass_flow_kgps: NotNegative | None = optional("mass expelled per second, kg/s (default 0)")
    burn_s: NotNegative | None = optional("for how long it is expelled, s")
    rate_damping: Annotated[CsvTable, RATE_DAMPING_COLUMNS] | None = optional(
        "moment against the body's rotation per rate about x, y and z, N m s/rad, over the stage clock"
    )

    def _check(self) -> None:
        if self.table is None:
            self._check_constants()
            return
        self.at_most_one("table", "mass_kg")
        constants = ("x_cg_m", "y_cg_m", "z_cg_m", "inertia_kgm2", "mass_flow_kgps", "burn_s")
        self.only_with(constants, False, "constant mass_kg")
        table = self.table
        x, y, z = diagonal = [table[f"I{a}{a}_kgm2"] for a in "xyz"]
        xy, xz, yz = (-table.get(f"I{a}_kgm2") for a in ("xy", "xz", "yz"))  # integrals, positive sign
        found = first_impossible(np.stack([x, xy, xz, xy, y, yz, xz, yz, z], axis=1).reshape(-1, 3, 3))
        if found:
            row, problem = found
            value = [float(moment[row]) for moment in diagonal]
            raise table.refusal(problem, column="Ixx_kgm2", row=row, value=value, at=("table",))

    def finely(
        self, ignition_s: float, interpolation: Literal["pchip", "linear"]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times of the stage clock (s) and the mass at them (kg), as it is joined in flight."""
        from maxq.control.kernel.tables import fit  # noqa: PLC0415  # lazy: it imports the compiler

        if self.table is None:
            spent = np.array([0.0, (self.mass_flow_kgps or 0.0) * (self.burn_s or 0.0)])
            return ignition_s + np.array([0.0, self.burn_s or 0.0]), (self.mass_kg or 0.0) - spent
        times, mass = self.table["time_s"], self.table["mass_kg"]
        fine = np.unique(np.concatenate([times, *(np.linspace(a, b, 65) for a, b in pairwise(times))]))
        return fine, fit(times, mass[:, None], interpolation).at(fine)[:, 0]

    def _check_constants(self) -> None:
        mass = self.needs("mass_kg", "mass needs a table or constants", "a number > 0")
        self.needs("x_cg_m", "mass_kg is given", "a number")
        inertia = np.array(self.needs("inertia_kgm2", "mass_kg is given", "a 3 x 3 tensor"))
        if np.abs(inertia - inertia.T).max() > _SYMMETRY * np.abs(inertia).max():
            raise refuse("an inertia tensor is symmetric", key="inertia_kgm2")
        found = first_impossible(0.5 * (inertia + inertia.T)[None])
        if found:
            raise refuse(found[1], key="inertia_kgm2")
        if (self.mass_flow_kgps is None) != (self.burn_s is None):
            missing = "burn_s" if self.burn_s is None else "mass_flow_kgps"
            raise refuse("required key is missing: they go together", "mass_flow_kgps and burn_s", missing)
        if self.mass_flow_kgps is not None and self.burn_s is not None:
            spent = self.mass_flow_kgps * self.burn_s
            if spent >= mass:
                raise refuse(f"expels {spent:g} kg of {mass:g} kg", f"burn_s * mass_flow_kgps < {mass:g}", ("burn_s",))


THRUST_COLUMNS = Columns(
    "time_s",
    sets=(("thrust_vacuum_N",),),
    optional=("mass_flow_kgps",),
    not_negative=("thrust_vacuum_N", "mass_flow_kgps"),
    begins_by=0.0,
    foreign=RASP,
)
GimbalAngle = Annotated[float, Field(ge=0.0, le=45.0)]


THROTTLE_COLUMNS = Columns("time_s", sets=(("throttle",),), not_negative=("throttle",), begins_by=0.0)
GimbalPlanes = Literal["both", "pitch", "yaw", "fixed"]


class Engine(Section):
    """Gimballed engine: one table for a single engine, or a list, one table for each engine."""

    name: ChannelPart = optional("name of the engine in logs and faults (default: its number)", "")
    table: Annotated[CsvTable, THRUST_COLUMNS] = Field(
        description="thrust in vacuum over the stage clock; mass_flow_kgps counts in relation to the other engines' "
        "(default: in proportion to thrust), the vehicle's mass is that of its own table"
    )
    throttle: Annotated[CsvTable, THROTTLE_COLUMNS] | None = optional(
        "share of the table's thrust and mass flow over the stage clock, linear between; tables over time then run on "
        "the propellant spent (default: 1)"
    )
    gimbal: GimbalPlanes = optional("planes in which the engine is gimballed", "both")
    group: ChannelPart = optional("engines of a group have the same gimbal angles", "")
    cant_deg: Pair = optional(
        "angle of the axis at rest, pitch and yaw, deg; the table of mass holds the engine so", (0.0, 0.0)
    )
    exit_area_m2: NotNegative = optional("nozzle exit area, m2: ambient pressure on it lessens thrust", 0.0)
    gimbal_station_m: float = Field(description="station of the gimbal, m aft of the nose")
    exit_station_m: float = Field(description="station of the nozzle exit, m aft of the nose (jet damping)")
    gimballed_mass_kg: NotNegative = optional("mass that moves with the engine, kg; 0: no reaction", 0.0)
    cg_from_gimbal_m: float = optional("CG of the gimballed mass aft of the gimbal, m", 0.0)
    inertia_about_gimbal_kgm2: NotNegative = optional("transverse inertia about the gimbal, kg m2", 0.0)
    misalignment_deg: Pair = optional("fixed angle of the thrust axis, pitch and yaw, deg", (0.0, 0.0))
    offset_m: Pair = optional("of the gimbal from the body axis, y and z, m", (0.0, 0.0))
    thrust_factor: NotNegative = optional("multiplies thrust", 1.0)
    mass_flow_factor: Positive = optional("burn rate: speeds up the stage's tables over time", 1.0)

    def _check(self) -> None:
        least = self.gimballed_mass_kg * self.cg_from_gimbal_m**2
        if self.inertia_about_gimbal_kgm2 < least:
            raise refuse(
                "no rigid body has this inertia about the gimbal",
                f"at least gimballed_mass_kg * cg_from_gimbal_m^2 = {least:.6g}",
                "inertia_about_gimbal_kgm2",
            )
        if self.gimbal == "fixed" and self.group:
            raise refuse("a fixed engine moves with no group", "this key with a gimballed engine only", "group")


SECTIONS = {"second-order": 1, "fourth-order": 2, "sixth-order": 4}
"""Frequencies and damping ratios of an actuator by its model; the fourth of the sixth order is the zero."""


class ActuatorAxis(Section):
    """Actuator of one axis."""

    model: Literal["second-order", "fourth-order", "sixth-order"] = optional(
        "poles: the servo; servo and a second pair; servo and two pairs with a pair of zeros (paper, eq. 28)",
        "sixth-order",
    )
    omega_hz: tuple[Positive, ...] = Field(
        description="natural frequencies, Hz: servo a1, from the fourth order a2, in the sixth a3 and the zero a4"
    )
    zeta: tuple[Positive, ...] = Field(description="damping ratios in the same order")
    exchange_a3_a4: bool = optional("exchange pole pair a3 and zero pair a4 (erratum 13)", False)
    angle_limit_deg: GimbalAngle = Field(description="limit of the gimbal angle, deg")
    rate_limit_degps: Positive = Field(description="limit of the gimbal rate, deg/s")
    limits_act_on: Literal["servo", "engine"] = optional(
        "servo: the other poles come behind it and may carry the engine past both limits; engine: they come ahead of "
        "it, and the engine's rate stays within its limit",
        "servo",
    )
    stop_deg: GimbalAngle | None = optional("hard stop of the engine's own angle, deg (default: none)")
    backlash_deg: NotNegative = optional("full width of the play between actuator and engine, deg", 0.0)

    def _check(self) -> None:
        count = SECTIONS[self.model]
        for key in ("omega_hz", "zeta"):
            given = len(getattr(self, key))
            if given != count:
                raise refuse(f"has {given} numbers in a {self.model} model", f"a list of {count}", key)
        if self.exchange_a3_a4 and count < 4:
            raise refuse(f"a {self.model} model has no a3 and a4", "false, or sixth-order", "exchange_a3_a4")


class YawActuator(Section):
    """What differs in the yaw actuator; every key is optional."""

    omega_hz: tuple[Positive, ...] | None = optional("natural frequencies, Hz")
    zeta: tuple[Positive, ...] | None = optional("damping ratios")
    exchange_a3_a4: bool | None = optional("exchange pole pair a3 and zero pair a4")
    angle_limit_deg: GimbalAngle | None = optional("limit of the gimbal angle, deg")
    rate_limit_degps: Positive | None = optional("limit of the gimbal rate, deg/s")
    stop_deg: GimbalAngle | None = optional("hard stop of the engine's own angle, deg")
    backlash_deg: NotNegative | None = optional("full width of the play between actuator and engine, deg")


class Actuator(ActuatorAxis):
    """Actuators of both axes, alike unless `yaw` says otherwise: of all groups of engines, or in a list of one each."""

    group: ChannelPart | None = optional("in a list: the group of engines that it moves, as the engines name it")
    bias_deg: Pair = optional("constant error of the angle, pitch and yaw, deg", (0.0, 0.0))
    yaw: YawActuator | None = optional("keys that differ in the yaw axis")

    def _check(self) -> None:
        super()._check()
        count = SECTIONS[self.model]
        for key in ("omega_hz", "zeta"):
            given = getattr(self.yaw, key, None)
            if given is not None and len(given) != count:
                raise refuse(f"has {len(given)} numbers in a {self.model} model", f"a list of {count}", ("yaw", key))

    @property
    def axes(self) -> tuple[ActuatorAxis, ActuatorAxis]:
        """Pitch and yaw axis in full."""
        if self.yaw is None:
            return self, self
        shared = {name: getattr(self, name) for name in ActuatorAxis.model_fields}
        return self, ActuatorAxis(**(shared | self.yaw.model_dump(exclude_none=True)))


class TvcLoad(Section):
    """Each engine on the compliance of actuators and mount, free in its planes: all groups, or a list by group."""

    group: ChannelPart | None = optional("in a list: the group of engines, as they name it")
    frequency_hz: Positive | None = optional("of the engine on its compliance, actuators locked, vehicle fixed, Hz")
    stiffness_Nmprad: Positive | None = optional("of the compliance of one engine, N m/rad")
    damping_ratio: Fraction = Field(description="of that vibration: the damper lies beside the spring")
    friction_Nm: NotNegative = optional(
        "Coulomb torque of one gimbal's bearings, N m (Dahl's model); without a TVC load there is no friction", 0.0
    )
    friction_angle_deg: Positive = optional("over which the friction builds up, deg", 0.05)
    stop_stiffness_Nmprad: Positive | None = optional(
        "of the contact of one engine at the actuator's stop_deg, N m/rad (default: ten times that of the compliance)"
    )

    def _check(self) -> None:
        self.at_most_one("frequency_hz", "stiffness_Nmprad")
        if self.stiffness_Nmprad is None:
            self.needs("frequency_hz", "stiffness_Nmprad is not given", "a number > 0")


class RollThrusters(Section):
    """Cold-gas thrusters about the roll axis, on or off."""

    torque_Nm: Positive = Field(description="torque of one direction while on, N m")


COEFFICIENTS = (
    "CA", "CA_coast", "CD", "CN_alpha_pr", "x_cp_m", "Cm_alpha_pr", "Cm0", "Cmq", "Cnr", "Clp", "C_crossflow",
)  # fmt: skip  # ten more lines otherwise
AERO_COLUMNS = Columns("mach", optional=COEFFICIENTS, not_negative=("mach", "CA", "CA_coast", "CD", "C_crossflow"))
SURFACE_COLUMNS = Columns("mach", sets=(("CN_alpha_pr", "station_m"),), not_negative=("mach",))


REFERENCE_OVER_TIME = Columns("time_s", sets=(("station_m",),), begins_by=0.0)
REFERENCE_OVER_MASS = Columns("mass_kg", sets=(("station_m",),), positive=("mass_kg",))


def _nothing() -> CsvTable:
    """A table without coefficients."""
    return CsvTable("", {"mach": np.zeros(1)})


class AeroSurface(Section):
    """A lifting part, with its own incidence where the body bends."""

    name: str = optional("name of the part", "")
    table: Annotated[CsvTable, SURFACE_COLUMNS] = Field(
        description="normal force slope (1/rad) and its station over Mach"
    )


class Coefficients(Section):
    """A table of coefficients over Mach number and incidence; all tables act together, beside the slopes."""

    name: str = optional("name of the table", "")
    table: Annotated[CsvTable, COEFFICIENT_COLUMNS] = Field(
        description="one row for each combination of up to three of: mach; total_deg, the angle between x axis and "
        "flow, with roll_deg, atan2(v, w), or alpha_deg = atan2(w, u) and beta_deg = asin(v/V); outside it the end "
        "values hold. Forces CA = -CX, CY, CN = -CZ, or drag CD and lift CL (turned by the incidence); moments Cl, Cm, "
        "Cn (span, chord, yaw chord) about the moment reference; Clp ... CNq per p span/2V, q chord/2V, r yaw chord/2V"
    )
    axes: Literal["body", "aeroballistic"] | None = optional(
        "of forces and moments; aeroballistic: CN and Cm in the plane of total incidence, CY and Cn across it "
        "(default with total_deg, else body)"
    )
    power: Literal["always", "on", "off"] = optional(
        "on: acts while the engine burns; off: while it does not", "always"
    )
    interpolation: Literal["linear", "pchip"] | None = optional(
        "multilinear, or with continuous slopes in all variables (default: as the aerodynamics')"
    )
    station_m: float | None = optional(
        "station at which bending and wind act on it and it on the modes, m aft of the nose (default: the mean moment "
        "reference)"
    )

    @property
    def grid(self) -> GridTable:
        """The table as arrays."""
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
        """Where the flow is along the axis, the plane of incidence is undefined: nothing may depend on it there."""
        k = grid.axes.index("total_deg")
        total = grid.breaks[k]
        if total[0] > 0.0:
            raise self.table.refusal(
                f"total_deg begins at {total[0]:g}: forces in the plane of incidence must vanish with it",
                "a first total_deg = 0",
                at=("table",),
            )
        for c, name in enumerate(grid.names):
            for end in (0, -1) if total[-1] == 180.0 else (0,):
                there = np.moveaxis(grid.values[..., c], k, 0)[end]
                if name in ("CY", "CN", "CZ", "CL", "Cm", "Cn") and (there != 0.0).any():
                    raise self.table.refusal(
                        f"{name} is not zero at total_deg = {total[end]:g}, where it has no direction", "0",
                        at=("table",),
                    )  # fmt: skip  # one more line otherwise
                if "roll_deg" in grid.axes and np.ptp(there, axis=grid.axes.index("roll_deg") - 1).max() > 0.0:
                    raise self.table.refusal(
                        f"{name} depends on roll_deg at total_deg = {total[end]:g}, where it is undefined",
                        "one value", at=("table",),
                    )  # fmt: skip  # one more line otherwise


class Aero(Section):
    """Coefficients over Mach number, and over incidence; outside the table the end values hold."""

    table: Annotated[CsvTable, AERO_COLUMNS] = Field(
        default_factory=_nothing,
        description="may be absent beside coefficients; absent columns are 0 (CA_coast, engine off: as CA); CD acts "
        "along the relative wind; CN_alpha_pr acts at x_cp_m, or gives Cm_alpha_pr about the moment reference; "
        "Cmq, Cnr, Clp damp rates",
    )
    interpolation: Literal["pchip", "linear"] = optional("between the rows", "pchip")
    moment_reference_m: float = optional("station about which moments are given, m aft of the nose", 0.0)
    moment_reference_over_time: Annotated[CsvTable, REFERENCE_OVER_TIME] | None = optional(
        "the moment reference as it moves over the stage clock, m aft of the nose, instead of moment_reference_m"
    )
    moment_reference_over_mass: Annotated[CsvTable, REFERENCE_OVER_MASS] | None = optional(
        "the same over the vehicle's total mass"
    )
    airspeed_floor_mps: NotNegative = optional("below this airspeed there are no aerodynamic forces, m/s", 0.0)
    crossflow_station_m: float | None = optional(
        "station of the cross-flow drag, m aft of the nose (default: half the length)"
    )
    force_factor: NotNegative = optional("multiplies normal force and cross-flow drag", 1.0)
    axial_factor: NotNegative = optional("multiplies axial force and drag (CA, CD)", 1.0)
    damping_factor: NotNegative = optional("multiplies the damping by body rates (Cmq, Cnr, Clp)", 1.0)
    centre_shift_m: float = optional("moves the centre of every lifting part aft, m", 0.0)
    rate_reference: Literal["inertial", "earth"] = optional("which body rates damp", "inertial")
    surface: tuple[AeroSurface, ...] = optional(
        "lifting parts; their sum is CN_alpha where the table has none", (), max_length=MAX_SURFACES
    )
    coefficients: tuple[Coefficients, ...] = optional(
        "tables over Mach number and incidence", (), max_length=MAX_SURFACES
    )

    @property
    def moment_reference(self) -> tuple[str, CsvTable]:
        """What the moment reference depends on ("", "time_s", "mass_kg"), and its station over that."""
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
                "column Cm_alpha_pr cannot stand beside x_cp_m", "one of x_cp_m, Cm_alpha_pr", at=("table",)
            )
        if "x_cp_m" in table and "CN_alpha_pr" not in table:
            raise table.refusal("column x_cp_m needs a column CN_alpha_pr", at=("table",))
        placed = "x_cp_m" in table or "Cm_alpha_pr" in table or self.surface
        if "CN_alpha_pr" in table and not placed:
            raise table.refusal(
                "the normal force has no place to act at", "x_cp_m or Cm_alpha_pr beside CN_alpha_pr", at=("table",)
            )


_SLACK = 1e-9
"""Rounding that is forgiven, relative to the largest principal moment."""


def first_impossible(inertia: NDArray[np.float64]) -> tuple[int, str] | None:
    """Row of the first tensor of (n, 3, 3) that no body can have, and why; None when all are possible.

    A body's principal moments are positive, and none is larger than the sum of the other two.
    """
    moments = np.linalg.eigvalsh(inertia)
    smallest, largest = moments[:, 0], moments[:, 2]
    not_definite = smallest <= 0.0
    not_a_triangle = largest > smallest + moments[:, 1] + _SLACK * np.abs(largest)
    wrong = not_definite | not_a_triangle
    if not wrong.any():
        return None
    row = int(np.argmax(wrong))
    listed = ", ".join(f"{moment:.6g}" for moment in moments[row])
    if not_definite[row]:
        return row, f"no rigid body has this inertia: principal moments {listed} kg m2 are not all positive"
    return (
        row,
        f"no rigid body has this inertia: of the principal moments {listed} kg m2 one exceeds the sum of the others",
    )
