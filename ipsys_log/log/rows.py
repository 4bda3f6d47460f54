"""Positions of the messages of a chunk by its message indexes, and the reads that they need."""

from bisect import bisect_right
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ipsys_log.log.byte_source import View
from ipsys_log.log.chunks import look_inside, unpack
from ipsys_log.log.records import ChunkRef, parse_chunk_head, parse_message_index

__all__ = ["ALWAYS", "Entries", "Rows", "Run", "as_rows", "chunk_entries", "runs", "wanted_rows"]

ALWAYS = (0, (1 << 64) - 1)  # ns
_GAP = 4096  # bytes: reading across less than this costs less than another system call
_RUN = 256 << 10  # bytes read at once
_LONG = 16 << 10  # bytes: copying a message once more costs more than another system call

Rows = NDArray[np.uint64]  # shape (N, 2): log time in ns, offset in the chunk or the file
Entries = Mapping[int, Rows]  # by channel id
Run = tuple[int, int]  # where a stretch begins and ends


def as_rows(entries: Mapping[int, list[tuple[int, int]]]) -> Entries:
    return {channel: np.array(rows, np.uint64).reshape(-1, 2) for channel, rows in entries.items()}


def chunk_entries(
    view: View, chunk: ChunkRef, searched: dict[int, Entries], wanted: set[int] | None = None
) -> Entries:
    """Return the rows of a chunk's messages, from its message indexes if there are any.

    `searched` caches, by offset, the rows of chunks without indexes: each is searched once.
    """
    if not chunk.index_offsets or not chunk.index_length:
        if chunk.offset not in searched:
            data = unpack(view, chunk.offset, parse_chunk_head(view, chunk.offset)[1])
            searched[chunk.offset] = as_rows(look_inside(view, chunk.offset, data).entries)
        return searched[chunk.offset]
    start = chunk.offset + chunk.length
    data = view.read(start, chunk.index_length)
    entries = {}
    for channel, offset in chunk.index_offsets.items():
        if wanted is None or channel in wanted:
            rows = parse_message_index(view, data, offset - start, channel, offset)
            entries[channel] = np.frombuffer(rows, "<u8").reshape(-1, 2)
    return entries


def wanted_rows(entries: Entries, topics: Mapping[int, str], span: tuple[int, int]) -> Rows:
    """The rows of the channels in `topics` with start <= log time <= end, sorted by time and offset."""
    found = [rows for channel, rows in entries.items() if channel in topics]
    if not found:
        return np.empty((0, 2), np.uint64)
    rows = found[0] if len(found) == 1 else np.concatenate(found)
    if span != ALWAYS:
        rows = rows[(rows[:, 0] >= span[0]) & (rows[:, 0] <= span[1])]
    return rows[np.lexsort((rows[:, 1], rows[:, 0]))]


def runs(entries: Entries, wanted: Rows, end: int) -> list[Run]:
    """For each wanted row the stretch to read, the same object for all that lie in it.

    Neighbours that lie close together are read at once. An index does not say how long a message is; it
    ends where the next one begins at the latest. A long message has an empty run: it is read when its
    head has said how long it is, and not copied out of anything.
    """
    starts = sorted({offset for rows in entries.values() for offset in rows[:, 1].tolist()})
    starts.append(end)
    offsets = wanted[:, 1].tolist()
    run_of: dict[int, Run] = {}
    group: list[int] = []
    low = high = 0
    for offset in sorted(offsets):
        stop = starts[bisect_right(starts, offset)] if offset < end else offset
        if stop - offset > _LONG:
            run_of[offset] = (offset, offset)
            continue
        if group and (offset - high > _GAP or stop - low > _RUN):
            run_of |= dict.fromkeys(group, (low, high))
            group = []
        low = low if group else offset
        group.append(offset)
        high = stop
    run_of |= dict.fromkeys(group, (low, high))
    return [run_of[offset] for offset in offsets]
