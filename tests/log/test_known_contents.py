"""A command parses the summary of a log once, and again only if another process has changed the file."""

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
from tests.conftest import ROOT


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
