"""Frames in the log before anything else, and what waits for the stages."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from ipsys_log.errors import LogError
from ipsys_log.log import LogWriter
from ipsys_log.messages import (
    FRAME_SKIPPED,
    CompressedImage,
    Event,
    Message,
    image_topic,
)
from ipsys_log.recording.recorder import TICK, Backlog, Recording, recording


def frame(number: int, camera: str = "red") -> Message:
    image = CompressedImage(number, camera, b"%d" % number, "jpeg")
    return Message(image_topic(camera), 1000 + number, number, image, camera)


class Noted(Recording):
    """Notes what is put into it."""

    def __init__(self, writer: LogWriter) -> None:
        super().__init__(writer, lambda: None)
        self.noted: list[Message] = []

    def put(self, message: Message) -> None:
        super().put(message)
        self.noted.append(message)


@pytest.fixture
def log(tmp_path: Path) -> Iterator[Noted]:
    with LogWriter.create(tmp_path / "a.mcap") as writer:
        yield Noted(writer)


def backlog(source: Iterator[Message | None], log: Recording) -> Backlog:
    return Backlog(source, log, lambda: 10_000, lambda: None)


def test_a_frame_is_in_the_log_before_a_stage_sees_it_and_a_tick_follows(log: Noted) -> None:
    def source() -> Iterator[Message | None]:
        for number in range(3):
            time.sleep(0.05)
            yield frame(number)
            yield None

    seen = []
    with backlog(source(), log) as frames:
        for message in frames:
            assert message is TICK or message in log.noted
            seen.append(message)
    assert [message is TICK for message in seen] == [False, True] * 3


def test_the_oldest_frames_are_skipped_and_named_by_their_log_times(log: Noted) -> None:
    def source() -> Iterator[Message | None]:
        yield from (frame(number) for number in range(10))
        yield from (frame(number, "white") for number in range(10, 12))

    with backlog(source(), log) as frames:
        time.sleep(0.2)
        seen = [message for message in frames if message is not TICK]
    assert [message.payload.timestamp for message in seen] == [7, 8, 9, 10, 11]
    events = [m.payload for m in log.noted if isinstance(m.payload, Event)]
    assert {event.kind for event in events} == {FRAME_SKIPPED}
    assert [event.timestamp for event in events] == [1000 + n for n in range(7)]
    assert len([m for m in log.noted if isinstance(m.payload, CompressedImage)]) == 12


def test_a_fault_of_the_recorder_is_raised_where_frames_are_taken(log: Noted) -> None:
    def source() -> Iterator[Message | None]:
        yield frame(0)
        raise ZeroDivisionError("a bug")

    with pytest.raises(ZeroDivisionError), backlog(source(), log) as frames:
        assert [message for message in frames if message is not TICK] == [frame(0)]


def test_a_log_that_is_being_written_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with recording(path) as first:
        first.put(frame(0))
        with pytest.raises(LogError), recording(path, overwrite=True):
            pass
        first.put(frame(1))
    with recording(path, overwrite=True) as second:
        second.put(frame(2))
    assert second.counts == {image_topic("red"): 1}
