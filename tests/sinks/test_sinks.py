"""Sinks: a slow sink loses images first, a failing sink ends no recording, an inline sink has no thread."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.capture.devices import OPENERS, open_source
from ipsys_log.capture.frames import Clock, Frame, Say
from ipsys_log.capture.lab import first_messages
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, CompressedVideo, Message, Rig, RigCamera, Tracks
from ipsys_log.messages.channels import EVENTS
from ipsys_log.sinks.sink import ALL, FanOut, LiveQueue, Sink
from tests.stages.drawing import jpeg

_LIMIT_S = 120.0


class Collected:
    """A sink in the form of a new sink: it keeps the messages. ``fault`` is raised at the n-th one."""

    payloads = ALL

    def __init__(self, name: str = "collected", fault_at: int | None = None) -> None:
        self.name = name
        self.messages: list[Message] = []
        self._fault_at = fault_at

    def consume(self, messages: Iterator[Message | None]) -> None:
        for message in messages:
            if message is None:
                continue
            self.messages.append(message)
            if len(self.messages) == self._fault_at:
                raise ZeroDivisionError("a fault\nin the sink")


class Inline:
    """A sink that never waits; it keeps the messages and their thread, and may raise at the n-th message."""

    name = "prompt"
    payloads: tuple[type, ...] = (Tracks,)

    def __init__(self, fault_at: int | None = None) -> None:
        self.messages: list[Message] = []
        self.threads: set[int] = set()
        self._fault_at = fault_at

    def send(self, message: Message) -> None:
        self.messages.append(message)
        self.threads.add(threading.get_ident())
        if len(self.messages) == self._fault_at:
            raise ZeroDivisionError("a fault")


class Stuck:
    """A sink that accepts one message only, until it is released."""

    name = "stuck"
    payloads = ALL

    def __init__(self) -> None:
        self.released = threading.Event()

    def consume(self, messages: Iterator[Message | None]) -> None:
        next(messages)
        assert self.released.wait(_LIMIT_S)


def image(number: int) -> Message:
    return Message("/cameras/red/image", number, number, CompressedImage(number, "red", b"", "jpeg"), "red")


def tracks(number: int) -> Message:
    return Message("/runs/poly/tracks", number, number, Tracks(number, ()))


def video(number: int, keyframe: bool) -> Message:
    data = b"\x00\x00\x01\x65" if keyframe else b"\x00\x00\x01\x41"
    return Message("/cameras/red/image", number, number, CompressedVideo(number, "red", data, "h264"), "red")


def drained(waiting: LiveQueue) -> list[Message]:
    return list(iter(iter(waiting).__next__, None))


def test_slow_sink_loses_images_before_tracks() -> None:
    waiting = LiveQueue()
    for number in range(150):
        waiting.put(image(number))
        if number < 90:
            waiting.put(tracks(number))
    messages = drained(waiting)
    assert len([m for m in messages if isinstance(m.payload, Tracks)]) == 90
    images = [m for m in messages if isinstance(m.payload, CompressedImage)]
    assert 0 < len(images) <= 100


def test_inline_sink_gets_messages_before_the_call_returns() -> None:
    """A queue and a thread would delay positions on their way to robots."""
    stuck, prompt = Stuck(), Inline()
    shown: list[int] = []
    with FanOut([lambda _: shown.append(len(prompt.messages)), stuck, prompt], lambda *_: None) as show:
        for number in range(300):
            show(tracks(number))
            show(image(number))
        assert [message.log_time_ns for message in prompt.messages] == list(range(300))
        assert prompt.threads == {threading.get_ident()}
        assert shown[0] == 1  # streams come before displays
        stuck.released.set()


def test_failing_inline_sink_does_not_affect_the_others() -> None:
    events: list[str] = []
    broken, good, collected = Inline(fault_at=3), Inline(), Collected()
    sinks = FanOut([broken, good, collected], lambda kind, text: events.append(f"{kind}: {text}"))
    with sinks as show:
        for number in range(10):
            show(tracks(number))
    assert events == ["sink_stopped: prompt stopped (a fault); the recording continues"]
    assert [len(sink.messages) for sink in (broken, good, collected)] == [3, 10, 10]
    with pytest.raises(ZeroDivisionError):
        sinks.check()


def test_video_continues_with_a_keyframe() -> None:
    waiting = LiveQueue()
    for number in range(110):
        waiting.put(video(number, keyframe=number % 30 == 0))
    assert [m.log_time_ns for m in drained(waiting)] == list(range(100))
    for number in range(110, 130):
        waiting.put(video(number, keyframe=number % 30 == 0))
    assert [m.log_time_ns for m in drained(waiting)] == list(range(120, 130))


def recorded(target: Path, *sinks: Sink) -> None:
    """Record 40 frames of each of two cameras; their source is a row of the table of openers."""
    rig = Rig("lab", "DICT_4X4_100", 0.2)
    cameras = [RigCamera(name, source=f"test:{name}") for name in ("red", "white")]
    attached = LiveCameras(cameras, open_source, Clock())
    with attached:
        pipeline.record(attached, first_messages(rig, {}, attached.now_ns), target, sinks=sinks)


@pytest.fixture
def source_of_one_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """A source for tests in the form of a new source: a function, and a row in the table."""
    data = jpeg(np.full((120, 160), 200, np.uint8))

    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        yield (Frame(data, "jpeg", clock.now_ns()) for _ in range(40))

    monkeypatch.setitem(OPENERS, "test", opened)


def frames_in(log: Path) -> dict[str, int]:
    with Session([log]) as session:
        return {camera: session.count(topic) for camera, topic in session.images.items()}


@pytest.mark.usefixtures("source_of_one_row")
def test_source_and_sink_of_one_row_are_recorded(tmp_path: Path) -> None:
    sink = Collected()
    recorded(tmp_path / "x.mcap", sink)
    assert frames_in(tmp_path / "x.mcap") == {"red": 40, "white": 40}
    assert len([m for m in sink.messages if isinstance(m.payload, CompressedImage)]) == 80


@pytest.mark.usefixtures("source_of_one_row")
def test_sink_that_raises_loses_no_frame(tmp_path: Path) -> None:
    good, bad = Collected("good"), Collected("bad", fault_at=3)
    with pytest.raises(ZeroDivisionError, match="a fault"):
        recorded(tmp_path / "x.mcap", bad, good)
    assert frames_in(tmp_path / "x.mcap") == {"red": 40, "white": 40}
    assert len(bad.messages) == 3
    assert len([m for m in good.messages if isinstance(m.payload, CompressedImage)]) == 80


@pytest.mark.usefixtures("source_of_one_row")
def test_sink_that_hangs_holds_nothing_up(tmp_path: Path) -> None:
    stuck = Stuck()
    try:
        recorded(tmp_path / "x.mcap", stuck)
    finally:
        stuck.released.set()
    assert frames_in(tmp_path / "x.mcap") == {"red": 40, "white": 40}


@pytest.mark.usefixtures("source_of_one_row")
def test_drops_of_a_sink_are_events_in_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ipsys_log.sinks.sink._MOST_WITH_IMAGES", 5)
    stuck = Stuck()
    try:
        recorded(tmp_path / "x.mcap", stuck)
    finally:
        stuck.released.set()
    with Session([tmp_path / "x.mcap"]) as session:
        events = session.payloads(session.topics(EVENTS))
    texts = [event.text for event in events if event.kind == "sink_dropped"]
    assert texts[:2] == [
        f"stuck: {count} dropped (the sink is too slow)" for count in ("1 message", "10 messages")
    ]
