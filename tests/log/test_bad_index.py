"""A message index that points to no valid message of its channel gives one line."""

import struct
from pathlib import Path

import pytest
import zstandard
from mcap import records as mcap

from ipsys_log.log.contents import Contents
from ipsys_log.log.records import MAGIC, ChunkRef, to_bytes
from tests.log.test_bad_input import build, fault_of, read_everything

NO_MESSAGE = "points to no message of its time"
BEYOND = "beyond the end of its chunk"


@pytest.mark.parametrize("compression", ["", "zstd"])
@pytest.mark.parametrize(
    ("opcode", "length", "channel", "offset", "more", "expected"),
    [
        (5, 30, 1, 0, 0, ""),
        (4, 30, 1, 0, 0, NO_MESSAGE),
        (5, 30, 9, 0, 0, NO_MESSAGE),  # of an undefined channel
        (5, 21, 1, 0, 0, NO_MESSAGE),  # shorter than its own header
        (5, 31, 1, 0, 0, BEYOND),
        (5, (1 << 64) - 10, 1, 0, 0, BEYOND),
        (5, 30, 1, 20, 0, BEYOND),
        (5, 30, 1, (1 << 64) - 1, 0, BEYOND),
        (5, 30, 1, 20, 1000, "damaged"),  # the chunk index has a chunk length that is too large
    ],
)
def test_one_message(
    opcode: int,
    length: int,
    channel: int,
    offset: int,
    more: int,
    expected: str,
    compression: str,
    tmp_path: Path,
) -> None:
    records = struct.pack("<BQHIQQ", opcode, length, channel, 0, 7, 7) + b"8 bytes."
    data = zstandard.ZstdCompressor().compress(records) if compression else records
    chunk = mcap.Chunk(compression, data, 7, 7, 0, len(records))
    index = mcap.MessageIndex(1, [(7, offset)])
    start = len(MAGIC) + len(to_bytes(mcap.Header("", "")))
    end = start + len(to_bytes(chunk))
    contents = Contents(channels={1: mcap.Channel(1, "/a", "", {}, 0)}, counts={1: 1})
    contents.chunks.append(
        ChunkRef(
            start,
            end - start,
            7,
            7,
            compression,
            len(data),
            len(records) + more,
            len(to_bytes(index)),
            {1: end},
        )
    )
    fault = fault_of(read_everything, build(tmp_path / "bad.mcap", contents, chunk, index))
    assert expected in fault
    assert bool(expected) == bool(fault)
