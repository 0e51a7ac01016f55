"""The recording of flight code: its inputs and outputs at every sample of a flight."""

from __future__ import annotations

import numpy as np

from maxq.control.external import FswInputs, FswOutputs
from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import blank, dtype_of
from maxq.control.kernel.vectors import quaternion_of
from maxq.sim.flight.parameters import CONTROL_LOST
from maxq.sim.input.values import to_ns
from maxq.sim.run.flight_software import setup_of
from maxq.sim.run.fly import FlightRun
from maxq.sim.run.held_code import Tape
from maxq.sim.scenario.loader import LoadedScenario

_quaternion_of = from_python(quaternion_of)


def record(loaded: LoadedScenario) -> Tape:
    """Fly a scenario with external flight code until the last burnout or loss of control, and return the tape.

    The flight is stopped after each sample to copy the inputs and outputs from its memory. Raises ScenarioError if the
    code cannot be started.
    """
    run = FlightRun(loaded, log=False)
    setup = bytes(setup_of(run.loaded, run.packed.parameters, run.memory, run.packed.state))
    inputs, outputs, calls = [], [], 0
    stages = len(loaded.vehicle.stage)
    while not run.finished:
        clock = run.packed.memory["clock"]
        if clock["stage_burnout_ns"][0, stages - 1] >= 0 or clock["event_ns"][0, CONTROL_LOST] >= 0:
            break
        flown = loaded.vehicle.computer_of(int(clock["stage"][0]))
        assert flown is not None
        run.fly_segment(to_ns(flown.sample_s))
        state = run.packed.memory["computer"]["external"]
        if int(state["calls"][0]) > calls and int(state["fault"][0]) == 0:
            calls = int(state["calls"][0])
            inputs.append(state["inputs"].tobytes())
            outputs.append(state["outputs"].tobytes())
    given, taken = (
        np.frombuffer(b"".join(rows), dtype_of(schema)) if rows else blank(schema)[:0]
        for rows, schema in ((inputs, FswInputs), (outputs, FswOutputs))
    )
    if not np.array_equal(given["tick"], np.arange(len(given))):
        raise AssertionError("a sample of the flight code is not on the tape")
    return Tape(setup, given, taken, _quaternion_of(tuple(run.packed.parameters[0].navigation.alignment_rad.tolist())))
