"""Frozen dataclasses are the schema of a parameter set; a packed `np.record` is what a kernel reads.

A kernel is handed `P[i]`, reads `P[i].engine.mass_kg`, and compiles once for every vehicle, because the layout
holds no size that depends on the vehicle: arrays are bounded and come with a count. `with_constants` puts counts into
the layout, where thousands of flights of one vehicle justify a compilation of their own.
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
"""Rows of one record type (dtype_of a dataclass). A kernel annotates a single row, an np.record, with its dataclass."""

Reader = tuple[Callable[[Any], tuple[Any, ...]], tuple[int, ...]]
"""Reads all fields of a dataclass at once; which of them are dataclasses themselves."""

_LAYOUTS: dict[type, np.dtype[Any]] = {}
_READERS: dict[type, Reader] = {}


def dtype_of(schema: type) -> np.dtype[Any]:
    """Record layout of a dataclass of `float`, `int`, `Annotated[Array, shape]`, nested dataclasses and tuples of them
    (`Annotated[tuple[X, ...], shape]`).

    Raises TypeError for any other field type, and for a name that np.record has itself.
    """
    if schema not in _LAYOUTS:
        _LAYOUTS[schema] = _layout(schema)
    return _LAYOUTS[schema]


def _layout(schema: type) -> np.dtype[Any]:
    hints = get_type_hints(schema, include_extras=True)
    taken = [f.name for f in fields(schema) if hasattr(np.record, f.name)]
    if taken:  # uncompiled, `row.shape` is NumPy's own attribute, not the field
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
    """A 1-D array of records, one row per instance (all of the same dataclass)."""
    rows = np.zeros(len(instances), dtype_of(type(instances[0])))
    rows[:] = [_values(instance) for instance in instances]
    return rows


def _values(instance: Any) -> tuple[Any, ...]:
    """Return nested tuples that NumPy converts to a record. It is fast because a campaign packs records for every
    flight.
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
    """Return one row of zeros: the mutable state of a component that a kernel owns."""
    return np.zeros(1, dtype_of(schema))


def with_constants(rows: NDArray[Any], *path: str) -> NDArray[Any]:
    """The same memory, with the integers of the nested record at `path` in its type as well: kernels that read
    them by `jit.integer` are compiled for these values, and compute the same bits. Unlike rows stay as they are.
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
    """Constants encoded in the names of a record's fields, see `with_constants`."""
    return {
        name: int(value)
        for encoded in names
        if "=" in encoded
        for name, _, value in (part.partition("=") for part in encoded.split(","))
    }


@lru_cache(maxsize=64)
def _with_constant_names(layout: np.dtype[Any], path: tuple[str, ...], encoded: str) -> np.dtype[Any]:
    """`layout` with a further field, without size, before those of the record at `path`.

    Without size, since NumPy hands no buffer to a record whose fields overlap; before them, since Numba takes a record
    with more fields behind for a subtype, and would call kernels of other constants with it.
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
