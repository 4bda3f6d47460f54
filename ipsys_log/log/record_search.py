"""Search for records in damaged bytes, without trusting any length.

Bytes prove themselves as a record: its fields are consistent, and another plausible record follows. A chunk
proves itself if its records can be unpacked and parsed. A chunk without its head is found by the start of its
compressed data.
"""

import re
from collections.abc import Container, Mapping
from dataclasses import dataclass, field

import lz4.frame
import zstandard
from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError, UnreadError
from ipsys_log.log import records
from ipsys_log.log.byte_source import LARGEST_DEFINITION, BoundError, LogBytes
from ipsys_log.log.chunks import check_definition, parse_chunk_contents, unpack

PRIVATE = 0x80  # every reader skips unknown types from this value on
_BLOCK = 1 << 20
_PIECE = 256  # compressed bytes at a time: the output of the pieces before an error is kept
_LARGEST_FRAME = 256 << 20  # bytes of records
_LARGEST_RATIO = 200  # no recorded data compress better
_ANY_RATIO = 16 << 20  # bytes of records: the ratio counts only above this
_DAY_NS = 86_400 * 1_000_000_000
_SEARCH_BYTES = 64 << 20  # limit of the search without result in a small log
_STEP_BYTES = 256  # the cost of the check of a small record, as bytes of that limit
_ZSTD, _LZ4 = b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"
_HEAD_BEFORE_FRAME = {_ZSTD: 53, _LZ4: 52}  # bytes from the start of a chunk to its data
_CRC_IN_HEAD = 33  # bytes from the start of a chunk to its CRC
_MESSAGE_HEAD = re.compile(rb"(?=\x05.{3}\0{5})", re.DOTALL)
# Compressed records, the head of a chunk, DataEnd, or the head of another record of less than 16 MiB.
_CANDIDATE = re.compile(
    rb"(?=\x28\xb5\x2f\xfd|\x04\x22\x4d\x18|\x06.{36}(?:\0{4}|\x04\0{3}zstd|\x03\0{3}lz4)"
    rb"|\x0f\x04\0{7}|[\x03\x04\x05\x07\x09\x0c].{3}\0{5})",
    re.DOTALL,
)
_SECTOR_BYTES = 512
_NEAR_BYTES = 4096  # after damage, where a stray copy of a sector may fit to the records by chance
_OVERLAP = 64  # bytes: longer than each candidate
_DEFINITIONS = frozenset((Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA))
_IN_CHUNK = frozenset((Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE))
IN_DATA = _DEFINITIONS | {
    Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.DATA_END
}  # fmt: skip
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
class RecordSearch:
    """A search in one log.

    `channels` are the known channel ids, `span_ns` is the time range of the known messages. `frame_at` is the
    offset of the last compressed data that were found without the head of their chunk. `damage_end` is the
    end of the last damage. `budget` limits the bytes that are searched without result.
    """

    view: LogBytes
    channels: Container[int]
    span_ns: tuple[int, int] | None = None
    frame_at: int = -1
    damage_end: int | None = None
    budget: int = field(init=False)

    def __post_init__(self) -> None:
        self.budget = _SEARCH_BYTES + 4 * self.view.size

    def find(self, start: int, end: int | None = None) -> int | None:
        """Return the offset of the next bytes that prove themselves, None if there are none."""
        view = self.view
        end = view.size if end is None else end
        for base in range(start, end, _BLOCK):
            block = view.read(base, min(_BLOCK + _OVERLAP, view.size - base))
            for match in _CANDIDATE.finditer(block):
                offset = base + match.start()
                if match.start() >= _BLOCK or offset >= end or self.budget < 0:
                    break
                if self._proves_itself(offset):
                    return offset
        return None

    def inner_record(self, record: records.RecordAt) -> int | None:
        """Return the offset of the first of other records within this one, if its length is wrong.

        The length is right if a plausible record follows; soon after damage, this may be chance. Records
        within this one prove the contrary if they lead to its end, or further than a stray copy of a sector.
        If nothing follows, one message that fits to the log is proof enough.
        """
        stop = record.offset + record.length
        follows = self._follows(stop)
        is_near = self.damage_end is not None and record.offset - self.damage_end < _NEAR_BYTES
        is_doubtful = is_near or not follows
        if is_doubtful and record.opcode == Opcode.ATTACHMENT:  # it may hold another log
            stored, crc = records.attachment_crcs(self.view, record)
            is_doubtful = stored != crc or stored == 0
        inner = self.find(record.offset + records.HEADER.size, stop) if is_doubtful else None
        while inner is not None and inner != self.frame_at and not self.leads_to(inner, stop):
            if not follows and self._fits_at(inner):
                break
            inner = self.find(inner + 1, stop)
        return inner

    def leads_to(self, start: int, stop: int) -> bool:
        """Return whether records from `start` on lead to `stop`, or further than a stray copy of a sector."""
        position = start
        while position < min(stop, start + _SECTOR_BYTES + 1):
            if not self._follows(position):
                return False
            position += (
                records.HEADER.size + records.HEADER.unpack(self.view.read(position, records.HEADER.size))[1]
            )
        return self._follows(position)

    def _follows(self, stop: int) -> bool:
        """Return whether the log ends at `stop`, or the head of a plausible record is there."""
        view = self.view
        if stop + records.HEADER.size > view.size:
            return stop == view.size
        opcode, length = records.HEADER.unpack(view.read(stop, records.HEADER.size))
        is_known = opcode in IN_DATA or opcode >= PRIVATE
        return is_known and int(length) <= view.size - stop - records.HEADER.size

    def _proves_itself(self, offset: int) -> bool:
        budget = self.budget
        self.budget -= _STEP_BYTES
        try:
            is_proved = self._is_frame(offset) or self._is_record(offset)
        except (BoundError, UnreadError):
            raise
        except LogError:
            return False
        if is_proved:
            self.budget = budget
        return is_proved

    def _is_frame(self, offset: int) -> bool:
        """Return whether the compressed records of a chunk begin at `offset`."""
        if self.view.read(offset, min(len(_ZSTD), self.view.size - offset)) not in (_ZSTD, _LZ4):
            return False
        data, end, _ = self.read_frame(offset)
        self.budget -= len(data) + end - offset
        if data:
            self.frame_at = offset
        return bool(data)

    def _is_record(self, offset: int) -> bool:
        """Return whether a whole record begins at `offset`, judged by its content and the next record."""
        view = self.view
        record = next(records.walk(view, offset, view.size))
        if record.opcode == Opcode.CHUNK:
            head = records.parse_chunk_head(view, offset)[1]
            self.budget -= head.data_size
            data = unpack(view, offset, head, is_crc_checked=False) if self.budget >= 0 else b""
            return bool(parse_chunk_contents(view, offset, data).entries)
        if record.opcode == Opcode.DATA_END:
            return self.end_of_log(offset + record.length) is not None
        if record.opcode in _DEFINITIONS:
            self.parse_definition(record)
            return True
        follows = self._follows(offset + record.length)
        if record.opcode == Opcode.MESSAGE and record.length >= records.MESSAGE.size:
            return follows or self._fits_at(offset)
        if record.opcode == Opcode.ATTACHMENT:
            stored, crc = records.attachment_crcs(view, record)
            return stored == crc if stored else follows
        return follows and record.opcode == Opcode.MESSAGE_INDEX and bool(index_rows(view, record))

    def _fits_at(self, offset: int) -> bool:
        head = self.view.read(offset, min(records.MESSAGE.size, self.view.size - offset))
        is_message = len(head) == records.MESSAGE.size and head[0] == Opcode.MESSAGE
        return is_message and self._fits(*records.MESSAGE.unpack(head)[2:])

    def _fits(self, channel: int, _: int, time_ns: int, published_ns: int) -> bool:
        """Return whether a message has a known channel, and about the time of the known messages.

        The channel may be unknown, or no message known, if log time and publish time are about the same.
        """
        is_consistent = published_ns > 0 and abs(time_ns - published_ns) < _DAY_NS
        if self.span_ns is None:
            return is_consistent
        is_near = self.span_ns[0] - _DAY_NS < time_ns < self.span_ns[1] + _DAY_NS
        return is_near and (is_consistent or channel in self.channels)

    def parse_definition(self, record: records.RecordAt) -> mcap.Schema | mcap.Channel | None:
        """Parse a Schema or Channel record; check a Metadata record, too."""
        if record.opcode not in _DEFINITIONS:
            return None
        if record.length > LARGEST_DEFINITION:
            if self._follows(record.offset + record.length):
                check_definition(self.view, record)
            raise self.view.fault(record.offset, f"a definition claims {record.length} bytes")
        parsed = records.parse_exact(self.view, record, self.view.read(record.offset, record.length))
        if isinstance(parsed, mcap.Schema) and parsed.id == 0:
            raise self.view.fault(record.offset, "a schema has the id 0")
        return parsed if isinstance(parsed, mcap.Schema | mcap.Channel) else None

    def end_of_log(self, start: int) -> int | None:
        """Return the end of the log whose summary begins at `start`; None if there is no such log."""
        view = self.view
        try:
            for record in records.walk(view, start, view.size):
                if record.opcode == Opcode.FOOTER and record.length == records.FOOTER.size:
                    summary = records.FOOTER.unpack(view.read(record.offset, records.FOOTER.size))[2]
                    stop = record.offset + record.length
                    following = view.read(stop, min(2 * len(records.MAGIC), view.size - stop))
                    # After a stray copy without summary, neither the file ends nor another log begins.
                    is_mine = summary == start and following.startswith(records.MAGIC)
                    return (
                        stop + len(records.MAGIC)
                        if is_mine or following in (records.MAGIC, 2 * records.MAGIC)
                        else None
                    )
                if record.opcode not in _IN_SUMMARY and record.opcode < PRIVATE:
                    return None
        except UnreadError:
            raise
        except LogError:
            pass
        return None

    def read_indexes(
        self, entries: Mapping[int, list[tuple[int, int]]], start: int
    ) -> tuple[int, dict[int, int], bool]:
        """Read the message indexes of a chunk with these entries, from `start` on.

        Returns
        -------
        Their end, the offset of each by channel id, and whether they have all entries of the chunk.
        """
        offsets: dict[int, int] = {}
        seen: set[int] = set()
        end, is_right = start, True
        try:
            for record in records.walk(self.view, start, self.view.size):
                if record.opcode != Opcode.MESSAGE_INDEX:
                    break
                channel, rows = index_rows(self.view, record)
                expected = entries.get(channel, [])
                is_mine = channel not in seen and (rows == expected or sorted(rows) == sorted(expected))
                is_right &= is_mine
                if not is_mine and self.inner_record(record) is not None:
                    break
                seen.add(channel)
                if rows:
                    offsets[channel] = record.offset
                end = record.offset + record.length
        except (BoundError, UnreadError):
            raise
        except LogError:
            pass  # the next record is damaged
        return end, offsets, is_right and seen >= entries.keys()

    def read_frame(self, offset: int) -> tuple[bytes, int, bool]:
        """Return the plausible records in compressed data, the end of the data, and whether these are all."""
        claimed = self._claimed_end(offset)
        data, end, is_whole = _decompress(self.view, offset, claimed or self.view.size, self.budget)
        if not is_whole and claimed is not None:
            end = claimed
        pieces, position = [], 0
        while position + records.HEADER.size <= len(data):
            stop = self._end_in(offset, data, position)
            if stop is None:
                is_whole = False
                position = self._next_message_in(data, position + 1)
            else:
                pieces.append(data[position:stop])
                position = stop
        return b"".join(pieces), end, is_whole and position == len(data)

    def frame_crc(self, offset: int) -> int:
        """Return the CRC in the head of the chunk whose compressed data begin at `offset`."""
        crc_at = offset - _HEAD_BEFORE_FRAME[self.view.read(offset, len(_ZSTD))] + _CRC_IN_HEAD
        return int.from_bytes(self.view.read(crc_at, 4), "little") if crc_at > 0 else 0

    def _claimed_end(self, offset: int) -> int | None:
        """Return the end of the chunk with compressed data at `offset`, if its head is whole, else None."""
        head_at = offset - _HEAD_BEFORE_FRAME[self.view.read(offset, len(_ZSTD))]
        try:
            record, head = records.parse_chunk_head(self.view, head_at)
        except LogError:
            return None
        stop = record.offset + record.length
        return stop if head.data_offset == offset and self._follows(stop) else None

    def _end_in(self, offset: int, data: bytearray, position: int) -> int | None:
        """Return the end of the record at `position` in the data of the chunk at `offset`, if plausible."""
        opcode, length = records.HEADER.unpack_from(data, position)
        record = records.RecordAt(opcode, offset, records.HEADER.size + length)
        stop = position + record.length
        is_short = opcode == Opcode.MESSAGE and record.length < records.MESSAGE.size
        if stop > len(data) or is_short or (opcode not in _IN_CHUNK and opcode < PRIVATE):
            return None
        if opcode in _DEFINITIONS:
            try:
                records.parse_exact(self.view, record, bytes(data[position:stop]))
            except LogError:
                return None
        return stop

    def _next_message_in(self, data: bytearray, start: int) -> int:
        """Return the position of the next plausible message in the data of a chunk."""
        for match in _MESSAGE_HEAD.finditer(data, start):
            position = match.start()
            if position + records.MESSAGE.size <= len(data):
                _, length, *fields = records.MESSAGE.unpack_from(data, position)
                is_inside = records.MESSAGE.size <= records.HEADER.size + length <= len(data) - position
                if is_inside and self._fits(*fields):
                    return position
        return len(data)


