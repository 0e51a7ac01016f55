"""Build layouts for which simvehicle finds only marginal first gains: a student rocket and a heavy launcher."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from made_once import copy_of

import maxq
from maxq import LoadedScenario
from maxq.sim.scenario.loader import load_scenario

LAYOUTS = Path(__file__).parent / "data" / "layouts"
WEAK = """\
schema = 2
name = "weak gains"

[gains]
table = [
    { time_s = 0.3, k_p = 0.192, k_d_s = 0.107 },
    { time_s = 9.3, k_p = 0.731, k_d_s = 0.103 },
    { time_s = 15.9, k_p = 1.758, k_d_s = 0.097 },
    { time_s = 25.0, k_p = 2.665, k_d_s = 0.087 },
]

[filter]
structure = "none"

[roll]
k_rate_s = 0.5
dead_band_deg = 1.0
hysteresis_deg = 0.2
minimum_on_s = 0.02
"""
"""A design with which the student rocket loses control under thrust: k_p M_delta / M_alpha is 1.06 at burnout."""


@cache
def folder(name: str) -> Path:
    """Return a folder with the built files of a layout in tests/data/layouts, kept for the session."""
    return _copy(name)


def _copy(name: str) -> Path:
    return copy_of(name, lambda out: maxq.vehicle(LAYOUTS / f"{name}.toml", out))


@cache
def lost() -> Path:
    """Return a folder with the student rocket, its case, and a scenario that is lost while the engine burns."""
    out = _copy("student")
    (out / "design.toml").write_text(WEAK)
    return out


def lost_scenario() -> LoadedScenario:
    """Return the scenario in the folder `lost`."""
    return load_scenario(lost() / "scenario.toml")
