"""A campaign's folder: its description, its data set in parts, and its lock.

    DIR/campaign.json        scenario, dispersions and versions
    DIR/runs/*.parquet       a part for each batch, with a row for each run
    DIR/histories/*.parquet  channels of the first runs at a reduced rate
    DIR/lock                 locked while a process writes

A folder contains a single campaign. The name of a part contains the numbers of its first and last run. A part is
written completely or not at all (sim/files.py), and is on the disk before the next part is begun.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import filelock
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic import ValidationError
from pydantic_core import to_json

from maxq.control.kernel.kept_code import source_hash
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.objects import ObjectFolder
from maxq.sim.campaign.read import LoadedCampaign, campaign_from, description_of
from maxq.sim.campaign.runs import Row, history_table, schema_of, table_of
from maxq.sim.files import cannot_write, reason, write_whole
from maxq.sim.input import toml_columns
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.record import versions

MOST_BYTES = 1 << 32
"""The largest size of a file of the data set in memory, bytes; a thousand runs take about a megabyte."""
MANIFEST, RUNS, HISTORIES, LOCK = "campaign.json", "runs", "histories", "lock"
SHARD = "shard"  # key of campaign.json in a folder with a part of the runs (shards.py)
LAYOUT = 3
_IDENTITY = "campaign", "disperse", "wind_model", "tables", "simulator"
_NOT_IDENTITY = tuple(f"campaign.{key}" for key in ("runs", "batch", "keep", "success", "confidence"))
Wait = Callable[[str], None]
"""A function that waits for a short time for another process, with its name as the argument."""
_WORDS = ("name", "description", "source", "file")
"""The keys that have no effect on a flight."""


@dataclass(frozen=True)
class StoredPart:
    """A file of the data set and the runs in it."""

    path: Path
    first: int
    last: int


@dataclass(frozen=True)
class PartFiles:
    """The content of the files of a part: the rows of consecutive runs, and their histories (empty without any)."""

    first: int
    last: int
    runs: bytes
    histories: bytes


class Store:
    """The folder of a campaign, opened by `open_store`. A single process at a time may write."""

    def __init__(self, folder: Path, campaign: LoadedCampaign) -> None:
        self.folder = folder
        self.schema = schema_of(campaign)
        self.notes: list[str] = []  # findings and repairs
        self._channels = campaign.campaign.envelope.channels
        self._lock = filelock.FileLock(folder / LOCK)
        self._copy: ObjectFolder | None = None
        self._made = False  # True if this process made the folder

    def make(self) -> None:
        """Create the folder if it is missing."""
        self._made = not self.folder.exists()
        self.folder.mkdir(parents=True, exist_ok=True)

    def discard(self) -> None:
        """Remove the folder if this process made it and no run is in it."""
        if not self._made or parts_in(self.folder):
            return
        with contextlib.suppress(OSError):  # another file, or a system that does not remove a locked one
            for name in (MANIFEST, LOCK):
                (self.folder / name).unlink(missing_ok=True)
            (self.folder / RUNS).rmdir()
            self.folder.rmdir()

    def missing(self, runs: range, batch: int) -> Iterator[tuple[int, int]]:
        """Yield the runs of `runs` that are in no part, as (first, count), divided at multiples of `batch`."""
        at = runs.start
        for part in [*parts_in(self.folder), StoredPart(self.folder, runs.stop, runs.stop)]:
            while at < min(part.first, runs.stop):
                end = min((at // batch + 1) * batch, part.first, runs.stop)
                yield at, end - at
                at = end
            at = max(at, part.last + 1)

    def write(self, rows: Sequence[Row]) -> None:
        """Write a part with the rows of consecutive runs, after their histories.

        Raises CampaignError if a file cannot be written; no incomplete file is then left.
        """
        self.write_files(files_of(rows, self.schema, self._channels))

    def write_files(self, part: PartFiles) -> None:
        """Write a part from the content of its files. Raises CampaignError as `write` does."""
        name = f"runs-{part.first:010d}-{part.last:010d}.parquet"
        if part.histories:
            write_whole(self.folder / HISTORIES / name, part.histories, CampaignError, durable=True)
        write_whole(self.folder / RUNS / name, part.runs, CampaignError, durable=True)
        if self._copy is not None:
            if part.histories:
                self._copy.write(f"{HISTORIES}/{name}", part.histories)
            self._copy.write(f"{RUNS}/{name}", part.runs)

    def begin_copy(self, copy: ObjectFolder) -> None:
        """Copy all parts of this folder to object storage, and from now on each new one. Raises CampaignError."""
        copy.push(self.folder)
        self._copy = copy

    def lock(self, elsewhere: str, wait: Wait | None = None) -> None:
        """Acquire the lock, which is released at the latest when the process ends.

        If another process holds the lock, `wait` is called with its name until the lock is free. Without `wait`,
        CampaignError is raised.
        """
        path = self.folder / LOCK
        try:
            while True:
                try:
                    self._lock.acquire(blocking=False)
                    break
                except filelock.Timeout:
                    other = ""
                    with contextlib.suppress(OSError):
                        other = path.read_text(errors="replace").strip()
                    who = f"process {other}" if other else "another process"
                    if wait is None:
                        problem = f"{who} is flying this campaign; wait for it, or {elsewhere}"
                        raise CampaignError(f"{self.folder}: {problem}") from None
                    wait(who)
            with contextlib.suppress(PermissionError):  # Windows locks the content of the file as well
                path.write_text(str(os.getpid()))
        except OSError as error:
            self._lock.release()
            raise CampaignError(cannot_write(path, error)) from error

    def unlock(self) -> None:
        self._lock.release()

    def sweep(self) -> None:
        """Remove the files of an interrupted process, and rename damaged or overlapping parts."""
        for folder in (self.folder / RUNS, self.folder / HISTORIES):
            for stray in folder.glob(".*.parquet.*"):
                stray.unlink(missing_ok=True)
        reach = -1
        for part in parts_in(self.folder):
            problem = part_problem(part, self.schema)
            if not problem and part.first <= reach:
                problem = f"it contains run {part.first}, which another part already contains"
            if problem:
                aside = part.path.with_name(part.path.name + ".corrupt")
                os.replace(part.path, aside)
                self.notes.append(f"{part.path}: {problem}; set aside as {aside.name}, its runs are flown again")
            else:
                reach = part.last
        there = {part.path.name for part in parts_in(self.folder)}
        for path in (self.folder / HISTORIES).glob("*.parquet"):
            if path.name not in there:
                path.unlink()


def part_problem(part: StoredPart, schema: pa.Schema) -> str:
    """Return the fault of a part, or an empty string if it is valid."""
    try:
        runs = read_part(part.path, schema=schema)["run"].to_numpy()
    except CampaignError as error:
        return str(error).removeprefix(f"{part.path}: ")
    whole = np.array_equal(runs, np.arange(part.first, part.last + 1))
    return "" if whole else "its rows are not the runs of its name"


def read_part(path: Path, columns: list[str] | None = None, schema: pa.Schema | None = None) -> pa.Table:
    """Return a file of the data set, or the columns `columns` of it.

    Raises CampaignError if the file cannot be read, would take more than MOST_BYTES of memory, or does not have the
    given schema.
    """
    try:
        texts = [f.name for f in pq.read_schema(path) if pa.types.is_string(f.type)]
        with pq.ParquetFile(path, page_checksum_verification=True, read_dictionary=texts) as file:
            whole = _without_dictionaries(file.schema_arrow)
            if schema is not None and not whole.equals(schema):
                raise CampaignError(f"{path}: its columns are not those of this campaign")
            about = file.metadata
            groups = [about.row_group(n) for n in range(about.num_row_groups)]
            values = sum(group.column(k).num_values for group in groups for k in range(group.num_columns))
            size = sum(group.total_byte_size for group in groups)
            _check_size(path, max(size, 8 * values))  # sequences of equal values take almost no space
            coded = file.read(columns)  # a text once, with an index in each row
            _check_size(path, 8 * values + sum(_text_bytes(column) for column in coded.columns))
            return coded.cast(pa.schema([whole.field(name) for name in coded.column_names]))
    except (OSError, UnicodeDecodeError, pa.ArrowException) as error:  # a damaged name of a column is no text
        raise CampaignError(f"{path}: it cannot be read ({str(error).splitlines()[0][:100]})") from None


def _check_size(path: Path, size: int) -> None:
    if size > MOST_BYTES:
        most = f"{MOST_BYTES / 1e9:.1f} GB"
        raise CampaignError(f"{path}: decompresses to {size / 1e9:.1f} GB; {most} is the most that is read")


def _without_dictionaries(schema: pa.Schema) -> pa.Schema:
    fields = [f.with_type(f.type.value_type) if pa.types.is_dictionary(f.type) else f for f in schema]
    return pa.schema(fields, schema.metadata)


def _text_bytes(column: pa.ChunkedArray) -> int:
    """Return the size of a dictionary-coded column's texts, one for each row, bytes; 0 for other columns."""
    if not pa.types.is_dictionary(column.type):
        return 0
    lengths = [pc.binary_length(chunk.dictionary).take(chunk.indices) for chunk in column.chunks]
    return sum(pc.sum(chunk).as_py() or 0 for chunk in lengths)


