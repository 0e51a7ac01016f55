"""Hypothesis tries the same examples in every run, unless new ones are requested (tests/conftest.py)."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

TRIAL = """
from hypothesis import given, strategies as st

@given(st.integers(), st.floats())
def test_trial(whole, real):
    with open("tried.txt", "a") as file:
        print(whole, real, file=file)
"""


def tried(folder: Path, examples: str | None) -> str:
    """Return the examples that a test tries in a separate process."""
    (folder / "test_trial.py").write_text(TRIAL)
    (folder / "tried.txt").unlink(missing_ok=True)
    environment = {k: v for k, v in os.environ.items() if k != "MAXQ_EXAMPLES"}
    environment |= {"PYTHONPATH": str(Path(__file__).parent)} | ({"MAXQ_EXAMPLES": examples} if examples else {})
    command = [sys.executable, "-m", "pytest", "-q", "-p", "conftest", "--rootdir=.", "test_trial.py"]
    subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
    return (folder / "tried.txt").read_text()


@pytest.mark.long
def test_examples_are_new_only_on_request(tmp_path: Path) -> None:
    usual, same, *new = (tried(tmp_path, examples) for examples in (None, "same", "random", "random"))
    assert len(usual.splitlines()) >= 100
    assert usual == same
    assert len({usual, *new}) == 3
