"""The files of a release agree with pyproject.toml, the Makefile and each other."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
GIVEN = {"matplotlib": "matplotlib-base"}  # names of conda's packages, where they differ
TEMPLATES = sorted((ROOT / ".github").rglob("*.md"))


def read(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text())


def test_the_version_is_the_same_everywhere() -> None:
    version = PROJECT["version"]
    assert re.fullmatch(r"\d+\.\d+\.\d+", version)
    assert read("CITATION.cff")["version"] == version
    assert read("conda/recipe.yaml")["context"]["version"] == version
    for name in ("Containerfile", "examples/cluster/kubernetes.yaml"):
        assert set(re.findall(r"maxq:(\S+)", (ROOT / name).read_text())) == {version}
    assert f"## {version}" in (ROOT / "CHANGELOG.md").read_text()


def test_conda_requires_what_the_package_requires() -> None:
    recipe = read("conda/recipe.yaml")
    wanted = {GIVEN.get(r.name, r.name): r.specifier for r in map(Requirement, PROJECT["dependencies"])}
    given = {r.name: r.specifier for r in map(Requirement, recipe["requirements"]["run"])}
    assert given.pop("python") == PROJECT["requires-python"]
    assert given == wanted
    points = dict(point.split(" = ") for point in recipe["build"]["python"]["entry_points"])
    assert points == PROJECT["scripts"]


def test_the_workflow_makes_targets_on_every_system_and_python() -> None:
    jobs = read(".github/workflows/test.yml")["jobs"]
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    called = [step["run"].split() for job in jobs.values() for step in job["steps"] if "run" in step]
    assert {words[0] for words in called} == {"make"}
    assert {words[1] for words in called} == {"lint", "test", "test-lowest", "test-slim", "docs", "dist"} <= targets
    matrix = jobs["test"]["strategy"]["matrix"]
    assert {system.partition("-")[0] for system in matrix["system"]} == {"ubuntu", "macos", "windows"}
    tried = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", c)}
    assert set(matrix["python"]) == tried | {"3.14"}
    assert min(matrix["python"]) == PROJECT["requires-python"].removeprefix(">=")


def test_the_container_is_built_from_files_that_exist() -> None:
    text = (ROOT / "Containerfile").read_text().replace("\\\n", " ")
    steps = re.findall(r"^RUN (.*)$", text, re.MULTILINE)
    assert len(steps) == 5
    for step in steps:
        subprocess.run(["sh", "-n", "-c", step], check=True)
    installed = shlex.split(steps[1])
    for option in ("--constraint", "-r"):
        assert (ROOT / installed[installed.index(option) + 1]).is_file()
    ignored = (ROOT / ".dockerignore").read_text().split()
    assert not {"api", "control", "design", "scenarios", "sim", "tools", "README.md", "LICENSE"} & set(ignored)


def test_hooks_call_programs_of_the_project() -> None:
    [repository] = read(".pre-commit-config.yaml")["repos"]
    assert repository["repo"] == "local"
    extras = {Requirement(line).name for line in PROJECT["optional-dependencies"]["lint"]} | {"lint-imports", "python"}
    for hook in repository["hooks"]:
        program = next(word for word in hook["entry"].split() if word.startswith(".venv/bin/"))
        assert program.removeprefix(".venv/bin/") in extras


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.name)
def test_templates_have_a_head(path: Path) -> None:
    text = path.read_text()
    if path.parent.name == "ISSUE_TEMPLATE":
        head = yaml.safe_load(text.split("---\n")[1])
        assert set(head) == {"name", "about"}
    assert text.count("**") >= 2


def test_nothing_names_a_host() -> None:
    """No address of a registry, a repository or a machine is in the files of a release."""
    names = [".pre-commit-config.yaml", "CITATION.cff", "Containerfile", "SECURITY.md", ".dockerignore"]
    files = [ROOT / name for name in names]
    files += [p for top in (".github", "conda", "examples/cluster") for p in (ROOT / top).rglob("*") if p.is_file()]
    assert len(files) >= 12
    for file in files:
        text = file.read_text()
        assert not re.search(r"https?://|\w\.(?:io|org|com|dev)/", text), file
        assert "/root/" not in text
        assert "/home/" not in text


def test_make_installs_the_highest_versions_without_constraints(tmp_path: Path) -> None:
    make = shutil.which("make")
    assert make is not None
    command = [make, "-n", "-C", str(ROOT), f"VENV={tmp_path / 'venv'}", "CONSTRAINTS=/dev/null", "test"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "--constraint /dev/null" in said
    assert "constraints.txt" not in said
