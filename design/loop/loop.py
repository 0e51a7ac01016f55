"""The interface of a loop for margins and plots, and the loop of a fixed path with a control law."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array
from maxq.design.laws.bending_filter import FASTEST
from maxq.design.laws.law import ANGLES, DRIFTS, Controller
from maxq.design.laws.registry import designed_law
from maxq.design.loop.fixed_path import Cut, ExactFixedPath, FixedPath, LoopKind, PadeFixedPath, fixed_path
from maxq.design.model.instruments import ACCELERATION
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.model.state_space import ComplexArray, StateSpace, chain, zeros_and_poles
from maxq.sim.scenario.schema_design import Design


class OpenLoop(Protocol):
    """A single loop opened at one point, with negative feedback. The poles of the closed loop satisfy 1 + L = 0.

    For a stable rigid body under PD control, L = (k_p / s + k_d) times the rest of the loop, with a positive sign.
    Poles are in rad/s; a pole z of a loop sampled with period T is converted to log(z) / T.
    """

    @property
    def highest_hz(self) -> float:
        """Return the highest frequency of the response: the Nyquist frequency, or infinity for a continuous loop."""

    def response(self, frequencies_hz: Array) -> ComplexArray:
        """Return L in the shape of `frequencies_hz`, each above 0 and at most `highest_hz`."""

    def open_poles(self) -> ComplexArray:
        """Return the poles of L, except those of pure delays."""

    def closed_poles(self) -> ComplexArray:
        """Return the zeros of 1 + L."""

    @property
    def sample_s(self) -> float | None:
        """Return the period of a sampled loop, s, or None for a continuous loop."""

    def factors(self) -> tuple[ComplexArray, ComplexArray] | None:
        """Return all zeros and all poles of L, in s or in z, or None if they are not known.

        With the factors, the search for crossings misses no pair.
        """


@dataclass(frozen=True)
class Loop:
    """The open loop L = sum of C_i P_i over the law's inputs (an `OpenLoop`).

    Raises ValueError if the sample periods of path and law differ, or if the path lacks a measurement that the law
    uses.
    """

    fixed: FixedPath
    law: Controller

    def __post_init__(self) -> None:
        self.law.check(self.fixed.sample_s)
        object.__setattr__(self, "fixed", self.fixed.with_inputs(self.law.inputs))

    @property
    def highest_hz(self) -> float:
        return self.fixed.highest_hz

    @property
    def sample_s(self) -> float | None:
        """Return the period of a sampled loop, s, or None for a continuous loop."""
        return self.fixed.sample_s

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return L in the shape of `frequencies_hz`, each above 0 and at most `highest_hz`."""
        f = np.asarray(frequencies_hz, float)
        return np.asarray(self.controller(f) * self.fixed.response(f))

    def controller(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the controller from mean rate to command, in the shape of `frequencies_hz`.

        It is L divided by the response of the fixed path.
        """
        f = np.asarray(frequencies_hz, float)
        law = self.law.response(f)
        parts = [law[..., i] * self.fixed.ratio(name, f) for i, name in enumerate(self.law.inputs)]
        return np.asarray(sum(parts, np.zeros(f.shape, np.complex128)))

    def open_poles(self) -> ComplexArray:
        """Return the poles of L, rad/s. A pole z of a sampled loop is converted to log(z) / T."""
        wanted, fixed = set(self.law.inputs), self.fixed
        at_zero = (
            bool(wanted & {*ANGLES, *DRIFTS}) and not fixed.rests_at_dc,
            "angle_integral_rads" in wanted,
            bool(wanted & set(DRIFTS)) and not fixed.drift_rests_at_dc,
            "drift_m" in wanted,
        )
        return np.concatenate([fixed.poles(), self.law.poles(), np.zeros(sum(at_zero), np.complex128)])

    def closed_poles(self) -> ComplexArray:
        """Return the zeros of 1 + L, rad/s, from the state matrix.

        A zero z of a sampled loop is converted to log(z) / T. The kind `exact` has infinitely many zeros. Newton's
        method finds them from the zeros of the Padé loop, up to twice the Nyquist frequency of the flight computer.
        """
        if isinstance(self.fixed, ExactFixedPath):
            return self._refined_poles(self.fixed)
        s = self.state_space()
        closed = s.a - 1.0 / (1.0 + float(s.d[0, 0])) * np.outer(s.b[:, 0], s.c[0])
        values = np.linalg.eigvals(closed).astype(np.complex128)
        if self.sample_s is None:
            return values
        return np.asarray(np.log(values[np.abs(values) > FASTEST]) / self.sample_s)

    def state_space(self) -> StateSpace:
        """Return L as a state space, from the gimbal command to the negative of the returned command.

        It is a discrete system for a sampled loop. Raises ValueError for the kind `exact`.
        """
        return self._state_space

    @cached_property
    def law_system(self) -> StateSpace:
        """Return the state space of the law, from its inputs to the command."""
        return self.law.state_space()

    @cached_property
    def _state_space(self) -> StateSpace:
        return chain(self.fixed.measured(self.law.inputs), self.law_system)

    def factors(self) -> tuple[ComplexArray, ComplexArray] | None:
        """Return the zeros and poles of L, in s or in z, or None for the kind `exact`, which is not rational."""
        if isinstance(self.fixed, ExactFixedPath):
            return None
        return zeros_and_poles(self.state_space())

    def to_state_space(self) -> Any:
        """Return L as a `control.StateSpace` of python-control, which must be installed.

        The `dt` of a sampled loop is its period. Raises ValueError for the kind `exact`.
        """
        import control  # noqa: PLC0415  # optional: nothing here needs it

        s = self.state_space()
        return control.StateSpace(s.a, s.b, s.c, s.d, self.sample_s or 0, states=list(s.states))

    def to_frd(self, frequencies_hz: ArrayLike) -> Any:
        """Return L at `frequencies_hz` as a `control.FRD` of python-control, which must be installed."""
        import control  # noqa: PLC0415  # optional: nothing here needs it

        f = np.atleast_1d(np.asarray(frequencies_hz, float))
        return control.FRD(self.response(f), 2.0 * np.pi * f, dt=self.sample_s or 0)

    def _refined_poles(self, exact: ExactFixedPath) -> ComplexArray:
        start, sample_s = (
            Loop(PadeFixedPath(exact.node, exact.cut), self.law).closed_poles(),
            exact.node.instruments.sample_s,
        )
        s = start[np.abs(start) * sample_s < 2.0 * np.pi]
        for _ in range(60):
            step = 1e-6 * (np.abs(s) + 1e-3)
            slope = (self._at(exact, s + step) - self._at(exact, s - step)) / (2.0 * step)
            move = (1.0 + self._at(exact, s)) / slope
            # limits each step to a tenth, so that neighbours do not converge to the same zero
            move *= np.minimum(1.0, 0.1 * (np.abs(s) + 1e-3) / np.maximum(np.abs(move), 1e-300))
            s = s - move
            if (np.abs(move) < 1e-12 * np.abs(s)).all():
                break
        s = s[np.abs(1.0 + self._at(exact, s)) < 1e-6]
        # removes duplicates found from different starts
        again = np.tril(np.abs(s[:, None] - s[None, :]) < 1e-7 * np.abs(s), -1).any(axis=1)
        return np.asarray(s[~again])

    def _at(self, exact: ExactFixedPath, s: ComplexArray) -> ComplexArray:
        ways = {name: exact.plant_at(s, k) for k, (name, _, _) in enumerate(exact.sensors, 1)}
        computer, rate = exact.computer_at(s), exact.plant_at(s)
        for name, _, samples in exact.sensors:
            ways[name] = ways[name] * np.exp(-s * samples * exact.node.instruments.sample_s)
        ways |= {"rate_radps": rate if exact.takes_rate else 0.0 * rate}
        ways |= {name: rate / s ** (1 + k) for k, name in enumerate(ANGLES)}
        if ACCELERATION in ways:
            across = ways[ACCELERATION] - exact.node.axial_load_mps2 * ways["angle_rad"]
            ways |= {name: across / s ** (1 + k) for k, name in enumerate(DRIFTS)}
        law = self.law.response(s / 2j / np.pi) * np.stack([ways[name] for name in self.law.inputs], axis=-1)
        return np.asarray(law.sum(axis=-1) * computer)


def law_at(design: Design, node: OperatingPoint, kind: LoopKind = "sampled") -> Controller:
    """Return the design's law at an operating point and in its plane.

    The law is sampled for `kind` "sampled" and continuous otherwise.
    """
    law = designed_law(design.of_stage(node.stage))
    form = law.at if kind == "sampled" else law.continuous_at
    return form(node.scheduled(law.over), node.plane, node.instruments.sample_s)


def close_loop(path: FixedPath, design: Design) -> Loop:
    """Return the loop of a fixed path and the design's law at the operating point of that path."""
    return Loop(path, law_at(design, path.node, path.kind))


def loops(
    where: Iterable[OperatingPoint], design: Design, *, kind: LoopKind = "sampled", cut: Cut = "gimbal_command"
) -> list[Loop]:
    """Return the loop of a design at each operating point, opened at `cut`.

    `kind` is `sampled` (as in the flight computer), `pade` (continuous, with the paper's approximations) or `exact`
    (continuous, with exact factors and no aliasing).
    """
    return [close_loop(fixed_path(node, kind, cut), design) for node in where]
