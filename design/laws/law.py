"""The interface of a control law to the linear tools: three protocols, one for each use of a law.

| protocol | represents | used by |
|---|---|---|
| `Controller` | the law at one instant in one plane: fixed gains, fixed filter | loops, margins, certificates |
| `DesignedLaw` | the law of a design file, over the whole flight | analyses and verification of a design |
| `LawVariables` | a family of laws as a vector of numbers, with gradients | the optimiser |

Each law has one module here and one in control/laws (its kernel). `registry.LAWS` lists the modules, and the `law` of a
design or of a case selects one. No other module of design/ depends on the choice of the law.

**Inputs.** The inputs of a law are named measurements, which a `FixedPath` provides (design/loop/fixed_path.py). Every
vehicle provides three: `angle_rad`, the measured attitude minus the commanded attitude; `rate_radps`, the mean rate
over a sample; and `angle_integral_rads`, the sum of the angle over the samples. Further gyros provide their mean rates
as `rate_2_radps` and so on. An accelerometer provides `accel_mps2`, the mean lateral specific force, positive in the
direction in which a positive command of the plane's model pushes the vehicle. From angle and acceleration, navigation
derives `drift_mps` and `drift_m`: the velocity and displacement of the accelerometer's station across the reference
trajectory (control/laws/drift.py). A law may use these measurements in any order.

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
from maxq.design.quantities import QUANTITIES, Quantity, Sense

MEASUREMENTS = ("angle_rad", "rate_radps", "angle_integral_rads")
ANGLES = MEASUREMENTS[::2]  # quantities derived from the angle
DRIFTS = ("drift_mps", "drift_m")  # quantities that navigation derives from the lateral acceleration and the angle


class Controller(Protocol):
    """A linear time-invariant law at one instant, from the measurements `inputs` to a gimbal command (rad).

    The argument `sample_s` of its methods is the period of the loop in s, or None for a continuous loop.
    """

    @property
    def inputs(self) -> tuple[str, ...]:
        """Return the names of the measurements that the law uses. A measurement with zero gain may be omitted."""

    @property
    def gains(self) -> Mapping[str, float]:
        """Return the gains in use by name, for reports."""

    def check(self, sample_s: float | None) -> None:
        """Check that the law is valid for a loop with the period `sample_s`. Raises ValueError otherwise."""

    def response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the response C, (..., inputs), at frequencies of shape (...).

        The frequencies s / (2 pi j) of a continuous law may be complex.
        """

    def filter_response(self, frequencies_hz: ArrayLike) -> ComplexArray:
        """Return the factor common to all inputs (the bending filter), in the shape of the frequencies.

        The factor is 1 without a filter.
        """

    def static_gain(self, name: str) -> float:
        """Return the gain of one input at zero frequency, or 0 for a measurement that the law does not use."""

    def poles(self) -> ComplexArray:
        """Return the poles of C, rad/s. A pole z of a discrete law is converted to log(z) / T."""

    def state_space(self) -> StateSpace:
        """Return the state space from `inputs` to `command_rad`. It is a discrete system if the law is discrete."""

    def scaled(self, factor: float) -> Controller:
        """Return the law with all its gains multiplied by `factor`."""


class DesignedLaw(Protocol):
    """The law of a design file, over the whole flight."""

    @property
    def over(self) -> Over:
        """Return the name of the quantity over which the gains are scheduled."""

    def at(self, at: float, plane: Plane, sample_s: float | None) -> Controller:
        """Return the law with the gains at a value of the scheduling quantity (`Node.scheduled`).

        The law is discrete with the flight computer's period `sample_s`, or continuous if it is None.
        """

    def continuous_at(self, at: float, plane: Plane, sample_s: float) -> Controller:
        """Return the continuous form of the law that `at` returns for the flight computer's period `sample_s`."""

    def tables(self) -> dict[str, Any]:
        """Return the law's tables in a design file: keys such as `gains` and `filter`."""

    def record(self) -> dict[str, Any]:
        """Return the tables of the law for reports, as columns of numbers."""


Axis = tuple[ComplexArray, ...]
"""Arrays (points,) that a law computes once per frequency. Each law defines their content (`LawVariables.axis`)."""


@dataclass(frozen=True)
class LogResponse:
    """The response C_i = exp(common) gains_i at a set of points.

    `common` (points,) and `gains` (points, inputs) are tuples of the value and its first and second derivatives with
    respect to x = ln f. A derivative of None is zero.
    """

    common: tuple[ComplexArray, ComplexArray, ComplexArray]
    gains: tuple[ComplexArray | Array, ComplexArray | None, ComplexArray | None]


