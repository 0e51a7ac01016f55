"""The interface of a control law to the linear tools: three protocols, one for each use of a law.

| protocol | stands for | used by |
|---|---|---|
| `Controller` | the law at one instant in one plane: fixed gains, fixed filter | loops, margins, certificates |
| `DesignedLaw` | the law of a design file, over the whole flight | everything that judges a design |
| `LawVariables` | a family of laws as a vector of numbers, with gradients | the optimiser |

Each law has one module here and one in control/laws (its kernel). `registry.LAWS` lists the modules, and the `law` of a
design or of a case selects one. No other module of design/ depends on the choice of the law.

**Inputs.** A law has named measurements as its inputs, which a `FixedPath` provides (design/loop/fixed_path.py).
Available are `angle_rad`, the counted attitude less the commanded one, `rate_radps`, the mean rate over a sample, and
`angle_integral_rads`, the sum of the angle over the samples. A vehicle with further sensors also provides
`rate_2_radps` and so on, the mean rates of further gyros, and `accel_mps2`. The latter is the mean lateral specific
force at the accelerometer, positive in the direction of the push of a positive command of the plane's model. From both,
navigation obtains `drift_mps` and `drift_m`, the velocity and the displacement of the accelerometer's station across
the reference trajectory (control/laws/drift.py). A law may use any of these, in any order.

**Sign.** C is positive for negative feedback: the gimbal command is -C times the measurements, and L = sum of C_i P_i.

**Outputs.** A loop is opened at one command, so a `Controller` has one output. A law with several outputs (gimbals in
pitch and yaw, engines) returns a controller for each plane or engine requested.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array, IntArray
from maxq.control.structures import Over
from maxq.design.model.instruments import Plane
from maxq.design.model.state_space import ComplexArray, StateSpace
from maxq.design.quantities import QUANTITIES, Quantity

MEASUREMENTS = ("angle_rad", "rate_radps", "angle_integral_rads")
ANGLES = MEASUREMENTS[::2]  # quantities derived from the angle
DRIFTS = ("drift_mps", "drift_m")  # quantities that navigation derives from the lateral acceleration and the angle


class Controller(Protocol):
    """A law at one instant, from the measurements `inputs` to a gimbal command (rad).

    The law is linear and time-invariant.

    The arguments `sample_s` are the period of the loop, or None for a continuous loop.
    """

    @property
    def inputs(self) -> tuple[str, ...]:
        """Return the names of the measurements that the law uses, without those whose gain is zero."""

    @property
    def gains(self) -> Mapping[str, float]:
        """Return the gains in use by name, for reports."""

    def check(self, sample_s: float | None) -> None:
        """Check the sample period. Raises ValueError if the law is not valid for a loop of this period."""

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return C, (..., inputs), for frequencies of shape (...).

        For a continuous law, the frequencies s / (2 pi j) may be complex.
        """

    def filter_response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the factor that all inputs have in common (bending filter), in the shape of the frequencies, or 1
        without a filter.
        """

    def static_gain(self, name: str) -> float:
        """Return C at zero frequency of one input, or 0 for a measurement that the law does not use."""

    def poles(self) -> ComplexArray:
        """Return the poles of C, rad/s. The poles of a discrete law at z are log(z) / T."""

    def state_space(self) -> StateSpace:
        """Return the state space from `inputs` to `command_rad`, in z for a discrete law."""

    def scaled(self, factor: float) -> Controller:
        """Return the same law with all its gains multiplied by a factor."""


class DesignedLaw(Protocol):
    """The law of a design file."""

    @property
    def over(self) -> Over:
        """Return the quantity over which its gains are scheduled."""

    def at(self, at: float, plane: Plane, sample_s: float | None) -> Controller:
        """Return the law with the gains at a value of `over`, such as a vehicle time (`Node.scheduled`).

        The law is discrete at the given period of the flight computer, or continuous for None.
        """

    def tables(self) -> dict[str, Any]:
        """Return the law's tables in a design file: keys such as `gains` and `filter`."""

    def record(self) -> dict[str, Any]:
        """Return the tables for reports, as columns of numbers."""


Axis = tuple[ComplexArray, ...]
"""The data that a law needs of frequencies, in arrays (points,). The law chooses its content (`LawVariables.axis`)."""


@dataclass(frozen=True)
class LogResponse:
    """The response C_i = exp(common) gains_i at points.

    `common` (points,) and `gains` (points, inputs) each include the first and second derivatives by x = ln f. None
    means zero.
    """

    common: tuple[ComplexArray, ComplexArray, ComplexArray]
    gains: tuple[ComplexArray | Array, ComplexArray | None, ComplexArray | None]


