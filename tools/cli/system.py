"""Functions of the C library that exist on Linux only. Without them, maxq needs more memory or time."""

from __future__ import annotations

import sys
from typing import Any

LINUX = sys.platform.startswith("linux")


def linux_function(name: str) -> Any:
    """Return a function of the C library, or None on another system or with a library that lacks it."""
    if not LINUX:
        return None
    import ctypes  # noqa: PLC0415  # lazy: --help does not need it

    return getattr(ctypes.CDLL(None, use_errno=True), name, None)
