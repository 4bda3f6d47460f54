"""A command parses the summary of a log once, and again only if another process has changed the file."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from ipsys_log.log import summary
from ipsys_log.log.byte_source import FileBytes
from ipsys_log.log.contents import Schema
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.reader import LogReader
from ipsys_log.log.summary import load_contents
from ipsys_log.log.writer import LogWriter
from tests.conftest import ROOT, Ipsys
from tests.tiers import first_fast


class Parses:
    """A counter of parsed summaries."""

    count = 0


@pytest.fixture
def parses(monkeypatch: pytest.MonkeyPatch) -> Parses:
    counter, parse = Parses(), summary._from_summary

    def counted(view: FileBytes, start: int, end: int) -> object:
        counter.count += 1
        return parse(view, start, end)

    monkeypatch.setattr(summary, "_from_summary", counted)
    return counter


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return Path(shutil.copy(ROOT / "sample_logs" / "small_lab.mcap", tmp_path / "small_lab.mcap"))


def append(path: Path, topic: str) -> None:
    with LogWriter.append(path) as writer:
        writer.add_channel(topic, Schema("A", "jsonschema", b"{}"), "json")
        writer.write(topic, 2**60, 2**60, b"{}")


@pytest.mark.parametrize("command", first_fast(2, ["replay", "evaluate --model poly", "verify", "runs"]))
def test_command_parses_a_summary_once(ipsys: Ipsys, log: Path, parses: Parses, command: str) -> None:
    if command == "verify":
        assert ipsys("replay", log).code == 0
        parses.count = 0
    name, *options = command.split()
    assert ipsys(name, log, *options).code == 0
    assert parses.count == 1


def test_contents_of_an_append_are_those_of_the_file(log: Path, parses: Parses) -> None:
    with one_reading():
        append(log, "/a")
        append(log, "/b")
        assert parses.count == 1
        with LogReader(log) as known:
            contents = known._contents
    fd = os.open(log, os.O_RDONLY)
    view = FileBytes(log, fd, log.stat().st_size, log.stat().st_size)
    assert load_contents(view) == contents
    view.close()


def test_change_by_another_process_is_read(log: Path, tmp_path: Path, parses: Parses) -> None:
    other = Path(shutil.copy(log, tmp_path / "other.mcap"))
    append(other, "/by_another_process")
    with one_reading():
        with LogReader(log) as reader:
            assert "/by_another_process" not in reader.channels
        with log.open("r+b") as file:  # the same file after an append of another process
            file.write(other.read_bytes())
        append(log, "/ours")
        with LogReader(log) as reader:
            assert {"/by_another_process", "/ours"} <= reader.channels.keys()
    assert parses.count == 3  # other.mcap once, this log before and after the change


def test_file_of_the_same_name_is_read(log: Path, tmp_path: Path) -> None:
    other = Path(shutil.copy(log, tmp_path / "other.mcap"))
    append(other, "/a")
    with one_reading():
        with LogReader(log) as reader:
            assert "/a" not in reader.channels
        other.rename(log)
        with LogReader(log) as reader:
            assert "/a" in reader.channels


def test_abandoned_append_leaves_what_is_known(log: Path, parses: Parses) -> None:
    with one_reading():
        with LogWriter.append(log) as writer:
            writer.add_channel("/a", None, "json")
            writer.write("/a", 2**60, 2**60, b"{}")
            writer.abandon()
        with LogReader(log) as reader:
            assert "/a" not in reader.channels
    assert parses.count == 1


def test_outside_of_a_command_every_opening_reads(log: Path, parses: Parses) -> None:
    for _ in range(2):
        with LogReader(log):
            pass
    assert parses.count == 2


def test_inner_block_shares_what_it_reads(log: Path, parses: Parses) -> None:
    with one_reading():
        with one_reading(), LogReader(log):
            pass
        with LogReader(log):
            pass
    assert parses.count == 1
