"""Compile flight code from C where a compiler is installed, and build scenarios that fly it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from maxq.control.external import HEADER

EXAMPLES = Path(__file__).resolve().parents[1] / "examples" / "flight_software"
COMPILER = next((c for c in ("cc", "gcc", "clang") if shutil.which(c)), None)
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2", "-ffp-contract=off")

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler (cc, gcc, clang) on this machine")


def compiled(folder: Path, source: Path, name: str, *flags: str, program: bool = False) -> Path:
    """Compile one C file into a shared library or a program. Warnings are errors."""
    out = folder / (name if program else f"lib{name}.so")
    shared = () if program else ("-shared", "-fPIC")
    words = [str(COMPILER), *STRICT, *shared, *flags, "-I", str(HEADER.parent), "-o", str(out), str(source), "-lm"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out


def flies(**computer: object) -> list[str]:
    """Return overrides that make a scenario fly external code."""
    return ["vehicle.computer.law=external", *(f"vehicle.computer.{key}={value}" for key, value in computer.items())]
