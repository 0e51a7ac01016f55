"""A stage of the vehicle file as the record that the derivative reads."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from maxq.control.kernel.tables import NO_TABLE, Cubics, Pool, TableRef, fit
from maxq.sim.packing.aero import pack_aero
from maxq.sim.packing.engines import on_clock, pack_engines
from maxq.sim.packing.pendulums import pendulums
from maxq.sim.scenario.burn import Burn
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.actuator import pack_actuators
from maxq.sim.vehicle.bending import pack_bending, pack_spatial_modes
from maxq.sim.vehicle.derivative import Vehicle
from maxq.sim.vehicle.gyro import pack_gyro
from maxq.sim.vehicle.slosh import pack_slosh
from maxq.sim.vehicle.state import Sizes
from maxq.sim.vehicle.tvc_load import pack_tvc_load


def pack_vehicle(scenario: Scenario, stage: Stage, burn: Burn, sizes: Sizes, schedule: Cubics, pool: Pool) -> Vehicle:
    """Parameters of one stage under the scenario's switches; its tables go into `pool`."""
    switches = scenario.switches
    pitch, yaw = pack_actuators(stage.actuator, switches.actuator)
    engine = pack_engines(stage, burn, switches)
    load = pack_tvc_load(stage.tvc_load, engine, pitch.stop_rad, yaw.stop_rad)
    if sizes.tvc_loads > 0:  # the stop is the engine's, not the actuator's
        pitch, yaw = replace(pitch, stop_rad=math.inf), replace(yaw, stop_rad=math.inf)
    return Vehicle(
        sizes=sizes,
        schedule=pool.add(schedule),
        engine=engine,
        actuator_pitch=pitch,
        actuator_yaw=yaw,
        tvc_load=load,
        gyro=pack_gyro(stage.gyro, switches.gyro == "ideal"),
        aero=pack_aero(scenario, stage, burn, pool),
        bending=pack_bending(stage.bending, switches.bending_softening),
        spatial_modes=pack_spatial_modes(stage.spatial_modes),
        slosh=pack_slosh(pendulums(stage)[: sizes.pendulums], stage.bending, switches.slosh_exchange),
        rate_damping=_rate_damping(stage, burn, pool),
        roll_torque_Nm=stage.roll_thrusters.torque_Nm if stage.roll_thrusters else 0.0,
        jet_damping=int(switches.jet_damping),
        follower_thrust=int(switches.follower_thrust),
        gravity_gradient=int(scenario.earth.gravity_gradient),
    )


def _rate_damping(stage: Stage, burn: Burn, pool: Pool) -> TableRef:
    table = stage.mass.rate_damping
    if table is None:
        return NO_TABLE
    columns = np.stack([table[f"{axis}_Nms"] for axis in "xyz"], axis=1)
    return pool.add(on_clock(fit(table["time_s"], columns, stage.interpolation), burn))
