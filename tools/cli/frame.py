"""What the commands have in common around what they do: exit codes, messages, interruption, the end of the process.

Nothing heavy is imported here: `simrun --help` takes less than 0.1 s.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import warnings
from collections.abc import Callable
from enum import IntEnum
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn, Self

from maxq.tools.cli.terminal import aligned, columns, folded, printable, tell

if TYPE_CHECKING:
    from pathlib import Path

FIRST = ("nominal", "campaigns/first", "ksr3-identical", "ksr3-default", "standard")
"""Built-in files with which to begin: --list names them first."""
TRACEBACK = "MAXQ_TRACEBACK"
"""Environment variable with which an error shows its traceback, too."""
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # options of glibc's malloc.h, in bytes


class Exit(IntEnum):
    """Exit codes of all commands. What 0, 1 and 3 mean in particular is listed in each command's --help."""

    OK = 0  # done: flown, designed, accepted, shown
    FAILED = 1  # done, with a negative result
    BAD_INPUT = 2  # wrong arguments or files, or files that cannot be read or written
    UNDECIDED = 3  # more runs are needed
    INTERNAL_ERROR = 70  # a fault of maxq (EX_SOFTWARE of sysexits.h)
    INTERRUPTED = 130  # Ctrl-C or SIGTERM
    UNREAD = 141  # whoever read our output, such as `head`, has closed it (as the shell reports SIGPIPE)


class CommandError(Exception):
    """What was asked for cannot be done; the text says why on one line."""


def say(command: str, text: str) -> None:
    """A message for the person, one line on stderr (folded at spaces on a terminal)."""
    print(folded(f"{command}: {printable(text)}", columns(sys.stderr)), file=sys.stderr)


def run(command: str, body: Callable[[], int], interrupted: str = "interrupted", memory: str = "") -> int:
    """The exit code of `body`. Whatever it raises is answered by one line on stderr and an exit code of its own.

    `interrupted` and `memory`: what is said after Ctrl-C, and what helps where the memory does not suffice.
    """
    _tolerate_letters()
    # Before NumPy is loaded: its library's threads would only wait for each other over matrices of forty rows.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        with warnings.catch_warnings():
            _say_notes(command)
            code = body()
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        say(command, interrupted)
        return Exit.INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return Exit.UNREAD
    except Exception as error:
        if os.environ.get(TRACEBACK):
            import traceback  # noqa: PLC0415  # lazy

            traceback.print_exception(error)
        text = _explanation(error, memory)
        say(command, text or _internal(error))
        return Exit.BAD_INPUT if text else Exit.INTERNAL_ERROR


def _say_notes(command: str) -> None:
    """Say each note on a name (`sim.input.files.NameNote`) once; other warnings are shown as usual."""
    usual, said = warnings.showwarning, set[str]()

    def show(message: Warning | str, category: type[Warning], *place: Any) -> None:
        if category.__name__ != "NameNote":
            usual(message, category, *place)
        elif str(message) not in said:
            said.add(str(message))
            say(command, f"note: {message}")

    warnings.showwarning = show  # type: ignore[assignment]  # its parameters are those that are used


def show_list(kinds: dict[str, str]) -> int:
    """Print name and description of the built-in files of each kind (of builtin.FOLDERS), below its title: --list."""
    from maxq.sim.input.files import builtin_files  # noqa: PLC0415  # lazy: --help is quick

    for kind, title in kinds.items():
        files = sorted(builtin_files(kind).items(), key=lambda item: (item[0] not in FIRST, "/" in item[0], item[0]))
        tell(title, *aligned([(name, _description(path)) for name, path in files], "  "))
    return Exit.OK


def _description(path: Path) -> str:
    """A file's own description, its first sentence, or that of the file it extends."""
    import tomllib  # noqa: PLC0415  # lazy

    content = tomllib.loads(path.read_text(encoding="utf-8"))
    if content.get("description"):
        return printable(str(content["description"])).split(". ")[0].rstrip(".")
    base = path.parent / f"{str(content.get('extends', '')).removesuffix('.toml')}.toml"
    return _description(base) if base.is_file() else ""


