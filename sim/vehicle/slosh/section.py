"""The schema of a tank with sloshing liquid: pendulums from tables or from the tank's shape, damping and high waves."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from maxq.sim.input.errors import refuse
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import ChannelPart, Fraction, NotNegative, Pair, Positive, Section, optional

Array = NDArray[np.float64]
SECOND_MODE = ("slosh_mass_2_kg", "pendulum_length_2_m", "hinge_station_2_m")
TANK_COLUMNS = Columns(
    "time_s",
    sets=(("slosh_mass_kg", "pendulum_length_m", "hinge_station_m"), ("liquid_mass_kg",)),
    optional=("liquid_height_m", *SECOND_MODE),
    positive=("pendulum_length_m", "pendulum_length_2_m"),
    not_negative=("slosh_mass_kg", "slosh_mass_2_kg", "liquid_mass_kg", "liquid_height_m"),
    begins_by=0.0,
)
_LEAST_DOME = 0.25  # of the radius: with a flatter dome, shallow liquid has a pendulum longer than the tank


class Profile(NamedTuple):
    """The inner shape of a tank, lengths in radii of its cylindrical part; domes are half ellipsoids, 0 is flat."""

    bottom: float
    wall: float
    top: float

    def surface_radius(self, depth: Array) -> Array:
        """Return the radius of the surface at rest when the liquid is `depth` deep."""
        low = 1.0 - np.minimum(depth, self.bottom) / self.bottom if self.bottom else 0.0 * depth
        high = np.maximum(depth - self.bottom - self.wall, 0.0) / self.top if self.top else 0.0 * depth
        return np.asarray(np.sqrt(np.maximum(1.0 - low**2 - high**2, 0.0)))

    def volume(self, depth: Array) -> Array:
        """Return the volume of the liquid, in cubes of the radius."""
        in_bottom, above = np.minimum(depth, self.bottom), np.maximum(depth - self.bottom, 0.0)
        in_wall, in_top = np.minimum(above, self.wall), np.maximum(above - self.wall, 0.0)
        out = np.pi * in_wall
        if self.bottom:
            out = out + np.pi * in_bottom**2 / self.bottom * (1.0 - in_bottom / (3.0 * self.bottom))
        if self.top:
            out = out + np.pi * in_top * (1.0 - in_top**2 / (3.0 * self.top**2))
        return np.asarray(out)

    @property
    def height(self) -> float:
        return self.bottom + self.wall + self.top

    def depth(self, volume: Array) -> Array:
        """Return the depth of the liquid, the inverse of `volume`, by bisection."""
        low, high = np.zeros_like(volume), np.full_like(volume, self.height)
        for _ in range(60):
            middle = 0.5 * (low + high)
            below = self.volume(middle) < volume
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.asarray(0.5 * (low + high))


def check_domes(profile: Profile, radius_m: float, key: str = "dome_m") -> None:
    """Reject domes that are too flat, or higher than the tank; `key` is the key of their heights."""
    for dome in (profile.bottom, profile.top):
        if dome < 0.0 or 0.0 < dome < _LEAST_DOME:
            least = _LEAST_DOME * radius_m
            allowed = f"at least {2 * least:g}" if key == "height_m" else f"0, or from {least:g}"
            raise refuse("the dome is too flat", allowed, key)
    if profile.wall < 0.0:
        least = radius_m * (profile.bottom + profile.top)
        raise refuse("the domes are higher than the tank", f"height_m from {least:g}", ("height_m",))


class Baffles(Section):
    """The rings on a tank's wall: damping proportional to the root of the wave height (NASA SP-106, eq. 4.10)."""

    width_m: Positive = Field(description="width of each ring, from the wall inwards, m")
    station_m: tuple[float, ...] = Field(
        min_length=1, description="stations of the rings, m aft of the nose; rings above the surface have no effect"
    )


