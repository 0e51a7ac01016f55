"""The external flight code of a flight: it is verified, started, and called by the compiled flight.

instances.py defines the running code. A guarded flight is flown by another process (guard.py), which alone loads or
imports the code. If the code crashes or does not return, the flight ends, and log and summary are closed as usual.
Flights on several threads can therefore run Python code on several processors. Without `os.fork` (Windows), guarded
flights are rejected; `guard = false` flies the code in this process.
"""

from __future__ import annotations

import ctypes
import logging
import math
import weakref
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from maxq.control.external import ABI
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run import guard
from maxq.sim.run.guard import MEMORY, Arrays, Worker, advance_to, complaint, instance_for, worker_for
from maxq.sim.run.held_code import CodeWindows, load_kernels
from maxq.sim.run.instances import Instance, Setup, Unusable, ended
from maxq.sim.scenario.flight_code import announce, code_hash
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_launch import OrbitTarget
from maxq.sim.scenario.schema_vehicle import ComputerSection
from maxq.sim.vehicle.block import R_I, V_I
from maxq.sim.world.earth import J2

KEY = "vehicle.computer"


def title(computer: ComputerSection) -> str:
    """Return the displayed name or the address of the flight code, for messages."""
    found = computer.library or computer.python
    return found.title if found is not None else computer.address or ""


@lru_cache(maxsize=64)
def _report_end(code: str, said: str) -> None:
    """Log a warning, once per process, that flight code has failed after its flight."""
    logging.getLogger("maxq").warning("maxq: flight code %s failed at its end, after the flight: %s", code, said)


def guards(loaded: LoadedScenario) -> bool:
    """Return True if the scenario's flight code runs in a separate process."""
    computer = loaded.scenario.vehicle.computer
    return computer is not None and computer.law == "external" and computer.guard


def checked(loaded: LoadedScenario) -> ComputerSection:
    """Return the scenario's computer after a check that its code and data have the recorded hashes.

    Code is not run by the check. Raises ScenarioError.
    """
    computer = loaded.vehicle.computer
    assert computer is not None
    if computer.guard and not guard.FORKS:
        problem = "this system cannot fork the process that guards a flight"
        allowed = "false, with which a crash of the code also ends maxq"
        raise ScenarioError(loaded.label, problem, f"{KEY}.guard", value=True, allowed=allowed)
    for key, file in computer.hashed_files.items():
        if key == "sources":  # the code that runs is the library
            continue
        where = f"{KEY}.{key}"
        try:
            sha256, _ = code_hash(Path(file.file))
        except OSError as error:
            problem = f"cannot be read: {(error.strerror or str(error)).lower()}"
            raise ScenarioError(loaded.label, problem, where, value=file.title) from None
        if sha256 != file.sha256:
            allowed = f"that with sha256 {file.sha256[:16]}, or --set {where}=FILE for the present file"
            problem = f"is not the {'data' if key == 'data' else 'flight code'} that was flown"
            raise ScenarioError(loaded.label, problem, where, value=file.title, allowed=allowed)
    code = computer.library or computer.python
    announce("flies flight code", title(computer), code.sha256 if code is not None else "")
    return computer


def setup_of(loaded: LoadedScenario, parameters: Any, memory: Any, y: Any) -> Setup:
    """Return the setup of a flight at its start: its records Parameters (stages,) and Memory, and its state `y`."""
    computer, first, stages = loaded.vehicle.computer, parameters[0], loaded.vehicle.stage
    assert computer is not None
    packed, earth, gnss = first.computer, first.environment.earth, loaded.vehicle.gnss
    setup = Setup(
        ctypes.sizeof(Setup),
        ABI,
        int(packed.sample_ns),
        int(packed.delay_ns),
        int(memory.clock.now_ns),
        int(packed.allocation.groups),
        float(packed.converter.count_rad),
        float(packed.dac_step_rad),
        float(packed.command_limit_rad),
        float(packed.angle_error_limit_rad),
        computer.settings.encode(),
        int(first.timeline.sequenced),
        len(stages),
        earth_rate_radps=float(earth.rate_radps),
        mu_m3ps2=float(earth.mu_m3ps2),
        j2=float(earth.j2) if earth.gravity == J2 else 0.0,
        equator_m=float(earth.equatorial_radius_m),
    )
    setup.start_q_RI[:] = memory.truth.start_q_BI.tolist()
    errors = memory.navigation
    setup.start_r_I_m[:] = (y[R_I : R_I + 3] + errors.position_m).tolist()
    setup.start_v_I_mps[:] = (y[V_I : V_I + 3] + errors.velocity_mps).tolist()
    force = stages[0].accelerometer
    if gnss is not None and force is not None:
        setup.gnss_lever_B_m[:] = (force.station_m - gnss.station_m, *gnss.offset_m)
    return setup


