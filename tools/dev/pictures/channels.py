"""Pictures of every channel of a flight, one sheet per topic:
`python -m maxq.tools.dev.pictures.channels SCENARIO DIR`.

docs/flights/nominal.md shows those of the nominal scenario.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from maxq.sim.flight.channels import Channel, Topic
from maxq.sim.run.fly import Flight, fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.plots.palette import BLUE, GREY

COLUMNS = 4
EVENTS_SHOWN = ("liftoff", "burnout", "apogee", "impact")


def sheet(flight: Flight, topic: Topic, path: Path, from_s: float, to_s: float) -> None:
    """One picture with every channel of a topic between two times."""
    rows = -(-len(topic.channels) // COLUMNS)
    figure, axes = plt.subplots(rows, COLUMNS, figsize=(15, 2.1 * rows), squeeze=False, sharex=True)
    for place, channel in zip(axes.flat, topic.channels, strict=False):
        _plot(flight, channel, place, from_s, to_s)
    for place in axes.flat[len(topic.channels) :]:
        place.axis("off")
    for place in axes[-1]:
        place.set_xlabel("time, s", fontsize=7)
    figure.suptitle(f"{flight.scenario.name}: {topic.name} - {topic.description}", fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=75)
    plt.close(figure)


def _plot(flight: Flight, channel: Channel, place: Axes, from_s: float, to_s: float) -> None:
    time_s, values = flight.time_s(channel.name), flight[channel.name]
    seen = (time_s >= from_s) & (time_s <= to_s)
    place.plot(time_s[seen], values[seen], color=BLUE, linewidth=0.6)
    for event in flight.events:
        if event.name in EVENTS_SHOWN and from_s <= event.time_s <= to_s:
            place.axvline(event.time_s, color=GREY, linewidth=0.6, linestyle=":")
    unit = "" if channel.unit == "1" else f", {channel.unit}"
    place.set_title(f"{channel.name}{unit}", fontsize=7)
    place.tick_params(labelsize=6)
    place.grid(alpha=0.3, linewidth=0.4)
    finite = values[seen][np.isfinite(values[seen])]
    if finite.size and np.ptp(finite) < 1e-9 * max(1.0, float(np.abs(finite).max())):
        middle = float(finite.mean())
        place.set_ylim(middle - max(1.0, abs(middle)), middle + max(1.0, abs(middle)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--from", dest="from_s", type=float, default=0.0)
    parser.add_argument("--to", dest="to_s", type=float, default=np.inf)
    parser.add_argument("--topics", nargs="*", help="names of topics, e.g. /actuator (default: all)")
    parser.add_argument("--prefix", default="")
    given = parser.parse_args()
    flight = fly(load_scenario(given.scenario))
    given.folder.mkdir(parents=True, exist_ok=True)
    for topic in flight.table.topics:
        if not given.topics or topic.name in given.topics:
            name = given.prefix + topic.name.strip("/").replace("/", "-")
            sheet(flight, topic, given.folder / f"{name}.png", given.from_s, given.to_s)


if __name__ == "__main__":
    main()
