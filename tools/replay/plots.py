"""The plots, in one table for viewer, paper and terminal, with units and limits, sorted into tabs by subject."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import ChannelTable
from maxq.sim.run.quantities import propellant_text
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.world.constants import STANDARD_GRAVITY_mps2
from maxq.tools.replay.flight import Channels
from maxq.tools.replay.vehicle_shape import PLANES, VehicleShape, shape_of, shapes_at

NEAR = 3.0
"""The ratio of a limit to the largest value above which the limit is named in place of being drawn."""
TimesAndValues = tuple[IntArray, Array]
Computed = Callable[[Channels, str, VehicleShape | None], TimesAndValues]


@dataclass(frozen=True)
class Limit:
    """A limit in a plot's unit. If `upper` is True, values above it are not allowed, else values below it."""

    value: float
    label: str
    upper: bool = True
    required: bool = True  # by the scenario; else a limit of the hardware

    @property
    def text(self) -> str:
        return f"{self.label} {abs(self.value):g}"


@dataclass(frozen=True)
class PlotLine:
    """A line of a plot: a channel, and the function that computes its values if they are not those of the channel."""

    label: str
    channel: str
    compute: Callable[[Channels], TimesAndValues] | None = None

    def values(self, channels: Channels) -> TimesAndValues:
        """Return the times (n,) in ns and the values (n,) in the plot's unit."""
        if self.compute is not None:
            return self.compute(channels)
        return channels.time_ns(self.channel), channels[self.channel]


_NEVER = np.iinfo(np.int64).max


@dataclass(frozen=True)
class ReplayPlot:
    """A plot. `key` is its path below `plots/`, in lower-case words. `unit` is "" for a dimensionless quantity.

    `glance` is the number of its curves that the terminal shows, and their name, in which {} is the label of the curve.
    """

    key: str
    title: str
    unit: str
    curves: tuple[PlotLine, ...]
    limits: tuple[Limit, ...] = ()
    glance: tuple[int, str] = (0, "")

    @property
    def heading(self) -> str:
        return f"{self.title}, {self.unit}" if self.unit else self.title

    def value_range(self, channels: Channels, from_ns: int = 0, until_ns: int = _NEVER) -> tuple[float, float] | None:
        """Return the least and greatest value of the curves between two times, or None if there are no numbers."""
        curves = (c.values(channels) for c in self.curves if c.channel in channels)
        return range_of([values[(ns >= from_ns) & (ns <= until_ns)] for ns, values in curves])


@dataclass(frozen=True)
class Tab:
    name: str
    plots: tuple[ReplayPlot, ...]


@dataclass(frozen=True)
class _Row:
    """A row of the table below: the definition of a plot, independent of log, scenario and vehicle.

    `curves` maps labels to channels. In both, {} stands for each mode or tank that has channels in the log. Values are
    multiplied by `factor`, or computed by `compute`. With `only`, they are gaps unless a channel exceeds a number.
    `limits` are metrics whose requirements are drawn, with both signs if `both` is True, since such a metric is a
    magnitude. `hardware` is the key and axis of a limit of the actuator, and its label.
    """

    key: str
    title: str
    unit: str
    curves: Mapping[str, str]
    factor: float = 1.0
    compute: Mapping[str, Computed] = field(default_factory=dict)
    only: tuple[str, float] | None = None
    limits: Sequence[str] = ()
    both: bool = False
    hardware: tuple[str, str, str] | None = None
    glance: tuple[int, str] = (0, "")


def _lateral(channels: Channels, name: str, shape: VehicleShape | None) -> TimesAndValues:
    other = name.replace("_y_", "_z_")
    return channels.time_ns(name), np.hypot(channels[name], channels[other]) / STANDARD_GRAVITY_mps2


