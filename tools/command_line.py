"""What the commands have in common around what they do: streams that do not fail, hints for wrong options, Ctrl-C, and
readers that have seen enough."""

from __future__ import annotations

import argparse
import difflib
import os
import sys
from collections.abc import Callable

INTERRUPTED = 130


def tolerate_letters() -> None:
    """A terminal that lacks a letter is no reason to fail."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def one_thread_a_matrix() -> None:
    """To be called before NumPy is loaded: threads of its library over matrices of forty rows wait for each other."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def unknown_option(argument: str, parser: argparse.ArgumentParser) -> str:
    """What to say of an option that `parser` does not know."""
    options = [option for action in parser._actions for option in action.option_strings]
    close = difflib.get_close_matches(argument.partition("=")[0], options, 1, 0.7)
    return f"unknown option {argument}" + (f"; did you mean {close[0]}?" if close else "")


def guarded(body: Callable[[], int], on_interrupt: str, unread: int) -> int:
    """The exit code of `body`; after Ctrl-C INTERRUPTED, and a line on stderr; `unread` where whoever read our output,
    such as `head`, has seen enough."""
    tolerate_letters()
    try:
        code = body()
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        print(on_interrupt, file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return unread
