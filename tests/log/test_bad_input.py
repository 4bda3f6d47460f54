"""A log is untrusted input: one clear line, no other exception, and little memory."""

import errno
import random
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pytest
import zstandard
from mcap import records as mcap
from mcap.opcode import Opcode
from mcap.writer import Writer

from ipsys_log.errors import LogError
from ipsys_log.log.contents import Contents, Schema
from ipsys_log.log.journal import DISK, Storage, check_locks, journal_path
from ipsys_log.log.reader import LogReader
from ipsys_log.log.records import MAGIC, ChunkRef, to_bytes
from ipsys_log.log.recovery import repair
from ipsys_log.log.summary import tail_bytes
from ipsys_log.log.writer import LogWriter
from tests.log.conftest import Row, append, create, stock_rows
from tests.log.crash import Recorder


def read_everything(path: Path) -> None:
    with LogReader(path) as reader:
        list(reader.messages())
        for topic in reader.channels:
            reader.times(topic)
            reader.channel_hash(topic)


def fault_of(act: Callable[[Path], object], path: Path) -> str:
    """Return the error that `act` reports, "" if none. Only LogError is allowed."""
    try:
        act(path)
    except LogError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "is empty"),
        (b"RIFF....", r"is not an MCAP file \(it starts with b'RIFF....'\)"),
        (MAGIC, "has no end: .* Run: ipsys repair"),
        (MAGIC[:5], "has no end"),
        (MAGIC + bytes(10_000), "has no end"),
        (bytes(10_000), "is not an MCAP file"),
    ],
)
def test_no_log_at_all(content: bytes, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    for read in (read_everything, LogWriter.append):
        with pytest.raises(LogError, match=expected) as caught:
            read(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)
    assert path.read_bytes() == content


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="does not exist"):
        LogReader(tmp_path / "none.mcap")
    with pytest.raises(LogError, match="does not exist"):
        LogWriter.append(tmp_path / "none.mcap")
    with pytest.raises(LogError, match="folder"):
        LogWriter.create(tmp_path / "none" / "a.mcap")
    with pytest.raises(LogError, match="cannot be opened"):
        LogWriter.create(tmp_path / ("x" * 300))
    with pytest.raises(LogError, match="cannot be"):
        LogReader(tmp_path)


def test_an_existing_log_is_never_overwritten(log: Path) -> None:
    before = log.read_bytes()
    for atomic in (False, True):
        with pytest.raises(LogError, match="exists already"):
            LogWriter.create(log, atomic=atomic)
    assert log.read_bytes() == before


def test_one_writer_at_a_time(log: Path, tmp_path: Path) -> None:
    with LogWriter.append(log):
        for other in (LogWriter.append, repair):
            with pytest.raises(LogError, match="another process is writing"):
                other(log)
    recording = LogWriter.create(tmp_path / "recording.mcap")
    with pytest.raises(LogError, match="another process is writing"):
        repair(tmp_path / "recording.mcap")
    recording.close()


