"""The scenario of a flight: vehicle, design, initial state, guidance, injected signals and requirements."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from maxq.control.kernel.limits import MAX_BURNS, MAX_FAULTS, MAX_INJECTIONS, MAX_TONES
from maxq.control.structures import DRIFT, RELIEF
from maxq.sim.flight.metric_table import METRIC_NAMES, CutoffMetrics, ImpactMetrics, LaunchMetrics
from maxq.sim.input.errors import refuse, suggestion
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import (
    FourNumbers,
    Latitude,
    Longitude,
    Period,
    Positive,
    Rate,
    Seconds,
    Section,
    ThreeRows,
    Triple,
    optional,
)
from maxq.sim.scenario.coverage import check_gains, check_programme, check_stages
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_environment import AtmosphereSection, EarthSection, Site, WindSection
from maxq.sim.scenario.schema_fault import KINDS, OF_VEHICLE, Fault
from maxq.sim.scenario.schema_launch import Cutoff, NavigationSection, OrbitTarget, Rail, RangeSafety, Restart, Tower
from maxq.sim.scenario.schema_vehicle import Stage, Vehicle
from maxq.sim.vehicle.loads.section import SECTION_PREFIX, check_line_mass

_ORTHONORMAL = 1e-6
POSITIONS = ("geodetic", "inertial_m", "earth_m")
VELOCITIES = ("ned_mps", "inertial_mps", "earth_mps")
ATTITUDES = ("euler_deg", "q_BI", "dcm_BI")
RATES = ("rate_BI_degps", "rate_BI_radps", "rate_BE_degps")


class Geodetic(Section):
    """A place on the Earth."""

    latitude_deg: Latitude = Field(description="geodetic latitude, deg")
    longitude_deg: Longitude = Field(description="longitude, deg")
    altitude_m: float = Field(description="height above the ellipsoid, m")


class Initial(Section):
    """The state at the start, with at most one key for each of position, velocity, attitude and rates."""

    held: bool = optional("hold-down until the release", False)
    geodetic: Geodetic | None = optional("position (default: the site)")
    inertial_m: Triple | None = optional("position in I, m")
    earth_m: Triple | None = optional("position in E, m")
    ned_mps: Triple | None = optional("velocity relative to the Earth, north, east, down, m/s (default 0)")
    inertial_mps: Triple | None = optional("inertial velocity in I, m/s")
    earth_mps: Triple | None = optional("velocity relative to the Earth in E, m/s")
    euler_deg: Triple | None = optional(
        "yaw, pitch, roll (3-2-1) of B from north, east, down, deg (default: nose up, body z at azimuth)"
    )
    q_BI: FourNumbers | None = optional("unit quaternion from B to I components, scalar first")
    dcm_BI: ThreeRows | None = optional("direction cosine matrix from I to B components")
    rate_BI_degps: Triple | None = optional("inertial rates p, q, r in B, deg/s")
    rate_BI_radps: Triple | None = optional("inertial rates p, q, r in B, rad/s")
    rate_BE_degps: Triple | None = optional("rates relative to the Earth in B, deg/s (default 0)")

    def _check(self) -> None:
        for keys in (POSITIONS, VELOCITIES, ATTITUDES, RATES):
            self.at_most_one(*keys)
        if self.q_BI is not None and abs(float(np.linalg.norm(self.q_BI)) - 1.0) > _ORTHONORMAL:
            norm = float(np.linalg.norm(self.q_BI))
            raise refuse("is not a unit quaternion", f"norm 1 within 1e-6, not {norm:.9g}", "q_BI")
        if self.dcm_BI is not None:
            dcm = np.array(self.dcm_BI)
            if np.abs(dcm @ dcm.T - np.eye(3)).max() > _ORTHONORMAL or np.linalg.det(dcm) < 0.0:
                raise refuse("is not a rotation matrix", "orthonormal rows within 1e-6, determinant +1", "dcm_BI")


SIGNAL_COLUMNS = Columns("time_s", sets=(("value",),))

AMPLITUDES = {
    "gimbal_command": "amplitude_deg",
    "rate_command": "amplitude_degps",
    "body_force": "amplitude_N",
    "body_torque": "amplitude_Nm",
    "thrust": "amplitude_share",
}
AXES = {
    "gimbal_command": ("pitch", "yaw"),
    "rate_command": ("pitch", "yaw", "roll"),
    "body_force": ("x", "y", "z"),
    "body_torque": ("x", "y", "z"),
    "thrust": ("x",),
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
    """A test signal about or along an axis."""

    at: Literal["gimbal_command", "rate_command", "body_force", "body_torque", "thrust"] = Field(
        description="place of the signal; thrust: all burning engines"
    )
    axis: Literal["pitch", "yaw", "roll", "x", "y", "z"] = Field(
        description="gimbal_command: pitch, yaw; rate_command: pitch, yaw, roll; body_*: x, y, z; thrust: x"
    )
    kind: Literal["step", "doublet", "sine", "chirp", "multisine", "table"] = Field(
        description="shape; doublet: + in the first half, - in the second; chirp: linear change of frequency"
    )
    replaces: bool = optional("true: replaces the command; false: is added to it", False)
    amplitude_deg: float | None = optional("amplitude at gimbal_command, deg")
    amplitude_degps: float | None = optional("amplitude at rate_command, deg/s")
    amplitude_N: float | None = optional("amplitude at body_force, N")
    amplitude_Nm: float | None = optional("amplitude at body_torque, N m")
    amplitude_share: Annotated[float, Field(ge=-1.0, le=1.0)] | None = optional("amplitude at thrust, as a share of it")
    start_s: Seconds = optional("start on the vehicle clock, s, whole ns", 0.0)
    stop_s: Seconds | None = optional("end, s, whole ns (default: end of the flight)")
    frequency_hz: Positive | None = optional("frequency of sine, start of chirp, Hz")
    stop_frequency_hz: Positive | None = optional("end of chirp, Hz")
    frequencies_hz: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=MAX_TONES)] | None = optional(
        "frequencies of multisine, Hz, with equal amplitudes and Schroeder phases"
    )
    table: Annotated[CsvTable, SIGNAL_COLUMNS] | None = optional(
        "kind = table: signal over the vehicle clock, in the unit of the target"
    )

    def _check(self) -> None:
        if self.axis not in AXES[self.at]:
            raise refuse(f"{self.at} has no such axis", ", ".join(AXES[self.at]), "axis")
        if self.replaces and self.at in ("body_force", "body_torque", "thrust"):
            raise refuse("there is no command to replace", f"false at {self.at}", "replaces")
        used = () if self.kind == "table" else (AMPLITUDES[self.at],)
        for key in AMPLITUDES.values():
            if key not in used and getattr(self, key) is not None:
                allowed = used[0] if used else "the values of the table"
                raise refuse(f"has no meaning with {self.kind} at {self.at}", allowed, key)
        for key in used:
            self.needs(key, f"at is {self.at}", "a number")
        for key in ("frequency_hz", "stop_frequency_hz", "frequencies_hz"):
            if key in FREQUENCIES[self.kind]:
                self.needs(key, f"kind is {self.kind}", "numbers > 0, Hz")
            else:
                self.only_with((key,), False, "kind = " + ", ".join(k for k, v in FREQUENCIES.items() if key in v))
        if self.kind == "table":
            self.needs("table", "kind is table", SIGNAL_COLUMNS.allowed())
        else:
            self.only_with(("table",), False, "kind = table")
        if self.kind in ("doublet", "chirp"):
            self.needs("stop_s", f"kind is {self.kind}", "a number > start_s")
        if self.stop_s is not None and self.stop_s <= self.start_s:
            raise refuse("ends before it begins", f"more than start_s = {self.start_s:g}", "stop_s")

    @property
    def amplitude(self) -> float:
        """Return the amplitude in the unit of the target; 1 for a table."""
        value: float | None = getattr(self, AMPLITUDES[self.at])
        return 1.0 if value is None else value

    @property
    def highest_hz(self) -> tuple[float, ...]:
        """Return the highest frequencies of the signal, Hz; 0 for a frequency that is not given.

        Steps and tables need none, because the integrator restarts at their kinks.
        """
        return (*(self.frequencies_hz or ()), self.frequency_hz or 0.0, self.stop_frequency_hz or 0.0)


PROGRAMME_COLUMNS = Columns("time_s", sets=(("pitch_rate_degps",),), optional=("yaw_rate_degps", "roll_rate_degps"))
Ending = Literal["impact", "apogee", "burnout", "tumble"]


USUAL_STEP_S = 0.001
MOST_HALVINGS = 3
"""The largest number of halvings of the step of run.accuracy, which reduce 10 ms to 1.25 ms."""


class Run(Section):
    """The duration, the integration step and the end of the flight."""

    duration_s: Period = optional("maximum duration from start_s on, s, whole ns", 400.0)
    step_s: Annotated[Period, Field(le=1.0)] = optional("integrator step, s, whole ns", USUAL_STEP_S)
    accuracy: Annotated[float, Field(gt=0.0, le=0.1)] | None = optional(
        "allowed integration error, as a share of the requirements (docs/performance.md), from which the step "
        "follows, instead of step_s (campaigns: 0.05 if neither is given)"
    )
    halvings: Annotated[int, Field(ge=0, le=MOST_HALVINGS)] = optional(
        "number of times that the step of run.accuracy is halved", 0
    )
    seed: Annotated[int, Field(ge=0, lt=2**63)] = optional("seed of all noise", 1)
    start_s: Seconds = optional("vehicle clock at the start, s, whole ns", 0.0)
    freeze_vehicle_at_s: Seconds | None = optional(
        "vehicle clock at which mass, thrust and modes are frozen, without cutoff, s (default: never)"
    )
    stop_at: tuple[Ending, ...] = optional("events that end the flight; burnout: that of the last stage", ("impact",))

    def _check(self) -> None:
        if self.accuracy is not None and self.step_s != USUAL_STEP_S:
            raise refuse("the step follows from run.accuracy", "one of step_s, accuracy", "step_s")
        if self.accuracy is None and self.halvings > 0:
            raise refuse("there is no run.accuracy whose step could be halved", "0 without run.accuracy", "halvings")
        if self.step_s > self.duration_s:
            raise refuse("is longer than the flight", f"at most duration_s = {self.duration_s:g}", "step_s")
        if len(set(self.stop_at)) != len(self.stop_at):
            raise refuse("contains an event twice", "each event once", "stop_at")


class Guidance(Section):
    """The commanded body rates over time, and the targets of the last engine's burns."""

    programme: Annotated[CsvTable, PROGRAMME_COLUMNS] | None = optional(
        "commanded rates over the vehicle clock (default: zero)"
    )
    method: Literal["linear", "pchip", "step"] = optional("interpolation between the rows", "linear")
    axes: Literal["body", "unrolled"] = optional(
        "axes of pitch and yaw: those of the body, or axes without the commanded roll", "body"
    )
    orbit: OrbitTarget | None = optional("closed-loop guidance to this orbit, after the programme")
    cutoff: Cutoff | None = optional("cutoff of the last engine without closed-loop guidance, instead of orbit")
    restart: tuple[Restart, ...] = optional("further burns of the last engine", (), max_length=MAX_BURNS - 1)

    @property
    def ends(self) -> tuple[OrbitTarget | Cutoff | None, ...]:
        """Return the target of each burn of the last engine; None for a burn until the propellant is spent."""
        return self.orbit or self.cutoff, *(restart.orbit or restart.cutoff for restart in self.restart)

    def _check(self) -> None:
        self.at_most_one("orbit", "cutoff")
        for n, end in enumerate(self.ends[:-1]):
            if end is None:
                key = ("orbit",) if n == 0 else ("restart", n - 1, "orbit")
                raise refuse("required key is missing: another burn follows", "orbit or cutoff", key)


