"""Import of a Python file of the user, and the description of its errors."""

from __future__ import annotations

import importlib.util
import os
import sys
from functools import lru_cache
from pathlib import Path
from types import ModuleType


class ImportFailure(Exception):
    """The failure to import a Python file. The message is one line."""


@lru_cache(maxsize=8)
def imported(file: str, sha256: str) -> ModuleType:
    """Return the module in a Python file, which may import other files of its folder. Raises ImportFailure.

    Compiled modules in folders __pycache__ are not used, because the hash of the code does not cover them.
    """
    spec = importlib.util.spec_from_file_location(f"maxq_flight_code_{sha256[:12]}", file)
    if spec is None or spec.loader is None:
        raise ImportFailure("is no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    beside, elsewhere, writes_not = str(Path(file).parent), sys.pycache_prefix, sys.dont_write_bytecode
    sys.path.insert(0, beside)
    try:
        sys.pycache_prefix, sys.dont_write_bytecode = os.devnull, True
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[spec.name]
        raise ImportFailure(described(error)) from None
    finally:
        sys.path.remove(beside)
        sys.pycache_prefix, sys.dont_write_bytecode = elsewhere, writes_not
    return module


def described(error: BaseException) -> str:
    """Return a one-line description of an exception in a file of the user, with this file and its line."""
    trace, at = error.__traceback__, ""
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        if not file.startswith(str(Path(__file__).parents[1])) and "importlib" not in file:
            at = f" ({Path(file).name}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return " ".join(f"{type(error).__name__}: {error}".split()) + at
