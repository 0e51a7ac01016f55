"""Parameters of a vehicle, its instruments and its flight condition at one instant, for one plane of one stage.

They are read from the packed tables that the simulator flies, so that both describe the same vehicle; equations are
not shared (docs/model.md is the simulator's, design/model/plant.py has its own derivation). Actuator and gyro are also
given as the linear systems (28) and (29).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.linalg

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.design.model.incidence import reference_station_m, table_slopes
from maxq.design.model.sections import Cuts, cuts_of
from maxq.design.model.state_space import ComplexArray, StateSpace
from maxq.sim.packing.flight import Packed
from maxq.sim.vehicle import aero, schedule
from maxq.sim.vehicle.actuator import Actuator
from maxq.sim.vehicle.gyro import Gyro
from maxq.sim.vehicle.sensors import ACCELEROMETER

Plane = Literal["pitch", "yaw"]
Trim = tuple[float, float]
ACCELERATION = "accel_mps2"  # lateral specific force at the accelerometer
ACTUATOR_OUTPUTS = ("delta_rad", "delta_rate_radps", "delta_accel_radps2")


@dataclass(frozen=True)
class FlightCondition:
    """Air and path at an instant; the vehicle does not turn. Its incidence is that of its aerodynamics."""

    time_s: float  # vehicle clock
    airspeed_mps: float
    density_kgpm3: float
    pressure_Pa: float  # ambient
    mach: float
    pitch_rad: float  # of the body axis above the horizon
    gravity_mps2: float

    @property
    def dynamic_pressure_Pa(self) -> float:
        return 0.5 * self.density_kgpm3 * self.airspeed_mps**2


@dataclass(frozen=True)
class Body:
    """The core: all but the sloshing masses. Stations in m aft of the nose; the inertia is about the core's CG."""

    core_mass_kg: float  # without the sloshing masses, engine straight
    core_cg_station_m: float
    core_cg_rate_mps: float  # rate of that station: aft positive; zero where the CG is held still
    core_inertia_kgm2: float  # about y (pitch) or z (yaw)
    core_inertia_rate_kgm2ps: float
    total_mass_kg: float
    mass_flow_kgps: float  # out of the nozzle
    rate_damping_Nms: float  # moment against turning that is given with the mass properties


@dataclass(frozen=True)
class Pendulums:
    """One entry a slosh mode, tank by tank, (pendulums,)."""

    mass_kg: Array
    mass_rate_kgps: Array
    length_m: Array
    hinge_station_m: Array
    bob_station_rate_mps: Array  # hinge and bob follow the surface of the liquid
    damping_ratio: Array
    viscous: Array  # what a smooth wall adds to it, times the fourth root of the axial load, (m/s2)^(1/4)
    ring: Array  # what ring baffles add to it, per root of the swing, rad^(-1/2)
    swing_rad: Array  # at which they do: that of a flight (node.with_swings), 0 of a vehicle that none has flown

    def small_wave_damping(self, load_mps2: float) -> Array:
        """Damping ratio in small waves, where baffles do nothing yet, under an axial load."""
        return np.asarray(self.damping_ratio + self.viscous * np.maximum(load_mps2, 1e-9) ** -0.25)

    def damping(self, load_mps2: float) -> Array:
        """Damping ratio of a swing of `swing_rad`: the describing function of the rings (docs/model.md, 5.9)."""
        return np.asarray(self.small_wave_damping(load_mps2) + self.ring * np.sqrt(self.swing_rad))

    @property
    def bob_station_m(self) -> Array:
        return np.asarray(self.hinge_station_m + self.length_m)


@dataclass(frozen=True)
class Along:
    """Displacement along x of spatial modes at the places of `Modes`; each (spatial modes, places)."""

    gimbals: Array
    hinges: Array
    surfaces: Array
    sensors: Array


@dataclass(frozen=True)
class Modes:
    """One entry a mode, (modes,), and where shapes are met elsewhere (modes, places).

    phi is positive in +z (pitch) or +y (yaw); slopes are d(phi)/d(station), 1/m. The first `spatial` are spatial modes,
    with the part that they have in this plane, the same ones in both; then those of the plane.
    """

    omega_radps: Array
    damping_ratio: Array
    generalized_mass_kg: Array
    phi_gimbal: Array
    slope_gimbal_pm: Array
    slope_gyro_pm: Array
    phi_hinge: Array  # (modes, tanks)
    phi_surface: Array  # (modes, surfaces)
    slope_surface_pm: Array  # (modes, surfaces)
    softening_kgpm: Array  # (modes, modes): stiffness lost per m/s2 of axial load; of spatial modes that of both planes
    spatial: int = 0
    roll_gyro_pm: Array = dataclasses.field(default_factory=lambda: np.zeros(0))  # rotation of spatial modes about x
    further_gimbals: tuple[tuple[Array, Array], ...] = ()  # shapes and slopes at stations of gimbals beyond the first
    sensors: tuple[tuple[Array, Array], ...] = ()  # the same at those of the vehicle's `sensors`
    along: Along | None = None  # None: nothing moves along x

    def at_gimbal(self, gimbal: int) -> tuple[Array, Array]:
        """Shapes and slopes at one of the gimbals' stations."""
        return (self.phi_gimbal, self.slope_gimbal_pm) if gimbal == 0 else self.further_gimbals[gimbal - 1]


