"""What stops `simreplay`: one line for the person who called it."""

from __future__ import annotations

from maxq.tools.cli.frame import CommandError


class ReplayError(CommandError):
    """Nothing can be shown; the text says why and what can be done."""
