"""The sections of a control design: gains, filters, roll control and adaptation."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from maxq.control.kernel.limits import MAX_SENSORS, MAX_STAGES
from maxq.control.structures import (
    GAIN_NAMES,
    GAINS,
    INTEGRAL,
    MAX_SECTIONS,
    OVER,
    OWN,
    RELIEF,
    STRUCTURES,
    Law,
    Over,
    Structure,
)
from maxq.sim.input.errors import refuse
from maxq.sim.input.tables_csv import LEAST_STEP, Columns, CsvTable
from maxq.sim.input.values import NotNegative, Positive, Section, optional
from maxq.sim.scenario.flight_code import PlugIn

if TYPE_CHECKING:
    from maxq.control.filter_schedule import FilterSchedule
    from maxq.control.filters import BendingFilter

GAIN_COLUMNS = Columns(
    "time_s",
    sets=(("k_p", "k_d_s"),),
    optional=GAIN_NAMES[2:],
    not_negative=GAIN_NAMES[:5],
    other_axes=OVER[1:],
    own=OWN,
)
LAW_TEXT = (
    "control law; pd: proportional-derivative with a bending filter; pid: pd with an integral; load-relief: pd "
    "with feedback of lateral acceleration; incidence-relief: pd with feedback of an estimated angle of attack; "
    "drift: pd with feedback of velocity and displacement across the path; pid-drift: drift with an integral; own: "
    "that of plug_in"
)
PLUG_IN_TEXT = "law own: Python file and the law in it, file.py:Law"


class GainsSection(Section):
    """The gains of the law (PD: paper, eq. 33), linear between rows; outside the table, the end values hold."""

    table: Annotated[CsvTable, GAIN_COLUMNS] = Field(
        description="k_p (rad/rad), k_d_s (s); pid: k_i_ps (1/s); load-relief: k_a_s2pm (rad per m/s2); "
        "incidence-relief: k_alpha (rad/rad) and the vehicle's percussion_m and accel_per_incidence_mps2; drift, "
        "pid-drift: k_zd_radspm (rad per m/s) and k_z_radpm (rad per m), positive against the drift; own: in their "
        "place, own_NAME for each variable NAME of the law. Over time_s (vehicle clock) or one of speed_mps (relative "
        "to the rotating Earth), mass_kg, dynamic_pressure_Pa (of that speed in still air), which the computer "
        "receives without error"
    )
    yaw: Literal["pitch"] | None = optional("gains as in pitch (the default without yaw_table)")
    yaw_table: Annotated[CsvTable, GAIN_COLUMNS] | None = optional("gains of the yaw axis")
    integral_limit_deg: Positive | None = optional(
        "pid, pid-drift: limit of the integral part of the command, deg (default: none)"
    )

    def _check(self) -> None:
        if self.yaw is not None and self.yaw_table is not None:
            raise refuse("cannot be combined with yaw", "one of yaw, yaw_table", "yaw_table", value={})
        if self.yaw_table is not None and GAIN_COLUMNS.axis_of(self.yaw_table) != self.over:
            raise self.yaw_table.refusal("is not over what pitch is over", f"a column {self.over}", at=("yaw_table",))

    @property
    def over(self) -> Over:
        """Return the quantity over which the gains are scheduled."""
        over: Over = GAIN_COLUMNS.axis_of(self.table)  # type: ignore[assignment]  # a column that the table may have
        return over

    @property
    def axes(self) -> tuple[CsvTable, CsvTable]:
        """Return the tables of the pitch and the yaw axis."""
        return self.table, self.yaw_table or self.table


class Quadratic(Section):
    """The quadratic section (s^2/wz^2 + 2 zz s/wz + 1) / (s^2/wp^2 + 2 zp s/wp + 1)."""

    zero_hz: Positive = Field(description="frequency of the zeros, Hz")
    zero_zeta: float = Field(description="damping ratio of the zeros (negative: right half plane)")
    pole_hz: float = Field(description="frequency of the poles, Hz")
    pole_zeta: float = Field(description="damping ratio of the poles")

    def _check(self) -> None:
        for key in ("pole_hz", "pole_zeta"):
            if getattr(self, key) <= 0.0:
                raise refuse("makes an unstable pole", "a number > 0", key)


class FirstOrder(Section):
    """The first-order section (s/z + 1) / (s/p + 1) with z = 2 pi zero_hz, p = 2 pi pole_hz."""

    zero_hz: float = Field(description="frequency of the zero, Hz (negative: right half plane)")
    pole_hz: float = Field(description="frequency of the pole, Hz")

    def _check(self) -> None:
        if self.pole_hz <= 0.0:
            raise refuse("makes an unstable pole", "a number > 0", "pole_hz")
        if self.zero_hz == 0.0:
            raise refuse("the section would divide by zero", "any number but 0", "zero_hz")


class FilterPoint(Section):
    """The sections of a filter at a value of the variable of the gain table."""

    time_s: float | None = optional("vehicle clock, s; of these four variables only the gain table's")
    speed_mps: float | None = optional("speed relative to the rotating Earth, m/s")
    mass_kg: float | None = optional("mass, kg")
    dynamic_pressure_Pa: float | None = optional("dynamic pressure, Pa")
    quadratic: tuple[Quadratic, ...] = optional("second-order sections of the structure", ())
    first_order: tuple[FirstOrder, ...] = optional("first-order sections of the structure", ())

    def _check(self) -> None:
        given = [name for name in OVER if getattr(self, name) is not None]
        if len(given) != 1:
            raise refuse(f"has {' and '.join(given) or 'no variable'}", f"one of {', '.join(OVER)}", value={})

    @property
    def over(self) -> Over:
        return next(name for name in OVER if getattr(self, name) is not None)

    @property
    def at(self) -> float:
        """Return the value of the variable at this point, in the unit of its key."""
        return float(getattr(self, self.over))

    def continuous(self) -> BendingFilter:
        """Return the continuous filter at this point."""
        return _continuous(self.quadratic, self.first_order)


def _continuous(quadratic: tuple[Quadratic, ...], first_order: tuple[FirstOrder, ...]) -> BendingFilter:
    from maxq.control import filters  # noqa: PLC0415  # lazy: imports Numba, which reading a file does not need

    return filters.BendingFilter(
        tuple(filters.QuadraticSection(q.zero_hz, q.zero_zeta, q.pole_hz, q.pole_zeta) for q in quadratic),
        tuple(filters.FirstOrderSection(f.zero_hz, f.pole_hz) for f in first_order),
    )


class FilterSection(Section):
    """The bending filter, constant or with a schedule over the flight."""

    structure: Structure = optional(f"F2 to F6: of the paper; sections: 1 to {MAX_SECTIONS} of any kind; none", "none")
    quadratic: tuple[Quadratic, ...] = optional("second-order sections: F2, F3: 1; F4, F5, F6: 2", ())
    first_order: tuple[FirstOrder, ...] = optional("first-order sections: F3, F5: 1; F6: 2", ())
    schedule: tuple[FilterPoint, ...] = optional(
        "sections over the variable of the gain table, instead of quadratic and first_order: frequencies and damping "
        "ratios are linear between points and constant outside",
        (),
    )
    discretization: Literal["prewarped", "bilinear", "matched", "zoh"] = optional(
        "prewarped: bilinear, and exact at prewarp_hz", "prewarped"
    )
    prewarp_hz: Positive | None = optional("frequency at which prewarped is exact, Hz; usually mode 1")

    def _check(self) -> None:
        if self.schedule:
            self._check_schedule()
        quadratic, first_order = self.counts
        if self.structure == "sections":
            given = quadratic + first_order
            if not 1 <= given <= MAX_SECTIONS:
                problem = f"has {given} sections, quadratic and first_order together"
                raise refuse(problem, f"1 .. {MAX_SECTIONS} sections", "structure", value="sections")
        else:
            at = ("schedule", 0) if self.schedule else ()
            for key, given, count in zip(
                ("quadratic", "first_order"), self.counts, STRUCTURES[self.structure], strict=True
            ):
                if given != count:
                    problem = f"{given} sections do not make {self.structure}"
                    raise refuse(problem, f"{count} sections", (*at, key))
        if self.structure != "none" and self.discretization == "prewarped":
            self.needs("prewarp_hz", "discretization is prewarped", "a number > 0, Hz")

    def _check_schedule(self) -> None:
        for key in ("quadratic", "first_order"):
            if getattr(self, key):
                raise refuse("cannot be combined with schedule", "the sections of each point", key)
        first = self.schedule[0]
        for n, (before, point) in enumerate(pairwise(self.schedule), 1):
            at = ("schedule", n)
            if point.over != first.over:
                raise refuse(f"the first point is over {first.over}", f"{first.over} at every point", (*at, point.over))
            if point.at - before.at < LEAST_STEP:
                allowed = f"rising values, by {LEAST_STEP:g} or more"
                raise refuse("does not rise", allowed, (*at, point.over), value=point.at)
            for key in ("quadratic", "first_order"):
                given, wanted = len(getattr(point, key)), len(getattr(first, key))
                if given != wanted:
                    raise refuse(f"has {given} sections, the first point {wanted}", f"{wanted} sections", (*at, key))
            for i, (a, b) in enumerate(zip(first.first_order, point.first_order, strict=True)):
                if (a.zero_hz > 0.0) != (b.zero_hz > 0.0):
                    sign = "above" if a.zero_hz > 0.0 else "below"
                    where = (*at, "first_order", i, "zero_hz")
                    raise refuse("changes the half plane of the zero", f"numbers {sign} 0, as at first", where)
        if self.discretization not in ("prewarped", "bilinear"):
            raise refuse("is not available for a schedule", "prewarped, bilinear", "discretization")

    @property
    def counts(self) -> tuple[int, int]:
        """Return the numbers of quadratic and of first-order sections."""
        form = self.schedule[0] if self.schedule else self
        return len(form.quadratic), len(form.first_order)

    def scheduled(self) -> FilterSchedule:
        """Return the continuous filter over the variable of the gain table."""
        from maxq.control.filter_schedule import FilterSchedule  # noqa: PLC0415  # lazy, as in `_continuous`

        if not self.schedule:
            return FilterSchedule.constant(self.continuous())
        return FilterSchedule(
            tuple(point.at for point in self.schedule), tuple(point.continuous() for point in self.schedule)
        )

    def continuous(self) -> BendingFilter:
        """Return the continuous filter without a schedule."""
        return _continuous(self.quadratic, self.first_order)

    @lru_cache(maxsize=64)  # a campaign asks for every flight  # noqa: B019  # frozen, and few at a time
    def unfit(self, sample_s: float) -> str:
        """Return the reason why the filter cannot be discretised with this sample period; empty if it can."""
        if self.structure == "none":
            return ""
        try:
            for filter_ in self.scheduled().filters:
                filter_.discretize(sample_s, self.discretization, self.prewarp_hz)
        except ValueError as error:
            return str(error)
        return ""


class RollSection(Section):
    """The roll control by on/off thrusters, which respond to roll angle + k_rate_s * roll rate."""

    k_rate_s: NotNegative = Field(description="weight of the rate, s")
    dead_band_deg: Positive = Field(description="half width of the dead band, deg")
    hysteresis_deg: NotNegative = optional("thrusters switch off at dead_band_deg minus hysteresis_deg, deg", 0.0)
    minimum_on_s: NotNegative = optional("shortest pulse, s", 0.0)

    def _check(self) -> None:
        if self.hysteresis_deg > self.dead_band_deg:
            raise refuse("exceeds the dead band", f"0 .. {self.dead_band_deg:g}", "hysteresis_deg")


class RollGimbal(Section):
    """The roll control by two or more groups of engines, with the command -k_p * roll angle - k_d_s * roll rate."""

    k_p: NotNegative = Field(description="rad of deflection per rad of roll error")
    k_d_s: NotNegative = Field(description="rad of deflection per rad/s of roll rate, s")
    limit_deg: Positive = Field(description="limit of the command, deg; pitch and yaw have priority")


BlendWeights = Annotated[tuple[float, ...], Field(min_length=1, max_length=MAX_SENSORS)]


class Blend(Section):
    """The weights of all rate gyros in the rate that the law uses; their sum is 1."""

    pitch: BlendWeights = Field(description="weights in pitch")
    yaw: BlendWeights | None = optional("weights in yaw (default: as in pitch)")

    def _check(self) -> None:
        for key, given in (("pitch", self.pitch), ("yaw", self.yaw)):
            if given is not None and abs(sum(given) - 1.0) > 1e-6:
                raise refuse(f"sums to {sum(given):g}", "weights that sum to 1", key)

    @property
    def axes(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the weights in pitch and in yaw."""
        return self.pitch, self.yaw or self.pitch


