"""Read the parameters of a vehicle and its flight condition at one instant, for one plane of one stage.

They come from the packed tables of the simulator, so both describe the same vehicle. The equations are not shared:
docs/model.md has the simulator's, and tests/oracles/planar/plant.py an independent derivation.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from oracles.planar.air import Aerodynamics, aerodynamics_at
from oracles.planar.engine import GimballedEngine, TvcLoad
from oracles.planar.sections import Cuts, cuts_of

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.design.model.held import FlightCondition, table_clock_s
from maxq.design.model.instruments import drives_of, sensed
from maxq.design.model.vehicle_at import StabilityDerivatives
from maxq.sim.packing.flight import Packed
from maxq.sim.vehicle import schedule


@dataclass(frozen=True)
class Body:
    """The core: the vehicle without the sloshing masses. Stations in m aft of the nose; inertia about the core's CG."""

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
    """The slosh modes by tank, as arrays with one entry each, (pendulums,)."""

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
        """Return the damping ratio in small waves under an axial load; baffles have no effect there."""
        return np.asarray(self.damping_ratio + self.viscous * np.maximum(load_mps2, 1e-9) ** -0.25)

    def damping(self, load_mps2: float) -> Array:
        """Return the damping ratio at `swing_rad`, the describing function of the rings (docs/model.md, 5.9)."""
        return np.asarray(self.small_wave_damping(load_mps2) + self.ring * np.sqrt(self.swing_rad))

    @property
    def bob_station_m(self) -> Array:
        return np.asarray(self.hinge_station_m + self.length_m)


@dataclass(frozen=True)
class Along:
    """The displacements of spatial modes along x at the places of `Modes`; each (spatial modes, places)."""

    gimbals: Array
    hinges: Array
    surfaces: Array
    sensors: Array


@dataclass(frozen=True)
class Modes:
    """The modes, as arrays with one entry each, (modes,), and their shapes at further places (modes, places).

    phi is positive in +z (pitch) or +y (yaw); slopes are d(phi)/d(station), 1/m. The first `spatial` modes are spatial,
    with their component in this plane, and are the same in both planes. The modes of the plane follow.
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
        """Return the shapes and slopes at one of the gimbals' stations."""
        return (self.phi_gimbal, self.slope_gimbal_pm) if gimbal == 0 else self.further_gimbals[gimbal - 1]


@dataclass(frozen=True)
class PlanarVehicle:
    """A stage at one instant, in one plane."""

    body: Body
    pendulums: Pendulums
    modes: Modes
    engines: tuple[GimballedEngine, ...]  # one at least
    aerodynamics: Aerodynamics
    jet_damping: bool
    slosh_exchange: bool = False  # liquid that goes over from bob to core takes its momentum along
    across: PlanarVehicle | None = None  # the same in the other plane, where spatial modes couple both
    sensors: tuple[tuple[str, float], ...] = ()  # beyond the gyro: what each measures, by name, and its station, m
    cuts: Cuts | None = None  # where its bending moment is wanted: the stations of section loads that are switched on

    @property
    def engine(self) -> GimballedEngine:
        """Return the first engine."""
        return self.engines[0]

    @property
    def sags(self) -> bool:
        return any(engine.sags for engine in self.engines)

    def hanging(self, load_mps2: float) -> PlanarVehicle:
        """Return the vehicle with its engines at their positions under the axial load."""
        if not self.sags:
            return self
        hung = tuple(engine.hanging(load_mps2) for engine in self.engines)
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
            body,
            core_cg_station_m=body.core_cg_station_m - forward,
            core_inertia_kgm2=inertia - body.core_mass_kg * forward**2,
        )
        return dataclasses.replace(self, body=body, engines=hung)

    def thrust_N(self, pressure_Pa: float) -> float:
        """Return the thrust of all engines at rest, along the body axis."""
        first, *others = (engine.rest[0] * engine.thrust_N(pressure_Pa) for engine in self.engines)
        return first + sum(others) if others else first

    @property
    def total_cg_station_m(self) -> float:
        """Return the CG with the liquid at rest."""
        b, p = self.body, self.pendulums
        moment = b.core_mass_kg * b.core_cg_station_m + (p.mass_kg * p.bob_station_m).sum(axis=0)
        station: float = moment / (b.core_mass_kg + p.mass_kg.sum(axis=0))
        return station

    @property
    def total_inertia_kgm2(self) -> float:
        """Return the transverse inertia about that CG with the liquid frozen."""
        b, p, cg = self.body, self.pendulums, self.total_cg_station_m
        core = b.core_inertia_kgm2 + b.core_mass_kg * (b.core_cg_station_m - cg) ** 2
        inertia: float = core + (p.mass_kg * (p.bob_station_m - cg) ** 2).sum(axis=0)
        return inertia


def vehicle_at(
    packed: Packed,
    time_s: float,
    mach: float,
    plane: str = "pitch",
    stage: int = 0,
    trim: tuple[float, float] = (0.0, 0.0),
) -> PlanarVehicle:
    """Read a burning stage at `time_s` of its own clock and a Mach number.

    `trim`: angles of attack and sideslip, rad, at which tables over angle of attack are differentiated.
    """
    one = _in_plane(packed, time_s, mach, plane, stage, trim)
    if one.modes.spatial == 0:
        return one
    other: str = "yaw" if plane == "pitch" else "pitch"
    return dataclasses.replace(one, across=_in_plane(packed, time_s, mach, other, stage, trim))


