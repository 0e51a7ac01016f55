"""Configure all tests.

Hypothesis tries the same examples in every run, or new ones with MAXQ_EXAMPLES=random. Ctrl-C is enabled again for the
commands under test: a shell disables it in background jobs and their children. The texts of every figure that a test
saves are checked. Verification packs are not printed as PDF.
"""

from __future__ import annotations

import atexit
import gc
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path

# Before NumPy is loaded, as the commands do: threads of its library, two for each worker, mostly wait for each other.
# Measured on two busy cores, the modes of a beam take 0.005 s of processor time instead of 0.24 s.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from filelock import FileLock
from hypothesis import settings
from matplotlib.figure import Figure
from picture_check import settled_faults

from maxq.tools.plots import style

SETTLE = style.settle

# A change lands or not by what it does, not by luck; a busy machine is no reason to fail either.
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("random", derandomize=False, deadline=None, print_blob=True)  # its own default in CI is True
settings.load_profile(os.environ.get("MAXQ_EXAMPLES") or "same")

if "MAXQ_TEST_FILES" not in os.environ:  # of made_once.py, for the workers of pytest-xdist, too
    os.environ["MAXQ_TEST_FILES"] = tempfile.mkdtemp(prefix="maxq-tests-")
    atexit.register(shutil.rmtree, os.environ["MAXQ_TEST_FILES"], ignore_errors=True)
if "MAXQ_LEDGER" not in os.environ:  # attempts of tests are none of a user's
    os.environ["MAXQ_LEDGER"] = tempfile.mkdtemp(prefix="ledger-", dir=os.environ["MAXQ_TEST_FILES"])
os.environ.pop("COLUMNS", None)  # pytest-xdist sets 80 for its workers, as if they wrote to a terminal

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Import the tests once before other workers do so, and exempt imported objects from garbage collection.

    On a new checkout, Python compiles all modules that it imports, which takes more time than importing them, and
    workers that begin together would each compile all of them.
    """
    compiled = Path(__file__).parent / "__pycache__"
    gc.disable()
    with FileLock(Path(os.environ["MAXQ_TEST_FILES"], "collection.lock")) as lock:
        if sys.dont_write_bytecode or any(compiled.glob("test_*.pyc")):
            lock.release()
        collected = yield
    gc.freeze()
    gc.enable()
    return collected


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests marked `long` as `slow` too, before pytest selects tests by marks."""
    for item in items:
        if item.get_closest_marker("long") is not None:
            item.add_marker("slow")


@pytest.fixture(autouse=True)
def _pictures_read_well(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Check that no drawn text is clipped or overlaps, except in tests marked `crowded`."""
    found: list[str] = []

    def settled(figure: Figure) -> None:
        SETTLE(figure)
        title = figure.get_suptitle() or figure.axes[0].get_title("left")
        found.extend(f"{title}: {fault}" for fault in settled_faults(figure))

    monkeypatch.setattr(style, "settle", settled)
    yield
    if request.node.get_closest_marker("crowded") is None:
        assert not found


@pytest.fixture(autouse=True)
def _packs_are_not_printed(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Find no browser in tests of simverify, which takes more than a second for each pack that it prints."""
    if "verify" in request.module.__name__:
        monkeypatch.setattr("maxq.tools.verify.report.BROWSERS", ())