def _distance_km(channels: Channels, name: str, shape: VehicleShape | None) -> TimesAndValues:
    """Return the great-circle distance from the start of the flight, km, accurate to half a percent.

    In a block of a running flight, the start is `start_place_deg`.
    """
    lat, lon = np.radians(channels[name]), np.radians(channels["longitude_deg"])
    start = getattr(channels, "start_place_deg", None)
    lat0, lon0 = np.radians(start) if start is not None else (lat[0], lon[0])
    haversine = np.sin(0.5 * (lat - lat0)) ** 2 + np.cos(lat) * np.cos(lat0) * np.sin(0.5 * (lon - lon0)) ** 2
    return channels.time_ns(name), 2.0 * 6371.0 * np.arcsin(np.sqrt(np.clip(haversine, 0.0, 1.0)))


def _in_motion(channels: Channels, name: str, shape: VehicleShape | None) -> TimesAndValues:
    """Return a direction of flight, with gaps at low speed, where it is undefined."""
    return channels.time_ns(name), np.where(channels["speed_mps"] > 1.0, channels[name], np.nan)


def _gyro_rate_of_mode(channels: Channels, name: str, shape: VehicleShape | None) -> TimesAndValues:
    """Return the angular rate at the gyro due to one mode (deg/s): its slope at the gyro times the modal rate.

    `name` has the form eta_pitch_1_mps. The slopes are those of the first stage.
    """
    _, axis, mode, _ = name.split("_")
    ns, rate = channels.time_ns(name), channels[name]
    assert shape is not None
    stage = shape.stages[0]
    table = stage.modes[PLANES.index(axis)]
    if table is None or stage.gyro_station_m is None or int(mode) > table.modes or not len(ns):
        return ns, np.full(len(rate), np.nan)
    slopes = shapes_at(table, ns / 1e9 * stage.clock_factor, np.array([stage.gyro_station_m]), "slope_pm")
    sign = 1.0 if axis == "pitch" else -1.0  # docs/model.md: yaw modes turn by minus their slope
    return ns, np.degrees(sign * slopes[:, int(mode) - 1, 0] * rate)


def _largest_section(channels: Channels, name: str, shape: VehicleShape | None) -> TimesAndValues:
    """Return the largest value over all stations: axial compression (kN), or magnitude over both planes (kN or kN m).

    `name` is the channel of station 1.
    """
    of_all = [n for n in channels.table.names if re.fullmatch(name.replace("_1_", r"_\d+_"), n)]
    if "_axial_" in name:
        values = [-channels[n] for n in of_all]
    else:
        values = [np.hypot(channels[n], channels[n.replace("_pitch_", "_yaw_")]) for n in of_all]
    return channels.time_ns(name), np.fmax.reduce(values) / 1e3


