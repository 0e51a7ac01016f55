"""The command `simreplay`: show flights.

Expensive modules are imported only once the task is known.
"""

from __future__ import annotations

import argparse
from functools import partial

from maxq.tools.cli.frame import Command, Exit
from maxq.tools.cli.parser import Parser, positive, seconds

_EXAMPLES = """\
  simreplay runs/nominal/flight.mcap               show the flight in a window
  simreplay runs/nominal/flight.mcap --web         show it in a browser on this machine
  simreplay runs/nominal runs/windy                show two flights together
  simreplay runs/nominal --screenshot q.png --at 43   write a picture; no display is needed
  simreplay runs/nominal --plots review            write the standard plots as SVG and PNG
  simreplay runs/nominal --summary                 print a summary in the terminal
"""
_EXITS = {
    Exit.OK: "shown",
    Exit.FAILED: "shown, but a flight or a part of one could not be read",
    Exit.BAD_INPUT: "nothing could be shown",
    Exit.INTERRUPTED: "interrupted",
}


def _size(text: str) -> str:
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and min(int(width), int(height)) >= 200):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size from 200x200; write e.g. 1920x1080")
    if max(int(width), int(height)) > 8192:
        raise argparse.ArgumentTypeError(f"{text} is too large: 8192 at most")
    return f"{int(width)}x{int(height)}"


def _parser() -> Parser:
    about = "Show flights, from logs (.mcap), folders that contain a log, or folders of campaigns."
    parser = Parser("simreplay", about, _EXAMPLES, _EXITS)
    add = parser.option
    add("LOG|DIR...", "a log, a folder with flight.mcap, or the folder of a campaign", dest="logs")
    way = parser.add_mutually_exclusive_group()
    add("--web", "serve the flight to a browser on this machine (127.0.0.1)", group=way)
    add("--save FILE.rrd", "write a file for the Rerun viewer (`rerun FILE.rrd`)", group=way)
    add("--screenshot FILE.png", "write a picture; no display is needed", needs=["--at"], group=way)
    add("--plots DIR", "write the standard set of plots as SVG and PNG", group=way)
    add("--summary", "print a summary of the flight", group=way)
    add("--at S...", "time of the picture, s; repeatable", needs=["--screenshot"], type=seconds)
    add("--size WxH", "size of the picture (default 1920x1080)", needs=["--screenshot"], type=_size)
    add("--port N", "port of --web (default 9090)", needs=["--web"], type=int)
    scene = partial(add, without=["--plots", "--summary"])
    scene("--tab NAME", "tab of plots to show first, e.g. Bending")
    about = "plot the smallest and the largest sample of each 1/HZ s (default 50; 10 for more than 4 flights)"
    scene("--rate HZ", about, type=positive, dest="rate_hz")
    scene("--bend-factor X", "exaggerate bending by this factor", type=positive)
    scene("--slosh-factor X", "exaggerate slosh angles by this factor", type=positive)
    scene("--side-by-side", "show the vehicles of several flights next to each other")
    parser.about_itself()
    return parser


def show(arguments: list[str]) -> int:
    """Run the command from Python and return its exit code. Raises ReplayError if nothing can be shown.

    Wrong arguments end the process, as on the command line.
    """
    options = _parser().read(arguments)
    from maxq.tools.replay.run import execute  # noqa: PLC0415  # lazy

    return execute(options)


command = Command("simreplay", show, memory="show fewer flights, or fewer samples (--rate 10)")
main = command.main

if __name__ == "__main__":
    command()
