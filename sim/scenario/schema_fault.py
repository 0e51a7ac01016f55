"""The faults of a scenario: the failed part, the time of the failure, and its end.

A new kind of fault needs its name in FaultKind and an entry of KINDS with its keys. A key that no other kind has
becomes a field of Fault. sim/packing/faults.py defines the effects of a fault.
"""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from maxq.control.kernel.limits import MAX_ENGINES, MAX_SENSORS, MAX_STAGES, MAX_UNITS
from maxq.sim.input.errors import refuse
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import Fraction, Positive, Seconds, Section, Triple, optional

FaultKind = Literal[
    "engine-off",
    "thrust-loss",
    "gyro-stuck",
    "gyro-dead",
    "gyro-bias",
    "gyro-noisy",
    "gyro-lost",
    "accelerometer-stuck",
    "accelerometer-dead",
    "accelerometer-bias",
    "accelerometer-noisy",
    "accelerometer-lost",
    "actuator-stuck",
    "actuator-hard-over",
    "actuator-floating",
    "gnss-outage",
    "gnss-stuck",
    "gnss-bias",
    "barometer-stuck",
    "barometer-dead",
    "barometer-bias",
    "magnetometer-stuck",
    "magnetometer-dead",
    "magnetometer-bias",
    "switch-stuck",
]


class FaultAbout(NamedTuple):
    """The keys of a kind of fault. `part` is a key that the section of the stage, or of the vehicle, must have."""

    part: str
    axes: tuple[str, ...] = ()  # allowed values of `axis`
    targets: tuple[str, ...] = ()  # optional keys that name the failed part
    values: tuple[str, ...] = ()  # required keys
    options: tuple[str, ...] = ()  # other optional keys

    @property
    def keys(self) -> tuple[str, ...]:
        return (*dict.fromkeys((*self.targets, *self.values, *self.options)),)


_TURNS, _GIMBALS, _ALONG = ("roll", "pitch", "yaw"), ("pitch", "yaw"), ("x", "y", "z")
TAIL_OFF_COLUMNS = Columns("time_s", sets=(("share",),), not_negative=("time_s", "share"), begins_by=0.0)
KINDS: dict[FaultKind, FaultAbout] = {
    "engine-off": FaultAbout("engine", (), ("engine",), (), ("tail_off", "reallocate_after_s")),
    "thrust-loss": FaultAbout("engine", (), ("engine",), ("loss",), ("reallocate_after_s",)),
    "gyro-stuck": FaultAbout("gyro", _TURNS, ("gyro", "axis")),
    "gyro-dead": FaultAbout("gyro", _TURNS, ("gyro", "axis")),
    "gyro-bias": FaultAbout("gyro", _TURNS, ("gyro", "axis"), ("bias_degps",)),
    "gyro-noisy": FaultAbout("gyro", _TURNS, ("gyro", "axis"), ("noise_deg_rt_h",)),
    "gyro-lost": FaultAbout("gyro", (), ("gyro",)),
    "accelerometer-stuck": FaultAbout("accelerometer", _ALONG, ("accelerometer", "axis")),
    "accelerometer-dead": FaultAbout("accelerometer", _ALONG, ("accelerometer", "axis")),
    "accelerometer-bias": FaultAbout("accelerometer", _ALONG, ("accelerometer", "axis"), ("bias_mps2",)),
    "accelerometer-noisy": FaultAbout("accelerometer", _ALONG, ("accelerometer", "axis"), ("noise_mps_rt_h",)),
    "accelerometer-lost": FaultAbout("accelerometer", (), ("accelerometer",)),
    "actuator-stuck": FaultAbout("actuator", _GIMBALS, ("axis", "group")),
    "actuator-hard-over": FaultAbout("actuator", _GIMBALS, ("axis", "group"), ("angle_deg",)),
    "actuator-floating": FaultAbout("actuator", _GIMBALS, ("axis", "group")),
    "gnss-outage": FaultAbout("gnss"),
    "gnss-stuck": FaultAbout("gnss"),
    "gnss-bias": FaultAbout("gnss", (), (), ("position_bias_m",)),
    "barometer-stuck": FaultAbout("barometer"),
    "barometer-dead": FaultAbout("barometer"),
    "barometer-bias": FaultAbout("barometer", (), (), ("bias_Pa",)),
    "magnetometer-stuck": FaultAbout("magnetometer"),
    "magnetometer-dead": FaultAbout("magnetometer"),
    "magnetometer-bias": FaultAbout("magnetometer", _ALONG, ("axis",), ("bias_nT",)),
    "switch-stuck": FaultAbout("computer", (), ("switch",), ("switch",)),
}
OF_VEHICLE = ("gnss", "barometer", "magnetometer", "computer")
"""The parts of the vehicle, which all stages share."""
_OF_KINDS = tuple(dict.fromkeys(key for kind in KINDS.values() for key in kind.keys))