@dataclass(frozen=True)
class GimballedEngine:
    vacuum_thrust_N: float
    exit_area_m2: float
    gimbal_station_m: float
    exit_station_m: float
    gimballed_mass_kg: float
    cg_from_gimbal_m: float
    inertia_about_gimbal_kgm2: float
    follower: bool  # thrust turns with the bent gimbal
    gain: float = 1.0  # angle per command of the law, by allocation; 0 for an engine fixed in this plane
    drive: int = 0  # which of the unlike actuators moves it
    group: int = 0  # of engines that go together
    numbers: tuple[int, ...] = (0,)  # of the stage's engines that it stands for: alike ones of a group are one here
    tvc_load: TvcLoad | None = None  # None: it follows its actuator
    gimbal: int = 0  # which of the gimbals' stations
    beside_m: float = 0.0  # gimbal from the body axis across the plane's axis of turning: z in pitch, y in yaw
    from_cg_m: float = 0.0  # and from the core's CG
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)  # of thrust at rest, B
    unloaded: tuple[float, float, float] | None = None  # the same without axial load, where that bends its mount
    plane: Plane = "pitch"
    across: float = 0.0  # 1 where it is gimballed in the other plane as well
    flow_share: float = 1.0  # of the mass flow
    exit_square_m2: float = 0.0  # mean square of the nozzle exits' distance across from the CG

    def _in_plane(self, axis: tuple[float, float, float]) -> tuple[float, float]:
        return axis[0], axis[2 if self.plane == "pitch" else 1]

    @property
    def rest(self) -> tuple[float, float]:
        """Thrust axis at rest: forward, across."""
        return self._in_plane(self.axis)

    @property
    def mounted(self) -> tuple[float, float]:
        """The same without axial load."""
        return self._in_plane(self.unloaded or self.axis)

    @property
    def slope(self) -> tuple[float, float]:
        """What it changes by per radian."""
        x, y, z = self.axis
        level = np.sqrt(1.0 - y * y)
        return (-z, x) if self.plane == "pitch" else (-y * x / level, level)

    @property
    def other_slope(self) -> tuple[float, float]:
        """In this plane, per radian of the other plane's angle."""
        x, y, z = self.axis
        level = np.sqrt(1.0 - y * y)
        return (
            (self.across * x * y / level, self.across * z * y / level)
            if self.plane == "pitch"
            else (-self.across * z, 0.0)
        )

    @property
    def levers(self) -> tuple[float, float]:
        """Squares of both changes in space."""
        y = self.axis[1]
        return (1.0 - y * y, 1.0) if self.plane == "pitch" else (1.0, 1.0 - y * y)

    @property
    def twist(self) -> float:
        """Second derivative of the forward part by both angles."""
        _, y, z = self.axis
        mixed: float = self.across * y * z / np.sqrt(1.0 - y * y)
        return -mixed if self.plane == "pitch" else mixed

    @property
    def sags(self) -> bool:
        """Canted, on a TVC load."""
        return self.tvc_load is not None and (self.axis[1] != 0.0 or self.axis[2] != 0.0)

    def hanging(self, load_mps2: float) -> GimballedEngine:
        """The same where it stands under the axial load `load_mps2`, at rest as it is without: canted, it sags.

        k (p - p0) = -S a sin p cos y and k (y - y0) = -S a cos p sin y (docs/model.md, 14).
        """
        if not self.sags or self.tvc_load is None:
            return self
        x, y, z = self.axis
        pull = load_mps2 * self.gimballed_mass_kg * self.cg_from_gimbal_m / self.tvc_load.stiffness_Nmprad
        pitch, yaw = start = np.arctan2(z, x), -np.arcsin(y)
        pitch_pull, yaw_pull = (pull, self.across * pull) if self.plane == "pitch" else (self.across * pull, pull)
        for _ in range(20):  # Newton's steps in turn; the pull straightens, so that both slopes are above 1
            level, stiff = np.sin(pitch) * np.cos(yaw), np.cos(pitch) * np.cos(yaw)
            pitch = pitch - (pitch - start[0] + pitch_pull * level) / (1.0 + pitch_pull * stiff)
            level, stiff = np.cos(pitch) * np.sin(yaw), np.cos(pitch) * np.cos(yaw)
            yaw = yaw - (yaw - start[1] + yaw_pull * level) / (1.0 + yaw_pull * stiff)
        axis = np.cos(pitch) * np.cos(yaw), -np.sin(yaw), np.sin(pitch) * np.cos(yaw)
        return dataclasses.replace(self, axis=axis, unloaded=self.axis)

    def thrust_N(self, pressure_Pa: float) -> float:
        thrust: float = np.maximum(self.vacuum_thrust_N - pressure_Pa * self.exit_area_m2, 0.0)
        return thrust


@dataclass(frozen=True)
class TvcLoad:
    """Compliance between engine and actuators, about the gimbal; friction and stops are not linear."""

    stiffness_Nmprad: float
    damping_Nmsprad: float


@dataclass(frozen=True)
class Aerodynamics:
    """Coefficients at one Mach number, referred to `area_m2` and `chord_m`."""

    area_m2: float
    chord_m: float
    axial: float  # CA + CD
    drag: float  # CD: the part that acts along the wind; its slope across
    rate_damping: float  # Cmq, or Cnr in yaw; per rate times chord / (2 U)
    slope_pr: Array  # CN_alpha of each surface, then of each table over incidence at the trim, 1/rad; then `beyond`
    moment_slope_mpr: Array  # CN_alpha times station of each of them, m/rad
    rate_slope_m: Array  # the same by the turning rate: normal force per rho U S / 2, m
    rate_moment_m2: Array  # and times station, m2
    couple_station_m: Array  # where tables load the modes, also by their moment about that; nan of a surface
    local_incidence: bool
    beyond: tuple[int, ...] = ()  # parts that see the flow at the CG alone; which surface's modes they load, -1: none
    forward: float = 1.0  # share of the airspeed along the body axis
    cross_slope_pr: Array = dataclasses.field(default_factory=lambda: np.zeros(0))  # of each part by the other plane's
    cross_moment_mpr: Array = dataclasses.field(default_factory=lambda: np.zeros(0))  # flow; empty: none

    def met_by_modes(self, part: int) -> tuple[int, bool]:
        """Which surface's modes a part of `slope_pr` loads (-1: none), and whether the bent body's flow counts."""
        first = len(self.slope_pr) - len(self.beyond)
        return (part, self.local_incidence) if part < first else (self.beyond[part - first], False)

    def modal_couples(self) -> tuple[Array, Array]:
        """Moments about `couple_station_m` that turn the modes' slopes: by incidence (m/rad), by turning rate (m2)."""
        at = np.nan_to_num(self.couple_station_m)
        acts = np.isfinite(self.couple_station_m)
        by_flow = acts * (self.slope_pr * at - self.moment_slope_mpr)
        return by_flow, acts * (self.rate_slope_m * at - self.rate_moment_m2)

    def cross_couples(self) -> Array:
        """The first of `modal_couples` by the other plane's flow."""
        stations = self.couple_station_m[: len(self.cross_slope_pr)]
        turns = self.cross_slope_pr * np.nan_to_num(stations) - self.cross_moment_mpr
        return np.asarray(np.isfinite(stations) * turns)


