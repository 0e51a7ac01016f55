"""Initial state, in any of the frames."""

from __future__ import annotations

import numpy as np
from pydantic import Field, model_validator

from maxq.sim.scenario.errors import refuse
from maxq.sim.scenario.schema_values import (
    Latitude,
    Longitude,
    Matrix,
    Quaternion,
    Section,
    Triple,
    at_most_one,
    optional,
)

_ORTHONORMAL = 1e-6
POSITIONS = ("geodetic", "inertial_m", "earth_m")
VELOCITIES = ("ned_mps", "inertial_mps", "earth_mps")
ATTITUDES = ("euler_deg", "q_BI", "dcm_BI")
RATES = ("rate_BI_degps", "rate_BI_radps", "rate_BE_degps")


class Geodetic(Section):
    """A place on the Earth."""

    latitude_deg: Latitude = Field(description="geodetic latitude, deg")
    longitude_deg: Longitude = Field(description="longitude, deg")
    altitude_m: float = Field(description="height above the ellipsoid, m")


class Initial(Section):
    """State at the start. Of each of position, velocity, attitude and rates at most one key is given."""

    held: bool = optional("whether the vehicle is held down until release", False)
    geodetic: Geodetic | None = optional("position (default: the site)")
    inertial_m: Triple | None = optional("position in I, m")
    earth_m: Triple | None = optional("position in E, m")
    ned_mps: Triple | None = optional("velocity relative to the Earth, north, east, down, m/s (default 0)")
    inertial_mps: Triple | None = optional("inertial velocity in I, m/s")
    earth_mps: Triple | None = optional("velocity relative to the Earth in E, m/s")
    euler_deg: Triple | None = optional(
        "yaw, pitch, roll (3-2-1) of B from north, east, down, deg (default: nose up, body z at azimuth)"
    )
    q_BI: Quaternion | None = optional("unit quaternion, scalar first, turns B components into I")
    dcm_BI: Matrix | None = optional("direction cosines, turns I components into B")
    rate_BI_degps: Triple | None = optional("inertial rates p, q, r in B, deg/s")
    rate_BI_radps: Triple | None = optional("inertial rates p, q, r in B, rad/s")
    rate_BE_degps: Triple | None = optional("rates relative to the Earth in B, deg/s (default 0)")

    @model_validator(mode="after")
    def _check(self) -> Initial:
        for keys in (POSITIONS, VELOCITIES, ATTITUDES, RATES):
            at_most_one(self, keys)
        if self.q_BI is not None and abs(float(np.linalg.norm(self.q_BI)) - 1.0) > _ORTHONORMAL:
            norm = float(np.linalg.norm(self.q_BI))
            raise refuse("is not a unit quaternion", f"norm 1 within 1e-6, not {norm:.9g}", key=("q_BI",))
        if self.dcm_BI is not None:
            dcm = np.array(self.dcm_BI)
            if np.abs(dcm @ dcm.T - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(dcm) < 0.0:
                raise refuse(
                    "is not a rotation matrix", "orthonormal rows within 1e-6, determinant +1", key=("dcm_BI",)
                )
        return self
