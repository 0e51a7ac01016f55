"""Nodes that are not quite what they should be: one set of deviations, applied to any node."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.node import Instruments, Node
from maxq.design.model.shift import with_pendulums
from maxq.design.model.vehicle_at import VehicleAt

Factors = float | Sequence[float]
"""One for all modes or tanks, or one each; what lies beyond the last is 1."""


@dataclass(frozen=True)
class Dispersion:
    """Factors unless a unit is named; the default deviates nowhere.

    `slosh_*` leave the vehicle with its liquid frozen as it is: what the bobs take on, the core gives; a hinge stays
    where it is. `actuator_frequency` multiplies the poles of (28), not the zero. `inertia` is that of the core.
    """

    bending_frequency: Factors = 1.0  # per mode
    bending_damping: Factors = 1.0
    bending_slope: Factors = 1.0  # at the gyro
    bending_shape: Factors = 1.0  # displacement and slope at the gimbal: what excites the mode
    slosh_frequency: Factors = 1.0  # per tank
    slosh_mass: Factors = 1.0
    slosh_damping: Factors = 1.0
    actuator_frequency: float = 1.0
    actuator_damping: float = 1.0
    gyro_frequency: float = 1.0
    delay_s: float = 0.0  # on top of the computer's
    thrust: float = 1.0  # the engine's lateral authority; the axial load stays
    normal_force: float = 1.0
    centre_of_pressure_m: float = 0.0  # moved aft
    inertia: float = 1.0
    label: str = ""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            if f.name == "label":
                continue
            value = np.atleast_1d(np.asarray(getattr(self, f.name), float))
            signed = f.name in ("bending_slope", "bending_shape", "centre_of_pressure_m", "normal_force")
            floor = -np.inf if signed else 0.0
            positive = f.name.endswith(("frequency", "inertia", "thrust"))
            if not np.isfinite(value).all() or (value < floor).any() or (positive and (value <= 0.0).any()):
                allowed = (
                    "finite numbers" if signed else "finite numbers above 0" if positive else "finite numbers from 0"
                )
                raise ValueError(f"{f.name} = {getattr(self, f.name)}: allowed are {allowed}")


NOMINAL = Dispersion()


def disperse(node: Node, by: Dispersion) -> Node:
    """The node with its deviations; `Node.with_` does the same by keywords. Raises ValueError for too many factors."""
    if by == NOMINAL:
        return node
    label = f"{node.label} {by.label}".strip() if by.label else node.label
    return dataclasses.replace(
        node, vehicle=_vehicle(node, by), instruments=_instruments(node.instruments, by), label=label
    )


def _vehicle(node: Node, by: Dispersion) -> VehicleAt:
    vehicle = node.vehicle
    modes, bobs, air = vehicle.modes, vehicle.pendulums, vehicle.aerodynamics
    n, m = len(modes.omega_radps), len(bobs.mass_kg)
    shape = _each(by.bending_shape, n, "bending_shape")
    modes = dataclasses.replace(
        modes,
        omega_radps=modes.omega_radps * _each(by.bending_frequency, n, "bending_frequency"),
        damping_ratio=modes.damping_ratio * _each(by.bending_damping, n, "bending_damping"),
        slope_gyro_pm=modes.slope_gyro_pm * _each(by.bending_slope, n, "bending_slope"),
        phi_gimbal=modes.phi_gimbal * shape,
        slope_gimbal_pm=modes.slope_gimbal_pm * shape,
    )
    mass = _each(by.slosh_mass, m, "slosh_mass")
    changed = dataclasses.replace(
        bobs,
        mass_kg=bobs.mass_kg * mass,
        mass_rate_kgps=bobs.mass_rate_kgps * mass,
        length_m=bobs.length_m / _each(by.slosh_frequency, m, "slosh_frequency") ** 2,
        damping_ratio=bobs.damping_ratio * _each(by.slosh_damping, m, "slosh_damping"),
    )
    if by.slosh_mass != 1.0 or by.slosh_frequency != 1.0:
        vehicle = with_pendulums(vehicle, changed)
    body = dataclasses.replace(vehicle.body, core_inertia_kgm2=vehicle.body.core_inertia_kgm2 * by.inertia)
    air = dataclasses.replace(
        air,
        slope_pr=air.slope_pr * by.normal_force,
        moment_slope_mpr=by.normal_force * (air.moment_slope_mpr + air.slope_pr * by.centre_of_pressure_m),
    )
    out = dataclasses.replace(vehicle, body=body, modes=modes, pendulums=changed, aerodynamics=air)
    return with_lateral_thrust(out, node, by.thrust)


def with_lateral_thrust(vehicle: VehicleAt, node: Node, factor: float) -> VehicleAt:
    """The vehicle with `factor` times the thrust; drag makes up for it, so that the axial load stays."""
    if factor == 1.0:
        return vehicle
    engine, air, condition = vehicle.engine, vehicle.aerodynamics, node.condition
    thrust = engine.thrust_N(condition.pressure_Pa)
    more = (factor - 1.0) * thrust
    if condition.dynamic_pressure_Pa * air.area_m2 == 0.0:
        raise ValueError("lateral thrust can be changed on its own only where there is drag to make up for it")
    engine = dataclasses.replace(engine, vacuum_thrust_N=engine.vacuum_thrust_N + more)
    air = dataclasses.replace(air, axial=air.axial + more / (condition.dynamic_pressure_Pa * air.area_m2))
    return dataclasses.replace(vehicle, engine=engine, aerodynamics=air)


def _instruments(instruments: Instruments, by: Dispersion) -> Instruments:
    a, g = instruments.actuator, instruments.gyro
    names = ("1", "2", "3")
    faster = {f"omega_{k}_radps": getattr(a, f"omega_{k}_radps") * by.actuator_frequency for k in names}
    damped = {f"zeta_{k}": getattr(a, f"zeta_{k}") * by.actuator_damping for k in names}
    return dataclasses.replace(
        instruments,
        actuator=dataclasses.replace(a, **faster, **damped),
        gyro=dataclasses.replace(g, omega_radps=g.omega_radps * by.gyro_frequency),
        delay_s=instruments.delay_s + by.delay_s,
    )


def _each(factors: Factors, count: int, name: str) -> Array:
    given = np.asarray(factors, float)
    if given.ndim == 0:
        return np.full(count, float(given))
    if len(given) > count:
        raise ValueError(f"{name} has {len(given)} factors: allowed are {count}, or one number for all")
    return np.concatenate([given, np.ones(count - len(given))])
