"""The table of contents of a log: schemas, channels, chunks, counts, and the parts of topics."""

import re
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple, Self

from mcap import records as mcap

from ipsys_log.log.records import ChunkRef

_OWN = re.compile(r"(?:/runs/(?P<run>[a-z][a-z0-9_]*))?/cameras/(?P<camera>[a-z][a-z0-9_]*)/[a-z_]+")
_RUN = re.compile(r"/runs/(?P<run>[a-z][a-z0-9_]*)/")
# The last parts of a topic that describe the image, and not its camera.
_GENERIC = re.compile(
    r"(image|images|raw|rect|color|colour|mono|compressed|calibration|camera_info|info|jpeg)"
    r"(_(raw|rect|color|colour|mono|compressed))*"
)


def camera_of_topic(topic: str) -> str | None:
    """Return the camera in an ipsys topic, such as ``/runs/stock/cameras/red/markers``; or None."""
    match = _OWN.fullmatch(topic)
    return match["camera"] if match else None


@lru_cache(4096)  # a log has few topics, but many messages
def run_of_topic(topic: str) -> str | None:
    """Return the run in a topic; None for a recorded topic."""
    match = _RUN.match(topic)
    return match["run"] if match else None


def parse_foreign_camera(topic: str) -> str:
    """Return the camera in a topic of another program, such as ``/robot/front/image_raw/compressed``."""
    parts = topic.strip("/").split("/")
    while len(parts) > 1 and _GENERIC.fullmatch(clean_name(parts[-1])):
        parts.pop()
    return clean_name("/".join(parts))


def clean_name(text: str) -> str:
    """Return a valid camera name made from any text."""
    name = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    return name if name[:1].isalpha() else f"camera_{name}".rstrip("_")


@dataclass(frozen=True, slots=True)
class Schema:
    """The type of a channel's messages.

    Parameters
    ----------
    name
        Full name of the message type, for example ``foxglove.CompressedImage``.
    encoding
        The format of ``data``, for example ``protobuf`` (a ``FileDescriptorSet``).
    data
        The definition.
    """

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class StoredChannel:
    """One topic of a log.

    ``schema`` is None for a channel without schema. ``message_count`` counts the messages in the whole log.
    """

    topic: str
    schema: Schema | None
    message_encoding: str
    metadata: Mapping[str, str]
    message_count: int


class RawMessage(NamedTuple):
    """One message, payload not decoded. Times are in ns.

    The class is a tuple: to create a frozen dataclass takes four times as long, and a log has many messages.
    """

    topic: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


_LARGEST_ID = 0xFFFF


@dataclass(slots=True)
class Contents:
    """Schemas and channels by id, chunks, and the counts that go into the Statistics record.

    `unchunked` holds the messages that lie in no chunk: per channel id (log time in ns, file offset).
    `data_end` is the offset of the end of the data, `data_crc` the CRC of the data (0: not computed). The
    DataEnd record lies at `data_end`, unless an append was interrupted (`cut_short`).
    """

    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)
    chunks: list[ChunkRef] = field(default_factory=list)
    attachments: list[mcap.AttachmentIndex] = field(default_factory=list)
    metadata: list[mcap.MetadataIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    attachment_count: int = 0
    metadata_count: int = 0
    start_ns: int | None = None
    end_ns: int | None = None
    unchunked: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    data_end: int = 0
    data_crc: int = 0
    cut_short: bool = False

    def copy(self) -> Self:
        """Return a copy that does not change when these contents grow."""
        fields = ("schemas", "channels", "chunks", "attachments", "metadata", "counts", "unchunked")
        return replace(self, **{name: copy(getattr(self, name)) for name in fields})

    def count(self, channel_id: int, messages: int) -> None:
        """Add `messages` to the count of a channel."""
        self.counts[channel_id] = self.counts.get(channel_id, 0) + messages

    def cover(self, start_ns: int, end_ns: int) -> None:
        """Extend the time range of the log to include `start_ns` and `end_ns`."""
        self.start_ns = start_ns if self.start_ns is None else min(self.start_ns, start_ns)
        self.end_ns = end_ns if self.end_ns is None else max(self.end_ns, end_ns)


_LOST_SCHEMA = Schema("", "", b"")


def free_id(known: Mapping[int, object]) -> int | None:
    """Return the lowest id above all known ids, else a free id below, else None."""
    above = max(known, default=0) + 1
    if above <= _LARGEST_ID:
        return above
    return next((key for key in range(1, _LARGEST_ID + 1) if key not in known), None)


def group_by_topic(contents: Contents) -> tuple[Mapping[str, StoredChannel], Mapping[str, str]]:
    """Return the channels by topic, and by topic the differences between channels of one topic, if any."""
    channels: dict[str, StoredChannel] = {}
    conflicts: dict[str, str] = {}
    for key, record in sorted(contents.channels.items()):
        schema_record = contents.schemas.get(record.schema_id)
        schema = (
            Schema(schema_record.name, schema_record.encoding, schema_record.data) if schema_record else None
        )
        count = contents.counts.get(key, 0)
        first = channels.get(record.topic)
        if first is None:
            metadata = MappingProxyType(dict(record.metadata))
            channels[record.topic] = StoredChannel(
                record.topic, schema, record.message_encoding, metadata, count
            )
            continue
        # Repair writes an empty schema in place of a lost one: it is that of the other channels of the topic.
        if first.schema == _LOST_SCHEMA:
            first = replace(first, schema=schema)
        elif schema == _LOST_SCHEMA:
            schema = first.schema
        if (_kind(first.schema), first.message_encoding) != (_kind(schema), record.message_encoding):
            conflicts[record.topic] = _difference(record.topic, first, schema, record.message_encoding)
        channels[record.topic] = replace(first, message_count=first.message_count + count)
    return MappingProxyType(channels), MappingProxyType(conflicts)


def _kind(schema: Schema | None) -> tuple[str, str] | None:
    """Return the parts of a schema that must agree.

    A later version of a message has more fields under the same name.
    """
    return (schema.name, schema.encoding) if schema else None


def _difference(topic: str, first: StoredChannel, schema: Schema | None, encoding: str) -> str:
    names = [f"{s.name} ({s.encoding})" if s else "no schema" for s in (first.schema, schema)]
    return f"channels of {topic} differ: {names[0]} as {first.message_encoding}, {names[1]} as {encoding}"
