"""The command line of a command: options, the modes in which each has a meaning, exit codes, errors on one line."""

from __future__ import annotations

import argparse
import difflib
import math
import re
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from maxq.tools.cli.frame import TRACEBACK, Exit
from maxq.tools.cli.terminal import printable

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Order = TypeVar("Order", bound="DataclassInstance")

_EVERY_COMMAND = {Exit.INTERNAL_ERROR: f"a fault of maxq itself; {TRACEBACK}=1 in the environment shows the traceback"}


class Parser(argparse.ArgumentParser):
    """argparse whose complaints are one line each, and which knows the modes in which an option has a meaning.

    A mode is what the command is asked to do, in the words of its usage ("--from DIR"). `exits` completes the list of
    exit codes at the end of --help.
    """

    def __init__(self, prog: str, usage: str, description: str, examples: str, exits: Mapping[Exit, str]) -> None:
        codes = sorted((_EVERY_COMMAND | dict(exits)).items())
        width = shutil.get_terminal_size().columns - 2  # as argparse has it
        listed = "\n".join(_hung(f"{code:5d}  ", " ".join(text.split()), width) for code, text in codes)
        calls = "\n       ".join(
            _hung("", call.strip(), width - 7, 7 + 4) for call in re.sub(r"\n +(?=\[)", " ", usage).splitlines()
        )
        super().__init__(
            prog=prog, usage=calls, description=_hung("", description, width),
            epilog=f"examples:\n{_examples(examples, width)}\n\nexit code:\n{listed}",
            formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, add_help=False,
        )  # fmt: skip  # five more lines otherwise
        self._modes: dict[str, tuple[str, ...]] = {}

    def option(
        self,
        usage: str,
        text: str,
        modes: Sequence[str] = (),
        group: argparse._ActionsContainer | None = None,
        **how: Any,
    ) -> None:
        """An option as the usage has it, and its help: "--out DIR", "--axis pitch|yaw", a flag "--orders", "--at T..."
        for one that may be repeated, "SCENARIO" or "LOG..." for what stands alone (`dest` says where it goes).

        `modes`: where it has a meaning; empty: everywhere. `how`: what else add_argument is to know.
        """
        name, *values = usage.removesuffix("...").split()
        repeated = usage.endswith("...")
        if repeated:
            how["default"] = []
        if not name.startswith("-"):
            how |= {"metavar": name, "nargs": "*" if repeated else "?"}
            name = how.pop("dest")
        elif not values:
            how["action"] = "store_true"
        elif "|" in values[0]:
            how["choices"] = values[0].split("|")
        else:
            how |= {"metavar": values[0]} if len(values) == 1 else {"metavar": tuple(values), "nargs": len(values)}
            if repeated:
                how["action"] = "append"
        action = (group or self).add_argument(name, help=text, **how)
        self._modes |= {action.dest: tuple(modes)} if modes else {}

    def overrides(self, of: str, modes: Sequence[str]) -> None:
        """The option --set; `of`: of what it overrides a value, with an example."""
        self.option("--set KEY=VALUE...", f"override a value of {of}; repeatable", modes, dest="overrides")

    def version_and_help(self) -> None:
        """The options that every command has, last in its list."""
        self.add_argument("--version", action=_Version, nargs=0, help="version of maxq")
        self.add_argument("-h", "--help", action="help", help="this text")

    def read(self, arguments: Sequence[str], extra: str = "what is {!r}?") -> argparse.Namespace:
        """The options. `extra`: what is said of a word too many."""
        options, unknown = self.parse_known_args(arguments)
        if unknown and unknown[0].startswith("-"):
            names = [option for action in self._actions for option in action.option_strings]
            close = difflib.get_close_matches(unknown[0].partition("=")[0], names, 1, 0.7)
            self.error(f"unknown option {unknown[0]}" + (f"; did you mean {close[0]}?" if close else ""))
        if unknown:
            self.error(extra.format(unknown[0]))
        return options

    def given(self, options: argparse.Namespace) -> dict[str, str]:
        """Names of the options that were given, by the attribute that holds their value."""
        return {
            action.dest: action.option_strings[0] if action.option_strings else str(action.metavar)
            for action in self._actions
            if getattr(options, action.dest, action.default) != action.default
        }

    def only(self, options: argparse.Namespace, *choices: str, none: str = "", default: str = "") -> str:
        """Which one of the options `choices` was given. An error where several were, or none and there is no default;
        `none` says then what to give."""
        given = [name for name in self.given(options).values() if name in choices] or [default]
        if given == [""]:
            self.error(none)
        if len(given) > 1:
            self.error(f"{given[0]} and {given[1]} exclude each other")
        return given[0]

    def stray(self, options: argparse.Namespace, mode: str) -> str:
        """The first option that was given though it means nothing in this mode, and where it does; empty: none."""
        for dest, name in self.given(options).items():
            modes = self._modes.get(dest, (mode,))
            if mode not in modes:
                *first, last = modes
                return f"{name} goes with {', '.join(first)}{' or ' if first else ''}{last}"
        return ""

    def check(self, options: argparse.Namespace, mode: str, shown: str = "") -> None:
        """An error where an option was given that means nothing in this mode (`shown` names the mode in particular), or
        an --out without a name."""
        if text := self.stray(options, mode):
            self.error(f"{text}, not with {shown or mode}")
        if getattr(options, "out", None) == "":
            self.error("--out needs the name of a folder")

    def error(self, message: str) -> NoReturn:
        self.exit(
            Exit.BAD_INPUT, f"{self.prog}: {printable(message.removeprefix('argument '))}; see {self.prog} --help\n"
        )


