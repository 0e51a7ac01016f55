"""The records of a scenario's Earth, atmosphere, wind and turbulence."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from maxq.control.kernel.limits import MAX_GUSTS
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import NO_TABLE, Cubics, Pool, TableRef, fit
from maxq.sim.input.remembered import cached_by_identity
from maxq.sim.input.values import Section
from maxq.sim.scenario import schema_environment as schema
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.vehicle.environment import Environment
from maxq.sim.world import atmosphere as air
from maxq.sim.world import earth as globe
from maxq.sim.world import turbulence as gusts
from maxq.sim.world import wind as winds
from maxq.sim.world.thermosphere import upper_air

_GRAVITY = {"none": globe.NO_GRAVITY, "uniform": globe.UNIFORM, "inverse_square": globe.INVERSE_SQUARE, "j2": globe.J2}
_AIR = {"us1976": air.US1976, "table": air.TABLE, "constant": air.CONSTANT}
_GUSTS = {"one-minus-cosine": winds.ONE_MINUS_COSINE, "shear": winds.SHEAR}


def pack_environment(scenario: Scenario, pool: Pool) -> Environment:
    return Environment(
        earth=pack_earth(scenario.earth),
        atmosphere=_atmosphere(scenario.atmosphere, pool),
        wind=pack_wind(scenario.wind, pool, scenario.site.altitude_m),
        turbulence=_turbulence(scenario, pool),
        penetration=int(scenario.switches.gust_penetration),
        reach_m=scenario.vehicle.reference.length_m,
    )


def pack_earth(earth: schema.EarthSection) -> globe.Earth:
    """Return the Earth with the defaults of its shape, except for values that the scenario gives."""
    default = {"flat": globe.flat, "sphere": globe.sphere, "wgs84": globe.wgs84}[earth.shape]()
    names = ("flattening", "rate_radps", "mu_m3ps2", "j2", "gravity_radius_m", "uniform_mps2")
    given = _given(earth, *names, "equatorial_radius_m")
    if earth.sphere_radius_m is not None:
        given["equatorial_radius_m"] = earth.sphere_radius_m
    if not earth.rotating:
        given["rate_radps"] = 0.0
    return replace(default, gravity=_GRAVITY[earth.gravity], **given)


def _given(section: Section, *names: str) -> dict[str, Any]:
    """Return the values of the optional keys `names`, without keys that have none."""
    return {name: value for name in names if (value := getattr(section, name)) is not None}


def _atmosphere(atmosphere: schema.AtmosphereSection, pool: Pool) -> air.Atmosphere:
    if atmosphere.model == "vacuum":
        return air.Atmosphere(air.VACUUM)
    made = air.Atmosphere(_AIR[atmosphere.model], density_factor=atmosphere.density_factor)
    if atmosphere.model == "us1976":
        return replace(made, table=pool.add(upper_air()))
    if (t := atmosphere.table) is not None:
        columns = t["density_kgpm3"], t["pressure_Pa"], t["temperature_K"]
        return replace(made, table=pool.add(air.air_table(t["altitude_m"], *columns)))
    return replace(made, **_given(atmosphere, "density_kgpm3", "pressure_Pa", "temperature_K"))


def pack_wind(wind: schema.WindSection, pool: Pool, ground_m: float) -> winds.Wind:
    columns = np.zeros((6, MAX_GUSTS))
    for i, g in enumerate(wind.gust):
        north, east, _ = winds.wind_components(g.speed_mps, g.from_deg)[0]
        columns[:, i] = _GUSTS[g.kind], g.altitude_m, g.thickness_m, g.edge_m or 0.0, north, east
    kinds = columns[0].astype(np.int64)
    return winds.Wind(_wind_profile(wind, pool, ground_m), wind.factor, len(wind.gust), kinds, *columns[1:])


def _wind_profile(wind: schema.WindSection, pool: Pool, ground_m: float) -> TableRef:
    if wind.speed_mps is not None and wind.from_deg is not None:
        return pool.add(fit([0.0], winds.wind_components(wind.speed_mps, wind.from_deg).reshape(1, 3)))
    if wind.profile is None:
        return NO_TABLE
    table = wind.profile
    if "speed_mps" in table:
        columns = winds.wind_components(table["speed_mps"], table["from_deg"])
        columns[:, 2] = table.get("down_mps")
    else:
        columns = np.stack([table["north_mps"], table["east_mps"], table.get("down_mps")], axis=1)
    altitude_m = table["altitude_m"]
    if wind.ground is not None:
        altitude_m, columns = _to_the_ground(wind.ground, altitude_m, columns, ground_m)
    if wind.turn_deg:
        c, s = math.cos(math.radians(wind.turn_deg)), math.sin(math.radians(wind.turn_deg))
        north, east, down = columns.T
        columns = np.stack([c * north - s * east, s * north + c * east, down], axis=1)
    return pool.add(fit(altitude_m, columns, wind.interpolation))


# fractions of the shear layer's height; linear interpolation is within 1 % of both laws from 0.01 upwards
_SHEAR_ROWS = np.concatenate([[0.0, 0.002, 0.005], np.geomspace(0.01, 1.0, 21)])


def _to_the_ground(
    shear: schema.GroundShear, altitude_m: Array, columns: Array, ground_m: float
) -> tuple[Array, Array]:
    """Return the profile with rows of a shear law below its lowest level or below the measured ground wind.

    The profile consists of `altitude_m` (n,) and `columns` (n, 3), the wind components north, east and down, m/s.
    `ground_m` is the altitude of the site. The result has the form of the profile.
    """
    height, lowest = altitude_m - ground_m, shear.height_m
    if shear.speed_mps is not None and shear.from_deg is not None:
        kept = height > lowest
        reference = winds.wind_components(shear.speed_mps, shear.from_deg)[0]
    else:
        first = min(int(np.searchsorted(height, 0.0)), len(height) - 1)  # levels below the ground are ignored
        lowest, reference = max(lowest, float(height[first])), columns[first]
        kept = height > lowest
    below = lowest * _SHEAR_ROWS
    if shear.law == "power":
        share = (below / lowest) ** (1.0 / 7.0 if shear.exponent is None else shear.exponent)
    else:
        roughness_m = 0.03 if shear.roughness_m is None else shear.roughness_m
        share = np.log1p(below / roughness_m) / math.log1p(lowest / roughness_m)
    rows = share[:, None] * reference
    return np.append(ground_m + below, altitude_m[kept]), np.concatenate([rows, columns[kept]])


def _turbulence(scenario: Scenario, pool: Pool) -> gusts.Turbulence:
    turbulence = scenario.wind.turbulence
    if turbulence is None:
        return gusts.Turbulence()
    seed = scenario.run.seed if turbulence.seed is None else turbulence.seed
    if (t := turbulence.spectrum) is not None:
        return gusts.Turbulence(1, seed=seed, **gusts.spectral_lines(t["wave_number_pm"], t["density_m3ps2"], seed))
    mixture = gusts.scale_mixture(gusts.VON_KARMAN if turbulence.model == "von-karman" else gusts.DRYDEN)
    frame = gusts.HORIZONTAL if turbulence.frame == "horizontal" else gusts.BODY
    return gusts.Turbulence(1, pool.add(_intensity(turbulence, scenario.site.altitude_m)), seed, frame=frame, **mixture)


@cached_by_identity
def _intensity(turbulence: schema.TurbulenceSection, ground_m: float) -> Cubics:
    if turbulence.table is not None:
        t = turbulence.table
        altitude_m, sigma = t["altitude_m"], np.stack([t[f"sigma_{axis}_mps"] for axis in "uvw"], axis=1)
        lengths = gusts.exceedance_table("moderate", ground_m).at(altitude_m)[:, 3:].copy()
    else:
        assert turbulence.exceedance is not None
        given = gusts.exceedance_table(turbulence.exceedance, ground_m)
        altitude_m, rows = given.breaks, given.at(given.breaks)
        sigma, lengths = rows[:, :3], rows[:, 3:].copy()
    for axis, length in enumerate((turbulence.length_u_m, turbulence.length_v_m, turbulence.length_w_m)):
        if length is not None:
            lengths[:, axis] = length
    return gusts.intensity_table(altitude_m, sigma, lengths)