@dataclass(frozen=True)
class VehicleAt:
    """A stage at one instant, in one plane."""

    body: Body
    pendulums: Pendulums
    modes: Modes
    engine: GimballedEngine
    aerodynamics: Aerodynamics
    jet_damping: bool
    slosh_exchange: bool = False  # liquid that goes over from bob to core takes its momentum along
    across: VehicleAt | None = None  # the same in the other plane, where spatial modes couple both
    further_engines: tuple[GimballedEngine, ...] = ()
    sensors: tuple[tuple[str, float], ...] = ()  # beyond the gyro: what each measures, by name, and its station, m
    cuts: Cuts | None = None  # where its bending moment is wanted: the stations of section loads that are switched on

    @property
    def engines(self) -> tuple[GimballedEngine, ...]:
        return self.engine, *self.further_engines

    @property
    def sags(self) -> bool:
        return any(engine.sags for engine in self.engines)

    def hanging(self, load_mps2: float) -> VehicleAt:
        """The same with its engines where they stand under the axial load."""
        if not self.sags:
            return self
        first, *others = hung = [engine.hanging(load_mps2) for engine in self.engines]
        body = self.body
        forward, inertia = 0.0, body.core_inertia_kgm2
        for e in hung:
            mass, arm, at = e.gimballed_mass_kg, e.cg_from_gimbal_m, body.core_cg_station_m - e.gimbal_station_m
            before, now = (
                (at - arm * axis[0]) ** 2 + (e.from_cg_m - arm * axis[1]) ** 2 for axis in (e.mounted, e.rest)
            )
            forward = forward + mass * arm * (e.mounted[0] - e.rest[0]) / body.core_mass_kg
            inertia = inertia + mass * (now - before)  # not in place: an array of many vehicles stays theirs
        body = dataclasses.replace(
            body, core_cg_station_m=body.core_cg_station_m - forward,
            core_inertia_kgm2=inertia - body.core_mass_kg * forward**2,
        )  # fmt: skip  # one more line otherwise
        return dataclasses.replace(self, body=body, engine=first, further_engines=tuple(others))

    def thrust_N(self, pressure_Pa: float) -> float:
        """Of all engines at rest, along the body axis."""
        first, *others = (engine.rest[0] * engine.thrust_N(pressure_Pa) for engine in self.engines)
        return first + sum(others) if others else first

    @property
    def total_cg_station_m(self) -> float:
        """CG with the liquid at rest."""
        b, p = self.body, self.pendulums
        moment = b.core_mass_kg * b.core_cg_station_m + (p.mass_kg * p.bob_station_m).sum(axis=0)
        station: float = moment / (b.core_mass_kg + p.mass_kg.sum(axis=0))
        return station

    @property
    def total_inertia_kgm2(self) -> float:
        """Transverse inertia about that CG with the liquid frozen."""
        b, p, cg = self.body, self.pendulums, self.total_cg_station_m
        core = b.core_inertia_kgm2 + b.core_mass_kg * (b.core_cg_station_m - cg) ** 2
        inertia: float = core + (p.mass_kg * (p.bob_station_m - cg) ** 2).sum(axis=0)
        return inertia


def vehicle_at(
    packed: Packed, time_s: float, mach: float, plane: Plane = "pitch", stage: int = 0, trim: Trim = (0.0, 0.0)
) -> VehicleAt:
    """Read a burning stage at `time_s` of its own clock and a Mach number.

    `trim`: angles of attack and sideslip, rad, at which tables over incidence have their slopes.
    """
    one = _in_plane(packed, time_s, mach, plane, stage, trim)
    if one.modes.spatial == 0:
        return one
    other: Plane = "yaw" if plane == "pitch" else "pitch"
    return dataclasses.replace(one, across=_in_plane(packed, time_s, mach, other, stage, trim))


def table_clock_s(row: Any, time_s: float) -> float:
    """Clock of a packed stage's tables at a time since its start."""
    return float(row.timeline.frozen_s) if row.timeline.frozen == 1 else float(row.timeline.burn_rate) * time_s


