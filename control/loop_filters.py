r"""Filters of the individual loops, and the fade-out of a stage's filters after its separation.

    attitude error -> filter -> \
    rate           -> filter ->  law -> bending filter -> command
    acceleration   -> filter -> /

The law's output always has its bending filter (laws/pd.py). A loop filter acts on one input of the law. After a
separation, the filters of the previous stage run in parallel with the new filters for `fade_ticks` samples, with the
same inputs. The output changes over linearly: the new filter has the weight k / (n + 1) at sample k of n.
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
    """The parameters of the loop filters.

    - `on`: 1 if there is any filter.
    - `fade_ticks`: number of samples over which the filters of the previous stage fade out.
    - `sections` (3, MAX_SECTIONS, 5): as `PdRecord.sections`, for ATTITUDE, RATE and ACCELERATION, equal in pitch and
      yaw.
    - `n_sections` (3,): number of sections of each filter.
    """

    on: int = 0
    fade_ticks: int = 0
    sections: Annotated[Array, (3, MAX_SECTIONS, 5)] = field(default_factory=_no_sections)
    n_sections: Annotated[IntArray, (3,)] = field(default_factory=lambda: np.zeros(3, np.int64))


@dataclass
class LoopFilterState:
    """The state of the loop filters, per loop and gimbal axis.

    - `fading`: number of samples to the end of the fade-out.
    - `memory`: memory of the filters.
    - `old_sections`, `old_n_sections`, `old_memory`: filters of the previous stage, including its bending filter
      (OUTPUT).
    """

    fading: int
    memory: Annotated[Array, (3, 2, MAX_SECTIONS, 2)]
    old_sections: Annotated[Array, (4, 2, MAX_SECTIONS, 5)]
    old_n_sections: Annotated[IntArray, (4, 2)]
    old_memory: Annotated[Array, (4, 2, MAX_SECTIONS, 2)]


def make_loop_filters(filters: Sequence[DiscreteFilter | None] = (), fade_ticks: int = 0) -> LoopFilters:
    """Return the parameters for `filters` of ATTITUDE, RATE and ACCELERATION, where None is no filter."""
    sections, n_sections = _no_sections(), np.zeros(3, np.int64)
    for loop, discrete in enumerate(filters):
        if discrete is not None:
            sections[loop], n_sections[loop] = discrete.padded(), discrete.n_sections
    return LoopFilters(int(n_sections.any()), fade_ticks, sections, n_sections)


@kernel
def start_loop_filters(state: LoopFilterState) -> None:
    """Clear the memory of the filters, and end any fade-out."""
    state.fading = 0
    for loop in range(3):
        for gimbal in range(2):
            for k in range(MAX_SECTIONS):
                state.memory[loop, gimbal, k, 0], state.memory[loop, gimbal, k, 1] = 0.0, 0.0


@kernel
def keep_filter(
    state: LoopFilterState, loop: int, gimbal: int, sections: Array, n_sections: int, memory: Array
) -> None:
    """Copy the filter of the previous stage, in order to fade it out."""
    state.old_n_sections[loop, gimbal] = n_sections
    for k in range(n_sections):
        for i in range(5):
            state.old_sections[loop, gimbal, k, i] = sections[k, i]
        state.old_memory[loop, gimbal, k, 0], state.old_memory[loop, gimbal, k, 1] = memory[k, 0], memory[k, 1]


@kernel
def take_over_filter(
    before: LoopFilters, filters: LoopFilters, state: LoopFilterState, loop: int, gimbal: int, value: float
) -> None:
    """Copy the previous filter of a loop, and settle the stage's own filter at `value`."""
    memory = state.memory[loop, gimbal]
    keep_filter(state, loop, gimbal, before.sections[loop], before.n_sections[loop], memory)
    settle_filter(filters.sections[loop], filters.n_sections[loop], memory, value)


@kernel
def faded(filters: LoopFilters, state: LoopFilterState, loop: int, gimbal: int, given: float, out: float) -> float:
    """Return a filter's output `out`, blended with that of the previous stage's filter for the same input `given`."""
    if state.fading == 0:
        return out
    n_old, memory = state.old_n_sections[loop, gimbal], state.old_memory[loop, gimbal]
    old = filter_sample(state.old_sections[loop, gimbal], n_old, memory, given)
    return out + state.fading / (filters.fade_ticks + 1.0) * (old - out)


@kernel
def filtered_input(filters: LoopFilters, state: LoopFilterState, loop: int, gimbal: int, value: float) -> float:
    """Return the input of the law from the measurement `value`, filtered and blended with the fading filter."""
    out = filter_sample(filters.sections[loop], filters.n_sections[loop], state.memory[loop, gimbal], value)
    return faded(filters, state, loop, gimbal, value, out)
