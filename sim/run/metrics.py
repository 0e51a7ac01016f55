"""Metrics of a flight by name, those of its end included, and the verdicts on a scenario's requirements.

A metric is declared once: as a field of `MetricIndex` (sim/flight/metrics.py) where the kernel gathers it, or of
`SectionMetrics`, `WaveMetrics`, `StepMetrics` or `EndMetrics` where it follows from the extremes of sections and waves,
the integration, or the flight's last instant.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.records import Records
from maxq.control.kernel.vectors import Vector, add, cross, dot, norm, scaled
from maxq.sim.flight.channels import declared_channels
from maxq.sim.flight.metrics import MetricIndex
from maxq.sim.scenario.schema_environment import Site
from maxq.sim.scenario.schema_scenario import Requirement
from maxq.sim.vehicle.loads import BENDING, COMPRESSION, KINDS, SHEAR, TENSILE, SectionLoads, extreme_index
from maxq.sim.world.earth import FLAT, INVERSE_SQUARE, J2, Earth

_ITERATIONS = 200
_CONVERGED_RAD = 1e-13


class EndMetrics(NamedTuple):
    """On a flat Earth latitude and longitude are nan; the site is its origin."""

    flight_time_s: Annotated[
        float, "s", "time to the end from lift-off, or from the start where nothing held the vehicle"
    ]
    range_m: Annotated[float, "m", "distance along the ground from the launch site to where the flight ended"]
    final_latitude_deg: Annotated[float, "deg", "geodetic latitude at the end"]
    final_longitude_deg: Annotated[float, "deg", "longitude at the end, east positive"]
    final_altitude_m: Annotated[float, "m", "altitude at the end"]
    final_speed_mps: Annotated[float, "m/s", "speed relative to the Earth at the end"]


class SectionMetrics(NamedTuple):
    """Of the section loads, under thrust and on the pad (with loads.coast always); nan without them."""

    max_section_bending_moment_Nm: Annotated[float, "N m", "largest bending moment of a section, both planes together"]
    max_section_bending_moment_station_m: Annotated[float, "m", "its station, aft of the nose"]
    max_section_shear_N: Annotated[float, "N", "largest shear of a section, both planes together"]
    max_section_compression_N: Annotated[float, "N", "largest axial compression of a section"]
    max_section_tension_N: Annotated[float, "N", "largest axial tension of a section"]
    max_section_load_ratio: Annotated[float, "1", "largest ratio of a section's load to its limit (loads.limits)"]
    max_section_load_ratio_station_m: Annotated[float, "m", "its station, aft of the nose"]
    max_section_mass_mismatch: Annotated[
        float, "1", "largest relative difference between line mass and core: of the mass, of the CG over the length"
    ]


class WaveMetrics(NamedTuple):
    """Over all tanks; nan for a vehicle that says nothing about the shape of any."""

    max_wave_share: Annotated[
        float, "1", "largest height of a wave in a tank under thrust, over that at which it counts as breaking"
    ]


class StepMetrics(NamedTuple):
    """Estimated errors of the integration: those of single steps every half second, as often as there are steps, added
    as if they never cancelled or died away (as their squares where an engine starts or stops within the step); that of
    the position holds what those of attitude and speed become, none what becomes of it in the control loop. nan with
    steps of a fixed length.
    """

    step_error_attitude_deg: Annotated[float, "deg", "estimated error of the attitude by the integration"]
    step_error_bending_m: Annotated[float, "m", "the same of the worst mode"]
    step_error_slosh_deg: Annotated[float, "deg", "the same of the worst pendulum"]
    step_error_position_m: Annotated[float, "m", "the same of the position"]


_OF_ERRORS = {
    "step_error_attitude_deg": "max_attitude_error_deg",
    "step_error_bending_m": "max_bending_m",
    "step_error_slosh_deg": "max_slosh_deg",
}
"""What an estimated error is a share of."""


def step_failure(accuracy: float, metrics: Mapping[str, float], requirements: Sequence[Requirement]) -> str:
    """What is said where an estimated error exceeds `accuracy` of what is required, or of what was reached where
    nothing is; else empty.
    """
    for name, of in _OF_ERRORS.items():
        limits = [r.limit for r in requirements if r.metric == of and r.limit is not None]
        allowed = accuracy * (limits[0] if limits else metrics[of])
        if metrics[name] > allowed:
            unit = unit_of(name)
            return (
                f"integration: {title_of(name)} {metrics[name]:.2g} {unit} exceeds run.accuracy = {accuracy:g} of "
                f"{title_of(of)}, {allowed:.2g} {unit}"
            )
    return ""


class OrbitMetrics(NamedTuple):
    """Kepler's orbit that the flight is on at its end (osculating); nan without gravitation towards a centre."""

    perigee_altitude_m: Annotated[float, "m", "lowest point above the equatorial radius, at the end"]
    apogee_altitude_m: Annotated[float, "m", "highest point above the equatorial radius, at the end; inf: escapes"]
    orbit_semimajor_m: Annotated[float, "m", "semi-major axis of the orbit, at the end; negative: escapes"]
    orbit_eccentricity: Annotated[float, "1", "eccentricity of the orbit, at the end"]
    orbit_inclination_deg: Annotated[float, "deg", "inclination of the orbit to the equator, at the end"]
    orbit_ascending_node_deg: Annotated[float, "deg", "right ascension of the ascending node in I, at the end"]
    orbit_argument_of_perigee_deg: Annotated[float, "deg", "angle from ascending node to perigee, at the end"]
    orbit_true_anomaly_deg: Annotated[float, "deg", "angle from perigee to the vehicle, at the end"]


