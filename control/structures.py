"""The names that a file may contain: control laws, and structures of the bending filter (Lee, Ahn & Roh eqs 37-41)."""

from __future__ import annotations

from typing import Literal, get_args

Law = Literal["pd", "pid", "load-relief", "incidence-relief", "drift", "pid-drift", "own"]
"""The control laws (control/laws, design/laws). `own` is that of a Python file of the user."""
LAWS: tuple[Law, ...] = get_args(Law)

GAINS: dict[Law, tuple[str, ...]] = {
    "pd": ("k_p", "k_d_s"),
    "pid": ("k_p", "k_d_s", "k_i_ps"),
    "load-relief": ("k_p", "k_d_s", "k_a_s2pm"),
    "incidence-relief": ("k_p", "k_d_s", "k_alpha", "percussion_m", "accel_per_incidence_mps2"),
    "drift": ("k_p", "k_d_s", "k_zd_radspm", "k_z_radpm"),
    "pid-drift": ("k_p", "k_d_s", "k_i_ps", "k_zd_radspm", "k_z_radpm"),
    "own": (),
}
OWN = "own_"
"""The beginning of the columns of a gain table that belong to the law `own`, one for each of its variables."""
GAIN_NAMES = tuple(dict.fromkeys(name for names in GAINS.values() for name in names))
RELIEF: tuple[Law, ...] = ("load-relief", "incidence-relief")
"""The laws that use an accelerometer signal after a lag."""
DRIFT: tuple[Law, ...] = ("drift", "pid-drift")
"""The laws that integrate an accelerometer signal (control/laws/drift.py)."""
INTEGRAL: tuple[Law, ...] = ("pid", "pid-drift")
"""The laws with an integral of the attitude error."""

Over = Literal["time_s", "speed_mps", "mass_kg", "dynamic_pressure_Pa"]
"""The variables of a gain schedule.

`time_s` is the vehicle clock. The others come from navigation, for which the simulator supplies its own values without
error: speed relative to the rotating Earth, mass, and dynamic pressure. The dynamic pressure is computed from this
speed and the air density at this altitude, without wind.
"""
OVER: tuple[Over, ...] = get_args(Over)

Attitude = Literal["quaternion", "rate-integral"]
"""The definitions of the computer's attitude error (control/attitude.py)."""

DesignedStructure = Literal["F2", "F3", "F4", "F5", "F6", "sections"]
"""The structures of filters to be optimised; `sections` has any numbers of sections."""

Structure = Literal["none", DesignedStructure]

STRUCTURES: dict[str, tuple[int, int]] = {
    "none": (0, 0),
    "F2": (1, 0),
    "F3": (1, 1),
    "F4": (2, 0),
    "F5": (2, 1),
    "F6": (2, 2),
}
"""The numbers of quadratic and of first-order sections; `sections` is not listed, because its numbers are free."""

MAX_SECTIONS = 8
"""The largest number of sections per axis in the flight computer, quadratic and first-order together."""


def structure_of(quadratic: int, first_order: int) -> str:
    """Return the name of the structure with these numbers of sections, or `sections` if eqs 37-41 contain none."""
    return next((name for name, known in STRUCTURES.items() if known == (quadratic, first_order)), "sections")
