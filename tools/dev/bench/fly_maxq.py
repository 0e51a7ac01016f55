"""The maxq worker: the powered phase of the nominal scenario with all models, without a log, on one core.

`--own-kernels` uses kernels compiled for this vehicle's sizes, as large campaigns do. `--nine-engines` replaces the
engine by nine engines of a ninth of its size. Each has separate actuators, since equal groups would count as a single
group. Further arguments are overrides of the scenario.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.metadata import version

from maxq.sim.packing.flight import pack_flight, pack_for_one_vehicle
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.engine.section import EngineSection
from maxq.sim.vehicle.state import Q_BI, R_I
from maxq.tools.dev.bench.serve import State, serve

POWERED_S = 59.0
WHOLE_FLIGHT_NS = 10**12  # more than the flight, so that it is one segment


def nine_engines(one: EngineSection) -> str:
    """Return the override that replaces an engine by nine, each in a group of its own."""
    whole = {
        "table": "'vehicles/ksr3/thrust.csv'",
        "gimbal_station_m": one.gimbal_station_m,
        "exit_station_m": one.exit_station_m,
        "cg_from_gimbal_m": one.cg_from_gimbal_m,
    }
    shared = ("thrust_factor", "exit_area_m2", "gimballed_mass_kg", "inertia_about_gimbal_kgm2")
    whole |= {key: getattr(one, key) / 9 for key in shared}
    each = ", ".join(f"{key}={value}" for key, value in whole.items())
    return f"vehicle.stage.0.engine=[{', '.join(f'{{{each}, group={name!r}}}' for name in 'abcdefghi')}]"


def main() -> None:
    overrides = [word for word in sys.argv[1:] if word not in ("--own-kernels", "--nine-engines")]
    pack = pack_for_one_vehicle if "--own-kernels" in sys.argv else pack_flight
    if "--nine-engines" in sys.argv:
        overrides.append(nine_engines(load_scenario("nominal").scenario.vehicle.stage[0].engines[0]))
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
