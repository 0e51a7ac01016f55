"""The scenario: what is flown."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, model_validator

from maxq.control.kernel.limits import MAX_INJECTIONS
from maxq.sim.scenario.coverage import check_coverage
from maxq.sim.scenario.errors import refuse, suggestion
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_environment import Atmosphere, Earth, Site, Wind
from maxq.sim.scenario.schema_initial import Initial
from maxq.sim.scenario.schema_injection import Injection
from maxq.sim.scenario.schema_values import Period, Rate, Seconds, Section, at_most_one, needs, only_with, optional
from maxq.sim.scenario.schema_vehicle import Vehicle
from maxq.sim.scenario.tables_csv import Columns, CsvTable

PROGRAMME_COLUMNS = Columns("time_s", sets=(("pitch_rate_degps",),), optional=("yaw_rate_degps", "roll_rate_degps"))
Ending = Literal["impact", "apogee", "burnout", "tumble"]


class Run(Section):
    """How long and how finely."""

    duration_s: Period = optional("longest flight from start_s on, s, whole ns", 400.0)
    step_s: Annotated[Period, Field(le=1.0)] = optional("integrator step, s, whole ns", 0.001)
    seed: Annotated[int, Field(ge=0, lt=2**63)] = optional("all noise derives from it", 1)
    start_s: Seconds = optional("vehicle clock at the start, s, whole ns", 0.0)
    freeze_vehicle_at_s: Seconds | None = optional(
        "mass, thrust, modes, ... are held as at this vehicle clock, s (default: not)"
    )
    stop_at: tuple[Ending, ...] = optional("events that end the flight, any of them", ("impact",))

    @model_validator(mode="after")
    def _check(self) -> Run:
        if self.step_s > self.duration_s:
            raise refuse("is longer than the flight", f"at most duration_s = {self.duration_s:g}", key=("step_s",))
        if len(set(self.stop_at)) != len(self.stop_at):
            raise refuse("names an event twice", "each event once", key=("stop_at",))
        return self


class Guidance(Section):
    """Commanded body rates over time."""

    programme: Annotated[CsvTable, PROGRAMME_COLUMNS] | None = optional(
        "commanded rates over the vehicle clock (default: zero)"
    )
    method: Literal["linear", "pchip", "step"] = optional("between the rows", "linear")


class HoldDown(Section):
    """When a vehicle that is held down is let go."""

    release: Literal["thrust", "time"] = optional("when thrust exceeds weight, or at release_s", "thrust")
    release_s: Seconds | None = optional('on the vehicle clock, s, for release = "time"')

    @model_validator(mode="after")
    def _check(self) -> HoldDown:
        only_with(self, ("release_s",), self.release == "time", "release = 'time'")
        if self.release == "time":
            needs(self, "release_s", "release is 'time'", "a number >= 0")
        return self


class Switches(Section):
    """Each part of the model can be switched off or made ideal."""

    aerodynamics: bool = optional("all aerodynamic forces", True)
    thrust: bool = optional("thrust", True)
    slosh: bool = optional("pendulums; off: the liquid is frozen", True)
    bending: bool = optional("bending modes", True)
    bending_softening: bool = optional("axial load softens the modes", True)
    follower_thrust: bool = optional("thrust turns with the bent gimbal", True)
    engine_inertia: bool = optional("reaction of the gimballed mass (tail wags dog)", True)
    jet_damping: bool = optional("damping by the mass flow", True)
    moving_cg: bool = optional("terms of CG and inertia that change", True)
    actuator: Literal["full", "linear", "ideal"] = optional("linear: no limits; ideal: angle = command", "full")
    gyro: Literal["full", "ideal"] = optional("ideal: measures the true rate", "full")
    converter: Literal["full", "ideal"] = optional("ideal: no quantisation", "full")
    delay: bool = optional("compute delay", True)
    control: bool = optional("control law; off: command zero", True)
    guidance: bool = optional("guidance programme; off: rates zero", True)
    roll_control: bool = optional("roll thrusters", True)
    local_incidence: bool = optional("bending changes the incidence of the lifting parts", True)


class Log(Section):
    """How often is logged."""

    fast_hz: Rate = optional("actuator, bending, slosh, control, gyro, Hz; must divide 1e9", 1000.0)
    slow_hz: Rate = optional("the rest, Hz; must divide 1e9", 100.0)
    transform_hz: Rate = optional("transforms for 3-D viewers, Hz; must divide 1e9", 50.0)


class Requirement(Section):
    """A number that the flight must keep to."""

    metric: str = Field(description="name of the metric")
    limit: float | None = optional("at most this")
    minimum: float | None = optional("at least this")
    name: str = optional("shown to people (default: the metric)", "")

    @model_validator(mode="after")
    def _check(self, info: ValidationInfo) -> Requirement:
        at_most_one(self, ("limit", "minimum"))
        if self.limit is None and self.minimum is None:
            raise refuse("required key is missing: a requirement needs a bound", "limit or minimum", key=("limit",))
        known: tuple[str, ...] | None = getattr(info.context, "known_metrics", None)
        if known is not None and self.metric not in known:
            hint = suggestion(self.metric, known)
            problem = "unknown metric" + (f"; {hint}" if hint else "")
            raise refuse(problem, "" if hint else ", ".join(known), key=("metric",))
        return self


class Scenario(Section):
    """A scenario with its vehicle and design in full, all `extends` and overrides applied."""

    schema_version: Literal[1] = optional("version of the format", 1, alias="schema")
    name: str = optional("default: the file's name", "")
    description: str = optional("what is flown, in a sentence", "")
    vehicle: Vehicle = Field(description="folder with vehicle.toml, a .toml file, or the vehicle itself")
    design: Design | None = optional("a design file, or the design itself (default: command zero)")
    run: Run = Run()
    site: Site = Site()
    earth: Earth = Earth()
    atmosphere: Atmosphere = Atmosphere()
    wind: Wind = Wind()
    initial: Initial | None = optional("absent: on the pad, nose up, at rest on the Earth, held down")
    guidance: Guidance = Guidance()
    holddown: HoldDown = HoldDown()
    injection: tuple[Injection, ...] = optional("signals for tests", (), max_length=MAX_INJECTIONS)
    switches: Switches = Switches()
    log: Log = Log()
    requirement: tuple[Requirement, ...] = optional("what the flight is judged by", ())

    @property
    def held(self) -> bool:
        """Whether the flight begins held down."""
        return self.initial is None or self.initial.held

    @model_validator(mode="after")
    def _check(self) -> Scenario:
        self._check_control()
        self._check_hold_down()
        self._check_wind()
        check_coverage(self)
        return self

    def _check_control(self) -> None:
        computer = self.vehicle.computer
        if self.design is not None:
            if computer is None:
                raise refuse(
                    "the vehicle has no [computer] to run a design on", key=("design",), value=self.design.name
                )
            nyquist = 0.5 / computer.sample_s
            warp = self.design.filter.prewarp_hz
            if warp is not None and warp >= nyquist:
                raise refuse(
                    "lies above half the sample rate", f"less than {nyquist:g}", ("design", "filter", "prewarp_hz")
                )
        for n, injection in enumerate(self.injection):
            key = ("injection", n, "at")
            if injection.at == "gimbal_command" and not any(stage.engine for stage in self.vehicle.stage):
                raise refuse("the vehicle has no engine", "body_force, body_torque", key=key)
            if injection.at == "rate_command" and computer is None:
                raise refuse("the vehicle has no [computer]", "body_force, body_torque", key=key)

    def _check_hold_down(self) -> None:
        engine = self.vehicle.stage[0].engine
        if self.held and self.holddown.release == "thrust" and (engine is None or not self.switches.thrust):
            raise refuse(
                "the vehicle is held down until thrust exceeds weight, but it has no thrust",
                "[initial] with held = false, or holddown.release = 'time'",
                key=("holddown", "release"),
                value="thrust",
            )

    def _check_wind(self) -> None:
        profile = self.wind.profile
        if profile is not None and self.wind.outside == "error" and profile["altitude_m"][0] > self.site.altitude_m:
            raise profile.refusal(
                "the profile begins above the site",
                f"at most {self.site.altitude_m:g}",
                "altitude_m",
                0,
                at=("wind", "profile"),
            )
