"""Table 2 of Lee, Ahn & Roh from the flown nominal trajectory.

    python -m maxq.tools.dev.documents.derivatives_table [FILE]

flies `nominal` and computes the stability derivatives (eqs 4 to 8) along its path from 5 s to 55 s. It writes them with
the paper's ranges into FILE (default: docs/flights/nominal-derivatives.md) and to the terminal.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.held import FlightCondition, hold_stage
from maxq.design.model.vehicle_at import StabilityDerivatives, stability_derivatives
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.flight import Flight
from maxq.sim.run.fly import fly
from maxq.sim.run.quantities import number_text
from maxq.sim.scenario.loader import load_scenario

SCENARIO = "nominal"
FIRST_S, LAST_S, EVERY_S, NODE_EVERY = 5.0, 55.0, 0.5, 20
DEFAULT_FILE = Path(__file__).resolve().parents[3] / "docs" / "flights" / "nominal-derivatives.md"

COLUMNS = {  # name, unit, meaning
    "z_alpha_1ps": ("Z_alpha", "1/s", "normal acceleration by angle of attack, over airspeed"),
    "m_alpha_1ps2": ("M_alpha", "1/s2", "pitch acceleration by angle of attack"),
    "z_delta_1ps": ("Z_delta", "1/s", "normal acceleration by gimbal angle, over airspeed"),
    "m_delta_1ps2": ("M_delta", "1/s2", "pitch acceleration by gimbal angle"),
    "m_q_1ps": ("M_q", "1/s", "pitch acceleration by pitch rate"),
}
PAPER = {  # Table 2: minimum and maximum
    "z_alpha_1ps": (-0.55, -0.1),
    "m_alpha_1ps2": (-40.0, -1.0),
    "z_delta_1ps": (0.05, 0.38),
    "m_delta_1ps2": (8.1, 15.5),
}


def flown_derivatives(flight: Flight, times_s: Array) -> list[StabilityDerivatives]:
    """Return the derivatives along a flight at its speed, air and Mach number, with frozen liquids."""
    packed = pack_flight(flight.scenario.scenario)
    names = ("airspeed_mps", "density_kgpm3", "pressure_Pa", "mach", "pitch_deg")
    clock = flight.time_s("airspeed_mps")
    at = {name: np.interp(times_s, clock, flight[name]) for name in names}
    out = []
    for k, time_s in enumerate(times_s):
        condition = FlightCondition(
            time_s=float(time_s),
            airspeed_mps=float(at["airspeed_mps"][k]),
            density_kgpm3=float(at["density_kgpm3"][k]),
            pressure_Pa=float(at["pressure_Pa"][k]),
            mach=float(at["mach"][k]),
            pitch_rad=float(np.radians(at["pitch_deg"][k])),
            gravity_mps2=9.80665,  # no derivative depends on it
        )
        held = hold_stage(packed, condition.time_s)
        out.append(stability_derivatives(held, condition, (0.0, 0.0), "pitch", [[(0, 1.0)]]))
    return out


def table_text(times_s: Array, values: Array) -> str:
    """Return the page. `values` is (times, 5), in the order of COLUMNS."""
    names = [f"{name}, {unit}" for name, unit, _ in COLUMNS.values()]
    lines = [
        "# Stability derivatives of the nominal flight",
        "",
        "<!-- Written by `python -m maxq.tools.dev.documents.derivatives_table`: run it again, do not edit. -->",
        "",
        "Lee, Ahn & Roh, eqs 4 to 8, along the trajectory of `nominal`, with speed, air and Mach number as flown.",
        "Mass, CG and inertia are those of the whole vehicle with frozen liquid, as in the paper. The aerodynamics of",
        "the reconstructed vehicle were fitted to the ends of the paper's ranges of Z_alpha and M_alpha",
        "(`scenarios/vehicles/ksr3/NOTES.md`), so their agreement is no independent evidence. The paper gives no M_q.",
        "",
        f"## Ranges from {FIRST_S:g} s to {LAST_S:g} s",
        "",
        "| derivative | unit | meaning | flown range | at times, s | range in Table 2 |",
        "|---|---|---|---|---|---|",
    ]
    for k, (key, about) in enumerate(COLUMNS.items()):
        ends = [int(find(values[:, k])) for find in (np.argmin, np.argmax)]
        flown = " to ".join(number_text(values[end, k], 3) for end in ends)
        at_s = " and ".join(f"{times_s[end]:g}" for end in ends)
        paper = "{:g} to {:g}".format(*PAPER[key]) if key in PAPER else "not given"
        lines.append("| " + " | ".join([*about, flown, at_s, paper]) + " |")
    lines += [
        "",
        f"Z_alpha, M_alpha and Z_delta reach the ends of the paper's ranges within {100.0 * _farthest(values):.1f} %.",
        "M_delta spans less than its range: with the thrust and mass of Table 1, no plausible arrangement of masses",
        "reaches the ends.",
        "",
        "## At every second operating point of the paper",
        "",
        "| time, s | " + " | ".join(names) + " |",
        "|---" * (1 + len(names)) + "|",
    ]
    for time_s, row in zip(times_s[::NODE_EVERY], values[::NODE_EVERY], strict=True):
        lines.append(f"| {time_s:g} | " + " | ".join(number_text(x) for x in row) + " |")
    return "\n".join(lines) + "\n"


def _farthest(values: Array) -> float:
    """Return the largest relative difference of the flown extremes from those of the paper, without M_delta."""
    flown = {key: (values[:, k].min(), values[:, k].max()) for k, key in enumerate(COLUMNS)}
    return max(
        abs(float(ours) / theirs - 1.0)
        for key, ends in PAPER.items()
        if key != "m_delta_1ps2"
        for ours, theirs in zip(flown[key], ends, strict=True)
    )


def main(arguments: list[str] | None = None) -> int:
    """Fly the scenario, and write and print the page. The exit code is 2 for unknown arguments."""
    given = sys.argv[1:] if arguments is None else arguments
    if len(given) > 1 or any(item.startswith("-") for item in given):
        print((__doc__ or "").strip(), file=sys.stderr)
        return 2
    file = Path(given[0]) if given else DEFAULT_FILE
    times_s = np.arange(FIRST_S, LAST_S + 0.5 * EVERY_S, EVERY_S)
    flight = fly(load_scenario(SCENARIO, [f"run.duration_s={LAST_S + 1.0}"]))
    values = np.array([dataclasses.astuple(d) for d in flown_derivatives(flight, times_s)])
    text = table_text(times_s, values)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")
    print(text)
    print(f"written to {file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