class LoopFiltersSection(Section):
    """The filters at the inputs of the law, one for each loop, in addition to the bending filter at its output."""

    attitude: FilterSection | None = optional("filter of the attitude error")
    rate: FilterSection | None = optional("filter of the (blended) rate")
    acceleration: FilterSection | None = optional("load relief: filter of the lateral acceleration before its lag")

    def _check(self) -> None:
        for name in type(self).model_fields:
            given = getattr(self, name)
            if given is not None and given.schedule:
                problem = "the filter of a loop is constant"
                raise refuse(problem, "quadratic, first_order; a schedule in [filter] only", (name, "schedule"))

    @property
    def each(self) -> tuple[FilterSection | None, ...]:
        """Return the filters in the order of control/loop_filters.py."""
        return self.attitude, self.rate, self.acceleration


class LoadReliefSection(Section):
    """The feedback of lateral acceleration or of an estimated angle of attack, with its gain in the gain table."""

    corner_hz: Positive = Field(description="corner of the accelerometer's first-order lag in the computer, Hz")


class AdaptiveSection(Section):
    """The adaptive augmenting control: a total gain on the pitch and yaw commands, 1 in nominal conditions."""

    least_gain: Annotated[float, Field(gt=0.0, lt=1.0)] = optional("lower limit of the total gain", 0.5)
    most_gain: Annotated[float, Field(gt=1.0)] = optional("upper limit of the total gain", 2.0)
    reference_hz: Positive = Field(description="rigid-body frequency of the reference model, Hz")
    reference_zeta: Positive = optional("damping ratio of the reference model", 0.7)
    error_gain_pdeg2s: NotNegative = Field(
        description="rate at which an attitude error above the reference model's raises the gain, 1/(deg2 s)"
    )
    damper_gain_pdeg2s: NotNegative = Field(
        description="spectral damper: rate at which command content above high_pass_hz lowers the gain, 1/(deg2 s)"
    )
    leakage_ps: Positive = optional("rate at which the gain returns to 1, 1/s", 0.1)
    high_pass_hz: Positive = Field(description="corner of the spectral damper, between control and bending, Hz")
    low_pass_hz: Positive = optional("corner of its mean-square filter, Hz", 0.2)

    def _check(self) -> None:
        if self.high_pass_hz <= self.reference_hz:
            raise refuse("is not above the reference model", f"above {self.reference_hz:g}", "high_pass_hz")


