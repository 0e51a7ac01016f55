"""One picture that shows a flight at a glance: `python -m maxq.tools.dev.pictures.overview SCENARIO FILE.png`.

README.md opens with that of the nominal scenario.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from maxq.sim.run.fly import Flight, fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.plots.palette import BLUE, GREEN, GREY, ORANGE, RED

EARTH_RADIUS_KM = 6371.0
FIRST_S = 0.5  # before it incidence is that of rounding errors
Curve = tuple[str, str, str, float]  # channel, label, colour, factor


def _downrange_km(flight: Flight) -> np.ndarray:
    """Great-circle distance from the first point, km: good to half a percent, enough to look at."""
    latitude, longitude = (np.radians(flight[c]) for c in ("latitude_deg", "longitude_deg"))
    cosine = np.sin(latitude) * np.sin(latitude[0]) + np.cos(latitude) * np.cos(latitude[0]) * np.cos(
        longitude - longitude[0]
    )
    return np.asarray(EARTH_RADIUS_KM * np.arccos(np.clip(cosine, -1.0, 1.0)))


def _trajectory(flight: Flight, place: Axes) -> None:
    along, up = _downrange_km(flight), flight["altitude_m"] / 1000.0
    time_s = flight.time_s("altitude_m")
    burning = time_s <= flight.event_s("burnout")
    place.plot(along[~burning], up[~burning], color=BLUE, linewidth=1.6, label="coast")
    place.plot(along[burning], up[burning], color=RED, linewidth=2.4, label="under thrust")
    for name in ("burnout", "apogee", "impact"):
        k = int(np.searchsorted(time_s, flight.event_s(name))) - 1
        place.plot(along[k], up[k], "o", color=GREY, markersize=4)
        beside = (-68, 8) if name == "impact" else (6, 6)
        place.annotate(f"{name} {time_s[k]:.0f} s", (along[k], up[k]), beside, textcoords="offset points", fontsize=8)
    place.set(xlabel="downrange, km", ylabel="altitude, km", title="trajectory")
    place.set_ylim(0.0, 1.15 * up.max())
    place.legend(fontsize=8, loc="lower center")


def _curves(flight: Flight, place: Axes, curves: Sequence[Curve], to_s: float, title: str, unit: str) -> None:
    for channel, label, colour, factor in curves:
        time_s = flight.time_s(channel)
        seen = (time_s >= FIRST_S) & (time_s <= to_s)
        place.plot(time_s[seen], factor * flight[channel][seen], color=colour, linewidth=1.0, label=label)
    place.set(xlabel="time, s", ylabel=unit, title=title)
    place.legend(fontsize=8)


def overview(flight: Flight, path: Path) -> None:
    """Draw trajectory, air data, steering, bending, slosh and computer of a powered flight."""
    end_s = flight.event_s("burnout")
    figure, axes = plt.subplots(2, 3, figsize=(13, 6.5))
    _trajectory(flight, axes[0, 0])
    air = (("dynamic_pressure_Pa", "dynamic pressure, kPa", BLUE, 1e-3), ("mach", "Mach number x 10", ORANGE, 10.0))
    _curves(flight, axes[0, 1], air, np.inf, "air", "")
    steering = (
        ("error_pitch_deg", "attitude error", BLUE, 1.0),
        ("gimbal_pitch_angle_deg", "gimbal", RED, 1.0),
        ("alpha_deg", "incidence", GREEN, 1.0),
    )
    _curves(flight, axes[0, 2], steering, end_s, "steering in pitch", "deg")
    axes[0, 2].set_ylim(-6.0, 6.0)
    modes = [(f"eta_pitch_{i}_m", f"mode {i}", c, 1e6) for i, c in ((1, BLUE), (2, ORANGE), (3, GREEN))]
    _curves(flight, axes[1, 0], modes, end_s, "bending at the gimbal", "micrometres")
    slosh = (("slosh_lox_pitch_deg", "LOX", BLUE, 1.0), ("slosh_jeta1_pitch_deg", "Jet A-1", ORANGE, 1.0))
    _curves(flight, axes[1, 1], slosh, end_s, "slosh pendulums in pitch", "deg")
    computer = (("law_yaw_deg", "PD law", GREY, 1.0), ("gimbal_yaw_angle_deg", "gimbal", RED, 1.0))
    _curves(flight, axes[1, 2], computer, end_s, "yaw: pulses of the gyro and the engine", "deg")
    for place in axes.flat:
        place.grid(alpha=0.3, linewidth=0.5)
        place.title.set_fontsize(10)
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("file", type=Path)
    given = parser.parse_args()
    overview(fly(load_scenario(given.scenario)), given.file)


if __name__ == "__main__":
    main()
