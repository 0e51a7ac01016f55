"""Earth, atmosphere, wind and turbulence of a scenario as records."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from maxq.control.kernel.limits import MAX_GUSTS
from maxq.control.kernel.tables import NO_TABLE, Cubics, Pool, TableRef, fit
from maxq.sim.packing.remembered import cached_by_identity
from maxq.sim.scenario import schema_environment as schema
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.vehicle.environment import Environment
from maxq.sim.world import atmosphere as air
from maxq.sim.world import earth as globe
from maxq.sim.world import turbulence as dryden
from maxq.sim.world import wind as winds

_GRAVITY = {
    "none": globe.NO_GRAVITY, "uniform": globe.UNIFORM, "inverse_square": globe.INVERSE_SQUARE, "j2": globe.J2,
}  # fmt: skip
_GUSTS = {"one-minus-cosine": winds.ONE_MINUS_COSINE, "shear": winds.SHEAR}


def pack_environment(scenario: Scenario, pool: Pool) -> Environment:
    return Environment(
        earth=pack_earth(scenario.earth),
        atmosphere=_atmosphere(scenario.atmosphere, pool),
        wind=pack_wind(scenario.wind, pool),
        turbulence=_turbulence(scenario, pool),
    )


def pack_earth(earth: schema.Earth) -> globe.Earth:
    """The figure's defaults with what the scenario gives in their place."""
    if earth.shape == "flat":
        default = globe.flat()
        radius_m = default.equatorial_radius_m
    elif earth.shape == "sphere":
        default = globe.sphere()
        radius_m = _or(earth.sphere_radius_m, default.equatorial_radius_m)
    else:
        default = globe.wgs84()
        radius_m = _or(earth.equatorial_radius_m, default.equatorial_radius_m)
    return replace(
        default,
        equatorial_radius_m=radius_m,
        flattening=_or(earth.flattening, default.flattening),
        rate_radps=_or(earth.rate_radps, default.rate_radps) if earth.rotating else 0.0,
        gravity=_GRAVITY[earth.gravity],
        mu_m3ps2=_or(earth.mu_m3ps2, default.mu_m3ps2),
        j2=_or(earth.j2, default.j2),
        gravity_radius_m=_or(earth.gravity_radius_m, default.gravity_radius_m),
        uniform_mps2=_or(earth.uniform_mps2, default.uniform_mps2),
    )


def _or(given: float | None, default: float) -> float:
    return default if given is None else given


def _atmosphere(atmosphere: schema.Atmosphere, pool: Pool) -> air.Atmosphere:
    factor = atmosphere.density_factor
    if atmosphere.model == "us1976":
        return air.Atmosphere(air.US1976, density_factor=factor)
    if atmosphere.model == "vacuum":
        return air.Atmosphere(air.VACUUM)
    if atmosphere.model == "table":
        t = atmosphere.table
        assert t is not None
        columns = t["density_kgpm3"], t["pressure_Pa"], t["temperature_K"]
        return air.Atmosphere(air.TABLE, pool.add(air.air_table(t["altitude_m"], *columns)), density_factor=factor)
    assert atmosphere.density_kgpm3 is not None
    default = air.Atmosphere()
    return air.Atmosphere(
        air.CONSTANT,
        density_kgpm3=atmosphere.density_kgpm3,
        pressure_Pa=_or(atmosphere.pressure_Pa, default.pressure_Pa),
        temperature_K=_or(atmosphere.temperature_K, default.temperature_K),
        density_factor=factor,
    )


def pack_wind(wind: schema.Wind, pool: Pool) -> winds.Wind:
    columns = np.zeros((6, MAX_GUSTS))
    for i, g in enumerate(wind.gust):
        north, east, _ = winds.wind_components(g.speed_mps, g.from_deg)[0]
        columns[:, i] = _GUSTS[g.kind], g.altitude_m, g.thickness_m, g.edge_m or 0.0, north, east
    kinds = columns[0].astype(np.int64)
    return winds.Wind(_wind_profile(wind, pool), wind.factor, len(wind.gust), kinds, *columns[1:])


def _wind_profile(wind: schema.Wind, pool: Pool) -> TableRef:
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
    return pool.add(fit(table["altitude_m"], columns, wind.interpolation))


def _turbulence(scenario: Scenario, pool: Pool) -> dryden.Turbulence:
    turbulence = scenario.wind.turbulence
    if turbulence is None:
        return dryden.Turbulence()
    seed = scenario.run.seed if turbulence.seed is None else turbulence.seed
    return dryden.Turbulence(1, pool.add(_intensity(turbulence, scenario.site.altitude_m)), seed)


@cached_by_identity
def _intensity(turbulence: schema.Turbulence, ground_m: float) -> Cubics:
    lengths = (turbulence.length_u_m, turbulence.length_v_m, turbulence.length_w_m)
    if turbulence.table is not None:
        t = turbulence.table
        sigma = np.stack([t[f"sigma_{axis}_mps"] for axis in "uvw"], axis=1)
        standard = dryden.exceedance_table("moderate", ground_m).at(t["altitude_m"])[:, 3:]
        return dryden.intensity_table(t["altitude_m"], sigma, _with(standard, lengths))
    assert turbulence.exceedance is not None
    given = dryden.exceedance_table(turbulence.exceedance, ground_m)
    rows = given.at(given.breaks)
    return dryden.intensity_table(given.breaks, rows[:, :3], _with(rows[:, 3:], lengths))


def _with(standard: np.ndarray, lengths: tuple[float | None, ...]) -> np.ndarray:
    """The standard's scale lengths with those of the scenario in their place."""
    out = standard.copy()
    for axis, length in enumerate(lengths):
        if length is not None:
            out[:, axis] = length
    return out
