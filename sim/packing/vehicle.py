"""A stage of the vehicle file as the record that the derivative reads."""

from __future__ import annotations

import math

import numpy as np

from maxq.control.kernel.tables import NO_TABLE, Cubics, Method, Pool, fit, merge
from maxq.sim.packing.remembered import cached_by_identity
from maxq.sim.packing.schedule import has_remainder
from maxq.sim.scenario import schema_stage as schema
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Reference, Stage
from maxq.sim.scenario.tables_csv import CsvTable
from maxq.sim.vehicle.actuator import pack_actuators
from maxq.sim.vehicle.aero import FIRST_SURFACE, Aero
from maxq.sim.vehicle.bending import pack_bending
from maxq.sim.vehicle.derivative import Vehicle
from maxq.sim.vehicle.engine import Engine
from maxq.sim.vehicle.gyro import pack_gyro
from maxq.sim.vehicle.slosh import pack_slosh
from maxq.sim.vehicle.state import Sizes


def pack_vehicle(scenario: Scenario, stage: Stage, sizes: Sizes, schedule: Cubics, pool: Pool) -> Vehicle:
    """Parameters of one stage under the scenario's switches; its tables go into `pool`."""
    switches = scenario.switches
    pitch, yaw = pack_actuators(stage.actuator, switches.actuator)
    return Vehicle(
        sizes=sizes,
        schedule=pool.add(schedule),
        engine=_engine(scenario, stage),
        actuator_pitch=pitch,
        actuator_yaw=yaw,
        gyro=pack_gyro(stage.gyro, switches.gyro == "ideal"),
        aero=_aero(scenario, stage, pool),
        bending=pack_bending(stage.bending, switches.bending_softening),
        slosh=pack_slosh(stage.tank[: sizes.tanks], stage.bending, switches.slosh_exchange),
        roll_torque_Nm=stage.roll_thrusters.torque_Nm if stage.roll_thrusters else 0.0,
        jet_damping=int(switches.jet_damping),
        follower_thrust=int(switches.follower_thrust),
        gravity_gradient=int(scenario.earth.gravity_gradient),
    )


def _engine(scenario: Scenario, stage: Stage) -> Engine:
    engine = stage.engine
    if engine is None:
        return Engine(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    moves = scenario.switches.engine_inertia
    mass, arm = engine.gimballed_mass_kg, engine.cg_from_gimbal_m
    on = 1.0 if scenario.switches.thrust else 0.0
    return Engine(
        exit_area_m2=engine.exit_area_m2,
        thrust_factor=on * engine.thrust_factor * engine.mass_flow_factor,
        gimbal_station_m=engine.gimbal_station_m,
        exit_station_m=engine.exit_station_m,
        gimbal_offset_y_m=engine.offset_m[0],
        gimbal_offset_z_m=engine.offset_m[1],
        misalignment_pitch_rad=math.radians(engine.misalignment_deg[0]),
        misalignment_yaw_rad=math.radians(engine.misalignment_deg[1]),
        gimballed_mass_kg=mass if moves else 0.0,
        cg_from_gimbal_m=arm,
        inertia_kgm2=engine.inertia_about_gimbal_kgm2 - mass * arm * arm if moves else 0.0,
    )


def _aero(scenario: Scenario, stage: Stage, pool: Pool) -> Aero:
    reference: Reference = scenario.vehicle.reference
    aero = stage.aero or schema.Aero.model_construct()  # its defaults, without a table
    on = stage.aero is not None and scenario.switches.aerodynamics
    table = NO_TABLE
    if on:
        shape = aero.table, aero.surface, aero.interpolation, aero.moment_reference_m
        table = pool.add(_mach_table(*shape, reference.chord_m))
    station = aero.crossflow_station_m
    return Aero(
        on=int(on),
        table=table,
        area_m2=reference.area_m2,
        chord_m=reference.chord_m,
        yaw_chord_m=reference.yaw_chord_m,
        span_m=reference.span_m,
        crossflow_station_m=0.5 * reference.length_m if station is None else station,
        earth_rates=int(aero.rate_reference == "earth"),
        local_incidence=int(scenario.switches.local_incidence),
        force_factor=aero.force_factor,
        axial_factor=aero.axial_factor,
        damping_factor=aero.damping_factor,
        centre_shift_m=aero.centre_shift_m,
    )


@cached_by_identity
def _mach_table(
    table: CsvTable, surfaces: tuple[schema.AeroSurface, ...], method: Method, reference_m: float, chord_m: float
) -> Cubics:
    """Columns of dynamics/aero.py over Mach number.

    Normal force enters as slope and slope times station, so that a moment about a fixed reference is carried over
    exactly to a CG that moves, even where the slope is zero.
    """
    coast = table["CA_coast"] if "CA_coast" in table else table.get("CA")
    columns = [table.get("CA"), coast, table.get("CD"), table.get("Cmq")]
    columns += [table["Cnr"] if "Cnr" in table else table.get("Cmq"), table.get("Clp")]
    columns += [table.get("C_crossflow"), table.get("Cm0")]
    assert len(columns) == FIRST_SURFACE
    parts = [fit(table["mach"], np.stack(columns, axis=1), method)]
    for surface in surfaces:
        slope, place = surface.table["CN_alpha_pr"], surface.table["station_m"]
        parts.append(fit(surface.table["mach"], np.stack([slope, slope * place], axis=1), method))
    if has_remainder(table):
        parts.append(_remainder(table, parts[1:], method, reference_m, chord_m))
    return merge(parts)


def _remainder(table: CsvTable, surfaces: list[Cubics], method: Method, reference_m: float, chord_m: float) -> Cubics:
    """Normal force that the table of coefficients has beyond the surfaces' sum."""
    slope = table.get("CN_alpha_pr")
    if "x_cp_m" in table:
        moment = slope * table["x_cp_m"]
    else:
        moment = slope * reference_m - chord_m * table.get("Cm_alpha_pr")
    total = fit(table["mach"], np.stack([slope, moment], axis=1), method)
    if not surfaces:
        return total
    together = merge([total, *surfaces])
    c = together.coefficients
    for k in range(1, len(surfaces) + 1):
        c[:, :, :2] -= c[:, :, 2 * k : 2 * k + 2]
    return Cubics(together.breaks, c[:, :, :2].copy())
