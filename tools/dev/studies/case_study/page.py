"""Tables in a page between marks, so that prose is written by people and numbers by the study."""

from __future__ import annotations

import re
from collections.abc import Sequence


def filled(page: str, name: str, lines: Sequence[str]) -> str:
    """The page with `lines` between `<!-- begin name -->` and `<!-- end name -->`. Raises ValueError without marks."""
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    if page.count(begin) != 1 or page.count(end) != 1 or page.index(begin) > page.index(end):
        raise ValueError(f"the page has no place for {name}: {begin} ... {end}")
    head, tail = page[: page.index(begin) + len(begin)], page[page.index(end) :]
    return "\n".join([head, "", *lines, "", tail])


def places(page: str) -> list[str]:
    """Names of the tables that a page wants."""
    return re.findall(r"<!-- begin (\S+) -->", page)
