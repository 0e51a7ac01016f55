"""Ctrl-C and SIGTERM (what a batch system sends before it kills), taken as a request so that files can be closed."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any, NoReturn, Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """Within its block the first Ctrl-C or SIGTERM only sets `requested`; a second one raises KeyboardInterrupt.

    `at_once`: the first one raises, too. A library's callback may swallow the exception (compilers print "Exception
    ignored"); calling `check` now and then raises it again. Outside the main thread, where Python has no signals, the
    block changes nothing.
    """

    def __init__(self, *, at_once: bool = False) -> None:
        self.requested = False
        self._at_once = at_once
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        try:
            self._before = {number: signal.signal(number, self._strike) for number in _SIGNALS}
        except ValueError:  # not the main thread
            self._before = {}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Raises KeyboardInterrupt where an interruption was requested."""
        if self.requested:
            raise KeyboardInterrupt

    def _strike(self, number: int, frame: FrameType | None) -> None:
        if self._at_once or self.requested:
            self.requested = True
            raise KeyboardInterrupt
        self.requested = True


def terminate_like_ctrl_c() -> None:
    """From now on SIGTERM raises KeyboardInterrupt, so that every `finally` runs."""

    def interrupt(number: int, frame: FrameType | None) -> NoReturn:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, interrupt)
