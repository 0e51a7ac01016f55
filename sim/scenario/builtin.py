"""Files that come with maxq: the folder scenarios/, which is package data (`maxq.scenarios`)."""

from __future__ import annotations

import importlib
from pathlib import Path

DATA_FOLDERS = ("vehicles", "designs", "winds", "campaigns", "suites", "layouts")
"""Folders of data that scenarios name; their files are no scenarios."""

FOLDERS = {
    "scenario": "", "campaign": "campaigns", "design": "designs", "case": "designs/cases", "suite": "suites",
    "layout": "layouts",
}  # fmt: skip  # a table
"""Below scenarios/, by the kind of file."""


def scenarios_folder() -> Path:
    """The folder of the package maxq.scenarios, which is the same in a checkout, a wheel and an editable installation.

    (importlib.resources cannot open a folder without __init__.py in an editable installation.)
    """
    return Path(importlib.import_module("maxq.scenarios").__path__[0])


def builtin_files(kind: str) -> dict[str, Path]:
    """The built-in files of a kind of FOLDERS by their names, such as `nominal`, `campaigns/ksr3`; sorted."""
    root = scenarios_folder()
    if kind not in ("scenario", "campaign"):
        return {path.stem: path for path in sorted((root / FOLDERS[kind]).glob("*.toml"))}
    names = {p.relative_to(root).with_suffix("").as_posix(): p for p in (root / FOLDERS[kind]).rglob("*.toml")}
    of_scenarios = kind == "scenario"
    return {n: names[n] for n in sorted(names) if not (of_scenarios and n.partition("/")[0] in DATA_FOLDERS)}


def builtin_names() -> list[str]:
    """Names of the built-in scenarios, such as `nominal` or `checkcases/nesc-01`, sorted."""
    return list(builtin_files("scenario"))