@pytest.mark.parametrize("error", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_disk_without_locks_is_named_and_keeps_no_file(
    log: Path, tmp_path: Path, error: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without(*_: object) -> None:
        raise OSError(error, "No locks available")

    monkeypatch.setattr("fcntl.flock", without)
    before = log.read_bytes()
    new = tmp_path / "new"
    new.mkdir()
    for write in (
        lambda: LogWriter.create(new / "a.mcap"),
        lambda: LogWriter.create(new / "a.mcap", atomic=True),
        lambda: LogWriter.append(log),
        lambda: repair(log),
        lambda: check_locks(new),
    ):
        with pytest.raises(LogError, match=r"has no locks \(No locks available\).*local disk"):
            write()
    assert list(new.iterdir()) == []
    assert log.read_bytes() == before
    read_everything(log)


def test_link_to_nowhere_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.symlink_to(tmp_path / "gone.mcap")
    for atomic in (False, True):
        with pytest.raises(LogError, match=r"is a link to .*gone\.mcap, which does not exist"):
            LogWriter.create(path, atomic=atomic)
    assert [one.name for one in tmp_path.iterdir()] == ["a.mcap"]


def test_a_journal_without_its_log(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    journal_path(path).write_bytes(b"journal")
    with pytest.raises(LogError, match="belongs to a log that does not exist"):
        LogWriter.create(path)


def test_journal_of_another_file_is_not_used(log: Path, tmp_path: Path, rows: list[Row]) -> None:
    other = create(tmp_path / "other.mcap", rows[::2])
    before = log.read_bytes()
    for content in (b"", b"junk", bytes(5000), other.read_bytes()):
        journal_path(log).write_bytes(content)
        read_everything(log)
        LogWriter.append(log).close()
        assert log.read_bytes() == before
        assert not journal_path(log).exists()


def test_complete_journal_of_another_file_is_not_used(log: Path, tmp_path: Path, rows: list[Row]) -> None:
    storage = Recorder()
    other = create(tmp_path / "other.mcap", rows[::2])
    storage.know(other)
    append(other, rows[:4], storage)
    pieces = [o.data for o in storage.operations if o.kind == "write" and o.file != 1]
    before = log.read_bytes()
    most = (1 << 64) - 1
    huge = b"\x89IPSYSJ2" + struct.pack("<QQQQIIQ", most, 0, 0, 0, 0, 0, most) + bytes(4)
    earlier = b"\x89IPSYSJ1" + struct.pack("<QQIIQ", most, 0, 0, 0, most) + bytes(4)
    for content in (b"".join(pieces), huge, earlier):
        journal_path(log).write_bytes(content)
        read_everything(log)
        LogWriter.append(log).close()
        assert log.read_bytes() == before
    assert pieces[0].startswith(b"\x89IPSYSJ2")


def test_a_changed_summary(log: Path) -> None:
    data = bytearray(log.read_bytes())
    data[data.rindex(b"image definition")] ^= 1
    log.write_bytes(data)
    with pytest.raises(LogError, match="the CRC of the summary is wrong"):
        LogReader(log)


def build(path: Path, contents: Contents, *records: mcap.McapRecord) -> Path:
    """Return a log of these records with a summary by `contents`."""
    data = MAGIC + to_bytes(mcap.Header("", "")) + b"".join(to_bytes(record) for record in records)
    contents.data_end = len(data)
    path.write_bytes(data + tail_bytes(contents))
    return path


@pytest.mark.parametrize("with_size", [True, False])
def test_a_bomb_is_not_unpacked(with_size: bool, tmp_path: Path) -> None:
    """A frame with a much larger claimed size than its chunk, and a chunk above the limit."""
    bomb = zstandard.ZstdCompressor(write_content_size=with_size).compress(bytes(300 << 20))
    size = 1000 if with_size else 1 << 42
    chunk = mcap.Chunk("zstd", bomb, 1, 1, 0, size)
    start = len(MAGIC) + len(to_bytes(mcap.Header("", "")))
    contents = Contents(channels={1: mcap.Channel(1, "/a", "", {}, 0)}, counts={1: 1})
    contents.chunks.append(ChunkRef(start, len(to_bytes(chunk)), 1, 1, "zstd", len(bomb), size, 0, {}))
    path = build(tmp_path / "bomb.mcap", contents, chunk)
    tracemalloc.start()
    try:
        assert "chunk" in fault_of(read_everything, path)
        assert tracemalloc.get_traced_memory()[1] < 64 << 20
    finally:
        tracemalloc.stop()


def test_messages_between_chunks_are_found(log: Path, rows: list[Row]) -> None:
    with LogReader(log) as reader:
        contents, end = reader._contents, reader.data_end
    loose = to_bytes(mcap.Message(1, 5, b"loose", 6, 0))
    contents.count(1, 1)
    contents.cover(5, 5)
    data = log.read_bytes()[:end] + loose
    contents.data_end, contents.data_crc = len(data), 0
    log.write_bytes(data + tail_bytes(contents))
    with LogReader(log) as reader:
        got = [(m.log_time_ns, m.publish_time_ns, m.data) for m in reader.messages(["/image/0"])]
    assert got == [(5, 6, b"loose"), *(row[1:] for row in rows if row[0] == "/image/0")]


def test_an_index_that_points_to_another_message(log: Path) -> None:
    with LogReader(log) as reader:
        chunk = next(c for c in reader._contents.chunks if c.compression)
    at = next(iter(chunk.index_offsets.values())) + 15
    data = bytearray(log.read_bytes())
    data[at + 8 : at + 16], data[at + 24 : at + 32] = data[at + 24 : at + 32], data[at + 8 : at + 16]
    log.write_bytes(data)
    assert "points to no message of its time" in fault_of(read_everything, log)
    repair(log)
    assert fault_of(read_everything, log) == ""


def test_copied_hash_is_not_trusted(tmp_path: Path) -> None:
    path = tmp_path / "copy.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_message(writer.register_channel("/a", "", 0), 5, b"payload", 5)
        writer.add_metadata("ipsys", {"offset": "12345", "hash:/a": f"1 5 {'00' * 16}"})
        writer.add_metadata("ipsys", {"hash:/a": "1 5"})
        writer.finish()  # type: ignore[no-untyped-call]
    with LogReader(path) as reader:
        assert int(reader.channel_hash("/a"), 16) != 0


def test_any_byte_changed(log: Path) -> None:
    """The log is readable, or one line names the fault."""
    append(log, [("/runs/a", k, k, b"x") for k in range(9)])
    whole = log.read_bytes()
    chance = random.Random(1)
    faults = 0
    for _ in range(400):
        data = bytearray(whole)
        at = chance.choice((chance.randrange(len(data)), chance.randrange(len(data) - 3000, len(data))))
        data[at : at + chance.choice((1, 8))] = chance.randbytes(chance.choice((1, 8)))
        log.write_bytes(data)
        fault = fault_of(read_everything, log)
        faults += bool(fault)
        assert "\n" not in fault
    assert faults > 100


@pytest.mark.parametrize("claim", [1 << 31, 1 << 40, (1 << 64) - 1])
def test_claimed_lengths_are_checked(log: Path, claim: int) -> None:
    whole = log.read_bytes()
    chunk = whole.index(b"\x06", 40)
    tracemalloc.start()
    try:
        for at in (9, chunk + 1, chunk + 9 + 16, chunk + 9 + 28, len(whole) - 36, len(whole) - 28):
            log.write_bytes(whole[:at] + struct.pack("<Q", claim) + whole[at + 8 :])
            for act in (read_everything, repair):
                fault = fault_of(act, log)
                assert not fault or str(log) in fault
        assert tracemalloc.get_traced_memory()[1] < 64 << 20
    finally:
        tracemalloc.stop()


def test_changed_bytes_in_a_chunk_lose_no_message(tmp_path: Path) -> None:
    """The chunk is whole except for its CRC, or its head is lost and its messages are found."""
    rows = [(f"/image/{k % 3}", k * 10**8, k, bytes([k]) * 3000) for k in range(60)]
    rows += [("/points", k * 10**8 + 1, k, bytes([k]) * 40) for k in range(60)]
    whole = create(tmp_path / "log.mcap", sorted(rows, key=lambda row: row[1])).read_bytes()
    path = tmp_path / "damaged.mcap"
    chance = random.Random(8)
    unchecked = 0
    for _ in range(60):
        data = bytearray(whole)
        data[chance.randrange(100, len(data))] ^= 0xFF
        path.write_bytes(data)
        report = repair(path)
        with LogReader(path) as reader:
            kept = {(message.topic, message.log_time_ns) for message in reader.messages()}
        missing = {(row[0], row[1]) for row in rows} - kept
        assert len(missing) <= 1  # its own head is damaged
        assert sum(report.lost_counts.values()) == len(missing)
        unchecked += bool(report.unchecked)
        assert not repair(path).changed
    assert unchecked > 40


@dataclass(frozen=True)
class FullDisk:
    """A disk with room for `room` bytes of each file."""

    room: int

    def __getattr__(self, name: str) -> Any:
        return getattr(DISK, name)

    def pwrite(self, fd: int, data: bytes | memoryview, offset: int) -> int:
        if offset >= self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return DISK.pwrite(fd, data[: self.room - offset], offset)


def test_a_full_disk_while_recording(tmp_path: Path, rows: list[Row]) -> None:
    path = tmp_path / "recording.mcap"
    with pytest.raises(LogError, match=r"No space left on device.*ipsys repair"):
        create(path, rows, cast(Storage, FullDisk(100_000)))
    repair(path)
    with LogReader(path) as reader:
        assert 0 < len(list(reader.messages())) < len(rows)


@dataclass
class OneFault:
    """A disk that writes only a half once."""

    armed: bool = False

    def __getattr__(self, name: str) -> Any:
        return getattr(DISK, name)

    def pwrite(self, fd: int, data: bytes | memoryview, offset: int) -> int:
        if self.armed and len(data) > 5_000:
            self.armed = False
            DISK.pwrite(fd, data[: len(data) // 2], offset)
            raise OSError(errno.ENOSPC, "No space left on device")
        return DISK.pwrite(fd, data, offset)


def test_a_recording_outlives_one_failed_write(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    storage = OneFault()
    with LogWriter.create(path, storage=cast(Storage, storage)) as writer:
        writer.add_channel("/a", None)
        writer.write("/a", 1, 1, b"payload")
        storage.armed = True
        with pytest.raises(LogError, match="No space left"):
            writer.add_channel("/big", Schema("Big", "x", bytes(100_000)))
    read_everything(path)
    assert [row[3] for row in stock_rows(path)] == [b"payload"]


def test_a_full_disk_while_appending(log: Path) -> None:
    before = log.read_bytes()
    more: list[Row] = [("/image/new", 1, 1, random.Random(1).randbytes(20_000))]
    for room in (100, len(before) + 100):
        with pytest.raises(LogError, match=r"No space left on device.*nothing of this result was written"):
            append(log, more, cast(Storage, FullDisk(room)))
        read_everything(log)
        append(log, [])
        assert log.read_bytes() == before


def test_a_chunk_index_with_wrong_times_is_repaired(tmp_path: Path) -> None:
    """Readers use the index, so repair must not report a good log."""
    path = create(tmp_path / "a.mcap", [("/a", n, n, bytes(50)) for n in range(100, 160)])
    whole = bytearray(path.read_bytes())
    summary_start = int.from_bytes(whole[-28:-20], "little")
    index = next(
        offset
        for offset in range(summary_start, len(whole))
        if whole[offset] == Opcode.CHUNK_INDEX
        and whole[offset + 9 : offset + 17] == (100).to_bytes(8, "little")
    )
    whole[index + 9 : index + 17] = (130).to_bytes(8, "little")
    footer = len(whole) - 8 - 29
    crc = zlib.crc32(bytes(whole[summary_start : footer + 25]))
    whole[footer + 25 : footer + 29] = crc.to_bytes(4, "little")
    path.write_bytes(whole)
    with LogReader(path) as reader:  # uses the index
        assert list(reader.messages(start_ns=100, end_ns=110)) == []
    assert repair(path).changed
    with LogReader(path) as reader:
        assert len(list(reader.messages(start_ns=100, end_ns=110))) == 10
    assert not repair(path).changed


def test_appended_second_log_is_kept_in_a_separate_file(tmp_path: Path) -> None:
    """The file is from ``cat a.mcap b.mcap``: the second part is foreign, and is kept."""
    one = create(tmp_path / "a.mcap", [("/a", n, n, bytes(50)) for n in range(30)]).read_bytes()
    other = create(tmp_path / "b.mcap", [("/b", n, n, bytes(50)) for n in range(20)]).read_bytes()
    path = tmp_path / "joined.mcap"
    path.write_bytes(one + other)
    report = repair(path)
    assert (report.messages_kept, report.bytes_lost) == (30, len(other))
    assert "perhaps another log" in str(report.notes)
    assert (tmp_path / "joined.mcap.damaged").read_bytes().endswith(other)
    assert stock_rows(path) == stock_rows(tmp_path / "a.mcap")