def _in_plane(packed: Packed, time_s: float, mach: float, plane: Plane, stage: int, trim: Trim) -> VehicleAt:
    row = packed.parameters[stage]
    vehicle, sizes = row.vehicle, row.vehicle.sizes
    table = table_in(packed.pool, vehicle.schedule)
    clock_s = table_clock_s(row, time_s)
    props = table(clock_s)
    inertia = schedule.CORE_INERTIA + (1 if plane == "pitch" else 2)
    turn = schedule.INERTIA_RATE + (1 if plane == "pitch" else 2)
    body = Body(
        core_mass_kg=float(props[schedule.CORE_MASS]),
        core_cg_station_m=float(props[schedule.CORE_CG]),
        core_cg_rate_mps=float(props[schedule.CG_RATE]),
        core_inertia_kgm2=float(props[inertia]),
        core_inertia_rate_kgm2ps=float(props[turn]),
        total_mass_kg=float(props[schedule.TOTAL_MASS]),
        mass_flow_kgps=float(props[schedule.MASS_FLOW]),
        rate_damping_Nms=_rate_damping(packed.pool, vehicle, clock_s, plane),
    )
    engines = _engines(packed, row, props, time_s, plane)
    return VehicleAt(
        body=body,
        pendulums=_pendulums(vehicle, sizes, props),
        modes=_modes(vehicle, sizes, props, plane),
        engine=engines[0],
        further_engines=engines[1:],
        aerodynamics=_aerodynamics(packed.pool, vehicle, props, clock_s, mach, plane, trim),
        jet_damping=bool(vehicle.jet_damping),
        slosh_exchange=bool(vehicle.slosh.exchange),
        sensors=tuple(
            (_sensed(k, each), float(each.station_m)) for k, each in enumerate(vehicle.sensors[: int(sizes.sensors)])
        ),
        cuts=cuts_of(packed.pool, row, clock_s, plane == "pitch"),
    )


def further_rate(number: int) -> str:
    """Name of what a rate gyro beyond the first measures; they are counted from 2."""
    return f"rate_{number}_radps"


def _sensed(number: int, sensor: Any) -> str:
    return ACCELERATION if sensor.kind == ACCELEROMETER else further_rate(number + 2)


def _pendulums(vehicle: Any, sizes: Any, props: Array) -> Pendulums:
    n = int(sizes.pendulums)
    first = np.array([schedule.tank_column(k) for k in range(n)], int)
    return Pendulums(
        mass_kg=props[first + schedule.TANK_MASS],
        mass_rate_kgps=props[first + schedule.TANK_MASS_RATE],
        length_m=props[first + schedule.TANK_LENGTH],
        hinge_station_m=props[first + schedule.TANK_HINGE],
        bob_station_rate_mps=props[first + schedule.TANK_TRAVEL],
        damping_ratio=np.array(vehicle.slosh.damping_ratio[:n]),
        viscous=vehicle.slosh.law_factor[:n] * props[first + schedule.TANK_VISCOUS],
        ring=vehicle.slosh.law_factor[:n] * props[first + schedule.TANK_RING] + vehicle.slosh.ring_damping[:n],
        swing_rad=np.zeros(n),
    )


def _modes(vehicle: Any, sizes: Any, props: Array, plane: Plane) -> Modes:
    pitch = plane == "pitch"
    n = int(sizes.pitch_modes if pitch else sizes.yaw_modes)
    tanks, surfaces = int(sizes.pendulums), int(sizes.surfaces)
    zeta = vehicle.bending.zeta_pitch if pitch else vehicle.bending.zeta_yaw
    shapes = schedule.MODE_FIRST + tanks

    def rows(first: int, count: int, every: int = 1) -> Array:
        """Rows of the plane for its modes, (n, count)."""
        at = [schedule.mode_column(sizes, int(not pitch), first + every * k) for k in range(count)]
        return np.array(props[np.array(at, int)[None, :] + np.arange(n)[:, None]])

    def row(which: int) -> Array:
        return np.array(rows(which, 1)[:, 0])

    stations = tuple(
        (row(at), row(at + 1)) for at in (int(schedule.gimbal_row(sizes, k)) for k in range(1, int(sizes.gimbals)))
    )
    engines = int(sizes.gimbals) - 1 - int(sizes.sensors)
    of_plane = Modes(
        omega_radps=vehicle.bending.frequency_factor[:n] * row(schedule.MODE_OMEGA),
        damping_ratio=np.array(zeta[:n]),
        generalized_mass_kg=row(schedule.MODE_MASS),
        phi_gimbal=row(schedule.MODE_PHI_GIMBAL),
        slope_gimbal_pm=row(schedule.MODE_SLOPE_GIMBAL),
        slope_gyro_pm=row(schedule.MODE_SLOPE_GYRO),
        phi_hinge=rows(schedule.MODE_FIRST, tanks),
        phi_surface=rows(shapes, surfaces, 2),
        slope_surface_pm=rows(shapes + 1, surfaces, 2),
        softening_kgpm=float(vehicle.bending.softening_factor) * rows(int(schedule.softening_row(sizes, 0)), n),
        further_gimbals=stations[:engines],
        sensors=stations[engines:],
    )
    return of_plane if int(sizes.spatial_modes) == 0 else _with_spatial(vehicle, sizes, props, plane, of_plane)


