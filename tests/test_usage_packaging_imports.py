"""Imports follow one direction (tools -> design -> sim -> control), and kernels import no files or user interface."""

import ast
import graphlib
import os
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LAYERS = ("control", "sim", "design", "tools", "api")


@cache
def import_nodes(text):
    """Return the import statements in a source text; all sources take seconds to parse."""
    return [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Import | ast.ImportFrom)]


def imports_of(root):
    """Return the maxq modules that each module imports, at its top, in functions and for type checkers alike."""
    files = {
        "maxq." + ".".join(path.relative_to(root).with_suffix("").parts): path
        for layer in LAYERS[:-1]
        for path in (root / layer).rglob("*.py")
        if ".ns" not in path.parts
    } | {"maxq": root / "api" / "__init__.py"}
    graph = {}
    for module, path in files.items():
        found = set()
        for node in import_nodes(path.read_text()):
            if isinstance(node, ast.ImportFrom) and node.module in files:
                found.add(node.module)
            elif isinstance(node, ast.ImportFrom):
                found |= {f"{node.module}.{alias.name}" for alias in node.names} & set(files)
            else:
                found |= {alias.name for alias in node.names} & set(files)
        graph[module] = found - {module}
    return graph


def lint_imports(root):
    """Run import-linter on the checkout `root`, through the links in tools/.ns as `make lint` does."""
    script = Path(sys.executable).parent / "lint-imports"
    command = [sys.executable, str(script), "--no-logo", "--no-cache"]
    environment = os.environ | {"PYTHONPATH": str(root / "tools" / ".ns"), "COLUMNS": "300"}
    return subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture
def copy(tmp_path):
    """Return a copy of the layers for planted mistakes."""
    for layer in ("control", "sim", "design", "tools", "api"):
        if (ROOT / layer).exists():
            shutil.copytree(ROOT / layer, tmp_path / layer, symlinks=True)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_imports_point_one_way():
    done = lint_imports(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "7 kept, 0 broken" in done.stdout


@pytest.mark.slow
def test_no_file_imports_another_that_imports_it():
    """No two files import each other; import-linter checks packages, and this test cycles within one."""
    graph = imports_of(ROOT)
    assert sum(map(len, graph.values())) > 1000
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names the cycle


@pytest.mark.slow
def test_no_layer_imports_the_public_api():
    """No layer imports maxq.api, which import-linter would not see in an import of maxq itself."""
    assert [module for module, found in imports_of(ROOT).items() if "maxq" in found] == []


@pytest.mark.slow
def test_a_cycle_of_files_is_found(copy):
    with (copy / "sim/vehicle/engine/burn.py").open("a") as file:
        file.write("\n\ndef late() -> None:\n    from maxq.sim.scenario.schema_scenario import Scenario\n")
    with pytest.raises(graphlib.CycleError, match=r"sim\.vehicle\.engine\.burn"):
        graphlib.TopologicalSorter(imports_of(copy)).prepare()


def test_no_layer_names_a_higher_one_in_a_string():
    """No layer imports a higher one by name at run time, which import-linter would not see."""
    found = [
        f"{path.relative_to(ROOT)}: {name}"
        for n, layer in enumerate(LAYERS)
        for path in (ROOT / layer).rglob("*.py")
        if ".ns" not in path.parts
        for name in re.findall(r"[\"']maxq\.(\w+)[.\w]*[\"']", path.read_text())
        if name in LAYERS[n + 1 :]
    ]
    assert found == []


PLANTED = (
    ("control/upward.py", "import maxq.sim.world.wind", "maxq.control is not allowed to import maxq.sim"),
    ("sim/log/upward.py", "import maxq.tools.plots.style", "maxq.sim is not allowed to import maxq.tools"),
    ("control/laws/pd.py", "import pydantic", "maxq.control is not allowed to import pydantic"),
    ("sim/flight/loop.py", "import rich", "maxq.sim.flight is not allowed to import rich"),
    (
        "sim/vehicle/air/kernel.py",
        "import maxq.sim.scenario.loader",
        "maxq.sim.vehicle is not allowed to import maxq.sim.scenario",
    ),
    (
        "tools/replay/upward.py",
        "import maxq.tools.dev.bench.run",
        "maxq.tools.replay is not allowed to import maxq.tools.dev",
    ),
)


@pytest.mark.slow
def test_each_import_the_other_way_is_found(copy):
    """All are planted at once, because import-linter takes seconds to read the layers."""
    for module, line, _ in PLANTED:
        with (copy / module).open("a") as file:
            file.write(f"\n{line}\n")
    done = lint_imports(copy)
    assert done.returncode == 1
    found = " ".join(done.stdout.split())
    assert [broken for _, _, broken in PLANTED if f"{broken}:" not in found] == []
