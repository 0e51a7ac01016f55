"""The campaign that simvehicle writes for a layout: the deviations of every stage, of the wind and of the computer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from maxq.design.model.spread import Spread
from maxq.tools.vehicle.build import Built
from maxq.tools.vehicle.layout import LayoutStage, steered_boosters

ISP, MISALIGNMENT_DEG, TEMPERATURE_K = 0.01, 0.15, 15.0  # three-sigma deviations of a solid motor
LIMIT_WIND = "vehicle/limit_wind.csv"
SPREAD = Spread()  # the deviations of a suite without a campaign; this module adds others
AXIAL, DAMPING = 0.1, {"distribution": "log-normal", "three_sigma": 0.6931}  # half or double at three sigma


def campaign_of(built: Built) -> dict[str, Any]:
    """Return the campaign of the whole ascent in winds up to the limit wind, with deviations of each stage."""
    spread = [
        {
            "name": "share of the limit wind",
            "key": "wind.profile.speed_mps",
            "apply": "scale",
            "distribution": "uniform",
            "low": 0.0,
            "high": 1.0,
            "source": "assumed, to begin with",
        },
        {
            "name": "direction of the wind",
            "key": "wind.turn_deg",
            "distribution": "uniform",
            "low": 0.0,
            "high": 360.0,
            "source": "assumed, to begin with",
        },
    ]
    for of_layout, stage in enumerate(built.layout.stage):
        parts = [n for n, stack in enumerate(built.stacks) if stack.number == of_layout]  # two if it drops the fairing
        of = f", {stage.name}" if len(built.layout.stage) > 1 else ""
        for name, keys, given in _deviations(built, stage, parts):
            spread.append(
                {
                    "name": f"{name}{of}",
                    "keys": [f"vehicle.stage.{n}.{key}" for n in parts for key in keys],
                    "apply": "scale",
                    "distribution": "normal",
                    **given,
                    "source": "assumed, to begin with",
                }
            )
    spread += [*_boosters(built), *_booster_actuators(built)]
    control = built.layout.control
    either_way_s = min(SPREAD.delay_s, control.delay_s, control.sample_s - control.delay_s)
    spread.append(
        {
            "name": "compute delay",
            "key": "vehicle.computer.delay_s",
            "apply": "add",
            "distribution": "uniform",
            "low": -either_way_s,
            "high": either_way_s,
            "source": "assumed, to begin with",
        }
    )
    return {
        "schema": 1,
        "extends": "scenario.toml",
        "description": f"{built.layout.name}, dispersed, in wind",
        "campaign": {"runs": 100, "seed": 1},
        "wind": {"profile": LIMIT_WIND, "turbulence": {"model": "dryden", "exceedance": "light"}},
        "disperse": spread,
    }


def _boosters(built: Built) -> Iterator[dict[str, Any]]:
    """Yield a deviation of thrust at equal impulse for each booster, with its keys in all parts of the burn that have
    it.
    """
    names = {name: None for stack in built.stacks for s in stack.boosters for name in s.booster.names}
    for name in names:
        keys = []
        for n, stack in enumerate(built.stacks):
            attached = [(other, s) for s in stack.boosters for other in s.booster.names]
            for k, (other, s) in enumerate(attached):
                if other == name:
                    engines = _each(len(s.booster.engine.positions_m))
                    keys += [f"vehicle.stage.{n}.booster.{k}.engine{one}.mass_flow_factor" for _, one in engines]
        yield {
            "name": f"thrust at equal impulse, {name}",
            "keys": keys,
            "apply": "scale",
            "distribution": "normal",
            "three_sigma": SPREAD.thrust,
            "source": "assumed, to begin with",
        }


def _booster_actuators(built: Built) -> Iterator[dict[str, Any]]:
    """Yield the poles of the actuators of each gimballed booster, which follow those of the core."""
    for name in {name: None for stack in built.stacks for name in stack.moving_boosters}:
        parts = [(n, stack) for n, stack in enumerate(built.stacks) if name in stack.moving_boosters]
        first = len(set(parts[0][1].stage.engine.groups))
        own = next(s.booster.engine for s in parts[0][1].boosters if name in s.booster.names)
        for p in range(len(own.servo_hz)):
            places = [f"vehicle.stage.{n}.actuator.{first + stack.moving_boosters.index(name)}" for n, stack in parts]
            yield {
                "name": f"actuator poles {p + 1}, {name}",
                "keys": [f"{place}.omega_hz.{p}" for place in places],
                "apply": "scale",
                "distribution": "normal",
                "three_sigma": SPREAD.actuator_frequency,
                "source": "assumed, to begin with",
            }


def _deviations(
    built: Built, stage: LayoutStage, parts: Sequence[int]
) -> Iterator[tuple[str, list[str], dict[str, Any]]]:
    """Yield the name, keys and distribution of each deviation of a stage of the layout.

    The keys cover all `parts` of the stage (indices of stacks), which deviate alike. The sizes are those of a suite
    without a campaign.
    """
    e, poles = stage.engine, range(len(stage.engine.servo_hz))

    def sized(shares: Any, k: int = 0, times: float = 1.0) -> dict[str, Any]:
        each = shares if isinstance(shares, tuple) else (shares,)
        return {"three_sigma": round(times * each[min(k, len(each) - 1)], 6)}

    for n, one in _each(len(e.positions_m)):
        yield f"thrust at equal impulse{n}", [f"engine{one}.mass_flow_factor"], sized(SPREAD.thrust)
        if stage.grain:
            yield f"specific impulse{n}", [f"engine{one}.thrust_factor"], sized(ISP)
            for k, axis in enumerate(("pitch", "yaw")):
                given = {"apply": "add", "three_sigma": MISALIGNMENT_DEG}
                yield f"thrust misalignment{n}, {axis}", [f"engine{one}.misalignment_deg.{k}"], given
    if e.temperature_sensitivity_1pK > 0.0:
        keys = [f"engine{one}.propellant_temperature_K" for _, one in _each(len(e.positions_m))]
        yield "propellant temperature", keys, {"apply": "add", "three_sigma": TEMPERATURE_K}
    groups = len(set(e.groups))
    for n, one in [("", ".0")] if groups == 1 and steered_boosters(stage) else _each(groups):
        for p in poles:
            yield f"actuator poles{n} {p + 1}", [f"actuator{one}.omega_hz.{p}"], sized(SPREAD.actuator_frequency)
    yield "normal force", ["aero.force_factor"], sized(SPREAD.normal_force)
    yield "centre of pressure", ["aero.centre_shift_m"], {"apply": "add", **sized(SPREAD.centre_of_pressure_m)}
    yield "axial force", ["aero.axial_factor"], sized(AXIAL)
    yield "lateral inertia", ["mass.table.Iyy_kgm2", "mass.table.Izz_kgm2"], sized(SPREAD.inertia)
    section = "bending" if stage.spatial_modes is None else "spatial_modes"
    for k in range(min(_modes_flown(built, n) for n in parts)):
        yield f"frequency of mode {k + 1}", [f"{section}.frequency_factor.{k}"], sized(SPREAD.bending_frequency, k)
        yield f"slope of mode {k + 1}, gyro", [f"{section}.gyro_slope_factor.{k}"], sized(SPREAD.bending_slope, k)
        yield f"shape of mode {k + 1}, gimbal", [f"{section}.gimbal_shape_factor.{k}"], sized(SPREAD.bending_slope, k)
        yield f"damping of mode {k + 1}", [f"{section}.damping_ratio.{k}"], DAMPING
    for k, tank in enumerate(stage.tank):
        yield f"slosh pendulum length, {tank.name}", [f"tank.{k}.length_factor"], sized(SPREAD.slosh_frequency, k, 2.0)
        yield f"slosh mass, {tank.name}", [f"tank.{k}.mass_factor"], sized(SPREAD.slosh_mass, k)
        yield f"slosh damping, {tank.name}", [f"tank.{k}.damping_ratio"], DAMPING


def _modes_flown(built: Built, n: int) -> int:
    """Return the number of modes in the vehicle file for stack `n`."""
    stage = built.stacks[n].stage
    if stage.spatial_modes is not None:
        return stage.spatial_modes.modes.modes
    if stage.bending is not None:
        tables = (stage.bending.pitch_modes, stage.bending.yaw_modes)
        return min((table.modes for table in tables if table is not None), default=0)
    return len(built.modes[n][1][0]) if built.modes[n][1] else 0


def _each(count: int) -> list[tuple[str, str]]:
    """Return the suffixes of the elements of a list in names and in key paths. For a single element, both are empty."""
    return [(f" {k + 1}", f".{k}") for k in range(count)] if count > 1 else [("", "")]
