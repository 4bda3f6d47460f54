"""The table of contents of a log, as the summary of an MCAP file holds it."""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace

from mcap import records as mcap

from ipsys_log.log.records import ChunkRef

__all__ = ["Contents", "free_id"]

_LARGEST_ID = 0xFFFF


@dataclass(slots=True)
class Contents:
    """Schemas and channels by id, chunks, and the counts that go into the Statistics record.

    `loose` holds the messages that lie in no chunk: per channel id (log time in ns, file offset).
    `data_end` is the offset of the end of the data, `data_crc` their CRC (0: not computed). The DataEnd
    record lies there, unless an append was interrupted (`cut_short`).
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
    loose: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    data_end: int = 0
    data_crc: int = 0
    cut_short: bool = False

    def copy(self) -> "Contents":
        """Return a copy that does not change when this one grows."""
        fields = ("schemas", "channels", "chunks", "attachments", "metadata", "counts", "loose")
        return replace(self, **{name: copy(getattr(self, name)) for name in fields})

    def count(self, channel_id: int, messages: int) -> None:
        """Add `messages` to the count of a channel."""
        self.counts[channel_id] = self.counts.get(channel_id, 0) + messages

    def cover(self, start_ns: int, end_ns: int) -> None:
        """Stretch the time range of the log over `start_ns` to `end_ns`."""
        self.start_ns = start_ns if self.start_ns is None else min(self.start_ns, start_ns)
        self.end_ns = end_ns if self.end_ns is None else max(self.end_ns, end_ns)


def free_id(known: Mapping[int, object]) -> int | None:
    """The lowest id above all known ones, or a free one below, or None."""
    above = max(known, default=0) + 1
    if above <= _LARGEST_ID:
        return above
    return next((key for key in range(1, _LARGEST_ID + 1) if key not in known), None)
