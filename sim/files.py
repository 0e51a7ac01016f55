"""Files on the disk: written whole or not at all, and one line that says why one cannot be written.

write_whole(folder / "summary.json", text)
with whole_file(folder / "gains.svg") as part:
    figure.savefig(part, format="svg")
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path


class FileError(Exception):
    """A file cannot be written. The message is one line that names it and says why."""


Raises = Callable[[str], Exception]


def write_whole(path: Path, content: str | bytes, raises: Raises = FileError, *, durable: bool = False) -> Path:
    """Write text (UTF-8, newlines as they are) or bytes, as `whole_file` does; returns `path`."""
    with whole_file(path, raises, durable=durable) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@contextlib.contextmanager
def whole_file(path: Path, raises: Raises = FileError, *, durable: bool = False) -> Iterator[Path]:
    """Yield a hidden temporary path beside `path`, and rename it to `path` at the end; folders are made as needed.

    Nothing is left of a file that fails. An OSError is raised as `raises(line)`. `durable`: the content is on the disk
    before the rename, so that even a power failure leaves a whole file or none.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        if durable:
            _sync(part)
        os.replace(part, path)
        if durable:
            with contextlib.suppress(OSError):  # not every system can
                _sync(path.parent)
    except OSError as error:
        raise raises(cannot_write(path, error)) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def plain_name(name: str, otherwise: str) -> str:
    """A name from a file or a person as one part of a path: no separators, no dots at its ends, not long."""
    return re.sub(r"[^\w.-]+", "-", name)[:80].strip(".-") or otherwise


def check_writable(folder: Path, raises: Raises = FileError) -> None:
    """Raise `raises(line)` where files could not be written into `folder`, which need not exist. Makes nothing."""
    try:
        there = next(path for path in (folder, *folder.parents) if path.exists())
        if not there.is_dir():
            where = f"{folder}: " if there == folder else f"{folder}: cannot be written: {there}: "
            raise raises(f"{where}is a file; files can be written into a folder only")
        if not os.access(there, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:  # also a name that is too long
        raise raises(cannot_write(folder, error)) from error


def reason(error: OSError) -> str:
    """Return the system's reason for an error, as the end of a line."""
    return (error.strerror or str(error)).lower()


def cannot_write(path: Path, error: OSError) -> str:
    """The line that says that a file cannot be written, why, and what to do."""
    advice = ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        advice = "; make room and start the same command again"
    elif error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
        advice = "; give a folder that you may write to"
    return f"{path}: cannot be written: {reason(error)}{advice}"


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
