"""Mutations: does a quick test fail when one token of the source is changed?

    python -m maxq.tools.dev.mutations map --work DIR              which quick test runs which line (once)
    python -m maxq.tools.dev.mutations run --work DIR              draw mutants, run the tests that can see each
    python -m maxq.tools.dev.mutations run --work DIR --only 17,40 the same mutants again, after new tests
    python -m maxq.tools.dev.mutations table --work DIR            counts by package, and the survivors

Every worker has a copy of the tree under DIR, at a path of its own, and a cache of kernels of its own. A kernel's
mutant meets the tests with kernels as plain Python first (`NUMBA_DISABLE_JIT=1`): compiling takes a minute, and is left
to what survives. Tests that run the changed statement come first, then the rest of their files, then what touches the
module. Answers are appended to DIR/results.jsonl; what stands there is not run again. DIR/map-*.json hold what `map`
measured.

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
from typing import Any

import coverage
import pytest
from _pytest.runner import runtestprotocol

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "control": ("control",),
    "sim/vehicle": ("sim/vehicle",),
    "sim/flight": ("sim/flight",),
    "design": ("design/case", "design/certificate", "design/laws", "design/loop", "design/margins", "design/model",
               "design/optimise"),
    "statistics": ("sim/campaign", "design/verify"),
}  # fmt: skip
FIRST = "tests/test_regression_nominal.py"  # the strongest test of a compiled flight
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


def _begin(node: ast.stmt) -> tuple[int, int]:
    return node.lineno, node.col_offset


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


# --- running the tests in a copy of the tree


def _copy(folder: Path) -> dict[str, str]:
    """A copy of what git knows, and an environment in which `maxq` is this copy."""
    tree = folder / "tree"
    if not tree.exists():
        names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True).stdout
        for name in filter(None, names.split("\0")):
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name, follow_symlinks=False)
    links = folder / "python" / "maxq"
    if not links.exists():
        links.mkdir(parents=True)
        for layer in ("control", "sim", "design", "tools", "scenarios"):
            (links / layer).symlink_to(tree / layer)
        (links.parent / "sitecustomize.py").write_text("import coverage\ncoverage.process_startup()\n")  # of `map`
    (folder / "cache").mkdir(mode=0o700, exist_ok=True)
    here = {"PYTHONPATH": str(links.parent), "XDG_CACHE_HOME": str(folder / "cache"), "MPLBACKEND": "Agg"}
    return {**os.environ, **here, "PYTHONDONTWRITEBYTECODE": "1"}


def _pytest(folder: Path, mode: str, tests: list[str], limit_s: float, *options: str, **more: str) -> tuple[int, str]:
    """Exit code and output; None of its processes outlives it. Code -1: time-out."""
    environment = {**_copy(folder), **({"NUMBA_DISABLE_JIT": "1"} if mode == "plain" else {}), **more}
    run = [sys.executable, *options, "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", "--tb=line"]
    run += ["-rfE", "--ignore-glob=*packaging*", *tests]  # those ask whether maxq can be installed, and take long
    with (folder / "output.txt").open("w+") as output:
        process = subprocess.Popen(run, cwd=folder / "tree", env=environment, stdout=output, stderr=subprocess.STDOUT,
                                   stdin=subprocess.DEVNULL, start_new_session=True)  # fmt: skip
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            code = -1
        finally:
            _kill(process.pid)
            process.wait()
        output.seek(0)
        return code, output.read()


def _kill(group: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, signal.SIGKILL)


# --- which test runs which line


class _Watch:
    """Within pytest: lines by test, how long each took and whether it passed; what takes over `limit_s` fails."""

    def __init__(self, out: Path, limit_s: int) -> None:
        self.out, self.limit_s = out, limit_s
        self.tests: dict[str, list[Any]] = {}
        os.environ["COVERAGE_PROCESS_START"] = os.environ["MUTATIONS_RC"]
        signal.signal(signal.SIGPROF, lambda *_: pytest.fail("too long for this"))

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        current = coverage.Coverage.current()
        assert current
        current.switch_context(item.nodeid)
        signal.setitimer(signal.ITIMER_PROF, self.limit_s)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        entry = self.tests.setdefault(report.nodeid, [0.0, True])
        entry[0] += report.duration
        entry[1] &= report.passed
        if report.when == "call":
            signal.setitimer(signal.ITIMER_PROF, 0)

    def pytest_sessionfinish(self) -> None:
        self.out.write_text(json.dumps(self.tests))


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(_Watch(Path(os.environ["MUTATIONS_TESTS"]), int(os.environ["MUTATIONS_LIMIT"])))


def measure(work: Path, mode: str, limit_s: int, tests: list[str]) -> None:
    """Write work/map-MODE.json: tests (seconds, passed) and, by file and line, the numbers of the tests that run it."""
    folder = work / "w0"
    _copy(folder)
    data, rc, seen = work / f"coverage-{mode}", work / "coverage.rc", work / f"tests-{mode}.json"
    sources = ", ".join(str(folder / "tree" / layer) for layer in ("control", "sim", "design", "tests"))
    rc.write_text(f"[run]\nsource={sources}\nparallel=true\ndata_file={data}\ncontext=${{PYTEST_CURRENT_TEST-}}\n")
    more = {"MUTATIONS_RC": str(rc), "MUTATIONS_TESTS": str(seen), "MUTATIONS_LIMIT": str(limit_s)}
    watch = ["-p", "maxq.tools.dev.mutations", *tests]
    code, output = _pytest(folder, mode, watch, 7200.0, "-m", "coverage", "run", f"--rcfile={rc}", **more)
    print(f"{mode}: exit {code}: {output.splitlines()[-1]}")
    whole = coverage.Coverage(data_file=str(data), config_file=False)
    whole.combine([str(work)])
    took = json.loads(seen.read_text())
    names = [name for name, (_, passed) in took.items() if passed]
    number, lines = {name: k for k, name in enumerate(names)}, {}
    for file in whole.get_data().measured_files():
        by_line = {
            at: sorted({number[n] for n in (c.rsplit(" (", 1)[0] for c in contexts) if n in number})
            for at, contexts in whole.get_data().contexts_by_lineno(file).items()
        }
        lines[Path(file).relative_to(folder / "tree").as_posix()] = {at: by for at, by in by_line.items() if by}
    (work / f"map-{mode}.json").write_text(json.dumps({"tests": [[n, took[n][0]] for n in names], "lines": lines}))


def _tests_for(mutant: Mutant, mapped: dict[str, Any], budget_s: float) -> tuple[list[str], float]:
    """Tests, nearest first, and how long they take: what runs the statement, its files, what runs the module."""
    lines, tests = mapped["lines"].get(mutant.file, {}), mapped["tests"]
    spans = [(n.lineno, n.end_lineno or 0) for n in ast.walk(ast.parse((ROOT / mutant.file).read_text()))
             if isinstance(n, ast.stmt) and n.lineno <= mutant.line <= (n.end_lineno or 0)]  # fmt: skip
    first, last = min(spans, key=lambda span: span[1] - span[0])
    near = set(lines.get(str(mutant.line), ())) or {k for at in range(first, last + 1) for k in lines.get(str(at), ())}
    files = {tests[k][0].split("::")[0] for k in near}
    module = {k for by in lines.values() for k in by}
    same = {k for k in module if tests[k][0].split("::")[0] in files} - near
    order = [k for group in (near, same, module - near - same) for k in sorted(group, key=lambda k: tests[k][1])]
    out, total = [], 0.0
    for k in order:
        if total + tests[k][1] <= budget_s:
            out.append(tests[k][0])
            total += tests[k][1]
    return out, total


def _flights(mapped: dict[str, Any], budget_s: float) -> list[str]:
    """Tests that fly, or evaluate the derivative: coverage does not see into compiled kernels."""
    files = [mapped["lines"].get(file, {}) for file in ("sim/run/fly.py", "sim/run/evaluate.py", "tests/flightkit.py")]
    order = sorted({k for lines in files for by in lines.values() for k in by}, key=lambda k: mapped["tests"][k][1])
    total = itertools.accumulate(mapped["tests"][k][1] for k in order)
    return [mapped["tests"][k][0] for k, s in zip(order, total, strict=True) if s <= budget_s]


# --- mutants in a process that has imported everything: the changed code is put into the living functions


class _Server:
    """Within pytest, in place of its loop: a forked process for each mutant runs its tests until one fails."""

    def __init__(self, mutants: list[Mutant], mapped: dict[str, Any], given: argparse.Namespace) -> None:
        self.mutants, self.mapped, self.given = mutants, mapped, given

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        items, seen = {item.nodeid: item for item in session.items}, self._warmed(session)
        for mutant in self.mutants:
            tests, expected_s = _tests_for(mutant, self.mapped, self.given.budget)
            name, own = _holder(mutant), [n for n, _ in self.mapped["tests"]]
            more = sorted((took, n) for n, (took, calls) in seen.items() if (mutant.file, name) in calls)
            near = self.mapped["lines"].get(mutant.file, {}).get(str(mutant.line), ())
            tests = list(dict.fromkeys([*(own[k] for k in near if own[k] in tests), *(n for _, n in more), *tests]))
            chosen, began = [items[n] for n in tests if n in items], time.monotonic()
            answer = self.given.work / f"answer-{os.getpid()}.json"
            answer.write_text(json.dumps({"status": "died"}))
            child = os.fork()
            if child == 0:
                _meet(mutant, chosen, answer, expected_s + sum(took for took, _ in more), self.given.most)
            _, code = os.waitpid(child, 0)
            _kill(child)
            out = json.loads(answer.read_text())
            if out["status"] == "died":
                out = {"status": "killed", "how": f"signal {code & 127}"}
            took = {"mode": self.given.mode, "tests": len(chosen), "seconds": round(time.monotonic() - began, 1)}
            _keep(self.given.work, mutant, {**out, **took})
        return True

    def _warmed(self, session: pytest.Session) -> dict[str, tuple[float, set[tuple[str, str]]]]:
        """Run tests that are to be warm here, so that oracles and compiled flights they keep are there for all; how
        long each took, and the functions it called. What fails without a mutant is left out.
        """
        out, warm = {}, [i for i in session.items if i.nodeid.startswith(tuple(self.given.warm)) and self.given.warm]
        for item, after in zip(warm, [*warm[1:], None], strict=True):
            calls: set[types.CodeType] = set()
            began = time.process_time()
            signal.setitimer(signal.ITIMER_PROF, 60.0 if "dynamics.py" in item.nodeid or "lagrange" in item.nodeid else self.given.most)
            sys.setprofile(partial(_note, calls))
            reports = runtestprotocol(item, nextitem=after, log=False)
            sys.setprofile(None)
            signal.setitimer(signal.ITIMER_PROF, 0)
            took = time.process_time() - began
            good = all(report.passed for report in reports)
            print(f"{took:6.1f} s {'passed' if good else 'LEFT OUT'} {item.nodeid}", file=sys.__stderr__, flush=True)
            if good:
                top = f"{ROOT}{os.sep}"
                ours = {
                    (c.co_filename.removeprefix(top), c.co_qualname) for c in calls if c.co_filename.startswith(top)
                }
                out[item.nodeid] = took, ours
        return out


def _note(calls: set[types.CodeType], frame: types.FrameType, event: str, _: object) -> None:
    if event == "call":
        calls.add(frame.f_code)


def _too_long(*_: object) -> None:
    pytest.skip("takes too long here")


def _holder(mutant: Mutant) -> str:
    """Qualified name of the innermost function or method around a mutant; empty: it is outside of any."""
    names = list[str]()
    node: ast.AST = ast.parse((ROOT / mutant.file).read_text())
    while True:
        inside = [
            n for n in ast.walk(node) if n is not node and isinstance(n, (ast.FunctionDef, ast.ClassDef))
            and n.lineno <= mutant.line <= (n.end_lineno or 0)
        ]  # fmt: skip
        if not inside:
            return ".".join(names)
        inner = min(inside, key=lambda n: n.lineno)
        names += [inner.name] if not names or isinstance(node, ast.ClassDef) else ["<locals>", inner.name]
        node = inner


def _meet(mutant: Mutant, tests: list[pytest.Item], answer: Path, expected_s: float, most: float) -> None:
    """In the forked process: change the code, run the tests, write the answer, end."""
    os.setsid()
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(null, stream)
    limit = int(60.0 + 5.0 * expected_s)
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
    out = {"status": "survived"} if _patch(mutant) else {"status": "not patched"}
    if out["status"] == "survived":
        for item, after in zip(tests, [*tests[1:], None], strict=True):
            signal.setitimer(signal.ITIMER_PROF, most)
            bad = [report for report in runtestprotocol(item, nextitem=after, log=False) if report.failed]
            if bad:
                lines = str(bad[0].longrepr).splitlines()
                out = {
                    "status": "killed",
                    "how": f"{item.nodeid}: {next((x for x in lines if x[:2] == 'E '), '')}"[:300],
                }
                break
    answer.write_text(json.dumps(out))
    os._exit(0)


def _patch(mutant: Mutant) -> int:
    """Give every living function that holds the mutant its changed code; how many there are."""
    path = ROOT / mutant.file
    source = _changed(mutant, path.read_text())
    outer = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef) and _inside(n, mutant)]
    if not outer:
        return 0
    first = min(outer, key=lambda n: n.lineno)
    codes = {c.co_qualname: c for c in _codes(compile(source, str(path), "exec")) if c.co_name == first.name}
    living = [f for f in gc.get_objects() if isinstance(f, types.FunctionType) and f.__code__.co_filename == str(path)]
    living = [
        f for f in living if f.__code__.co_qualname in codes and _at(f.__code__) == _at(codes[f.__code__.co_qualname])
    ]
    for function in living:
        function.__code__ = codes[function.__code__.co_qualname]
    return len(living)


def _inside(function: ast.FunctionDef, mutant: Mutant) -> bool:
    """Within the body: defaults and decorators are not part of a function's code."""
    return _begin(function.body[0]) <= (mutant.line, mutant.column) < _end(function)