def files_of(rows: Sequence[Row], schema: pa.Schema, channels: Sequence[str]) -> PartFiles:
    """Return the files of a part with the rows of consecutive runs, and with the histories of `channels`."""
    table, histories = table_of(rows, schema), history_table(rows, channels)
    first, last = table["run"][0].as_py(), table["run"][-1].as_py()
    if last - first + 1 != len(table):
        raise ValueError(f"runs {first} to {last} are not {len(table)} rows")
    return PartFiles(first, last, _as_parquet(table), _as_parquet(histories) if len(histories) else b"")


def _as_parquet(table: pa.Table) -> bytes:
    texts = [f.name for f in table.schema if pa.types.is_string(f.type)]  # numbers rarely repeat
    with pa.BufferOutputStream() as sink:
        pq.write_table(table, sink, compression="snappy", use_dictionary=texts, write_page_checksum=True)
        content: bytes = sink.getvalue().to_pybytes()
    return content


def open_store(
    folder: Path,
    campaign: LoadedCampaign,
    elsewhere: str = "give another --out",
    wait: Wait | None = None,
    shard: str | None = None,
    copy: ObjectFolder | None = None,
) -> tuple[Store, int]:
    """Create and lock the folder of a campaign, and return it with the size of its batches.

    `elsewhere` is the advice in messages, `wait` that of `Store.lock`, `shard` the shard that the folder contains, and
    `copy` its copy in object storage. Raises CampaignError if the folder cannot be written, contains other data,
    another campaign or shard, or is in use.
    """
    try:
        there = sorted(os.listdir(folder)) if folder.is_dir() else []
        if folder.exists() and not folder.is_dir():
            raise CampaignError(f"{folder}: is a file; a campaign needs a folder")
        if there and MANIFEST not in there and LOCK not in there:
            raise CampaignError(f"{folder}: holds other files ({there[0]}); {elsewhere}")
        store = Store(folder, campaign)
        store.make()
        store.lock(elsewhere, wait)
        try:
            identity = _identity(campaign, shard)
            if copy is not None and (before := copy.manifest()) is not None:
                _refuse_other(copy.address, before, identity, "give another --sync")
                copy.pull(folder)
            batch = _same_campaign(folder, campaign, identity, elsewhere)
            (folder / RUNS).mkdir(exist_ok=True)
            store.sweep()
            if copy is not None:
                store.begin_copy(copy)
        except BaseException:
            store.unlock()
            raise
    except OSError as error:
        raise CampaignError(cannot_write(folder, error)) from error
    return store, batch


