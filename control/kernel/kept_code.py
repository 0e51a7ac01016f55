"""Storage of the machine code of entries on disk, with all their callees.

The name of the folder contains a hash of all sources that may contain a kernel. Numba checks only the file of the
called function, so an edited callee would otherwise keep its old machine code.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import os
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import llvmlite.binding
from numba import typeof
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys

from maxq.control.kernel import progress
from maxq.control.kernel.machine import own_cache

if sys.platform != "win32":
    import fcntl

_KERNEL_FREE = {"input", "scenario", "log", "packing", "run", "campaign", "section.py", "packing.py", "files.py"}
"""The folders and files of sim/ whose constants no kernel uses."""
_COMPILED = re.compile(rb"^@(?:kernel|formula|\w*routine\w*|entry|from_python)\b", re.MULTILINE)


def _source_files() -> dict[Path, bytes]:
    """Return the contents of the sources that contain a kernel, or a constant that a kernel uses, by path.

    These are all files of control/, the files of sim/ used in flight, and any other file of sim/ and design/ that
    compiles a function.
    """
    layers, found = Path(__file__).resolve().parents[2], dict[Path, bytes]()
    for path in (path for layer in ("control", "sim", "design") for path in sorted((layers / layer).rglob("*.py"))):
        source = path.read_bytes()
        if _flies(path.relative_to(layers).parts) or _COMPILED.search(source):
            found[path] = source
    return found


def _flies(parts: tuple[str, ...]) -> bool:
    """Return True for a file of control/, or of sim/ outside `_KERNEL_FREE`; `parts` is its path below the layers."""
    return parts[0] == "control" or (parts[0] == "sim" and not _KERNEL_FREE.intersection(parts))


def source_hash() -> str:
    """Return the first 16 hex digits of the SHA-256 of all sources that may contain a kernel."""
    return _hash_of(_source_files())


def _hash_of(sources: dict[Path, bytes]) -> str:
    digest = hashlib.sha256()
    for path, source in sources.items():
        digest.update(path.name.encode())
        digest.update(source)
    return digest.hexdigest()[:16]


def _folder_and_sources() -> tuple[str, frozenset[str]]:
    """Return the folder of stored machine code and the paths of all sources that may contain a kernel."""
    sources = _source_files()
    return str(own_cache(f"kernels-{_hash_of(sources)}")), frozenset(map(str, sources))


_FOLDER, _SOURCES = _folder_and_sources()


_loaded = set[str]()
"""The names of the routines whose machine code this process has loaded; equal names mean equal code."""


def is_own(path: str) -> bool:
    """Return True for a source of maxq, whose machine code remains valid as long as the folder."""
    return os.path.realpath(path) in _SOURCES


class _CheckedFile(IndexDataCacheFile):  # type: ignore[misc]  # Numba has no types
    """The cache files of one function's machine code, each followed by its SHA-256.

    Machine code in a damaged file is compiled again. Numba does not detect a damaged file, but accepts an empty index
    and missing code, which this class returns in that case.
    """

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[io.BytesIO]:
        content = io.BytesIO()
        yield content
        with super()._open_for_write(filepath) as file:
            file.write(content.getvalue() + hashlib.sha256(content.getvalue()).digest())

    def _load_index(self) -> dict[Any, str]:
        return super()._load_index() if _whole_content(self._index_path) else {}

    def _load_data(self, name: str) -> Any:
        path = self._data_path(name)
        if not _whole_content(path):
            raise OSError(errno.EIO, "this machine code is damaged", path)
        return super()._load_data(name)


class _Place:
    """The location and the validity criterion of an entry's machine code, in the form that Numba requires.

    Code of maxq's own sources is valid for any place and date of installation, because the folder's name contains their
    hash. Code of other files is valid for their path, size and modification time.
    """

    def __init__(self, function: Any, path: str) -> None:
        self._line, own = function.__code__.co_firstlineno, is_own(path)
        name = function.__module__ if own else hashlib.sha256(os.path.abspath(path).encode()).hexdigest()[:16]
        self._folder = _own_folder(name)
        status = os.stat(path)
        self._stamp = () if own else (status.st_size, status.st_mtime_ns)

    @classmethod
    def from_function(cls, function: Any, path: str) -> _Place | None:
        """Return the location, or None if nothing can be stored there.

        Raises PermissionError for a folder that others may write to.
        """
        if not os.path.exists(path):
            return None
        place = cls(function, path)
        try:
            place.ensure_cache_path()
        except OSError:
            return None
        return place

    def ensure_cache_path(self) -> None:
        os.makedirs(self._folder, exist_ok=True)
        if not os.access(self._folder, os.W_OK):
            raise PermissionError(errno.EACCES, "this folder cannot be written", self._folder)

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> tuple[int, ...]:
        return self._stamp

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Kept(CompileResultCacheImpl):  # type: ignore[misc]  # Numba has no types
    """The stored form of an entry: machine code without its LLVM IR, because it is not linked again."""

    _locator_classes = (_Place,)

    def reduce(self, result: Any) -> Any:
        return result.library.objects, super().reduce(result)

    def rebuild(self, context: Any, kept: Any) -> Any:
        load_objects(context.codegen(), kept[0])
        result = super().rebuild(context, kept[1])
        result.library._shared_module = None  # Numba then refuses to link it
        return result


class EntryCache(FunctionCache):  # type: ignore[misc]  # Numba has no types
    _impl_class = _Kept
    _turn: int | None = None  # descriptor of the locked file while this process compiles

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        self._cache_file.__class__ = _CheckedFile

    def holds(self, *arguments: Any) -> bool:
        """Return True if machine code for a call with these arguments is stored."""
        key = self._index_key(tuple(map(typeof, arguments)), cpu_target.target_context.codegen())
        return key in self._cache_file._load_index()

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Load machine code from disk, without Numba's NumPy functions, which would import SciPy's linear algebra.

        Compiled code needs only the reference counts of arrays; a compilation loads the NumPy functions. If no machine
        code is stored, None is returned and this process compiles it. Other processes that need the same code wait for
        the first process.
        """
        rtsys.initialize(target)
        for _ in range(2):
            with self._guard_against_spurious_io_errors():
                found = self._load_overload(signature, target)
                if found is not None or self._turn is not None:
                    break
            self._await_turn(repr(self._index_key(signature, target.codegen())))
        if found is not None:
            progress.current().loaded(self._py_func)
            self._end_turn()
        return found

    def save_overload(self, signature: Any, data: Any) -> None:
        try:
            super().save_overload(signature, data)
        finally:
            self._end_turn()

    def _await_turn(self, key: str) -> None:
        name = hashlib.sha256(f"{self._cache_file._index_path}{key}".encode()).hexdigest()[:16]
        if sys.platform != "win32":
            with contextlib.suppress(OSError):  # without a cache or lock, each process compiles separately
                self._turn = os.open(Path(_FOLDER, f"{name}.lock"), os.O_RDWR | os.O_CREAT, 0o600)
                fcntl.flock(self._turn, fcntl.LOCK_EX)

    def _end_turn(self) -> None:
        if self._turn is not None:  # a process forked meanwhile must not hold the lock
            with contextlib.suppress(OSError):
                fcntl.flock(self._turn, fcntl.LOCK_UN)
            os.close(self._turn)
            self._turn = None


