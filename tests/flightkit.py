"""Build small vehicles for flight tests, and call the flight kernels on behalf of all tests.

A scenario is a dict that becomes TOML text and passes through loader and packing like any other. `Parts` describes a
vehicle by its parts (core, engine, pendulums, modes). `scenario_of` composes the totals that the vehicle file needs;
`oracle_vehicle` and `oracle_state` give the same vehicle and state to the independent oracles.

Only `Rig` and `Stretches`, at the end of the file, call kernels.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from oracles import multibody_system as system

from maxq import FlightRun, LoadedScenario
from maxq.control.kernel.jit import bare_pointer, entry
from maxq.control.kernel.records import Array, Records, blank
from maxq.sim.flight import events as flight_events
from maxq.sim.flight import loop as flight_loop
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.run.evaluate import Space, evaluate_into
from maxq.sim.scenario.loader import load_scenario_text
from maxq.sim.vehicle import state as layout
from maxq.sim.vehicle.state import MAX_STATE, state_size

Tree = dict[str, Any]


# --- scenarios as text
def toml(value: Any) -> str:
    """Return a value in TOML's inline notation."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple | np.ndarray):
        return "[" + ", ".join(toml(item) for item in value) + "]"
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, int | np.integer):
        return str(int(value))
    return repr(float(value))


def merged(tree: Tree, changes: Tree) -> Tree:
    """Return a copy of `tree` in which the values of `changes` replace existing ones, table by table."""
    out = dict(tree)
    for key, value in changes.items():
        out[key] = merged(out[key], value) if isinstance(value, dict) and key in out else value
    return out


def load(tree: Tree) -> LoadedScenario:
    return load_scenario_text("\n".join(f"{key} = {toml(value)}" for key, value in tree.items()))


# --- vehicles by their parts
@dataclass(frozen=True)
class Tank:
    """A pendulum. `place_m`: y and z of its hinge, from the body axis."""

    mass_kg: float
    length_m: float
    hinge_station_m: float
    damping_ratio: float = 0.0
    place_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Mode:
    """A mode of one plane: shape and slope d(phi)/d(x_n) at the `stations` of the vehicle."""

    frequency_hz: float
    mass_kg: float
    phi: tuple[float, ...]
    slope_pm: tuple[float, ...]
    zeta: float = 0.0


@dataclass(frozen=True)
class Parts:
    """A vehicle by its parts; stations in m aft of the nose.

    `core_inertia` is the tensor about the core CG, in B axes, with the engine straight.
    """

    core_mass_kg: float = 4000.0
    core_cg: tuple[float, float, float] = (7.0, 0.0, 0.0)  # station, y, z
    core_inertia: tuple[tuple[float, float, float], ...] = ((700.0, 0.0, 0.0), (0.0, 5.0e4, 0.0), (0.0, 0.0, 5.0e4))
    tanks: tuple[Tank, ...] = ()
    stations_m: tuple[float, ...] = (0.0, 3.0, 5.0, 10.0, 12.0, 14.0)
    mass_forward_kg: tuple[float, ...] = (0.0, 600.0, 1500.0, 3200.0, 3800.0, 4200.0)
    pitch: tuple[Mode, ...] = ()
    yaw: tuple[Mode, ...] = ()
    gimbal_station_m: float = 12.0
    gimbal_offset_m: tuple[float, float] = (0.0, 0.0)
    engine_mass_kg: float = 0.0
    engine_cg_m: float = 0.0
    engine_inertia_kgm2: float = 0.0  # about its own CG
    gyro_station_m: float = 3.0
    thrust_N: float = 0.0
    engine: bool = True


