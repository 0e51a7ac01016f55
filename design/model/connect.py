"""Putting linear systems together, and leaving out what cannot matter."""

from __future__ import annotations

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import StateSpace


def series(first: StateSpace, second: StateSpace) -> StateSpace:
    """`second` driven by all outputs of `first`; continuous or sampled alike."""
    n, m = len(first.states), len(second.states)
    a = np.zeros((n + m, n + m))
    a[:n, :n], a[n:, n:] = first.a, second.a
    a[n:, :n] = second.b @ first.c
    return StateSpace(
        a,
        np.concatenate([first.b, second.b @ first.d]),
        np.concatenate([second.d @ first.c, second.c], axis=1),
        second.d @ first.d,
        (*first.states, *second.states),
        first.inputs,
        second.outputs,
    )


def chain(*systems: StateSpace) -> StateSpace:
    """Systems in series, the first one first."""
    out = systems[0]
    for system in systems[1:]:
        out = series(out, system)
    return out


def closed(loop: StateSpace) -> Array:
    """State matrix of the loop closed with negative feedback (one input, one output)."""
    gain = 1.0 / (1.0 + float(loop.d[0, 0]))
    return np.asarray(loop.a - gain * np.outer(loop.b[:, 0], loop.c[0]))


def channels(system: StateSpace, outputs: tuple[str, ...], inputs: tuple[str, ...] | None = None) -> StateSpace:
    """The system with some outputs and inputs only, and without the states that do not lie between them.

    Left out are states that no entry of the matrices connects: a body in vacuum does not feel its own drift, and
    the poles at zero that go with it are none of the loop's.
    """
    i = [system.outputs.index(name) for name in outputs]
    j = [system.inputs.index(name) for name in (system.inputs if inputs is None else inputs)]
    b, c, d = system.b[:, j], system.c[i], system.d[np.ix_(i, j)]
    reached = _connected(system.a != 0.0, (b != 0.0).any(axis=1))
    seen = _connected((system.a != 0.0).T, (c != 0.0).any(axis=0))
    keep = np.flatnonzero(reached & seen)
    return StateSpace(
        system.a[np.ix_(keep, keep)],
        b[keep],
        c[:, keep],
        d,
        tuple(system.states[k] for k in keep),
        tuple(system.inputs[k] for k in j),
        outputs,
    )


def _connected(entries: np.ndarray, start: np.ndarray) -> np.ndarray:
    """States (bool) that a path of entries reaches from `start`; entry [i, k]: k acts on i."""
    found = start.copy()
    for _ in range(len(start)):
        grown = found | (entries & found).any(axis=1)
        if (grown == found).all():
            break
        found = grown
    return found
