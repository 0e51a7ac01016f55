"""The launch azimuth for an orbit of a given inclination."""

from __future__ import annotations

import math

from maxq.sim.world import earth


def launch_azimuth_deg(
    latitude_deg: float, inclination_deg: float, perigee_m: float, apogee_m: float, *, southwards: bool = False
) -> float:
    """Return the launch azimuth on the rotating Earth, deg clockwise from north, for an orbit of given inclination.

    `perigee_m` and `apogee_m` are radii from the centre of the Earth. The azimuth is that of the velocity at perigee in
    the orbital plane, sin(azimuth) = cos i / cos(latitude), minus the velocity of the ground. The Earth is a sphere,
    with the geocentric latitude of the site. Source: Skopinski & Johnson, NASA TN D-233 (1960).

    Raises ValueError if no plane through the site has this inclination.
    """
    latitude_rad = earth.geocentric_rad(latitude_deg)
    cos_latitude = math.cos(latitude_rad)
    sine = math.cos(math.radians(inclination_deg)) / cos_latitude
    if abs(sine) > 1.0:
        least = abs(math.degrees(latitude_rad))
        raise ValueError(f"{least:.4g} to {180.0 - least:.4g}, from the site's geocentric latitude")
    speed = math.sqrt(earth.WGS84_MU_m3ps2 * (2.0 / perigee_m - 2.0 / (perigee_m + apogee_m)))
    east = speed * sine - earth.WGS84_RATE_radps * perigee_m * cos_latitude
    north = speed * math.sqrt(1.0 - sine * sine) * (-1.0 if southwards else 1.0)
    return math.degrees(math.atan2(east, north))