def _aim(loaded: LoadedScenario, inputs: Any) -> None:
    """Write the target orbit of the scenario into the inputs of flight code."""
    target = next((end for end in reversed(loaded.scenario.guidance.ends) if isinstance(end, OrbitTarget)), None)
    inputs.target_inclination_rad = -1.0
    if target is not None:
        inputs.target_perigee_m, inputs.target_apogee_m = target.perigee_altitude_m, target.apogee_altitude_m
        if target.inclination_deg is not None:
            inputs.target_inclination_rad = math.radians(target.inclination_deg)


class FlightSoftware:
    """The flight code of a flight. `held` contains the windows of a held flight (held_code.py)."""

    def __init__(self, loaded: LoadedScenario, held: CodeWindows | None = None) -> None:
        self._held = held
        if held is not None:
            load_kernels()
        self._loaded, self._label, self._computer = loaded, loaded.label, checked(loaded)
        self._guarded = guards(loaded)
        self._worker: Worker | None = None
        self._instance: Instance | None = None
        self._said = ""
        self._end: Callable[[], str | None] = lambda: None

    def start(self, arrays: Arrays) -> Arrays:
        """Start the code for a flight that is at its start, and return the arrays of the flight.

        The arrays of a guarded flight are in shared memory. Raises ScenarioError if the code cannot be started.
        """
        memory = arrays[MEMORY][0]
        setup = setup_of(self._loaded, arrays[0], memory, arrays[3])
        state = memory.computer.external
        _aim(self._loaded, state.inputs)
        self._arrays = arrays
        try:
            if self._guarded:
                self._worker = worker_for(self._computer, arrays)
                self._end = weakref.finalize(self, self._worker.release)
                self._arrays, begun, said = self._worker.start(arrays, setup, self._held)
                if not begun:
                    problem = said or self.complaint(self._arrays[MEMORY][0].computer.external)
                    self.close()
                    raise Unusable(problem)
            else:
                self._instance = instance_for(self._computer, setup, self._held, state)
                self._end = weakref.finalize(self, ended, self._instance)
        except Unusable as error:
            where = f"{KEY}.{self._computer.code_keys[0]}"
            raise ScenarioError(self._label, str(error), where, value=title(self._computer)) from None
        return self._arrays

    def advance(self, until_ns: int) -> None:
        """Fly until `until_ns` or the end of the flight. The flight also ends if the process of the code ends."""
        if self._worker is None:
            advance_to(until_ns, self._arrays)
            self._said = self._instance.error if self._instance is not None else ""
            return
        done, self._said = self._worker.advance(until_ns)
        if not done:
            self._arrays[MEMORY][0].clock.finished = 1

    def close(self) -> None:
        """End the code of the flight, and report an error of its end. A second call has no effect.

        Another flight may then use shared arrays.
        """
        if said := self._end():
            _report_end(title(self._computer), said)

    def complaint(self, state: Any) -> str:
        """Return the reason for which the flight code ended the flight, or an empty string if it has not.

        `state` is the ExternalState in the memory of the flight.
        """
        stage = int(self._arrays[MEMORY][0].clock.stage)
        separation = stage, int(self._arrays[0][stage].timeline.separates)
        numbers = {name: int(getattr(state, name)) for name in ("fault", "code", "inside")}
        return complaint(self._computer, self._said, **numbers, separation=separation)
