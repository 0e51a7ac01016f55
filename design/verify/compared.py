"""The comparison of a suite with the basis of the design under test, with respect to limits and loops."""

from __future__ import annotations

from typing import Any

import numpy as np

from maxq.design.case.basis import Basis, stated_basis
from maxq.design.quantities import QUANTITIES
from maxq.design.verify.names import stage_name
from maxq.design.verify.suite import LinearMargins, Suite
from maxq.sim.scenario.loader import LoadedScenario

IMPLIED = {
    "gain_margin_db": ("gain_up_db", "gain_down_db"),
    "phase_margin_deg": ("rigid_phase_deg", "first_mode_phase_deg"),
    "second_mode_db": ("modes_from_2_db",),
    "modes_from_3_db": ("modes_from_2_db",),
}
"""The limits of a suite that together correspond to a limit of a design."""
OF_THE_LAW = ("filter_gain_at_infinity", "integral_hz", "most_integral_hz")
"""The limits of the law itself, which suites do not contain."""


def against_basis(suite: Suite, scenario: LoadedScenario) -> list[str]:
    """Return a line for each difference between the linear margins of a suite and the basis of a scenario's design.

    The result is empty if the suite has no margins, or if the design has no basis. Raises ScenarioError for an invalid
    basis.
    """
    design, count = scenario.design, len(scenario.vehicle.stage)
    if suite.margins is None or design is None:
        return []
    out: dict[str, list[str]] = {}
    for n in range(count):
        basis = stated_basis(design, n)
        for line in [] if basis is None else _differences(suite.margins, basis):
            out.setdefault(line, []).append(stage_name(scenario.vehicle, n))
    return [line if len(names) == count else f"{', '.join(names)}: {line}" for line, names in out.items()]


def _differences(margins: LinearMargins, basis: Basis) -> list[str]:
    less, more, absent = list[str](), list[str](), list[str]()
    for key in (k for k in basis.limits.asked if k not in OF_THE_LAW):
        about, designed, wanted = QUANTITIES[key], getattr(basis.limits, key), _wanted(margins.nominal, key)
        number, unit = isinstance(designed, int | float), f" {about.unit}".rstrip()
        if wanted is None:
            absent.append(f"{about.label} {designed:g}{unit}" if number else about.label)
        elif number and isinstance(wanted, int | float):
            lists = {-1: more, 1: less}.get(int(np.sign(about.badness(wanted) - about.badness(designed))), [])
            lists.append(f"{about.label} {wanted:g}, not {designed:g}{unit}")
        elif wanted != designed:
            less.append(f"{about.label}, which does not change over time alike")
    words = (
        "requires less than the basis of the design",
        "requires more than the basis of the design",
        "does not limit",
    )
    out = [
        f"the suite {word}: {', '.join(each)}" for word, each in zip(words, (less, more, absent), strict=True) if each
    ]
    others = [] if basis.loop == "sampled" else [f"the sampled loop, not the {basis.loop} one"]
    others += [] if basis.plane in margins.planes else [f"{' and '.join(margins.planes)}, not {basis.plane}"]
    if margins.between_nodes != basis.between_nodes:
        others.append(f"{'also between' if margins.between_nodes == 'hold' else 'only at'} operating points")
    return out + ([f"the suite's conditions differ from the design's: {'; '.join(others)}"] if others else [])


def _wanted(limits: Any, key: str) -> Any:
    """Return the suite's limit for a limit of the design, or None if the suite does not cover it fully."""
    own = getattr(limits, key, None)
    if own is not None or key not in IMPLIED:
        return own
    each = [getattr(limits, part) for part in IMPLIED[key]]
    return None if None in each else max(each, key=QUANTITIES[key].badness)
