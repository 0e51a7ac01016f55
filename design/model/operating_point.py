"""The interface of an operating point: all quantities on which a linear loop depends at one instant, in one plane.

| class | plant |
|---|---|
| `node.Node` | a vehicle of maxq at an instant of its flight: the Jacobian of the simulator's derivative |
| `paper.nodes.PaperNode` | the same vehicle with the published planar equations |
| `given.GivenPoint` | published derivatives over time, or the matrices A, B, C, D, without vehicle and flight |

A loop (design/loop) uses only this interface.
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
"""The steps of the vehicle's build-up."""


@dataclass(frozen=True, kw_only=True)
class OperatingPoint(abc.ABC):
    """The air, the instruments and the plant of one plane at a vehicle time."""

    time_s: float
    condition: FlightCondition
    instruments: Instruments
    plane: Plane = "pitch"
    label: str = ""
    stage: int = 0  # index of the burning stage, from 0
    speed_mps: float = math.nan  # relative to the rotating Earth

    @cached_property
    def plant(self) -> StateSpace:
        """Return the linear model from actuator motion to measurements, without wind."""
        return self.plant_in_wind(wind=False)

    @abc.abstractmethod
    def plant_in_wind(self, wind: bool = True) -> StateSpace:
        """Return the plant, by default with the lateral velocity of the air in the plane, m/s, as its last input.

        The other inputs are, for each drive, the actuator angle and the derivatives of it that act on engines
        (`instruments.DERIVATIVES`). The outputs include `held.OUTPUTS` and the measurements of further sensors.
        """

    @property
    @abc.abstractmethod
    def axial_load_mps2(self) -> float:
        """Return the axial specific force of the whole vehicle, (thrust - drag) / mass."""

    def held_still(self) -> Self:
        """Return the operating point with the axial load as gravity, so that the vehicle has no axial acceleration."""
        still = dataclasses.replace(self.condition, pitch_rad=0.5 * math.pi, gravity_mps2=self.axial_load_mps2)
        return self if still == self.condition else dataclasses.replace(self, condition=still)

    @property
    @abc.abstractmethod
    def derivatives(self) -> StabilityDerivatives:
        """Return the derivatives of the rigid vehicle with frozen liquid. Raises ValueError for zero airspeed."""

    @property
    @abc.abstractmethod
    def omega_radps(self) -> Array:
        """Return the angular frequencies of the bending modes, (modes,)."""

    @property
    def cut_stations_m(self) -> tuple[float, ...]:
        """Return the stations at which the plant has a bending moment as an output, m aft of the nose."""
        return ()

    @abc.abstractmethod
    def steps(self) -> list[tuple[str, OperatingPoint]]:
        """Return models of the operating point with an increasing number of effects, each named by its added effect.

        The names are those of `BUILD_UP`. The last model is the operating point itself.
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
        """Return the flight computer's value of a scheduling quantity at this instant.

        Raises ValueError for an operating point that does not have this quantity.
        """
        if over == "time_s":
            return self.time_s
        if over == "mass_kg" or not math.isfinite(self.speed_mps):
            what = over.partition("_")[0]
            raise ValueError(
                f"operating point at {self.time_s:g} s: it has no {what}, over which the gains are scheduled"
            )
        return self.speed_mps if over == "speed_mps" else 0.5 * self.condition.density_kgpm3 * self.speed_mps**2
