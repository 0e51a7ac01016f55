"""Build slow files once for all workers of a test run."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from filelock import FileLock


def copy_of(name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder of this process with the files that `make` writes into a folder.

    The first worker that requests `name` makes the files, and the others wait for them.
    """
    shared = Path(os.environ["MAXQ_TEST_FILES"])  # by conftest.py
    with FileLock(shared / f"{name}.lock"):
        if not (shared / name).exists():
            begun = Path(tempfile.mkdtemp(prefix=name, dir=shared))
            make(begun)
            begun.rename(shared / name)
    return shutil.copytree(shared / name, Path(tempfile.mkdtemp(prefix=f"{name}-", dir=shared)), dirs_exist_ok=True)
