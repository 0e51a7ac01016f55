"""The simulator's own equations, linearised numerically at a frozen instant: all axes with all that couples them.

    model = linearise(*at_rest(packed, time_s), time_s)
    poles = np.linalg.eigvals(model.a)

It shares no equation with design/model/plant.py, whose oracle it is in the tests; the loops of several axes
(design/loop/multiloop.py) stand on it.

The state vector of the simulator lies on a manifold (unit quaternion, unit vectors of the pendulums) and
holds inertial and quasi-velocities. It is therefore expressed in local coordinates, all independent and all
small-signal quantities of flight mechanics, whose time derivatives follow exactly from the simulator's:

    r_I            position of the core's CG in I, m
    u, v, w        its velocity relative to the Earth, in B, m/s
    rotation       rotation vector from the reference attitude, which rotates on at its own rate, in B, rad
    p, q, r        angular velocity relative to I, in B, rad/s
    actuators, gyros, gyro angles    as in the state
    eta, eta', xi, xi'               true rates: without the rotation of the bending plane with p
    spatial, nu                      of spatial modes as in the state: the same where roll rate and modes are at rest
    per tank       angles atan2(u_z, -u_x), atan2(u_y, -u_x) and their rates, rad, rad/s
    actuators of further groups, TVC load      as in the state

Away from equilibrium (an accelerating rocket always is) a linear model depends on its coordinates; these are those of
design/model/plant.py. The vehicle's properties are frozen at the instant, their rates (mass flow, moving CG) act.
The model is continuous: the flight computer is not part of it; inputs are the commands of each group of engines in
pitch and yaw.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import StateSpace
from maxq.sim.flight.loop import begin
from maxq.sim.packing.flight import Packed
from maxq.sim.packing.initial import quaternion, rotation
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.vehicle import state as layout
from maxq.sim.vehicle.block import Sizes
from maxq.sim.vehicle.loads import MOMENT_Y, MOMENT_Z
from maxq.sim.vehicle.state import MAX_STATE
from maxq.sim.vehicle.workspace import ENGINE_PITCH, ENGINE_YAW, GYRO_BEND

OUTPUTS = ("delta_pitch_rad", "delta_yaw_rad", "local_rate_pitch_radps", "local_rate_yaw_radps")

_R, _V, _TURN, _W = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_FLAT = slice(12, 12 + layout.N_FIXED - layout.ACTUATOR)  # actuators, gyros, gyro angles: taken as they are
_FLEXIBLE = _FLAT.stop

_LEVELS = 6  # of the extrapolation: each halves the step
_STEP_R, _STEP_V, _STEP_TURN, _STEP_W = 8.0, 0.5, 4e-3, 1e-2
_SETTLING_M = 1e-4
_STEP_FLAT, _STEP_BEND, _STEP_BEND_RATE, _STEP_SLOSH, _STEP_COMMAND = 2e-3, 2e-3, 0.1, 8e-3, 4e-3


@dataclass(frozen=True)
class LinearModel(StateSpace):
    """x' = rate + A x + B u, y = C x + D u about a state; `rate` is the derivative at the state itself.

    Outputs are OUTPUTS, and bending moments about y and z where section loads are switched on.
    """

    rate: Array  # (n,)


def linearise(packed: Packed, y: Array, time_s: float) -> LinearModel:
    """Linear model of the derivative about the state `y` (MAX_STATE,) at the flight time `time_s`.

    `packed` may be at its start or in mid-flight (its stage, and whether it burns or is held down, count); it
    is not changed. Derivatives are central differences, extrapolated to step zero over all powers of the step
    (Ridders 1982; odd powers too, because of terms like |w| w), with the best entry of each tableau by its
    error estimate.
    """
    frame = _Chart(packed, y, time_s)
    n, inputs = len(frame.names), frame.inputs

    def motion(offset: Array) -> Array:
        return frame.motion(offset[:n], offset[n:])

    at_rest = motion(np.zeros(n + len(inputs)))
    slopes = _jacobian(motion, np.concatenate([frame.steps, np.full(len(inputs), _STEP_COMMAND)]))
    parts = slopes[:n, :n], slopes[:n, n:], slopes[n:, :n], slopes[n:, n:]
    return LinearModel(*parts, frame.names, inputs, frame.outputs, at_rest[:n])


class _Chart:
    """Local coordinates about a state, and their rates."""

    def __init__(self, packed: Packed, y: Array, time_s: float) -> None:
        memory = packed.memory.copy()
        if memory[0].clock.started == 0:
            begin(packed.parameters, packed.pool, memory, packed.state.copy())
        self._packed, self._time_s = dataclasses.replace(packed, memory=memory), time_s
        self._held = memory[0].held
        stage = packed.parameters[int(memory[0].clock.stage)]
        self._sizes = stage.vehicle.sizes
        self._spin = np.array([0.0, 0.0, float(stage.environment.earth.rate_radps)])
        self._attitude = rotation(y[layout.Q_BI : layout.Q_BI + 4])
        self._turning = y[layout.W_BI_B : layout.W_BI_B + 3].copy()
        pitch, yaw, tanks = (int(self._sizes[k]) for k in ("pitch_modes", "yaw_modes", "pendulums"))
        self._eta = layout.N_FIXED + np.arange(pitch)
        self._xi = layout.N_FIXED + 2 * pitch + np.arange(yaw)
        first, spatial = int(layout.spatial_index(self._sizes)), int(self._sizes["spatial_modes"])
        self._spatial = slice(first, first + 2 * spatial)
        self._tanks = [int(layout.pendulum_index(self._sizes, k)) for k in range(tanks)]
        self._rest = slice(int(layout.pendulum_index(self._sizes, tanks)), int(layout.state_size(self._sizes)))
        self._point = self._read(y)
        coordinates = self._coordinates(pitch, yaw, spatial, tanks)
        coordinates += [(name, _STEP_FLAT) for name in layout.state_names(self._sizes)[self._rest]]
        self.names, self.steps = tuple(name for name, _ in coordinates), np.array([step for _, step in coordinates])
        channels = 2 * (1 + int(self._sizes.further_groups))
        self._command = np.array(self._held.command_rad[:channels])
        numbered = ["", *(f"_{group}" for group in range(2, channels // 2 + 1))]
        self.inputs = tuple(f"command_{axis}{n}_rad" for n in numbered for axis in ("pitch", "yaw"))
        stations = stage.loads.station_m[: int(stage.loads.stations)]
        self.outputs = (*OUTPUTS, *(f"bending_{axis}_{at:g}_Nm" for axis in ("pitch", "yaw") for at in stations))

    def motion(self, offset: Array, command: Array) -> Array:
        """Rates of the coordinates `offset` from the reference, then the outputs."""
        x = self._point + offset
        y = self._state(x)
        self._held.command_rad[: len(command)] = self._command + command
        now = evaluate_at(self._packed, y, self._time_s)
        w = x[_W]
        outputs = [now.aux[ENGINE_PITCH], now.aux[ENGINE_YAW], w[1] + now.aux[GYRO_BEND], w[2] + now.aux[GYRO_BEND + 1]]
        return np.concatenate(
            [self._rates(x, y, now.rate), outputs, now.sections[:, MOMENT_Y], now.sections[:, MOMENT_Z]]
        )

    def _read(self, y: Array) -> Array:
        """Coordinates of a state with the reference attitude."""
        over_ground = y[layout.V_I : layout.V_I + 3] - _cross(self._spin, y[layout.R_I : layout.R_I + 3])
        w = y[layout.W_BI_B : layout.W_BI_B + 3]
        eta, xi = y[self._eta], y[self._xi]
        eta_rate = y[self._eta + len(eta)] - w[0] * _padded(xi, len(eta))
        xi_rate = y[self._xi + len(xi)] + w[0] * _padded(eta, len(xi))
        parts = [y[layout.R_I : layout.R_I + 3], self._attitude.T @ over_ground, np.zeros(3), w]
        parts += [y[layout.ACTUATOR : layout.N_FIXED], eta, eta_rate, xi, xi_rate, y[self._spatial]]
        for i in self._tanks:
            u = y[i : i + 3]
            u_rate = y[i + 3 : i + 6] - _cross(w, u)
            for across in (2, 1):
                angle, rate, _ = _angle(u, u_rate, np.zeros(3), across)
                parts.append(np.array([angle, rate]))
        return np.concatenate([*parts, y[self._rest]])

    def _state(self, x: Array) -> Array:
        """The simulator's state at coordinates `x`."""
        y = np.zeros(MAX_STATE)
        attitude = self._attitude @ _rotation_of(x[_TURN])
        w = x[_W]
        y[layout.R_I : layout.R_I + 3] = x[_R]
        y[layout.V_I : layout.V_I + 3] = attitude @ x[_V] + _cross(self._spin, x[_R])
        y[layout.Q_BI : layout.Q_BI + 4] = quaternion(attitude)
        y[layout.W_BI_B : layout.W_BI_B + 3] = w
        y[layout.ACTUATOR : layout.N_FIXED] = x[_FLAT]
        n, m = len(self._eta), len(self._xi)
        eta, eta_rate, xi, xi_rate = np.split(x[_FLEXIBLE : _FLEXIBLE + 2 * (n + m)], [n, 2 * n, 2 * n + m])
        y[self._eta], y[self._eta + n] = eta, eta_rate + w[0] * _padded(xi, n)
        y[self._xi], y[self._xi + m] = xi, xi_rate - w[0] * _padded(eta, m)
        flexible = _FLEXIBLE + 2 * (n + m) + self._spatial.stop - self._spatial.start
        y[self._spatial] = x[_FLEXIBLE + 2 * (n + m) : flexible]
        for k, i in enumerate(self._tanks):
            pitch, pitch_rate, yaw, yaw_rate = x[flexible + 4 * k :][:4]
            u, u_rate = _bob(pitch, pitch_rate, yaw, yaw_rate)
            y[i : i + 3], y[i + 3 : i + 6] = u, u_rate + _cross(w, u)
        y[self._rest] = x[len(x) - (self._rest.stop - self._rest.start) :]
        return y

    def _rates(self, x: Array, y: Array, dy: Array) -> Array:
        """Time derivative of the coordinates from that of the state."""
        attitude = rotation(y[layout.Q_BI : layout.Q_BI + 4])
        w, w_rate = x[_W], dy[layout.W_BI_B : layout.W_BI_B + 3]
        moving = dy[layout.V_I : layout.V_I + 3] - _cross(self._spin, y[layout.V_I : layout.V_I + 3])
        n, m = len(self._eta), len(self._xi)
        eta, eta_rate, xi, xi_rate = np.split(x[_FLEXIBLE : _FLEXIBLE + 2 * (n + m)], [n, 2 * n, 2 * n + m])
        eta_accel = dy[self._eta + n] - w_rate[0] * _padded(xi, n) - w[0] * _padded(xi_rate, n)
        xi_accel = dy[self._xi + m] + w_rate[0] * _padded(eta, m) + w[0] * _padded(eta_rate, m)
        turning = _vector_rate(x[_TURN], w - _rotation_of(x[_TURN]).T @ self._turning)
        parts = [dy[layout.R_I : layout.R_I + 3], attitude.T @ moving - _cross(w, x[_V]), turning, w_rate]
        # eta' is taken from the simulator's derivative and not derived from the quasi-velocity here
        parts += [dy[layout.ACTUATOR : layout.N_FIXED], dy[self._eta], eta_accel, dy[self._xi], xi_accel]
        parts.append(dy[self._spatial])
        for i in self._tanks:
            u, u_rate = y[i : i + 3], dy[i : i + 3]
            u_accel = dy[i + 3 : i + 6] - _cross(w_rate, u) - _cross(w, u_rate)
            for across in (2, 1):
                _, rate, accel = _angle(u, u_rate, u_accel, across)
                parts.append(np.array([rate, accel]))
        return np.concatenate([*parts, dy[self._rest]])

    @staticmethod
    def _coordinates(pitch: int, yaw: int, spatial: int, tanks: int) -> list[tuple[str, float]]:
        """Name of each but the last (`_rest`), and the first step of its differences."""
        first = {
            ("x_I_m", "y_I_m", "z_I_m"): _STEP_R,
            ("u_mps", "v_mps", "w_mps"): _STEP_V,
            ("phi_rad", "theta_rad", "psi_rad"): _STEP_TURN,
            ("p_radps", "q_radps", "r_radps"): _STEP_W,
            tuple(layout.state_names(Sizes(pitch, yaw, tanks, 0))[layout.ACTUATOR : layout.N_FIXED]): _STEP_FLAT,
        }
        out = [(name, step) for names, step in first.items() for name in names]
        for symbol, count in (("eta", pitch), ("xi", yaw), ("spatial", spatial)):
            for what, step in (("m", _STEP_BEND), ("rate_mps", _STEP_BEND_RATE)):
                out += [(f"{symbol}_{i + 1}_{what}", step) for i in range(count)]
        angles = [f"{plane}{what}" for plane in ("pitch", "yaw") for what in ("_rad", "_rate_radps")]
        return out + [(f"slosh_{k + 1}_{angle}", _STEP_SLOSH) for k in range(tanks) for angle in angles]


