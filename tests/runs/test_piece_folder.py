"""Stored pieces: their files, attempts in any number and order, damage, and logs that change meanwhile."""

from __future__ import annotations

import random
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import encode
from ipsys_log.log.dataset import Session
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import Encoded, Event, ImageAnnotations, Marker, Markers
from ipsys_log.pipeline import replay
from ipsys_log.runs import pieces
from ipsys_log.runs.options import Request
from ipsys_log.runs.output import write_log
from ipsys_log.runs.piece_file import from_bytes, to_bytes
from ipsys_log.runs.piece_folder import (
    OtherSoftwareError,
    PieceFolder,
    PiecesMissingError,
    PieceTask,
    StoredPieces,
    store_piece,
)
from ipsys_log.runs.pieces import FrameResult, PieceResult
from ipsys_log.stages.detect.reports import OtherSize

REQUEST = Request(parameters={"reset_s": "2"})

numbers = st.floats(allow_nan=False, allow_infinity=False, width=64)
corners = st.lists(numbers, min_size=8, max_size=8).map(lambda values: np.array(values).reshape(4, 2))
markers = st.builds(Marker, st.integers(0, 999), corners)
events = st.builds(
    Event,
    st.integers(0, 2**62),
    st.sampled_from(["corrupt_frame", "unknown_marker"]),
    st.text(),
    st.just("red"),
)
payloads = st.one_of(
    st.builds(
        Markers, st.integers(0, 2**62), st.lists(markers, max_size=3).map(tuple), st.just(960), st.just(540)
    ),
    st.builds(Encoded, st.just(ImageAnnotations), st.binary(max_size=9)),
    events,
    st.builds(OtherSize, events, st.text(), st.tuples(st.integers(1, 9999), st.integers(1, 9999))),
)
frames = st.lists(
    st.builds(FrameResult, st.integers(0, 2**62), st.lists(payloads, max_size=3).map(tuple)), max_size=4
)


@settings(max_examples=40)
@given(frames, st.none() | st.text())
def test_file_gives_the_result_that_was_written(frames: list[FrameResult], error: str | None) -> None:
    result = PieceResult(frames, None if error is None else IpsysError(error))
    read = from_bytes(to_bytes(result), (OtherSize,))
    assert read is not None
    assert (str(read.error), read.error is None) == (str(result.error), result.error is None)
    assert [list(map(_comparable, frame.payloads)) for frame in read.frames] == [
        list(map(_comparable, frame.payloads)) for frame in result.frames
    ]
    assert [frame.publish_time_ns for frame in read.frames] == [frame.publish_time_ns for frame in frames]


def _comparable(payload: Any) -> tuple[type, Any]:
    """Return a payload in a form that can be compared: arrays cannot."""
    return type(payload), payload if isinstance(payload, OtherSize) else encode(payload)


@given(st.data())
def test_damaged_file_has_no_result(data: st.DataObject) -> None:
    event = Event(1, "corrupt_frame", "text", "red")
    whole = to_bytes(PieceResult([FrameResult(2, (event, OtherSize(event, "too small", (3, 4))))]))
    place = data.draw(st.integers(0, len(whole) - 1))
    changed = bytearray(whole)
    changed[place] ^= data.draw(st.integers(1, 255))
    assert from_bytes(bytes(changed), (OtherSize,)) is None
    assert from_bytes(whole[:place], (OtherSize,)) is None


def test_file_of_an_unknown_type_has_no_result() -> None:
    """A file names types, but only those of the stage are made."""
    event = Event(1, "corrupt_frame", "text", "red")
    assert from_bytes(to_bytes(PieceResult([FrameResult(2, (OtherSize(event, "", (3, 4)),))]))) is None


