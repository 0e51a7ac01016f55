"""The schema of the engines and roll thrusters of a stage in the vehicle file."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from maxq.sim.input.errors import refuse
from maxq.sim.input.foreign import RASP
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import ChannelPart, NotNegative, Pair, Positive, Section, optional

THRUST_COLUMNS = Columns(
    "time_s",
    sets=(("thrust_vacuum_N",),),
    optional=("mass_flow_kgps",),
    not_negative=("thrust_vacuum_N", "mass_flow_kgps"),
    begins_by=0.0,
    foreign=RASP,
)


THROTTLE_COLUMNS = Columns("time_s", sets=(("throttle",),), not_negative=("throttle",), begins_by=0.0)


_LARGEST_EXPONENT = 2.0  # limit of the exponent of the burn rate's temperature factor

GimbalPlanes = Literal["both", "pitch", "yaw", "fixed"]


class EngineSection(Section):
    """A gimballed engine: one table for a single engine, or a list with one table for each engine."""

    name: ChannelPart = optional("name of the engine in logs and faults (default: its number)", "")
    table: Annotated[CsvTable, THRUST_COLUMNS] = Field(
        description="thrust in vacuum over the stage clock; mass_flow_kgps is relative to that of the other engines "
        "(default: in proportion to thrust); the vehicle's mass is in the table of mass"
    )
    throttle: Annotated[CsvTable, THROTTLE_COLUMNS] | None = optional(
        "share of the table's thrust and mass flow over the stage clock, linear between rows; tables over time then "
        "follow the propellant spent (default: 1)"
    )
    gimbal: GimbalPlanes = optional("planes in which the engine is gimballed", "both")
    group: ChannelPart = optional("engines of a group have the same gimbal angles", "")
    cant_deg: Pair = optional(
        "angle of the axis at rest, pitch and yaw, deg; the table of mass includes the engine in this position",
        (0.0, 0.0),
    )
    exit_area_m2: NotNegative = optional("nozzle exit area, m2: ambient pressure on it reduces thrust", 0.0)
    gimbal_station_m: float = Field(description="station of the gimbal, m aft of the nose")
    exit_station_m: float = Field(description="station of the nozzle exit, m aft of the nose (jet damping)")
    gimballed_mass_kg: NotNegative = optional("mass that moves with the engine, kg; 0: no reaction", 0.0)
    cg_from_gimbal_m: float = optional("CG of the gimballed mass aft of the gimbal, m", 0.0)
    inertia_about_gimbal_kgm2: NotNegative = optional("transverse inertia about the gimbal, kg m2", 0.0)
    misalignment_deg: Pair = optional("fixed angle of the thrust axis, pitch and yaw, deg", (0.0, 0.0))
    offset_m: Pair = optional("y and z of the gimbal from the body axis, m", (0.0, 0.0))
    thrust_factor: NotNegative = optional("factor on thrust", 1.0)
    mass_flow_factor: Positive = optional("burn rate: rate of the clock of the stage's tables", 1.0)
    temperature_sensitivity_1pK: NotNegative = optional(
        "pi_K of a solid motor, 1/K, with the factor exp(pi_K (propellant_temperature_K - reference_temperature_K)) "
        "on mass_flow_factor",
        0.0,
    )
    propellant_temperature_K: Positive = optional("mean temperature of the propellant, K", 294.15)
    reference_temperature_K: Positive = optional("propellant temperature of the thrust table, K", 294.15)
    roll_arm_m: float = optional("torque of the exhaust about the axis of the engine per newton of thrust, m", 0.0)

    @property
    def burn_factor(self) -> float:
        """Return the burn rate relative to the table, from deviation and temperature."""
        warmer_K = self.propellant_temperature_K - self.reference_temperature_K
        return self.mass_flow_factor * math.exp(self.temperature_sensitivity_1pK * warmer_K)

    @property
    def inertia_kgm2(self) -> float:
        """Return the inertia about the CG of the engine."""
        return self.inertia_about_gimbal_kgm2 - self.gimballed_mass_kg * self.cg_from_gimbal_m**2

    @property
    def arm_m(self) -> tuple[float, float, float]:
        """Return the vector from the body axis at the gimbal's station to the CG of the engine at rest, B."""
        (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in map(math.radians, self.cant_deg))
        length, (y, z) = self.cg_from_gimbal_m, self.offset_m
        return -length * cp * cy, y + length * sy, z - length * sp * cy

    def _check(self) -> None:
        least = self.gimballed_mass_kg * self.cg_from_gimbal_m**2
        if self.inertia_about_gimbal_kgm2 < least:
            raise refuse(
                "no rigid body has this inertia about the gimbal",
                f"at least gimballed_mass_kg * cg_from_gimbal_m^2 = {least:.6g}",
                "inertia_about_gimbal_kgm2",
            )
        warm = self.temperature_sensitivity_1pK * (self.propellant_temperature_K - self.reference_temperature_K)
        if abs(warm) > _LARGEST_EXPONENT:
            allowed = f"at most exp({_LARGEST_EXPONENT:g}), or its inverse"
            raise refuse(f"multiplies the burn rate by exp({warm:.3g})", allowed, "propellant_temperature_K")
        if self.gimbal == "fixed" and self.group:
            raise refuse("a fixed engine moves with no group", "this key with a gimballed engine only", "group")


class RollThrusters(Section):
    """The on/off cold-gas thrusters about the roll axis and, in a coast before a restart, about pitch and yaw."""

    torque_Nm: Positive = Field(description="torque of one direction while on, N m")
    pitch_yaw_torque_Nm: Positive | None = optional(
        "torque in pitch and in yaw, which hold the attitude in a coast before a restart (guidance.restart), N m"
    )
