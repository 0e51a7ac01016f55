"""The schema of the sensors in the vehicle file: rate gyros and accelerometer of a stage, sensors for navigation."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from maxq.control.kernel.limits import MAX_LATENCY
from maxq.sim.input.errors import refuse
from maxq.sim.input.values import Fraction, NotNegative, Period, Positive, Seconds, Section, Triple, optional


class GyroSection(Section):
    """The rate gyros, one per axis (Lee, Ahn & Roh eq. 29)."""

    station_m: float = Field(description="station, m aft of the nose")
    omega_hz: Positive = Field(description="natural frequency, Hz")
    zeta: Positive = Field(description="damping ratio")
    bias_degph: Triple = optional("constant error about x, y, z, deg/h", (0.0, 0.0, 0.0))
    scale_factor: Triple = optional("relative error of the scale about x, y, z", (0.0, 0.0, 0.0))
    misalignment_deg: Triple = optional("small rotation about x, y, z, deg", (0.0, 0.0, 0.0))
    noise_deg_rt_h: NotNegative = optional("angle random walk, deg per root hour", 0.0)


Latency = Annotated[int, Field(ge=0, le=MAX_LATENCY)]


class RateGyro(GyroSection):
    """An additional three-axis rate gyro; `blend` of the design gives its weight in the rate of the law."""

    latency_samples: Latency = optional("delay of the output, samples of the computer", 0)
    dropout: Fraction = optional("probability that a sample is lost; the computer then holds the last one", 0.0)


class Accelerometer(Section):
    """A three-axis accelerometer: specific force at its station, with the effects of bending, engine and liquid."""

    station_m: float = Field(description="station, m aft of the nose, on the body axis")
    omega_hz: Positive = Field(description="natural frequency, Hz")
    zeta: Positive = Field(description="damping ratio")
    count_mps: NotNegative = optional("velocity per pulse, m/s; 0: no quantisation", 0.0)
    bias_mps2: Triple = optional("constant error along x, y, z, m/s2", (0.0, 0.0, 0.0))
    scale_factor: Triple = optional("relative error of the scale along x, y, z", (0.0, 0.0, 0.0))
    misalignment_deg: Triple = optional("small rotation about x, y, z, deg", (0.0, 0.0, 0.0))
    noise_mps_rt_h: NotNegative = optional("velocity random walk, m/s per root hour", 0.0)
    latency_samples: Latency = optional("delay of the output, samples of the computer", 0)
    dropout: Fraction = optional("probability that a sample is lost; the computer then holds the last one", 0.0)


Sigmas = tuple[NotNegative, NotNegative, NotNegative]


class GnssSection(Section):
    """The GNSS receiver, for flight code: position and velocity of its antenna, Earth-fixed."""

    station_m: float = Field(description="station of the antenna, m aft of the nose")
    offset_m: tuple[float, float] = optional("y and z of the antenna from the body axis, m", (0.0, 0.0))
    period_s: Period = optional("time between solutions, s, whole ns", 0.1)
    latency_s: Seconds = optional("delay of a solution, s, at most period_s", 0.0)
    position_noise_m: Sigmas = optional("standard deviation, m", (0.0, 0.0, 0.0))
    velocity_noise_mps: Sigmas = optional("standard deviation, m/s", (0.0, 0.0, 0.0))
    correlation_s: NotNegative = optional("correlation time of both errors, s; 0: white", 0.0)
    position_bias_m: Triple = optional("north, east, down, m", (0.0, 0.0, 0.0))

    def _check(self) -> None:
        if self.latency_s > self.period_s:
            raise refuse("is longer than the period", f"0 .. period_s = {self.period_s:g}", ("latency_s",))


class BarometerSection(Section):
    """The barometer, for flight code: static air pressure at the altitude of the vehicle."""

    bias_Pa: float = optional("constant error, Pa", 0.0)
    scale_factor: float = optional("relative error of the scale", 0.0)
    noise_Pa: NotNegative = optional("standard deviation of a sample, Pa", 0.0)


class MagnetometerSection(Section):
    """The three-axis magnetometer, for flight code: field of the Earth's dipole in body axes."""

    bias_nT: Triple = optional("x, y, z, nT", (0.0, 0.0, 0.0))
    misalignment_deg: Triple = optional("small rotation about x, y, z, deg", (0.0, 0.0, 0.0))
    noise_nT: NotNegative = optional("standard deviation of a sample, nT", 0.0)
