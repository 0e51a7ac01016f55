"""`simrun --list` and `simrun --copy`: the scenarios that come with maxq."""

from __future__ import annotations

import shlex
import tomllib
from pathlib import Path
from typing import Any

from maxq.sim.scenario.builtin import builtin_names, builtin_path, campaign_names, campaign_path
from maxq.tools.cli.frame import Exit
from maxq.tools.cli.terminal import aligned, printable


def show_list() -> int:
    """Print name and description of every built-in scenario and campaign."""
    names = [*builtin_names(), *campaign_names()]
    print("\n".join(aligned([(name, _description(name)) for name in names])))
    return Exit.OK


def copy(name: str, folder: str) -> int:
    """Copy a scenario with its files, and say how to fly the copy."""
    from maxq.sim.scenario.copying import copy_scenario  # noqa: PLC0415  # lazy: --list needs no schema

    path = copy_scenario(name, folder)
    print(f"copied; fly it with: simrun {shlex.quote(str(path))}")
    return Exit.OK


def _description(name: str) -> str:
    """A scenario's own description, or that of the one it extends."""
    path = builtin_path(name) or campaign_path(name)
    while path is not None and path.is_file():
        content: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
        if content.get("description"):
            return printable(str(content["description"]))
        path = _beside(path, content.get("extends"))
    return ""


def _beside(path: Path, extends: str | None) -> Path | None:
    return path.parent / f"{extends.removesuffix('.toml')}.toml" if extends else None
