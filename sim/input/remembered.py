"""Caching of results by identity of the arguments: runs of a campaign share the objects that no run changes."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import wraps
from typing import Any, TypeVar

Answer = TypeVar("Answer")

_MOST = 64
_BY_VALUE = frozenset({int, float, bool, str, type(None)})


def cached_by_identity(function: Callable[..., Answer]) -> Callable[..., Answer]:
    """Cache results by the identity of the arguments; neither arguments nor results may be changed.

    Numbers and texts are compared by value, tuples by their elements. A comparison of the sections of a scenario by
    value would take longer than most computations.
    """
    kept: dict[Hashable, tuple[tuple[Any, ...], Answer]] = {}

    @wraps(function)
    def remembered(*arguments: Any) -> Answer:
        key = _key(arguments)
        known = kept.get(key)
        if known is None:
            # the arguments stay alive, so that no other object gets their identity
            known = arguments, function(*arguments)
            if len(kept) >= _MOST:  # another thread may also add results, which are then computed again
                kept.clear()
            kept[key] = known
        return known[1]

    return remembered


def _key(value: Any) -> Hashable:
    kind = type(value)
    if kind is tuple:
        return tuple([_key(item) for item in value])
    return value if kind in _BY_VALUE else id(value)
