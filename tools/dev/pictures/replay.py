"""The pictures of docs/replay.md: `python -m maxq.tools.dev.pictures.replay [DIR]`.

The module flies the nominal scenario without wind, in the November wind and in four times this wind. It also flies a
scenario that loses control, and petrel in its limit wind with section loads. It takes pictures of `simreplay` with
these flights, and draws a sheet of the standard set. No display is needed.
"""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

from PIL import Image

from maxq.tools import simrun, simvehicle
from maxq.tools.replay import convert, viewer
from maxq.tools.replay.convert import Options, save
from maxq.tools.replay.flight import open_flights
from maxq.tools.replay.log_layout import TIMELINE, send_layout
from maxq.tools.replay.sheets import write_sheets

DEFAULT = Path(__file__).resolve().parents[3] / "docs" / "pictures" / "replay"
WIND = ["--set", "wind.profile=winds/anheung-november.csv"]


def _described(text: str) -> list[str]:
    return ["--set", f"description=KSR-III (reconstruction), {text}"]


FLIGHTS = {
    "nominal": [],
    "windy": [*WIND, *_described("November wind of Anheung")],
    "loaded": ["--set", "switches.section_loads=true"],
    "failing": [*WIND, *_described("four times the November wind of Anheung"), "--set", "wind.factor=4"],
    "lost": [
        *WIND,
        *_described("a torque of 300 kN m from 9 s on"),
        "--set",
        "run.duration_s=14",
        "--set",
        'injection=[{at="body_torque",axis="y",kind="step",amplitude_Nm=3e5,start_s=9.0}]',
    ],
}
SHOTS = (  # flights, time (s), tab, name of the picture
    (("windy",), 40.0, "Bending", "replay"),
    (("nominal",), 0.3, "Attitude", "liftoff"),
    (("nominal",), 43.2, "Loads", "max-q"),
    (("nominal",), 59.4, "Gimbal", "burnout"),
    (("nominal",), 127.0, "Trajectory", "apogee"),
    (("loaded",), 12.5, "Loads", "section-loads"),
    (("failing",), 44.8, "Loads", "failing"),
    (("lost",), 9.6, "Attitude", "control-lost"),
    (("nominal", "windy", "failing"), 47.0, "Loads", "several"),
    (("petrel",), 58.0, "Loads", "petrel"),
)
EYES = {"petrel": (3.4, -8.3, -11.5)}  # below the engines
SHEETS = (("failing", "gimbal"),)
WIDTH = 1280  # width of a picture in the repository, pixels


def _eyes(close: tuple[float, float, float] | None) -> Callable[..., convert.Eyes]:
    """Return a replacement of `eyes_for` whose close-up camera is at `close` (m east, north, up of the vehicle)."""
    usual = convert.eyes_for
    return lambda *given: usual(*given) if close is None else replace(usual(*given), close=close)


def main() -> int:
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="maxq-pictures-") as name:
        folder = Path(name)
        for flight, options in FLIGHTS.items():
            simrun.main(["nominal", *options, "--set", f"name={flight}", "--out", str(folder / flight)])
        simvehicle.main(["petrel", "--out", str(folder / "made")])
        windy = ["wind.profile=vehicle/limit_wind.csv", "switches.section_loads=true", "run.duration_s=200"]
        options = [text for each in windy for text in ("--set", each)]
        simrun.main([str(folder / "made" / "scenario.toml"), *options, "--out", str(folder / "petrel")])
        for flights, time_s, tab, picture in SHOTS:
            opened, _ = open_flights([str(folder / flight) for flight in flights])
            with patch.object(convert, "eyes_for", _eyes(EYES.get(picture))):
                save(opened, Options(tab=tab, side_by_side=True, bare=True), folder / "shot.rrd")
            with viewer.headless() as client:
                shots, complaints = viewer.pictures(client(), folder / "shot.rrd", [time_s])
            if complaints:
                sys.exit(f"{picture}: {complaints}")
            _keep(shots[0], target / f"{picture}.png")
        _as_rerun_shows_it(folder / "lost" / "flight.mcap", target)
        for flight, tab in SHEETS:
            opened, _ = open_flights([str(folder / flight)])
            for path in write_sheets(opened, folder / "sheets", only=tab):
                if path.suffix == ".png":
                    _keep(path.read_bytes(), target / f"sheet-{tab}.png")
    return 0


def _as_rerun_shows_it(log: Path, target: Path) -> None:
    """Take pictures of a log that Rerun opens directly: without a layout, and with the layout of maxq."""
    with viewer.headless() as start:
        client = start()
        viewer.open_whole(client, log)
        for picture in ("rerun-alone", "rerun-laid-out"):
            if picture == "rerun-laid-out":
                send_layout(log, int(client.url.rsplit(":", 1)[1].split("/")[0]))
                viewer.steady_picture(client)  # the layout has arrived
            client.pause_at(TIMELINE, timestamp=9.0)
            _keep(viewer.steady_picture(client), target / f"{picture}.png")


def _keep(png: bytes, path: Path) -> None:
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
    few = picture.quantize(256, kmeans=2, dither=Image.Dither.NONE)  # half the size; curves keep distinct colours
    few.save(path, optimize=True)
    print(path)


if __name__ == "__main__":
    sys.exit(main())
