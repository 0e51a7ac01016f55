"""Topics as protobuf without protoc: schemas built at run time, flat messages of doubles encoded as NumPy arrays.

A message of a topic holds one `double` per channel, numbered 1, 2, ... in the order of the table. Every
field is written, zeros too, so all messages of a topic have one size and a block of them is a structured
array whose columns are tag bytes and values (protobuf wire format: tag = field number << 3 | 1 as varint,
then 8 bytes little-endian). Unit, frame and description of a channel stand in the metadata of the MCAP channel, where
viewers show them.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError, Message
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.sim.flight.channels import Channel, Topic

PACKAGE = "maxq"
MOST_FIELDS = 2047  # from field 2048 on, a tag takes three bytes

_GROUP, _DESCRIPTION, _FIELD = "group", "description", "field."  # keys of the metadata
_Field = descriptor_pb2.FieldDescriptorProto
_WIRE_TYPE_64_BIT = 1
RECORD_PREFIX = struct.Struct("<BQ")  # MCAP record: opcode, length of the content
MESSAGE_HEADER = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_ONE_BYTE_TAGS = 15  # fields 1..15 have tags of one byte, all others here of two


def message_type(topic: Topic) -> str:
    return f"{PACKAGE}.{topic.message_name}"


def schema_of(topic: Topic) -> bytes:
    """Serialised FileDescriptorSet of the topic's message, with one double per channel."""
    name = topic.message_name
    file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}/{name}.proto", package=PACKAGE, syntax="proto3")
    message = file.message_type.add(name=name)
    for number, channel in enumerate(topic.channels, start=1):
        message.field.add(name=channel.name, number=number, type=_Field.TYPE_DOUBLE, label=_Field.LABEL_OPTIONAL)
    return serialise([file])


def metadata_of(topic: Topic) -> dict[str, str]:
    """Rate group and description; for each field a JSON object of unit, frame and description."""
    metadata = {_GROUP: topic.group, _DESCRIPTION: topic.description}
    for channel in topic.channels:
        about = {"unit": channel.unit, "frame": channel.frame, "description": channel.description}
        metadata[_FIELD + channel.name] = json.dumps(about, ensure_ascii=False)
    return metadata


def topic_from(name: str, schema: bytes, metadata: Mapping[str, str], renamed: Mapping[str, str]) -> Topic:
    """The topic that an MCAP channel was made from; `renamed`: parts of channel names, and what replaces them.

    Raises ValueError where the parts do not fit.
    """
    try:
        channels = []
        for field in _field_names(schema):
            about = json.loads(metadata[_FIELD + field])
            channel = next((field.replace(old, new) for old, new in renamed.items() if old in field), field)
            channels.append(Channel(channel, about["unit"], about["frame"], about["description"]))
        return Topic(name, metadata[_GROUP], tuple(channels), metadata[_DESCRIPTION])
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"the description of topic {name} cannot be read") from error


def serialise(files: Iterable[descriptor_pb2.FileDescriptorProto]) -> bytes:
    """Bytes of a FileDescriptorSet; the files stand in the order of their imports."""
    return descriptor_pb2.FileDescriptorSet(file=files).SerializeToString(deterministic=True)


def _field_names(schema: bytes) -> list[str]:
    """Names of the fields of a `schema_of` a topic, in the order of their numbers.

    Raises ValueError unless the schema is such a flat message of doubles.
    """
    try:
        files = descriptor_pb2.FileDescriptorSet.FromString(schema).file
    except DecodeError as error:
        raise ValueError("the schema is no protobuf schema") from error
    if len(files) != 1 or len(files[0].message_type) != 1:
        raise ValueError("the schema does not hold exactly one message")
    fields = files[0].message_type[0].field
    if any(f.number != i or f.type != _Field.TYPE_DOUBLE for i, f in enumerate(fields, start=1)):
        raise ValueError("the schema is not a flat message of doubles")
    return [f.name for f in fields]


def message_class(schema: bytes, full_name: str) -> type[Message]:
    """A class for messages of one type of a serialised FileDescriptorSet."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(full_name))


def doubles_template(n_fields: int) -> NDArray[np.void]:
    """One message of `n_fields` doubles as a structured array of length 1: tags set, values to be filled.

    Raises ValueError outside 1..MOST_FIELDS.
    """
    if not 1 <= n_fields <= MOST_FIELDS:
        raise ValueError(f"a message holds 1 to {MOST_FIELDS} channels, not {n_fields}")
    n_narrow = min(n_fields, _ONE_BYTE_TAGS)
    columns: list[tuple[str, Any, tuple[int]]] = [("narrow", [("tag", "u1"), ("value", "<f8")], (n_narrow,))]
    if n_fields > n_narrow:
        columns.append(("wide", [("tag", "<u2"), ("value", "<f8")], (n_fields - n_narrow,)))
    template = np.zeros(1, np.dtype(columns))
    tags = np.arange(1, n_fields + 1) << 3 | _WIRE_TYPE_64_BIT
    template["narrow"]["tag"] = tags[:n_narrow]
    if n_fields > n_narrow:
        wide = tags[n_narrow:]
        template["wide"]["tag"] = (wide & 0x7F | 0x80) | wide >> 7 << 8  # a varint: low seven bits first
    return template


def message_dtype(payload: np.dtype[np.void]) -> np.dtype[np.void]:
    """Layout of a message record around a payload of fixed size."""
    return np.dtype(
        [
            ("opcode", "u1"),
            ("length", "<u8"),
            ("channel", "<u2"),
            ("sequence", "<u4"),
            ("log_time", "<u8"),
            ("publish_time", "<u8"),
            ("payload", payload),
        ]
    )


def put_values(messages: NDArray[np.void], values: Array) -> None:
    """Write `values` (n, fields) into n messages of a `doubles_template`, bit by bit."""
    messages["narrow"]["value"] = values[:, :_ONE_BYTE_TAGS]
    if "wide" in (messages.dtype.names or ()):
        messages["wide"]["value"] = values[:, _ONE_BYTE_TAGS:]


def get_values(messages: NDArray[np.void], out: Array) -> None:
    """Read n messages of a `doubles_template` into `out` (fields, n): a row per channel."""
    out[:_ONE_BYTE_TAGS] = messages["narrow"]["value"].T
    if "wide" in (messages.dtype.names or ()):
        out[_ONE_BYTE_TAGS:] = messages["wide"]["value"].T
