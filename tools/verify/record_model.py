"""The model of verdict.json, from which its JSON Schema is made: `simrun schema verdict`.

`tools/verify/report.py` writes a `VerdictRecord`. Numbers without a value are null.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NotRequired

from pydantic import ConfigDict, Field, TypeAdapter, with_config
from typing_extensions import TypedDict  # pydantic requires it before Python 3.12, and installs it

from maxq.design.verify.suite import SuiteVerdict

Number = float | None


class RequirementRecord(TypedDict):
    """A requirement with its verdict."""

    part: Annotated[str, Field(description="method: scenarios, margins, dispersed, authority, certificate, campaign")]
    name: str
    wanted: Annotated[str, Field(description="limit, as text")]
    found: Annotated[str, Field(description="value, as text")]
    verdict: SuiteVerdict
    room: Annotated[Number, Field(description="relative margin to the limit, negative beyond it")]
    where: Annotated[str, Field(description="operating point or run")]
    more_runs: int
    again: Annotated[str, Field(description="command that repeats this result")]
    waived: Annotated[str, Field(description="waiver in force, or empty")]


class BaselineRecord(TypedDict):
    """The suite with which this one is compared, and the differences."""

    suite: str
    shipped: bool
    differences: list[dict[str, Any]]
    from_shipped: list[dict[str, Any]]


class FlightRecord(TypedDict):
    """A flight of the part `scenarios`."""

    name: str
    outcome: str
    passed: bool
    failures: list[str]
    metrics: dict[str, Number]
    state_hash: str
    again: str


class MarginsRecord(TypedDict):
    """The margins as designed of a plane and stage."""

    plane: str
    stage: str
    times_s: list[float]
    as_designed: list[dict[str, Any]]


class CampaignRecord(TypedDict):
    """A campaign; `finer_runs` counts the runs by the number of halvings of their step."""

    name: str
    runs: int
    folder: str
    finer_runs: dict[str, int]


class PartsRecord(TypedDict):
    """The numbers of parts recalled from the cache and computed."""

    recalled: int
    worked_out: int


class AttemptRecord(TypedDict):
    """The number of this attempt in the ledger of the vehicle."""

    number: int
    repeated: bool
    text: str
    since: str
    line: str
    others: list[dict[str, Any]]
    other_versions: list[dict[str, Any]]
    damage: list[str]


class RecalledRecord(TypedDict):
    """The results from the cache, and the results among them that were computed again."""

    parts: list[str]
    computed_again: list[str]
    runs: dict[str, dict[str, Any]]


class ProvenanceRecord(TypedDict):
    """The sections on the attempt, the seeds and the recalled results."""

    attempt: AttemptRecord
    seeds: list[dict[str, Any]]
    recalled: RecalledRecord


@with_config(ConfigDict(extra="forbid"))
class VerdictRecord(ProvenanceRecord):
    """The content of verdict.json: a verification without histories."""

    schema: Literal[2]
    design: str
    design_name: str
    vehicle: str
    suite: str
    verdict: SuiteVerdict
    missing_evidence: Annotated[list[str], Field(description="evidence that an acceptance lacks: a screening")]
    part: Annotated[str, Field(description="of --only, or empty")]
    left_out: list[str]
    deviations: str
    not_covered: Annotated[list[dict[str, Any]], Field(description="times of the flight without margins")]
    more_runs: int
    command: Annotated[str, Field(description="command that repeats the verification")]
    asked: dict[str, Any]
    requirements: list[RequirementRecord]
    baseline: BaselineRecord
    board: dict[str, Any]
    against_basis: list[str]
    flights: list[FlightRecord]
    margins: list[MarginsRecord]
    certificate: list[dict[str, Any]]
    measured_only: list[dict[str, Any]]
    authority: list[dict[str, Any]]
    worst: list[dict[str, Any]]
    slosh: list[dict[str, Any]]
    campaigns: list[CampaignRecord]
    hashes: Annotated[dict[str, str], Field(description="SHA-256 of inputs")]
    versions: dict[str, str]
    parts: PartsRecord
    wall_s: float
    walls_s: dict[str, float]
    cpus_s: dict[str, float]
    files: NotRequired[Annotated[dict[str, str], Field(description="SHA-256 of each file of the pack")]]


def verdict_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of verdict.json."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | TypeAdapter(VerdictRecord).json_schema()
