"""Attitude control law of the user: compiled code at an address, called once per sample and gimbal axis.

The code is a C function `int step(const double *values, double *memory, double *sample)`. It receives the values of the
law's variables at this sample, its memory for the axis, and the sample: attitude error (rad), rate (rad/s) and period
(s). It writes the command (rad) to `sample[3]`. The bending filter and all later stages follow as in other laws.
sim/packing/own_law.py obtains the address from a Python file. The linear model is design/laws/own.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from maxq.control.external import call_c
from maxq.control.kernel.jit import address_of, kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import look_up
from maxq.control.laws.pd import LawInputs, PdRecord, PdState, filtered

MAX_VALUES = 24
"""The largest number of variables."""
MAX_MEMORY = 32
"""The numbers of memory for each gimbal axis."""


@dataclass(frozen=True)
class OwnLaw:
    """The address of the code, or 0 without such a law, and the number of its variables.

    The gain table has a column for each variable, in pitch, then in yaw.
    """

    step: int = 0
    count: int = 0


@dataclass
class OwnState:
    """The state of such a law.

    - `values`: values of the variables at the last sample.
    - `memory`: memory of the code in pitch, then in yaw; 0 at the start and while the law is switched off.
    - `sample`: attitude error, rate, period and command of the last sample.
    """

    values: Annotated[Array, (MAX_VALUES,)]
    memory: Annotated[Array, (2 * MAX_MEMORY,)]
    sample: Annotated[Array, (4,)]


@kernel
def start_own(state: OwnState) -> None:
    """Set the memory to 0."""
    for k in range(2 * MAX_MEMORY):
        state.memory[k] = 0.0


@kernel
def tick_own(law: OwnLaw, pd: PdRecord, pool: Array, state: OwnState, output: PdState, given: LawInputs) -> float:
    """Return the filtered command of an axis, rad, as `tick_pd` does; NaN if the code writes no command."""
    law_rad, gimbal, sample = 0.0, given.gimbal, state.sample
    if given.on == 0:
        for k in range(MAX_MEMORY):
            state.memory[MAX_MEMORY * gimbal + k] = 0.0
    elif pd.gains.n_breaks != 0:
        for k in range(law.count):
            state.values[k] = look_up(pool, pd.gains, given.at, law.count * gimbal + k)
        sample[0], sample[1], sample[2], sample[3] = given.error_rad, given.rate_radps, given.sample_s, math.nan
        mine = address_of(state.memory) + 8 * MAX_MEMORY * gimbal
        if call_c(law.step, address_of(state.values), mine, address_of(sample)) == 0:
            law_rad = sample[3]
        else:
            law_rad = math.nan
    return filtered(pd, output, gimbal, law_rad)
