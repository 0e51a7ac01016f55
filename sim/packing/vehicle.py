"""A stage of the vehicle file as the record that the derivative reads."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np

from maxq.control.kernel.limits import MAX_ENGINES, MAX_TVC_LOADS
from maxq.control.kernel.tables import NO_TABLE, Cubics, Pool, TableRef, fit
from maxq.sim.packing.aero import pack_aero
from maxq.sim.packing.engines import on_clock, pack_engines
from maxq.sim.packing.pendulums import pendulums
from maxq.sim.scenario.burn import Burn
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.actuator import Actuator, pack_actuators
from maxq.sim.vehicle.bending import pack_bending, pack_spatial_modes
from maxq.sim.vehicle.derivative import Vehicle
from maxq.sim.vehicle.engine import Engine
from maxq.sim.vehicle.gyro import pack_gyro
from maxq.sim.vehicle.sensors import pack_sensors
from maxq.sim.vehicle.slosh import pack_slosh
from maxq.sim.vehicle.state import Sizes
from maxq.sim.vehicle.tvc_load import STOP_FACTOR, TvcLoad


def pack_vehicle(
    scenario: Scenario, stage: Stage, burn: Burn, sizes: Sizes, schedule: Sequence[Cubics], pool: Pool
) -> Vehicle:
    """Parameters of one stage under the scenario's switches; its tables go into `pool`."""
    switches = scenario.switches
    given = stage.actuators or (None,) * len(stage.engine_groups)
    actuators = [axis for each in given for axis in pack_actuators(each, switches.actuator)]
    engine = pack_engines(stage, burn, switches)
    load = _tvc_loads(stage, engine, sizes, actuators)
    for group, name in enumerate(stage.engine_groups):
        if sizes.tvc_loads > 0 and name in stage.tvc_loads:  # the stop is the engines', not the actuators'
            for k in (2 * group, 2 * group + 1):
                actuators[k] = replace(actuators[k], stop_rad=math.inf, backlash_rad=0.0)
    pitch, yaw, *further = actuators
    return Vehicle(
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
        rate_damping=_rate_damping(stage, burn, pool),
        roll_torque_Nm=stage.roll_thrusters.torque_Nm if stage.roll_thrusters else 0.0,
        jet_damping=int(switches.jet_damping),
        follower_thrust=int(switches.follower_thrust),
        gravity_gradient=int(scenario.earth.gravity_gradient),
    )


def _tvc_loads(stage: Stage, e: Engine, sizes: Sizes, actuators: Sequence[Actuator]) -> TvcLoad:
    """From the stage's section `tvc_load`; stops and play are those of the actuators, pitch and yaw of each group."""
    out: dict[str, Any] = {f.name: np.zeros(MAX_TVC_LOADS) for f in fields(TvcLoad)}
    out["engine"] = np.zeros(MAX_TVC_LOADS, np.int64)
    for k in range(sizes.engines):
        n = int(e.swings[k])
        if n < 0:
            continue
        group = int(e.group[k])
        given, count = stage.tvc_loads[stage.engine_groups[group]], float((e.taken_as[: len(stage.engines)] == k).sum())
        inertia = float(e.inertia_kgm2[k] + e.gimballed_mass_kg[k] * e.cg_from_gimbal_m[k] ** 2)
        stiffness = inertia * (2.0 * math.pi * (given.frequency_hz or 0.0)) ** 2
        if given.stiffness_Nmprad is not None:
            stiffness = count * given.stiffness_Nmprad
        values = {
            "engine": k,
            "stiffness_Nmprad": stiffness,
            "damping_Nmsprad": 2.0 * given.damping_ratio * math.sqrt(stiffness * inertia),
            "friction_Nm": count * given.friction_Nm,
            "friction_angle_rad": math.radians(given.friction_angle_deg),
            "stop_stiffness_Nmprad": count * (given.stop_stiffness_Nmprad or STOP_FACTOR * stiffness / count),
            "stop_pitch_rad": actuators[2 * group].stop_rad,
            "stop_yaw_rad": actuators[2 * group + 1].stop_rad,
            "play_pitch_rad": actuators[2 * group].backlash_rad,
            "play_yaw_rad": actuators[2 * group + 1].backlash_rad,
        }
        for name, value in values.items():
            out[name][n] = value
    return TvcLoad(**out)


def _rate_damping(stage: Stage, burn: Burn, pool: Pool) -> TableRef:
    table = stage.mass.rate_damping
    if table is None:
        return NO_TABLE
    columns = np.stack([table[f"{axis}_Nms"] for axis in "xyz"], axis=1)
    return pool.add(on_clock(fit(table["time_s"], columns, stage.interpolation), burn))
