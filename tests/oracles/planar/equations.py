"""Write the equations of plant.py, with each quantity as a row of coefficients per state and input."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from oracles.planar.engine import GimballedEngine
from oracles.planar.sections import bending_moments
from oracles.planar.vehicle_at import PlanarVehicle

from maxq.control.kernel.records import Array
from maxq.design.model.held import OUTPUTS, FlightCondition, moment_name, state_names
from maxq.design.model.instruments import DERIVATIVES, of_drive
from maxq.design.model.state_space import StateSpace
from maxq.design.paper.errata import Errata


def dot(shape: Array, rows: Array) -> Array:
    """Return the sum of rows (k, columns, ...), weighted with `shape` (k, ...)."""
    return np.asarray((shape[:, None] * rows).sum(axis=0))


def outer(shape: Array, row: Array) -> Array:
    """Return a row (columns, ...) multiplied by each number of `shape` (k, ...)."""
    return np.asarray(shape[:, None] * row)


def joined(*parts: Array) -> Array:
    """Return stacked rows, each broadcast to the same number of vehicles."""
    one = np.broadcast_shapes(*(part.shape[1:] for part in parts))
    return np.concatenate([np.broadcast_to(part, (len(part), *one)) for part in parts])


def without_unknowns(system: Array, hinges: Array) -> Array:
    """Return the rows over states and inputs; the accelerations in the last columns follow from `hinges` = 0."""
    n = len(hinges)
    if n == 0:
        return system
    left, right = (np.moveaxis(part, (0, 1), (-2, -1)) for part in (-hinges[:, -n:], hinges[:, :-n]))
    known = np.moveaxis(np.linalg.solve(left, right), (-2, -1), (0, 1))
    return np.asarray(system[:, :-n] + np.einsum("ij...,jk...->ik...", system[:, -n:], known))


class Equations:
    """The equations of a vehicle. Each quantity is a row of coefficients: per state, then per input."""

    def __init__(
        self,
        vehicle: PlanarVehicle,
        condition: FlightCondition,
        load: float,
        errata: Errata,
        wind: bool = False,
        held: Array | None = None,
    ) -> None:
        vehicle = vehicle.hanging(load)
        self.vehicle, self.condition, self.load, self.errata = vehicle, condition, load, errata
        self.modes, self.tanks = len(vehicle.modes.omega_radps), len(vehicle.pendulums.mass_kg)
        # of each engine on a load its angle in this plane and, canted, the other one, which moves it in this plane too
        self.loaded = [swing for engine in vehicle.engines for swing in swings_of(engine)]
        self.names = state_names(self.modes, self.tanks, len(self.loaded))
        self.inputs = inputs_of(vehicle) + (("wind_mps",) if wind else ())
        n, m, states = self.modes, self.tanks, len(self.names)
        # behind states and inputs the unknown accelerations of engines on a TVC load
        rows = np.eye(states + len(self.inputs) + len(self.loaded))
        # of many vehicles at once every quantity has them along its last axis
        rows = rows[..., None] if vehicle.modes.omega_radps.ndim > 1 else rows
        self.w, self.q, self.theta = rows[0], rows[1], rows[2]
        self.eta, self.eta_rate = rows[3 : 3 + n], rows[3 + n : 3 + 2 * n]
        self.gamma, self.gamma_rate = rows[3 + 2 * n : 3 + 2 * n + m], rows[3 + 2 * n + m : 3 + 2 * n + 2 * m]
        self.driven = dict(zip(self.inputs, rows[states : states + len(self.inputs)], strict=True))
        swinging = rows[states - 2 * len(self.loaded) : states]
        self.swing, self.swing_rate = swinging[: len(self.loaded)], swinging[len(self.loaded) :]
        self.swing_accel = rows[states + len(self.inputs) :]
        self.through_air = self.w - self.driven["wind_mps"] if wind else self.w
        body = vehicle.body
        self.mass, self.inertia, self.cg = (
            (body.core_mass_kg, body.core_inertia_kgm2, body.core_cg_station_m)
            if errata.core_mass
            else (body.total_mass_kg, vehicle.total_inertia_kgm2, vehicle.total_cg_station_m)
        )
        # what the body really has: between their rows the tables' total is not quite that of core and bobs
        whole = body.core_mass_kg + vehicle.pendulums.mass_kg.sum(axis=0) if errata.core_mass else body.total_mass_kg
        self.specific_force = load * body.total_mass_kg / whole
        self.slosh_damping = vehicle.pendulums.damping(load)
        along, bobs = vehicle.modes.along, vehicle.pendulums
        moved: list[Array | float] = [0.0] * 4  # by the modes' deflection, forward
        if along is not None and held is not None:
            moved = [held @ shapes for shapes in (along.hinges, along.gimbals, along.surfaces, along.sensors)]
        self.hinge_station_m = bobs.hinge_station_m - moved[0]
        self.gimbal_moved_m = np.zeros(len(vehicle.modes.further_gimbals) + 1) - moved[1]
        self.surface_moved_m = np.zeros(vehicle.modes.phi_surface.shape[1]) - moved[2]
        self.sensor_station_m = np.array([station for _, station in vehicle.sensors]) - moved[3]
        # and what moves them forward, with the local rotation that they are held at
        self.held = np.zeros(0) if held is None or along is None else held
        self.forward = self.eta[: len(self.held)]
        self.force: Array = np.zeros(rows.shape[1:])
        self.moment: Array = np.zeros(rows.shape[1:])
        self.modal: Array = np.zeros((n, *rows.shape[1:]))
        self._aerodynamics()
        self.air_force, self.air_moment = self.force, self.moment
        for engine in vehicle.engines:
            motion = self._motion(engine)
            ahead, aside = (np.sum([slope[k] * delta for slope, delta, _ in motion], axis=0) for k in (0, 1))
            self._thrust(engine, ahead, aside)
            for slope, delta, accel in motion:
                self._engine(engine, slope, delta, accel)
        self.rod: list[Array] = []  # pull of each rod at its hinge, and force of each damper at its bob
        self.damper: list[Array] = []
        self._slosh()
        self.outflow = 0.0 * self.q, 0.0 * self.q  # force and moment
        if errata.jet_damping and vehicle.jet_damping:
            momentum, turning = mass_flow_momentum(vehicle)
            self.outflow = 2.0 * momentum * self.q, -turning * self.q
            self.force = self.force + self.outflow[0]
            self.moment = self.moment + self.outflow[1]

    def _aerodynamics(self) -> None:
        """Add aerodynamics: (4), (6), (7), (17)."""
        air, modes = self.vehicle.aerodynamics, self.vehicle.modes
        flow = 0.5 * self.condition.density_kgpm3 * self.condition.airspeed_mps * air.area_m2
        couples, rate_couples = air.modal_couples()
        self.force, self.moment, self.modal = self.by_flow(self, air.slope_pr, air.moment_slope_mpr, couples)
        for k, (by_rate, moment) in enumerate(zip(air.rate_slope_m, air.rate_moment_m2, strict=True)):
            place, local_flow = air.met_by_modes(k)
            if place < 0:
                continue
            phi, tilt = modes.phi_surface[:, place], modes.slope_surface_pm[:, place]
            if local_flow and modes.along is not None:
                met = air.forward * self.condition.airspeed_mps * (self.held @ tilt[: len(self.held)])
                pushed = flow * air.slope_pr[k] * met
                self.moment = self.moment + pushed * self._forward(modes.along.surfaces[:, place])
            self.force = self.force - flow * by_rate * self.q
            self.moment = self.moment + flow * (by_rate * self.cg - moment) * self.q
            on_modes = tilt * rate_couples[k] - phi * by_rate
            self.modal = self.modal + flow * outer(on_modes, self.q)
        self.moment = self.moment + 0.5 * flow * air.chord_m**2 * air.rate_damping * self.q
        self.moment = self.moment - self.vehicle.body.rate_damping_Nms * self.q
        if self.errata.path_terms:
            self.force = self.force - flow * air.drag * self.through_air

    def by_flow(
        self, other: Equations, slope_pr: Array, moment_mpr: Array, couples: Array
    ) -> tuple[Array, Array, Array]:
        """Return force, moment and modal forces due to flow in the plane of `other` (or this one), in its rows."""
        air, modes = self.vehicle.aerodynamics, self.vehicle.modes
        flow = 0.5 * self.condition.density_kgpm3 * self.condition.airspeed_mps * air.area_m2
        force, moment, modal = 0.0 * other.w, 0.0 * other.w, 0.0 * outer(modes.omega_radps, other.w)
        for k, slope in enumerate(slope_pr):
            place = air.met_by_modes(k)[0]
            local, whole = self.met_by(k, other)
            force = force - flow * slope * whole
            moved = self.surface_moved_m[place] if place >= 0 else 0.0
            moment = moment + flow * (slope * (self.cg - moved) - moment_mpr[k]) * whole
            if place >= 0:
                modal = modal - flow * slope * outer(modes.phi_surface[:, place], local)
                modal = modal + flow * couples[k] * outer(modes.slope_surface_pm[:, place], local)
        return force, moment, modal

    def met_by(self, part: int, other: Equations) -> tuple[Array, Array]:
        """Return the flows in the plane of `other` at a part of `slope_pr`: on the modes and on the body."""
        air, theirs = self.vehicle.aerodynamics, other.vehicle.modes
        place, local_flow = air.met_by_modes(part)
        bent = 0.0 * other.w
        if local_flow:
            bent = air.forward * self.condition.airspeed_mps * dot(theirs.slope_surface_pm[:, place], other.eta)
            bent = bent + dot(theirs.phi_surface[:, place], other.eta_rate)
        local = other.through_air + bent
        return local, local if self.errata.bent_body_loads else other.through_air

    def _actuator(self, engine: GimballedEngine, derivative: str) -> Array:
        return np.asarray(engine.gain * self.driven[of_drive(derivative, engine.drive)])

    def _motion(self, engine: GimballedEngine) -> list[tuple[tuple[float, float], Array, Array]]:
        """Return, for each relevant angle, the change of the thrust axis, the angle and its acceleration."""
        if engine.tvc_load is not None:
            mine = [k for k, swing in enumerate(self.loaded) if swing.engine is engine]
            return [(self.loaded[k].slope, self.swing[k], self.swing_accel[k]) for k in mine]
        if engine.gain == 0.0:
            return [(engine.slope, 0.0 * self.w, 0.0 * self.w)]
        angle, accel = (self._actuator(engine, name) for name in ("delta_rad", "delta_accel_radps2"))
        return [(engine.slope, angle, accel)]

    def _thrust(self, engine: GimballedEngine, turned: Array, aside: Array) -> None:
        """Add (5), (8), (16) of one engine; axial thrust of an off-axis or canted engine also bends the body."""
        thrust = engine.thrust_N(self.condition.pressure_Pa)
        arm = engine.gimbal_station_m + self.gimbal_moved_m[engine.gimbal] - self.cg
        phi, slope = self.vehicle.modes.at_gimbal(engine.gimbal)
        ahead, across = engine.rest
        bent = -dot(slope, self.eta) if engine.follower else 0.0 * self.w
        tilt = ahead * bent
        self.modal = self.modal + thrust * outer(phi, aside + tilt)
        whole, offset = aside, 0.0 * self.w
        if self.errata.bent_body_loads:
            whole, offset = aside + tilt, ahead * dot(phi, self.eta)
        self.force = self.force + thrust * whole
        self.moment = self.moment + thrust * (arm * whole + offset)
        if engine.follower and self.vehicle.modes.along is not None:
            tilted = ahead * (self.held @ slope[: len(self.held)])
            moves = self._forward(self.vehicle.modes.along.gimbals[:, engine.gimbal])
            self.moment = self.moment + thrust * tilted * moves
        if engine.beside_m != 0.0 or engine.from_cg_m != 0.0:
            forward = turned - across * bent
            self.modal = self.modal + thrust * engine.beside_m * outer(slope, forward)
            self.moment = self.moment + thrust * engine.from_cg_m * forward

    def _forward(self, shape: Array) -> Array:
        """Return the displacement of a place along x, relative to the held deflection."""
        return dot(shape[: len(self.held)], self.forward) if len(self.held) else 0.0 * self.w

    def _engine(self, engine: GimballedEngine, by: tuple[float, float], delta: Array, accel: Array) -> None:
        """Add (18) to (20) for one angle of an engine; the thrust axis changes by `by` per radian."""
        phi, slope = self.vehicle.modes.at_gimbal(engine.gimbal)
        (ahead, across), (ahead_slope, across_slope), length = engine.rest, by, engine.cg_from_gimbal_m
        first = engine.gimballed_mass_kg * length
        own = engine.inertia_about_gimbal_kgm2 - first * length
        turning = ahead * across_slope - across * ahead_slope
        swung = first * length if self.errata.engine_inertia else 0.0
        inertia = own * turning + swung * turning
        lateral = first * across_slope
        self.force = self.force + lateral * accel
        besides = first * engine.from_cg_m * ahead_slope
        self.moment = self.moment + (inertia + lateral * (engine.gimbal_station_m - self.cg) + besides) * accel
        self.modal = self.modal + lateral * outer(phi, accel)
        if self.errata.engine_inertia:
            ahead, across = engine.mounted  # modes have its CG there, wherever it hangs
            bends = own * turning + swung * (ahead * across_slope - across * ahead_slope)
            bends = bends + first * engine.beside_m * ahead_slope
            self.modal = self.modal + bends * outer(slope, accel)
        if self.errata.engine_weight:
            self.moment = self.moment + self.specific_force * lateral * delta
            self.modal = self.modal + self.load * lateral * outer(slope, delta)

    def _slosh(self) -> None:
        """Add slosh: (24), (26), (27)."""
        bobs, modes = self.vehicle.pendulums, self.vehicle.modes
        for k in range(self.tanks):
            rod = bobs.mass_kg[k] * self.specific_force * self.gamma[k]
            # force between bob and tank per rate of the pendulum's angle, a_x m_p 2 zeta / omega (24)
            length, mass = bobs.length_m[k], bobs.mass_kg[k]
            friction = 2.0 * self.slosh_damping[k] * np.sqrt(self.load / length) * length * mass * self.gamma_rate[k]
            arm = self.cg - self.hinge_station_m[k]
            self.force = self.force + rod + friction
            self.moment = self.moment - arm * rod
            self.moment = self.moment - (arm - bobs.length_m[k] if self.errata.damper_at_bob else arm) * friction
            self.modal = self.modal + outer(modes.phi_hinge[:, k], rod + friction)
            self.rod.append(rod)
            self.damper.append(friction)
            if self.errata.bent_body_loads:
                self.moment = self.moment - self.specific_force * bobs.mass_kg[k] * dot(modes.phi_hinge[:, k], self.eta)
            if self.vehicle.slosh_exchange and np.all(bobs.mass_kg[k] > 0.0):
                self._exchange(k, arm - length)

    def _exchange(self, k: int, arm: float) -> None:
        """Add the liquid that moves from bob to core, at the bob, `arm` forward of the CG.

        The liquid keeps its velocity; its velocity relative to the bent axis drives the modes. `state_space` adds the
        deceleration of a bob by the liquid that it gains.
        """
        bobs, modes = self.vehicle.pendulums, self.vehicle.modes
        flow, swung = np.maximum(-bobs.mass_rate_kgps[k], 0.0), bobs.length_m[k] * self.gamma_rate[k]
        push = flow * (swung + dot(modes.phi_hinge[:, k], self.eta_rate))
        self.force = self.force + push
        self.moment = self.moment - arm * push
        self.modal = self.modal + flow * outer(modes.phi_hinge[:, k], swung)
        self.damper[k] = self.damper[k] + flow * swung

    def held_load_mps2(self) -> Array:
        """Return the lateral specific force at the hinges (tanks,) at the held deflection."""
        bent = slice(3, 3 + len(self.held))
        lateral, turning = (row[bent] @ self.held for row in (self.force / self.mass, self.moment / self.inertia))
        return np.asarray(lateral - (self.cg - self.hinge_station_m) * turning)

    def drive(self) -> Array:
        """Return the modal accelerations by everything but the modes' own stiffness and damping, (modes, row)."""
        modes = self.vehicle.modes
        force = self.modal if self.errata.mode_force_sign else -self.modal
        if self.errata.axial_softening:
            force = force + self.load * np.einsum("ij...,jk...->ik...", modes.softening_kgpm, self.eta)
        return np.asarray(force / modes.generalized_mass_kg[:, None])

    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """Return A, B, C and D; vehicles are along the last axis."""
        system, hinges, sensed = self.rows()
        whole, n = without_unknowns(joined(system, sensed), hinges), len(self.names)
        return whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:]

    def state_space(self) -> StateSpace:
        return StateSpace(*self.matrices(), self.names, self.inputs, outputs_of(self.vehicle))

    def _sensed(self, lateral: Array, turning: Array, bending: Array) -> Array:
        """Return `outputs_of` the vehicle from the accelerations of body and modes."""
        modes = self.vehicle.modes
        rates = self.eta_rate if self.errata.gyro_senses_rate else self.eta
        out = [self.q, self.q + dot(modes.slope_gyro_pm, rates), self.w, self.theta]
        sensors = zip(self.vehicle.sensors, self.sensor_station_m, modes.sensors, strict=True)
        for (name, _), station_m, (phi, slope) in sensors:
            if name == "accel_mps2":
                tilted = self.specific_force * dot(slope, self.eta)
                out.append(lateral - (self.cg - station_m) * turning + dot(phi, bending) + tilted)
            else:
                out.append(self.q + dot(slope, rates))
        if self.vehicle.cuts is not None:
            out += bending_moments(self, self.vehicle.cuts, lateral, turning, bending)
        return np.stack(np.broadcast_arrays(*out))

    def rows(self) -> tuple[Array, Array, Array]:
        """Return state rates, balances about the hinges of TVC loads, and outputs, in unknown accelerations."""
        modes, bobs = self.vehicle.modes, self.vehicle.pendulums
        lateral, turning = self.force / self.mass, self.moment / self.inertia
        omega = modes.omega_radps[:, None]
        damping = 2.0 * modes.damping_ratio[:, None] * omega
        bending = self.drive() - omega**2 * self.eta - damping * self.eta_rate
        coriolis = (
            bobs.bob_station_rate_mps if self.errata.jet_damping and self.vehicle.jet_damping else 0.0 * bobs.mass_kg
        )
        swing: list[Array] = []
        for k in range(self.tanks):  # (21)
            length, natural = bobs.length_m[k], np.sqrt(self.load / bobs.length_m[k])
            arm = self.cg - self.hinge_station_m[k]
            drive = (
                lateral - (arm - length) * turning + dot(modes.phi_hinge[:, k], bending) + 2.0 * coriolis[k] * self.q
            )
            damped = 2.0 * self.slosh_damping[k] * natural * self.gamma_rate[k]
            free = -self.specific_force / length * self.gamma[k] - damped
            swing.append(free - drive / length)
            gained = np.maximum(bobs.mass_rate_kgps[k], 0.0)
            if self.vehicle.slosh_exchange and np.all(bobs.mass_kg[k] > 0.0):
                relative = self.gamma_rate[k] + dot(modes.phi_hinge[:, k], self.eta_rate) / length
                swing[k] = swing[k] - gained / bobs.mass_kg[k] * relative
        swings = np.stack(np.broadcast_arrays(*swing)) if swing else np.zeros((0, *turning.shape))
        w_rate = lateral + self.vehicle.aerodynamics.forward * self.condition.airspeed_mps * self.q
        if self.errata.path_terms:
            weight = self.condition.gravity_mps2 * np.sin(self.condition.pitch_rad)
            w_rate = w_rate - weight * self.theta + self.vehicle.body.core_cg_rate_mps * self.q
        body = np.stack(np.broadcast_arrays(w_rate, turning, self.q))
        system = joined(body, self.eta_rate, bending, self.gamma_rate, swings, self.swing_rate, self.swing_accel)
        hinges = np.zeros((len(self.loaded), *turning.shape))
        for k, one in enumerate(self.loaded):
            engine = one.engine
            about_hinge = engine.inertia_about_gimbal_kgm2
            if not self.errata.engine_inertia:
                about_hinge -= engine.gimballed_mass_kg * engine.cg_from_gimbal_m**2
            hinges[k] = self._hinge(k, one) - about_hinge * one.lever * self.swing_accel[k]
            unknown = len(self.w) - len(self.loaded) + k
            hinges[k] += (
                self.force[unknown] * lateral + self.moment[unknown] * turning + dot(self.modal[:, unknown], bending)
            )
        return system, hinges, self._sensed(lateral, turning, bending)

    def _hinge(self, k: int, swing: Swing) -> Array:
        """Return the moment of spring, damper and axial load on an engine about its hinge."""
        engine = swing.engine
        load, (_, slope) = engine.tvc_load, self.vehicle.modes.at_gimbal(engine.gimbal)
        assert load is not None
        first = engine.gimballed_mass_kg * engine.cg_from_gimbal_m if self.errata.engine_weight else 0.0
        moment = -load.stiffness_Nmprad * self.swing[k] - load.damping_Nmsprad * self.swing_rate[k]
        if swing.commanded:
            moment = moment + load.stiffness_Nmprad * self._actuator(engine, "delta_rad")
            moment = moment + load.damping_Nmsprad * self._actuator(engine, "delta_rate_radps")
        weight = engine.rest[0] * self.swing[k]
        others = [j for j, other in enumerate(self.loaded) if other.engine is engine and j != k]
        weight = weight - sum(engine.twist * self.swing[j] for j in others)
        bent = swing.slope[1] * dot(slope, self.eta)  # of the mode's potential, which has the tables' mass
        return np.asarray(moment - first * (self.specific_force * weight - self.load * bent))


