"""Moved to maxq.tools.cli.terminal; goes when nothing imports it any more."""

from maxq.tools.cli.terminal import aligned, printable

__all__ = ["aligned", "printable"]