def _hung(head: str, text: str, width: int, indent: int | None = None) -> str:
    """`text` behind `head`, folded at spaces that are in no brackets, further lines `indent` to the right."""
    depth, whole = 0, ""
    for letter in text:
        depth += (letter == "[") - (letter == "]")
        whole += "\0" if letter == " " and depth else letter
    lines = textwrap.wrap(whole, width - len(head), break_long_words=False, break_on_hyphens=False)
    return head + ("\n" + " " * (len(head) if indent is None else indent)).join(lines).replace("\0", " ")


_BESIDE = 40  # column in which examples are explained


def _examples(text: str, width: int) -> str:
    """Commands, and what each does beside it or below: two spaces or more part them."""
    lines = re.sub(r"\n {8,}", " ", text).splitlines()
    rows = [re.split(r" {2,}", line.strip(), maxsplit=1) for line in lines]
    out = []
    for command, about in ([*row, ""][:2] for row in rows):
        below = not about or len(command) > _BESIDE - 4
        head = " " * _BESIDE if below else f"  {command}".ljust(_BESIDE)
        out += [f"  {command}"] * below + ([_hung(head, about, width)] if about else [])
    return "\n".join(out)


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version  # noqa: PLC0415  # lazy: --help is quick

        print(f"maxq {version('maxq')}")
        parser.exit()


def filled(kind: type[Order], options: argparse.Namespace, **more: Any) -> Order:
    """The dataclass `kind` with the options that bear the names of its fields; those not given keep its defaults."""
    values = {name: getattr(options, name, None) for name in kind.__dataclass_fields__} | more
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items() if v is not None})


# types of arguments


def count(text: str, least: int = 0, most: int = 2**63 - 1) -> int:
    """A whole number of at least `least` and at most `most`."""
    if text.isdecimal() and (len(text) > 19 or int(text) > most):
        raise argparse.ArgumentTypeError(f"{text[:20]}{'...' * (len(text) > 20)} is too large: at most {most}")
    if not text.isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {least}")
    return int(text)


def count_of_runs(text: str) -> int:
    """How many flights a campaign has."""
    from maxq.sim.scenario.ranges import MOST_RUNS  # noqa: PLC0415  # lazy: --help is quick

    return count(text, 0, MOST_RUNS)


def count_from_1(text: str) -> int:
    """A whole number of at least 1."""
    return count(text, 1)


def number(text: str, what: str = "a number") -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return value


def seconds(text: str) -> float:
    """A time, s."""
    return number(text, "a time in seconds")


def positive(text: str) -> float:
    """A number above 0."""
    if (value := number(text)) <= 0.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not above 0")
    return value