def _with_spatial(vehicle: Any, sizes: Any, props: Array, plane: Plane, of_plane: Modes) -> Modes:
    n, k = int(sizes.spatial_modes), len(of_plane.omega_radps)
    across, about, sign = (2, 4, 1.0) if plane == "pitch" else (1, 5, -1.0)

    def row(which: int) -> Array:
        first = int(schedule.spatial_column(sizes, which))
        return np.array(props[first : first + n])

    def at(place: int, component: int) -> Array:
        return row(schedule.SPATIAL_FIRST + 6 * place + component)

    def each(first: int, count: int, component: int) -> Array:
        return np.array([at(first + i, component) for i in range(count)]).reshape(count, n).T

    tanks, surfaces = int(sizes.pendulums), int(sizes.surfaces)
    gimbal, gyro_at = schedule.gimbal_place(sizes, 0), schedule.GYRO_PLACE
    tank, surface = schedule.tank_place(0), schedule.surface_place(sizes, 0)
    softening = np.array([row(schedule.spatial_softening_row(sizes, i)) for i in range(n)])
    both = np.zeros((n + k, n + k))
    both[:n, :n], both[n:, n:] = float(vehicle.bending.softening_factor) * softening, of_plane.softening_kgpm
    given = vehicle.spatial_modes
    mine = {
        "omega_radps": given.frequency_factor[:n] * row(schedule.SPATIAL_OMEGA),
        "damping_ratio": np.array(given.zeta[:n]),
        "generalized_mass_kg": row(schedule.SPATIAL_MASS),
        "phi_gimbal": at(gimbal, across),
        "slope_gimbal_pm": sign * at(gimbal, about),
        "slope_gyro_pm": sign * at(gyro_at, about),
        "phi_hinge": each(tank, tanks, across),
        "phi_surface": each(surface, surfaces, across),
        "slope_surface_pm": sign * each(surface, surfaces, about),
    }
    joined = {name: np.concatenate([values, getattr(of_plane, name)]) for name, values in mine.items()}
    places = [int(schedule.gimbal_place(sizes, k)) for k in range(1, int(sizes.gimbals))]
    further = tuple(
        (np.concatenate([at(p, across), phi]), np.concatenate([sign * at(p, about), slope]))
        for p, (phi, slope) in zip(places, (*of_plane.further_gimbals, *of_plane.sensors), strict=True)
    )
    engines = len(of_plane.further_gimbals)
    beyond = np.array([at(p, 0) for p in places]).reshape(-1, n).T
    along = Along(
        gimbals=np.concatenate([at(gimbal, 0)[:, None], beyond[:, :engines]], axis=1),
        hinges=each(tank, tanks, 0), surfaces=each(surface, surfaces, 0), sensors=beyond[:, engines:],
    )  # fmt: skip  # three more lines otherwise
    moves = any(shapes.any() for shapes in vars(along).values())
    return dataclasses.replace(
        of_plane, **joined, softening_kgpm=both, spatial=n, roll_gyro_pm=at(gyro_at, 3), along=along if moves else None,
        further_gimbals=further[:engines], sensors=further[engines:],
    )  # fmt: skip  # four more lines otherwise


def _engines(packed: Packed, row: Any, props: Array, time_s: float, plane: Plane) -> tuple[GimballedEngine, ...]:
    """Each of the simulator's engines. Angles of the other plane, and what allocation sends there, are left out."""
    vehicle, e, sizes = row.vehicle, row.vehicle.engine, row.vehicle.sizes
    pitch, n = plane == "pitch", int(sizes.engines)
    thrusts = [props[schedule.thrust_column(sizes, int(e.curve[k]))] for k in range(n)]
    flows = [float(e.flow_weight[k] * thrusts[k]) for k in range(n)]
    gains, out = _gains(packed, row, time_s, plane), []
    drives = _drives(row, plane)[1]
    for k in range(n):
        mass, arm = float(e.gimballed_mass_kg[k]), float(e.cg_from_gimbal_m[k])
        side, cg = ("z", props[schedule.CORE_CG + 2]) if pitch else ("y", props[schedule.CORE_CG + 1])
        beside, nozzle = float(e[f"gimbal_offset_{side}_m"][k]), float(e[f"exit_{side}_m"][k]) - float(cg)
        follows, others = (float(e[f"follows_{name}"][k]) for name in (("pitch", "yaw") if pitch else ("yaw", "pitch")))
        out.append(
            GimballedEngine(
                vacuum_thrust_N=float(e.thrust_factor[k]) * float(thrusts[k]),
                exit_area_m2=float(e.exit_area_m2[k]),
                gimbal_station_m=float(e.gimbal_station_m[k]),
                exit_station_m=float(e.exit_station_m[k]),
                gimballed_mass_kg=mass,
                cg_from_gimbal_m=arm,
                inertia_about_gimbal_kgm2=float(e.inertia_kgm2[k]) + mass * arm * arm,
                follower=bool(vehicle.follower_thrust),
                gain=follows * gains[int(e.group[k])],
                drive=drives[int(e.group[k])] if follows else 0,
                group=int(e.group[k]),
                numbers=tuple(n for n, parts in enumerate(e.parts) if parts > 0.0 and int(e.taken_as[n]) == k),
                tvc_load=_tvc_load(vehicle, k) if follows else None,
                gimbal=int(e.gimbal[k]),
                beside_m=beside,
                from_cg_m=beside - float(cg),
                axis=(float(e.rest_x[k]), float(e.rest_y[k]), float(e.rest_z[k])),
                plane=plane,
                across=others,
                flow_share=1.0 if n == 1 else flows[k] / sum(flows) if sum(flows) > 0.0 else 0.0,
                exit_square_m2=nozzle * nozzle + float(e[f"exit_{side}{side}_m2"][k]),
            )
        )
    return tuple(out)


def _gains(packed: Packed, row: Any, time_s: float, plane: Plane) -> list[float]:
    """Angle of each group per command of the law in this plane."""
    a, axis = row.computer.allocation, 0 if plane == "pitch" else 1
    if a.groups == 1:
        return [1.0]
    now_s = time_s + 1e-9 * int(row.timeline.stage_start_ns)
    matrix = table_in(packed.pool, a.matrix)(now_s).reshape(-1, 3)
    return [float(matrix[2 * group + axis, axis]) for group in range(int(a.groups))]


def _tvc_load(vehicle: Any, engine: int) -> TvcLoad | None:
    load, n = vehicle.tvc_load, int(vehicle.engine.swings[engine])
    return None if n < 0 else TvcLoad(float(load.stiffness_Nmprad[n]), float(load.damping_Nmsprad[n]))


