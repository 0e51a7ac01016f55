"""The packed form of a scenario is independent of the processor, so a log can be flown again on another machine.

OpenBLAS and NumPy choose other code on other processors, with other rounding. Both can be set to use the code of an
older processor.
"""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PACK = """
import hashlib
from maxq.sim.input.files import builtin_names
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.packing.flight import pack_flight
cases = [(name, []) for name in builtin_names()]
cases += [("nominal", ["wind.profile=winds/anheung-november.csv", "initial={euler_deg=[10,70,3],earth_mps=[1,2,3]}"])]
for name, overrides in cases:
    packed = pack_flight(load_scenario(name, overrides).scenario)
    for part in (packed.pool, packed.parameters, packed.state, packed.memory):
        print(name, hashlib.sha256(part.tobytes()).hexdigest())
"""
PROCESSORS = {
    "this one": {},
    "of 2013": {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": "X86_V4"},
    "of 2004": {"OPENBLAS_CORETYPE": "Prescott", "NPY_DISABLE_CPU_FEATURES": "X86_V4 X86_V3"},
}


def packed_on(processor: dict[str, str]) -> str:
    chosen = ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES")
    environment = {key: value for key, value in os.environ.items() if key not in chosen} | processor
    command = [sys.executable, "-W", "ignore", "-c", PACK]  # NumPy warns of what this processor has not anyway
    return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout


@pytest.mark.long
def test_packing_is_the_same_to_the_bit_on_every_processor() -> None:
    here, newer, older = (packed_on(processor) for processor in PROCESSORS.values())
    assert len(here.splitlines()) > 60
    assert here == newer
    assert here == older
