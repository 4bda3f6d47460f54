"""A repair saves all readable data, loses no byte, reports unknown losses, and is atomic."""

import os
import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import cast

import lz4.frame
import pytest
import zstandard
from mcap import records as mcap
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from ipsys_log.errors import LogError
from ipsys_log.log.contents import Contents, Schema, group_by_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.journal import Storage
from ipsys_log.log.reader import LogReader
from ipsys_log.log.records import MAGIC, to_bytes
from ipsys_log.log.recovery import repair
from ipsys_log.messages.channels import EVENTS_TOPIC
from ipsys_log.messages.events import DAMAGED
from tests.conftest import ROOT
from tests.log.conftest import IMAGE, POINT, Row, as_row, create, linear_rows, stock_rows
from tests.log.crash import Recorder, crashes
from tests.log.damage import QUICK, NoSync, non_seeking_rows

START_NS = 1_700_000_000_000_000_000


def read(path: Path) -> list[Row]:
    with LogReader(path) as reader:
        return [as_row(message) for message in reader.messages()]


def agree(path: Path) -> list[Row]:
    """Read with all readers, which must agree; repair again, which must change nothing.

    Return the messages without the events of the repair.
    """
    rows = sorted(read(path))
    for other in (stock_rows, linear_rows, non_seeking_rows):
        assert sorted(other(path)) == rows
    before = path.read_bytes()
    assert not repair(path).changed
    assert path.read_bytes() == before
    return [row for row in rows if row[0] != EVENTS_TOPIC]


def rows_of(count: int) -> list[Row]:
    chance = random.Random(count)
    rows: list[Row] = []
    for k in range(count):
        now = START_NS + k * 50_000_000
        rows.append(("/image/0", now, now, chance.randbytes(700)))
        rows.append(("/points", now + 1, now, chance.randbytes(20)))
    return rows


def record_at(data: bytes | bytearray, opcode: int, number: int = 0) -> tuple[int, int]:
    """Return the first and last offset of a record of the data section."""
    position = 8
    while position < len(data):
        kind, length = struct.unpack_from("<BQ", data, position)
        if kind == opcode:
            if number == 0:
                return position, position + 9 + length
            number -= 1
        position += 9 + length
    raise AssertionError(opcode)


def test_repair_zeroed_index_body_is_written_again(tmp_path: Path) -> None:
    """A sector of zeros that begins inside a message index: an index of channel 0 without rows."""
    rows = rows_of(200)
    path = create(tmp_path / "a.mcap", rows)
    data = bytearray(path.read_bytes())
    start, end = record_at(data, Opcode.MESSAGE_INDEX)
    data[start + 9 : min(end, start + 9 + 512)] = bytes(min(end, start + 9 + 512) - start - 9)
    path.write_bytes(data)
    report = repair(path)
    assert agree(path) == sorted(rows)
    assert (report.lost_counts, report.uncounted) == ({}, False)


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize("what", ["schema id", "channel id", "schema record"])
def test_repair_lost_definition_keeps_messages(what: str, finished: bool, tmp_path: Path) -> None:
    """Messages keep their topics if the summary has them, or if only the schema is lost."""
    rows = rows_of(60)
    path = create(tmp_path / "a.mcap", rows)
    data = bytearray(path.read_bytes())
    if not finished:
        del data[record_at(data, Opcode.DATA_END)[0] :]
    channel, _ = record_at(data, Opcode.CHANNEL)
    schema, end = record_at(data, Opcode.SCHEMA)
    if what == "schema record":
        data[schema:end] = bytes(end - schema)
    else:
        data[channel + (11 if what == "schema id" else 9)] ^= 1 << 5
    path.write_bytes(data)
    repair(path)
    got = agree(path)
    assert [row[1:] for row in sorted(got, key=lambda row: row[1])] == [row[1:] for row in rows]
    if finished or what != "channel id":
        assert got == sorted(rows)
    if finished:
        with LogReader(path) as reader:
            assert reader.channels["/image/0"].schema == IMAGE
            assert reader.channels["/points"].schema == POINT


