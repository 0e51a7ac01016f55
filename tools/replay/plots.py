"""What is plotted: one table for the viewer and for paper, with units and limits, sorted into tabs by subject."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import ChannelTable
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.tools.replay.bent_body import shapes_at
from maxq.tools.replay.flight import Channels
from maxq.tools.replay.limits import Limit, hardware, required
from maxq.tools.replay.vehicle_shape import VehicleShape, shape_of

STANDARD_GRAVITY_MPS2 = 9.80665
Values = tuple[IntArray, Array]


@dataclass(frozen=True)
class Curve:
    """A line of a plot: a channel times a factor, or something computed from several (`compute`)."""

    label: str
    channel: str
    factor: float = 1.0
    compute: Callable[[Channels], Values] | None = None

    def values(self, channels: Channels) -> Values:
        """Times (n,) in ns and values (n,) in the plot's unit."""
        if self.compute is not None:
            return self.compute(channels)
        values = channels[self.channel]
        return channels.time_ns(self.channel), values if self.factor == 1.0 else values * self.factor


@dataclass(frozen=True)
class Plot:
    """`key` is its place below `plots/`, made of lower-case words; `unit` is "" for a bare number."""

    key: str
    title: str
    unit: str
    curves: tuple[Curve, ...]
    limits: tuple[Limit, ...] = ()

    @property
    def heading(self) -> str:
        return f"{self.title} ({self.unit})" if self.unit else self.title


@dataclass(frozen=True)
class Tab:
    name: str
    plots: tuple[Plot, ...]


def tabs_of(table: ChannelTable, scenario: Scenario | None, shape: VehicleShape | None = None) -> tuple[Tab, ...]:
    """All tabs that the channels of a log can fill."""
    if shape is None and scenario is not None:
        shape = shape_of(scenario.vehicle)
    made = (
        _trajectory(),
        _air(scenario),
        _attitude(scenario),
        _gimbal(scenario),
        _bending(table, scenario, shape),
        _slosh(table, scenario),
        _computer(),
        _loads(scenario),
        _vehicle(),
    )
    out = []
    for tab in made:
        plots = [_present(plot, table) for plot in tab.plots]
        kept = tuple(plot for plot in plots if plot is not None)
        if kept:
            out.append(Tab(tab.name, kept))
    return tuple(out)


def _present(plot: Plot, table: ChannelTable) -> Plot | None:
    curves = tuple(curve for curve in plot.curves if curve.channel in table)
    return Plot(plot.key, plot.title, plot.unit, curves, plot.limits) if curves else None


def _plot(key: str, title: str, unit: str, *curves: Curve, limits: list[Limit] | None = None) -> Plot:
    return Plot(key, title, unit, curves, tuple(limits or ()))


def _trajectory() -> Tab:
    return Tab(
        "Trajectory",
        (
            _plot(
                "trajectory/altitude", "altitude and distance from the site", "km",
                Curve("altitude", "altitude_m", 1e-3),
                Curve("distance along the ground", "latitude_deg", compute=_distance_km),
            ),
            _plot(
                "trajectory/speed", "speed", "m/s",
                Curve("over the ground", "speed_mps"), Curve("through the air", "airspeed_mps"),
            ),
            _plot("trajectory/path_angle", "flight path and pitch above the horizon", "deg",
                Curve("flight path", "flight_path_deg"), Curve("body axis", "pitch_deg")),
            _plot("trajectory/mach", "Mach number", "", Curve("Mach number", "mach")),
        ),
    )  # fmt: skip


