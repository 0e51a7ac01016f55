"""Reference tables of the documentation, made from the code.

    python -m maxq.tools.dev.documents.reference [--write]

names the pages whose tables differ from the code, with exit code 1 if there are any; `--write` renews them. A page
marks the place of a table by `<!-- from code: keys scenario -->`. The table follows, up to `<!-- end of code -->`;
`--write` adds both where they are missing. TABLES below lists the kinds. The build of the site uses the same function.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from maxq.sim.flight.channels import ChannelTable
from maxq.sim.flight.metric_table import METRICS
from maxq.sim.flight.parameters import EVENT_NAMES
from maxq.sim.flight.telemetry import channel_table
from maxq.sim.input.errors import show_value
from maxq.sim.input.ranges import LARGEST_NUMBER, RANGES
from maxq.sim.input.values import Section
from maxq.sim.packing.schedule import stage_sizes
from maxq.sim.run.flight import WAVE_BREAKING_NAME
from maxq.sim.run.fly import (
    BOOSTER_NAMES,
    CONTROL_LOST_CAUSE,
    CUTOFF_NAME,
    FAULT_END_NAME,
    FAULT_NAME,
    IGNITION_NAME,
    OVERRUN_NAME,
    RAIL_EXIT_NAME,
    RESTART_NAME,
    SOFTWARE_NAME,
)
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.scenario.messages import describe, section_of, unwrap
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_vehicle import Vehicle
from maxq.sim.vehicle.state import CAUSES
from maxq.tools.flight_messages import fields
from maxq.tools.schemas import MODELS

DOCS = Path(__file__).resolve().parents[3] / "docs"
_END = "<!-- end of code -->"
_MARK = re.compile(
    rf"^(?P<begin><!-- from code: (?P<kind>\w+) ?(?P<words>[^\n]*?) -->)$(?:(?:(?!^<!-- from code:).)*?^{_END}$)?",
    re.MULTILINE | re.DOTALL,
)
_EVENTS = (
    IGNITION_NAME,
    *BOOSTER_NAMES,
    CUTOFF_NAME,
    RESTART_NAME,
    RAIL_EXIT_NAME,
    *EVENT_NAMES,
    FAULT_NAME,
    FAULT_END_NAME,
    WAVE_BREAKING_NAME,
    SOFTWARE_NAME,
    OVERRUN_NAME,
)
_EVENT_MEANINGS = {
    IGNITION_NAME: "the engine of a stage begins to burn",
    CUTOFF_NAME: "the guidance or flight code cuts an engine off before a restart",
    RESTART_NAME: "an engine is ignited again",
    RAIL_EXIT_NAME: "the last button leaves the launch rail",
    "booster_ignition": "a booster begins to burn; the text names it",
    "booster_burnout": "a booster burns out while it is attached; the text names it",
    "liftoff": "hold-down is released: thrust exceeds weight, or at holddown.release_s",
    "burnout": "the engine of a stage stops",
    "separation": "a stage is dropped",
    "apogee": "the altitude begins to fall for the first time",
    "impact": "the altitude falls below the ground: the lower of the site and sea level",
    "control_lost": CONTROL_LOST_CAUSE,
    "tumble": "the total angle of attack exceeds 90 deg while the dynamic pressure exceeds 5 kPa",
    FAULT_NAME: "a fault of the scenario begins; the text names it",
    FAULT_END_NAME: "a fault of the scenario ends",
    WAVE_BREAKING_NAME: "a wave reaches its breaking height (docs/model.md, section 5); the text names the tank",
    SOFTWARE_NAME: "external flight code has ended the flight; the text gives its reason (docs/flight-software.md)",
    OVERRUN_NAME: "a flight with --pace-limit ends, because a sample was computed too late",
    "diverged": "the state is outside the bounds of a flight; the text gives the cause: "
    + ", or ".join(dict.fromkeys(cause for cause in CAUSES if cause)),
}


def fill(text: str) -> str:
    """Return a page with its tables renewed."""
    return _MARK.sub(_place, text)


def _place(mark: re.Match[str]) -> str:
    """Return a table between its marks."""
    table = TABLES[mark["kind"]](*mark["words"].split()).strip("\n")
    return f"{mark['begin']}\n\n{table}\n\n{_END}"


def pages() -> list[Path]:
    """Return the pages that contain tables from the code."""
    found = (page for page in sorted(DOCS.rglob("*.md")) if "build" not in page.relative_to(DOCS).parts)
    return [page for page in found if _MARK.search(page.read_text(encoding="utf-8"))]


def keys(kind: str) -> str:
    """Return tables of every key of a kind of file, section by section."""
    return "\n".join(_section(MODELS[kind], "", {}))


def topics(scenario: str) -> str:
    """Return tables of every channel that flights of a scenario log, and of those for parts that its vehicle lacks."""
    loaded = load_scenario(scenario)
    stage = loaded.vehicle.stage[0]
    sizes = replace(stage_sizes(stage, loaded.scenario.switches), tvc_loads=1, sensors=3, buffets=1, feed_lines=1)
    assert stage.loads is not None
    first = f"station 1 at {stage.loads.stations_m[0]:g} m"
    return topics_markdown(
        channel_table(
            sizes,
            stage.pendulum_names,
            (first,),
            external=True,
            accelerometers=2,
            adaptive=True,
            drift=True,
            receivers=True,
        )
    )


def events() -> str:
    """Return a table of every event of a flight."""
    return _rows(("event", "when"), [(f"`{name}`", _EVENT_MEANINGS[name]) for name in _EVENTS])


def metrics() -> str:
    """Return a table of every metric of a flight."""
    return _rows(("metric", "unit", "meaning"), [(f"`{m.name}`", m.unit, m.description) for m in METRICS.values()])


def ranges() -> str:
    """Return a table of the ranges of numbers, by the names of keys and columns."""
    return "\n".join(_ranges())


def messages() -> str:
    """Return a table of the fields of each message between maxq and a flight computer behind a socket."""
    head, found = ("offset", "bytes", "type", "field", "meaning"), list(fields())
    sections = []
    for message in dict.fromkeys(field.message for field in found):
        rows = [
            (str(f.offset), str(f.bytes), f"`{f.type}`", f"`{f.name}`", f.meaning_and_version)
            for f in found
            if f.message == message
        ]
        sections.append(f"## {message.capitalize()}\n\n{_rows(head, rows)}")
    return "\n".join(sections)


def help_of(command: str) -> str:
    """Return the help of a command and of its subcommands, each subcommand below a heading."""
    code = f"import json; from maxq.tools.{command} import _parser; print(json.dumps(_parser().helps()))"
    done = subprocess.run(
        [sys.executable, "-c", code], env={"COLUMNS": "92"}, capture_output=True, text=True, check=True
    )
    first, *others = json.loads(done.stdout).items()
    sections = [f"```text\n{first[1].rstrip()}\n```\n"]
    sections += [f"### {name}\n\n```text\n{text.rstrip()}\n```\n" for name, text in others]
    return "\n".join(sections)


def _ranges() -> Iterator[str]:
    yield "| names | least | most | why |"
    yield "|---|---|---|---|"
    for r in RANGES:
        names = ", ".join(f"`{name}`" if name[0] != "_" else f"`...{name}`" for name in r.names)
        yield (
            f"| {names} | {r.least:g} | {r.most:g} | {r.why} |" if r.least else f"| {names} | | {r.most:g} | {r.why} |"
        )
    yield f"| others | | {LARGEST_NUMBER:g} | |"
    yield ""


def _section(model: type[Section], path: str, listed: dict[type[Section], str]) -> Iterator[str]:
    if path:
        yield f"## `{path}`\n"
        yield f"{(model.__doc__ or '').splitlines()[0]}\n"
    if model in listed:
        yield f"The keys are those of `{listed[model]}`.\n"
        return
    listed[model] = path
    yield "| key | allowed | default | meaning |"
    yield "|---|---|---|---|"
    below: list[tuple[str, type[Section]]] = []
    for name, field in model.model_fields.items():
        key = field.alias or name
        yield f"| `{key}` | {_cell(_allowed(field))} | {_default(field)} | {_cell(field.description or '')} |"
        section = section_of(field.annotation)
        if section is not None and section not in (Vehicle, Design):
            bare, _ = unwrap(field.annotation)
            inner = ".".join(part for part in (path.strip("[]"), key) if part)
            below.append((f"[{inner}]" if isinstance(bare, type) else f"[[{inner}]]", section))
    yield ""
    for inner, section in below:
        yield from _section(section, inner, listed)


def _allowed(field: FieldInfo) -> str:
    if section_of(field.annotation) in (Vehicle, Design):
        return "a file, or a table"
    return describe(field.annotation, list(field.metadata))


def _default(field: FieldInfo) -> str:
    default: Any = field.default
    if field.default_factory is not None or default is None or default == "" or isinstance(default, Section):
        return ""
    return "*required*" if default is PydanticUndefined else f"`{show_value(default)}`"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def topics_markdown(table: ChannelTable) -> str:
    """Return a section with a table for each topic."""
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


TABLES: dict[str, Callable[..., str]] = {
    "events": events,
    "help": help_of,
    "keys": keys,
    "messages": messages,
    "metrics": metrics,
    "ranges": ranges,
    "topics": topics,
}


def main() -> int:
    """Check the pages or renew them. Return 1 if a page is out of date and not renewed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="renew the tables")
    write, stale = parser.parse_args().write, False
    for page in pages():
        text = page.read_text(encoding="utf-8")
        filled = fill(text)
        if filled != text:
            print(f"{'written' if write else 'out of date'}: {page.relative_to(DOCS.parent)}")
            stale = True
            if write:
                page.write_text(filled, encoding="utf-8")
    return int(stale and not write)


if __name__ == "__main__":
    sys.exit(main())
