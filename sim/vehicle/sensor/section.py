"""The schema of the rate gyros and the accelerometer of a stage in the vehicle file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from maxq.control.kernel.limits import MAX_LATENCY
from maxq.sim.input.values import Fraction, NotNegative, Positive, Section, Triple, optional


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
