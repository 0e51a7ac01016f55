"""The upgrade of files from an earlier version of their format to the present version.

The sections of the schema define the changed keys:

    text, changes = upgraded_text(Path("old.toml").read_text(), Design, Source("old.toml"))
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator
from typing import Any, get_args

import tomli_w

from maxq.sim.input.documents import Source, parse
from maxq.sim.input.values import Section
from maxq.sim.scenario.messages import OBSOLETE, section_of

VERSION = "schema_version"


def upgraded(given: dict[str, Any], section: type[Section], source: Source) -> tuple[dict[str, Any], list[str]]:
    """Return a section's document with the present names of its keys, and a line for each change.

    Raises ScenarioError for `source` if an old key and its present name both exist.
    """
    changes: list[str] = []
    out = _upgraded(given, section, source, (), changes)
    if changes and "extends" not in given:
        missing = {key: value for key, value in section.earlier.items() if key not in given}
        changes += [f"{key} is given, {value!r}, which was the default" for key, value in missing.items()]
        out |= missing
    return out, changes


def _upgraded(
    given: dict[str, Any], section: type[Section], source: Source, path: tuple[str | int, ...], changes: list[str]
) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in given.items():
        here, at, below = (*path, key), out, _below(section, key)
        where = ".".join(map(str, here))
        if key in section.renamed:
            if not section.renamed[key]:
                changes.append(f"{where} {OBSOLETE}")
                continue
            changes.append(f"{where} is now {section.renamed[key]}")
        elif key == "unset" and isinstance(value, list):
            value = _present_paths(value, section, where, changes)  # noqa: PLW2901  # the value to be put
        elif key == "append" and isinstance(value, dict):  # its lists have the keys of the section itself
            value = _upgraded(value, section, source, here, changes)  # noqa: PLW2901  # likewise
        elif below is not None and isinstance(value, dict):
            value = _upgraded(value, below, source, here, changes)  # noqa: PLW2901  # likewise
        elif below is not None and isinstance(value, list):
            value = [  # noqa: PLW2901  # likewise
                _upgraded(item, below, source, (*here, n), changes) if isinstance(item, dict) else item
                for n, item in enumerate(value)
            ]
        elif key == "schema" and value == (newest := newest_version(section)) - 1:
            changes.append(f"{where} is now {newest}")
            value = newest  # noqa: PLW2901  # likewise
        *tables, last = section.renamed.get(key, key).split(".")
        for table in tables:
            at = at.setdefault(table, {})
        if last in at or (key in section.renamed and section.renamed[key] in given):
            raise source.error(here, f"is given in addition to {section.renamed.get(key, key)}", allowed="one of them")
        at[last] = value
    return out


def _below(section: type[Section] | None, key: str) -> type[Section] | None:
    """Return the section that a key, or a key `<part>_overrides`, contains; None if it contains none."""
    if section is None:
        return None
    fields = {field.alias or name: field for name, field in section.model_fields.items()}
    field = fields.get(key) or fields.get(key.removesuffix("_overrides"))
    return section_of(field.annotation) if field is not None else None


def _present_paths(old: list[Any], section: type[Section], where: str, changes: list[str]) -> list[Any]:
    """Return the key paths of a list `unset` with their present names, without obsolete keys."""
    out = []
    for path in old:
        new = _present_path(path, section) if isinstance(path, str) else path
        if new != path:
            changes.append(f"{where}: {path} {f'is now {new}' if new else OBSOLETE}")
        out += [new] if new else []
    return out


def _present_path(path: str, section: type[Section]) -> str:
    """Return the present form of a key path such as "limits.higher_modes_db"; empty if a key is obsolete."""
    parts, at = list[str](), section or None
    for part in path.split("."):
        new = part if at is None else at.renamed.get(part, part)
        if not new:
            return ""
        parts.append(new)
        at = at if part.isdecimal() else _below(at, part)
    return ".".join(parts)


def newest_version(section: type[Section]) -> int:
    """Return the present format version of the files described by a section; 0 if they have no version."""
    return int(get_args(section.model_fields[VERSION].annotation)[0]) if VERSION in section.model_fields else 0


def upgraded_text(text: str, section: type[Section], source: Source) -> tuple[str, list[str]]:
    """Return the text of a file in the present version of its format, and a line for each change.

    Comments and layout are kept if replacing the names of keys in the text gives the upgraded document. Otherwise, the
    document is written again without comments, and the last line reports this. Raises ScenarioError.
    """
    old = parse(text, source)
    wanted, changes = upgraded(old, section, source)
    if not changes:
        return text, changes
    names = dict(_renamed(section, set()))
    obsolete = _any_of(name for name, new in names.items() if not new)
    kept = re.sub(rf"^[ \t]*(?:[\w-]+\.)*{obsolete}\s*=.*\n?", "", text, flags=re.MULTILINE)  # on separate lines
    kept = re.sub(rf"(?<=[{{,])\s*{obsolete}\s*=[^,}}\n]*(?:,|(?=\}}))", "", kept)  # in tables on one line
    kept = re.sub(rf"""(["'])(?:[\w-]+\.)*{obsolete}\1\s*,?\s*""", "", kept)  # in `unset`
    in_paths = re.compile(rf"""(?<=["'.]){_any_of(names)}(?=(?:\.[\w-]+)*["'])""")
    in_keys = rf"""(?<![\w"'-]){_any_of(names)}(?=\s*[=.\]])"""

    def present(found: re.Match[str]) -> str:
        return in_paths.sub(lambda m: names[m[0]], found[0]) if found[0] not in names else names[found[0]]

    renamed = re.sub(rf"\bunset\s*=\s*\[[^\]]*\]|{in_keys}", present, kept)
    added = "".join(
        f'{key} = "{value}"\n' for key, value in section.earlier.items() if key in wanted.keys() - old.keys()
    )
    head = re.search(r"^\s*schema\s*=.*\n", renamed, re.MULTILINE)
    at = head.end() if head else 0
    renamed = renamed[:at] + added + renamed[at:]
    versions = [m.span(1) for m in re.finditer(r"^\s*schema\s*=\s*(\d+)", renamed, re.MULTILINE)]
    for begin, end in [(0, 0), *versions]:
        number = str(int(renamed[begin:end]) + 1) if end else ""
        trial = renamed[:begin] + number + renamed[end:]
        try:
            if tomllib.loads(trial) == wanted:
                return trial, changes
        except tomllib.TOMLDecodeError:
            continue
    return tomli_w.dumps(wanted), [*changes, "comments and layout are lost"]


def _any_of(names: Iterable[str]) -> str:
    """Return a regular expression that matches any of the names."""
    return f"(?:{'|'.join(map(re.escape, names)) or '(?!)'})"


def _renamed(section: type[Section], known: set[type[Section]]) -> Iterator[tuple[str, str]]:
    """Yield the old and present names of the renamed keys of a section and of all sections below it."""
    if section in known:
        return
    known.add(section)
    yield from section.renamed.items()
    for field in section.model_fields.values():
        below = section_of(field.annotation)
        if below is not None:
            yield from _renamed(below, known)
