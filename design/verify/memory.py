"""Results that are stored for later runs, each under the hash of all data on which it depends.

    memory = PartsOnDisk(folder)
    answer = memory.recall("node", (packed, node, loop), lambda: certify(...))

The key consists of the content of the arguments, bit by bit, and the source code of maxq. A part with the same inputs
is shared by all designs and scenarios. For a design with one changed gain, only the adjacent operating points are
computed again.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import hashlib
import importlib
import itertools
import json
import random
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from maxq.control.kernel.machine import own_cache
from maxq.sim.files import FileError, write_whole
from maxq.sim.input.values import Section

T = TypeVar("T")


def default_folder() -> Path:
    """Return a folder next to the compiled kernels. Raises PermissionError if another user has write access."""
    return own_cache("verified")


@lru_cache(maxsize=1)
def code_hash() -> str:
    """Return the hash of every module that can affect a result."""
    top = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for layer in ("control", "sim", "design"):
        for path in sorted((top / layer).rglob("*.py")):
            digest.update(path.relative_to(top).as_posix().encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def content_hash(*things: Any) -> str:
    """Return the SHA-256 of values: numbers, texts, arrays, records, dataclasses, and collections of them.

    Raises TypeError for any other type, since different values could then have the same hash.
    """
    return hashlib.sha256(json.dumps(to_plain(things, records=True)).encode()).hexdigest()


_OF_JSON = frozenset({type(None), bool, int, float, str})
"""The types of single values in JSON."""


def to_plain(thing: Any, records: bool = False) -> Any:
    """Return a result in a form that JSON can represent.

    A type that JSON lacks becomes an object with one key, the name of the type. With `records`, NumPy records and bytes
    are permitted, for a hash. Raises TypeError for any other type that `from_plain` does not support.
    """
    if type(thing) in _OF_JSON:
        return thing
    plain = partial(to_plain, records=records)
    if isinstance(thing, np.ndarray | np.generic) and thing.dtype.kind in ("biufcSUV" if records else "biufc"):
        dtype = thing.dtype.str if thing.dtype.names is None else str(thing.dtype)
        return {"array": [dtype, np.shape(thing), base64.b64encode(thing.tobytes()).decode()]}
    if records and isinstance(thing, bytes):
        return {"bytes": base64.b64encode(thing).decode()}
    if isinstance(thing, bool | int | float | str):
        return thing
    if isinstance(thing, list):  # fast path for tables with thousands of numbers
        return list(thing) if _OF_JSON.issuperset(map(type, thing)) else [plain(item) for item in thing]
    if isinstance(thing, Mapping):
        return {"mapping": [[plain(key), plain(value)] for key, value in thing.items()]}
    if isinstance(thing, complex):
        return {"complex": [thing.real, thing.imag]}
    if isinstance(thing, Path):
        return {"path": str(thing)}
    kind = type(thing)
    name = f"{kind.__module__}:{kind.__qualname__}"
    if dataclasses.is_dataclass(thing) or isinstance(thing, Section):
        return {name: {field: plain(getattr(thing, field)) for field in _fields(kind)}}
    if isinstance(thing, tuple):
        return {name if hasattr(kind, "_fields") else "tuple": [plain(item) for item in thing]}
    raise TypeError(f"no plain form of {kind.__name__}")


def from_plain(plain: Any) -> Any:
    """Return the object that `to_plain` converted to `plain`.

    Raises ValueError or TypeError for input that `to_plain` cannot have written.
    """
    if isinstance(plain, list):
        return [from_plain(item) for item in plain]
    if not isinstance(plain, dict):
        return plain
    ((name, content),) = plain.items()
    if name == "mapping":
        return {from_plain(key): from_plain(value) for key, value in content}
    if name == "array":
        array = np.frombuffer(base64.b64decode(content[2]), np.dtype(content[0])).reshape(content[1]).copy()
        return array if content[1] else array[()]
    if name == "complex":
        return complex(*content)
    if name == "path":
        return Path(content)
    if name == "tuple":
        return tuple(from_plain(item) for item in content)
    module, _, kind_name = name.partition(":")
    if not module.startswith("maxq."):
        raise ValueError(f"{name} is no type of maxq")
    kind = getattr(importlib.import_module(module), kind_name, None)
    if not isinstance(kind, type):
        raise ValueError(f"{name} is no type of a result")
    if issubclass(kind, tuple):
        return kind(*(from_plain(item) for item in content))
    fields = {field: from_plain(content[field]) for field in _fields(kind)}
    if issubclass(kind, Section):
        return kind.model_construct(**fields)
    made = object.__new__(kind)
    for field, value in fields.items():
        object.__setattr__(made, field, value)
    return made


def _fields(kind: Any) -> list[str]:
    """Return the field names of a dataclass or of a section. Raises TypeError for other types."""
    return list(kind.model_fields) if issubclass(kind, Section) else [f.name for f in dataclasses.fields(kind)]


def counted(work: Callable[..., T], watch: Callable[[int, int], None], of: int, each: int = 1) -> Callable[..., T]:
    """Return `work` for use in threads, with a call of `watch` after every job.

    `watch` receives the completed amount and the total `of`. A job counts as `each`.
    """
    done = itertools.count(each, each)
    watch(0, of)

    def one(*job: Any) -> T:
        found = work(*job)
        watch(next(done), of)
        return found

    return one


def text_of(result: Any) -> bytes:
    """Return a result as the text of `to_plain`, which preserves every bit."""
    return json.dumps(to_plain(result)).encode()


def _digest(text: bytes) -> str:
    return hashlib.sha256(text).hexdigest()


class PartsOnDisk:
    """The parts in a folder, one file each. A `folder` of None stores nothing. Threads may share an instance.

    The lines of a file are the SHA-256 of the other lines, the hash of the part's inputs, and the part as JSON. A part
    whose file is damaged or belongs to other inputs is computed again. No file can name code to be executed.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._recalled: dict[Path, tuple[str, Callable[[], Any], str]] = {}  # name, function and hash of the result
        self._stored: dict[Path, str] = {}  # hashes of the parts that this object computed, by file
        self.worked_out = 0

    @property
    def recalled(self) -> int:
        """Return the number of parts of earlier computations that were read from the folder."""
        return len(self._recalled)

    @property
    def recalled_names(self) -> tuple[str, ...]:
        """Return the names of the parts that were read from the folder, in alphabetical order."""
        return tuple(sorted(name for name, _, _ in self._recalled.values()))

    def recheck(self, most: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Compute a random sample of the recalled parts again.

        Returns the names of the parts in the sample, and of those that differ.
        """
        sample = random.SystemRandom().sample([*self._recalled.values()], min(most, len(self._recalled)))
        wrong = [name for name, work_out, known in sample if _digest(text_of(work_out())) != known]
        return tuple(sorted(name for name, _, _ in sample)), tuple(sorted(wrong))

    def recall(self, kind: str, depends_on: Any, work_out: Callable[[], T], label: str = "") -> T:
        """Return a part, from the folder or computed by `work_out` and stored. `label` describes it in reports."""
        if self._folder is None:
            self.worked_out += 1
            return work_out()
        key = content_hash(code_hash(), kind, depends_on)
        path = self._folder / f"{kind}-{key[:32]}.json"
        try:
            checksum, _, rest = path.read_bytes().partition(b"\n")
            if checksum.decode() == _digest(rest) and rest.startswith(key.encode()):
                text = rest[len(key) + 1 :]
                found: T = from_plain(json.loads(text))
                if self._stored.get(path) != _digest(text):
                    self._recalled[path] = f"{kind} {label}".rstrip(), work_out, _digest(text)
                return found
        except (OSError, ValueError, TypeError, ImportError, LookupError, AttributeError, RecursionError):
            pass  # the file is missing or not written by `to_plain`
        found = work_out()
        self.worked_out += 1
        text = text_of(found)
        self._stored[path] = _digest(text)
        rest = f"{key}\n".encode() + text
        with contextlib.suppress(FileError):  # without write access, only time is lost
            write_whole(path, _digest(rest).encode() + b"\n" + rest)
        return found
