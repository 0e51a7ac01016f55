"""The quantities of a loop that can be limited, each defined once with its key for all files.

`QUANTITIES` is the table. The sections below define the keys of case, design file and suite. The assessment of designs,
the margin sweep, the reports and the optimiser (`optimise.criteria`, by key) take label, unit, sense and value from the
table. A quantity that does not exist in a loop, such as the peak of an absent mode, is infinite on the favourable side
and meets every limit. NaN denotes a margin of an unstable loop, which meets no limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Protocol

from pydantic import Field

from maxq.sim.input.values import Positive, PositiveOverTime, Section, optional

Sense = Literal[">=", "<="]
RigidBody = Literal["paper", "aerodynamic"]
ZoneName = Literal["none", "ellipse", "diamond", "rectangle"]
Degrees = Annotated[float, Field(gt=0.0, le=90.0)]
Negative = Annotated[float, Field(lt=0.0)]
LAST_MODE = 999
"""An upper bound for the number of a bending mode."""
TOLERANCE = 5e-4
"""The tolerance of a limit in dB and deg, far above the effect of rounded digits in a file."""


@dataclass(frozen=True)
class Convention:
    """The conventions by which quantities of a loop are evaluated."""

    rigid_body: RigidBody = "paper"
    slosh_peak_db: float = -6.0


class MeasuredLoop(Protocol):
    """A loop at an operating point (`margins.measured_loop.LoopAtPoint`)."""

    @property
    def margins(self) -> Any:
        """Return the `margins.measure.Margins` of the loop."""

    def mode_peak_db(self, first: int, last: int) -> float:
        """Return the largest peak of the bending modes `first` to `last`, or -inf if there is none."""

    def mode_phase_deg(self, mode: int) -> float:
        """Return the phase margin of a mode's lobe, or inf if the mode is gain-stabilised or absent."""

    def slosh_phase_deg(self, peak_db: float) -> float:
        """Return the least phase margin of slosh lobes with a peak above `peak_db`, or inf without such a lobe."""

    def rigid(self, body: RigidBody) -> tuple[float, float]:
        """Return the frequency (Hz) and damping ratio of the rigid body's motion."""

    @property
    def integral_hz(self) -> float:
        """Return the corner frequency of the law's integral, Hz."""


@dataclass(frozen=True)
class Quantity:
    """A quantity that can be limited.

    `value` evaluates it from a measured loop, or is None if the loop alone is not sufficient. `heading` is its column
    heading. `sense` is ">=" for a lower and "<=" for an upper limit.
    """

    label: str
    heading: str
    unit: str
    sense: Sense
    value: Callable[[MeasuredLoop, Convention], float] | None = None

    def violation(self, value: Any, limit: Any) -> Any:
        """Return the amount by which a value misses a limit, minus the tolerance (see the function `violation`)."""
        return violation(value, limit, self.sense, self.unit)

    def badness(self, value: float) -> float:
        """Return the value with a sign such that larger is worse."""
        return value if self.sense == "<=" else -value


def violation(value: Any, limit: Any, sense: str, unit: str) -> Any:
    """Return the amount by which a value misses a limit, minus the tolerance. The limit is met at 0 or less.

    `value` and `limit` are numbers or arrays in `unit`, and `sense` is "<=" or ">=". The tolerance is TOLERANCE in dB
    and deg, and 1e-4 of the limit in other units. It is necessary because the search places values on limits. NaN
    remains NaN. simdesign and simverify both use this function.
    """
    tolerance = TOLERANCE if unit in ("dB", "deg") else 1e-4 * abs(limit)
    return (value - limit if sense == "<=" else limit - value) - tolerance


def _in_db(ratio: float) -> float:
    return 20.0 * math.log10(ratio) if ratio > 0.0 else -math.inf if ratio == 0.0 else math.nan


class CommonLimits(Section):
    """The limits that cases, design files and suites can set. An absent key sets no limit."""

    gain_margin_db: Annotated[
        Positive | None, Quantity("gain margin", "gain dB", "dB", ">=", lambda j, _: j.margins.gain_db)
    ] = optional("smaller of the upper and lower gain margins, dB")
    phase_margin_deg: Annotated[
        Degrees | None, Quantity("phase margin", "phase deg", "deg", ">=", lambda j, _: j.margins.phase_deg.value)
    ] = optional("phase margin over all crossings, deg")
    modulus_db: Annotated[
        Negative | None, Quantity("modulus margin", "|1+L| dB", "dB", ">=", lambda j, _: _in_db(j.margins.modulus))
    ] = optional("modulus margin: least |1 + L|, dB")
    first_mode_db: Annotated[
        float | None, Quantity("peak of mode 1", "mode 1 dB", "dB", "<=", lambda j, _: j.mode_peak_db(1, 1))
    ] = optional("peak of mode 1, dB: the largest |L| at its frequency, the mode's share only")
    second_mode_db: Annotated[
        float | None, Quantity("peak of mode 2", "mode 2 dB", "dB", "<=", lambda j, _: j.mode_peak_db(2, 2))
    ] = optional("peak of mode 2, dB; likewise")
    modes_from_2_db: Annotated[
        float | None,
        Quantity("peak of modes 2 and above", "modes 2+ dB", "dB", "<=", lambda j, _: j.mode_peak_db(2, LAST_MODE)),
    ] = optional("largest peak of modes 2 and above, dB; likewise")
    modes_from_3_db: Annotated[
        float | None,
        Quantity("peak of modes 3 and above", "modes 3+ dB", "dB", "<=", lambda j, _: j.mode_peak_db(3, LAST_MODE)),
    ] = optional("largest peak of modes 3 and above, dB; likewise")
    first_mode_phase_deg: Annotated[
        Degrees | None, Quantity("phase margin at mode 1", "mode 1 deg", "deg", ">=", lambda j, _: j.mode_phase_deg(1))
    ] = optional("phase margin at the crossings of 0 dB by mode 1, deg")
    rigid_hz: Annotated[
        PositiveOverTime | None,
        Quantity("rigid-body frequency", "rigid Hz", "Hz", ">=", lambda j, by: j.rigid(by.rigid_body)[0]),
    ] = optional("frequency of the rigid-body motion, Hz; or a table {time_s, value} over the vehicle clock")
    rigid_zeta: Annotated[
        PositiveOverTime | None,
        Quantity("rigid-body damping ratio", "rigid zeta", "", ">=", lambda j, by: j.rigid(by.rigid_body)[1]),
    ] = optional("damping ratio of the rigid-body motion; likewise")


