"""The one error that a person sees when a log cannot be written or read."""

from __future__ import annotations


class LogError(Exception):
    """A log file cannot be used. The message names the file and says what is wrong with it."""
