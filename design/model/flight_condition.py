"""The point of a flight at which the vehicle is linearised."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FlightCondition:
    """Air and path at an instant; the vehicle flies along its own axis (no incidence, no rotation)."""

    time_s: float  # vehicle clock
    airspeed_mps: float
    density_kgpm3: float
    pressure_Pa: float  # ambient
    mach: float
    pitch_rad: float  # of the body axis above the horizon
    gravity_mps2: float

    @property
    def dynamic_pressure_Pa(self) -> float:
        return 0.5 * self.density_kgpm3 * self.airspeed_mps**2