def test_repair_zeroed_beginning_keeps_every_message(tmp_path: Path) -> None:
    """Without a summary, the topics are unknown; the messages are there under others."""
    rows = rows_of(60)
    path = create(tmp_path / "a.mcap", rows)
    data = bytearray(path.read_bytes())
    end = record_at(data, Opcode.CHUNK)[0]
    data[:end] = bytes(end)
    path.write_bytes(data)
    repair(path)
    assert agree(path) == sorted(rows)
    data = data[: record_at(MAGIC + bytes(path.read_bytes()[8:]), Opcode.DATA_END)[0]]
    path.write_bytes(data)
    repair(path)
    assert [row[1:] for row in sorted(agree(path), key=lambda row: row[1])] == [row[1:] for row in rows]
    with LogReader(path) as reader:
        assert set(reader.channels) == {"/lost/1", "/lost/2"}


def one_chunk_log(path: Path, compression: CompressionType, count: int = 3000) -> list[Row]:
    chance = random.Random(5)
    rows: list[Row] = []
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 30, compression=compression)
        writer.start()
        channel = writer.register_channel("/a", "json", writer.register_schema("A", "jsonschema", b"{}"))
        for k in range(count):
            data = f'{{"x": {chance.random()}, "number": {k}}}'.encode()
            writer.add_message(channel, START_NS + k, data, START_NS + k)
            rows.append(("/a", START_NS + k, START_NS + k, data))
        writer.finish()  # type: ignore[no-untyped-call]
    return rows


def whole_messages(data: bytes) -> int:
    """Messages are in the records of a chunk with a lost end."""
    position = count = 0
    while position + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, position)
        position += 9 + length
        count += opcode == Opcode.MESSAGE and position <= len(data)
    return count


NAMES = {CompressionType.ZSTD: "zstd", CompressionType.LZ4: "lz4", CompressionType.NONE: ""}
UNPACK: dict[CompressionType, Callable[[bytes], bytes]] = {
    CompressionType.ZSTD: lambda data: zstandard.ZstdDecompressor().decompressobj().decompress(data),
    CompressionType.LZ4: lambda data: lz4.frame.LZ4FrameDecompressor().decompress(data),
    CompressionType.NONE: lambda data: data,
}


