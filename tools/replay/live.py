"""Flights that `simrun` shows in a viewer, either live in blocks of 0.2 s of flight, or after the flight.

    run = LiveRun(loaded, packed, view)      # in place of FlightRun: the same flight and log, bit by bit

Closing the viewer does not stop the flight.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rerun as rr

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import ChannelTable
from maxq.sim.flight.telemetry import SLOW
from maxq.sim.log.messages import Level
from maxq.sim.packing.flight import Packed
from maxq.sim.run.flight import Event, Flight, LoggedRows, copied, joined
from maxq.sim.run.fly import FlightRun
from maxq.sim.run.record import LEVELS
from maxq.sim.scenario.loader import LoadedScenario
from maxq.tools.flight_report import verdict_line
from maxq.tools.replay import convert, stream, viewer
from maxq.tools.replay.flight import Moment, ShownLaunchSite, has_motion, launch_site, open_flight
from maxq.tools.replay.plots import tabs_of
from maxq.tools.replay.run import temporary_recording
from maxq.tools.replay.scene import Scene, send_ground, tail_below_cg
from maxq.tools.replay.text import drawn_text
from maxq.tools.replay.vehicle_shape import Exaggeration, shape_of
from maxq.tools.replay.viewer import LOCAL, ReplayError

BLOCK_NS = 200_000_000
BENDING, SLOSH = 1000.0, 5.0
"""The exaggeration of a live flight, whose largest bending and slosh angle are not known in advance."""
_ROOT = "flight"
_PATIENCE_S, _FLOWN_PATIENCE_S = 5.0, 30.0
_SCENE_EVERY_S, _PLOTS_EVERY_S = 0.15, 0.9


def _connected(name: str, port: int) -> rr.RecordingStream:
    """Return a recording in the viewer that listens on `port`."""
    recording = rr.RecordingStream(stream.APPLICATION, recording_id=f"{name}, {time.time_ns()}")
    recording.connect_grpc(f"rerun+http://{LOCAL}:{port}/proxy")
    return recording


class FlownView:
    """A viewer for the log of a completed flight.

    It is the viewer that listens on `port` of this machine, or a new window if `port` is None. Create it before the
    flight, so that a missing viewer is reported before the flight. Raises ReplayError.
    """

    def __init__(self, port: int | None) -> None:
        self._port = viewer.listening(port)

    def show(self, log: Path) -> None:
        """Show a log. If the viewer is a new window, return when it is closed.

        Raises ReplayError if the log or the viewer fails.
        """
        flight = open_flight(log)
        if self._port is None:
            with temporary_recording() as path:
                convert.save([flight], convert.Options(), path)
                viewer.show(path)
            return
        recording = _connected(flight.label, self._port)
        made = convert.send_flights(recording, [flight], convert.Options())
        recording.send_blueprint(made, make_active=True, make_default=True)
        try:
            recording.flush(timeout_sec=_FLOWN_PATIENCE_S)
        except (RuntimeError, ValueError) as error:
            raise ReplayError(f"the viewer on port {self._port} does not take the flight: {error}") from error
        recording.disconnect()


class Block:
    """Rows of a running flight by channel name. `start_place_deg` is the latitude and longitude of the start of the
    flight.
    """

    def __init__(self, table: ChannelTable, rows: LoggedRows, start_place_deg: tuple[float, float] | None) -> None:
        self.table = table
        self._rows = rows
        self.start_place_deg = start_place_deg or (float(self["latitude_deg"][0]), float(self["longitude_deg"][0]))

    def __contains__(self, name: str) -> bool:
        return name in self.table

    def __getitem__(self, name: str) -> Array:
        return self._rows[self.table.topic(name).group][1][:, self.table.index(name)]

    def time_ns(self, name: str) -> IntArray:
        return self._rows[self.table.topic(name).group][0]


class LiveView:
    """A viewer for a running flight.

    It is the viewer that listens on `port` of this machine, or a new window if `port` is None. Raises ReplayError if
    neither is available.
    """

    def __init__(self, loaded: LoadedScenario, port: int | None = None) -> None:
        if viewer.listening(port) is None:
            port = viewer.free_port()
            self._process = viewer.window(port)
        assert port is not None
        self._loaded = loaded
        self._scenario = scenario = loaded.scenario
        self._recording = _connected(scenario.name, port)
        self._shape = shape_of(scenario.vehicle)
        self._place: ShownLaunchSite | None = None
        self._exaggeration = Exaggeration(BENDING, SLOSH, 1.5 * self._shape.diameter_m)
        self._start_s = scenario.run.start_s
        self._scene: Scene | None = None
        self._grid = ""
        self._moments: dict[Event, Moment] = {}
        self._phases: list[stream.Phase] = []
        self._start_place: tuple[float, float] | None = None
        self._table: ChannelTable | None = None
        self._for_scene: list[LoggedRows] = []
        self._for_plots: list[LoggedRows] = []
        self._scene_sent_s = self._plots_sent_s = -_PLOTS_EVERY_S
        self.stop: Callable[[], bool] = lambda: False

    def run(self, packed: Packed, factor: float | None) -> LiveRun:
        """Return the flight, which is flown like any other. `factor` is as in `LiveRun`."""
        return LiveRun(self._loaded, packed, self, factor)

    def add(self, run: FlightRun, rows: LoggedRows) -> None:
        """Show the rows of a block and the events since the last block.

        A viewer processes some hundred messages per second, and each entity of a block is one message. Therefore, rows
        are collected for a minimum time between messages. In real time, every block is shown immediately, and its plots
        every few blocks. At full speed, thousands of blocks within a second or two are sent as a few large blocks.
        """
        if not len(rows[SLOW][0]):
            return
        self._for_scene.append(rows)
        self._for_plots.append(rows)
        now_s = time.monotonic()
        if now_s - self._scene_sent_s >= _SCENE_EVERY_S:
            self._send_scene(run)
        if now_s - self._plots_sent_s >= _PLOTS_EVERY_S:
            self._send_plots(run)
        self._send_events(run)

    def end(self, run: FlightRun, flight: Flight) -> None:
        """Show the complete flight, with fixed axes and its outcome."""
        if self._for_scene:
            self._send_scene(run)
        if self._for_plots:
            self._send_plots(run)
        self._send_events(run)
        if self._table is None:
            return
        outcome = f"**{verdict_line(flight)}**"
        self._send_about([outcome, "", f"{flight.outcome} at {flight.end_s:.1f} s"])
        eyes = self._first_eyes()
        if self._scene is not None and self._scene.track:
            positions = np.concatenate(self._scene.track)
            eyes = convert.eyes_for(self._shape.length_m, self._scenario.site.azimuth_deg, positions)
        self._send_layout(eyes, max(flight.end_s, self._start_s + 1.0), live=False)
        with contextlib.suppress(RuntimeError, ValueError):  # the viewer was closed
            self._recording.flush(timeout_sec=_PATIENCE_S)
        self._recording.disconnect()

    # -- pieces ----------------------------------------------------------------------------------------------------
    def _send_scene(self, run: FlightRun) -> None:
        block = self._block(run, self._for_scene)
        if self._scene is not None:
            self._scene.add(block)
        self._for_scene, self._scene_sent_s = [], time.monotonic()

    def _send_plots(self, run: FlightRun) -> None:
        block = self._block(run, self._for_plots)
        stream.send_curves(self._recording, _ROOT, self._tabs, block, round(1e9 / convert.DEFAULT_RATE_HZ))
        stream.send_now(self._recording, [("", block)])
        self._send_limits(int(block.time_ns("latitude_deg")[-1]))
        self._for_plots, self._plots_sent_s = [], time.monotonic()

    def _block(self, run: FlightRun, parts: list[LoggedRows]) -> Block:
        block = Block(run.table, joined(parts), self._start_place)
        self._start_place = block.start_place_deg
        if self._table is None:
            self._begin(block)
        return block

    def _begin(self, block: Block) -> None:
        recording, scenario = self._recording, self._scenario
        self._table = block.table
        self._tabs = tabs_of(block.table, scenario, self._shape)
        recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stream.send_styles(recording, _ROOT, self._tabs)
        self._limits_until_ns = round(self._start_s * 1e9)
        self._send_limits(self._limits_until_ns, styled=True)
        if has_motion(block):
            self._place = launch_site(scenario.earth, scenario.site, block)
            self._scene = Scene(recording, _ROOT, self._place, self._shape, self._exaggeration)
            self._grid = send_ground(recording, self._place, self._reach_m(), tail_below_cg(block, self._shape))
        self._send_about([scenario.description])
        self._send_layout(self._first_eyes(), self._start_s, live=True)
        self._phases = [stream.first_phase(block, round(self._start_s * 1e9))]
        stream.send_phases(recording, _ROOT, self._phases, styled=True)

    def _send_about(self, lines: list[str]) -> None:
        text = [f"# {self._scenario.name}", "", *lines, "", *drawn_text(self._exaggeration, self._place)]
        self._recording.log("about", rr.TextDocument("\n".join(text), media_type="text/markdown"), static=True)

    def _send_limits(self, until_ns: int, *, styled: bool = False) -> None:
        """Send the limits up to the current time only, since the viewer's cursor follows the latest of all samples."""
        for plot in (plot for tab in self._tabs for plot in tab.plots):
            required = [limit for limit in plot.limits if limit.required]
            stream.send_limits(self._recording, plot, required, (self._limits_until_ns, until_ns), styled=styled)
        self._limits_until_ns = until_ns

    def _send_layout(self, eyes: convert.Eyes, end_s: float, *, live: bool) -> None:
        pictures = []
        if self._scene is not None and self._table is not None:
            factor = self._exaggeration.text(self._table)
            name = f"Vehicle ({factor})" if factor else "Vehicle"
            pictures = [convert.close_view(_ROOT, eyes, name), convert.overview([_ROOT], eyes, self._grid)]
        made = convert.layout(
            [_ROOT], pictures, self._tabs, [convert.TimeSpan("", (self._start_s, end_s), {})], live=live
        )
        self._recording.send_blueprint(made, make_active=True, make_default=True)

    def _send_events(self, run: FlightRun) -> None:
        for event in run.events:
            if event in self._moments:
                continue
            moment = Moment(event.name, event.time_ns, event.text, LEVELS.get(event.name, Level.INFO))
            self._moments[event] = moment
            stream.send_events(self._recording, [("", [*self._moments.values()])], moment.time_ns)
            now = stream.phases(self._phases[0], self._moments.values())
            stream.send_phases(self._recording, _ROOT, [p for p in now if p not in self._phases], styled=False)
            self._phases = now

    def _reach_m(self) -> float:
        """Return an estimate of the range: half that of a throw at 45 deg with the speed that all stages gain without
        drag.

        It is at least 1 km and at most 2000 km.
        """
        speed = 0.0
        for stage in self._scenario.vehicle.stage:
            if not stage.engines:
                continue
            time_s = np.unique(np.concatenate([e.table["time_s"] for e in stage.engines]))
            thrust = sum(np.interp(time_s, e.table["time_s"], e.table["thrust_vacuum_N"]) for e in stage.engines)
            mass = np.full(len(time_s), stage.mass.mass_kg or 1.0)
            if stage.mass.table is not None:
                mass = np.interp(time_s, stage.mass.table["time_s"], stage.mass.table["mass_kg"])
            speed += float(np.trapezoid(np.maximum(thrust / mass - 9.8, 0.0), time_s))
        return float(np.clip(0.5 * speed * speed / 9.8, 1000.0, 2e6))

    def _first_eyes(self) -> convert.Eyes:
        reach, a = self._reach_m(), np.radians(self._scenario.site.azimuth_deg)
        ahead = reach * np.array([np.sin(a), np.cos(a), 0.0])
        corners = np.array([[0.0, 0.0, 0.0], ahead, 0.5 * ahead + [0.0, 0.0, 0.5 * reach]])
        return convert.eyes_for(self._shape.length_m, self._scenario.site.azimuth_deg, corners)


