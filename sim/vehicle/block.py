"""State blocks: the declaration of a component's integrated states.

The module of a component declares its states as a `StateBlock` and contains the kernels of their derivatives and
initial values, whose argument is the index of the first state. `state.py` contains the list of blocks, from which the
state vector, its size, initial values, names and divergence limits follow. The log rows of the states are declared in
the module of the component (control/kernel/rows.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from maxq.control.kernel.jit import integer, kernel
from maxq.control.kernel.limits import (
    MAX_BUFFETS,
    MAX_ENGINES,
    MAX_FEED_LINES,
    MAX_MODES,
    MAX_PENDULUMS,
    MAX_SENSORS,
    MAX_SURFACES,
    MAX_TVC_LOADS,
)


@dataclass(frozen=True)
class Sizes:
    """The numbers of flexible, sloshing and moving parts of a stage, which determine all indices of the state."""

    pitch_modes: int
    yaw_modes: int
    pendulums: int  # slosh modes of all tanks
    # places at which aerodynamic loads act on the bent body: lifting surfaces, then tables of coefficients
    surfaces: int
    tables: int = 0  # number of these surfaces that are tables over angle of attack
    spatial_modes: int = 0
    further_groups: int = 0  # groups of engines that move together, after the first group
    engines: int = 1  # equal engines of a group are combined (engine/kernel.py); 1 without an engine
    gimbals: int = 1  # stations of gimbals, feed lines, buffet, then sensors, at which mode shapes are evaluated
    thrust_curves: int = 1  # columns of the schedule
    tvc_loads: int = 0  # engines with a compliant mount
    sensors: int = 0  # rate gyros after the first, and accelerometers
    buffets: int = 0  # stations of buffet
    feed_lines: int = 0
    air_lags: int = 0  # 1: the air lags behind the first modes
    mode_groups: int = field(init=False)  # number of groups of four modes in a plane, rounded up

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
    MAX_ENGINES + MAX_FEED_LINES + MAX_BUFFETS + MAX_SENSORS,
    MAX_ENGINES,
    MAX_TVC_LOADS,
    MAX_SENSORS,
    MAX_BUFFETS,
    MAX_FEED_LINES,
    1,
)


class Counts(NamedTuple):
    """Sizes as plain numbers, because compiled code reads those of a record again after every write to an array.

    In a kernel compiled for one vehicle (`records.with_constants`) they are constants, so that index arithmetic and
    loop ends are known at compile time. Measured saving: a seventh of a flight's time.
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
    buffets: int
    feed_lines: int
    air_lags: int
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
        integer(sizes, "buffets"),
        integer(sizes, "feed_lines"),
        integer(sizes, "air_lags"),
        integer(sizes, "mode_groups"),
    )


@kernel
def are_usual(sizes: Counts) -> bool:
    """Return True for at most four modes per plane, and none of the parts that few vehicles have."""
    none = sizes.tables + sizes.spatial_modes + sizes.further_groups + sizes.tvc_loads + sizes.sensors == 0
    none = none and sizes.buffets + sizes.feed_lines + sizes.air_lags == 0
    return none and sizes.mode_groups < 2 and sizes.engines * sizes.gimbals * sizes.thrust_curves == 1


@kernel
def usual_counts(sizes: Counts) -> Counts:
    """Return the usual counts of a vehicle with modes, as constants where all such vehicles have the same value.

    `sizes` must satisfy `are_usual`. Code inlined for these counts contains no loop over groups of modes, and none of
    the parts that few vehicles have. Measured saving: a quarter of a flight's time.
    """
    return Counts(
        sizes.pitch_modes, sizes.yaw_modes, sizes.pendulums, sizes.surfaces, 0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 0, 1
    )


@kernel
def rigid_counts(sizes: Counts) -> Counts:
    """Return the usual counts of a vehicle without modes, as constants where all such vehicles have the same value."""
    return Counts(0, 0, sizes.pendulums, sizes.surfaces, 0, 0, 0, 1, 1, 1, 0, 0, 0, 0, 0, 0)


@dataclass(frozen=True)
class StateBlock:
    """The states of one kind of part: all states of the first part, then those of the next.

    - `states`: name and unit of each state of a part, where `{}` in a name stands for the part.
    - `parts`: names of the parts, or the field of `Sizes` that counts them.
    - `bound`, `excess`: if the sum of the magnitudes of a part's states exceeds the bound, the flight has diverged, and
      `excess` is the reported cause.
    """

    states: Mapping[str, str]
    parts: tuple[str, ...] | str = ("",)
    bound: float = math.inf
    excess: str = ""

    @property
    def counted_by(self) -> str:
        """Return the field of `Sizes` that counts the parts, or "" for a fixed number of parts."""
        return self.parts if isinstance(self.parts, str) else ""

    @property
    def fixed_parts(self) -> int:
        return 0 if isinstance(self.parts, str) else len(self.parts)

    def names(self, sizes: Sizes) -> Iterator[str]:
        """Yield the names of the states in their order; counted parts are numbered from 1."""
        parts = range(1, int(getattr(sizes, self.parts)) + 1) if isinstance(self.parts, str) else self.parts
        return (name.format(part) for part in parts for name in self.states)


# The states of the rigid body come first for every vehicle.
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
