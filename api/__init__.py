"""maxq from Python: what the commands do, as functions with a few lines each.

::

    from maxq.api import load, fly, plot, campaign, read, vehicle, design, bode, verify, replay

    flight = fly("nominal", "wind.profile=winds/anheung-november.csv")
    plot(flight, "alpha_total_deg", "gimbal_pitch_angle_deg")
    flight.to_pandas("/truth"), flight.to_csv("flight.csv", "altitude_m"), flight.metrics

    made = design("ksr3-relaxed")
    made.bode(40.0), made.save("mine.toml")
    verify("mine.toml", "quick").judgement

These names and their arguments are stable; each is imported when it is first used, so that ``import maxq.api`` takes no
time. Wrong input raises a :class:`ScenarioError`, :class:`CampaignError` or :class:`LogError` of one line, which names
file, key, value and what is allowed.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for type checkers and editors; _HOMES says the same to the interpreter
    from maxq.api.designs import Designed, bode, design, verify
    from maxq.api.flights import campaign, fly, load, plot, read, replay, vehicle
    from maxq.design.api import load_design, loop, loops, nodes
    from maxq.design.margins.measure import margins
    from maxq.design.verify.verify import Verification
    from maxq.sim.campaign.analysis import DataSet
    from maxq.sim.campaign.error import CampaignError
    from maxq.sim.campaign.read import LoadedCampaign
    from maxq.sim.log.head import LogError
    from maxq.sim.log.reader import Log
    from maxq.sim.run.flight import Flight
    from maxq.sim.run.fly import FlightRun
    from maxq.sim.run.record import record
    from maxq.sim.scenario.errors import ScenarioError
    from maxq.sim.scenario.files import builtin_names
    from maxq.sim.scenario.loader import LoadedScenario

__all__ = [
    "CampaignError", "DataSet", "Designed", "Flight", "FlightRun", "LoadedCampaign", "LoadedScenario", "Log",
    "LogError", "ScenarioError", "Verification", "bode", "builtin_names", "campaign", "design", "fly", "load",
    "load_design", "loop", "loops", "margins", "nodes", "plot", "read", "record", "replay", "vehicle", "verify",
]  # fmt: skip  # twenty more lines otherwise
_HOMES = {
    "maxq.api.designs": ("Designed", "bode", "design", "verify"),
    "maxq.api.flights": ("campaign", "fly", "load", "plot", "read", "replay", "vehicle"),
    "maxq.design.api": ("load_design", "loop", "loops", "nodes"),
    "maxq.design.margins.measure": ("margins",),
    "maxq.design.verify.verify": ("Verification",),
    "maxq.sim.campaign.analysis": ("DataSet",),
    "maxq.sim.campaign.error": ("CampaignError",),
    "maxq.sim.campaign.read": ("LoadedCampaign",),
    "maxq.sim.log.head": ("LogError",),
    "maxq.sim.log.reader": ("Log",),
    "maxq.sim.run.fly": ("Flight", "FlightRun"),
    "maxq.sim.run.record": ("record",),
    "maxq.sim.scenario.errors": ("ScenarioError",),
    "maxq.sim.scenario.files": ("builtin_names",),
    "maxq.sim.scenario.loader": ("LoadedScenario",),
}


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names:
            return getattr(import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
