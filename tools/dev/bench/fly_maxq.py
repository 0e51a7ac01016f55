"""Worker: the nominal scenario's powered phase with everything switched on, no log, on one core.

`--own-kernels`: by kernels that are compiled for this vehicle's sizes, as large campaigns fly. Further arguments are
overrides of the scenario.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.metadata import version

from maxq.sim.packing.flight import pack_flight, pack_for_one_vehicle
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.state import Q_BI, R_I
from maxq.tools.dev.bench.serve import State, serve

POWERED_S = 59.0
WHOLE_FLIGHT_NS = 10**12  # one segment holds it


def main() -> None:
    overrides = [word for word in sys.argv[1:] if word != "--own-kernels"]
    pack = pack_for_one_vehicle if "--own-kernels" in sys.argv else pack_flight
    loaded = load_scenario("nominal", [f"run.duration_s={POWERED_S}", *overrides])

    def prepare() -> Callable[[], tuple[int, State]]:
        run = FlightRun(loaded, pack(loaded.scenario), log=False)

        def fly() -> tuple[int, State]:
            while not run.finished:
                run.fly_segment(WHOLE_FLIGHT_NS)
            y = run.packed.state
            return int(run.memory.clock.steps), [*y[R_I : R_I + 3].tolist(), *y[Q_BI : Q_BI + 4].tolist()]

        return fly

    serve({"program": "maxq", "version": version("maxq"), "flown_s": POWERED_S}, prepare)


if __name__ == "__main__":
    main()