def _jacobian(function: Any, steps: Array) -> Array:
    """Derivatives at zero (outputs, inputs)."""
    columns = []
    for j, first in enumerate(steps):
        tableau: list[list[Array]] = []
        best, least = np.zeros(0), np.zeros(0)
        for level in range(_LEVELS):
            offset = np.zeros(len(steps))
            offset[j] = first / 2**level
            row = [(function(offset) - function(-offset)) / (2.0 * offset[j])]
            for power in range(1, level + 1):
                row.append(row[-1] + (row[-1] - tableau[-1][power - 1]) / (2.0**power - 1.0))
                error = np.maximum(np.abs(row[-1] - row[-2]), np.abs(row[-1] - tableau[-1][power - 1]))
                if not len(best):
                    best, least = row[-1], error
                best, least = np.where(error < least, row[-1], best), np.minimum(error, least)
            tableau.append(row)
        columns.append(best)
    return np.array(columns).T


def _padded(values: Array, length: int) -> Array:
    """The first `length` values, then zeros: modes of the two planes are paired as far as they go."""
    out = np.zeros(length)
    out[: min(length, len(values))] = values[:length]
    return out


def _cross(a: Any, b: Array) -> Array:
    """Of two vectors; NumPy's takes thirty times as long."""
    (a0, a1, a2), (b0, b1, b2) = a, b
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def _rotation_of(vector: Array) -> Array:
    """Rotation matrix of a rotation vector."""
    angle = float(np.linalg.norm(vector))
    half = 0.5 * angle
    scale = 0.5 * math.sin(half) / half if half > 0.0 else 0.5
    return np.asarray(rotation(np.array([math.cos(half), *(scale * vector)])))


