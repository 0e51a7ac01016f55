"""The equations of motion of Lee, Ahn & Roh (1 to 27) in one plane, with a switch for each erratum (errata.py).

Body axes are at the core's CG, x forward, z down (pitch plane). Stations are in metres aft of the nose. The vehicle
flies along x at the speed U without rotation, with the axial specific force a = (T - D) / m. The equations have the
form of the paper: forces and moments on a body of mass m and inertia I (1, 2), a modal force (14), and pendulums driven
by their hinges (21). With `PAPER` they are the equations as printed. With `CORRECTED` they are the linear model of the
simulator, with which tests/test_oracle_design_model_printed.py compares them.

The constant g cos(theta_0) acts on every particle alike and is omitted: it bends the path (gravity turn). Gravity does
no work on a free-free mode (erratum 3). Thrust T acts at the displaced gimbal along the bent axis, each lifting surface
acts at its local angle of attack, and drag acts along the wind. The gimballed engine (I_E about the gimbal, first
moment S = m_E l_E) reacts to delta'' and is subject to the axial load (8). Slosh damping is a force between bob and
tank:

    M_S = - sum m_p [ a l_p G + 2 zeta w L (l_p - L) G' ],

Eq. (27) prints the hinge's arm l_p for both forces (erratum 22), which is wrong. The rod's pull acts at the hinge, but
the friction of the liquid acts at the bob, l_p - L forward of the CG. The printed pair of damping forces is not
collinear and thus does not conserve angular momentum.

The paper leaves several definitions open. Here, delta_b = -sigma_T eta and alpha_b = sigma_s eta + phi_s eta' / U (16,
17), with phi at the surface, gimbal or hinge where the force acts. The derivatives (4 to 8) are those of the whole
vehicle with frozen liquid. I_E in (20) is about the engine's CG, a_x = (T - D) / m, and W' - g_z - U q in (21) follows
from (1).

The lateral slosh of an upright cylinder is modelled as a pendulum (22, 23, 25, with errata 6 and 7). With the tank
radius R, the liquid depth h and the first root xi of J1' (NASA SP-106, ch. 6; Dodge, The New "Dynamic Behavior of
Liquids in Moving Containers", 2000),

    L = R / (xi tanh(xi h / R)),    m_p = m 2 R tanh(xi h / R) / (xi h (xi^2 - 1)),
    hinge above the liquid's CG by  h / 2 - (2 R / xi) tanh(xi h / (2 R)) + L.

Limits of validity: one engine on the body axis without TVC load, planar modes, lifting surfaces without tables over
angle of attack, one gyro. Other vehicles are rejected.

The yaw plane is obtained with w -> v, q -> -r, theta -> -psi, eta -> xi, delta -> -delta_yaw, gyro -> -gyro.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.design.model.held import OUTPUTS, WIND, FlightCondition, HeldStage, state_names
from maxq.design.model.instruments import Plane
from maxq.design.model.state_space import StateSpace
from maxq.design.model.vehicle_at import Pendulums, pendulums_of
from maxq.design.paper.errata import Errata
from maxq.sim.vehicle import schedule
from maxq.sim.vehicle.air import kernel as aero

XI = 1.84118378134066
_SHALLOWEST = 1e-6  # least depth in radii, since the formulae are singular at zero


@dataclass(frozen=True)
class Liquids:
    """The radius and liquid depth of each tank, (tanks,)."""

    radius_m: Array
    height_m: Array


@dataclass(frozen=True)
class PlaneModes:
    """The modes of a plane, (modes,), and their shapes at the hinges (modes, tanks) and surfaces (modes, surfaces)."""

    omega_radps: Array
    damping_ratio: Array
    generalized_mass_kg: Array
    phi_gimbal: Array
    slope_gimbal_pm: Array
    slope_gyro_pm: Array
    phi_hinge: Array
    phi_surface: Array
    slope_surface_pm: Array
    softening_kgpm: Array  # (modes, modes): stiffness lost per m/s2 of axial load


@dataclass(frozen=True)
class PlaneVehicle:
    """The coefficients of the equations of motion of a stage, at one instant and in one plane.

    The core is the vehicle without the bobs.
    """

    core_mass_kg: float
    core_cg_station_m: float
    core_cg_rate_mps: float
    core_inertia_kgm2: float
    core_inertia_rate_kgm2ps: float
    total_mass_kg: float
    mass_flow_kgps: float
    rate_damping_Nms: float
    jet_damping: bool
    slosh_exchange: bool
    pendulums: Pendulums
    bob_mass_rate_kgps: Array
    bob_station_rate_mps: Array
    modes: PlaneModes
    thrust_N: float
    follower: bool
    gimbal_station_m: float
    exit_station_m: float
    exit_square_m2: float
    engine_mass_kg: float
    engine_arm_m: float  # from the gimbal to the engine's CG
    engine_inertia_kgm2: float  # about the gimbal
    flow_kgps: float  # rho U S / 2
    chord_m: float
    drag: float  # CD, drag along the wind
    pitch_damping: float  # Cmq, or Cnr in yaw, with respect to rate times chord / (2 U)
    local_incidence: bool
    slope_pr: Array  # CN_alpha of each surface
    moment_slope_mpr: Array  # slope times station of each surface

    @property
    def total_cg_station_m(self) -> float:
        """Return the station of the CG with the liquid at rest."""
        bobs, core = self.pendulums, self.core_mass_kg
        moment = core * self.core_cg_station_m + bobs.mass_kg @ bobs.bob_station_m
        return float(moment / (core + bobs.mass_kg.sum()))

    @property
    def total_inertia_kgm2(self) -> float:
        """Return the transverse inertia about the total CG, with frozen liquid."""
        bobs, cg = self.pendulums, self.total_cg_station_m
        core = self.core_inertia_kgm2 + self.core_mass_kg * (self.core_cg_station_m - cg) ** 2
        return float(core + bobs.mass_kg @ (bobs.bob_station_m - cg) ** 2)


def plane_vehicle(held: HeldStage, condition: FlightCondition, plane: Plane) -> PlaneVehicle:
    """Return the coefficients of the first vehicle of a held stage.

    Raises ValueError for a vehicle that the published equations do not describe.
    """
    row, p, sizes, pitch = held.parameters[0], held.properties[0], held.sizes, plane == "pitch"
    vehicle, e, a, about = row.vehicle, row.vehicle.engine, row.vehicle.aero, 1 if pitch else 2
    beside = max(abs(float(x)) for x in (e.rest_y[0], e.rest_z[0], e.gimbal_offset_y_m[0], e.gimbal_offset_z_m[0]))
    for more, what in (
        (int(sizes.engines) > 1 or beside > 0.0, "one engine on the body axis"),
        (sizes.spatial_modes, "planar modes"),
        (sizes.tvc_loads, "an engine without TVC load"),
        (sizes.tables, "surfaces without tables over angle of attack"),
        (sizes.sensors, "one gyro"),
    ):
        if int(more):
            raise ValueError(f"the published equations describe {what} only; allowed is errata = 'corrected'")
    mach_row, clock_s = np.zeros(aero.FIRST_SURFACE), float(row.timeline.frozen_s)
    slope, moment = np.zeros(int(sizes.surfaces)), np.zeros(int(sizes.surfaces))
    if a.on:
        mach_row, last = table_in(held.pool, a.table)(condition.mach), aero.FIRST_SURFACE + 2 * len(slope)
        slope = a.force_factor * mach_row[aero.FIRST_SURFACE : last : 2]
        moment = a.force_factor * mach_row[aero.FIRST_SURFACE + 1 : last : 2] + slope * float(a.centre_shift_m)
        if a.remainder >= 0:
            over = p[schedule.TOTAL_MASS] if a.reference_moves == aero.OVER_MASS else clock_s
            moment[a.remainder] += slope[a.remainder] * table_in(held.pool, a.reference)(over)[0]
    exit_m = float(e[f"exit_{'z' if pitch else 'y'}_m"][0]) - float(p[schedule.CORE_CG + 3 - about])
    mass, arm, damping = float(e.gimballed_mass_kg[0]), float(e.cg_from_gimbal_m[0]), vehicle.rate_damping
    vacuum = float(e.thrust_factor[0]) * float(p[int(schedule.thrust_column(sizes, int(e.curve[0])))])
    return PlaneVehicle(
        core_mass_kg=float(p[schedule.CORE_MASS]),
        core_cg_station_m=float(p[schedule.CORE_CG]),
        core_cg_rate_mps=float(p[schedule.CG_RATE]),
        core_inertia_kgm2=float(p[schedule.CORE_INERTIA + about]),
        core_inertia_rate_kgm2ps=float(p[schedule.INERTIA_RATE + about]),
        total_mass_kg=float(p[schedule.TOTAL_MASS]),
        mass_flow_kgps=float(p[schedule.MASS_FLOW]),
        rate_damping_Nms=float(table_in(held.pool, damping)(clock_s)[about]) if damping.n_columns else 0.0,
        jet_damping=bool(vehicle.jet_damping),
        slosh_exchange=bool(vehicle.slosh.exchange),
        pendulums=pendulums_of(held),
        bob_mass_rate_kgps=held.tank(schedule.TANK_MASS_RATE)[0],
        bob_station_rate_mps=held.tank(schedule.TANK_TRAVEL)[0],
        modes=_modes(held, int(not pitch)),
        thrust_N=max(vacuum - condition.pressure_Pa * float(e.exit_area_m2[0]), 0.0),
        follower=bool(vehicle.follower_thrust),
        gimbal_station_m=float(e.gimbal_station_m[0]),
        exit_station_m=float(e.exit_station_m[0]),
        exit_square_m2=exit_m**2 + float(e["exit_zz_m2" if pitch else "exit_yy_m2"][0]),
        engine_mass_kg=mass,
        engine_arm_m=arm,
        engine_inertia_kgm2=float(e.inertia_kgm2[0]) + mass * arm * arm,
        flow_kgps=0.5 * condition.density_kgpm3 * condition.airspeed_mps * float(a.area_m2) if a.on else 0.0,
        chord_m=float(a.chord_m if pitch else a.yaw_chord_m),
        drag=float(a.axial_factor) * float(mach_row[aero.CD]),
        pitch_damping=float(a.damping_factor) * float(mach_row[aero.CMQ if pitch else aero.CNR]),
        local_incidence=bool(a.local_incidence),
        slope_pr=slope,
        moment_slope_mpr=moment,
    )


def _modes(held: HeldStage, plane: int) -> PlaneModes:
    p, bending, sizes = held.properties[0], held.parameters[0].vehicle.bending, held.sizes
    n, tanks, surfaces = int((sizes.pitch_modes, sizes.yaw_modes)[plane]), int(sizes.pendulums), int(sizes.surfaces)

    def row(which: int) -> Array:
        first = int(schedule.mode_column(sizes, plane, which))
        return np.array(p[first : first + n])

    def rows(first: int, count: int, every: int = 1) -> Array:
        return np.array([row(first + every * k) for k in range(count)]).reshape(count, n).T

    at_surface = int(schedule.surface_row(sizes, 0))
    return PlaneModes(
        omega_radps=bending.frequency_factor[:n] * row(schedule.MODE_OMEGA),
        damping_ratio=np.array((bending.zeta_yaw if plane else bending.zeta_pitch)[:n]),
        generalized_mass_kg=row(schedule.MODE_MASS),
        phi_gimbal=row(schedule.MODE_PHI_GIMBAL),
        slope_gimbal_pm=row(schedule.MODE_SLOPE_GIMBAL),
        slope_gyro_pm=row(schedule.MODE_SLOPE_GYRO),
        phi_hinge=rows(schedule.MODE_FIRST, tanks),
        phi_surface=rows(at_surface, surfaces, 2),
        slope_surface_pm=rows(at_surface + 1, surfaces, 2),
        softening_kgpm=float(bending.softening_factor) * rows(int(schedule.softening_row(sizes, 0)), n),
    )


def with_printed_tanks(vehicle: PlaneVehicle, errata: Errata, liquids: Liquids | None) -> PlaneVehicle:
    """Return the vehicle with pendulums according to the errata of the tanks. The core absorbs the difference.

    Raises ValueError if an erratum of the tanks is not corrected and `liquids` is None.
    """
    old = vehicle.pendulums
    if (errata.tank_radius and errata.tank_liquid) or not len(old.mass_kg):
        return vehicle
    if liquids is None:
        raise ValueError(
            "errata tank_radius and tank_liquid need the tanks' radius_m and liquid_height_m, which this vehicle lacks"
        )
    new = as_printed(old, liquids, errata.tank_radius, errata.tank_liquid)
    centre, inertia = vehicle.total_cg_station_m, vehicle.total_inertia_kgm2
    total = vehicle.core_mass_kg + old.mass_kg.sum()
    core = total - new.mass_kg.sum()
    station = (total * centre - new.mass_kg @ new.bob_station_m) / core
    apart = new.mass_kg @ (new.bob_station_m - centre) ** 2 + core * (station - centre) ** 2
    there = old.mass_kg > 0.0
    grown = np.divide(new.mass_kg, old.mass_kg, out=np.ones_like(old.mass_kg), where=there)
    return dataclasses.replace(
        vehicle,
        pendulums=new,
        bob_mass_rate_kgps=vehicle.bob_mass_rate_kgps * grown,
        core_mass_kg=float(core),
        core_cg_station_m=float(station),
        core_inertia_kgm2=float(inertia - apart),
    )


def as_printed(pendulums: Pendulums, liquids: Liquids, radius: bool, liquid: bool) -> Pendulums:
    """Return the pendulums of eqs 22, 23 and 25 with uncorrected errata.

    If `radius` is False, the diameter replaces the radius. If `liquid` is False, all propellant replaces the liquid of
    the tank. Mass and position of the liquid follow from the true pendulum. The paper does not give the hinge; it
    follows from the formula above with the same radius. The damping ratio is kept.
    """
    r = liquids.radius_m
    h = np.maximum(liquids.height_m, _SHALLOWEST * r)
    used = r if radius else 2.0 * r
    in_tank = pendulums.mass_kg / _mass_ratio(r, h)
    counted = in_tank if liquid else np.full_like(in_tank, in_tank.sum())
    centre = pendulums.hinge_station_m + _hinge_above(r, h, pendulums.length_m)
    length = pendulums.length_m if radius else used / (XI * np.tanh(XI * h / used))
    return dataclasses.replace(
        pendulums,
        mass_kg=counted * _mass_ratio(used, h),
        length_m=length,
        hinge_station_m=centre - _hinge_above(used, h, length),
    )


def _mass_ratio(radius: Array, height: Array) -> Array:
    x = XI * height / radius
    return np.asarray(2.0 * np.tanh(x) / (x * (XI * XI - 1.0)))


def _hinge_above(radius: Array, height: Array, length: Array) -> Array:
    """Return the height of the hinge above the liquid's CG."""
    return np.asarray(0.5 * height - 2.0 * radius / XI * np.tanh(0.5 * XI * height / radius) + length)


