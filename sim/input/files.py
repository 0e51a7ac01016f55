"""The search and reading of the files of a scenario, a case or a suite, including maxq's built-in files.

Built-in files are in the folder scenarios/, which is package data (`maxq.scenarios`).

A name denotes the same file in every working folder (`locate`, `find`):

- A built-in name as printed by --list (standard, nominal, campaigns/ksr3) denotes the shipped file. In an override, so
  does a path below scenarios/ (winds/anheung-november.csv, vehicles/ksr3, designs/ksr3-robust.toml).
- Any other name is a path. `./standard`, `standard.toml` and an absolute path denote a file of the user. If there is no
  such file, a name with .toml denotes the shipped file.
- A path in a file is searched for in the folder of that file, then below scenarios/. In cases, suites and layouts that
  name scenarios, campaigns or other such files, a built-in name denotes the shipped file, as above.

A `NameNote` reports a file of the working folder that has a built-in name.
"""

from __future__ import annotations

import contextlib
import glob
import importlib
import os
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from maxq.sim.input.documents import COMMAND_LINE, Source, Text, TomlArray, TomlTable, append, drop, merge, parse
from maxq.sim.input.errors import ScenarioError, refuse, suggestion

DATA_FOLDERS = ("vehicles", "designs", "winds", "campaigns", "suites", "layouts", "points")
"""The folders of data that scenarios name; their files are not scenarios."""

FOLDERS = {
    "scenario": "", "campaign": "campaigns", "design": "designs", "case": "designs/cases", "suite": "suites",
    "layout": "layouts", "points": "points",
}  # fmt: skip  # a table
"""The folders below scenarios/, by the kind of file."""

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
    "points": "a file of published derivatives (.toml)",
}
"""The allowed forms of a name, by the kind of file."""

DOCUMENT_KEYS = ("extends", "unset", "append")
"""The keys by which a file changes another one."""

PARTS = ("vehicle", "design")
"""The parts of a scenario that may be named by file instead of given as tables."""

_LISTED_ALONE = ("case", "suite", "layout", "points")
"""The kinds of files that a file of the same kind can name by the built-in name alone."""

_LISTED_BY = {
    "scenario": "simrun",
    "design": "simverify",
    "case": "simdesign",
    "suite": "simverify",
    "layout": "simvehicle",
    "points": "simdesign",
}


class NameNote(UserWarning):
    """A note that a built-in name is also the name of a user's file, which was not read."""


def scenarios_folder() -> Path:
    """Return the folder of the package maxq.scenarios, the same in a checkout, a wheel and an editable installation.

    (importlib.resources cannot open a folder without __init__.py in an editable installation.)
    """
    return Path(importlib.import_module("maxq.scenarios").__path__[0])


def builtin_files(kind: str) -> dict[str, Path]:
    """Return the built-in files of a kind of FOLDERS by name, such as `nominal` or `campaigns/ksr3`, sorted.

    The folders are searched once in a process, which takes a third of the time of loading a scenario a second time.
    """
    return dict(_files_below(scenarios_folder(), kind))


@cache
def _files_below(root: Path, kind: str) -> dict[str, Path]:
    if kind not in ("scenario", "campaign"):
        return {path.stem: path for path in sorted((root / FOLDERS[kind]).glob("*.toml"))}
    names = {p.relative_to(root).with_suffix("").as_posix(): p for p in (root / FOLDERS[kind]).rglob("*.toml")}
    of_scenarios = kind == "scenario"
    return {n: names[n] for n in sorted(names) if not (of_scenarios and n.partition("/")[0] in DATA_FOLDERS)}


def builtin_names() -> list[str]:
    """Return the names of the built-in scenarios, such as `nominal` or `checkcases/nesc-01`, sorted."""
    return list(builtin_files("scenario"))


@dataclass(frozen=True)
class ReadFile:
    """A file that was read: its path, its name in messages, and its bytes."""

    path: Path
    shown: str
    content: bytes


