"""Answers kept for arguments that are the same objects: runs of a campaign share whatever none of them changes."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import wraps
from typing import Any, TypeVar

Answer = TypeVar("Answer")

_MOST = 64
_BY_VALUE = frozenset({int, float, bool, str, type(None)})


def cached_by_identity(function: Callable[..., Answer]) -> Callable[..., Answer]:
    """Remember answers by the identity of the arguments, which must not be changed, nor must the answers.

    Numbers and texts are told by their value, tuples by what is in them. Comparing sections of a scenario by value
    would take longer than most answers.
    """
    kept: dict[Hashable, tuple[tuple[Any, ...], Answer]] = {}

    @wraps(function)
    def remembered(*arguments: Any) -> Answer:
        key = _key(arguments)
        known = kept.get(key)
        if known is None:
            known = arguments, function(*arguments)  # arguments stay alive, or another could get their identity
            if len(kept) >= _MOST:  # another thread may be here, too: what it asks for again is worked out again
                kept.clear()
            kept[key] = known
        return known[1]

    return remembered


def _key(value: Any) -> Hashable:
    kind = type(value)
    if kind is tuple:
        return tuple([_key(item) for item in value])
    return value if kind in _BY_VALUE else id(value)
