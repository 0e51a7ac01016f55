"""The one place that knows how kernels are compiled.

A kernel is a plain Python function over floats, flat arrays and records. `@kernel` compiles it with Numba on
first use and keeps the machine code in a cache folder whose name holds a hash of all of maxq's sources: Numba
itself looks only at the file of the function that is called, so without this an edited callee would go on
answering with its old code.

`NUMBA_DISABLE_JIT=1` runs the same functions as plain Python.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def _source_files() -> Iterator[Path]:
    """Python sources of the layers that hold kernels, wherever they are installed."""
    here = Path(__file__).resolve().parent
    for layer in ("control", "sim", "design"):
        yield from sorted((here.parent / layer).rglob("*.py"))


def source_hash() -> str:
    """First 16 hex digits of the SHA-256 of all sources that may hold a kernel."""
    digest = hashlib.sha256()
    for path in _source_files():
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Folder of the compiled kernels: `$MAXQ_CACHE`, else the user's cache folder."""
    base = os.environ.get("MAXQ_CACHE") or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "maxq"
    )
    return Path(base) / f"kernels-{source_hash()}"


_FOLDER = str(cache_folder())


def kernel(function: Function) -> Function:
    """Compile `function` (nogil, cached on disk, IEEE arithmetic as written: no fastmath).

    Division by zero gives inf or nan as in C (`error_model="numpy"`); the flight loop checks the state for it.
    """
    saved = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = _FOLDER  # read at decoration time; restored so that no other library is touched
    try:
        return numba.njit(function, nogil=True, cache=True, error_model="numpy")  # type: ignore[no-any-return]
    finally:
        numba.config.CACHE_DIR = saved
