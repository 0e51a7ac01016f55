"""The pendulums of a stage's tanks over time: one for each slosh mode, with its damping and the height of its wave.

The pendulums are given by the table of the tank, or follow from its shape (`slosh_modes`). In addition to mass, length
and hinge, each pendulum has three columns of schedule.py, from which `sim/vehicle/slosh/kernel.py` computes damping and
waves. If only a radius is given, their values are those of an upright cylinder:

- smooth wall: zeta a^(1/4), a the axial load. NASA SP-106, ch. 4 (Mikishev & Dorozhkin 1961), at the depth h:
  zeta = 0.79 sqrt(nu / sqrt(a R^3)) (1 + 0.318 / sinh(1.84 h/R) (1 + (1 - h/R) / cosh(1.84 h/R)))
- ring baffles: zeta / sqrt(swing), by the law of `ring_damping`, summed over the rings below the surface
- wave: height of the highest point of the surface per sine of the swing, 2 R / (xi^2 - 1) in the first mode. The
  moments about the axis of the liquid, rho pi R^3 eta / xi^2, and of the pendulum, m L sin(swing), are equal
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Cubics, Method, fit
from maxq.sim.input.remembered import cached_by_identity
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.vehicle.slosh.section import SECOND_MODE, Baffles, Profile, Tank
from maxq.sim.vehicle.slosh.shapes import MEASURED_OVER_LAMINAR, modes_over

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_vehicle import Stage

XI = (1.84118378134066, 5.33144277352503)  # first zeros of J1'
# radii; that of mode 2 is not at the wall, but where J1 is largest
WAVE_PER_SWING = (2.0 / (XI[0] ** 2 - 1.0), 0.122571)
_FIRST_MODE = ("slosh_mass_kg", "pendulum_length_m", "hinge_station_m")
_SHALLOWEST = 0.05  # depth in radii below which the damping of the wall is constant
_INSTANTS = 200  # least number of instants over a table of liquid
_PASSING_S = 0.01  # half the time in which a ring leaves the liquid


@dataclass(frozen=True)
class Pendulum:
    """A slosh mode of a tank over the stage clock."""

    name: str
    tank: Tank
    mode: int  # from 1
    joined: Cubics  # columns TANK_MASS to TANK_HINGE of schedule.py
    waves: Cubics  # columns TANK_VISCOUS to TANK_WAVE
    body: int = 0  # number of the body in the stage: 0 is the core, then the boosters
    place_m: tuple[float, float] = (0.0, 0.0)  # position of the tank's axis relative to the body axis, y and z

    @property
    def damping_ratio(self) -> float:
        """Return the damping ratio at small waves, without the contribution of a smooth wall."""
        second = self.tank.second_damping_ratio
        own = self.tank.damping_ratio if self.mode == 1 or second is None else second
        return own * self.tank.damping_factor

    @property
    def breaking_height_m(self) -> float:
        """Return the breaking height of the wave that the tank specifies; 0 selects that of linear theory."""
        return (self.tank.breaking_height_m or 0.0) if self.mode == 1 else 0.0

    @property
    def has_law(self) -> bool:
        """Return True if a smooth wall or baffles add damping."""
        return self.tank.viscosity_m2ps is not None or self.tank.baffles is not None


def pendulums(stage: Stage) -> list[Pendulum]:
    """Return all pendulums of a stage, tank by tank."""
    places = [(0.0, 0.0), *(booster.position_m for booster in stage.booster)]
    modes = [
        (tank, mode, *curves, body, (places[body][0] + tank.position_m[0], places[body][1] + tank.position_m[1]))
        for body, _, tank in stage.tanks
        for mode, curves in enumerate(pendulum_curves(tank, stage.interpolation), start=1)
    ]
    return [Pendulum(name, *mode) for name, mode in zip(stage.pendulum_names, modes, strict=True)]


def pendulum_curves(tank: Tank, method: Method) -> list[tuple[Cubics, Cubics]]:
    """Return the columns `joined` and `waves` of each pendulum of a tank over the stage clock."""
    given = tank.radius_m or 0.0, tank.bottom_station_m or 0.0, tank.viscosity_m2ps or 0.0
    if tank.shape is None:
        found = _of_table(tank.table, tank.pendulums, *given, tank.baffles, method)
    else:
        shape = tank.table, tank.profile, tank.pendulums, *given, tank.density_kgpm3 or 0.0
        found = _of_shape(*shape, tank.baffles, method)
    factors = np.array([tank.mass_factor, tank.length_factor, 1.0])
    return [(Cubics(joined.breaks, joined.coefficients * factors), waves) for joined, waves in found]


def ring_damping(depth_r: float, cover: float, wave_r: float) -> float:
    """Return the damping ratio of a ring baffle that covers the share `cover` of the surface.

    `depth_r`: depth of the ring below the surface, radii. `wave_r`: height of the wave at the wall, radii. The formula
    is valid for an upright cylinder and the first mode, and for narrow rings in waves lower than the depth of the ring.
    It follows from the drag of a plate in oscillating flow of Keulegan & Carpenter (Miles, J. Aero. Sci. 25, 1958; NASA
    SP-106, eq. 4.10).
    """
    return 2.83 * math.exp(-4.6 * depth_r) * math.pow(cover, 1.5) * math.sqrt(wave_r)


@cached_by_identity
def _of_table(
    table: CsvTable, modes: int, radius: float, bottom: float, viscosity: float, baffles: Baffles | None, method: Method
) -> list[tuple[Cubics, Cubics]]:
    time_s, out = table["time_s"], []
    for mode, names in enumerate((_FIRST_MODE, SECOND_MODE)[:modes]):
        joined = fit(time_s, np.stack([table[n] for n in names], axis=1), method)
        wave = radius * WAVE_PER_SWING[mode]
        if not viscosity and baffles is None:
            out.append((joined, fit([0.0], [[0.0, 0.0, wave]])))
            continue
        has_depth = "liquid_height_m" in table
        height = fit(time_s, table["liquid_height_m"], method) if has_depth else fit([0.0], [[np.inf]])
        rings = baffles if mode == 0 else None
        at = _instants(time_s, height, bottom, rings) if has_depth else time_s
        depth = height.at(at)[:, 0] if has_depth else np.full(len(at), 100.0 * radius)
        smooth = 0.79 * math.sqrt(viscosity) * radius**-0.75 * _shallow(np.clip(depth / radius, _SHALLOWEST, 100.0))
        if mode == 1:
            loss = (1.0 + XI[1] ** -2) / (1.0 - XI[1] ** -2) / radius
            smooth = _smooth(viscosity, joined.at(at)[:, 1], np.full(len(at), loss))
        ring = _rings(rings, radius, bottom - depth, np.full(len(at), wave))
        out.append((joined, fit(at, np.stack([smooth, ring, np.full(len(at), wave)], axis=1), method)))
    return out


@cached_by_identity
def _of_shape(
    table: CsvTable,
    profile: Profile,
    modes: int,
    radius: float,
    bottom: float,
    viscosity: float,
    density: float,
    baffles: Baffles | None,
    method: Method,
) -> list[tuple[Cubics, Cubics]]:
    mass = fit(table["time_s"], table["liquid_mass_kg"], method)

    def depth_at(at: Array) -> Array:
        return profile.depth(mass.at(at)[:, 0] / (density * radius**3))

    rough = _instants(table["time_s"])
    at = _instants(rough, fit(rough, radius * depth_at(rough), method), bottom, baffles)
    depth = depth_at(at)
    surface = bottom - radius * depth
    out = []
    for n, mode in enumerate(modes_over(profile, depth, modes)):
        length = radius * mode.length
        hinge = surface + radius * mode.bob - length
        joined = fit(at, np.stack([density * radius**3 * mode.mass, length, hinge], axis=1), method)
        smooth = _smooth(viscosity, length, mode.wall_loss / radius)
        ring = _rings(baffles if n == 0 else None, radius, surface, radius * mode.wave)
        out.append((joined, fit(at, np.stack([smooth, ring, radius * mode.wave], axis=1), method)))
    return out


def _instants(
    time_s: Array, height: Cubics | None = None, bottom: float = 0.0, baffles: Baffles | None = None
) -> Array:
    """Return the times (s) of a table, including those before and after each ring leaves the liquid.

    There are more than `_INSTANTS` times, unless the table has a single time.
    """
    if len(time_s) == 1:
        return time_s
    dense = np.unique(np.concatenate([time_s, np.linspace(time_s[0], time_s[-1], _INSTANTS + 1)]))
    found = [dense]
    for station in baffles.station_m if baffles is not None and height is not None else ():
        assert height is not None
        above = station - (bottom - height.at(dense)[:, 0])
        for k in np.flatnonzero(above[:-1] * above[1:] < 0.0):
            passed = dense[k] + (dense[k + 1] - dense[k]) * above[k] / (above[k] - above[k + 1])
            found.append(np.array([passed - _PASSING_S, passed + _PASSING_S]))
    return np.unique(np.concatenate(found))


def _shallow(depth_r: Array) -> Array:
    """Return the factor of the bottom in the damping of a smooth wall; `depth_r` is the depth in radii."""
    deep = np.minimum(1.84 * depth_r, 300.0)
    return 1.0 + 0.318 / np.sinh(deep) * (1.0 + (1.0 - depth_r) / np.cosh(deep))


def _smooth(viscosity: float, length: Array, loss_1pm: Array) -> Array:
    """Return the damping ratio of a laminar layer times the fourth root of the axial load (see `slosh_modes`)."""
    return np.asarray(MEASURED_OVER_LAMINAR * math.sqrt(viscosity / 8.0) * length**0.25 * loss_1pm)


def _rings(baffles: Baffles | None, radius: float, surface: Array, wave: Array) -> Array:
    """Return the damping ratio of rings per root of the swing.

    `surface` (station) and `wave` (per sine of the swing) are values over time.
    """
    out = np.zeros(len(surface))
    if baffles is None:
        return out
    cover = 1.0 - (1.0 - baffles.width_m / radius) ** 2
    for station in baffles.station_m:
        below = (station - surface) / radius
        each = [ring_damping(d, cover, w / radius) if d >= 0.0 else 0.0 for d, w in zip(below, wave, strict=True)]
        out += np.array(each)
    return out
