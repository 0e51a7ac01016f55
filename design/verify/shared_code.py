"""The code that linear model, flight computer and simulator share, determined from the imports of their modules.

Agreement of two models gives no evidence about the code that both execute. This module derives the list of that code
from the sources, so that it cannot differ from the program.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

from maxq.design.laws.registry import designed_law
from maxq.sim.scenario.loader import LoadedScenario

_TOP = Path(__file__).resolve().parents[2]
_LINEAR = ("design/laws", "design/loop", "design/model")
_APART = ("control.kernel", "sim.input", "sim.scenario", "sim.campaign")
"""The packages without models: arrays and tables, input files, draws."""
_IMPORT = re.compile(r"^from maxq\.((?:control|sim)[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)


class SharedCode(NamedTuple):
    """A row of the list: the part, the programs that execute it, and its modules with the names that are imported."""

    part: str
    by: str
    modules: str


@cache
def imported_names() -> dict[str, frozenset[str]]:
    """Return the names that the linear model imports from flight computer and simulator, by module."""
    return _taken(_sources(*_LINEAR))


@cache
def modules_apart() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the modules of the linear model without shared code, and those of the computer not imported."""
    taken = imported_names()
    linear = tuple(name for name, path in _sources(*_LINEAR).items() if not _taken({name: path}))
    computer = (name for name in _sources("control") if not name.startswith(_APART))
    return linear, tuple(name for name in computer if name not in taken)


def _sources(*folders: str) -> dict[str, Path]:
    """Return the modules in folders, without the prefix maxq, and their files."""
    paths = (path for folder in folders for path in sorted((_TOP / folder).rglob("*.py")))
    return {".".join(path.relative_to(_TOP).with_suffix("").parts): path for path in paths}


def _taken(sources: dict[str, Path]) -> dict[str, frozenset[str]]:
    out: dict[str, set[str]] = {}
    for path in sources.values():
        for module, names in _IMPORT.findall(path.read_text(encoding="utf-8")):
            for name in re.sub(r"#[^\n]*", "", names).strip("()").split(","):
                word = name.partition(" as ")[0].strip()
                inner = (_TOP / module.replace(".", "/") / f"{word}.py").is_file()
                owner = f"{module}.{word}" if inner else module
                if word and not owner.startswith(_APART):
                    out.setdefault(owner, set()).update(() if inner else (word,))
    return {module: frozenset(names) for module, names in sorted(out.items())}


def shared_code(scenario: LoadedScenario) -> list[SharedCode]:
    """Return the shared and the separate code of flight code, linear model and simulator, as rows of text."""
    vehicle, design = scenario.vehicle, scenario.design
    computers = [c for c in map(vehicle.computer_of, range(len(vehicle.stage))) if c is not None]
    files = {f for c in computers for f in (c.library, c.python) if f is not None}
    laws = sorted({f"law {design.of_stage(n).law}" for n in range(len(vehicle.stage))}) if design is not None else []
    code = [f"flight code {file.title}, sha256 {file.sha256[:16]}" for file in files]
    code += ["flight code at a socket"] if any(c.address for c in computers) else []
    law = type(designed_law(design)) if design is not None else None
    linear = f"{law.__module__.removeprefix('maxq.')}.{law.__name__}" if law is not None else "none: no linear model"
    rows = [
        SharedCode("control law", "simulator", ", ".join(code or [f"{text} of control.computer" for text in laws])),
        SharedCode("control law", "linear model", linear),
    ]
    packages: dict[str, list[str]] = {}
    for module, names in imported_names().items():
        package = ".".join(module.split(".")[: 1 if module.startswith("control") else 2])
        said = f" ({', '.join(sorted(names))})" if names else ""
        packages.setdefault(package, []).append(f"{module.removeprefix(package + '.')}{said}")
    for package, modules in packages.items():
        rows.append(SharedCode(package, "simulator and linear model", "; ".join(modules)))
    alone, computer = modules_apart()
    short = ", ".join(name.removeprefix("design.") for name in alone)
    rows.append(SharedCode("loop and laws", "linear model only", short))
    short = ", ".join(name.removeprefix("control.") for name in computer)
    return [*rows, SharedCode("flight computer", "simulator only", short)]
