"""The command `simreplay`: look at flights. Nothing heavy is imported before it is known what to do."""

from __future__ import annotations

import argparse
import math
import signal
import sys
from types import FrameType
from typing import NoReturn

from maxq.tools.command_line import tolerate_letters

SHOWN, PARTLY, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

_USAGE = (
    "simreplay LOG|DIR... [--web [--port N]] [--tab NAME] [--rate HZ] [--bend-factor X] [--slosh-factor X]\n"
    "       simreplay LOG|DIR... --save FILE.rrd\n"
    "       simreplay LOG|DIR... --screenshot FILE.png --at S [--at S ...] [--size WxH]\n"
    "       simreplay LOG|DIR... --plots DIR\n"
    "       simreplay LOG|DIR... --summary\n"
    "       simreplay --version | --help"
)
_EXAMPLES = """\
examples:
  simreplay runs/nominal/flight.mcap                      a window with everything in it
  simreplay runs/nominal/flight.mcap --web                the same in a browser, from this machine only
  simreplay runs/nominal runs/windy                       two flights, one over the other
  simreplay runs/nominal --screenshot q.png --at 43       a picture without any display
  simreplay runs/nominal --plots review                   the standard set as SVG and PNG
  simreplay runs/nominal --summary                        a glance in the terminal

exit code:
    0  shown
    1  shown, but some of the flights, or a part of one, could not be read
    2  nothing could be shown
  130  interrupted
"""


class _Parser(argparse.ArgumentParser):
    """argparse whose complaints are one line each."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"simreplay: {message}; see simreplay --help\n")


def _positive(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text} is no number above 0")
    return value


def _seconds(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is no time in seconds")
    return value


def _size(text: str) -> str:
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and min(int(width), int(height)) >= 200):
        raise argparse.ArgumentTypeError(f"{text} is no size; write e.g. 1920x1080")
    if max(int(width), int(height)) > 8192:
        raise argparse.ArgumentTypeError(f"{text} is too large: 8192 at most")
    return f"{int(width)}x{int(height)}"


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="simreplay",
        usage=_USAGE,
        description="Look at flights: logs (.mcap), folders that hold one, folders of campaigns.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
        add_help=False,
    )
    parser.add_argument(
        "logs", nargs="*", metavar="LOG", help="a log, a folder with flight.mcap, or a campaign's folder"
    )
    ways = parser.add_mutually_exclusive_group()
    ways.add_argument("--web", action="store_true", help="serve it to a browser on this machine (127.0.0.1)")
    ways.add_argument("--save", metavar="FILE.rrd", help="write a file that `rerun` opens")
    ways.add_argument("--screenshot", metavar="FILE.png", help="write a picture; no display is needed")
    ways.add_argument("--plots", metavar="DIR", help="write the standard set of plots as SVG and PNG")
    ways.add_argument("--summary", action="store_true", help="print a glance at the flight")
    parser.add_argument("--at", metavar="S", type=_seconds, action="append", default=[], help="time of the picture, s")
    parser.add_argument("--size", metavar="WxH", type=_size, help="of the picture (default 1920x1080)")
    parser.add_argument("--port", metavar="N", type=int, help="of --web (default 9090)")
    parser.add_argument("--tab", metavar="NAME", help="the tab of plots that is in front, e.g. Bending")
    parser.add_argument(
        "--rate", metavar="HZ", type=_positive,
        help="plots keep the smallest and the largest sample of each 1/HZ s (default 50; 10 for more than 4 flights)",
    )  # fmt: skip
    parser.add_argument("--bend-factor", metavar="X", type=_positive, help="how much larger bending is drawn")
    parser.add_argument("--slosh-factor", metavar="X", type=_positive, help="how much larger slosh angles are drawn")
    parser.add_argument("--side-by-side", action="store_true", help="vehicles of several flights beside each other")
    parser.add_argument("--version", action="store_true", help="version of maxq")
    parser.add_argument("-h", "--help", action="help", help="this text")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    tolerate_letters()
    if arguments is None:  # as a program, not from Python
        signal.signal(signal.SIGTERM, _end)
    try:
        return _run(sys.argv[1:] if arguments is None else arguments)
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # whoever read our output, such as `head`, has seen enough
        sys.stderr.close()
        return SHOWN


def _end(number: int, frame: FrameType | None) -> NoReturn:
    """Leave by way of every `finally`: viewers and temporary files go, too."""
    sys.exit(128 + number)


def _run(arguments: list[str]) -> int:
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.version:
        from importlib.metadata import version  # noqa: PLC0415  # lazy, as all imports here: --help is quick

        print(f"maxq {version('maxq')}")
        return SHOWN
    if not options.logs:
        parser.error("name a log, e.g. simreplay runs/nominal/flight.mcap")
    if options.at and not options.screenshot:
        parser.error("--at means nothing without --screenshot")
    if options.size and not options.screenshot:
        parser.error("--size means nothing without --screenshot")
    if options.port is not None and not options.web:
        parser.error("--port means nothing without --web")
    if options.screenshot and not options.at:
        parser.error("--screenshot needs a time, e.g. --at 42")
    from maxq.tools.replay.run import execute  # noqa: PLC0415  # lazy

    return execute(options)


if __name__ == "__main__":
    sys.exit(main())
