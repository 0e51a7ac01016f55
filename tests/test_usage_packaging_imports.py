"""Imports point one way (tools -> design -> sim -> control), and kernels know neither files nor people."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def lint_imports(root):
    """Run import-linter on the checkout `root`, through the links in tools/.ns as `make lint` does."""
    script = Path(sys.executable).parent / "lint-imports"
    command = [sys.executable, str(script), "--no-logo", "--no-cache"]
    environment = os.environ | {"PYTHONPATH": str(root / "tools" / ".ns"), "COLUMNS": "300"}
    return subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture
def copy(tmp_path):
    """A copy of the layers, to put mistakes into."""
    for layer in ("control", "sim", "design", "tools", "api"):
        if (ROOT / layer).exists():
            shutil.copytree(ROOT / layer, tmp_path / layer, symlinks=True)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_imports_point_one_way():
    done = lint_imports(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "7 kept, 0 broken" in done.stdout


@pytest.mark.parametrize(
    ("module", "line", "broken"),
    [
        ("control/upward.py", "import maxq.sim.world.wind", "maxq.control is not allowed to import maxq.sim"),
        ("sim/log/upward.py", "import maxq.tools.plots.style", "maxq.sim is not allowed to import maxq.tools"),
        ("control/laws/pd.py", "import pydantic", "maxq.control is not allowed to import pydantic"),
        ("sim/flight/loop.py", "import rich", "maxq.sim.flight is not allowed to import rich"),
        (
            "sim/vehicle/aero.py",
            "import maxq.sim.scenario.loader",
            "maxq.sim.vehicle is not allowed to import maxq.sim.scenario",
        ),
        (
            "tools/replay/upward.py",
            "import maxq.tools.dev.bench.run",
            "maxq.tools.replay is not allowed to import maxq.tools.dev",
        ),
    ],
)
def test_an_import_the_other_way_is_found(copy, module, line, broken):
    with (copy / module).open("a") as file:
        file.write(f"\n{line}\n")
    done = lint_imports(copy)
    assert done.returncode == 1
    assert broken in " ".join(done.stdout.split())