class LoopLimits(CommonLimits):
    """The limits of a suite on the margins of a loop. An absent key sets no limit."""

    renamed: ClassVar[dict[str, str]] = {
        "aero_gain_db": "gain_down_db", "phase_deg": "rigid_phase_deg", "higher_modes_db": "modes_from_2_db",
    }  # fmt: skip  # a table

    gain_up_db: Annotated[
        Positive | None,
        Quantity("upper gain margin", "gain up dB", "dB", ">=", lambda j, _: j.margins.gain_up_db.value),
    ] = optional("upper gain margin: gain increase to the stability limit, dB")
    gain_down_db: Annotated[
        Positive | None,
        Quantity("lower gain margin", "gain down dB", "dB", ">=", lambda j, _: j.margins.gain_down_db.value),
    ] = optional("lower gain margin: gain decrease to the stability limit, including the aerodynamic one, dB")
    rigid_phase_deg: Annotated[
        Degrees | None,
        Quantity("phase margin, rigid body", "rigid deg", "deg", ">=", lambda j, _: j.margins.rigid_phase_deg.value),
    ] = optional("phase margin at the crossings outside bending lobes, deg")
    delay_ms: Annotated[
        Positive | None, Quantity("delay margin", "delay ms", "ms", ">=", lambda j, _: 1e3 * j.margins.delay_s.value)
    ] = optional("delay margin over all crossings, ms")
    slosh_phase_deg: Annotated[
        Degrees | None,
        Quantity("phase margin of slosh", "slosh deg", "deg", ">=", lambda j, by: j.slosh_phase_deg(by.slosh_peak_db)),
    ] = optional("phase margin of slosh lobes with a peak above slosh_peak_db, deg")
    slosh_peak_db: float = optional("peak below which slosh needs no phase margin, dB", -6.0)
    rigid_body: RigidBody = optional(
        "rigid_hz and rigid_zeta by eqs 35 and 36 of the paper, or including M_alpha and M_q", "paper"
    )


def _declared(section: type[Section]) -> dict[str, Quantity]:
    """Return the quantities in the annotations of a section's fields, by key."""
    found = {key: [m for m in about.metadata if isinstance(m, Quantity)] for key, about in section.model_fields.items()}
    return {key: marks[0] for key, marks in found.items() if marks}


def _integral_hz(loop: MeasuredLoop, _: Convention) -> float:
    return loop.integral_hz


MEASURED = _declared(LoopLimits)
"""The quantities that follow from the margins of a loop, by key, in the order of reports."""
SWEPT = (
    "gain_up_db",
    "gain_down_db",
    "rigid_phase_deg",
    "delay_ms",
    "slosh_phase_deg",
    "first_mode_phase_deg",
    "modes_from_2_db",
)
"""The quantities of dispersed vehicles, which are fields of `margins.many.MEASURES` (with the delay in s)."""
QUANTITIES: dict[str, Quantity] = MEASURED | {
    "unstable_poles": Quantity("unstable poles", "unstable", "", "<="),
    "zone": Quantity("Nichols zone", "zone", "", ">="),
    "filter_gain_at_infinity": Quantity("|F(j inf)|", "|F(j inf)|", "", "<="),
    "filter_motion": Quantity("change of L by filter motion, of |1 + L|", "motion %", "%", "<="),
    "integral_hz": Quantity("least corner of the integral", "integral Hz", "Hz", ">=", _integral_hz),
    "most_integral_hz": Quantity("largest corner of the integral", "integral Hz", "Hz", "<=", _integral_hz),
    "q_alpha_Padeg": Quantity("load q alpha in wind, rms", "q alpha", "Pa deg", "<="),
    "drift_mps": Quantity("drift in wind, rms", "drift", "m/s", "<="),
    "bending_moment": Quantity("bending moment in wind, rms", "M", "N m", "<="),
}
"""All quantities, including those of the filter, the law and the wind."""
STEPS: dict[str, Quantity] = {
    "overshoot_pct": Quantity("overshoot after an attitude step", "overshoot %", "%", "<="),
    "settling_pct": Quantity("deviation after the settling time", "settled %", "%", "<="),
    "gimbal_peak": Quantity("largest gimbal command per attitude step", "gimbal peak", "", "<="),
    "offset_peak": Quantity("largest attitude per gimbal offset", "offset peak", "", "<="),
}
"""The quantities of step responses, which goals can limit."""