class Swing(NamedTuple):
    """An engine angle on a TVC load; `lever`: squared change of its thrust axis per radian, in space."""

    engine: GimballedEngine
    slope: tuple[float, float]  # what it changes by in this plane
    lever: float
    commanded: bool


def swings_of(engine: GimballedEngine) -> list[Swing]:
    """Return the engine's angle in this plane and, if a cant couples it to this plane, the angle in the other."""
    if engine.tvc_load is None:
        return []
    own, other = engine.levers
    others = [Swing(engine, engine.other_slope, other, False)] if np.any(engine.other_slope) else []
    return [Swing(engine, engine.slope, own, True), *others]


def outputs_of(vehicle: PlanarVehicle) -> tuple[str, ...]:
    """Return the names of a plane's outputs: OUTPUTS, further sensors, bending moments at the vehicle's sections."""
    stations = () if vehicle.cuts is None else vehicle.cuts.station_m.tolist()
    return (*OUTPUTS, *(name for name, _ in vehicle.sensors), *(moment_name(at) for at in stations))


def inputs_of(vehicle: PlanarVehicle) -> tuple[str, ...]:
    """Return the names of a plane's inputs by drive: the angle and the derivatives that act on engines."""
    out = []
    for drive in sorted({engine.drive for engine in vehicle.engines}):
        moved = [e for e in vehicle.engines if e.drive == drive]
        swings = any(e.tvc_load is not None for e in moved)
        follows = any(e.tvc_load is None and e.gain != 0.0 for e in moved) or not swings
        wanted = dict(zip(DERIVATIVES, (True, swings, follows), strict=True))
        out += [of_drive(name, drive) for name in DERIVATIVES if wanted[name]]
    return tuple(out)


