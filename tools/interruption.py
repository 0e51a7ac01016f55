"""Moved to maxq.tools.cli.interruption; goes when nothing imports it any more."""

from maxq.tools.cli.interruption import Interruption

__all__ = ["Interruption"]
