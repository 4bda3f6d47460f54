"""A reader of logs: by their indexes, in log order, also while another process appends."""

import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import LogError, UnreadError
from ipsys_log.log.byte_source import FileBytes, LogBytes, ReadLimits, open_for_reading
from ipsys_log.log.channel_sizes import ChannelSize, read_sizes
from ipsys_log.log.chunk_messages import (
    ALWAYS,
    PendingChunk,
    RangeCache,
    Rows,
    chunk_entries,
    in_log_order,
    open_chunk,
    open_unchunked,
    planned_range,
    to_rows,
)
from ipsys_log.log.chunks import has_wrong_crc
from ipsys_log.log.contents import Contents, RawMessage, group_by_topic
from ipsys_log.log.file_check import FileCheck, check_file
from ipsys_log.log.hashing import ChannelHash, hash_messages, stored_hashes
from ipsys_log.log.journal import attach_journal, is_being_written
from ipsys_log.log.known_contents import contents_of, open_remote
from ipsys_log.log.location import LogLocation, LogUrl
from ipsys_log.log.records import ChunkRef
from ipsys_log.log.summary import NoFooterError
from ipsys_log.log.survey import Watch
from ipsys_log.plain_text import shell_words

_logger = logging.getLogger(__name__)

_ATTEMPTS = 100
_PAUSE_S = 0.02


