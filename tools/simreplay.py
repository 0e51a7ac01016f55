"""The command `simreplay`: look at flights. Nothing heavy is imported before it is known what to do."""

from __future__ import annotations

import argparse
import sys
from typing import NoReturn

from maxq.tools.cli.frame import Exit, process, run
from maxq.tools.cli.parser import Parser, positive, seconds

_USAGE = """\
simreplay LOG|DIR... [--web [--port N]] [--tab NAME] [--rate HZ] [--bend-factor X] [--slosh-factor X]
       simreplay LOG|DIR... --save FILE.rrd
       simreplay LOG|DIR... --screenshot FILE.png --at S [--at S ...] [--size WxH]
       simreplay LOG|DIR... --plots DIR
       simreplay LOG|DIR... --summary
       simreplay --version | --help"""
_EXAMPLES = """\
  simreplay runs/nominal/flight.mcap               a window with everything in it
  simreplay runs/nominal/flight.mcap --web         the same in a browser, from this
                                                   machine only
  simreplay runs/nominal runs/windy                two flights, one over the other
  simreplay runs/nominal --screenshot q.png --at 43   a picture without any display
  simreplay runs/nominal --plots review            the standard set as SVG and PNG
  simreplay runs/nominal --summary                 a glance in the terminal
"""
_EXITS = {
    Exit.OK: "shown",
    Exit.FAILED: "shown, but some of the flights, or a part of one, could not be read",
    Exit.BAD_INPUT: "nothing could be shown",
    Exit.INTERRUPTED: "interrupted",
}
_WINDOW = "LOG"
_WAYS = ("--web", "--save", "--screenshot", "--plots", "--summary")
_SCENES = (_WINDOW, *_WAYS[:3])


def _size(text: str) -> str:
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and min(int(width), int(height)) >= 200):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size from 200x200; write e.g. 1920x1080")
    if max(int(width), int(height)) > 8192:
        raise argparse.ArgumentTypeError(f"{text} is too large: 8192 at most")
    return f"{int(width)}x{int(height)}"


def _parser() -> Parser:
    about = "Look at flights: logs (.mcap), folders that hold one, folders of campaigns."
    parser = Parser("simreplay", _USAGE, about, _EXAMPLES, _EXITS)
    add = parser.option
    add("logs", nargs="*", metavar="LOG", default=[], help="a log, a folder with flight.mcap, or a campaign's folder")
    add("--web", action="store_true", help="serve it to a browser on this machine (127.0.0.1)")
    add("--save", metavar="FILE.rrd", help="write a file that `rerun` opens")
    add("--screenshot", metavar="FILE.png", help="write a picture; no display is needed")
    add("--plots", metavar="DIR", help="write the standard set of plots as SVG and PNG")
    add("--summary", action="store_true", help="print a glance at the flight")
    picture = ("--screenshot",)
    add("--at", modes=picture, metavar="S", type=seconds, action="append", default=[], help="time of the picture, s")
    add("--size", modes=picture, metavar="WxH", type=_size, help="of the picture (default 1920x1080)")
    add("--port", modes=("--web",), metavar="N", type=int, help="of --web (default 9090)")
    add("--tab", modes=_SCENES, metavar="NAME", help="the tab of plots that is in front, e.g. Bending")
    add(
        "--rate",
        modes=_SCENES,
        metavar="HZ",
        type=positive,
        help="plots keep the smallest and the largest sample of each 1/HZ s (default 50; 10 for more than 4 flights)",
    )
    add("--bend-factor", modes=_SCENES, metavar="X", type=positive, help="how much larger bending is drawn")
    add("--slosh-factor", modes=_SCENES, metavar="X", type=positive, help="how much larger slosh angles are drawn")
    add("--side-by-side", modes=_SCENES, action="store_true", help="vehicles of several flights beside each other")
    parser.version_and_help()
    return parser


def command() -> NoReturn:
    """`simreplay` as a process."""
    process(main)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    return run("simreplay", lambda: show(given), memory="show fewer flights, or fewer samples (--rate 10)")


def show(arguments: list[str]) -> int:
    """What the command does, for Python: wrong input raises."""
    parser = _parser()
    options = parser.read(arguments)
    if not options.logs:
        parser.error("name a log, e.g. simreplay runs/nominal/flight.mcap")
    parser.check(options, parser.only(options, *_WAYS, default=_WINDOW))
    if options.screenshot and not options.at:
        parser.error("--screenshot needs a time, e.g. --at 42")
    from maxq.tools.replay.run import execute  # noqa: PLC0415  # lazy

    return execute(options)


if __name__ == "__main__":
    command()
