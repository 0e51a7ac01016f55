"""The sections of a scenario for launch site, Earth, atmosphere and wind."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from maxq.control.kernel.limits import MAX_GUSTS
from maxq.sim.input.errors import refuse
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import Angle, Fraction, Latitude, Longitude, NotNegative, Positive, Section, optional
from maxq.sim.scenario.soundings import SOUNDING

ATMOSPHERE_COLUMNS = Columns(
    "altitude_m",
    sets=(("density_kgpm3", "temperature_K", "pressure_Pa"),),
    positive=("temperature_K", "density_kgpm3", "pressure_Pa"),
)
WIND_COLUMNS = Columns(
    "altitude_m",
    sets=(("speed_mps", "from_deg"), ("north_mps", "east_mps")),
    optional=("down_mps",),
    not_negative=("speed_mps",),
    foreign=SOUNDING,
)
TURBULENCE_COLUMNS = Columns(
    "altitude_m",
    sets=(("sigma_u_mps", "sigma_v_mps", "sigma_w_mps"),),
    not_negative=("sigma_u_mps", "sigma_v_mps", "sigma_w_mps"),
)
SPECTRUM_COLUMNS = Columns("wave_number_pm", sets=(("density_m3ps2",),), positive=("wave_number_pm", "density_m3ps2"))


def _date_and_time(text: str) -> str:
    try:
        if text:
            datetime.fromisoformat(text)
    except ValueError:
        raise refuse("is not a date and time", "ISO 8601, as 2026-01-31T12:00:00Z") from None
    return text


class Site(Section):
    """The launch site."""

    latitude_deg: Latitude = optional("geodetic latitude, deg, north positive", 0.0)
    longitude_deg: Longitude = optional("longitude, deg, east positive", 0.0)
    altitude_m: float = optional("height above the ellipsoid, m", 0.0)
    azimuth_deg: Angle = optional("launch azimuth, deg from north through east; direction of body z on the pad", 90.0)
    utc: Annotated[str, AfterValidator(_date_and_time)] = optional(
        "date and time of T0, as 2026-01-31T12:00:00Z, for the log and exports", ""
    )


class EarthSection(Section):
    """The shape, rotation and gravity of the Earth."""

    shape: Literal["wgs84", "sphere", "flat"] = optional("figure; flat: not rotating, gravity uniform or none", "wgs84")
    rotating: bool = optional("rotation of the Earth", True)
    gravity: Literal["j2", "inverse_square", "uniform", "none"] = optional("gravitation", "j2")
    mu_m3ps2: Positive | None = optional("gravitational parameter, m3/s2 (default: the shape's)")
    j2: float | None = optional("oblateness coefficient (default: WGS-84)")
    equatorial_radius_m: Positive | None = optional("ellipsoid radius, m (default: WGS-84)")
    flattening: Annotated[float, Field(ge=0.0, lt=1.0)] | None = optional("ellipsoid flattening (default: WGS-84)")
    sphere_radius_m: Positive | None = optional("radius with shape = 'sphere', m")
    rate_radps: float | None = optional("rotation rate, rad/s (default: WGS-84)")
    uniform_mps2: NotNegative | None = optional("uniform gravity, m/s2 (default 9.80665)")
    gravity_radius_m: Positive | None = optional("reference radius of J2, m (default: equatorial)")
    gravity_gradient: bool = optional("gravity-gradient torque", False)

    def _check(self) -> None:
        if self.shape == "flat":
            if self.rotating:
                raise refuse("a flat Earth does not rotate", "rotating = false", "rotating", value=True)
            if self.gravity not in ("uniform", "none"):
                allowed = "'uniform', 'none' with shape = 'flat'"
                raise refuse("a flat Earth has no centre", allowed, "gravity", value=self.gravity)
        self.only_with(("sphere_radius_m",), self.shape == "sphere", "shape = 'sphere'")
        self.only_with(("equatorial_radius_m", "flattening"), self.shape == "wgs84", "shape = 'wgs84'")
        self.only_with(("j2", "gravity_radius_m"), self.gravity == "j2", "gravity = 'j2'")
        self.only_with(("uniform_mps2",), self.gravity == "uniform", "gravity = 'uniform'")


class AtmosphereSection(Section):
    """The atmosphere at rest relative to the Earth."""

    model: Literal["us1976", "table", "constant", "vacuum"] = optional(
        "us1976: US Standard Atmosphere 1976, -5 to 1000 km (no air above); vacuum: no air", "us1976"
    )
    table: Annotated[CsvTable, ATMOSPHERE_COLUMNS] | None = optional('air over altitude, for model = "table"')
    density_kgpm3: NotNegative | None = optional('density, kg/m3, for model = "constant"')
    temperature_K: Positive | None = optional('temperature, K, for model = "constant" (default 288.15)')
    pressure_Pa: NotNegative | None = optional('pressure, Pa, for model = "constant" (default 101325)')
    density_factor: NotNegative = optional("factor on the density", 1.0)

    def _check(self) -> None:
        self.only_with(("table",), self.model == "table", "model = 'table'")
        constants = ("density_kgpm3", "temperature_K", "pressure_Pa")
        self.only_with(constants, self.model == "constant", "model = 'constant'")
        if self.model == "table":
            table: CsvTable = self.needs("table", "model is 'table'", ATMOSPHERE_COLUMNS.allowed())
            if len(table) < 2:
                raise table.refusal("has one row only", "at least two rows; or model = 'constant'")
        if self.model == "constant":
            self.needs("density_kgpm3", "model is 'constant'", "a number >= 0")


class Gust(Section):
    """A gust or shear layer, added to the wind."""

    kind: Literal["one-minus-cosine", "shear"] = Field(
        description="one-minus-cosine: rises over edge_m, holds, falls over edge_m; "
        "shear: rises over thickness_m, holds"
    )
    altitude_m: float = Field(description="altitude of its base, m")
    thickness_m: Positive = Field(description="thickness including the edges, m")
    edge_m: Positive | None = optional("length of each edge, m (one-minus-cosine)")
    speed_mps: NotNegative = Field(description="peak speed, m/s")
    from_deg: Angle = Field(description="direction from which it blows, deg from north through east")

    def _check(self) -> None:
        if self.kind == "shear":
            self.only_with(("edge_m",), False, "kind = 'one-minus-cosine'")
        elif 2.0 * self.needs("edge_m", "kind is one-minus-cosine", "a number > 0") > self.thickness_m:
            raise refuse("two edges are thicker than the gust", f"at most {self.thickness_m / 2:g}", "edge_m")


class TurbulenceSection(Section):
    """The turbulence, a random wind in addition to the mean wind."""

    model: Literal["dryden", "von-karman", "spectrum"] = optional(
        "dryden, von-karman: spectra of MIL-F-8785C along the path; spectrum: that of the horizontal wind over "
        "altitude",
        "dryden",
    )
    frame: Literal["body", "horizontal"] = optional(
        "axes of u, v, w: body x, y, z; or north, east, down with spectra by the direction of flight, for a climb "
        "near the ground (spectrum: always horizontal)",
        "body",
    )
    spectrum: Annotated[CsvTable, SPECTRUM_COLUMNS] | None = optional(
        "one-sided power spectrum of each horizontal component, (m/s)^2 per cycle/m, over the vertical wave number, "
        'cycles/m, for model = "spectrum"'
    )
    exceedance: Literal["light", "moderate", "severe"] | None = optional("severity")
    table: Annotated[CsvTable, TURBULENCE_COLUMNS] | None = optional(
        "standard deviations of u, v, w over altitude, instead of exceedance"
    )
    length_u_m: Positive | None = optional("scale length of u, m (default: MIL-F-8785C)")
    length_v_m: Positive | None = optional("scale length of v, m (default: MIL-F-8785C)")
    length_w_m: Positive | None = optional("scale length of w, m (default: MIL-F-8785C)")
    seed: Annotated[int, Field(ge=0, lt=2**63)] | None = optional("seed (default: from run.seed)")

    def _check(self) -> None:
        self.at_most_one("exceedance", "table")
        along_path = ("exceedance", "table", "length_u_m", "length_v_m", "length_w_m")
        self.only_with(along_path, self.model != "spectrum", "model = 'dryden', 'von-karman'")
        self.only_with(("spectrum",), self.model == "spectrum", "model = 'spectrum'")
        if self.model == "spectrum":
            table: CsvTable = self.needs("spectrum", "model is 'spectrum'", SPECTRUM_COLUMNS.allowed())
            if len(table) < 2:
                raise table.refusal("has one row only", "at least two rows")
        elif self.table is None:
            self.needs("exceedance", "turbulence needs a strength", "'light', 'moderate', 'severe', or a table")


class GroundShear(Section):
    """The wind between the ground and the lowest level of the profile, in the direction of that level."""

    law: Literal["power", "log"] = Field(
        description="speed at height h above the site as power: h^exponent; log: ln(1 + h / roughness_m)"
    )
    exponent: Fraction | None = optional("power (default 1/7)")
    roughness_m: Positive | None = optional("log: roughness length, m (default 0.03, open grass)")
    height_m: Positive = optional(
        "height of speed_mps above the site, m; without speed_mps, least height assigned to the lowest level (a "
        "surface report gives the height of its station)",
        10.0,
    )
    speed_mps: NotNegative | None = optional("speed measured at height_m, m/s; lower levels of the profile are omitted")
    from_deg: Angle | None = optional("direction from which it blows, deg from north through east")

    def _check(self) -> None:
        self.only_with(("exponent",), self.law == "power", "law = 'power'")
        self.only_with(("roughness_m",), self.law == "log", "law = 'log'")
        for key, other in (("speed_mps", "from_deg"), ("from_deg", "speed_mps")):
            if getattr(self, key) is not None:
                self.needs(other, f"{key} is given", "a number")


class WindSection(Section):
    """The motion of the air relative to the Earth."""

    profile: Annotated[CsvTable, WIND_COLUMNS] | None = optional("wind over altitude")
    ground: GroundShear | None = optional("absent: the lowest level of the profile extends to the ground")
    speed_mps: NotNegative | None = optional("constant wind, m/s, instead of a profile")
    from_deg: Angle | None = optional("direction from which it blows, deg from north through east")
    interpolation: Literal["linear", "pchip"] = optional("interpolation between the rows of the profile", "linear")
    outside: Literal["hold", "error"] = optional(
        "hold: end values hold outside the profile; error: a flight above the profile fails", "hold"
    )
    factor: float = optional("factor on profile or constant wind", 1.0)
    turn_deg: Angle = optional("angle added to the direction of the profile and its ground shear, deg", 0.0)
    gust: tuple[Gust, ...] = optional("gusts and shear layers", (), max_length=MAX_GUSTS)
    turbulence: TurbulenceSection | None = optional("absent: none")

    def _check(self) -> None:
        self.at_most_one("profile", "speed_mps")
        self.at_most_one("profile", "from_deg")
        self.only_with(("ground",), self.profile is not None, "profile")
        if self.speed_mps is not None:
            self.needs("from_deg", "speed_mps is given", "a number -360 .. 360")
        if self.from_deg is not None:
            self.needs("speed_mps", "from_deg is given", "a number >= 0")