class LiveRun(FlightRun):
    """A flight that is sent to a view block by block. Its segments, rows and log equal those of a `FlightRun`, bit by
    bit.

    `factor` is the ratio of flight time to real time (None: full speed). The view's `stop` is called after every block,
    so that a flight in real time can be interrupted immediately.
    """

    def __init__(
        self, loaded: LoadedScenario, packed: Packed | None, view: LiveView, factor: float | None = None
    ) -> None:
        super().__init__(loaded, packed, log=True)
        self._view, self._factor = view, factor
        self._begun_s = time.monotonic()
        self._begun_ns = int(self.memory.clock.now_ns)
        self._block_ns = self._block_length_ns()

    def fly_segment(self, length_ns: int | None = None) -> LoggedRows:
        """Fly a segment like `FlightRun.fly_segment`, and show it block by block. A segment of given length is not
        shown.
        """
        if length_ns is not None:
            return super().fly_segment(length_ns)
        end_ns = (int(self.memory.clock.now_ns) // self.segment_ns + 1) * self.segment_ns
        parts = []
        while not self.finished and int(self.memory.clock.now_ns) < end_ns:
            rows = copied(super().fly_segment(self._block_ns))
            self._pace()
            self._view.add(self, rows)
            parts.append(rows)
            if self._view.stop():
                break
        return joined(parts)

    def result(self, rows: LoggedRows | None = None) -> Flight:
        flight = super().result(rows)
        self._view.end(self, flight)
        return flight

    def _block_length_ns(self) -> int:
        """Return the length of a block: about 0.2 s, such that a segment has whole blocks of whole steps.

        If there is no such length, it is that of the segment.
        """
        step_ns = int(self.packed.parameters[0].timeline.step_ns)
        for count in range(max(1, self.segment_ns // BLOCK_NS), 1, -1):
            if self.segment_ns % (count * step_ns) == 0:
                return self.segment_ns // count
        return self.segment_ns

    def _pace(self) -> None:
        if self._factor is None:
            return
        due_s = (int(self.memory.clock.now_ns) - self._begun_ns) / 1e9 / self._factor
        while (left_s := self._begun_s + due_s - time.monotonic()) > 0.0 and not self._view.stop():
            time.sleep(min(left_s, 0.1))
