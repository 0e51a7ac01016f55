"""Take the pictures of README.md and of the first pages of docs: `python -m maxq.tools.dev.pictures.tour [RUNS]`.

The module draws two flights of the nominal scenario next to the margins of the design that they fly. It runs the
commands of the pages in the folder RUNS (default: a temporary one), and takes pictures of the files and report pages
that they write. A result that already exists in RUNS is used unchanged. The module needs Chromium, and about ten
minutes for all results.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from PIL import Image, ImageChops, ImageOps

from maxq.design.loop.loop import loops
from maxq.design.margins.measure import margins
from maxq.design.operating_points import nodes
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.dev.documents.outputs import ROOT, files_of, run
from maxq.tools.plots.palette import BLUE, LIMIT, ORANGE
from maxq.tools.plots.style import drawing, label, save, sheet

TARGET = ROOT / "docs" / "pictures" / "tour"
COMMANDS = {  # by the path that they write
    "runs/nominal": "simrun nominal",
    "runs/sheets": "simreplay runs/nominal --plots runs/sheets",
    "runs/first": "simrun campaigns/first",
    "runs/my-gains": "simdesign analyse my-gains.toml --plots --out runs/my-gains",
    "hawk": "simvehicle examples/own_vehicle/hawk.toml --out hawk",
    "runs/design": "simdesign hawk/case.toml --out runs/design --no-pictures",
    "runs/loop": "simdesign analyse runs/design --scenario hawk/scenario.toml --at 50 --plots --out runs/loop",
    "runs/verify-design": "simverify runs/design --suite hawk/suite.toml",
}
COPIES = {
    "gimbal-sheet": "runs/sheets/04-gimbal.png",
    "margins-my-gains": "runs/my-gains/margins.png",
    "loop-hawk": "runs/loop/loop-050.0s.png",
}
SHOTS = {  # of each page: the elements shown
    "vehicle-page": ("hawk/vehicle.html", "#figure-vehicle, #figure-modes"),
    "campaign-report": ("runs/first/report.html", "#figure-histograms"),
    "review-pack": ("runs/verify-design/review.html", ".outcome, .own-page > table:first-of-type"),
}
SHOT_PX, SCALE, BORDER_PX = (1000, 1600), 1.5, 12
DESIGN = "design=designs/ksr3-robust-ascent.toml"
JET = "wind.profile=winds/anheung-november.csv"
ASCENT = ("run.duration_s=66", 'run.stop_at=["impact"]')
LIMITS = {"q alpha": 100.0, "gimbal angle": 4.0, "gain margin": 6.0, "phase margin": 30.0}
TIMES_S = np.linspace(0.5, 58.0, 24)
LARGE = {
    "font.size": 11.0,
    "axes.titlesize": 12.0,
    "axes.labelsize": 11.0,
    "legend.fontsize": 10.5,
    "xtick.labelsize": 10.0,
    "ytick.labelsize": 10.0,
    "lines.linewidth": 1.8,
    "figure.dpi": 170,
}


def main() -> int:
    TARGET.mkdir(parents=True, exist_ok=True)
    _draw_overview()
    if len(sys.argv) > 1:
        _take_pictures(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory(prefix="maxq-pictures-") as name:
            _take_pictures(Path(name))
    return 0


def _take_pictures(folder: Path) -> None:
    """Run the commands whose results are missing, copy pictures, and take pictures of report pages."""
    if not (folder / "examples").exists():
        (folder / "examples").symlink_to(ROOT / "examples")
    for name, text in files_of((ROOT / "docs/start/margins.md").read_text(encoding="utf-8")).items():
        (folder / name).write_text(text, encoding="utf-8")
    for result, command in COMMANDS.items():
        if not (folder / result).exists():
            run(command, folder)
    for name, file in COPIES.items():
        with Image.open(folder / file) as image:
            save_small(image.convert("RGB"), TARGET / f"{name}.png")
    for name, (page, shown) in SHOTS.items():
        _photograph(folder / page, shown, TARGET / f"{name}.png")


def _photograph(page: Path, shown: str, target: Path) -> None:
    """Save a picture of the elements of a page that match the selector `shown`, without the white margin around
    them.
    """
    script = f"""<script>addEventListener("load", () => setTimeout(() =>
        document.body.replaceChildren(...document.querySelectorAll({shown!r})), 500));</script>"""
    with tempfile.TemporaryDirectory() as name:
        part, shot = Path(name) / "page.html", Path(name) / "shot.png"
        part.write_text(page.read_text(encoding="utf-8") + script, encoding="utf-8")
        size = ",".join(map(str, SHOT_PX))
        options = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=5000")
        look = (f"--window-size={size}", f"--force-device-scale-factor={SCALE}", f"--screenshot={shot}")
        subprocess.run(["chromium", *options, *look, part.as_uri()], check=True, capture_output=True)
        with Image.open(shot) as image:
            whole = image.convert("RGB")
    box = ImageChops.difference(whole, Image.new("RGB", whole.size, "white")).getbbox()
    if box is None:
        raise SystemExit(f"{page}: nothing is shown of {shown}")
    save_small(ImageOps.expand(whole.crop((0, box[1], whole.width, box[3])), BORDER_PX, "white"), target)


def save_small(image: Image.Image, target: Path) -> None:
    """Save a picture with few colours, which halves its file. The method preserves the colours of small marks."""
    few = image.quantize(128, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(target, optimize=True)


def _draw_overview() -> None:
    with drawing(("png",), LARGE):
        figure, places = sheet(2, 2, height_in=2.75, width_in=10.0)
        _draw_flights(places[0], places[1])
        _draw_margins(places[2], places[3])
        for place in places:
            place.set_xlim(0.0, 66.0)
        save(figure, TARGET / "flight-and-margins")


def _draw_flights(load: Axes, gimbal: Axes) -> None:
    looks: dict[str, dict[str, Any]] = {
        "calm air": {"color": BLUE},
        "November jet": {"color": ORANGE, "linestyle": "--"},
    }
    for (name, look), wind in zip(looks.items(), ((), (JET,)), strict=True):
        flight = fly(load_scenario("nominal", [DESIGN, *ASCENT, *wind]))
        q_alpha = flight["dynamic_pressure_Pa"] * np.interp(
            flight.time_s("dynamic_pressure_Pa"), flight.time_s("alpha_total_deg"), flight["alpha_total_deg"]
        )
        load.plot(flight.time_s("dynamic_pressure_Pa"), q_alpha / 1e3, label=name, **look)
        gimbal.plot(flight.time_s("gimbal_pitch_angle_deg"), flight["gimbal_pitch_angle_deg"], label=name, **look)
    _limit(load, LIMITS["q alpha"], above=True)
    label(load, y="q alpha, kPa deg", title="Flight: aerodynamic load")
    load.set_ylim(0.0, 118.0)
    load.legend(loc="upper left", bbox_to_anchor=(0.0, 0.84), ncols=2)
    for side in (-1.0, 1.0):
        _limit(gimbal, side * LIMITS["gimbal angle"], above=side > 0.0)
    gimbal.set_ylim(-5.4, 5.4)
    label(gimbal, y="gimbal angle, pitch, deg", title="Flight: gimbal angle")


def _draw_margins(gain: Axes, phase: Axes) -> None:
    scenario = load_scenario("nominal", [DESIGN])
    assert scenario.design is not None
    found = [margins(loop) for loop in loops(nodes(scenario, TIMES_S.tolist()), scenario.design)]
    gain.plot(TIMES_S, [m.gain_down_db.value for m in found], color=ORANGE, linestyle="--", label="lower")
    gain.plot(TIMES_S, [m.gain_up_db.value for m in found], color=BLUE, label="upper")
    phase.plot(TIMES_S, [m.rigid_phase_deg.value for m in found], color=BLUE)
    _limit(gain, LIMITS["gain margin"], above=False)
    _limit(phase, LIMITS["phase margin"], above=False)
    gain.set(ylim=(0.0, 16.0), yticks=[0.0, 3.0, 6.0, 9.0, 12.0, 15.0])
    phase.set_ylim(0.0, 80.0)
    gain.legend(loc="upper left", ncols=2)
    label(gain, "time, s", "gain margin, dB", "Loop: gain margins")
    label(phase, "time, s", "phase margin, deg", "Loop: phase margin, rigid body")


def _limit(place: Axes, value: float, *, above: bool) -> None:
    """Draw a limit, and name it on the side that it excludes."""
    place.axhline(value, color=LIMIT, linewidth=1.2)
    place.annotate(
        f"limit {value:g}",
        (65.0, value),
        xytext=(0.0, 3.0 if above else -4.0),
        textcoords="offset points",
        color=LIMIT,
        ha="right",
        va="bottom" if above else "top",
        fontsize=10.0,
    )


if __name__ == "__main__":
    sys.exit(main())
