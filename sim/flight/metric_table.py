"""The metrics of a flight: names, units and meanings.

A metric is declared once. Metrics that the kernel gathers (sim/flight/metrics.py) are fields of `MetricIndex`. Metrics
that follow from the extremes of sections and waves, the integration, or the flight's last instant (sim/run/metrics.py)
are fields of the other classes.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from maxq.sim.flight.channels import declared_channels


class MetricIndex(NamedTuple):
    """The index of each metric in `Extremes`, with its unit and its meaning."""

    max_speed_mps: Annotated[int, "m/s", "largest speed relative to the Earth"]
    max_altitude_m: Annotated[int, "m", "largest altitude"]
    max_mach: Annotated[int, "1", "largest Mach number"]
    max_dynamic_pressure_Pa: Annotated[int, "Pa", "largest dynamic pressure"]
    max_powered_dynamic_pressure_Pa: Annotated[int, "Pa", "largest dynamic pressure under thrust"]
    max_alpha_deg: Annotated[
        int, "deg", "largest total angle of attack under thrust while the dynamic pressure exceeds 1 kPa"
    ]
    max_q_alpha_Padeg: Annotated[
        int, "Pa deg", "largest product of dynamic pressure (above 1 kPa) and total angle of attack under thrust"
    ]
    max_attitude_error_deg: Annotated[
        int, "deg", "largest angle of pitch or yaw from the commanded to the true attitude under thrust"
    ]
    max_roll_error_deg: Annotated[int, "deg", "the same for roll"]
    max_computer_attitude_error_deg: Annotated[
        int, "deg", "largest attitude error of pitch or yaw in the computer under thrust"
    ]
    max_computer_roll_error_deg: Annotated[int, "deg", "the same of roll"]
    max_gimbal_deg: Annotated[int, "deg", "largest gimbal angle of either axis under thrust"]
    max_gimbal_rate_degps: Annotated[int, "deg/s", "largest gimbal rate of either axis under thrust"]
    max_bending_m: Annotated[int, "m", "largest displacement of the gimbal by bending, either plane"]
    max_slosh_deg: Annotated[int, "deg", "largest angle of a slosh pendulum from the body axis under thrust"]
    max_thrust_over_weight_g: Annotated[int, "g", "largest thrust over mass"]
    max_axial_load_g: Annotated[int, "g", "largest sensed axial specific force at the vehicle's CG"]
    max_lateral_load_g: Annotated[int, "g", "largest sensed lateral specific force at the core CG under thrust"]
    saturation_time_s: Annotated[int, "s", "time during which a gimbal command is at its limit"]


N_METRICS = len(MetricIndex._fields)


class EndMetrics(NamedTuple):
    """The metrics at the flight's end; on a flat Earth, latitude and longitude are nan, and the site is the origin."""

    flight_time_s: Annotated[
        float, "s", "time from liftoff, or from the start of a flight without hold-down, to the end"
    ]
    range_m: Annotated[float, "m", "distance along the ground from the launch site to where the flight ended"]
    final_latitude_deg: Annotated[float, "deg", "geodetic latitude at the end"]
    final_longitude_deg: Annotated[float, "deg", "longitude at the end, east positive"]
    final_altitude_m: Annotated[float, "m", "altitude at the end"]
    final_speed_mps: Annotated[float, "m/s", "speed relative to the Earth at the end"]


class SectionMetrics(NamedTuple):
    """Extremes of section loads, under thrust and on the pad (with loads.coast always); nan without them."""

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
    """The metrics of waves over all tanks; nan for a vehicle without the shape of any tank."""

    max_wave_share: Annotated[
        float, "1", "peak height of a wave in a tank under thrust / height at which it counts as breaking"
    ]


class StepMetrics(NamedTuple):
    """The estimated errors of the integration; nan with steps of a fixed length.

    Errors of single steps are estimated every half second, multiplied by the number of steps, and added as if they
    never cancelled or decayed. Errors of steps in which an engine starts or stops are added as squares. The position
    error includes the effects of attitude and speed errors. No error includes effects through the control loop.
    """

    step_error_attitude_deg: Annotated[float, "deg", "estimated integration error of the attitude"]
    step_error_bending_m: Annotated[float, "m", "the same for the worst mode"]
    step_error_slosh_deg: Annotated[float, "deg", "the same for the worst pendulum"]
    step_error_position_m: Annotated[float, "m", "the same for the position"]


