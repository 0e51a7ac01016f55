"""Errors of a scenario: one line with file, key, value, problem and allowed values."""

from __future__ import annotations

import datetime
import difflib
from collections.abc import Iterable
from typing import Any

from pydantic_core import PydanticCustomError

Path = tuple[str | int, ...]
"""The path of a value: names of tables and keys, indices of lists."""


NOTHING: Any = object()
"""The marker of a missing value (of a missing key)."""

_LONGEST_VALUE = 60
_LONGEST_FILE = 240
_LONGEST_WORDS = 1000


class ScenarioError(Exception):
    """The error of wrong input, whose `str()` is one line: `file: key = value: problem; allowed: ... (and N more)`.

    After a question, such as `did you mean x?`, the allowed values are a new sentence: `Allowed: ...`. `file` is the
    file as named by the user, or `--set` for an override. `key` is empty if the error concerns the whole file. `more`
    is the number of further errors found at the same time.
    """

    def __init__(
        self, file: str, problem: str, key: str = "", *, value: Any = NOTHING, allowed: str = "", more: int = 0
    ) -> None:
        super().__init__(file, problem)  # unpickling calls the constructor with these, then restores the attributes
        self.file, self.problem, self.key, self.allowed, self.more = file, problem, key, allowed, more
        self.shown_value = "" if value is NOTHING else show_value(value)

    def __str__(self) -> str:
        key = printable(self.key, _LONGEST_FILE)
        place = f"{key} = {self.shown_value}" if self.shown_value else key
        problem, allowed = (printable(text, _LONGEST_WORDS) for text in (self.problem, self.allowed))
        line = ": ".join(part for part in (printable(self.file, _LONGEST_FILE), place, problem) if part)
        if allowed:
            line += f" Allowed: {allowed}" if line.endswith("?") else f"; allowed: {allowed}"
        if self.more:
            line += f" (and {self.more} more)"
        return " ".join(line.split())


def show_value(value: Any) -> str:
    """Return a value in a form close to TOML, cut to fit into a line."""
    if isinstance(value, bool):
        text = str(value).lower()
    elif isinstance(value, datetime.date | datetime.time):  # a datetime is a date, too
        text = value.isoformat()
    elif isinstance(value, str):
        text = f'"{value}"'
    elif isinstance(value, dict):
        text = "{" + ", ".join(f"{k} = {show_value(v)}" for k, v in list(value.items())[:9]) + "}"
    elif isinstance(value, list | tuple):
        text = "[" + ", ".join(show_value(v) for v in value[:20]) + "]"
    else:
        try:
            text = repr(value)
        except ValueError:  # Python does not convert integers of thousands of digits
            text = "a number of thousands of digits"
    return printable(text, _LONGEST_VALUE)


def printable(text: str, longest: int = _LONGEST_WORDS) -> str:
    """Return `text` without line ends and other control characters, cut to a length."""
    text = text if text.isprintable() else text.encode("unicode_escape").decode()
    return text if len(text) <= longest else text[: longest - 4] + " ..."


def refuse(
    problem: str, allowed: str = "", key: str | Path = (), *, value: Any = NOTHING, file: str = "", place: str = ""
) -> PydanticCustomError:
    """Return the exception for a validator of the schema to raise.

    `key` is relative to the section being validated; its value is looked up unless given. For an error in a CSV file,
    `file` and the `place` in it are given instead.
    """
    key = (key,) if isinstance(key, str) else key
    return PydanticCustomError(
        "refused",
        "{problem}",
        {"problem": problem, "allowed": allowed, "key": key, "value": value, "file": file, "place": place},
    )


def suggestion(word: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """Return `did you mean x?`, or an empty string.

    A key that differs only in its unit (`_km` for `_m`) has priority. `cutoff`: least similarity, from 0 to 1
    (difflib).
    """
    choices = list(known)
    stem = word.rpartition("_")[0]
    same_stem = [c for c in choices if c == stem or ("_" in c and c.rpartition("_")[0] in (stem, word))]
    near = difflib.get_close_matches(word, choices, n=1, cutoff=cutoff)
    if same_stem and stem:
        near = difflib.get_close_matches(word, same_stem, n=1, cutoff=0.0)
    elif not near and same_stem:
        near = same_stem[:1]
    return f"did you mean {near[0]}?" if near else ""
