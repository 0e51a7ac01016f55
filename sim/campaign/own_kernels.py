"""Kernels compiled for the vehicle of a campaign, by another process while the campaign already flies."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from contextlib import suppress
from functools import partial

from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.campaign.runs import Packing
from maxq.sim.packing.flight import Packed, for_one_vehicle, pack_flight, pack_for_one_vehicle
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import load_scenario_text
from maxq.sim.scenario.schema_scenario import Scenario

OWN_KERNELS_FROM = 500
"""The number of runs that justifies the compilation, which takes as long as about two hundred flights."""
_PROGRAM = "from maxq.sim.campaign.own_kernels import compile_from_input; compile_from_input()"


def load_kernels(campaign: LoadedCampaign, pack: Packing = pack_flight) -> FlightRun:
    """Load or compile the kernels before the time is measured, so that threads do not compile them at the same time."""
    run = FlightRun(campaign.base, pack(campaign.base.scenario), log=False)
    run.result()
    return run


class OwnKernels:
    """The packing of a campaign's flights for kernels of its vehicle, as soon as these are stored on disk.

    Until then, and for fewer than OWN_KERNELS_FROM runs, flights are packed for the kernels that all
    vehicles share. Both compute the same bits. `end` stops a compilation, which keeps its finished parts, and so does
    the end of this process.
    """

    def __init__(self, campaign: LoadedCampaign, runs: int) -> None:
        """Load the common kernels, and begin the compilation of the vehicle's if `runs` runs justify it.

        A flight starts its external flight code, and a second process must not start another instance. Campaigns of
        such code use the kernels of the vehicle only if these are stored already.
        """
        self._compiler: subprocess.Popen[str] | None = None
        self._compiled = self._ready = False
        run = load_kernels(campaign)
        if runs < OWN_KERNELS_FROM:
            return
        scenario = campaign.base.scenario
        own = for_one_vehicle(run.packed)
        if own.parameters.dtype == run.packed.parameters.dtype:  # its stages have different sizes
            return
        self._are_stored = partial(run.finds_kernels, own)
        self._ready = self._are_stored()
        external = scenario.vehicle.computer is not None and scenario.vehicle.computer.law == "external"
        if not self._ready and not external:
            self._compiler = _begun(campaign.base.as_flown)

    def pack(self, scenario: Scenario) -> Packed:
        """Return the packed flight for the best kernels available now. Several threads may call this function."""
        if self._compiler is not None and not self._compiled and self._compiler.poll() is not None:
            self._compiled, self._ready = True, self._are_stored()
        return pack_for_one_vehicle(scenario) if self._ready else pack_flight(scenario)

    def __enter__(self) -> OwnKernels:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Stop the compilation, if there is one."""
        if self._compiler is not None:
            self._compiler.kill()
            self._compiler.wait()
            assert self._compiler.stdin is not None
            self._compiler.stdin.close()


def _begun(scenario: str) -> subprocess.Popen[str] | None:
    """Return a process that compiles the kernels for the text of a scenario, or None if no process can be started."""
    paths = os.pathsep.join(filter(None, sys.path))
    with suppress(OSError):
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            text=True,
            env=os.environ | {"PYTHONPATH": paths},
            start_new_session=True,  # Ctrl-C concerns the campaign, which then ends this process
        )
        assert process.stdin is not None
        with suppress(OSError):  # it ended at once
            process.stdin.write(json.dumps(scenario) + "\n")
            process.stdin.flush()
        return process
    return None


def compile_from_input() -> None:
    """Compile and store the kernels for the scenario in the first line of the standard input.

    The end of the input ends this process, so that it does not survive the campaign.
    """
    loaded = load_scenario_text(json.loads(sys.stdin.readline()), (), "campaign")

    def leave() -> None:
        sys.stdin.read()
        os._exit(1)

    threading.Thread(target=leave, daemon=True).start()
    FlightRun(loaded, pack_for_one_vehicle(loaded.scenario), log=False)
    os._exit(0)
