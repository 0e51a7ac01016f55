"""The common frame of the commands: exit codes, messages, interruption, and the end of the process.

No expensive module is imported here, so that `simrun --help` takes less than 0.1 s.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import stat
import sys
import threading
import warnings
from collections.abc import Callable
from enum import IntEnum
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn, Self

from maxq.tools.cli.system import linux_function
from maxq.tools.cli.terminal import aligned, columns, folded, printable, tell, wipe

if TYPE_CHECKING:
    from pathlib import Path

FIRST = ("nominal", "campaigns/first", "ksr3-identical", "ksr3-default", "standard")
"""The built-in files for beginners, which --list names first."""
TRACEBACK = "MAXQ_TRACEBACK"
"""The environment variable that makes an error print its traceback too."""
GRACE_S = 3.0
"""The time within which an interrupted command must end in an orderly way before it is ended."""
_POLL_S = 0.2
_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""The signals that interrupt a command: of Ctrl-C, of batch systems, and of a terminal that is closed."""
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # options of glibc's malloc.h, in bytes


class Exit(IntEnum):
    """The exit codes of all commands. The --help of each command lists the specific meanings of 0, 1 and 3."""

    OK = 0  # done: flown, designed, accepted, shown
    FAILED = 1  # done, with a negative result
    BAD_INPUT = 2  # wrong arguments or files, or files that cannot be read or written
    UNDECIDED = 3  # more runs are needed
    INTERNAL_ERROR = 70  # a fault in maxq (EX_SOFTWARE of sysexits.h)
    INTERRUPTED = 130  # Ctrl-C, SIGTERM or SIGHUP
    UNREAD = 141  # the reader of the output, such as `head`, has closed it (as the shell reports SIGPIPE)


class CommandError(Exception):
    """An error for a request that cannot be met. The text gives the reason on one line."""


def say(command: str, text: str) -> None:
    """Print a message for the user, one line on stderr (folded at spaces on a terminal)."""
    wipe()
    print(folded(f"{command}: {printable(text)}", columns(sys.stderr)), file=sys.stderr)


def run(command: str, body: Callable[[], int], interrupted: str = "interrupted", memory: str = "") -> int:
    """Run `body` and return its exit code.

    An exception is reported on one line of stderr and has its own exit code. `interrupted` is the message after Ctrl-C.
    `memory` is the advice printed when memory runs out.
    """
    _tolerate_letters()
    # Set before NumPy is loaded: the threads of its BLAS only block each other for matrices of forty rows.
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
    """Print each note on a name (`sim.input.files.NameNote`) once. Other warnings are shown as usual."""
    usual, said = warnings.showwarning, set[str]()

    def show(message: Warning | str, category: type[Warning], *place: Any) -> None:
        if category.__name__ != "NameNote":
            usual(message, category, *place)
        elif str(message) not in said:
            said.add(str(message))
            say(command, f"note: {message}")

    warnings.showwarning = show  # type: ignore[assignment]  # the further parameters are in *place


def show_list(kinds: dict[str, str]) -> int:
    """Print the names and descriptions of built-in files, for the option --list. Return the exit code.

    `kinds` maps each kind (a key of FOLDERS in sim/input/files.py) to the title above its files. All descriptions begin
    in the same column.
    """
    from maxq.sim.input.files import builtin_files  # noqa: PLC0415  # lazy: --help is quick

    found = {kind: builtin_files(kind) for kind in kinds}
    width = max(len(name) for files in found.values() for name in files)
    for k, (kind, title) in enumerate(kinds.items()):
        files = sorted(found[kind].items(), key=lambda item: (item[0] not in FIRST, "/" in item[0], item[0]))
        rows = [(name.ljust(width), _description(path)) for name, path in files]
        tell(*[""] * (k > 0), title, *aligned(rows, "  "))
    return Exit.OK


def _description(path: Path) -> str:
    """Return the first sentence of a file's description, else of the description of the file that it extends,
    else "".
    """
    import tomllib  # noqa: PLC0415  # lazy

    content = tomllib.loads(path.read_text(encoding="utf-8"))
    if content.get("description"):
        return printable(str(content["description"])).split(". ")[0].rstrip(".")
    base = path.parent / f"{str(content.get('extends', '')).removesuffix('.toml')}.toml"
    return _description(base) if base.is_file() else ""