METRICS = {
    metric.name: metric
    for kind in (MetricIndex, SectionMetrics, EndMetrics, WaveMetrics, StepMetrics, OrbitMetrics)
    for metric in declared_channels(kind)
}
METRIC_NAMES = tuple(METRICS)
"""Names that a requirement may use."""


_SHORT = {  # where a name without its unit says less than it should
    "max_alpha_deg": "largest angle of attack",
    "max_q_alpha_Padeg": "largest q alpha",
    "max_powered_dynamic_pressure_Pa": "largest dynamic pressure under thrust",
    "max_bending_m": "largest bending at the gimbal",
    "max_slosh_deg": "largest slosh angle",
    "max_thrust_over_weight_g": "largest thrust over weight",
    "max_section_bending_moment_station_m": "station of the largest bending moment",
    "max_section_load_ratio": "largest section load over its limit",
    "max_section_load_ratio_station_m": "its station",
    "orbit_semimajor_m": "semi-major axis",
    "max_wave_share": "largest wave over the breaking one",
    "saturation_time_s": "gimbal command at its limit",
}


def title_of(metric: str) -> str:
    """A metric's name for people, without its unit: "largest gimbal rate" for max_gimbal_rate_degps. A name that is no
    metric's is returned as it is.
    """
    if metric in _SHORT or metric not in METRICS:
        return _SHORT.get(metric, metric)
    name = metric if unit_of(metric) == "1" else metric.rpartition("_")[0]
    return name.replace("max_", "largest ", 1).replace("_", " ").replace(" mach", " Mach number")


def figures(value: float, digits: int = 4) -> str:
    """A value with so many significant digits, without exponent from 1e-4 to 1e7; what is below 1e-6 is 0."""
    if not math.isfinite(value):
        return "-" if math.isnan(value) else f"{value}"
    if abs(value) < 1e-6:
        return "0"
    text = f"{value:.{digits}g}"
    if "e" not in text or not 1e-4 <= abs(value) < 1e7:
        return text
    return f"{float(text):.0f}"


def unit_of(metric: str) -> str:
    """Unit of a metric; KeyError for an unknown name."""
    return METRICS[metric].unit


def end_metrics(final: Mapping[str, float], earth: Earth, site: Site, flight_time_s: float) -> EndMetrics:
    """From the channels at the flight's last instant."""
    if earth.figure == FLAT:
        latitude_deg, longitude_deg = math.nan, math.nan
        range_m = math.hypot(final["r_E_x_m"], final["r_E_y_m"])
    else:
        latitude_deg, longitude_deg = final["latitude_deg"], final["longitude_deg"]
        range_m = geodesic_m(
            earth.equatorial_radius_m,
            earth.flattening,
            (math.radians(site.latitude_deg), math.radians(site.longitude_deg)),
            (math.radians(latitude_deg), math.radians(longitude_deg)),
        )
    return EndMetrics(
        flight_time_s=flight_time_s,
        range_m=range_m,
        final_latitude_deg=latitude_deg,
        final_longitude_deg=longitude_deg,
        final_altitude_m=final["altitude_m"],
        final_speed_mps=final["speed_mps"],
    )


