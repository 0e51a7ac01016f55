"""The protobuf messages of a log, without protoc: schemas are built at run time, and numbers are encoded by NumPy.

A message of a topic contains a `double` for each channel, with field numbers 1, 2, ... in the order of the table. Every
field is written, including zeros. All messages of a topic therefore have the same size, and a block of messages is a
structured array with columns of tag bytes and values. In the protobuf wire format, a field consists of the tag, field
number << 3 | 1 as a varint, and 8 bytes, little-endian. The metadata of the MCAP channel contain the unit, frame and
description of each channel, which viewers display.

Events and frames use messages that viewers support, `foxglove.Log` and `foxglove.FrameTransforms`. Their names and
field numbers are those of Foxglove's published protobuf schemas.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.message import DecodeError, Message
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import Channel, Topic

PACKAGE = "maxq"
MOST_FIELDS = 2047  # from field 2048 on, a tag takes three bytes

_GROUP, _DESCRIPTION, _FIELD = "group", "description", "field."  # keys of the metadata
_Field = descriptor_pb2.FieldDescriptorProto
_WIRE_TYPE_64_BIT = 1
RECORD_PREFIX = struct.Struct("<BQ")  # MCAP record: opcode, length of the content
MESSAGE_HEADER = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_ONE_BYTE_TAGS = 15  # fields 1..15 have tags of one byte, all further fields of two


def message_type(topic: Topic) -> str:
    return f"{PACKAGE}.{topic.message_name}"


def schema_of(topic: Topic) -> bytes:
    """Return the serialised FileDescriptorSet of a topic's message, which has a double for each channel."""
    name = topic.message_name
    file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}/{name}.proto", package=PACKAGE, syntax="proto3")
    message = file.message_type.add(name=name)
    for number, channel in enumerate(topic.channels, start=1):
        message.field.add(name=channel.name, number=number, type=_Field.TYPE_DOUBLE, label=_Field.LABEL_OPTIONAL)
    return serialise([file])


def metadata_of(topic: Topic) -> dict[str, str]:
    """Return a topic's rate group and description, and the unit, frame and description of each channel as JSON."""
    metadata = {_GROUP: topic.group, _DESCRIPTION: topic.description}
    for channel in topic.channels:
        about = {"unit": channel.unit, "frame": channel.frame, "description": channel.description}
        metadata[_FIELD + channel.name] = json.dumps(about, ensure_ascii=False)
    return metadata


def topic_from(name: str, schema: bytes, metadata: Mapping[str, str], renamed: Mapping[str, str]) -> Topic:
    """Return the topic from which an MCAP channel was made.

    `renamed` maps parts of channel names to their replacements. Raises ValueError if schema or metadata are invalid, or
    do not match.
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
    """Return the serialised FileDescriptorSet of these files, which must be in the order of their imports."""
    return descriptor_pb2.FileDescriptorSet(file=files).SerializeToString(deterministic=True)


def _field_names(schema: bytes) -> list[str]:
    """Return the field names in a schema made by `schema_of`, in the order of their numbers.

    Raises ValueError unless the schema is a flat message of doubles.
    """
    try:
        files = descriptor_pb2.FileDescriptorSet.FromString(schema).file
    except DecodeError as error:
        raise ValueError("the schema is not a protobuf schema") from error
    if len(files) != 1 or len(files[0].message_type) != 1:
        raise ValueError("the schema does not hold exactly one message")
    fields = files[0].message_type[0].field
    if any(f.number != i or f.type != _Field.TYPE_DOUBLE for i, f in enumerate(fields, start=1)):
        raise ValueError("the schema is not a flat message of doubles")
    return [f.name for f in fields]


def message_class(schema: bytes, full_name: str) -> type[Message]:
    """Return a class for messages of the type `full_name` in a serialised FileDescriptorSet."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(full_name))


def doubles_template(n_fields: int) -> NDArray[np.void]:
    """Return a message of `n_fields` doubles as a structured array of length 1.

    The tags are set, and the values are 0. Raises ValueError unless `n_fields` is from 1 to MOST_FIELDS.
    """
    if not 1 <= n_fields <= MOST_FIELDS:
        raise ValueError(f"a message holds 1 to {MOST_FIELDS} channels, not {n_fields}")
    n_narrow = min(n_fields, _ONE_BYTE_TAGS)
    narrow, wide = [("tag", "u1"), ("value", "<f8")], [("tag", "<u2"), ("value", "<f8")]
    template = np.zeros(1, np.dtype([("narrow", narrow, (n_narrow,)), ("wide", wide, (n_fields - n_narrow,))]))
    tags = np.arange(1, n_fields + 1) << 3 | _WIRE_TYPE_64_BIT
    template["narrow"]["tag"], late = tags[:n_narrow], tags[n_narrow:]
    template["wide"]["tag"] = (late & 0x7F | 0x80) | late >> 7 << 8  # a varint: low seven bits first
    return template


