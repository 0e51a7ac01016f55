"""summary.json for now."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from maxq.sim.campaign.analysis import DataSet, Judged, Lost, summary_of
from maxq.sim.campaign.store import write_json


def write_report(
    data: DataSet,
    verdicts: Sequence[Judged],
    losses: Sequence[Lost],
    total: int,
    further: dict[str, Any],
    *,
    pictures: bool,
) -> list[Path]:
    path = data.folder / "summary.json"
    write_json(path, summary_of(data, total, further))
    return [path]
