"""The head of a log, from which the flight can be repeated, and the error of an unusable log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version

SCHEMA_VERSION = "2"
NAMES_OF_SCHEMA_1 = {"felt_B": "specific_force_B", "counted_deg": "measured_deg", "held_down": "on_pad"}
"""The present names of parts of channel names in schema 1."""
PROFILE = "maxq"  # MCAP header that identifies a maxq log
RUN_METADATA = "run"
HEAD_METADATA = "head"  # the head's last record: CRC-32 of all bytes before it
END_METADATA = "end"  # the last record of a closed log: status and result of the run
SCHEMA_KEY, VERSION_KEY = "schema", "maxq"  # keys of the run metadata that the writer sets
CRC_KEY = "crc32"
STATUS_KEY, REASON_KEY = "status", "reason"
COMPLETE, ABORTED = "complete", "aborted"


class LogError(Exception):
    """The error of a log that cannot be read or written, with a message that names the file and the problem."""


@dataclass(frozen=True)
class Attachment:
    """A file inside the log, such as the scenario as flown."""

    name: str
    media_type: str
    data: bytes


@dataclass(frozen=True)
class RunHead:
    """The facts and files of a run.

    `metadata` contains seed, run number, launch site, T0 and similar facts as text. The writer adds the keys `schema`
    and `maxq`, the versions of the log and of maxq. Raises ValueError if `metadata` has these keys, or if two
    attachments have the same name.
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
        """Return the metadata with the versions, sorted by key so that equal content gives equal bytes."""
        own = {SCHEMA_KEY: SCHEMA_VERSION, VERSION_KEY: maxq_version()}
        return dict(sorted({**self.metadata, **own}.items()))


def maxq_version() -> str:
    return version("maxq")
