"""The mutation test of the tests draws its mutants from every module that is installed."""

from __future__ import annotations

import tomllib
from collections import Counter
from pathlib import Path

from maxq.tools.dev import mutations

ROOT = Path(__file__).resolve().parents[1]


def test_mutants_are_drawn_from_every_installed_module_once() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = [name.removeprefix("maxq").strip(".").replace(".", "/") or "api" for name in listed]
    installed = {path for folder in folders for path in (ROOT / folder).glob("*.py")}
    by_package = mutations.modules_of_packages()
    assert Counter(path for paths in by_package.values() for path in paths) == Counter(installed)
    for package, name in (
        ("input to run", "sim/packing/flight.py"),
        ("input to run", "sim/files.py"),
        ("sim/flight", "sim/world/earth.py"),
        ("statistics", "design/verify/suite.py"),
        ("design", "design/quantities.py"),
        ("tools", "tools/simrun.py"),
    ):
        assert ROOT / name in by_package[package]
