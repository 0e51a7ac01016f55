"""The fixed part of a loop, from the gimbal command to the inputs of the law. It does not depend on the law.

    L(f) = sum of C_i(f) P_i(f),    P = fixed(f) (integrator(f), 1, integrator(f)^2)
    for the measurements (angle_rad, rate_radps, angle_integral_rads)

with negative feedback (`loop.OpenLoop`). Three kinds share one interface:

| kind | class | converter, delay, hold | integrator |
|---|---|---|---|
| `sampled` | `SampledFixedPath` | as in flight: mean over a sample, delayed command, hold | T z / (z - 1) |
| `pade` | `PadeFixedPath` | the paper's eqs 30 to 32 | 1 / s |
| `exact` | `ExactFixedPath` | the exact factors, without aliasing | 1 / s |

For a law with further sensors (`senses`), the path includes the responses of their measurements. Navigation integrates
the lateral acceleration in the axes of the reference trajectory, with the axial specific force a_x:

    drift_mps = integrator (accel_mps2 - a_x angle_rad),    drift_m = integrator drift_mps

A loop can be opened at three points (`Cut`). `gimbal_command` gives the margins of the loop. The other two are those of
eq. 42: from the commanded rate q_c to the pitch rate q of the rigid body, or to q_m at the gyro. This command acts on
the angle alone (33) and passes through neither gyro nor converter. `takes_rate` is then False, and the measured rate
does not contribute. With these two cuts, 1 + L = 0 gives no information about stability (erratum 16).
"""

from __future__ import annotations

import abc
import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from typing import ClassVar, Literal, get_args

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array
from maxq.design.laws.law import ANGLES, DRIFTS, MEASUREMENTS
from maxq.design.loop.own_part import centre_of, dominance, folded_hz
from maxq.design.loop.rational import Rational, average, converter_pade, delay_pade, hold_pade
from maxq.design.loop.resonance import NamedPole, Resonance, named, resonances, vehicle_poles
from maxq.design.loop.sampling import SampledPlant, sample
from maxq.design.model.instruments import ACCELERATION, actuator_poles, actuators, gyro, lag, per_command
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.model.state_space import ComplexArray, Resolvent, StateSpace, chain, channels

LoopKind = Literal["sampled", "pade", "exact"]
Cut = Literal["gimbal_command", "rate_command_to_q", "rate_command_to_q_m"]
KINDS: tuple[LoopKind, ...] = get_args(LoopKind)
CUTS: tuple[Cut, ...] = get_args(Cut)
SETTLED = 1e-7  # relative to the cancelling terms of a steady quantity; above the rounding of the linear model
IMAGES = 8  # on each side of the baseband; they decrease at least with the third power of their number


