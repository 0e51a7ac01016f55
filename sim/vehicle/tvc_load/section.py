"""The schema of the compliance of a stage's engine mounts in the vehicle file."""

from __future__ import annotations

from pydantic import Field

from maxq.sim.input.values import ChannelPart, Fraction, NotNegative, Positive, Section, optional


class TvcLoadSection(Section):
    """The compliance of actuators and mount on which each engine swings: for all groups, or a list by group."""

    group: ChannelPart | None = optional("in a list: name of the group of engines")
    frequency_hz: Positive | None = optional(
        "frequency of the engine on its compliance, with locked actuators, fixed vehicle, no bearing, Hz"
    )
    stiffness_Nmprad: Positive | None = optional("stiffness k of an engine's compliance, N m/rad")
    bearing_stiffness_Nmprad: NotNegative = optional(
        "stiffness of an engine's flexible bearing, N m/rad: an actuator at rest holds the engine at k / (k + bearing) "
        "of its angle",
        0.0,
    )
    damping_ratio: Fraction = Field(
        description="damping ratio of that vibration, with the damper parallel to the spring"
    )
    friction_Nm: NotNegative = optional("Coulomb torque of a gimbal's bearings, N m (Dahl's model)", 0.0)
    friction_angle_deg: Positive = optional("angle over which the friction builds up, deg", 0.05)
    stop_stiffness_Nmprad: Positive | None = optional(
        "contact stiffness of an engine at the actuator's stop_deg, N m/rad (default: ten times k)"
    )

    def _check(self) -> None:
        self.at_most_one("frequency_hz", "stiffness_Nmprad")
        if self.stiffness_Nmprad is None:
            self.needs("frequency_hz", "stiffness_Nmprad is not given", "a number > 0")
