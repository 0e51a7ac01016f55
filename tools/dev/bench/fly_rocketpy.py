"""The RocketPy worker: a rigid rocket of about KSR-III's size with a 100 Hz controller for 60 s.

With `--causal`, every call of the controller ends an integration step (`time_overshoot=False`). RK23 is RocketPy's
fastest method for such short steps: RK45 takes 1.6 times as long, LSODA 2.5 times, DOP853 3 times. Without it, as by
default, a step extends past the controller's instants. The controller is then called at interpolated points, which is
faster, but its output is too late for the step of the call.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

from rocketpy import Environment, Flight, GenericMotor, Rocket  # type: ignore[import-not-found]  # in .venv-bench only

from maxq.tools.dev.bench.serve import State, serve

FLOWN_S = 60.0
CONTROLLER_HZ = 100


def _brake(time_s: float, rate_hz: float, state: Any, history: Any, observed: Any, brakes: Any, *rest: Any) -> None:
    brakes.deployment_level = 0.1 if time_s > 30.0 else 0.0


def _rocket() -> Any:
    motor = GenericMotor(
        thrust_source=129e3,
        burn_time=59.0,
        chamber_radius=0.5,
        chamber_height=6.0,
        chamber_position=4.0,
        propellant_initial_mass=3400.0,
        nozzle_radius=0.28,
        dry_mass=400.0,
        dry_inertia=(300.0, 300.0, 50.0),
        center_of_dry_mass_position=0.5,
        nozzle_position=0.0,
    )
    rocket = Rocket(
        radius=0.5,
        mass=2300.0,
        inertia=(25e3, 25e3, 600.0),
        power_off_drag=0.4,
        power_on_drag=0.35,
        center_of_mass_without_motor=7.0,
        coordinate_system_orientation="tail_to_nose",
    )
    rocket.add_motor(motor, position=0.0)
    rocket.add_nose(length=2.5, kind="von karman", position=14.0)
    rocket.add_trapezoidal_fins(4, root_chord=1.5, tip_chord=0.8, span=0.9, position=1.8)
    rocket.add_air_brakes(lambda level, mach: 0.1 * level, _brake, sampling_rate=CONTROLLER_HZ)
    return rocket


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--causal", action="store_true")
    parser.add_argument("rtol", nargs="?", type=float, default=1e-6, help="relative tolerance (default 1e-6)")
    choice = parser.parse_args()
    causal = choice.causal
    warnings.filterwarnings("ignore")  # about the coarse rocket, which is intended
    environment = Environment(latitude=36.7, longitude=126.47, elevation=30.0)

    def prepare() -> Callable[[], tuple[int, State]]:
        rocket = _rocket()

        def fly() -> tuple[int, State]:
            flight = Flight(
                rocket=rocket,
                environment=environment,
                rail_length=10.0,
                inclination=88.0,
                heading=250.0,
                max_time=FLOWN_S,
                rtol=choice.rtol,
                time_overshoot=not causal,
                ode_solver="RK23" if causal else "LSODA",
            )
            end = [float(x) for x in flight.solution[-1]]
            return len(flight.solution), [*end[1:4], *end[7:11]]

        return fly

    serve({"program": "RocketPy", "version": version("rocketpy"), "flown_s": FLOWN_S}, prepare)


if __name__ == "__main__":
    main()
