"""The sending of data to a recording over time: curves decimated to their extremes, limits, events and phases.

With an entity for each curve of each flight, a campaign would need thousands of entities, and the viewer a minute to
load them. Therefore, the curves of many flights are sent as families: an entity for each curve, with a line for each
flight.
"""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import rerun as rr

from maxq.control.kernel.records import Array, IntArray
from maxq.tools.plots.palette import BLUE, GREY, LIMIT, ON_DARK, ORANGE, PALE, PURPLE, RED, SKY, rgba
from maxq.tools.replay.decimate import extremes, extremes_on_grid, last_before
from maxq.tools.replay.flight import Channels, Moment
from maxq.tools.replay.plots import Limit, PlotAxis, PlotLine, ReplayPlot, Tab

TIMELINE = "sim_time"
APPLICATION = "maxq"
FAMILY = "family"
"""The root of the entities for the curves of many flights."""
FAMILY_FROM = 20
"""The number of flights without a drawn vehicle from which on their curves are sent as families."""
PHASES = {
    "held down": GREY,
    "powered": ORANGE,
    "coasting up": SKY,
    "falling": BLUE,
    "control lost": RED,
    "tumbling": PURPLE,
    "diverged": RED,
    "ended": PALE,
}
_BEGUN_BY = {
    "liftoff": "powered",
    "ignition": "powered",
    "restart": "powered",
    "cutoff": "coasting up",
    "burnout": "coasting up",
    "apogee": "falling",
    "control_lost": "control lost",
    "tumble": "tumbling",
    "impact": "ended",
    "diverged": "diverged",
}
_WORSE = ("control lost", "tumbling")
_EVENT_WIDTH = 46  # characters in a row of the list of events, at 1920 pixels
_TEETH = 240  # teeth of the hatching over the whole flight
WIDTHS = (3.2, 1.8, 1.0, 0.5)
"""The widths of the curves of a flight that share one name in the legend."""
_MIN_MAX = rr.components.AggregationPolicy.MinMax  # keep the extremes when the viewer zooms out


# -- columns -------------------------------------------------------------------------------------------------------
def times(times_ns: IntArray) -> list[rr.TimeColumn]:
    """Return the time column for `send_columns`."""
    return [rr.TimeColumn(TIMELINE, duration=times_ns.astype("timedelta64[ns]"))]


def set_time(recording: rr.RecordingStream, time_ns: int) -> None:
    recording.set_time(TIMELINE, duration=np.timedelta64(time_ns, "ns"))


def matrices(columns: Array) -> pa.Array:
    """Return matrices (n, 9), in column-major order, for `Transform3D.columns`.

    That function would convert other forms one by one.
    """
    kind = rr.components.TransformMat3x3Batch(np.eye(3)).pa_array.type
    return pa.FixedSizeListArray.from_arrays(pa.array(columns.astype("f4").ravel()), type=kind)


def send_scalars(recording: rr.RecordingStream, entity: str, times_ns: IntArray, values: Array) -> None:
    recording.send_columns(entity, times(times_ns), rr.Scalars.columns(scalars=values))


# -- curves --------------------------------------------------------------------------------------------------------
def _curves(root: str, tabs: Sequence[Tab]) -> Iterator[tuple[str, int, ReplayPlot, PlotLine]]:
    """Yield the entity, the index within its plot, the plot and the line of every curve of these tabs."""
    for tab in tabs:
        for plot in tab.plots:
            for i, curve in enumerate(plot.curves):
                yield f"{root}/plots/{plot.key}/curve_{i + 1}", i, plot, curve


def send_styles(
    recording: rr.RecordingStream,
    root: str,
    tabs: Sequence[Tab],
    colour: str | None = None,
    prefix: str = "",
    alpha: float = 1.0,
    by_width: Collection[str] = (),
) -> None:
    """Send the names, colours and widths of a flight's curves.

    `colour` applies to all curves (None: a separate colour for each). `prefix` precedes the names. In the plots
    `by_width` (keys), it is the name of all curves, which the viewer's legend lists once; there, the curves differ in
    width (`send_widths`).
    """
    for entity, i, plot, curve in _curves(root, tabs):
        own, merged = rgba(colour or ON_DARK[i % len(ON_DARK)], alpha), plot.key in by_width
        name, width = (prefix.removesuffix(": "), WIDTHS[i]) if merged else (prefix + curve.label, 1.4)
        lines = rr.SeriesLines(names=name, colors=own, widths=width, aggregation_policy=_MIN_MAX)
        recording.log(entity, lines, static=True)


def width_text(plot: ReplayPlot) -> str:
    """Return the entry in the legend for curves that differ in width."""
    return f"thick to thin: {', '.join(curve.label for curve in plot.curves)}"


