"""The held flight: the nonlinear simulator with vehicle, gains, air and speed frozen at one instant.

A linear model has frozen coefficients, but a rocket in flight loses mass, gains speed and leaves the atmosphere. Two
measurements need minutes of flight at constant conditions: a frequency response over many periods of 0.05 Hz, and the
growth of a loop close to its stability boundary. The vehicle's tables are therefore frozen, and the air is uniform. The
vehicle flies straight up over a flat Earth with uniform gravity equal to its axial specific force. Its speed is
constant, and its parts are under the axial load of the real flight, since uniform gravity acts on every particle alike.

One term differs from the flown instant: gravity times the pitch angle in w' (design/model/held.py). It affects only the
slowest root and cannot be avoided. A vehicle that keeps its airspeed moves with its air. In a frame that moves with the
air, all parts fall with the axial load, whatever its cause. For a vehicle that gains speed, an updraught with
dW/dt = a - g would add the missing part of gravity to w'. The linear model of the held flight, `HeldFlight.node`,
contains the same term, so that model and flight can be compared exactly. The linear model of the flown instant shows
the effect of the term, and in_flight.py shows the remaining effect in the ascent.

A law with load relief turns into the wind, so that this term becomes a gravity turn. Under several times the real
gravity, the vehicle topples within seconds. Such a loop is held with `along_body`: gravity acts aft along the vehicle's
axis in every attitude, equally on every particle. Then w' contains no such term, in flight and in `HeldFlight.node`.

The damping of ring baffles depends on the wave height, which the excitation determines. The baffles are therefore
frozen at their damping in the flown swing. `rings_by_law` keeps their dependence on the wave (response.py compares both
with the linear loop).
"""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array, pack
from maxq.control.kernel.tables import Pool
from maxq.design.laws.registry import law_kind
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node, at_swing, node_of
from maxq.sim.flight.telemetry import FAST
from maxq.sim.input.values import to_ns
from maxq.sim.packing.computer import pack_injections
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.run.flight import GrowingRows
from maxq.sim.run.fly import SOFTWARE_NAME, FlightRun
from maxq.sim.run.held_code import DIFFERS, SHORTEST_S, CodeWindows, Tape
from maxq.sim.run.instances import Setup
from maxq.sim.run.tape import record
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_environment import AtmosphereSection, EarthSection, WindSection
from maxq.sim.scenario.schema_scenario import Geodetic, Guidance, Initial, Injection, LogSection, Run, Scenario
from maxq.sim.world.atmosphere import HEAT_RATIO, GAS_CONSTANT_Jpkg_K
from maxq.sim.world.earth import ALONG_BODY

ALTITUDE_M = 1.0e6  # high enough to avoid the ground; the air is independent of altitude
DETUNED = 0.02  # largest frequency error relative to the half bandwidth of a mode, zeta omega
_MOST_TAPES = 4
_NOSE_UP_DEG = (0.0, 90.0, 0.0)


PackedChange = Callable[[Packed], None]
"""A function that changes a packed flight in place."""


def unchanged(packed: Packed) -> None:
    """Leave a packed flight unchanged, as the default without a fault."""