class _Equations:
    """The rows of coefficients of each quantity, first for the states, then for the inputs."""

    def __init__(self, vehicle: PlaneVehicle, condition: FlightCondition, load: float, errata: Errata) -> None:
        self.vehicle, self.condition, self.load, self.errata = vehicle, condition, load, errata
        self.tanks, n = len(vehicle.pendulums.mass_kg), len(vehicle.modes.omega_radps)
        self.names, self.inputs = state_names(n, self.tanks), ("delta_rad", "delta_accel_radps2", WIND)
        rows = np.eye(len(self.names) + len(self.inputs))
        self.w, self.q, self.theta = rows[:3]
        self.eta, self.eta_rate = rows[3 : 3 + n], rows[3 + n : 3 + 2 * n]
        self.swing, self.swing_rate = np.split(rows[3 + 2 * n : len(self.names)], 2)
        self.delta, self.delta_accel, wind = rows[len(self.names) :]
        self.through_air = self.w - wind
        v, bobs = vehicle, vehicle.pendulums.mass_kg.sum()
        self.mass, self.inertia, self.cg = (
            (v.core_mass_kg, v.core_inertia_kgm2, v.core_cg_station_m)
            if errata.core_mass
            else (v.total_mass_kg, v.total_inertia_kgm2, v.total_cg_station_m)
        )
        # between the rows of the tables, the total mass differs slightly from the sum of core and bobs
        whole = v.core_mass_kg + bobs if errata.core_mass else v.total_mass_kg
        self.specific_force = load * v.total_mass_kg / whole
        self.force, self.moment, self.modal = 0.0 * self.w, 0.0 * self.w, 0.0 * self.eta
        self._aerodynamics()
        self._thrust()
        self._engine()
        for k in range(self.tanks):
            self._slosh(k)
        if errata.jet_damping and v.jet_damping:
            momentum, turning = _mass_flow_momentum(v)
            self.force = self.force + 2.0 * momentum * self.q
            self.moment = self.moment - turning * self.q

    def _aerodynamics(self) -> None:
        """Add the aerodynamic terms (4), (6), (7), (17)."""
        v, modes = self.vehicle, self.vehicle.modes
        for k, slope in enumerate(v.slope_pr):
            local = self.through_air
            if v.local_incidence:
                local = local + self.condition.airspeed_mps * (modes.slope_surface_pm[:, k] @ self.eta)
                local = local + modes.phi_surface[:, k] @ self.eta_rate
            whole = local if self.errata.bent_body_loads else self.through_air
            self.force = self.force - v.flow_kgps * slope * whole
            self.moment = self.moment + v.flow_kgps * (slope * self.cg - v.moment_slope_mpr[k]) * whole
            self.modal = self.modal - v.flow_kgps * slope * np.outer(modes.phi_surface[:, k], local)
        damping = 0.5 * v.flow_kgps * v.chord_m**2 * v.pitch_damping - v.rate_damping_Nms
        self.moment = self.moment + damping * self.q
        if self.errata.path_terms:
            self.force = self.force - v.flow_kgps * v.drag * self.through_air

    def _thrust(self) -> None:
        """Add the thrust terms (5), (8), (16)."""
        v, modes = self.vehicle, self.vehicle.modes
        along = self.delta - modes.slope_gimbal_pm @ self.eta if v.follower else self.delta
        self.modal = self.modal + v.thrust_N * np.outer(modes.phi_gimbal, along)
        whole, offset = self.delta, 0.0 * self.w
        if self.errata.bent_body_loads:
            whole, offset = along, modes.phi_gimbal @ self.eta
        self.force = self.force + v.thrust_N * whole
        self.moment = self.moment + v.thrust_N * ((v.gimbal_station_m - self.cg) * whole + offset)

    def _engine(self) -> None:
        """Add the engine terms (18) to (20)."""
        v, modes, accel = self.vehicle, self.vehicle.modes, self.delta_accel
        first = v.engine_mass_kg * v.engine_arm_m
        inertia = v.engine_inertia_kgm2
        self.modal = self.modal + first * np.outer(modes.phi_gimbal, accel)
        if self.errata.engine_inertia:
            self.modal = self.modal + inertia * np.outer(modes.slope_gimbal_pm, accel)
        else:
            inertia = inertia - first * v.engine_arm_m
        self.force = self.force + first * accel
        self.moment = self.moment + (inertia + first * (v.gimbal_station_m - self.cg)) * accel
        if self.errata.engine_weight:
            self.moment = self.moment + self.specific_force * first * self.delta
            self.modal = self.modal + self.load * first * np.outer(modes.slope_gimbal_pm, self.delta)

    def _slosh(self, k: int) -> None:
        """Add the slosh terms (24), (26), (27)."""
        v, bobs, phi = self.vehicle, self.vehicle.pendulums, self.vehicle.modes.phi_hinge[:, k]
        mass, length, arm = bobs.mass_kg[k], bobs.length_m[k], self.cg - bobs.hinge_station_m[k]
        rod = mass * self.specific_force * self.swing[k]
        # force between bob and tank per rate of the pendulum's angle, a_x m_p 2 zeta / omega (24)
        friction = 2.0 * bobs.damping(self.load)[k] * np.sqrt(self.load * length) * mass * self.swing_rate[k]
        self.force = self.force + rod + friction
        self.moment = self.moment - arm * rod - (arm - length if self.errata.damper_at_bob else arm) * friction
        self.modal = self.modal + np.outer(phi, rod + friction)
        if self.errata.bent_body_loads:
            self.moment = self.moment - self.specific_force * mass * (phi @ self.eta)
        if v.slosh_exchange and mass > 0.0:  # liquid that moves from the bob to the core keeps its velocity
            flow = max(-v.bob_mass_rate_kgps[k], 0.0)
            swung = length * self.swing_rate[k]
            push = flow * (swung + phi @ self.eta_rate)
            self.force, self.moment = self.force + push, self.moment - (arm - length) * push
            self.modal = self.modal + flow * np.outer(phi, swung)

    def _swing_acceleration(self, k: int, lateral: Array, turning: Array, bending: Array) -> Array:
        """Return the row of a pendulum's angular acceleration (21)."""
        v, bobs, phi = self.vehicle, self.vehicle.pendulums, self.vehicle.modes.phi_hinge[:, k]
        mass, length = bobs.mass_kg[k], bobs.length_m[k]
        drive = lateral - (self.cg - bobs.hinge_station_m[k] - length) * turning + phi @ bending
        if self.errata.jet_damping and v.jet_damping:
            drive = drive + 2.0 * v.bob_station_rate_mps[k] * self.q
        damped = 2.0 * bobs.damping(self.load)[k] * np.sqrt(self.load / length) * self.swing_rate[k]
        out = -self.specific_force / length * self.swing[k] - damped - drive / length
        if v.slosh_exchange and mass > 0.0:  # liquid that moves from the core to the bob slows the bob
            gained = max(v.bob_mass_rate_kgps[k], 0.0) / mass
            out = out - gained * (self.swing_rate[k] + phi @ self.eta_rate / length)
        return np.asarray(out)

    def state_space(self) -> StateSpace:
        modes, errata = self.vehicle.modes, self.errata
        lateral, turning = self.force / self.mass, self.moment / self.inertia
        modal = self.modal if errata.mode_force_sign else -self.modal
        if errata.axial_softening:
            modal = modal + self.load * modes.softening_kgpm @ self.eta
        omega = modes.omega_radps[:, None]
        bending = modal / modes.generalized_mass_kg[:, None] - omega**2 * self.eta
        bending = bending - 2.0 * modes.damping_ratio[:, None] * omega * self.eta_rate
        swings = [self._swing_acceleration(k, lateral, turning, bending) for k in range(self.tanks)]
        w_rate = lateral + self.condition.airspeed_mps * self.q
        if errata.path_terms:
            weight = self.condition.gravity_mps2 * np.sin(self.condition.pitch_rad)
            w_rate = w_rate - weight * self.theta + self.vehicle.core_cg_rate_mps * self.q
        rates = np.vstack([w_rate, turning, self.q, self.eta_rate, bending, self.swing_rate, *swings])
        local = self.q + modes.slope_gyro_pm @ (self.eta_rate if errata.gyro_senses_rate else self.eta)
        sensed, n = np.array([self.q, local, self.w, self.theta]), len(self.names)
        return StateSpace(rates[:, :n], rates[:, n:], sensed[:, :n], sensed[:, n:], self.names, self.inputs, OUTPUTS)


