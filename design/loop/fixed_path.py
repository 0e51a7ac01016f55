"""The fixed part of a loop, which the designer of a law cannot change: from the gimbal command to the inputs of the
law.

    L(f) = sum of C_i(f) P_i(f),    P = fixed(f) (integrator(f), 1, integrator(f)^2)

for the measurements (angle_rad, rate_radps, angle_integral_rads)
with negative feedback (`loop.OpenLoop`). Three kinds with one interface:

| kind | class | converter, delay, hold | integrator |
|---|---|---|---|
| `sampled` | `SampledFixedPath` | as the computer does it: mean over a sample, late command, hold | T z / (z - 1) |
| `pade` | `PadeFixedPath` | the paper's eqs 30 to 32 | 1 / s |
| `exact` | `ExactFixedPath` | their exact factors, without aliasing | 1 / s |

For a law that uses further sensors (`senses`), the path includes the responses of their measurements.

A loop can be opened at three points (`Cut`). `gimbal_command` is the loop's own point and gives the margins of the
loop. The other two follow eq. 42 to the letter: from the commanded rate q_c to the pitch rate q of the rigid body, or
to q_m at the gyro. q_c acts on the angle alone (33) and passes no gyro and no converter. `takes_rate` is then False and
the measured rate has no part. These two are not loops: 1 + L = 0 gives no information about stability there (erratum
16).
"""

from __future__ import annotations

import abc
import math
from dataclasses import replace
from functools import cached_property
from typing import ClassVar, Literal, get_args

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array
from maxq.design.laws.law import ANGLES, MEASUREMENTS
from maxq.design.loop.own_part import centre_of, dominance, folded_hz
from maxq.design.loop.rational import Rational, average, converter_pade, delay_pade, hold_pade
from maxq.design.loop.resonance import NamedPole, Resonance, named, resonances, vehicle_poles
from maxq.design.loop.sampling import SampledPlant, sample
from maxq.design.model.instruments import actuator_poles, actuators, gyro, lag, per_command
from maxq.design.model.node import Node
from maxq.design.model.state_space import ComplexArray, Resolvent, StateSpace, chain, channels

LoopKind = Literal["sampled", "pade", "exact"]
Cut = Literal["gimbal_command", "rate_command_to_q", "rate_command_to_q_m"]
KINDS: tuple[LoopKind, ...] = get_args(LoopKind)
CUTS: tuple[Cut, ...] = get_args(Cut)
IMAGES = 8  # on either side of a mode's own part; they decrease at least with the third power of their number


