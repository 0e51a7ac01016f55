"""The combined loops of pitch, yaw and roll, coupled by the vehicle as the simulator flies it.

    L(f) = C(f) P(f),    C = diag(C_pitch, C_yaw, C_roll)

The poles of the closed loops satisfy det(1 + L) = 0. P is the sampled response from the law's commands, through
allocation, to the mean rates that the flight computer measures about all axes. The plant is the linearised simulator
(design/model/linearised.py) with products of inertia and a roll rate. It includes spatial modes with their torsion and
axial motion, off-axis engines, and tanks with slosh in both planes.

Attitude angles are sums of the counts about each body axis (attitude = "rate-integral"). A quaternion error also
rotates with the roll rate. The effect is negligible if the roll rate is small relative to the crossover frequencies.

Roll is included if gimbals control it. Switching thrusters have no linear loop, and the roll rate is then free, as
inside their dead band. The roll angle is held constant, since only gravity couples it to the motion.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.design.laws.bending_filter import FASTEST
from maxq.design.laws.law import MEASUREMENTS, Controller
from maxq.design.laws.navigated import navigated
from maxq.design.laws.pd import Pd
from maxq.design.laws.registry import designed_law
from maxq.design.loop.fixed_path import delayed
from maxq.design.loop.sampling import SampledPlant, sample
from maxq.design.model.instruments import Plane, instruments_of
from maxq.design.model.linearised import at_rest, linearise
from maxq.design.model.node import node_of
from maxq.design.model.powered import flown_run, flown_to
from maxq.design.model.state_space import ComplexArray, Resolvent, StateSpace, chain, channels, zeros_and_poles
from maxq.sim.packing.flight import Packed
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_design import Design

PLANES: tuple[Plane, Plane] = ("pitch", "yaw")
AXES = (*PLANES, "roll")
_HELD = ("x_I_m", "y_I_m", "z_I_m", "u_mps")  # position and speed are constant, as in the model of one plane


@dataclass(frozen=True)
class Multiloop:
    """The loops of `axes`, each with its law, around a common plant.

    `path` maps commands to mean rates, in the order of the axes. `sensed` lists the name and the latency in samples of
    each further measurement in pitch and yaw. These measurements are outputs of `path` after the rates.
    """

    time_s: float
    axes: tuple[str, ...]
    path: SampledPlant
    laws: tuple[Controller, ...]
    sensed: tuple[tuple[str, int], ...] = ()
    plant: StateSpace | None = None  # continuous, from commands to the quantities that `path` averages

    @property
    def highest_hz(self) -> float:
        return 0.5 / self.path.sample_s

    def response(self, frequencies_hz: Array) -> ComplexArray:
        """Return L, (*frequencies.shape, axes, axes). Rows are returned commands, and columns are applied commands."""
        f = np.asarray(frequencies_hz, float)
        z = np.exp(2j * np.pi * self.path.sample_s * f)
        way, n = self.path.at(z, self._resolvent), len(self.axes)
        out = np.asarray(self.controllers(f)[..., None] * way[..., :n, :])
        for k, (name, late) in enumerate(self.sensed):
            for axis, law in enumerate(self.laws[:2]):
                if name in law.inputs:
                    gain = law.response(f)[..., law.inputs.index(name)] * z**-late
                    out[..., axis, :] += gain[..., None] * way[..., n + 2 * k + axis, :]
        return out

    def controllers(self, f: Array) -> ComplexArray:
        """Return the response from the mean rate of each axis to its command at frequencies in Hz, (..., axes)."""
        z = np.exp(2j * np.pi * self.path.sample_s * f)
        summed = self.path.sample_s * z / (z - 1.0)
        ratio = dict(zip(MEASUREMENTS, (summed, np.ones_like(z), summed**2), strict=True))
        none = np.zeros_like(z)  # further measurements are not functions of the rate and are added separately
        parts = [
            law.response(f) * np.stack([ratio.get(name, none) for name in law.inputs], axis=-1) for law in self.laws
        ]
        return np.stack([part.sum(axis=-1) for part in parts], axis=-1)

    @cached_property
    def _resolvent(self) -> Resolvent:
        return self.path.resolvent()

    @cached_property
    def state_space(self) -> StateSpace:
        """Return L as a discrete state space, from the commands to the negatives of the returned commands."""
        t, parts, path, n_axes = self.path.sample_s, [], self.path.state_space(), len(self.axes)
        taken: list[int] = []  # indices of the path's outputs, law by law
        for k, (_, late) in enumerate(self.sensed):
            for axis in range(2):
                path = delayed(path, n_axes + 2 * k + axis, late)
        for axis, law in enumerate(self.laws):
            mine = [k for k, (name, _) in enumerate(self.sensed) if axis < 2 and name in law.inputs]
            taken += [axis, *(n_axes + 2 * k + axis for k in mine)]
            # coefficients of the previous angle and angle integral, and of the new rate
            rows = dict(zip(MEASUREMENTS, ([1.0, 0.0, t], [0.0, 0.0, 1.0], [t, 1.0, t * t]), strict=True))
            n = 2 if "angle_integral_rads" in law.inputs else 1
            a, b = np.array([[1.0, 0.0], [t, 1.0]])[:n, :n], np.zeros((n, 1 + len(mine)))
            b[:, 0] = np.array([t, t * t])[:n]
            outputs = np.array([rows.get(name, [0.0, 0.0, 0.0]) for name in law.inputs])
            states = ("angle_rad", "angle_integral_rads")[:n]
            through = np.zeros((len(law.inputs), 1 + len(mine)))
            through[:, 0] = outputs[:, 2]
            for column, k in enumerate(mine, 1):
                through[law.inputs.index(self.sensed[k][0]), column] = 1.0
            inputs = ("rate", *(self.sensed[k][0] for k in mine))
            summed = StateSpace(a, b, outputs[:, :n], through, states, inputs, law.inputs)
            parts.append(chain(summed, law.state_space()))
        a, b, c, d = (scipy.linalg.block_diag(*(getattr(part, name) for part in parts)) for name in "abcd")
        states = tuple(f"{axis}_{name}" for axis, p in zip(self.axes, parts, strict=True) for name in p.states)
        names = tuple(path.outputs[k] for k in taken)
        path = StateSpace(path.a, path.b, path.c[taken], path.d[taken], path.states, path.inputs, names)
        return chain(path, StateSpace(a, b, c, d, states, names, self.axes))

    def poles(self, closed: Iterable[int]) -> ComplexArray:
        """Return the poles with the loops of the axes `closed` (indices) closed, log(z) / T in rad/s."""
        s, i = self.state_space, list(closed)
        z = np.linalg.eigvals(s.a - s.b[:, i] @ s.c[i]).astype(np.complex128)
        return np.asarray(np.log(z[np.abs(z) > FASTEST]) / self.path.sample_s)

    def one(self, axis: str) -> OneLoop:
        """Return the loop of one axis, opened at its command with the other loops closed."""
        return OneLoop(self, self.axes.index(axis))


@dataclass(frozen=True)
class OneLoop:
    """The loop (`OpenLoop`) of one axis, opened at its command while the loops of the other axes are closed:

    L_ii - L_io (1 + L_oo)^-1 L_oi
    """

    whole: Multiloop
    axis: int

    @property
    def highest_hz(self) -> float:
        return self.whole.highest_hz

    @property
    def sample_s(self) -> float:
        return self.whole.path.sample_s

    @property
    def _others(self) -> list[int]:
        return [k for k in range(len(self.whole.axes)) if k != self.axis]

    def response(self, frequencies_hz: Array) -> ComplexArray:
        whole, i, o = self.whole.response(frequencies_hz), self.axis, self._others
        around = whole[..., o, :][..., :, o] + np.eye(len(o))
        through = np.linalg.solve(around, whole[..., o, i][..., None])[..., 0]
        return np.asarray(whole[..., i, i] - (whole[..., i, o] * through).sum(axis=-1))

    def open_poles(self) -> ComplexArray:
        return self.whole.poles(self._others)

    def closed_poles(self) -> ComplexArray:
        return self.whole.poles(range(len(self.whole.axes)))

    def factors(self) -> tuple[ComplexArray, ComplexArray]:
        s, i, o = self.whole.state_space, [self.axis], self._others
        a = s.a - s.b[:, o] @ s.c[o]
        names = (s.inputs[self.axis],)
        return zeros_and_poles(StateSpace(a, s.b[:, i], s.c[i], s.d[i][:, i], s.states, names, names))


def multiloops(scenario: LoadedScenario, design: Design, times_s: Iterable[float]) -> list[Multiloop]:
    """Return the loops at vehicle times (s), in rising order, of the scenario's flight with its own design.

    The laws are those of `design`. Raises ValueError for a time outside the powered flight; the message states the
    operating point and the range.
    """
    run, out = flown_run(scenario, faults=False), []
    for time_s in sorted(set(times_s)):
        flown_to(run, time_s)
        out.append(multiloop(run.packed, design, run.now_s))
    return out


def multiloop(packed: Packed, design: Design, time_s: float) -> Multiloop:
    """Return the loops of a packed flight at its present state.

    Position, attitude, velocity and roll rate are those flown. Modes, pendulums and engines are at rest. Pitch and yaw
    rates are zero.
    """
    model, matrix = linearise(*at_rest(packed, time_s), time_s), np.eye(2, 3)
    stage = int(packed.memory[0].clock.stage)
    row = packed.parameters[stage]
    allocation, t = row.computer.allocation, 1e-9 * int(row.computer.sample_ns)
    axes: tuple[str, ...] = AXES[:2]
    law, roll = designed_law(design.of_stage(stage)), Pd(float(allocation.k_p), float(allocation.k_d_s))
    node = node_of(packed, time_s, stage)
    at = node.scheduled(law.over)
    laws: tuple[Controller, ...] = tuple(navigated(law.at(at, plane, t), node.axial_load_mps2, t) for plane in PLANES)
    if int(allocation.groups) > 1:
        matrix = table_in(packed.pool, allocation.matrix)(time_s).reshape(-1, 3)
        if matrix[:, 2].any() and (roll.k_p, roll.k_d_s) != (0.0, 0.0):
            axes, laws = AXES, (*laws, roll)
    held = (*_HELD, *(f"gyro_{axis}_rad" for axis in AXES), *(() if "roll" in axes else ("phi_rad",)))
    kept = [k for k, name in enumerate(model.states) if name not in held and not name.endswith("_integral")]
    integrals, sensed = [f"gyro_{axis}_rad" for axis in axes], []  # states that integrate the sensors' outputs
    signs = [1.0] * len(axes)
    if any(name not in MEASUREMENTS for one in laws for name in one.inputs):
        for k, (name, _, late) in enumerate(instruments_of(row).sensors, 1):
            force = not name.startswith("rate_")  # a positive yaw command pushes in the direction -y
            integrals += [f"sensor_{k}_{axis}_integral" for axis in ("zy" if force else "yz")]
            signs += [1.0, -1.0 if force else 1.0]
            sensed.append((name, late))
    counted = [model.states.index(name) for name in integrals]
    plant = StateSpace(
        model.a[np.ix_(kept, kept)],
        model.b[kept] @ matrix[:, : len(axes)],
        np.array(signs)[:, None] * model.a[np.ix_(counted, kept)],
        np.zeros((len(counted), len(axes))),
        tuple(model.states[k] for k in kept),
        axes,
        tuple(integrals),
    )
    path = sample(channels(plant, tuple(integrals)), t, 1e-9 * int(row.computer.delay_ns))
    return Multiloop(time_s, axes, path, laws, tuple(sensed), plant)