@dataclass(frozen=True)
class LawLimit:
    """A limit that is independent of frequency.

    `linear` is True if its gradient by the law's own parameters is constant.

    `objective` is True if the quantity is minimised instead.
    """

    text: str
    unit: str
    linear: bool
    objective: bool = False

    @staticmethod
    def of(about: Quantity, linear: bool, objective: bool = False) -> LawLimit:
        return LawLimit(about.label, about.unit, linear, objective)

    @staticmethod
    def on(key: str, linear: bool) -> LawLimit:
        """Return the limit on the quantity of a key."""
        return LawLimit.of(QUANTITIES[key], linear)


@dataclass(frozen=True)
class LimitValues:
    """The values of limit number `number` of a law at some plants, (rows,), in the limit's own unit, and the excess
    over the limit.

    `plant` -1 denotes the law itself. `gradient` (rows, own parameters) is that of the excess.
    """

    number: int
    plant: IntArray
    value: Array
    limit: Array
    excess_db: Array
    gradient: Array


class LawVariables(Protocol):
    """A family of laws as a vector of variables, for all plants of a task.

    At one plant a law has `own` parameters, such as filter frequencies and logarithms of gains. They follow from the
    variables (the gain schedules at that plant's time). The optimiser differentiates with respect to the own parameters
    of a plant, then applies the chain rule to the variables with `jacobian` and `bend`.

    The law must not add poles of L in the right half plane. Its only poles at zero must be those of the measurements
    and `poles_at_zero`. The count of unstable poles relies on both conditions.
    """

    @property
    def inputs(self) -> tuple[str, ...]:
        """Return the names of all measurements, as in `Controller`."""

    @property
    def poles_at_zero(self) -> int:
        """Return the number of poles of C at s = 0 (z = 1)."""

    @property
    def limits(self) -> tuple[LawLimit, ...]:
        """Return the limits that the law itself defines."""

    @property
    def lower(self) -> Array:
        """Return the lower bounds of the variables."""

    @property
    def upper(self) -> Array:
        """Return the upper bounds of the variables."""

    @property
    def own_size(self) -> int:
        """Return the number of own parameters."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the variables."""

    def own(self, variables: Array) -> Array:
        """Return the own parameters of each plant, (plants, own)."""

    def jacobian(self, variables: Array) -> Array:
        """Return d own / d variables, (plants, own, variables)."""

    def bend(self, variables: Array, slopes: Array) -> Array:
        """Return the sum of the second derivatives of all own parameters, weighted with `slopes` (plants, own), (size,
        size).
        """

    def axis(self, x: Array) -> Axis:
        """Return the precomputed values that `response` and `log_response` need at points x = ln f."""

    def response(self, variables: Array, plant: IntArray, axis: Axis) -> tuple[ComplexArray, ComplexArray | Array]:
        """Return C on a mesh, as a common factor (points,) and gains (points, inputs).

        `plant` is the plant of each point.
        """

    def log_response(self, own: Array, axis: Axis) -> LogResponse:
        """Return C at points with the parameters `own` (points, own), with derivatives."""

    def gradient(self, own: Array, axis: Axis, weights: ComplexArray) -> ComplexArray:
        """Return d ln L / d own, (points, own).

        `weights` (points, inputs) are the ratios of measurement i to the sum of gains_k P_k.
        """

    def limit_values(self, own: Array) -> list[LimitValues]:
        """Return the values of all limits that are set, at own parameters (plants, own)."""

    def controllers(self, variables: Array) -> list[Controller]:
        """Return the law at each plant."""

    def designed(self, variables: Array) -> DesignedLaw:
        """Return the law of the design file that these variables represent."""

    def variables_of(self, law: DesignedLaw) -> Array | None:
        """Return the variables of a law that was designed with at most the same freedom, or None if it does not fit."""

    def starts(self, count: int, seed: int) -> list[Array]:
        """Return the starting points of the search, the most promising first."""

    def beside(self, variables: Array, lost: IntArray) -> Array | None:
        """Return the variables with the gains of the plants number `lost` interpolated between those of the others.

        Returns None if every gain belongs to one of the removed plants.
        """

    def leap_size(self, number: int) -> Array:
        """Return the standard deviations of the variables for a random step away from an optimum.

        The sizes vary from step to step.
        """

    def simpler(self) -> tuple[LawVariables, Callable[[Array], Array]] | None:
        """Return laws of fewer variables for rough searches and the conversion of their variables, or None if such a
        search is not worthwhile.
        """
