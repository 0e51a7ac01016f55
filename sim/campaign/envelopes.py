"""Percentiles over time from the thinned-out histories, channel by channel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from maxq.control.kernel.records import Array
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.store import HISTORIES


@dataclass(frozen=True)
class Band:
    """One channel: `lines` (percentiles, n) over `time_s` (n,), of the `flying` (n,) runs that reach each time."""

    channel: str
    runs: int
    time_s: Array
    percentiles: tuple[float, ...]
    lines: Array
    flying: Array


def bands(folder: Path, campaign: LoadedCampaign) -> list[Band]:
    """An envelope for each channel; none where no histories were kept."""
    envelope = campaign.campaign.envelope
    files = sorted((folder / HISTORIES).glob("runs-*.parquet"))
    if not files:
        return []
    times = [t for file in files for t in _lists(file, "time_s")]
    steps = [np.rint(t * envelope.rate_hz).astype(np.int64) for t in times]
    first = min((int(s[0]) for s in steps if len(s)), default=0)
    length = max((int(s[-1]) for s in steps if len(s)), default=0) - first + 1
    out = []
    for channel in envelope.channels:
        grid = np.full((len(steps), length), np.nan, dtype=np.float32)
        values = (v for file in files for v in _lists(file, channel))
        for row, step, value in zip(grid, steps, values, strict=True):
            row[step - first] = value
        flying = np.isfinite(grid).sum(axis=0)
        used = flying > 0
        lines = np.nanpercentile(grid[:, used], envelope.percentiles, axis=0)
        time_s = (first + np.arange(length)[used]) / envelope.rate_hz
        out.append(Band(channel, len(steps), time_s, envelope.percentiles, np.atleast_2d(lines), flying[used]))
    return out


def _lists(file: Path, column: str) -> list[Array]:
    whole = pq.read_table(file, columns=[column], partitioning=None)[column]
    return [np.asarray(row) for row in whole.combine_chunks().to_numpy(zero_copy_only=False)]
