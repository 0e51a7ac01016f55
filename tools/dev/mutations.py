"""Mutations: does a quick test fail when one token of the source is changed?

    python -m maxq.tools.dev.mutations map --work DIR --mode MODE      how long each quick test takes, and what it calls
    python -m maxq.tools.dev.mutations run --work DIR --mode MODE      draw mutants, run the tests that can see each
    python -m maxq.tools.dev.mutations confirm --work DIR              what is left, changed in a copy of the tree
    python -m maxq.tools.dev.mutations table --work DIR                counts by package, and the survivors

MODE: `plain`, kernels as plain Python (`NUMBA_DISABLE_JIT=1`), for mutants in control, sim/vehicle and sim/flight: of
these each would be compiled for a minute or more. `compiled` for all others. Each mutant is met in a forked process
that has imported everything: the living functions get the changed code. The tests that call the function come first,
the quickest first, then what touches the module. What is no part of a function's code meets its tests in `confirm`:
compiled, in a copy of the tree with a cache of its own. `--named`: the faults of harness_mutants.py. Answers are
appended to DIR/results.jsonl; what stands there is not run again. `--part 1 --parts 2` shares the work.

Not drawn: documentation, annotations, imports, messages of exceptions, f-strings, decorators, and tolerances (powers of
ten below 1e-3): a change there is equivalent, or is no fault of the model. A comparison is shifted by its equal case
only beside an integer: for measured quantities that case has no weight.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import gc
import io
import itertools
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import tokenize
import types
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import pytest
from _pytest.runner import runtestprotocol

from maxq.tools.dev.harness_mutants import NAMED

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "control": ("control",),
    "sim/vehicle": ("sim/vehicle",),
    "sim/flight": ("sim/flight",),
    "design": ("design/case", "design/certificate", "design/laws", "design/loop", "design/margins", "design/model",
               "design/optimise"),
    "statistics": ("sim/campaign", "design/verify"),
}  # fmt: skip
FIRST = "tests/test_regression_nominal.py"  # the strongest test of a compiled flight, and the first in `confirm`
COMPILED_FROM = ("control/", "sim/vehicle/", "sim/flight/")  # a change in these compiles all kernels anew
OPERATORS: dict[type[ast.AST], tuple[str, tuple[str, ...]]] = {
    ast.Add: ("+", ("-",)), ast.Sub: ("-", ("+",)), ast.Mult: ("*", ("/",)), ast.Div: ("/", ("*",)),
    ast.Pow: ("**", ("*",)), ast.FloorDiv: ("//", ("*",)), ast.Mod: ("%", ("*",)), ast.Lt: ("<", (">", "<=")),
    ast.Gt: (">", ("<", ">=")), ast.LtE: ("<=", (">", "<")), ast.GtE: (">=", ("<", ">")), ast.Eq: ("==", ("!=",)),
    ast.NotEq: ("!=", ("==",)), ast.And: ("and", ("or",)), ast.Or: ("or", ("and",)),
}  # fmt: skip
NAMES = {"sin": "cos", "cos": "sin", "min": "max", "max": "min", "any": "all", "all": "any", "minimum": "maximum",
         "maximum": "minimum", "floor": "ceil", "ceil": "floor", "real": "imag", "imag": "real", "argmin": "argmax",
         "argmax": "argmin", "PITCH": "YAW", "YAW": "PITCH", "sinh": "cosh", "cosh": "sinh"}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    number: int
    package: str
    file: str
    line: int
    column: int
    old: str
    new: str


def _sites(source: str) -> Iterator[tuple[int, int, str, tuple[str, ...]]]:
    """(line, column, token, replacements) of what may be changed."""
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


def _end(node: ast.expr | ast.stmt) -> tuple[int, int]:
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


def drawn(number: int, seed: int) -> list[Mutant]:
    """Equally many from every package, each site and each of its replacements as likely as any other."""
    chance, out = random.Random(seed), list[Mutant]()
    for package, folders in PACKAGES.items():
        files = sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))
        sites = [(path, site) for path in files for site in _sites(path.read_text())]
        for path, (line, column, old, new) in chance.sample(sites, number // len(PACKAGES)):
            file = path.relative_to(ROOT).as_posix()
            out.append(Mutant(len(out), package, file, line, column, old, chance.choice(new)))
    return out


def named() -> list[Mutant]:
    """The faults of harness_mutants.py."""
    out = list[Mutant]()
    for file, text, new, what in NAMED:
        before, old, after = re.split("[«»]", text)
        source = (ROOT / file).read_text()
        assert source.count(before + old + after) == 1, (file, text)
        lines = source[: source.index(before + old + after) + len(before)].split("\n")
        out.append(Mutant(1000 + len(out), what, file, len(lines), len(lines[-1].encode()), old, new))
    return out


def changed(mutant: Mutant) -> str:
    lines = (ROOT / mutant.file).read_text().split("\n")
    text = lines[mutant.line - 1].encode()  # ast counts bytes
    end = mutant.column + len(mutant.old.encode())
    assert text[mutant.column : end] == mutant.old.encode()
    lines[mutant.line - 1] = (text[: mutant.column] + mutant.new.encode() + text[end:]).decode()
    return "\n".join(lines)


# --- in a process that has imported everything

Map = dict[str, tuple[float, list[str]]]
"""Of each test: processor seconds, and what it calls, FILE:QUALIFIED_NAME."""


class _Server:
    """Within pytest, in place of its loop."""

    def __init__(self, mutants: list[Mutant], known: Map, given: argparse.Namespace) -> None:
        self.mutants, self.known, self.given = mutants, known, given

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        signal.signal(signal.SIGPROF, lambda *_: pytest.skip("takes too long here"))
        items = {item.nodeid: item for item in session.items}
        if self.given.do == "map":
            self._measure(list(items.values()))
            return True
        for item in (i for n, i in items.items() if self.given.warm and n.startswith(tuple(self.given.warm))):
            runtestprotocol(item, nextitem=None, log=False)  # what oracles keep, and compiled code, is there for all
        for mutant in self.mutants:
            tests = [n for n in _tests_for(mutant, self.known, self.given.budget) if n in items]
            answer, began = self.given.work / f"answer-{os.getpid()}.json", time.monotonic()
            answer.write_text(json.dumps({"status": "died"}))
            child = os.fork()
            if child == 0:
                _meet(mutant, [items[n] for n in tests], answer, self.given)
            _, code = os.waitpid(child, 0)
            _kill(child)
            out = json.loads(answer.read_text())
            if out["status"] == "died" and code:  # by the limit of its time, or by what it did
                out = {"status": "killed", "how": f"exit {code}"}
            took = {"mode": self.given.mode, "tests": len(tests), "seconds": round(time.monotonic() - began, 1)}
            _keep(self.given.work, mutant, {**out, **took})
        return True

    def _measure(self, items: list[pytest.Item]) -> None:
        for item, after in zip(items, [*items[1:], None], strict=True):
            calls, began = set[types.CodeType](), time.process_time()
            signal.setitimer(signal.ITIMER_PROF, self.given.most)
            sys.setprofile(partial(_note, calls))
            reports = runtestprotocol(item, nextitem=after, log=False)
            sys.setprofile(None)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            if all(report.passed for report in reports):  # what fails without a mutant, or takes too long, is left out
                ours = [c for c in calls if c.co_filename.startswith(f"{ROOT}{os.sep}")]
                names = sorted(f"{Path(c.co_filename).relative_to(ROOT).as_posix()}:{c.co_qualname}" for c in ours)
                self.known[item.nodeid] = time.process_time() - began, names
        (self.given.work / f"map-{self.given.mode}.json").write_text(json.dumps(self.known))


def _note(calls: set[types.CodeType], frame: types.FrameType, event: str, _: object) -> None:
    if event == "call":
        calls.add(frame.f_code)


def _tests_for(mutant: Mutant, known: Map, budget_s: float) -> list[str]:
    """What calls the function, then what touches the module; fixtures and caches may have been filled by others."""
    own, module = f"{mutant.file}:{_holder(mutant)}", f"{mutant.file}:"
    near = [n for n, (_, calls) in known.items() if own in calls]
    files = {n.split("::")[0] for n in near}
    other = [n for n, (_, calls) in known.items() if n not in near and any(c.startswith(module) for c in calls)]
    groups = (near, [n for n in known if n.split("::")[0] in files], other)
    order = dict.fromkeys(n for group in groups for n in sorted(group, key=lambda n: known[n][0]))
    total = itertools.accumulate(known[n][0] for n in order)
    return [n for n, seconds in zip(order, total, strict=True) if seconds <= budget_s]


def _holder(mutant: Mutant) -> str:
    """Qualified name of the innermost function or class around a mutant; empty: it is outside of any."""
    names, node = list[str](), cast("ast.AST", ast.parse((ROOT / mutant.file).read_text()))
    while True:
        inside = [
            n for n in ast.walk(node) if n is not node and isinstance(n, (ast.FunctionDef, ast.ClassDef))
            and n.lineno <= mutant.line <= (n.end_lineno or 0)
        ]  # fmt: skip
        if not inside:
            return ".".join(names)
        inner = min(inside, key=lambda n: n.lineno)
        names += ["<locals>", inner.name] if isinstance(node, ast.FunctionDef) else [inner.name]
        node = inner


def _meet(mutant: Mutant, tests: list[pytest.Item], answer: Path, given: argparse.Namespace) -> None:
    """In the forked process: change the code, run the tests, write the answer, end."""
    os.setsid()
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(null, stream)
    limit = int(20.0 + 2.0 * given.budget)  # an endless loop ends here
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
    out = {"status": "survived" if _patch(mutant) else "not patched"}
    for item, after in zip(tests, [*tests[1:], None], strict=False) if out["status"] == "survived" else ():
        signal.setitimer(signal.ITIMER_PROF, given.most)
        bad = [report for report in runtestprotocol(item, nextitem=after, log=False) if report.failed]
        if bad:
            said = next((x for x in str(bad[0].longrepr).splitlines() if x[:2] == "E "), "")
            out = {"status": "killed", "how": f"{item.nodeid}: {said}"[:300]}
            break
    answer.write_text(json.dumps(out))
    os._exit(0)  # what is raised before ends in pytest's own report, without an answer


def _patch(mutant: Mutant) -> int:
    """Give every living function that holds the mutant its changed code; how many there are."""
    path, source = str(ROOT / mutant.file), changed(mutant)
    outer = [
        n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)  # its body: defaults are no code
        and (n.body[0].lineno, n.body[0].col_offset) <= (mutant.line, mutant.column) < _end(n)
    ]  # fmt: skip
    if not outer:
        return 0
    name = min(outer, key=lambda n: n.lineno).name
    codes = {(c.co_qualname, c.co_firstlineno): c for c in _codes(compile(source, path, "exec")) if c.co_name == name}
    living = [f for f in gc.get_objects() if isinstance(f, types.FunctionType) and f.__code__.co_filename == path]
    places = [(f, (f.__code__.co_qualname, f.__code__.co_firstlineno)) for f in living]
    for function, place in places:
        function.__code__ = codes.get(place, function.__code__)
    return sum(place in codes for _, place in places)


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield constant
            yield from _codes(constant)


def _kill(group: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


def _keep(work: Path, mutant: Mutant, answer: dict[str, Any]) -> None:
    source = (ROOT / mutant.file).read_text().split("\n")[mutant.line - 1].strip()
    with (work / "results.jsonl").open("a") as file:
        file.write(json.dumps({**asdict(mutant), "source": source, **answer}) + "\n")


# --- in a copy of the tree


def confirm(mutant: Mutant, folder: Path, known: Map, budget_s: float) -> dict[str, Any]:
    """Change the file in a copy of what git knows, run the tests there, compiled; none of its processes is left."""
    tree, links = folder / "tree", folder / "python" / "maxq"
    if not tree.exists():
        names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True).stdout
        for name in filter(None, names.split("\0")):
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name, follow_symlinks=False)
        links.mkdir(parents=True)
        for layer in ("api", "control", "sim", "design", "tools", "scenarios"):
            (links / layer).symlink_to(tree / layer)
        (folder / "cache").mkdir(mode=0o700)
    kernels, tests = mutant.file.startswith(COMPILED_FROM), _tests_for(mutant, known, budget_s)
    fly = sorted((n for n, (_, calls) in known.items() if "sim/run/fly.py:fly" in calls), key=lambda n: known[n][0])
    tests = list(dict.fromkeys([FIRST, *tests, *fly])) if kernels or not tests else tests
    environment = {**os.environ, "PYTHONPATH": str(links.parent), "XDG_CACHE_HOME": str(folder / "cache")}
    run = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow", "-p", "no:cacheprovider", "-rfE", *tests]
    kept, began = set((folder / "cache").glob("maxq/*")), time.monotonic()
    path = tree / mutant.file
    path.write_text(changed(mutant))
    with (folder / "output.txt").open("w+") as output:
        process = subprocess.Popen(run, cwd=tree, env=environment, stdin=subprocess.DEVNULL, stdout=output,
                                   stderr=subprocess.STDOUT, start_new_session=True)  # fmt: skip
        try:
            code = process.wait(1800.0)
        except subprocess.TimeoutExpired:
            code = -1
        finally:
            _kill(process.pid)
            process.wait()
            shutil.copy2(ROOT / mutant.file, path)
        output.seek(0)
        said = [line for line in output.read().splitlines() if line.startswith(("FAILED", "ERROR", "E "))]
    for made in set((folder / "cache").glob("maxq/*")) - kept if kernels else ():
        shutil.rmtree(made)
    how = "time-out" if code == -1 else (said or [f"exit {code}"])[-1][:300]
    answer = {"status": "survived"} if code in (0, 5) else {"status": "killed", "how": how}
    return {**answer, "mode": "copy", "tests": len(tests), "seconds": round(time.monotonic() - began, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("do", choices=["map", "run", "confirm", "table"])
    parser.add_argument("tests", nargs="*", help="of `map`: these files only")
    parser.add_argument("--work", type=Path, required=True, help="folder for copies, maps and results")
    parser.add_argument("--mode", choices=["plain", "compiled"], default="compiled")
    parser.add_argument("--number", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--named", action="store_true", help="the faults of harness_mutants.py")
    parser.add_argument("--only", help="numbers of mutants, with commas; run again whatever results.jsonl says")
    parser.add_argument("--part", type=int, default=1, help="of --parts, each in a process of its own")
    parser.add_argument("--parts", type=int, default=1)
    parser.add_argument("--budget", type=float, default=60.0, help="processor seconds of tests for a mutant, as mapped")
    parser.add_argument("--most", type=float, default=20.0, help="processor seconds of one test; then it is left out")
    parser.add_argument(
        "--warm", nargs="*", default=[], help="of `run`: beginnings of tests that run before all mutants"
    )
    given = parser.parse_intermixed_args()
    given.work = given.work.resolve()
    given.work.mkdir(parents=True, exist_ok=True)
    results, mapped = given.work / "results.jsonl", given.work / f"map-{given.mode}.json"
    done = {r["number"]: r for r in map(json.loads, results.read_text().splitlines())} if results.exists() else {}
    known: Map = json.loads(mapped.read_text()) if mapped.exists() and given.do != "map" else {}
    mutants = named() if given.named else drawn(given.number, given.seed)
    if given.only:
        mutants = [m for m in mutants if m.number in {int(n) for n in given.only.split(",")}]
    elif given.do == "run":
        kernels = given.mode == "plain"
        mutants = [m for m in mutants if m.number not in done and m.file.startswith(COMPILED_FROM) == kernels]
    else:
        mutants = [m for m in mutants if done.get(m.number, {}).get("status") not in (None, "killed")]
    each = given.number // len(PACKAGES)  # packages in turn, so that an early end says something of each
    mutants = sorted(mutants, key=lambda m: (m.number % each, m.number))[given.part - 1 :: given.parts]
    if given.do == "table":
        table([r for r in done.values() if (r["number"] >= 1000) == given.named])
    elif given.do == "confirm":
        for mutant in mutants:
            _keep(given.work, mutant, confirm(mutant, given.work / f"copy-{given.part}", known, given.budget))
    else:
        if given.mode == "plain":
            os.environ["NUMBA_DISABLE_JIT"] = "1"
        os.chdir(ROOT)
        files = given.tests or sorted({n.split("::")[0] for n in known}) or ["tests"]
        options = ["-s", "-m", "not slow", "-p", "no:cacheprovider", "-p", "no:terminal"]
        pytest.main([*options, "--ignore-glob=*packaging*", *files], plugins=[_Server(mutants, known, given)])


def table(done: list[dict[str, Any]]) -> None:
    """Counts by package, and a line for each survivor."""
    print("| package | mutants | killed | share |\n|---|---|---|---|")
    for package in [*PACKAGES, "all"]:
        own = [r for r in done if package in (r["package"], "all")]
        killed = sum(r["status"] == "killed" for r in own)
        print(f"| {package} | {len(own)} | {killed} | {100.0 * killed / max(len(own), 1):.1f} % |")
    print("\n| mutant | place | change |\n|---|---|---|")
    for r in done:
        if r["status"] != "killed":
            change = f"`{r['source']}`: `{r['old']}` at {r['column']} -> `{r['new']}`"
            print(f"| {r['number']} | {r['file']}:{r['line']} | {change} |")


if __name__ == "__main__":
    main()