@pytest.mark.parametrize("compression", CompressionType)
def test_repair_cut_chunk_keeps_what_streams_out(compression: CompressionType, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    rows = one_chunk_log(path, compression, 8000)
    data = path.read_bytes()
    start, end = record_at(data, Opcode.CHUNK)
    cut = start + (end - start) * 4 // 5
    path.write_bytes(data[:cut])
    expected = whole_messages(UNPACK[compression](data[start + 49 + len(NAMES[compression]) : cut]))
    report = repair(path)
    assert agree(path) == sorted(rows[:expected])
    assert 5000 < expected < 8000
    assert (report.messages_kept, report.unchecked) == (expected, expected)
    assert report.uncounted
    assert report.bytes_lost > 0
    assert report.damaged_file is not None
    kept = report.damaged_file.read_bytes()
    assert path.read_bytes()[: cut - len(kept)] + kept == data[:cut]


@pytest.mark.parametrize("compression", CompressionType)
def test_repair_hole_in_chunk_keeps_the_rest(compression: CompressionType, tmp_path: Path) -> None:
    """The part before the hole is saved; without compression, the part after the hole, too."""
    path = tmp_path / "a.mcap"
    rows = one_chunk_log(path, compression)
    data = bytearray(path.read_bytes())
    start, end = record_at(data, Opcode.CHUNK)
    hole = (start + (end - start) * 3 // 4) // 512 * 512
    data[hole : hole + 512] = bytes(512)
    path.write_bytes(data)
    report = repair(path)
    got = set(agree(path))
    kept = [row in got for row in rows]
    assert kept.index(False) > 1000
    assert compression != CompressionType.NONE or kept.count(False) < 10
    assert report.unchecked == len(got)
    assert report.uncounted is False
    assert set(report.lost.get("/a", ())) <= {row[1] for row in rows} - {row[1] for row in got}
    assert report.damaged_file is not None
    assert report.damaged_file.read_bytes() == data
    event = next(row for row in read(path) if row[0] == EVENTS_TOPIC)
    assert b"no CRC confirms them: /a" in event[3]


def log_with_loose_messages(path: Path) -> list[Row]:
    """Return chunks, each with its message indexes, and messages between them; no summary."""
    rows, data = [], to_bytes(mcap.Header("", "other"), mcap.Channel(1, "/a", "json", {}, 0))
    data = MAGIC + data + to_bytes(mcap.Channel(2, "/b", "json", {}, 0))
    for number in range(6):
        now = START_NS + number * 10**9
        entries: dict[int, list[tuple[int, int]]] = {1: [], 2: []}
        inside = b""
        for k in range(10):
            entries[1 + k % 2].append((now + k, len(inside)))
            inside += to_bytes(mcap.Message(1 + k % 2, now + k, b"inside" * 9, now, k))
        data += to_bytes(mcap.Chunk("", inside, now + 9, now, zlib.crc32(inside), len(inside)))
        data += to_bytes(*(mcap.MessageIndex(channel, found) for channel, found in entries.items()))
        for k in range(10, 16):
            data += to_bytes(mcap.Message(1 + k % 2, now + k, b"beside" * 9, now, k))
        texts = [b"inside"] * 10 + [b"beside"] * 6
        rows += [(("/a", "/b")[k % 2], now + k, now, text * 9) for k, text in enumerate(texts)]
    path.write_bytes(data + to_bytes(mcap.DataEnd(0), mcap.Footer(0, 0, 0)) + MAGIC)
    return rows


@pytest.mark.parametrize("at", [9, 0, 14])
@pytest.mark.parametrize("number", [2, 5, 7])
def test_repair_damaged_index_costs_no_loose_message(at: int, number: int, tmp_path: Path) -> None:
    """Flip one bit of channel, type or length, in a log with messages in and outside of chunks."""
    path = tmp_path / "mixed.mcap"
    rows = log_with_loose_messages(path)
    data = bytearray(path.read_bytes())
    data[record_at(data, Opcode.MESSAGE_INDEX, number)[0] + at] ^= 0x40
    path.write_bytes(data)
    repair(path, storage=QUICK)
    assert agree(path) == sorted(rows)


def test_repair_reports_an_unknown_content_of_removed_bytes(tmp_path: Path) -> None:
    """A chunk and its indexes are missing: the summary has moved, and no CRC matches."""
    path = create(tmp_path / "log.mcap", rows_of(60))
    data = path.read_bytes()
    start, _ = record_at(data, Opcode.CHUNK, 1)
    stop, _ = record_at(data, Opcode.CHUNK, 2)
    path.write_bytes(data[:start] + data[stop:])
    report = repair(path, storage=QUICK)
    assert report.uncounted
    agree(path)


def test_repair_without_room_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = create(tmp_path / "a.mcap", rows_of(80))
    data = path.read_bytes()[:-4000]
    path.write_bytes(data)
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 5_000})())
    with pytest.raises(LogError, match=r"cannot be repaired: the old data are kept.* free some space"):
        repair(path)
    assert path.read_bytes() == data
    assert [*tmp_path.iterdir()] == [path]


