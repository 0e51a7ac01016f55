"""pyproject.toml, constraints.txt and the Makefile agree with the files on disk."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import control
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from maxq.tools.dev.lowest import lowest_versions

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
LAYERS = ("control", "sim", "design", "tools")
PIN = re.compile(r"([A-Za-z0-9._-]+)==([A-Za-z0-9.+!]+)")


def modules():
    """Yield all modules of the four layers; tools/.ns contains only links to them, for type checkers."""
    for layer in LAYERS:
        yield from (p for p in (ROOT / layer).rglob("*.py") if ".ns" not in p.parts)


def make(*arguments):
    """Run make as a user would, outside any make that runs the tests."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS"))}
    return subprocess.run(["make", *arguments], cwd=ROOT, env=environment, capture_output=True, text=True, check=False)


def test_every_folder_with_modules_is_a_listed_package():
    folders = {path.parent.relative_to(ROOT).parts for path in modules()}
    on_disk = {"maxq." + ".".join(parts) for parts in folders if parts[:2] != ("tools", "dev")}  # dev/ is not installed
    listed = set(PROJECT["tool"]["setuptools"]["packages"])
    # tools/ itself and scenarios/ (data) are packages with or without modules
    assert listed == on_disk | {"maxq", "maxq.tools", "maxq.scenarios"}


def test_every_package_maps_to_its_folder():
    folders = PROJECT["tool"]["setuptools"]["package-dir"]
    assert folders == {"maxq": "api"} | {f"maxq.{name}": name for name in (*LAYERS, "scenarios")}


def test_no_layer_can_shadow_another_package():
    """No layer has an __init__.py, with which `import control` in the checkout would import the flight software."""
    assert [p for layer in LAYERS for p in (ROOT / layer).rglob("__init__.py")] == []


@pytest.mark.slow
def test_control_is_python_control_and_maxq_control_is_ours():
    assert control.tf([1], [1, 1]).poles() == [-1]
    code = "import control, maxq.control.laws.pd as m; print(control.tf([1], [1, 1]).poles()[0].real, m.__file__)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    pole, file = done.stdout.split(maxsplit=1)
    assert float(pole) == -1
    assert Path(file.strip()) == ROOT / "control" / "laws" / "pd.py"


def test_links_for_type_checkers_lead_to_the_layers():
    links = ROOT / "tools" / ".ns" / "maxq"
    assert {link.name: os.readlink(link) for link in links.iterdir()} == {
        layer: f"../../../{layer}" for layer in ("api", *LAYERS)
    }


