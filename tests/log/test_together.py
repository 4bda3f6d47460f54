"""Readers during appends, and writers killed at random moments."""

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from ipsys_log.errors import LogError
from ipsys_log.log import reader as reader_module
from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.contents import Contents
from ipsys_log.log.journal import Storage, journal_path, replace_tail
from ipsys_log.log.reader import LogReader
from ipsys_log.log.recovery import repair
from ipsys_log.log.summary import load_contents
from ipsys_log.log.writer import LogWriter
from tests.log.conftest import Row, append, as_row, create, linear_rows, stock_rows
from tests.waiting import wait_until

PER_SESSION = 5
LIMIT_S = 240.0
FIRST: list[Row] = [("/image/a", k, k, bytes(4000)) for k in range(10)]
SCRIPT = Path(__file__).with_name("write_forever.py")


def session(number: int) -> list[Row]:
    return [(f"/runs/{number % 20}", 100 + number, k, b"x" * 50) for k in range(PER_SESSION)]


def check_consistent(path: Path) -> int:
    """Read all messages; return the number of sessions, which must all be complete."""
    with LogReader(path) as reader:
        rows = [as_row(message) for message in reader.messages()]
        assert reader.message_count == len(rows)
    sessions, rest = divmod(len(rows) - len(FIRST), PER_SESSION)
    assert rest == 0
    assert rows == FIRST + [row for number in range(sessions) for row in session(number)]
    return sessions


def test_an_open_reader_keeps_its_log(log: Path, rows: list[Row]) -> None:
    with LogReader(log) as reader:
        stream = reader.messages()
        got = [next(stream)]
        append(log, [("/runs/a", rows[-1][1] + k, k, b"x" * 100) for k in range(50)])
        got += stream
        assert [as_row(message) for message in got] == rows
        assert reader.channel_hash("/points")
        assert reader.times("/points").size == 60


def test_readers_during_appends(tmp_path: Path) -> None:
    path = create(tmp_path / "log.mcap", FIRST)
    seen: list[int] = []
    faults: list[BaseException] = []
    done = threading.Event()

    def keep_reading() -> None:
        try:
            while not done.is_set():
                seen.append(check_consistent(path))
        except BaseException as error:
            faults.append(error)

    readers = [threading.Thread(target=keep_reading) for _ in range(2)]
    for reader in readers:
        reader.start()
    for number in range(40):
        append(path, session(number))
        if number == 20:
            wait_until(lambda: seen or faults, "a reader has read the log")
    wait_until(lambda: seen[-1] == 40 or faults, "a reader has read 40 sessions", lambda: seen[-1])
    done.set()
    for reader in readers:
        reader.join()
    assert not faults
    assert min(seen) <= 21
    assert max(seen) == 40
    assert check_consistent(path) == 40