AXES, _XYZ = ("pitch", "yaw", "roll"), "xyz"
_IN_AIR, _POWERED = ("dynamic_pressure_Pa", 1000.0), ("thrust_N", 0.0)
_TABLE: dict[str, list[_Row]] = {
    "Trajectory": [
        _Row("altitude", "altitude and distance from the site", "km",
             {"altitude": "altitude_m", "distance": "latitude_deg"}, 1e-3,
             {"distance": _distance_km}, glance=(2, "{}")),
        _Row("speed", "speed", "m/s",
             {"over the ground": "speed_mps", "through the air": "airspeed_mps"}, glance=(1, "speed, {}")),
        _Row("path_angle", "angle above the horizon", "deg",
             {"flight path": "flight_path_deg", "body axis": "pitch_deg"}, compute={"flight path": _in_motion},
             glance=(1, "{}")),
        _Row("mach", "Mach number", "", {"Mach number": "mach"}, glance=(1, "{}")),
    ],
    "Air": [
        _Row("pressure", "dynamic pressure", "kPa", {"dynamic pressure": "dynamic_pressure_Pa"}, 1e-3,
             limits=("max_powered_dynamic_pressure_Pa", "max_dynamic_pressure_Pa"), glance=(1, "{}")),
        _Row("incidence", "angle of attack where the dynamic pressure exceeds 1 kPa", "deg",
             {"in pitch": "alpha_deg", "sideslip": "beta_deg", "total": "alpha_total_deg"},
             only=_IN_AIR, limits=("max_alpha_deg",), glance=(3, "angle of attack, {}")),
        _Row("wind", "wind: motion of the air", "m/s",
             {"to north": "wind_N_north_mps", "to east": "wind_N_east_mps", "down": "wind_N_down_mps"}),
        _Row("density", "density", "kg/m3", {"density": "density_kgpm3"}),
    ],
    "Attitude": [
        *(_Row(axis, f"{axis} angle since the start", "deg",
               {f"{axis} commanded": f"{axis}_commanded_deg", f"{axis} by the gyro": f"{axis}_measured_deg"})
          for axis in AXES),
        _Row("error", "attitude error in the computer", "deg", {axis: f"error_{axis}_deg" for axis in AXES},
             limits=("max_attitude_error_deg",), both=True, glance=(3, "error, {}")),
        _Row("rate", "body rates", "deg/s", {axis: f"body_{axis}_rate_degps" for axis in AXES}),
    ],
    "Gimbal": [
        *(_Row(axis, f"{axis} gimbal angle", "deg",
               {f"{axis} command": f"gimbal_{axis}_command_deg", f"{axis} angle": f"gimbal_{axis}_angle_deg"},
               limits=("max_gimbal_deg",), both=True,
               hardware=("angle_limit_deg", axis, "stop of the gimbal"), glance=(2, "gimbal, {}"))
          for axis in PLANES),
        *(_Row(f"{axis}_rate", f"{axis} gimbal rate", "deg/s", {f"{axis} rate": f"gimbal_{axis}_rate_degps"},
               limits=("max_gimbal_rate_degps",), both=True,
               hardware=("rate_limit_degps", axis, "largest rate of the actuator"))
          for axis in PLANES),
    ],
    "Bending": [
        row for axis in PLANES for row in (
            _Row(axis, f"bending at the gimbal, {axis}", "mm",
                 {f"{axis} mode {{}}": f"eta_{axis}_{{}}_m"}, 1e3,
                 limits=("max_bending_m",), both=True, glance=(1, "bending, {}")),
            _Row(f"{axis}_gyro", f"bending rate at the gyro, {axis}", "deg/s",
                 {"all modes": f"bending_{axis}_rate_degps", "mode {}": f"eta_{axis}_{{}}_mps"},
                 compute={"mode {}": _gyro_rate_of_mode}),
        )
    ],
    "Slosh": [
        *(_Row(axis, f"slosh angle, {axis}", "deg", {f"{{}} {axis}": f"slosh_{{}}_{axis}_deg"},
               limits=("max_slosh_deg",), both=True, glance=(99, "slosh {}"))
          for axis in PLANES),
        _Row("rate", "slosh rates", "deg/s", {f"{{}} {axis}": f"slosh_{{}}_{axis}_rate_degps" for axis in PLANES}),
        _Row("force", "force of the slosh pendulums", "kN", {"{}": "slosh_{}_tension_N"}, 1e-3),
    ],
    "Computer": [
        _Row("counts", "gyro pulses in each sample", "counts", {axis: f"counts_{axis}" for axis in AXES}),
        *(_Row(f"filter_{axis}", f"{axis} bending filter", "deg",
               {f"{axis}: in, from the law": f"law_{axis}_deg", f"{axis}: out": f"filtered_{axis}_deg"})
          for axis in PLANES),
        _Row("states", "command at its limit (pitch, yaw), roll thrusters", "",
             {"pitch at limit": "saturated_pitch", "yaw at limit": "saturated_yaw", "roll thrusters": "roll_thruster"}),
    ],
    "Loads": [
        _Row("q_alpha", "q alpha under thrust", "kPa deg", {"q alpha": "q_alpha_Padeg"}, 1e-3, only=_POWERED,
             limits=("max_q_alpha_Padeg",), glance=(1, "q alpha under thrust")),
        _Row("bending", "largest section bending moment", "kN m",
             {"bending moment": "section_1_bending_pitch_Nm"}, 1e-3, {"bending moment": _largest_section},
             only=_POWERED, limits=("max_section_bending_moment_Nm",), glance=(1, "bending moment")),
        _Row("compression", "largest section compression", "kN",
             {"compression": "section_1_axial_N"}, 1e-3, {"compression": _largest_section},
             only=_POWERED, limits=("max_section_compression_N",)),
        _Row("force", "aerodynamic force in body axes", "kN", {a: f"aero_force_B_{a}_N" for a in _XYZ}, 1e-3),
        _Row("moment", "aerodynamic moment about the CG", "kN m", {a: f"aero_moment_B_{a}_Nm" for a in _XYZ}, 1e-3),
        _Row("axial", "axial load", "g",
             {"sensed": "axial_load_g", "thrust over weight": "thrust_over_weight_g"},
             limits=("max_axial_load_g", "max_thrust_over_weight_g"), glance=(1, "axial load, {}")),
        _Row("lateral", "lateral load at the CG", "g", {"sensed": "specific_force_B_y_mps2"}, only=_POWERED,
             compute={"sensed": _lateral}, limits=("max_lateral_load_g",), glance=(1, "lateral load at the CG")),
    ],
    "Vehicle": [
        _Row("thrust", "thrust", "kN", {"thrust": "thrust_N"}, 1e-3, glance=(1, "{}")),
        _Row("mass", "mass", "t", {"all": "mass_kg", "without slosh": "core_mass_kg"}, 1e-3, glance=(1, "mass, {}")),
        _Row("cg", "CG aft of the nose", "m", {"core CG": "cg_station_m"}),
        _Row("inertia", "core inertia", "t m2", {name: f"{name}_kgm2" for name in ("Ixx", "Iyy", "Izz")}, 1e-3),
    ],
}  # fmt: skip  # a table: a plot in each entry


