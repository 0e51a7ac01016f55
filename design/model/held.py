"""A stage held at one instant of a flight, and its linear model: the Jacobian of the simulator's derivative.

`HeldStage` contains the packed parameters and properties of the simulator, for one vehicle or for many that deviate
from it. For the linear model, the vehicle flies straight without rotation over a flat Earth, in uniform gravity and
uniform air. Speed and pitch angle are those of a `FlightCondition`. The plant then contains every effect of the flown
instant except the Earth's rotation and curvature, and is independent of position. Modes, pendulums and engines are at
rest. Spatial modes, and canted engines on a TVC load, are deflected to the equilibrium under the axial loads. The
instruments are ideal. The actuators are unit oscillators, which separates the derivatives with respect to an engine's
angle, rate and acceleration.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array, IntArray, Records, blank, duplicate
from maxq.control.kernel.tables import table_in
from maxq.design.model import jacobian
from maxq.design.model.instruments import DERIVATIVES, Plane, of_drive, sensed
from maxq.design.model.linearised import coordinates_of, differentiate
from maxq.sim.flight.parameters import Memory
from maxq.sim.packing.flight import Packed
from maxq.sim.vehicle import schedule
from maxq.sim.vehicle import state as layout
from maxq.sim.vehicle.sensor.further import ACCELEROMETER
from maxq.sim.vehicle.state import MAX_STATE
from maxq.sim.vehicle.workspace import PROPERTIES_SIZE
from maxq.sim.world.atmosphere import CONSTANT, HEAT_RATIO, GAS_CONSTANT_Jpkg_K
from maxq.sim.world.earth import FLAT, UNIFORM
from maxq.sim.world.turbulence import BODY

Trim = tuple[float, float]
"""The angles of attack and sideslip, rad."""
OUTPUTS = ("q_radps", "local_rate_radps", "w_mps", "theta_rad")
WIND = "wind_mps"
Drives = Sequence[Sequence[tuple[int, float]]]
"""The actuators that each drive moves, as the channel 2 * group (+ 1 in yaw) and the angle per command."""

_NOISE = 3e-14  # entries times their step, relative to the largest of the row, below which an entry is a rounding error
_SETTLING = 3  # Newton iterations
_UNIT = {"omega_1_radps": 1.0, "zeta_1": 0.5, "order": 2, "bias_rad": 0.0, "backlash_rad": 0.0, "ideal": 0}
_UNIT |= dict.fromkeys(("angle_limit_rad", "rate_limit_radps", "stop_rad"), math.inf)
"""The parameters of the unit oscillator angle'' = command - angle - angle'."""


@dataclass(frozen=True)
class FlightCondition:
    """The air and the path at an instant, for a vehicle without rotation."""

    time_s: float  # vehicle clock
    airspeed_mps: float
    density_kgpm3: float
    pressure_Pa: float  # ambient
    mach: float
    pitch_rad: float  # angle of the body axis above the horizon
    gravity_mps2: float

    @property
    def dynamic_pressure_Pa(self) -> float:
        return 0.5 * self.density_kgpm3 * self.airspeed_mps**2


