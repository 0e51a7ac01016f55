"""A layout for unchanged maxq logs, for a viewer that has opened a log directly.

    rerun flight.mcap &
    python -m maxq.tools.replay.log_layout flight.mcap [PORT]

Rerun reads the numbers of an MCAP log, but plots none without a layout. This layout plots up to eight channels of each
topic and unit, next to the body axes and the events.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from maxq.sim.flight.channels import EVENTS_TOPIC, FRAMES_TOPIC, Topic
from maxq.sim.log.head import LogError
from maxq.sim.log.messages import message_type
from maxq.sim.log.reader import Log, read_log
from maxq.sim.run.launch_frames import PARENT
from maxq.tools.plots.palette import ON_DARK, rgba
from maxq.tools.replay.convert import window
from maxq.tools.replay.viewer import LOCAL, ReplayError, listening

TIMELINE = "message_log_time"
_AXES_M = 10.0  # length of the body's axes
_MOST = 8  # most curves in a plot
_PORT = 9876  # Rerun's default


def layout_of(log: Log) -> rrb.Blueprint:
    """Return the layout for a log: plots in a tab for each topic, the frames in 3D, and the events."""
    ends = [int(log.time_ns(topic.name)[-1]) for topic in log.table.topics if len(log.time_ns(topic.name))]
    whole = rrb.archetypes.TimeAxis(
        view_range=rr.TimeRange(
            start=rr.TimeRangeBoundary.absolute(seq=0), end=rr.TimeRangeBoundary.absolute(seq=max(ends, default=0))
        )
    )
    tabs = [rrb.Vertical(contents=list(_plots(topic, whole)), name=topic.name.strip("/")) for topic in log.table.topics]
    frames = rrb.Spatial3DView(
        name="Body axes at the launch site",
        origin="/",
        contents=[f"+ {FRAMES_TOPIC}"],
        overrides={FRAMES_TOPIC: [rr.TransformAxes3D(axis_length=_AXES_M, show_frame=True)]},
        spatial_information=rrb.SpatialInformation(target_frame=PARENT),
        eye_controls=rrb.EyeControls3D(tracking_entity=FRAMES_TOPIC),
    )
    events = rrb.TextLogView(name="Events", origin=EVENTS_TOPIC)
    pictures = rrb.Vertical(frames, events, row_shares=[3, 1])
    return window(rrb.Horizontal(pictures, rrb.Tabs(*tabs), column_shares=[2, 3]), TIMELINE)


def selectors(topic: Topic) -> dict[str, list[str]]:
    """Return the channels of a topic to plot, by unit and at most `_MOST` for each."""
    by_unit: dict[str, list[str]] = {}
    for channel in topic.channels:
        by_unit.setdefault(channel.unit, []).append(channel.name)
    return {unit: names[:_MOST] for unit, names in by_unit.items()}


def _plots(topic: Topic, whole: rrb.archetypes.TimeAxis) -> Iterator[rrb.TimeSeriesView]:
    for unit, names in selectors(topic).items():
        yield rrb.TimeSeriesView(
            name=f"{topic.name.strip('/')} ({unit})",
            origin=topic.name,
            overrides={topic.name: [_line(topic, name, i) for i, name in enumerate(names)]},
            axis_x=whole,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
        )


def _line(topic: Topic, name: str, number: int) -> rrb.Visualizer:
    source = VisualizerComponentMapping(
        "Scalars:scalars",
        ComponentSourceKind.SourceComponent,
        source_component=f"{message_type(topic)}:message",  # the name that Rerun gives to the messages of a topic
        selector=f".{name}",
    )
    look = rr.SeriesLines(names=name, colors=rgba(ON_DARK[number % len(ON_DARK)]), widths=1.2)
    return look.visualizer(mappings=[source])


def send_layout(log: Path, port: int) -> None:
    """Set the layout of the viewer that listens on `port` of this machine. Raises ReplayError and LogError."""
    listening(port)
    application = log.stem  # the name that Rerun gives to recordings of files of that name
    layout_of(read_log(log)).connect_grpc(application, url=f"rerun+http://{LOCAL}:{port}/proxy")


def main() -> int:
    log, port = (*sys.argv[1:], str(_PORT))[:2]
    try:
        send_layout(Path(log), int(port))
    except (LogError, ReplayError, ValueError) as error:
        print(f"log_layout: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
