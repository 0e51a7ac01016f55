"""The channels of a flight under the names and in the units of the NESC check cases (English units, degrees)."""

from __future__ import annotations

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.run.flight import Flight

FOOT_m = 0.3048
POUND_N = 0.45359237 * 9.80665
SLUG_kg = POUND_N / FOOT_m
RANKINE_K = 5.0 / 9.0
KNOT_mps = 1852.0 / 3600.0

_CHANNELS: dict[str, tuple[str, float]] = {
    "altitudeMsl_ft": ("altitude_m", FOOT_m),
    "longitude_deg": ("longitude_deg", 1.0),
    "latitude_deg": ("latitude_deg", 1.0),
    "eulerAngle_deg_Yaw": ("yaw_deg", 1.0),
    "eulerAngle_deg_Pitch": ("pitch_deg", 1.0),
    "eulerAngle_deg_Roll": ("roll_deg", 1.0),
    "speedOfSound_ft_s": ("sound_speed_mps", FOOT_m),
    "airDensity_slug_ft3": ("density_kgpm3", SLUG_kg / FOOT_m**3),
    "ambientPressure_lbf_ft2": ("pressure_Pa", POUND_N / FOOT_m**2),
    "ambientTemperature_dgR": ("temperature_K", RANKINE_K),
    "mach": ("mach", 1.0),
    "dynamicPressure_lbf_ft2": ("dynamic_pressure_Pa", POUND_N / FOOT_m**2),
    "trueAirspeed_nmi_h": ("airspeed_mps", KNOT_mps),
}
for _axis, _ned, _letter, _turn in zip("XYZ", ("north", "east", "down"), "LMN", ("Roll", "Pitch", "Yaw"), strict=True):
    _low = _axis.lower()
    _CHANNELS |= {
        f"feVelocity_ft_s_{_axis}": (f"v_N_{_ned}_mps", FOOT_m),
        f"eiPosition_ft_{_axis}": (f"r_I_{_low}_m", FOOT_m),
        f"gePosition_ft_{_axis}": (f"r_E_{_low}_m", FOOT_m),
        f"bodyAngularRateWrtEi_deg_s_{_turn}": (f"w_BI_B_{_low}_radps", np.pi / 180.0),
        f"aero_bodyForce_lbf_{_axis}": (f"aero_force_B_{_low}_N", POUND_N),
        f"aero_bodyMoment_ftlbf_{_letter}": (f"aero_moment_B_{_low}_Nm", POUND_N * FOOT_m),
    }


def in_nesc_units(flight: Flight, variable: str) -> Array:
    """Return a variable of the NESC time histories from the channels of a flight. Raises KeyError for an unknown
    variable.
    """
    if variable == "localGravity_ft_s2":
        return _downward_gravitation_mps2(flight) / FOOT_m
    channel, unit = _CHANNELS[variable]
    return np.asarray(flight[channel] / unit)


def _downward_gravitation_mps2(flight: Flight) -> Array:
    """Return the downward component of the gravitation along the geodetic normal, without the centrifugal part."""
    latitude = np.radians(flight["latitude_deg"])
    # azimuth of the meridian in I: altitude and latitude do not depend on the Earth's rotation
    azimuth = np.arctan2(flight["r_I_y_m"], flight["r_I_x_m"])
    up = (np.cos(latitude) * np.cos(azimuth), np.cos(latitude) * np.sin(azimuth), np.sin(latitude))
    pull = [flight[f"gravitation_I_{axis}_mps2"] for axis in "xyz"]
    return np.asarray(-sum(u * g for u, g in zip(up, pull, strict=True)))