def _air(scenario: Scenario | None) -> Tab:
    return Tab(
        "Air",
        (
            _plot(
                "air/pressure", "dynamic pressure", "kPa", Curve("dynamic pressure", "dynamic_pressure_Pa", 1e-3),
                limits=required(scenario, "max_powered_dynamic_pressure_Pa", 1e-3)
                + required(scenario, "max_dynamic_pressure_Pa", 1e-3),
            ),
            _plot(
                "air/incidence", "incidence where the dynamic pressure exceeds 1 kPa", "deg",
                Curve("attack", "alpha_deg", compute=_in_air("alpha_deg")),
                Curve("sideslip", "beta_deg", compute=_in_air("beta_deg")),
                Curve("total", "alpha_total_deg", compute=_in_air("alpha_total_deg")),
                limits=required(scenario, "max_alpha_deg"),
            ),
            _plot(
                "air/wind", "wind: motion of the air", "m/s",
                Curve("to north", "wind_N_north_mps"), Curve("to east", "wind_N_east_mps"),
                Curve("down", "wind_N_down_mps"),
            ),
            _plot("air/density", "density", "kg/m3", Curve("density", "density_kgpm3")),
        ),
    )  # fmt: skip


def _attitude(scenario: Scenario | None) -> Tab:
    limits = required(scenario, "max_attitude_error_deg", both=True)
    axes = ("pitch", "yaw", "roll")
    return Tab(
        "Attitude",
        (
            *(
                _plot(
                    f"attitude/{axis}", f"{axis}: turned since the start", "deg",
                    Curve(f"{axis} commanded", f"{axis}_commanded_deg"),
                    Curve(f"{axis} by the gyro", f"{axis}_measured_deg"),
                )
                for axis in axes
            ),
            _plot(
                "attitude/error", "attitude error in the computer", "deg",
                *(Curve(axis, f"error_{axis}_deg") for axis in axes), limits=limits,
            ),
            _plot(
                "attitude/rate", "body rates", "deg/s",
                *(Curve(axis, f"body_{axis}_rate_degps") for axis in axes),
            ),
        ),
    )  # fmt: skip


def _gimbal(scenario: Scenario | None) -> Tab:
    angle = required(scenario, "max_gimbal_deg", both=True)
    rate = required(scenario, "max_gimbal_rate_degps", both=True)
    return Tab(
        "Gimbal",
        (
            *(
                _plot(
                    f"gimbal/{axis}", f"{axis} gimbal", "deg",
                    Curve(f"{axis} command", f"gimbal_{axis}_command_deg"),
                    Curve(f"{axis} engine", f"gimbal_{axis}_angle_deg"),
                    limits=angle + hardware(scenario, "angle_limit_deg", i, "stop of the gimbal"),
                )
                for i, axis in enumerate(("pitch", "yaw"))
            ),
            *(
                _plot(
                    f"gimbal/{axis}_rate", f"{axis} gimbal rate", "deg/s",
                    Curve(f"{axis} engine rate", f"gimbal_{axis}_rate_degps"),
                    limits=rate + hardware(scenario, "rate_limit_degps", i, "most that the actuator does"),
                )
                for i, axis in enumerate(("pitch", "yaw"))
            ),
        ),
    )  # fmt: skip


def _bending(table: ChannelTable, scenario: Scenario | None, shape: VehicleShape | None) -> Tab:
    plots = []
    for axis in ("pitch", "yaw"):
        modes = [i for i in range(1, 9) if f"eta_{axis}_{i}_m" in table]
        plots.append(
            _plot(
                f"bending/{axis}", f"{axis} bending: motion of the gimbal by modes", "mm",
                *(Curve(f"{axis} mode {i}", f"eta_{axis}_{i}_m", 1e3) for i in modes),
                limits=required(scenario, "max_bending_m", 1e3, both=True),
            )
        )  # fmt: skip
        by_mode = [Curve(f"mode {i}", f"eta_{axis}_{i}_mps", compute=_pick_up(shape, axis, i)) for i in modes]
        plots.append(
            _plot(
                f"bending/{axis}_gyro", f"{axis} rate that the gyro picks up from bending", "deg/s",
                Curve("all modes", f"bending_{axis}_rate_degps"),
                *(by_mode if shape is not None else ()),
            )
        )  # fmt: skip
    return Tab("Bending", tuple(plots))


