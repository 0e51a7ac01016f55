"""Writes docs/telemetry.md from the channel table, the metrics and the events.

python -m maxq.tools.dev.documents.docs_telemetry [FILE]
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from maxq.sim.flight.channels import EVENTS_TOPIC, FRAMES_TOPIC, ChannelTable
from maxq.sim.flight.parameters import EVENT_NAMES
from maxq.sim.flight.telemetry import FAST, SLOW, channel_table
from maxq.sim.log.head import END_METADATA, REASON_KEY, RUN_METADATA, SCHEMA_VERSION, STATUS_KEY
from maxq.sim.packing.schedule import stage_sizes
from maxq.sim.run.fly import (
    CONTROL_LOST_CAUSE,
    FAULT_END_NAME,
    FAULT_NAME,
    IGNITION_NAME,
    SOFTWARE_NAME,
    WAVE_BREAKING_NAME,
)
from maxq.sim.run.launch_frames import CHILD, PARENT
from maxq.sim.run.metrics import METRICS
from maxq.sim.run.record import DESIGN_ATTACHMENT, END_KEY, OUTCOME_KEY, SCENARIO_ATTACHMENT, STATE_HASH_KEY, STEPS_KEY
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.state import CAUSES

_EXAMPLE = "nominal"
_EVENTS = (IGNITION_NAME, *EVENT_NAMES, FAULT_NAME, FAULT_END_NAME, WAVE_BREAKING_NAME, SOFTWARE_NAME)
_EVENT_MEANINGS = {
    IGNITION_NAME: "the engine of a stage begins to burn",
    "liftoff": "hold-down is released: thrust exceeds weight, or at holddown.release_s",
    "burnout": "the engine of a stage stops",
    "separation": "a stage is dropped",
    "apogee": "the altitude begins to fall for the first time",
    "impact": "the altitude falls below the ground: the lower of the site and sea level",
    "control_lost": CONTROL_LOST_CAUSE,
    "tumble": "the total incidence exceeds 90 deg while the dynamic pressure exceeds 5 kPa",
    FAULT_NAME: "a fault of the scenario begins; the text says which",
    FAULT_END_NAME: "it ends",
    WAVE_BREAKING_NAME: "a wave in a tank is as high as it can be (docs/model.md, section 5); the text says in which",
    SOFTWARE_NAME: "flight code from outside has ended the flight; the text says why (docs/flight-software.md)",
    "diverged": "the state is outside the bounds of a flight; the text gives the cause: "
    + ", or ".join(dict.fromkeys(cause for cause in CAUSES if cause)),
}


def page() -> str:
    """The whole page."""
    loaded = load_scenario(_EXAMPLE)
    stage = loaded.vehicle.stage[0]
    sizes = replace(stage_sizes(stage, loaded.scenario.switches), tvc_loads=1)  # and what that vehicle lacks
    assert stage.loads is not None
    first = f"station 1 at {stage.loads.stations_m[0]:g} m"
    table = channel_table(sizes, stage.pendulum_names, (first,), external=True)
    return f"""\
# Telemetry

<!-- Written by `python -m maxq.tools.dev.documents.docs_telemetry`: change the channel table, not this file. -->

`flight.mcap` is an MCAP file of protobuf messages that Foxglove, Rerun and PlotJuggler open; `read_log` reads
it into arrays (docs/simrun.md). Times are nanoseconds of simulated time; the metadata hold T0.

Topics of the group `{FAST}` have `log.fast_hz` messages a second (default 1000), those of `{SLOW}`
`log.slow_hz` (default 100), and both have one more at the flight's last instant. Rows fall on
the flight's steps: a log cannot be finer than these.

Names end with the unit; a part of the name is the frame: I inertial, E Earth-fixed, N local
north-east-down, B body (x forward, y right, z down). `1` stands for no unit. Angles are in degrees where the
name says so. The tables are those of the built-in `{_EXAMPLE}`: {sizes.pitch_modes} bending modes in pitch,
{sizes.yaw_modes} in yaw, {len(stage.tank)} tanks. `/bending` and `/slosh` have as many columns as the vehicle
has modes and tanks, and are missing where it has none; spatial modes are `eta_spatial_N_m` and
`eta_spatial_N_mps`. Of several engines `/engines` has each group's command, angle and rate
(`gimbal_group_NAME_pitch_angle_deg`), where there are several groups, and each engine's thrust
(`thrust_engine_NAME_N`); `/actuator` is that of the first group. `/tvc_load` is there with `[stage.tvc_load]`
(where several engines swing, of each in their order `swing_load_N_pitch_angle_deg`, `actuator_load_N_...` and
`hinge_load_N_...`),
`/flight_code` with `computer.law = "external"`.
`/sections` is there with `switches.section_loads`, and has the same five columns for every station of `[stage.loads]`
(docs/model.md, section 13, for the signs). What a stage
lacks, and the pendulum of an empty tank, is nan.

{topics_markdown(table)}
## `{EVENTS_TOPIC}`

`foxglove.Log` messages from `flight`; the text begins with the name, followed by the stage on a vehicle of
several.

{_rows(("event", "when"), [(f"`{name}`", _EVENT_MEANINGS[name]) for name in _EVENTS])}
## `{FRAMES_TOPIC}`

`foxglove.FrameTransforms`: frame `{CHILD}` (B, origin at the core CG) in `{PARENT}` (x east, y north, z up at
the site, turning with the Earth), in doubles. At most `log.transform_hz` a second (default 50), picked from
the slow rows.

## Head and end

Attachments:

- `{SCENARIO_ATTACHMENT}`: the scenario as flown with vehicle, design and all tables, for `simrun --from LOG`
- `{DESIGN_ATTACHMENT}`: the control design alone

Metadata:

- `{RUN_METADATA}`: scenario, vehicle, design, seed, run index, launch site, T0, versions of maxq and log
- `{END_METADATA}`: `{STATUS_KEY}` (`complete`, or `aborted` with a `{REASON_KEY}`),
  `{OUTCOME_KEY}`, `{END_KEY}`, `{STEPS_KEY}`, `{STATE_HASH_KEY}`

Nothing in the file comes from the clock: equal flights give equal bytes. The log's schema is {SCHEMA_VERSION}; logs of
schema 1 are read with the channel names of today.

## Metrics

The names used by `summary.json` and `[[requirement]]`; computed at every step, not from the log.

{_rows(("metric", "unit", "meaning"), [(f"`{m.name}`", m.unit, m.description) for m in METRICS.values()])}"""


def topics_markdown(table: ChannelTable) -> str:
    """One section with a table per topic."""
    sections = []
    for topic in table.topics:
        text = f"{topic.description}\n\n" if topic.description else ""
        channels = [(f"`{c.name}`", c.unit, c.frame, c.description.replace("|", "\\|")) for c in topic.channels]
        rows = _rows(("channel", "unit", "frame", "description"), channels)
        sections.append(f"## `{topic.name}` ({topic.group})\n\n{text}{rows}")
    return "\n".join(sections)


def _rows(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "".join("| " + " | ".join(cells) + " |\n" for cells in lines)


def main(arguments: list[str]) -> int:
    """Write the page; returns 0."""
    path = Path(arguments[0] if arguments else "docs/telemetry.md")
    path.write_text(page(), encoding="utf-8", newline="\n")
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
