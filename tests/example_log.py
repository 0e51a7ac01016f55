"""Write a small flight log for the tests that read, cut and damage logs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from maxq import Log
from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import Channel, ChannelTable, Topic
from maxq.sim.log.head import Attachment, RunHead
from maxq.sim.log.messages import EventMessage, FramePath, Level
from maxq.sim.log.writer import LogWriter

SECOND = 1_000_000_000


def numbered(prefix: str, count: int) -> tuple[Channel, ...]:
    return tuple(Channel(f"{prefix}_{i}_m", "m", "", f"number {i}") for i in range(count))


# 18 channels in one topic: protobuf tags take two bytes from field 16 on
TABLE = ChannelTable(
    (
        Topic("/truth", "fast", (*numbered("truth", 17), Channel("w_BI_B_y_radps", "rad/s", "B", "pitch rate"))),
        Topic("/aero", "slow", (Channel("alpha_deg", "deg", "", "angle of attack"),)),
        Topic("/slosh/tank_1", "fast", numbered("slosh", 2), "one | two"),
    )
)
HEAD = RunHead(
    {"seed": "7", "site": "Kourou, 5.2° N"},
    (
        Attachment("scenario.toml", "application/toml", b"[vehicle]\nname = 'X'\n"),
        Attachment("design.json", "application/json", bytes(range(256)) * 3),
    ),
)
Samples = tuple[IntArray, Array]


def samples(group: str, rate_hz: int, duration_s: float) -> Samples:
    """Return random bit patterns of every kind of double: signed zeros, denormals, infinities, many NaNs."""
    n = round(rate_hz * duration_s)
    random = np.random.default_rng([rate_hz, n])
    values = random.normal(size=(n, len(TABLE.columns(group))))
    if group == "fast":
        values.ravel()[::7] = random.integers(-(2**63), 2**63 - 1, values.ravel()[::7].shape).view(float)
        values.ravel()[:6] = [0.0, -0.0, 5e-324, np.inf, -np.inf, np.nan]
    return np.arange(n) * (SECOND // rate_hz), values


FAST = samples("fast", 100, 3.25)
SLOW = samples("slow", 20, 3.25)
EVENTS = (
    EventMessage(0, Level.INFO, "lift-off", "sequence"),
    EventMessage(1_500_000_001, Level.WARNING, "gimbal at its limit: 6°", "actuator"),
    EventMessage(3 * SECOND, Level.FATAL, "q·alpha out of bounds"),
)
FRAMES = FramePath(
    "I", "B", SLOW[0], np.arange(3.0 * len(SLOW[0])).reshape(-1, 3), np.tile([0.5, -0.5, 0.1, 0.7], (len(SLOW[0]), 1))
)


def write_example(path: Path, head: RunHead = HEAD) -> bytes:
    """Write the example log and return its bytes. It has a chunk for each of the seconds 0, 1, 2 and 3."""
    with LogWriter(path, TABLE, head) as log:
        log.write_block({"fast": FAST, "slow": SLOW}, EVENTS, [FRAMES])
    return path.read_bytes()


def same_bits(a: Array, b: Array) -> bool:
    return np.array_equal(np.ascontiguousarray(a).view(np.int64), np.ascontiguousarray(b).view(np.int64))


def holds_exactly(log: Log, seconds: list[int]) -> bool:
    """Return True if the log contains exactly the samples and events of these seconds, bit for bit."""
    for group, (times, values) in (("fast", FAST), ("slow", SLOW)):
        kept = np.isin(times // SECOND, seconds)
        for column, channel in enumerate(TABLE.columns(group)):
            if not np.array_equal(log.time_ns(channel.name), times[kept]):
                return False
            if not same_bits(log[channel.name], values[kept, column]):
                return False
    return log.events == tuple(event for event in EVENTS if event.time_ns // SECOND in seconds)
