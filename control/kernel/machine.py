"""The resources of this machine: its cores, and the user's cache folder."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def own_cache(name: str) -> Path:
    """Return the cache folder `name` for machine code or results, and create it if it is missing.

    The folder is in `$MAXQ_CACHE`, or in the user's cache folder; `name` may be a path in it. Raises PermissionError if
    another user owns one of the folders or may write to it, because its content is executed and trusted.
    """
    base = os.environ.get("MAXQ_CACHE") or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "maxq"
    )
    wanted = Path(base) / name
    for folder in (Path(base), *(Path(base, *Path(name).parts[:n]) for n in range(1, len(Path(name).parts) + 1))):
        with contextlib.suppress(OSError):  # without a writable folder, results are computed again
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if hasattr(os, "getuid") and folder.exists():
            status = folder.stat()
            advice = "give a cache folder of your own to which no one else may write (chmod go-w)"
            if status.st_uid != os.getuid():
                raise PermissionError(errno.EACCES, f"this cache belongs to another user; {advice}", str(folder))
            if status.st_mode & 0o022:
                raise PermissionError(errno.EACCES, f"other users may write to this cache; {advice}", str(folder))
    return wanted
