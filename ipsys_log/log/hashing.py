"""Hashes of channels from the CRC-32 of their messages, without reading the images again.

A digest is a chain over the messages in log order. So it does not depend on chunks or files, and it can be
continued when a channel grows.

The CRC of an image is computed once. The hash of its channel, its chunk and the data section all use it.
"""

import hashlib
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

from mcap import records as mcap

from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.contents import Contents, RawMessage
from ipsys_log.log.records import HEADER, parse, to_bytes, walk

Buffer = bytes | memoryview
WORTH_COMBINING = 32 << 10  # bytes: for shorter data, a second read costs less

# For each byte of a CRC, the lowest first: the result for each of its 256 values.
Tables = tuple[list[int], list[int], list[int], list[int]]


def combine(first: int, second: int, length: int) -> int:
    """Return the CRC-32 of two joined byte strings from their CRCs; the second has `length` bytes.

    The result is the same as from ``crc32_combine`` of zlib, which Python does not offer. Except for a
    constant, a CRC is linear in the bits of the data. So `length` more bytes change the first CRC like
    `length` zero bytes. The zero bytes are appended in powers of two. This takes about 5 µs for an image.

    Examples
    --------
    >>> combine(zlib.crc32(b"one, "), zlib.crc32(b"two"), 3) == zlib.crc32(b"one, two")
    True
    """
    power = 0
    while length >> power:
        if length >> power & 1:
            first = _apply(_append_zeros(power), first)
        power += 1
    return first ^ second


def extend(first: int, data: Buffer, crc: int) -> int:
    """Return the CRC-32 `first` continued by `data`, whose CRC-32 is `crc`; choose the faster method."""
    return zlib.crc32(data, first) if len(data) < WORTH_COMBINING else combine(first, crc, len(data))


def _apply(tables: Tables, crc: int) -> int:
    low, second, third, high = tables
    return low[crc & 255] ^ second[crc >> 8 & 255] ^ third[crc >> 16 & 255] ^ high[crc >> 24]


@cache
def _append_zeros(power: int) -> Tables:
    """Return the tables that append 2**power zero bytes to a CRC, without the constant."""
    if power == 0:
        of_bit = [zlib.crc32(b"\0", 1 << bit) ^ zlib.crc32(b"\0") for bit in range(32)]
    else:
        half = _append_zeros(power - 1)
        of_bit = [_apply(half, _apply(half, 1 << bit)) for bit in range(32)]
    return _sums(of_bit[:8]), _sums(of_bit[8:16]), _sums(of_bit[16:24]), _sums(of_bit[24:])


def _sums(of_bit: list[int]) -> list[int]:
    """Return the value for each byte, from the values for its eight bits."""
    sums = [0]
    for value in of_bit:
        sums += [value ^ lower for lower in sums]
    return sums


METADATA_NAME = "ipsys"
_ROW = struct.Struct("<QQQI")
_PREFIX = "hash:"


@dataclass(slots=True)
class ChannelHash:
    """The hash chain of a channel after `count` messages; `last_ns` is the log time of the last message.

    `valid` becomes False if a message is older than the message before it. Then the chain is not in log
    order, and the hash needs a read of the whole channel.
    """

    count: int = 0
    last_ns: int = 0
    digest: bytes = bytes(16)
    valid: bool = True

    def add(self, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        """Continue the chain by one message."""
        self.add_row(log_time_ns, publish_time_ns, len(data), zlib.crc32(data))

    def add_row(self, log_time_ns: int, publish_time_ns: int, length: int, crc: int) -> None:
        """Continue the chain by one message, given by the length and the CRC-32 of its data."""
        if log_time_ns < self.last_ns:
            self.valid = False
        self.count += 1
        self.last_ns = log_time_ns
        if self.valid:
            row = _ROW.pack(log_time_ns, publish_time_ns, length, crc)
            self.digest = hashlib.blake2b(self.digest + row, digest_size=16).digest()


def hash_messages(messages: Iterable[RawMessage]) -> ChannelHash:
    """Return the hash chain of messages in log order."""
    state = ChannelHash()
    for message in messages:
        state.add(message.log_time_ns, message.publish_time_ns, message.data)
    return state


def metadata_of_hashes(hashes: dict[str, ChannelHash], offset: int) -> bytes:
    """Return the Metadata record for `offset` that stores the valid hashes in `hashes` by topic.

    The record holds its own offset. A tool that copies records to other offsets may change the log and not
    update the hashes. Then the stored offset is wrong, and readers ignore the hashes.
    """
    values = {"offset": str(offset)}
    for topic, state in hashes.items():
        if state.valid and state.count:
            values[_PREFIX + topic] = f"{state.count} {state.last_ns} {state.digest.hex()}"
    return to_bytes(mcap.Metadata(METADATA_NAME, values)) if len(values) > 1 else b""


def stored_hashes(view: LogBytes, contents: Contents) -> dict[str, ChannelHash]:
    """Return the hashes that writers stored in the log, the newest per topic."""
    hashes: dict[str, ChannelHash] = {}
    for index in sorted(contents.metadata, key=lambda record: record.offset):
        if index.name == METADATA_NAME and index.offset + HEADER.size <= contents.data_end:
            record_at = next(walk(view, index.offset, contents.data_end))
            body = view.read(record_at.offset + HEADER.size, record_at.length - HEADER.size)
            record = parse(mcap.Metadata.read, view, record_at, body)
            hashes |= _hashes_in(record, index.offset)
    return hashes


def _hashes_in(record: mcap.Metadata, offset: int) -> dict[str, ChannelHash]:
    """Return the hashes in `record` at `offset`; none if the record was moved, or is not from ipsys."""
    hashes: dict[str, ChannelHash] = {}
    if record.name != METADATA_NAME or record.metadata.get("offset") != str(offset):
        return hashes
    for key, value in record.metadata.items():
        if key.startswith(_PREFIX):
            try:
                count, last_ns, digest = value.split()
                state = ChannelHash(int(count), int(last_ns), bytes.fromhex(digest))
            except ValueError:
                continue
            if len(state.digest) == 16:
                hashes[key.removeprefix(_PREFIX)] = state
    return hashes