def _vector_rate(vector: Array, turning: Array) -> Array:
    """Rate of a rotation vector from the angular velocity in turned axes.

    Inverse of the right Jacobian; small angles only (the series' next term is of order 8).
    """
    square = float(vector @ vector)
    factor = 1.0 / 12.0 + square * (1.0 / 720.0 + square / 30240.0)
    once = _cross(vector, turning)
    return np.asarray(turning + 0.5 * once + factor * _cross(vector, once))


def _angle(u: Array, u_rate: Array, u_accel: Array, across: int) -> tuple[float, float, float]:
    """atan2(u[across], -u[0]) with its first and second time derivative."""
    a, b = float(u[across]), -float(u[0])
    a1, b1, a2, b2 = float(u_rate[across]), -float(u_rate[0]), float(u_accel[across]), -float(u_accel[0])
    square, cross = a * a + b * b, a1 * b - a * b1
    rate = cross / square
    return math.atan2(a, b), rate, (a2 * b - a * b2) / square - 2.0 * rate * (a * a1 + b * b1) / square


def _bob(pitch: float, pitch_rate: float, yaw: float, yaw_rate: float) -> tuple[Array, Array]:
    """Unit vector from hinge to bob and its rate in B, from angles below 90 degrees and their rates."""
    tangent_pitch, tangent_yaw = math.tan(pitch), math.tan(yaw)
    along = np.array([-1.0, tangent_yaw, tangent_pitch])
    along_rate = np.array([0.0, yaw_rate * (1 + tangent_yaw**2), pitch_rate * (1 + tangent_pitch**2)])
    length = float(np.linalg.norm(along))
    u = along / length
    return u, (along_rate - u * (u @ along_rate)) / length


def at_rest(packed: Packed, time_s: float) -> tuple[Packed, Array]:
    """A packed flight where it stands, with its modes, pendulums and engines at rest and no command: flight and state.

    Place, attitude, velocity and roll rate are kept; rates in pitch and yaw are zero, the gyros' output with them.
    """
    memory, out = packed.memory.copy(), np.zeros(MAX_STATE)
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
    """The state with its spatial modes deflected as the loads of the instant hold them: thrust compresses axial parts.

    About modes that spring back from no deflection the pull of the liquid along the axis would be another one.
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