class FixedPath(abc.ABC):
    """The base class of all kinds of path. `response` and `integrator` accept frequencies in Hz of any shape."""

    kind: ClassVar[LoopKind]

    def __init__(self, node: OperatingPoint, cut: Cut = "gimbal_command", senses: bool = False) -> None:
        if cut not in CUTS:
            raise ValueError(f"cut = {cut!r}: allowed is {', '.join(CUTS)}")
        self.node, self.cut = node, cut
        self.sensors = node.instruments.sensors if senses and cut == "gimbal_command" else ()
        self.takes_rate = cut == "gimbal_command"
        self.measurements: tuple[str, ...] = MEASUREMENTS[: 2 if self.takes_rate else 1]  # those of the basic law
        ideal = bool(node.actuator.ideal)  # the actuators are all ideal or all real
        output = "q_radps" if cut == "rate_command_to_q" else "local_rate_radps"
        # an ideal actuator is at rest between commands; the reaction to its steps is neglected
        inputs = tuple(name for name in node.plant.inputs if not ideal or name.startswith("delta_rad"))
        self.vehicle = channels(node.plant, (output, *(name for name, _, _ in self.sensors)), inputs)
        self._actuator = None if ideal else actuators(node.actuators)
        self._gyro = gyro(node.instruments.gyro) if self.takes_rate and not node.instruments.gyro.ideal else None
        self._latest: tuple[bytes, ComplexArray] = (b"", np.zeros(0, np.complex128))

    @property
    @abc.abstractmethod
    def highest_hz(self) -> float:
        """Return the Nyquist frequency of a sampled path, or infinity."""

    @property
    @abc.abstractmethod
    def sample_s(self) -> float | None:
        """Return the period of a sampled path, s, or None for a continuous path."""

    def with_inputs(self, measurements: Iterable[str]) -> FixedPath:
        """Return the path with the further sensors that the measurements of a law need.

        With a drift among the measurements, gravity is set to the axial load, as in the frame of the trajectory. The
        gravity of the flown instant is inconsistent with a model of constant speed. Raises ValueError if the vehicle
        has no sensors beyond the gyro.
        """
        if all(name in MEASUREMENTS for name in measurements):
            return self
        if not self.node.instruments.sensors:
            raise ValueError("the vehicle has no sensors beyond the gyro: allowed is a law that takes the gyro alone")
        node = self.node.held_still() if any(name in DRIFTS for name in measurements) else self.node
        return self if self.sensors and node is self.node else type(self)(node, self.cut, senses=True)

    @abc.abstractmethod
    def responses(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the responses from gimbal command to the mean rate and to each further sensor's mean measurement.

        The shape is (..., outputs).
        """

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the response from gimbal command to mean rate, in the shape of `frequencies_hz`."""
        return np.asarray(self._remembered(np.asarray(frequencies_hz, float))[..., 0])

    def _remembered(self, f: Array) -> ComplexArray:
        """Return `responses` from a cache of the latest result, since callers request one measurement at a time."""
        if not self.sensors:
            return self.responses(f)
        key = f.tobytes() + str(f.shape).encode()
        if self._latest[0] != key:
            self._latest = key, self.responses(f)
        return self._latest[1]

    @abc.abstractmethod
    def integrator(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the ratio of angle to mean rate, in s and in the shape of `frequencies_hz`."""

    @abc.abstractmethod
    def state_space(self) -> StateSpace:
        """Return the state space from gimbal command to mean rate, without direct feedthrough.

        It is a discrete system for a sampled path. Further sensors are further outputs.
        """

    def ratio(self, measurement: str, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the ratio of a measurement to the mean rate, in the shape of the frequencies.

        The ratio is 0 for a rate that the cut excludes. Raises ValueError for an unknown measurement.
        """
        f = np.asarray(frequencies_hz, float)
        further = [name for name, _, _ in self.sensors]
        if measurement in further:
            all_of_them = self._remembered(f)
            return np.asarray(all_of_them[..., 1 + further.index(measurement)] / all_of_them[..., 0])
        integrator = self.integrator(f)
        if measurement in DRIFTS and ACCELERATION in further:
            across = self.ratio(ACCELERATION, f) - self.node.axial_load_mps2 * integrator
            return np.asarray(across * integrator ** (1 + DRIFTS.index(measurement)))
        if measurement not in MEASUREMENTS:
            known = ", ".join((*MEASUREMENTS, *further, *(DRIFTS if ACCELERATION in further else ())))
            raise ValueError(f"a law uses {measurement}; measured are {known}")
        if measurement in ANGLES:
            return integrator ** (1 + ANGLES.index(measurement))
        return np.full(f.shape, 1.0 if self.takes_rate else 0.0, np.complex128)

    def measured(self, measurements: tuple[str, ...], *, states_of_sums: bool = False) -> StateSpace:
        """Return the state space from gimbal command to measurements, including the integrators of angle and drift.

        It is a discrete system for a sampled path. An integral that is a combination of the path's states adds no
        state, unless `states_of_sums` is True.
        """
        path, period = self.state_space(), self.sample_s
        system = _Summed(
            path.a, path.b, period, dict(zip(("rate_radps", *(n for n, _, _ in self.sensors)), path.c, strict=True))
        )
        states = list(path.states)
        if not self.takes_rate:
            system.rows["rate_radps"] = 0.0 * path.c[0]
        if set(measurements) & {*ANGLES, *DRIFTS}:
            states += system.add("angle_rad", path.c[0], known=self.rests_at_dc and not states_of_sums)
        if set(measurements) & set(DRIFTS):
            if ACCELERATION not in system.rows:
                self.ratio(DRIFTS[0], 1.0)  # raises the ValueError
            across = system.rows[ACCELERATION] - self.node.axial_load_mps2 * system.rows["angle_rad"]
            states += system.add(DRIFTS[0], across, known=self.drift_rests_at_dc and not states_of_sums)
        # integrals that are states are added last: with their poles at zero, a known integral would not be unique
        if ANGLES[1] in measurements:
            states += system.add(ANGLES[1], system.rows["angle_rad"])
        if DRIFTS[1] in measurements:
            states += system.add(DRIFTS[1], system.rows[DRIFTS[0]])
        c = np.array([system.rows[name] for name in measurements])
        return StateSpace(system.a, system.b, c, np.zeros((len(c), 1)), tuple(states), path.inputs, measurements)

    def named_poles(self) -> list[NamedPole]:
        """Return the poles of actuator, vehicle and sensors with their owners, rad/s, without folding.

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
        """Return the poles, rad/s. A pole z of a sampled path is converted to log(z) / T."""
        found = np.array([p.pole_radps for p in self.named_poles()], np.complex128)
        return found if self.sample_s is None else folded(found, self.sample_s)

    def resonances(self, below_zeta: float = 0.3) -> list[Resonance]:
        """Return the oscillatory poles with a damping ratio below `below_zeta`, in rising order of frequency."""
        found = resonances(self.named_poles(), below_zeta, self.sample_s)
        return [replace(r, part=self._own_parts[r.number]) if r.kind == "bending" else r for r in found]

    @cached_property
    def _own_parts(self) -> dict[int, complex]:
        """Return `Resonance.part` of each bending mode by its number.

        With further sensors, the part is that of the measurement in which the mode is strongest relative to the rest.
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
        parts = np.where(np.isfinite(parts), parts, 1.0)  # an undamped mode has an infinite response
        return {p.number: complex(max(row.tolist(), key=dominance)) for p, row in zip(modes, parts, strict=True)}

    def _sensed(self, s: ComplexArray, vehicle: ComplexArray, output: int) -> ComplexArray:
        """Return the response of the vehicle (..., inputs) in series with actuators and gyro, per gimbal command.

        `output` 0 selects the gyro, and a higher index a further sensor.
        """
        out = per_command(s, vehicle, self.vehicle.inputs, self.node.actuators)
        sensor = self.sensors[output - 1][1] if output > 0 else self.node.instruments.gyro
        return out if sensor.ideal or not self.takes_rate else out * lag(s, sensor.omega_radps, sensor.zeta)

    @abc.abstractmethod
    def computer_at(self, s: ComplexArray) -> ComplexArray:
        """Return the response of converter, delay and hold at complex s, rad/s, without aliasing."""

    @cached_property
    def continuous(self) -> StateSpace:
        """Return the state space of actuators, vehicle and sensors in series."""
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
        """Return the state space of gyro and further sensors in parallel. An ideal sensor is a direct feedthrough."""
        each = [self._gyro, *(None if lag.ideal else gyro(lag) for _, lag, _ in self.sensors)]
        through = StateSpace(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.eye(1), (), ("rate",), ("rate",))
        filled = [one or through for one in each]
        a, b, c, d = (scipy.linalg.block_diag(*(getattr(one, name) for one in filled)) for name in "abcd")
        states = tuple(f"{name}_{k + 1}" if k else name for k, one in enumerate(filled) for name in one.states)
        return StateSpace(a, b, c, d, states, self.vehicle.outputs, self.vehicle.outputs)

    @cached_property
    def rests_at_dc(self) -> bool:
        """Return True if a constant command results in zero rate, so that the path has a zero at the integrator's pole.

        This is the case if the attitude affects the motion, because gravity rotates relative to the body. The measured
        rate is then the derivative of a combination of states, and its integral adds no state.
        """
        body = self.vehicle
        if "theta_rad" not in body.states:
            return False
        settled = self._settled
        terms = np.abs(body.c[0] * settled)
        return bool(abs(body.c[0] @ settled) <= 1e-9 * (terms.sum() + np.abs(settled).max()))

    @cached_property
    def drift_rests_at_dc(self) -> bool:
        """Return True if a constant command results in zero acceleration across the reference trajectory.

        The drift velocity is then a combination of the path's states. This is the case in the atmosphere if gravity is
        the axial load (`held_still`), and if bending tilts accelerometer and gyro equally.
        """
        body, names = self.vehicle, [name for name, _, _ in self.sensors]
        if not self.rests_at_dc or ACCELERATION not in names:
            return False
        row, settled = 1 + names.index(ACCELERATION), self._settled
        angle = np.linalg.lstsq(body.a.T, body.c[0], rcond=None)[0]  # at the gyro, as a combination of the states
        turned = self.node.axial_load_mps2 * float(angle @ settled)
        terms = np.append(body.c[row] * settled, (body.d[row, 0], -turned))
        return bool(abs(terms.sum()) <= SETTLED * np.abs(terms).sum())

    @cached_property
    def _settled(self) -> Array:
        """Return the least-squares steady states of the vehicle for a constant unit input of the first drive."""
        return np.asarray(np.linalg.lstsq(self.vehicle.a, -self.vehicle.b[:, 0], rcond=None)[0], float)


class _ContinuousFixedPath(FixedPath):
    """A continuous path as a product of exact factors.

    In contrast to a sum of partial fractions, the product loses no digits by cancellation.
    """

    def __init__(self, node: OperatingPoint, cut: Cut = "gimbal_command", senses: bool = False) -> None:
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
        """Return the transfer function from gimbal command to mean rate at complex s, rad/s."""
        return np.asarray(self.plant_at(s) * self.computer_at(s))

    def plant_at(self, s: ComplexArray, output: int = 0) -> ComplexArray:
        """Return the response of actuator, vehicle and gyro, or of further sensor `output`, at complex s, rad/s."""
        return self._sensed(s, self._turning(s)[..., output, :] + self.vehicle.d[output], output)


class PadeFixedPath(_ContinuousFixedPath):
    """The path with the paper's Padé approximations: H_VF [3/3], H_D [2/2], H_DZ [0/2]."""

    kind = "pade"

    def __init__(self, node: OperatingPoint, cut: Cut = "gimbal_command", senses: bool = False) -> None:
        super().__init__(node, cut, senses)
        if any(samples > 0 for _, _, samples in self.sensors):
            raise ValueError("the kind pade has no latency of single sensors: allowed is sampled or exact")
        timing = node.instruments
        sampled = timing.sample_s > 0.0
        self.computer: list[Rational] = [hold_pade(timing.sample_s)] if sampled else []
        if timing.delay_s > 0.0:
            self.computer.append(delay_pade(timing.delay_s))
        if self.takes_rate and sampled:
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
    """The path with the exact transcendental functions of average, delay and hold, without aliasing."""

    kind = "exact"

    def computer_at(self, s: ComplexArray) -> ComplexArray:
        timing = self.node.instruments
        out = average(s, timing.sample_s) * np.exp(-timing.delay_s * np.asarray(s))
        return np.asarray(out * average(s, timing.sample_s) if self.takes_rate else out)

    def state_space(self) -> StateSpace:
        raise ValueError("a transcendental transfer function has no state space: take the kind pade or sampled")


class SampledFixedPath(FixedPath):
    """The path as the flight computer samples it.

    `response` is evaluated at z = exp(j w T), up to the Nyquist frequency. The cuts of eq. 42 end at q, or q_m,
    averaged by the converter without the lag of a gyro.
    """

    kind = "sampled"

    def __init__(self, node: OperatingPoint, cut: Cut = "gimbal_command", senses: bool = False) -> None:
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
    """Return a sampled system without direct feedthrough, with output number `output` delayed by `samples`."""
    a, b, c, n = path.a, path.b, path.c.copy(), len(path.a)
    for _ in range(samples):
        a = np.block([[a, np.zeros((len(a), 1))], [c[output : output + 1], np.zeros((1, 1))]])
        b, c = np.vstack([b, np.zeros((1, b.shape[1]))]), np.hstack([c, np.zeros((len(c), 1))])
        c[output] = np.eye(len(a))[-1]
    states = (*path.states, *(f"{path.outputs[output]}_{k + 1}_ago" for k in range(len(a) - n)))
    return StateSpace(a, b, c, path.d, states, path.inputs, path.outputs)


def fixed_path(
    node: OperatingPoint, kind: LoopKind = "sampled", cut: Cut = "gimbal_command", senses: bool = False
) -> FixedPath:
    """Return the fixed path of an operating point.

    `senses` adds the further sensors of the vehicle. Raises ValueError for an unknown kind or cut.
    """
    kinds = {one.kind: one for one in (SampledFixedPath, PadeFixedPath, ExactFixedPath)}
    if kind not in kinds:
        raise ValueError(f"kind = {kind!r}: allowed is {', '.join(kinds)}")
    return kinds[kind](node, cut, senses)


def folded(poles_radps: ComplexArray, sample_s: float) -> ComplexArray:
    """Return log(exp(s T)) / T, the poles with imaginary parts between -pi / T and pi / T."""
    turn = 2.0 * math.pi / sample_s
    imaginary = poles_radps.imag - turn * np.round(poles_radps.imag / turn)
    return poles_radps.real + 1j * imaginary


def sampled_computer(s: ComplexArray, sample_s: float, delay_s: Array | float) -> ComplexArray:
    """Return the response of converter, delay and hold of a sampled path for one image, at complex s, rad/s."""
    return np.asarray(average(s, sample_s) ** 2 * np.exp(-delay_s * np.asarray(s)))


def image_points(poles_radps: ComplexArray, sample_s: float | None) -> ComplexArray:
    """Return the points s on the imaginary axis that contribute to the response at each pole's frequency.

    The shape is (poles, images). The frequency itself (`own_part.centre_of`) is in the middle. A continuous path
    (`sample_s` None) has no further images.
    """
    rate_hz = 1.0 / (sample_s or 1e-300)
    hz, widths_hz = poles_radps.imag / (2.0 * math.pi), np.abs(poles_radps.real) / (2.0 * math.pi)
    centres = centre_of(folded_hz(hz, rate_hz), widths_hz, 0.5 * rate_hz)
    images = np.zeros(1)
    if sample_s is not None:
        most = IMAGES + math.ceil(np.abs(poles_radps).max() * sample_s / (2.0 * math.pi))
        images = np.arange(-most, most + 1) * rate_hz
    return np.asarray(2j * np.pi * (centres[:, None] + images))


class _Summed:
    """A path that is extended by integrals of its outputs, which become further outputs.

    `rows` are the output rows by name. The integrals are sums for a sampled path.
    """

    def __init__(self, a: Array, b: Array, period: float | None, rows: dict[str, Array]) -> None:
        self.a, self.b, self.period, self.rows = a, b, period, rows

    def add(self, name: str, added: Array, known: bool = False) -> list[str]:
        """Add the integral of an output to the path and return the names of the new states.

        In a sampled path, the integral is a sum that includes the present sample. If `known` is True, the integral is a
        combination of the existing states and adds none.
        """
        n, period = len(self.a), self.period
        if known:
            # the combination of the states' rates of change equals the output
            drift, kept = (self.a, 0.0) if period is None else (self.a - np.eye(n), 1.0)
            addend = added if period is None else period * added
            self.rows[name] = kept * addend + np.linalg.lstsq(drift.T, addend, rcond=None)[0]
            return []
        addend, kept = (added, 0.0) if period is None else (period * added, 1.0)
        self.a = np.block([[self.a, np.zeros((n, 1))], [addend[None], np.full((1, 1), kept)]])
        self.b = np.vstack([self.b, np.zeros((1, 1))])
        self.rows = {key: np.append(row, 0.0) for key, row in self.rows.items()}
        self.rows[name] = np.append(kept * addend, 1.0)
        return [name]


def _pair(omega: float, zeta: float) -> ComplexArray:
    """Return the roots of s^2 + 2 zeta omega s + omega^2."""
    root = np.sqrt(complex(zeta * zeta - 1.0))
    return np.array([-zeta + root, -zeta - root], np.complex128) * omega