def published_plant(
    vehicle: PlaneVehicle, condition: FlightCondition, load_mps2: float, errata: Errata, liquids: Liquids | None = None
) -> StateSpace:
    """Return the state space from engine motion and lateral wind to the rates of body, modes and pendulums.

    It corresponds to `Node.plant_in_wind`. The states are w (m/s, at the body point of the core's CG), q (rad/s), theta
    (rad), eta (m), eta' (m/s), G (rad), G' (rad/s). The outputs are `OUTPUTS`, with the local rate at the gyro, q + sum
    sigma_G eta' (12 with erratum 1). Raises ValueError if an erratum of the tanks is not corrected and `liquids` is
    None.
    """
    return _Equations(with_printed_tanks(vehicle, errata, liquids), condition, load_mps2, errata).state_space()


def _mass_flow_momentum(vehicle: PlaneVehicle) -> tuple[float, float]:
    """Return the lateral momentum P (kg m/s) and the damping (kg m2/s) of the mass flow per angular rate.

    The source is Reynolds' transport theorem with the Coriolis acceleration 2 w x v_rel of the flow through a rotating
    vessel (W. T. Thomson, Introduction to Space Dynamics, ch. 7). The equations are m a = F - 2 w x P, P = m
    dc/dt + sum of outflow times position, and I q' = M - (dI/dt + sum of outflow times position^2) q. Positions are
    forward of the CG, and c is the CG in the body. The gas leaves at the nozzle exit. Liquid also moves from the
    shrinking bobs to the core.
    """
    v, cg = vehicle, vehicle.core_cg_station_m
    exit_place, bob_place, bob_rate = cg - v.exit_station_m, cg - v.pendulums.bob_station_m, v.bob_mass_rate_kgps
    momentum = -v.core_mass_kg * v.core_cg_rate_mps + v.mass_flow_kgps * exit_place + bob_rate @ bob_place
    turning = v.core_inertia_rate_kgm2ps + v.mass_flow_kgps * (exit_place**2 + v.exit_square_m2)
    return float(momentum), float(turning + bob_rate @ bob_place**2)
