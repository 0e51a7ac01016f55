"""A stage of the vehicle file as the record that the derivative reads."""

from __future__ import annotations

import math

import numpy as np

from maxq.control.kernel.tables import NO_TABLE, Cubics, Pool, TableRef, fit
from maxq.sim.packing.aero import pack_aero
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.actuator import pack_actuators
from maxq.sim.vehicle.bending import pack_bending, pack_spatial_modes
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
        aero=pack_aero(scenario, stage, pool),
        bending=pack_bending(stage.bending, switches.bending_softening),
        spatial_modes=pack_spatial_modes(stage.spatial_modes),
        slosh=pack_slosh(stage.tank[: sizes.tanks], stage.bending, switches.slosh_exchange),
        rate_damping=_rate_damping(stage, pool),
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


def _rate_damping(stage: Stage, pool: Pool) -> TableRef:
    table = stage.mass.rate_damping
    if table is None:
        return NO_TABLE
    columns = np.stack([table[f"{axis}_Nms"] for axis in "xyz"], axis=1)
    return pool.add(fit(table["time_s"], columns, stage.interpolation))
