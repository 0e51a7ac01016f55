"""The layout of a launcher: the data that a designer has before there are tables.

Stations are in m aft of the nose of the whole vehicle. A stage flies with all parts ahead of it.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from maxq.control.kernel.limits import MAX_BURNS, MAX_PENDULUMS, MAX_STAGES
from maxq.sim.input import values
from maxq.sim.input.errors import refuse
from maxq.sim.input.foreign import RASP
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import Fraction, NotNegative, Pair, Positive, Section, optional
from maxq.sim.scenario.loader import load_file
from maxq.sim.scenario.schema_launch import Rail, Restart
from maxq.sim.vehicle.actuator.section import SECTIONS
from maxq.sim.vehicle.air.section import AeroSection
from maxq.sim.vehicle.loads.section import SectionStations, check_stations
from maxq.sim.vehicle.modes.section import BendingSection, SpatialModesSection
from maxq.sim.vehicle.slosh.section import Profile, check_domes
from maxq.sim.vehicle.tvc_load.section import TvcLoadSection
from maxq.sim.world.earth import WGS84_RADIUS_m
from maxq.tools.vehicle.azimuth import launch_azimuth_deg

LAYOUT_THRUST_COLUMNS = Columns(
    "time_s",
    sets=(("thrust_vacuum_N",),),
    optional=("mass_flow_kgps", "isp_vacuum_s"),
    not_negative=("thrust_vacuum_N", "mass_flow_kgps", "isp_vacuum_s"),
    begins_by=0.0,
    foreign=RASP,
)


class Between(Section):
    """A part between two stations."""

    front_station_m: float = Field(description="forward end, m aft of the nose")
    rear_station_m: float = Field(description="aft end, m aft of the nose")

    def _check(self) -> None:
        if self.rear_station_m <= self.front_station_m:
            raise refuse("ends where it begins, or before", f"above {self.front_station_m:g}", ("rear_station_m",))


class DryMass(Between):
    """A dry mass on a thin ring, spread evenly between two stations."""

    name: str = Field(description="name of the part")
    mass_kg: Positive = Field(description="mass, kg")
    radius_m: Positive | None = optional("radius of the ring, m (default: that of its stage)")
    gyration_m: Pair | None = optional(
        "radii of gyration of its cross-section about and across the axis, m (default: those of the ring)"
    )


class Shell(Between):
    """A section of the load-carrying structure: its bending stiffness, and its mass if no part includes it."""

    EI_Nm2: Positive | None = optional("bending stiffness, N m2")
    rear_EI_Nm2: Positive | None = optional("bending stiffness at the aft end, linear between, N m2 (default: EI_Nm2)")
    radius_m: Positive | None = optional("radius of a thin wall, m (default: that of its stage)")
    wall_m: Positive | None = optional("thickness of the wall, m: EI = pi E r^3 t")
    modulus_Pa: Positive | None = optional("Young's modulus of the wall, Pa")
    strength_Pa: Positive | None = optional("allowable stress, Pa; with modulus_Pa it limits section loads")
    density_kgpm3: NotNegative = optional("density of the wall, kg/m3; 0: its mass is in the parts", 0.0)

    def _check(self) -> None:
        wall = self.wall_m is not None and self.modulus_Pa is not None
        if (self.EI_Nm2 is None) == (not wall):
            raise refuse("no stiffness, or two", "EI_Nm2, or wall_m with modulus_Pa", ("EI_Nm2",))

    def stiffness_Nm2(self, station_m: float, radius_m: float) -> float:
        """Return the bending stiffness at a station. `radius_m` is the radius of the stage."""
        if self.EI_Nm2 is None:
            return math.pi * (self.modulus_Pa or 0.0) * (self.radius_m or radius_m) ** 3 * (self.wall_m or 0.0)
        share = (station_m - self.front_station_m) / (self.rear_station_m - self.front_station_m)
        return self.EI_Nm2 + share * ((self.rear_EI_Nm2 or self.EI_Nm2) - self.EI_Nm2)


class LayoutTank(Section):
    """An upright tank with the propellant in it."""

    name: values.ChannelPart = Field(description="name of the tank in logs")
    liquid_mass_kg: Positive = Field(description="propellant at liftoff, kg")
    residual_kg: NotNegative = optional("propellant left at burnout, kg", 0.0)
    density_kgpm3: Positive = Field(description="density of the propellant, kg/m3")
    radius_m: Positive = Field(description="inner radius, m")
    height_m: Positive = Field(description="inner height, domes included, m")
    dome_m: Pair = optional("heights of half-ellipsoidal domes, bottom and top, m; 0: flat", (0.0, 0.0))
    bottom_station_m: float = Field(description="aft end, m aft of the nose")
    position_m: Pair = optional(
        "y and z of its axis from that of the stage or booster, m; liquids off the axis balance each other", (0.0, 0.0)
    )
    damping_ratio: Fraction = optional("damping ratio of the slosh mode; 0.01 to 0.03 with ring baffles", 0.01)
    roll_share: Fraction = optional("share of the liquid's solid-body roll inertia that turns with the walls", 0.0)

    @property
    def profile(self) -> Profile:
        """Return the profile of the tank, in units of its radius."""
        bottom, top = (dome / self.radius_m for dome in self.dome_m)
        return Profile(bottom, self.height_m / self.radius_m - bottom - top, top)

    def _check(self) -> None:
        check_domes(self.profile, self.radius_m)


class Grain(Between):
    """A solid propellant grain, which does not slosh. All grains of a stage burn in proportion to their mass."""

    mass_kg: Positive = Field(description="mass, kg")
    radius_m: Positive | None = optional("outer radius, m (default: that of its stage)")
    burns: Literal["uniform", "port", "end"] = optional(
        "uniform: the density decreases; port: from a cylindrical port outwards; end: from the aft face forward",
        "uniform",
    )
    port_radius_m: Positive | None = optional("radius of the port at ignition, m (default: none)")

    def _check(self) -> None:
        super()._check()
        self.only_with(("port_radius_m",), self.burns == "port", "burns = 'port'")


def check_balance(tanks: tuple[LayoutTank, ...]) -> None:
    """Check that the liquids off the axis balance each other, full and drained."""
    for name in ("liquid_mass_kg", "residual_kg"):
        first = [sum(getattr(t, name) * t.position_m[k] for t in tanks) for k in (0, 1)]
        largest = max((getattr(t, name) * math.hypot(*t.position_m) for t in tanks), default=0.0)
        if max(map(abs, first)) > 1e-6 * largest:
            problem = f"{name} off the axis has the moments {first[0]:g} and {first[1]:g} kg m along y and z"
            raise refuse(problem, "tanks that balance each other", ("tank",), value=len(tanks))


def check_grains(grains: tuple[Grain, ...], radius_m: float) -> None:
    """Check that each port is inside its grain. `radius_m` is the radius of the stage.

    Raises the error of an input file at the first port that is not.
    """
    for n, grain in enumerate(grains):
        outside = grain.radius_m or radius_m
        if (port := grain.port_radius_m) is not None and port >= outside:
            raise refuse("is not inside the grain", f"below {outside:g}", ("grain", n, "port_radius_m"), value=port)


_STACKED = ("upper", "middle", "lower")  # names of groups by the sign of z, which points down


class LayoutThrust(Section):
    """Equal engines: their thrust, places and masses."""

    positions_m: tuple[Pair, ...] = optional("y and z of each gimbal, m", ((0.0, 0.0),), min_length=1)
    thrust: Annotated[CsvTable, LAYOUT_THRUST_COLUMNS] | None = optional(
        "thrust of each over time from ignition, CSV, RASP (.eng) or RockSim (.rse), instead of thrust_vacuum_N and "
        "ramps. The flow is proportional to mass_flow_kgps, to thrust / isp_vacuum_s, or without these columns to "
        "thrust; its integral is the propellant"
    )
    thrust_vacuum_N: Positive | None = optional("vacuum thrust of each, N")
    isp_vacuum_s: Positive | None = optional("specific impulse in vacuum, s; with thrust, only compared with it")
    temperature_sensitivity_1pK: NotNegative = optional(
        "sensitivity of a solid motor's burn rate and thrust at constant total impulse, 1/K; 0.001 to 0.004", 0.0
    )
    roll_arm_m: float = optional("roll torque of the exhaust of each per newton of thrust, m", 0.0)
    exit_area_m2: NotNegative = optional("nozzle exit area of each, m2", 0.0)
    gimbal_station_m: float = Field(description="station of the gimbals, m aft of the nose: end of the beam")
    exit_station_m: float = Field(description="station of the nozzle exits, m aft of the nose")
    mass_kg: Positive = Field(description="mass of each, kg, between gimbal and exit")
    rear_station_m: float | None = optional("aft end of this mass, m aft of the nose (default: exit_station_m)")
    thrust_end_share: Annotated[float, Field(gt=0.0, le=1.5)] = optional(
        "thrust at the end of the burn relative to its beginning, with linear decrease (a pressure-fed chamber)", 1.0
    )
    ramp_s: Positive = optional("time from ignition to full thrust, s", 0.3)
    tail_off_s: Positive = optional("time from full thrust to none, s", 0.3)

    def _check(self) -> None:
        self.at_most_one("thrust", "thrust_vacuum_N")
        if (table := self.thrust) is not None and "isp_vacuum_s" in table:
            if "mass_flow_kgps" in table:
                problem = "both mass_flow_kgps and isp_vacuum_s give the flow"
                raise table.refusal(problem, "one of these columns", at=("thrust",))
            none = table["isp_vacuum_s"] <= 0.0
            table.refuse_where(none, "isp_vacuum_s", "is not a number > 0", "> 0", at=("thrust",))
        if self.thrust is None:
            self.needs("thrust_vacuum_N", "thrust is not given", "a number > 0")
            self.needs("isp_vacuum_s", "thrust is not given", "a number > 0")


class LayoutEngines(LayoutThrust):
    """Equal engines with their gimbals and actuators."""

    gimballed_mass_kg: NotNegative | None = optional("gimballed mass of each, kg (default: 0.8 of mass_kg)")
    cg_from_gimbal_m: NotNegative | None = optional("its CG aft of the gimbal, m (default: 0.3 of the length)")
    inertia_about_gimbal_kgm2: Positive | None = optional("its inertia, kg m2 (default: a rod from gimbal to exit)")
    angle_limit_deg: Positive = optional("gimbal angle limit, deg", 6.0)
    rate_limit_degps: Positive = optional("gimbal rate limit, deg/s", 30.0)
    servo_hz: tuple[Positive, ...] = optional("one, two or four natural frequencies of the actuator, Hz", (7.0,))
    servo_zeta: tuple[Positive, ...] = optional("damping ratios of the actuator", (0.7,))
    tvc_load: TvcLoadSection | None = optional(
        "compliance, flexible bearing and friction of each, as in a vehicle file (absent: the engine follows its "
        "actuators)"
    )

    def _check(self) -> None:
        super()._check()
        if self.tvc_load is not None and self.tvc_load.group is not None:
            raise refuse("one table is that of all engines", "none", ("tvc_load", "group"))
        if len(self.servo_hz) != len(self.servo_zeta) or len(self.servo_hz) not in SECTIONS.values():
            allowed = "as many of each: one, two or four"
            raise refuse(f"{len(self.servo_hz)} frequencies, {len(self.servo_zeta)} ratios", allowed, ("servo_hz",))

    @property
    def groups(self) -> tuple[str, ...]:
        """Return the group of each engine: its side of the axis, or above and below if all are in the pitch plane."""
        across, names = (0, ("left", "middle", "right")) if any(y for y, _ in self.positions_m) else (1, _STACKED)
        return tuple(names[int(np.sign(at[across])) + 1] for at in self.positions_m)


class LayoutNozzles(LayoutEngines):
    """The engines of a booster, all equal."""

    gimbal: Literal["both", "fixed"] = optional("both: the engines of each booster move together", "fixed")

    def _check(self) -> None:
        super()._check()
        self._check_fixed()
        if self.tvc_load is not None:
            raise refuse("boosters follow their actuators", "none", "tvc_load", value={})

    def _check_fixed(self) -> None:
        moving = [name for name in LayoutEngines.model_fields if name not in LayoutThrust.model_fields]
        for name in moving:
            if self.gimbal == "fixed" and name in self.model_fields_set:
                raise refuse("has no meaning here", "this key with gimbal = 'both' only", name)


class StageEngines(LayoutNozzles):
    """The engines of a stage, all equal. Several engines form groups to the left and right of the axis, and on it."""

    gimbal: Literal["both", "fixed"] = optional("fixed, in every stage: the vehicle flies unguided from a rail", "both")
    mass_kg: NotNegative = Field(
        description="mass of each, kg, between gimbal and exit; with fixed nozzles, 0 if the motor is among the parts"
    )

    def _check(self) -> None:
        LayoutEngines._check(self)
        self._check_fixed()
        if self.gimbal == "both" and self.mass_kg == 0.0:
            raise refuse("a gimballed engine has mass", "a number > 0", "mass_kg", value=0.0)


class LayoutFins(Section):
    """A set of fins with trapezoidal planform."""

    count: Annotated[int, Field(ge=3, le=8)] = optional("number of fins", 4)
    root_chord_m: Positive = Field(description="chord at the body's wall, m")
    tip_chord_m: NotNegative = Field(description="chord at the tip, m")
    semispan_m: Positive = Field(description="semispan from the body's wall, m")
    leading_edge_station_m: float = Field(description="leading edge of the root, m aft of the nose")
    sweep_m: NotNegative = optional("leading edge of the tip aft of the root's, m", 0.0)


class LayoutBooster(Between):
    """Equal boosters attached to the core of a stage, rigid bodies."""

    name: values.ChannelPart = Field(description="name of the booster (letters a-z, digits, _); several are numbered")
    positions_m: tuple[Pair, ...] = Field(min_length=1, description="y and z of each axis from the body axis, m")
    attachments_m: tuple[float, ...] = Field(
        min_length=1,
        max_length=2,
        description="stations of the core that carry it: one that clamps it, or two that hold its ends; the first "
        "carries its axial load",
    )
    diameter_m: Positive = Field(description="diameter, m")
    nose_length_m: Positive | None = optional("length of its nose, m (default: twice its diameter)")
    part: tuple[DryMass, ...] = optional("dry parts without engines", ())
    tank: tuple[LayoutTank, ...] = optional("tanks with liquid propellant", (), max_length=MAX_PENDULUMS)
    grain: tuple[Grain, ...] = optional("solid propellant", ())
    engine: LayoutNozzles
    axial_factor: NotNegative = optional("factor on the assumed axial force coefficient", 1.0)
    ignition_after_s: values.Seconds = optional("ignition on the stage clock, s", 0.0)
    separation_after_s: values.Seconds = optional("time from burnout to separation, s", 1.0)

    @property
    def shell(self) -> tuple[Shell, ...]:
        """Return an empty structure, because the body is rigid."""
        return ()

    @property
    def usable_kg(self) -> float:
        """Return the mass of the propellant that one booster burns."""
        return sum(t.liquid_mass_kg - t.residual_kg for t in self.tank) + sum(g.mass_kg for g in self.grain)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the name of each booster."""
        count = len(self.positions_m)
        return tuple(f"{self.name}{k + 1}" if count > 1 else self.name for k in range(count))

    def _check(self) -> None:
        super()._check()
        check_grains(self.grain, 0.5 * self.diameter_m)
        check_balance(self.tank)
        if self.usable_kg <= 0.0:
            raise refuse("no propellant", "tanks with more than their residual, or a grain", ("tank",))


