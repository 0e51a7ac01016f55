"""Ctrl-C as a request that is granted at the next opportunity, so that files can be closed properly."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
from typing import Any, Self


class _AtCtrlC:
    """Within its block Ctrl-C calls `_strike`.

    Outside the main thread, where Python has no signals, Ctrl-C is left as it is.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: Any = None

    def __enter__(self) -> Self:
        try:
            self._before = signal.signal(signal.SIGINT, self._strike)
        except ValueError:  # not the main thread
            self._before = None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _strike(self, number: int, frame: FrameType | None) -> None:
        raise NotImplementedError


class Interruption(_AtCtrlC):
    """Within its block the first Ctrl-C only sets `requested`; a second one raises KeyboardInterrupt."""

    def _strike(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True


class Stop(_AtCtrlC):
    """Within its block Ctrl-C raises KeyboardInterrupt, as always, and is remembered in `requested`.

    Where it strikes inside a library's callback it is lost (compilers print "Exception ignored"); whoever asks `check`
    now and then gets it all the same.
    """

    def check(self) -> None:
        """Raises KeyboardInterrupt if Ctrl-C was pressed."""
        if self.requested:
            raise KeyboardInterrupt

    def _strike(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        raise KeyboardInterrupt