def _rate_damping(pool: Array, vehicle: Any, clock_s: float, plane: Plane) -> float:
    if vehicle.rate_damping.n_columns == 0:
        return 0.0
    return float(table_in(pool, vehicle.rate_damping)(clock_s)[1 if plane == "pitch" else 2])


def _aerodynamics(
    pool: Array, vehicle: Any, props: Array, clock_s: float, mach: float, plane: Plane, trim: Trim
) -> Aerodynamics:
    a, tables = vehicle.aero, int(vehicle.sizes.tables)
    surfaces = int(vehicle.sizes.surfaces) - tables
    if a.on == 0:
        none = np.zeros(surfaces + tables)
        return Aerodynamics(0.0, 1.0, 0.0, 0.0, 0.0, none, none, none, none, none, local_incidence=False)
    row = table_in(pool, a.table)(mach)
    slope = row[aero.FIRST_SURFACE : aero.FIRST_SURFACE + 2 * surfaces : 2]
    moment = row[aero.FIRST_SURFACE + 1 : aero.FIRST_SURFACE + 2 * surfaces : 2].copy()
    if a.remainder >= 0:
        moment[a.remainder] += slope[a.remainder] * reference_station_m(pool, a, props, clock_s)
    moment = a.force_factor * (moment + slope * float(a.centre_shift_m))
    parts = np.stack([a.force_factor * slope, moment, 0.0 * slope, 0.0 * slope, np.full_like(slope, np.nan)])
    over = table_slopes(pool, vehicle, props, clock_s, mach, *trim)
    more = np.array([(*table.plane(plane), table.station_m) for table in over]).reshape(-1, 5)
    of_parts, beyond, forward = np.concatenate([parts, more.T], axis=1), (), 1.0
    axial, drag = row[aero.CA] + row[aero.CD], row[aero.CD]
    crossed: Array = np.zeros((2, 0))
    if tables > 0 and any(trim):  # without tables incidence is taken as zero
        forward, side, down = np.cos(trim[0]) * np.cos(trim[1]), np.sin(trim[1]), np.sin(trim[0]) * np.cos(trim[1])
        own, other = (down, side) if plane == "pitch" else (side, down)
        of_parts[:2, :surfaces] *= forward
        per_mach = mach * table_in(pool, a.table).slope(mach)
        by_mach, across = own * per_mach, other * per_mach
        more = _beyond(a, row, by_mach, (forward, own, other), plane)
        aside = _beyond(a, row, across, (forward, own, other), plane, across=True)
        aside[:, -1] += (
            a.axial_factor * own * (other * drag + across[aero.CD]) * np.array([1.0, props[schedule.CORE_CG]])
        )
        if a.remainder >= 0:
            reference_m = reference_station_m(pool, a, props, clock_s)
            for slopes in (more, aside):
                slopes[1, a.remainder] += slopes[0, a.remainder] * reference_m
        by_other = np.array([table.across(plane) for table in over]).T
        none = np.zeros((2, surfaces))
        crossed = np.concatenate([none, by_other[:2], aside[:, :surfaces], by_other[2:], aside[:, surfaces:]], axis=1)
        by_tables = np.array([table.plane_by_mach(plane) for table in over]).T
        more = np.concatenate([more[:, :surfaces], by_tables, more[:, surfaces:]], axis=1)
        stations = np.append(of_parts[4], np.nan)
        none = np.zeros_like(stations)
        of_parts = np.concatenate([of_parts, [*more, none, none, stations]], axis=1)
        beyond = (*range(surfaces + tables), -1)
        axial, drag = forward * (forward * row[aero.CA] + drag), drag + own * (own * drag + by_mach[aero.CD])
    return Aerodynamics(
        area_m2=float(a.area_m2),
        chord_m=float(a.chord_m if plane == "pitch" else a.yaw_chord_m),
        axial=float(a.axial_factor * axial) - sum(float(table.force[0]) for table in over),
        drag=float(a.axial_factor * drag),
        rate_damping=float(a.damping_factor * row[aero.CMQ if plane == "pitch" else aero.CNR]),
        slope_pr=of_parts[0],
        moment_slope_mpr=of_parts[1],
        rate_slope_m=of_parts[2],
        rate_moment_m2=of_parts[3],
        couple_station_m=of_parts[4],
        local_incidence=bool(a.local_incidence),
        beyond=beyond,
        forward=float(forward),
        cross_slope_pr=crossed[0],
        cross_moment_mpr=crossed[1],
    )


def _beyond(
    a: Any, row: Array, by_mach: Array, flow: tuple[float, float, float], plane: Plane, across: bool = False
) -> Array:
    """Slopes and slopes times stations, (2, surfaces and one), of what incidence adds to those along the axis.

    Surfaces under a Mach number that moves with the flow, and the body's cross-flow and Cm0. `by_mach`: what the
    columns `row` of the Mach table change by per radian; `flow`: the unit vector of the velocity through the air,
    forward, in the plane, across it. `across`: slopes by the flow across the plane.
    """
    forward, own, other = flow
    moved = other if across else own
    ends = len(row) - (len(row) - aero.FIRST_SURFACE) % 2
    slope, moment = (forward * own * by_mach[aero.FIRST_SURFACE + k : ends : 2] for k in (0, 1))
    lateral = np.hypot(own, other)
    cross = row[aero.CROSSFLOW] * (own * moved / lateral + (0.0 if across else lateral))
    cross += by_mach[aero.CROSSFLOW] * lateral * own
    couple = a.chord_m * (2.0 * moved * row[aero.CM0] + by_mach[aero.CM0]) if plane == "pitch" else 0.0
    moment = a.force_factor * np.append(moment + slope * float(a.centre_shift_m), cross * a.crossflow_station_m)
    moment[-1] -= couple
    return np.array([a.force_factor * np.append(slope, cross), moment])