def test_repair_record_types_that_stray_do_no_harm(tmp_path: Path) -> None:
    """The log has a second definition of one id, an index of no chunk, and a message of no channel."""
    rows = rows_of(20)
    path = create(tmp_path / "a.mcap", rows)
    data = path.read_bytes()
    at = record_at(data, Opcode.CHUNK)[0]
    stray = to_bytes(
        mcap.Channel(1, "/other", "protobuf", {}, 1),
        mcap.MessageIndex(0, []),
        mcap.Message(77, 5, b"x", 5, 0),
    )
    path.write_bytes(data[:at] + stray + data[at : record_at(data, Opcode.DATA_END)[0]])
    repair(path)
    assert agree(path) == sorted([*rows, ("/lost/77", 5, 5, b"x")])


def test_repair_small_bomb_takes_little_memory(tmp_path: Path) -> None:
    """Return a cut chunk of 1 GiB of zeros in 33 kB."""
    import tracemalloc

    path = create(tmp_path / "a.mcap", rows_of(5))
    data = path.read_bytes()
    end = record_at(data, Opcode.DATA_END)[0]
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 30))
    chunk = to_bytes(mcap.Chunk("zstd", bomb, 1, 1, 0, 1 << 30))
    path.write_bytes(data[:end] + chunk[:-20])
    tracemalloc.start()
    try:
        repair(path)
        assert tracemalloc.get_traced_memory()[1] < 64 << 20
    finally:
        tracemalloc.stop()
    assert len(agree(path)) == 10


