"""A mutation test of the quick tests: does a test fail when a token of the source is changed?

    python -m maxq.tools.dev.mutations plant --work DIR     # draw mutants, plant all of them in a copy of the tree
    python -m maxq.tools.dev.mutations map --work DIR       # mutants that each quick test reaches, and its time
    python -m maxq.tools.dev.mutations run --work DIR       # run the tests that reach each mutant until one fails
    python -m maxq.tools.dev.mutations table --work DIR     # write counts and survivors into docs/verification.md

`run --concerned` needs no map: it uses the files of tests that import the module of a mutant, and a few that reach most
modules. `plant --without-kernels` draws mutants that need no compilation.

One copy of the tree contains all mutants, each with its original statement: `if at(7): changed else: original`. A file
that all processes map into their memory selects the active mutant and records the mutants reached. Compiled kernels
read this file too, so that no mutant requires a compilation. Each mutant is tested in a forked process with compiled
kernels, as in `.ci/run`. Values computed on import are not affected by the fork and require a new pytest process.

A mutant is killed by the first test that fails, or by a test that takes more than five minutes and ten times its
usual time. `--named` adds the faults of harness_mutants.py. Mutants in DIR/results.jsonl are not run again, except with
`--only`. `map` and `run` use the present tests of the tree of this script.

Documentation, annotations, imports, messages of exceptions, f-strings, decorators and tolerances (powers of ten below
1e-3) are not mutated, because such a change is equivalent or no fault of the model. Equality is added to a comparison
or removed only for integers, because measured quantities are never equal.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import copy
import io
import itertools
import json
import mmap
import os
import random
import re
import shutil
import signal
import struct
import subprocess
import sys
import time
import tokenize
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest
from _pytest.runner import runtestprotocol

from maxq.control.kernel import kept_code
from maxq.tools.dev.harness_mutants import NAMED

ROOT = Path(__file__).resolve().parents[2]
PIPE = "\\|"  # a bar within a cell of a table
PAGE = ROOT / "docs/verification.md"
REASONS = Path(__file__).with_name("surviving_mutants.json")
PACKAGES = {
    "control": ("control",),
    "sim/vehicle": ("sim/vehicle",),
    "sim/flight": ("sim/flight", "sim/world"),
    "input to run": ("sim",),
    "design": ("design",),
    "statistics": ("sim/campaign", "design/verify"),
    "tools": ("tools", "api"),
}
"""The folders of each package. A module belongs to the longest folder that contains it, so that all are drawn."""
OPERATORS: dict[type[ast.AST], tuple[str, tuple[str, ...]]] = {
    ast.Add: ("+", ("-",)),
    ast.Sub: ("-", ("+",)),
    ast.Mult: ("*", ("/",)),
    ast.Div: ("/", ("*",)),
    ast.Pow: ("**", ("*",)),
    ast.FloorDiv: ("//", ("*",)),
    ast.Mod: ("%", ("*",)),
    ast.Lt: ("<", (">", "<=")),
    ast.Gt: (">", ("<", ">=")),
    ast.LtE: ("<=", (">", "<")),
    ast.GtE: (">=", ("<", ">")),
    ast.Eq: ("==", ("!=",)),
    ast.NotEq: ("!=", ("==",)),
    ast.And: ("and", ("or",)),
    ast.Or: ("or", ("and",)),
}
NAMES = {
    "sin": "cos",
    "cos": "sin",
    "min": "max",
    "max": "min",
    "any": "all",
    "all": "any",
    "minimum": "maximum",
    "maximum": "minimum",
    "floor": "ceil",
    "ceil": "floor",
    "real": "imag",
    "imag": "real",
    "argmin": "argmax",
    "argmax": "argmin",
    "PITCH": "YAW",
    "YAW": "PITCH",
    "sinh": "cosh",
    "cosh": "sinh",
}
FIRST = "tests/test_regression_nominal.py"  # the first of the tests that reach a mutant: the strongest for its time
USUAL = {"test_regression_nominal.py", "test_usage_scenario_loading.py", "test_usage_python.py", "test_usage_simrun.py"}
"""The files of tests that reach most modules which they do not import."""
_LIMIT_S = 300.0  # beyond ten times the usual time of a test; the machine may be busy
MOST = 511  # most mutants of a copy
SWITCH = f'''
"""Which mutant holds, and which have been got to: eight bytes each, at one address in every process."""
import ctypes
import os

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

ADDRESS = 0x6F0000000000
_map = ctypes.CDLL(None).mmap
_map.restype, _map.argtypes = ctypes.c_void_p, (ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long)
# read and write, shared, at this very address
assert _map(ADDRESS, {8 * (MOST + 1)}, 3, 0x100001, os.open(os.environ["MAXQ_MUTANTS"], os.O_RDWR), 0) == ADDRESS
_NOTED = (ctypes.c_int64 * {MOST + 1}).from_address(ADDRESS)


def at(number):
    _NOTED[number] = 1
    return _NOTED[0] == number


@intrinsic
def _at(context, number):
    def build(context, builder, signature, arguments):
        word = ir.IntType(64)
        first = builder.inttoptr(ir.Constant(word, ADDRESS), word.as_pointer())
        builder.store(ir.Constant(word, 1), builder.gep(first, arguments))
        return builder.icmp_signed("==", builder.load(first), arguments[0])

    return types.boolean(types.int64), build


@overload(at)
def _at_compiled(number):
    return lambda number: _at(number)
'''


@dataclass(frozen=True)
class Mutant:
    number: int
    package: str
    file: str
    line: int
    column: int
    old: str
    new: str
    source: str
    """The line of the original source."""


# --- the tokens that are changed


def _sites(source: str) -> Iterator[tuple[int, int, str, tuple[str, ...]]]:
    """Yield the line, column, token and replacements of each token that may be changed."""
    tree = ast.parse(source)
    tokens = {t.start: t.string for t in tokenize.generate_tokens(io.StringIO(source).readline) if t.string.strip()}
    found: list[tuple[int, int, str, tuple[str, ...]]] = []

    def between(left: ast.expr, right: ast.expr, kind: type[ast.AST], boundary: bool = True) -> None:
        token, new = OPERATORS.get(kind, ("", ()))
        stop = right.lineno, right.col_offset
        here = [at for at, text in tokens.items() if _end(left) <= at < stop and text == token]
        if here:
            found.append((*here[0], token, new if boundary else new[:1]))

    def walk(node: ast.AST) -> None:
        if isinstance(node, (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom, ast.arg)):
            return
        if isinstance(node, ast.BinOp):
            between(node.left, node.right, type(node.op))
        elif isinstance(node, ast.Compare):
            for left, op, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
                between(left, right, type(op), _integer(left) or _integer(right))
        elif isinstance(node, ast.BoolOp):
            for left, right in zip(node.values, node.values[1:], strict=False):
                between(left, right, type(node.op))
        elif isinstance(node, ast.AugAssign):
            token, new = OPERATORS.get(type(node.op), ("", ()))
            here = [at for at, text in tokens.items() if at >= _end(node.target) and text == token + "="]
            if token and here:
                found.append((*min(here), token + "=", (new[0] + "=",)))
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.Not)):
            flipped = ("-", ("+",)) if isinstance(node.op, ast.USub) else ("not", ("",))
            found.append((node.lineno, node.col_offset, *flipped))
        elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
            text, others = tokens.get((node.lineno, node.col_offset), ""), _other_number(node.value)
            if text and others:
                found.append((node.lineno, node.col_offset, text, others))
        elif isinstance(node, ast.Attribute) and node.attr in NAMES:
            line, end = _end(node)
            found.append((line, end - len(node.attr), node.attr, (NAMES[node.attr],)))
        elif isinstance(node, ast.Name) and node.id in NAMES:
            found.append((node.lineno, node.col_offset, node.id, (NAMES[node.id],)))
        elif isinstance(node, (ast.Break, ast.Continue)):
            swapped = ("break", ("continue",)) if isinstance(node, ast.Break) else ("continue", ("break",))
            found.append((node.lineno, node.col_offset, *swapped))
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "type_params"):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    walk(child)

    walk(tree)
    yield from sorted(set(found))


def _end(node: Any) -> tuple[int, int]:
    return node.end_lineno or 0, node.end_col_offset or 0


def _integer(node: ast.expr) -> bool:
    if isinstance(node, ast.Call):
        return getattr(node.func, "id", "") == "len"
    return isinstance(node, ast.Constant) and type(node.value) is int


def _other_number(value: float) -> tuple[str, ...]:
    if isinstance(value, bool):
        return (str(not value),)
    if isinstance(value, int):
        return (str(value + 1), str(value - 1)) if value > 0 else ("1",)
    if 0.0 < value < 1e-3 and f"{value:e}".startswith("1.000000e"):
        return ()
    return (repr(2.0 * value),) if value else ("1.0",)


def modules_of_packages() -> dict[str, list[Path]]:
    """Return all installed modules of maxq, by package."""
    out: dict[str, list[Path]] = {package: [] for package in PACKAGES}
    owner = {folder: package for package, folders in PACKAGES.items() for folder in folders}
    for layer in ("api", "control", "design", "sim", "tools"):
        for path in sorted((ROOT / layer).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            if not name.startswith(("tools/dev/", "tools/.ns/")):
                out[owner[max((f for f in owner if name.startswith(f"{f}/")), key=len)]].append(path)
    return out


def drawn(number: int, seed: int, kernels: bool = True) -> list[Mutant]:
    """Return mutants in equal numbers from every package, with equal probabilities for sites and for their
    replacements. Without `kernels`, none are in the sources that determine machine code.
    """
    compiled = set() if kernels else set(kept_code._source_files())
    chance, out, modules = random.Random(seed), list[Mutant](), modules_of_packages()
    for package, files in modules.items():
        sites = [(path, site) for path in files if path not in compiled for site in _sites(path.read_text())]
        for path, (line, column, old, new) in chance.sample(sites, min(number // len(modules), len(sites))):
            source = path.read_text().split("\n")[line - 1].strip()
            file = path.relative_to(ROOT).as_posix()
            out.append(Mutant(1 + len(out), package, file, line, column, old, chance.choice(new), source))
    return out


def named(first: int) -> list[Mutant]:
    """Return the faults of harness_mutants.py as mutants, numbered from `first`."""
    out = list[Mutant]()
    for file, text, new, what in NAMED:
        before, old, after = re.split("[«»]", text)
        source = (ROOT / file).read_text()
        assert source.count(before + old + after) == 1, (file, text)
        lines = source[: source.index(before + old + after) + len(before)].split("\n")
        at = source.split("\n")[len(lines) - 1].strip()
        out.append(Mutant(first + len(out), what, file, len(lines), len(lines[-1].encode()), old, new, at))
    return out


def found_again(mutants: list[dict[str, Any]], first: int) -> list[Mutant]:
    """Return mutants of an earlier tree at the present positions of their lines.

    Mutants whose line is missing are omitted and reported.
    """
    out = list[Mutant]()
    for m in mutants:
        path = ROOT / m["file"]
        lines = path.read_text().split("\n") if path.exists() else []
        old, column = m["old"].encode(), m["column"]
        alike = [k for k, line in enumerate(lines, 1) if line.strip() == m["source"]]
        at = [k for k in alike if lines[k - 1].encode()[column:].startswith(old)]
        if at:
            line = min(at, key=lambda k: abs(k - m["line"]))
            values = {f.name: m[f.name] for f in fields(Mutant)}
            out.append(Mutant(**{**values, "line": line, "number": first + len(out)}))
        else:
            print(f"gone: {m['file']}: {m['source']}")
    return out


# --- the copy that contains all mutants


def _changed(source: str, mutant: Mutant) -> str:
    lines = source.split("\n")
    text = lines[mutant.line - 1].encode()  # ast counts bytes
    end = mutant.column + len(mutant.old.encode())
    assert text[mutant.column : end].decode() == mutant.old, mutant
    lines[mutant.line - 1] = (text[: mutant.column] + mutant.new.encode() + text[end:]).decode()
    return "\n".join(lines)


SourcePlace = tuple[str | int, ...]
SIMPLE = (ast.Assign, ast.AugAssign, ast.AnnAssign, ast.Return, ast.Expr, ast.Break, ast.Continue)


def _place(node: Any, at: tuple[int, int], inside: bool = False) -> SourcePlace:
    """Return the path from a node to the part that is duplicated around a token.

    The part is a simple statement of a function, else an expression. The path is empty if the token is not below the
    node.
    """
    for name, value in ast.iter_fields(node):
        within = inside or (isinstance(node, ast.FunctionDef) and name == "body")
        for index, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            here: SourcePlace = (name,) if index is None else (name, index)
            begin = (child.lineno, child.col_offset) if hasattr(child, "lineno") else at  # `arguments` has no position
            if not isinstance(child, ast.AST) or not (begin <= at and (begin is at or at < _end(child))):
                continue
            if isinstance(child, ast.expr) or (within and isinstance(child, SIMPLE)):
                return here
            further = _place(child, at, within)
            if further:
                return here + further
    return ()


def _at(tree: Any, way: SourcePlace) -> Any:
    for step in way:
        tree = tree[step] if isinstance(step, int) else getattr(tree, step)
    return tree


def planted(source: str, mutants: list[Mutant]) -> str:
    """Return the source of a module with all its mutants."""
    original, groups = ast.parse(source), dict[SourcePlace, list[tuple[int, Any]]]()
    for mutant in mutants:
        way = _place(original, (mutant.line, mutant.column))
        groups.setdefault(way, []).append((mutant.number, _at(ast.parse(_changed(source, mutant)), way)))
    tree = copy.deepcopy(original)
    for way, changes in sorted(groups.items(), key=lambda item: -len(item[0])):  # inner parts first
        node = _at(tree, way)
        for number, new in changes:
            here = ast.Call(ast.Name("_mutant_at", ast.Load()), [ast.Constant(number)], [])
            node = ast.If(here, [new], [node]) if isinstance(node, ast.stmt) else ast.IfExp(here, new, node)
        holder = _at(tree, way[:-1])
        if isinstance(way[-1], int):
            holder[way[-1]] = node
        else:
            setattr(holder, way[-1], node)
    names = [i for i, n in enumerate(tree.body) if isinstance(n, ast.ImportFrom) and n.module == "__future__"]
    switch = ast.ImportFrom("maxq.tools.mutant", [ast.alias("at", "_mutant_at")], 0)
    tree.body.insert(names[-1] + 1 if names else 0, switch)
    return ast.unparse(ast.fix_missing_locations(tree)) + "\n"


def plant(work: Path, mutants: list[Mutant], refused: set[int]) -> None:
    tree, links = work / "tree", work / "python" / "maxq"
    for old in (tree, links, work / "cache"):
        shutil.rmtree(old, ignore_errors=True)
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True).stdout
    for name in filter(None, names.split("\0")):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, tree / name, follow_symlinks=False)
    links.mkdir(parents=True)
    (links / "__init__.py").symlink_to(tree / "api" / "__init__.py")
    for layer in ("control", "sim", "design", "tools", "scenarios"):
        (links / layer).symlink_to(tree / layer)
    for file in {m.file for m in mutants}:
        path = tree / file
        here = [m for m in mutants if m.file == file and m.number not in refused]
        path.write_text(planted(path.read_text(), here))
    (tree / "tools/mutant.py").write_text(SWITCH)  # no source of kernels, so that their hash remains
    (work / "cache").mkdir(mode=0o700)
    if not any((ROOT / m.file).resolve() in kept_code._source_files() for m in mutants):
        shutil.copytree(kept_code._FOLDER, work / "cache" / Path(kept_code._FOLDER).name)  # compiles nothing again
    (work / "mutants.json").write_text(json.dumps([asdict(m) for m in mutants], indent=0))


# --- in a process with all imports

Map = dict[str, tuple[float, list[int]]]
"""The time (s) and the mutants reached of each test that passes."""


class _Server:
    """A plugin of pytest that replaces its loop over the tests."""

    def __init__(self, work: Path, mutants: list[Mutant], do: str, budget_s: float, concerned: bool) -> None:
        self.work, self.mutants, self.do, self.budget_s, self.concerned = work, mutants, do, budget_s, concerned
        self.flags = mmap.mmap(os.open(os.environ["MAXQ_MUTANTS"], os.O_RDWR), 8 * (MOST + 1))

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if self.do == "map":  # a process for each file, so that none uses data that another has left in memory
            for _, group in itertools.groupby(session.items, key=lambda item: _file_of(item.nodeid)):
                self._forked(partial(self._measure, list(group)), self.work / "map.jsonl")
            return True
        items = {item.nodeid: item for item in session.items}
        known = self._assumed(items) if self.concerned else read_map(self.work)
        for mutant in self.mutants:
            names, began = _tests_for(mutant.number, known, self.budget_s), time.monotonic()
            tests = [items[name] for name in names if name in items]
            self.flags[:8] = struct.pack("<q", mutant.number)
            said = self._forked(partial(self._meet, tests, known)).splitlines() or ["nothing ran"]
            self.flags[:8] = bytes(8)
            while self.concerned and len(said) > 1 and said[-2] in items and not self._passes(items[said[-2]]):
                tests.remove(items.pop(said[-2]))  # it fails without a mutant, too
                self.flags[:8] = struct.pack("<q", mutant.number)
                said = self._forked(partial(self._meet, tests, known)).splitlines() or ["nothing ran"]
                self.flags[:8] = bytes(8)
            answer = {"status": "killed", "how": f"{said[-1]}: the clock, or the process ended"}
            answer = json.loads(said[-1]) if said[-1].startswith("{") else answer
            row = {**asdict(mutant), **answer, "tests": len(tests), "seconds": round(time.monotonic() - began, 1)}
            with (self.work / "results.jsonl").open("a") as file:
                file.write(json.dumps(row) + "\n")
        return True

    def _assumed(self, items: dict[str, pytest.Item]) -> Map:
        """Return a map in which a test reaches the mutants of the modules that its file imports, in a second."""
        files = {m.number: set(concerned([m])) for m in self.mutants}
        return {name: (1.0, [number for number, by in files.items() if _file_of(name) in by]) for name in items}

    @cache  # noqa: B019  # the plugin exists once
    def _passes(self, item: pytest.Item) -> bool:
        """Return True if a test passes without a mutant."""
        return '"survived"' in self._forked(partial(self._meet, [item], {item.nodeid: (1.0, [])}))

    def _forked(self, do: Any, path: Path | None = None) -> str:
        """Call `do` in a forked process with a file open for writing, and return the text of this file.

        The file is `path`, to which text is appended, or a temporary file.
        """
        if path is None:
            path = self.work / f"answer-{os.getpid()}"
            path.write_text("")
        shutil.rmtree(Path(os.environ["MAXQ_CACHE"]) / "verified", ignore_errors=True)  # results of another mutant
        child = os.fork()
        if child == 0:
            os.setsid()
            null = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(null, stream)
            with path.open("a", buffering=1) as out:
                do(out)
            os._exit(0)
        os.waitpid(child, 0)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        return path.read_text()

    def _measure(self, items: list[pytest.Item], out: Any) -> None:
        for item, after in zip(items, [*items[1:], None], strict=True):
            self.flags[:] = bytes(len(self.flags))
            began = time.monotonic()
            reports = runtestprotocol(item, nextitem=after, log=False)
            got_to = [k for k, v in enumerate(struct.unpack(f"<{MOST + 1}q", self.flags[:])) if v and k]
            passed = all(r.passed for r in reports)  # tests that fail without a mutant are omitted
            out.write(json.dumps([item.nodeid, round(time.monotonic() - began, 3), got_to, passed]) + "\n")

    def _meet(self, tests: list[pytest.Item], known: Map, out: Any) -> None:
        for item, after in zip(tests, [*tests[1:], None], strict=False):
            signal.setitimer(signal.ITIMER_REAL, _LIMIT_S + 10.0 * known[item.nodeid][0])  # the signal ends the process
            out.write(item.nodeid + "\n")
            bad = [r for r in runtestprotocol(item, nextitem=after, log=False) if r.failed]
            if bad:
                said = next((x for x in str(bad[0].longrepr).splitlines() if x[:2] == "E "), "")
                out.write(json.dumps({"status": "killed", "how": f"{item.nodeid}: {said}"[:300]}) + "\n")
                return
        out.write(json.dumps({"status": "survived"}) + "\n")


def concerned(mutants: list[Mutant]) -> list[str]:
    """Return the files of tests that import a module of a mutant, and those that reach most modules."""
    modules = {"maxq." + m.file.removesuffix(".py").replace("/", ".").removeprefix("api.") for m in mutants}
    pattern = re.compile("|".join(rf"{re.escape(module)}\b" for module in sorted(modules)))
    tests = ((ROOT / "tests" / name, name) for name in sorted(os.listdir(ROOT / "tests")) if name.startswith("test_"))
    return [f"tests/{name}" for path, name in tests if name in USUAL or pattern.search(_imported(path))]


@cache
def _imported(path: Path) -> str:
    """Return the modules, and the names from modules, that a file imports, one on each line."""
    nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Import | ast.ImportFrom)]
    return "\n".join(f"{getattr(node, 'module', '') or ''}.{name.name}" for node in nodes for name in node.names)


def read_map(work: Path) -> Map:
    lines = (json.loads(line) for line in (work / "map.jsonl").read_text().splitlines())
    return {name: (seconds, got_to) for name, seconds, got_to, passed in lines if passed}


def _tests_for(number: int, known: Map, budget_s: float) -> list[str]:
    """Return the tests for a mutant by file: those that reach it, and the others of their files, which may share a
    fixture.
    """
    seconds = dict[str, float]()  # time of the tests that reach it, by file
    for name, (took, got_to) in known.items():
        if number in got_to:
            seconds[_file_of(name)] = seconds.get(_file_of(name), 0.0) + took
    names = [name for name in known if _file_of(name) in seconds]
    names.sort(
        key=lambda n: (_file_of(n) != FIRST, seconds[_file_of(n)], _file_of(n), number not in known[n][1], known[n][0])
    )
    total = itertools.accumulate(known[name][0] for name in names)
    return [name for name, so_far in zip(names, total, strict=True) if so_far <= budget_s]


def _file_of(name: str) -> str:
    return name.split("::", maxsplit=1)[0]


def table(done: list[dict[str, Any]]) -> None:
    """Write tables of counts by package and of survivors, for drawn and for named mutants.

    REASONS explains survivors. A reason that begins with "equivalent" marks an equivalent mutant, which is not listed.
    Mutants whose line is gone, deleted since they were drawn, are not counted.
    """
    text, said = PAGE.read_text(), json.loads(REASONS.read_text())
    for name, packages in (("mutants", [*PACKAGES, "all"]), ("named", ["by name"])):
        mine = [r for r in done if r["status"] != "gone" and (r["package"] in PACKAGES) == (name == "mutants")]
        if not mine:
            continue
        begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
        before, rest = text.split(begin)
        _, after = rest.split(end)
        rows = list[tuple[str, str, str]]()  # package, mutant, and the reason for its survival, "" if it was killed
        for r in sorted(mine, key=lambda r: r["number"]):
            key = f"{r['file']}: `{r['source'].replace('|', PIPE)}`, `{r['old']}` -> `{r['new'] or ' '}`"
            rows.append((r["package"], key, "" if r["status"] == "killed" else said.get(key, "open")))
        lines = [
            "| package | mutants | killed | equivalent | neither | killed of the rest |",
            "|---|---|---|---|---|---|",
        ]
        for package in packages:
            own = [why for of, _, why in rows if package in (of, "all", "by name")]
            killed, equivalent = own.count(""), sum(why.startswith("equivalent") for why in own)
            counts = f"{len(own)} | {killed} | {equivalent} | {len(own) - killed - equivalent}"
            lines.append(f"| {package} | {counts} | {100.0 * killed / max(len(own) - equivalent, 1):.1f} % |")
        lines += ["", "| survivor | reason |", "|---|---|"]
        lines += [f"| {key} | {why} |" for _, key, why in rows if why and not why.startswith("equivalent")]
        text = before + begin + "\n" + "\n".join(lines) + "\n" + end + after
    PAGE.write_text(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("do", choices=["plant", "map", "run", "table"])
    parser.add_argument("tests", nargs="*", help="these files only")
    parser.add_argument("--work", type=Path, required=True, help="folder for the copy, its cache, and results")
    parser.add_argument("--number", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--without-kernels", action="store_true", help="of `plant`: none that require a compilation")
    parser.add_argument("--concerned", action="store_true", help="the files of tests that import a module of a mutant")
    parser.add_argument("--named", action="store_true", help="of `plant`: the faults of harness_mutants.py as well")
    parser.add_argument("--also", type=Path, help="of `plant`: mutants of an earlier mutants.json too")
    parser.add_argument("--refused", default="", help="of `plant`: numbers of those that Numba refuses to compile")
    parser.add_argument("--only", help="comma-separated numbers of mutants, run again even if in results.jsonl")
    parser.add_argument("--budget", type=float, default=1e9, help="seconds of tests for a mutant, as mapped")
    given = parser.parse_intermixed_args()
    work = given.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    if given.do == "plant":
        mutants = drawn(given.number, given.seed, not given.without_kernels)
        mutants += named(1 + len(mutants)) if given.named else []
        mutants += found_again(json.loads(given.also.read_text()), 1 + len(mutants)) if given.also else []
        refused = {int(n) for n in given.refused.split(",") if n}
        plant(work, mutants, refused)
        return
    mutants = [Mutant(**m) for m in json.loads((work / "mutants.json").read_text())]
    results = work / "results.jsonl"
    done = {r["number"]: r for r in map(json.loads, results.read_text().splitlines())} if results.exists() else {}
    if given.do == "table":
        table(list(done.values()))
        return
    if "MAXQ_MUTANTS" not in os.environ:  # start again with the planted sources
        (work / "switch").write_bytes(bytes(8 * (MOST + 1)))
        places = {"MAXQ_MUTANTS": work / "switch", "PYTHONPATH": work / "python", "MAXQ_CACHE": work / "cache"}
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **{k: str(v) for k, v in places.items()}})
    shutil.copytree(ROOT / "tests", work / "tree/tests", dirs_exist_ok=True)
    os.chdir(work / "tree")
    wanted = {int(n) for n in given.only.split(",")} if given.only else {m.number for m in mutants} - set(done)
    mutants = [m for m in mutants if m.number in wanted]
    options = ["-s", "-m", "not slow", "-p", "no:cacheprovider", "-p", "no:terminal", "--ignore-glob=*packaging*"]
    tests = [t for t in concerned(mutants) if not given.tests or t in given.tests] if given.concerned else given.tests
    pytest.main(
        [*options, *(tests or ["tests"])], plugins=[_Server(work, mutants, given.do, given.budget, given.concerned)]
    )


if __name__ == "__main__":
    main()
