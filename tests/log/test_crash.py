"""A power loss at any instant leaves the old log or the new one; of a recording, a part."""

import random
from collections.abc import Sequence
from pathlib import Path

import pytest

from ipsys_log.errors import LogError
from ipsys_log.log.reader import LogReader
from ipsys_log.log.records import MAGIC
from ipsys_log.log.recovery import repair
from ipsys_log.log.writer import LogWriter
from tests.log.conftest import POINT, Row, append, as_row, create, linear_rows, write_rows
from tests.log.crash import Disk, Operation, Recorder, crashes

NEW: list[Row] = [("/runs/a", 10 + k, k, bytes([k]) * 40) for k in range(20)]


def read(path: Path) -> list[Row]:
    with LogReader(path) as reader:
        return [as_row(message) for message in reader.messages()]


def record_append(path: Path, rows: list[Row]) -> list[Operation]:
    storage = Recorder()
    storage.know(path)
    append(path, rows, storage)
    return storage.operations


def check_append(folder: Path, old: bytes, new: bytes, operations: Sequence[Operation], tries: int) -> int:
    """Check every crash state with a reader, the next append and repair."""
    folder.mkdir()
    path = folder / "session.mcap"
    wanted = {}
    for name, data in (("old", old), ("new", new)):
        path.write_bytes(data)
        wanted[name] = read(path)
    states: dict[tuple[object, ...], int] = {}
    for cut, disk in crashes({"session.mcap": old}, operations, random.Random(1), tries):
        files = sorted((name, bytes(disk.files[number])) for name, number in disk.names.items())
        state = (cut == len(operations), *files)
        if state in states:
            continue
        states[state] = cut
        disk.store(folder)
        assert read(path) in wanted.values(), f"a reader after {cut} operations"
        LogWriter.append(path).close()
        assert path.read_bytes() in (old, new), f"an appender after {cut} operations"
        assert [file.name for file in folder.iterdir()] == ["session.mcap"]
        if cut == len(operations):
            assert path.read_bytes() == new, "the append had returned"
        disk.store(folder)
        repair(path)
        assert path.read_bytes() in (old, new), f"repair after {cut} operations"
    return len(states)


def test_append_cut_at_every_point(tmp_path: Path) -> None:
    path = create(tmp_path / "session.mcap", [("/points", k, k, b"point") for k in range(30)])
    old = path.read_bytes()
    operations = record_append(path, NEW)
    assert check_append(tmp_path / "crashed", old, path.read_bytes(), operations, tries=60) > 30


def test_a_roll_back_may_be_cut_too(tmp_path: Path) -> None:
    path = create(tmp_path / "session.mcap", [("/points", k, k, b"point") for k in range(30)])
    old = path.read_bytes()
    operations = record_append(path, NEW)
    new = path.read_bytes()
    journal = next(o for o in operations if o.kind == "create").file
    half = b"".join(o.data for o in operations if o.kind == "write" and o.file == journal)
    with LogReader(path):
        pass
    torn = old[: len(old) - 300] + b"\xff" * 100
    path.write_bytes(torn)
    journal_file = path.with_name("session.mcap.journal")
    journal_file.write_bytes(half)
    storage = Recorder()
    storage.know(path)
    storage.know(journal_file)
    LogWriter.append(path, storage=storage).abandon()
    assert path.read_bytes() == old
    folder = tmp_path / "crashed"
    folder.mkdir()
    files = {"session.mcap": torn, "session.mcap.journal": half}
    for _, disk in crashes(files, storage.operations, random.Random(2), 40):
        disk.store(folder)
        LogWriter.append(folder / "session.mcap").close()
        assert (folder / "session.mcap").read_bytes() in (old, new)


@pytest.mark.slow
def test_append_to_a_larger_log(tmp_path: Path) -> None:
    chance = random.Random(3)
    rows = [("/image/a", k * 10**8, k, chance.randbytes(40_000)) for k in range(60)]
    path = create(tmp_path / "session.mcap", rows)
    for number in range(2):
        old = path.read_bytes()
        more = [(f"/runs/{number}/{k % 3}", k * 10**8, k, chance.randbytes(3_000)) for k in range(400)]
        operations = record_append(path, more)
        check_append(tmp_path / f"crashed{number}", old, path.read_bytes(), operations, tries=20)