def _identity(campaign: LoadedCampaign, shard: str | None) -> dict[str, Any]:
    """Return the content of campaign.json on which the rows of a campaign, or of a shard of it, depend."""
    identity = description_of(campaign) | {"simulator": simulator()}
    if campaign.campaign.sampling == "latin-hypercube":
        identity["campaign"]["stratum"] = campaign.campaign.stratum or max(campaign.campaign.runs, 1)
    return identity if shard is None else {SHARD: shard, **identity}


def _refuse_other(place: object, before: dict[str, Any], identity: dict[str, Any], elsewhere: str) -> None:
    """Raise CampaignError if the campaign.json of a place, `before`, belongs to another campaign or shard."""
    changed = differences(before, identity)
    shards, totals = ([each.get(SHARD) for each in (before, identity)], [runs_of(each) for each in (before, identity)])
    if shards[0] != shards[1]:
        whole = "the whole campaign"
        changed.insert(0, f"{SHARD} was {shards[0] or whole}, is {shards[1] or whole}")
    elif shards[0] is not None and totals[0] != totals[1]:  # the shards would consist of other runs
        changed.insert(0, f"campaign.runs was {totals[0]}, is {totals[1]}")
    if changed:
        more = f" (and {len(changed) - 1} more)" if len(changed) > 1 else ""
        raise CampaignError(f"{place}: another campaign was flown here: {changed[0]}{more}; {elsewhere}")


