"""Injections: signals that are added to a command, or a force or torque on the body."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from maxq.control.kernel.limits import MAX_TONES
from maxq.sim.scenario.errors import refuse
from maxq.sim.scenario.schema_values import Positive, Seconds, Section, needs, only_with, optional
from maxq.sim.scenario.tables_csv import Columns, CsvTable

SIGNAL_COLUMNS = Columns("time_s", sets=(("value",),))

AMPLITUDES = {
    "gimbal_command": "amplitude_deg",
    "rate_command": "amplitude_degps",
    "body_force": "amplitude_N",
    "body_torque": "amplitude_Nm",
}
AXES = {
    "gimbal_command": ("pitch", "yaw"),
    "rate_command": ("pitch", "yaw", "roll"),
    "body_force": ("x", "y", "z"),
    "body_torque": ("x", "y", "z"),
}
FREQUENCIES = {
    "step": (),
    "doublet": (),
    "sine": ("frequency_hz",),
    "chirp": ("frequency_hz", "stop_frequency_hz"),
    "multisine": ("frequencies_hz",),
    "table": (),
}


class Injection(Section):
    """One signal on one axis."""

    at: Literal["gimbal_command", "rate_command", "body_force", "body_torque"] = Field(description="where it enters")
    axis: Literal["pitch", "yaw", "roll", "x", "y", "z"] = Field(
        description="gimbal_command: pitch, yaw; rate_command: pitch, yaw, roll; body_*: x, y, z"
    )
    kind: Literal["step", "doublet", "sine", "chirp", "multisine", "table"] = Field(
        description="shape; doublet: + in the first half of the time, - in the second; "
        "chirp: the frequency changes linearly"
    )
    replaces: bool = optional("whether it replaces the command; false: is added to it", False)
    amplitude_deg: float | None = optional("deg, at gimbal_command")
    amplitude_degps: float | None = optional("deg/s, at rate_command")
    amplitude_N: float | None = optional("N, at body_force")
    amplitude_Nm: float | None = optional("N m, at body_torque")
    start_s: Seconds = optional("begin on the vehicle clock, s, whole ns", 0.0)
    stop_s: Seconds | None = optional("end, s, whole ns (default: end of the flight)")
    frequency_hz: Positive | None = optional("Hz, of sine; first of chirp")
    stop_frequency_hz: Positive | None = optional("Hz, last of chirp")
    frequencies_hz: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=MAX_TONES)] | None = optional(
        "Hz, of multisine; all have the amplitude, with Schroeder phases"
    )
    table: Annotated[CsvTable, SIGNAL_COLUMNS] | None = optional(
        "signal over the vehicle clock in the unit of the target, for kind = table"
    )

    @model_validator(mode="after")
    def _check(self) -> Injection:
        if self.axis not in AXES[self.at]:
            raise refuse(f"{self.at} has no such axis", ", ".join(AXES[self.at]), key=("axis",))
        if self.replaces and self.at in ("body_force", "body_torque"):
            raise refuse("there is no command to replace", f"false at {self.at}", key=("replaces",))
        used = () if self.kind == "table" else (AMPLITUDES[self.at],)
        for key in AMPLITUDES.values():
            if key not in used and getattr(self, key) is not None:
                allowed = used[0] if used else "the values of the table"
                raise refuse(f"has no meaning with {self.kind} at {self.at}", allowed, key=(key,))
        for key in used:
            needs(self, key, f"at is {self.at}", "a number")
        for key in ("frequency_hz", "stop_frequency_hz", "frequencies_hz"):
            if key in FREQUENCIES[self.kind]:
                needs(self, key, f"kind is {self.kind}", "numbers > 0, Hz")
            else:
                only_with(self, (key,), False, "kind = " + ", ".join(k for k, v in FREQUENCIES.items() if key in v))
        if self.kind == "table":
            needs(self, "table", "kind is table", SIGNAL_COLUMNS.allowed())
        else:
            only_with(self, ("table",), False, "kind = table")
        if self.kind in ("doublet", "chirp"):
            needs(self, "stop_s", f"kind is {self.kind}", "a number > start_s")
        if self.stop_s is not None and self.stop_s <= self.start_s:
            raise refuse("ends before it begins", f"more than start_s = {self.start_s:g}", key=("stop_s",))
        return self

    @property
    def amplitude(self) -> float:
        """In the unit of the target; 1 for a table."""
        value: float | None = getattr(self, AMPLITUDES[self.at])
        return 1.0 if value is None else value
