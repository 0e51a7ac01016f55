"""Limits that a suite states for flights off the nominal one, in place of the scenario's own, each with a reason."""

from __future__ import annotations

from maxq.design.verify.suite import Suite
from maxq.sim.scenario.errors import ScenarioError, suggestion
from maxq.sim.scenario.schema_scenario import Scenario


def limit_changes(suite: Suite, which: str, scenario: Scenario, label: str) -> list[str]:
    """Overrides of the scenario's requirements, `which` being "own" (none) or "dispersed".

    `label`: the suite as the person named it. Raises ScenarioError where the scenario has no such requirement, or it is
    no upper limit.
    """
    if which == "own":
        return []
    limits = {r.name or r.metric: (n, r.limit) for n, r in enumerate(scenario.requirement)}
    out = []
    for k, stated in enumerate(suite.dispersed_limit):
        known = [name for name, (_, limit) in limits.items() if limit is not None]
        if stated.requirement not in known:
            hint = suggestion(stated.requirement, known)
            raise ScenarioError(
                label, f"the scenario has no such limit{'; ' + hint if hint else ''}",
                f"dispersed_limit[{k}].requirement", value=stated.requirement, allowed="" if hint else ", ".join(known),
            )  # fmt: skip
        out.append(f"requirement.{limits[stated.requirement][0]}.limit={stated.limit!r}")
    return out
