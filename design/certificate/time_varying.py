"""The linear loop along the ascent: its matrices change while mass, speed, air and gains do.

A lightly damped mode does not follow a change of its frequency that takes less than its decay. The response that is
measured while such a mode passes a line is that of no single instant. Here the sampled loop is advanced from sample to
sample, with matrices that are linear in time between operating points, under the excitation of the flight.

The states must keep their meaning between operating points: they are those of the vehicle in its units, of the law, and
one for each integral of the computer. Loops whose law changes the meaning of its states, such as those with a scheduled
filter, are not accepted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.loop.fixed_path import SampledFixedPath
from maxq.design.loop.loop import Loop
from maxq.design.model.state_space import StateSpace, chain


def output_along(loops: Sequence[Loop], times_s: Array, injected: Array, first: int) -> Array | None:
    """Return the output of the law in the closed loop, per sample from 0 to the last of `injected` (n,).

    `loops` are sampled loops at equally spaced `times_s` of one stage. `injected` is added to the output of the law.
    All states and outputs are 0 up to the sample `first`. Returns None if the states of the loops differ in meaning.
    """
    systems = [_in_units(loop) for loop in loops]
    n_law = len(loops[0].law.state_space().states)
    laws = [system.a[len(system.a) - n_law :, len(system.a) - n_law :] for system in systems]
    if any(system.states != systems[0].states for system in systems) or not all(
        np.array_equal(law, laws[0]) for law in laws
    ):
        return None
    sample_s = loops[0].sample_s
    assert sample_s is not None
    stacked = np.stack([np.block([[s.a, s.b], [s.c, s.d]]) for s in systems])
    out, state = np.zeros(len(injected)), np.zeros(len(systems[0].a))
    spacing_s = (times_s[-1] - times_s[0]) / (len(times_s) - 1)
    for k in range(first, len(injected)):
        at = min(max((k * sample_s - times_s[0]) / spacing_s, 0.0), len(times_s) - 1.0)
        before = min(int(at), len(times_s) - 2)
        share = at - before
        m = (1.0 - share) * stacked[before] + share * stacked[before + 1]
        command = (injected[k] - m[-1, :-1] @ state) / (1.0 + m[-1, -1])
        out[k] = command - injected[k]
        state = m[:-1, :-1] @ state + m[:-1, -1] * command
    return out


def _in_units(loop: Loop) -> StateSpace:
    """Return L of a sampled loop with the vehicle's states in their units and a state for each integral."""
    path = loop.fixed
    assert isinstance(path, SampledFixedPath)
    system = chain(path.measured(loop.law.inputs, states_of_sums=True), loop.law.state_space())
    scale = np.ones(len(system.a))
    scale[: len(path.sampled.scale)] = path.sampled.scale
    return StateSpace(
        system.a * scale[:, None] / scale,
        system.b * scale[:, None],
        system.c / scale,
        system.d,
        system.states,
        system.inputs,
        system.outputs,
    )