@dataclass(frozen=True)
class HeldStage:
    """The `parameters` (vehicles,) and `properties` (vehicles, PROPERTIES_SIZE) of vehicles at an instant.

    `swing_rad` (pendulums,) is the slosh amplitude that determines the damping of ring baffles.
    """

    parameters: Records
    pool: Array
    properties: Array
    swing_rad: Array

    @cached_property
    def sizes(self) -> Any:
        return self.parameters[0].vehicle.sizes

    @property
    def vehicle(self) -> Any:
        """Return the vehicle parameters as records, with fields of shape (vehicles, ...)."""
        return self.parameters["vehicle"]

    @cached_property
    def coordinates(self) -> dict[str, float]:
        return coordinates_of(self.sizes)

    def repeated(self, count: int) -> HeldStage:
        """Return a stage with `count` copies of the first vehicle."""
        return dataclasses.replace(
            self, parameters=np.repeat(self.parameters[:1], count), properties=np.repeat(self.properties[:1], count, 0)
        )

    def copied(self) -> HeldStage:
        """Return a copy with its own arrays."""
        return dataclasses.replace(self, parameters=duplicate(self.parameters), properties=self.properties.copy())

    @property
    def rings(self) -> Array:
        """Return the damping ratio of ring baffles per root of the swing, (vehicles, pendulums), rad^(-1/2)."""
        n, slosh = len(self.swing_rad), self.vehicle["slosh"]
        return np.asarray(slosh["law_factor"][:, :n] * self.tank(schedule.TANK_RING) + slosh["ring_damping"][:, :n])

    def tank(self, column: int) -> Array:
        """Return one column of `schedule` for each pendulum, (vehicles, pendulums)."""
        return self.properties[:, [schedule.tank_column(k) + column for k in range(len(self.swing_rad))]]

    # --- the linear model
    def prepared(self, condition: FlightCondition, trim: Trim) -> tuple[HeldStage, Array]:
        """Change the stage in place to a flight condition, and return it with its states (vehicles, MAX_STATE).

        Ring baffles become linear dampers at the swing of the stage.
        """
        held, n = self, len(self.swing_rad)
        air, earth, air_m = condition, held.parameters["environment"]["earth"], held.parameters["environment"]
        earth["figure"], earth["gravity"], earth["rate_radps"] = FLAT, UNIFORM, 0.0
        earth["uniform_mps2"] = air.gravity_mps2
        kelvin = (air.airspeed_mps / air.mach) ** 2 / (HEAT_RATIO * GAS_CONSTANT_Jpkg_K) if air.mach > 0.0 else 288.15
        gas = {"density_kgpm3": air.density_kgpm3, "pressure_Pa": air.pressure_Pa, "temperature_K": kelvin}
        for name, value in {"model": CONSTANT, "density_factor": 1.0, **gas}.items():
            air_m["atmosphere"][name] = value
        slosh = held.vehicle["slosh"]
        slosh["damping_ratio"][:, :n] += self.rings * np.sqrt(self.swing_rad)
        slosh["ring_damping"][:] = 0.0
        for k in range(n):
            held.properties[:, schedule.tank_column(k) + schedule.TANK_RING] = 0.0
        y = np.zeros((len(held.parameters), MAX_STATE))
        alpha, beta = trim if int(self.sizes.tables) > 0 else (0.0, 0.0)
        flow = np.array([math.cos(alpha) * math.cos(beta), math.sin(beta), math.sin(alpha) * math.cos(beta)])
        s, c = math.sin(0.5 * air.pitch_rad), math.cos(0.5 * air.pitch_rad)
        turned = np.array([[c * c - s * s, 0.0, 2.0 * s * c], [0.0, 1.0, 0.0], [-2.0 * s * c, 0.0, c * c - s * s]])
        y[:, layout.V_I : layout.V_I + 3] = air.airspeed_mps * turned[:, 0]
        y[:, layout.Q_BI], y[:, layout.Q_BI + 2] = c, s
        for k in range(n):
            y[:, int(layout.pendulum_index(self.sizes, k))] = -1.0
        y = held._settled(y)
        y[:, layout.V_I : layout.V_I + 3] = air.airspeed_mps * turned @ flow
        return held, y

    def _settled(self, y: Array) -> Array:
        """Return the states with spatial modes, and canted engines on a TVC load, in equilibrium with axial loads."""
        names = list(self.coordinates)
        at = [names.index(f"spatial_{k + 1}_m") for k in range(int(self.sizes.spatial_modes))]
        engine, places = self.vehicle["engine"], []
        first, behind = int(layout.spatial_index(self.sizes)), [first_k for first_k in at]
        states = [first + k for k in range(len(behind))]
        for k in range(int(self.sizes.tvc_loads)):
            e = int(self.vehicle["tvc_load"]["engine"][0, k])
            if engine["rest_y"][0, e] == 0.0 and engine["rest_z"][0, e] == 0.0 and not at:
                continue
            for axis, plane in enumerate(("pitch", "yaw")):
                if engine[f"follows_{plane}"][0, e] > 0.0:
                    places.append(names.index(f"tvc_load_{k + 1}_{plane}_rad"))
                    states.append(int(layout.tvc_load_index(self.sizes)) + 6 * k + 3 * axis)
        rates = [names.index(f"spatial_{k + 1}_rate_mps") for k in range(len(at))] + [k + 1 for k in places]
        at += places
        if not at:
            return y
        y, steps = y.copy(), np.array([list(self.coordinates.values())[k] for k in at])
        along = self.copied()
        along.vehicle["aero"]["force_factor"] = 0.0
        for _ in range(_SETTLING):
            rate, slopes = along.differentiated(y, np.array(at), steps, np.array(rates))
            y[:, states] -= np.linalg.solve(slopes, rate[:, rates, None])[..., 0]
        return y

    def differentiated(
        self, y: Array, which: IntArray, steps: Array, wanted: IntArray, levels: int = jacobian.LEVELS
    ) -> tuple[Array, Array]:
        """Return rates and derivatives at the states of all vehicles, by `linearised.differentiate`."""
        memory = blank(Memory)
        memory["clock"]["started"], memory["held"]["burning"] = 1, 1
        return differentiate(
            self.parameters,
            self.pool,
            memory,
            y,
            0,
            which,
            steps,
            wanted=wanted,
            levels=levels,
            stations=int(self.parameters[0].loads.stations),
            properties=self.properties,
        )

    def groups_that_follow(self, plane: Plane) -> set[int]:
        """Return the groups of engines with at least one engine that is gimballed in the plane."""
        engine, n = self.vehicle["engine"], int(self.sizes.engines)
        return {int(g) for g, f in zip(engine["group"][0, :n], engine[f"follows_{plane}"][0, :n], strict=True) if f}

    def plants(
        self,
        condition: FlightCondition,
        trim: Trim,
        plane: Plane,
        drives: Drives,
        *,
        wind: bool = False,
        moments: bool = False,
        levels: int = jacobian.LEVELS,
        in_place: bool = False,
    ) -> tuple[Array, Array, Array, Array, Names]:
        """Return A, B, C, D of all vehicles, (vehicles, ...), and their names (see `Node.plant_in_wind`).

        `wind` adds the wind as an input, and `moments` the bending moments as outputs. With `in_place`, the stage is
        not copied and must not be used afterwards.
        """
        held, y = (self if in_place else self.copied()).prepared(condition, trim)
        found = _PlaneOf(self, plane)
        n, steps = len(self.coordinates), np.array(list(self.coordinates.values()))
        groups = 1 + int(self.sizes.further_groups)
        channels = sorted({channel for drive in drives for channel, _ in drive})
        angles = [self._actuator(channel) for channel in channels]
        gust = n + 2 * groups + (2 if plane == "pitch" else 1)
        which = [
            *found.states,
            *angles,
            *(k + 1 for k in angles),
            *(n + c for c in channels),
            *([gust] if wind else []),
        ]
        size, m = len(found.states), len(channels)
        stations = int(self.parameters[0].loads.stations) if moments else 0
        first = n + jacobian.OUTPUTS + (0 if plane == "pitch" else stations)
        cuts = list(range(first, first + stations))
        wanted = [*found.states, found.rate, *found.sensed, *cuts]
        steps = np.array([*(steps[k] if k < n else 4e-3 for k in which[: size + 3 * m]), *([0.5] if wind else [])])
        if not moments:
            held.parameters["loads"]["stations"] = 0
        # the other axes are held, so that their rotation does not couple into that of the plane's axis
        held.properties[:, schedule.CORE_INERTIA + 3 : schedule.CORE_INERTIA + 6] = 0.0
        _, slopes = held.differentiated(y, np.array(which), steps, np.array(wanted), levels)
        tilt = found.signs[:, None]
        down = np.array([found.turn, *found.sensed_signs, *([1.0 if plane == "pitch" else -1.0] * stations)])[:, None]
        slopes[:, :size] *= tilt
        slopes[:, size:] *= down
        slopes[:, :, :size] *= found.signs
        slopes[:, :, size : size + 3 * m] *= found.turn
        size_of = np.abs(slopes) * steps
        slopes[size_of < _NOISE * size_of.max(axis=2, keepdims=True)] = 0.0
        slopes[:, 1:, 2] = 0.0  # in uniform gravity and air, only w' depends on the attitude
        a, by_angle = slopes[:, :size, :size], slopes[:, :, size:]
        command = by_angle[:, :, 2 * m : 3 * m]
        orders = by_angle[:, :, :m] + command, by_angle[:, :, m : 2 * m] + command, command
        inputs, b = [], []
        for k, drive in enumerate(drives):
            moved = np.zeros(m)
            for channel, gain in drive:
                moved[channels.index(channel)] += gain
            wanted_orders = dict(zip(DERIVATIVES, (True, *found.drives_by(drive)), strict=True))
            for name, order in zip(DERIVATIVES, orders, strict=True):
                if wanted_orders[name]:
                    inputs.append(of_drive(name, k))
                    b.append(order @ moved)
        if wind:
            inputs.append(WIND)
            b.append(by_angle[:, :, 3 * m])
        through = np.stack(b, axis=-1)
        unit = np.broadcast_to(np.eye(size), (len(a), size, size))
        none = np.zeros((len(a), 1, len(inputs)))
        c = np.concatenate(
            [unit[:, 1:2], slopes[:, size : size + 1, :size], unit[:, :1], unit[:, 2:3], slopes[:, size + 1 :, :size]],
            1,
        )
        d = np.concatenate([none, through[:, size : size + 1], none, none, through[:, size + 1 :]], axis=1)
        outputs = (*OUTPUTS, *found.sensors, *(moment_name(at) for at in self.parameters[0].loads.station_m[:stations]))
        return a, through[:, :size], c, d, (found.names, tuple(inputs), outputs)

    def without_sections(self) -> HeldStage:
        if not self.parameters["loads"]["stations"].any():
            return self
        held = self.copied()
        held.parameters["loads"]["stations"] = 0
        return held

    def _actuator(self, channel: int) -> int:
        """Return the index of the coordinate of an actuator's angle. The rate is the next coordinate."""
        group, axis = divmod(channel, 2)
        if group == 0:
            return jacobian.FLAT + layout.N_ACTUATOR * axis
        behind = int(layout.pendulum_index(self.sizes, int(self.sizes.pendulums)))
        tail = len(self.coordinates) - (int(layout.state_size(self.sizes)) - behind)
        return tail + int(layout.actuator_index(self.sizes, group)) - behind + layout.N_ACTUATOR * axis


