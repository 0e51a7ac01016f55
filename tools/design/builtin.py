"""`simdesign --list`: the cases and designs that come with maxq."""

from __future__ import annotations

import tomllib
from pathlib import Path

from maxq.sim.scenario.builtin import scenarios_folder
from maxq.tools.cli.terminal import aligned, printable

CASES = "cases"


def cases_folder() -> Path:
    """Folder of the built-in cases."""
    return scenarios_folder() / "designs" / CASES


def builtin_cases() -> list[str]:
    """Names of the built-in cases, sorted."""
    return sorted(
        path.relative_to(cases_folder()).with_suffix("").as_posix() for path in cases_folder().rglob("*.toml")
    )


def show_list() -> int:
    """Print name and description of every built-in case and design."""
    designs = sorted((scenarios_folder() / "designs").glob("*.toml"))
    cases = [cases_folder() / f"{name}.toml" for name in builtin_cases()]
    for title, files in (("cases (simdesign CASE)", cases), ("designs (simdesign analyse DESIGN)", designs)):
        rows = [(path.stem, _description(path)) for path in files]
        print("\n".join([title, *aligned(rows, "  ")]))
    return 0


def _description(path: Path) -> str:
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    text = printable(str(content.get("description", "")))
    return text.split(". ")[0].rstrip(".")
