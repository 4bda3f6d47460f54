"""The messages of a chunk with their CRC-32, from one pass over its bytes.

The CRC of an image is computed once: the CRC of its chunk follows from it, and so do the hash of its channel
and the CRC of a new chunk.
"""

import zlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.hashing import WORTH_COMBINING, Buffer, combine, extend
from ipsys_log.log.records import HEAD_SIZE, MESSAGE, MESSAGE_HEAD_SIZE

Rows = NDArray[np.uint64]  # shape (N, 2): log time in ns, offset in the chunk or the file
Entries = Mapping[int, Rows]  # by channel id

# A change of times within a message changes at most so many of its first bytes.
_CHANGED_START = 256


class CheckedMessage(NamedTuple):
    """A message of a chunk: its channel id, times in ns, the bytes of its data, and their CRC-32.

    `offset` is that of its record, `start` and `end` those of its data; all count from the first record.
    """

    channel: int
    log_time_ns: int
    publish_time_ns: int
    offset: int
    start: int
    end: int
    crc: int


def check_messages(
    view: LogBytes, chunk_offset: int, data: Buffer, entries: Entries, chunk_crc: int
) -> tuple[list[CheckedMessage], int]:
    """Return the messages of a chunk in the order of the file, and the CRC-32 of its records.

    Parameters
    ----------
    data : the records of the chunk, decompressed.
    entries : log times in ns and offsets of the messages, (N, 2), by channel id.
    chunk_crc : the stored CRC-32 of the records; 0 if there is none.

    Raises
    ------
    LogError
        The CRC is wrong, or the message indexes do not name each message once.
    """
    data, position, crc = memoryview(data), 0, 0
    messages = []
    for time_ns, offset in rows_by_offset(entries):
        opcode, length, key, _, log_ns, publish_ns = message_head(view, data, offset, chunk_offset)
        start, end = offset + MESSAGE_HEAD_SIZE, offset + HEAD_SIZE + length
        is_valid = opcode == Opcode.MESSAGE and key in entries and log_ns == time_ns
        has_more = position < offset and data[position] == Opcode.MESSAGE  # and the index lacks it
        if not is_valid or has_more or offset < position or not start <= end <= len(data):
            raise view.fault(chunk_offset, "a message index points to no message of its time")
        own_crc = zlib.crc32(data[start:end])
        crc = extend(zlib.crc32(data[position:start], crc), data[start:end], own_crc)
        messages.append(CheckedMessage(key, log_ns, publish_ns, offset, start, end, own_crc))
        position = end
    crc = zlib.crc32(data[position:], crc)
    if chunk_crc and crc != chunk_crc:
        raise view.fault(chunk_offset, "the CRC of the chunk is wrong")
    return messages, crc


def rows_by_offset(entries: Entries) -> list[list[int]]:
    """Return log time and offset of messages in the order of the file."""
    rows = np.concatenate([*entries.values()])
    ordered: list[list[int]] = rows[np.argsort(rows[:, 1], kind="stable")].tolist()
    return ordered


def message_head(view: LogBytes, data: Buffer, position: int, chunk_offset: int) -> tuple[int, ...]:
    """Return the values of a message record without its data.

    Raises
    ------
    LogError
        The record reaches beyond the end of the chunk.
    """
    if position + MESSAGE_HEAD_SIZE > len(data):
        raise view.fault(chunk_offset, "a message reaches beyond the end of its chunk")
    return MESSAGE.unpack_from(data, position)


def crc_of_changed(old: Buffer, old_crc: int, new: bytes) -> int:
    """Return the CRC-32 of data whose first bytes have changed, without a pass over equal last bytes.

    A CRC is linear. So the CRC of the equal bytes follows from those of the old data and of their start.

    Examples
    --------
    >>> old, new = b"12" + bytes(100_000), b"567" + bytes(100_000)
    >>> crc_of_changed(old, zlib.crc32(old), new) == zlib.crc32(new)
    True
    """
    length = min(len(old), len(new)) - _CHANGED_START
    if length < WORTH_COMBINING:
        return zlib.crc32(new)
    old = memoryview(old)
    if not new.endswith(old[-length:]):
        return zlib.crc32(new)
    tail_crc = combine(zlib.crc32(old[:-length]), old_crc, length)
    return combine(zlib.crc32(new[:-length]), tail_crc, length)
