"""The simulator's own equations, linearised numerically at a frozen instant, with all axes and their couplings.

    model = linearise(*at_rest(packed, time_s), time_s)
    poles = np.linalg.eigvals(model.a)

The plant of one plane (design/model/held.py) and the loops of several axes (design/loop/multiloop.py) use it. The tests
compare it with planar equations derived by hand (tests/oracles/planar).

The simulator's state vector is on a manifold (unit quaternion, unit vectors of the pendulums) and contains inertial and
quasi-velocities. It is therefore expressed in local coordinates. These are independent small-signal quantities of
flight mechanics, and their time derivatives follow exactly from those of the simulator:

    r_I            position of the core's CG in I, m
    u, v, w        its velocity relative to the Earth, in B, m/s
    rotation       rotation vector from the reference attitude, which continues to rotate at its own rate, in B, rad
    p, q, r        angular velocity relative to I, in B, rad/s
    actuators, gyros, gyro angles    as in the state
    eta, eta', xi, xi'               true rates, without the rotation of the bending plane with p
    spatial, nu                      of spatial modes as in the state; equal to rates if roll rate and modes are at rest
    per tank       angles atan2(u_z, -u_x), atan2(u_y, -u_x) and their rates, rad, rad/s
    actuators of further groups, TVC load      as in the state

An accelerating rocket is never in equilibrium, and away from equilibrium a linear model depends on its coordinates.
These coordinates are those of the paper. The vehicle's properties are frozen at the instant, but their rates (mass
flow, moving CG) act. The model is continuous and does not contain the flight computer. Its inputs are the commands of
each engine group in pitch and yaw.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array, IntArray, blank, duplicate
from maxq.design.model import jacobian
from maxq.design.model.state_space import StateSpace
from maxq.sim.flight.loop import begin
from maxq.sim.packing.flight import Packed
from maxq.sim.run.evaluate import Space, evaluate_at
from maxq.sim.vehicle import state as layout
from maxq.sim.vehicle.block import Sizes
from maxq.sim.vehicle.workspace import PROPERTIES_SIZE

OUTPUTS = ("delta_pitch_rad", "delta_yaw_rad", "local_rate_pitch_radps", "local_rate_yaw_radps")

_SETTLING_M = 1e-4
_STEP_R, _STEP_V, _STEP_TURN, _STEP_W = 8.0, 0.5, 4e-3, 1e-2
_STEPS_OF_FLOW = {"kgps": 1.0, "Pa": 1e3}
_STEP_FLAT, _STEP_BEND, _STEP_BEND_RATE, _STEP_SLOSH, _STEP_COMMAND = 2e-3, 2e-3, 0.1, 8e-3, 4e-3


@dataclass(frozen=True)
class LinearModel(StateSpace):
    """The linear model x' = rate + A x + B u, y = C x + D u about a state.

    `rate` is the derivative at the state itself. The outputs are OUTPUTS, followed by the bending moments about y and z
    if section loads are switched on.
    """

    rate: Array  # (n,)


def linearise(packed: Packed, y: Array, time_s: float) -> LinearModel:
    """Return the linear model of the derivative about the state `y` (MAX_STATE,) at the flight time `time_s`.

    `packed` may be at its start or in flight and is not changed. It determines the stage, and whether the stage burns
    or is held down. The derivatives are those of `jacobian.differentiate`.
    """
    memory = duplicate(packed.memory)
    if memory[0].clock.started == 0:
        begin(packed.parameters, packed.pool, memory, packed.state.copy())
    stage = packed.parameters[int(memory[0].clock.stage)]
    parameters = packed.parameters
    if int(stage.vehicle.sizes.buffets) > 0:  # a random force is not part of the model
        parameters = parameters.copy()
        parameters["vehicle"]["buffet"]["factor"] = 0.0
    coordinates, inputs = coordinates_of(stage.vehicle.sizes), inputs_of(stage.vehicle.sizes)
    n, m, stations = len(coordinates), len(inputs), int(stage.loads.stations)
    steps = np.array([*coordinates.values(), *[_STEP_COMMAND] * m])
    rate, slopes = differentiate(
        parameters, packed.pool, memory, y, round(1e9 * time_s), np.arange(n + m), steps, stations=stations
    )
    outputs = (
        *OUTPUTS,
        *(f"bending_{a}_{at:g}_Nm" for a in ("pitch", "yaw") for at in stage.loads.station_m[:stations]),
    )
    parts = slopes[:n, :n], slopes[:n, n:], slopes[n:, :n], slopes[n:, n:]
    return LinearModel(*parts, tuple(coordinates), inputs, outputs, rate[:n])


def differentiate(
    parameters: Any,
    pool: Array,
    memory: Any,
    y: Array,
    now_ns: int,
    which: IntArray,
    steps: Array,
    *,
    stations: int = 0,
    wanted: IntArray | None = None,
    levels: int = jacobian.LEVELS,
    properties: Array | None = None,
) -> tuple[Array, Array]:
    """Return the rates and outputs (rows,) at a state, and their derivatives (wanted, columns).

    `properties` are those of the vehicle at the instant and replace those of its schedule. For states (vehicles,
    MAX_STATE) with the same number of parameters and properties, the results have the vehicles along their first axis.
    See `jacobian.differentiate` for the other arguments.
    """
    sizes = parameters[int(memory[0].clock.stage)].vehicle.sizes
    rows = int(jacobian.coordinate_count(sizes)) + jacobian.OUTPUTS + 2 * stations
    states, given = (
        np.atleast_2d(y).copy(),
        np.atleast_2d(np.zeros(PROPERTIES_SIZE) if properties is None else properties),
    )
    wanted = np.arange(rows) if wanted is None else wanted
    rate, slopes = np.zeros((len(states), rows)), np.zeros((len(states), len(wanted), len(which)))
    space, x = blank(Space), np.zeros(rows + len(inputs_of(sizes)) + 3)
    jacobian.differentiate(
        parameters,
        pool,
        duplicate(memory),
        states,
        now_ns,
        int(properties is None),
        np.asarray(which, np.int64),
        steps,
        np.asarray(wanted, np.int64),
        levels,
        given,
        space,
        x,
        np.zeros((3 * jacobian.LEVELS + 4, rows)),
        rate,
        slopes,
    )
    return (rate[0], slopes[0]) if np.ndim(y) == 1 else (rate, slopes)


def inputs_of(sizes: Any) -> tuple[str, ...]:
    """Return the names of the commands of each engine group."""
    numbered = ["", *(f"_{group}" for group in range(2, 2 + int(sizes.further_groups)))]
    return tuple(f"command_{axis}{n}_rad" for n in numbered for axis in ("pitch", "yaw"))


def coordinates_of(sizes: Any) -> dict[str, float]:
    """Return the names of a stage's coordinates, in order, with the first step of the differences in each."""
    counts = sizes.item()
    if counts not in _COORDINATES:
        _COORDINATES[counts] = _coordinates_of(sizes)
    return dict(_COORDINATES[counts])