def _slosh(table: ChannelTable, scenario: Scenario | None) -> Tab:
    tanks = tank_names(table)
    limits = required(scenario, "max_slosh_deg", both=True)
    return Tab(
        "Slosh",
        (
            *(
                _plot(
                    f"slosh/{axis}", f"slosh pendulums, {axis} plane", "deg",
                    *(Curve(f"{tank} {axis}", f"slosh_{tank}_{axis}_deg") for tank in tanks), limits=limits,
                )
                for axis in ("pitch", "yaw")
            ),
            _plot(
                "slosh/rate", "slosh rates", "deg/s",
                *(Curve(f"{tank} {axis}", f"slosh_{tank}_{axis}_rate_degps")
                  for tank in tanks for axis in ("pitch", "yaw")),
            ),
            _plot("slosh/force", "force of the pendulums' rods", "kN",
                *(Curve(tank, f"slosh_{tank}_tension_N", 1e-3) for tank in tanks)),
        ),
    )  # fmt: skip


def _computer() -> Tab:
    return Tab(
        "Computer",
        (
            _plot(
                "computer/counts", "V/F pulses in each sample", "counts",
                *(Curve(axis, f"counts_{axis}") for axis in ("pitch", "yaw", "roll")),
            ),
            *(
                _plot(
                    f"computer/filter_{axis}", f"{axis} bending filter", "deg",
                    Curve(f"{axis}: in, from the PD law", f"law_{axis}_deg"),
                    Curve(f"{axis}: out", f"filtered_{axis}_deg"),
                )
                for axis in ("pitch", "yaw")
            ),
            _plot(
                "computer/states", "command at its limit (pitch, yaw), roll thrusters", "",
                Curve("pitch at limit", "saturated_pitch"), Curve("yaw at limit", "saturated_yaw"),
                Curve("roll thrusters", "roll_thruster"),
            ),
        ),
    )  # fmt: skip


def _loads(scenario: Scenario | None) -> Tab:
    return Tab(
        "Loads",
        (
            _plot(
                "loads/q_alpha", "q alpha under thrust", "kPa deg",
                Curve("q alpha", "q_alpha_Padeg", compute=_powered("q_alpha_Padeg", 1e-3)),
                limits=required(scenario, "max_q_alpha_Padeg", 1e-3),
            ),
            _plot(
                "loads/force", "aerodynamic force in body axes", "kN",
                *(Curve(a, f"aero_force_B_{a}_N", 1e-3) for a in "xyz"),
            ),
            _plot(
                "loads/moment", "aerodynamic moment about the CG", "kN m",
                *(Curve(a, f"aero_moment_B_{a}_Nm", 1e-3) for a in "xyz"),
            ),
            _plot(
                "loads/axial", "axial load", "g", Curve("sensed", "axial_load_g"),
                Curve("thrust over weight", "thrust_over_weight_g"),
                limits=required(scenario, "max_axial_load_g")
                + required(scenario, "max_thrust_over_weight_g"),
            ),
            _plot(
                "loads/lateral", "lateral load at the CG", "g",
                Curve("sensed", "specific_force_B_y_mps2", compute=_lateral),
                limits=required(scenario, "max_lateral_load_g"),
            ),
        ),
    )  # fmt: skip


def _vehicle() -> Tab:
    return Tab(
        "Vehicle",
        (
            _plot("vehicle/thrust", "thrust", "kN", Curve("thrust", "thrust_N", 1e-3)),
            _plot("vehicle/mass", "mass", "t",
                Curve("all", "mass_kg", 1e-3), Curve("without slosh", "core_mass_kg", 1e-3)),
            _plot("vehicle/cg", "CG aft of the nose", "m", Curve("core CG", "cg_station_m")),
            _plot(
                "vehicle/inertia", "core inertia", "t m2",
                *(Curve(name, f"{name}_kgm2", 1e-3) for name in ("Ixx", "Iyy", "Izz")),
            ),
        ),
    )  # fmt: skip


