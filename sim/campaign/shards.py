"""The shards of a campaign: parts of its runs that separate processes fly into separate folders, and their merging.

Shard K of N consists of consecutive runs. A draw depends only on seed, key and run, so merged shards contain the rows
of a campaign flown at once, bit for bit.

    run_campaign(campaign, Path("part-3"), shard=Shard(3, 8))
    campaign, parts = checked_shards([Path(f"part-{k}") for k in range(1, 9)])
    merge(campaign, parts, Path("runs/ksr3"))
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pyarrow as pa

from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.campaign.runs import schema_of
from maxq.sim.campaign.store import (
    HISTORIES,
    RUNS,
    SHARD,
    StoredPart,
    campaign_in,
    differences,
    open_store,
    part_problem,
    parts_in,
    read_manifest,
    runs_of,
)
from maxq.sim.files import cannot_write, whole_file

_NAMED = 4  # most missing shards that a message lists


@dataclass(frozen=True)
class Shard:
    """Shard `number` (from 1) of `of`."""

    number: int
    of: int

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    def runs(self, total: int) -> range:
        """Return the runs of this shard of a campaign of `total` runs. Sizes of shards differ by at most one run.

        Raises CampaignError if there are more shards than runs.
        """
        if self.of > total:
            raise CampaignError(f"shard {self}: the campaign has {total} runs; at most {total} shards are possible")
        return range(total * (self.number - 1) // self.of, total * self.number // self.of)


def shard_from(text: str) -> Shard:
    """Return the shard in a text such as "3/8". Raises ValueError."""
    match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
    shard = Shard(int(match[1]), int(match[2])) if match else Shard(0, 0)
    if not 1 <= shard.number <= shard.of:
        raise ValueError(f"{text!r} is not K/N with K from 1 to N, e.g. 3/8")
    return shard


@dataclass(frozen=True)
class _Given:
    """A folder with a shard."""

    folder: Path
    shard: Shard
    total: int  # runs of the whole campaign
    manifest: dict[str, Any]


def shard_in(folder: Path) -> Shard | None:
    """Return the shard in a folder, or None if it contains a whole campaign. Raises CampaignError."""
    return _shard_of(folder, read_manifest(folder))


def _shard_of(folder: Path, manifest: dict[str, Any]) -> Shard | None:
    text = manifest.get(SHARD)
    try:
        return None if text is None else shard_from(text)
    except (TypeError, ValueError):
        raise CampaignError(f"{folder}: campaign.json names no valid shard ({text!r:.40})") from None


def checked_shards(folders: Sequence[Path]) -> tuple[LoadedCampaign, list[StoredPart]]:
    """Return the campaign whose shards are in `folders`, and the parts of all its runs in order.

    Raises CampaignError, which names the folder, if a shard is missing, incomplete, damaged, given twice, or one of
    another campaign.
    """
    given = sorted((_given(folder) for folder in folders), key=lambda each: each.shard.number)
    if not given:
        raise CampaignError("no shard is given")
    first = given[0]
    for each in given[1:]:
        changed = differences(first.manifest, each.manifest)
        if each.shard.of != first.shard.of:
            changed.insert(0, f"it is shard {each.shard}, not one of {first.shard.of}")
        elif each.total != first.total:
            changed.insert(0, f"campaign.runs was {first.total}, is {each.total}")
        if changed:
            raise CampaignError(f"{each.folder}: is no shard of the campaign in {first.folder}: {changed[0]}")
    for one, two in pairwise(given):
        if one.shard == two.shard:
            raise CampaignError(f"{two.folder}: is shard {two.shard}, as {one.folder} is; give each shard once")
    there = {each.shard.number for each in given}
    missing = [str(Shard(k, first.shard.of)) for k in range(1, first.shard.of + 1) if k not in there]
    if missing:
        more = f" and {len(missing) - _NAMED} more" if len(missing) > _NAMED else ""
        are = "are" if len(missing) > 1 else "is"
        raise CampaignError(f"shard {', '.join(missing[:_NAMED])}{more} {are} missing among the {len(given)} folders")
    campaign = campaign_in(first.folder)
    schema = schema_of(campaign)
    return campaign, [part for each in given for part in _checked(each, schema)]


def _given(folder: Path) -> _Given:
    manifest = read_manifest(folder)
    shard = _shard_of(folder, manifest)
    if shard is None:
        raise CampaignError(f"{folder}: holds a whole campaign, not a shard of one")
    total = runs_of(manifest)
    if not isinstance(total, int):
        raise CampaignError(f"{folder}: campaign.json has no number of runs")
    return _Given(folder, shard, total, manifest)


def _checked(given: _Given, schema: pa.Schema) -> list[StoredPart]:
    """Return the parts of a complete shard. Raises CampaignError."""
    parts, due = parts_in(given.folder), given.shard.runs(given.total)
    at = due.start
    repair = f"the same command as before completes shard {given.shard}"
    for part in parts:
        if part.first > at:
            break
        if part.first < at or part.last >= due.stop:
            raise CampaignError(f"{part.path}: contains other runs than {at} to {due.stop - 1}; {repair}")
        if problem := part_problem(part, schema):
            raise CampaignError(f"{part.path}: {problem}; {repair}")
        at = part.last + 1
    if at < due.stop:
        raise CampaignError(f"{given.folder}: run {at} of runs {due.start} to {due.stop - 1} is missing; {repair}")
    return parts


def merge(campaign: LoadedCampaign, parts: Sequence[StoredPart], place: Path) -> None:
    """Copy the parts of a campaign and their histories into the folder of the whole campaign.

    The folder can then be judged, enlarged and flown again like the folder of any campaign. An interrupted merging can
    be repeated. Raises CampaignError.
    """
    names = {part.path.name for part in parts}
    store, _ = open_store(place, campaign)
    try:
        other = next((part for part in parts_in(place) if part.path.name not in names), None)
        if other is not None:
            raise CampaignError(f"{place}: has runs of its own ({other.path.name}); give another --out")
        for part in parts:
            history = part.path.parent.parent / HISTORIES / part.path.name
            for source, kind in ((history, HISTORIES), (part.path, RUNS)):
                if source is not history or history.exists():
                    with whole_file(place / kind / part.path.name, CampaignError, durable=True) as copy:
                        shutil.copyfile(source, copy)
    except OSError as error:
        raise CampaignError(cannot_write(place, error)) from error
    finally:
        store.unlock()
