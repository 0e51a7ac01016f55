"""The metrics that follow from the end and the extremes of a flight, and the verdicts on its requirements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from maxq.control.kernel.records import Records
from maxq.control.kernel.vectors import Vector, add, cross, dot, norm, scaled
from maxq.sim.flight.metric_table import CutoffMetrics, EndMetrics, OrbitMetrics, SectionMetrics, title_of, unit_of
from maxq.sim.run.quantities import against_limit, by_utilisation, meets, sign_of, utilisation
from maxq.sim.scenario.schema_environment import Site
from maxq.sim.scenario.schema_launch import Cutoff, OrbitTarget
from maxq.sim.scenario.schema_scenario import MOST_HALVINGS, RequirementSection, Run, Scenario
from maxq.sim.vehicle.loads.columns import BENDING, COMPRESSION, KINDS, SHEAR, TENSILE, SectionLoads, extreme_index
from maxq.sim.world.earth import FLAT, INVERSE_SQUARE, J2, Earth

_ITERATIONS = 200
_CONVERGED_RAD = 1e-13


_OF_ERRORS = {
    "step_error_attitude_deg": ("max_attitude_error_deg", 5e-4),
    "step_error_bending_m": ("max_bending_m", 1e-5),
    "step_error_slosh_deg": ("max_slosh_deg", 5e-4),
}
"""The metric to which each estimated error is relative, and the error that is allowed if nothing is required.

5e-4 deg is about a count of KSR-III's attitude converter (1e-5 rad). A mode that moves the gimbal by 1e-5 m rotates a
sensor by about the same angle.
"""


STEP_SCALES = tuple(of for of, _ in _OF_ERRORS.values())
"""The metrics to which the estimated errors are relative."""
ATTITUDE_METRICS = (  # metrics of controlled vehicles
    "max_attitude_error_deg",
    "max_roll_error_deg",
    "max_computer_attitude_error_deg",
    "max_computer_roll_error_deg",
)


def judged_requirements(scenario: Scenario) -> tuple[RequirementSection, ...]:
    """Return the requirements on a flight; without control, requirements on attitude errors are omitted."""
    controlled = scenario.design is not None and scenario.vehicle.computer is not None
    return tuple(r for r in scenario.requirement if controlled or r.metric not in ATTITUDE_METRICS)


def step_failure(run: Run, metrics: Mapping[str, float], requirements: Sequence[RequirementSection]) -> str:
    """Return a message with a remedy if an estimated error exceeds `run.accuracy`, else an empty string.

    The accuracy is relative to the required limit of a metric. Without a limit, it is relative to the value of the
    metric, and errors below the resolution of sensors are allowed.
    """
    if run.accuracy is None:
        return ""
    for name, (of, least) in _OF_ERRORS.items():
        limit = min((r.limit for r in requirements if r.metric == of and r.limit is not None), default=None)
        allowed = run.accuracy * (metrics[of] if limit is None else limit)
        if metrics[name] > (max(allowed, least) if limit is None else allowed):
            unit, finer = unit_of(name), run.halvings < MOST_HALVINGS
            return (
                f"integration: {title_of(name)} {metrics[name]:.2g} {unit} exceeds run.accuracy = {run.accuracy:g} of "
                f"{title_of(of)}, {allowed:.2g} {unit}; "
                f"set {f'run.halvings = {run.halvings + 1}' if finer else 'run.step_s instead of run.accuracy'}"
            )
    return ""


def end_metrics(final: Mapping[str, float], earth: Earth, site: Site, flight_time_s: float) -> EndMetrics:
    """Return the end metrics from `final`, the channels at the last instant of the flight."""
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
    """Return the orbit metrics from position and velocity in I; nan without a central gravity field.

    Source: Vallado, Fundamentals of Astrodynamics and Applications, algorithm 9. For an equatorial orbit, the x axis of
    I replaces the node, and for a circular orbit, the node replaces the perigee.
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
        """Return the angle from `start` to `end` in the plane of the orbit, 0 to 360 deg."""
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


