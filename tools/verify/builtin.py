"""`simverify --list`: the suites and designs that come with maxq."""

from __future__ import annotations

import tomllib
from pathlib import Path

from maxq.design.case.design_file import builtin_designs, designs_folder
from maxq.design.verify.suite import builtin_suites, suites_folder
from maxq.tools.cli.terminal import aligned, printable


def show_list() -> int:
    """Print name and description of every built-in suite and design."""
    suites = [(name, _description(suites_folder() / f"{name}.toml")) for name in builtin_suites()]
    designs = [(name, _description(designs_folder() / f"{name}.toml")) for name in builtin_designs()]
    for title, rows in (("suites (simverify --suite SUITE)", suites), ("designs (simverify DESIGN)", designs)):
        print("\n".join([title, *aligned(rows, "  ")]))
    return 0


def _description(path: Path) -> str:
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    return printable(str(content.get("description", "")))
