"""The parameter record of the engines with a compliant mount."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from maxq.control.kernel.limits import MAX_TVC_LOADS
from maxq.sim.vehicle.actuator.kernel import Actuator
from maxq.sim.vehicle.engine.kernel import Engine
from maxq.sim.vehicle.state import Sizes
from maxq.sim.vehicle.tvc_load.kernel import STOP_FACTOR, TvcLoad

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_vehicle import Stage


def _tvc_loads(stage: Stage, e: Engine, sizes: Sizes, actuators: Sequence[Actuator]) -> TvcLoad:
    """Return the record of the stage's section `tvc_load`.

    Stops, play and stall torques are those of the actuators, pitch and yaw of each group.
    """
    out: dict[str, Any] = {f.name: np.zeros(MAX_TVC_LOADS) for f in fields(TvcLoad) if f.name != "stalls"}
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
            "bearing_Nmprad": count * given.bearing_stiffness_Nmprad,
            "damping_Nmsprad": 2.0 * given.damping_ratio * math.sqrt(stiffness * inertia),
            "friction_Nm": count * given.friction_Nm,
            "friction_angle_rad": math.radians(given.friction_angle_deg),
            "stop_stiffness_Nmprad": count * (given.stop_stiffness_Nmprad or STOP_FACTOR * stiffness / count),
            "stop_pitch_rad": actuators[2 * group].stop_rad,
            "stop_yaw_rad": actuators[2 * group + 1].stop_rad,
            "play_pitch_rad": actuators[2 * group].backlash_rad,
            "play_yaw_rad": actuators[2 * group + 1].backlash_rad,
            "stall_pitch_Nm": count * actuators[2 * group].stall_torque_Nm,
            "stall_yaw_Nm": count * actuators[2 * group + 1].stall_torque_Nm,
        }
        for name, value in values.items():
            out[name][n] = value
    out["stalls"] = int(any(math.isfinite(a.stall_torque_Nm) for a in actuators))
    return TvcLoad(**out)
