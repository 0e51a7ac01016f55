"""The campaigns of a suite, flown with the design and judged with the confidence that the suite asks for."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from maxq.design.verify.limits import limit_changes
from maxq.design.verify.memory import code_hash, content_hash
from maxq.design.verify.suite import CampaignWanted, LoadedSuite
from maxq.design.verify.verdict import ACCEPTED, REJECTED, UNDECIDED, Judgement, Requirement
from maxq.sim.campaign.analysis import DataSet, Judged, judged
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.read import description_of, load_campaign
from maxq.sim.campaign.runner import Progress, run_campaign

PART = "campaign"


@dataclass(frozen=True)
class CampaignResult:
    """A campaign that was flown, and what it says of each requirement; the first is that control is kept."""

    name: str
    file: str
    folder: Path
    runs: int
    stopped: bool
    success: float
    confidence: float
    verdicts: tuple[Judged, ...]

    @property
    def worst_runs(self) -> list[int]:
        """The worst run of each requirement."""
        return sorted({v.worst[0].run for v in self.verdicts if v.worst})


def load_wanted(loaded_suite: LoadedSuite, wanted: CampaignWanted, design: str, vehicle: str | None) -> LoadedCampaign:
    """The campaign with the design in it, and the suite's numbers and limits. Raises ScenarioError."""
    changes = [f'design="{design}"'] + ([f'vehicle="{vehicle}"'] if vehicle is not None else [])
    changes += wanted.set
    loaded = load_campaign(wanted.file, changes)
    more = limit_changes(loaded_suite.suite, wanted.limits, loaded.base.scenario, loaded_suite.label)
    loaded = load_campaign(wanted.file, [*changes, *more]) if more else loaded
    given = {key: getattr(wanted, key) for key in ("runs", "success", "confidence")}
    return loaded.with_campaign(**{key: value for key, value in given.items() if value is not None})


def campaign_folder(loaded: LoadedCampaign, parts: Path) -> Path:
    """Where its runs lie: the same for all that would fly the same, so that runs are never flown twice."""
    said = description_of(loaded)
    drawn = {key: loaded.file.campaign.model_dump(mode="json")[key] for key in ("seed", "sampling", "noise", "outside")}
    stratum = loaded.campaign.stratum or 0
    key = content_hash(code_hash(), json.dumps({**said, "campaign": drawn}, sort_keys=True), stratum)
    return parts / f"campaign-{loaded.name}-{key[:16]}"


def fly_campaign(
    loaded_suite: LoadedSuite,
    wanted: CampaignWanted,
    design: str,
    vehicle: str | None,
    parts: Path,
    watch: Callable[[Progress], None] = lambda progress: None,
    stop: Callable[[], bool] = lambda: False,
    afresh: bool = False,
) -> CampaignResult:
    """Fly what is missing of a campaign, or all of it into a new folder. Raises ScenarioError, CampaignError."""
    loaded = load_wanted(loaded_suite, wanted, design, vehicle)
    folder = known = campaign_folder(loaded, parts)
    count = 1
    while afresh and folder.exists():
        folder = known.with_name(f"{known.name}-{(count := count + 1)}")
    outcome = run_campaign(loaded, folder, watch=watch, stop=stop)
    data = DataSet(folder, loaded, loaded.campaign.runs)
    return CampaignResult(
        wanted.name or loaded.name, wanted.file, folder, len(data.runs), outcome.stopped, loaded.campaign.success,
        loaded.campaign.confidence, tuple(judged(data)),
    )  # fmt: skip


def campaign_requirements(result: CampaignResult) -> list[Requirement]:
    """One for each of the campaign's."""
    words: dict[str, Judgement] = {"met": ACCEPTED, "not met": REJECTED}
    level = f"{100.0 * result.success:g} % with {100.0 * result.confidence:g} %"
    out = []
    for v in result.verdicts:
        bound = f"{'<=' if v.kind == 'limit' else '>='} {v.bound:g}, " if v.metric else ""
        worst = v.worst[0] if v.worst else None
        found = f"{v.shown.failures} of {v.shown.runs} failed" + (f", worst {worst.value:.4g}" if worst else "")
        room = math.nan
        if worst is not None and v.bound:
            room = 1.0 - worst.value / v.bound if v.kind == "limit" else worst.value / v.bound - 1.0
        again = f"simrun --from {result.folder} --run {worst.run}" if worst else ""
        out.append(
            Requirement(
                PART, f"{result.name}: {v.name}", bound + level, found, words.get(v.shown.judgement, UNDECIDED), room,
                f"run {worst.run}" if worst else "", v.shown.more, again,
            )
        )  # fmt: skip
    return out
