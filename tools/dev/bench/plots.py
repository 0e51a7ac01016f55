"""The work-precision diagram."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("svg")
matplotlib.rcParams["svg.hashsalt"] = "maxq"  # equal results give equal files
import matplotlib.pyplot as plt  # noqa: E402 - the backend is chosen first

PANELS = (
    ("attitude_deg", "attitude, deg"),
    ("bending_m", "bending coordinate, m"),
    ("slosh_deg", "slosh angle, deg"),
    ("position_m", "position, m"),
)
WORK = (1000, 2000, 5000, 10_000, 20_000, 50_000)


def work_precision(precision: dict[str, Any], path: Path) -> None:
    """Errors over derivative evaluations per second of flight, both axes logarithmic."""
    figure, axes = plt.subplots(2, 2, figsize=(9.0, 7.0), sharex=True, layout="constrained")
    for axis, (key, label) in zip(axes.flat, PANELS, strict=True):
        for rows, name, style in (
            (precision["steps"], "RK4", "o-"),
            (precision["adaptive"], "DOP853", "s--"),
        ):
            work = [row["evaluations_per_s"] for row in rows]
            axis.loglog(work, [row["largest"][key] for row in rows], style, label=f"{name}, largest in flight")
            (line,) = axis.loglog(work, [row["burnout"][key] for row in rows], style, label=f"{name}, burn-out")
            line.set(alpha=0.45, markersize=4)
        for row in precision["steps"]:
            axis.annotate(
                f"{row['step_ms']:g} ms", (row["evaluations_per_s"], row["largest"][key]), fontsize=7,
                xytext=(3, 4), textcoords="offset points",
            )  # fmt: skip
        axis.set_ylabel(f"error in {label}")
        axis.grid(True, which="major", alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel("derivative evaluations per second of flight")
        axis.set_xticks(WORK, [f"{work:,}" for work in WORK])
        axis.minorticks_off()
    axes[0, 0].legend(fontsize=7)
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    work_precision(json.loads(Path(sys.argv[1]).read_text())["sections"]["precision"]["result"], Path(sys.argv[2]))
