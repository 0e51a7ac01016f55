"""Filters of each loop by itself, and how the filters of a stage fade out behind its separation.

    attitude error -> filter -> \
    rate           -> filter ->  law -> bending filter -> command
    acceleration   -> filter -> /

The law's output has its bending filter in any case (laws/pd.py); a loop's own one filters what the law works on. After
a separation the filters of the stage before run on beside those of the new one for `fade_ticks` samples, each with the
same input, and what they give goes over linearly: share k / (n + 1) of the new one at sample k of n.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from maxq.control.filters import DiscreteFilter, filter_sample, settle_filter
from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array, IntArray
from maxq.control.structures import MAX_SECTIONS

ATTITUDE, RATE, ACCELERATION, OUTPUT = range(4)


def _no_sections() -> Array:
    return np.zeros((3, MAX_SECTIONS, 5))


@dataclass(frozen=True)
class LoopFilters:
    """`on`: 1 with any filter. `fade_ticks`: samples over which the filters of the stage before fade out.

    `sections` (3, MAX_SECTIONS, 5): as `Pd.sections`, of ATTITUDE, RATE, ACCELERATION, alike in pitch and yaw;
    `n_sections` (3,).
    """

    on: int = 0
    fade_ticks: int = 0
    sections: Annotated[Array, (3, MAX_SECTIONS, 5)] = field(default_factory=_no_sections)
    n_sections: Annotated[IntArray, (3,)] = field(default_factory=lambda: np.zeros(3, np.int64))


@dataclass
class LoopFilterState:
    """Per loop and gimbal axis: `memory` of the filters.

    `old_sections`, `old_n_sections`, `old_memory`: of the stage before, the bending filter (OUTPUT) among them.
    `fading`: samples left.
    """

    memory: Annotated[Array, (3, 2, MAX_SECTIONS, 2)]
    fading: int
    old_sections: Annotated[Array, (4, 2, MAX_SECTIONS, 5)]
    old_n_sections: Annotated[IntArray, (4, 2)]
    old_memory: Annotated[Array, (4, 2, MAX_SECTIONS, 2)]


def make_loop_filters(filters: Sequence[DiscreteFilter | None] = (), fade_ticks: int = 0) -> LoopFilters:
    """`filters` of ATTITUDE, RATE, ACCELERATION; None: none."""
    sections, n_sections = _no_sections(), np.zeros(3, np.int64)
    for loop, discrete in enumerate(filters):
        if discrete is not None:
            sections[loop], n_sections[loop] = discrete.padded(), discrete.n_sections
    return LoopFilters(int(n_sections.any()), fade_ticks, sections, n_sections)


@kernel
def start_loop_filters(state: LoopFilterState) -> None:
    """Settled at 0, nothing fading."""
    state.fading = 0
    for loop in range(3):
        for gimbal in range(2):
            for k in range(MAX_SECTIONS):
                state.memory[loop, gimbal, k, 0], state.memory[loop, gimbal, k, 1] = 0.0, 0.0


@kernel
def keep_filter(
    state: LoopFilterState, loop: int, gimbal: int, sections: Array, n_sections: int, memory: Array
) -> None:
    """The filter of the stage before, to fade out."""
    state.old_n_sections[loop, gimbal] = n_sections
    for k in range(n_sections):
        for i in range(5):
            state.old_sections[loop, gimbal, k, i] = sections[k, i]
        state.old_memory[loop, gimbal, k, 0], state.old_memory[loop, gimbal, k, 1] = memory[k, 0], memory[k, 1]


@kernel
def take_over_filter(
    before: LoopFilters, filters: LoopFilters, state: LoopFilterState, loop: int, gimbal: int, value: float
) -> None:
    """A stage's own filter of a loop begins settled at `value`; that before is kept."""
    memory = state.memory[loop, gimbal]
    keep_filter(state, loop, gimbal, before.sections[loop], before.n_sections[loop], memory)
    settle_filter(filters.sections[loop], filters.n_sections[loop], memory, value)


@kernel
def faded(filters: LoopFilters, state: LoopFilterState, loop: int, gimbal: int, given: float, out: float) -> float:
    """Return the output of a filter, `out`, faded with the output of the previous stage's filter for the same input."""
    if state.fading == 0:
        return out
    n_old, memory = state.old_n_sections[loop, gimbal], state.old_memory[loop, gimbal]
    old = filter_sample(state.old_sections[loop, gimbal], n_old, memory, given)
    return out + state.fading / (filters.fade_ticks + 1.0) * (old - out)


@kernel
def filtered_input(filters: LoopFilters, state: LoopFilterState, loop: int, gimbal: int, value: float) -> float:
    """Return the filtered measurement that the law uses."""
    out = filter_sample(filters.sections[loop], filters.n_sections[loop], state.memory[loop, gimbal], value)
    return faded(filters, state, loop, gimbal, value, out)
