"""--list of every command: the files that come with maxq. Needs no schema."""

from __future__ import annotations

import tomllib
from pathlib import Path

from maxq.sim.scenario.builtin import builtin_files
from maxq.tools.cli.frame import Exit
from maxq.tools.cli.terminal import aligned, printable


def show_list(kinds: dict[str, str]) -> int:
    """Print name and description of the built-in files of each kind (of builtin.FOLDERS), below its title."""
    for kind, title in kinds.items():
        rows = [(name, _description(path)) for name, path in builtin_files(kind).items()]
        print("\n".join([*([title] if title else []), *aligned(rows, "  " if title else "")]))
    return Exit.OK


def _description(path: Path) -> str:
    """A file's own description, its first sentence, or that of the file it extends."""
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    if content.get("description"):
        return printable(str(content["description"])).split(". ")[0].rstrip(".")
    base = path.parent / f"{str(content.get('extends', '')).removesuffix('.toml')}.toml"
    return _description(base) if base.is_file() else ""