def _in_plane(
    packed: Packed, time_s: float, mach: float, plane: str, stage: int, trim: tuple[float, float]
) -> PlanarVehicle:
    row = packed.parameters[stage]
    vehicle, sizes = row.vehicle, row.vehicle.sizes
    table = table_in(packed.pool, vehicle.schedule)
    clock_s = table_clock_s(row, time_s)
    props = table(clock_s)
    about = 1 if plane == "pitch" else 2
    damped = vehicle.rate_damping.n_columns > 0
    body = Body(
        core_mass_kg=float(props[schedule.CORE_MASS]),
        core_cg_station_m=float(props[schedule.CORE_CG]),
        core_cg_rate_mps=float(props[schedule.CG_RATE]),
        core_inertia_kgm2=float(props[schedule.CORE_INERTIA + about]),
        core_inertia_rate_kgm2ps=float(props[schedule.INERTIA_RATE + about]),
        total_mass_kg=float(props[schedule.TOTAL_MASS]),
        mass_flow_kgps=float(props[schedule.MASS_FLOW]),
        rate_damping_Nms=float(table_in(packed.pool, vehicle.rate_damping)(clock_s)[about]) if damped else 0.0,
    )
    return PlanarVehicle(
        body=body,
        pendulums=_pendulums(vehicle, sizes, props),
        modes=_modes(vehicle, sizes, props, plane),
        engines=_engines(packed, row, props, time_s, plane),
        aerodynamics=aerodynamics_at(packed.pool, vehicle, props, clock_s, mach, plane, trim),
        jet_damping=bool(vehicle.jet_damping),
        slosh_exchange=bool(vehicle.slosh.exchange),
        sensors=tuple(
            (sensed(k, each), float(each.station_m)) for k, each in enumerate(vehicle.sensors[: int(sizes.sensors)])
        ),
        cuts=cuts_of(packed.pool, row, clock_s, plane == "pitch"),
    )


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


def _modes(vehicle: Any, sizes: Any, props: Array, plane: str) -> Modes:
    pitch = plane == "pitch"
    n = int(sizes.pitch_modes if pitch else sizes.yaw_modes)
    tanks, surfaces = int(sizes.pendulums), int(sizes.surfaces)
    zeta = vehicle.bending.zeta_pitch if pitch else vehicle.bending.zeta_yaw
    shapes = schedule.MODE_FIRST + tanks

    def rows(first: int, count: int, every: int = 1) -> Array:
        """Return the rows of the plane for its modes, (n, count)."""
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


def _with_spatial(vehicle: Any, sizes: Any, props: Array, plane: str, of_plane: Modes) -> Modes:
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
        hinges=each(tank, tanks, 0),
        surfaces=each(surface, surfaces, 0),
        sensors=beyond[:, engines:],
    )
    moves = any(shapes.any() for shapes in vars(along).values())
    return dataclasses.replace(
        of_plane,
        **joined,
        softening_kgpm=both,
        spatial=n,
        roll_gyro_pm=at(gyro_at, 3),
        along=along if moves else None,
        further_gimbals=further[:engines],
        sensors=further[engines:],
    )


def _engines(packed: Packed, row: Any, props: Array, time_s: float, plane: str) -> tuple[GimballedEngine, ...]:
    """Return the simulator's engines in one plane, without the angles and allocated commands of the other plane."""
    vehicle, e, sizes = row.vehicle, row.vehicle.engine, row.vehicle.sizes
    pitch, n = plane == "pitch", int(sizes.engines)
    thrusts = [props[schedule.thrust_column(sizes, int(e.curve[k]))] for k in range(n)]
    flows = [float(e.flow_weight[k] * thrusts[k]) for k in range(n)]
    gains, out = _gains(packed, row, time_s, plane), []
    drives = drives_of(row, plane)[1]
    for k in range(n):
        mass, arm = float(e.gimballed_mass_kg[k]), float(e.cg_from_gimbal_m[k])
        side, cg = ("z", props[schedule.CORE_CG + 2]) if pitch else ("y", props[schedule.CORE_CG + 1])
        beside, nozzle = float(e[f"gimbal_offset_{side}_m"][k]), float(e[f"exit_{side}_m"][k]) - float(cg)
        swing, compliance = int(e.swings[k]), vehicle.tvc_load
        load = TvcLoad(float(compliance.stiffness_Nmprad[swing]), float(compliance.damping_Nmsprad[swing]))
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
                tvc_load=load if follows and swing >= 0 else None,
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


def _gains(packed: Packed, row: Any, time_s: float, plane: str) -> list[float]:
    """Return the angle of each group per command of the law in this plane."""
    a, axis = row.computer.allocation, 0 if plane == "pitch" else 1
    if a.groups == 1:
        return [1.0]
    now_s = time_s + 1e-9 * int(row.timeline.stage_start_ns)
    matrix = table_in(packed.pool, a.matrix)(now_s).reshape(-1, 3)
    return [float(matrix[2 * group + axis, axis]) for group in range(int(a.groups))]


def with_pendulums(vehicle: PlanarVehicle, pendulums: Pendulums) -> PlanarVehicle:
    """Return the vehicle with other pendulums and the same total mass, CG and inertia, liquid frozen.

    The core makes up the difference. Raises ValueError where no core mass is left.
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


def stability_derivatives(vehicle: PlanarVehicle, condition: FlightCondition) -> StabilityDerivatives:
    """Return the stability derivatives at a flight condition.

    Raises ValueError at rest, where eqs 4 and 5 divide by the speed.
    """
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
