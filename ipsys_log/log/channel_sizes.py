"""The sizes of the channels of a log, before and after compression."""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field

from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.chunks import parse_chunk_contents, unpack
from ipsys_log.log.contents import Contents
from ipsys_log.log.records import HEADER, MESSAGE, ChunkRef, parse_chunk_head


@dataclass(frozen=True, slots=True)
class ChannelSize:
    """The size of a channel in bytes.

    ``payload_bytes`` are those of its messages, before compression. ``stored_bytes`` are those in the file,
    with the heads of the messages. A compressed chunk counts for its channels in proportion to their bytes.
    """

    topic: str
    messages: int
    payload_bytes: int
    stored_bytes: int


@dataclass(slots=True)
class _Total:
    messages: int = 0
    record_bytes: int = 0
    stored_bytes: float = field(default=0.0)

    def add(self, messages: int, record_bytes: int, ratio: float) -> None:
        self.messages += messages
        self.record_bytes += record_bytes
        self.stored_bytes += record_bytes * ratio


def read_sizes(
    view: LogBytes, contents: Contents, progress: Callable[[int], None] = lambda done: None
) -> list[ChannelSize]:
    """Return the sizes of the channels, the largest in the file first; every chunk is read once."""
    totals: defaultdict[str, _Total] = defaultdict(_Total)
    for channel in contents.channels.values():
        totals[channel.topic] = _Total()
    for number, chunk in enumerate(contents.chunks, 1):
        for topic, count, record_bytes, ratio in _chunk_sizes(view, contents, chunk):
            totals[topic].add(count, record_bytes, ratio)
        progress(number)
    for key, rows in contents.unchunked.items():
        lengths = [HEADER.unpack(view.read(offset, HEADER.size))[1] for _, offset in rows]
        totals[_topic(contents, key)].add(len(rows), sum(lengths) + HEADER.size * len(rows), 1.0)
    sizes = [
        ChannelSize(
            topic, total.messages, total.record_bytes - MESSAGE.size * total.messages,
            round(total.stored_bytes),
        )
        for topic, total in totals.items()
    ]  # fmt: skip
    return sorted(sizes, key=lambda size: (-size.stored_bytes, size.topic))


def _chunk_sizes(view: LogBytes, contents: Contents, chunk: ChunkRef) -> list[tuple[str, int, int, float]]:
    """Return topic, messages, bytes of their records, and the compression ratio, by channel of a chunk."""
    head = parse_chunk_head(view, chunk.offset)[1]
    data = unpack(view, chunk.offset, head)
    ratio = head.data_size / len(data) if data else 0.0
    rows = []
    for key, entries in parse_chunk_contents(view, chunk.offset, data).entries.items():
        lengths = [HEADER.unpack_from(data, offset)[1] for _, offset in entries]
        rows.append((_topic(contents, key), len(entries), sum(lengths) + HEADER.size * len(lengths), ratio))
    return rows


def _topic(contents: Contents, key: int) -> str:
    return contents.channels[key].topic if key in contents.channels else f"channel {key}"
