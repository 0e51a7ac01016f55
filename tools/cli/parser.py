"""The command line of a command: subcommands, options, exit codes, help, and errors on one line."""

from __future__ import annotations

import argparse
import difflib
import math
import os
import re
import shutil
import textwrap
from collections.abc import Callable, Mapping, Sequence
from itertools import takewhile
from typing import Any, NoReturn

from maxq.tools.cli.frame import TRACEBACK, Exit, show_list
from maxq.tools.cli.terminal import announce, printable, tell, wipe

_AT_ONCE = {"-h", "--help", "--list", "--version"}
"""The options that import nothing further."""
_EXITS = {
    Exit.OK: "done",
    Exit.BAD_INPUT: "bad input, or files that cannot be read or written",
    Exit.INTERNAL_ERROR: f"a fault in maxq itself; {TRACEBACK}=1 in the environment shows the traceback",
    Exit.INTERRUPTED: "interrupted",
}


class Parser(argparse.ArgumentParser):
    """The command line of a command or of one of its subcommands.

    Usage and help follow from the declared options, and every error is one line. `exits` adds or replaces exit codes at
    the end of --help. `do` is called with the given options as keyword arguments and returns the exit code.
    """

    def __init__(
        self, prog: str, about: str, examples: str, exits: Mapping[Exit, str], do: Callable[..., int] | None = None
    ) -> None:
        super().__init__(prog=prog, formatter_class=_Formatter, allow_abbrev=False, add_help=False)
        self._about, self._examples, self._exits = about, examples, _EXITS | dict(exits)
        self._usages: dict[str, str] = {}
        self._bound: dict[str, tuple[Sequence[str], Sequence[str]]] = {}
        self._commands: dict[str, Parser] = {}
        self._command_of: Parser | None = None
        self._kinds: dict[str, str] | None = None
        self._positionals.title = "arguments"
        self.set_defaults(do=do)

    def commands(self, otherwise: str, default: Callable[[str], str]) -> None:
        """Declare that the command has subcommands.

        `default` returns the subcommand for a first word that names none. `otherwise` is the name of such a word in the
        usage.
        """
        self._otherwise, self._default = otherwise, default
        self._listed = self.add_subparsers(title="commands", metavar="COMMAND", prog=self.prog, parser_class=Parser)
        self._action_groups.insert(0, self._action_groups.pop())  # listed before the options

    def command(
        self, name: str, about: str, examples: str, do: Callable[..., int], exits: Mapping[Exit, str] | None = None
    ) -> Parser:
        """Add a subcommand and return its parser. `about` is a sentence without its full stop."""
        listed = about[0].lower() + about[1:]
        about += "."
        parser = self._listed.add_parser(name, help=listed, about=about, examples=examples, exits=exits or {}, do=do)
        parser._command_of = self
        parser.add_argument("-h", "--help", action="help", help="show this help")
        self._commands[name] = parser
        return parser

    def option(
        self,
        usage: str,
        text: str,
        needs: Sequence[str] = (),
        without: Sequence[str] = (),
        group: argparse._ActionsContainer | None = None,
        **how: Any,
    ) -> None:
        """Declare an option by its form in the usage, with its help `text`.

        Examples are "--out DIR", "--axis pitch|yaw", a flag "--orders", "--at T..." for a repeatable option, and
        "--realtime [X]". "SCENARIO" and "LOG..." are required words, "[DESIGN]" is an optional word, and "[DESIGN]..."
        means any number.

        At least one of the options `needs` must be given as well, and none of the options `without`. `how` contains
        further arguments of add_argument; its `dest` is the name of the argument of `do`.
        """
        name, *values = usage.removesuffix("...").split()
        repeated = usage.endswith("...")
        if not name.startswith("-"):
            optional = name.startswith("[")
            how |= {"nargs": "*" if optional else "+"} if repeated else {"nargs": "?"} if optional else {}
            metavar = name.strip("[]")
            action = self.add_argument(how.pop("dest", metavar.lower()), metavar=metavar, help=text, **how)
            self._usages[action.dest] = usage
            return
        if repeated:
            how |= {"action": "append", "default": []}
        if not values:
            how["action"] = "store_true"
        elif "|" in values[0]:
            how |= {"choices": values[0].split("|"), "metavar": values[0]}
        else:
            how["metavar"] = values[0].strip("[]")
            how |= {"nargs": "?"} if values[0].startswith("[") else {}
        action = (group or self).add_argument(name, help=text, **how)
        shown = " ".join((name, *values))
        self._usages[action.dest] = (shown if how.get("required") else f"[{shown}]") + "..." * repeated
        self._bound[name] = needs, without

    def overrides(self, of: str, needs: Sequence[str] = (), without: Sequence[str] = ()) -> None:
        """Declare the option --set. `of` describes the values that it overrides, with an example."""
        text = f"override a value of {of}; repeatable"
        self.option("--set KEY=VALUE...", text, needs, without, dest="overrides")

    def about_itself(self, listed: dict[str, str] | None = None) -> None:
        """Declare the options of every command, and --list if there are built-in files to list.

        `listed` maps each kind of file to the title of its list.
        """
        self._kinds = listed
        if listed is not None:
            *others, last = (title.partition(" (")[0] for title in listed.values())
            text = f"list the built-in {' and '.join(filter(None, (', '.join(others), last)))}"
            self.add_argument("--list", action="store_true", default=argparse.SUPPRESS, help=text)
        self.add_argument("--version", action=_Version, nargs=0, help="show the version of maxq")
        self.add_argument("-h", "--help", action="help", help="show this help")

    def run(self, arguments: Sequence[str]) -> int:
        """Perform the requested task and return the exit code. A terminal shows immediately that the command is
        loading.
        """
        if arguments and not _AT_ONCE.intersection(arguments):
            announce(f"{self.prog}: loading")
        given = vars(self.read(arguments))
        do: Callable[..., int] = given.pop("do")
        return do(**{k: tuple(v) if isinstance(v, list) else v for k, v in given.items() if v not in (None, [])})

    def read(self, arguments: Sequence[str]) -> argparse.Namespace:
        """Parse the words of a command line, and return the options with the function `do` that is to be called.

        A first word that names a subcommand selects its parser. An error is printed on one line and ends the process.
        """
        first = self._first_word(arguments) if self._commands else None
        if first is not None:
            name, words = arguments[first], [*arguments[:first], *arguments[first + 1 :]]
            if name in self._commands:
                return self._commands[name].read(words)
            close = difflib.get_close_matches(name, self._commands, 1, 0.7)
            if close and words and not words[0].startswith("-") and not os.path.exists(name):
                self.error(f"what is {name!r}? did you mean {close[0]}?")
            return self._commands[self._default(name)].read(arguments if "--" in arguments else [name, *words])
        self._refuse_unknown(arguments)
        if (kinds := self._kinds) is not None and "--list" in arguments:
            if others := [word for word in arguments if word != "--list"]:
                self.error(f"--list stands alone: not with {others[0]}")
            return argparse.Namespace(do=lambda: show_list(kinds))
        options, unknown = self.parse_known_args(arguments)
        if self._commands:
            self.error(f"give a {self._otherwise}, e.g. {self._example}")
        if unknown:
            takes = [action for action in self._actions if not action.option_strings]
            one = f"one {takes[0].metavar} at a time: " if len(takes) == 1 and takes[0].nargs not in ("+", "*") else ""
            self.error(f"{one}what is {unknown[0]!r}?")
        self._check(options)
        return options

    def _print_message(self, message: str, file: Any = None) -> None:
        wipe()
        super()._print_message(message, file)

    def _first_word(self, arguments: Sequence[str]) -> int | None:
        """Return the index of the first word that is neither an option nor the value of an option, or None."""
        options = {name: a for parser in self._commands.values() for name, a in parser._option_string_actions.items()}
        values = 0
        for at, word in enumerate(arguments):
            if values > 0:
                values -= 1
            elif word == "--":
                return at + 1 if at + 1 < len(arguments) else None
            elif not word.startswith("-"):
                return at
            elif (action := options.get(word)) is None:
                continue
            elif action.nargs == "?":
                values = int(at + 1 < len(arguments) and _is_number(arguments[at + 1]))
            else:
                values = 1 if action.nargs is None else int(action.nargs)
        return None

    def _refuse_unknown(self, arguments: Sequence[str]) -> None:
        """Reject an option that this command does not have. The error names the subcommand that has it, or a similar
        option.
        """
        mine = self._option_string_actions
        for word in takewhile("--".__ne__, arguments):
            name = word.partition("=")[0]
            if name in mine or not re.match("--?[A-Za-z]", name):
                continue
            root = self._command_of or self
            if owners := [
                command for command, parser in root._commands.items() if name in parser._option_string_actions
            ]:
                *others, last = owners
                where = f"{', '.join(others)}{' or ' * bool(others)}{last}"
                self.error(f"{name} is an option of {root.prog} {where}, not of {self.prog}")
            if name in root._option_string_actions:
                self.error(f"{name} stands alone: {root.prog} {name}")
            close = difflib.get_close_matches(name, mine, 1, 0.7)
            self.error(f"unknown option {word}" + (f"; did you mean {close[0]}?" if close else ""))

    def _check(self, options: argparse.Namespace) -> None:
        """Reject options without those that they need or with those that they exclude, and an --out without a name."""
        given = [
            action.option_strings[0]
            for action in self._actions
            if action.option_strings and getattr(options, action.dest, action.default) != action.default
        ]
        for name in given:
            needs, without = self._bound[name]
            if needs and not {*needs} & {*given}:
                self.error(f"{name} needs {' or '.join(needs)}")
            for other in without:
                if other in given:
                    self.error(f"{other} and {name} exclude each other")
        if getattr(options, "out", None) == "":
            self.error("--out needs the name of a folder")

    def error(self, message: str) -> NoReturn:
        message = message.removeprefix("argument ")
        message = re.sub("^(.*): not allowed with argument (.*)", r"\2 and \1 exclude each other", message)
        message = re.sub(
            "^one of the arguments (.*) is required", lambda m: f"give {m[1].replace(' ', ' or ')}", message
        )
        message = re.sub(
            "^the following arguments are required: ([^,]*).*", rf"give a \1, e.g. {self._example}", message
        )
        line = printable(message)
        see = " See" if line.endswith("?") else "; see"
        self.exit(Exit.BAD_INPUT, f"{self.prog.split()[0]}: {line}{see} {self.prog} --help\n")

    @property
    def _example(self) -> str:
        return re.split(" {2,}", self._examples.strip(), maxsplit=1)[0].splitlines()[0]

    # help

    def format_help(self) -> str:
        width = shutil.get_terminal_size().columns - 2  # as in argparse
        self.usage = self._usage(width - 11)  # further lines are indented by 11
        self._optionals._group_actions.sort(key=lambda action: action.dest == "help")  # last in the list
        self.description = _hung("", self._about, width)
        codes = "\n".join(_hung(f"{code:5d}  ", text, width) for code, text in sorted(self._exits.items()))
        self.epilog = f"examples:\n{_examples(self._examples, width)}\n\nexit code:\n{codes}"
        return super().format_help()

    def helps(self) -> dict[str, str]:
        """Return the help of the command and of its subcommands, by the name of each ("simrun fly")."""
        return {parser.prog: parser.format_help() for parser in (self, *self._commands.values())}

    def _usage(self, width: int) -> str:
        """Return the usage, with bars between options that exclude each other."""
        if self._commands:
            calls = [f"{self.prog} COMMAND [OPTION]...", f"{self.prog} {self._otherwise} [OPTION]..."]
            return "\n       ".join(calls)
        groups = {id(a): g for g in self._mutually_exclusive_groups for a in g._group_actions}
        shown: list[str] = []
        for action in sorted(self._actions, key=lambda a: bool(a.option_strings)):
            usage = self._usages.get(action.dest, "")
            group = groups.get(id(action))
            if group is not None:
                if action is group._group_actions[0]:
                    each = " | ".join(self._usages[a.dest].strip("[]") for a in group._group_actions)
                    shown.append(f"({each})" if group.required else f"[{each}]")
            elif usage:
                shown.append(usage)
        return _hung("", " ".join((self.prog, *shown)), width, 4 + 7)


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """The formatter of argparse, with subcommands listed like options."""

    def _format_action(self, action: argparse.Action) -> str:
        if isinstance(action, argparse._SubParsersAction):
            return "".join(map(self._format_action, action._get_subactions()))
        return super()._format_action(action)