_COORDINATES: dict[tuple[int, ...], dict[str, float]] = {}
"""The results of `coordinates_of`, which each operating point requests several times."""


def _coordinates_of(sizes: Any) -> dict[str, float]:
    pitch, yaw, spatial, tanks = (int(sizes[k]) for k in ("pitch_modes", "yaw_modes", "spatial_modes", "pendulums"))
    flat = layout.state_names(Sizes(0, 0, 0, 0))[layout.ACTUATOR : layout.N_FIXED]
    groups: list[tuple[Sequence[str], float]] = [
        (("x_I_m", "y_I_m", "z_I_m"), _STEP_R),
        (("u_mps", "v_mps", "w_mps"), _STEP_V),
        (("phi_rad", "theta_rad", "psi_rad"), _STEP_TURN),
        (("p_radps", "q_radps", "r_radps"), _STEP_W),
        (flat, _STEP_FLAT),
    ]
    for symbol, count in (("eta", pitch), ("xi", yaw), ("spatial", spatial)):
        for quantity, step in (("m", _STEP_BEND), ("rate_mps", _STEP_BEND_RATE)):
            groups.append(([f"{symbol}_{i + 1}_{quantity}" for i in range(count)], step))
    angles = [f"{plane}{rate}" for plane in ("pitch", "yaw") for rate in ("_rad", "_rate_radps")]
    groups.append(([f"slosh_{k + 1}_{angle}" for k in range(tanks) for angle in angles], _STEP_SLOSH))
    behind = slice(int(layout.pendulum_index(sizes, tanks)), int(layout.state_size(sizes)))
    groups.append((layout.state_names(sizes)[behind], _STEP_FLAT))
    steps = {name: step for names, step in groups for name in names}
    return steps | {name: _STEPS_OF_FLOW[name.rsplit("_", 1)[1]] for name in steps if name.startswith("feed_")}


def at_rest(packed: Packed, time_s: float) -> tuple[Packed, Array]:
    """Return a packed flight and its present state, with modes, pendulums and engines at rest and without commands.

    Position, attitude, velocity and roll rate are kept. Pitch and yaw rates and the corresponding gyro states are zero.
    """
    memory, out = duplicate(packed.memory), np.zeros(layout.MAX_STATE)
    memory[0].held.command_rad[:] = 0.0
    out[: layout.W_BI_B + 1] = packed.state[: layout.W_BI_B + 1]
    out[layout.GYRO] = out[layout.W_BI_B]
    sizes = packed.parameters[int(memory[0].clock.stage)].vehicle.sizes
    for tank in range(int(sizes.pendulums)):
        first = int(layout.pendulum_index(sizes, tank))
        out[first] = -1.0
    still = dataclasses.replace(packed, memory=memory)
    return still, settled(still, out, time_s)


def settled(packed: Packed, y: Array, time_s: float) -> Array:
    """Return the state with its spatial modes deflected by the present loads, such as the compression by thrust.

    With undeflected modes, the rebound would change the pull of the liquid along the axis.
    """
    sizes = packed.parameters[int(packed.memory[0].clock.stage)].vehicle.sizes
    n, first = int(sizes.spatial_modes), int(layout.spatial_index(sizes))
    out = y.copy()
    if n == 0:
        return out

    def rates(eta: Array) -> Array:
        out[first : first + n] = eta
        return evaluate_at(packed, out, time_s).rate[first : first + 2 * n]

    free = rates(np.zeros(n))[n:]
    per_m = np.array([rates(np.asarray(row))[n:] - free for row in _SETTLING_M * np.eye(n)]).T / _SETTLING_M
    out[first + n : first + 2 * n] = -rates(np.asarray(np.linalg.solve(per_m, -free), float))[:n]
    return out