def _whole_content(path: str | Path) -> bytes:
    """Return the content of a file without its SHA-256, or b"" for a damaged or missing file."""
    try:
        content = Path(path).read_bytes()
    except OSError:
        return b""
    return content[:-32] if hashlib.sha256(content[:-32]).digest() == content[-32:] else b""


def load_objects(codegen: Any, objects: Mapping[str, bytes]) -> None:
    """Load the object files `objects` (by name of the routine) that this process has not loaded yet."""
    for name in objects.keys() - _loaded:
        codegen._engine._ee.add_object_file(llvmlite.binding.ObjectFileRef.from_data(objects[name]))
        _loaded.add(name)


def kept_routine(name: str) -> bytes:
    """Return the stored object file of a routine, or b"" if there is none."""
    return _whole_content(_routine_path(name))


def keep_routine(name: str, code: bytes) -> None:
    """Store the object file of a routine, so that it remains if the compilation of its entry is killed."""
    path = _routine_path(name)
    begun = path.with_suffix(f".{os.getpid()}")
    with contextlib.suppress(OSError):  # the folder may not be writable
        path.parent.mkdir(parents=True, exist_ok=True)
        begun.write_bytes(code + hashlib.sha256(code).digest())
        begun.replace(path)


def _routine_path(name: str) -> Path:
    return Path(_own_folder("routines"), f"{hashlib.sha256(name.encode()).hexdigest()[:32]}.o")


def _own_folder(name: str) -> str:
    return str(own_cache(os.path.join(os.path.basename(_FOLDER), name)))
