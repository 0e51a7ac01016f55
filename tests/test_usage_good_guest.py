"""maxq leaves Numba, garbage collector and interpreter unchanged for other code in its process."""

from __future__ import annotations

import gc
import sys
from pathlib import Path
from typing import Any

import campaignkit
import numba
import pytest
from numba.core import types
from numba.core.base import BaseContext
from numba.core.callconv import CPUCallConv
from numba.core.types.functions import BaseFunction
from numba.core.typing.arraydecl import RecordAttribute
from numba.np import numpy_support

from maxq.control.kernel.jit import entry, kernel
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario


def process_wide() -> dict[str, Any]:
    """Return the process-wide settings that a library could change."""
    return {
        "get_call_type": BaseFunction.get_call_type,
        "from_struct_dtype": numpy_support.from_struct_dtype,
        "mangling_args": types.Record.mangling_args,
        "mangling_of_tuples": types.NamedTuple.mangling_args,
        "fields": (RecordAttribute.generic_resolve, BaseContext.get_getattr),
        "status": (CPUCallConv._get_return_status, CPUCallConv.return_status_propagate),
        "slp_vectorize": numba.config.SLP_VECTORIZE,
        "frozen": gc.get_freeze_count(),
        "collecting": gc.isenabled(),
        "thresholds": gc.get_threshold(),
        "switch_s": sys.getswitchinterval(),
    }


def assert_unchanged(before: dict[str, Any]) -> None:
    """Compare with earlier settings. Frozen objects may have been freed, but none may have been added."""
    found = process_wide()
    assert found.pop("frozen") <= before["frozen"]
    assert found == {name: value for name, value in before.items() if name != "frozen"}


def test_numba_is_as_it_came() -> None:
    """Numba is unchanged after this file's imports, which compile and load kernels."""
    fly(load_scenario("nominal", ["run.duration_s=1"]), log=False)
    found = process_wide()
    assert found["get_call_type"].__module__ == "numba.core.types.functions"
    assert found["from_struct_dtype"].__module__ == "numba.np.numpy_support"
    assert found["mangling_args"].fget.__module__ == "numba.core.types.npytypes"
    assert {each.__module__ for each in (*found["fields"], *found["status"])} == {
        "numba.core.base",
        "numba.core.callconv",
        "numba.core.typing.arraydecl",
    }
    assert found["slp_vectorize"] == 0


def test_a_compilation_takes_its_changes_back() -> None:
    """A compilation restores all settings, whether it succeeds or fails half-way."""
    before = process_wide()

    @kernel
    def doubled(x: float) -> float:
        return 2.0 * x

    def tripled(x: float) -> float:
        return doubled(x) + x

    def wrong(x: float) -> float:
        return doubled(x) + "a"  # type: ignore[operator]  # meant

    assert entry(tripled)(1.5) == 4.5
    with pytest.raises(numba.TypingError):
        entry(wrong)(1.5)
    assert_unchanged(before)


def test_a_campaign_leaves_the_process_alone(tmp_path: Path) -> None:
    before = process_wide()
    run_campaign(campaignkit.small(tmp_path), tmp_path / "out", workers=2)
    assert_unchanged(before)