class HoldDown(Section):
    """The release of a vehicle that is held down."""

    release: Literal["thrust", "time"] = optional("release when thrust exceeds weight, or at release_s", "thrust")
    release_s: Seconds | None = optional('vehicle clock of the release, s, for release = "time"')
    clamped: bool = optional(
        "the vehicle is clamped at its first gimbal and bends on it (off: the body is held, and its modes are free)",
        False,
    )

    def _check(self) -> None:
        self.only_with(("release_s",), self.release == "time", "release = 'time'")
        if self.release == "time":
            self.needs("release_s", "release is 'time'", "a number >= 0")


class Switches(Section):
    """The switches that remove parts of the model or make them ideal."""

    aerodynamics: bool = optional("all aerodynamic forces", True)
    thrust: bool = optional("thrust", True)
    slosh: bool = optional("slosh pendulums; off: the liquid is frozen", True)
    slosh_exchange: bool = optional(
        "liquid that moves from a pendulum's bob to the core keeps its momentum (off: arrives at rest)", False
    )
    bending: bool = optional("bending modes", True)
    bending_softening: bool = optional("axial load softens the modes", True)
    follower_thrust: bool = optional("thrust turns with the mode slope at the gimbal", True)
    engine_inertia: bool = optional("reaction of the gimballed mass (tail wags dog)", True)
    tvc_load: bool = optional("engine on its compliance; off: it follows its actuators exactly", True)
    jet_damping: bool = optional("damping by the mass flow", True)
    moving_cg: bool = optional("rates of CG and inertia", True)
    actuator: Literal["full", "linear", "ideal"] = optional("linear: no limits; ideal: angle = command", "full")
    gyro: Literal["full", "ideal"] = optional("ideal: measures the true rate", "full")
    converter: Literal["full", "ideal"] = optional("ideal: no quantisation", "full")
    delay: bool = optional("compute delay", True)
    control: bool = optional("control law; off: command zero", True)
    guidance: bool = optional("guidance programme; off: rates zero", True)
    roll_control: bool = optional("roll thrusters", True)
    section_loads: bool = optional("section loads at the stations of [stage.loads]", False)
    local_incidence: bool = optional("bending changes the angle of attack of the lifting parts", True)
    gust_penetration: bool = optional(
        "wind, gusts and turbulence at the station of each lifting part (off: at the CG for all)", False
    )