@dataclass(frozen=True)
class LawLimit:
    """A limit that is independent of frequency.

    `linear` is True if the gradient with respect to the law's own parameters is constant. `objective` is True if the
    quantity is minimised rather than limited, with a `weight` in a `term` of the objective.
    """

    text: str
    unit: str
    linear: bool
    objective: bool = False
    term: int = 0
    weight: float = 1.0
    sense: Sense = "<="

    @staticmethod
    def of(about: Quantity, linear: bool, objective: bool = False, term: int = 0, weight: float = 1.0) -> LawLimit:
        return LawLimit(about.label, about.unit, linear, objective, term, weight, about.sense)

    @staticmethod
    def on(key: str, linear: bool) -> LawLimit:
        """Return the limit on the quantity with the given key."""
        return LawLimit.of(QUANTITIES[key], linear)


@dataclass(frozen=True)
class LimitValues:
    """The values of a law's limit `number` at some plants, (rows,), in the limit's unit, and the excess over the limit.

    A `plant` of -1 denotes the law as a whole. `gradient` (rows, own parameters) is the gradient of the excess. `index`
    identifies the rows of a plant, if it may have several.
    """

    number: int
    plant: IntArray
    value: Array
    limit: Array
    excess_db: Array
    gradient: Array
    index: IntArray | None = None


class LawVariables(Protocol):
    """A family of laws as a vector of variables, for all plants of a task.

    At one plant a law has `own` parameters, such as filter frequencies and logarithms of gains. They follow from the
    variables, for example from the gain schedules at the time of that plant. The optimiser differentiates with respect
    to the own parameters of a plant. `jacobian` and `bend` then apply the chain rule to the variables.

    The law must not add poles of L in the right half plane. Its only poles at zero must be those of the measurements
    and `poles_at_zero`. The count of unstable poles relies on both conditions.
    """

    @property
    def inputs(self) -> tuple[str, ...]:
        """Return the names of all measurements that the law may use, as in `Controller`."""

    @property
    def poles_at_zero(self) -> int:
        """Return the number of poles of C at s = 0 (z = 1)."""

    @property
    def limits(self) -> tuple[LawLimit, ...]:
        """Return the limits that the law itself imposes."""

    @property
    def lower(self) -> Array:
        """Return the lower bounds of the variables, (variables,)."""

    @property
    def upper(self) -> Array:
        """Return the upper bounds of the variables, (variables,)."""

    @property
    def own_size(self) -> int:
        """Return the number of own parameters."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the variables."""

    def own(self, variables: Array) -> Array:
        """Return the own parameters at each plant, (plants, own)."""

    def jacobian(self, variables: Array) -> Array:
        """Return the derivative of the own parameters with respect to the variables, (plants, own, variables)."""

    def bend(self, variables: Array, slopes: Array) -> Array:
        """Return the sum of the second derivatives of all own parameters, weighted with `slopes`.

        `slopes` has the shape (plants, own), and the result (variables, variables).
        """

    def axis(self, x: Array) -> Axis:
        """Return the arrays that `response` and `log_response` need at the points x = ln f, which may be complex."""

    def response(self, variables: Array, plant: IntArray, axis: Axis) -> tuple[ComplexArray, ComplexArray | Array]:
        """Return C at the points of a mesh, as a common factor (points,) and gains (points, inputs).

        `plant` (points,) contains the index of the plant of each point.
        """

    def log_response(self, own: Array, axis: Axis) -> LogResponse:
        """Return C and its derivatives with respect to x at points with the own parameters `own` (points, own)."""

    def gradient(self, own: Array, axis: Axis, weights: ComplexArray) -> ComplexArray:
        """Return the gradient of ln L with respect to the own parameters, (points, own).

        `weights` (points, inputs) are the ratios P_i / (sum of gains_k P_k) of each measurement.
        """

    def at_points(self, own: Array, axis: Axis) -> tuple[ComplexArray, ComplexArray | Array]:
        """Return C of one plant with the own parameters (own,), as a common factor (points,) and gains (points,
        inputs).
        """

    def limit_values(self, own: Array) -> list[LimitValues]:
        """Return the values of all active limits at the own parameters of each plant, (plants, own)."""

    def controllers(self, variables: Array) -> list[Controller]:
        """Return the law at each plant."""

    def designed(self, variables: Array) -> DesignedLaw:
        """Return the law of the design file that these variables represent."""

    def variables_of(self, law: DesignedLaw, clipped: bool = True) -> Array | None:
        """Return the variables of a given law, or None if the law has more freedom than this family.

        `clipped` moves values outside the bounds to the bounds.
        """

    def starts(self, count: int, seed: int) -> list[Array]:
        """Return the starting points of the search, most promising first."""

    def beside(self, variables: Array, lost: IntArray) -> Array | None:
        """Return the variables with the gains of the plants `lost` (indices) interpolated between the others.

        Returns None if every gain belongs to one of these plants.
        """

    def leap_size(self, number: int) -> Array:
        """Return the standard deviations of the variables for random step `number` away from an optimum.

        The standard deviations alternate between steps.
        """

    def simpler(self) -> tuple[LawVariables, Callable[[Array], Array]] | None:
        """Return a family with fewer variables for rough searches, and the conversion of its variables to these.

        Returns None if such a search is not worthwhile.
        """
