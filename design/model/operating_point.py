"""The interface of an operating point: all quantities on which a linear loop depends at one instant, in one plane.

| class | plant |
|---|---|
| `node.Node` | a vehicle of maxq at an instant of its flight: the Jacobian of the simulator's derivative |
| `paper.nodes.PaperNode` | the same by the published planar equations |
| `given.GivenPoint` | published derivatives over time, or the matrices A, B, C, D: no vehicle, no flight |

A loop (design/loop) uses nothing else of an operating point.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Self

from maxq.control.kernel.records import Array
from maxq.control.structures import Over
from maxq.design.model.held import FlightCondition
from maxq.design.model.instruments import Instruments, Plane
from maxq.design.model.state_space import StateSpace
from maxq.design.model.vehicle_at import StabilityDerivatives
from maxq.sim.vehicle.actuator.kernel import Actuator

BUILD_UP = ("rigid body", "aerodynamics", "slosh", "engine inertia", "bending")
"""The steps in which the vehicle is built up."""


@dataclass(frozen=True, kw_only=True)
class OperatingPoint(abc.ABC):
    """The air and the instruments of one plane at a vehicle time, and the plant between them."""

    time_s: float
    condition: FlightCondition
    instruments: Instruments
    plane: Plane = "pitch"
    label: str = ""
    stage: int = 0  # stage that burns, from 0
    speed_mps: float = math.nan  # relative to the rotating Earth

    @cached_property
    def plant(self) -> StateSpace:
        """Return the linear model from the motion of the actuators to the measurements, without the wind."""
        return self.plant_in_wind(wind=False)

    @abc.abstractmethod
    def plant_in_wind(self, wind: bool = True) -> StateSpace:
        """Return `plant` with the lateral velocity of the air in the plane, m/s, as its last input.

        The inputs before it are, for each drive, the angle of an actuator and those derivatives that engines feel
        (`instruments.DERIVATIVES`). The outputs include `held.OUTPUTS` and the measurements of the further sensors.
        """

    @property
    @abc.abstractmethod
    def axial_load_mps2(self) -> float:
        """Return the axial specific force of the whole vehicle, (thrust - drag) / mass."""

    def held_still(self) -> Self:
        """Return the operating point with the axial load as gravity: the vehicle does not accelerate along its axis."""
        still = dataclasses.replace(self.condition, pitch_rad=0.5 * math.pi, gravity_mps2=self.axial_load_mps2)
        return self if still == self.condition else dataclasses.replace(self, condition=still)

    @property
    @abc.abstractmethod
    def derivatives(self) -> StabilityDerivatives:
        """Return the derivatives of the rigid vehicle with its liquid frozen. Raises ValueError at rest."""

    @property
    @abc.abstractmethod
    def omega_radps(self) -> Array:
        """Return the angular frequencies of the bending modes, (modes,)."""

    @property
    def cut_stations_m(self) -> tuple[float, ...]:
        """Return the stations at which the plant has the bending moment as an output, m aft of the nose."""
        return ()

    @abc.abstractmethod
    def steps(self) -> list[tuple[str, OperatingPoint]]:
        """Return models of the operating point, named by the effect that each has and the one before has not
        (`BUILD_UP`). The last one is the operating point.
        """

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        """Return the actuator of each drive."""
        return self.instruments.actuators

    @property
    def actuator(self) -> Actuator:
        """Return the actuator of the first drive."""
        return self.actuators[0]

    def scheduled(self, over: Over) -> float:
        """Return the quantity over which gains are scheduled, with the flight computer's value at this instant.

        Raises ValueError for an operating point that does not have it.
        """
        if over == "time_s":
            return self.time_s
        if over == "mass_kg" or not math.isfinite(self.speed_mps):
            what = over.partition("_")[0]
            raise ValueError(
                f"operating point at {self.time_s:g} s: it has no {what}, over which the gains are scheduled"
            )
        return self.speed_mps if over == "speed_mps" else 0.5 * self.condition.density_kgpm3 * self.speed_mps**2