def tank_names(table: ChannelTable) -> list[str]:
    """Names of the tanks that a log has channels of."""
    return [
        c.name.removeprefix("slosh_").removesuffix("_tension_N")
        for topic in table.topics
        for c in topic.channels
        if c.name.startswith("slosh_") and c.name.endswith("_tension_N")
    ]


# -- computed curves -----------------------------------------------------------------------------------------------
def _in_air(name: str) -> Callable[[Channels], Values]:
    """Incidence means nothing on the pad and above the air: there it is a gap."""

    def compute(channels: Channels) -> Values:
        values = channels[name]
        if "dynamic_pressure_Pa" in channels:
            values = np.where(channels["dynamic_pressure_Pa"] > 1000.0, values, np.nan)
        return channels.time_ns(name), values

    return compute


def _powered(name: str, factor: float) -> Callable[[Channels], Values]:
    """Loads are judged under thrust; a tumbling re-entry would hide them."""

    def compute(channels: Channels) -> Values:
        values = factor * channels[name]
        if "thrust_N" in channels and len(channels["thrust_N"]) == len(values):
            values = np.where(channels["thrust_N"] > 0.0, values, np.nan)
        return channels.time_ns(name), values

    return compute


def _lateral(channels: Channels) -> Values:
    lateral = np.hypot(channels["specific_force_B_y_mps2"], channels["specific_force_B_z_mps2"]) / STANDARD_GRAVITY_MPS2
    if "thrust_N" in channels and len(channels["thrust_N"]) == len(lateral):
        lateral = np.where(channels["thrust_N"] > 0.0, lateral, np.nan)
    return channels.time_ns("specific_force_B_y_mps2"), lateral


def _pick_up(shape: VehicleShape | None, axis: str, mode: int) -> Callable[[Channels], Values]:
    """Turning rate at the gyro by one mode: its slope there times the modal rate."""

    def compute(channels: Channels) -> Values:
        name = f"eta_{axis}_{mode}_mps"
        ns, rate = channels.time_ns(name), channels[name]
        assert shape is not None
        stage = shape.stages[0]
        table = stage.modes[0 if axis == "pitch" else 1]
        if table is None or stage.gyro_station_m is None or mode > table.modes or not len(ns):
            return ns, np.full(len(rate), np.nan)
        # the mode changes slowly: its slope at every 0.1 s, joined by lines
        coarse = np.linspace(ns[0] / 1e9, ns[-1] / 1e9, max(2, int((ns[-1] - ns[0]) / 1e8)))
        slopes = shapes_at(table, coarse * stage.clock_factor, np.array([stage.gyro_station_m]), "slope_pm")
        slope = np.interp(ns / 1e9, coarse, slopes[:, mode - 1, 0])
        sign = 1.0 if axis == "pitch" else -1.0  # docs/model.md: yaw modes turn by minus their slope
        return ns, np.degrees(sign * slope * rate)

    return compute


def _distance_km(channels: Channels) -> Values:
    """Great circle from the first point, good to half a percent."""
    ns = channels.time_ns("latitude_deg")
    first = _first_place(channels)
    lat, lon = np.radians(channels["latitude_deg"]), np.radians(channels["longitude_deg"])
    haversine = (
        np.sin(0.5 * (lat - first[0])) ** 2 + np.cos(lat) * np.cos(first[0]) * np.sin(0.5 * (lon - first[1])) ** 2
    )
    return ns, 2.0 * 6371.0 * np.arcsin(np.sqrt(np.clip(haversine, 0.0, 1.0)))


def _first_place(channels: Channels) -> tuple[float, float]:
    """Where the flight began; blocks of a flight under way bring it along."""
    start = getattr(channels, "start_place_deg", None)
    if start is None:
        start = float(channels["latitude_deg"][0]), float(channels["longitude_deg"][0])
    return float(np.radians(start[0])), float(np.radians(start[1]))
