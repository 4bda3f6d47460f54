"""Cameras that send now: the order of their messages, what is lost, and what is said of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import simplejpeg

from ipsys_log.capture import multiplexer as attached_module
from ipsys_log.capture.frames import Clock, Frame, Open, Say, SourceError
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.messages import STAMP_UNRELIABLE, CompressedImage, Event, Message, RigCamera
from tests.playing import cameras, playing

# Nothing takes so long, however busy the machine is.
LIMIT_S = 240.0
FRAMES = {name: [f"{name} {n}".encode() for n in range(20)] for name in ("red", "white", "black")}


def messages(attached: LiveCameras) -> list[Message]:
    with attached:
        return [message for message in attached if message is not None]


def events(found: list[Message]) -> list[Event]:
    """Return the events but for those of a busy machine, on which this program stands still at times."""
    payloads = [message.payload for message in found if isinstance(message.payload, Event)]
    return [event for event in payloads if event.kind != STAMP_UNRELIABLE]


def wait_until(true: Callable[[], bool]) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not true():
        assert time.monotonic() < end_s, "nothing happens"
        time.sleep(0.005)


def data_of(found: list[Message], camera: str) -> list[bytes]:
    payloads = [message.payload for message in found if message.camera == camera]
    return [payload.data for payload in payloads if isinstance(payload, CompressedImage)]


def test_every_frame_comes_as_it_was_and_log_times_increase() -> None:
    begun_ns = time.monotonic_ns()
    found = messages(LiveCameras(cameras(*FRAMES), playing(FRAMES, 200.0), Clock()))
    most_ns = time.monotonic_ns() - begun_ns + 1_000_000
    assert {name: data_of(found, name) for name in FRAMES} == FRAMES
    assert all(one.log_time_ns < other.log_time_ns for one, other in pairwise(found))
    assert all(0 < message.log_time_ns - message.publish_time_ns < most_ns for message in found)


def test_log_times_are_utc() -> None:
    before_ns = time.time_ns()
    (first, *_) = messages(LiveCameras(cameras("red"), playing(FRAMES, 1000.0), Clock()))
    assert before_ns - 50_000_000 < first.log_time_ns < time.time_ns() + 50_000_000


def test_a_camera_without_stamps_has_the_time_of_arrival() -> None:
    """The time is when the thread had the frame, even if the frame waited. No delay is claimed."""
    sent_ns: list[int] = []
    clock = Clock()

    def before(_: str, number: int) -> None:
        if number == 1:  # until then frames without stamps are thrown away
            assert attached._started.wait(LIMIT_S)
        sent_ns.append(clock.now_ns())

    attached = LiveCameras(cameras("red"), playing(FRAMES, 200.0, False, before), clock)
    with attached:
        wait_until(lambda: attached.states["red"].frames == 20)
        taken_ns = clock.now_ns()
        frames = [message for message in attached if message is not None and message.camera == "red"]
    assert len(frames) == 20
    assert all(message.publish_time_ns < taken_ns < message.log_time_ns for message in frames)
    assert all(
        attached.received_ns[m.log_time_ns] == m.publish_time_ns == m.payload.timestamp for m in frames
    )
    for (sent, following), message in zip(pairwise([*sent_ns, taken_ns]), frames, strict=True):
        assert sent <= message.publish_time_ns <= following
    assert attached.states["red"].delay_s is None


def test_frames_that_were_lost_before_they_came_are_counted_and_named() -> None:
    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        yield iter([Frame(b"x", "jpeg", clock.now_ns(), missed) for missed in (0, 0, 2, 0, 3, 1, 0)])

    said: list[str] = []
    attached = LiveCameras(cameras("red"), opened, Clock(), said.append)
    found = messages(attached)
    assert (attached.states["red"].missed, attached.states["red"].dropped) == (6, 0)
    assert len(data_of(found, "red")) == 7
    # The first at once, those within a second of it together.
    assert [(event.kind, event.camera) for event in events(found)] == [("frames_missed", "red")] * 2
    assert [event.text for event in events(found)] == said
    assert said == [
        f"{n} frames of camera red are missing: the camera or its driver lost them" for n in (2, 4)
    ]


def test_a_camera_that_cannot_be_opened_ends_it_at_once() -> None:
    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        if camera.name == "white":
            raise SourceError("camera white: there is no /dev/video7")
        yield iter([Frame(b"a", "jpeg", clock.now_ns())])

    with pytest.raises(SourceError, match="no /dev/video7"):
        messages(LiveCameras(cameras("red", "white"), opened, Clock()))
    assert not [thread for thread in threading.enumerate() if thread.name in ("red", "white")]


def test_a_camera_that_sends_nothing_is_named_without_its_password(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ipsys_log.capture.camera_thread._FIRST_FRAME_S", 0.2)

    @contextmanager
    def silent(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        yield iter(partial(time.sleep, 0.05), "the end")  # None, and None again

    camera = RigCamera("red", source="rtsp://admin:secret@10.0.0.7/live")
    with pytest.raises(SourceError, match=r"admin:\*+@10\.0\.0\.7/live sends no frames") as raised:
        messages(LiveCameras([camera], silent, Clock()))
    assert "secret" not in str(raised.value)


def test_a_camera_that_vanishes_is_tried_again_while_the_others_go_on() -> None:
    tries: list[float] = []
    gone: list[float] = []

    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        def sent() -> Iterator[Frame | None]:
            for n in range(5):
                time.sleep(0.02)
                yield Frame(b"%d" % n, "jpeg", clock.now_ns())
            if camera.name == "red" and len(tries) < 3:
                gone.append(time.monotonic())
                raise SourceError("camera red: /dev/video0 has gone")
            for _ in range(40 if camera.name == "white" else 0):
                time.sleep(0.05)
                yield Frame(b"w", "jpeg", clock.now_ns())

        if camera.name == "red":
            tries.append(time.monotonic())
            if len(tries) == 2:
                gone.append(time.monotonic())
                raise SourceError("camera red: there is no /dev/video0")
        yield sent()

    found = messages(LiveCameras(cameras("red", "white"), opened, Clock()))
    said = [event for event in events(found) if event.camera == "red"]
    # It was open when it went the first time, and not when the second try failed.
    assert [event.kind for event in said] == ["camera_lost", "camera_back"]
    assert "has gone; ipsys tries again" in said[0].text
    assert len(data_of(found, "red")) == 10
    assert len(data_of(found, "white")) == 45
    assert tries[2] - gone[1] > tries[1] - gone[0]


def changing(*visits: list[Frame]) -> Open:
    """A camera that sends some frames at each visit, and is gone then; after the last it ends."""
    left = list(visits)

    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        def sent() -> Iterator[Frame | None]:
            yield from left.pop(0)
            if left:
                raise SourceError(f"camera {camera.name}: has gone")

        yield sent()

    return opened


def test_a_camera_that_returns_with_another_codec_is_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ipsys_log.capture.camera_thread._RETRY_S", 0.02)
    jpeg, video = Frame(b"a", "jpeg", None), Frame(b"b", "h264", None)
    said: list[str] = []
    opened = changing([jpeg], [video], [video], [jpeg, video], [jpeg])
    found = messages(LiveCameras(cameras("red"), opened, Clock(), said.append))
    assert [m.payload.data for m in found if m.camera] == [b"a"] * 3
    kinds = [event.kind for event in events(found)]
    assert kinds == ["camera_lost", "camera_lost", "camera_back", "camera_lost", "camera_back"]
    assert "its format changed from jpeg to h264" in said[1]
    assert said[1] == said[3]
    assert said[1].endswith("set the camera to jpeg, or start a new recording; ipsys tries again")


def test_pictures_of_another_size_are_said_once_for_each_change() -> None:
    large, small = (
        Frame(simplejpeg.encode_jpeg(np.zeros((*shape, 3), np.uint8)), "jpeg", None)
        for shape in ((48, 64), (24, 32))
    )
    damaged = Frame(b"no picture", "jpeg", None)
    attached = LiveCameras(
        cameras("red"), changing([large, large, small, damaged, small, large, large]), Clock()
    )
    found = messages(attached)
    assert [event.kind for event in events(found)] == ["camera_size"] * 2
    assert "its image size changed from 64 x 48 px to 32 x 24 px" in events(found)[0].text
    assert attached.states["red"].size_px == (64, 48)
    assert len(data_of(found, "red")) == 7


def test_what_the_disk_cannot_take_is_dropped_by_name_and_memory_stays_bounded() -> None:
    frames = {"red": [bytes([n]) * 1000 for n in range(40)]}
    many_sent, some_written = threading.Event(), threading.Event()

    def before(_: str, number: int) -> None:
        if number == 25:
            many_sent.set()
            some_written.wait(LIMIT_S)

    attached = LiveCameras(cameras("red"), playing(frames, 500.0, before=before), Clock(), limit_bytes=10_000)
    found: list[Message] = []
    with attached:
        for message in attached:
            if message is not None:
                many_sent.wait(LIMIT_S)
                found.append(message)
            if len(found) == 8:
                some_written.set()
    kept, dropped = data_of(found, "red"), attached.states["red"].dropped
    assert len(kept) + dropped == 40
    assert 5 < dropped < 35
    (event,) = events(found)
    assert (event.kind, event.camera) == ("frames_dropped", "red")
    assert event.text == f"{dropped} frames of camera red dropped: the disk is too slow"
    # In order, and without what is missing.
    assert kept == [data for data in frames["red"] if data in kept]


def test_log_times_increase_when_the_clock_stands_still() -> None:
    class Standing(Clock):
        def now_ns(self) -> int:
            return 1_000

    found = messages(LiveCameras(cameras(*FRAMES), playing(FRAMES, 500.0), Standing()))
    assert all(one.log_time_ns < other.log_time_ns for one, other in pairwise(found))


def test_nothing_is_taken_when_nobody_would_write_it() -> None:
    attached = LiveCameras(cameras("red"), playing(FRAMES, 500.0), Clock())
    with attached:
        attached.add("/note", Event(5, "note", "written"))
        found = [message for message in attached if message is not None]
        with pytest.raises(SourceError, match="has ended"):
            attached.add("/note", Event(6, "note", "lost"))
    assert [message.payload.text for message in found if message.topic == "/note"] == ["written"]


def test_what_is_saved_is_written_by_then() -> None:
    attached = LiveCameras(cameras("red"), playing({"red": [b"a"] * 100}, 100.0), Clock())
    asked: list[str] = []
    with attached, ThreadPoolExecutor(1) as page:
        saved = page.submit(lambda: attached.save("/note", Event(5, "note", "kept")))
        for message in attached:
            if message is not None and message.topic == "/note":
                time.sleep(0.3)
                assert not saved.done()
                asked.append("written")
                note = message
            elif len(asked) == 1:
                assert not saved.done(), "written, but not on the disk yet"
                asked.append("on the disk")
                attached.confirm(note)
            elif asked:
                saved.result(LIMIT_S)
                break
        assert asked


def test_what_is_not_written_is_not_saved_and_it_is_said_why() -> None:
    attached = LiveCameras(cameras("red"), playing({"red": [b"a"] * 300}, 100.0), Clock())
    with attached, ThreadPoolExecutor(1) as page:
        messages = iter(attached)
        next(messages)
        saved = page.submit(lambda: attached.save("/note", Event(5, "note", "lost")))
        for message in messages:
            if message is not None and message.topic == "/note":
                attached.stop("the disk is full")
                messages.close()  # it could not be written
        with pytest.raises(SourceError, match="not saved: the disk is full"):
            saved.result(LIMIT_S)
        with pytest.raises(SourceError, match="not saved: the disk is full"):
            attached.save("/note", Event(6, "note", "late"))


def test_what_waits_too_long_to_be_saved_is_not_written_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attached_module, "_SAVED_S", 0.1)
    attached = LiveCameras(cameras("red"), playing(FRAMES, 500.0), Clock())
    with attached:
        with pytest.raises(SourceError, match="not saved: the disk is too slow"):
            attached.save("/note", Event(5, "note", "late"))
        assert not [one for one in attached if one is not None and one.topic == "/note"]


def test_what_was_dropped_at_the_end_is_named_too() -> None:
    frames = {"red": [bytes(1000)] * 40}
    attached = LiveCameras(cameras("red"), playing(frames, 500.0), Clock(), limit_bytes=10_000)
    with attached:
        wait_until(lambda: attached.states["red"].dropped > 0)
        attached.stop()
        found = [message for message in attached if message is not None]
    (event,) = events(found)
    assert (
        event.text == f"{attached.states['red'].dropped} frames of camera red dropped: the disk is too slow"
    )


def test_early_frames_do_not_pile_up_while_another_camera_opens() -> None:
    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        def sent() -> Iterator[Frame | None]:
            if camera.name == "late":
                wait_until(lambda: attached.states["early"].frames > 0)
                time.sleep(0.3)
                waiting.append(attached.states["early"].frames)
            for n in range(5):
                yield Frame(b"%d" % n, "jpeg", clock.now_ns())

        yield sent()

    waiting: list[int] = []
    attached = LiveCameras(cameras("early", "late"), opened, Clock())
    with attached:
        assert waiting == [1]
        assert len([message for message in attached if message is not None]) == 10


@pytest.mark.parametrize("format", ["jpeg", "h264"])
def test_frames_without_stamps_do_not_wait_for_another_camera_to_get_a_false_time(format: str) -> None:
    """A stream that cannot be stopped: what is not taken waits in the socket, and comes late."""
    picture, key = b"\0\0\1\x41", b"\0\0\1\x67\0\0\1\x65"
    taken_15, asked_ns = threading.Event(), list[int]()

    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        def late() -> Iterator[Frame | None]:
            taken_15.wait(LIMIT_S)
            yield Frame(key, format, None)

        def early() -> Iterator[Frame | None]:
            for n in range(40):
                if n == 15:
                    taken_15.set()
                    assert attached._started.wait(LIMIT_S)
                asked_ns.append(clock.now_ns())
                yield Frame((picture if n % 10 else key) + b"%03d" % n, format, None)
            asked_ns.append(clock.now_ns())

        yield early() if camera.name == "early" else late()

    attached = LiveCameras(cameras("early", "late"), opened, Clock())
    with attached:
        found = [message for message in attached if message is not None and message.camera == "early"]
    numbers = [int(message.payload.data[-3:]) for message in found]
    # Those that came before the other camera are thrown away; a video goes on where it can be read.
    assert numbers == [0, *range(20 if format == "h264" else 15, 40)]
    # Each has the time at which it came: before the next one was asked for.
    for message, n in zip(found, numbers, strict=True):
        assert asked_ns[n] <= message.publish_time_ns <= asked_ns[n + 1]


def test_a_video_without_keyframes_is_said_once_and_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ipsys_log.capture.camera_thread.MAX_FRAMES_WITHOUT_KEYFRAME", 10)
    key, other = (Frame(data, "h264", 1) for data in (b"\0\0\1\x67\0\0\1\x65", b"\0\0\1\x41"))
    for frames, count in (([key, *[other] * 9] * 3, 0), ([key, *[other] * 10, key, *[other] * 15], 1)):
        found = messages(LiveCameras(cameras("red"), changing(frames), Clock()))
        assert [event.kind for event in events(found)] == ["no_keyframes"] * count
        assert sum(message.camera is not None for message in found) == len(frames)


def test_what_came_before_a_fault_is_given_out() -> None:
    def broken(camera: str, number: int) -> None:
        if camera == "red" and number == 5:
            raise ZeroDivisionError("a bug")
        if camera == "white" and number == 10:
            wait_until(lambda: bool(said))

    found: list[Message] = []
    said: list[str] = []
    attached = LiveCameras(
        cameras("red", "white"), playing(FRAMES, 200.0, before=broken), Clock(), said.append
    )
    with attached:
        time.sleep(0.3)
        with pytest.raises(ZeroDivisionError):
            found.extend(message for message in attached if message is not None)
    assert len(data_of(found, "red")) == 5
    assert len(data_of(found, "white")) == 20
    # Not only in the end: the other camera might go on for hours.
    ((number, event),) = [(n, m.payload) for n, m in enumerate(found) if isinstance(m.payload, Event)]
    assert (event.kind, event.camera, event.text) == ("camera_failed", "red", said[0])
    assert "camera red: internal error (ZeroDivisionError('a bug'))" in event.text
    assert number < len(found) - 5


def test_stopping_gives_out_what_has_come() -> None:
    stopped = threading.Event()

    def before(_: str, number: int) -> None:
        if number == 10:
            stopped.wait(LIMIT_S)

    attached = LiveCameras(cameras("red"), playing(FRAMES, 100.0, before=before), Clock())
    found = []
    with attached:
        for message in attached:
            found.append(message)
            if len(found) == 5:
                attached.stop()
                stopped.set()
    assert 5 <= len(found) < 20


def test_a_bug_in_a_source_keeps_its_traceback() -> None:
    def broken(camera: str, number: int) -> None:
        if number == 3:
            raise ZeroDivisionError("a bug")

    with pytest.raises(ZeroDivisionError, match="a bug"):
        messages(LiveCameras(cameras("red"), playing(FRAMES, 100.0, before=broken), Clock()))


def test_a_silent_camera_is_no_reason_to_be_silent() -> None:
    """So that a recorder can look at its clock, and at signals."""
    attached = LiveCameras(cameras("red"), playing({"red": [b"a", b"b"]}, 2.0), Clock())
    with attached:
        assert list(attached).count(None) >= 3
