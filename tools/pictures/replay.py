"""The pictures of docs/replay.md and the one README.md opens with: `python -m maxq.tools.pictures.replay [DIR]`.

Flies the nominal scenario, the same in the November wind and in four times that wind, and one that loses control; then
takes pictures of what `simreplay` shows of them, and draws two sheets of the standard set. Needs no display.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image

from maxq.tools import simrun
from maxq.tools.replay import viewer
from maxq.tools.replay.collect import open_flights
from maxq.tools.replay.convert import Options, save
from maxq.tools.replay.sheets import write_sheets

DEFAULT = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "replay"
WIND = ["--set", "wind.profile=winds/anheung-november.csv"]
FLIGHTS = {
    "nominal": [],
    "windy": WIND,
    "failing": [*WIND, "--set", "wind.factor=4"],
    "lost": [*WIND, "--set", "run.duration_s=14", "--set",
             'injection=[{at="body_torque",axis="y",kind="step",amplitude_Nm=3e5,start_s=9.0}]'],
}  # fmt: skip
SHOTS = (  # flights, time, tab, name of the picture
    (("windy",), 12.6, "Bending", "replay"),
    (("nominal",), 0.3, "Attitude", "liftoff"),
    (("nominal",), 43.2, "Loads", "max-q"),
    (("nominal",), 59.4, "Gimbal", "burnout"),
    (("nominal",), 127.0, "Trajectory", "apogee"),
    (("failing",), 44.8, "Loads", "failing"),
    (("lost",), 9.6, "Attitude", "control-lost"),
    (("nominal", "windy", "failing"), 47.0, "Loads", "several"),
)
SHEETS = (("failing", "gimbal"), ("windy", "bending"))
WIDTH = 1280  # of a picture in the repository


def main() -> int:
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="maxq-pictures-") as name:
        folder = Path(name)
        for flight, options in FLIGHTS.items():
            simrun.main(["nominal", *options, "--set", f"name={flight}", "--out", str(folder / flight)])
        for flights, time_s, tab, picture in SHOTS:
            opened, _ = open_flights([str(folder / flight) for flight in flights])
            save(opened, Options(tab=tab, side_by_side=True), folder / "shot.rrd")
            with viewer.Headless() as running:
                shots, complaints = viewer.pictures(running, folder / "shot.rrd", [time_s])
            assert not complaints, complaints
            _keep(shots[0], target / f"{picture}.png")
        for flight, tab in SHEETS:
            opened, _ = open_flights([str(folder / flight)])
            for path in write_sheets(opened, folder / "sheets", only=tab):
                if path.suffix == ".png":
                    _keep(path.read_bytes(), target / f"sheet-{tab}.png")
    return 0


def _keep(png: bytes, path: Path) -> None:
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
    picture.save(path, optimize=True)
    print(path)


if __name__ == "__main__":
    sys.exit(main())
