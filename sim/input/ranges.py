"""The range of a number by the name of its key or column: one table for all files.

Names carry their units. Hence a physical bound belongs to a unit, or to a whole name if that is more specific. No
vehicle, flight or flight computer has values outside a range, and some such values overflow the arithmetic of a flight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

LONGEST_S = 1.0e8
"""The longest time, about three years.

The times of eight stages sum to less than the 292 years that 64 bits of ns can represent.
"""

LARGEST_NUMBER = 1e30
"""The bound of names without a range: products of a few such numbers are finite."""

MOST_RUNS, MOST_TOGETHER = 10**9, 10**6


@dataclass(frozen=True)
class Range:
    """The magnitudes from `least` to `most`, of either sign, and zero; a key may allow less.

    `names`: whole names, or ends of names with their unit ("_kg"). `why`: reason for the bound, used in messages.
    """

    names: tuple[str, ...]
    least: float
    most: float
    why: str

    def holds(self, value: ArrayLike) -> NDArray[np.bool_]:
        """Return True for each number within the range; nan is outside."""
        size = np.abs(value)
        return np.asarray((size <= self.most) & ((size >= self.least) | (size == 0.0)))

    def allowed(self) -> str:
        """Return the range in words."""
        most = f"{self.most:g}" if abs(self.most) < 2**53 else f"2^{math.ceil(math.log2(self.most))} - 1"
        return (f"magnitudes {self.least:g} .. {most}" if self.least else f"magnitudes up to {most}") + f" ({self.why})"


# fmt: off
RANGES = (
    Range(("time_s",), 0.0, 1e7, "115 days of flight"),
    Range(("nodes_s", "times_s"), 0.0, 1e5, "instants of an ascent, s"),
    Range(("sample_s", "step_s"), 1e-6, 10.0, "periods of computers and integrators, s"),
    Range(("k_d_s", "k_rate_s", "minimum_on_s"), 0.0, 1e4, "time constants of control, s"),
    Range(("k_i_ps",), 0.0, 1e4, "integral gains of control, 1/s"),
    Range(("_s",), 0.0, LONGEST_S, "three years of flight, s"),
    Range(("_ms",), 0.0, 1e5, "delays of a loop, ms"),
    Range(("inertial_m", "earth_m", "altitude_m", "orbit_altitude_m", "jettison_altitude_m", "perigee_altitude_m",
           "apogee_altitude_m"), 0.0, 1e9, "beyond the Moon, m"),
    Range(("_radius_m",), 1.0, 1e9, "figures of planets, m"),
    Range(("length_u_m", "length_v_m", "length_w_m", "correlation_length_m", "thickness_m", "edge_m"), 1e-3, 1e7,
          "scales of wind and turbulence, m"),
    Range(("length_m", "diameter_m", "chord_m", "span_m", "yaw_chord_m", "pendulum_length_m", "pendulum_length_2_m",
           "radius_m", "port_radius_m", "vehicle_radius_m"), 1e-4, 1e3,
          "sizes of vehicles and tanks, m"),
    Range(("position_error_m", "position_bias_m", "position_noise_m"), 0.0, 1e6, "errors of navigation, m"),
    Range(("_m",), 0.0, 1e3, "stations and distances on a vehicle, m"),
    Range(("_m2",), 1e-8, 1e6, "areas of vehicles and nozzles, m2"),
    Range(("mass_kg", "generalized_mass_kg"), 1e-6, 1e8, "the heaviest rockets have 5e6 kg"),
    Range(("_kg",), 0.0, 1e8, "the heaviest rockets have 5e6 kg"),
    Range(("Ixx_kgm2", "Iyy_kgm2", "Izz_kgm2"), 1e-12, 1e12, "a body of 5e6 kg and 120 m has 6e9 kg m2"),
    Range(("_kgm2",), 0.0, 1e12, "a body of 5e6 kg and 120 m has 6e9 kg m2"),
    Range(("_kgps",), 0.0, 1e6, "the largest first stages burn 2e4 kg/s"),
    Range(("_N",), 0.0, 1e9, "the largest first stages have 7e7 N"),
    Range(("_Nm", "value"), 0.0, 1e11, "the largest thrust at 100 m"),
    Range(("_Nms",), 0.0, 1e12, "damping, N m s"),
    Range(("_Ns", "_J"), 0.0, 1e9, "springs and impulses between stages"),
    Range(("dead_band_deg", "angle_error_limit_deg", "command_limit_deg", "angle_limit_deg", "integral_limit_deg"),
          1e-6, 360.0,
          "limits of control, deg"),
    Range(("_deg",), 0.0, 360.0, "a turn, deg"),
    Range(("_degps",), 0.0, 1e5, "spinning shells have 1e5 deg/s"),
    Range(("_radps",), 0.0, 2e3, "spinning shells have 2e3 rad/s"),
    Range(("_degph",), 0.0, 1e7, "errors of gyros, deg/h"),
    Range(("_rt_h",), 0.0, 1e5, "noise of gyros, deg per root hour"),
    Range(("count_mps",), 1e-9, 1e3, "one pulse of a converter: smaller ones overflow its counters, m/s"),
    Range(("k_a_s2pm",), 0.0, 1e4, "gains of an acceleration, rad per m/s2"),
    Range(("percussion_m",), -1e3, 1e3, "levers along a vehicle, m"),
    Range(("accel_per_incidence_mps2",), -1e5, 1e5, "lateral forces of the air over mass, m/s2 per rad"),
    Range(("count_rad",), 1e-9, 7.0, "one pulse of a converter: smaller ones overflow its counters, rad"),
    Range(("ned_mps", "inertial_mps", "earth_mps", "inertial_speed_mps", "earth_speed_mps"), 0.0, 1e5,
          "nine times escape velocity, m/s"),
    Range(("V_mps",), 0.0, 1e5, "nine times escape velocity, m/s"),
    Range(("_mps",), 0.0, 1e3, "winds up to those of the thermosphere, m/s"),
    Range(("_mps2",), 0.0, 1e3, "gravity of planets, m/s2"),
    Range(("_m3ps2",), 1.0, 1e21, "the Sun has 1.3e20 m3/s2"),
    Range(("density_m3ps2",), 1e-12, 1e9, "spectra of winds, (m/s)2 per cycle/m"),
    Range(("wave_number_pm",), 1e-6, 10.0, "waves of 10 cm to 1000 km, cycles/m"),
    Range(("j2",), 0.0, 1.0, "planets have up to 0.016"),
    Range(("_K",), 1.0, 1e5, "atmospheres, K"),
    Range(("_1pK",), 0.0, 1.0, "temperature sensitivities of solid motors, 1/K"),
    Range(("_kgpm3",), 0.0, 1e5, "atmospheres and liquids, kg/m3"),
    Range(("_m2ps",), 1e-10, 1e2, "kinematic viscosities of liquids, m2/s"),
    Range(("modulus_Pa",), 1e6, 1e13, "stiffness of materials, Pa"),
    Range(("_Pa",), 0.0, 1e9, "atmospheres, Pa"),
    Range(("_hz",), 1e-6, 1e6, "frequencies of loops, structures and logs, Hz"),
    Range(("zero_zeta",), 0.0, 1e3, "damping ratios"),
    Range(("zeta", "_zeta"), 1e-6, 1e3, "damping ratios"),
    Range(("_db",), 0.0, 1e3, "decibels"),
    Range(("k_p",), 0.0, 1e4, "gains of control, rad/rad"),
    Range(("mach",), 0.0, 1e3, "Mach numbers"),
    Range(("CA", "CA_coast", "CD", "CX", "CY", "CZ", "CN", "CL", "Cl", "Cm", "Cn", "Cm0", "C_crossflow"), 0.0, 1e4,
          "coefficients referred to a vehicle's reference area"),
    Range(("_pr",), 0.0, 1e5, "slopes of such coefficients, 1/rad"),
    Range(("Cmq", "Cnr", "Clp", "Clr", "Cnp", "CYp", "CYr", "CNq"), 0.0, 1e7, "rate derivatives of slender vehicles"),
    Range(("phi", "phi_x", "phi_y", "phi_z"), 0.0, 1e6, "mode shapes"),
    Range(("_pm",), 0.0, 1e6, "slopes of mode shapes, 1/m"),
    Range(("mass_flow_factor",), 0.01, 100.0, "burn rates relative to the nominal one"),
    Range(("length_factor", "frequency_factor"), 1e-3, 1e3, "factors on nominal values"),
    Range(("factor", "_factor"), 0.0, 1e3, "factors on nominal values"),
    Range(("throttle",), 0.0, 1.5, "share of the table's thrust; engines reach 1.1"),
    Range(("share", "exponent"), 0.0, 10.0, "shares of a whole"),
    Range(("corner_sigmas",), 0.0, 100.0, "standard deviations"),
    Range(("seed",), 0, 2**63 - 1, "64 bits"),
    Range(("runs",), 0, MOST_RUNS, "flights"),
    Range(("stratum", "batch"), 0, MOST_TOGETHER, "flights whose draws share the memory"),
)
# fmt: on
_ANY = Range((), 0.0, LARGEST_NUMBER, "what the arithmetic of a flight can hold")


@cache
def range_of(name: str) -> Range:
    """Return the range of a key or column of this name, or of its unit if the name is not in the table."""
    ends = [r for r in RANGES if any(end[0] == "_" and name.endswith(end) for end in r.names)]
    whole = [r for r in RANGES if name in r.names]
    longest = max(ends, key=lambda r: max(len(end) for end in r.names if name.endswith(end)), default=_ANY)
    return whole[0] if whole else longest


def first_beyond(name: str, value: Any) -> tuple[tuple[int, ...], float] | None:
    """Return index path and value of the first number outside the range of `name`, or None.

    `value` may be a number or nested tuples.
    """
    if isinstance(value, tuple):
        for n, item in enumerate(value):
            if found := first_beyond(name, item):
                return (n, *found[0]), found[1]
    elif type(value) in (float, int):
        of = range_of(name)
        if not of.least <= abs(value) <= of.most and value != 0:
            return (), value
    return None
