"""Finding and reading the files that a scenario, a case or a suite is made of; those that come with maxq.

These lie in the folder scenarios/, which is package data (`maxq.scenarios`).
"""

from __future__ import annotations

import contextlib
import glob
import importlib
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maxq.sim.input.documents import Source, Text, TomlArray, TomlTable, drop, merge, parse
from maxq.sim.input.errors import ScenarioError, refuse, suggestion

DATA_FOLDERS = ("vehicles", "designs", "winds", "campaigns", "suites", "layouts")
"""Folders of data that scenarios name; their files are no scenarios."""

FOLDERS = {
    "scenario": "", "campaign": "campaigns", "design": "designs", "case": "designs/cases", "suite": "suites",
    "layout": "layouts",
}  # fmt: skip  # a table
"""Below scenarios/, by the kind of file."""

VEHICLE_FILE = "vehicle.toml"
TABLE_VARIANTS = ("{}",)
_FILE_VARIANTS = ("{}", "{}.toml")
_VARIANTS = {"vehicle": ("{}", "{}/vehicle.toml", "{}.toml")}
WANTED = {
    "scenario": "a scenario file (.toml)",
    "vehicle": "a folder with vehicle.toml, or a .toml file",
    "design": "a design file (.toml)",
    "case": "a case file (.toml)",
    "suite": "a suite (.toml)",
    "layout": "a layout file (.toml)",
}
"""What is allowed where a file of this kind is named."""

PARTS = ("vehicle", "design")
"""What a scenario names by file, besides tables."""

_LISTED_BY = {"scenario": "simrun", "case": "simdesign", "suite": "simverify", "layout": "simvehicle"}


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


def find(name: Text, variants: Iterable[str] = TABLE_VARIANTS) -> Path | None:
    """The first file there is: `name` with each of `variants` ("{}.toml") in each folder of its source."""
    for folder in name.source.folders:
        for variant in variants:
            path = folder / variant.format(name)
            if kind(path) == "file":
                return Path(os.path.normpath(path))
    return None


def not_found(name: Text, wanted: str, variants: Iterable[str]) -> tuple[str, str]:
    """Return the fault of a name for which `find` found none of the `variants`, and the allowed names."""
    if not name.source.folders:
        return "names a file, which a scenario given as text cannot do", "the content itself"
    for folder in name.source.folders:
        here = kind(folder / name)
        if here:
            return ("is a folder" if here == "folder" else "is not an ordinary file"), wanted
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
            if {"campaigns", "layouts"}.intersection(path.relative_to(root).parts):  # no scenario names one
                continue
            if asked.name in (path.name, path.stem) and fits(path):
                return f"did you mean {path.relative_to(root).as_posix()}?"
    beside: list[str] = []
    for folder in name.source.folders:
        with contextlib.suppress(OSError, ValueError):  # there is no such folder, or it may not be read
            there = sorted((folder / asked).parent.iterdir())
            beside += [str(asked.with_name(path.name)) for path in there if fits(path)]
    return suggestion(str(name), beside)


def _below(path: Path) -> str:
    """`did you mean x?` for a file of this name one or two folders below: --copy keeps the folders of its files."""
    with contextlib.suppress(OSError, ValueError):
        for pattern in ("*/", "*/*/"):
            for found in sorted(path.parent.glob(pattern + glob.escape(path.name))) if path.parent != Path() else ():
                return f"did you mean {found}?"
    return ""


def locate(name: str, role: str) -> tuple[Path, str]:
    """The file that a person means by `name`, or the built-in one of that name, with or without `.toml`; and how it is
    shown. `role` is a kind of WANTED. Raises ScenarioError where there is neither.
    """
    there = kind(Path(name)) if name else ""
    if there == "file":
        return Path(name).resolve(), name
    stem, known = name.removesuffix(".toml"), builtin_files(role)
    if role == "scenario":
        known |= builtin_files("campaign")
    if stem in known:
        return known[stem], shown(known[stem])
    hint = _below(Path(f"{stem}.toml")) or suggestion(stem, known)
    as_a_file = not name.isidentifier() or hint  # a bare word may have been meant as one of ours
    missing = "no such file" if as_a_file else f"neither a file nor a built-in {role}"
    problem = {"folder": "is a folder", "other": "is not an ordinary file"}.get(there, missing)
    listed = "" if hint else f", or a built-in {role} ({_LISTED_BY[role]} --list names them)"
    raise ScenarioError(name or '""', f"{problem}; {hint}" if hint else problem, allowed=WANTED[role] + listed)


