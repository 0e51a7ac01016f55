"""One run of a campaign flown again, alone and with a full log: is it the same?"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from maxq.sim.campaign import columns
from maxq.sim.campaign.analysis import DataSet
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.flying import recorded_row
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.store import campaign_in
from maxq.sim.campaign.targets import Refused
from maxq.sim.files import check_writable
from maxq.sim.log.head import LogError
from maxq.sim.run import record
from maxq.sim.run.fly import Flight, FlightRun

FLIGHTS = "flights"


@dataclass(frozen=True)
class Reflown:
    """A flight and how it compares with what the data set holds; `same` is None where there is nothing to compare."""

    flight: Flight
    folder: Path
    same: bool | None
    differences: tuple[str, ...]


def flight_folder(folder: Path, run: int) -> Path:
    return folder / FLIGHTS / f"run-{run:06d}"


def refly(
    folder: Path,
    run: int,
    out: Path | None = None,
    *,
    campaign: LoadedCampaign | None = None,
    log: bool = True,
    watch: Callable[[FlightRun], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Reflown:
    """Fly run `run` of the campaign in `folder` again, into `out` (default: DIR/flights/run-000417).

    Raises CampaignError where no flight comes of the draws, LogError where a file cannot be written.
    """
    campaign = campaign or campaign_in(folder)
    if run < 0:
        raise CampaignError(f"{folder}: runs are numbered from 0; there is no run {run}")
    try:
        made = campaign.inputs(run)
    except Refused as refused:
        raise CampaignError(f"run {run} of {folder} has no scenario: {refused}") from None
    out = out or flight_folder(folder, run)
    check_writable(out, LogError)
    flight = record.record(FlightRun(made.loaded, log=log), out, log=log, watch=watch, stop=stop, number=run)
    recorded = DataSet(folder, campaign).row(run)
    if recorded is None or flight.outcome == "interrupted":
        return Reflown(flight, out, None, ())
    row = recorded_row(made, flight)
    now = columns.table_of([row], columns.schema_of(campaign)).to_pylist()[0]
    found = tuple(differing(recorded, now))
    return Reflown(flight, out, not found, found)


def differing(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Columns that are not equal bit by bit, in words."""
    return [
        f"{name} {before[name]!r}, now {now.get(name)!r}"
        for name in before
        if _bits(before[name]) != _bits(now.get(name))
    ]


def _bits(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return "nan" if value != value else struct.pack("<d", value)  # noqa: PLR0124  # all nan are alike