class Interruption:
    """Ctrl-C and SIGTERM (what a batch system sends before it kills), taken as a request so that files can be closed.

    Within its block the first Ctrl-C or SIGTERM only sets `requested`, which calling the object tells as well; a second
    one raises KeyboardInterrupt.

    `at_once`: the first one raises, too. A library's callback may swallow the exception (compilers print "Exception
    ignored"); calling `check` now and then raises it again. Outside the main thread, where Python has no signals, the
    block changes nothing.
    """

    def __init__(self, *, at_once: bool = False) -> None:
        self.requested = False
        self._at_once = at_once
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        with contextlib.suppress(ValueError):  # not the main thread
            self._before = {number: signal.signal(number, self._strike) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        return self.requested

    def check(self) -> None:
        """Raises KeyboardInterrupt where an interruption was requested."""
        if self.requested:
            raise KeyboardInterrupt

    def _strike(self, number: int, frame: FrameType | None) -> None:
        if self._at_once or self.requested:
            self.requested = True
            raise KeyboardInterrupt
        self.requested = True


class Command:
    """A command: called without arguments it is the process, `main` does the same within another one.

    `body` takes the words of the command line and returns the exit code; the rest is for `run`.
    """

    def __init__(
        self, name: str, body: Callable[[list[str]], int], interrupted: str = "interrupted", memory: str = ""
    ) -> None:
        self.alone = False
        """Whether the process ends with the command, so that nothing needs to be loaded or kept for others."""
        self._name, self._body, self._interrupted, self._memory = name, body, interrupted, memory

    def __call__(self) -> NoReturn:
        self.alone = True
        process(self.main)

    def main(self, arguments: list[str] | None = None) -> int:
        """Run the command with these arguments (None: those of the process); returns the exit code."""
        given = sys.argv[1:] if arguments is None else arguments
        return run(self._name, lambda: self._body(given), self._interrupted, self._memory)


def process(main: Callable[[], int]) -> NoReturn:
    """A command as a process: `main`, then the end of the process without taking it apart.

    By then everything is written and closed. What is left out, Python's and LLVM's freeing of each object and module
    by itself, took a quarter of a second.
    """
    gc.set_threshold(50_000)  # imports make much that stays: looking through it every 700 objects takes 0.05 s
    sys.setswitchinterval(5e-4)  # a thread of a campaign that comes back from the kernel waits no longer
    _keep_freed_memory()

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)  # like Ctrl-C, so that every `finally` runs
    code = main()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # nobody is there to read it
            stream.flush()
    os._exit(code)


def _keep_freed_memory() -> None:
    """Let glibc keep what is freed for the next flight, a few megabytes.

    To get each page from the system anew takes a hundredth of a campaign's time. Other C libraries stay as they are.
    """
    import ctypes  # noqa: PLC0415  # lazy: --help does without

    if sys.platform == "linux" and (set_option := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        for option, size in ((_TRIM_THRESHOLD, 64 << 20), (_MMAP_THRESHOLD, 32 << 20)):
            set_option(option, size)


def _tolerate_letters() -> None:
    """A terminal that lacks a letter is no reason to fail."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def _explanation(error: Exception, memory: str) -> str:
    """What the person can do about an error that input or system cause; empty for a fault of ours."""
    if isinstance(error, ImportError) and not (error.name or "").startswith("maxq"):
        return f"a package is missing or broken: {error}; install maxq again (pip install maxq)"
    from maxq.sim.campaign.error import CampaignError  # noqa: PLC0415  # lazy, as the next: needed by an error only
    from maxq.sim.files import FileError  # noqa: PLC0415  # lazy
    from maxq.sim.input.errors import ScenarioError  # noqa: PLC0415  # lazy
    from maxq.sim.log.head import LogError  # noqa: PLC0415  # lazy

    if isinstance(error, CommandError | ScenarioError | CampaignError | LogError | FileError):
        return str(error)
    if isinstance(error, MemoryError):
        return f"not enough memory{'; ' if memory else ''}{memory}"
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {(error.strerror or str(error)).lower()}"
    return ""


def _internal(error: Exception) -> str:
    """Says that maxq is at fault, and where."""
    import traceback  # noqa: PLC0415  # lazy

    last = traceback.extract_tb(error.__traceback__)[-1]
    what = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(": ").removesuffix(":")
    how = "" if os.environ.get(TRACEBACK) else f"; {TRACEBACK}=1 in the environment shows the traceback"
    return (
        f"internal error: {what} ({os.path.basename(last.filename)}, line {last.lineno}); this is a fault of maxq, "
        f"not of your input: please report it with the command and its input files{how}"
    )