def with_pendulums(vehicle: VehicleAt, pendulums: Pendulums) -> VehicleAt:
    """The vehicle with other pendulums and the same total mass, CG and inertia, liquid frozen.

    The core makes up the difference. Raises ValueError where no core is left.
    """
    old, body = vehicle.pendulums, vehicle.body
    total = body.core_mass_kg + old.mass_kg.sum(axis=0)
    centre, inertia = vehicle.total_cg_station_m, vehicle.total_inertia_kgm2
    sloshing = pendulums.mass_kg.sum(axis=0)
    mass = total - sloshing
    if np.min(mass) <= 0.0:
        raise ValueError(f"sloshing masses of {np.max(sloshing):g} kg in a vehicle of {np.max(total):g} kg")
    station = (total * centre - (pendulums.mass_kg * pendulums.bob_station_m).sum(axis=0)) / mass
    bobs = (pendulums.mass_kg * (pendulums.bob_station_m - centre) ** 2).sum(axis=0)
    core = inertia - bobs - mass * (station - centre) ** 2
    if np.min(core) <= 0.0:
        raise ValueError(f"bobs of {np.max(bobs):g} kg m2 in a vehicle of {np.max(inertia):g} kg m2")
    changed = dataclasses.replace(body, core_mass_kg=mass, core_cg_station_m=station, core_inertia_kgm2=core)
    return dataclasses.replace(vehicle, body=changed, pendulums=pendulums)


@dataclass(frozen=True)
class StabilityDerivatives:
    """Of alpha' = Z and q' = M as the paper defines them (4 to 8): pitch plane, whole mass, liquid frozen.

    Z_alpha and M_alpha are negative for a statically stable vehicle with lift.
    """

    z_alpha_1ps: float  # (4)
    m_alpha_1ps2: float  # (6)
    z_delta_1ps: float  # (5)
    m_delta_1ps2: float  # (8), without the axial load of the engine's mass (erratum 8: +0.2 to 0.4 %)
    m_q_1ps: float  # (7), aerodynamic


def stability_derivatives(vehicle: VehicleAt, condition: FlightCondition) -> StabilityDerivatives:
    """Derivatives at a flight condition. Raises ValueError at rest, where eqs 4 and 5 divide by the speed."""
    if condition.airspeed_mps <= 0.0:
        raise ValueError("stability derivatives are defined for positive airspeed only")
    a, speed = vehicle.aerodynamics, condition.airspeed_mps
    mass, inertia, cg = vehicle.body.total_mass_kg, vehicle.total_inertia_kgm2, vehicle.total_cg_station_m
    force_area = condition.dynamic_pressure_Pa * a.area_m2
    pushes = [(e, e.gain * e.slope[1] * e.thrust_N(condition.pressure_Pa)) for e in vehicle.engines]
    moment = sum(push * (e.gimbal_station_m - cg) for e, push in pushes)
    slope = float(a.slope_pr.sum())
    # normal force acts upwards (-z) at its own station; aft of the CG it turns the nose down
    moment_slope_m = slope * cg - float(a.moment_slope_mpr.sum())
    by_rate = 0.5 * a.chord_m**2 * a.rate_damping + float((a.rate_slope_m * cg - a.rate_moment_m2).sum())
    damping = 0.5 * condition.density_kgpm3 * speed * a.area_m2 * by_rate
    return StabilityDerivatives(
        z_alpha_1ps=-force_area * slope / (mass * speed),
        m_alpha_1ps2=force_area * moment_slope_m / inertia,
        z_delta_1ps=sum(push for _, push in pushes) / (mass * speed),
        m_delta_1ps2=moment / inertia,
        m_q_1ps=damping / inertia,
    )


def incidence_by_acceleration(vehicle: VehicleAt, condition: FlightCondition) -> tuple[float, float]:
    """What the incidence follows from by an accelerometer and the pitch acceleration (control/laws/load_relief.py):
    `percussion_m` and `accel_per_incidence_mps2`, of the rigid body.

    Raises ValueError without an accelerometer, without air, and without an engine that turns the vehicle.
    """
    station_m = next((at for name, at in vehicle.sensors if name == ACCELERATION), None)
    d, speed = stability_derivatives(vehicle, condition), condition.airspeed_mps
    if station_m is None or d.z_alpha_1ps == 0.0 or d.m_delta_1ps2 == 0.0:
        missing = "an accelerometer" if station_m is None else "air" if d.m_delta_1ps2 != 0.0 else "an engine"
        raise ValueError(f"no incidence can be estimated without {missing}")
    # from the CG to the centre of percussion, m forward; the accelerometer may lie on either side of it
    centre_m = d.z_delta_1ps * speed / d.m_delta_1ps2
    forward_m = vehicle.total_cg_station_m - station_m
    return centre_m - forward_m, d.z_alpha_1ps * speed - centre_m * d.m_alpha_1ps2


@dataclass(frozen=True)
class Instruments:
    """Actuators, gyro and timing of the flight computer in one plane; `ideal` actuators and gyros have no dynamics."""

    actuator: Actuator  # of the first drive
    gyro: Gyro
    sample_s: float  # period of the computer: tau_VF of the converter (30), tau_DZ of the hold (32)
    delay_s: float  # tau_D (31), from sample to command
    further_actuators: tuple[Actuator, ...] = ()  # of further drives: groups of engines with unlike actuators
    groups: tuple[tuple[int, ...], ...] = ((0,),)  # that each drive moves
    sensors: tuple[tuple[str, Gyro, int], ...] = ()  # beyond the gyro: what it measures, dynamics, latency in samples

    @property
    def actuators(self) -> tuple[Actuator, ...]:
        return self.actuator, *self.further_actuators


