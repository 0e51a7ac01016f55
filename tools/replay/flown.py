"""A log shown once its flight has been flown: `simrun --from DIR --run N --view`."""

from __future__ import annotations

import time
from pathlib import Path

import rerun as rr

from maxq.tools.replay import viewer
from maxq.tools.replay.convert import Options, send_flights
from maxq.tools.replay.error import ReplayError
from maxq.tools.replay.flight import open_flight
from maxq.tools.replay.run import window_of
from maxq.tools.replay.sending import APPLICATION
from maxq.tools.replay.web_page import LOCAL

_PATIENCE_S = 30.0


class FlownView:
    """Where the log will be shown: in a viewer that listens on `port` of this machine, or in a window (None).

    Made before the flight, so that nothing is flown for nothing. Raises ReplayError where there is no viewer.
    """

    def __init__(self, port: int | None) -> None:
        self._port = port
        if port is None:
            viewer.executable()
            viewer.check_display()
        elif viewer.port_is_free(port):
            raise ReplayError(f"no viewer listens on port {port} of {LOCAL}")

    def show(self, log: Path) -> None:
        """Show it; a window is waited for. Raises ReplayError where the log or the viewer fails."""
        flight = open_flight(log)
        if self._port is None:
            window_of([flight])
            return
        recording = rr.RecordingStream(APPLICATION, recording_id=f"{flight.label}, {time.time_ns()}")
        recording.connect_grpc(f"rerun+http://{LOCAL}:{self._port}/proxy")
        layout = send_flights(recording, [flight], Options())
        recording.send_blueprint(layout, make_active=True, make_default=True)
        try:
            recording.flush(timeout_sec=_PATIENCE_S)
        except (RuntimeError, ValueError) as error:
            raise ReplayError(f"the viewer on port {self._port} does not take the flight: {error}") from error
        recording.disconnect()
