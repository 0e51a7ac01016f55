"""What is `borrowed` on a CUDA GPU: a bare pointer too, where need be to every 32nd number only.

The threads of a warp do the same at the same time, each with its own flight. Their numbers lie interleaved, LANES to
a row, so that what the warp reads at once is one stretch of memory. A thread's column of such a matrix has a stride
that is known when the kernel is compiled. An array carries shape and stride along instead: compiled for sm_90, the
flight loop's own frame then spilled 1,540 bytes of registers instead of 60.

Only `jit.on_device` imports this: it needs numba-cuda, an extra.
"""

from __future__ import annotations

import operator
from typing import Any

from numba import types
from numba.core.datamodel import models
from numba.cuda.extending import intrinsic, overload
from numba.cuda.models import register_model

from maxq.control.kernel.jit import LANES, borrowed


class Lane(types.Type):  # type: ignore[misc]  # Numba has no types
    """Every LANES-th number from a pointer on."""

    def __init__(self, dtype: Any) -> None:
        self.dtype = dtype
        super().__init__(f"Lane({dtype})")


register_model(Lane)(models.PointerModel)


@intrinsic  # type: ignore[untyped-decorator]  # Numba has no types
def _address(context: Any, array: Any) -> Any:
    pointer = types.CPointer(array.dtype) if array.layout == "C" else Lane(array.dtype)

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return context.make_array(signature.args[0])(context, builder, arguments[0]).data

    return pointer(array), build


@intrinsic  # type: ignore[untyped-decorator]  # Numba has no types
def _load(context: Any, lane: Any, index: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_element(builder, *arguments))

    return lane.dtype(lane, types.intp), build


@intrinsic  # type: ignore[untyped-decorator]  # Numba has no types
def _store(context: Any, lane: Any, index: Any, value: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.store(arguments[2], _element(builder, *arguments[:2]))
        return context.get_dummy_value()

    return types.void(lane, types.intp, lane.dtype), build


def _element(builder: Any, pointer: Any, index: Any) -> Any:
    return builder.gep(pointer, [builder.mul(index, index.type(LANES))])


@overload(borrowed)
def _borrowed(array):  # type: ignore[no-untyped-def]  # Numba compares both signatures, annotations included
    return lambda array: _address(array)  # noqa: PLW0108  # Numba compiles this body: it cannot be the intrinsic itself


@overload(operator.getitem)
def _get(lane, index):  # type: ignore[no-untyped-def]  # as above
    if isinstance(lane, Lane) and isinstance(index, types.Integer):
        return lambda lane, index: _load(lane, index)  # noqa: PLW0108  # as above
    return None


@overload(operator.setitem)
def _set(lane, index, value):  # type: ignore[no-untyped-def]  # as above
    if isinstance(lane, Lane) and isinstance(index, types.Integer):
        return lambda lane, index, value: _store(lane, index, value)  # noqa: PLW0108  # as above
    return None
