"""maxq as a library.

    from maxq.sim.api import fly, load_scenario, read_log

    flight = fly(load_scenario("nominal", ["wind.profile=winds/anheung-november.csv"]))
    flight["alpha_deg"], flight.time_s("alpha_deg"), flight.metrics["max_q_alpha_Padeg"]

    log = read_log("runs/nominal/flight.mcap")
    log["alpha_deg"], log.time_s("alpha_deg"), log.events

Wrong input is a `ScenarioError`, a log that cannot be read or written a `LogError`: one line each.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maxq.sim.scenario.errors import ScenarioError
from maxq.sim.scenario.files import builtin_names

if TYPE_CHECKING:
    from maxq.sim.log.head import LogError
    from maxq.sim.log.reader import Log, read_log
    from maxq.sim.run.flight import Event, Flight
    from maxq.sim.run.fly import FlightRun, fly
    from maxq.sim.run.metrics import Verdict
    from maxq.sim.run.record import record
    from maxq.sim.scenario.loader import LoadedScenario

_AT = {
    "LogError": "log.head", "Log": "log.reader", "read_log": "log.reader",
    "Event": "run.fly", "Flight": "run.fly", "FlightRun": "run.fly", "fly": "run.fly",
    "Verdict": "run.metrics", "record": "run.record", "LoadedScenario": "scenario.loader",
}  # fmt: skip  # a table
"""Where the rest stands: imported when it is asked for, since compiler and schemas take a second."""


def __getattr__(name: str) -> Any:
    if name not in _AT:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(import_module(f"maxq.sim.{_AT[name]}"), name)
    return value


def load_scenario(path: str | Path, overrides: Iterable[str] = ()) -> LoadedScenario:
    """The scenario in a file, or the built-in one of that name, with `key=value` overrides.

    Raises ScenarioError.
    """
    from maxq.sim.run.metrics import METRIC_NAMES  # noqa: PLC0415  # lazy, as above
    from maxq.sim.scenario import loader  # noqa: PLC0415  # likewise

    return loader.load_scenario(path, overrides, METRIC_NAMES)


def load_scenario_text(text: str, overrides: Iterable[str] = ()) -> LoadedScenario:
    """The scenario that a self-contained TOML text holds, e.g. one from a log. Raises ScenarioError."""
    from maxq.sim.run.metrics import METRIC_NAMES  # noqa: PLC0415  # lazy, as above
    from maxq.sim.scenario import loader  # noqa: PLC0415  # likewise

    return loader.load_scenario_text(text, overrides, METRIC_NAMES)


__all__ = [
    "Event",
    "Flight",
    "FlightRun",
    "LoadedScenario",
    "Log",
    "LogError",
    "ScenarioError",
    "Verdict",
    "builtin_names",
    "fly",
    "load_scenario",
    "load_scenario_text",
    "read_log",
    "record",
]
