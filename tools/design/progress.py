"""Moved to maxq.tools.cli.terminal; goes when nothing imports it any more."""

from maxq.tools.cli.terminal import Progress

__all__ = ["Progress"]
