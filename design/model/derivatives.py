"""Stability derivatives as the paper defines them (Lee, Ahn & Roh, eqs 4 to 8): whole mass, liquid frozen."""

from __future__ import annotations

from dataclasses import dataclass

from maxq.design.model.flight_condition import FlightCondition
from maxq.design.model.vehicle_at import VehicleAt


@dataclass(frozen=True)
class StabilityDerivatives:
    """Of alpha' = Z and q' = M; pitch plane. Za and Ma negative: lift and a vehicle that weathercocks."""

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
    thrust = vehicle.engine.thrust_N(condition.pressure_Pa)
    slope = float(a.slope_pr.sum())
    # normal force acts upwards (-z) at its own station; aft of the CG it turns the nose down
    moment_slope_m = slope * cg - float(a.moment_slope_mpr.sum())
    damping = 0.25 * condition.density_kgpm3 * speed * a.area_m2 * a.chord_m**2 * a.rate_damping
    return StabilityDerivatives(
        z_alpha_1ps=-force_area * slope / (mass * speed),
        m_alpha_1ps2=force_area * moment_slope_m / inertia,
        z_delta_1ps=thrust / (mass * speed),
        m_delta_1ps2=thrust * (vehicle.engine.gimbal_station_m - cg) / inertia,
        m_q_1ps=damping / inertia,
    )