RENAMED = {"limits": "basis.limits"}
DesignBasis = dict[str, Any]
"""The basis of a design, on which no flight depends (design/case/basis.py reads it)."""


def check_plug_in(given: Any) -> None:
    """Check that a design or a case names the file of the law `own`, and of this law only."""
    if given.law == "own":
        given.needs("plug_in", "law is own", "a Python file and the law in it, file.py:Law")
    given.only_with(("plug_in",), given.law == "own", "law = 'own'")


class StageLaw(Section):
    """The keys of the design that differ in a stage; absent keys have the values of the design."""

    renamed: ClassVar[dict[str, str]] = RENAMED

    gains: GainsSection | None = optional("gains of the stage")
    filter: FilterSection | None = optional("bending filter of the stage, settled at the separation")
    loop_filters: LoopFiltersSection | None = optional("filters of each loop, settled at the separation")
    fade_s: NotNegative | None = optional("time over which the filters of the preceding stage fade out, s (default: 0)")
    roll: RollSection | None = optional("roll control by thrusters")
    roll_gimbal: RollGimbal | None = optional("roll control by gimbals")
    blend: Blend | None = optional("weights of the rate gyros")
    load_relief: LoadReliefSection | None = optional("lag of the accelerometer")
    adaptive: AdaptiveSection | None = optional("adaptation, restarted at the separation")
    basis: DesignBasis | None = optional("basis of the stage")


