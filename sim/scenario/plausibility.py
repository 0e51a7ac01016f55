"""Warnings about values of a scenario that are possible but implausible.

The bounds are those of existing launch vehicles with a margin. Impossible values are rejected (sim/input/ranges.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from maxq.sim.scenario.schema_scenario import USUAL_STEP_S, Scenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.body.section import Reference
from maxq.sim.vehicle.modes.tables import ORTHOGONALITY, SpatialModeTable, mode_warnings
from maxq.sim.vehicle.slosh.section import Tank

Array = NDArray[np.float64]
Implausible = tuple[str, float, str]
"""A key, its value, and a description of the plausible values."""

_LONG_RUN = 1e9  # steps or log rows: hours, and hundreds of gigabytes
_WEATHER_M, _WEATHER_MPS = 30e3, 150.0  # the strongest jet streams reach 110 m/s
_G = 9.8
_LEAST_GYRATION = 0.03  # gyration radius / length; 0.29 for a rod, 0.32 for a sphere
_MOST_MARGIN = 0.6  # static margin / length
_INCIDENCE_deg, _HELD_Pa = 5.0, 8e3  # launchers reach 15 to 80 kPa
_DAMPED = 0.01  # damping ratio of a liquid with baffles
_ROOT = 1.8412  # first zero of J1'


def warnings(scenario: Scenario) -> tuple[str, ...]:
    """Return a line for each implausible value (key, value, usual values) and for each defect of a mode table."""
    said = list[str]()
    for about, check in _checks(scenario):
        try:
            said += check
        except Exception as error:  # a check that only warns must not end a flight
            said.append(f"{about}: not all values could be checked ({type(error).__name__}: {error})")
    return tuple(said)


def _checks(scenario: Scenario) -> Iterator[tuple[str, Iterator[str]]]:
    """Yield each check as the section that it reads, and an iterator that makes the check and yields its warnings."""

    def lines(section: str, found: Iterator[Implausible]) -> tuple[str, Iterator[str]]:
        said = (f"{section}.{key} = {value:.6g} is implausible; usual: {usual}" for key, value, usual in found)
        return section, said

    reference, stages = scenario.vehicle.reference, scenario.vehicle.stage
    yield lines("run", _run(scenario))
    yield lines("log", _log(scenario))
    yield lines("site", _site(scenario))
    yield lines("wind", _wind(scenario))
    for n, stage in enumerate(stages):
        yield lines(f"vehicle.stage.{n}", _stage(stage, reference))
        yield lines(f"vehicle.stage.{n}", _control(stage, reference, first=n == 0))
        yield lines(f"vehicle.stage.{n}", _liquids(stage))
    yield lines("vehicle.computer", _sampling(scenario))
    if any(stage.aero is not None for stage in stages):
        yield lines("vehicle.reference", _reference(reference, stages))
    if scenario.held and scenario.holddown.release == "thrust":
        yield lines("vehicle.stage.0", _lift_off(stages[0]))
    for n, stage in enumerate(stages):
        section = f"vehicle.stage.{n}"
        if scenario.switches.slosh:
            yield section, _unreported_waves(section, stage)
        yield section, _of_modes(section, stage)


def _unreported_waves(section: str, stage: Stage) -> Iterator[str]:
    for k, tank in enumerate(stage.tank):
        if tank.radius_m is None:
            yield f"{section}.tank.{k}.radius_m is not given: breaking waves of this tank are not reported"


def _of_modes(section: str, stage: Stage) -> Iterator[str]:
    from maxq.sim.vehicle.modes.masses import misfit  # noqa: PLC0415  # lazy: it imports the compiler

    for key, table in stage.mode_tables():
        found = mode_warnings(table)
        if isinstance(table, SpatialModeTable) and (
            unlike := misfit(table, stage.engine_masses, (1.0 + ORTHOGONALITY, ORTHOGONALITY))
        ):
            found = [*found, unlike]
        yield from (f"{section}.{key}: {warning}" for warning in found)


def _reference(reference: Reference, stages: Iterable[Stage]) -> Iterator[Implausible]:
    """Yield implausible reference quantities, by comparison with the rearmost station in the files, if there is one."""
    tail_m = max((tail for stage in stages for tail in _tails(stage)), default=0.0)
    length, diameter, area = reference.length_m, reference.diameter_m, reference.area_m2
    if tail_m > 0.0 and not 0.9 * tail_m <= length <= 2.0 * tail_m:
        yield "length_m", length, f"the rearmost station, {tail_m:g} m, or a little more"
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
    """Yield the stations of engines, and the rearmost stations of mode shapes, m."""
    for engine in stage.engines:
        yield max(engine.exit_station_m, engine.gimbal_station_m)
    if stage.bending is not None:
        for table in (stage.bending.pitch, stage.bending.yaw):
            if table is not None:
                yield float(table["station_m"].max())


def _stage(stage: Stage, reference: Reference) -> Iterator[Implausible]:
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
        return  # the reference lengths are not used and may have any value
    across_m2 = 0.25 * math.pi * reference.diameter_m**2
    for n, engine in enumerate(stage.engines):
        if engine.exit_area_m2 > 1.5 * across_m2:
            key = ".".join(map(str, (*stage.engine_key(n), "exit_area_m2")))
            yield key, engine.exit_area_m2, f"at most the cross section of the body, {across_m2:.3g} m2"
    volume = across_m2 * length
    heaviest = float(kg.max())
    if not 1.0 <= heaviest / volume <= 2e4:
        yield f"{where}mass_kg", heaviest, f"1 to 20,000 kg/m3 of a body of {reference.diameter_m:g} m by {length:g} m"
    least = kg * (_LEAST_GYRATION * length) ** 2
    if (lateral < least).any():
        at = int(np.argmax(lateral < least))
        key = f"{where}Iyy_kgm2" if table is not None else f"{where}inertia_kgm2"
        yield (
            key,
            float(lateral[at]),
            f"from {least[at]:.3g} kg m2, {_LEAST_GYRATION:g} of {length:g} m as gyration radius",
        )
    outside = (cg_m < 0.0) | (cg_m > length)
    if outside.any():
        yield f"{where}x_cg_m", float(cg_m[np.argmax(outside)]), f"inside the vehicle, 0 .. {length:g} m"
    most = kg * (0.25 * length**2 + 0.25 * reference.diameter_m**2)
    too_much = lateral > 1.5 * most
    if too_much.any():
        at = int(np.argmax(too_much))
        key = f"{where}Iyy_kgm2" if table is not None else f"{where}inertia_kgm2"
        yield key, float(lateral[at]), f"at most {most[at]:.3g} kg m2, all of the mass at the ends of {length:g} m"


def _control(stage: Stage, reference: Reference, *, first: bool) -> Iterator[Implausible]:
    """Yield a gimbal ahead of the CG, an implausible centre of pressure, and gimbal limits with too little authority.

    The authority is that of the first stage against the aerodynamic moment at an angle of attack of _INCIDENCE_deg.
    """
    mass, engines = stage.mass.table, [e for e in stage.engines if e.gimbal != "fixed"]
    if mass is None or stage.aero is None:
        return
    times, rows = stage.mass_over_time()
    cg_m = rows[:, 1]
    for n, engine in enumerate(stage.engines):
        if engine in engines and engine.gimbal_station_m <= float(cg_m.max()):
            key = ".".join(map(str, (*stage.engine_key(n), "gimbal_station_m")))
            yield (
                key,
                engine.gimbal_station_m,
                f"aft of the CG, {float(cg_m.max()):.4g} m: else the gimbal turns the wrong way",
            )
            return
    lift = _lift(stage)
    if lift is None:
        return
    slope, centre_m = lift
    length, diameter = reference.length_m, reference.diameter_m
    outside = np.abs(centre_m - 0.5 * length) > 0.75 * length  # a wide nose may move it ahead of the body
    if outside.any():
        yield (
            "aero.surface",
            float(centre_m[np.argmax(outside)]),
            f"a centre of pressure near the body, 0 .. {length:g} m",
        )
        return
    margin = (centre_m[None, :] - cg_m[:, None]) / diameter
    largest, most = margin.ravel()[np.argmax(np.abs(margin))], _MOST_MARGIN * length / diameter
    if abs(largest) > most:
        usual = f"a static margin within {most:.3g} diameters; over time and Mach number it is "
        yield "aero.surface", float(largest), f"{usual}{margin.min():.3g} to {margin.max():.3g}"
    if not (first and engines and stage.actuator):
        return
    thrust = sum(e.thrust_factor * np.interp(times, e.table["time_s"], e.table["thrust_vacuum_N"]) for e in engines)
    arm_m, burns = min(e.gimbal_station_m for e in engines) - cg_m, thrust > 0.5 * np.max(thrust)
    limit_deg = min(actuator.angle_limit_deg for actuator in stage.actuators)
    per_pressure = _INCIDENCE_deg * reference.area_m2 * slope[None, :] * np.abs(centre_m[None, :] - cg_m[:, None])
    held_Pa = limit_deg * thrust * arm_m / np.maximum(per_pressure.max(axis=1), 1e-9)
    if np.any(burns) and (lowest := float(held_Pa[burns].min())) < _HELD_Pa:
        usual = f"more: |M_alpha| / M_delta takes all of it at {_INCIDENCE_deg:g} deg angle of attack from "
        yield "actuator.angle_limit_deg", limit_deg, f"{usual}{lowest / 1e3:.3g} kPa on"


def _lift(stage: Stage) -> tuple[Array, Array] | None:
    """Return the slope of the normal force, 1/rad, and its station, m aft of the nose, both over Mach number.

    Mach numbers without a positive slope are omitted. The result is None if the stage has coefficient tables or no
    such data.
    """
    aero = stage.aero
    if aero is None or aero.coefficients:
        return None
    if aero.surface:
        mach = np.unique(np.concatenate([part.table["mach"] for part in aero.surface]))
        parts = [
            [np.interp(mach, part.table["mach"], part.table[name]) for name in ("CN_alpha_pr", "station_m")]
            for part in aero.surface
        ]
        slope = sum((each for each, _ in parts), np.zeros(len(mach)))
        moment = sum((each * station for each, station in parts), np.zeros(len(mach)))
    elif "x_cp_m" in aero.table:
        slope, moment = aero.table["CN_alpha_pr"], aero.table["CN_alpha_pr"] * aero.table["x_cp_m"]
    else:
        return None
    lifts = slope > 0.0
    return (slope[lifts], moment[lifts] / slope[lifts] + aero.centre_shift_m) if lifts.any() else None


def _liquids(stage: Stage) -> Iterator[Implausible]:
    """Yield the damping ratios of lightly damped liquids that an attitude loop destabilises.

    They are between the CG and the centre of percussion.

    Source: Greensite, Analysis and Design of Space Vehicle Flight Control Systems, vol. 1, section 3. The centre of
    percussion of a body with a lateral force at its gimbal, l aft of the CG, is I / (m l) ahead of the CG.
    """
    mass, gimbals = stage.mass.table, [e.gimbal_station_m for e in stage.engines if e.gimbal != "fixed"]
    if mass is None or not gimbals or (mass["x_cg_m"] >= min(gimbals)).any():
        return
    for n, tank in enumerate(stage.tank):
        if tank.damping_ratio >= _DAMPED or tank.baffles is not None:
            continue
        times, bob_m, kg = _bob(tank)
        total, cg_m, lateral = (np.interp(times, mass["time_s"], mass[k]) for k in ("mass_kg", "x_cg_m", "Iyy_kgm2"))
        percussion_m = cg_m - lateral / (total * (min(gimbals) - cg_m))
        between = (percussion_m < bob_m) & (bob_m < cg_m) & (kg > 0.01 * total)
        if between.any():
            when = f"{times[between][0]:.3g} s" if len(times) > 1 else "all times"
            usual = f"from {_DAMPED:g}: from {when} on it swings between centre of percussion and CG"
            yield f"tank.{n}.damping_ratio", tank.damping_ratio, usual


def _bob(tank: Tank) -> tuple[Array, Array, Array]:
    """Return the times (n,), s, and the stations (n,), m, and masses (n,), kg, of the first slosh mode.

    A tank with a shape is treated as a cylinder with the same radius and liquid depth (NASA SP-106).
    """
    table = tank.table
    if "slosh_mass_kg" in table:
        return table["time_s"], table["hinge_station_m"] + table["pendulum_length_m"], table["slosh_mass_kg"]
    radius, density, kg = tank.radius_m or 1.0, tank.density_kgpm3 or 1.0, table["liquid_mass_kg"]
    depth = np.maximum(tank.profile.depth(kg / (density * radius**3)), 1e-9)
    below = 2.0 * radius / _ROOT * np.tanh(0.5 * _ROOT * depth)
    share = 2.0 * np.tanh(_ROOT * depth) / (_ROOT * depth * (_ROOT**2 - 1.0))
    return table["time_s"], (tank.bottom_station_m or 0.0) - radius * depth + below, share * kg


def _sampling(scenario: Scenario) -> Iterator[Implausible]:
    """Yield a sample period with which the first bending mode of a stage is above the Nyquist frequency."""
    computer = scenario.vehicle.computer
    if computer is None:
        return
    for stage in scenario.vehicle.stage:
        for _, modes in stage.mode_tables():
            lowest = float(modes.frequency_hz[:, 0].max())
            if lowest > 0.5 / computer.sample_s:
                name = f"of {stage.name}" if stage.name else "here"
                usual = f"below {0.5 / lowest:.3g} s: the first mode {name} reaches {lowest:.3g} Hz and aliases"
                yield "sample_s", computer.sample_s, usual
                return


def _lift_off(stage: Stage) -> Iterator[Implausible]:
    """Yield the largest thrust if it is below the weight, for a vehicle that is released when thrust exceeds weight."""
    thrust = sum(engine.thrust_factor * float(engine.table["thrust_vacuum_N"].max()) for engine in stage.engines)
    kg = stage.mass.mass_kg if stage.mass.table is None else float(stage.mass.table["mass_kg"].min())
    if stage.engines and thrust < _G * (kg or 0.0):
        yield "engine", thrust, f"more than the weight of {_G * (kg or 0.0):.4g} N, or it is never released"


def _run(scenario: Scenario) -> Iterator[Implausible]:
    run = scenario.run
    if run.duration_s / run.step_s > _LONG_RUN:
        yield "step_s", run.step_s, f"fewer than {_LONG_RUN:g} steps in duration_s = {run.duration_s:g} s"


def _log(scenario: Scenario) -> Iterator[Implausible]:
    duration_s, step_s = scenario.run.duration_s, min(scenario.run.step_s, USUAL_STEP_S)
    for key in ("fast_hz", "slow_hz"):
        rate_hz = getattr(scenario.log, key)
        if duration_s * rate_hz > _LONG_RUN:
            yield key, rate_hz, f"fewer than {_LONG_RUN:g} rows in duration_s = {duration_s:g} s"
        elif rate_hz * step_s > 1.0:
            yield key, rate_hz, f"at most {1.0 / step_s:g} Hz, a row for each step"


def _site(scenario: Scenario) -> Iterator[Implausible]:
    altitude_m = scenario.site.altitude_m
    if scenario.initial is None and not -500.0 <= altitude_m <= 9000.0:
        yield "altitude_m", altitude_m, "a place on the ground, -500 .. 9000 m"


def _wind(scenario: Scenario) -> Iterator[Implausible]:
    wind = scenario.wind
    speeds = np.array([wind.speed_mps or 0.0])
    if wind.profile is not None:
        low = wind.profile["altitude_m"] <= _WEATHER_M
        parts = [wind.profile.get(name)[low] for name in ("speed_mps", "north_mps", "east_mps")]
        speeds = np.concatenate([np.hypot(np.abs(parts[0]), np.hypot(parts[1], parts[2])), [0.0]])
    fastest = abs(wind.factor) * float(speeds.max())
    if fastest > _WEATHER_MPS:
        key = "profile" if wind.profile is not None else "speed_mps"
        yield key, fastest, f"less than {_WEATHER_MPS:g} m/s below {_WEATHER_M:g} m"
