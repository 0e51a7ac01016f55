"""Engine, actuators and roll thrusters of a stage."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from maxq.sim.scenario.errors import refuse
from maxq.sim.scenario.schema_values import NotNegative, Pair, Positive, Section
from maxq.sim.scenario.tables_csv import Columns, CsvTable

THRUST_COLUMNS = Columns("time_s", sets=(("thrust_vacuum_N",),), not_negative=("thrust_vacuum_N",), begins_by=0.0)
Angle = Annotated[float, Field(ge=0.0, le=45.0)]
Four = tuple[Positive, Positive, Positive, Positive]


class Engine(Section):
    """Gimballed engine."""

    table: Annotated[CsvTable, THRUST_COLUMNS] = Field(description="thrust in vacuum over the stage clock")
    exit_area_m2: NotNegative = Field(
        default=0.0, description="nozzle exit area, m2: ambient pressure on it lessens thrust"
    )
    gimbal_station_m: float = Field(description="station of the gimbal, m aft of the nose")
    exit_station_m: float = Field(description="station of the nozzle exit, m aft of the nose (jet damping)")
    gimballed_mass_kg: NotNegative = Field(
        default=0.0, description="mass that moves with the engine, kg; 0: no reaction"
    )
    cg_from_gimbal_m: float = Field(default=0.0, description="CG of the gimballed mass aft of the gimbal, m")
    inertia_about_gimbal_kgm2: NotNegative = Field(
        default=0.0, description="transverse inertia about the gimbal, kg m2"
    )
    misalignment_deg: Pair = Field(default=(0.0, 0.0), description="fixed angle of the thrust axis, pitch and yaw, deg")
    offset_m: Pair = Field(default=(0.0, 0.0), description="of the gimbal from the body axis, y and z, m")
    thrust_factor: NotNegative = Field(default=1.0, description="multiplies thrust")
    mass_flow_factor: Positive = Field(default=1.0, description="burn rate: speeds up the stage's tables over time")

    @model_validator(mode="after")
    def _check(self) -> Engine:
        least = self.gimballed_mass_kg * self.cg_from_gimbal_m**2
        if self.inertia_about_gimbal_kgm2 < least:
            raise refuse(
                "no body has this inertia about the gimbal",
                f"at least gimballed_mass_kg * cg_from_gimbal_m^2 = {least:.6g}",
                key=("inertia_about_gimbal_kgm2",),
            )
        return self


class ActuatorAxis(Section):
    """Sixth-order actuator of one axis (paper, eq. 28)."""

    omega_hz: Four = Field(description="natural frequencies a1 .. a4, Hz")
    zeta: Four = Field(description="damping ratios a1 .. a4")
    exchange_a3_a4: bool = Field(default=False, description="exchange pole pair a3 and zero pair a4 (erratum 13)")
    angle_limit_deg: Angle = Field(description="limit of the gimbal angle, deg")
    rate_limit_degps: Positive = Field(description="limit of the gimbal rate, deg/s")
    backlash_deg: NotNegative = Field(default=0.0, description="full width of the play, deg")


class YawActuator(Section):
    """What differs in the yaw actuator; every key is optional."""

    omega_hz: Four | None = Field(default=None, description="natural frequencies a1 .. a4, Hz")
    zeta: Four | None = Field(default=None, description="damping ratios a1 .. a4")
    exchange_a3_a4: bool | None = Field(default=None, description="exchange pole pair a3 and zero pair a4")
    angle_limit_deg: Angle | None = Field(default=None, description="limit of the gimbal angle, deg")
    rate_limit_degps: Positive | None = Field(default=None, description="limit of the gimbal rate, deg/s")
    backlash_deg: NotNegative | None = Field(default=None, description="full width of the play, deg")


class Actuator(ActuatorAxis):
    """Actuators of both axes, alike unless `yaw` says otherwise."""

    bias_deg: Pair = Field(default=(0.0, 0.0), description="constant error of the angle, pitch and yaw, deg")
    yaw: YawActuator | None = Field(default=None, description="keys that differ in the yaw axis")

    @property
    def axes(self) -> tuple[ActuatorAxis, ActuatorAxis]:
        """Pitch and yaw axis in full."""
        shared = {name: getattr(self, name) for name in ActuatorAxis.model_fields}
        differing = self.yaw.model_dump(exclude_none=True) if self.yaw else {}
        return ActuatorAxis(**shared), ActuatorAxis(**(shared | differing))


class RollThrusters(Section):
    """Cold-gas thrusters about the roll axis, on or off."""

    torque_Nm: Positive = Field(description="torque of one direction while on, N m")