def orbit_metrics(earth: Earth, r_I_m: Vector, v_I_mps: Vector) -> OrbitMetrics:
    """From position and velocity in I (Vallado, Fundamentals of Astrodynamics and Applications, algorithm 9).

    Where the orbit lies in the equator the node counts as I's x axis, where it is a circle the perigee as the node.
    """
    if earth.figure == FLAT or earth.gravity not in (INVERSE_SQUARE, J2):
        return OrbitMetrics(*[math.nan] * len(OrbitMetrics._fields))
    mu, equator_m = float(earth.mu_m3ps2), float(earth.equatorial_radius_m)
    radius, momentum = norm(r_I_m), cross(r_I_m, v_I_mps)
    towards_perigee = add(scaled(1.0 / mu, cross(v_I_mps, momentum)), scaled(-1.0 / radius, r_I_m))
    eccentricity = norm(towards_perigee)
    axis_m = 1.0 / (2.0 / radius - dot(v_I_mps, v_I_mps) / mu)
    up = scaled(1.0 / max(norm(momentum), 1e-300), momentum)
    towards_node = math.hypot(up[0], up[1])
    node = (-up[1] / towards_node, up[0] / towards_node, 0.0) if towards_node > 1e-12 else (1.0, 0.0, 0.0)
    perigee = scaled(1.0 / eccentricity, towards_perigee) if eccentricity > 1e-12 else node

    def angle_deg(start: Vector, end: Vector) -> float:
        """In the plane of the orbit, 0 .. 360."""
        return math.degrees(math.atan2(dot(cross(start, end), up), dot(start, end))) % 360.0

    return OrbitMetrics(
        perigee_altitude_m=axis_m * (1.0 - eccentricity) - equator_m,
        apogee_altitude_m=axis_m * (1.0 + eccentricity) - equator_m if axis_m > 0.0 else math.inf,
        orbit_semimajor_m=axis_m,
        orbit_eccentricity=eccentricity,
        orbit_inclination_deg=math.degrees(math.acos(max(-1.0, min(1.0, float(up[2]))))),
        orbit_ascending_node_deg=math.degrees(math.atan2(node[1], node[0])) % 360.0,
        orbit_argument_of_perigee_deg=angle_deg(node, perigee),
        orbit_true_anomaly_deg=angle_deg(perigee, r_I_m),
    )


@dataclass(frozen=True)
class SectionExtreme:
    """The largest load of a kind (sim/vehicle/loads.py, KINDS) at a station, and the largest ratio to its limit.

    Zero where the load never was positive, and a ratio of 0 where there is no limit; times are nan then.
    """

    stage: int  # from 1
    station_m: float
    kind: str
    value: float
    time_s: float
    ratio: float
    ratio_time_s: float


def section_extremes(parameters: Records, sections: SectionLoads) -> tuple[SectionExtreme, ...]:
    """All extremes of a flight's section loads, stage by stage, station by station; `parameters` of every stage."""
    out = []
    for stage, p in enumerate(parameters):
        for n in range(int(p.loads.stations)):
            for kind, name in enumerate(KINDS):
                e = extreme_index(stage, kind, n)
                times_s = (_time_s(int(times_ns[e])) for times_ns in (sections.value_ns, sections.ratio_ns))
                pairs = zip((float(sections.value[e]), float(sections.ratio[e])), times_s, strict=True)
                out.append(
                    SectionExtreme(stage + 1, float(p.loads.station_m[n]), name, *(x for pair in pairs for x in pair))
                )
    return tuple(out)


def section_metrics(
    extremes: tuple[SectionExtreme, ...], sections: SectionLoads
) -> tuple[SectionMetrics, SectionMetrics]:
    """The metrics of these extremes, and their times, s."""
    if not extremes:
        nothing = SectionMetrics(*[math.nan] * len(SectionMetrics._fields))
        return nothing, nothing
    largest = {
        kind: max((e for e in extremes if e.kind == KINDS[kind]), key=lambda e: e.value)
        for kind in (BENDING, SHEAR, COMPRESSION, TENSILE)
    }
    worst = max(extremes, key=lambda e: e.ratio)
    bending, shear, compression, tension = largest.values()
    mismatch_s = _time_s(int(sections.mismatch_ns))
    values = (worst.ratio, worst.station_m, float(sections.mismatch))
    times = (worst.ratio_time_s, worst.ratio_time_s, mismatch_s)
    return (
        SectionMetrics(bending.value, bending.station_m, shear.value, compression.value, tension.value, *values),
        SectionMetrics(bending.time_s, bending.time_s, shear.time_s, compression.time_s, tension.time_s, *times),
    )