class LogReader:
    """A finished log, open for reading.

    Other programs write several channels with one topic. They are read as one channel. A reader stays
    consistent while another process appends: it shows the log at the time of opening.

    Attributes
    ----------
    channels : Mapping[str, Channel]
        The channels by topic.
    conflicts : Mapping[str, str]
        The topics whose channels differ in schema or encoding, with the difference. They cannot be read as
        one channel.
    start_ns, end_ns : int or None
        Log times of the first and the last message.
    message_count : int
    chunk_count : int
    compressions : Mapping[str, int]
        Number of chunks by compression ("" means none).
    size : int
        Size of the file in bytes.
    bytes_read : int
        Bytes read from it so far.

    Raises
    ------
    LogError
        The file is missing, empty, not an MCAP, has no footer, or is damaged.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from ipsys_log.log.contents import Schema
    >>> from ipsys_log.log.writer import LogWriter
    >>> with TemporaryDirectory() as folder:
    ...     with LogWriter.create(Path(folder) / "a.mcap") as log:
    ...         log.add_channel("/a", Schema("A", "jsonschema", b"{}"), "json")
    ...         log.write("/a", 1_000, 900, b"{}")
    ...     with LogReader(Path(folder) / "a.mcap") as log:
    ...         [(message.topic, message.log_time_ns) for message in log.messages()]
    [('/a', 1000)]
    """

    def __init__(self, path: str | os.PathLike[str] | LogUrl) -> None:
        self.path: LogLocation = path if isinstance(path, LogUrl) else Path(path)
        self._view, self._contents = _open(self.path)
        self._view.plan("chunks", (planned_range(chunk) for chunk in self._contents.chunks))
        self._cache = RangeCache()
        self._stored: dict[str, ChannelHash] | None = None
        self.channels, self.conflicts = group_by_topic(self._contents)
        self.start_ns, self.end_ns = self._contents.start_ns, self._contents.end_ns
        self.message_count = sum(self._contents.counts.values())
        self.chunk_count = len(self._contents.chunks)
        self.compressions: Mapping[str, int] = Counter(chunk.compression for chunk in self._contents.chunks)
        self.size = self._view.size

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the file; a second call does nothing."""
        self._view.close()

    @property
    def bytes_read(self) -> int:
        """The number of bytes read from the file so far, with its table of contents."""
        return self._view.bytes_read

    @property
    def read_limits(self) -> ReadLimits:
        """The limits of the work to read the log."""
        return self._view.read_limits

    @property
    def view(self) -> LogBytes:
        """The bytes of the log."""
        return self._view

    @property
    def contents(self) -> Contents:
        """The table of contents of the log, which callers do not change."""
        return self._contents

    @property
    def data_end(self) -> int:
        """The end of the data section; an append changes no byte before it."""
        return self._contents.data_end

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
        is_checked: bool = False,
    ) -> Iterator[RawMessage]:
        """Return the messages in log order: by log time, then by offset in the file.

        Parameters
        ----------
        topics
            The topics to read; None means all topics. A topic that is not in the log has no messages.
        start_ns, end_ns
            Half-open range of log time in ns: start <= log time < end.
        is_checked
            Read each chunk as a whole, and check its CRC.

        Raises
        ------
        LogError
            A record is damaged, or the channels of a wanted topic differ in schema.
        """
        contents, view = self._contents, self._view
        wanted = self._topics_by_id(topics)
        span = (max(0, start_ns or 0), ALWAYS[1] if end_ns is None else end_ns - 1)
        chunks = [
            chunk
            for chunk in self._chunks_with(wanted)
            if chunk.start_ns <= span[1] and chunk.end_ns >= span[0]
        ]
        if span[1] < span[0] or not wanted:
            return iter(())
        pending = [
            PendingChunk(
                chunk.start_ns,
                chunk.offset,
                partial(open_chunk, view, self._cache, chunk, wanted, span, is_checked),
            )
            for chunk in chunks
        ]
        if contents.unchunked:
            entries = to_rows(contents.unchunked)
            unchunked = partial(open_unchunked, view, self._cache, entries, wanted, span, contents.data_end)
            pending.append(PendingChunk(0, 0, unchunked))
        return in_log_order(pending, lambda at: view.fault(at, "a message is older than its chunk says"))

    def times(self, topic: str) -> NDArray[np.int64]:
        """Return the log times of a topic in ns, sorted, shape (N,); read from the indexes alone."""
        parts = [rows[:, 0] for _, _, rows in self._indexed(self._topics_by_id([topic]))]
        return np.sort(np.concatenate(parts) if parts else np.empty(0, np.uint64)).astype(np.int64)

    def order(self, topics: Sequence[str]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the log times in ns and the places in ``topics`` of messages, (N,) each, in log order.

        They are read from the indexes alone.
        """
        names = self._topics_by_id(topics)
        # Rows of log time, offset of the chunk, offset in the chunk, and place.
        parts = [
            _positions(rows, chunk_offsets, topics.index(names[key]))
            for key, chunk_offsets, rows in self._indexed(names)
        ]
        rows = np.concatenate(parts) if parts else np.empty((0, 4), np.uint64)
        ordered = rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))].astype(np.int64)
        return ordered[:, 0], ordered[:, 3]

    def _indexed(self, wanted: Collection[int]) -> Iterator[tuple[int, Rows | int, Rows]]:
        """Yield the rows of some channels: the channel id, the offset of their chunk, and the rows.

        Messages outside of chunks have their own offsets in the file, as in `in_log_order`.
        """
        for key, rows in to_rows(self._contents.unchunked).items():
            if key in wanted:
                yield key, rows[:, 1], rows
        for chunk in self._chunks_with(wanted):
            for key, rows in self._entries(chunk, wanted):
                yield key, chunk.offset, rows

    def _chunks_with(self, wanted: Collection[int]) -> list[ChunkRef]:
        """Return the chunks that have messages of some channels, or that have no index."""
        ids = set(wanted)
        return [
            chunk
            for chunk in self._contents.chunks
            if not chunk.index_offsets or not ids.isdisjoint(chunk.index_offsets)
        ]

    def _entries(self, chunk: ChunkRef, wanted: Collection[int]) -> list[tuple[int, Rows]]:
        entries = chunk_entries(self._view, chunk, self._cache.searched, set(wanted))
        return [(key, rows) for key, rows in entries.items() if key in wanted]

    def first_time(self, topic: str) -> int | None:
        """Return the log time of the first message of a topic in ns; None if it has none."""
        return self._extreme_time(topic, last=False)

    def last_time(self, topic: str) -> int | None:
        """Return the log time of the last message of a topic in ns; None if it has none."""
        return self._extreme_time(topic, last=True)

    def _extreme_time(self, topic: str, last: bool) -> int | None:
        """Read the indexes from that end of the log, until no other chunk can have a further time."""
        wanted, sign = set(self._topics_by_id([topic])), -1 if last else 1
        rows = to_rows(self._contents.unchunked)
        times = [sign * int(time) for key in wanted & rows.keys() for time in rows[key][:, 0]]
        chunks = [
            (sign * (chunk.end_ns if last else chunk.start_ns), chunk) for chunk in self._chunks_with(wanted)
        ]
        for bound, chunk in sorted(chunks, key=lambda row: row[0]):
            if times and min(times) <= bound:
                break
            times += [sign * int(time) for _, rows in self._entries(chunk, wanted) for time in rows[:, 0]]
        return sign * min(times) if times else None

    def channel_hash(self, topic: str) -> str:
        """Return the hash over times and payloads of a channel in log order, in hexadecimal.

        The hash does not depend on the chunks and files of the messages. The stored hash of the writer is
        used if it matches the log; else the channel is read once.
        """
        if topic not in self.channels:
            raise LogError(
                f"{self.path} has no topic {topic}. To list the topics: ipsys info {shell_words(self.path)}"
            )
        state = self._known_hash(topic)
        if state is None:
            state = self._hashes()[topic] = hash_messages(self.messages([topic]))
        return state.digest.hex()

    def has_stored_hash(self, topic: str) -> bool:
        """Return whether the hash of a channel is known without a read of its messages."""
        return topic in self.channels and self._known_hash(topic) is not None

    def _known_hash(self, topic: str) -> ChannelHash | None:
        state = self._hashes().get(topic)
        return state if state is not None and state.count == self.channels[topic].message_count else None

    def _hashes(self) -> dict[str, ChannelHash]:
        if self._stored is None:
            self._stored = stored_hashes(self._view, self._contents)
        return self._stored

    def check_file(self, watch: Watch) -> FileCheck:
        """Read every byte of the log, and compare records, CRCs, indexes, summary and stored hashes."""
        return check_file(self._view, self._contents, stored_hashes(self._view, self._contents), watch)

    def changed_chunks(self, topics: Collection[str]) -> Iterator[tuple[int, int, list[str]]]:
        """Yield the chunks with these topics that contradict their CRC; of files, not of remote objects.

        Yields
        ------
        The offset of the chunk, its first log time in ns, and those of the topics that it has.
        """
        wanted = self._topics_by_id(topics)
        chunks = self._contents.chunks if wanted and isinstance(self._view, FileBytes) else []
        for chunk in chunks:
            names = [topic for key, topic in wanted.items() if key in chunk.index_offsets]
            if names and has_wrong_crc(self._view, chunk.offset):
                yield chunk.offset, chunk.start_ns, names

    def sizes(
        self, progress: Callable[[int], None] = lambda done: None, topics: Collection[str] | None = None
    ) -> list[ChannelSize]:
        """Return the sizes of the channels, the largest first; `progress` gets the number of chunks done.

        With `topics`, only the chunks of these topics are read, and only their sizes are returned.
        """
        contents = self._contents
        if topics is None:
            return read_sizes(self._view, contents, progress)
        wanted = {key for key, channel in contents.channels.items() if channel.topic in topics}
        sizes = read_sizes(self._view, replace(contents, chunks=self._chunks_with(wanted)), progress)
        return [size for size in sizes if size.topic in topics]

    def _topics_by_id(self, topics: Collection[str] | None) -> dict[int, str]:
        wanted = self.channels.keys() if topics is None else set(topics)
        for topic in sorted(self.conflicts.keys() & wanted):
            raise LogError(f"{self.path}: {self.conflicts[topic]}: the topic cannot be read as one channel")
        return {key: c.topic for key, c in self._contents.channels.items() if c.topic in wanted}


