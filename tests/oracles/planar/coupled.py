"""Combine both planes of plant.py and the spatial modes that they share."""

from __future__ import annotations

import numpy as np
from oracles.planar.equations import Equations, outputs_of, without_unknowns
from oracles.planar.vehicle_at import PlanarVehicle

from maxq.control.kernel.records import Array
from maxq.design.model.held import OUTPUTS, FlightCondition, state_names
from maxq.design.model.state_space import StateSpace
from maxq.design.paper.errata import Errata


class Coupled:
    """Both planes and their spatial modes, about the modes' deflection `held` (m); `wind` in the first plane.

    Along x, liquid moves with its tank: it adds to the modal masses, and its pull has a moment about a bent axis.
    """

    def __init__(
        self,
        vehicle: PlanarVehicle,
        across: PlanarVehicle,
        condition: FlightCondition,
        load: float,
        errata: Errata,
        held: Array,
        wind: bool = False,
    ) -> None:
        one = Equations(vehicle, condition, load, errata, wind, held)
        other = Equations(across, condition, load, errata, held=held)
        self.one, self.across, self.held, self.shared = one, other, held, vehicle.modes.spatial
        shared, self.planes = self.shared, (one, other)
        n, k = len(one.names), len(other.names)
        common = [*(3 + np.arange(shared)), *(3 + other.modes + np.arange(shared))]
        self.own = np.setdiff1d(np.arange(k), common)
        self.size, inputs = n + len(self.own), [len(plane.inputs) for plane in self.planes]
        # from a plane's states, inputs and unknown accelerations to those of the whole
        self.columns = self.size + sum(inputs) + sum(len(plane.loaded) for plane in self.planes)
        self.embed, at, unknown = [], self.size, self.size + sum(inputs)
        theirs = np.zeros(k)  # the other plane's own behind the first plane's, those that both share anywhere
        theirs[self.own] = n + np.arange(len(self.own))
        for plane, places_of in zip(self.planes, (np.arange(n), theirs), strict=True):
            places = np.concatenate(
                [places_of, at + np.arange(len(plane.inputs)), unknown + np.arange(len(plane.loaded))]
            )
            at, unknown = at + len(plane.inputs), unknown + len(plane.loaded)
            self.embed.append(np.eye(self.columns)[places.astype(int)])
        self.embed[1][common] = np.eye(self.columns)[[*(3 + np.arange(shared)), *(3 + one.modes + np.arange(shared))]]
        self.crossed = self._crossed()
        self.drives = [
            plane.drive()[:shared] @ e + modal[:shared]
            for plane, e, (_, _, modal) in zip(self.planes, self.embed, self.crossed, strict=True)
        ]
        modes, eye = one.vehicle.modes, np.eye(self.columns)
        omega = modes.omega_radps[:shared, None]
        spring = omega**2 * eye[3 : 3 + shared]
        spring = spring + 2.0 * modes.damping_ratio[:shared, None] * omega * eye[3 + one.modes : 3 + one.modes + shared]
        self.free = self.drives[0] + self.drives[1] - spring  # accelerations without what rides along x

    def _crossed(self) -> list[tuple[Array, Array, Array]]:
        """Return the accelerations of each plane due to flow in the other: lateral, angular, of all its modes."""
        out = []
        for plane, other, e in zip(self.planes, self.planes[::-1], self.embed[::-1], strict=True):
            air = plane.vehicle.aerodynamics
            force, moment, modal = plane.by_flow(other, air.cross_slope_pr, air.cross_moment_mpr, air.cross_couples())
            mass = plane.vehicle.modes.generalized_mass_kg[:, None]
            out.append((force @ e / plane.mass, moment @ e / plane.inertia, modal @ e / mass))
        return out

    def settled(self) -> Array:
        """Return the deflections at which thrust and the axial pull of the liquid hold the modes at rest."""
        one, along = self.one, self.one.vehicle.modes.along
        assert along is not None
        push = -one.specific_force * along.hinges @ one.vehicle.pendulums.mass_kg
        for engine in one.vehicle.engines:
            thrust = engine.rest[0] * engine.thrust_N(one.condition.pressure_Pa)
            push = push + thrust * along.gimbals[:, engine.gimbal]
        per_m = self.free[:, 3 : 3 + self.shared]
        return np.asarray(np.linalg.solve(per_m, -push / one.vehicle.modes.generalized_mass_kg[: self.shared]))

    def _riding(self) -> tuple[Array, Array]:
        """Return the contribution of liquid that moves with its tank along x to the modal accelerations, and pull rows.

        The rows are the changes of each bob's pull: its mass times the axial acceleration of its hinge. It is due to
        the body, the modes and, where the bent axis is displaced, rotation, less the part of a bob that swings under a
        lateral load.
        """
        one, along = self.one, self.one.vehicle.modes.along
        if along is None:
            return 0.0 * self.free, np.zeros((one.tanks, self.columns))
        mass, core = one.vehicle.pendulums.mass_kg, one.vehicle.body.core_mass_kg
        per_force = along.hinges / one.vehicle.modes.generalized_mass_kg[: self.shared, None]
        given, yields = along.hinges.T @ self.free, 1.0 / core + along.hinges.T @ per_force
        for plane, e, (_, turning, _) in zip(self.planes, self.embed, self.crossed, strict=True):
            beside = self._beside(plane)
            given += np.outer(beside, plane.moment @ e / plane.inertia + turning)
            given -= plane.held_load_mps2()[:, None] * (plane.gamma @ e)
            yields = yields + np.outer(beside, beside) / plane.inertia
        pull = np.linalg.solve(np.eye(one.tanks) + mass[:, None] * yields, mass[:, None] * given)
        return -per_force @ pull, pull

    def _beside(self, plane: Equations) -> Array:
        """Return the lateral displacements of the hinges at the held modal coordinates (tanks,)."""
        return np.asarray(self.held @ plane.vehicle.modes.phi_hinge[: self.shared])

    def state_space(self) -> StateSpace:
        one, across, shared = self.one, self.across, self.shared
        riding, pulled = self._riding()
        systems, hinges, seen = [], [], []
        parts = zip(self.planes, self.embed, self.drives[::-1], self.crossed, strict=True)
        for plane, e, driven, (pushed, turning, by_flow) in parts:
            drive = by_flow.copy()
            drive[:shared] += driven + riding
            system, hinge, sensed = (rows @ e for rows in plane.rows())
            bobs, phi = plane.vehicle.pendulums, plane.vehicle.modes.phi_hinge
            turned = turning - self._beside(plane) @ pulled / plane.inertia
            for k, (name, _) in enumerate(plane.vehicle.sensors):
                if name == "accel_mps2":
                    sensed[len(OUTPUTS) + k] += plane.vehicle.modes.sensors[k][0] @ drive + pushed
                    sensed[len(OUTPUTS) + k] -= (plane.cg - plane.sensor_station_m[k]) * turned
            seen.append(sensed)
            system[0] += pushed
            system[1] += turned
            system[3 + plane.modes : 3 + 2 * plane.modes] += drive
            swing = 3 + 2 * plane.modes + plane.tanks
            arms = plane.cg - plane.hinge_station_m - bobs.length_m
            system[swing : swing + plane.tanks] -= (phi / bobs.length_m).T @ drive
            system[swing : swing + plane.tanks] += (np.outer(arms, turned) - pushed) / bobs.length_m[:, None]
            unknown = slice(len(plane.names) + len(plane.inputs), None)
            reacts = np.outer(plane.moment[unknown], turned) + np.outer(plane.force[unknown], pushed)
            hinges.append(hinge + plane.modal[:, unknown].T @ drive + reacts)
            systems.append(system)
        rolls = np.zeros((1, self.columns))
        rolls[0, 3 + one.modes : 3 + one.modes + shared] = one.vehicle.modes.roll_gyro_pm
        rows = np.concatenate([systems[0], systems[1][self.own], *seen, rolls])
        whole, size = without_unknowns(rows, np.concatenate(hinges)), self.size
        every = state_names(
            one.modes + across.modes - shared, one.tanks + across.tanks, len(one.loaded) + len(across.loaded)
        )
        further = (*(f"across_{name}" for name in across.names[:3]), *(x for x in every if x not in one.names))
        outputs = outputs_of(one.vehicle)
        return StateSpace(
            whole[:size, :size],
            whole[:size, size:],
            whole[size:, :size],
            whole[size:, size:],
            (*one.names, *further),
            (*one.inputs, *(f"across_{name}" for name in across.inputs)),
            (*outputs, *(f"across_{name}" for name in outputs), "roll_bending_radps"),
        )