@pytest.fixture(scope="module")
def short(lab_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the first frames of the small session, in several pieces."""
    path = tmp_path_factory.mktemp("folder") / "short.mcap"
    with Session([lab_log]) as session:
        images = [session.images["red"], session.images["white"]]
        end_ns = int(session.order(images)[0][11])
        topics = ["/rig", *session.calibrations.values(), *images]
        write_log(path, session.messages(topics, None, end_ns))
    return path


@pytest.fixture
def log(short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(pieces, "_MIN_FRAMES", 1)
    monkeypatch.setattr(pieces, "_MIN_PIECES", 1)
    return Path(shutil.copy(short, tmp_path / "log.mcap"))


def missing(log: Path, output: Path | None = None) -> list[PieceTask]:
    """Return the pieces that a replay of a log asks for."""
    stored = StoredPieces(PieceFolder.beside(output or log))
    with pytest.raises(PiecesMissingError) as caught:
        replay([log], REQUEST, "detect", output, workers=stored)
    return caught.value.tasks


def merge(log: Path, output: Path | None = None) -> int:
    """Replay a log whose pieces are stored; return the number of lost attempts."""
    stored = StoredPieces(PieceFolder.beside(output or log))
    replay([log], REQUEST, "detect", output, workers=stored)
    assert stored.is_complete
    return stored.folder.clear(stored.keys)


@pytest.mark.slow
def test_attempts_in_any_order_give_the_bytes_of_one_process(log: Path, tmp_path: Path) -> None:
    """Pieces are computed in any order, some of them twice; a killed attempt leaves a part of a file."""
    alone = Path(shutil.copy(log, tmp_path / "alone.mcap"))
    replay([alone], REQUEST, "detect")
    before = log.read_bytes()
    tasks = missing(log)
    assert log.read_bytes() == before
    for task in random.Random(7).sample([*tasks, tasks[0], tasks[-1]], len(tasks) + 2):
        store_piece(task)
    (tasks[0].folder / f"{tasks[0].key}.0.partial").write_bytes(b"ips")
    (tasks[0].folder / "of_another_content.0.piece").write_bytes(b"ips")
    assert merge(log) == 3
    assert log.read_bytes() == alone.read_bytes()
    assert not tasks[0].folder.exists()
    # A late attempt leaves nothing behind.
    PieceFolder(tasks[0].folder).write(tasks[0].key, b"late")
    assert not tasks[0].folder.exists()


@pytest.mark.slow
def test_pieces_that_are_stored_are_not_asked_for_again(log: Path, tmp_path: Path) -> None:
    """The results go to a new log, as those of a URL; one file is damaged."""
    output = tmp_path / "new.mcap"
    tasks = missing(log, output)
    for task in tasks[1:]:
        store_piece(task)
    assert [task.key for task in missing(log, output)] == [tasks[0].key]
    store_piece(tasks[0])
    (damaged,) = PieceFolder.beside(output).attempts()[tasks[1].key]
    damaged.write_bytes(damaged.read_bytes()[:-1])
    assert [task.key for task in missing(log, output)] == [tasks[1].key]
    assert not output.exists()
    store_piece(tasks[1])
    merge(log, output)
    alone = tmp_path / "alone.mcap"
    replay([log], REQUEST, "detect", alone)
    assert output.read_bytes() == alone.read_bytes()


@pytest.mark.slow
def test_piece_that_another_merge_deletes_is_missing(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tasks = missing(log)
    for task in tasks:
        store_piece(task)
    attempts = PieceFolder.attempts

    def list_and_delete(folder: PieceFolder) -> dict[str, list[Path]]:
        found = attempts(folder)
        found[tasks[1].key][0].unlink()
        return found

    monkeypatch.setattr(PieceFolder, "attempts", list_and_delete)
    before = log.read_bytes()
    assert [task.key for task in missing(log)] == [tasks[1].key]
    assert log.read_bytes() == before


def test_log_that_changed_after_the_division_is_refused(log: Path) -> None:
    (task, *_) = missing(log)
    with LogWriter.append(log) as writer:
        with Session([log]) as session:
            schema = session.readers[0].channels["/rig"].schema
        assert schema is not None
        writer.add_channel("/more", schema)
        writer.write("/more", 2**62, 2**62, b"")
    with pytest.raises(IpsysError, match=r"log\.mcap changed while it was read: run the command again$"):
        store_piece(task)
    assert not list(task.folder.iterdir())


def test_worker_with_other_libraries_computes_no_piece(log: Path) -> None:
    (task, *_) = missing(log)
    with pytest.raises(OtherSoftwareError, match="different versions: numpy"):
        store_piece(replace(task, software={**task.software, "numpy": "0.1"}))


def test_pieces_of_another_content_have_other_names(log: Path) -> None:
    keys = {task.key for task in missing(log)}
    assert len(keys) > 1
    with Session([log]) as session:
        messages = [*session.messages(["/rig", *session.calibrations.values(), *session.images.values()])]
    other = log.with_name("other.mcap")
    write_log(other, (replace(m, publish_time_ns=m.publish_time_ns + 1) for m in messages))
    assert not keys & {task.key for task in missing(other)}
    request = Request(parameters={"reset_s": "3"})
    with pytest.raises(PiecesMissingError) as caught:
        replay([log], request, "detect", workers=StoredPieces(PieceFolder.beside(log)))
    assert not keys & {task.key for task in caught.value.tasks}
    write_log(log.with_name("copy.mcap"), messages)
    assert {task.key for task in missing(log.with_name("copy.mcap"))} == keys