def send_widths(recording: rr.RecordingStream, plot: ReplayPlot, time_ns: int) -> None:
    """Send a curve without values whose name in the legend is the order of the widths of a plot's curves."""
    entity = f"{limits_root(plot)}/widths"
    recording.log(entity, rr.SeriesLines(names=width_text(plot), colors=rgba(GREY, 1.0), widths=1.0), static=True)
    send_scalars(recording, entity, np.array([time_ns]), np.array([np.nan]))


def send_curves(
    recording: rr.RecordingStream, root: str, tabs: Sequence[Tab], channels: Channels, interval_ns: int
) -> None:
    """Send the curves of a block or of a whole log, decimated to their extremes in intervals of `interval_ns`."""
    for entity, _, _, curve in _curves(root, tabs):
        ns, values = curve.values(channels)
        if len(ns):
            kept = extremes(ns, values, interval_ns, even=True)
            send_scalars(recording, entity, ns[kept], values[kept])


class Family:
    """A collection of the curves of many flights that are sent together.

    All lines of an entity share their times. Therefore, every interval has two rows, at a quarter and at three quarters
    of its length. They contain its smallest and largest value in the order of the trend. No value is changed, but the
    time of a value may be wrong by up to three quarters of an interval.
    """

    def __init__(self, span_s: tuple[float, float], interval_ns: int) -> None:
        self._interval_ns = interval_ns
        self._start_ns = round(span_s[0] * 1e9) // interval_ns * interval_ns
        self._count = (round(span_s[1] * 1e9) - self._start_ns) // interval_ns + 1
        self._lines: dict[tuple[str, str], list[tuple[str, str, Array]]] = {}

    def add(self, label: str, colour: str, tabs: Sequence[Tab], channels: Channels) -> None:
        """Add a flight's curves in these tabs, named by its label."""
        for _, _, plot, curve in _curves("", tabs):
            ns, values = curve.values(channels)
            rows = extremes_on_grid(ns, values, self._start_ns, self._interval_ns, self._count)
            line = f"{label}: {curve.label}", colour, rows.astype("f4")
            self._lines.setdefault((plot.key, curve.label), []).append(line)

    def send(self, recording: rr.RecordingStream) -> None:
        """Send all collected curves and clear the collection."""
        row = np.arange(2 * self._count)
        at = self._start_ns + row // 2 * self._interval_ns + np.where(row % 2, 3, 1) * self._interval_ns // 4
        for number, key in enumerate(list(self._lines)):
            names, colours, columns = zip(*self._lines.pop(key), strict=True)
            entity = f"{FAMILY}/plots/{key[0]}/curve_{number + 1}"
            style = rr.SeriesLines(
                names=names,
                colors=[rgba(colour, 0.5) for colour in colours],
                widths=[1.2] * len(names),
                aggregation_policy=_MIN_MAX,
            )
            recording.log(entity, style, static=True)
            values = np.stack(columns, axis=1)
            some = np.flatnonzero(np.isfinite(values).any(axis=1))
            send_scalars(recording, entity, at[some], values[some].astype(float))


# -- limits --------------------------------------------------------------------------------------------------------
def limits_root(plot: ReplayPlot) -> str:
    return f"limits/{plot.key}"


def send_limits(
    recording: rr.RecordingStream,
    plot: ReplayPlot,
    limits: Sequence[Limit],
    span_ns: tuple[int, int],
    axis: PlotAxis | None = None,
    *,
    styled: bool = True,
) -> None:
    """Send a line at each limit between two times and, if the axis is known, hatching beyond the limit.

    A running flight sends the limits piece by piece; `styled` is True only for the first piece.
    """
    ends = np.array(span_ns, np.int64)
    along = np.linspace(*span_ns, 2 * _TEETH + 1).astype(np.int64)
    for i, limit in enumerate(limits):
        parts = [("line", ends, np.full(2, limit.value), 1.6, 1.0)]
        if axis is not None:
            teeth = np.where(np.arange(len(along)) % 2 == 0, limit.value, axis.high if limit.upper else axis.low)
            parts.append(("band", along, teeth, 1.0, 0.45))
        for part, at, values, width, alpha in parts:
            entity = f"{limits_root(plot)}/limit_{i + 1}/{part}"
            if styled:
                colour = rgba(LIMIT if limit.required else GREY, alpha)
                style = rr.SeriesLines(names=f"limit: {limit.text}", colors=colour, widths=width)
                recording.log(entity, style, static=True)
            send_scalars(recording, entity, at, values)


# -- read-outs -----------------------------------------------------------------------------------------------------
_READ = {  # channel, factor to the unit, number of decimals
    "altitude, km": ("altitude_m", 1e-3, 2),
    "speed, m/s": ("speed_mps", 1.0, 1),
    "Mach number": ("mach", 1.0, 2),
    "dynamic pressure, kPa": ("dynamic_pressure_Pa", 1e-3, 2),
    "angle of attack, deg": ("alpha_total_deg", 1.0, 2),
    "pitch gimbal angle, deg": ("gimbal_pitch_angle_deg", 1.0, 2),
    "yaw gimbal angle, deg": ("gimbal_yaw_angle_deg", 1.0, 2),
}