def steered_boosters(stage: LayoutStage) -> bool:
    """Return True if engines of boosters of a stage are gimballed."""
    return any(booster.engine.gimbal == "both" for booster in stage.booster)


class LayoutStage(Between):
    """A stage and its extent in the vehicle."""

    name: values.ChannelPart = Field(description="name of the stage")
    diameter_m: Positive = Field(description="diameter, m")
    part: tuple[DryMass, ...] = optional("dry parts without engines", ())
    shell: tuple[Shell, ...] = Field(min_length=1, description="structure from the front to the rear of the stage")
    tank: tuple[LayoutTank, ...] = optional("tanks with liquid propellant", (), max_length=MAX_PENDULUMS)
    grain: tuple[Grain, ...] = optional("solid propellant", ())
    engine: StageEngines
    booster: tuple[LayoutBooster, ...] = optional("boosters attached to the first stage", ())
    fins: LayoutFins | None = optional("absent: none")
    aero: AeroSection | None = optional("as in a vehicle file, instead of computed values (CSV, DATCOM's for006)")
    bending: BendingSection | None = optional("as in a vehicle file, instead of the beam's modes")
    spatial_modes: SpatialModesSection | None = optional("as in a vehicle file (CSV, NASTRAN's op2 or f06)")
    loads: SectionStations | None = optional("absent: no section loads")
    modes: Annotated[int, Field(ge=0, le=8)] = optional("bending modes of the beam", 3)
    bending_damping: Fraction = optional("damping ratio of all modes", 0.005)
    roll_torque_Nm: Positive | None = optional("torque of roll thrusters, N m (default: for 5 deg/s2 at ignition)")
    turn_torque_Nm: Positive | None = optional(
        "torque in pitch and yaw that turns the last stage before a restart, N m (default: for 0.5 deg/s2)"
    )
    separation_after_s: values.Seconds = optional("time from burnout to separation, s", 1.0)
    ignition_after_s: values.Seconds = optional("time from the preceding separation to ignition, s", 2.0)
    robust: bool = optional(
        "true: the case also designs this stage for the worst vehicles of the campaign within two sigma of each "
        "deviation ([robust]), which takes several times as long; for a stage with notches at uncertain frequencies",
        False,
    )

    @property
    def usable_kg(self) -> float:
        """Return the mass of the propellant that the stage burns, without boosters."""
        return sum(t.liquid_mass_kg - t.residual_kg for t in self.tank) + sum(g.mass_kg for g in self.grain)

    def _check(self) -> None:
        check_grains(self.grain, 0.5 * self.diameter_m)
        check_balance(self.tank)
        if self.usable_kg <= 0.0:
            raise refuse("no propellant", "tanks with more than their residual, or a grain", ("tank",))
        self.at_most_one("bending", "spatial_modes")
        ends = [self.front_station_m, *(x for s in self.shell for x in (s.front_station_m, s.rear_station_m))]
        for n, (before, begins) in enumerate(zip(ends[::2], ends[1::2], strict=False)):
            if abs(before - begins) > 1e-6:
                raise refuse("leaves a gap or overlaps", f"{before:g}", ("shell", n, "front_station_m"), value=begins)
        if self.shell[-1].rear_station_m < self.engine.gimbal_station_m - 1e-6:
            raise refuse(
                "the structure ends ahead of the gimbal",
                f"from {self.engine.gimbal_station_m:g}",
                ("shell", len(self.shell) - 1, "rear_station_m"),
                value=self.shell[-1].rear_station_m,
            )
        check_stations(self.loads, self.engine.gimbal_station_m)


