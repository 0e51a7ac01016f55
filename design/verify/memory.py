"""What has been worked out before is not worked out again: parts kept by the hash of all that they depend on.

    memory = Memory(folder)
    answer = memory.recall("node", (packed, node, loop), lambda: certify(...))

A key is the content of the arguments, bit by bit, and the source code of maxq. A part whose inputs are the same is the
same part, whatever design or scenario asks for it: of a design with one changed gain, only the nodes beside it are new.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import pickle
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from maxq.control.kernel.jit import cache_folder
from maxq.sim.files import FileError, write_whole

T = TypeVar("T")


def default_folder() -> Path:
    """Beside the compiled kernels: `$MAXQ_CACHE`, else the user's cache folder."""
    return cache_folder().parent / "verified"


@lru_cache(maxsize=1)
def code_hash() -> str:
    """Of every module that can have a part in an answer."""
    top = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for layer in ("control", "sim", "design"):
        for path in sorted((top / layer).rglob("*.py")):
            digest.update(path.relative_to(top).as_posix().encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def content_hash(*things: Any) -> str:
    """SHA-256 of values: numbers, texts, arrays, records, dataclasses, and collections of them.

    Raises TypeError for anything else, rather than to tell two different things for one.
    """
    digest = hashlib.sha256()
    for thing in things:
        _feed(digest, thing)
    return digest.hexdigest()


def _feed(digest: Any, thing: Any) -> None:
    digest.update(type(thing).__name__.encode() + b":")
    if thing is None or isinstance(thing, bool | int | float | complex | str):
        digest.update(repr(thing).encode() + b";")
    elif isinstance(thing, bytes):
        digest.update(thing)
    elif isinstance(thing, np.ndarray | np.generic):
        digest.update(f"{thing.dtype}{np.shape(thing)}".encode())
        digest.update(thing.tobytes())
    elif dataclasses.is_dataclass(thing) and not isinstance(thing, type):
        _feed(digest, {f.name: getattr(thing, f.name) for f in dataclasses.fields(thing)})
    elif isinstance(thing, Mapping):
        _feed(digest, [part for item in thing.items() for part in item])
    elif isinstance(thing, tuple | list):
        digest.update(str(len(thing)).encode())
        for item in thing:
            _feed(digest, item)
    else:
        raise TypeError(f"no way to tell two {type(thing).__name__} apart")


class Memory:
    """Parts in a folder, a file each; `folder` None remembers nothing. Threads may share one."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self.recalled = 0
        self.worked_out = 0

    def recall(self, kind: str, depends_on: Any, work_out: Callable[[], T]) -> T:
        """The part of that kind, from the folder or worked out now and kept."""
        if self._folder is None:
            self.worked_out += 1
            return work_out()
        path = self._folder / f"{kind}-{content_hash(code_hash(), kind, depends_on)[:32]}.pickle"
        try:
            found: T = pickle.loads(path.read_bytes())
        except (OSError, pickle.UnpicklingError, EOFError, AttributeError, ImportError):
            found = work_out()
            self.worked_out += 1
            with contextlib.suppress(FileError):  # a memory that cannot be written costs time, no more
                write_whole(path, pickle.dumps(found))
            return found
        self.recalled += 1
        return found