def test_repair_hash_of_channel_is_that_of_its_messages(tmp_path: Path) -> None:
    """The record of a run must not name another input than the real one."""
    path = tmp_path / "a.mcap"
    one_chunk_log(path, CompressionType.NONE)
    data = bytearray(path.read_bytes())
    start, end = record_at(data, Opcode.CHUNK)
    hole = (start + (end - start) * 3 // 4) // 512 * 512
    data[hole : hole + 512] = bytes(512)
    path.write_bytes(data)
    repair(path)
    with LogReader(path) as reader:
        stored = reader.channel_hash("/a")
        again = create(tmp_path / "b.mcap", [as_row(message) for message in reader.messages()])
    with LogReader(again) as reader:
        assert reader.channel_hash("/a") == stored


@pytest.mark.parametrize("lost", [1, 2])
def test_topic_with_a_lost_schema_is_read_with_the_other_one(lost: int) -> None:
    """Repair knows the channel, but not its schema; another channel of the topic has it."""
    contents = Contents()
    contents.schemas = {key: mcap.Schema(key, b"{}", "jsonschema", "A") for key in (1, 2)}
    contents.schemas[lost] = mcap.Schema(lost, b"", "", "")
    contents.channels = {key: mcap.Channel(key, "/a", "json", {}, key) for key in (1, 2)}
    channels, conflicts = group_by_topic(contents)
    assert conflicts == {}
    assert channels["/a"].schema == Schema("A", "jsonschema", b"{}")


def case(name: str, folder: Path) -> Path:
    """Return a copy of a file from the folder of faulty inputs."""
    cases = Path(os.environ.get("IPSYS_CASES", ROOT / "../shared/cases"))
    if not cases.is_dir():
        pytest.skip(f"no folder {cases} with faulty inputs: set IPSYS_CASES")
    log = folder / "log.mcap"
    log.write_bytes((cases / name).read_bytes())
    return log


def test_repaired_log_is_not_refused(tmp_path: Path) -> None:
    """The schema of one of the channels of a topic was lost with the beginning of the log."""
    log = case("damage/appended_1_3196.mcap", tmp_path)
    assert repair(log).changed
    with Session([log]) as session:
        topics = [topic for reader in session.readers for topic in reader.channels]
        assert sum(1 for _ in session.messages([t for t in topics if not t.startswith("/lost/")])) > 900
        assert session.payloads(["/measurements"])


def test_repair_wrong_crc_keeps_and_names_all_messages(tmp_path: Path) -> None:
    """The damaged message is unknown: all messages of its chunk are kept, and an event names their range."""
    path = tmp_path / "a.mcap"
    rows = one_chunk_log(path, CompressionType.NONE, 50)
    data = bytearray(path.read_bytes())
    data[data.index(b'"number": 30')] ^= 1
    path.write_bytes(data)
    report = repair(path)
    assert [row[1] for row in agree(path)] == [row[1] for row in rows]
    assert (report.unchecked, report.messages_kept, report.lost_counts) == (50, 51, {})
    with Session([path]) as session:
        [event] = session.payloads([EVENTS_TOPIC])
    assert (event.kind, event.start, event.end) == (DAMAGED, rows[0][1], rows[-1][1])
    assert event.text.startswith("50 messages from ")


@pytest.mark.parametrize("name", ["hdr33", "hdr45", "silent_bitflip_39253"])
def test_repair_one_flipped_bit_loses_no_message(name: str, tmp_path: Path) -> None:
    log = case(f"damage/{name}.mcap", tmp_path)
    with LogReader(log) as reader:
        count = reader.message_count
    report = repair(log)
    assert (report.lost_counts, report.uncounted) == ({}, False)
    assert len(agree(log)) >= count


def test_repair_twice_keeps_both_old_logs(tmp_path: Path) -> None:
    path = create(tmp_path / "a.mcap", rows_of(80))
    damaged = []
    for number in (1, 3):
        data = bytearray(path.read_bytes())
        start, end = record_at(data, Opcode.CHUNK, number)
        data[(start + end) // 2] ^= 0xFF
        path.write_bytes(data)
        damaged.append((bytes(data), repair(path).damaged_file))
    assert [kept.name for _, kept in damaged if kept] == ["a.mcap.damaged", "a.mcap.damaged_2"]
    assert all(kept is not None and kept.read_bytes() == data for data, kept in damaged)


@pytest.mark.parametrize("is_cut", [True, False])
def test_repair_cut_at_every_point_is_old_or_new(tmp_path: Path, is_cut: bool) -> None:
    """After a power loss during a repair, a second repair gives the same log, and the old bytes are kept."""
    path = create(tmp_path / "a.mcap", rows_of(25))
    data = bytearray(path.read_bytes())
    start, end = record_at(data, Opcode.CHUNK, 1)
    if is_cut:
        del data[(start + end) // 2 :]
    else:
        data[(start + end) // 2] ^= 0xFF
    old = bytes(data)
    path.write_bytes(old)
    storage = Recorder()
    storage.know(path)
    kept = repair(path, storage=storage).damaged_file
    assert kept is not None
    new, removed = path.read_bytes(), kept.read_bytes()
    assert old.endswith(removed)
    folder = tmp_path / "crashed"
    folder.mkdir()
    log = folder / "a.mcap"
    seen = set()
    for cut, disk in crashes({"a.mcap": old}, storage.operations, random.Random(3), tries=4):
        state = tuple(sorted((name, bytes(disk.files[number])) for name, number in disk.names.items()))
        if state in seen:
            continue
        seen.add(state)
        disk.store(folder)
        repair(log, storage=QUICK)
        assert log.read_bytes() == new, f"after {cut} operations"
        rest = {file.name: file.read_bytes() for file in folder.iterdir() if file != log}
        assert all(name.startswith("a.mcap.damaged") for name in rest), f"after {cut} operations"
        assert removed in rest.values(), f"after {cut} operations"
    assert len(seen) > 10


class Replacing(NoSync):
    """A disk where another program replaces the log while its copy is written."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def fsync(self, fd: int) -> None:  # noqa: ARG002
        other = self.path.with_name("other")
        other.write_bytes(b"another log")
        other.rename(self.path)


def test_repair_of_a_replaced_log_leaves_the_other_one(tmp_path: Path) -> None:
    path = create(tmp_path / "a.mcap", rows_of(25))
    data = bytearray(path.read_bytes())
    start, end = record_at(data, Opcode.CHUNK, 1)
    data[(start + end) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(LogError, match="another program has replaced the log"):
        repair(path, storage=cast(Storage, Replacing(path)))
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("a.mcap", b"another log")]
