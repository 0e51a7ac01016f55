"""Worker: the nominal scenario's powered phase with everything switched on, no log, on one core.

`--own-kernels`: by kernels that are compiled for this vehicle's sizes, as large campaigns fly.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.metadata import version

from maxq.sim.packing.flight import pack_flight, pack_for_one_vehicle
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.dev.bench.serve import serve

POWERED_S = 59.0
WHOLE_FLIGHT_NS = 10**12  # one segment holds it


def main() -> None:
    pack = pack_for_one_vehicle if "--own-kernels" in sys.argv else pack_flight
    loaded = load_scenario("nominal", [f"run.duration_s={POWERED_S}"])

    def prepare() -> Callable[[], int]:
        run = FlightRun(loaded, pack(loaded.scenario), log=False)

        def fly() -> int:
            while not run.finished:
                run.fly_segment(WHOLE_FLIGHT_NS)
            return int(run.memory.clock.steps)

        return fly

    serve({"program": "maxq", "version": version("maxq"), "flown_s": POWERED_S}, prepare)


if __name__ == "__main__":
    main()