def test_a_log_that_changes_while_it_is_opened_is_opened_again(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes = [[("/runs/a", k, k, b"x")] for k in range(3)]

    def slowly(view: LogBytes) -> Contents:
        contents = load_contents(view)
        if changes:
            append(log, list(changes.pop()))
        return contents

    monkeypatch.setattr(reader_module, "contents_of", slowly)
    with LogReader(log) as reader:
        assert reader.channels["/runs/a"].message_count == 3


def start(kind: str, path: Path) -> "subprocess.Popen[bytes]":
    return subprocess.Popen([sys.executable, str(SCRIPT), kind, str(path)], stdout=subprocess.PIPE)


def kill_soon(process: "subprocess.Popen[bytes]", chance: random.Random, line: bytes = b"begun\n") -> None:
    """Kill a writer soon after it has printed a line."""
    assert process.stdout is not None
    while process.stdout.readline() not in (line, b""):
        pass
    time.sleep(chance.random() * 0.15)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()


@pytest.mark.slow
def test_kill_an_appender(tmp_path: Path) -> None:
    path = create(tmp_path / "log.mcap", FIRST)
    chance = random.Random(os.getpid())
    sessions = journals = 0
    for number in range(20):
        kill_soon(start("append", path), chance)
        journals += journal_path(path).exists()
        now = check_consistent(path)
        assert now >= sessions
        sessions = now
        if number % 2:
            append(path, session(sessions))
            assert check_consistent(path) == sessions + 1
            assert len(stock_rows(path)) == len(FIRST) + PER_SESSION * (sessions + 1)
            sessions += 1
    repair(path)
    assert check_consistent(path) == sessions > 20
    print(f"{sessions} sessions, {journals} journals left over")  # noqa: T201


@pytest.mark.slow
def test_kill_a_recorder(tmp_path: Path) -> None:
    chance = random.Random(os.getpid())
    kept = 0
    for number in range(15):
        path = tmp_path / f"{number}.mcap"
        kill_soon(start("record", path), chance, b"written\n" if number % 3 == 0 else b"begun\n")
        with pytest.raises(LogError, match="ipsys repair"):
            LogReader(path)
        report = repair(path)
        with LogReader(path) as reader:
            times = [message.log_time_ns for message in reader.messages(["/points"])]
            images = [message.log_time_ns for message in reader.messages(["/image/a"])]
        assert times == list(range(0, len(times) * 10**8, 10**8))
        assert images == list(range(0, len(images) * 10**8, 10**8))
        assert len(linear_rows(path)) == len(times) + len(images) == report.messages_kept
        kept += len(times)
        path.unlink()
    assert kept > 0


def test_outdated_journal_is_not_rolled_back(tmp_path: Path) -> None:
    """A crash, then a repair and an append under another name, then the old name again."""
    path, moved = tmp_path / "a.mcap", tmp_path / "b.mcap"
    create(path, [("/a", n, n, b"old") for n in range(30)])
    whole = path.read_bytes()
    # This is the state after a crash: the journal exists, the file ends at the old tail.
    with pytest.raises(OSError, match="crash"):
        _crash_after_truncate(path, whole)
    path.rename(moved)
    assert repair(moved).messages_kept == 30
    append(moved, [("/c", 200, 200, b"kept")])
    moved.rename(path)
    for _ in range(2):
        with LogReader(path) as reader:
            assert [m.data for m in reader.messages(["/c"])] == [b"kept"]
        append(path, [])


def _crash_after_truncate(path: Path, whole: bytes) -> None:
    path.write_bytes(whole)

    class Crashing(Storage):
        def pwrite(self, fd: int, data: bytes | memoryview, offset: int) -> int:
            if os.fstat(fd).st_ino == path.stat().st_ino:
                raise OSError(5, "crash")
            return int(os.pwrite(fd, data, offset))

    fd = os.open(path, os.O_RDWR)
    try:
        summary_start = int.from_bytes(whole[-28:-20], "little")
        replace_tail(Crashing(), path, fd, summary_start - 13, (b"new tail",))
    finally:
        os.close(fd)


def _replace(path: Path, other: Path) -> None:
    other.rename(path)


def _overwrite(path: Path, other: Path) -> None:
    path.write_bytes(other.read_bytes())


def _delete(path: Path, other: Path) -> None:
    path.unlink()


@pytest.mark.parametrize("change", [_replace, _overwrite, _delete])
def test_append_to_a_log_that_others_change_is_refused(
    tmp_path: Path, change: Callable[[Path, Path], None]
) -> None:
    """Without this check, the results are lost with the old file, or they damage the new one."""
    path = create(tmp_path / "a.mcap", FIRST)
    other = create(tmp_path / "b.mcap", FIRST[:3])
    whole = other.read_bytes()

    def write_meanwhile() -> None:
        with LogWriter.append(path) as writer:
            writer.add_channel("/runs/a", None)
            writer.write("/runs/a", 100, 100, b"result")
            change(path, other)

    with pytest.raises(LogError, match=r"a\.mcap: another program has replaced or changed the log"):
        write_meanwhile()
    assert not journal_path(path).exists()
    assert not path.exists() or path.read_bytes() == whole


def test_log_is_the_same_through_every_link(tmp_path: Path) -> None:
    path, link = tmp_path / "a.mcap", tmp_path / "link.mcap"
    create(path, [("/a", n, n, b"old") for n in range(30)])
    whole = path.read_bytes()
    link.symlink_to(path)
    with pytest.raises(OSError, match="crash"):
        _crash_after_truncate(path, whole)
    for name in (path, link):
        with LogReader(name) as reader:
            assert reader.message_count == 30
    append(link, [])
    assert path.read_bytes() == whole