class FixedPath(abc.ABC):
    """The base of all kinds of path. `response` and `integrator` accept frequencies in Hz of any shape."""

    kind: ClassVar[LoopKind]

    def __init__(self, node: Node, cut: Cut = "gimbal_command", senses: bool = False) -> None:
        if cut not in CUTS:
            raise ValueError(f"cut = {cut!r}: allowed is {', '.join(CUTS)}")
        self.node, self.cut = node, cut
        self.sensors = node.instruments.sensors if senses and cut == "gimbal_command" else ()
        self.takes_rate = cut == "gimbal_command"
        self.measurements: tuple[str, ...] = MEASUREMENTS[: 2 if self.takes_rate else 1]  # of the usual law
        ideal = bool(node.actuator.ideal)  # that of one applies to all
        output = "q_radps" if cut == "rate_command_to_q" else "local_rate_radps"
        # an ideal actuator is at rest between commands: the corners of the staircase excite no mode
        inputs = tuple(name for name in node.plant.inputs if not ideal or name.startswith("delta_rad"))
        self.vehicle = channels(node.plant, (output, *(name for name, _, _ in self.sensors)), inputs)
        self._actuator = None if ideal else actuators(node.actuators)
        self._gyro = gyro(node.instruments.gyro) if self.takes_rate and not node.instruments.gyro.ideal else None
        self._latest: tuple[bytes, ComplexArray] = (b"", np.zeros(0, np.complex128))

    @property
    @abc.abstractmethod
    def highest_hz(self) -> float:
        """Return the Nyquist frequency, or infinity."""

    @property
    @abc.abstractmethod
    def sample_s(self) -> float | None:
        """Return the period of a sampled path, or None for a continuous one."""

    @property
    def with_sensors(self) -> FixedPath:
        """Return the path with the measurements of further sensors. Raises ValueError if there are none."""
        if not self.node.instruments.sensors:
            raise ValueError("the vehicle has no sensors beyond the gyro: allowed is a law that takes the gyro alone")
        return self if self.sensors else type(self)(self.node, self.cut, senses=True)

    @abc.abstractmethod
    def responses(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the responses from gimbal command to the means of the rate and of each further sensor's measurement,
        (..., outputs).
        """

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return fixed(f), from gimbal command to mean rate, in the shape of `frequencies_hz`."""
        return np.asarray(self._remembered(np.asarray(frequencies_hz, float))[..., 0])

    def _remembered(self, f: Array) -> ComplexArray:
        """Return `responses`, and cache the latest result, since the measurements are requested one at a time."""
        if not self.sensors:
            return self.responses(f)
        key = f.tobytes() + str(f.shape).encode()
        if self._latest[0] != key:
            self._latest = key, self.responses(f)
        return self._latest[1]

    @abc.abstractmethod
    def integrator(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the ratio of angle to mean rate, s, in the shape of `frequencies_hz`."""

    @abc.abstractmethod
    def state_space(self) -> StateSpace:
        """Return the state space from gimbal command to mean rate, without direct feedthrough, in z for a sampled
        path.
        """

    def ratio(self, measurement: str, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the ratio of a measurement to the mean rate in the shape of the frequencies, or 0 if the cut excludes
        it.

        Raises ValueError for an unknown measurement.
        """
        f = np.asarray(frequencies_hz, float)
        further = [name for name, _, _ in self.sensors]
        if measurement in further:
            all_of_them = self._remembered(f)
            return np.asarray(all_of_them[..., 1 + further.index(measurement)] / all_of_them[..., 0])
        if measurement not in MEASUREMENTS:
            known = ", ".join((*MEASUREMENTS, *further))
            raise ValueError(f"a law uses {measurement}; measured are {known}")
        if measurement in ANGLES:
            return self.integrator(f) ** (1 + ANGLES.index(measurement))
        return np.full(f.shape, 1.0 if self.takes_rate else 0.0, np.complex128)

    def measured(self, measurements: tuple[str, ...]) -> StateSpace:
        """Return the system from gimbal command to measurements, with the integrators of the angle, in z for a sampled
        path.
        """
        path, period = self.state_space(), self.sample_s
        rate = path.c[0]
        a, b, states = path.a, path.b, path.states
        # kept in addition to the rate while integrators are added
        others = {name: k for k, (name, _, _) in enumerate(self.sensors, 1) if name in measurements}
        # a sampled angle includes the increment of this sample
        drift, per_rate = (a, rate) if period is None else (a - np.eye(len(a)), period * rate)
        angle = np.zeros(len(a)) if period is None else per_rate
        wanted = any(name in measurements for name in ANGLES)
        if wanted and self.rests_at_dc:
            # the angle follows from the path's states: `known` times their rate of change is the measured rate
            angle = angle + np.linalg.lstsq(drift.T, per_rate, rcond=None)[0]
        elif wanted:
            a, b, (rate,), angle = _integrated(a, b, (rate,), per_rate, period)
            states = (*states, "angle_rad")
        integral = angle
        if "angle_integral_rads" in measurements:
            added = angle if period is None else period * angle
            a, b, (rate, angle), integral = _integrated(a, b, (rate, angle), added, period)
            states = (*states, "angle_integral_rads")
        rows = dict(zip(MEASUREMENTS, (angle, rate if self.takes_rate else 0.0 * rate, integral), strict=True))
        rows |= {name: np.append(path.c[k], np.zeros(len(a) - len(path.a))) for name, k in others.items()}
        c = np.array([rows[name] for name in measurements])
        return StateSpace(a, b, c, np.zeros((len(c), 1)), states, path.inputs, measurements)

    def named_poles(self) -> list[NamedPole]:
        """Return the poles of actuator, vehicle and gyro and their owners, rad/s, not folded.

        Each part is treated separately, since a series connection preserves the poles. The poles of a pure delay are
        omitted.
        """
        out = list(self._vehicle_poles)
        if self._actuator is not None:
            poles = [pair for record in self.node.actuators for pair in actuator_poles(record)]
            for k, (omega, zeta) in enumerate(poles):
                out += named(_pair(omega, zeta), "actuator", k + 1)
        if self._gyro is not None:
            out += named(_pair(self.node.instruments.gyro.omega_radps, self.node.instruments.gyro.zeta), "gyro")
        for k, (_, g, _) in enumerate(self.sensors):
            out += [] if g.ideal else named(_pair(g.omega_radps, g.zeta), "sensor", k + 1)
        return out

    @cached_property
    def _vehicle_poles(self) -> list[NamedPole]:
        return vehicle_poles(self.vehicle)

    def poles(self) -> ComplexArray:
        """Return the poles in rad/s, those of a sampled path as log(z) / T."""
        found = np.array([p.pole_radps for p in self.named_poles()], np.complex128)
        return found if self.sample_s is None else folded(found, self.sample_s)

    def resonances(self, below_zeta: float = 0.3) -> list[Resonance]:
        """Return the oscillatory poles with a damping ratio below `below_zeta`, by frequency."""
        found = resonances(self.named_poles(), below_zeta, self.sample_s)
        return [replace(r, part=self._own_parts[r.number]) if r.kind == "bending" else r for r in found]

    @cached_property
    def _own_parts(self) -> dict[int, complex]:
        """Return `Resonance.part` of each bending mode by its number.

        With further sensors, it is that of the measurement in which the mode is strongest relative to the rest.
        """
        modes = [p for p in self._vehicle_poles if p.kind == "bending" and p.pole_radps.imag > 0.0]
        if not modes:
            return {}
        poles, residue = np.array([p.pole_radps for p in modes]), np.array([p.residue for p in modes])[:, None]
        s = image_points(poles, self.sample_s)
        at, pole = s[..., None, None], poles[:, None, None, None]
        way = residue / (at - pole) + residue.conj() / (at - pole.conj())
        late = [0, *(samples for _, _, samples in self.sensors)]
        period, computer = self.node.instruments.sample_s, self.computer_at(s)
        each = [
            (self._sensed(s, way[..., k, :], k) * computer * np.exp(-s * n * period)).sum(axis=1)
            for k, n in enumerate(late)
        ]
        with np.errstate(divide="ignore", invalid="ignore"):
            parts = np.stack(each, axis=-1) / self.responses(s.imag[:, s.shape[1] // 2] / (2.0 * math.pi))
        parts = np.where(np.isfinite(parts), parts, 1.0)  # of an undamped mode
        return {p.number: complex(max(row.tolist(), key=dominance)) for p, row in zip(modes, parts, strict=True)}

    def _sensed(self, s: ComplexArray, vehicle: ComplexArray, output: int) -> ComplexArray:
        """Return a response (..., inputs) of the vehicle through the actuators and the gyro, or sensor `output`."""
        out = per_command(s, vehicle, self.vehicle.inputs, self.node.actuators)
        sensor = self.sensors[output - 1][1] if output > 0 else self.node.instruments.gyro
        return out if sensor.ideal or not self.takes_rate else out * lag(s, sensor.omega_radps, sensor.zeta)

    @abc.abstractmethod
    def computer_at(self, s: ComplexArray) -> ComplexArray:
        """Return the converter, delay and hold at complex s, rad/s, without aliasing."""

    @cached_property
    def continuous(self) -> StateSpace:
        """Return the actuator, vehicle and gyro in series."""
        parts = []
        if self._actuator is not None:
            parts.append(channels(self._actuator, self.vehicle.inputs))
        parts.append(self.vehicle)
        if self.sensors:
            parts.append(self._lags())
        elif self._gyro is not None:
            parts.append(self._gyro)
        return chain(*parts)

    def _lags(self) -> StateSpace:
        """Return the gyro and further sensors in parallel. Sensors without dynamics pass their inputs on."""
        each = [self._gyro, *(None if lag.ideal else gyro(lag) for _, lag, _ in self.sensors)]
        through = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.eye(1), (), ("rate",), ("rate",))
        filled = [one or through for one in each]
        a, b, c, d = (scipy.linalg.block_diag(*(getattr(one, name) for one in filled)) for name in "abcd")
        states = tuple(f"{name}_{k + 1}" if k else name for k, one in enumerate(filled) for name in one.states)
        return StateSpace(a, b, c, d, states, self.vehicle.outputs, self.vehicle.outputs)

    @cached_property
    def rests_at_dc(self) -> bool:
        """Return True if a constant command results in zero rate: the path then has a zero at the integrator's pole.

        This is so if the attitude acts on the motion, because gravity turns in the body. The measured rate is then the
        derivative of a state, and its integral adds no state.
        """
        body = self.vehicle
        if "theta_rad" not in body.states:
            return False
        settled = np.linalg.lstsq(body.a, -body.b[:, 0], rcond=None)[0]
        terms = np.abs(body.c[0] * settled)
        return bool(abs(body.c[0] @ settled) <= 1e-9 * (terms.sum() + np.abs(settled).max()))


class _ContinuousFixedPath(FixedPath):
    """The product of factors, each exact.

    No digit is lost by cancellation, in contrast to a sum of partial fractions.
    """

    def __init__(self, node: Node, cut: Cut = "gimbal_command", senses: bool = False) -> None:
        super().__init__(node, cut, senses)
        self._turning = Resolvent(self.vehicle.a, self.vehicle.b, self.vehicle.c)

    @property
    def highest_hz(self) -> float:
        return math.inf

    @property
    def sample_s(self) -> float | None:
        return None

    def responses(self, frequencies_hz: ArrayLike) -> ComplexArray:
        s = 2j * np.pi * np.asarray(frequencies_hz, float)
        ways = [self.plant_at(s, k) for k in range(1 + len(self.sensors))]
        late = [0, *(samples for _, _, samples in self.sensors)]
        ways = [way * np.exp(-s * n * self.node.instruments.sample_s) for way, n in zip(ways, late, strict=True)]
        return np.asarray(np.stack(ways, axis=-1) * self.computer_at(s)[..., None])

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        return self.at(2j * np.pi * np.asarray(frequencies_hz, float))

    def integrator(self, frequencies_hz: ArrayLike) -> ComplexArray:
        return np.asarray(1.0 / (2j * np.pi * np.asarray(frequencies_hz, float)))

    def at(self, s: ComplexArray) -> ComplexArray:
        """Return the transfer function at complex s, rad/s."""
        return np.asarray(self.plant_at(s) * self.computer_at(s))

    def plant_at(self, s: ComplexArray, output: int = 0) -> ComplexArray:
        """Return the actuator, vehicle and gyro, or further sensor number `output`."""
        return self._sensed(s, self._turning(s)[..., output, :] + self.vehicle.d[output], output)


class PadeFixedPath(_ContinuousFixedPath):
    """The path with the paper's approximations: H_VF [3/3], H_D [2/2], H_DZ [0/2]."""

    kind = "pade"

    def __init__(self, node: Node, cut: Cut = "gimbal_command", senses: bool = False) -> None:
        super().__init__(node, cut, senses)
        if any(samples > 0 for _, _, samples in self.sensors):
            raise ValueError("the kind pade has no latency of single sensors: allowed is sampled or exact")
        timing = node.instruments
        self.computer: list[Rational] = [hold_pade(timing.sample_s)]
        if timing.delay_s > 0.0:
            self.computer.append(delay_pade(timing.delay_s))
        if self.takes_rate:
            self.computer.append(converter_pade(timing.sample_s))

    def computer_at(self, s: ComplexArray) -> ComplexArray:
        out = np.ones(np.shape(s), np.complex128)
        for part in self.computer:
            out = out * part.at(s)
        return out

    def state_space(self) -> StateSpace:
        return chain(*(part.state_space() for part in self.computer), self.continuous)

    def named_poles(self) -> list[NamedPole]:
        return super().named_poles() + [p for part in self.computer for p in named(part.poles(), part.name)]


class ExactFixedPath(_ContinuousFixedPath):
    """The path with the exact factors: average, delay and hold as transcendental functions, without aliasing."""

    kind = "exact"

    def computer_at(self, s: ComplexArray) -> ComplexArray:
        timing = self.node.instruments
        out = average(s, timing.sample_s) * np.exp(-timing.delay_s * np.asarray(s))
        return np.asarray(out * average(s, timing.sample_s) if self.takes_rate else out)

    def state_space(self) -> StateSpace:
        raise ValueError("a transcendental transfer function has no state space: take the kind pade or sampled")


class SampledFixedPath(FixedPath):
    """The loop as the flight computer runs it. `response` is at z = exp(j w T), up to the Nyquist frequency.

    The cuts of eq. 42 end at q, or q_m, as a converter without a gyro would count it.
    """

    kind = "sampled"

    def __init__(self, node: Node, cut: Cut = "gimbal_command", senses: bool = False) -> None:
        super().__init__(node, cut, senses)
        self.sampled: SampledPlant = sample(self.continuous, node.instruments.sample_s, node.instruments.delay_s)
        self._resolvent = self.sampled.resolvent()

    def computer_at(self, s: ComplexArray) -> ComplexArray:
        return sampled_computer(s, self.sample_s, self.node.instruments.delay_s)

    @property
    def highest_hz(self) -> float:
        return 0.5 / self.node.instruments.sample_s

    @property
    def sample_s(self) -> float:
        return self.node.instruments.sample_s

    def responses(self, frequencies_hz: ArrayLike) -> ComplexArray:
        z = self.z(frequencies_hz)
        late = [0, *(samples for _, _, samples in self.sensors)]
        return np.asarray(self.sampled.at(z, self._resolvent)[..., 0] * np.stack([z**-n for n in late], axis=-1))

    def integrator(self, frequencies_hz: ArrayLike) -> ComplexArray:
        turn = 2j * np.pi * self.sample_s * np.asarray(frequencies_hz, float)
        return np.asarray(-self.sample_s / np.expm1(-turn))

    def z(self, frequencies_hz: ArrayLike) -> ComplexArray:
        return np.asarray(np.exp(2j * np.pi * self.sample_s * np.asarray(frequencies_hz, float)))

    def state_space(self) -> StateSpace:
        path = self.sampled.state_space()
        for output, (_, _, samples) in enumerate(self.sensors, 1):
            path = delayed(path, output, samples)
        return path


def delayed(path: StateSpace, output: int, samples: int) -> StateSpace:
    """Return a sampled system without direct feedthrough, with one of its outputs delayed by that number of samples."""
    a, b, c, n = path.a, path.b, path.c.copy(), len(path.a)
    for _ in range(samples):
        a = np.block([[a, np.zeros((len(a), 1))], [c[output : output + 1], np.zeros((1, 1))]])
        b, c = np.vstack([b, np.zeros((1, b.shape[1]))]), np.hstack([c, np.zeros((len(c), 1))])
        c[output] = np.eye(len(a))[-1]
    states = (*path.states, *(f"{path.outputs[output]}_{k + 1}_ago" for k in range(len(a) - n)))
    return StateSpace(a, b, c, path.d, states, path.inputs, path.outputs)


def fixed_path(node: Node, kind: LoopKind = "sampled", cut: Cut = "gimbal_command", senses: bool = False) -> FixedPath:
    """Return the fixed path of an operating point.

    `senses` adds further sensors. Raises ValueError for an unknown kind or cut.
    """
    kinds = {one.kind: one for one in (SampledFixedPath, PadeFixedPath, ExactFixedPath)}
    if kind not in kinds:
        raise ValueError(f"kind = {kind!r}: allowed is {', '.join(kinds)}")
    return kinds[kind](node, cut, senses)


def folded(poles_radps: ComplexArray, sample_s: float) -> ComplexArray:
    """Return log(exp(s T)) / T, with imaginary parts between -pi / T and pi / T."""
    turn = 2.0 * math.pi / sample_s
    imaginary = poles_radps.imag - turn * np.round(poles_radps.imag / turn)
    return poles_radps.real + 1j * imaginary


def sampled_computer(s: ComplexArray, sample_s: float, delay_s: Array | float) -> ComplexArray:
    """Return the converter, delay and hold of a sampled path for one of its images, at complex s, rad/s."""
    return np.asarray(average(s, sample_s) ** 2 * np.exp(-delay_s * np.asarray(s)))


def image_points(poles_radps: ComplexArray, sample_s: float | None) -> ComplexArray:
    """Return the points s on the imaginary axis, (poles, images), that contribute to the response at each pole's
    frequency.

    The frequency (`own_part.centre_of`) is in the middle. A continuous path (`sample_s` None) has no other image.
    """
    rate_hz = 1.0 / (sample_s or 1e-300)
    hz, widths_hz = poles_radps.imag / (2.0 * math.pi), np.abs(poles_radps.real) / (2.0 * math.pi)
    centres = centre_of(folded_hz(hz, rate_hz), widths_hz, 0.5 * rate_hz)
    images = np.zeros(1)
    if sample_s is not None:
        most = IMAGES + math.ceil(np.abs(poles_radps).max() * sample_s / (2.0 * math.pi))
        images = np.arange(-most, most + 1) * rate_hz
    return np.asarray(2j * np.pi * (centres[:, None] + images))


def _integrated(
    a: Array, b: Array, rows: tuple[Array, ...], added: Array, period: float | None
) -> tuple[Array, Array, list[Array], Array]:
    """Return state matrices with one additional state, the integral (the sum) of the output `added`, and the rows of
    the outputs and of the new state.

    A sum includes the addend of the present sample.
    """
    n, kept = len(a), 0.0 if period is None else 1.0
    a = np.block([[a, np.zeros((n, 1))], [added[None], np.full((1, 1), kept)]])
    b = np.vstack([b, np.zeros((1, 1))])
    return a, b, [np.append(row, 0.0) for row in rows], np.append(kept * added, 1.0)


def _pair(omega: float, zeta: float) -> ComplexArray:
    """Return the roots of s^2 + 2 zeta omega s + omega^2."""
    root = np.sqrt(complex(zeta * zeta - 1.0))
    return np.array([-zeta + root, -zeta - root], np.complex128) * omega
