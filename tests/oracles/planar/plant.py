"""Model the vehicle as a linear system: small motions in one plane about flight along the body axis, time frozen.

Body axes at the core's CG, x forward, z down (pitch plane); stations are metres aft of the nose. The vehicle flies
along x at speed U without turning, under the specific axial force a = (T - D) / m. The equations are those of Lee, Ahn
& Roh, 1 to 27, in the paper's form: forces and moments on a body of mass m and inertia I (1, 2), a modal force (14),
pendulums driven by the motion of their hinge (21). Each erratum is a switch (errata.py). With `PAPER` they are the
equations as printed, with `CORRECTED` the physics that the simulator flies. tests/oracles/dalembert_plant.py derives
the corrected ones independently, by d'Alembert's principle.

The constant g cos(theta_0) acts on every particle alike and curves the path (gravity turn); it is omitted. Gravity does
no work on a free-free mode (erratum 3). Thrust T acts at the displaced gimbal along the bent axis, each lifting surface
on its local angle of attack, drag along the wind; the engine behind the gimbal (I_E about it, first moment S = m_E l_E)
reacts to delta'' and hangs under the axial load (8). Its rate has no effect. Slosh damping is a force between bob and
tank:

    M_S = - sum m_p [ a l_p G + 2 zeta w L (l_p - L) G' ].

(27) prints the hinge's arm l_p for both terms (erratum 22). The rod's pull acts at the hinge, the liquid's friction at
the bob, l_p - L forward of the CG. The printed pair of damping forces is not on one line, so it does not conserve
angular momentum.

With a TVC load (docs/model.md, section 14) an engine's angle is a state and its acceleration an unknown. Spring and
damper to the actuator, the axial load on its mass, and the vehicle's accelerations drive it. By reciprocity, its
acceleration drives the vehicle equally. Engines of a cluster drive each other through the motions of this plane. Their
effects on roll and on the other plane cancel in a cluster symmetric about the plane, and are omitted otherwise.

A *drive* is an actuator's motion, which the law commands: all groups of engines with alike actuators are one. The names
of further drives' inputs end with their number (`delta_rad_2`).

Choices that the paper leaves open: delta_b = -sigma_T eta and alpha_b = sigma_s eta + phi_s eta' / U (16, 17), phi at
the surface, gimbal or hinge at which a force acts, the derivatives (4 to 8) of the whole vehicle with its liquid
frozen, I_E as that about the engine's CG (20), a_x = (T - D) / m, and W' - g_z - U q in (21) from (1).

Lateral slosh of an upright cylinder as a pendulum (22, 23, 25, with errata 6 and 7): with the tank's radius R, the
liquid's depth h and xi the first root of J1' (NASA SP-106, ch. 6; Dodge, The New "Dynamic Behavior of Liquids in Moving
Containers", 2000),

    L = R / (xi tanh(xi h / R)),    m_p = m 2 R tanh(xi h / R) / (xi h (xi^2 - 1)),
    hinge above the liquid's CG by  h / 2 - (2 R / xi) tanh(xi h / (2 R)) + L.

Spatial modes move in both planes. The plant of one plane then also has the states of the other plane ("across"), with
the same equations. The force of a spatial mode is the sum over both planes. Along the body axis, thrust and liquid hold
the modes deflected. The plant is linear about this deflection and includes the liquid that moves with its tanks.
Torsion affects the gimbal only in second order and is omitted, except for the rotation that the roll gyro measures.

Yaw plane: the same with w -> v, q -> -r, theta -> -psi, eta -> xi, delta -> -delta_yaw, gyro -> -gyro. The rotation
that takes B's z axis to y takes the pitch axis y to -z, so a positive angle moves the gimbal's thrust to +z in pitch
but to -y in yaw. From command to gyro both signs change, and the transfer function is the same.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from oracles.planar.coupled import Coupled
from oracles.planar.equations import Equations, inputs_of, outputs_of, swings_of
from oracles.planar.vehicle_at import Pendulums, PlanarVehicle, with_pendulums

from maxq.control.kernel.records import Array
from maxq.design.model.held import FlightCondition, state_names
from maxq.design.model.state_space import StateSpace
from maxq.design.paper.errata import Errata

XI = 1.84118378134066
_SHALLOWEST = 1e-6  # depth in radii: the formulae have limits at zero
CORRECTED = Errata()


@dataclass(frozen=True)
class Liquids:
    """The radius and liquid depth of each tank, (tanks,)."""

    radius_m: Array
    height_m: Array


def axial_load_mps2(vehicle: PlanarVehicle, condition: FlightCondition) -> float:
    """Return the axial specific force of the vehicle with hanging engines, (thrust - drag) / mass."""
    drag = condition.dynamic_pressure_Pa * vehicle.aerodynamics.area_m2 * vehicle.aerodynamics.axial
    load = (vehicle.thrust_N(condition.pressure_Pa) - drag) / vehicle.body.total_mass_kg
    for _ in range(3 if vehicle.sags else 0):  # sag takes some 1e-5 of it
        load = (vehicle.hanging(load).thrust_N(condition.pressure_Pa) - drag) / vehicle.body.total_mass_kg
    return load


def vehicle_plant(
    vehicle: PlanarVehicle,
    condition: FlightCondition,
    errata: Errata = CORRECTED,
    liquids: Liquids | None = None,
    wind: bool = False,
) -> StateSpace:
    """Return the plant from actuator motion, on which engines follow or swing, to rates of body, modes and pendulums.

    States w (m/s, of the body point at the core's CG), q (rad/s), theta (rad), eta (m), eta' (m/s), G (rad), G'
    (rad/s), angle and rate of each engine on a TVC load. Inputs are `inputs_of`. The outputs are OUTPUTS, of which the
    local rate is that at the gyro, q + sum sigma_G eta' (12 with erratum 1), then the measurements of the vehicle's
    other sensors: the local rate, or the lateral specific force in axes that turn with the bent body (docs/model.md,
    section 2). A vehicle with `cuts` also has the bending moment at each, N m (sections.py; corrected physics only).
    With `wind`, the last input of the plane is the air's lateral velocity in it, m/s. A vehicle with spatial modes also
    has the states, inputs and outputs of the other plane (its modes, tanks and engines are numbered consecutively), and
    the roll rate of its modes at the gyro; `alone` holds them.

    Raises ValueError where the axial load is not positive and there are pendulums, and where an erratum of the tanks is
    uncorrected and `liquids` is missing.
    """
    load = axial_load_mps2(vehicle, condition)
    _check_load(vehicle, load)
    plane = _with_printed_tanks(vehicle, errata, liquids)
    if vehicle.across is None:
        return Equations(plane, condition, load, errata, wind).state_space()
    # both planes have the spatial modes' softening: it counts once
    softening = vehicle.across.modes.softening_kgpm.copy()
    softening[: vehicle.modes.spatial, : vehicle.modes.spatial] = 0.0
    modes = dataclasses.replace(vehicle.across.modes, softening_kgpm=softening)
    across = _with_printed_tanks(dataclasses.replace(vehicle.across, modes=modes), errata, liquids)
    held = np.zeros(vehicle.modes.spatial)
    if vehicle.modes.along is not None:  # the axial load deflects them, and stations move
        held = Coupled(plane, across, condition, load, errata, held).settled()
    return Coupled(plane, across, condition, load, errata, held, wind).state_space()


def alone(whole: StateSpace, vehicle: PlanarVehicle, wind: bool = False) -> StateSpace:
    """Return one plane of a plant of both, with the body, liquid and gimbal of the other plane held."""
    if vehicle.across is None:
        return whole
    inputs, outputs = inputs_of(vehicle) + (("wind_mps",) if wind else ()), outputs_of(vehicle)
    swinging = sum(len(swings_of(engine)) for engine in vehicle.engines)
    n = len(state_names(len(vehicle.modes.omega_radps), len(vehicle.pendulums.mass_kg), swinging))
    m, rows = len(inputs), len(outputs)
    return StateSpace(
        whole.a[:n, :n], whole.b[:n, :m], whole.c[:rows, :n], whole.d[:rows, :m], whole.states[:n], inputs, outputs
    )


def _check_load(vehicle: PlanarVehicle, load_mps2: Array | float) -> None:
    if len(vehicle.pendulums.mass_kg) and np.min(load_mps2) <= 0.0:
        raise ValueError(f"a pendulum needs a positive axial load, not {np.min(load_mps2):g} m/s2")


def _with_printed_tanks(vehicle: PlanarVehicle, errata: Errata, liquids: Liquids | None) -> PlanarVehicle:
    if (errata.tank_radius and errata.tank_liquid) or not len(vehicle.pendulums.mass_kg):
        return vehicle
    if liquids is None:
        raise ValueError(
            "errata tank_radius and tank_liquid need the tanks' radius_m and liquid_height_m, which this vehicle lacks"
        )
    return with_pendulums(vehicle, as_printed(vehicle.pendulums, liquids, errata.tank_radius, errata.tank_liquid))


def as_printed(pendulums: Pendulums, liquids: Liquids, radius: bool, liquid: bool) -> Pendulums:
    """Return the pendulums of eqs 22, 23 and 25 with their errata uncorrected.

    `radius` False: the diameter instead of the radius. `liquid` False: all propellant instead of that in the tank. Mass
    and place of the liquid follow from the true pendulum. The paper does not give the hinge; the formula above places
    it, with the same radius. The damping ratio is unchanged.
    """
    r = liquids.radius_m
    h = np.maximum(liquids.height_m, _SHALLOWEST * r)
    used = r if radius else 2.0 * r
    in_tank = pendulums.mass_kg / _mass_ratio(r, h)
    counted = in_tank if liquid else np.full_like(in_tank, in_tank.sum())
    centre = pendulums.hinge_station_m + _hinge_above(r, h, pendulums.length_m)
    length = pendulums.length_m if radius else used / (XI * np.tanh(XI * h / used))
    mass = counted * _mass_ratio(used, h)
    there = pendulums.mass_kg > 0.0
    grown = np.divide(mass, pendulums.mass_kg, out=np.ones_like(mass), where=there)
    return dataclasses.replace(
        pendulums,
        mass_kg=mass,
        mass_rate_kgps=pendulums.mass_rate_kgps * grown,
        length_m=length,
        hinge_station_m=centre - _hinge_above(used, h, length),
    )


def _mass_ratio(radius: Array, height: Array) -> Array:
    x = XI * height / radius
    return np.asarray(2.0 * np.tanh(x) / (x * (XI * XI - 1.0)))


def _hinge_above(radius: Array, height: Array, length: Array) -> Array:
    """Return the height of the hinge above the liquid's CG."""
    return np.asarray(0.5 * height - 2.0 * radius / XI * np.tanh(0.5 * XI * height / radius) + length)