class Fault(Section):
    """A part that fails, permanently or for a time."""

    kind: FaultKind = Field(
        description="engine-off: no thrust or flow; thrust-loss: a share of both is lost; gyro-stuck, "
        "accelerometer-stuck: constant output; -dead: zero output; -bias, -noisy: a constant or noise is added; "
        "-lost: samples do not reach the computer, which keeps the last one; "
        "actuator-stuck: constant servo position; actuator-hard-over: the servo moves to angle_deg within its limits; "
        "actuator-floating: no force, and the engine swings freely on its gimbal (without a TVC load the servo is "
        "centred); gnss-outage: no solutions; gnss-stuck: the last solution with new times; switch-stuck: a discrete "
        "input of flight code does not change"
    )
    at_s: Seconds = Field(description="instant of the failure, s, whole ns")
    since: Literal["clock", "liftoff"] = optional("zero of at_s and until_s: vehicle clock or liftoff", "clock")
    until_s: Seconds | None = optional("end of the failure, s, whole ns (default: none)")
    stage: int | None = optional("stage, from 0 (default: the active one)", None, ge=0, lt=MAX_STAGES)
    gyro: int | None = optional(
        "gyro number in the log: 1 is [stage.gyro], 2 and above [[stage.rate_gyro]] (default: 1)",
        None,
        ge=1,
        le=MAX_SENSORS,
    )
    accelerometer: int | None = optional(
        "number: 1 is [stage.accelerometer], 2 and above [[stage.further_accelerometer]] (default: 1)",
        None,
        ge=1,
        le=MAX_UNITS,
    )
    axis: Literal["roll", "pitch", "yaw", "x", "y", "z"] | None = optional(
        "axis: roll, pitch, yaw of gyros and actuators; x, y, z of the accelerometer (default: all)"
    )
    group: int | None = optional("group of engines, from 0 (default: 0)", None, ge=0, lt=MAX_ENGINES)
    angle_deg: float | None = optional("actuator-hard-over: target angle, deg, within the angle limit")
    bias_degps: float | None = optional("gyro-bias: added to the output, deg/s")
    bias_mps2: float | None = optional("accelerometer-bias: added to the output, m/s2")
    position_bias_m: Triple | None = optional("gnss-bias: added to the position, north, east, down, m")
    bias_Pa: float | None = optional("barometer-bias: added to the output, Pa")
    bias_nT: float | None = optional("magnetometer-bias: added to the output, nT")
    switch: Literal["liftoff", "separation"] | None = optional("switch-stuck: the switch, or all those of separations")
    noise_mps_rt_h: Positive | None = optional("accelerometer-noisy: additional velocity random walk, m/s/sqrt(h)")
    noise_deg_rt_h: Positive | None = optional("gyro-noisy: additional angle random walk, deg/sqrt(h)")
    engine: int | None = optional("engine number in the stage, from 0 (default: all)", None, ge=0, lt=MAX_ENGINES)
    loss: Fraction | None = optional("thrust-loss: share of thrust and mass flow that is lost")
    tail_off: Annotated[CsvTable, TAIL_OFF_COLUMNS] | None = optional(
        "engine-off: remaining share of thrust and mass flow over the time since at_s (default: 0 at once)"
    )
    reallocate_after_s: Seconds | None = optional(
        "time after at_s at which the computer reallocates its commands to the remaining engines, s (default: never)"
    )

    def _check(self) -> None:
        kind = KINDS[self.kind]
        for key in _OF_KINDS:
            named = ", ".join(name for name, other in KINDS.items() if key in other.keys)
            self.only_with((key,), key in kind.keys, f"kind = {named}")
        for key in kind.values:
            self.needs(key, f"kind is {self.kind}", '"liftoff", "separation"' if key == "switch" else "a number")
        if self.axis is not None and self.axis not in kind.axes:
            raise refuse(f"{self.kind} has no such axis", ", ".join(kind.axes), "axis")
        if self.tail_off is not None:
            more = self.tail_off["share"] > 1.0
            self.tail_off.refuse_where(more, "share", "exceeds the thrust before the fault", "0 .. 1", at=("tail_off",))
        if self.until_s is not None and self.until_s <= self.at_s:
            raise refuse("ends before it begins", f"more than at_s = {self.at_s:g}", "until_s")

    @property
    def of_engines(self) -> bool:
        """Return True if the fault changes thrust and mass flow over time, which are computed before the flight."""
        return KINDS[self.kind].part == "engine"

    @property
    def axes(self) -> tuple[str, ...]:
        """Return the failed axes; empty for a part without axes."""
        return KINDS[self.kind].axes if self.axis is None else (self.axis,)

    @property
    def text(self) -> str:
        """Return the kind and the failed part, for messages."""
        targets = [(key, getattr(self, key)) for key in KINDS[self.kind].targets]
        named = [value if isinstance(value, str) else f"{key} {value}" for key, value in targets if value is not None]
        return " ".join((self.kind, *named))