def pinned_versions():
    """Return the version of each package that constraints.txt pins, by canonical name."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    matches = [PIN.fullmatch(line) for line in lines if not line.startswith("#")]
    assert all(matches), "constraints.txt holds comments and NAME==VERSION, nothing else"
    return {canonicalize_name(match[1]): match[2] for match in matches if match}


def test_constraints_pin_every_requirement_within_its_range():
    pins = pinned_versions()
    extras = PROJECT["project"]["optional-dependencies"]
    wanted = [
        *PROJECT["build-system"]["requires"],
        *PROJECT["project"]["dependencies"],
        *(requirement for extra in extras.values() for requirement in extra),
    ]
    for requirement in map(Requirement, wanted):
        pin = pins.get(canonicalize_name(requirement.name))
        assert pin is not None, f"constraints.txt does not pin {requirement.name}"
        assert requirement.specifier.contains(pin), f"{requirement.name}=={pin} is not {requirement.specifier}"


def test_every_bound_of_a_requirement_is_stated_and_tested():
    """`make test-lowest` installs the lowest versions; the pins, with which all tests run, are within the highest ones.

    The upper bounds are of packages whose private or experimental parts are used: Numba's and the viewer's.
    """
    pins, lowest, upper = pinned_versions(), dict(lowest_versions(PROJECT)), {}
    for requirement in map(Requirement, PROJECT["project"]["dependencies"]):
        assert requirement.specifier.contains(lowest[requirement.name])
        assert Version(lowest[requirement.name]) <= Version(pins[canonicalize_name(requirement.name)])
        upper.update((requirement.name, part.version) for part in requirement.specifier if part.operator == "<")
        assert {part.operator for part in requirement.specifier} <= {">=", "<"}
    assert set(upper) == {"numba", "rerun-sdk"}
    for name, bound in upper.items():
        first, second = Version(pins[name]).release[:2]
        assert bound == f"{first}.{second + 1}", f"{name}: constraints.txt pins no version of the highest minor one"
        assert Version(lowest[name]).release[:2] < (first, second), f"{name}: one minor version only"


def test_help_names_every_target_for_people():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    said = make("help").stdout
    assert {line.split("\t")[0].strip() for line in said.splitlines()[1:]} == targets


@pytest.mark.parametrize(
    ("script", "message"),
    [
        (None, "needs Python 3.11 or later, and there is no"),
        ("case $1 in --version) echo Python 3.9.2;; *) exit 1;; esac", "is Python 3.9.2"),
        ('case "$2" in *version_info*) exit 0;; *) exit 1;; esac', "apt install python3-venv"),
    ],
    ids=["no python", "old python", "no venv module"],
)
def test_make_says_what_is_missing(tmp_path, script, message):
    python = tmp_path / "python3"
    if script is not None:
        python.write_text(f"#!/bin/sh\n{script}\n")
        python.chmod(0o755)
    done = make("fly", f"PYTHON={python}", f"VENV={tmp_path / 'venv'}")
    assert done.returncode == 2
    assert message in done.stderr
    assert not (tmp_path / "venv").exists()


ONE_VEHICLE = re.compile(r"ksr|anheung|korea|reconstruct|\bkari\b", re.IGNORECASE)
THE_PAPER = re.compile(r"\bpaper\b|\bRoh\b")
NAMES_ONE = {
    "design/paper/table2.py": "the paper's Table 2",
    "tools/cli/frame.py": "built-in examples in help",
    "tools/design/report.py": "the command's default design",
    "tools/simdesign.py": "examples in help",
    "tools/simrun.py": "examples in help",
    "tools/simvehicle.py": "examples in help",
    "tools/simverify.py": "examples in help",
}
PAPER_MODE = {
    "control/structures.py",
    "design/case/basis.py",
    "design/case/schema.py",
    "design/paper/errata_effects.py",
    "design/paper/errata.py",
    "design/paper/model.py",
    "design/paper/nodes.py",
    "design/quantities.py",
    "design/verify/judging.py",
    "sim/scenario/schema_design.py",
    "sim/vehicle/actuator/section.py",
    "sim/vehicle/air/section.py",
    "sim/scenario/schema_vehicle.py",
    "tools/design/analyse.py",
    "tools/design/report.py",
    "tools/simdesign.py",
}


def _said(file: Path) -> list[str]:
    """Return the texts of a file: the strings of a Python file without docstrings, other sources whole."""
    text = file.read_text(encoding="utf-8")
    if file.suffix != ".py":
        return [text]
    tree = ast.parse(text)
    prose = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}
    return [
        n.value
        for n in ast.walk(tree)
        if isinstance(n, ast.Constant) and isinstance(n.value, str) and id(n) not in prose
    ]


@pytest.mark.slow
def test_nothing_of_one_vehicle_is_said_by_the_code():
    """Only data, the paper's mode and examples name the first vehicle, its site or its source."""
    suffixes = {".py", ".j2", ".html", ".css", ".js", ".c", ".h"}
    files = [f for top in (*LAYERS, "api") for f in sorted((ROOT / top).rglob("*")) if f.suffix in suffixes]
    shipped = [f for f in files if not {"dev", ".ns"} & set(f.relative_to(ROOT).parts)]
    found = {f.relative_to(ROOT).as_posix(): "\n".join(_said(f)) for f in shipped}
    assert {name for name, text in found.items() if ONE_VEHICLE.search(text)} == set(NAMES_ONE)
    assert {name for name, text in found.items() if THE_PAPER.search(text)} <= PAPER_MODE
    generic = (ROOT / "scenarios/suites/launcher.toml").read_text()
    assert not ONE_VEHICLE.search(generic)
    assert not re.search(r"stage\.\d|tank\.\d|_s=\d{2}", generic)  # by no number, at no second
