"""The messages between maxq and a flight computer behind a socket, byte by byte, from the header maxq_fsw.h.

    simrun schema messages

prints them as CSV. Offsets are from the first byte of a message. Numbers have the byte order of the machine.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator
from typing import NamedTuple

from maxq.control.external import HEADER

MESSAGES = (
    ("setup", 1, "setup"),
    ("answer to setup", 1, ""),
    ("step", 2, "inputs"),
    ("answer to step", 2, "outputs"),
    ("end", 3, ""),
)
"""The messages: name, kind, and the end of the struct's name; empty without a struct."""
_STRUCT = re.compile(r"typedef struct maxq_fsw_(\w+) \{(.*?)\n\} maxq_fsw_\1;", re.DOTALL)
_FIELD = re.compile(r"^\s*(int64_t|double|char) (\w+)((?:\[\d+\])*);\s*(?:/\* (.*?) \*/)?\s*$")
_VERSION = re.compile(r"^\s*/\* version (\d+)")
_HEADER_BYTES, _CODE_BYTES = 16, 8
_SIZES = {"int64_t": 8, "double": 8, "char": 1, "uint32_t": 4}


class Field(NamedTuple):
    """A field of a message: its place, its type in C, and the version of maxq_fsw.h that added it."""

    message: str
    offset: int
    bytes: int
    type: str
    name: str
    version: int
    meaning: str

    @property
    def meaning_and_version(self) -> str:
        return self.meaning + f" (version {self.version})" * (self.version > 1)


def fields() -> Iterator[Field]:
    """Yield the fields of all messages. Raises ValueError for a line of a struct that is not understood."""
    structs = dict(_STRUCT.findall(HEADER.read_text(encoding="utf-8")))
    for message, kind, struct in MESSAGES:
        is_answer = message.startswith("answer")
        yield from _head(message, str(kind), is_answer)
        if struct:
            yield from _of_struct(message, structs[struct], _HEADER_BYTES + _CODE_BYTES * is_answer)


def _head(message: str, kind: str, has_code: bool) -> Iterator[Field]:
    yield Field(message, 0, 4, "char[4]", "magic", 1, "MAXQ")
    yield Field(message, 4, 4, "uint32_t", "kind", 1, kind)
    number = "number of the message" if has_code else "1 for the setup, then counts up"
    yield Field(message, 8, 8, "int64_t", "number", 1, number)
    if has_code:
        yield Field(message, _HEADER_BYTES, _CODE_BYTES, "int64_t", "code", 1, "0: success")


def _of_struct(message: str, body: str, offset: int) -> Iterator[Field]:
    version = 1
    for line in body.split("\n")[1:]:
        found = _FIELD.match(line)
        if found is None:
            added = _VERSION.match(line)
            if added is None:
                raise ValueError(f"maxq_fsw.h: {line.strip()!r} is no field")
            version = int(added[1])
            continue
        kind, name, shape, meaning = found.groups()
        size = _SIZES[kind] * math.prod(int(n) for n in re.findall(r"\d+", shape))
        yield Field(message, offset, size, kind + shape, name, version, meaning or "")
        offset += size


def as_csv() -> str:
    """Return the fields of all messages as CSV, with a line of names."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(Field._fields)
    writer.writerows(fields())
    return out.getvalue()