def is_repaired(path: Path) -> bool:
    """Repair a log; return False if its start is lost and no other part identifies it."""
    begins_well = path.read_bytes()[:8] == MAGIC
    try:
        repair(path)
    except LogError as error:
        if begins_well or "is not an MCAP" not in str(error):
            raise
        return False
    return True


def check_recording(folder: Path, rows: list[Row], operations: Sequence[Operation], tries: int) -> set[int]:
    """Check that every repaired row was written, in order; return the number of kept rows."""
    folder.mkdir()
    path = folder / "recording.mcap"
    by_topic = {topic: [row for row in rows if row[0] == topic] for topic in {row[0] for row in rows}}
    kept = set()
    for cut, disk in crashes({}, operations, random.Random(4), tries):
        disk.store(folder)
        assert path.exists() or "sync_directory" not in [o.kind for o in operations[:cut]]
        assert operations.index(Operation("sync_directory")) < 3, "before anything is written"
        if not path.exists() or path.stat().st_size < 8:
            continue
        if not is_repaired(path):
            continue
        got = read(path)
        # If the sector with a channel's definition is lost, its messages have another topic.
        assert {row[1:] for row in got} <= {row[1:] for row in rows}, f"after {cut} operations"
        for topic, expected in by_topic.items():
            mine = [row for row in got if row[0] == topic]
            rest = iter(expected)
            assert all(row in rest for row in mine), f"after {cut} operations"  # in order and unchanged
        assert sorted(linear_rows(path)) == sorted(got)
        assert not repair(path).changed
        kept.add(len(got))
        if cut == len(operations):
            assert len(got) == len(rows), "the writer had returned"
    return kept


def record_recording(path: Path, rows: list[Row]) -> list[Operation]:
    storage = Recorder()
    create(path, rows, storage)
    return storage.operations


def test_recording_cut_at_every_point(tmp_path: Path) -> None:
    chance = random.Random(5)
    rows: list[Row] = []
    for k in range(12):
        rows.append(("/image/a", k * 4 * 10**8, k, chance.randbytes(1_500)))
        rows.append(("/points", k * 4 * 10**8 + 1, k, chance.randbytes(50)))
    operations = record_recording(tmp_path / "recording.mcap", rows)
    kept = check_recording(tmp_path / "crashed", rows, operations, tries=6)
    assert {0, len(rows)} <= kept
    assert len(kept) > 5


def test_results_of_a_frame_are_never_stored_without_the_frame(tmp_path: Path) -> None:
    """At any kill of a recorder, the flushed messages are there, and no others."""
    rows: list[Row] = [("/points", 0, 0, b"a note before the first frame")]
    for k in range(6, 60):
        rows += [("/image/a", k * 10**8, k, bytes([k]) * 500), ("/points", k * 10**8, k, bytes([k]) * 50)]
    operations = record_recording(tmp_path / "recording.mcap", rows)
    folder = tmp_path / "killed"
    folder.mkdir()
    counts = set()
    for cut in range(4, len(operations) + 1):
        disk = Disk({}, {})
        for operation in operations[:cut]:
            disk.apply(operation)
        disk.store(folder)
        repair(folder / "recording.mcap")
        kept = read(folder / "recording.mcap")
        frames, made = ({row[1] for row in kept if row[0] == topic} for topic in ("/image/a", "/points"))
        assert made - {0} <= frames
        counts.add(len(made))
    assert len(counts) > 5


def test_an_atomic_log_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    storage = Recorder()
    path = tmp_path / "out.mcap"
    with LogWriter.create(path, atomic=True, storage=storage) as writer:
        write_rows(writer, NEW)
    whole = path.read_bytes()
    for cut, disk in crashes({}, storage.operations, random.Random(7), 20):
        content = bytes(disk.files[disk.names["out.mcap"]]) if "out.mcap" in disk.names else None
        assert content in (None, whole), f"after {cut} operations"
    assert content == whole


def test_flushed_messages_of_a_killed_recorder_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    writer = LogWriter.create(path)
    writer.add_channel("/points", POINT)
    for k in range(5):
        writer.write("/points", k, k, b"point")
    writer.flush()
    copy = tmp_path / "killed.mcap"
    copy.write_bytes(path.read_bytes())
    writer.abandon()
    with pytest.raises(LogError, match=r"no end.*ipsys repair"):
        LogReader(copy)
    report = repair(copy)
    assert (report.messages_kept, report.bytes_lost, report.last_kept_ns) == (5, 0, 4)
