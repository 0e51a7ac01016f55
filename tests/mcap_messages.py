"""Read the messages of a log with the `mcap` package and protobuf's parser, as oracles of maxq's reader."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema


def messages(path: Path, topic: str) -> Iterator[tuple[Schema, Channel, Message, Any]]:
    """Yield the schema, channel, raw message and decoded message of each message of a topic."""
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages(topics=[topic]):
            assert schema is not None
            pool = descriptor_pool.DescriptorPool()
            for entry in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                pool.Add(entry)
            kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            yield schema, channel, message, kind.FromString(message.data)
