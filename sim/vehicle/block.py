"""State blocks: how a component declares what is integrated of it.

A component's module declares its states as a `StateBlock` and has kernels for their derivatives and initial values,
which get the index of the first state as an argument. `state.py` holds the list of blocks and composes from it the
state vector, its size, initial values, names and the bounds beyond which a flight counts as diverged. The log rows that
show the states are declared in the same module (control/kernel/rows.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from maxq.control.kernel.jit import integer, kernel
from maxq.control.kernel.limits import MAX_ENGINES, MAX_MODES, MAX_PENDULUMS, MAX_SENSORS, MAX_SURFACES, MAX_TVC_LOADS


@dataclass(frozen=True)
class Sizes:
    """The numbers of flexible, sloshing and moving parts of a stage, which determine every index of the state."""

    pitch_modes: int
    yaw_modes: int
    pendulums: int  # slosh modes of all tanks
    surfaces: int  # places at which the air acts on the bent body: lifting surfaces, then tables of coefficients
    tables: int = 0  # of these, tables of coefficients over angle of attack
    spatial_modes: int = 0
    further_groups: int = 0  # of engines that move together, beyond the first
    engines: int = 1  # alike engines of a group count once (engine/kernel.py); 1 without one
    gimbals: int = 1  # stations of gimbals, at which the engines meet the mode shapes, and behind them of sensors
    thrust_curves: int = 1  # columns of the schedule
    tvc_loads: int = 0  # engines on the compliance of their mount
    sensors: int = 0  # rate gyros beyond the first, and an accelerometer
    mode_groups: int = field(init=False)  # how many times four modes a plane has, rounded up

    def __post_init__(self) -> None:
        object.__setattr__(self, "mode_groups", (max(self.pitch_modes, self.yaw_modes) + 3) // 4)


LARGEST = Sizes(
    MAX_MODES,
    MAX_MODES,
    MAX_PENDULUMS,
    MAX_SURFACES + 1,
    MAX_SURFACES,
    MAX_MODES,
    MAX_ENGINES - 1,
    MAX_ENGINES,
    MAX_ENGINES + MAX_SENSORS,
    MAX_ENGINES,
    MAX_TVC_LOADS,
    MAX_SENSORS,
)


class Counts(NamedTuple):
    """Sizes as plain numbers: those of a record are read again after every write to an array.

    In a kernel compiled for one vehicle (`records.with_constants`) they are constants, which takes the arithmetic of
    indices and the ends of loops out of it: measured, a seventh of a flight's time.
    """

    pitch_modes: int
    yaw_modes: int
    pendulums: int
    surfaces: int
    tables: int
    spatial_modes: int
    further_groups: int
    engines: int
    gimbals: int
    thrust_curves: int
    tvc_loads: int
    sensors: int
    mode_groups: int


@kernel
def counts(sizes: Sizes) -> Counts:
    return Counts(
        integer(sizes, "pitch_modes"),
        integer(sizes, "yaw_modes"),
        integer(sizes, "pendulums"),
        integer(sizes, "surfaces"),
        integer(sizes, "tables"),
        integer(sizes, "spatial_modes"),
        integer(sizes, "further_groups"),
        integer(sizes, "engines"),
        integer(sizes, "gimbals"),
        integer(sizes, "thrust_curves"),
        integer(sizes, "tvc_loads"),
        integer(sizes, "sensors"),
        integer(sizes, "mode_groups"),
    )


@kernel
def are_usual(sizes: Counts) -> bool:
    """Return True for at most four modes in a plane, and none of the parts that few vehicles have."""
    none = sizes.tables + sizes.spatial_modes + sizes.further_groups + sizes.tvc_loads + sizes.sensors == 0
    return none and sizes.mode_groups < 2 and sizes.engines * sizes.gimbals * sizes.thrust_curves == 1


@kernel
def usual_counts(sizes: Counts) -> Counts:
    """Return counts that `are_usual` of a vehicle with modes, as constants where these are all equal.

    Code that is inlined for them holds no loop over groups of modes, and nothing of parts that few vehicles have:
    measured, a quarter of a flight's time.
    """
    return Counts(sizes.pitch_modes, sizes.yaw_modes, sizes.pendulums, sizes.surfaces, 0, 0, 0, 1, 1, 1, 0, 0, 1)


@kernel
def rigid_counts(sizes: Counts) -> Counts:
    """Return counts that `are_usual` of a vehicle without modes, as constants where these are all equal."""
    return Counts(0, 0, sizes.pendulums, sizes.surfaces, 0, 0, 0, 1, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class StateBlock:
    """States of one kind of part, all states of the first part, then those of the next.

    `states`: name and unit of the states of a part, `{}` in a name standing for the part. `parts`: names of the parts,
    or the field of `Sizes` that counts them. `bound`: the flight has diverged, for the cause `excess`, when the sum of
    the magnitudes of a part's states exceeds it.
    """

    states: Mapping[str, str]
    parts: tuple[str, ...] | str = ("",)
    bound: float = math.inf
    excess: str = ""

    @property
    def counted_by(self) -> str:
        """The field of `Sizes` that counts the parts, or "" for a fixed number of them."""
        return self.parts if isinstance(self.parts, str) else ""

    @property
    def fixed_parts(self) -> int:
        return 0 if isinstance(self.parts, str) else len(self.parts)

    def names(self, sizes: Sizes) -> Iterator[str]:
        """Names of the states in their order; counted parts are numbered from 1."""
        parts = range(1, int(getattr(sizes, self.parts)) + 1) if isinstance(self.parts, str) else self.parts
        return (name.format(part) for part in parts for name in self.states)


# The rigid body's states come first, for every vehicle.
R_I = 0  # position of the core CG in I, m
V_I = 3  # its velocity in I, m/s
Q_BI = 6  # attitude quaternion, scalar first: v_I = q v_B q*
W_BI_B = 10  # angular velocity of B relative to I, in B, rad/s

_FAR = "the position is more than 1e9 m away or the speed above 1e5 m/s"
POSITION = StateBlock({f"r_I_{axis}_m": "m" for axis in "xyz"}, bound=1e9, excess=_FAR)
VELOCITY = StateBlock({f"v_I_{axis}_mps": "m/s" for axis in "xyz"}, bound=1e5, excess=_FAR)
ATTITUDE = StateBlock({f"q_BI_{component}": "1" for component in "wxyz"})
ANGULAR_VELOCITY = StateBlock(
    {f"w_BI_B_{axis}_radps": "rad/s" for axis in "xyz"}, bound=1000.0, excess="the vehicle turns faster than 1000 rad/s"
)
