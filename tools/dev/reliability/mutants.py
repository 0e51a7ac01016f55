"""Mutants of an input file: values of a TOML document, tokens of a text, and bytes.

    for name, content in mutants(path.name, path.read_bytes(), random.Random(1)): ...

The values, texts and bytes put in are those of tests/file_fuzzer.py, whose strategies for Hypothesis make mutants of
small files by their JSON Schema. These mutants need no schema, so that they also damage files of other programs.
"""

from __future__ import annotations

import copy
import importlib
import json
import random
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tomli_w

TESTS = Path(__file__).resolve().parents[3] / "tests"
_BINARY = (".op2", ".parquet", ".gz", ".mcap", ".nc")
_TOKEN = re.compile(rb"[-+]?\d+\.?\d*(?:[eEdD][-+]?\d+)?|[A-Za-z_][\w./-]*|[^\s\w]")
_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eEdD][-+]?\d+)?")
_WORDS = (0, 1, -1, 2**31 - 1, -(2**31), 1146, 3, 7, 0x7FC00000, 0x7F800000)
"""32-bit words put into binary files: limits, numbers of records, nan and infinity."""


def of_tests(module: str) -> Any:
    """Return a module of tests/."""
    if str(TESTS) not in sys.path:
        sys.path.insert(0, str(TESTS))
    return importlib.import_module(module)


def mutants(name: str, content: bytes, chance: random.Random) -> Iterator[bytes]:
    """Yield mutants of a file without end, each with one to three changes."""
    while True:
        out = content
        for _ in range(chance.choice((1, 1, 1, 2, 3))):
            out = _changed(name, out, chance)
        if out != content:
            yield out


def _changed(name: str, content: bytes, chance: random.Random) -> bytes:
    if name.endswith(_BINARY) or chance.random() < 0.08:
        return _bytes(content, chance)
    if name.endswith((".toml", ".json")) and chance.random() < 0.75:
        return _value(name, content, chance)
    return _token(content, chance)


def _value(name: str, content: bytes, chance: random.Random) -> bytes:
    """Replace, delete, double or move a value of a TOML or JSON document."""
    fuzzer = of_tests("file_fuzzer")
    try:
        tree = tomllib.loads(content.decode()) if name.endswith(".toml") else json.loads(content)
    except (ValueError, RecursionError):  # an earlier change has damaged it
        return _token(content, chance)
    every = list(fuzzer.places(tree))
    if not every:
        return _token(content, chance)
    path = chance.choice(every)
    parent, key = fuzzer.at(tree, path[:-1]), path[-1]
    old, what = parent[key], chance.random()
    if what < 0.12:
        del parent[key]
    elif what < 0.2:
        parent[key] = copy.deepcopy(fuzzer.at(tree, chance.choice(every)))
    elif what < 0.28 and isinstance(parent, list):
        parent.insert(key, copy.deepcopy(old))
    elif what < 0.34 and isinstance(parent, dict):
        parent[chance.choice(fuzzer.TEXTS)] = old
    elif what < 0.7 and isinstance(old, int | float) and not isinstance(old, bool):
        parent[key] = chance.choice((-old, 10 * old, old / 10, old * 1e3, 0, old + 1, *fuzzer.NUMBERS[:12]))
    else:
        parent[key] = copy.deepcopy(chance.choice((*fuzzer.NUMBERS, *fuzzer.TEXTS, *fuzzer.NESTED)))
    try:
        text: str = json.dumps(tree) if name.endswith(".json") else tomli_w.dumps(tree)
    except (TypeError, ValueError):  # an integer of thousands of digits, a lone surrogate
        text = fuzzer.toml(tree)
    return text.encode(errors="replace")


def _token(content: bytes, chance: random.Random) -> bytes:
    """Change a number, a word or a line of a text."""
    fuzzer, what = of_tests("file_fuzzer"), chance.random()
    if what < 0.25:
        lines = content.split(b"\n")
        k, other = chance.randrange(len(lines)), chance.randrange(len(lines))
        if what < 0.08:
            del lines[k]
        elif what < 0.14:
            lines.insert(other, lines[k])
        elif what < 0.2:
            lines[k], lines[other] = lines[other], lines[k]
        else:
            lines = lines[:k]
        return b"\n".join(lines)
    found = list((_NUMBER if what < 0.75 else _TOKEN).finditer(content))
    if not found:
        return _bytes(content, chance)
    token, new = chance.choice(found), b""
    if _NUMBER.fullmatch(token[0]) and chance.random() < 0.9:
        value = float(re.sub(rb"[dD]", b"e", token[0]))
        near = (-value, 10.0 * value, 0.1 * value, 1e3 * value, 0.0)
        new = str(chance.choice((*near, *fuzzer.NUMBERS))).encode()[:400]
    elif chance.random() < 0.6:
        new = chance.choice((chance.choice(found)[0], chance.choice(fuzzer.TEXTS).encode(errors="replace")))
    return content[: token.start()] + new + content[token.end() :]


def _bytes(content: bytes, chance: random.Random) -> bytes:
    """Flip a bit, cut, double, delete or insert bytes, or write a 32-bit word."""
    at, length = chance.randrange(len(content) + 1), chance.choice((1, 2, 4, 8, 20, 100))
    what = chance.randrange(7)
    if what == 0 and at < len(content):
        return content[:at] + bytes([content[at] ^ (1 << chance.randrange(8))]) + content[at + 1 :]
    if what == 1:
        return content[:at]
    if what == 2:
        return content[:at] + content[at : at + length] * 2 + content[at + length :]
    if what == 3:
        return content[:at] + content[at + length :]
    if what == 4:
        word = chance.choice(_WORDS).to_bytes(4, "little", signed=True)
        at -= at % 4
        return content[:at] + word + content[at + 4 :]
    if what == 5:
        return content[:at] + chance.randbytes(length) + content[at + length :]
    put_in: bytes = chance.choice(of_tests("file_fuzzer").BYTES)
    return content[:at] + put_in + content[at:]
