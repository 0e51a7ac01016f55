"""The head of a log, which suffices to repeat the flight, and the error of a log that cannot be used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version

SCHEMA_VERSION = "2"
NAMES_OF_SCHEMA_1 = {"felt_B": "specific_force_B", "counted_deg": "measured_deg", "held_down": "on_pad"}
"""Parts of channel names in schema 1, with their present names."""
PROFILE = "maxq"  # MCAP header that identifies a maxq log
RUN_METADATA = "run"
HEAD_METADATA = "head"  # the head's last record: CRC-32 of all bytes before it
END_METADATA = "end"  # the last record of a log that was closed: how the run ended
SCHEMA_KEY, VERSION_KEY = "schema", "maxq"  # keys of the run metadata that the writer sets
CRC_KEY = "crc32"
STATUS_KEY, REASON_KEY = "status", "reason"
COMPLETE, ABORTED = "complete", "aborted"


class LogError(Exception):
    """The error of a log file that cannot be used; the message names the file and the problem."""


@dataclass(frozen=True)
class Attachment:
    """A file kept inside the log, such as the scenario as flown."""

    name: str
    media_type: str
    data: bytes


@dataclass(frozen=True)
class RunHead:
    """The facts and files of one run.

    `metadata` as text: seed, run index, commit, launch site, T0 and so on. The writer adds `schema` and `maxq`
    (versions of the log and of maxq), so these two keys are rejected here with ValueError. The names of attachments
    must differ.
    """

    metadata: Mapping[str, str] = field(default_factory=dict)
    attachments: tuple[Attachment, ...] = ()

    def __post_init__(self) -> None:
        for key in (SCHEMA_KEY, VERSION_KEY):
            if key in self.metadata:
                raise ValueError(f"metadata key {key!r} is set by the log writer")
        names = [attachment.name for attachment in self.attachments]
        if len(set(names)) < len(names):
            raise ValueError(f"attachment named twice: {', '.join(sorted(names))}")

    def full_metadata(self) -> dict[str, str]:
        """Return the metadata with versions, sorted by key so that equal content gives equal bytes."""
        own = {SCHEMA_KEY: SCHEMA_VERSION, VERSION_KEY: maxq_version()}
        return dict(sorted({**self.metadata, **own}.items()))


def maxq_version() -> str:
    return version("maxq")