ACTUATOR: Tree = {
    "omega_hz": [5.8, 7.2, 52.6, 15.6],
    "zeta": [0.87, 0.49, 0.15, 0.042],
    "angle_limit_deg": 45.0,
    "rate_limit_degps": 1000.0,
}
COMPUTER: Tree = {
    "sample_s": 0.01,
    "delay_s": 0.003,
    "count_rad": 0.0,
    "angle_error_limit_deg": 20.0,
    "command_limit_deg": 6.0,
}
EMPTY_SPACE: Tree = {
    "site": {"latitude_deg": 0.0, "longitude_deg": 0.0, "altitude_m": 0.0},
    "earth": {"shape": "flat", "rotating": False, "gravity": "none"},
    "atmosphere": {"model": "vacuum"},
    "run": {"duration_s": 100.0, "stop_at": []},
}


def composed(parts: Parts) -> tuple[float, Array, Array]:
    """Return the total mass, CG (station, y, z) and inertia tensor about it; bobs hang at rest behind their hinges."""
    masses = [parts.core_mass_kg, *(tank.mass_kg for tank in parts.tanks)]
    places = [np.array([-parts.core_cg[0], parts.core_cg[1], parts.core_cg[2]])]
    places += [np.array([-(tank.hinge_station_m + tank.length_m), *tank.place_m]) for tank in parts.tanks]
    total = sum(masses)
    cg = sum(m * r for m, r in zip(masses, places, strict=True)) / total
    inertia = np.array(parts.core_inertia)
    for m, r in zip(masses, places, strict=True):
        d = r - cg
        inertia = inertia + m * (d @ d * np.eye(3) - np.outer(d, d))
    return total, np.array([-cg[0], cg[1], cg[2]]), inertia


def mode_rows(parts: Parts, modes: tuple[Mode, ...]) -> list[Tree]:
    return [
        {
            "time_s": 0.0,
            "mode": number + 1,
            "frequency_hz": mode.frequency_hz,
            "generalized_mass_kg": mode.mass_kg,
            "station_m": station,
            "phi": mode.phi[k],
            "slope_pm": mode.slope_pm[k],
            "mass_forward_kg": parts.mass_forward_kg[k],
        }
        for number, mode in enumerate(modes)
        for k, station in enumerate(parts.stations_m)
    ]


def stage_of(parts: Parts) -> Tree:
    mass, cg, inertia = composed(parts)
    stage: Tree = {
        "mass": {"mass_kg": mass, "x_cg_m": cg[0], "y_cg_m": cg[1], "z_cg_m": cg[2], "inertia_kgm2": inertia},
        "gyro": {"station_m": parts.gyro_station_m, "omega_hz": 60.0, "zeta": 0.65},
    }
    if parts.engine:
        stage["engine"] = {
            "table": [{"time_s": 0.0, "thrust_vacuum_N": parts.thrust_N}],
            "gimbal_station_m": parts.gimbal_station_m,
            "exit_station_m": parts.gimbal_station_m + 1.0,
            "offset_m": parts.gimbal_offset_m,
            "gimballed_mass_kg": parts.engine_mass_kg,
            "cg_from_gimbal_m": parts.engine_cg_m,
            "inertia_about_gimbal_kgm2": parts.engine_inertia_kgm2 + parts.engine_mass_kg * parts.engine_cg_m**2,
        }
        stage["actuator"] = dict(ACTUATOR)
    if parts.tanks:
        stage["tank"] = [
            {
                "table": [
                    {
                        "time_s": 0.0,
                        "slosh_mass_kg": tank.mass_kg,
                        "pendulum_length_m": tank.length_m,
                        "hinge_station_m": tank.hinge_station_m,
                    }
                ],
                "damping_ratio": tank.damping_ratio,
                "position_m": list(tank.place_m),
            }
            for tank in parts.tanks
        ]
    longest = max(parts.pitch, parts.yaw, key=len)
    if longest:
        stage["bending"] = {"damping_ratio": [mode.zeta for mode in longest]}
        if parts.pitch:
            stage["bending"]["pitch"] = mode_rows(parts, parts.pitch)
        if parts.yaw:
            stage["bending"]["yaw"] = mode_rows(parts, parts.yaw)
    return stage