class LogSection(Section):
    """The sample rates of the log."""

    fast_hz: Rate = optional("rate of actuator, bending, slosh, control and gyro, Hz; must divide 1e9", 1000.0)
    slow_hz: Rate = optional("rate of the other topics, Hz; must divide 1e9", 100.0)
    transform_hz: Rate = optional("rate of the transforms for 3-D viewers, Hz; must divide 1e9", 50.0)


class RequirementSection(Section):
    """A limit for a metric of the flight."""

    metric: str = Field(description="name of the metric")
    limit: float | None = optional("largest value allowed")
    minimum: float | None = optional("smallest value allowed")
    name: str = optional("name in reports (default: the metric)", "")

    @property
    def bound(self) -> tuple[str, float]:
        """Return the key `limit` or `minimum`, and its value."""
        return ("limit", self.limit) if self.limit is not None else ("minimum", self.minimum or 0.0)

    @model_validator(mode="after")
    def _judges(self) -> RequirementSection:
        self.at_most_one("limit", "minimum")
        if self.limit is None and self.minimum is None:
            raise refuse("required key is missing: a requirement needs a bound", "limit or minimum", "limit")
        if self.metric not in METRIC_NAMES:
            hint = suggestion(self.metric, METRIC_NAMES)
            problem = "unknown metric" + (f"; {hint}" if hint else "")
            raise refuse(problem, "" if hint else ", ".join(METRIC_NAMES), "metric")
        return self


