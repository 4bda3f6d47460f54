"""Search for the next whole record after damage, without trusting any length."""

import re
import struct
import zlib
from collections import deque
from collections.abc import Container
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice

from mcap.opcode import Opcode

from ipsys_log.errors import LogError, UnreadError
from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.chunks import parse_chunk_contents, unpack
from ipsys_log.log.records import (
    DATA_END,
    FOOTER,
    HEADER,
    INDEX_HEAD,
    MAGIC,
    MESSAGE,
    RecordAt,
    parse_chunk_head,
    parse_exact,
    to_bytes,
    walk,
)

PRIVATE = 0x80  # every reader skips unknown types from this value on
_BLOCK = 1 << 20
_OVERLAP = 64
_LONGEST_HEAD = 1 << 16
_NAME, _SIZE = struct.Struct("<I"), struct.Struct("<Q")
_LONGEST_CHAIN = 256  # records
_LEAST_MESSAGES = 3  # messages and channels in a row, even if they do not belong together
_RECENT = 8  # messages: damage may have changed the time of one of them
_DAY_NS = 86_400 * 1_000_000_000
_FRUITLESS_SEARCH_BYTES = 64 << 20  # bytes: limit of the search without result in a small log
_STEP = 4096  # bytes: the cost of a check of a small record
_CHUNK = rb"\x06.{36}(?:\x00{4}|\x04\x00{3}zstd|\x03\x00{3}lz4)"
_CHUNK_HEAD = re.compile(_CHUNK, re.DOTALL)
_MESSAGE = re.compile(rb"(?=\x05.{3}\x00{5})", re.DOTALL)
_INDEX = re.compile(rb"(?=\x07.{3}\x00{5})", re.DOTALL)
# A chunk by its compression, DataEnd with the next record, or another record of less than 16 MiB.
_CANDIDATE = re.compile(
    rb"(?=" + _CHUNK + rb"|\x0f\x04\x00{7}.{4}[\x02\x03\x04\x08\x0b]|[\x03\x04\x05\x07\x09\x0c].{3}\x00{5})",
    re.DOTALL,
)
_DEFINITIONS = frozenset((Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA))
_IN_SUMMARY = frozenset(
    (
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.STATISTICS,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.METADATA_INDEX,
        Opcode.SUMMARY_OFFSET,
    )
)


