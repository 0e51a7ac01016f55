"""The memory that a flight works in, besides its state: one allocation, made once, and where what lies in it."""

from __future__ import annotations

from typing import NamedTuple

from maxq.control.kernel.jit import bare_pointer, kernel
from maxq.control.kernel.records import Array
from maxq.sim.vehicle.state import MAX_STATE
from maxq.sim.vehicle.workspace import AUX_SIZE, WORK_SIZE

PROPERTIES_SIZE = (
    1024  # columns of the widest schedule (8 modes a plane, 8 tanks, 9 surfaces: 686) and behind them (315)
)

_Y_END = 0
_Y_STAGE = _Y_END + MAX_STATE
_K_1 = _Y_STAGE + MAX_STATE
_K = _K_1 + MAX_STATE
_PROPS = _K + MAX_STATE
_PROPS_MIDDLE = _PROPS + PROPERTIES_SIZE
_PROPS_END = _PROPS_MIDDLE + PROPERTIES_SIZE
_WORK = _PROPS_END + PROPERTIES_SIZE
_AUX = _WORK + WORK_SIZE
_AUX_STAGE = _AUX + AUX_SIZE
ARENA_SIZE = _AUX_STAGE + AUX_SIZE


class Workspace(NamedTuple):
    """The arrays of an arena."""

    y_end: Array  # state at a step's end, and at a stage of the Runge-Kutta method
    y_stage: Array
    k_1: Array  # derivative at a step's start, and at the later stages
    k: Array
    properties: Array  # the schedule's row at a step's start, middle, end
    properties_mid: Array
    properties_end: Array
    work: Array  # scratch of the derivative
    aux: Array  # by-products of the derivative at a step's start, and at the later stages
    aux_stage: Array


@kernel
def workspace_of(arena: Array) -> Workspace:
    """Bare pointers into `arena`, as `bare_pointer` hands them out."""
    return Workspace(
        bare_pointer(arena[_Y_END:_Y_STAGE]),
        bare_pointer(arena[_Y_STAGE:_K_1]),
        bare_pointer(arena[_K_1:_K]),
        bare_pointer(arena[_K:_PROPS]),
        bare_pointer(arena[_PROPS:_PROPS_MIDDLE]),
        bare_pointer(arena[_PROPS_MIDDLE:_PROPS_END]),
        bare_pointer(arena[_PROPS_END:_WORK]),
        bare_pointer(arena[_WORK:_AUX]),
        bare_pointer(arena[_AUX:_AUX_STAGE]),
        bare_pointer(arena[_AUX_STAGE:ARENA_SIZE]),
    )
