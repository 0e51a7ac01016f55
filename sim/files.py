"""The output of files, which are written completely or not at all, with one-line messages of failures.

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
    """The error of a file that cannot be written, with a one-line message that names the file and the reason."""


Raises = Callable[[str], Exception]


def write_whole(path: Path, content: str | bytes, raises: Raises = FileError, *, durable: bool = False) -> Path:
    """Write text (UTF-8, newlines unchanged) or bytes by means of `whole_file`, and return `path`."""
    with whole_file(path, raises, durable=durable) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@contextlib.contextmanager
def whole_file(path: Path, raises: Raises = FileError, *, durable: bool = False) -> Iterator[Path]:
    """Yield a hidden temporary path in the folder of `path`, and rename it to `path` at the end.

    Missing folders are created. If writing fails, the temporary file is removed, and an OSError is raised as
    `raises(line)`. With `durable`, the content is flushed to the disk before the file is renamed, so that even a power
    failure leaves a complete file or none.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        if durable:
            _sync(part, os.O_RDWR)  # Windows flushes only what may be written
        os.replace(part, path)
        if durable:
            with contextlib.suppress(OSError):  # some systems cannot flush a folder
                _sync(path.parent, os.O_RDONLY)
    except OSError as error:
        raise raises(cannot_write(path, error)) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def plain_name(name: str, otherwise: str) -> str:
    """Return a name as a valid part of a path: at most 80 characters, no separators, and no dots or dashes at its ends.

    If no character of the name is left, the result is `otherwise`.
    """
    return re.sub(r"[^\w.-]+", "-", name)[:80].strip(".-") or otherwise


def check_writable(folder: Path, raises: Raises = FileError) -> None:
    """Raise `raises(line)` if files cannot be written into `folder`. The folder need not exist and is not created."""
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
    """Return the system's reason for an error in lower case, as the end of a message."""
    return (error.strerror or str(error)).lower()


def cannot_write(path: Path, error: OSError) -> str:
    """Return a message that a file cannot be written, with the reason and, for common reasons, a remedy."""
    advice = ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        advice = "; make room and start the same command again"
    elif error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
        advice = "; give a folder that you may write to"
    return f"{path}: cannot be written: {reason(error)}{advice}"


def _sync(path: Path, how: int) -> None:
    handle = os.open(path, how)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
