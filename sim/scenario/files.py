"""Finding and reading the files that a scenario is made of."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from maxq.sim.scenario.builtin import scenarios_folder
from maxq.sim.scenario.documents import Text, decode
from maxq.sim.scenario.errors import ScenarioError, refuse, suggestion

VEHICLE_FILE = "vehicle.toml"
TABLE_VARIANTS = ("{}",)


@dataclass(frozen=True)
class ReadFile:
    """A file that was read: where, how it is shown to people, and its bytes."""

    path: Path
    shown: str
    content: bytes


def shown(path: Path) -> str:
    """A path for people: relative to the working folder when it lies below it."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


def kind(path: Path) -> str:
    """`file`, `folder`, `other` (a device, a pipe), or empty when there is nothing."""
    try:
        if path.is_file():
            return "file"
        if path.is_dir():
            return "folder"
        return "other" if path.exists() else ""
    except PermissionError:
        return "file"  # reading it will say what is wrong
    except (OSError, ValueError):  # a name that is too long, or holds a zero byte
        return ""


def read(path: Path, label: str) -> bytes:
    """Content of a file; ScenarioError when the system will not give it."""
    try:
        return path.read_bytes()
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise ScenarioError(label, f"cannot be read: {reason}", allowed="a file you may read") from None


def find(name: Text, variants: Iterable[str]) -> Path | None:
    """The first file there is: `name` with each of `variants` ("{}.toml") in each folder of its source."""
    for folder in name.source.folders:
        for variant in variants:
            path = folder / variant.format(name)
            if kind(path) == "file":
                return Path(os.path.normpath(path))
    return None


def not_found(name: Text, wanted: str, variants: Iterable[str]) -> tuple[str, str]:
    """What is wrong with a name for which `find` found none of the `variants`, and what is allowed."""
    if not name.source.folders:
        return "names a file, which a scenario given as text cannot do", "the content itself"
    for folder in name.source.folders:
        here = kind(folder / name)
        if here:
            return ("is a folder" if here == "folder" else "is no ordinary file"), wanted
    folders = dict.fromkeys(f"{shown(folder)}/" for folder in name.source.folders)
    hint = _nearest(name, variants)
    return "no such file" + (f"; {hint}" if hint else ""), f"{wanted}, looked for in {', '.join(folders)}"


def _nearest(name: Text, variants: Iterable[str]) -> str:
    """`did you mean x?` for a built-in file of this name in another folder, or one like it beside the place meant."""
    asked, root = Path(name), scenarios_folder()
    table = tuple(variants) == TABLE_VARIANTS

    def fits(path: Path) -> bool:
        if path.suffix == (".csv" if table else ".toml"):
            return kind(path) == "file"
        return not table and kind(path / VEHICLE_FILE) == "file"

    if root in name.source.folders:
        for path in sorted(root.rglob("*")):
            if "campaigns" in path.relative_to(root).parts:  # no scenario names a campaign
                continue
            if asked.name in (path.name, path.stem) and fits(path):
                return f"did you mean {path.relative_to(root).as_posix()}?"
    beside: list[str] = []
    for folder in name.source.folders:
        with contextlib.suppress(OSError, ValueError):  # there is no such folder, or it may not be read
            there = sorted((folder / asked).parent.iterdir())
            beside += [str(asked.with_name(path.name)) for path in there if fits(path)]
    return suggestion(str(name), beside)


@dataclass
class Reading:
    """Files read so far; also the validation context, through which the schema reads its tables."""

    known_metrics: tuple[str, ...] | None = None
    files: dict[Path, ReadFile] = field(default_factory=dict)

    def text(self, path: Path, label: str, what: str) -> str:
        """Content of a file as text; noted among `files`."""
        if path not in self.files:
            self.files[path] = ReadFile(path, label, read(path, label))
        return decode(self.files[path].content, label, what)

    def read_table(self, name: Text) -> tuple[str, str]:
        """How the CSV file `name` is shown to people, and its text (for the schema)."""
        path = find(name, TABLE_VARIANTS)
        if path is None:
            raise refuse(*not_found(name, "a CSV file", TABLE_VARIANTS))
        label = shown(path)
        return label, self.text(path, label, "a CSV file")


def named_file(name: str, folder: Path, wanted: str) -> tuple[Path, str]:
    """A file by its path, or a built-in one of `folder` by its name, with or without `.toml`; and how it is shown.

    Raises ScenarioError where there is neither, with `wanted` as what is allowed.
    """
    path = Path(name)
    if name and kind(path) == "file":
        return path.resolve(), name
    stem, names = name.removesuffix(".toml"), sorted(file.stem for file in folder.glob("*.toml"))
    if stem in names:
        return folder / f"{stem}.toml", shown(folder / f"{stem}.toml")
    problem = {"folder": "is a folder", "other": "is no ordinary file"}.get(kind(path) if name else "", "no such file")
    hint = suggestion(stem, names)
    listed = "" if hint else " or a built-in one: " + ", ".join(names)
    raise ScenarioError(name or '""', f"{problem}; {hint}" if hint else problem, allowed=wanted + listed)