def _decompress(view: LogBytes, offset: int, stop: int, most: int) -> tuple[bytearray, int, bool]:
    """Decompress data up to their end, an error, the offset `stop`, or a limit of decompressed bytes.

    Returns
    -------
    The bytes, the offset of the end of their compressed data, and whether all was decompressed.
    """
    is_zstd = view.read(offset, len(_ZSTD)) == _ZSTD
    decoder = zstandard.ZstdDecompressor().decompressobj() if is_zstd else lz4.frame.LZ4FrameDecompressor()
    data, position, end = bytearray(), offset, offset
    try:
        while position < stop:
            block = view.read(position, min(_BLOCK, stop - position))
            for start in range(0, len(block), _PIECE):
                piece = block[start : start + _PIECE]
                position += len(piece)
                unpacked = decoder.decompress(piece)
                data += unpacked
                end = position if unpacked else end  # a block with a wrong length may lead further
                limit = min(_LARGEST_FRAME, most, max(_ANY_RATIO, _LARGEST_RATIO * (position - offset)))
                if len(data) > limit:
                    return data, end, False
                if decoder.eof:
                    return data, position - len(decoder.unused_data or b""), True
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError):
        pass
    return data, end, False


def index_rows(view: LogBytes, record: records.RecordAt) -> tuple[int, list[tuple[int, int]]]:
    """Return the channel of a MessageIndex record, and the log times and offsets of its messages."""
    if record.length >= records.INDEX_HEAD.size:
        _, length, channel, size = records.INDEX_HEAD.unpack(
            view.read(record.offset, records.INDEX_HEAD.size)
        )
        if length == size + 6 and size % records.ENTRY.size == 0:
            body = view.read(record.offset, record.length)
            rows = records.parse_message_index(view, body, 0, channel, record.offset)
            return channel, list(records.ENTRY.iter_unpack(rows))
    raise view.fault(record.offset, "a MessageIndex record has another length than its entries")
