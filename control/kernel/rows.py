"""Rows of a log: the declaration of a component's logged values, and the kernel that writes them.

A declaration is a NamedTuple whose fields are annotated with a type, a unit and a description:

    class EngineRow(NamedTuple):
        thrust_N: Annotated[float, "N", "thrust at ambient pressure"]
        mount_force_B_axis_N: Annotated[Xyz, "N", "force on the mount"]

`sim/flight/channels.py` derives the channels from it, here `thrust_N`, `mount_force_B_x_N`, `..._y_N` and `..._z_N`:
`axis` in a name stands for the components of the field's type. A field may itself be a row (`law: LawRow`). A kernel
returns an instance of the class with values in the declared units, and `put` writes it into the row of the log. A
missing or unknown field is an error when the kernel is compiled. Columns need no explicit numbers.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from numba import types
from numba.extending import intrinsic, overload

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array

DEG = 180.0 / math.pi


class Xyz(NamedTuple):
    x: float
    y: float
    z: float


class QuaternionRow(NamedTuple):
    w: float
    x: float
    y: float
    z: float


class NorthEastDown(NamedTuple):
    north: float
    east: float
    down: float


class RollPitchYaw(NamedTuple):
    roll: float
    pitch: float
    yaw: float


class PitchYaw(NamedTuple):
    pitch: float
    yaw: float


@kernel
def xyz(values: Array, first: int) -> Xyz:
    """Return the three adjacent components that begin at `first`."""
    return Xyz(values[first], values[first + 1], values[first + 2])


@kernel
def quaternion(values: Array) -> QuaternionRow:
    """Return the first four components, a quaternion with the scalar first."""
    return QuaternionRow(values[0], values[1], values[2], values[3])


@kernel
def degrees(rad: Array, first: int = 0) -> RollPitchYaw:
    """Return three adjacent angles or rates from `first` on, converted from rad to deg."""
    return RollPitchYaw(DEG * rad[first], DEG * rad[first + 1], DEG * rad[first + 2])


def put(row: Array, column: int, values: Any) -> int:
    """Write the numbers of a tuple, with nested tuples in order, into `row`, and return the next column.

    The first number goes into `column`. `row` must be contiguous and long enough. This function is for kernels.
    """
    if not isinstance(values, tuple):
        row[column] = values
        return column + 1
    for value in values:
        column = put(row, column, value)
    return column


@intrinsic  # type: ignore[untyped-decorator]  # Numba has no types
def _store(context: Any, row: Any, column: Any, values: Any) -> Any:
    """Implement `put` as one store per number (Numba intrinsic).

    Numba cannot loop over tuples with elements of different types.
    """

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data

        def store(column: Any, kind: Any, value: Any) -> Any:
            if not isinstance(kind, types.BaseTuple):
                number = context.cast(builder, value, kind, types.float64)
                builder.store(number, builder.gep(data, [column]))
                return builder.add(column, context.get_constant(types.intp, 1))
            for i, part in enumerate(kind.types):
                column = store(column, part, builder.extract_value(value, i))
            return column

        return store(arguments[1], signature.args[2], arguments[2])

    return types.intp(row, types.intp, values), build


@overload(put)
def _put(row, column, values):  # type: ignore[no-untyped-def]  # Numba compares both signatures, annotations included
    return lambda row, column, values: _store(row, column, values)  # noqa: PLW0108  # Numba compiles this body