@dataclass(frozen=True)
class HeldFlight:
    """A packed scenario held at the time of its operating point. `run` and `fly` use copies of it.

    `node` is its linear model, in `plane`. `fault` changes every flight but not the linear model, for tests of fault
    detection.
    """

    loaded: LoadedScenario
    packed: Packed
    node: Node
    plane: Plane
    fault: PackedChange = unchanged
    tape: Tape | None = None  # record of external flight code in its own flight

    @property
    def axis(self) -> int:
        """Return the index of the gimbal axis, 0 for pitch and 1 for yaw."""
        return 0 if self.plane == "pitch" else 1

    @property
    def sample_s(self) -> float:
        return self.node.instruments.sample_s

    def run(self, duration_s: float, injections: tuple[Injection, ...], change: PackedChange = unchanged) -> FlightRun:
        """Return a new flight with injected signals. `change` may alter the packed parameters before the flight.

        Only the changed parameters are packed again, since packing the tables takes longer than the flight.
        """
        run = self.loaded.scenario.run.model_copy(update={"duration_s": duration_s})
        scenario = self.loaded.scenario.model_copy(update={"injection": injections, "run": run})
        kept = {name: getattr(self.packed, name).copy() for name in ("parameters", "pool", "memory", "state")}
        packed = dataclasses.replace(self.packed, **kept)
        row = packed.parameters[0]
        row.injections = pack([pack_injections(scenario, Pool())])[0]
        row.timeline.stop_ns = int(packed.memory[0].clock.now_ns) + to_ns(duration_s)
        self.fault(packed)
        change(packed)
        windows = None if self.tape is None else self.windows(self.tape, packed)
        return FlightRun(dataclasses.replace(self.loaded, scenario=scenario), packed, held=windows)

    def windows(self, tape: Tape, packed: Packed) -> CodeWindows:
        """Return the windows of the tape in which external flight code flies a packed flight."""
        computer, stage = packed.parameters[0].computer, np.flatnonzero(tape.inputs["stage"] == self.node.stage)
        count_rad = Setup.from_buffer_copy(tape.setup).count_rad
        return CodeWindows(
            tape,
            int(np.searchsorted(tape.inputs["time_s"], self.node.time_s)),
            int(stage[0]),
            int(stage[-1]) + 1,
            1e-9 * int(computer.sample_ns),
            count_rad,
            count_rad > 0.0 and float(computer.converter.count_rad) == count_rad,
            int(computer.attitude),
            float(computer.angle_error_limit_rad),
        )

    def fly(
        self, duration_s: float, injections: tuple[Injection, ...], change: PackedChange = unchanged
    ) -> tuple[FlightRun, Array]:
        """Run a flight to its end, with the arguments of `run`.

        Returns the flight and its rows at the computer's sample rate, (samples, channels). Raises CodeDiffers if
        external flight code fails the replay check.
        """
        run = self.run(duration_s, injections, change)
        rows = fast_rows(run)
        if self.tape is not None:
            raise_if_differing(run)
        return run, rows


class CodeDiffers(Exception):
    """An error for flight code that returns other commands for the inputs of its own flight.

    The message states the time.
    """


class CodeLost(ValueError):
    """An error for a flight of external flight code that ends before an operating point."""


def raise_if_differing(run: FlightRun) -> None:
    """Raise CodeDiffers if external flight code has failed the replay check."""
    for event in run.events:
        if event.name == SOFTWARE_NAME and event.detail.startswith(DIFFERS):
            raise CodeDiffers(event.detail)


_recording = threading.Lock()
_tapes: dict[str, Tape] = {}


def tape_at(loaded: LoadedScenario, node: Node) -> Tape:
    """Return the tape of the scenario's flight code, which is recorded once.

    Raises CodeLost if the flight of the code ends before the operating point.
    """
    with _recording:
        if loaded.as_flown not in _tapes:
            _tapes[loaded.as_flown] = record(loaded)
            while len(_tapes) > _MOST_TAPES:
                del _tapes[next(iter(_tapes))]
        tape = _tapes[loaded.as_flown]
    end_s = float(tape.inputs["time_s"][-1]) if len(tape.inputs) else loaded.scenario.run.start_s
    if not (tape.inputs["stage"] == node.stage).any() or end_s < node.time_s + SHORTEST_S / 2.0:
        raise CodeLost(f"node at {node.time_s:g} s: the flight of the code under control ends at {end_s:.3f} s")
    return tape


def fast_rows(run: FlightRun) -> Array:
    """Fly to the end and return all rows of the fast channels, (rows, channels).

    `run.table.index(name)` is the column of a channel.
    """
    kept = GrowingRows()
    while not run.finished:
        kept.add(run.fly_segment())
    return kept.rows()[FAST][1]


def with_ideal_converters(loaded: LoadedScenario) -> LoadedScenario:
    """Return the scenario without counting and quantisation."""
    switches = loaded.scenario.switches.model_copy(update={"converter": "ideal"})
    return dataclasses.replace(loaded, scenario=loaded.scenario.model_copy(update={"switches": switches}))