def scenario_of(parts: Parts, **sections: Any) -> Tree:
    """Return the scenario that flies `parts` through empty space, with whole `sections` merged in."""
    vehicle: Tree = {
        "name": "parts",
        "reference": {"length_m": 14.0, "diameter_m": 1.0, "area_m2": 0.8},
        "stage": [stage_of(parts)],
        "computer": dict(COMPUTER),
    }
    start: Tree = {"euler_deg": [0.0, 0.0, 0.0], "ned_mps": [0.0, 0.0, 0.0]}
    return merged({"schema": 1, "vehicle": vehicle, "initial": start} | EMPTY_SPACE, sections)


def with_stage(tree: Tree, **changes: Any) -> Tree:
    """Return the scenario with its only stage changed."""
    return merged(tree, {"vehicle": {"stage": [merged(tree["vehicle"]["stage"][0], changes)]}})


def oracle_vehicle(parts: Parts, damping_1ps: tuple[float, ...] = ()) -> system.Vehicle:
    """Return the same vehicle for the oracles; mode pairs need equal numbers of modes in both planes."""
    x, y, z = parts.core_cg
    at = {station: k for k, station in enumerate(parts.stations_m)}
    pairs = tuple(
        system.ModePair(
            a.mass_kg,
            b.mass_kg,
            2 * np.pi * a.frequency_hz,
            2 * np.pi * b.frequency_hz,
            a.zeta,
            b.zeta,
            a.phi[at[parts.gimbal_station_m]],
            b.phi[at[parts.gimbal_station_m]],
            a.slope_pm[at[parts.gimbal_station_m]],
            b.slope_pm[at[parts.gimbal_station_m]],
        )
        for a, b in zip(parts.pitch, parts.yaw, strict=True)
    )
    pendulums = tuple(
        system.Pendulum(
            tank.mass_kg,
            tank.length_m,
            np.array([x - tank.hinge_station_m, tank.place_m[0] - y, tank.place_m[1] - z]),
            damping_1ps[k] if damping_1ps else 0.0,
            np.array([mode.phi[at[tank.hinge_station_m]] for mode in parts.pitch]),
            np.array([mode.phi[at[tank.hinge_station_m]] for mode in parts.yaw]),
        )
        for k, tank in enumerate(parts.tanks)
    )
    offset = parts.gimbal_offset_m
    gimbal = np.array([x - parts.gimbal_station_m, offset[0] - y, offset[1] - z])
    engine = system.Engine(parts.engine_mass_kg, parts.engine_inertia_kgm2, parts.engine_cg_m, gimbal)
    return system.Vehicle(
        parts.core_mass_kg, np.array(parts.core_inertia), engine if parts.engine else None, pairs, pendulums
    )


# --- kernels
@entry
def _meet(P, pool, state, y, space, until_ns):  # type: ignore[no-untyped-def]  # Numba infers
    memory = state[0]
    p = P[memory.clock.stage]
    pool, y, properties = bare_pointer(pool), bare_pointer(y), space[0].properties
    flight_events.process_due_events(p, pool, memory, y, space[0].aux, properties)
    return flight_events.step_length(p, pool, memory, until_ns)


def gimbal_motions(channels: Any) -> Array:
    """Return the angle, rate and acceleration (n, 3) of gimbal motions."""
    return np.array(channels.tolist())


