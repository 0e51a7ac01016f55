"""The schema of the actuators of a stage's gimbals in the vehicle file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from maxq.sim.input.errors import refuse
from maxq.sim.input.values import ChannelPart, NotNegative, Pair, Positive, Section, optional

GimbalAngle = Annotated[float, Field(ge=0.0, le=45.0)]


SECTIONS = {"second-order": 1, "fourth-order": 2, "sixth-order": 4}
"""The number of frequencies and damping ratios of each actuator model; the fourth pair of sixth order is the zero."""


class ActuatorAxis(Section):
    """The actuator of one axis."""

    model: Literal["second-order", "fourth-order", "sixth-order"] = optional(
        "pole pairs: servo; servo and one; servo and two, with a pair of zeros (paper, eq. 28)", "sixth-order"
    )
    omega_hz: tuple[Positive, ...] = Field(
        description="natural frequencies, Hz: servo a1, with fourth order a2, with sixth order a3 and zero pair a4"
    )
    zeta: tuple[Positive, ...] = Field(description="damping ratios in the same order")
    exchange_a3_a4: bool = optional("exchange pole pair a3 and zero pair a4 (erratum 13)", False)
    angle_limit_deg: GimbalAngle = Field(description="limit of the gimbal angle, deg")
    rate_limit_degps: Positive = Field(description="limit of the gimbal rate, deg/s")
    limits_act_on: Literal["servo", "engine"] = optional(
        "servo: the other poles follow the servo, and the engine can exceed both limits; engine: they precede the "
        "servo, and the engine's rate is limited",
        "servo",
    )
    stop_deg: GimbalAngle | None = optional("hard stop of the gimbal angle, deg (default: none)")
    backlash_deg: NotNegative = optional("full width of the play between actuator and engine, deg", 0.0)
    stall_torque_Nm: Positive | None = optional(
        "torque of an engine about its gimbal that stops the actuator, N m; a larger torque drives it back; needs a "
        "TVC load (default: none)"
    )

    def _check(self) -> None:
        count = SECTIONS[self.model]
        for key in ("omega_hz", "zeta"):
            given = len(getattr(self, key))
            if given != count:
                raise refuse(f"has {given} numbers in a {self.model} model", f"a list of {count}", key)
        if self.exchange_a3_a4 and count < 4:
            raise refuse(f"a {self.model} model has no a3 and a4", "false, or sixth-order", "exchange_a3_a4")


class YawActuator(Section):
    """The keys that differ in the yaw actuator; all are optional."""

    omega_hz: tuple[Positive, ...] | None = optional("natural frequencies, Hz")
    zeta: tuple[Positive, ...] | None = optional("damping ratios")
    exchange_a3_a4: bool | None = optional("exchange pole pair a3 and zero pair a4")
    angle_limit_deg: GimbalAngle | None = optional("limit of the gimbal angle, deg")
    rate_limit_degps: Positive | None = optional("limit of the gimbal rate, deg/s")
    stop_deg: GimbalAngle | None = optional("hard stop of the gimbal angle, deg")
    backlash_deg: NotNegative | None = optional("full width of the play between actuator and engine, deg")
    stall_torque_Nm: Positive | None = optional("torque that stops the actuator, N m")


class ActuatorSection(ActuatorAxis):
    """The actuators of both axes, equal except for the keys in `yaw`; for all groups of engines, or a list by group."""

    group: ChannelPart | None = optional("in a list: name of the group of engines")
    bias_deg: Pair = optional("constant error of the angle in pitch and yaw, deg", (0.0, 0.0))
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
        """Return the pitch and the yaw axis in full."""
        if self.yaw is None:
            return self, self
        shared = {name: getattr(self, name) for name in ActuatorAxis.model_fields}
        return self, ActuatorAxis(**(shared | self.yaw.model_dump(exclude_none=True)))
