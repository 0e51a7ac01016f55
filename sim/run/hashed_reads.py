"""The restriction of guarded Python flight code to reading hashed files and files of the installation.

An audit hook detects files that Python opens. It does not detect files that compiled code opens, paths relative to an
open folder (`dir_fd`), processes or sockets.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from maxq.control.kernel.machine import own_cache
from maxq.sim.scenario.flight_code import CodeFile

SYSTEM = ("/dev", "/etc", "/proc", "/sys", "/usr", "/lib", "/lib64")
_MODULES = (".py", ".pyc", ".so", ".pyd")


class UnhashedFile(PermissionError):
    """The error of flight code that opens a file without a hash."""


def installed_folders() -> tuple[str, ...]:
    """Return the folders of Python, its packages, the system and the cache of maxq, whose files need no hash."""
    here, packages = os.getcwd(), [path for path in sys.path if path.rstrip(os.sep).endswith("-packages")]
    prefixes = {sys.prefix, sys.base_prefix, sys.exec_prefix, os.path.dirname(os.__file__), *packages}
    every = (*prefixes, *SYSTEM, str(own_cache("")))
    return tuple(os.path.realpath(path) for path in every if path not in ("", "/", here))


def only_hashed_reads(code: Iterable[CodeFile]) -> None:
    """Restrict this process, permanently, to reading the files of `code` and of the installation.

    Any attempt to open another existing file for reading then raises UnhashedFile.
    """
    allowed, roots = {os.path.realpath(path) for one in code for path in one.paths}, installed_folders()
    own = os.path.realpath(Path(__file__).parents[2])

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event not in ("open", "sqlite3.connect") or isinstance(arguments[0], int):
            return
        mode, flags = (arguments[1], arguments[2]) if event == "open" else ("r", 0)
        if isinstance(mode, str) and not {"r", "+"} & set(mode):
            return
        if mode is None and flags & os.O_ACCMODE == os.O_WRONLY:
            return
        path = os.path.realpath(os.fsdecode(arguments[0]))
        of_maxq = path.startswith(own + os.sep) and path.endswith(_MODULES)
        if path in allowed or of_maxq or any(path.startswith(root + os.sep) for root in roots):
            return
        if os.path.exists(path) and not os.path.isdir(path):
            raise UnhashedFile(f"opens {path}, which no hash covers; name it in vehicle.computer.data")

    sys.addaudithook(hook)
