"""The sections of a vehicle: its stages, reference lengths and flight computer."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, Tag, model_validator

from maxq.control.kernel.limits import (
    MAX_BOOSTERS,
    MAX_ENGINES,
    MAX_FEED_LINES,
    MAX_PENDULUMS,
    MAX_SENSORS,
    MAX_STAGES,
    MAX_SURFACES,
    MAX_UNITS,
)
from maxq.control.structures import Attitude
from maxq.sim.input.errors import refuse
from maxq.sim.input.values import TABLE_FORM, NotNegative, Period, Positive, Seconds, Section, Triple, optional
from maxq.sim.scenario.flight_code import Address, CodeFile, LibraryFile, PythonClass, Settings, SourceFiles
from maxq.sim.scenario.schema_booster import FORM, LISTED, Booster, Engines
from maxq.sim.vehicle.actuator.section import ActuatorSection
from maxq.sim.vehicle.air.section import AeroSection
from maxq.sim.vehicle.body.section import Mass, Reference, joined
from maxq.sim.vehicle.buffet.section import BuffetSection
from maxq.sim.vehicle.engine.section import EngineSection, RollThrusters
from maxq.sim.vehicle.feed.section import FeedLineSection
from maxq.sim.vehicle.loads.section import LoadsSection, check_liquids, check_stations
from maxq.sim.vehicle.modes.section import BendingSection, SpatialModesSection
from maxq.sim.vehicle.modes.tables import (
    OVER_MASS,
    ModeTable,
    PointMass,
    SpatialModeTable,
    mode_table,
    over_time,
    spatial_mode_table,
)
from maxq.sim.vehicle.sensor.section import (
    Accelerometer,
    BarometerSection,
    GnssSection,
    GyroSection,
    MagnetometerSection,
    RateGyro,
)
from maxq.sim.vehicle.slosh.section import SECOND_MODE, Tank
from maxq.sim.vehicle.tvc_load.section import TvcLoadSection

_CODE = ("library", "python", "address")
_OF_BOOSTER = re.compile(r"booster\.(\d+)\.(engine|tank)(?:\.(\d+))?\.(.*)")


class ComputerSection(Section):
    """The flight computer: converter, sampling, delay and output."""

    sample_s: Period = Field(description="sample period, s, whole ns")
    delay_s: Seconds = Field(description="delay from sample to output, s, whole ns, at most sample_s")
    count_rad: NotNegative = Field(description="angle per pulse of the V/F converter, rad; 0: no quantisation")
    dac_step_deg: NotNegative = optional("step of the output, deg; 0: no quantisation", 0.0)
    attitude: Attitude = optional(
        "method of the attitude error; quaternion: strapdown, roll and tilt about body axes; rate-integral: separate "
        "integrals of the body rates (paper, eq. 33), for vehicles that turn about one axis",
        "quaternion",
    )
    angle_error_limit_deg: Positive = Field(description="clamp of the attitude error for the law, deg")
    command_limit_deg: Positive = Field(description="clamp of the gimbal command, deg")
    law: Literal["design", "external"] = optional("control law: that of the design, or external flight code", "design")
    library: LibraryFile | None = optional("flight code: shared library (C ABI of maxq_fsw.h)")
    python: PythonClass | None = optional("flight code: Python class, file.py:Class")
    address: Address | None = optional("flight code: computer behind a socket, tcp://127.0.0.1:PORT or udp://...")
    sources: SourceFiles | None = optional("sources of the library, a folder or file: hashed, not run")
    data: SourceFiles | None = optional(
        "folder or file that the flight code reads: hashed; guarded Python code can read no other data"
    )
    settings: Settings = optional("text passed to the flight code at its start", "")
    interface: Literal[1, 2] | None = optional("version of maxq_fsw.h that the computer at address uses (default: 1)")
    sequencing: Literal["scenario", "flight-code"] = optional(
        "source of ignitions, cutoffs, throttle and separations; flight-code: version 2", "scenario"
    )
    timeout_s: Positive = optional("time limit of the flight code for one sample, s", 2.0)
    guard: bool = optional("run the flight code in its own process; off: a crash ends maxq, for debuggers", True)

    sandbox: bool = optional(
        "run a library or Python class that is not trusted without files to write, sockets and processes (Linux)", False
    )

    @property
    def hashed_files(self) -> dict[str, CodeFile]:
        """Return the flight code, its sources and its data, by key."""
        every = {key: getattr(self, key) for key in ("library", "python", "sources", "data")}
        return {key: file for key, file in every.items() if file is not None}

    @property
    def sequences(self) -> bool:
        """Return True if flight code commands ignitions, cutoffs, throttle and separations."""
        return self.sequencing == "flight-code"

    @property
    def code_keys(self) -> tuple[str, ...]:
        """Return the given keys that name flight code."""
        return tuple(key for key in _CODE if getattr(self, key) is not None)

    def _check(self) -> None:
        self.only_with(_CODE, self.law == "external", "law = 'external'")
        self.at_most_one(*_CODE)
        self.only_with(("sources",), self.library is not None, "library")
        self.only_with(("interface",), self.address is not None, "address")
        if self.sequences and self.law != "external":
            raise refuse("the design commands no sequence", "flight-code with law = 'external'", ("sequencing",))
        if self.sequences and self.address is not None and self.interface != 2:
            raise refuse("needs version 2 of maxq_fsw.h", "flight-code with interface = 2", ("sequencing",))
        self.only_with(("data",), self.library is not None or self.python is not None, "library or python")
        if self.sandbox and (self.address is not None or not self.guard or not self.code_keys):
            raise refuse("is for a guarded library or Python class only", "false", ("sandbox",))
        if self.law == "external" and not self.code_keys:
            raise refuse("names no flight code", f"external with one of {', '.join(_CODE)}", ("law",))
        if self.delay_s > self.sample_s:
            raise refuse("is longer than the sample period", f"0 .. sample_s = {self.sample_s:g}", ("delay_s",))


class StageComputer(Section):
    """The keys of the flight computer that differ in a stage."""

    sample_s: Period | None = optional("sample period, s, whole ns")
    delay_s: Seconds | None = optional("delay from sample to output, s, whole ns, at most sample_s")
    dac_step_deg: NotNegative | None = optional("step of the output, deg; 0: no quantisation")
    angle_error_limit_deg: Positive | None = optional("clamp of the attitude error (anti-windup), deg")
    command_limit_deg: Positive | None = optional("clamp of the gimbal command, deg")


class Separation(Section):
    """The loads and rates on the next stage at a separation."""

    impulse_Ns: NotNegative = optional("forward impulse of retro-rockets or gas on the next stage, N s", 0.0)
    spring_J: NotNegative = optional("energy of the separation springs, J", 0.0)
    tip_off_degps: Triple = optional("initial rates of the next stage about x, y, z, deg/s", (0.0, 0.0, 0.0))
    ballistic_kgpm2: Positive | None = optional(
        "m / (C_D A) of what is dropped, kg/m2, for its impact point (default: impact in vacuum)"
    )


Actuators = Annotated[
    Annotated[ActuatorSection, Tag(TABLE_FORM)] | Annotated[tuple[ActuatorSection, ...], *LISTED], FORM
]


TvcLoads = Annotated[Annotated[TvcLoadSection, Tag(TABLE_FORM)] | Annotated[tuple[TvcLoadSection, ...], *LISTED], FORM]


class Stage(Section):
    """A stage. The clock of its tables starts at the preceding separation.

    The stage without its boosters is the core.
    """

    name: str = optional("name of the stage in logs (default: its number)", "")
    separation_s: Period | None = optional("end of this stage on its clock, s")
    separation_after_burnout_s: Seconds | None = optional(
        "end of this stage after burnout, s; if only boosters leave, after the last burnout among them"
    )
    separation: Separation | None = optional("springs, impulse and tip-off rates at its end")
    cutoff_decay_s: Seconds = optional(
        "duration of the linear thrust decay after a cutoff by the guidance, which allows for it, s", 0.0
    )
    cutoff_decay_factor: NotNegative = optional("factor on cutoff_decay_s, unknown to the guidance", 1.0)
    continues: bool = optional(
        "engines and tanks of the preceding stage remain, except those of separated boosters; gimbal angles, liquid "
        "and modes keep their motion",
        False,
    )
    clock: Literal["own", "preceding"] = optional(
        "preceding, with continues: tables and times of this stage are on the clock of the preceding stage", "own"
    )
    computer: StageComputer | None = optional("absent: the vehicle's computer unchanged")
    ignition_s: Seconds = optional("ignition on the stage clock, s", 0.0)
    interpolation: Literal["pchip", "linear"] = optional("interpolation of the tables over time", "pchip")
    mass: Mass
    engine: Engines | None = optional(f"one table, or up to {MAX_ENGINES} as a list [[...]]; absent: no thrust")
    actuator: Actuators | None = optional(
        "one table, or a list [[...]] by group of engines; absent: gimbal angle = command"
    )
    tvc_load: TvcLoads | None = optional(
        "one table, or a list [[...]] by group; absent, or groups without one: engines follow their actuators exactly"
    )
    tank: tuple[Tank, ...] = optional("tanks with sloshing liquid", (), max_length=MAX_PENDULUMS)
    bending: BendingSection | None = optional("absent: no planar modes")
    spatial_modes: SpatialModesSection | None = optional("absent: none")
    aero: AeroSection | None = optional("absent: no aerodynamic forces")
    gyro: GyroSection | None = optional("absent: ideal gyros")
    rate_gyro: tuple[RateGyro, ...] = optional(
        "rate gyros in addition to the first; the same number in all stages", (), max_length=MAX_SENSORS - 1
    )
    accelerometer: Accelerometer | None = optional("absent: none; all stages have one, or none")
    further_accelerometer: tuple[Accelerometer, ...] = optional(
        "accelerometers of further inertial units, for flight code; the same number in all stages",
        (),
        max_length=MAX_UNITS - 1,
    )
    booster: tuple[Booster, ...] = optional("bodies attached to the core; those that stay longest come first", ())
    roll_thrusters: RollThrusters | None = optional("absent: no roll control")
    loads: LoadsSection | None = optional("absent: no section loads")
    buffet: BuffetSection | None = optional("absent: no buffet")
    feed_line: tuple[FeedLineSection, ...] = optional(
        "feed lines whose oscillations couple with axial modes", (), max_length=MAX_FEED_LINES
    )

    @property
    def sensors(self) -> tuple[RateGyro | Accelerometer, ...]:
        """Return the sensors in addition to the first gyro: the other rate gyros, then the accelerometers."""
        return (*self.rate_gyro, *self.accelerometers)

    @property
    def accelerometers(self) -> tuple[Accelerometer, ...]:
        return (*((self.accelerometer,) if self.accelerometer is not None else ()), *self.further_accelerometer)

    @property
    def acted_stations_m(self) -> tuple[float, ...]:
        """Return the stations of feed lines and of buffet."""
        buffet_m = self.buffet.stations_m if self.buffet is not None else ()
        return (*(line.bottom_station_m for line in self.feed_line), *buffet_m)

    @property
    def counts(self) -> tuple[int, ...]:
        """Return the numbers of parts that keep their state when a stage continues.

        These are engine groups, pendulums, modes in pitch, in yaw and in space, 1 for TVC loads, feed lines, and 1 for
        the air's lag.
        """
        bending, spatial = self.bending, self.spatial_modes
        planes = (bending.pitch_modes, bending.yaw_modes) if bending is not None else (None, None)
        modes = [0 if plane is None else plane.modes for plane in planes]
        spatial_modes = len(spatial.damping_ratio) if spatial else 0
        late = self.aero is not None and self.aero.lag_m is not None
        further = int(self.tvc_load is not None), len(self.feed_line), int(late)
        return len(self.engine_groups), len(self.pendulum_names), *modes, spatial_modes, *further

    def leaving(self, following: Stage) -> tuple[Booster, ...]:
        """Return the boosters that leave before the next stage; none if the core leaves too."""
        staying = {booster.name for booster in following.booster}
        return tuple(b for b in self.booster if b.name not in staying) if following.continues else ()

    def without(self, boosters: Sequence[Booster]) -> Stage:
        """Return the stage after the separation of these boosters."""
        return self.model_copy(update={"booster": tuple(b for b in self.booster if b not in boosters)})

    @property
    def gated(self) -> bool:
        """Return True if thrust is set to zero outside the burn of each body, because another body may burn then."""
        return bool(self.booster) or self.clock == "preceding"

    @property
    def bodies(self) -> tuple[Stage | Booster, ...]:
        """Return the bodies with their own propellant: the core, then the boosters."""
        return (self, *self.booster)

    @property
    def own_engines(self) -> tuple[EngineSection, ...]:
        """Return the engines of the core."""
        return (self.engine,) if isinstance(self.engine, EngineSection) else self.engine or ()

    @property
    def engines(self) -> tuple[EngineSection, ...]:
        """Return all engines: those of the core, then those of each booster. An unpowered stage has none."""
        return (*self.own_engines, *(engine for booster in self.booster for engine in booster.engines))

    @property
    def engine_bodies(self) -> tuple[int, ...]:
        """Return, for each engine, the index of its body in `bodies`."""
        return tuple(b for b, body in enumerate(self.bodies) for _ in body.own_engines)

    @property
    def engine_masses(self) -> tuple[PointMass, ...]:
        """Return the gimballed masses of all engines, except those without mass."""
        out = []
        for b, e in zip(self.engine_bodies, self.engines, strict=True):
            attachments_m = self.booster[b - 1].attachments_m if b > 0 else ()
            out.append(PointMass(e.gimbal_station_m, attachments_m, e.gimballed_mass_kg, e.inertia_kgm2, e.arm_m))
        return tuple(each for each in out if each.mass_kg > 0.0)

    @property
    def tanks(self) -> tuple[tuple[int, str, Tank], ...]:
        """Return the body index, name and section of all tanks, those of the core first."""
        own = [(0, tank.name or str(n + 1), tank) for n, tank in enumerate(self.tank)]
        for b, booster in enumerate(self.booster, start=1):
            own += [(b, f"{booster.name}_{t.name or n + 1}", t) for n, t in enumerate(booster.tank)]
        return tuple(own)

    def mass_over_time(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times (n,), s, and the vehicle's mass properties (n, 10), linear between the rows of nominal tables.

        The times are on the clock of the tables, or on the stage clock if there are boosters. A row contains mass (kg),
        CG station, y and z (m), and the inertia integrals Ixx, Iyy, Izz, Ixy, Ixz, Iyz (kg m2).
        """
        own = self.mass.rows(self.ignition_s)
        if not self.booster:
            return own
        each = [(own, (0.0, 0.0))]
        for booster in self.booster:
            times, rows = booster.mass.rows(0.0)
            each.append(((times + booster.ignition_s, rows), booster.position_m))
        at = np.unique(np.concatenate([times for (times, _), _ in each]))
        parts = [
            (np.stack([np.interp(at, times, column) for column in rows.T], axis=1), place)
            for (times, rows), place in each
        ]
        return at, joined(parts)

    @property
    def engine_groups(self) -> tuple[str, ...]:
        """Return the names of the groups of gimballed engines, at least one, in the order of the engines."""
        return tuple(dict.fromkeys(e.group for e in self.engines if e.gimbal != "fixed")) or ("",)

    @property
    def actuators(self) -> tuple[ActuatorSection, ...]:
        """Return the actuators of each group of engines, in order; none if gimbal angles equal commands."""
        if not isinstance(self.actuator, tuple):
            return () if self.actuator is None else (self.actuator,) * len(self.engine_groups)
        by_group = {actuator.group or "": actuator for actuator in self.actuator}
        return tuple(by_group[group] for group in self.engine_groups)

    @property
    def tvc_loads(self) -> dict[str, TvcLoadSection]:
        """Return the TVC loads by group of engines."""
        if isinstance(self.tvc_load, tuple):
            return {load.group or "": load for load in self.tvc_load}
        return {} if self.tvc_load is None else dict.fromkeys(self.engine_groups, self.tvc_load)

    def engine_key(self, number: int) -> tuple[str | int, ...]:
        """Return the key of an engine of `engines` within the stage."""
        b = self.engine_bodies[number]
        body, number = self.bodies[b], number - self.engine_bodies.index(b)
        key: tuple[str | int, ...] = ("booster", b - 1) if b > 0 else ()
        return (*key, "engine", number) if isinstance(body.engine, tuple) else (*key, "engine")

    def tank_key(self, number: int) -> tuple[str | int, ...]:
        """Return the key of a tank of `tanks` within the stage."""
        bodies = [body for body, *_ in self.tanks]
        b, number = bodies[number], number - bodies.index(bodies[number])
        return ("booster", b - 1, "tank", number) if b > 0 else ("tank", number)

    def counted_key(self, key: str) -> str:
        """Return a key path of the stage with engines and tanks of boosters numbered after the parts of the core."""
        found = _OF_BOOSTER.fullmatch(key)
        if found is None:
            return key
        body, part, number, rest = int(found[1]) + 1, found[2], int(found[3] or 0), found[4]
        bodies = self.engine_bodies if part == "engine" else [b for b, *_ in self.tanks]
        return f"{part}.{list(bodies).index(body) + number}.{rest}"

    @model_validator(mode="after")
    def _modes_over_time(self) -> Stage:
        """Convert mode tables over mass to tables over time by the mass of the stage, and check all parts."""
        changed: dict[str, Any] = {}
        for section, keys, arrays in (
            ("bending", ("pitch", "yaw"), mode_table),
            ("spatial_modes", ("table",), spatial_mode_table),
        ):
            given = getattr(self, section)
            tables = {} if given is None else {key: getattr(given, key) for key in keys}
            over_mass = {key: table for key, table in tables.items() if table is not None and OVER_MASS in table}
            if over_mass and self.booster:
                raise refuse(
                    "modes over mass, of a stage with boosters", "a table over time_s", (section, next(iter(over_mass)))
                )
            if over_mass:
                times_s, mass_kg = self.mass.finely(self.ignition_s, self.interpolation)
                found = {k: over_time(table, times_s, mass_kg, (section, k)) for k, table in over_mass.items()}
                for key, table in found.items():
                    arrays(table, (section, key))
                changed[section] = given.model_copy(update=found)
                changed[section].check_counts((section,))
        out = self.model_copy(update=changed) if changed else self
        out._check_parts()
        return out

    def _check_parts(self) -> None:
        self.at_most_one("separation_s", "separation_after_burnout_s")
        if self.separation_after_burnout_s is not None and self.engine is None:
            raise refuse("the stage has no engine", "separation_s", "separation_after_burnout_s")
        if self.actuator is not None and all(engine.gimbal == "fixed" for engine in self.engines):
            raise refuse("the stage has no engine to move", "[stage.engine]", "actuator", value={})
        self._check_boosters()
        names = [tank.name or str(n + 1) for n, tank in enumerate(self.tank)]
        for n, name in enumerate(names):
            if name in names[:n]:
                raise refuse("is already the name of another tank", "each name once", ("tank", n, "name"), value=name)
        self._check_engines()
        for n, line in enumerate(self.feed_line):
            if line.engine >= len(self.own_engines):
                allowed = f"0 .. {len(self.own_engines) - 1}" if self.own_engines else "a stage with an engine"
                raise refuse("the core has no such engine", allowed, ("feed_line", n, "engine"), value=line.engine)
        self._check_groups("actuator", self.actuator, all_of_them=True)
        if self.further_accelerometer and self.accelerometer is None:
            raise refuse("there is no first accelerometer", "[stage.accelerometer]", "further_accelerometer", value={})
        if len(self.sensors) > MAX_SENSORS:
            problem, allowed = f"{len(self.sensors)} sensors after the first gyro", f"up to {MAX_SENSORS}"
            raise refuse(problem, allowed, "further_accelerometer", value=len(self.further_accelerometer))
        if len(self.pendulum_names) > MAX_PENDULUMS:
            problem = f"{len(self.pendulum_names)} slosh modes in all"
            raise refuse(problem, f"up to {MAX_PENDULUMS} of all tanks of a stage", "tank", value=len(self.tank))
        self._check_tvc_load()
        if self.aero is not None and self.aero.lag_m is not None and self.bending is None:
            raise refuse("the stage has no planar modes", "[stage.bending]", ("aero", "lag_m"), value=self.aero.lag_m)
        self._check_slosh_mass()
        self._check_stations()
        self._check_spatial_modes()
        if self.loads is not None:
            gimbal_station_m = min((engine.gimbal_station_m for engine in self.own_engines), default=None)
            check_stations(self.loads, gimbal_station_m)
            check_liquids(self.loads, names)

    def _check_spatial_modes(self) -> None:
        given = self.spatial_modes
        if given is None or given.modes.mass_kg is None:
            return
        from maxq.sim.vehicle.modes.masses import misfit  # noqa: PLC0415  # lazy: it imports the compiler

        found = misfit(given.modes, self.engine_masses, (2.0, 0.5))
        if found:
            raise given.table.refusal(found, "1 and 0: orthogonal modes", at=("spatial_modes", "table"))

    def _check_boosters(self) -> None:
        named = [booster.name for booster in self.booster]
        for n, name in enumerate(named):
            if name in named[:n]:
                raise refuse("another booster has this name", "each name once", ("booster", n, "name"), value=name)
        if len(self.engines) > MAX_ENGINES:
            problem, allowed = f"{len(self.engines)} engines in all", f"up to {MAX_ENGINES} of core and boosters"
            raise refuse(problem, allowed, "booster", value=len(self.booster))
        if len(self.booster) > MAX_BOOSTERS and self.loads is not None:
            raise refuse(
                "too many boosters for section loads", f"up to {MAX_BOOSTERS}", "booster", value=len(self.booster)
            )
        lifting = sum(b.aero is not None and "CN_alpha_pr" in b.aero.table for b in self.booster)
        own = len(self.aero.surface) + len(self.aero.coefficients) if self.aero is not None else 0
        if lifting and own + lifting > MAX_SURFACES:
            problem = f"{own + lifting} surfaces and tables with the boosters"
            raise refuse(problem, f"{MAX_SURFACES} in all", "booster", value=len(self.booster))
        for n, booster in enumerate(self.booster):
            if booster.aero is not None and self.aero is None:
                raise refuse("the stage has no aerodynamics", "[stage.aero]", ("booster", n, "aero"), value={})

    def mode_tables(self) -> list[tuple[str, ModeTable | SpatialModeTable]]:
        """Return the keys and mode tables of the stage; a table for both planes appears once."""
        out: list[tuple[str, ModeTable | SpatialModeTable]] = []
        bending = self.bending
        if bending is not None:
            planes = [("bending.pitch", bending.pitch_modes)]
            planes += [("bending.yaw", bending.yaw_modes)] if bending.yaw != bending.pitch else []
            out += [(key, table) for key, table in planes if table is not None]
        if self.spatial_modes is not None:
            out.append(("spatial_modes.table", self.spatial_modes.modes))
        return out

    def _check_engines(self) -> None:
        names = [engine.name for engine in self.engines]
        for n, engine in enumerate(self.engines):
            if engine.name and names.index(engine.name) != n:
                raise refuse("another engine has this name", "a name for each engine", (*self.engine_key(n), "name"))
            first = self.bodies[self.engine_bodies[n]].own_engines[0]
            if ("mass_flow_kgps" in engine.table) != ("mass_flow_kgps" in first.table):
                raise engine.table.refusal(
                    "some engines have a column mass_flow_kgps and some have none",
                    "all or none",
                    at=(*self.engine_key(n), "table"),
                )

    def _check_groups(self, key: str, given: Any, *, all_of_them: bool) -> None:
        """Check that each entry of a list is for another group of engines. A single table serves all groups.

        With `all_of_them`, each group needs an entry.
        """
        groups = self.engine_groups
        allowed = ", ".join(repr(group) for group in groups)
        if not isinstance(given, tuple):
            if given is not None and given.group is not None:
                raise refuse("one table moves all groups of engines", f"a list [[{key}]]", (key, "group"))
            return
        named = [each.group or "" for each in given]
        for n, group in enumerate(named):
            if group not in groups:
                raise refuse("no gimballed engine is of this group", allowed, (key, n, "group"), value=group)
            if group in named[:n]:
                raise refuse("already has an entry", "each group once", (key, n, "group"), value=group)
        missing = [group for group in groups if group not in named]
        if missing and all_of_them:
            raise refuse(f"no entry for group {missing[0]!r}", f"one for each of {allowed}", (key,), value=len(given))

    @property
    def pendulum_names(self) -> tuple[str, ...]:
        """Return the names of the simulated slosh modes in the log, tank by tank."""
        names = [(name, tank.pendulums) for _, name, tank in self.tanks]
        return tuple(name + ("" if mode == 0 else f"_{mode + 1}") for name, modes in names for mode in range(modes))

    def _check_tvc_load(self) -> None:
        moved = [engine for engine in self.engines if engine.gimbal != "fixed"]
        if self.tvc_load is not None and not moved:
            raise refuse("no gimballed engine", "[stage.engine]", "tvc_load", value={})
        self._check_groups("tvc_load", self.tvc_load, all_of_them=False)
        for n, engine in enumerate(self.engines):
            if engine in moved and engine.group in self.tvc_loads and engine.inertia_about_gimbal_kgm2 == 0.0:
                key = (*self.engine_key(n), "inertia_about_gimbal_kgm2")
                raise refuse("an engine without inertia cannot swing on a TVC load", "a number > 0", key, value=0.0)
        for group, actuator in zip(self.engine_groups, self.actuators, strict=False):
            stalls = [axis.stall_torque_Nm for axis in actuator.axes if axis.stall_torque_Nm is not None]
            if group not in self.tvc_loads and stalls:
                at = ("actuator", self.actuator.index(actuator)) if isinstance(self.actuator, tuple) else ("actuator",)
                at = (*at, "yaw") if actuator.stall_torque_Nm is None else at
                problem = "without a TVC load the engine follows its actuator at any torque"
                raise refuse(problem, "[stage.tvc_load]", (*at, "stall_torque_Nm"), value=stalls[0])

    def _check_slosh_mass(self) -> None:
        """Check that each body has more mass than its sloshing liquids and gimballed engines."""
        for b, body in enumerate(self.bodies):
            self._check_slosh_mass_of(body, ("booster", b - 1) if b > 0 else ())

    def _check_slosh_mass_of(self, body: Stage | Booster, key: tuple[str | int, ...]) -> None:
        tables = [tank.table for tank in body.tank]
        of_mass = [] if body.mass.table is None else [body.mass.table]
        times = np.unique(np.concatenate([np.zeros(1), *(table["time_s"] for table in (*tables, *of_mass))]))
        if body.mass.table is not None:
            total = np.interp(times, body.mass.table["time_s"], body.mass.table["mass_kg"])
        else:
            flow, burn = body.mass.mass_flow_kgps or 0.0, body.mass.burn_s or 0.0
            total = (body.mass.mass_kg or 0.0) - flow * np.clip(times, 0.0, burn)
        moving = np.zeros(len(times))
        for factor, table in zip((tank.mass_factor for tank in body.tank), tables, strict=True):
            of_liquid = "liquid_mass_kg" in table  # with a shape: the whole liquid, above the sloshing mass
            mass = table["liquid_mass_kg"] if of_liquid else table["slosh_mass_kg"] + table.get(SECOND_MODE[0])
            moving += factor * np.interp(times, table["time_s"], mass)
        if (moving >= total).any():
            worst = int(np.argmax(moving - total))
            raise refuse(
                f"at {times[worst]:g} s {moving[worst]:g} kg slosh in a vehicle of {total[worst]:g} kg",
                "sloshing masses below the mass of the vehicle",
                (*key, "tank"),
            )
        if body.own_engines and sum(e.gimballed_mass_kg for e in body.own_engines) >= float((total - moving).min()):
            first = ("engine", 0) if isinstance(body.engine, tuple) else ("engine",)
            raise refuse(
                "the gimballed mass is more than the vehicle's",
                f"less than {float((total - moving).min()):g}",
                (*key, *first, "gimballed_mass_kg"),
            )

    def _check_stations(self) -> None:
        """Check that the mode shapes include every station with a load or a sensor."""
        needed: list[tuple[tuple[str | int, ...], float]] = []
        for n, engine in enumerate(self.own_engines):
            needed.append(((*self.engine_key(n), "gimbal_station_m"), engine.gimbal_station_m))
        for n, booster in enumerate(self.booster):
            needed += [(("booster", n, "attachments_m"), station) for station in booster.attachments_m]
        if self.gyro is not None:
            needed.append((("gyro", "station_m"), self.gyro.station_m))
        needed += [(("rate_gyro", n, "station_m"), gyro.station_m) for n, gyro in enumerate(self.rate_gyro)]
        if self.accelerometer is not None:
            needed.append((("accelerometer", "station_m"), self.accelerometer.station_m))
        for n, accelerometer in enumerate(self.further_accelerometer):
            needed.append((("further_accelerometer", n, "station_m"), accelerometer.station_m))
        for n, tank in enumerate(self.tank):
            for name in ("hinge_station_m", SECOND_MODE[2]):
                if name in tank.table:
                    hinge = tank.table[name]
                    needed += [(("tank", n, "table"), float(x)) for x in (hinge.min(), hinge.max())]
            if tank.shape is not None:
                bottom = tank.bottom_station_m or 0.0
                top = bottom - (tank.radius_m or 0.0) * tank.profile.height
                needed += [(("tank", n, "bottom_station_m"), station) for station in (top, bottom)]
        for n, surface in enumerate(self.aero.surface if self.aero is not None else ()):
            place = surface.table["station_m"]
            needed += [(("aero", "surface", n, "table"), float(x)) for x in (place.min(), place.max())]
        for n, table in enumerate(self.aero.coefficients if self.aero is not None else ()):
            if table.station_m is not None:
                needed.append((("aero", "coefficients", n, "station_m"), table.station_m))
        needed += [
            (("feed_line", n, "bottom_station_m"), line.bottom_station_m) for n, line in enumerate(self.feed_line)
        ]
        if self.buffet is not None:
            needed += [(("buffet", "table"), station) for station in self.buffet.stations_m]
        for _, modes in self.mode_tables():
            nose, tail = float(modes.station_m[0]), float(modes.station_m[-1])
            for key, station in needed:
                if not nose <= station <= tail:
                    raise refuse(
                        "this station lies beyond the mode shapes", f"{nose:g} .. {tail:g}", key, value=station
                    )