def _hung(head: str, text: str, width: int, indent: int | None = None) -> str:
    """Return `head` followed by `text`, folded at spaces outside brackets, and in brackets only after a bar.

    Further lines are indented by `indent` columns, by default to the end of `head`.
    """
    depth, whole = 0, ""
    for letter in text:
        depth += (letter == "[") - (letter == "]")
        whole += "\0" if letter == " " and depth and whole[-1] != "|" else letter
    lines = textwrap.wrap(whole, width - len(head), break_long_words=False, break_on_hyphens=False)
    return head + ("\n" + " " * (len(head) if indent is None else indent)).join(lines).replace("\0", " ")


_BESIDE = 42  # column at which explanations of examples begin


def _examples(text: str, width: int) -> str:
    """Return commands with their explanations, each on the line of its command or, if that is long, on the next line.

    In `text`, two or more spaces separate a command from its explanation.
    """
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
        from importlib.metadata import version  # noqa: PLC0415  # lazy: --help is fast

        tell(f"maxq {version('maxq')}")
        parser.exit()


# types of arguments


def count(text: str, least: int = 0, most: int = 2**63 - 1) -> int:
    """Parse a whole number from `least` to `most`. Raises argparse.ArgumentTypeError."""
    if text.isdecimal() and (len(text) > 19 or int(text) > most):
        raise argparse.ArgumentTypeError(f"{text[:20]}{'...' * (len(text) > 20)} is too large: at most {most}")
    if not text.isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {least}")
    return int(text)


def count_of_runs(text: str) -> int:
    """Parse the number of flights of a campaign."""
    from maxq.sim.input.ranges import MOST_RUNS  # noqa: PLC0415  # lazy: --help is fast

    return count(text, 0, MOST_RUNS)


def count_from_1(text: str) -> int:
    """Parse a whole number of at least 1."""
    return count(text, 1)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def number(text: str, what: str = "a number") -> float:
    """Parse a finite number. `what` names it in the error."""
    if not _is_number(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return float(text)


def seconds(text: str) -> float:
    """Parse a time, s."""
    return number(text, "a time in seconds")


def positive(text: str) -> float:
    """Parse a number above 0."""
    if (value := number(text)) <= 0.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not above 0")
    return value
