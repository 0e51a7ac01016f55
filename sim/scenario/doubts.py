"""What a scenario may hold and is hardly meant: said as warnings, and flown as it is.

The bounds are those of launch vehicles that exist, with room. What no vehicle can have is refused (`ranges.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from maxq.sim.scenario import mode_checks
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Reference, Stage

Doubt = tuple[str, float, str]
"""Key, value, and what it should be like."""

_LONG_RUN = 1e9  # steps or log rows: hours, and hundreds of gigabytes
_WEATHER_M, _WEATHER_MPS = 30e3, 150.0  # the strongest jet streams have 110 m/s
_G = 9.8


def doubts(scenario: Scenario) -> tuple[str, ...]:
    """A line for each: key, value and what is usual, or what is odd about a mode table."""
    found: list[Doubt] = [*_run(scenario), *_surroundings(scenario)]
    reference = scenario.vehicle.reference
    for n, stage in enumerate(scenario.vehicle.stage):
        found += [(f"vehicle.stage.{n}.{key}", value, usual) for key, value, usual in _stage(stage, reference)]
    if any(stage.aero is not None for stage in scenario.vehicle.stage):
        tails = [tail for stage in scenario.vehicle.stage for tail in _tails(stage)]
        doubted = _reference(reference, max(tails, default=0.0))
        found += [(f"vehicle.reference.{key}", value, usual) for key, value, usual in doubted]
    if scenario.held and scenario.holddown.release == "thrust":
        found += _lift_off(scenario.vehicle.stage[0])
    said = [f"{key} = {value:.6g} is hardly meant; usual: {usual}" for key, value, usual in found]
    for n, stage in enumerate(scenario.vehicle.stage):
        for key, table in stage.mode_tables():
            said += [f"vehicle.stage.{n}.{key}: {doubt}" for doubt in mode_checks.doubts(table)]
    return tuple(said)


def _reference(reference: Reference, tail_m: float) -> Iterator[Doubt]:
    """Lengths against each other; `tail_m`: the hindmost station that the files name, 0 where there is none."""
    length, diameter, area = reference.length_m, reference.diameter_m, reference.area_m2
    if tail_m > 0.0 and not 0.9 * tail_m <= length <= 2.0 * tail_m:
        yield "length_m", length, f"the hindmost station, {tail_m:g} m, or a little more"
    if diameter > 1.5 * length:
        yield "diameter_m", diameter, f"less than the length of {length:g} m"
    across = 0.25 * math.pi * diameter**2
    if not across / 5.0 <= area <= 5.0 * across:
        yield "area_m2", area, f"about that of the diameter, {across:.3g} m2"
    for key in ("chord_m", "span_m", "yaw_chord_m"):
        value = getattr(reference, key)
        if not 0.1 * min(length, diameter) <= value <= 2.0 * max(length, diameter):
            yield key, value, f"between the diameter of {diameter:g} m and the length of {length:g} m"


def _tails(stage: Stage) -> Iterator[float]:
    """Stations of what sits at the tail."""
    for engine in stage.engines:
        yield max(engine.exit_station_m, engine.gimbal_station_m)
    if stage.bending is not None:
        for table in (stage.bending.pitch, stage.bending.yaw):
            if table is not None:
                yield float(table["station_m"].max())


def _stage(stage: Stage, reference: Reference) -> Iterator[Doubt]:
    mass, table, length = stage.mass, stage.mass.table, reference.length_m
    if table is not None:
        kg, cg_m, lateral = table["mass_kg"], table["x_cg_m"], np.maximum(table["Iyy_kgm2"], table["Izz_kgm2"])
        where = "mass.table."
    else:
        tensor = np.array(mass.inertia_kgm2)
        kg, cg_m, lateral = (np.array([x]) for x in (mass.mass_kg, mass.x_cg_m, max(tensor[1, 1], tensor[2, 2])))
        where = "mass."
    for n, engine in enumerate(stage.engines):
        thrust = engine.thrust_factor * float(engine.table["thrust_vacuum_N"].max())
        if thrust > 1000.0 * float(kg.min()):
            key = ".".join(map(str, (*stage.engine_key(n), "table.thrust_vacuum_N")))
            yield key, thrust, f"less than 100 g on {float(kg.min()):g} kg"
    if stage.aero is None:
        return  # nobody needs the reference lengths: they may be anything
    volume = 0.25 * math.pi * reference.diameter_m**2 * length
    heaviest = float(kg.max())
    if not 1.0 <= heaviest / volume <= 2e4:
        yield f"{where}mass_kg", heaviest, f"1 to 20,000 kg/m3 of a body of {reference.diameter_m:g} m by {length:g} m"
    outside = (cg_m < 0.0) | (cg_m > length)
    if outside.any():
        yield f"{where}x_cg_m", float(cg_m[np.argmax(outside)]), f"inside the vehicle, 0 .. {length:g} m"
    most = kg * (0.25 * length**2 + 0.25 * reference.diameter_m**2)
    too_much = lateral > 1.5 * most
    if too_much.any():
        at = int(np.argmax(too_much))
        key = f"{where}Iyy_kgm2" if table is not None else f"{where}inertia_kgm2"
        yield key, float(lateral[at]), f"at most {most[at]:.3g} kg m2, all of the mass at the ends of {length:g} m"


def _lift_off(stage: Stage) -> Iterator[Doubt]:
    """A vehicle that is held down until thrust exceeds weight, and never is let go."""
    thrust = sum(engine.thrust_factor * float(engine.table["thrust_vacuum_N"].max()) for engine in stage.engines)
    kg = stage.mass.mass_kg if stage.mass.table is None else float(stage.mass.table["mass_kg"].min())
    if stage.engines and thrust < _G * (kg or 0.0):
        usual = f"more than the weight of {_G * (kg or 0.0):.4g} N, or it is never let go"
        yield "vehicle.stage.0.engine", thrust, usual


def _run(scenario: Scenario) -> Iterator[Doubt]:
    run, fastest = scenario.run, scenario.log.fast_hz
    if run.duration_s / run.step_s > _LONG_RUN:
        yield "run.step_s", run.step_s, f"fewer than {_LONG_RUN:g} steps in duration_s = {run.duration_s:g} s"
    if run.duration_s * fastest > _LONG_RUN:
        yield "log.fast_hz", fastest, f"fewer than {_LONG_RUN:g} rows in duration_s = {run.duration_s:g} s"


def _surroundings(scenario: Scenario) -> Iterator[Doubt]:
    site, wind = scenario.site, scenario.wind
    if scenario.initial is None and not -500.0 <= site.altitude_m <= 9000.0:
        yield "site.altitude_m", site.altitude_m, "a place on the ground, -500 .. 9000 m"
    speeds = np.array([wind.speed_mps or 0.0])
    if wind.profile is not None:
        low = wind.profile["altitude_m"] <= _WEATHER_M
        parts = [wind.profile.get(name)[low] for name in ("speed_mps", "north_mps", "east_mps")]
        speeds = np.concatenate([np.hypot(np.abs(parts[0]), np.hypot(parts[1], parts[2])), [0.0]])
    fastest = abs(wind.factor) * float(speeds.max())
    if fastest > _WEATHER_MPS:
        key = "wind.profile" if wind.profile is not None else "wind.speed_mps"
        yield key, fastest, f"less than {_WEATHER_MPS:g} m/s below {_WEATHER_M:g} m"