def _positions(rows: Rows, chunk_offsets: Rows | int, place: int) -> Rows:
    positions = np.empty((len(rows), 4), np.uint64)
    positions[:, 0], positions[:, 1] = rows[:, 0], chunk_offsets
    positions[:, 2], positions[:, 3] = rows[:, 1], place
    return positions


def _open(path: LogLocation) -> tuple[LogBytes, Contents]:
    if isinstance(path, LogUrl):
        remote = open_remote(path)
        return remote, contents_of(remote)
    return _open_file(path)


def _open_file(path: Path) -> tuple[FileBytes, Contents]:
    """Open a log in a consistent state: the old log if its journal is valid, else an unchanging file."""
    fault: LogError | None = None
    for _ in range(_ATTEMPTS):
        fd = open_for_reading(path)
        status_before = os.fstat(fd)
        view = FileBytes(path, fd, status_before.st_size, status_before.st_size)
        has_journal = attach_journal(view)
        fault = None
        try:
            contents = contents_of(view)
        except LogError as error:
            fault = error
        except BaseException:
            view.close()
            raise
        if fault is None and (has_journal or _is_unchanged(view, status_before)):
            if (has_journal or contents.cut_short) and not is_being_written(path):
                _logger.warning(
                    "%s: an append was interrupted; ipsys reads the old log. To repair it: "
                    "ipsys repair %s",
                    path, path,
                )  # fmt: skip
            return view, contents
        has_changed = not has_journal and not _is_unchanged(view, status_before)
        view.close()
        if fault is not None and not has_changed:
            break
        time.sleep(_PAUSE_S)
    if fault is None or (isinstance(fault, NoFooterError) and is_being_written(path)):
        raise UnreadError(f"{path} is being recorded or written now: try again when this has ended")
    raise fault


def _is_unchanged(view: FileBytes, before: os.stat_result) -> bool:
    now = os.fstat(view.fd)
    probe = FileBytes(view.path, os.dup(view.fd), now.st_size, now.st_size)
    try:
        same = (now.st_size, now.st_mtime_ns) == (before.st_size, before.st_mtime_ns)
        return same and not attach_journal(probe)
    finally:
        probe.close()