@dataclass(slots=True)
class Resync:
    """A search for records in one log.

    `chunked` says whether its messages lie in chunks (None: not known yet). If they do, a message record
    elsewhere is a piece of a damaged chunk. `channels` are the defined ids. `times_ns` are the log times of
    the last messages outside of chunks. `span_ns` is the time range of all messages, if the summary has it.
    `budget` limits the bytes that are searched without result.
    """

    view: LogBytes
    channels: Container[int] = ()
    chunked: bool | None = None
    span_ns: tuple[int, int] | None = None
    times_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_RECENT))
    budget: int = field(init=False)

    def __post_init__(self) -> None:
        self.budget = _FRUITLESS_SEARCH_BYTES + 4 * self.view.size

    def find(self, damaged: int, claimed: int = 0, gap: int = HEADER.size) -> int | None:
        """Return the offset of the next whole record after the damaged record, None if there is none.

        `claimed` is the end of the damaged record by its own length, 0 if there is none. The damaged record
        takes at least `gap` bytes.
        """
        if self.chunked is None and not self.times_ns:
            self.chunked = self._has_chunks(damaged)
        if damaged < claimed and self.starts_records(claimed):
            # Its length may be right, but a stray copy of a head may also claim the bytes after it.
            pattern = _CHUNK_HEAD if self.is_chunk_head(damaged) else _CANDIDATE
            inner = self._find(pattern, damaged + gap, claimed, into_damage=False)
            return claimed if inner is None else inner
        return self._find(_CANDIDATE, damaged + gap)

    def _has_chunks(self, start: int) -> bool:
        """Return whether messages after `start` lie in chunks, judged from the bytes after `start`."""
        torn = start > len(MAGIC) and self.is_chunk_head(start)  # no chunk begins at the offset of the Header
        if torn or self._find(_CHUNK_HEAD, start) is not None:
            return True
        self.chunked = False
        first = self._find(_MESSAGE, start)
        if first is None:
            self.chunked = True
            return self._find(_INDEX, start) is not None
        with suppress(LogError):
            for record_at in walk(self.view, first, self.view.size):
                if record_at.opcode == Opcode.MESSAGE_INDEX:
                    return is_index(self.view, record_at)
        return False

    def is_chunk_head(self, offset: int) -> bool:
        """Return whether the bytes look like the beginning of a chunk, whole or not."""
        head = self.view.read(offset, min(_OVERLAP, self.view.size - offset))
        return _CHUNK_HEAD.match(head) is not None

    def is_end(self, offset: int, crc: int) -> bool:
        """Return whether the DataEnd record at `offset` ends this log.

        A stray copy of a sector may also hold such a record. `crc` is the CRC of the data section up to
        `offset`.
        """
        stored = DATA_END.unpack(self.view.read(offset, DATA_END.size))[2]
        if (stored and stored == crc) or self._leads_to_footer(offset + DATA_END.size):
            return True
        return self.find(offset + DATA_END.size - HEADER.size) is None

    def _leads_to_footer(self, start: int) -> bool:
        try:
            for record_at in walk(self.view, start, self.view.size):
                if record_at.opcode == Opcode.FOOTER and record_at.length == FOOTER.size:
                    summary = FOOTER.unpack(self.view.read(record_at.offset, FOOTER.size))[2]
                    stop = record_at.offset + record_at.length
                    following = self.view.read(stop, min(2 * len(MAGIC), self.view.size - stop))
                    # A stray copy without summary has the same bytes. But neither the end of the file nor
                    # another log follows it.
                    return following in (MAGIC, 2 * MAGIC) or (
                        summary == start and following.startswith(MAGIC)
                    )
                if record_at.opcode not in _IN_SUMMARY and record_at.opcode < PRIVATE:
                    return False
        except UnreadError:
            raise
        except LogError:
            pass
        return False

    def _find(
        self, pattern: re.Pattern[bytes], start: int, end: int | None = None, *, into_damage: bool = True
    ) -> int | None:
        view = self.view
        end = view.size if end is None else end
        for base in range(start, end, _BLOCK):
            block = view.read(base, min(_BLOCK + _OVERLAP, view.size - base))
            for match in pattern.finditer(block):
                offset = base + match.start()
                if match.start() >= _BLOCK or offset >= end:
                    break
                if self.starts_records(offset, into_damage=into_damage):
                    return offset
        return None

    def starts_records(self, offset: int, *, into_damage: bool = True) -> bool:
        """Return whether a record of the data section begins at `offset`, judged by it and the next records.

        With `into_damage`, records may count as whole although damage follows them.
        """
        last = start = stop = steps = 0
        defined: set[int] = set()
        times_ns: list[int] = []  # of messages
        try:
            for record_at in islice(walk(self.view, offset, self.view.size), _LONGEST_CHAIN):
                self.budget -= _STEP
                steps += _STEP
                if self.budget < 0:
                    return False
                verdict = self._judge(record_at, times_ns, defined)
                if verdict is not None:
                    self.budget += steps if verdict else 0
                    return verdict
                last, start, stop = record_at.opcode, record_at.offset, record_at.offset + record_at.length
        except UnreadError:
            raise
        except LogError:  # damage follows, or the end of the written data
            if last == Opcode.MESSAGE_INDEX:
                return into_damage and self.is_chunk_head(stop)
            if last == Opcode.MESSAGE:
                heads = self._is_series(times_ns, stop) or self._are_message_heads(start, stop)
                return into_damage and heads
            return into_damage and last in _DEFINITIONS
        return last > 0

    def _judge(self, record: RecordAt, times_ns: list[int], defined: set[int]) -> bool | None:
        """Return whether a record proves that it and earlier records are whole.

        None means that the next record decides.

        Raises
        ------
        LogError
            The record is damaged.
        """
        view = self.view
        if record.opcode == Opcode.CHUNK:
            return self.chunked is not False and self._is_whole_chunk(record)
        if record.opcode == Opcode.MESSAGE:
            return self._judge_message(record, times_ns, defined)
        if record.opcode in _DEFINITIONS:
            check_exact(view, record, HEADER.size - 1)
            if record.opcode == Opcode.CHANNEL:
                defined.add(int.from_bytes(view.read(record.offset + HEADER.size, 2), "little"))
            return True if record.opcode == Opcode.METADATA else None
        if record.opcode == Opcode.ATTACHMENT:
            stored, crc = attachment_crc(view, record)
            return (stored == crc) if stored else None
        if record.opcode == Opcode.DATA_END:
            return record.length == DATA_END.size
        may_index = record.opcode == Opcode.MESSAGE_INDEX and self.chunked is not False
        return None if record.opcode >= PRIVATE or (may_index and is_index(view, record)) else False

    def _judge_message(self, record: RecordAt, times_ns: list[int], defined: set[int]) -> bool | None:
        if self.chunked or record.length < MESSAGE.size:
            return False
        _, _, channel, _, time_ns, _ = MESSAGE.unpack(self.view.read(record.offset, MESSAGE.size))
        times_ns.append(time_ns)
        near = self._is_near(time_ns) or (not self.times_ns and len(times_ns) > 1)
        fits = channel in defined or (near and channel in self.channels)
        return True if fits or len(times_ns) + len(defined) >= _LEAST_MESSAGES else None

    def fits(self, channel: int, time_ns: int) -> bool:
        """Return whether a message has a defined channel, or about the time of the last messages."""
        return channel in self.channels or not self.times_ns or self._is_near(time_ns)

    def _is_near(self, time_ns: int) -> bool:
        if self.span_ns is not None and self.span_ns[0] - _DAY_NS < time_ns < self.span_ns[1] + _DAY_NS:
            return True
        return any(abs(time_ns - recent_ns) < _DAY_NS for recent_ns in self.times_ns)

    def _is_series(self, times_ns: list[int], stop: int) -> bool:
        """Return whether messages have about the same time, and the head of another message follows them."""
        near = len(times_ns) > 1 and max(times_ns) - min(times_ns) < _DAY_NS
        return near and stop < self.view.size and self.view.read(stop, 1) == bytes([Opcode.MESSAGE])

    def _are_message_heads(self, first: int, second: int) -> bool:
        """Return whether messages of about the same time begin at both offsets; the second may be cut off.

        The channel of one of them must be defined.
        """
        if self.chunked or second + MESSAGE.size > self.view.size:
            return False
        heads = [MESSAGE.unpack(self.view.read(offset, MESSAGE.size)) for offset in (first, second)]
        (_, _, channel, _, time_ns, _), (opcode, length, next_channel, _, next_ns, _) = heads
        is_head = opcode == Opcode.MESSAGE and length >= MESSAGE.size - HEADER.size
        is_defined = channel in self.channels or next_channel in self.channels
        return is_head and is_defined and abs(next_ns - time_ns) < _DAY_NS

    def holds_chunk(self, record: RecordAt) -> bool:
        """Return whether a whole chunk begins within a record."""
        return self._find(_CHUNK_HEAD, record.offset + HEADER.size, record.offset + record.length) is not None

    def _is_whole_chunk(self, record: RecordAt) -> bool:
        view = self.view
        self.budget -= record.length
        if self.budget < 0:
            raise view.fault(record.offset, "too many of its bytes look like chunks, but are not chunks")
        parse_chunk_contents(
            view, record.offset, unpack(view, record.offset, parse_chunk_head(view, record.offset)[1])
        )
        self.budget += record.length
        return True