class LaunchMetrics(NamedTuple):
    """The metrics of the launch; nan without a tower, a rail and a clamp, respectively."""

    min_tower_clearance_m: Annotated[float, "m", "least distance of the vehicle to the tower; negative: contact"]
    max_tower_drift_m: Annotated[
        float, "m", "largest horizontal displacement of the nozzle exit plane until it has passed the top of the tower"
    ]
    rail_exit_speed_mps: Annotated[float, "m/s", "speed relative to the Earth at the end of the rail"]
    max_release_bending_degps: Annotated[
        float, "deg/s", "largest angular rate by bending at the gyro in the 2 s after the release of a clamped tail"
    ]


class CutoffMetrics(NamedTuple):
    """The state at the last cutoff by the guidance, and its errors; nan without such guidance."""

    cutoff_altitude_m: Annotated[float, "m", "altitude above the equatorial radius at the last cutoff"]
    cutoff_speed_mps: Annotated[float, "m/s", "speed relative to the Earth at the last cutoff"]
    cutoff_inertial_speed_mps: Annotated[float, "m/s", "inertial speed at the last cutoff"]
    cutoff_speed_error_mps: Annotated[float, "m/s", "error of the speed that the last cutoff aimed at, absolute"]
    cutoff_apogee_error_m: Annotated[float, "m", "error of the apogee that the last cutoff aimed at, absolute"]
    cutoff_perigee_error_m: Annotated[float, "m", "the same for the perigee"]


class ImpactMetrics(NamedTuple):
    """The metrics of the instantaneous impact point in vacuum; nan without [range_safety], and without a zone."""

    max_impact_range_m: Annotated[float, "m", "largest distance of the impact point from the site"]
    max_impact_cross_range_m: Annotated[float, "m", "largest distance of the impact point from the flight line"]
    max_impact_excursion_m: Annotated[
        float, "m", "largest distance of the impact point outside the permitted zone; negative: inside, from its edge"
    ]


class OrbitMetrics(NamedTuple):
    """The osculating Kepler orbit at the flight's end; nan without gravitation towards a centre."""

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
    for kind in (
        MetricIndex,
        SectionMetrics,
        EndMetrics,
        WaveMetrics,
        StepMetrics,
        LaunchMetrics,
        CutoffMetrics,
        ImpactMetrics,
        OrbitMetrics,
    )
    for metric in declared_channels(kind)
}
METRIC_NAMES = tuple(METRICS)
"""The names that a requirement may use."""


_SHORT = {  # titles of metrics whose name without its unit is not clear
    "max_alpha_deg": "largest angle of attack",
    "max_q_alpha_Padeg": "largest q alpha",
    "max_powered_dynamic_pressure_Pa": "largest dynamic pressure under thrust",
    "max_gimbal_deg": "largest gimbal angle",
    "max_computer_attitude_error_deg": "largest attitude error in the computer",
    "max_computer_roll_error_deg": "largest roll error in the computer",
    "max_bending_m": "largest bending at the gimbal",
    "max_slosh_deg": "largest slosh angle",
    "max_thrust_over_weight_g": "largest thrust over weight",
    "max_section_bending_moment_station_m": "station of the largest bending moment",
    "max_section_load_ratio": "largest section load / limit",
    "max_section_load_ratio_station_m": "its station",
    "orbit_semimajor_m": "semi-major axis",
    "max_wave_share": "peak wave height / breaking height",
    "saturation_time_s": "time with the gimbal command at its limit",
}


def title_of(metric: str) -> str:
    """Return a metric's title without its unit: "largest gimbal rate" for max_gimbal_rate_degps.

    Any other name is returned unchanged.
    """
    if metric in _SHORT or metric not in METRICS:
        return _SHORT.get(metric, metric)
    name = metric if unit_of(metric) == "1" else metric.rpartition("_")[0]
    return name.replace("max_", "largest ", 1).replace("_", " ").replace(" mach", " Mach number")


def unit_of(metric: str) -> str:
    """Return the unit of a metric. Raises KeyError for an unknown name."""
    return METRICS[metric].unit
