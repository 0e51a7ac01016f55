"""The margin budget: gain and phase of each part of a loop at one frequency. The sum is the whole loop.

Parts in series multiply, so their decibels and degrees add. Parts that are not in series - aerodynamics, slosh, engine
inertia, bending - act on one another. They are added one after the other in a stated order of build-up steps. The share
of each is the ratio of L with the part to L without it, all earlier parts being present and all later parts absent. The
ratios telescope: in any order, their sum is L. The order decides which part includes the interaction of two parts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.loop.fixed_path import PadeFixedPath
from maxq.design.loop.loop import Loop
from maxq.design.loop.rational import average
from maxq.design.margins.measure import Margins
from maxq.design.margins.solving import DB, wrapped
from maxq.design.model.instruments import actuator_response, lag, per_actuator_angle
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.model.state_space import ComplexArray, Resolvent, channels

Response = Callable[[Array], ComplexArray]

_PATH = 400  # points, and decades below the frequency, along which a phase is unwrapped
_DECADES = 4.0


@dataclass(frozen=True)
class Share:
    """The share of one part.

    Degrees below 0 are lag. The phase of a part in series is unwrapped from low frequency (a delay may exceed 180 deg).
    That of a build-up step is within +-180 deg.
    """

    part: str
    gain_db: float
    phase_deg: float


@dataclass(frozen=True)
class Budget:
    """The budget at one frequency.

    `left_db` and `left_deg` are L itself less the sum of the shares, which is rounding.
    """

    frequency_hz: float
    shares: tuple[Share, ...]
    left_db: float
    left_deg: float

    @property
    def gain_db(self) -> float:
        """Return the sum of the gains: |L|."""
        return float(sum(share.gain_db for share in self.shares))

    @property
    def phase_deg(self) -> float:
        """Return the sum of the phases: the phase of L, up to turns."""
        return float(sum(share.phase_deg for share in self.shares))

    @property
    def phase_margin_deg(self) -> float:
        """Return the sum of the phases beyond -180 + 360 k degrees, in [-180, 180)."""
        return wrapped(self.phase_deg + 180.0, 180.0)


def split(
    whole: Response,
    frequency_hz: float,
    series: Sequence[tuple[str, Response]],
    steps: Sequence[tuple[str, Response]] = (),
) -> Budget:
    """Return the budget of `whole` = product of `series` times the last of `steps`.

    A step is the response with that part and all earlier parts present. Raises ValueError if a part is zero or not
    finite at the frequency.
    """
    path = frequency_hz * 10.0 ** np.linspace(-_DECADES, 0.0, _PATH)
    here = path[-1:]
    shares = []
    for part, response in series:
        values = _checked(part, response(path), frequency_hz)
        phase = np.unwrap(np.angle(values))
        shares.append(Share(part, _db(values[-1]), float(np.degrees(phase[-1]))))
    before = 1.0 + 0j
    for part, response in steps:
        with_it = complex(_checked(part, response(here), frequency_hz)[-1])
        shares.append(Share(part, _db(with_it / before), float(np.degrees(np.angle(with_it / before)))))
        before = with_it
    value = complex(_checked("the whole", whole(here), frequency_hz)[-1])
    found = Budget(float(frequency_hz), tuple(shares), 0.0, 0.0)
    left_deg = wrapped(float(np.degrees(np.angle(value))) - found.phase_deg, 180.0)
    return Budget(found.frequency_hz, found.shares, _db(value) - found.gain_db, left_deg)


def _checked(part: str, values: ComplexArray, frequency_hz: float) -> ComplexArray:
    v = np.asarray(values, np.complex128)
    if not np.isfinite(v[-1]) or v[-1] == 0.0:
        raise ValueError(f"budget at {frequency_hz:.6g} Hz: {part} is {v[-1]} there")
    return v


def _db(value: complex) -> float:
    return float(DB * np.log(abs(value)))


def loop_budget(loop: Loop, frequencies_hz: Sequence[float]) -> tuple[Budget, ...]:
    """Return the shares of law, filter, converter, delay, hold, gyro, actuator and the vehicle's build-up at each
    frequency.

    The computer's parts are those of the loop's kind: the paper's Pade approximants, or their exact factors. Law and
    filter of a sampled loop are the discrete ones. A last share, `sampling`, is the contribution of the images of the
    sampled spectrum (aliasing): the sampled path over the exact continuous one. Ideal instruments have no share.
    """
    fixed = loop.fixed
    if not fixed.takes_rate:
        raise ValueError(f"a budget needs the loop that is closed, not the cut {fixed.cut!r}")
    series = [
        ("law", lambda f: loop.controller(f) / loop.law.filter_response(f)),
        ("filter", loop.law.filter_response),
        *_computer(loop),
        *_instruments(fixed.node),
    ]
    steps = [(name, _vehicle(node)) for name, node in fixed.node.steps()]
    if loop.sample_s is not None:
        whole_path = [*_computer(loop), *_instruments(fixed.node), steps[-1]]

        def sampling(f: Array) -> ComplexArray:
            return np.asarray(fixed.response(f) / np.prod([part(f) for _, part in whole_path], axis=0))

        # multiplied by the bent vehicle it telescopes like a build-up step, with no phase of its own to unwrap
        bent = steps[-1][1]
        steps.append(("sampling", lambda f: np.asarray(bent(f) * sampling(f))))
    return tuple(split(loop.response, float(f), series, steps) for f in frequencies_hz)


def crossing_budgets(loop: Loop, measured: Margins) -> dict[str, Budget]:
    """Return budgets by name, at the rigid crossover and at the frequency of each margin of a stable loop."""
    if not measured.stable:
        return {}
    wanted = {
        "crossover": measured.crossover_hz,
        "phase margin": measured.phase_deg.frequency_hz,
        "delay margin": measured.delay_s.frequency_hz,
        "upper gain margin": measured.gain_up_db.frequency_hz,
        "lower gain margin": measured.gain_down_db.frequency_hz,
    }
    inside = {name: f for name, f in wanted.items() if 0.0 < f < np.inf}
    return dict(zip(inside, loop_budget(loop, list(inside.values())), strict=True))


def _computer(loop: Loop) -> list[tuple[str, Response]]:
    timing = loop.fixed.node.instruments
    if isinstance(loop.fixed, PadeFixedPath):
        named = {"converter": "V/F"}
        return [(named.get(part.name, part.name), _of_s(part.at)) for part in reversed(loop.fixed.computer)]
    return [
        ("V/F", _of_s(lambda s: average(s, timing.sample_s))),
        ("delay", _of_s(lambda s: np.exp(-timing.delay_s * s))),
        ("hold", _of_s(lambda s: average(s, timing.sample_s))),
    ]


def _instruments(node: OperatingPoint) -> list[tuple[str, Response]]:
    gyro, out = node.instruments.gyro, []
    if not gyro.ideal:
        out.append(("gyro", _of_s(lambda s: lag(s, gyro.omega_radps, gyro.zeta))))
    if not node.instruments.actuator.ideal:
        out.append(("actuator", _of_s(lambda s: actuator_response(node.actuator, s))))
    return out


def _vehicle(node: OperatingPoint) -> Response:
    """Return the response from the angle of the first drive's actuators to the local rate at the gyro, by all
    drives.
    """
    ideal = bool(node.instruments.actuator.ideal)
    inputs = tuple(name for name in node.plant.inputs if not ideal or name.startswith("delta_rad"))
    system = channels(node.plant, ("local_rate_radps",), inputs)
    resolvent = Resolvent(system.a, system.b, system.c)

    def response(s: ComplexArray) -> ComplexArray:
        first, *others = per_actuator_angle(s, resolvent(s)[..., 0, :], inputs)
        for turned, record in zip(others, node.actuators[1:], strict=True):
            beside = 1.0 if ideal else actuator_response(record, s) / actuator_response(node.actuator, s)
            first = np.asarray(first + turned * beside)
        return first

    return _of_s(response)


def _of_s(function: Callable[[ComplexArray], ComplexArray]) -> Response:
    return lambda f: np.asarray(function(2j * np.pi * np.asarray(f, float)), np.complex128)
