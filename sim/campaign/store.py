"""A campaign's folder: what it is, its data set part by part, and who may write.

    DIR/campaign.json        what was flown: scenario, dispersions, versions. A folder holds one campaign
    DIR/runs/*.parquet       one row for each run; a part for each batch, named after its runs
    DIR/histories/*.parquet  thinned-out channels of the first runs, for envelopes
    DIR/lock                 held while someone writes

A part is written under a name that begins with a dot, brought to the disk, and renamed: there is a whole one or none.
"""

from __future__ import annotations

import errno
import json
import os
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import ValidationError

from maxq.control.kernel.jit import source_hash
from maxq.sim.campaign import columns
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.flying import Row
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.read import campaign_from, description_of
from maxq.sim.files import cannot_write, reason, whole_file, write_whole
from maxq.sim.run.record import versions
from maxq.sim.scenario.errors import ScenarioError

MANIFEST, RUNS, HISTORIES, LOCK = "campaign.json", "runs", "histories", "lock"
LAYOUT = 1
_DIGITS = 10
_NOT_IDENTITY = tuple(f"campaign.{key}" for key in ("runs", "batch", "keep", "success", "confidence"))
_WORDS = ("name", "description", "source", "file")
"""Keys that change nothing in a flight."""


@dataclass(frozen=True)
class Part:
    """A file of the data set and the runs in it."""

    path: Path
    first: int
    last: int

    @property
    def count(self) -> int:
        return self.last - self.first + 1