def _time_s(time_ns: int) -> float:
    return time_ns / 1e9 if time_ns >= 0 else math.nan


@dataclass(frozen=True)
class Verdict:
    """A requirement and the metric it bounds; `time_s`: when the flight had that value, nan if unknown."""

    requirement: Requirement
    value: float
    time_s: float
    met: bool

    @property
    def name(self) -> str:
        return self.requirement.name or self.requirement.metric

    @property
    def bound(self) -> tuple[str, float]:
        return self.requirement.bound

    @property
    def wanted(self) -> str:
        """The bound in words: "<= 5 deg"."""
        (kind, bound), unit = self.bound, unit_of(self.requirement.metric)
        return f"{'<=' if kind == 'limit' else '>='} {bound:.6g} {'' if unit == '1' else unit}".rstrip()


def judge(requirement: Requirement, values: Mapping[str, float], times_s: Mapping[str, float]) -> Verdict:
    """A value that is not a number meets no requirement. Raises KeyError for an unknown metric."""
    value, (kind, bound) = values[requirement.metric], requirement.bound
    met = value <= bound if kind == "limit" else value >= bound
    return Verdict(requirement, value, times_s[requirement.metric], met)


def geodesic_m(radius_m: float, flattening: float, start: tuple[float, float], end: tuple[float, float]) -> float:
    """Geodesic distance on an ellipsoid between two places (geodetic latitude, longitude), rad.

    Vincenty's inverse formula (Survey Review 23, 1975), good to 0.1 mm on the Earth. It does not converge for
    nearly antipodal places: then, and for coordinates that are not numbers, nan.
    """
    (latitude_1, longitude_1), (latitude_2, longitude_2) = start, end
    if not math.isfinite(latitude_2 + longitude_2):
        return math.nan
    reduced_1 = math.atan((1.0 - flattening) * math.tan(latitude_1))
    reduced_2 = math.atan((1.0 - flattening) * math.tan(latitude_2))
    sin_1, cos_1 = math.sin(reduced_1), math.cos(reduced_1)
    sin_2, cos_2 = math.sin(reduced_2), math.cos(reduced_2)
    difference = math.remainder(longitude_2 - longitude_1, math.tau)
    wide = difference
    for _ in range(_ITERATIONS):
        sin_wide, cos_wide = math.sin(wide), math.cos(wide)
        sin_arc = math.hypot(cos_2 * sin_wide, cos_1 * sin_2 - sin_1 * cos_2 * cos_wide)
        if sin_arc == 0.0 and cos_wide > 0.0:
            return 0.0
        cos_arc = sin_1 * sin_2 + cos_1 * cos_2 * cos_wide
        arc = math.atan2(sin_arc, cos_arc)
        sin_azimuth = cos_1 * cos_2 * sin_wide / sin_arc if sin_arc else 0.0
        cos2_azimuth = 1.0 - sin_azimuth * sin_azimuth
        cos_middle = cos_arc - 2.0 * sin_1 * sin_2 / cos2_azimuth if cos2_azimuth > 1e-15 else 0.0
        c = flattening / 16.0 * cos2_azimuth * (4.0 + flattening * (4.0 - 3.0 * cos2_azimuth))
        before = wide
        wide = difference + (1.0 - c) * flattening * sin_azimuth * (
            arc + c * sin_arc * (cos_middle + c * cos_arc * (2.0 * cos_middle * cos_middle - 1.0))
        )
        if abs(wide - before) < _CONVERGED_RAD and abs(wide) <= math.pi:
            break
    else:
        return math.nan
    second = (1.0 - flattening) ** -2 - 1.0  # second eccentricity squared
    u2 = cos2_azimuth * second
    a = 1.0 + u2 / 16384.0 * (4096.0 + u2 * (-768.0 + u2 * (320.0 - 175.0 * u2)))
    b = u2 / 1024.0 * (256.0 + u2 * (-128.0 + u2 * (74.0 - 47.0 * u2)))
    inner = cos_arc * (2.0 * cos_middle * cos_middle - 1.0) - b / 6.0 * cos_middle * (4.0 * sin_arc * sin_arc - 3.0) * (
        4.0 * cos_middle * cos_middle - 3.0
    )
    correction = b * sin_arc * (cos_middle + b / 4.0 * inner)
    return float(radius_m * (1.0 - flattening) * a * (arc - correction))