class LayoutSite(Section):
    """The launch site."""

    latitude_deg: values.Latitude = Field(description="geodetic latitude, deg")
    longitude_deg: values.Longitude = Field(description="longitude, deg east")
    altitude_m: float = optional("height above the ellipsoid, m", 0.0)
    azimuth_deg: values.Angle | None = optional(
        "launch azimuth, deg from north (default: from trajectory.inclination_deg)"
    )
    jet_mps: Positive = optional("peak of the suite's limit wind, from the west at 11 km, m/s", 40.0)


class Fairing(Between):
    """The fairing, dropped while an upper stage burns. Its shell is part of the last stage's structure."""

    mass_kg: Positive = Field(description="mass, kg")
    jettison_altitude_m: Positive = optional("altitude above which it is dropped when a stage burns, m", 110e3)


class Trajectory(Section):
    """The ascent: vertical rise, pitch-over and gravity turn. Upper stages reach an orbit by a linear tangent law."""

    pitch_over_start_s: Positive = optional("end of the vertical rise, s after ignition", 5.0)
    pitch_over_s: Positive = optional("duration of the pitch-over, s", 12.0)
    final_path_angle_deg: Annotated[float, Field(gt=-30.0, lt=85.0)] = optional(
        "path angle above the local horizon at the last burnout, deg: sets the pitch-over", 20.0
    )
    orbit_altitude_m: Annotated[float, Field(ge=100e3, le=2e6)] | None = optional(
        "altitude of the last burnout above the equatorial radius, with a level path: the perigee of an orbit if the "
        "speed is sufficient; instead of final_path_angle_deg"
    )
    apogee_altitude_m: Annotated[float, Field(ge=100e3, le=1e8)] | None = optional(
        "apogee above the equatorial radius of an orbit with perigee at orbit_altitude_m, reached by closed-loop "
        "guidance and cutoff of the last engine (default: pitch programme only, to the end of propellant)"
    )

    inclination_deg: Annotated[float, Field(ge=0.0, le=180.0)] | None = optional(
        "inclination of the orbit, deg: gives the launch azimuth instead of site.azimuth_deg"
    )
    southwards: bool = optional("launch to the south, with inclination_deg", False)
    restart: tuple[Restart, ...] = optional(
        "further burns of the last engine, as guidance.restart of a scenario, which end at an orbit or a cutoff",
        (),
        max_length=MAX_BURNS - 1,
    )

    def _check(self) -> None:
        if self.southwards and self.inclination_deg is None:
            raise refuse("the azimuth is given", "with inclination_deg", "southwards", value=True)
        if self.inclination_deg is not None and self.orbit_altitude_m is None:
            raise refuse("belongs to an orbit", "with orbit_altitude_m", "inclination_deg", value=self.inclination_deg)
        if self.restart and self.apogee_altitude_m is None:
            problem = "the first burn has no orbit to end at"
            raise refuse(problem, "with apogee_altitude_m", "restart", value=len(self.restart))
        perigee_m, apogee_m = self.orbit_altitude_m, self.apogee_altitude_m
        if apogee_m is not None and (perigee_m is None or apogee_m < perigee_m):
            least = "an orbit_altitude_m" if perigee_m is None else f"at least orbit_altitude_m = {perigee_m:g}"
            raise refuse("needs a perigee below it", least, "apogee_altitude_m", value=apogee_m)


