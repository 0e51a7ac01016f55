"""The public API has the names and signatures of tests/data/public_api.txt, and docs/python.md lists them.

After a change that docs/python.md allows: `python tests/test_usage_public_api.py > tests/data/public_api.txt`.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import maxq

ROOT = Path(__file__).resolve().parents[1]
SNAPSHOT = ROOT / "tests" / "data" / "public_api.txt"
ON_PAGE = re.compile(r"^\.\. auto(?:function|class|exception):: (\w+)\n((?:   :.*\n)*)", re.MULTILINE)


def documented() -> dict[str, str]:
    """Return the names on docs/python.md, each with the options of its directive."""
    return dict(ON_PAGE.findall((ROOT / "docs" / "python.md").read_text(encoding="utf-8")))


def members(kind: type, options: str) -> Iterator[str]:
    """Yield the members of a class that the page lists."""
    listed, left_out = (
        [name.strip() for name in found[1].split(",")] if (found := re.search(rf":{option}:(.*)", options)) else []
        for option in ("members", "exclude-members")
    )
    if listed == [""]:
        inherited = ":inherited-members:" in options
        fields = {field.name for field in dataclasses.fields(kind)} if dataclasses.is_dataclass(kind) else set()
        listed = [name for name in dir(kind) if inherited or name in vars(kind)] + sorted(fields - set(vars(kind)))
    yield from sorted(name for name in listed if not name.startswith("_") and name not in left_out)


def signature(name: str, member: Any) -> str:
    if not (inspect.isfunction(member) or inspect.ismethod(member)):
        return name
    return name + re.sub(" at 0x[0-9a-f]+", "", str(inspect.signature(member)))  # of a function as a default


def lines() -> Iterator[str]:
    """Yield the public API, one line per name and documented member."""
    page = documented()
    for name in sorted(maxq.__all__):
        public = getattr(maxq, name)
        yield signature(name, public)
        if isinstance(public, type):
            for member in members(public, page.get(name, "")):
                yield signature(f"{name}.{member}", getattr(public, member, None))


def test_names_and_signatures_are_those_of_the_snapshot() -> None:
    assert list(lines()) == SNAPSHOT.read_text(encoding="utf-8").splitlines()


def test_the_page_lists_every_name() -> None:
    assert sorted(documented()) == sorted(maxq.__all__)


if __name__ == "__main__":
    print(*lines(), sep="\n")
