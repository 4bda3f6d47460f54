"""An interrupted append, as other processes see it: without the journal, and on a failing disk."""

import errno
import os
import random
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from ipsys_log.errors import WriteError
from ipsys_log.log.journal import DISK, Storage, journal_path
from ipsys_log.log.reader import LogReader
from ipsys_log.log.recovery import repair
from ipsys_log.log.writer import LogWriter
from tests.conftest import Ipsys
from tests.log.conftest import Row, append, as_row, create, linear_rows, stock_rows
from tests.log.crash import Disk, Operation, Recorder

OLD: list[Row] = [("/image/a", 10**9 * k, k, bytes([k]) * 4_000) for k in range(30)]
NEW: list[Row] = [("/runs/a", 10**9 * k, k, bytes([k]) * 400) for k in range(20)]


def killed_at_each_operation(path: Path, rows: list[Row]) -> Iterator[int]:
    """Append, then restore each state of the file and its journal; yield the operations done."""
    old = path.read_bytes()
    storage = Recorder()
    storage.know(path)
    append(path, rows, storage)
    for cut in range(len(storage.operations) + 1):
        disk = Disk({1: bytearray(old)}, {path.name: 1})
        for operation in storage.operations[:cut]:
            disk.apply(operation)
        disk.store(path.parent)
        yield cut


@pytest.fixture
def path(tmp_path: Path) -> Path:
    folder = tmp_path / "log"
    folder.mkdir()
    return create(folder / "session.mcap", OLD)


def rows_of(path: Path) -> list[Row]:
    with LogReader(path) as reader:
        return [as_row(message) for message in reader.messages()]


@pytest.mark.parametrize("size", [40, 400_000])
def test_stock_reader_opens_a_log_whatever_append_is_cut(path: Path, size: int) -> None:
    """Such a reader uses the footer at the end of the file, and has no journal."""
    chance = random.Random(size)
    new = [("/runs/a", 10**9 * k, k, chance.randbytes(size)) for k in range(20)]
    counts = [len(stock_rows(path)) for _ in killed_at_each_operation(path, new)]
    assert counts == sorted(counts)
    assert set(counts) == {len(OLD), len(OLD) + len(new)}


@pytest.mark.slow
def test_foxglove_reader_opens_a_log_whatever_append_is_cut(
    path: Path, read_with_node: Callable[[Path], tuple[int, int, int]]
) -> None:
    complete = {len(OLD): stock_rows(path)}
    for _ in killed_at_each_operation(path, NEW):
        count, _, _ = read_with_node(path)
        assert stock_rows(path) == complete.setdefault(count, stock_rows(path))
    assert set(complete) == {len(OLD), len(OLD) + len(NEW)}


def test_truncated_log_is_usable_without_its_journal(path: Path) -> None:
    """The journal is on the machine that crashed."""
    seen = set()
    for _ in killed_at_each_operation(path, NEW):
        journal_path(path).unlink(missing_ok=True)
        content, rows = path.read_bytes(), rows_of(path)
        seen.add(len(rows))
        append(path, [("/runs/b", 5, 5, b"more")])
        assert sorted(stock_rows(path)) == sorted(linear_rows(path)) == sorted(rows_of(path))
        assert len(rows_of(path)) == len(rows) + 1
        path.write_bytes(content)
        repair(path)
        assert set(OLD) <= set(rows_of(path))
        assert sorted(stock_rows(path)) == sorted(rows_of(path)) == sorted(linear_rows(path))
        assert not repair(path).changed
    assert seen == {len(OLD), len(OLD) + len(NEW)}


def test_reading_command_names_repair_for_an_append_cut_short(ipsys: Ipsys, path: Path) -> None:
    said = []
    for _ in killed_at_each_operation(path, NEW):
        done = ipsys("info", path)
        assert done.code == 0
        lines = done.err.splitlines()
        assert lines in ([], [f"{path}: an append was interrupted; ipsys reads the old log. "
                              f"To repair it: ipsys repair {path}"])  # fmt: skip
        said.append(bool(lines))
        if lines:
            with LogWriter.append(path) as other:  # another process appends, and rolls back itself
                other.abandon()
            assert ipsys("info", path).err == ""
    assert 5 < sum(said) < len(said)
    assert not said[0]
    assert not said[-1]


def test_repair_rolls_back_an_interrupted_append(ipsys: Ipsys, path: Path) -> None:
    old = path.read_bytes()
    for cut in killed_at_each_operation(path, NEW):
        assert ipsys("repair", path).code == 0
        assert ipsys("info", path).err == ""
        assert [file.name for file in path.parent.iterdir()] == [path.name]
        assert (path.read_bytes() == old) == (len(rows_of(path)) == len(OLD)), cut