class Scenario(Section):
    """A scenario with its complete vehicle and design, after all `extends` and overrides are applied."""

    schema_version: Literal[1] = optional("version of the format", 1, alias="schema")
    name: str = optional("default: the file's name", "")
    description: str = optional("description of the flight, one sentence", "")
    vehicle: Vehicle = Field(description="folder with vehicle.toml, a .toml file, or the vehicle itself")
    design: Design | None = optional("a design file, or the design itself (default: command zero)")
    run: Run = Run()
    site: Site = Site()
    earth: EarthSection = EarthSection()
    atmosphere: AtmosphereSection = AtmosphereSection()
    wind: WindSection = WindSection()
    initial: Initial | None = optional("absent: on the pad, nose up, at rest on the Earth, held down")
    guidance: Guidance = Guidance()
    holddown: HoldDown = HoldDown()
    rail: Rail | None = optional("absent: no launch rail")
    tower: Tower | None = optional("absent: none")
    range_safety: RangeSafety | None = optional("absent: no metrics of the impact point")
    navigation: NavigationSection | None = optional("absent: no errors except those of the gyros in the attitude")
    injection: tuple[Injection, ...] = optional("signals for tests", (), max_length=MAX_INJECTIONS)
    fault: tuple[Fault, ...] = optional(
        "failures of parts; of two entries for a part, the later holds", (), max_length=MAX_FAULTS
    )
    switches: Switches = Switches()
    log: LogSection = LogSection()
    requirement: tuple[RequirementSection, ...] = optional("limits of the flight", ())

    @property
    def held(self) -> bool:
        """Return True if the flight begins in hold-down."""
        return self.initial is None or self.initial.held

    def _check(self) -> None:
        self._check_control()
        self._check_faults()
        self._check_hold_down()
        self._check_launch()
        self._check_wind()
        self._check_section_loads()
        self._check_coverage()

    def _check_control(self) -> None:
        computer = self.vehicle.computer
        if self.design is not None:
            if computer is None:
                raise refuse("the vehicle has no [computer] to run a design on", key="design", value=self.design.name)
            stages = self.vehicle.stage
            if len(self.design.stage) > len(stages):
                problem = f"has {len(self.design.stage)} stages"
                raise refuse(problem, f"{len(stages)}, as the vehicle", ("design", "stage"))
            for n in range(len(stages)):
                self._check_filter(n)
                self._check_sensors(n)
        if self.guidance.axes == "unrolled" and (computer is None or computer.attitude != "quaternion"):
            raise refuse(
                "needs an attitude that can roll", "vehicle.computer.attitude = 'quaternion'", ("guidance", "axes")
            )
        self._check_burns()
        for n, injection in enumerate(self.injection):
            key = ("injection", n, "at")
            if injection.at in ("gimbal_command", "thrust") and not any(stage.engine for stage in self.vehicle.stage):
                raise refuse("the vehicle has no engine", "body_force, body_torque", key)
            if injection.at == "rate_command" and computer is None:
                raise refuse("the vehicle has no [computer]", "body_force, body_torque", key)
            if injection.at.endswith("_command") and computer is not None:
                self._check_aliases(n, injection)

    def _check_aliases(self, n: int, injection: Injection) -> None:
        """Reject a signal at a command that the samples of no stage's computer can follow."""
        samples_s = [c.sample_s for k in range(len(self.vehicle.stage)) if (c := self.vehicle.computer_of(k))]
        most_hz = 0.5 / min(samples_s)
        if max(injection.highest_hz) > most_hz:
            key = next(k for k in FREQUENCIES[injection.kind] if np.max(getattr(injection, k)) > most_hz)
            allowed = f"at most {most_hz:g} Hz, half of the sample rate"
            raise refuse("would alias", allowed, ("injection", n, key))

    def _check_burns(self) -> None:
        """Check the targets of the burns of the last engine, and that vehicle and Earth allow them."""
        keys = [(), *(("restart", n) for n in range(len(self.guidance.restart)))]
        for n, (key, end) in enumerate(zip(keys, self.guidance.ends, strict=True)):
            at = ("guidance", *key, "orbit" if isinstance(end, OrbitTarget) else "cutoff")
            if isinstance(end, OrbitTarget):
                self._check_attitude(at)
                self._check_gravity(at)
                self._check_inclination(end, at)
            elif end is not None:
                if not any(stage.engines for stage in self.vehicle.stage):
                    raise refuse("the vehicle has no engine", "a vehicle with [stage.engine]", at, value={})
                if end.apogee_altitude_m is not None:
                    self._check_gravity((*at, "apogee_altitude_m"))
            if n > 0 and self.guidance.restart[n - 1].before_apogee_s is not None:
                self._check_gravity(("guidance", *key, "before_apogee_s"))
        if self.guidance.restart:
            self._check_coast()

    def _check_coast(self) -> None:
        """Check that thrusters can turn the vehicle between two burns."""
        at, last, computer = ("guidance", "restart"), len(self.vehicle.stage) - 1, self.vehicle.computer
        self._check_attitude(at)
        assert computer is not None
        count = len(self.guidance.restart)
        if computer.law == "external":
            raise refuse("external flight code has no thrusters in pitch and yaw", "law = 'design'", at, value=count)
        thrusters = self.vehicle.stage[last].roll_thrusters
        if thrusters is None or thrusters.pitch_yaw_torque_Nm is None:
            allowed = f"vehicle.stage.{last}.roll_thrusters.pitch_yaw_torque_Nm"
            raise refuse("nothing turns the vehicle in its coast", allowed, at, value=count)
        if self.design is None or self.design.of_stage(last).roll is None:
            raise refuse("nothing switches the thrusters in the coast", "a design with [roll]", at, value=count)

    def _check_attitude(self, at: tuple[str | int, ...]) -> None:
        computer = self.vehicle.computer
        if computer is None or computer.attitude != "quaternion":
            raise refuse("needs an attitude in space", "vehicle.computer.attitude = 'quaternion'", at)

    def _check_gravity(self, at: tuple[str | int, ...], problem: str = "there are no orbits") -> None:
        if self.earth.gravity not in ("j2", "inverse_square"):
            raise refuse(problem, "earth.gravity = 'j2', 'inverse_square'", at)

    def _check_inclination(self, wanted: OrbitTarget, at: tuple[str | int, ...]) -> None:
        from maxq.sim.world.earth import WGS84_FLATTENING, geocentric_rad  # noqa: PLC0415  # lazy: imports Numba

        if wanted.inclination_deg is None:
            return
        given, on_ellipsoid = self.earth.flattening, self.earth.shape == "wgs84"
        flattening = (WGS84_FLATTENING if given is None else given) if on_ellipsoid else 0.0
        least = math.degrees(geocentric_rad(abs(self.site.latitude_deg), flattening))
        if not least - 1e-9 <= wanted.inclination_deg <= 180.0 - least + 1e-9:
            allowed = f"{least:.4g} to {180.0 - least:.4g}, from the site's geocentric latitude"
            raise refuse("no plane through the site has it", allowed, (*at, "inclination_deg"))

    def _check_launch(self) -> None:
        """Check rail, tower and navigation, and that the flight measures all required metrics of launch and cutoff."""
        given = [name for name in ATTITUDES if self.initial is not None and getattr(self.initial, name) is not None]
        for key in ("rail", "tower"):
            if getattr(self, key) is not None and not self.held:
                raise refuse("the flight begins in the air", "a vehicle that is held down", (key,), value={})
        computer = self.vehicle.computer
        if self.navigation is not None and computer is not None and computer.attitude != "quaternion":
            if any(self.navigation.alignment_error_deg):
                problem, allowed = "the computer has integrals of rates, no attitude", "attitude = 'quaternion'"
                raise refuse(problem, allowed, ("navigation", "alignment_error_deg"))
        if self.rail is not None and given:
            raise refuse("the rail sets the attitude", "without this key", ("initial", given[0]))
        if self.tower is not None:
            radius_m = self.tower.radius_m + self.tower.vehicle_radius(self.vehicle.reference.diameter_m)
            if self.tower.distance_m <= radius_m:
                raise refuse("the tower reaches into the vehicle", f"above {radius_m:g}", ("tower", "distance_m"))
        if self.range_safety is not None:
            self._check_gravity(("range_safety",), "there is no impact point")
        zone = self.range_safety is not None and self.range_safety.zone is not None
        last = self.guidance.ends[-1]
        aims = {
            "cutoff_speed_error_mps": isinstance(last, Cutoff) and last.apogee_altitude_m is None,
            "cutoff_apogee_error_m": last is not None and last.apogee_altitude_m is not None,
            "cutoff_perigee_error_m": isinstance(last, OrbitTarget),
        }
        for n, requirement in enumerate(self.requirement):
            needs = {
                "[rail]": requirement.metric == "rail_exit_speed_mps" and self.rail is None,
                "[tower]": requirement.metric in LaunchMetrics._fields[:2] and self.tower is None,
                "[range_safety]": requirement.metric in ImpactMetrics._fields and self.range_safety is None,
                "range_safety.zone": requirement.metric == "max_impact_excursion_m" and not zone,
                "guidance.orbit or guidance.cutoff, of the last burn": requirement.metric in CutoffMetrics._fields
                and last is None,
                "a last burn that aims at it": not aims.get(requirement.metric, True),
            }
            for allowed, missing in needs.items():
                if missing:
                    raise refuse("this flight does not measure it", allowed, ("requirement", n, "metric"))

    def _check_filter(self, stage: int) -> None:
        design, computer = self.design, self.vehicle.computer_of(stage)
        assert design is not None
        assert computer is not None
        own = stage < len(design.stage) and design.stage[stage].filter is not None
        key, flown = ("design", *(("stage", stage) if own else ()), "filter"), design.of_stage(stage).filter
        nyquist = 0.5 / computer.sample_s
        if flown.prewarp_hz is not None and flown.prewarp_hz >= nyquist:
            raise refuse("is above half the sample rate", f"less than {nyquist:g}", (*key, "prewarp_hz"))
        if unfit := flown.unfit(computer.sample_s):
            problem = f"cannot be run every {computer.sample_s:g} s: {unfit}"
            raise refuse(problem, key=(*key, "structure"), value=flown.structure)
        loops = design.of_stage(stage).loop_filters
        for name, each in () if loops is None else zip(type(loops).model_fields, loops.each, strict=True):
            if each is not None and (unfit := each.unfit(computer.sample_s)):
                problem = f"cannot be run every {computer.sample_s:g} s: {unfit}"
                raise refuse(problem, key=(*key[:-1], "loop_filters", name), value=each.structure)

    def _check_sensors(self, stage: int) -> None:
        assert self.design is not None
        flown, sensors, own = self.design.of_stage(stage), self.vehicle.stage[stage], stage < len(self.design.stage)
        if flown.law in (*RELIEF, *DRIFT) and sensors.accelerometer is None:
            raise refuse(
                "the vehicle has no accelerometer",
                "a vehicle with [stage.accelerometer]",
                ("design", "law"),
                value=flown.law,
            )
        gyros = 1 + len(sensors.rate_gyro)
        for axis, weights in zip(("pitch", "yaw"), flown.blend.axes if flown.blend is not None else (), strict=False):
            if len(weights) != gyros:
                at = ("stage", stage) if own and self.design.stage[stage].blend is not None else ()
                problem, allowed = f"has {len(weights)} weights", f"{gyros}: [stage.gyro] and each [[stage.rate_gyro]]"
                raise refuse(problem, allowed, ("design", *at, "blend", axis))

    def _check_faults(self) -> None:
        for n, fault in enumerate(self.fault):
            part, stages = KINDS[fault.kind].part, self.vehicle.stage
            if fault.stage is not None and fault.stage >= len(stages):
                raise refuse("the vehicle has no such stage", f"0 .. {len(stages) - 1}", ("fault", n, "stage"))
            concerned = stages if fault.stage is None else stages[fault.stage : fault.stage + 1]
            groups = max(len(stage.engine_groups) for stage in concerned)
            if fault.group is not None and fault.group >= groups:
                raise refuse("the vehicle has no such group", f"0 .. {groups - 1}", ("fault", n, "group"))
            owners = (self.vehicle,) if part in OF_VEHICLE else concerned
            if not any(getattr(owner, part) for owner in owners):
                if part in OF_VEHICLE:
                    raise refuse(f"there is no {part} to fail", f"with [{part}] only", ("fault", n, "kind"))
                raise refuse(f"there is no {part} to fail", f"with [{part}] in the stage only", ("fault", n, "kind"))
            gyros = 1 + len(self.vehicle.stage[0].rate_gyro)
            if fault.gyro is not None and fault.gyro > gyros:
                allowed = f"1 .. {gyros}: [stage.gyro], then each [[stage.rate_gyro]]"
                raise refuse("the vehicle has no such gyro", allowed, ("fault", n, "gyro"))
            forces = len(self.vehicle.stage[0].accelerometers)
            if fault.accelerometer is not None and fault.accelerometer > forces:
                allowed = f"1 .. {forces}: [stage.accelerometer], then each [[stage.further_accelerometer]]"
                raise refuse("the vehicle has no such accelerometer", allowed, ("fault", n, "accelerometer"))
            ideal = self.switches.gyro == "ideal" and part == "accelerometer"  # this switch applies to all sensors
            if ideal or getattr(self.switches, part, "") == "ideal":
                switch = "gyro" if ideal else part
                raise refuse(f"an ideal {part} cannot fail", f"switches.{switch} = 'full'", ("fault", n, "kind"))
            if fault.of_engines:
                self._check_engine_fault(n, fault, concerned)
            if fault.since == "liftoff" and not self.held:
                raise refuse("the flight begins in the air", "clock", ("fault", n, "since"))

    def _check_engine_fault(self, n: int, fault: Fault, concerned: tuple[Stage, ...]) -> None:
        if sum(bool(stage.engines) for stage in concerned) > 1:
            raise refuse("required key is missing: several stages have engines", "its number", ("fault", n, "stage"))
        engines = next(len(stage.engines) for stage in concerned if stage.engines)
        if fault.engine is not None and fault.engine >= engines:
            raise refuse("the stage has no such engine", f"0 .. {engines - 1}", ("fault", n, "engine"))

    def _check_hold_down(self) -> None:
        no_thrust = not (self.vehicle.stage[0].engines and self.switches.thrust)
        if self.held and self.holddown.release == "thrust" and no_thrust:
            raise refuse(
                "the vehicle is held down until thrust exceeds weight, but it has no thrust",
                "[initial] with held = false, or holddown.release = 'time'",
                ("holddown", "release"),
                value="thrust",
            )
        if not self.holddown.clamped:
            return
        first, key = self.vehicle.stage[0], ("holddown", "clamped")
        if not self.held or self.rail is not None:
            problem = "the vehicle is not held on a pad"
            raise refuse(problem, "with held = true in [initial], and without [rail]", key, value=True)
        if not first.engines:
            raise refuse("the first stage has no gimbal", "a stage with an engine", key, value=True)
        if first.spatial_modes is not None and first.bending is not None:
            raise refuse("a clamp of planar and spatial modes together is not modelled", "one kind", key, value=True)

    def _check_section_loads(self) -> None:
        if self.switches.section_loads and not any(stage.loads for stage in self.vehicle.stage):
            raise refuse("no stage has [stage.loads]", "false", ("switches", "section_loads"), value=True)
        for n, stage in enumerate(self.vehicle.stage):
            if self.switches.section_loads and stage.loads is not None:
                check_line_mass(stage.loads, stage.mass, ("vehicle", "stage", n))
        for n, requirement in enumerate(self.requirement):
            if requirement.metric.startswith(SECTION_PREFIX) and not self.switches.section_loads:
                problem = "section loads are switched off"
                raise refuse(problem, "switches.section_loads = true", ("requirement", n, "metric"))

    def _check_wind(self) -> None:
        profile = self.wind.profile
        if self.wind.ground is not None:
            return
        if profile is not None and self.wind.outside == "error" and profile["altitude_m"][0] > self.site.altitude_m:
            raise profile.refusal(
                "the profile begins above the site",
                f"at most {self.site.altitude_m:g}",
                "altitude_m",
                0,
                at=("wind", "profile"),
            )

    def _check_coverage(self) -> None:
        """Reject tables of vehicle, design and guidance that end before the powered flight does."""
        on, start_s, end_s = self.switches.thrust, self.run.start_s, self.run.start_s + self.run.duration_s
        powered_end_s = check_stages(self.vehicle.stage, end_s, on and self.run.freeze_vehicle_at_s is None)
        if powered_end_s == 0.0 or not on:
            return
        programme, gains = self.guidance.programme, self.design.gains if self.design is not None else None
        if programme is not None and self.switches.guidance and start_s < powered_end_s:
            check_programme(programme, start_s, min(powered_end_s, end_s))
        if gains is not None and gains.over == "time_s":
            for name, table in (("table", gains.table), ("yaw_table", gains.yaw_table)):
                if table is not None:
                    check_gains(table, ("design", "gains", name), powered_end_s)
