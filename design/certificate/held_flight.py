"""A flight in which time stands still: vehicle, gains, air and speed stay what they were at one instant.

A linear model speaks of frozen coefficients; a rocket in flight loses mass, gains speed and leaves the air within
seconds. To measure a frequency response over many periods of 0.05 Hz, or to watch a loop that barely grows, the
nonlinear simulator must fly for minutes without any of that changing. So the vehicle's tables are frozen, the air is
uniform, and the vehicle flies straight up over a flat Earth whose uniform gravity equals its own axial specific force:
it neither gains nor loses speed, while everything inside it feels the axial load of the real flight, since a uniform
gravity pulls at every particle alike.

What differs from the flown instant is one term, gravity by the pitch angle in w' (design/model/plant.py): it moves the
slowest root alone. No held flight can do without. One that keeps its airspeed keeps pace with its air, and in a frame
that moves with the air everything falls with the axial load, however the load comes about: an updraught that makes
way for a vehicle which really gains speed, wind dW/dt = a - g, adds to w' what gravity lacks. The linear node that
belongs to the held flight (`HeldFlight.node`) has the term too, so that both may be compared to the last digit; that of
the flight itself shows what it is worth, and flown_through.py what is left of it when time does not stand still.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array, pack
from maxq.control.kernel.tables import Pool
from maxq.design.model.node import Node, node_of
from maxq.design.model.plant import axial_load_mps2
from maxq.design.model.vehicle_at import Plane
from maxq.sim.packing.computer import pack_injections
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.nanoseconds import to_ns
from maxq.sim.scenario.schema_environment import Atmosphere, Earth, Wind
from maxq.sim.scenario.schema_initial import Geodetic, Initial
from maxq.sim.scenario.schema_injection import Injection
from maxq.sim.scenario.schema_scenario import Guidance, Log, Run, Scenario
from maxq.sim.world.atmosphere import HEAT_RATIO, GAS_CONSTANT_Jpkg_K

ALTITUDE_M = 1.0e6  # high enough never to meet the ground; the air does not depend on it
_NOSE_UP_DEG = (0.0, 90.0, 0.0)


Change = Callable[[Packed], None]
"""Alters a packed flight in place."""


def _unchanged(packed: Packed) -> None:
    """What no fault does."""


@dataclass(frozen=True)
class HeldFlight:
    """A scenario held at `time_s`, packed: fly it with `run`, which leaves it as it is.

    `node` is the linear model's view of it, in `plane`. `fault` alters every flight before it flies, and nothing that
    the linear model sees: so faults are planted.
    """

    loaded: LoadedScenario
    packed: Packed
    node: Node
    time_s: float
    plane: Plane
    fault: Change = _unchanged

    @property
    def axis(self) -> int:
        """Index of the gimbal axis."""
        return 0 if self.plane == "pitch" else 1

    @property
    def sample_s(self) -> float:
        return self.node.instruments.sample_s

    def run(self, duration_s: float, injections: tuple[Injection, ...], change: Change = _unchanged) -> FlightRun:
        """A fresh flight with signals injected; `change` may alter what has been packed before it flies.

        Only what differs is packed anew: tables take longer than the flight.
        """
        run = self.loaded.scenario.run.model_copy(update={"duration_s": duration_s})
        scenario = self.loaded.scenario.model_copy(update={"injection": injections, "run": run})
        kept = self.packed
        packed = dataclasses.replace(
            kept, parameters=kept.parameters.copy(), pool=kept.pool.copy(), memory=kept.memory.copy(),
            state=kept.state.copy(),
        )  # fmt: skip
        row = packed.parameters[0]
        row.injections = pack([pack_injections(scenario, Pool())])[0]
        row.timeline.stop_ns = int(packed.memory[0].clock.now_ns) + to_ns(duration_s)
        self.fault(packed)
        change(packed)
        return FlightRun(dataclasses.replace(self.loaded, scenario=scenario), packed)


def hold(loaded: LoadedScenario, node: Node, fault: Change | None = None) -> HeldFlight:
    """Hold the scenario at a node of its flight, in the node's plane.

    Works for the first stage of a vehicle under thrust. Raises ValueError where the axial load is not positive, the
    scenario has no design, or the stage is a later one.
    """
    scenario = loaded.scenario
    if scenario.design is None:
        raise ValueError(f"{loaded.label}: there is no design whose loop could be held")
    if len(scenario.vehicle.stage) > 1:
        raise ValueError(f"{loaded.label}: only vehicles of one stage can be held, this one has several")
    load = axial_load_mps2(node.vehicle, node.condition)
    if load <= 0.0:
        raise ValueError(f"node at {node.time_s:g} s: the axial load is {load:g} m/s2: allowed is above 0")
    held = dataclasses.replace(
        loaded,
        scenario=scenario.model_copy(update=_stillness(scenario, node, load)),
        label=f"{loaded.label} held at {node.time_s:g} s",
    )
    packed = held_gains(pack_flight(held.scenario), node.time_s)
    same = dataclasses.replace(node_of(packed, node.time_s, 0, node.plane, node.errata), liquids=node.liquids)
    return HeldFlight(held, packed, same, node.time_s, node.plane, fault or _unchanged)


def _stillness(scenario: Scenario, node: Node, load_mps2: float) -> dict[str, object]:
    """What has to be changed in the scenario."""
    air = node.condition
    temperature = (air.airspeed_mps / air.mach) ** 2 / (HEAT_RATIO * GAS_CONSTANT_Jpkg_K) if air.mach > 0 else 288.15
    fast = 1.0 / node.instruments.sample_s
    return {
        "earth": Earth(shape="flat", rotating=False, gravity="uniform", uniform_mps2=load_mps2),
        "atmosphere": Atmosphere(
            model="constant", density_kgpm3=air.density_kgpm3, temperature_K=temperature, pressure_Pa=air.pressure_Pa
        ),
        "wind": Wind(),
        "initial": Initial(
            geodetic=Geodetic(latitude_deg=0.0, longitude_deg=0.0, altitude_m=ALTITUDE_M),
            euler_deg=_NOSE_UP_DEG,
            ned_mps=(0.0, 0.0, -air.airspeed_mps),
        ),
        "guidance": Guidance(),
        "injection": (),
        "requirement": (),
        "run": Run(step_s=scenario.run.step_s, seed=scenario.run.seed, freeze_vehicle_at_s=node.time_s, stop_at=()),
        "log": Log(fast_hz=fast, slow_hz=1.0, transform_hz=1.0),
    }


def held_gains(packed: Packed, time_s: float) -> Packed:
    """The same with the gains of one instant at all times."""
    ref = packed.parameters[0].computer.law.gains
    pool: Array = packed.pool.copy()
    n, columns, at = int(ref.n_breaks), int(ref.n_columns), int(ref.offset)
    if n == 0:
        return packed
    breaks = pool[at : at + n]
    cubics = pool[at + n : at + n + 4 * columns * (n - 1)].reshape(n - 1, 4, columns)
    k = int(np.clip(np.searchsorted(breaks, time_s, side="right") - 1, 0, n - 2))
    s = float(np.clip(time_s, breaks[0], breaks[-1]) - breaks[k])
    now = cubics[k, 0] + s * (cubics[k, 1] + s * (cubics[k, 2] + s * cubics[k, 3]))
    cubics[:] = 0.0
    cubics[:, 0] = now
    return dataclasses.replace(packed, pool=pool)


def linear_limits(held: HeldFlight) -> tuple[float, float]:
    """Gimbal command (rad) and commanded rate of the servo (rad/s) at which actuator or computer stop being linear."""
    actuator = held.node.instruments.actuator
    command = float(held.packed.parameters[0].computer.law.command_limit_rad)
    if actuator.ideal:
        return command, math.inf
    return min(command, actuator.angle_limit_rad), actuator.rate_limit_radps