class Failing:
    """A disk whose operations fail from a given number on: all of them, or only that one."""

    def __init__(self, first: int, error: int, for_good: bool) -> None:
        self.first, self.error, self.for_good, self.done = first, error, for_good, 0

    def __getattr__(self, name: str) -> Any:
        operation = getattr(DISK, name)
        if name in ("open", "close"):
            return operation

        def counted(*arguments: Any) -> Any:
            number, self.done = self.done, self.done + 1
            if number >= self.first if self.for_good else number == self.first:
                raise OSError(self.error, os.strerror(self.error))
            return operation(*arguments)

        return counted


def error_of_append(path: Path, storage: Failing) -> str:
    try:
        append(path, NEW, cast(Storage, storage))
    except WriteError as fault:
        return str(fault)
    return ""


@pytest.mark.parametrize("for_good", [True, False])
@pytest.mark.parametrize("error", [errno.EIO, errno.ENOSPC])
def test_message_after_a_failed_append_is_correct(
    tmp_path: Path, error: int, for_good: bool, caplog: pytest.LogCaptureFixture
) -> None:
    whole = create(tmp_path / "whole.mcap", OLD).read_bytes()
    said = set()
    for first in range(30):
        path = tmp_path / str(first) / "session.mcap"
        path.parent.mkdir()
        path.write_bytes(whole)
        caplog.clear()
        storage = Failing(first, error, for_good)
        fault = error_of_append(path, storage)
        if fault:
            assert "nothing of this result was written" in fault or "the old log" in fault
            assert ("free some space" in fault) == (error == errno.ENOSPC)
            assert ("nothing of this result was written" in fault) == (path.read_bytes() == whole)
            assert ("ipsys repair" in fault) == (path.read_bytes() != whole)
            assert len(rows_of(path)) == len(OLD)
            said.add("not put back" if "ipsys repair" in fault else "as it was")
        else:
            assert len(rows_of(path)) == len(OLD) + len(NEW)
            assert ("the messages are in the log" in caplog.text) == (storage.done > first)
            said.add("in the log" if caplog.text else "")
        assert len(stock_rows(path)) in (len(OLD), len(OLD) + len(NEW)), "no other program can open it"
        repair(path)
        assert sorted(linear_rows(path)) == sorted(stock_rows(path)) == sorted(rows_of(path))
    assert said == {"as it was", "in the log", ""} | ({"not put back"} if for_good else set())


def test_journal_of_the_first_format_rolls_back(path: Path) -> None:
    """Earlier versions truncated the file before they wrote."""
    old = path.read_bytes()
    storage = Recorder()
    storage.know(path)
    append(path, NEW, storage)
    journal = next(one.file for one in storage.operations if one.kind == "create")
    content = b"".join(one.data for one in storage.operations if is_write(one, journal))
    new_size, tail_at = path.stat().st_size, int.from_bytes(content[32:40], "little")
    head = b"\x89IPSYSJ1" + content[8:24] + content[32:56]
    body = head + content[56:-4]
    for size in (tail_at, tail_at + 100, new_size):
        path.write_bytes((old[:tail_at] + bytes(new_size))[:size])
        journal_path(path).write_bytes(body + zlib.crc32(body).to_bytes(4, "little"))
        assert rows_of(path) == OLD
        LogWriter.append(path).close()
        assert path.read_bytes() == old


def is_write(operation: Operation, file: int) -> bool:
    return operation.kind == "write" and operation.file == file


class Interrupting:
    """A disk during whose n-th operation the user interrupts."""

    def __init__(self, number: int) -> None:
        self.left = number

    def __getattr__(self, name: str) -> Any:
        def operation(*arguments: Any) -> Any:
            result = getattr(DISK, name)(*arguments)
            if name not in ("open", "close"):
                self.left -= 1
                if self.left == 0:
                    raise KeyboardInterrupt
            return result

        return operation


def test_interrupted_append_leaves_the_old_log_or_the_new_one(path: Path) -> None:
    """No journal and no longer file remains, so no other command has to roll back."""
    old, ends = path.read_bytes(), set()
    for number in range(1, 100):
        path.write_bytes(old)
        try:
            append(path, NEW, cast(Storage, Interrupting(number)))
        except KeyboardInterrupt:
            assert [*path.parent.iterdir()] == [path]
            ends.add(len(rows_of(path)))
            assert (path.read_bytes() == old) == (len(rows_of(path)) == len(OLD))
            continue
        break
    assert ends == {len(OLD), len(OLD) + len(NEW)}
    assert number > 8