def instruments_of(row: Any, plane: Plane = "pitch") -> Instruments:
    """Instruments of a packed stage."""
    (first, *further), of_group = _drives(row, plane)
    return Instruments(
        actuator=first,
        groups=tuple(tuple(g for g, d in enumerate(of_group) if d == drive) for drive in range(1 + len(further))),
        further_actuators=tuple(further),
        gyro=_gyro(row.vehicle.gyro),
        sensors=tuple(
            (_sensed(k, each), _gyro(each.triad), int(row.computer.sensors.latency[k]))
            for k, each in enumerate(row.vehicle.sensors[: int(row.vehicle.sizes.sensors)])
        ),
        sample_s=1e-9 * int(row.computer.sample_ns),
        delay_s=1e-9 * int(row.computer.delay_ns),
    )


def _gyro(record: Any) -> Gyro:
    return Gyro(**{f.name: record[f.name].item() for f in dataclasses.fields(Gyro)})


def _drives(row: Any, plane: Plane) -> tuple[list[Actuator], list[int]]:
    """The unlike actuators of a plane, and which of them each group of engines has."""
    vehicle, axis = row.vehicle, 0 if plane == "pitch" else 1
    records = [vehicle.actuator_yaw if axis else vehicle.actuator_pitch]
    records += [vehicle.further_actuators[2 * k + axis] for k in range(int(vehicle.sizes.further_groups))]
    unlike: list[Actuator] = []
    of_group = []
    for record in records:
        actuator = Actuator(**{f.name: record[f.name].item() for f in dataclasses.fields(Actuator)})
        if actuator not in unlike:
            unlike.append(actuator)
        of_group.append(unlike.index(actuator))
    return unlike, of_group


def of_drive(name: str, drive: int) -> str:
    """Name of a derivative of a drive's angle."""
    return name if drive == 0 else f"{name}_{drive + 1}"


def actuators(records: Sequence[Any]) -> StateSpace:
    """Command -> angle, rate and acceleration of every drive, see `actuator`."""
    each = [actuator(record) for record in records]
    states = tuple(of_drive(name, k) for k, one in enumerate(each) for name in one.states)
    outputs = tuple(of_drive(name, k) for k, one in enumerate(each) for name in one.outputs)
    b, d = (np.concatenate([getattr(one, name) for one in each]) for name in ("b", "d"))
    a, c = (scipy.linalg.block_diag(*(getattr(one, name) for one in each)) for name in ("a", "c"))
    return StateSpace(a, b, c, d, states, each[0].inputs, outputs)


def actuator_response(record: Any, s: ComplexArray) -> ComplexArray:
    """Angle over command at complex s, rad/s, as a product of its factors."""
    out: ComplexArray = np.ones(np.shape(s), np.complex128)
    for omega, zeta in actuator_poles(record):
        out = out * lag(s, omega, zeta)
    return out / lag(s, record.omega_4_radps, record.zeta_4) if record.order == 6 else out


def lag(s: ComplexArray, omega: Array | float, zeta: Array | float) -> ComplexArray:
    """omega^2 / (s^2 + 2 zeta omega s + omega^2)."""
    x = np.asarray(s) / omega
    return np.asarray(1.0 / (1.0 + x * (2.0 * zeta + x)))


def actuator_poles(record: Any) -> list[tuple[float, float]]:
    """Frequency (rad/s) and damping ratio of each pair of poles of a packed `Actuator`."""
    return [
        (getattr(record, f"omega_{k}_radps"), getattr(record, f"zeta_{k}")) for k in range(1, record.order // 2 + 1)
    ]


def actuator(record: Any) -> StateSpace:
    """Command -> angle, rate and acceleration of the engine, as many states as the order; `record`: packed `Actuator`.

    A chain of second-order sections, each with its position and rate as states; in which order they come matters to
    the limits only. That of order six is (28), the denominator four orders above the numerator.
    """
    poles = actuator_poles(record)
    n = 2 * len(poles)
    a, b = np.zeros((n, n)), np.zeros((n, 1))
    for k, (omega, zeta) in enumerate(poles):
        i = 2 * k
        a[i, i + 1] = 1.0
        a[i + 1, i], a[i + 1, i + 1] = -(omega**2), -2.0 * zeta * omega
        if k == 0:
            b[1, 0] = omega**2
        else:
            a[i + 1, i - 2] = omega**2
    angle = np.eye(n)[n - 2]
    if record.order == 6:
        # the last numerator, s^2 + 2 z w s + w^2 over w^2, acts on its section's state: s^2 is that rate's row
        omega_4, zeta_4 = float(record.omega_4_radps), float(record.zeta_4)
        angle = a[5] / omega_4**2
        angle[4] += 1.0
        angle[5] += 2.0 * zeta_4 / omega_4
    c = np.stack([angle, angle @ a, angle @ a @ a])
    d = np.stack([np.zeros(1), angle @ b, angle @ a @ b])
    states = tuple(f"actuator_{k + 1}{what}" for k in range(len(poles)) for what in ("", "_rate"))
    return StateSpace(a, b, c, d, states, ("command_rad",), ACTUATOR_OUTPUTS)


def gyro(record: Any) -> StateSpace:
    """Local angular rate -> sensed rate (29), two states; `record` is a packed `Gyro`, whose errors are left out."""
    w, zeta = float(record.omega_radps), float(record.zeta)
    a: Array = np.array([[0.0, 1.0], [-w * w, -2.0 * zeta * w]])
    return StateSpace(
        a, np.array([[0.0], [w * w]]), np.array([[1.0, 0.0]]), np.zeros((1, 1)),
        ("gyro_radps", "gyro_rate_radps2"), ("local_rate_radps",), ("gyro_radps",),
    )  # fmt: skip  # five more lines otherwise