def is_index(view: LogBytes, record: RecordAt) -> bool:
    """Return whether a MessageIndex record has the length that its entries need."""
    if record.length < INDEX_HEAD.size:
        return False
    _, length, _, size = INDEX_HEAD.unpack(view.read(record.offset, INDEX_HEAD.size))
    return bool(length == size + 6 and size % 16 == 0)


def check_exact(view: LogBytes, record: RecordAt, padding: int | None = None) -> None:
    """Refuse a Schema, Channel or Metadata record with wrong lengths, or with more than `padding` zeros."""
    data = view.read(record.offset, record.length)
    rest = data[len(to_bytes(parse_exact(view, record, data))) :]
    if padding is not None and (len(rest) > padding or any(rest)):
        raise view.fault(record.offset, "a record holds more than its fields")


def attachment_crc(view: LogBytes, record: RecordAt) -> tuple[int, int]:
    """Return the stated CRC of an attachment (0: none), and its computed CRC.

    Raises
    ------
    LogError
        The record has wrong lengths.
    """
    head = view.read(record.offset, min(record.length, _LONGEST_HEAD))
    try:
        (name,) = _NAME.unpack_from(head, HEADER.size + 16)
        (media_type,) = _NAME.unpack_from(head, HEADER.size + 20 + name)
        (size,) = _SIZE.unpack_from(head, HEADER.size + 24 + name + media_type)
    except struct.error:
        raise view.fault(record.offset, "the Attachment record is not valid") from None
    if record.length < HEADER.size + 36 + name + media_type + size:
        raise view.fault(record.offset, "the Attachment record claims lengths that it does not have")
    stored = (
        int.from_bytes(view.read(record.offset + record.length - 4, 4), "little") if record.length > 13 else 0
    )
    return stored, crc_of(view, record.length - HEADER.size - 4, record.offset + HEADER.size) if stored else 0


def crc_of(view: LogBytes, length: int, start: int = 0, crc: int = 0) -> int:
    """Return the CRC-32 of a byte range of the file, continued from `crc`."""
    for offset in range(start, start + length, _BLOCK):
        crc = zlib.crc32(view.read(offset, min(_BLOCK, start + length - offset)), crc)
    return crc
