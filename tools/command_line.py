"""What the commands have in common before they do anything: streams that do not fail, and hints for wrong options."""

from __future__ import annotations

import argparse
import difflib
import sys


def tolerate_letters() -> None:
    """A terminal that lacks a letter is no reason to fail."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def unknown_option(argument: str, parser: argparse.ArgumentParser) -> str:
    """What to say of an option that `parser` does not know."""
    options = [option for action in parser._actions for option in action.option_strings]
    close = difflib.get_close_matches(argument.partition("=")[0], options, 1, 0.7)
    return f"unknown option {argument}" + (f"; did you mean {close[0]}?" if close else "")