def hold(
    loaded: LoadedScenario,
    node: Node,
    fault: PackedChange | None = None,
    *,
    along_body: bool = False,
    rings_by_law: bool = False,
) -> HeldFlight:
    """Return the scenario held at an operating point of its flight, in the plane of the point.

    `along_body` removes the gravity turn. Only the stage that burns at the operating point is held. External flight
    code first flies the scenario. In the held flight, it receives the inputs of that flight plus the deviations of the
    held flight (sim/run/held_code.py). Raises ValueError if the axial load is not positive, or if the scenario has
    neither a design nor external flight code. Raises CodeLost if the flight of the code ends before the operating
    point.
    """
    scenario, computer = loaded.scenario, loaded.vehicle.computer
    external = computer is not None and computer.law == "external"
    if scenario.design is None and not external:
        raise ValueError(f"{loaded.label}: there is no design, and so no loop to hold")
    load = node.axial_load_mps2
    if load <= 0.0:
        raise ValueError(f"operating point at {node.time_s:g} s: the axial load is {load:g} m/s2: allowed is above 0")
    held = dataclasses.replace(
        loaded,
        scenario=scenario.model_copy(update=_stillness(scenario, node, load)),
        label=f"{loaded.label} held at {node.time_s:g} s",
    )
    packed = pack_flight(held.scenario)
    bobs, slosh = node.vehicle.pendulums, packed.parameters[0].vehicle.slosh
    if bobs.ring.any() and not rings_by_law:
        slosh.damping_ratio[: len(bobs.ring)], slosh.law_factor[:] = bobs.damping(load), 0.0
    same = node_of(packed, node.time_s, 0, node.plane)
    if along_body:
        packed.parameters[0].environment.earth.gravity = ALONG_BODY
        same = dataclasses.replace(same, condition=dataclasses.replace(same.condition, gravity_mps2=0.0))
    same = dataclasses.replace(at_swing(same, bobs.swing_rad), stage=node.stage, surface_radius_m=node.surface_radius_m)
    return HeldFlight(held, packed, same, node.plane, fault or unchanged, tape_at(loaded, node) if external else None)


def _stillness(scenario: Scenario, node: Node, load_mps2: float) -> dict[str, object]:
    """Return the changes of the scenario that hold it at constant conditions."""
    air = node.condition
    temperature = (air.airspeed_mps / air.mach) ** 2 / (HEAT_RATIO * GAS_CONSTANT_Jpkg_K) if air.mach > 0 else 288.15
    fast = 1.0 / node.instruments.sample_s
    vehicle, design = scenario.vehicle, scenario.design and scenario.design.of_stage(node.stage)
    alone = vehicle.stage[node.stage].model_copy(update={"separation_s": None, "separation_after_burnout_s": None})
    return {
        "vehicle": vehicle.model_copy(update={"stage": (alone,)}),
        "design": design and law_kind(design.law).frozen(design, node.scheduled(design.gains.over)),
        "earth": EarthSection(shape="flat", rotating=False, gravity="uniform", uniform_mps2=load_mps2),
        "atmosphere": AtmosphereSection(
            model="constant", density_kgpm3=air.density_kgpm3, temperature_K=temperature, pressure_Pa=air.pressure_Pa
        ),
        "wind": WindSection(),
        "initial": Initial(
            geodetic=Geodetic(latitude_deg=0.0, longitude_deg=0.0, altitude_m=ALTITUDE_M),
            euler_deg=_NOSE_UP_DEG,
            ned_mps=(0.0, 0.0, -air.airspeed_mps),
        ),
        "guidance": Guidance(),
        "navigation": None,
        "injection": (),
        "fault": (),
        "requirement": (),
        "run": Run(
            step_s=_step_s(scenario, node),
            seed=scenario.run.seed,
            freeze_vehicle_at_s=round(node.time_s - node.stage_start_s, 9),
            stop_at=(),
        ),
        "log": LogSection(fast_hz=fast, slow_hz=1.0, transform_hz=1.0),
    }


def _step_s(scenario: Scenario, node: Node) -> float:
    """Return the scenario's step, or a smaller one that changes no mode by more than DETUNED of its half bandwidth.

    The integrator lowers a frequency by the fraction (w h)^4 / 120 (docs/model.md, section 10). At 80 Hz and 1 ms, this
    is a tenth of the half bandwidth of a mode with a damping ratio of 0.005. In a loop sampled at 100 Hz, this mode
    appears at 20 Hz.
    """
    modes = zip(node.vehicle.omega_radps, node.vehicle.damping_ratio, strict=True)
    most_s = min(((120.0 * DETUNED * zeta) ** 0.25 / omega for omega, zeta in modes if zeta > 0.0), default=math.inf)
    given_s = scenario.run.step_s
    return given_s if most_s >= given_s else round(given_s / math.ceil(given_s / most_s), 9)


def linear_limits(held: HeldFlight) -> tuple[float, float]:
    """Return the gimbal command (rad) and the servo rate (rad/s) up to which actuator and computer are linear."""
    actuator, computer = held.node.instruments.actuator, held.loaded.scenario.vehicle.computer_of(0)
    command = math.inf if computer is None else math.radians(computer.command_limit_deg)
    if actuator.ideal:
        return command, math.inf
    lowest = min(actuator.rate_limit_radps for actuator in held.node.instruments.actuators)
    return min(command, held.node.angle_limit_rad), lowest