Names = tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]
"""The names of states, inputs and outputs."""


class _PlaneOf:
    """The coordinates of one plane among those of a stage, with their signs and names.

    The yaw plane is the pitch plane rotated about x: w -> v, q -> -r, theta -> -psi, eta -> xi, delta -> -delta_yaw,
    gyro -> -gyro.
    """

    def __init__(self, held: HeldStage, plane: Plane) -> None:
        at, sizes = {name: k for k, name in enumerate(held.coordinates)}, held.sizes
        pitch = plane == "pitch"
        self.turn = 1.0 if pitch else -1.0
        body = ("w_mps", "q_radps", "theta_rad") if pitch else ("v_mps", "r_radps", "psi_rad")
        symbol, modes = ("eta", int(sizes.pitch_modes)) if pitch else ("xi", int(sizes.yaw_modes))
        spatial, tanks = int(sizes.spatial_modes), int(sizes.pendulums)
        wanted, signs = list(body), [1.0, self.turn, self.turn]
        for what in ("m", "rate_mps"):
            wanted += [f"spatial_{k + 1}_{what}" for k in range(spatial)]
            wanted += [f"{symbol}_{k + 1}_{what}" for k in range(modes)]
        for what in ("rad", "rate_radps"):
            wanted += [f"slosh_{k + 1}_{plane}_{what}" for k in range(tanks)]
        engine, loads = held.vehicle["engine"], held.vehicle["tvc_load"]
        swings: list[tuple[int, Plane]] = []
        self._swinging = set()
        for k in range(int(sizes.tvc_loads)):
            e = int(loads["engine"][0, k])
            other: Plane = "yaw" if pitch else "pitch"
            if engine[f"follows_{plane}"][0, e] == 0.0:
                continue
            self._swinging.add(int(engine["group"][0, e]))
            swings.append((k, plane))
            canted = engine["rest_y"][0, e] != 0.0 or engine["rest_z"][0, e] != 0.0
            if engine[f"follows_{other}"][0, e] > 0.0 and (canted or spatial):
                swings.append((k, other))
        for what in ("rad", "rate_radps"):
            wanted += [f"tvc_load_{k + 1}_{axis}_{what}" for k, axis in swings]
        self.states = [at[name] for name in wanted]
        signs += [1.0] * (2 * (spatial + modes + tanks)) + [-1.0 if axis == "yaw" else 1.0 for _, axis in swings] * 2
        feed = [name for name in at if name.startswith("feed_")] if spatial else []  # they act through axial modes
        late = [name for name in at if name.startswith("air_lag_") and name.endswith(f"_{plane}_m")]
        self.states += [at[name] for name in (*feed, *late)]
        signs += [1.0] * (len(feed) + len(late))
        self.names = (*state_names(spatial + modes, tanks, len(swings)), *feed, *late)
        self.signs = np.array(signs)
        self.rate = at[f"gyro_{plane}_rad"]
        self.sensors = list(sensed(held.parameters[0].vehicle.sensors[: int(sizes.sensors)]))
        self.sensed, self.sensed_signs = [], []
        for k in range(int(sizes.sensors)):
            force = held.vehicle["sensors"]["kind"][0, k] == ACCELEROMETER
            axis = "zy"[not pitch] if force else "yz"[not pitch]
            self.sensed.append(at[f"sensor_{k + 1}_{axis}_integral"])
            self.sensed_signs.append(1.0 if force else self.turn)
        self._engines = int(sizes.engines)
        self._groups = [int(engine["group"][0, e]) for e in range(self._engines)]
        self._follows = [bool(engine[f"follows_{plane}"][0, e]) for e in range(self._engines)]
        self._swings = [int(engine["swings"][0, e]) >= 0 for e in range(self._engines)]

    def drives_by(self, drive: Sequence[tuple[int, float]]) -> tuple[bool, bool]:
        """Return two flags: the rate of a drive acts on engines, and its acceleration acts on engines.

        The rate acts on engines with a TVC load, and the acceleration on all others. A drive without engines counts as
        acting by acceleration.
        """
        moved = {channel // 2 for channel, gain in drive if gain != 0.0}
        mine = [e for e in range(self._engines) if self._groups[e] in moved and self._follows[e]]
        swings = any(self._swings[e] for e in mine)
        return swings, any(not self._swings[e] for e in mine) or not swings


def moment_name(station_m: float) -> str:
    """Return the name of the bending moment at a station of section loads, among the outputs of the plant."""
    return f"bending_{station_m:g}_Nm"


def state_names(modes: int, tanks: int, loaded: int = 0) -> tuple[str, ...]:
    """Return the state names of the plant of one plane, with `loaded` angles of engines on TVC loads."""
    parts = [("eta_{}_m", "eta_{}_rate_mps", modes), ("slosh_{}_rad", "slosh_{}_rate_radps", tanks)]
    parts.append(("engine_{}_rad", "engine_{}_rate_radps", loaded))
    named = [name.format(k + 1) for *pair, count in parts for name in pair for k in range(count)]
    return ("w_mps", "q_radps", "theta_rad", *named)


def table_clock_s(row: Any, time_s: float) -> float:
    """Return the table clock of a packed stage at a time since the start of the stage, s."""
    return float(row.timeline.frozen_s) if row.timeline.frozen == 1 else float(row.timeline.burn_rate) * time_s


def hold_stage(packed: Packed, clock_s: float, stage: int = 0) -> HeldStage:
    """Return a packed, burning stage held at an instant of its table clock.

    Instruments are ideal, and wind, turbulence and failures are absent.
    """
    rows = duplicate(packed.parameters[stage : stage + 1])
    row, sizes = rows[0], packed.parameters[stage].vehicle.sizes
    properties = np.zeros((1, PROPERTIES_SIZE))
    columns = table_in(packed.pool, row.vehicle.schedule)(clock_s)
    properties[0, : len(columns)] = columns
    timeline, environment, vehicle = rows["timeline"], rows["environment"], rows["vehicle"]
    timeline["frozen"], timeline["frozen_s"], timeline["stage_start_ns"] = 1, clock_s, 0
    environment["penetration"], environment["turbulence"]["on"] = 0, 0
    environment["turbulence"]["frame"] = BODY
    environment["wind"]["profile"]["n_columns"], environment["wind"]["n_gusts"] = 0, 0
    rows["injections"]["count"], vehicle["buffet"]["factor"] = 0, 0.0
    for actuator in (vehicle["actuator_pitch"], vehicle["actuator_yaw"], vehicle["further_actuators"]):
        for name, value in _UNIT.items():
            actuator[name] = value
    ideal = blank_triad()
    for triad in (vehicle["gyro"], vehicle["sensors"]["triad"]):
        for name, value in ideal.items():
            triad[name] = value
    engine, loads = vehicle["engine"], vehicle["tvc_load"]
    engine["turned_pitch_rad"] = np.arctan2(engine["rest_z"], engine["rest_x"])  # cant angles without misalignment
    engine["turned_yaw_rad"] = -np.arcsin(engine["rest_y"])
    loads["friction_Nm"], loads["play_pitch_rad"], loads["play_yaw_rad"] = 0.0, 0.0, 0.0
    loads["stop_pitch_rad"], loads["stop_yaw_rad"] = math.inf, math.inf
    return HeldStage(rows, packed.pool, properties, np.zeros(int(sizes.pendulums)))


def blank_triad() -> dict[str, float]:
    """Return the parameters of an ideal gyro or accelerometer triad without errors."""
    errors = [
        f"{kind}_{axis}{unit}"
        for axis in "xyz"
        for kind, unit in (("bias", "_radps"), ("scale", ""), ("misalignment", "_rad"))
    ]
    return {**dict.fromkeys(errors, 0.0), "ideal": 1}