def shown(path: Path) -> str:
    """Return a path for messages, relative to the working folder if it is inside that folder."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


def kind(path: Path) -> str:
    """Return `file`, `folder`, `other` (a device, a pipe), or an empty string if nothing exists."""
    try:
        if path.is_file():
            return "file"
        if path.is_dir():
            return "folder"
        return "other" if path.exists() else ""
    except PermissionError:
        return "file"  # the attempt to read it reports the error
    except (OSError, ValueError):  # the name is too long, or contains a zero byte
        return ""


def find(name: Text, variants: Iterable[str] = TABLE_VARIANTS) -> Path | None:
    """Return the first existing file: `name` with each of `variants` ("{}.toml") in each folder of its source.

    In an override, a shipped file of that path has priority.
    """
    folders, shipped = name.source.folders, scenarios_folder()
    overriding = name.source.label == COMMAND_LINE and shipped in folders and not names_a_path(name)
    for folder in (shipped, *folders) if overriding else folders:
        for variant in variants:
            path = folder / variant.format(name)
            if kind(path) == "file":
                if overriding and folder == shipped:
                    others = (other / variant.format(name) for other in folders)
                    note_other(name, next((p for p in others if kind(p) == "file" and not p.samefile(path)), None))
                return Path(os.path.normpath(path))
    return None


def names_a_path(name: str) -> bool:
    """Return True for an absolute path, and for one that begins with ./ or ../.

    Such a path never denotes a shipped file.
    """
    return os.path.isabs(name) or name.startswith(("./", "../"))


def note_other(name: str, other: Path | None) -> None:
    """Warn that the built-in `name` is used instead of the user's file of that name, if that file exists."""
    if other is not None:
        theirs = shown(other.absolute())
        theirs = theirs if names_a_path(theirs) else f"./{theirs}"
        warnings.warn(f"{name} is the one that comes with maxq; the other file is {theirs}", NameNote, stacklevel=2)


def note_here(name: str, shipped: Path, variants: Iterable[str] = ("{}", "{}.toml")) -> None:
    """Warn if the working folder contains a file with a built-in name other than the file `shipped` itself."""
    found = (Path(variant.format(name)) for variant in variants)
    note_other(name, next((path for path in found if kind(path) == "file" and not path.samefile(shipped)), None))


def not_found(name: Text, wanted: str, variants: Iterable[str]) -> tuple[str, str]:
    """Return the problem and the allowed forms of a name, of which `find` found none of the `variants`."""
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
    """Return `did you mean x?` for a built-in file in another folder, or a similar name in the intended folder."""
    asked, root = Path(name), scenarios_folder()
    table = tuple(variants) == TABLE_VARIANTS

    def fits(path: Path) -> bool:
        if path.suffix == (".csv" if table else ".toml"):
            return kind(path) == "file"
        return not table and kind(path / VEHICLE_FILE) == "file"

    if root in name.source.folders:
        for path in sorted(root.rglob("*")):
            if {"campaigns", "layouts"}.intersection(path.relative_to(root).parts):  # no scenario names such a file
                continue
            if asked.name in (path.name, path.stem) and fits(path):
                return f"did you mean {path.relative_to(root).as_posix()}?"
    beside: list[str] = []
    for folder in name.source.folders:
        with contextlib.suppress(OSError, ValueError):  # there is no such folder, or it cannot be read
            there = sorted((folder / asked).parent.iterdir())
            beside += [str(asked.with_name(path.name)) for path in there if fits(path)]
    return suggestion(str(name), beside)


def _below(path: Path) -> str:
    """Return `did you mean x?` for a file of this name one or two folders below the intended folder.

    Such a file is plausible, because simrun --copy keeps the folders of its files.
    """
    with contextlib.suppress(OSError, ValueError):
        for pattern in ("*/", "*/*/"):
            for found in sorted(path.parent.glob(pattern + glob.escape(path.name))) if path.parent != Path() else ():
                return f"did you mean {found}?"
    return ""


def locate(name: str, role: str) -> tuple[Path, str]:
    """Return the built-in file of that name, or the file at that path, and its name in messages.

    `role` is a kind of WANTED. Raises ScenarioError if there is neither.
    """
    known = builtin_files(role) | (builtin_files("campaign") if role == "scenario" else {})
    if name in known:
        note_here(name, known[name])
        return known[name], shown(known[name])
    there = kind(Path(name)) if name else ""
    if there == "file":
        return Path(name).resolve(), name
    stem = name.removesuffix(".toml")
    if stem in known:
        return known[stem], shown(known[stem])
    hint = _below(Path(f"{stem}.toml")) or suggestion(stem, known)
    as_a_file = not name.isidentifier() or hint  # a bare word may denote a built-in file
    called = "file of derivatives" if role == "points" else role
    missing = "no such file" if as_a_file else f"neither a file nor a built-in {called}"
    problem = {"folder": "is a folder", "other": "is not an ordinary file"}.get(there, missing)
    listed = "" if hint else f", or a built-in {called} ({_LISTED_BY[role]} --list names them)"
    raise ScenarioError(name or '""', f"{problem}; {hint}" if hint else problem, allowed=WANTED[role] + listed)


