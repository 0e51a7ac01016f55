"""The schema of the compliance of a stage's engine mounts in the vehicle file."""

from __future__ import annotations

from pydantic import Field

from maxq.sim.input.values import ChannelPart, Fraction, NotNegative, Positive, Section, optional


class TvcLoadSection(Section):
    """The compliance of actuators and mount on which each engine swings: for all groups, or a list by group."""

    group: ChannelPart | None = optional("in a list: name of the group of engines")
    frequency_hz: Positive | None = optional(
        "of the engine on its compliance, actuators locked, vehicle fixed, without bearing, Hz"
    )
    stiffness_Nmprad: Positive | None = optional("of the compliance of one engine, N m/rad")
    bearing_stiffness_Nmprad: NotNegative = optional(
        "of the flexible bearing of one engine between engine and vehicle, N m/rad: an actuator at rest holds the "
        "engine at k / (k + bearing) of its angle",
        0.0,
    )
    damping_ratio: Fraction = Field(
        description="damping ratio of that vibration, with the damper parallel to the spring"
    )
    friction_Nm: NotNegative = optional(
        "Coulomb torque of one gimbal's bearings, N m (Dahl's model); without a TVC load there is no friction", 0.0
    )
    friction_angle_deg: Positive = optional("angle over which the friction builds up, deg", 0.05)
    stop_stiffness_Nmprad: Positive | None = optional(
        "contact stiffness of one engine at the actuator's stop_deg, N m/rad (default: ten times that of the "
        "compliance)"
    )

    def _check(self) -> None:
        self.at_most_one("frequency_hz", "stiffness_Nmprad")
        if self.stiffness_Nmprad is None:
            self.needs("frequency_hz", "stiffness_Nmprad is not given", "a number > 0")
