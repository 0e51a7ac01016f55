"""What a control law is to the linear tools: three protocols, one for each thing that is done with a law.

| protocol | stands for | used by |
|---|---|---|
| `Controller` | the law at one instant in one plane: fixed gains, fixed filter | loops, margins, certificates |
| `DesignedLaw` | the law of a design file, over the whole flight | everything that judges a design |
| `LawVariables` | a family of laws as a vector of numbers, with gradients | the optimiser |

A law lives in one module here and one in control/laws (its kernel); `registry.LAWS` lists the modules, and the `law` of
a design or of a case chooses. Nothing else in design/ depends on which law it is.

**Inputs.** A law works on measurements, by name: those that a `FixedPath` offers (design/loop/fixed_path.py). Today
these are `angle_rad`, the counted attitude less the commanded one, and `rate_radps`, the mean rate over a sample. A law
may take any of them, in any order.

**Sign.** C is positive for negative feedback: the gimbal command is -C times the measurements, and L = sum of C_i P_i.

**Outputs.** A loop is opened at one command, so a `Controller` gives one output: a law with several (gimbals in pitch
and yaw, engines) gives a controller for each plane or engine that is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from numpy.typing import ArrayLike

from maxq.design.model.state_space import ComplexArray, StateSpace
from maxq.design.model.vehicle_at import Plane


class Controller(Protocol):
    """A law at one instant, from the measurements `inputs` to a gimbal command (rad); linear and time-invariant.

    `sample_s` arguments are the loop's period, None for a continuous loop.
    """

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the measurements that it takes, without those whose gain is zero."""
        ...

    @property
    def gains(self) -> Mapping[str, float]:
        """Gains in use by name, for reports."""
        ...

    def check(self, sample_s: float | None) -> None:
        """Raises ValueError where the law is not one for a loop of this period."""
        ...

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """C, (..., inputs) for frequencies of shape (...)."""
        ...

    def filter_response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """The factor that all inputs have in common (bending filter), same shape as the frequencies; 1 without one."""
        ...

    def at(self, s: ComplexArray) -> ComplexArray:
        """Of a continuous law: C at complex s (rad/s), (..., inputs)."""
        ...

    def static_gain(self, name: str) -> float:
        """C at zero frequency of one input; 0 for one that it does not take."""
        ...

    def poles(self) -> ComplexArray:
        """Poles of C, rad/s; those of a discrete law at z are log(z) / T."""
        ...

    def state_space(self) -> StateSpace:
        """From `inputs` to `command_rad`; in z for a discrete law."""
        ...

    def scaled(self, factor: float) -> Controller:
        """The same law with all its gains times a factor."""
        ...


class DesignedLaw(Protocol):
    """The law of a design file."""

    def at(self, time_s: float, plane: Plane, sample_s: float | None) -> Controller:
        """The law at a vehicle time: as the flight computer runs it at the period, or continuous for None."""
        ...
