"""The work-precision diagram of docs/performance.md."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from maxq.tools.plots.style import curve, drawing, label, save, sheet

PANELS = (
    ("attitude_deg", "attitude, deg"),
    ("bending_m", "bending coordinate, m"),
    ("slosh_deg", "slosh angle, deg"),
    ("position_m", "position, m"),
)
WORK = (1000, 2000, 5000, 10_000, 20_000, 50_000)


def work_precision(precision: dict[str, Any], path: Path) -> None:
    """Draw the errors over the derivative evaluations per second of flight, with logarithmic axes."""
    with drawing(("svg",)):
        figure, places = sheet(2, 2, height_in=3.5, width_in=9.0, sharex=True)
        for place, (key, text) in zip(places, PANELS, strict=True):
            for k, (rows, name) in enumerate(((precision["steps"], "RK4"), (precision["adaptive"], "DOP853"))):
                work = [row["evaluations_per_s"] for row in rows]
                look = curve(k) | {"marker": "os"[k]}
                place.loglog(work, [row["largest"][key] for row in rows], label=f"{name}, largest in flight", **look)
                at_end = [row["burnout"][key] for row in rows]
                place.loglog(work, at_end, label=f"{name}, burnout", alpha=0.45, **look)
            for row in precision["steps"]:
                at = row["evaluations_per_s"], row["largest"][key]
                place.annotate(f"{row['step_ms']:g} ms", at, (3, 4), textcoords="offset points", fontsize=7)
            label(place, y=f"error in {text}")
        for place in places[2:]:
            label(place, "derivative evaluations per second of flight")
            place.set_xticks(WORK, [f"{work:,}" for work in WORK])
            place.minorticks_off()
        places[0].legend()
        save(figure, path.with_suffix(""))


if __name__ == "__main__":
    work_precision(json.loads(Path(sys.argv[1]).read_text())["sections"]["precision"]["result"], Path(sys.argv[2]))