@dataclass
class Rig:
    """A packed flight and the derivative of its state.

    `y` (n,) is the initial state and may be written; `dy`, `aux` and `props` contain results of the latest
    `derivative`.
    """

    loaded: LoadedScenario
    packed: Packed
    n: int
    space: Records = field(default_factory=lambda: blank(Space))

    @property
    def y(self) -> Array:
        return self.packed.state[: self.n]

    @property
    def aux(self) -> Any:
        return self.space[0].aux

    @property
    def props(self) -> Array:
        return self.space["properties"][0]

    @property
    def dy(self) -> Array:
        return self.space["rate"][0]

    @property
    def motion(self) -> Array:
        """Return the angle, rate and acceleration (2, 3) of the first group of engines in pitch and yaw."""
        return gimbal_motions(self.aux.engines.channel[:2])

    @property
    def vehicle(self) -> Any:
        """Return the vehicle parameters of the first stage; they may be written."""
        return self.packed.parameters[0].vehicle

    @property
    def timeline(self) -> Any:
        return self.packed.parameters[0].timeline

    @property
    def held(self) -> Any:
        """Return the values held between events: commands (rad), injected loads, flags of launch pad and burning."""
        return self.packed.memory[0].held

    @property
    def sizes(self) -> Any:
        return self.vehicle.sizes

    def derivative(self, y: Array, time_s: float = 0.0) -> Array:
        """Return a copy of the time derivative of `y` (n,) at a flight time."""
        return self.derivative_within(y, round(1e9 * time_s), 0.0)

    def derivative_within(self, y: Array, now_ns: int, elapsed_s: float) -> Array:
        """Return the derivative at `elapsed_s` into a step that starts at `now_ns`."""
        full = np.zeros(MAX_STATE)
        full[: self.n] = y
        evaluate_into(self.packed.parameters, self.packed.pool, self.packed.memory, full, now_ns, elapsed_s, self.space)
        return self.dy[: self.n].copy()

    def run(self) -> FlightRun:
        """Fly from `y`, using the memory of the rig, and return the flight."""
        return FlightRun(self.loaded, self.packed, log=False)


def rig(tree: Tree) -> Rig:
    """Return a rig ready to fly, with engine, computer and clock at the start of the scenario."""
    loaded = load(tree)
    return rig_of(loaded)


def rig_of(loaded: LoadedScenario) -> Rig:
    packed = pack_flight(loaded.scenario)
    made = Rig(loaded, packed, int(state_size(packed.parameters[0].vehicle.sizes)))
    flight_loop.begin(packed.parameters, packed.pool, packed.memory, packed.state)
    return made


