"""The record of a stage that the derivative reads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from maxq.control.kernel.limits import MAX_ENGINES
from maxq.control.kernel.tables import NO_TABLE, Cubics, Pool, TableRef, fit
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.actuator.kernel import pack_actuators
from maxq.sim.vehicle.air.packing import pack_aero
from maxq.sim.vehicle.buffet.packing import pack_buffet
from maxq.sim.vehicle.derivative import StageRecord
from maxq.sim.vehicle.engine.burn import Burn
from maxq.sim.vehicle.engine.packing import on_clock, pack_engines
from maxq.sim.vehicle.feed.packing import pack_feed_lines
from maxq.sim.vehicle.modes.planar import pack_bending, pack_spatial_modes
from maxq.sim.vehicle.sensor.further import pack_sensors
from maxq.sim.vehicle.sensor.gyro import pack_gyro
from maxq.sim.vehicle.slosh.kernel import pack_slosh
from maxq.sim.vehicle.slosh.packing import pendulums
from maxq.sim.vehicle.state import Sizes
from maxq.sim.vehicle.tvc_load.packing import _tvc_loads


def pack_vehicle(
    scenario: Scenario, stage: Stage, burn: Burn, sizes: Sizes, schedule: Sequence[Cubics], pool: Pool
) -> StageRecord:
    """Return the parameters of a stage under the scenario's switches, and add its tables to `pool`."""
    switches = scenario.switches
    given = stage.actuators or (None,) * len(stage.engine_groups)
    actuators = [axis for each in given for axis in pack_actuators(each, switches.actuator)]
    engine = pack_engines(stage, burn, switches)
    load = _tvc_loads(stage, engine, sizes, actuators)
    for group, name in enumerate(stage.engine_groups):
        if sizes.tvc_loads > 0 and name in stage.tvc_loads:  # the stop belongs to the engines, not to the actuators
            for k in (2 * group, 2 * group + 1):
                actuators[k] = replace(actuators[k], stop_rad=math.inf, backlash_rad=0.0)
    pitch, yaw, *further = actuators
    return StageRecord(
        sizes=sizes,
        schedule=pool.add(*schedule),
        engine=engine,
        actuator_pitch=pitch,
        actuator_yaw=yaw,
        further_actuators=(*further, *[pitch] * (2 * MAX_ENGINES - 2 - len(further))),
        tvc_load=load,
        gyro=pack_gyro(stage.gyro, switches.gyro == "ideal"),
        sensors=pack_sensors(stage, switches.gyro == "ideal"),
        aero=pack_aero(scenario, stage, burn, pool),
        bending=pack_bending(stage.bending, switches.bending_softening),
        spatial_modes=pack_spatial_modes(stage.spatial_modes),
        slosh=pack_slosh(pendulums(stage)[: sizes.pendulums], stage.bending, switches.slosh_exchange),
        buffet=pack_buffet(stage, scenario.run.seed, pool),
        feed_lines=pack_feed_lines(stage, burn, engine, pool),
        rate_damping=_rate_damping(stage, burn, pool),
        roll_torque_Nm=stage.roll_thrusters.torque_Nm if stage.roll_thrusters else 0.0,
        turn_torque_Nm=(stage.roll_thrusters.pitch_yaw_torque_Nm or 0.0) if stage.roll_thrusters else 0.0,
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