def message_dtype(payload: np.dtype[np.void]) -> np.dtype[np.void]:
    """Return the layout of a message record with a payload of fixed size."""
    head = [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4")]
    return np.dtype([*head, ("log_time", "<u8"), ("publish_time", "<u8"), ("payload", payload)])


def put_values(messages: NDArray[np.void], values: Array) -> None:
    """Copy `values` (n, fields) into n messages of a `doubles_template`, without a change of bits."""
    messages["narrow"]["value"] = values[:, :_ONE_BYTE_TAGS]
    messages["wide"]["value"] = values[:, _ONE_BYTE_TAGS:]


def get_values(messages: NDArray[np.void], out: Array) -> None:
    """Copy the values of n messages of a `doubles_template` into `out` (fields, n), a row for each channel."""
    out[:_ONE_BYTE_TAGS] = messages["narrow"]["value"].T
    out[_ONE_BYTE_TAGS:] = messages["wide"]["value"].T


# events and frames

LOG_TYPE = "foxglove.Log"
FRAMES_TYPE = "foxglove.FrameTransforms"
NS_PER_S = 1_000_000_000


Level = IntEnum("Level", "UNKNOWN DEBUG INFO WARNING ERROR FATAL", start=0)
"""The severity of an event, with the numbers of foxglove.LogLevel."""


@dataclass(frozen=True)
class EventMessage:
    """An event at an instant; `source` is the component that reports it."""

    time_ns: int
    level: Level
    text: str
    source: str = ""


@dataclass(frozen=True)
class FramePath:
    """The motion of the frame `child` relative to the frame `parent` at the times `times_ns` (n,).

    `translation_m` (n, 3) is the origin of the child in parent components. `rotation` (n, 4) is the unit quaternion
    from child to parent components, scalar first (q_BI for parent I and child B).
    """

    parent: str
    child: str
    times_ns: IntArray
    translation_m: Array
    rotation: Array


_TIMESTAMP = "google.protobuf.Timestamp"  # defined here, so that logs do not depend on the protobuf release
_MESSAGES: dict[str, dict[str, str | _Field.Type.ValueType]] = {
    _TIMESTAMP: {"seconds": _Field.TYPE_INT64, "nanos": _Field.TYPE_INT32},
    LOG_TYPE: {
        "timestamp": _TIMESTAMP,
        "level": "foxglove.LogLevel",
        "message": _Field.TYPE_STRING,
        "name": _Field.TYPE_STRING,
        "file": _Field.TYPE_STRING,
        "line": _Field.TYPE_FIXED32,
    },
    "foxglove.Vector3": dict.fromkeys("xyz", _Field.TYPE_DOUBLE),
    "foxglove.Quaternion": dict.fromkeys("xyzw", _Field.TYPE_DOUBLE),
    "foxglove.FrameTransform": {
        "timestamp": _TIMESTAMP,
        "parent_frame_id": _Field.TYPE_STRING,
        "child_frame_id": _Field.TYPE_STRING,
        "translation": "foxglove.Vector3",
        "rotation": "foxglove.Quaternion",
    },
    FRAMES_TYPE: {"transforms": "foxglove.FrameTransform"},
}
"""The fields 1, 2, ... of each message with their types: a scalar, a message, or the enumeration LogLevel."""


def _files_of(full_name: str) -> dict[str, descriptor_pb2.FileDescriptorProto]:
    """Return the descriptor files of a message or enumeration, by type: those it imports, then its own."""
    package, _, name = full_name.rpartition(".")
    fields = _MESSAGES.get(full_name, {})
    files: dict[str, descriptor_pb2.FileDescriptorProto] = {}
    for kind in fields.values():
        if isinstance(kind, str):
            files |= _files_of(kind)
    path = timestamp_pb2.DESCRIPTOR.name if full_name == _TIMESTAMP else f"foxglove/{name}.proto"
    imports = sorted({files[kind].name for kind in fields.values() if isinstance(kind, str)})
    file = descriptor_pb2.FileDescriptorProto(name=path, package=package, syntax="proto3", dependency=imports)
    if not fields:
        enum = file.enum_type.add(name=name)
        for member in Level:
            enum.value.add(name=member.name, number=member.value)
        return {full_name: file}
    message = file.message_type.add(name=name)
    for number, (field_name, kind) in enumerate(fields.items(), start=1):
        label = _Field.LABEL_REPEATED if full_name == FRAMES_TYPE else _Field.LABEL_OPTIONAL
        field = message.field.add(name=field_name, number=number, label=label)
        if isinstance(kind, str):
            field.type = _Field.TYPE_MESSAGE if kind in _MESSAGES else _Field.TYPE_ENUM
            field.type_name = f".{kind}"
        else:
            field.type = kind
    return files | {full_name: file}


LOG_SCHEMA = serialise(_files_of(LOG_TYPE).values())
FRAMES_SCHEMA = serialise(_files_of(FRAMES_TYPE).values())
_LogMessage: Any = message_class(LOG_SCHEMA, LOG_TYPE)  # has attributes that type checkers cannot find
_FramesMessage: Any = message_class(FRAMES_SCHEMA, FRAMES_TYPE)


def encode_event(event: EventMessage) -> NDArray[np.void]:
    """Return an event as a foxglove.Log message, in an array of length 1."""
    message = _LogMessage(level=int(event.level), message=event.text, name=event.source)
    message.timestamp.seconds, message.timestamp.nanos = divmod(event.time_ns, NS_PER_S)
    data = bytes(message.SerializeToString(deterministic=True))
    return np.array([data], f"V{len(data)}")


def decode_event(payload: bytes) -> EventMessage:
    """Return the event in a payload. Raises ValueError if it is not a foxglove.Log with a known level."""
    try:
        message = _LogMessage.FromString(payload)
    except DecodeError as error:
        raise ValueError("not a foxglove.Log") from error
    time_ns = message.timestamp.seconds * NS_PER_S + message.timestamp.nanos
    return EventMessage(time_ns, Level(message.level), message.message, message.name)


def frames_template(parent: str, child: str) -> NDArray[np.void]:
    """Return a FrameTransforms message with a single transform as a structured array of length 1.

    `put_frames` fills in its numbers. Times are varints of five bytes, which every protobuf parser accepts for smaller
    numbers, too. All messages of a pair of frames therefore have the same size.
    """
    message = _FramesMessage()
    transform = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
    transform.timestamp.seconds, transform.timestamp.nanos = 2**35 - 1, 2**31 - 1  # the largest varints of five bytes
    transform.translation.x = transform.translation.y = transform.translation.z = 1.0  # zeros would not be written
    transform.rotation.x = transform.rotation.y = transform.rotation.z = transform.rotation.w = 1.0
    data: bytes = message.SerializeToString(deterministic=True)
    start, component = data.index(b"\xff\xff\xff\xff\x7f"), [("tag", "u1"), ("value", "<f8")]
    layout: list[tuple[str, Any, tuple[int]]] = [
        ("before_seconds", "u1", (start,)),
        ("seconds", "u1", (5,)),
        ("before_nanos", "u1", (1,)),
        ("nanos", "u1", (5,)),
        ("names", "u1", (len(data) - start - 5 - 1 - 5 - 3 * 9 - 2 - 4 * 9,)),
        ("translation", component, (3,)),
        ("before_rotation", "u1", (2,)),
        ("rotation", component, (4,)),
    ]
    return np.frombuffer(data, np.dtype(layout))


def put_frames(messages: NDArray[np.void], times_ns: IntArray, translation_m: Array, rotation: Array) -> None:
    """Write times (n,), translations (n, 3) and rotations (n, 4) into n messages of a `frames_template`.

    The quaternions are scalar first here, and scalar last in the messages.
    """
    messages["seconds"] = _five_byte_varints(times_ns // NS_PER_S)
    messages["nanos"] = _five_byte_varints(times_ns % NS_PER_S)
    messages["translation"]["value"] = translation_m
    messages["rotation"]["value"] = rotation[:, [1, 2, 3, 0]]


def _five_byte_varints(numbers: IntArray) -> NDArray[np.uint8]:
    """Return the varints (n, 5) of numbers (n,) below 2^35, which include every second of an int64 time in ns."""
    groups: NDArray[np.uint8] = ((numbers[:, None] >> np.array([0, 7, 14, 21, 28])) & 0x7F).astype(np.uint8)
    groups[:, :4] |= 0x80
    return groups