@dataclass
class Reading:
    """Files read so far; also the validation context, through which the schema reads its tables."""

    files: dict[Path, ReadFile] = field(default_factory=dict)
    soundings: dict[str, Any] = field(default_factory=dict)  # of wind files that hold them, see soundings.py

    def content(self, path: Path, label: str) -> bytes:
        """Content of a file; noted among `files`."""
        if path not in self.files:
            try:
                self.files[path] = ReadFile(path, label, path.read_bytes())
            except OSError as error:
                reason = (error.strerror or str(error)).lower()
                raise ScenarioError(label, f"cannot be read: {reason}", allowed="a file you may read") from None
        return self.files[path].content

    def text(self, path: Path, label: str, what: str) -> str:
        """Content of a file as text; noted among `files`. `what` names what was expected."""
        content = self.content(path, label)
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            problem = f"is not text: byte 0x{content[error.start]:02x} at position {error.start}"
            raise ScenarioError(label, problem, allowed=f"{what} in UTF-8") from None
        if "\0" in text:
            raise ScenarioError(label, "is a binary file: it holds zero bytes", allowed=f"{what} in UTF-8")
        return text

    def read_table(self, name: Text) -> tuple[str, str]:
        """Return the displayed name of the CSV file `name`, and its text (for the schema)."""
        path = find(name)
        if path is None:
            raise refuse(*not_found(name, "a CSV file", TABLE_VARIANTS))
        label = shown(path)
        return label, self.text(path, label, "a CSV file")

    def files_in(self, name: Text) -> list[Text]:
        """The files in a folder, in the order of their names; `name` itself where it is no folder."""
        for folder in name.source.folders:
            if kind(folder / name) == "folder":
                return [name.like(f"{name}/{p.name}") for p in sorted((folder / name).iterdir()) if kind(p) == "file"]
        return [name]

    def document(
        self, path: Path, label: str, role: str, chain: tuple[Path, ...] = (), *, ignore_unset: bool = False
    ) -> TomlTable:
        """Return the document in a file on top of the one that it extends. `role` is a kind of WANTED.

        `ignore_unset`: keep the keys that the file removes, as one of an earlier version may name them by other names.
        """
        within = (role,) if role in PARTS else ()
        beside = scenarios_folder() / FOLDERS[role] if role in ("case", "suite", "layout") else scenarios_folder()
        source = Source(label, (path.parent, beside), within)
        table = parse(self.text(path, label, "a TOML file"), source)
        if ignore_unset and "extends" in table:
            table.pop("unset", None)
        return self.extended(table, role, (*chain, path))

    def named(
        self, name: Text, where: Source, key: tuple[str, ...], role: str, chain: tuple[Path, ...] = ()
    ) -> TomlTable:
        """The document in the file that the value `name` of `key` names."""
        variants = _VARIANTS.get(role, _FILE_VARIANTS)
        path = find(name, variants)
        if path is None:
            problem, allowed = not_found(name, WANTED[role], variants)
            if role == "vehicle" and any(kind(folder / name) == "folder" for folder in name.source.folders):
                problem = "the folder has no vehicle.toml"
            raise where.error(key, problem, value=name, allowed=allowed)
        if path in chain:
            loop = " -> ".join(shown(p) for p in (*chain[chain.index(path) :], path))
            raise where.error(key, f"files extend each other in a loop: {loop}", value=name)
        return self.document(path, shown(path), role, chain)

    def extended(self, table: TomlTable, role: str, chain: tuple[Path, ...] = ()) -> TomlTable:
        """`table` on top of the file that its key `extends` names, less the keys that `unset` takes away."""
        source, within = table.source, (role,) if role in PARTS else ()
        name, unset = table.pop("extends", None), table.pop("unset", None)
        if name is None:
            if unset is not None:
                raise source.error((*within, "unset"), "there is nothing to remove keys from", allowed="with extends")
            return table
        where = (*within, "extends")
        if not isinstance(name, Text):
            raise source.error(where, "has the wrong type", value=name, allowed=f"the name of {WANTED[role]}")
        base = self.named(name, source, where, role, chain)
        base.pop("name", None)  # a file is named after itself unless it says otherwise
        if unset is not None and not (isinstance(unset, TomlArray) and all(isinstance(item, str) for item in unset)):
            allowed = "a list of keys, e.g. ['wind.profile']"
            raise source.error((*within, "unset"), "has the wrong type", value=unset, allowed=allowed)
        for item in unset or ():
            drop(base, tuple(item.split(".")), source, (*within, "unset"))
        merge(base, table)
        base.source = source
        return base
