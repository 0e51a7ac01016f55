"""What margins and plots ask of a loop, whichever way it was made."""

from __future__ import annotations

from typing import Protocol

from maxq.control.kernel.records import Array
from maxq.design.model.state_space import ComplexArray


class OpenLoop(Protocol):
    """A single loop opened at one point, with negative feedback: it closes on 1 + L = 0.

    L has positive sign: a stable rigid body under PD control has L = (k_p / s + k_d) times the rest. Poles are in
    rad/s; those of a sampled loop at z are log(z) / T.
    """

    @property
    def highest_hz(self) -> float:
        """Where the response ends: the Nyquist frequency of a sampled loop, infinity of a continuous one."""

    def response(self, frequencies_hz: Array) -> ComplexArray:
        """L, same shape as `frequencies_hz` (each above 0 and at most `highest_hz`)."""

    def open_poles(self) -> ComplexArray:
        """Poles of L, those that a pure delay has left out."""

    def closed_poles(self) -> ComplexArray:
        """Zeros of 1 + L."""

    @property
    def sample_s(self) -> float | None:
        """Period of a sampled loop."""

    def factors(self) -> tuple[ComplexArray, ComplexArray] | None:
        """All zeros and all poles of L, in s or in z, by which no pair of crossings is missed; None: not known."""