class Store:
    """Opened with `open_store`; one process at a time writes."""

    def __init__(self, folder: Path, campaign: LoadedCampaign) -> None:
        self.folder = folder
        self.schema = columns.schema_of(campaign)
        self.channels = campaign.campaign.envelope.channels
        self.notes: list[str] = []  # what was found and repaired
        self._lock = -1

    # what is there

    def parts(self) -> list[Part]:
        """Whole parts by their names, in order of runs."""
        return parts_in(self.folder)

    def missing(self, runs: int, batch: int) -> Iterator[tuple[int, int]]:
        """Runs below `runs` that are in no part, as (first, count), cut at multiples of `batch`."""
        at = 0
        for part in [*self.parts(), Part(self.folder, runs, runs)]:
            while at < min(part.first, runs):
                end = min((at // batch + 1) * batch, part.first, runs)
                yield at, end - at
                at = end
            at = max(at, part.last + 1)

    # writing

    def write(self, rows: Sequence[Row]) -> None:
        """One part of consecutive runs. Raises CampaignError where it cannot be written; then nothing is left of it."""
        self.write_tables(columns.table_of(rows, self.schema), columns.history_table(rows, self.channels))

    def write_tables(self, table: pa.Table, histories: pa.Table) -> None:
        """As `write`, of rows that are tables already."""
        first, last = table[columns.RUN][0].as_py(), table[columns.RUN][-1].as_py()
        if last - first + 1 != len(table):
            raise ValueError(f"runs {first} to {last} are not {len(table)} rows")
        if len(histories):
            self._write(histories, self.folder / HISTORIES / _name(first, last))
        self._write(table, self.folder / RUNS / _name(first, last))

    def _write(self, table: pa.Table, path: Path) -> None:
        texts = [f.name for f in table.schema if pa.types.is_string(f.type)]  # numbers hardly ever repeat

        with whole_file(path, CampaignError, durable=True) as part, open(part, "wb") as file:
            pq.write_table(table, file, compression="snappy", use_dictionary=texts, write_page_checksum=True)

    # the lock

    def lock(self) -> None:
        """Take the lock, or raise CampaignError: another process writes here. It ends with the process."""
        import fcntl  # noqa: PLC0415  # not on Windows, where campaigns run without a lock

        try:
            self._lock = os.open(self.folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise CampaignError(cannot_write(self.folder / LOCK, error)) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            other = os.read(self._lock, 100).decode(errors="replace").strip()
            os.close(self._lock)
            self._lock = -1
            if error.errno not in (errno.EAGAIN, errno.EACCES):
                raise CampaignError(cannot_write(self.folder / LOCK, error)) from error
            who = f"process {other}" if other else "another process"
            raise CampaignError(
                f"{self.folder}: {who} is flying this campaign; wait for it, or give another --out"
            ) from None
        os.ftruncate(self._lock, 0)
        os.write(self._lock, str(os.getpid()).encode())

    def unlock(self) -> None:
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    # repair

    def sweep(self) -> None:
        """Take away what an interrupted process left; set aside parts that are not whole."""
        for folder in (self.folder / RUNS, self.folder / HISTORIES):
            for stray in folder.glob(".*.parquet.*"):
                stray.unlink(missing_ok=True)
        for part in self.parts():
            problem = self._problem(part)
            if problem:
                self._set_aside(part.path, problem)
        reach = -1
        for part in self.parts():
            if part.first <= reach:
                self._set_aside(part.path, f"it holds run {part.first}, which another part holds already")
            else:
                reach = part.last
        there = {part.path.name for part in self.parts()}
        histories = self.folder / HISTORIES
        for path in histories.glob("*.parquet") if histories.is_dir() else ():
            if path.name not in there:
                path.unlink()

    def _set_aside(self, path: Path, problem: str) -> None:
        aside = path.with_name(path.name + ".corrupt")
        os.replace(path, aside)
        self.notes.append(f"{path}: {problem}; set aside as {aside.name}, its runs are flown again")

    def _problem(self, part: Part) -> str:
        """What is wrong with a part; empty where it is whole."""
        try:
            with pq.ParquetFile(part.path, page_checksum_verification=True) as file:
                if not file.schema_arrow.equals(self.schema):
                    return "its columns are not those of this campaign"
                table = file.read()
        except (OSError, pa.ArrowException) as error:
            return f"it cannot be read ({str(error).splitlines()[0][:100]})"
        runs = table[columns.RUN].to_numpy()
        if len(runs) != part.count or (runs != np.arange(part.first, part.last + 1)).any():
            return "its rows are not the runs of its name"
        return ""


def batch_of(campaign: LoadedCampaign) -> int:
    """Runs in a part: what the file says, or a 32nd of the runs, rounded to a power of two from 64 to 1024."""
    given = campaign.campaign.batch
    if given is not None:
        return given
    return 1 << min(max(campaign.campaign.runs // 32, 64).bit_length() - 1, 10)


def open_store(folder: Path, campaign: LoadedCampaign) -> tuple[Store, int]:
    """The folder of a campaign, made and locked, and the size of its batches.

    Raises CampaignError where it cannot be written, holds something else or another campaign, or is in use.
    """
    try:
        there = sorted(os.listdir(folder)) if folder.is_dir() else []
        if folder.exists() and not folder.is_dir():
            raise CampaignError(f"{folder}: is a file; a campaign needs a folder")
        if there and MANIFEST not in there and LOCK not in there:
            raise CampaignError(f"{folder}: holds other files ({there[0]}); give another --out")
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CampaignError(cannot_write(folder, error)) from error
    store = Store(folder, campaign)
    store.lock()
    try:
        batch = _same_campaign(folder, campaign)
        (folder / RUNS).mkdir(exist_ok=True)
        store.sweep()
    except OSError as error:
        store.unlock()
        raise CampaignError(cannot_write(folder, error)) from error
    except BaseException:
        store.unlock()
        raise
    return store, batch


def _same_campaign(folder: Path, campaign: LoadedCampaign) -> int:
    """Write what is flown here, or check that it is the same. Returns the size of batches."""
    identity = identity_of(campaign)
    path = folder / MANIFEST
    if not path.exists():
        batch = batch_of(campaign)
        write_json(path, {"layout": LAYOUT, "name": campaign.name, "batch": batch, **identity})
        return batch
    before = read_manifest(folder)
    changed = differences(before, identity)
    if changed:
        more = f" (and {len(changed) - 1} more)" if len(changed) > 1 else ""
        raise CampaignError(f"{folder}: another campaign was flown here: {changed[0]}{more}; give another --out")
    return int(before["batch"])


def read_manifest(folder: Path) -> dict[str, Any]:
    """What was flown in a folder. Raises CampaignError."""
    path = folder / MANIFEST
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CampaignError(f"{folder}: holds no campaign ({MANIFEST} is missing)") from None
    except OSError as error:
        raise CampaignError(f"{path}: cannot be read: {reason(error)}") from None
    except ValueError:
        raise CampaignError(f"{path}: is damaged; take it away, and the runs beside it") from None
    if content.get("layout") != LAYOUT:
        raise CampaignError(f"{path}: has layout {content.get('layout')}, this maxq knows {LAYOUT}")
    return content


def identity_of(campaign: LoadedCampaign) -> dict[str, Any]:
    """All that the flights depend on, and that makes the same campaign again (`campaign_in`)."""
    description = description_of(campaign)
    if campaign.campaign.sampling == "latin-hypercube":
        description["campaign"]["stratum"] = campaign.campaign.stratum or max(campaign.campaign.runs, 1)
    return description | {"simulator": {"kernels": source_hash(), **versions()}}


def campaign_in(folder: Path) -> LoadedCampaign:
    """The campaign that was flown in a folder, from the folder alone. Raises CampaignError."""
    manifest = read_manifest(folder)
    try:
        return campaign_from(manifest, str(folder / MANIFEST))
    except (ScenarioError, ValidationError, KeyError) as error:
        raise CampaignError(f"{folder / MANIFEST}: does not make a campaign: {str(error).splitlines()[0]}") from None


def differences(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """What of `now` is not as `before`, in words; descriptions and the like do not count."""
    out = []
    old = _flat(tomllib.loads(before["scenario"]))
    new = _flat(tomllib.loads(now["scenario"]))
    for part in ("campaign", "disperse", "wind_model", "tables", "simulator"):
        old |= _flat(before.get(part), part)
        new |= _flat(now.get(part), part)
    for key in dict.fromkeys([*new, *old]):
        if key.rpartition(".")[2] in _WORDS or key in _NOT_IDENTITY:
            continue
        a, b = old.get(key, "nothing"), new.get(key, "nothing")
        if a != b:
            out.append(f"{key} was {_short(a)}, is {_short(b)}")
    return out


def _flat(value: Any, key: str = "") -> dict[str, Any]:
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, list) and any(isinstance(item, dict) for item in value):
        items = {str(n): item for n, item in enumerate(value)}.items()
    else:
        return {key: value}
    out: dict[str, Any] = {}
    for name, item in items:
        out |= _flat(item, f"{key}.{name}" if key else name)
    return out


def _short(value: Any) -> str:
    text = value if value == "nothing" else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:56] + " ..."


def parts_in(folder: Path) -> list[Part]:
    """Parts of a folder by their names, in order of runs."""
    out = []
    for path in (folder / RUNS).glob("runs-*.parquet"):
        first, _, last = path.stem.removeprefix("runs-").partition("-")
        if first.isdecimal() and last.isdecimal() and int(first) <= int(last):
            out.append(Part(path, int(first), int(last)))
    return sorted(out, key=lambda part: (part.first, part.last))


def _name(first: int, last: int) -> str:
    return f"runs-{first:0{_DIGITS}d}-{last:0{_DIGITS}d}.parquet"


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write whole or not at all. Raises CampaignError."""
    write_whole(path, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n", CampaignError)
