"""The arrays of records as pointers in compiled kernels.

At each use of such an array, Numba creates a structure with its size, counts a reference to it, and checks the sign of
the index. These were half of the LLVM IR of a flight's kernels. A pointer supports one non-negative index only.
"""

from __future__ import annotations

import operator
from typing import Any

from numba.core import cgutils, types
from numba.core.datamodel.models import PointerModel
from numba.core.types.misc import CPointer
from numba.extending import lower_builtin, register_model


class RecordsPointer(CPointer):  # type: ignore[misc]  # Numba has no types
    """The type of a pointer to records, of which an index selects one. Numba's `CPointer` would copy it."""


register_model(RecordsPointer)(PointerModel)


@lower_builtin(operator.getitem, RecordsPointer, types.Integer)  # type: ignore[untyped-decorator]  # as above
def _record(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.gep(arguments[0], [arguments[1]])


def field_pointer(field: Any) -> Any:
    """Return the type of a pointer for the type of a one-dimensional array in a record; return other types as given."""
    if isinstance(field, types.NestedArray) and field.ndim == 1:
        return (RecordsPointer if isinstance(field.dtype, types.Record) else CPointer)(field.dtype)
    return field


def read_pointer(context: Any, builder: Any, record: Any, value: Any, name: str) -> Any:
    """Return the pointer to an array in a record (code of Numba for an attribute)."""
    of = context.get_data_type(record.typeof(name).dtype)
    return cgutils.get_record_member(builder, value, record.offset(name), of)