def mass_flow_momentum(vehicle: PlanarVehicle) -> tuple[float, float]:
    """Return the momentum of the mass flow through the core: lateral momentum P (kg m/s) and pitch damping (kg m2/s)
    per pitch rate.

    Reynolds' transport theorem with the Coriolis acceleration 2 w x v_rel of the flow through a turning vessel (W. T.
    Thomson, Introduction to Space Dynamics, ch. 7): m a = F - 2 w x P, P = m dc/dt + sum of outflow times place, and I
    q' = M - (dI/dt + sum of outflow times place^2) q, places forward of the CG, c the CG in the body. The gas leaves at
    the nozzle exit. Liquid also moves from the shrinking bobs to the core.
    """
    body, bobs, cg = vehicle.body, vehicle.pendulums, vehicle.body.core_cg_station_m
    bob_place = cg - bobs.bob_station_m
    momentum, turning = -body.core_mass_kg * body.core_cg_rate_mps, body.core_inertia_rate_kgm2ps
    for engine in vehicle.engines:
        flow, exit_place = engine.flow_share * body.mass_flow_kgps, cg - engine.exit_station_m
        # not in place: of many vehicles the CG may differ where the core does not
        momentum = momentum + flow * exit_place
        turning = turning + flow * (exit_place**2 + engine.exit_square_m2)
    momentum = momentum + (bobs.mass_rate_kgps * bob_place).sum(axis=0)
    return momentum, turning + (bobs.mass_rate_kgps * bob_place**2).sum(axis=0)