def tabs_of(table: ChannelTable, scenario: Scenario | None, shape: VehicleShape | None = None) -> tuple[Tab, ...]:
    """Return all tabs that the channels of a log can fill.

    They include limits if the scenario is known, and the bending at the gyro if the shape of the vehicle is known.
    """
    if shape is None and scenario is not None:
        shape = shape_of(scenario.vehicle)
    tabs = []
    for name, rows in _TABLE.items():
        plots = tuple(
            ReplayPlot(f"{name.lower()}/{row.key}", row.title, row.unit, curves, _limits(row, scenario), row.glance)
            for row in rows
            if (curves := _curves(row, table, shape))
        )
        if plots:
            tabs.append(Tab(name, plots))
    return tuple(tabs)


def own_tabs(tabs: Sequence[Tab], table: ChannelTable, scenario: Scenario | None) -> list[Tab]:
    """Return `tabs` with only the plots and curves that the channels of another log can fill."""
    own = {plot.key: plot for tab in tabs_of(table, scenario) for plot in tab.plots}
    return [replace(tab, plots=tuple(own[plot.key] for plot in tab.plots if plot.key in own)) for tab in tabs]


def _curves(row: _Row, table: ChannelTable, shape: VehicleShape | None) -> tuple[PlotLine, ...]:
    wild = {label: channel for label, channel in row.curves.items() if "{}" in channel}
    found = [(label, label, channel) for label, channel in row.curves.items() if label not in wild]
    if wild:
        pattern = re.compile(re.escape(next(iter(wild.values()))).replace(r"\{\}", "(.+)"))
        words = [match[1] for name in table.names if (match := pattern.fullmatch(name))]
        found += [
            (label, label.format(propellant_text(w)), channel.format(w))
            for w in words
            for label, channel in wild.items()
        ]
    curves = []
    for plan, label, channel in found:
        compute = row.compute.get(plan)
        if channel not in table or (compute is _gyro_rate_of_mode and shape is None):
            continue
        changed = compute is not None or row.factor != 1.0 or row.only is not None
        curves.append(PlotLine(label, channel, partial(_values, row, channel, compute, shape) if changed else None))
    return tuple(curves)