def _at(code: types.CodeType) -> int:
    return code.co_firstlineno


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield constant
            yield from _codes(constant)


def _changed(mutant: Mutant, source: str) -> str:
    lines = source.split("\n")
    text = lines[mutant.line - 1].encode()  # ast counts bytes
    assert text[mutant.column :].startswith(mutant.old.encode())
    lines[mutant.line - 1] = (
        text[: mutant.column] + mutant.new.encode() + text[mutant.column + len(mutant.old) :]
    ).decode()
    return "\n".join(lines)


def _keep(work: Path, mutant: Mutant, answer: dict[str, Any]) -> None:
    source = (ROOT / mutant.file).read_text().split("\n")[mutant.line - 1].strip()
    line = json.dumps({**asdict(mutant), "source": source, **answer})
    with (work / "results.jsonl").open("a") as file:
        file.write(line + "\n")


# --- mutants in a copy of the tree, compiled: what the processes above could not change, and what survived there


def judge(mutant: Mutant, folder: Path, maps: dict[str, Any], budget_s: float) -> dict[str, Any]:
    """Change the file, run the stages until one fails, put the file back as it was."""
    _copy(folder)
    path, began = folder / "tree" / mutant.file, time.monotonic()
    shutil.copy2(ROOT / mutant.file, path)
    source, stamp = path.read_text(), path.stat()
    compiled_anew = mutant.file.startswith(COMPILED_FROM)
    kept = set((folder / "cache").glob("maxq/*"))
    out: dict[str, Any] = {"stages": [], "status": "survived", "mode": "copy"}
    try:
        path.write_text(_changed(mutant, source))
        for mode in ("plain", "compiled") if compiled_anew else ("compiled",):
            tests, expected_s = _tests_for(mutant, maps[mode], budget_s)
            if mode == "compiled" and compiled_anew:
                tests = list(dict.fromkeys([FIRST, *tests, *_flights(maps[mode], budget_s)]))
                expected_s += 600.0 + budget_s
            if not tests:
                continue
            code, output = _pytest(folder, mode, ["-x", *tests], 120.0 + 5.0 * expected_s)
            out["stages"].append([mode, len(tests), code])
            if code not in (0, 5):
                said = [line for line in output.splitlines() if line.startswith(("FAILED", "ERROR", "E "))]
                how = "time-out" if code == -1 else (said or output.splitlines() or [str(code)])[-1][:300]
                out |= {"status": "killed", "how": how}
                break
    finally:
        path.write_text(source)
        os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
        for made in set((folder / "cache").glob("maxq/*")) - kept if compiled_anew else ():
            shutil.rmtree(made)
    return out | {"seconds": round(time.monotonic() - began, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("do", choices=["map", "run", "confirm", "table"])
    parser.add_argument("tests", nargs="*", help="of `map`: these tests only")
    parser.add_argument("--work", type=Path, required=True, help="folder for copies, caches, maps and results")
    parser.add_argument("--mode", choices=["plain", "compiled"], help="of `map` and `run`")
    parser.add_argument("--number", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", type=int, default=1, help="of --parts, each in a process of its own")
    parser.add_argument("--parts", type=int, default=1)
    parser.add_argument("--warm", nargs="*", default=[], help="tests, by their beginnings, that run before all mutants")
    parser.add_argument("--most", type=float, default=20.0, help="processor seconds of one test; then it is left out")
    parser.add_argument("--only", help="numbers of mutants, with commas; run again whatever results.jsonl says")
    parser.add_argument("--budget", type=float, default=200.0, help="seconds of tests for a mutant and mode, as mapped")
    given = parser.parse_intermixed_args()
    work: Path = given.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    results = work / "results.jsonl"
    done = {r["number"]: r for r in map(json.loads, results.read_text().splitlines())} if results.exists() else {}
    if given.do == "map":
        for mode in [given.mode] if given.mode else ["plain", "compiled"]:
            measure(work, mode, 8 if mode == "plain" else 60, given.tests)
    elif given.do == "table":
        table(list(done.values()))
    else:
        mutants = drawn(given.number, given.seed)
        each = given.number // len(PACKAGES)  # packages in turn, so that an early end says something of each
        mutants.sort(key=lambda m: (m.number % each, m.number))
        if given.only:
            mutants = [m for m in mutants if m.number in {int(n) for n in given.only.split(",")}]
        elif given.do == "run":
            mutants = [m for m in mutants if m.number not in done]
        else:
            mutants = [m for m in mutants if m.number in done and done[m.number]["status"] != "killed"]
        if given.do == "confirm":
            maps = {mode: json.loads((work / f"map-{mode}.json").read_text()) for mode in ("plain", "compiled")}
            for mutant in mutants:
                _keep(work, mutant, judge(mutant, work / "w0", maps, given.budget))
            return
        mutants = [m for m in mutants if m.file.startswith(COMPILED_FROM) == (given.mode == "plain")]
        mutants = mutants[given.part - 1 :: given.parts]
        mapped = json.loads((work / f"map-{given.mode}.json").read_text())
        if given.mode == "plain":
            os.environ["NUMBA_DISABLE_JIT"] = "1"
        os.chdir(ROOT)
        signal.signal(signal.SIGPROF, _too_long)
        files = sorted({name.split("::")[0] for name in (*given.warm, *(name for name, _ in mapped["tests"]))})
        options = ["-s", "-m", "not slow", "-p", "no:cacheprovider", "-p", "no:terminal"]
        pytest.main([*options, *files], plugins=[_Server(mutants, mapped, given)])


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