def named_in_file(name: Text, file: Path) -> str:
    """Return a name that denotes, in any folder, the file that `name` denotes in the case or suite `file`.

    A built-in name is unchanged, that of a file in the folder becomes its path, and any other name is unchanged.
    """
    known, root = builtin_files("scenario") | builtin_files("campaign"), scenarios_folder()
    path = find(name, _FILE_VARIANTS)
    if name in known:
        note_other(name, None if path is None or path in (file, known[name]) else path)
        return str(name)
    text = str(name)
    if path is not None and path != file:
        ours = path.is_relative_to(root)
        text = path.relative_to(root).as_posix() if ours else shown(path)
        if not ours and not names_a_path(text) and kind(root / text) == "file":
            text = f"./{text}"
    stem = text.removesuffix(".toml")
    return stem if stem in known else text


@dataclass
class Reading:
    """The files read so far; also the validation context through which the schema reads its tables."""

    files: dict[Path, ReadFile] = field(default_factory=dict)
    soundings: dict[str, Any] = field(default_factory=dict)  # soundings by wind file, see soundings.py

    def content(self, path: Path, label: str) -> bytes:
        """Return the content of a file, and record it in `files`."""
        if path not in self.files:
            try:
                self.files[path] = ReadFile(path, label, path.read_bytes())
            except OSError as error:
                reason = (error.strerror or str(error)).lower()
                raise ScenarioError(label, f"cannot be read: {reason}", allowed="a file you may read") from None
        return self.files[path].content

    def text(self, path: Path, label: str, what: str) -> str:
        """Return the content of a file as text, and record it in `files`.

        `what` names the expected content in messages.
        """
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
        """Return the name in messages of the CSV file `name`, and its text (for the schema)."""
        path = find(name)
        if path is None:
            raise refuse(*not_found(name, "a CSV file", TABLE_VARIANTS))
        label = shown(path)
        return label, self.text(path, label, "a CSV file")

    def files_in(self, name: Text) -> list[Text]:
        """Return the files in a folder in the order of their names, or `name` itself if it is not a folder."""
        for folder in name.source.folders:
            if kind(folder / name) == "folder":
                return [name.like(f"{name}/{p.name}") for p in sorted((folder / name).iterdir()) if kind(p) == "file"]
        return [name]

    def document(
        self, path: Path, label: str, role: str, chain: tuple[Path, ...] = (), *, ignore_unset: bool = False
    ) -> TomlTable:
        """Return the document in a file, merged over the document that it extends; `role` is a kind of WANTED.

        `ignore_unset`: keep the keys that the file removes, because a file of an earlier version may use other names
        for them.
        """
        within = (role,) if role in PARTS else ()
        beside = scenarios_folder() / FOLDERS[role] if role in _LISTED_ALONE else scenarios_folder()
        source = Source(label, (path.parent, beside), within)
        table = parse(self.text(path, label, "a TOML file"), source)
        if ignore_unset and "extends" in table:
            table.pop("unset", None)
        return self.extended(table, role, (*chain, path))

    def named(
        self, name: Text, where: Source, key: tuple[str, ...], role: str, chain: tuple[Path, ...] = ()
    ) -> TomlTable:
        """Return the document in the file that the value `name` of `key` names."""
        variants = _VARIANTS.get(role, _FILE_VARIANTS)
        shipped = builtin_files(role) if role in _LISTED_ALONE else {}
        path = shipped[name] if name in shipped else find(name, variants)
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
        """Return `table` merged over the file that its key `extends` names.

        The keys in `unset` are removed before, and the elements of the lists in `append` are added at the end.
        """
        source, within = table.source, (role,) if role in PARTS else ()
        name, unset, more = (table.pop(key, None) for key in DOCUMENT_KEYS)
        if name is None:
            if unset is not None:
                raise source.error((*within, "unset"), "there is nothing to remove keys from", allowed="with extends")
            if more is not None:
                raise source.error((*within, "append"), "there is no list to append to", allowed="with extends")
            return table
        where = (*within, "extends")
        if not isinstance(name, Text):
            raise source.error(where, "has the wrong type", value=name, allowed=f"the name of {WANTED[role]}")
        base = self.named(name, source, where, role, chain)
        base.pop("name", None)  # the default name is that of the file itself
        if unset is not None and not (isinstance(unset, TomlArray) and all(isinstance(item, str) for item in unset)):
            allowed = "a list of keys, e.g. ['wind.profile']"
            raise source.error((*within, "unset"), "has the wrong type", value=unset, allowed=allowed)
        for item in unset or ():
            drop(base, tuple(item.split(".")), source, (*within, "unset"))
        if not isinstance(more, TomlTable | None):
            allowed = "a table of lists, e.g. [[append.flight]]"
            raise source.error((*within, "append"), "has the wrong type", value=more, allowed=allowed)
        merge(base, table)
        base.source = source
        append(base, more or TomlTable(source))
        return base