class Control(Section):
    """The flight computer, gyro and first gains."""

    sample_s: values.Period = optional("sample period, s", 0.01)
    delay_s: values.Seconds = optional("delay from sample to command, s", 0.003)
    gyro_station_m: float = Field(description="station of the rate gyros, m aft of the nose; in the last stage")
    accelerometer_station_m: float | None = optional(
        "station of a lateral accelerometer for load relief, in the last stage (default: none)"
    )
    gyro_hz: Positive = optional("natural frequency of gyros and accelerometer, Hz", 60.0)
    gyro_zeta: Positive = optional("their damping ratio", 0.7)
    rigid_hz: Positive | None = optional(
        "rigid-body frequency of the first gains, Hz (default: at each instant an eighth of mode 1 and of the "
        "actuator and half of the slowest slosh mode, at most 0.4)"
    )
    rigid_zeta: Positive = optional("rigid-body damping ratio of the first gains", 0.7)


class Layout(Section):
    """A layout file."""

    schema_version: Literal[1] = optional("version of the format", 1, alias="schema")
    name: str = optional("name of the vehicle", "")
    description: str = optional("description, one sentence", "")
    nose: Literal["ogive", "cone"] = optional("shape of the nose", "ogive")
    nose_length_m: Positive = Field(description="length of the nose, m")
    axial_factor: Positive = optional("factor on the assumed axial force coefficient", 1.0)
    site: LayoutSite
    trajectory: Trajectory = Trajectory()
    control: Control
    fairing: Fairing | None = optional("absent: none, or never dropped")
    rail: Rail | None = optional("launch rail of an unguided vehicle, whose engines all have gimbal = 'fixed'")
    stage: tuple[LayoutStage, ...] = Field(
        min_length=1, max_length=MAX_STAGES, description="stages in the order of flight"
    )

    @property
    def unguided(self) -> bool:
        """Return True if no engine of a stage moves."""
        return all(stage.engine.gimbal == "fixed" for stage in self.stage)

    @property
    def azimuth_deg(self) -> float:
        """Return the launch azimuth, as given or from the inclination. Raises ValueError if no plane has the
        inclination.
        """
        if self.site.azimuth_deg is not None:
            return self.site.azimuth_deg
        wanted, (perigee_m, apogee_m) = self.trajectory, self._orbit_m()
        assert wanted.inclination_deg is not None
        way = wanted.southwards
        return launch_azimuth_deg(self.site.latitude_deg, wanted.inclination_deg, perigee_m, apogee_m, southwards=way)

    def _orbit_m(self) -> tuple[float, float]:
        """Return the radii of perigee and apogee of the first orbit, which is circular unless an apogee is given."""
        perigee_m = self.trajectory.orbit_altitude_m or 0.0
        return WGS84_RADIUS_m + perigee_m, WGS84_RADIUS_m + (self.trajectory.apogee_altitude_m or perigee_m)

    def _check(self) -> None:
        if (self.site.azimuth_deg is None) == (self.trajectory.inclination_deg is None):
            raise refuse(
                "no launch azimuth, or two", "azimuth_deg, or trajectory.inclination_deg", ("site", "azimuth_deg")
            )
        try:
            self.azimuth_deg  # noqa: B018  # raises where no plane has the inclination
        except ValueError as beyond:
            at = ("trajectory", "inclination_deg")
            raise refuse("no plane through the site has it", str(beyond), at) from beyond
        for n, (lower, upper) in enumerate(pairwise(self.stage)):
            if abs(upper.rear_station_m - lower.front_station_m) > 1e-6:
                raise refuse(
                    f"the next stage ends at {upper.rear_station_m:g} m: a gap in the structure, or an overlap",
                    f"{upper.rear_station_m:g}",
                    ("stage", n, "front_station_m"),
                    value=lower.front_station_m,
                )
        for n, stage in enumerate(self.stage):
            count = len(stage.booster)
            if n > 0 and count:
                raise refuse("only the first stage has boosters", "none", ("stage", n, "booster"), value=count)
        self._check_guidance()
        if self.trajectory.orbit_altitude_m is not None and len(self.stage) == 1:
            raise refuse(
                "a single stage does not steer to an orbit", "two stages or more", ("trajectory", "orbit_altitude_m")
            )
        last = self.stage[-1]
        if abs(last.front_station_m) > 1e-9:
            raise refuse("the last stage holds the nose", "0", ("stage", len(self.stage) - 1, "front_station_m"))
        for key in ("gyro_station_m", "accelerometer_station_m"):
            station = getattr(self.control, key)
            if station is not None and not last.front_station_m <= station <= last.rear_station_m:
                raise refuse(
                    "is not in the last stage", f"0 .. {last.rear_station_m:g}", ("control", key), value=station
                )

    def _check_guidance(self) -> None:
        """Check that all stages have gimbals, or none and a rail."""
        for n, stage in enumerate(self.stage):
            if not self.unguided and stage.engine.gimbal == "fixed":
                allowed = "gimbal = 'both', or 'fixed' in every stage"
                raise refuse("other stages have gimbals", allowed, ("stage", n, "engine", "gimbal"), value="fixed")
        if self.unguided and self.rail is None:
            raise refuse("an unguided vehicle needs a rail", "length_m and elevation_deg", ("rail",))
        if self.rail is not None and not self.unguided:
            raise refuse("engines on gimbals steer from a pad", "with gimbal = 'fixed' in every stage", ("rail",))
        if self.unguided and self.trajectory.orbit_altitude_m is not None:
            raise refuse("an unguided vehicle does not steer", "none", ("trajectory", "orbit_altitude_m"))
        if self.unguided and any(stage.booster for stage in self.stage):
            raise refuse("an unguided vehicle has no boosters", "none", ("stage", 0, "booster"))


def read_layout(name: str | Path) -> Layout:
    """Read the layout in a file, or the built-in layout of that name. Raises ScenarioError."""
    return load_file(Layout, "layout", name, ())[0]
