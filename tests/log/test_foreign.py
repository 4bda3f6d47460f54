"""Logs of other software, in every shape of the format: read, appended to, read again."""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from mcap import records as mcap
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from ipsys_log.errors import LogError
from ipsys_log.log.contents import Contents, Schema
from ipsys_log.log.reader import LogReader
from ipsys_log.log.records import MAGIC, ChunkRef, to_bytes
from ipsys_log.log.recovery import repair
from ipsys_log.log.summary import tail_bytes
from ipsys_log.log.writer import LogWriter
from tests.log.conftest import Row, append, as_row, linear_rows, stock_rows
from tests.log.test_bad_input import build, fault_of, read_everything

COUNT = 80
NEW: list[Row] = [("/runs/a", 7 * k + 3, k, bytes([k]) * 30) for k in range(40)]


def payload(number: int) -> bytes:
    return bytes([number]) * 50


def write(path: Path, **options: object) -> list[Row]:
    """Return two topics and a third with two channels, chunks of 2 kB, an attachment, metadata."""
    rows: list[Row] = []
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2000, **options)  # type: ignore[arg-type]
        writer.start()
        schema = writer.register_schema("Thing", "jsonschema", b"{}")
        topics = ["/a", "/b", "/two", "/two"]
        ids = [writer.register_channel(topic, "json", schema) for topic in topics]
        writer.add_attachment(1, 2, "notes.txt", "text/plain", b"hello")
        for number in range(COUNT):
            time = number * 10 - number % 3 * 25 + 100  # out of order
            writer.add_message(ids[number % 4], time, payload(number), time)
            rows.append((topics[number % 4], time, time, payload(number)))
        writer.add_metadata("robot", {"name": "seven"})
        writer.finish()  # type: ignore[no-untyped-call]
    return sorted(rows, key=lambda row: row[1])


def ours(path: Path) -> list[Row]:
    with LogReader(path) as reader:
        return [as_row(message) for message in reader.messages()]


SHAPES: dict[str, dict[str, object]] = {
    "plain": {"compression": CompressionType.NONE},
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "unchunked": {"use_chunking": False},
    "no index": {"index_types": IndexType.NONE},
    "no message index": {"index_types": IndexType.CHUNK},
    "no chunk index": {"index_types": IndexType.MESSAGE},
    "no statistics": {"use_statistics": False},
    "no channels": {"repeat_channels": False, "repeat_schemas": False},
    "no schemas": {"repeat_schemas": False},
    "no offsets": {"use_summary_offsets": False},
    "no CRC": {"enable_crcs": False},
    "data CRC": {"enable_data_crcs": True},
    "no summary": {
        "index_types": IndexType.NONE,
        "use_statistics": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_summary_offsets": False,
    },
}


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape(shape: str, tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    rows = write(path, **SHAPES[shape])
    assert ours(path) == rows
    with LogReader(path) as reader:
        end = reader.data_end
        hashes = {topic: reader.channel_hash(topic) for topic in reader.channels}
        assert reader.channels["/two"].message_count == COUNT // 2
        assert reader.times("/a").tolist() == [row[1] for row in rows if row[0] == "/a"]
    before = path.read_bytes()[:end]
    assert not repair(path).changed
    append(path, NEW)
    append(path, [])
    expected = sorted(rows + NEW, key=lambda row: row[1])
    assert path.read_bytes()[:end] == before
    assert sorted(ours(path)) == sorted(expected)
    assert [row[1] for row in ours(path)] == [row[1] for row in expected]
    assert sorted(linear_rows(path)) == sorted(expected)
    assert sorted(stock_rows(path)) == sorted(expected)
    with LogReader(path) as reader:
        assert {topic: reader.channel_hash(topic) for topic in hashes} == hashes
    assert not repair(path).changed


@pytest.mark.parametrize("shape", ["zstd", "lz4", "no statistics", "no chunk index", "no channels"])
def test_node_reads_what_was_appended(
    shape: str, tmp_path: Path, read_with_node: Callable[[Path], tuple[int, int, int]]
) -> None:
    """The other reader cannot index logs without chunks, or chunks without message indexes."""
    path = tmp_path / "foreign.mcap"
    rows = write(path, **SHAPES[shape])
    append(path, NEW)
    assert read_with_node(path)[::2] == (len(rows) + len(NEW), len(rows) + len(NEW))


def test_attachments_and_metadata_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    write(path)
    append(path, NEW)
    with path.open("rb") as file:
        reader = make_reader(file)
        assert [a.data for a in reader.iter_attachments()] == [b"hello"]
        assert [m.metadata for m in reader.iter_metadata() if m.name == "robot"] == [{"name": "seven"}]


def test_a_foreign_channel_can_be_extended(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    rows = write(path)
    with LogWriter.append(path) as writer:
        writer.add_channel("/two", Schema("Thing", "jsonschema", b"{}"), "json")
        writer.write("/two", 5, 5, b"early")
    assert ours(path) == sorted([*rows, ("/two", 5, 5, b"early")], key=lambda row: row[1])


def test_ids_with_gaps(tmp_path: Path) -> None:
    """Ids 7 and 65535 are in use, so new ids must differ."""
    contents = Contents()
    contents.schemas[65535] = mcap.Schema(65535, b"", "json", "Thing")
    for key in (7, 65535):
        contents.channels[key] = mcap.Channel(key, f"/{key}", "json", {}, 65535)
    records = [*contents.schemas.values(), *contents.channels.values()]
    data = MAGIC + to_bytes(mcap.Header("", ""), *records)
    contents.data_end = len(data)
    path = tmp_path / "gaps.mcap"
    path.write_bytes(data + tail_bytes(contents))
    append(path, NEW)
    assert ours(path) == NEW
    assert stock_rows(path) == NEW


def test_channels_of_one_topic_that_differ(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for name in ("One", "Two"):
            channel = writer.register_channel("/x", "json", writer.register_schema(name, "jsonschema", b"{}"))
            writer.add_message(channel, 1, b"{}", 1)
        other = writer.register_channel("/y", "json", 0)
        writer.add_message(other, 2, b"{}", 2)
        writer.finish()  # type: ignore[no-untyped-call]
    with LogReader(path) as reader:
        assert list(reader.conflicts) == ["/x"]
        assert [message.topic for message in reader.messages(["/y"])] == ["/y"]
        with pytest.raises(LogError, match=r"channels of /x differ: One \(jsonschema\) as json, Two"):
            reader.messages()


def test_unknown_compression(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    write(path, compression=CompressionType.ZSTD)
    path.write_bytes(path.read_bytes().replace(b"\x04\0\0\0zstd", b"\x04\0\0\0abcd"))
    with pytest.raises(LogError, match=r"CRC of the summary|abcd"):
        ours(path)


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
