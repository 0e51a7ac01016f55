"""The sections of a scenario for rail, tower, range safety, navigation errors, and the burns of the last engine."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from maxq.sim.input.errors import refuse
from maxq.sim.input.values import Angle, Latitude, Longitude, NotNegative, Positive, Seconds, Section, Triple, optional


class OrbitTarget(Section):
    """The closed-loop guidance of the last engine to an orbit outside the atmosphere."""

    perigee_altitude_m: float = Field(description="height above the equatorial radius, m")
    apogee_altitude_m: float = Field(description="height above the equatorial radius, m")
    inclination_deg: Annotated[float, Field(ge=0.0, le=180.0)] | None = optional(
        "inclination, deg (default: that of the plane of flight at the start)"
    )
    isp_s: Positive = Field(description="effective specific impulse used by the guidance, s")
    cutoff_at: Literal["perigee", "apogee"] = optional("place of the cutoff", "perigee")
    start_s: Seconds = optional("start on the vehicle clock, s, at least 3 s after ignition; not for a restart", 0.0)
    cycle_s: Positive = optional("time between two solutions, s", 1.0)
    rate_limit_degps: Positive = optional("rate limit of the commanded attitude, deg/s", 3.0)

    def _check(self) -> None:
        if self.perigee_altitude_m < 100e3:
            raise refuse("is in the air", "at least 100e3", "perigee_altitude_m")
        if self.apogee_altitude_m < self.perigee_altitude_m:
            raise refuse("is below the perigee", f"at least {self.perigee_altitude_m:g}", "apogee_altitude_m")


class Cutoff(Section):
    """The cutoff of the last engine when the given quantity reaches its value."""

    earth_speed_mps: Positive | None = optional("speed relative to the Earth, m/s")
    inertial_speed_mps: Positive | None = optional("inertial speed, m/s")
    apogee_altitude_m: float | None = optional("apogee of the Kepler orbit above the equatorial radius, m")

    def _check(self) -> None:
        self.at_most_one("earth_speed_mps", "inertial_speed_mps", "apogee_altitude_m")
        if self.wanted is None:
            raise refuse(
                "names no quantity", "earth_speed_mps, inertial_speed_mps or apogee_altitude_m", ("earth_speed_mps",)
            )

    @property
    def wanted(self) -> tuple[str, float] | None:
        """Return the key and the value of the given quantity, or None if none is given."""
        given = {key: value for key in type(self).model_fields if (value := getattr(self, key)) is not None}
        return next(iter(given.items()), None)


class Restart(Section):
    """A further burn of the last engine after a coast in which thrusters align the vehicle with its level motion."""

    coast_s: Positive | None = optional("time from the preceding cutoff to ignition, s")
    before_apogee_s: NotNegative | None = optional(
        "time from ignition to the next apogee of the Kepler orbit, s; immediate ignition if less remains"
    )
    settling_s: Seconds = optional("duration of settling thrust, which ends at ignition, s", 0.0)
    settling_thrust_N: NotNegative = optional("forward settling thrust of thrusters with their own propellant, N", 0.0)
    orbit: OrbitTarget | None = optional("closed-loop guidance of this burn")
    cutoff: Cutoff | None = optional("instead of orbit: cutoff, with thrust along the level motion")

    def _check(self) -> None:
        self.at_most_one("coast_s", "before_apogee_s")
        self.at_most_one("orbit", "cutoff")
        if self.coast_s is None and self.before_apogee_s is None:
            raise refuse("required key is missing: when it begins", "coast_s or before_apogee_s", ("coast_s",))
        if self.orbit is not None and self.orbit.start_s > 0.0:
            raise refuse("a restart begins after its coast", "without this key", ("orbit", "start_s"))
        if self.coast_s is not None and self.settling_s > self.coast_s:
            raise refuse("is longer than the coast", f"at most coast_s = {self.coast_s:g}", ("settling_s",))


class Rail(Section):
    """A launch rail. Until the last button leaves it, the vehicle moves along the rail with a fixed attitude."""

    length_m: Positive = Field(description="travel until the last button leaves, m")
    elevation_deg: Annotated[float, Field(gt=0.0, le=90.0)] = Field(description="angle above the horizontal, deg")
    azimuth_deg: Angle | None = optional("azimuth, deg from north through east (default: site.azimuth_deg)")


class NavigationSection(Section):
    """The errors of the computer's navigation at the start, for guidance to orbit, cutoffs and attitude control."""

    position_error_m: Triple = optional("north, east, down, m", (0.0, 0.0, 0.0))
    velocity_error_mps: Triple = optional("north, east, down, m/s", (0.0, 0.0, 0.0))
    alignment_error_deg: Triple = optional(
        "rotation error of the computed attitude about body x, y, z, deg; grows with the gyros' errors", (0.0, 0.0, 0.0)
    )


class RangeSafety(Section):
    """The flight line and the permitted zone, for the metrics of the instantaneous impact point in vacuum."""

    azimuth_deg: Angle | None = optional(
        "azimuth of the flight line at the site, deg from north through east (default: site.azimuth_deg)"
    )
    zone: Annotated[tuple[tuple[Latitude, Longitude], ...], Field(min_length=3)] | None = optional(
        "corners [latitude, longitude] of the permitted zone in order, deg; edges: great circles; at most a hemisphere"
    )

    def _check(self) -> None:
        if self.zone is not None and len(set(self.zone)) < len(self.zone):
            raise refuse("names a corner twice", "different corners; the last edge closes the ring", "zone")


class Tower(Section):
    """A vertical cylinder next to the pad, with its base at the height of the nozzle exits on the pad."""

    distance_m: Positive = Field(description="distance between the axes of vehicle and tower, m")
    azimuth_deg: Angle = Field(description="direction to the tower, deg from north through east")
    height_m: Positive = Field(description="height above the nozzle exits on the pad, m")
    radius_m: NotNegative = optional("radius, m", 0.0)
    vehicle_radius_m: Positive | None = optional(
        "radius of the cylinder around vehicle, fins and nozzles, m (default: half of reference.diameter_m)"
    )

    def vehicle_radius(self, diameter_m: float) -> float:
        """Return the radius of the cylinder around a vehicle with the reference diameter `diameter_m`, m."""
        return 0.5 * diameter_m if self.vehicle_radius_m is None else self.vehicle_radius_m