def _values(
    row: _Row, channel: str, compute: Computed | None, shape: VehicleShape | None, of: Channels
) -> TimesAndValues:
    ns, values = (of.time_ns(channel), row.factor * of[channel]) if compute is None else compute(of, channel, shape)
    name, least = row.only or ("", 0.0)
    if name in of and len(of[name]) == len(values):
        values = np.where(of[name] > least, values, np.nan)
    return ns, values


def _limits(row: _Row, scenario: Scenario | None) -> tuple[Limit, ...]:
    """Return the limits from the requirements of the scenario and from the first actuator of the vehicle."""
    if scenario is None:
        return ()
    out = []
    for r in (r for metric in row.limits for r in scenario.requirement if r.metric == metric):
        name = r.name or r.metric
        if r.limit is not None and math.isfinite(r.limit):
            out.append(Limit(row.factor * r.limit, name))
            if row.both:
                out.append(Limit(-row.factor * r.limit, name, upper=False))
        if r.minimum is not None and not row.both:
            out.append(Limit(row.factor * r.minimum, name, upper=False))
    actuator = next((actuator for stage in scenario.vehicle.stage for actuator in stage.actuators), None)
    if row.hardware is not None and actuator is not None:
        key, axis, label = row.hardware
        value = float(getattr(actuator.axes[PLANES.index(axis)], key))
        out += [Limit(value, label, required=False), Limit(-value, label, upper=False, required=False)]
    return tuple(out)


# -- ranges --------------------------------------------------------------------------------------------------------
def range_of(values: Sequence[Array]) -> tuple[float, float] | None:
    """Return the least and greatest of all finite values, or None if there are none."""
    ends = [(float(some.min()), float(some.max())) for v in values if len(some := v[np.isfinite(v)])]
    return (min(a for a, _ in ends), max(b for _, b in ends)) if ends else None


@dataclass(frozen=True)
class PlotAxis:
    """The range of a plot's y axis, the limits drawn within it, and those beyond it."""

    low: float
    high: float
    drawn: tuple[Limit, ...]
    beyond: tuple[Limit, ...]

    def beyond_text(self, unit: str) -> str:
        """Return a note on the limits that are not drawn, such as `limit 30 deg/s`."""
        sizes = sorted({abs(limit.value) for limit in self.beyond})
        if not sizes:
            return ""
        text = " and ".join(f"{size:g}" for size in sizes) + (f" {unit}" if unit else "")
        return f"limit{'s' * (len(sizes) > 1)} {text}"


def axis_of(plot: ReplayPlot, found: tuple[float, float] | None) -> PlotAxis:
    """Return an axis that shows the data, and each limit that is near enough not to compress the data.

    `found` is the range of the data.
    """
    low, high = found or (0.0, 1.0)
    reach = max(abs(low), abs(high), 1e-12)
    drawn = tuple(limit for limit in plot.limits if abs(limit.value) <= NEAR * reach)
    beyond = tuple(limit for limit in plot.limits if limit not in drawn)
    low, high = min([low, *(x.value for x in drawn)]), max([high, *(x.value for x in drawn)])
    if high - low < 1e-9 * max(abs(high), abs(low), 1e-3):  # a constant
        low, high = (low, 1.0) if high == 0.0 else (low - 0.5 * abs(high), high + 0.5 * abs(high))
    margin = 0.045 * (high - low)
    return PlotAxis(low - margin, high + margin, drawn, beyond)
