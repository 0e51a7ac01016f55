"""Topics as MCAP channels, and back: names in the schema; unit, frame and text in the metadata.

The metadata is where viewers show such text; a protobuf schema has no place for it but comments.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from maxq.sim.flight.channels import Channel, Topic
from maxq.sim.log.protobuf import PACKAGE, doubles_schema, field_names

_GROUP, _DESCRIPTION, _FIELD = "group", "description", "field."


def message_type(topic: Topic) -> str:
    return f"{PACKAGE}.{topic.message_name}"


def schema_of(topic: Topic) -> bytes:
    return doubles_schema(topic.message_name, [channel.name for channel in topic.channels])


def metadata_of(topic: Topic) -> dict[str, str]:
    """Rate group and description; for each field a JSON object of unit, frame and description."""
    metadata = {_GROUP: topic.group, _DESCRIPTION: topic.description}
    for channel in topic.channels:
        about = {"unit": channel.unit, "frame": channel.frame, "description": channel.description}
        metadata[_FIELD + channel.name] = json.dumps(about, ensure_ascii=False)
    return metadata


def topic_from(name: str, schema: bytes, metadata: Mapping[str, str]) -> Topic:
    """The topic that a channel was made from. Raises ValueError where the parts do not fit."""
    try:
        channels = []
        for field in field_names(schema):
            about = json.loads(metadata[_FIELD + field])
            channels.append(Channel(field, about["unit"], about["frame"], about["description"]))
        return Topic(name, metadata[_GROUP], tuple(channels), metadata[_DESCRIPTION])
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"the description of topic {name} cannot be read") from error
