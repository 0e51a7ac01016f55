"""The memory that a flight works in, besides its state: one allocation, made once, and where what lies in it."""

from __future__ import annotations

from typing import NamedTuple

from maxq.control.kernel.jit import borrowed, kernel
from maxq.control.kernel.records import Array
from maxq.sim.vehicle.state import MAX_STATE
from maxq.sim.vehicle.workspace import AUX_SIZE, WORK_SIZE

PROPS_SIZE = 1024  # columns of the widest schedule (8 modes a plane, 8 tanks, 9 surfaces: 686) and behind them (315)

_Y_END = 0
_Y_STAGE = _Y_END + MAX_STATE
_K_1 = _Y_STAGE + MAX_STATE
_K = _K_1 + MAX_STATE
_PROPS = _K + MAX_STATE
_PROPS_MIDDLE = _PROPS + PROPS_SIZE
_PROPS_END = _PROPS_MIDDLE + PROPS_SIZE
_WORK = _PROPS_END + PROPS_SIZE
_AUX = _WORK + WORK_SIZE
_AUX_STAGE = _AUX + AUX_SIZE
ARENA_SIZE = _AUX_STAGE + AUX_SIZE


class Lent(NamedTuple):
    """The arrays of an arena."""

    y_end: Array  # state at a step's end, and at a stage of the Runge-Kutta method
    y_stage: Array
    k_1: Array  # derivative at a step's start, and at the later stages
    k: Array
    props: Array  # the schedule's row at a step's start, middle, end
    props_middle: Array
    props_end: Array
    work: Array  # scratch of the derivative
    aux: Array  # by-products of the derivative at a step's start, and at the later stages
    aux_stage: Array


@kernel
def lend(arena: Array) -> Lent:
    """Bare pointers into `arena`, as `borrowed` hands them out."""
    return Lent(
        borrowed(arena[_Y_END:_Y_STAGE]),
        borrowed(arena[_Y_STAGE:_K_1]),
        borrowed(arena[_K_1:_K]),
        borrowed(arena[_K:_PROPS]),
        borrowed(arena[_PROPS:_PROPS_MIDDLE]),
        borrowed(arena[_PROPS_MIDDLE:_PROPS_END]),
        borrowed(arena[_PROPS_END:_WORK]),
        borrowed(arena[_WORK:_AUX]),
        borrowed(arena[_AUX:_AUX_STAGE]),
        borrowed(arena[_AUX_STAGE:ARENA_SIZE]),
    )