def send_now(recording: rr.RecordingStream, flights: Sequence[tuple[str, Channels]]) -> None:
    """Send a table of the key values every fifth of a second, with a column for each flight."""
    rows = [(what, how) for what, how in _READ.items() if any(how[0] in channels for _, channels in flights)]
    known = [channels.time_ns(name) for _, channels in flights for _, (name, *_) in rows if name in channels]
    known = [ns for ns in known if len(ns)]
    if not known:
        return
    step = 200_000_000
    at = np.arange(min(ns[0] for ns in known) // step, max(ns[-1] for ns in known) // step + 1) * step

    def cells(name: str, factor: float, digits: int, channels: Channels) -> list[str]:
        ns = channels.time_ns(name) if name in channels else np.zeros(0, np.int64)
        if not len(ns):
            return [""] * len(at)
        values = factor * channels[name][last_before(ns, at)]
        shown = np.isfinite(values) & (at <= ns[-1] + step)
        return [f"{v:z.{digits}f}" if ok else "" for v, ok in zip(values.tolist(), shown, strict=True)]

    head = "| quantity | " + " | ".join(label or "value" for label, _ in flights) + " |\n|---|" + "--:|" * len(flights)
    table = [(what, [cells(*how, channels) for _, channels in flights]) for what, how in rows]
    texts = []
    for k, t in enumerate(at):
        lines = (f"| {what} | {' | '.join(one[k] for one in each)} |" for what, each in table)
        texts.append("\n".join([f"**{t / 1e9:.1f} s**", "", head, *lines]))
    columns = rr.TextDocument.columns(text=texts, media_type=["text/markdown"] * len(texts))
    recording.send_columns("now", times(at), columns)


# -- events and phases ---------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Phase:
    """A phase of a flight, such as `powered`, from `start_ns` on."""

    name: str
    start_ns: int


def first_phase(channels: Channels, start_ns: int) -> Phase:
    """Return the phase at the start of a flight, from its first sample."""

    def first(name: str) -> float:
        return float(channels[name][0]) if name in channels and len(channels[name]) else 0.0

    if first("on_pad") > 0.0:
        return Phase("held down", start_ns)
    if first("thrust_N") > 0.0:
        return Phase("powered", start_ns)
    return Phase("coasting up" if first("v_N_down_mps") < 0.0 else "falling", start_ns)


def phases(first: Phase, moments: Iterable[Moment]) -> list[Phase]:
    """Return the phases of a flight in order. After a loss of control, only worse phases or the end follow."""
    out = [first]
    for moment in sorted(moments, key=lambda m: m.time_ns):
        name, now = _BEGUN_BY.get(moment.name), out[-1].name
        if name is None or name == now or (moment.name == "ignition" and now == "held down"):
            continue
        if now in _WORSE and name not in (*_WORSE, "diverged", "ended"):
            continue
        out.append(Phase(name, moment.time_ns))
    return out


def send_events(
    recording: rr.RecordingStream, flights: Sequence[tuple[str, Iterable[Moment]]], start_ns: int, note: str = ""
) -> None:
    """Send a table of the events of the flights at the time of each event, with this event in bold.

    `flights` contains labels and events. `note` is written below the table.
    """
    every = sorted(((m, label) for label, moments in flights for m in moments), key=lambda each: each[0].time_ns)
    several = len(flights) > 1
    head = ["| time, s | flight | event |", "|--:|---|---|"] if several else ["| time, s | event |", "|--:|---|"]
    times_ns = [start_ns, *(m.time_ns for m, _ in every)]
    for last, time_ns in enumerate(times_ns, -1):
        rows = list(head)
        for n, (moment, label) in enumerate(every):
            first, strong = [f"{moment.time_s:.3f}", *[label] * several], "**" if n == last else ""
            for k, text in enumerate(textwrap.wrap(moment.text, _EVENT_WIDTH)):  # a cell has one line
                cells = [*("" if k else cell for cell in first), text]
                rows.append(f"| {' | '.join(f'{strong}{cell}{strong}' if cell else '' for cell in cells)} |")
        set_time(recording, time_ns)
        recording.log("events", rr.TextDocument("\n".join([*rows, "", note]), media_type="text/markdown"))
    recording.reset_time()


def send_phases(recording: rr.RecordingStream, root: str, some: Iterable[Phase], *, styled: bool) -> None:
    """Send the phases `some` as a band of colours. `styled` is True the first time, to send the colours as well."""
    if styled:
        names, colours = list(PHASES), [rgba(colour) for colour in PHASES.values()]
        recording.log(f"{root}/phase", rr.StateConfiguration(values=names, labels=names, colors=colours), static=True)
    for phase in some:
        set_time(recording, phase.start_ns)
        recording.log(f"{root}/phase", rr.StateChange(state=phase.name))
    recording.reset_time()