def flown(made: Rig, duration_s: float, every_s: float | None = None) -> Array:
    """Return the states (samples, n) of a flight at the start and every `every_s` (default: at the end only).

    `every_s` must be a multiple of the step, so that sampling does not change the flight.
    """
    run = made.run()
    period = round(1e9 * (every_s or duration_s))
    states = [made.y.copy()]
    for _ in range(round(1e9 * duration_s) // period):
        run.fly_segment(period)
        states.append(made.y.copy())
    return np.array(states)


def meet(made: Rig, until_ns: int) -> int:
    """Process everything due at this instant (samples, commands, ignition), and return the ns to the next instant."""
    return int(
        _meet(made.packed.parameters, made.packed.pool, made.packed.memory, made.packed.state, made.space, until_ns)
    )


# --- between the simulator's state and the oracles'
def engine_states(made: Rig, angle: Array, rate: Array, accel: Array) -> Array:
    """Return the smallest actuator states (12,) that give engine angles, rates and accelerations (pitch, yaw; rad)."""
    out = np.zeros(12)
    for axis in range(2):
        columns = []
        for k in range(layout.N_ACTUATOR):
            y = made.y.copy()
            y[layout.ACTUATOR : layout.ACTUATOR + 12] = 0.0
            y[layout.ACTUATOR + 6 * axis + k] = 1.0
            made.derivative(y)
            columns.append(made.motion[axis])
        matrix = np.array(columns).T
        scale = np.array([1.0, 1e-2, 1e-4])  # rates of tens and accelerations of thousands per radian
        wanted = scale * np.array([angle[axis], rate[axis], accel[axis]])
        out[6 * axis : 6 * axis + 6] = np.linalg.lstsq(scale[:, None] * matrix, wanted, rcond=None)[0]
    return out


def to_simulator(made: Rig, state: system.State) -> Array:
    """Return the oracle's state as a simulator state (n,)."""
    y = made.y.copy()
    w = state.w_BI_B_radps
    y[layout.R_I : layout.R_I + 3], y[layout.V_I : layout.V_I + 3] = state.r_I_m, state.v_I_mps
    y[layout.Q_BI : layout.Q_BI + 4] = system.quaternion_from_rotation(state.C_IB)
    y[layout.W_BI_B : layout.W_BI_B + 3] = w
    y[layout.ACTUATOR : layout.ACTUATOR + 12] = engine_states(
        made, state.deflection_rad, state.deflection_radps, state.deflection_radps2
    )
    n = int(made.sizes.pitch_modes)
    i, j = int(layout.eta_index(made.sizes)), int(layout.xi_index(made.sizes))
    y[i : i + n], y[j : j + n] = state.eta_m, state.xi_m
    y[i + n : i + 2 * n] = state.etadot_mps + w[0] * state.xi_m
    y[j + n : j + 2 * n] = state.xidot_mps - w[0] * state.eta_m
    for k in range(int(made.sizes.pendulums)):
        i = int(layout.pendulum_index(made.sizes, k))
        y[i : i + 3] = state.u_B[k]
        y[i + 3 : i + 6] = state.udot_B_1ps[k] + np.cross(w, state.u_B[k])
    return y


def to_oracle(made: Rig, y: Array) -> system.State:
    """Return a simulator state as an oracle state; engine angles follow from the actuator states."""
    made.derivative(y)
    engine = made.motion
    w = y[layout.W_BI_B : layout.W_BI_B + 3].copy()
    n, tanks = int(made.sizes.pitch_modes), int(made.sizes.pendulums)
    i, j = int(layout.eta_index(made.sizes)), int(layout.xi_index(made.sizes))
    eta, xi = y[i : i + n].copy(), y[j : j + n].copy()
    u, u_dot = np.zeros((tanks, 3)), np.zeros((tanks, 3))
    for k in range(tanks):
        b = int(layout.pendulum_index(made.sizes, k))
        u[k] = y[b : b + 3]
        u_dot[k] = y[b + 3 : b + 6] - np.cross(w, u[k])
    return system.State(
        C_IB=system.rotation_from_quaternion(y[layout.Q_BI : layout.Q_BI + 4]),
        w_BI_B_radps=w,
        r_I_m=y[layout.R_I : layout.R_I + 3].copy(),
        v_I_mps=y[layout.V_I : layout.V_I + 3].copy(),
        eta_m=eta,
        etadot_mps=y[i + n : i + 2 * n] - w[0] * xi,
        xi_m=xi,
        xidot_mps=y[j + n : j + 2 * n] + w[0] * eta,
        u_B=u,
        udot_B_1ps=u_dot,
        deflection_rad=engine[:, 0],
        deflection_radps=engine[:, 1],
        deflection_radps2=engine[:, 2],
    )


def accelerations(made: Rig, y: Array, gravitation_I_mps2: Array | None = None) -> dict[str, Array]:
    """Return the simulator's accelerations under the names of `multibody_sympy.accelerations`."""
    dy = made.derivative(y)
    state = to_oracle(made, y)
    w = state.w_BI_B_radps
    n = int(made.sizes.pitch_modes)
    i, j = int(layout.eta_index(made.sizes)), int(layout.xi_index(made.sizes))
    w_dot = dy[layout.W_BI_B : layout.W_BI_B + 3]
    g = np.zeros(3) if gravitation_I_mps2 is None else gravitation_I_mps2
    u_ddot = np.zeros_like(state.u_B)
    for k in range(len(u_ddot)):
        b = int(layout.pendulum_index(made.sizes, k))
        u_ddot[k] = dy[b + 3 : b + 6] - np.cross(w_dot, state.u_B[k]) - np.cross(w, state.udot_B_1ps[k])
    return {
        "specific_force_B_mps2": state.C_IB.T @ (dy[layout.V_I : layout.V_I + 3] - g),
        "wdot_B_radps2": w_dot,
        "etaddot_mps2": dy[i + n : i + 2 * n] - w_dot[0] * state.xi_m - w[0] * state.xidot_mps,
        "xiddot_mps2": dy[j + n : j + 2 * n] + w_dot[0] * state.eta_m + w[0] * state.etadot_mps,
        "uddot_B_1ps2": u_ddot,
    }
