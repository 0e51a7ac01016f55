"""Mass, CG and inertia of the vehicle with its liquids frozen in their tanks, from the components."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import pi

from maxq.tools.dev.ksr3 import assumptions as a
from maxq.tools.dev.ksr3.propulsion import Burn

TANK_AREA_M2 = pi * a.TANK_RADIUS_M**2


@dataclass(frozen=True)
class Part:
    """A uniform rod of mass between two stations, with a transverse inertia of its own beside the rod's."""

    mass_kg: float
    front_station_m: float
    rear_station_m: float
    gyration_m2: float

    @property
    def station_m(self) -> float:
        return (self.front_station_m + self.rear_station_m) / 2

    @property
    def inertia_kgm2(self) -> float:
        """About a transverse axis through its own CG."""
        length = self.rear_station_m - self.front_station_m
        return self.mass_kg * (length**2 / 12 + self.gyration_m2)


@dataclass(frozen=True)
class MassProperties:
    mass_kg: float
    x_cg_m: float  # station
    roll_inertia_kgm2: float
    pitch_inertia_kgm2: float  # about the CG


@dataclass(frozen=True)
class Fill:
    """The liquid in one tank."""

    tank: a.Tank
    mass_kg: float

    @property
    def height_m(self) -> float:
        return self.mass_kg / self.tank.density_kgpm3 / TANK_AREA_M2

    @property
    def surface_station_m(self) -> float:
        return self.tank.bottom_station_m - self.height_m


def fills(burn: Burn, t: float) -> list[Fill]:
    """Liquids left at time t; both tanks drain in the mixture ratio."""
    propellant = a.LIFTOFF_MASS_KG - burn.burnout_mass_kg
    left = float(burn.propellant_left(t))
    return [Fill(tank, propellant * tank.share * left) for tank in a.TANKS]


def dry_parts(burn: Burn) -> list[Part]:
    """Structure: the guesses scaled so that, with the engine, they make the burn-out mass."""
    scale = (burn.burnout_mass_kg - a.ENGINE_MASS_KG) / sum(c.guess_kg for c in a.DRY_COMPONENTS)
    return [
        Part(c.guess_kg * scale, c.front_station_m, c.rear_station_m, a.CROSS_GYRATION_M2) for c in a.DRY_COMPONENTS
    ]


def engine_part() -> Part:
    return Part(a.ENGINE_MASS_KG, a.GIMBAL_STATION_M, a.ENGINE_END_STATION_M, a.ENGINE_GYRATION_M2)


def all_parts(burn: Burn, t: float) -> Iterator[Part]:
    yield from dry_parts(burn)
    yield engine_part()
    for fill in fills(burn, t):
        yield Part(fill.mass_kg, fill.surface_station_m, fill.tank.bottom_station_m, a.TANK_RADIUS_M**2 / 4)


def mass_properties(burn: Burn, t: float) -> MassProperties:
    parts = list(all_parts(burn, t))
    mass = sum(p.mass_kg for p in parts)
    cg = sum(p.mass_kg * p.station_m for p in parts) / mass
    pitch = sum(p.inertia_kgm2 + p.mass_kg * (p.station_m - cg) ** 2 for p in parts)
    roll = (mass - a.ENGINE_MASS_KG) * a.ROLL_GYRATION_M2 + a.FIN_ROLL_INERTIA_KGM2
    return MassProperties(mass, cg, roll, pitch)
