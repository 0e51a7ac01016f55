"""The description of the dispersed vehicles in a suite's margins: draws of a campaign, or normal deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from maxq.design.model.deviations import acting_at, deviations_of
from maxq.design.model.node import Node
from maxq.design.model.spread import campaign_of
from maxq.design.verify.suite import LinearMargins
from maxq.sim.campaign.read import LoadedCampaign, load_campaign
from maxq.sim.campaign.schema import campaign_title
from maxq.sim.scenario.loader import LoadedScenario

NORMAL = "normal deviations of [margins.three_sigma]"


@dataclass(frozen=True)
class DescribedVehicles:
    """The dispersed vehicles of the margins `wanted`, in a suite that flies `campaign`.

    `base` is the scenario to which normal deviations apply. `changes` are the changes of design and vehicle, key=value.
    """

    wanted: LinearMargins
    base: LoadedScenario
    campaign: LoadedCampaign | None
    changes: Sequence[str] = ()

    @cached_property
    def named(self) -> LoadedCampaign | None:
        """Return the campaign whose draws the vehicles have, or None if the margins have their own deviations.

        The default is the campaign of the suite.
        """
        if self.wanted.three_sigma.campaign is not None:
            return load_campaign(self.wanted.three_sigma.campaign, self.changes)
        return None if "three_sigma" in self.wanted.model_fields_set else self.campaign

    def at(self, node: Node) -> LoadedCampaign:
        """Return the campaign of the vehicles at an operating point.

        It is `named` if that changes the loop, or else `three_sigma`. Raises ScenarioError if a campaign of the suite's
        margins changes nothing at the operating point.
        """
        named, own = self.named, self.wanted.three_sigma
        if named is not None and deviations_of(named, node).places:
            return named
        return acting_at(campaign_of(own, self.base, self.wanted.seed), own, node)

    def text(self, nodes: Sequence[Node]) -> str:
        """Return the description at operating points as text, with the draws that no margin includes."""
        named, flies = self.named, self.campaign
        if named is None:
            own = "the suite has no campaign" if flies is None else f"not draws of {campaign_title(flies.name)}"
            return f"dispersed vehicles: {NORMAL}, {own}"
        stages = {node.stage: node for node in nodes}
        without = [str(n + 1) for n, node in stages.items() if self.at(node) is not named]
        if len(without) == len(stages):
            return f"dispersed vehicles: {NORMAL}; {campaign_title(named.name)} changes nothing that a loop depends on"
        text = f"dispersed vehicles: draws of {campaign_title(named.name)}, vehicle N is its run N"
        if flies is not None and named is not flies:
            text += f"; not of {campaign_title(flies.name)}, which the suite flies"
        text += f"; {NORMAL} in stage {', '.join(without)}, which it leaves alone" if without else ""
        left = dict.fromkeys(name for node in stages.values() for name in deviations_of(named, node).left_out)
        return f"{text}; without {', '.join(left)}" if left else text
