"""The channels of a log by topic: other programs write several channels of one topic."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from ipsys_log.log.contents import Contents
from ipsys_log.log.types import Channel, Schema

__all__ = ["by_topic"]


def by_topic(contents: Contents) -> tuple[Mapping[str, Channel], Mapping[str, str]]:
    """Channels by topic, and in what the channels of one topic differ, where they do."""
    channels: dict[str, Channel] = {}
    conflicts: dict[str, str] = {}
    for key, record in sorted(contents.channels.items()):
        found = contents.schemas.get(record.schema_id)
        schema = Schema(found.name, found.encoding, found.data) if found else None
        count = contents.counts.get(key, 0)
        first = channels.get(record.topic)
        if first is None:
            metadata = MappingProxyType(dict(record.metadata))
            channels[record.topic] = Channel(record.topic, schema, record.message_encoding, metadata, count)
            continue
        if (_kind(first.schema), first.message_encoding) != (_kind(schema), record.message_encoding):
            conflicts[record.topic] = _difference(record.topic, first, schema, record.message_encoding)
        channels[record.topic] = replace(first, message_count=first.message_count + count)
    return MappingProxyType(channels), MappingProxyType(conflicts)


def _kind(schema: Schema | None) -> tuple[str, str] | None:
    """What must agree: a later version of a message has more fields under the same name."""
    return (schema.name, schema.encoding) if schema else None


def _difference(topic: str, first: Channel, schema: Schema | None, encoding: str) -> str:
    names = [f"{s.name} ({s.encoding})" if s else "no schema" for s in (first.schema, schema)]
    return f"channels of {topic} differ: {names[0]} as {first.message_encoding}, {names[1]} as {encoding}"
