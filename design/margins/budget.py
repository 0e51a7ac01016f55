"""The margin budget: the gain and phase of each part of a loop at one frequency, which add up to the whole loop.

Parts in series multiply, so their decibels and degrees add. Aerodynamics, slosh, engine inertia and bending are not in
series but interact. They are added one after the other in a stated order of build-up steps. The share of each step is
the ratio of L with the part to L without it, with all earlier parts present and all later parts absent. The product of
these ratios is L in any order. The order determines the part to which an interaction of two parts is attributed.
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

_PATH = 400  # points for unwrapping a phase, from _DECADES below the frequency
_DECADES = 4.0


@dataclass(frozen=True)
class Share:
    """The share of one part. Negative degrees are lag.

    The phase of a part in series is unwrapped from low frequency (a delay may exceed 180 deg). The phase of a build-up
    step is within +-180 deg.
    """

    part: str
    gain_db: float
    phase_deg: float


@dataclass(frozen=True)
class Budget:
    """The budget at one frequency.

    `left_db` and `left_deg` are the difference between L and the sum of the shares, due to rounding.
    """

    frequency_hz: float
    shares: tuple[Share, ...]
    left_db: float
    left_deg: float

    @property
    def gain_db(self) -> float:
        """Return the sum of the gains, which is |L|, dB."""
        return float(sum(share.gain_db for share in self.shares))

    @property
    def phase_deg(self) -> float:
        """Return the sum of the phases, deg, which is the phase of L up to multiples of 360 deg."""
        return float(sum(share.phase_deg for share in self.shares))

    @property
    def phase_margin_deg(self) -> float:
        """Return the difference between the sum of the phases and the nearest -180 + 360 k degrees, in [-180, 180)."""
        return wrapped(self.phase_deg + 180.0, 180.0)


def split(
    whole: Response,
    frequencies_hz: Sequence[float],
    series: Sequence[tuple[str, Response]],
    steps: Sequence[tuple[str, Response]] = (),
) -> tuple[Budget, ...]:
    """Return the budgets of `whole`, the product of `series` and of the last response of `steps`, at each frequency.

    Each step is the response with its part and all earlier parts present. Raises ValueError if a part is zero or not
    finite at a frequency.
    """
    here = np.array(frequencies_hz, float)
    if not len(here):
        return ()
    path = here[:, None] * 10.0 ** np.linspace(-_DECADES, 0.0, _PATH)
    shares: list[list[Share]] = [[] for _ in here]
    for part, response in series:
        values = np.asarray(response(path), np.complex128)
        turned = np.degrees(np.unwrap(np.angle(values))[:, -1])
        for k, value in enumerate(_checked(part, values[:, -1], here)):
            shares[k].append(Share(part, _db(value), float(turned[k])))
    before = np.ones(len(here), np.complex128)
    for part, response in steps:
        with_it = _checked(part, response(here), here)
        for k, value in enumerate((with_it / before).tolist()):
            shares[k].append(Share(part, _db(value), float(np.degrees(np.angle(value)))))
        before = with_it
    out = []
    for hz, mine, value in zip(here.tolist(), shares, _checked("the whole", whole(here), here).tolist(), strict=True):
        found = Budget(hz, tuple(mine), 0.0, 0.0)
        left_deg = wrapped(float(np.degrees(np.angle(value))) - found.phase_deg, 180.0)
        out.append(Budget(hz, found.shares, _db(value) - found.gain_db, left_deg))
    return tuple(out)


def _checked(part: str, values: ComplexArray, frequencies_hz: Array) -> ComplexArray:
    found = np.asarray(values, np.complex128)
    for value, hz in zip(found.tolist(), frequencies_hz.tolist(), strict=True):
        if not np.isfinite(value) or value == 0.0:
            raise ValueError(f"budget at {hz:.6g} Hz: {part} is {value} there")
    return found


def _db(value: complex) -> float:
    return float(DB * np.log(abs(value)))


def loop_budget(loop: Loop, frequencies_hz: Sequence[float]) -> tuple[Budget, ...]:
    """Return the budget of a loop at each frequency.

    The shares are those of law, filter, converter, delay, hold, gyro, actuator and the build-up of the vehicle. The
    parts of the flight computer are those of the loop's kind: the paper's Padé approximants or the exact factors. Law
    and filter of a sampled loop are discrete. The last share of a sampled loop, `sampling`, is the contribution of
    aliasing: the ratio of the sampled path to the exact continuous path. Ideal instruments have no share. Raises
    ValueError for a loop that is not opened at the gimbal command.
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

        # as a build-up step on the flexible vehicle, it needs no unwrapped phase
        bent = steps[-1][1]
        steps.append(("sampling", lambda f: np.asarray(bent(f) * sampling(f))))
    return split(loop.response, frequencies_hz, series, steps)


def crossing_budgets(loop: Loop, measured: Margins) -> dict[str, Budget]:
    """Return the budgets at the rigid crossover and at the frequency of each margin, by name.

    An unstable loop has none.
    """
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
    """Return the response from the first drive's actuator angle to the local rate at the gyro, through all drives."""
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
