"""Message types that viewers know by name: `foxglove.Log` (events), `foxglove.FrameTransforms` (frames).

Names and field numbers are those of Foxglove's published protobuf schemas.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, timestamp_pb2
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.log.protobuf import message_class, serialise

LOG_TYPE = "foxglove.Log"
FRAMES_TYPE = "foxglove.FrameTransforms"

_Field = descriptor_pb2.FieldDescriptorProto
_NS_PER_S = 1_000_000_000


class Level(IntEnum):
    """Severity of an event, numbered as foxglove.LogLevel."""

    UNKNOWN = 0
    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4
    FATAL = 5


@dataclass(frozen=True)
class Event:
    """Something that happened at one instant; `source` is the component that reports it."""

    time_ns: int
    level: Level
    text: str
    source: str = ""


@dataclass(frozen=True)
class FramePath:
    """Motion of the frame `child` relative to `parent`.

    `times_ns` (n,); `translation_m` (n, 3): origin of the child in parent components; `rotation` (n, 4): unit
    quaternion, scalar first, that turns child components into parent components (q_BI for parent I, child B).
    """

    parent: str
    child: str
    times_ns: IntArray
    translation_m: Array
    rotation: Array


_TIMESTAMP = "google.protobuf.Timestamp"  # written here so that a log does not vary with the protobuf release
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
"""Fields 1, 2, ... of each message by type: a scalar, or the name of a message or of the enumeration LogLevel."""


def _files_of(full_name: str) -> dict[str, descriptor_pb2.FileDescriptorProto]:
    """The file of a message or enumeration after those that it imports, by type."""
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
_LogMessage: Any = message_class(LOG_SCHEMA, LOG_TYPE)  # its attributes are known at run time only
_FramesMessage: Any = message_class(FRAMES_SCHEMA, FRAMES_TYPE)


def encode_event(event: Event) -> bytes:
    message = _LogMessage(level=int(event.level), message=event.text, name=event.source)
    message.timestamp.seconds, message.timestamp.nanos = divmod(event.time_ns, _NS_PER_S)
    return bytes(message.SerializeToString(deterministic=True))


def decode_event(payload: bytes) -> Event:
    """Raises ValueError if the bytes are no foxglove.Log with a known level."""
    try:
        message = _LogMessage.FromString(payload)
    except DecodeError as error:
        raise ValueError("not a foxglove.Log") from error
    time_ns = message.timestamp.seconds * _NS_PER_S + message.timestamp.nanos
    return Event(time_ns, Level(message.level), message.message, message.name)


def frames_template(parent: str, child: str) -> NDArray[np.void]:
    """One FrameTransforms message of one transform as a structured array of length 1, numbers to be filled.

    Times are varints of five bytes, which every protobuf parser reads for smaller numbers too: so all messages of a
    pair of frames have one size.
    """
    message = _FramesMessage()
    transform = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
    transform.timestamp.seconds, transform.timestamp.nanos = 2**35 - 1, 2**31 - 1  # the largest of five bytes
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
    """Fill n messages of a `frames_template`; `rotation` comes scalar first and is stored scalar last."""
    messages["seconds"] = _five_byte_varints(times_ns // _NS_PER_S)
    messages["nanos"] = _five_byte_varints(times_ns % _NS_PER_S)
    messages["translation"]["value"] = translation_m
    messages["rotation"]["value"] = rotation[:, [1, 2, 3, 0]]


def _five_byte_varints(numbers: IntArray) -> NDArray[np.uint8]:
    """(n, 5) bytes; five groups of seven bits hold any second of an int64 time in nanoseconds."""
    groups: NDArray[np.uint8] = ((numbers[:, None] >> np.array([0, 7, 14, 21, 28])) & 0x7F).astype(np.uint8)
    groups[:, :4] |= 0x80
    return groups