class Interruption:
    """A context manager for Ctrl-C, SIGTERM and SIGHUP, so that files can be closed. Batch systems send SIGTERM before
    they kill, and a terminal sends SIGHUP when it is closed.

    Within the block, the first signal only sets `requested`, which a call of the object also returns. The second signal
    raises KeyboardInterrupt.

    With `at_once`, the first signal raises as well. A library's callback may suppress the exception (compilers print
    "Exception ignored"); regular calls of `check` raise it again. Outside the main thread, where Python has no signals,
    the block changes nothing.

    If the block is still active `GRACE_S` after the first signal, because a call takes minutes, another thread calls
    `last_resort`, which ends the process (`Command.end`).
    """

    def __init__(self, *, at_once: bool = False, last_resort: Callable[[], object] | None = None) -> None:
        self.requested = False
        self._at_once, self._last_resort, self._over = at_once, last_resort, threading.Event()
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        with contextlib.suppress(ValueError):  # not the main thread
            self._before = _handled(self._strike)
        if self._last_resort is not None:  # started here, because a signal handler may interrupt a thread's start
            threading.Thread(target=self._limit, args=(self._last_resort,), daemon=True).start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        return self.requested

    def check(self) -> None:
        """Raise KeyboardInterrupt if an interruption was requested."""
        if self.requested:
            raise KeyboardInterrupt

    def _strike(self, number: int, frame: FrameType | None) -> None:
        _leave_terminal(number)
        if self._at_once or self.requested:
            self.requested = True
            raise KeyboardInterrupt
        self.requested = True

    def _limit(self, last_resort: Callable[[], object]) -> None:
        while not self.requested:
            if self._over.wait(_POLL_S):
                return
        if not self._over.wait(GRACE_S):
            last_resort()


class Command:
    """A command. Calling the object runs it as the process, which then ends; `main` runs it within another process.

    `body` takes the words of the command line and returns the exit code. The other arguments are those of `run`.
    """

    def __init__(
        self, name: str, body: Callable[[list[str]], int], interrupted: str = "interrupted", memory: str = ""
    ) -> None:
        self.alone = False
        """True if the process ends with the command, so that nothing needs to be loaded or kept for others."""
        self._name, self._body, self._interrupted, self._memory = name, body, interrupted, memory

    def __call__(self) -> NoReturn:
        self.alone = True
        process(self.main)

    def end(self, text: str = "") -> NoReturn:
        """End the process as interrupted, whatever its threads are computing. `text` replaces the usual message."""
        say(self._name, text or self._interrupted)
        os._exit(Exit.INTERRUPTED)

    def main(self, arguments: list[str] | None = None) -> int:
        """Run the command with these arguments (None: those of the process). Return the exit code."""
        given = sys.argv[1:] if arguments is None else arguments
        return run(self._name, lambda: self._body(given), self._interrupted, self._memory)


def process(main: Callable[[], int]) -> NoReturn:
    """Run `main`, then end the process with its exit code, without the usual cleanup.

    By then, all files are written and closed. The omitted cleanup, in which Python and LLVM free each object and module
    separately, takes a quarter of a second.
    """
    gc.set_threshold(50_000)  # imports create many permanent objects: collecting every 700 takes 0.05 s
    sys.setswitchinterval(5e-4)  # a campaign's thread that returns from the kernel waits no longer than this
    _keep_freed_memory()

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        _leave_terminal(number)
        raise KeyboardInterrupt

    _handled(interrupt)  # like Ctrl-C, so that every `finally` runs
    code = main()
    wipe()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):  # the reader has closed the output
            stream.flush()
    os._exit(code)


def _handled(handler: Callable[[int, FrameType | None], Any]) -> dict[signal.Signals, Any]:
    """Install a handler of the signals that interrupt a command, and return the earlier handlers.

    A signal that is ignored stays ignored: SIGHUP by `nohup`, SIGINT by a shell in its background jobs. Raises
    ValueError outside the main thread.
    """
    return {s: signal.signal(s, handler) for s in _SIGNALS if signal.getsignal(s) is not signal.SIG_IGN}


def _leave_terminal(number: int) -> None:
    """Replace streams of a terminal by the null device after SIGHUP, because writing to a closed terminal fails."""
    if number != getattr(signal, "SIGHUP", None):
        return
    null = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        with contextlib.suppress(OSError):  # a stream that is closed
            if stat.S_ISCHR(os.fstat(stream).st_mode):
                os.dup2(null, stream)
    os.close(null)


def _keep_freed_memory() -> None:
    """Configure glibc to keep the few megabytes that a flight frees for the next flight.

    Requesting each page from the system again takes a hundredth of a campaign's time. Other C libraries are not
    changed.
    """
    if (set_option := linux_function("mallopt")) is not None:
        for option, size in ((_TRIM_THRESHOLD, 64 << 20), (_MMAP_THRESHOLD, 32 << 20)):
            set_option(option, size)


def _tolerate_letters() -> None:
    """Replace characters that the encoding of a stream lacks, instead of raising an error."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def _explanation(error: Exception, memory: str) -> str:
    """Return the message for an error due to the input or the system, or "" for a fault in maxq."""
    if isinstance(error, ImportError) and not (error.name or "").startswith("maxq"):
        return f"a package is missing or broken: {error}; install maxq again (pip install maxq)"
    from maxq.sim.campaign.error import CampaignError  # noqa: PLC0415  # lazy, like the next three: for errors
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
    """Return the message for a fault in maxq, with the place at which it occurred."""
    import traceback  # noqa: PLC0415  # lazy

    last = traceback.extract_tb(error.__traceback__)[-1]
    what = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(": ").removesuffix(":")
    how = "" if os.environ.get(TRACEBACK) else f"; {TRACEBACK}=1 in the environment shows the traceback"
    return (
        f"internal error: {what} ({os.path.basename(last.filename)}, line {last.lineno}); this is a fault in maxq, "
        f"not in your input: please report it with the command and its input files{how}"
    )
