"""Our reader and three other readers read our logs with the same result."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from ipsys_log.errors import LogError
from ipsys_log.log.contents import Schema
from ipsys_log.log.reader import LogReader
from ipsys_log.log.recovery import repair
from ipsys_log.log.writer import LogWriter
from tests.log.conftest import (
    IMAGE,
    POINT,
    Row,
    append,
    as_row,
    crc_of,
    create,
    linear_rows,
    stock_rows,
    write_rows,
)

LATER: list[Row] = [("/runs/poly/tracks", 1_700_000_000_000_000_000 + k, k, b"track") for k in range(50)]


def ours(path: Path) -> list[Row]:
    with LogReader(path) as reader:
        return [as_row(message) for message in reader.messages()]


def in_order(rows: list[Row]) -> list[Row]:
    return sorted(rows, key=lambda row: row[1])


def fail_in(log: LogWriter, rows: list[Row]) -> None:
    with log as writer:
        write_rows(writer, rows)
        raise RuntimeError


@pytest.fixture(params=["created", "appended", "repaired"])
def finished(request: pytest.FixtureRequest, log: Path, rows: list[Row]) -> tuple[Path, list[Row]]:
    if request.param == "appended":
        append(log, LATER)
        append(log, [("/points", 5, 5, b"a measurement of long ago")])
        return log, in_order(rows + LATER + [("/points", 5, 5, b"a measurement of long ago")])
    if request.param == "repaired":
        with log.open("r+b") as file:
            file.truncate(log.stat().st_size - 100)
        assert repair(log).changed
    return log, in_order(rows)


def test_all_readers_agree(
    finished: tuple[Path, list[Row]], read_with_node: Callable[[Path], tuple[int, int, int]]
) -> None:
    path, expected = finished
    assert ours(path) == expected
    assert stock_rows(path) == expected
    assert sorted(linear_rows(path)) == sorted(expected)
    assert read_with_node(path) == (len(expected), crc_of(expected), len(expected))


def test_rerun_finds_no_fault(log: Path) -> None:
    append(log, LATER)
    rerun = Path(sys.executable).with_name("rerun")
    done = subprocess.run(
        [rerun, "mcap", "check", log], capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("\nok ") == 4
    assert "PROBLEM" not in done.stdout


def test_same_calls_same_bytes(tmp_path: Path, rows: list[Row]) -> None:
    first, second = (append(create(tmp_path / name, rows), LATER) for name in ("a.mcap", "b.mcap"))
    assert first.read_bytes() == second.read_bytes()


def test_appending_extends_the_data_section_only(log: Path) -> None:
    with LogReader(log) as reader:
        end = reader.data_end
    before = log.read_bytes()[:end]
    append(log, LATER)
    assert log.read_bytes()[:end] == before
    assert not log.with_name(log.name + ".journal").exists()


def test_appending_nothing_changes_nothing(log: Path) -> None:
    before = log.read_bytes(), log.stat().st_mtime_ns
    append(log, [])
    with LogWriter.append(log) as writer:
        writer.add_channel("/points", POINT)
    assert (log.read_bytes(), log.stat().st_mtime_ns) == before


def test_an_exception_leaves_an_append_undone(log: Path) -> None:
    before = log.read_bytes()
    with pytest.raises(RuntimeError):
        fail_in(LogWriter.append(log), LATER)
    assert log.read_bytes() == before
    append(log, LATER)  # and the lock is released


def test_an_exception_leaves_no_atomic_log(tmp_path: Path, rows: list[Row]) -> None:
    path = tmp_path / "out.mcap"
    with pytest.raises(RuntimeError):
        fail_in(LogWriter.create(path, atomic=True), rows)
    assert list(tmp_path.iterdir()) == []
    with LogWriter.create(path, atomic=True) as writer:
        write_rows(writer, rows)
    assert list(tmp_path.iterdir()) == [path]
    assert ours(path) == in_order(rows)


def test_an_exception_finishes_a_recording(tmp_path: Path, rows: list[Row]) -> None:
    path = tmp_path / "recording.mcap"
    with pytest.raises(RuntimeError):
        fail_in(LogWriter.create(path), rows)
    assert ours(path) == in_order(rows)


def test_topics_and_time_range(log: Path, rows: list[Row]) -> None:
    start, end = rows[20][1], rows[60][1]
    with LogReader(log) as reader:
        got = [as_row(m) for m in reader.messages(["/image/0", "/points"], start, end)]
        assert got == [r for r in rows if r[0] != "/image/1" and start <= r[1] < end]
        assert list(reader.messages(["/unknown"])) == []
        assert list(reader.messages(None, end, start)) == []
        assert reader.times("/points").tolist() == [r[1] for r in rows if r[0] == "/points"]
        assert (reader.start_ns, reader.end_ns) == (rows[0][1], rows[-1][1])
        assert reader.channels["/points"].message_count == 60
        assert reader.channels["/image/0"].schema == IMAGE


def test_small_channels_are_read_without_the_images(log: Path) -> None:
    with LogReader(log) as reader:
        assert len(list(reader.messages(["/points"]))) == 60
        assert reader.bytes_read < log.stat().st_size / 10


def test_another_schema_on_the_same_topic_is_refused(log: Path) -> None:
    with LogWriter.append(log) as writer, pytest.raises(LogError, match="/points with another schema"):
        writer.add_channel("/points", IMAGE)


def test_a_schema_that_has_grown_continues_the_topic(log: Path) -> None:
    """A later version adds fields to a message; appends to old logs still work."""
    with LogReader(log) as reader:
        old = reader.channels["/points"].schema
        count = reader.channels["/points"].message_count
        end_ns = reader.end_ns or 0
    assert old is not None
    grown = Schema(old.name, old.encoding, old.data + b" and a new field")
    with LogWriter.append(log) as writer:
        writer.add_channel("/points", grown)
        writer.write("/points", end_ns + 1, end_ns + 1, b"new")
    with LogReader(log) as reader:
        assert reader.channels["/points"].message_count == count + 1
        messages = list(reader.messages(["/points"]))
        hashed = reader.channel_hash("/points")
    assert messages[-1].data == b"new"
    # The combined hash is correct, and is computed without reading them.
    with LogWriter.append(log) as writer:
        writer.add_channel("/points", grown)
        writer.write("/points", end_ns + 2, end_ns + 2, b"newer")
    with LogReader(log) as reader:
        assert len(list(reader.messages(["/points"]))) == count + 2
        assert reader.channel_hash("/points") != hashed
