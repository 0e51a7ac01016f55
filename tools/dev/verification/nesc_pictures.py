"""The pictures of the NESC check cases in docs/pictures/verification: maxq and NASA, and differences over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from maxq.sim.run.flight import Flight
from maxq.tools.dev.verification.nesc_cases import (
    ATMOSPHERIC,
    DATA,
    ORBITS_WITH_DRAG,
    atmospheric_errors,
    orbit_errors,
    read_columns,
)
from maxq.tools.dev.verification.nesc_units import in_nesc_units
from maxq.tools.plots.palette import BLACK, BLUE, GREEN, ORANGE, RED
from maxq.tools.plots.style import label, save, sheet

PICTURES = Path(__file__).resolve().parents[3] / "docs" / "pictures" / "verification"
SHOWN = {
    "02": ("case 02, body rates", "deg/s", "bodyAngularRateWrtEi_deg_s_", ("Roll", "Pitch", "Yaw")),
    "09": ("case 09, velocity north, east, down", "ft/s", "feVelocity_ft_s_", ("X", "Y", "Z")),
}
"""The title, the unit, and the common name of the variables with its endings, by case."""


def draw(flights: Mapping[str, Flight]) -> list[Path]:
    """Draw both pictures, and return the paths of the files. `flights` are by the name of their scenario."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    return [*histories(flights, PICTURES / "nesc-histories"), *differences(flights, PICTURES / "nesc-differences")]


def histories(flights: Mapping[str, Flight], stem: Path) -> list[Path]:
    """Plot two check cases, maxq as lines and NASA as dots every second. Return the paths of the files."""
    figure, places = sheet(1, 2, height_in=2.3)
    for place, (case, (title, unit, name, endings)) in zip(places, SHOWN.items(), strict=True):
        columns, flight = read_columns(DATA / f"nesc-{case}.csv.gz"), flights[f"nesc-{case}"]
        time = np.array(columns["time"], float)
        for ending, colour in zip(endings, (BLUE, ORANGE, GREEN), strict=True):
            ours, theirs = in_nesc_units(flight, name + ending), np.array(columns[name + ending], float)
            place.plot(flight.time_s("r_I_x_m"), ours, color=colour, label=ending)
            place.plot(time[::10], theirs[::10], ".", color=BLACK, markersize=2.5)
        label(place, "time, s", unit, title)
        place.legend(loc="upper right" if case == "09" else "lower left", ncols=3)
        low, high = place.get_ylim()
        place.set_ylim(low - 0.2 * (high - low), high + 0.2 * (high - low))
    return save(figure, stem)


def differences(flights: Mapping[str, Flight], stem: Path) -> list[Path]:
    """Draw the largest difference / tolerance over time, and the distance in orbit. Return the paths of the files."""
    figure, places = sheet(1, 2, height_in=2.3)
    for case in ATMOSPHERIC:
        every = atmospheric_errors(case, flights[f"nesc-{case}"])
        ratio = np.max([e.error / e.tolerance for e in every], axis=0)
        places[0].plot(every[0].time_s, ratio, linewidth=0.9, label=case)
    places[0].axhline(1.0, color=RED, linewidth=0.9)
    places[0].set_ylim(0.0, 1.1)
    places[0].legend(ncols=4, loc="upper center", bbox_to_anchor=(0.5, 0.9))
    label(places[0], "time, s", "difference / tolerance", "cases 01 to 09: worst of 32 variables")
    for (simulation, (scenario, limit)), colour in zip(ORBITS_WITH_DRAG.items(), (BLUE, ORANGE, GREEN), strict=True):
        found = orbit_errors(simulation, flights[scenario])
        some = found.error > 0.0
        places[1].plot(found.time_s[some] / 3600.0, found.error[some], color=colour, label=f"SIM {simulation}")
        places[1].axhline(limit, color=colour, linewidth=0.7, linestyle="--")
    places[1].set_yscale("log")
    places[1].legend()
    label(places[1], "time, h", "distance, m", "exo 6A: eight hours (dashed: allowed)")
    return save(figure, stem)
