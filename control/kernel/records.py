"""Parameter records: frozen dataclasses as schemas, and packed `np.record`s as the input of kernels.

A kernel receives `P[i]` and reads `P[i].engine.mass_kg`. It is compiled once for all vehicles, because arrays have
fixed bounds and a count, so that the layout does not depend on the vehicle. `with_constants` adds the counts to the
layout, for thousands of flights of one vehicle that justify a separate compilation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass
from functools import lru_cache
from operator import attrgetter
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Records = NDArray[Any]
"""The rows of one record type (`dtype_of` a dataclass).

The annotation of a single row, an np.record, is its dataclass.
"""

Reader = tuple[Callable[[Any], tuple[Any, ...]], tuple[int, ...]]
"""The getter of all fields of a dataclass, and the indices of the fields that are themselves dataclasses."""

_LAYOUTS: dict[type, np.dtype[Any]] = {}
_READERS: dict[type, Reader] = {}


def dtype_of(schema: type) -> np.dtype[Any]:
    """Return the record layout of a dataclass.

    Its fields may be `float`, `int`, `Annotated[Array, shape]`, a dataclass, or a tuple of dataclasses
    (`Annotated[tuple[X, ...], shape]`). Raises TypeError for any other type of field, and for a field named like an
    attribute of np.record.
    """
    if schema not in _LAYOUTS:
        _LAYOUTS[schema] = _layout(schema)
    return _LAYOUTS[schema]


def _layout(schema: type) -> np.dtype[Any]:
    hints = get_type_hints(schema, include_extras=True)
    taken = [f.name for f in fields(schema) if hasattr(np.record, f.name)]
    if taken:  # in plain Python, `row.shape` is NumPy's attribute, not the field
        raise TypeError(f"{schema.__name__}.{taken[0]}: np.record has an attribute of that name already")
    return np.dtype((np.record, [(f.name, *_column(hints[f.name])) for f in fields(schema)]))


def _column(hint: Any) -> tuple[Any, ...]:
    if hint is float:
        return ("f8",)
    if hint is int:
        return ("i8",)
    if get_origin(hint) is Annotated:
        array, shape = get_args(hint)
        if get_origin(array) is tuple:
            return (dtype_of(get_args(array)[0]), shape)
        kind = "i8" if array == IntArray else "f8"
        return (kind, shape)
    if is_dataclass(hint) and isinstance(hint, type):
        return (dtype_of(hint),)
    raise TypeError(f"a parameter record cannot hold a field of type {hint}")


def pack(instances: list[Any]) -> NDArray[Any]:
    """Return a 1-D array of records, one row per instance; all instances must be of the same dataclass."""
    rows = np.zeros(len(instances), dtype_of(type(instances[0])))
    rows[:] = [_values(instance) for instance in instances]
    return rows


def _values(instance: Any) -> tuple[Any, ...]:
    """Return the field values of an instance as nested tuples, from which NumPy makes a record.

    All fields are read by one call, because a campaign packs a record for every flight.
    """
    schema = type(instance)
    if schema not in _READERS:
        _READERS[schema] = _reader(schema)
    read, nested = _READERS[schema]
    values = read(instance)
    if not nested:
        return values
    filled = list(values)
    for k in nested:
        filled[k] = [_values(x) for x in filled[k]] if isinstance(filled[k], tuple) else _values(filled[k])
    return tuple(filled)


def _reader(schema: type) -> Reader:
    names = [f.name for f in fields(schema)]
    layout = dtype_of(schema)
    nested = tuple(k for k, name in enumerate(names) if layout[name].base.names)
    if len(names) == 1:
        return lambda instance: (getattr(instance, names[0]),), nested
    return attrgetter(*names), nested


def blank(schema: type) -> NDArray[Any]:
    """Return one row of zeros, the mutable state of a component in a kernel."""
    return np.zeros(1, dtype_of(schema))


def duplicate(rows: NDArray[Any]) -> NDArray[Any]:
    """Return a copy of a contiguous array of records. NumPy's `copy` treats each field alone, which takes longer."""
    return rows.view(np.uint8).copy().view(rows.dtype)


def with_constants(rows: NDArray[Any], *path: str) -> NDArray[Any]:
    """Return `rows` as a view whose type contains the integers of the nested record at `path`.

    Kernels that read them by `jit.integer` are compiled for these values and compute the same bits. If the integers
    differ between rows, `rows` is returned unchanged.
    """
    nested = rows
    for name in path:
        nested = nested[name]
    names = nested.dtype.names or ()
    if len(rows) > 1 and any((nested[name] != nested[name][0]).any() for name in names):
        return rows
    encoded = ",".join(f"{name}={int(nested[name][0])}" for name in names)
    return rows.view(_with_constant_names(rows.dtype, path, encoded))


def constants_in(names: Iterable[str]) -> dict[str, int]:
    """Return the constants encoded in the field names of a record by `with_constants`."""
    return {
        name: int(value)
        for encoded in names
        if "=" in encoded
        for name, _, value in (part.partition("=") for part in encoded.split(","))
    }


@lru_cache(maxsize=64)
def _with_constant_names(layout: np.dtype[Any], path: tuple[str, ...], encoded: str) -> np.dtype[Any]:
    """Return `layout` with an additional field of zero size before the fields of the record at `path`.

    The size is zero because NumPy provides no buffer for a record with overlapping fields. The field comes first
    because Numba treats a record with more fields at its end as a subtype, and would pass it to kernels compiled for
    other constants.
    """
    of: dict[str, Any] = dict(layout.fields or {})
    names = list(layout.names or ())
    formats = [of[name][0] for name in names]
    offsets = [of[name][1] for name in names]
    if path:
        formats[names.index(path[0])] = _with_constant_names(formats[names.index(path[0])], path[1:], encoded)
    else:
        names, formats, offsets = [encoded, *names], [("i8", (0,)), *formats], [0, *offsets]
    spelt = {"names": names, "formats": formats, "offsets": offsets, "itemsize": layout.itemsize}
    return np.dtype((np.record, spelt))  # type: ignore[arg-type,unused-ignore]  # NumPy's stubs lack such a spelling
