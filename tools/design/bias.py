"""The subcommand `simdesign bias SCENARIO`: a pitch and yaw programme that turns the vehicle into a measured wind.

With a programme for still air, the wind adds to the angle of attack. Here, the commanded attitude is turned until the
angle of attack and the sideslip in the measured profile equal those in still air. Alternatively, only a share of the
difference is removed. Flight after flight, the bias theta_b in pitch changes by d; yaw follows with beta reversed:

    theta_b <- theta_b + d,    d = W (e + v / V),    v' = a d + Z (V d - v),    e = alpha_wanted - alpha

The missing angle of attack is e, and the airspeed is V. A vehicle turned by d is pushed off its path by the axial load
a and by the normal force Z V per mass and angle. Its velocity v off the path reduces the effect of the turn by v / V.
The linear model gives a and Z.

The factor W fades with the dynamic pressure: it is 1 from `FULL_FROM` of the largest value upwards, and 0 without
dynamic pressure. Liftoff and the later flight thus keep their attitude. The angle e is averaged over `SMOOTHED_S`,
because a programme can follow the profile, but not slosh or gusts. The profile is flown as measured, without gusts and
turbulence.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design import operating_points
from maxq.sim.files import check_writable, write_whole
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.run.flight import Flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.schema_environment import WindSection
from maxq.tools.cli.frame import Exit
from maxq.tools.cli.terminal import aligned, tell

FULL_FROM = 0.15  # share of the largest dynamic pressure
SMOOTHED_S = 3.0  # width of a raised-cosine window
GRID_S = 0.5
ROUNDS = 4


@dataclass(frozen=True)
class Incidence:
    """The angle of attack, the sideslip and the dynamic pressure along a flight, at `time_s`."""

    time_s: Array
    alpha_rad: Array
    beta_rad: Array
    dynamic_pressure_Pa: Array

    @staticmethod
    def of(flight: Flight, time_s: Array) -> Incidence:
        def at(name: str) -> Array:
            return np.interp(time_s, flight.time_s(name), flight[name])

        return Incidence(time_s, np.radians(at("alpha_deg")), np.radians(at("beta_deg")), at("dynamic_pressure_Pa"))

    @property
    def load_Padeg(self) -> Array:
        """Return the dynamic pressure times the total angle of attack, Pa deg."""
        return self.dynamic_pressure_Pa * np.degrees(np.hypot(self.alpha_rad, self.beta_rad))


@dataclass(frozen=True)
class Biased:
    """A biased programme, its bias over time, and the angles met in still air, in the wind, and in the wind with the
    bias.
    """

    table: CsvTable  # time_s, pitch_rate_degps, yaw_rate_degps
    bias_rad: Array  # (2, times), pitch and yaw
    still: Incidence
    before: Incidence
    after: Incidence


def execute(scenario: str, *, wind: str | None = None, share: float = 1.0, out: str | None = None) -> int:
    """Write the programme of a scenario, biased for its wind, and print its effect. Return the exit code."""
    changes = [] if wind is None else [f"wind.profile={json.dumps(wind)}"]
    loaded = load_scenario(scenario, changes)
    path = Path(out or f"{Path(scenario).stem}-biased.csv")
    check_writable(path.parent)
    found = wind_biased(loaded, share)
    name = loaded.scenario.name or scenario
    profile = loaded.scenario.wind.profile
    of = profile.file if profile is not None and profile.file else "the scenario"
    rows = zip(*(column.tolist() for column in found.table.columns.values()), strict=True)
    lines = [f"# Programme of {name}, biased by simdesign for the wind of {of}", ",".join(found.table.columns)]
    lines += [",".join(f"{x:.9g}" for x in row) for row in rows]
    write_whole(path, "\n".join(lines) + "\n")
    largest = np.degrees(np.abs(found.bias_rad).max(axis=1))
    loads = [each.load_Padeg for each in (found.still, found.before, found.after)]
    table = [
        ("", "still air", "in the wind", "biased"),
        ("largest q alpha, Pa deg", *(f"{x.max():.0f}" for x in loads)),
    ]
    table.append(("rms of q alpha, Pa deg", *(f"{math.sqrt(float(np.mean(x**2))):.0f}" for x in loads)))
    tell(
        *aligned(table, "  ", right=(1, 2, 3)), f"bias up to {largest[0]:.2f} deg in pitch, {largest[1]:.2f} deg in yaw"
    )
    tell(path, "fly it with:", f"  simrun {scenario} --set guidance.programme={path}")
    return Exit.OK


def wind_biased(loaded: LoadedScenario, share: float = 1.0) -> Biased:
    """Return the scenario's programme with a bias for its wind.

    `share` is the share of the wind's contribution that is removed, 0 to 1. Raises ScenarioError if there is no wind,
    no programme, or a programme to which a bias in pitch and yaw cannot be added.
    """
    scenario, programme = loaded.scenario, loaded.scenario.guidance.programme
    wind = scenario.wind.model_copy(update={"gust": (), "turbulence": None})
    if wind == WindSection() or (wind.profile is None and not wind.speed_mps):
        raise ScenarioError(loaded.label, "there is no wind to bias for", "wind", allowed="a profile, or --wind FILE")
    if programme is None:
        raise ScenarioError(loaded.label, "there is no programme to bias", "guidance.programme", allowed="a table")
    if scenario.guidance.method != "linear" and len(programme) > 1:
        raise ScenarioError(
            loaded.label,
            "a bias is linear between rows",
            "guidance.method",
            value=scenario.guidance.method,
            allowed="linear",
        )
    if programme.get("roll_rate_degps").any():
        raise ScenarioError(
            loaded.label,
            "pitch and yaw change places when the vehicle rolls",
            "guidance.programme",
            allowed="a programme that commands no roll",
        )

    def flown(air: WindSection, table: CsvTable, end_s: float) -> Flight:
        guidance = scenario.guidance.model_copy(update={"programme": table})
        run = scenario.run.model_copy(update={"duration_s": min(scenario.run.duration_s, end_s)})
        changed = scenario.model_copy(
            update={"wind": air, "guidance": guidance, "run": run, "requirement": (), "fault": ()}
        )
        return fly(LoadedScenario(changed, loaded.label, ()))

    calm = flown(WindSection(), programme, math.inf)
    pressure, at = calm["dynamic_pressure_Pa"], calm.time_s("dynamic_pressure_Pa")
    powered = at <= max((e.time_s for e in calm.events if e.name == "burnout"), default=calm.end_s)
    pressure, at = pressure[powered], at[powered]
    low = np.flatnonzero((pressure < 0.01 * pressure.max()) & (at > at[np.argmax(pressure)]))
    end_s = float(at[low[0]]) if len(low) else float(at[-1])
    time_s = np.arange(scenario.run.start_s, end_s + GRID_S, GRID_S).clip(max=end_s)
    time_s = np.unique(np.concatenate([time_s, [t for t in programme["time_s"] if time_s[0] < t < time_s[-1]]]))
    after_s = [t for t in programme["time_s"] if t > time_s[-1]]
    still, path = Incidence.of(calm, time_s), _path(loaded, calm, time_s)
    strength = np.clip(still.dynamic_pressure_Pa / still.dynamic_pressure_Pa.max() / FULL_FROM, 0.0, 1.0)
    fade = strength * strength * (3.0 - 2.0 * strength)  # from 0 to 1 with continuous slope
    before = Incidence.of(flown(wind, programme, end_s), time_s)
    wanted = [
        share * a + (1.0 - share) * b
        for a, b in ((still.alpha_rad, before.alpha_rad), (still.beta_rad, before.beta_rad))
    ]
    bias, now, made = np.zeros((2, len(time_s))), before, None
    for _ in range(ROUNDS):
        left = np.stack([wanted[0] - now.alpha_rad, now.beta_rad - wanted[1]])
        bias = bias + np.stack([_turned(time_s, fade, path, _smoothed(time_s, each)) for each in left])
        made = _programme(programme, time_s, after_s, bias)
        now = Incidence.of(flown(wind, made, end_s), time_s)
    assert made is not None
    return Biased(made, bias, still, before, now)


def _path(loaded: LoadedScenario, calm: Flight, time_s: Array) -> Array:
    """Return over time the airspeed (m/s), the axial load (m/s2), and the lateral force per mass and speed (1/s).

    The array is (3, times). Load and force are those of the linear model in still air.
    """
    air = loaded.scenario.model_copy(update={"wind": WindSection(), "fault": (), "requirement": ()})
    nodes = operating_points.nodes(LoadedScenario(air, loaded.label, ()))
    at = [node.time_s for node in nodes]
    w = [node.plant.states.index("w_mps") for node in nodes]
    rows = (
        [node.axial_load_mps2 for node in nodes],
        [-float(node.plant.a[k, k]) for node, k in zip(nodes, w, strict=True)],
    )
    speed = np.interp(time_s, calm.time_s("airspeed_mps"), calm["airspeed_mps"])
    return np.stack([np.maximum(speed, 1.0), *(np.interp(time_s, at, row) for row in rows)])


def _turned(time_s: Array, fade: Array, path: Array, lacks_rad: Array) -> Array:
    """Return the turn d that gives the missing angle of attack, including the change of the path, by Heun's method.

    `path` is that of `_path`, `lacks_rad` the missing angle. All are over `time_s`.
    """
    turned, across = np.zeros(len(time_s)), 0.0

    def turn(k: int, v: float) -> tuple[float, float]:
        speed, load, damping = path[:, k]
        d = float(fade[k] * (lacks_rad[k] + v / speed))
        return d, float(load * d + damping * (speed * d - v))

    for k in range(len(time_s)):
        turned[k], rate = turn(k, across)
        if k + 1 < len(time_s):
            step = float(time_s[k + 1] - time_s[k])
            across += 0.5 * step * (rate + turn(k + 1, across + step * rate)[1])
    return turned


def _smoothed(time_s: Array, values: Array) -> Array:
    """Return the running mean of values over `SMOOTHED_S`, weighted by a raised cosine."""
    apart = np.abs(time_s[:, None] - time_s[None]) / (0.5 * SMOOTHED_S)
    weight = np.where(apart < 1.0, 1.0 + np.cos(np.pi * apart), 0.0) * np.gradient(time_s)[None]
    return np.asarray(weight @ values / weight.sum(axis=1))


def _programme(old: CsvTable, time_s: Array, after_s: Sequence[float], bias_rad: Array) -> CsvTable:
    """Return the programme with the rates of the bias added. The bias is constant after the last of `time_s`.

    `after_s` are the later times of the old programme.
    """
    rates = np.degrees(np.gradient(bias_rad, time_s, axis=1))
    rates[:, -1] = 0.0
    times = np.concatenate([time_s, after_s])
    columns = {"time_s": times}
    for name, more in zip(("pitch_rate_degps", "yaw_rate_degps"), rates, strict=True):
        own = np.interp(times, old["time_s"], old.get(name))
        columns[name] = own + np.concatenate([more, np.zeros(len(after_s))])
    return CsvTable("", columns)
