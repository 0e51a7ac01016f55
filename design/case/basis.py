"""The basis of a design: the plant, loop, operating points and limits with which a law is designed and verified.

A case is a basis with an optimisation problem. A design file contains the basis of its law in `[basis]`, or one basis
per stage in `[stage.basis]`. `stated_basis` reads it.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, ValidationError

from maxq.design.case.goals import GoalSection
from maxq.design.model.spread import Shares, Spread
from maxq.design.quantities import STEPS, CommonLimits, Degrees, RigidBody, ZoneName
from maxq.sim.input.documents import Source, adopt, plain
from maxq.sim.input.errors import refuse
from maxq.sim.input.values import NotNegative, Positive, PositiveOverTime, Section, optional
from maxq.sim.scenario.loader import told
from maxq.sim.scenario.messages import explain
from maxq.sim.scenario.schema_design import Design

LIMIT_NAMES = Literal[
    "second_mode_db", "filter_gain_at_infinity", "rigid_hz", "rigid_zeta", "gain_margin_db", "phase_margin_deg"
]

BetweenTimes = tuple[float, float]
BetweenNodes = Literal["ignore", "hold"]
BETWEEN = (
    "hold: instants between the operating points that are worse by 0.02 dB or 0.1 deg become operating points, until "
    "none is found; with [robust] also for dispersed plants; ignore: limits at the operating points only, as in the "
    "paper"
)
WIND_KEYS = ("q_alpha_Padeg", "drift_mps", "bending_moment")
"""The limits that require a wind."""


def check_range(value: BetweenTimes, key: str, lowest: float) -> None:
    low, high = value
    if not lowest < low:
        raise refuse("reaches down to an unstable or right-half-plane root", "numbers above 0", key)
    if not low < high:
        raise refuse("is empty", "two numbers, the lower one first", key)


def check_rising(values: tuple[float, ...], key: str) -> None:
    if len(values) == 0 or any(b <= a for a, b in pairwise(values)):
        raise refuse("does not rise", "one rising number or more", key)


class SectionLimit(Section):
    """A limit on the bending moment at one station."""

    station_m: float = Field(description="one of the stage's loads.stations_m, m aft of the nose")
    rms_Nm: Positive = Field(description="largest rms in the wind of [wind], N m")


class LoadLimits(CommonLimits):
    """The load limits of one plant in still air and in wind. An absent key sets no limit."""

    renamed: ClassVar[dict[str, str]] = {"higher_modes_db": "modes_from_3_db"}

    q_alpha_Padeg: Positive | None = optional(
        "largest rms of dynamic pressure times angle of attack in the wind of [wind]"
    )
    drift_mps: Positive | None = optional("largest rms of the lateral velocity in the wind of [wind]")
    bending_moment: tuple[SectionLimit, ...] = optional("largest rms of the bending moment in the wind of [wind]", ())


class DesignLimits(LoadLimits):
    """The limits of a design. An absent key sets no limit."""

    zone: ZoneName = optional(
        "exclusion zone of L around -1 in the Nichols plane, half axes gain_margin_db, phase_margin_deg", "none"
    )
    filter_gain_at_infinity: Positive | None = optional("P^F, largest |F(j inf)| (46)")
    integral_hz: Positive | None = optional(
        "law pid: lowest corner k_i / (2 pi k_p) of the integral, Hz (default of a case: a tenth of rigid_hz)"
    )
    most_integral_hz: Positive | None = optional("law pid: highest corner of the integral, Hz (default: none)")
    rigid_body: RigidBody = optional(
        "rigid-body frequency and damping ratio by (35) and (36), or including M_alpha and M_q (erratum 12)", "paper"
    )

    def _check(self) -> None:
        if self.zone != "none":
            for key in ("gain_margin_db", "phase_margin_deg"):
                self.needs(key, "it is a half axis of the zone", "a number > 0")
        least, most = self.integral_hz, self.most_integral_hz
        if most is not None and least is not None and most < least:
            raise refuse("is below integral_hz", f"at least {least:g}", "most_integral_hz")

    @property
    def asked(self) -> tuple[str, ...]:
        """Return the keys of the limits that are set."""
        return tuple(k for k, v in dict(self).items() if k != "rigid_body" and v not in (None, (), "none"))


class MarginLimits(LoadLimits):
    """The limits of a loop. The margins hold at every crossing, and the closed loop must be stable."""

    gain_margin_db: Positive = optional("GM_R (44): customary, the paper gives none", 6.0)
    phase_margin_deg: Degrees = optional("PM_R (45): customary, the paper gives none", 30.0)
    second_mode_db: float = optional("P2_UL (43): as low as the gain margin requires; not in the paper", -6.0)
    rigid_hz: PositiveOverTime = optional(
        "omega_RB,min (47): limit of the paper's reference design; or a table {time_s, value} over the vehicle clock, "
        "linear between its times",
        0.5,
    )
    rigid_zeta: PositiveOverTime = optional("zeta_RB,min (48): likewise", 0.7)
    without: tuple[LIMIT_NAMES, ...] = optional("limits to omit", ())

    def _check(self) -> None:
        super()._check()
        if getattr(self, "zone", "none") != "none" and {"gain_margin_db", "phase_margin_deg"} & set(self.without):
            raise refuse("omits a half axis of the zone", "zone = 'none'", "without")


class Limits(MarginLimits, DesignLimits):
    """The limits of the nominal plants, of the filter and of the method."""

    filter_gain_at_infinity: Positive = optional(
        "P^F, largest |F(j inf)| (46): 1 for a filter that does not amplify noise; not in the paper", 1.0
    )


class CaseWind(Section):
    """The lateral wind for the limits of load and drift, with a spectrum of MIL-F-8785C."""

    sigma_mps: Positive = Field(description="intensity, m/s")
    length_v_m: Positive = optional("scale length, m", 533.0)
    model: Literal["dryden", "von-karman"] = optional("form of the spectrum", "dryden")
    band_hz: BetweenTimes = optional(
        "frequency band, from 0.02 Hz to less than half the sample rate: wind shears are below some tenths of 1 Hz, "
        "where a law can relieve loads; bending modes are included if the band contains them",
        (0.02, 5.0),
    )

    def _check(self) -> None:
        check_range(self.band_hz, "band_hz", 0.0)


class DispersedLimits(MarginLimits):
    """The limits of the dispersed plants, customarily half the nominal limits."""

    gain_margin_db: Positive = optional("customary: half the nominal one", 3.0)
    phase_margin_deg: Degrees = optional("customary: half the nominal one", 15.0)
    second_mode_db: float = optional("as low as the gain margin requires", -3.0)
    without: tuple[LIMIT_NAMES, ...] = optional("limits to omit", ("rigid_hz", "rigid_zeta"))


class Robust(Spread):
    """The dispersed plants for which the design must meet its limits. Half ranges are relative unless a unit is given.

    Every mode and every tank deviates independently. The defaults are 3-sigma ranges after a modal survey: 0.05, 0.10
    and 0.15 for the frequencies of bending modes, and 0.20 for their slopes. The plants are corners at which all
    parameters deviate simultaneously: n deviations of one sigma each have a distance of sqrt(n) sigma. If parameters
    are correlated, the corners are those of the underlying independent scores and are equally probable.
    """

    where: ClassVar[tuple[str, str]] = ("case", "robust")

    corner_sigmas: Annotated[float, Field(gt=0.0, le=3.0)] = optional(
        "deviation of each parameter at a corner, sigma", 2.0
    )
    bending_damping: Shares = optional("damping of each mode", 0.0)
    delay_s: NotNegative = optional("in both directions, s; the delay is never negative", 0.005)
    rounds: Annotated[int, Field(ge=1, le=50)] = optional(
        "rounds of searching for the worst plants, adding them and repeating the design", 8
    )
    limits: DispersedLimits = DispersedLimits()


class Basis(Section):
    """The plant, the loop, the operating points and the limits of a design."""

    scenario: str = optional("name or file of the scenario whose flight gave the operating points", "")
    points: str | None = optional(
        "file of published derivatives that gives the operating points, instead of a flight (docs/design.md)"
    )
    plant: Literal["flown", "table2"] = optional(
        "flown: the scenario's vehicle; table2: with derivatives that span the paper's Table 2", "flown"
    )
    errata: Literal["corrected", "paper"] = optional("the paper's model corrected or as printed", "corrected")
    loop: Literal["pade", "sampled", "exact"] = optional(
        "pade: the paper's continuous model (30 to 32); sampled: as the computer runs it", "sampled"
    )
    plane: Literal["pitch", "yaw"] = optional("plane of the model", "pitch")
    nodes_s: tuple[float, ...] | None = optional(
        "vehicle times of the operating points, s (default: chosen from the flight, in every stage)"
    )
    between_nodes: BetweenNodes = optional(BETWEEN, "ignore")
    wind: CaseWind | None = optional("absent: no limits of load and drift")
    limits: DesignLimits = DesignLimits()
    goal: tuple[GoalSection, ...] = optional("goals of your own (default: none)", (), max_length=24)
    robust: Robust | None = optional("absent: the nominal plants only")

    def _check(self) -> None:
        if self.nodes_s is not None:
            check_rising(self.nodes_s, "nodes_s")
        for key in WIND_KEYS:
            if self.wind is None and getattr(self.limits, key) not in (None, ()):
                raise refuse("needs a wind", "a table [wind]", ("limits", key))
        steps = [one.quantity for one in self.goal if one.quantity in STEPS]
        if steps and self.loop != "sampled":
            raise refuse(f"limits a step response ({steps[0]}), which only the sampled loop has", "none", "goal")
        if self.bends and self.errata == "paper":
            raise refuse("has no bending moments", "errata = 'corrected'", "errata")

    @property
    def bends(self) -> bool:
        """Return True if a bending moment is limited."""
        return len(self._stations_m(())) > 0

    def bending_stations_m(self, known: tuple[float, ...]) -> tuple[float, ...]:
        """Return the stations at which bending moments are required in a stage with the stations `known`.

        Raises ValueError for a required station that is not in `known`.
        """
        asked = self._stations_m(known)
        if not asked <= set(known):
            strange = ", ".join(f"{x:g}" for x in sorted(asked - set(known)))
            raise ValueError(
                f"bending moment at {strange} m: allowed are the stage's loads.stations_m, "
                f"{', '.join(f'{x:g}' for x in known) or 'of which it has none'}"
            )
        return tuple(sorted(asked))

    def _stations_m(self, known: tuple[float, ...]) -> set[float]:
        del known  # `Case` overrides this method; its objective may apply to all known stations
        limits: list[LoadLimits] = [self.limits, *([] if self.robust is None else [self.robust.limits])]
        return {one.station_m for each in limits for one in each.bending_moment}

    def as_table(self) -> dict[str, Any]:
        """Return the basis as the table of a design file, without keys that have no effect."""
        table: dict[str, Any] = _what_sets(plain(told(self)))
        return table


def _what_sets(value: Any) -> Any:
    """Return a table without keys that have no effect and without limits that are not set."""
    if not isinstance(value, dict):
        return value
    left_out = value.get("without", ())
    return {k: _what_sets(v) for k, v in value.items() if v not in ((), "none", "") and k not in left_out}


def limit_of(limits: LoadLimits, key: str | float) -> Any:
    """Return a limit by its key, or the limit of a bending moment by its station (m).

    Returns None if the limit is not set.
    """
    if isinstance(key, str):
        return None if key in getattr(limits, "without", ()) else getattr(limits, key)
    return next((one.rms_Nm for one in limits.bending_moment if one.station_m == key), None)


def stated_basis(design: Design, stage: int = 0, label: str = "") -> Basis | None:
    """Return the basis that a design states for a stage, counted from 0, or None without a basis.

    Raises ScenarioError for an invalid basis; the message refers to the file by `label`.
    """
    given = design.of_stage(stage).basis
    if given is None:
        return None
    try:
        return Basis.model_validate(plain(told(given)))
    except ValidationError as error:
        source = Source(label or design.name or "design", shown_as=("basis",))
        raise explain(error, adopt(told(given), source), Basis) from None