class Tank(Section):
    """A tank with a sloshing liquid, modelled by one or two spherical pendulums."""

    name: ChannelPart = optional("name of the tank in logs (default: its number); a second pendulum is NAME_2", "")
    table: Annotated[CsvTable, TANK_COLUMNS] = Field(
        description="over the stage clock: the pendulum, and that of the second mode in columns ..._2_...; or the "
        "liquid's mass, from which `shape` gives the pendulums. The stage's table of mass includes it"
    )
    position_m: Pair = optional("y and z of the tank's axis from the axis of its body (core or booster), m", (0.0, 0.0))
    damping_ratio: Fraction = optional(
        "damping ratio of the pendulum in small waves (default 0 with viscosity_m2ps or baffles)", 0.0
    )
    second_damping_ratio: Fraction | None = optional(
        "damping ratio of the second mode's pendulum (default: as damping_ratio)"
    )
    damping_factor: NotNegative = optional("factor on all damping: pendulums, smooth walls and baffles", 1.0)
    viscosity_m2ps: Positive | None = optional("kinematic viscosity, m2/s, which adds the damping of a smooth wall")
    baffles: Baffles | None = optional("ring baffles, whose damping of the first mode increases with the wave")
    mass_factor: NotNegative = optional("factor on the slosh mass; the vehicle's mass is unchanged", 1.0)
    length_factor: Positive = optional(
        "factor on the pendulum's length; the frequency is proportional to 1 / sqrt(length)", 1.0
    )
    shape: Literal["cylinder", "sphere", "ellipsoid"] | None = optional("shape of the tank, upright")
    radius_m: Positive | None = optional("radius of the tank, m; without a shape: an upright cylinder")
    bottom_station_m: float | None = optional("aft end of the tank, m aft of the nose")
    height_m: Positive | None = optional("inner height of a cylinder (domes included) or an ellipsoid, m")
    dome_m: Pair | None = optional("heights of a cylinder's half-ellipsoidal domes, bottom and top, m; 0: flat")
    density_kgpm3: Positive | None = optional("density of the liquid, kg/m3")
    modes: Literal[1, 2] | None = optional("number of lateral slosh modes of a shape (default 1)")
    breaking_height_m: Positive | None = optional(
        "height of a breaking wave, m (default: where the surface falls with the axial load)"
    )

    @property
    def profile(self) -> Profile:
        """Return the shape in radii; without a shape, an upright cylinder."""
        radius = self.radius_m or 1.0
        height = (self.height_m or 2.0 * radius) / radius
        if self.shape in ("sphere", "ellipsoid"):
            return Profile(0.5 * height, 0.0, 0.5 * height)
        bottom, top = (dome / radius for dome in self.dome_m or (0.0, 0.0))
        return Profile(bottom, height - bottom - top, top)

    @property
    def pendulums(self) -> int:
        """Return the number of simulated slosh modes."""
        return self.modes or (2 if SECOND_MODE[0] in self.table else 1)

    @property
    def shows_waves(self) -> bool:
        """Return True if the log contains the height of the tank's waves."""
        return self.shape is not None or self.baffles is not None or self.viscosity_m2ps is not None

    def _check(self) -> None:
        table = self.table
        given = [name for name in SECOND_MODE if name in table]
        if given and len(given) < len(SECOND_MODE):
            missing = next(name for name in SECOND_MODE if name not in table)
            raise table.refusal(f"column {missing} is missing with {given[0]}", ", ".join(SECOND_MODE), at=("table",))
        if ("liquid_mass_kg" in table) != (self.shape is not None):
            allowed = "shape with liquid_mass_kg, or neither"
            raise refuse("the pendulum is given by a table or follows from a shape", allowed, ("shape",))
        if given and self.shape is not None:
            raise table.refusal(f"column {given[0]} cannot be combined with liquid_mass_kg", "modes = 2", at=("table",))
        damped = {"damping_ratio", "viscosity_m2ps", "baffles"} & self.model_fields_set
        if not damped:
            allowed = "damping_ratio (0 .. 1), viscosity_m2ps or baffles"
            raise refuse("required key is missing: nothing damps the liquid", allowed, ("damping_ratio",))
        self.only_with(("second_damping_ratio",), self.pendulums == 2, "a second slosh mode")
        self.only_with(("height_m", "density_kgpm3", "modes"), self.shape is not None, "shape")
        self.only_with(("dome_m",), self.shape == "cylinder", 'shape = "cylinder"')
        if self.shape is not None:
            self._check_shape()
        for key in ("viscosity_m2ps", "baffles", "breaking_height_m"):
            if getattr(self, key) is not None:
                self.needs("radius_m", f"{key} is given", "a number > 0")
        if self.baffles is not None:
            self._check_baffles(self.baffles)

    def _check_shape(self) -> None:
        radius = float(self.needs("radius_m", "shape is given", "a number > 0"))
        density = float(self.needs("density_kgpm3", "shape is given", "a number > 0"))
        self.needs("bottom_station_m", "shape is given", "a number")
        if self.shape == "sphere":
            self.only_with(("height_m",), False, "a cylinder or an ellipsoid")
        else:
            self.needs("height_m", f'shape = "{self.shape}"', "a number > 0")
        profile = self.profile
        check_domes(profile, radius, "height_m" if self.shape == "ellipsoid" else "dome_m")
        most = density * radius**3 * float(profile.volume(np.array(profile.height)))
        mass = self.table["liquid_mass_kg"]
        self.table.refuse_where(
            mass > most * (1.0 + 1e-9),
            "liquid_mass_kg",
            "is more than the tank holds",
            f"up to {most:.6g}",
            at=("table",),
        )

    def _check_baffles(self, baffles: Baffles) -> None:
        if self.shape is None:
            self.needs("bottom_station_m", "baffles are given", "a number")
            if "liquid_height_m" not in self.table:
                raise self.table.refusal("column liquid_height_m is missing: baffles are given", at=("table",))
        radius, bottom = self.radius_m or 0.0, self.bottom_station_m or 0.0
        if baffles.width_m >= radius:
            raise refuse("is as wide as the tank", f"below {radius:g}", ("baffles", "width_m"))
        profile = self.profile
        top = bottom - radius * (profile.bottom + profile.wall)
        for n, station in enumerate(baffles.station_m):
            outside = self.shape is not None and not top <= station <= bottom - radius * profile.bottom
            if outside or station > bottom:
                allowed = f"{top:g} .. {bottom - radius * profile.bottom:g}" if self.shape else f"up to {bottom:g}"
                raise refuse("the ring is not on the cylindrical wall", allowed, ("baffles", "station_m", n))