class Vehicle(Section):
    """The vehicle, given by a file vehicle.toml."""

    schema_version: Literal[1] = optional("version of the format", 1, alias="schema")
    name: str = optional("name of the vehicle", "")
    description: str = optional("description, one sentence", "")
    reference: Reference
    stage: tuple[Stage, ...] = Field(min_length=1, max_length=MAX_STAGES, description="stages in the order of flight")
    computer: ComputerSection | None = optional("absent: no flight computer; the gimbal angle stays at zero")
    gnss: GnssSection | None = optional("absent: none")
    barometer: BarometerSection | None = optional("absent: none")
    magnetometer: MagnetometerSection | None = optional("absent: none")

    def _check(self) -> None:
        last = len(self.stage) - 1
        for n, stage in enumerate(self.stage):
            separates = stage.separation_s is not None or stage.separation_after_burnout_s is not None
            if n < last and not separates:
                raise refuse(
                    "required key is missing: another stage follows",
                    "separation_s or separation_after_burnout_s",
                    ("stage", n, "separation_s"),
                )
            if n == last and separates:
                key = "separation_s" if stage.separation_s is not None else "separation_after_burnout_s"
                raise refuse("the last stage does not separate", "this key on earlier stages", ("stage", n, key))
            if n == last and stage.separation is not None:
                key = "separation"
                raise refuse("the last stage does not separate", "this key on earlier stages", ("stage", n, key))
            kinds, first = ((len(s.rate_gyro), len(s.accelerometers)) for s in (stage, self.stage[0]))
            if kinds != first:
                key = "rate_gyro" if kinds[0] != first[0] else "accelerometer"
                problem, allowed = (
                    "this stage has other sensors than the first",
                    "as many rate gyros and accelerometers",
                )
                raise refuse(problem, allowed, ("stage", n, key), value={})
            self._check_goes_on(n, stage)

    def _check_goes_on(self, n: int, stage: Stage) -> None:
        if stage.clock == "preceding" and not stage.continues:
            raise refuse("the stage does not continue", "with continues = true", ("stage", n, "clock"))
        if stage.booster and stage.continues:
            names, before = [b.name for b in stage.booster], [b.name for b in self.stage[n - 1].booster] if n else []
            if names != before[: len(names)]:
                allowed = ", ".join(before) or "none"
                problem = "boosters that stay are the first of the preceding stage, in the same order"
                raise refuse(problem, allowed, ("stage", n, "booster"), value=", ".join(names))
        leave = self.stage[n - 1].leaving(stage) if n > 0 else ()
        mine, kept = list(stage.counts), list(self.stage[n - 1].without(leave).counts) if n > 0 else []
        if leave:
            mine[2:5] = kept[2:5]  # the modes belong to another configuration
            if stage.clock == "own":
                problem = "boosters leave, and the core burns on"
                raise refuse(problem, '"preceding"', ("stage", n, "clock"), value=stage.clock)
        late = stage.ignition_s > 0.0 and stage.clock == "own"
        if stage.continues and (n == 0 or mine != kept or late):
            raise refuse(
                "there is no stage before with as many engine groups, slosh modes and bending modes that burns on",
                "false",
                ("stage", n, "continues"),
                value=True,
            )
        if stage.computer is None:
            return
        if self.computer is None:
            raise refuse("the vehicle has no [computer]", "[computer]", ("stage", n, "computer"), value={})
        if (own := self.computer_of(n)) is not None and own.delay_s > own.sample_s:
            problem, allowed = "is longer than the sample period", f"0 .. sample_s = {own.sample_s:g}"
            raise refuse(problem, allowed, ("stage", n, "computer", "delay_s"), value=own.delay_s)

    def computer_of(self, number: int) -> ComputerSection | None:
        """Return the computer of stage `number`, counted from 0; None if the vehicle has none."""
        own = self.stage[number].computer
        if self.computer is None or own is None:
            return self.computer
        return self.computer.model_copy(update={k: v for k, v in dict(own).items() if v is not None})