class Design(Section):
    """The control design, given by a file in designs/."""

    renamed: ClassVar[dict[str, str]] = RENAMED

    schema_version: Literal[2] = optional("version of the format", 2, alias="schema")
    name: str = optional("name of the design", "")
    description: str = optional("description, one sentence", "")
    vehicle: str = optional("name of its vehicle; another vehicle flies it on explicit request only", "")
    law: Law = optional(LAW_TEXT, "pd")
    plug_in: PlugIn | None = optional(PLUG_IN_TEXT)
    gains: GainsSection
    filter: FilterSection = FilterSection()
    loop_filters: LoopFiltersSection | None = optional("absent: the bending filter only")
    roll: RollSection | None = optional("absent: no roll control by thrusters")
    roll_gimbal: RollGimbal | None = optional("absent: no roll control by gimbals")
    blend: Blend | None = optional("absent: the first gyro only")
    load_relief: LoadReliefSection | None = optional("for the laws load-relief and incidence-relief")
    adaptive: AdaptiveSection | None = optional("absent: no adaptation; available with every law")
    basis: DesignBasis | None = optional(
        "conditions of the design (loop, operating points, limits), which simdesign and simverify use"
    )
    stage: tuple[StageLaw, ...] = optional(
        "keys that differ by stage, in the order of flight (default: none)", (), max_length=MAX_STAGES
    )

    def _check(self) -> None:
        every = [self.gains, *(own.gains for own in self.stage if own.gains is not None)]
        check_plug_in(self)
        for gains, key in ((gains, key) for gains in every for key in ("table", "yaw_table")):
            table = getattr(gains, key)
            if table is not None and any(name.startswith(OWN) for name in table.columns) != (self.law == "own"):
                verb, allowed = ("needs", f"columns {OWN}...") if self.law == "own" else ("has no", "law = 'own'")
                raise table.refusal(f"the law {self.law} {verb} columns {OWN}...", allowed, at=("gains", key))
        for gains, key in ((gains, key) for gains in every for key in ("table", "yaw_table")):
            table = getattr(gains, key)
            for column in GAIN_NAMES[2:] if table is not None else ():
                if (column in table) != (column in self.gain_names):
                    law = next(law for law, names in GAINS.items() if column in names)
                    verb, others = ("needs a", "") if column in self.gain_names else ("has no", f"law = '{law}', or ")
                    allowed = f"{others}{', '.join((gains.over, *self.gain_names))}"
                    raise table.refusal(f"the law {self.law} {verb} column {column}", allowed, at=("gains", key))
            slope = table.get(self.gain_names[-1]) if table is not None and self.law == "incidence-relief" else None
            if slope is not None and not ((slope > 0.0).all() or (slope < 0.0).all()):
                problem, allowed = (
                    "no angle of attack follows from 0 m/s2",
                    "accel_per_incidence_mps2 of one sign (below 0)",
                )
                raise table.refusal(problem, allowed, at=("gains", key))
        if self.law not in INTEGRAL and self.gains.integral_limit_deg is not None:
            problem = f"the law {self.law} has no integral"
            raise refuse(problem, "with law = 'pid' or 'pid-drift' only", ("gains", "integral_limit_deg"))
        self.only_with(("load_relief",), self.law in RELIEF, f"law = {' or '.join(map(repr, RELIEF))}")
        if self.law in RELIEF:
            self.needs("load_relief", f"law is {self.law}", "a table [load_relief]")
        loops = [given for given in (self.loop_filters, *(own.loop_filters for own in self.stage)) if given is not None]
        if self.law not in RELIEF and any(given.acceleration is not None for given in loops):
            allowed = f"law = {' or '.join(map(repr, RELIEF))}"
            raise refuse(f"the law {self.law} takes no acceleration", allowed, ("loop_filters", "acceleration"))
        for n in range(len(self.stage) + 1):  # the last n is that of a stage without keys
            own = self.of_stage(n)
            if own.filter.schedule and own.filter.schedule[0].over != own.gains.over:
                mine = n < len(self.stage) and self.stage[n].filter is not None
                at = (*(("stage", n) if mine else ()), "filter", "schedule", 0, own.filter.schedule[0].over)
                raise refuse(f"the gains are over {own.gains.over}", f"{own.gains.over}, as the gain table", at)

    @property
    def gain_names(self) -> tuple[str, ...]:
        """Return the names of the gains in the gain tables."""
        own = tuple(name for name in self.gains.table.columns if name.startswith(OWN))
        return own if self.law == "own" else GAINS[self.law]

    @property
    def at_unit_gain(self) -> Design:
        """Return the design without adaptation, whose linear loops are those at a total gain of 1."""
        still = tuple(own.model_copy(update={"adaptive": None}) for own in self.stage)
        return self.model_copy(update={"adaptive": None, "stage": still})

    def of_stage(self, number: int) -> Design:
        """Return the design that stage `number` flies, counted from 0; the same object for a design without stages."""
        if not self.stage:
            return self
        own = self.stage[number] if number < len(self.stage) else StageLaw()
        return self.model_copy(
            update={**{k: v for k, v in dict(own).items() if v is not None and k != "fade_s"}, "stage": ()}
        )