def runs_of(manifest: dict[str, Any]) -> Any:
    """Return the number of runs of the whole campaign in a campaign.json, or None."""
    return (manifest.get("campaign") or {}).get("runs")


def _same_campaign(folder: Path, campaign: LoadedCampaign, identity: dict[str, Any], elsewhere: str) -> int:
    """Write the description of the campaign, or check that an existing description is the same.

    Returns the size of batches. If the campaign gives no size, it is a 32nd of the runs, rounded down to a power of two
    and limited to 64 to 1024. Raises CampaignError for another campaign.
    """
    path = folder / MANIFEST
    if not path.exists():
        runs = campaign.campaign.runs
        batch = campaign.campaign.batch or 1 << min(max(runs // 32, 128).bit_length() - 1, 10)
        write_json(path, {"layout": LAYOUT, "name": campaign.name, "batch": batch, **identity})
        return batch
    before = read_manifest(folder)
    _refuse_other(folder, before, identity, elsewhere)
    return int(before["batch"])


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the content of campaign.json in a folder. Raises CampaignError."""
    path = folder / MANIFEST
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CampaignError(f"{folder}: holds no campaign ({MANIFEST} is missing)") from None
    except OSError as error:
        raise CampaignError(f"{path}: cannot be read: {reason(error)}") from None
    except (ValueError, RecursionError):
        content = {}
    if not (isinstance(content, dict) and content):
        raise CampaignError(f"{path}: is damaged; remove it and the runs in the same folder")
    if content.get("layout") != LAYOUT:
        raise CampaignError(f"{path}: has layout {content.get('layout')}, this maxq knows {LAYOUT}")
    return content


def simulator() -> dict[str, str]:
    """Return the hash of the kernels and the versions on which the bits of a flight depend."""
    return {"kernels": source_hash(), **versions()}


def campaign_in(folder: Path) -> LoadedCampaign:
    """Return the campaign of a folder, from campaign.json alone. Raises CampaignError."""
    manifest = read_manifest(folder)
    try:
        return campaign_from(manifest, str(folder / MANIFEST))
    except (ScenarioError, ValidationError, KeyError) as error:
        raise CampaignError(f"{folder / MANIFEST}: does not make a campaign: {str(error).splitlines()[0]}") from None


def differences(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Return a text for each difference between two descriptions that has an effect on flights or draws."""
    if all(before.get(part) == now.get(part) for part in ("scenario", *_IDENTITY)):  # the next lines take a second
        return []
    old, new = (
        _flat(toml_columns.loads(content["scenario"])) | _flat({part: content.get(part) for part in _IDENTITY})
        for content in (before, now)
    )
    out = []
    for key in dict.fromkeys([*new, *old]):
        if key.rpartition(".")[2] in _WORDS or key in _NOT_IDENTITY:
            continue
        a, b = old.get(key, "nothing"), new.get(key, "nothing")
        if a != b:
            out.append(f"{key} was {_short(a)}, is {_short(b)}")
    return out


def _flat(value: Any, key: str = "") -> dict[str, Any]:
    """Return the values of nested tables by key path."""
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        value = {str(n): item for n, item in enumerate(value)}
    if not isinstance(value, dict):
        return {key: value}
    return {k: v for name, item in value.items() for k, v in _flat(item, f"{key}.{name}" if key else name).items()}


def _short(value: Any) -> str:
    text = value if value == "nothing" else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:56] + " ..."


def parts_in(folder: Path) -> list[StoredPart]:
    """Return the parts in a folder, according to their names, in order of runs."""
    out = []
    for path in (folder / RUNS).glob("runs-*.parquet"):
        first, _, last = path.stem.removeprefix("runs-").partition("-")
        if first.isdecimal() and last.isdecimal() and int(first) <= int(last):
            out.append(StoredPart(path, int(first), int(last)))
    return sorted(out, key=lambda part: (part.first, part.last))


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file completely or not at all. Raises CampaignError.

    nan and infinity become null, and dataclasses become objects.
    """
    write_whole(path, to_json(content, indent=1, inf_nan_mode="null") + b"\n", CampaignError, durable=True)
