"""The allocation of a stage's commands to its groups of engines, by their positions and thrusts.

The method is that of control/allocation.py.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from maxq.control.allocation import ONE_GROUP, Allocation, pseudo_inverse
from maxq.control.kernel.limits import MAX_ENGINES
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Pool, fit
from maxq.sim.vehicle.engine.burn import Burn, EngineFault
from maxq.sim.vehicle.engine.packing import thrust_slopes

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_scenario import Scenario
    from maxq.sim.scenario.schema_vehicle import Stage


def pack_allocation(scenario: Scenario, stage: Stage, burn: Burn, pool: Pool) -> Allocation:
    """Return the allocation of a stage; a single group receives the law's commands unchanged.

    Moments are those of the largest nominal vacuum thrusts about the CG at half of the burn. The shares of a cluster in
    each axis depend only slightly on the instant. The allocation accounts for a fault `reallocate_after_s` after it
    occurs.
    """
    if len(stage.engine_groups) == 1:
        return ONE_GROUP
    known = [fault for fault in burn.faults if fault.fault.reallocate_after_s is not None]
    begins = [fault.at_s + (fault.fault.reallocate_after_s or 0.0) for fault in known]
    ends = [fault.until_s + (fault.fault.reallocate_after_s or 0.0) for fault in known]
    times = sorted({0.0, *begins, *(end for end in ends if math.isfinite(end))})
    nominal = moments(stage, ())
    authority = np.abs(nominal).sum(axis=1)
    scales = channel_scales_rad(stage)
    rows = []
    for time_s in times:
        lost = tuple(f for f, a, b in zip(known, begins, ends, strict=True) if a <= time_s < b)
        rows.append(pseudo_inverse(moments(stage, lost), scales, authority).ravel())
    after = times[-1] + 1.0  # a step holds up to the next row
    table = fit(np.array([*times, after]) + burn.start_s, np.array([*rows, rows[-1]]), "step")
    gains = scenario.design.roll_gimbal if scenario.design is not None else None
    bounds = np.full(2 * MAX_ENGINES, np.inf)
    bounds[: len(scales)] = (scenario.switches.actuator == "full" and limits_rad(stage)) or np.inf
    roll = (0.0, 0.0, 0.0) if gains is None else (gains.k_p, gains.k_d_s, math.radians(gains.limit_deg))
    return Allocation(len(stage.engine_groups), pool.add(table), *roll, bounds)


def channel_scales_rad(stage: Stage) -> list[float]:
    """Return the scales of the pitch and yaw channels of each group, rad.

    A scale is the angle limit divided by the square root of the number of gimballed engines, because the allocation
    minimises a sum over engines.
    """
    limits = limits_rad(stage) or [1.0] * (2 * len(stage.engine_groups))
    sizes = [sum(e.group == group and e.gimbal != "fixed" for e in stage.engines) for group in stage.engine_groups]
    return [max(limit, math.radians(1e-6)) / math.sqrt(sizes[k // 2]) for k, limit in enumerate(limits)]


def limits_rad(stage: Stage) -> list[float]:
    """Return the angle limits of each group's actuators in pitch and yaw, rad; an empty list for ideal actuators."""
    return [math.radians(axis.angle_limit_deg) for actuator in stage.actuators for axis in actuator.axes]


def moments(stage: Stage, lost: tuple[EngineFault, ...]) -> Array:
    """Return the moments in pitch, yaw and roll (3, channels) per radian of each channel, N m/rad.

    `lost`: faults of engines to be included.
    """
    groups = stage.engine_groups
    out = np.zeros((3, 2 * len(groups)))
    cg_m, y_m, z_m = cg_at_half_burn(stage)
    for number, engine in enumerate(stage.engines):
        if engine.gimbal == "fixed":
            continue
        # without deviations of the engines, which the computer does not have
        strength = float(engine.table["thrust_vacuum_N"].max())
        for fault in lost:
            if fault.affects(number):
                strength *= 0.0 if fault.fault.loss is None else 1.0 - fault.fault.loss
        x, y, z = cg_m - engine.gimbal_station_m, engine.offset_m[0] - y_m, engine.offset_m[1] - z_m
        for plane, (f_x, f_y, f_z) in zip(("pitch", "yaw"), thrust_slopes(engine), strict=True):
            if engine.gimbal in ("both", plane):
                channel = 2 * groups.index(engine.group) + int(plane == "yaw")
                moment = (z * f_x - x * f_z, x * f_y - y * f_x, y * f_z - z * f_y)
                out[:, channel] += strength * np.array(moment)
    return out


def cg_at_half_burn(stage: Stage) -> tuple[float, float, float]:
    """Return station, y and z of the CG of the whole vehicle when half of its propellant is consumed, m."""
    rows = stage.mass_over_time()[1][::-1]
    half = 0.5 * float(rows[0, 0] + rows[-1, 0])
    x, y, z = (float(np.interp(half, rows[:, 0], rows[:, k])) for k in (1, 2, 3))
    return x, y, z
