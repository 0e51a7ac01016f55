"""Files of an earlier version of their format, brought to the present one: sections name the keys that have changed.

text, changes = upgraded_text(Path("old.toml").read_text(), Design, Source("old.toml"))
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from typing import Any, get_args

import tomli_w

from maxq.sim.scenario.documents import Source, parse
from maxq.sim.scenario.messages import section_of
from maxq.sim.scenario.schema_values import Section

VERSION = "schema_version"


def upgraded(given: dict[str, Any], section: type[Section], source: Source) -> tuple[dict[str, Any], list[str]]:
    """Return a document of a section with the present names of its keys, and a line on each change.

    Raises ScenarioError, about `source`, where an old key and the present one are both there.
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
    fields = {field.alias or name: field for name, field in section.model_fields.items()}
    out: dict[str, Any] = {}
    for key, value in given.items():
        here, at, below = (*path, key), out, section_of(fields[key].annotation) if key in fields else None
        if key in section.renamed:
            changes.append(f"{'.'.join(map(str, here))} is now {section.renamed[key]}")
        elif below is not None and isinstance(value, dict):
            value = _upgraded(value, below, source, here, changes)  # noqa: PLW2901  # the value to be put
        elif below is not None and isinstance(value, list):
            value = [  # noqa: PLW2901  # likewise
                _upgraded(item, below, source, (*here, n), changes) if isinstance(item, dict) else item
                for n, item in enumerate(value)
            ]
        elif key == "schema" and value == (newest := newest_version(section)) - 1:
            changes.append(f"{'.'.join(map(str, here))} is now {newest}")
            value = newest  # noqa: PLW2901  # likewise
        *tables, last = section.renamed.get(key, key).split(".")
        for table in tables:
            at = at.setdefault(table, {})
        if last in at or (key in section.renamed and section.renamed[key] in given):
            raise source.error(here, f"is given besides {section.renamed.get(key, key)}", allowed="one of them")
        at[last] = value
    return out


def newest_version(section: type[Section]) -> int:
    """Return the version of the format of a kind of file."""
    return int(get_args(section.model_fields[VERSION].annotation)[0]) if VERSION in section.model_fields else 0


def upgraded_text(text: str, section: type[Section], source: Source) -> tuple[str, list[str]]:
    """Return the text of a file in the present version of its format, and a line on each change.

    Comments and layout stay, unless keys are written in a way that a search for their names does not find: then the
    document is written again, without its comments, and the last line says so. Raises ScenarioError.
    """
    old = parse(text, source)
    wanted, changes = upgraded(old, section, source)
    if not changes:
        return text, changes
    names = dict(_renamed(section, set()))
    found = re.compile(rf"(?<![\w\"'-])({'|'.join(map(re.escape, names)) or '(?!)'})(?=\s*[=.\]])")
    renamed = found.sub(lambda m: names[m[1]], text)
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


def _renamed(section: type[Section], known: set[type[Section]]) -> Iterator[tuple[str, str]]:
    """Yield the old and the present names of keys of a section, and of the sections in it."""
    if section in known:
        return
    known.add(section)
    yield from section.renamed.items()
    for field in section.model_fields.values():
        below = section_of(field.annotation)
        if below is not None:
            yield from _renamed(below, known)