def cutoff_metrics(earth: Earth, end: OrbitTarget | Cutoff, r_I_m: Vector, v_I_mps: Vector) -> CutoffMetrics:
    """Return the metrics of a cutoff with the target `end` from position and velocity in I."""
    spin = float(earth.rate_radps)
    over_ground = (v_I_mps[0] + spin * r_I_m[1], v_I_mps[1] - spin * r_I_m[0], v_I_mps[2])
    speed_mps, inertial_mps, orbit = norm(over_ground), norm(v_I_mps), orbit_metrics(earth, r_I_m, v_I_mps)
    aim = end if isinstance(end, Cutoff) else Cutoff.model_construct()
    aims = [(speed_mps, aim.earth_speed_mps), (inertial_mps, aim.inertial_speed_mps)]
    perigee_m = end.perigee_altitude_m if isinstance(end, OrbitTarget) else None
    return CutoffMetrics(
        cutoff_altitude_m=norm(r_I_m) - float(earth.equatorial_radius_m) if earth.figure != FLAT else -r_I_m[2],
        cutoff_speed_mps=speed_mps,
        cutoff_inertial_speed_mps=inertial_mps,
        cutoff_speed_error_mps=next((abs(value - wanted) for value, wanted in aims if wanted is not None), math.nan),
        cutoff_apogee_error_m=_error(orbit.apogee_altitude_m, end.apogee_altitude_m),
        cutoff_perigee_error_m=_error(orbit.perigee_altitude_m, perigee_m),
    )


def _error(value: float, wanted: float | None) -> float:
    return math.nan if wanted is None else abs(value - wanted)


@dataclass(frozen=True)
class SectionExtreme:
    """The largest load of one of the KINDS (sim/vehicle/loads/columns.py) at a station, and its ratio to the limit.

    The value is 0 if the load never was positive, and the ratio is 0 without a limit. The time is then nan.
    """

    stage: int  # from 1
    station_m: float
    kind: str
    value: float
    time_s: float
    ratio: float
    ratio_time_s: float


def section_extremes(parameters: Records, sections: SectionLoads) -> tuple[SectionExtreme, ...]:
    """Return all extremes of a flight's section loads in the order of stages, stations and kinds.

    `parameters` (stages,) is of Parameters.
    """
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
    """Return the metrics of section loads and their times, s; nan without extremes."""
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
    """The verdict on a requirement: the value of its metric, the time of this value, s (nan if unknown), and `met`."""

    requirement: RequirementSection
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
    def utilisation(self) -> float:
        """Return the utilisation of the limit; nan for a limit of 0 or less."""
        return utilisation(self.value, *self.bound)

    @property
    def shown(self) -> tuple[str, str, str]:
        """Return the texts of value, limit and their engineering unit."""
        return against_limit(self.value, *self.bound, unit_of(self.requirement.metric))

    @property
    def limit_text(self) -> str:
        """Return the limit with its sign and engineering unit, such as "<= 100 kPa deg"."""
        _, bound, unit = self.shown
        return f"{sign_of(self.bound[0])} {bound} {unit}".rstrip()

    @property
    def wanted(self) -> str:
        """Return the limit with its sign in the unit of the metric, such as "<= 5 deg"."""
        (kind, bound), unit = self.bound, unit_of(self.requirement.metric)
        return f"{'<=' if kind == 'limit' else '>='} {bound:.6g} {'' if unit == '1' else unit}".rstrip()


def judge(requirement: RequirementSection, values: Mapping[str, float], times_s: Mapping[str, float]) -> Verdict:
    """Return the verdict on a requirement from the metrics and their times; nan meets no requirement.

    Raises KeyError for an unknown metric.
    """
    value = values[requirement.metric]
    return Verdict(requirement, value, times_s[requirement.metric], meets(value, *requirement.bound))


def tightest_first(verdicts: Iterable[Verdict]) -> list[Verdict]:
    """Return the missed verdicts followed by the others, each in order of decreasing utilisation."""
    return sorted(verdicts, key=lambda v: by_utilisation(v.met, v.utilisation))


def geodesic_m(radius_m: float, flattening: float, start: tuple[float, float], end: tuple[float, float]) -> float:
    """Return the geodesic distance, m, on an ellipsoid between two places (geodetic latitude, longitude), rad.

    Method: Vincenty's inverse formula (Survey Review 23, 1975), accurate to 0.1 mm on the Earth. It does not converge
    for nearly antipodal places. For these places, and if the end is not finite, the result is nan.
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
