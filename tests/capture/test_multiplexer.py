"""Live cameras: the order of their messages, lost frames, and events."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import islice, pairwise
from math import inf

import numpy as np
import pytest
import simplejpeg

from ipsys_log.capture import multiplexer as attached_module
from ipsys_log.capture.camera_thread import imported_run
from ipsys_log.capture.frames import CameraState, Clock, Frame, NodeRefusedError, Open, Say, SourceError
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.messages import STAMP_UNRELIABLE, CompressedImage, Event, Message, RigCamera
from tests.playing import cameras, playing
from tests.waiting import wait_until

# A limit far above any duration on a busy machine.
LIMIT_S = 240.0
FRAMES = {name: [f"{name} {n}".encode() for n in range(20)] for name in ("red", "white", "black")}


def messages(attached: LiveCameras) -> list[Message]:
    with attached:
        return [message for message in attached if message is not None]


def events(found: list[Message]) -> list[Event]:
    """Return the events, without those of a busy machine that pauses this program."""
    payloads = [message.payload for message in found if isinstance(message.payload, Event)]
    return [event for event in payloads if event.kind != STAMP_UNRELIABLE]


class Standing(Clock):
    """A clock that stands still."""

    def now_ns(self) -> int:
        return 10**10


@contextmanager
def silent_camera() -> Iterator[LiveCameras]:
    """Open a camera that sends one frame, and is silent until the end of the block."""
    ended = threading.Event()

    def before(_: str, number: int) -> None:
        assert number == 0 or ended.wait(LIMIT_S)

    with LiveCameras(cameras("red"), playing({"red": [b"a"] * 2}, inf, before=before), Clock()) as attached:
        try:
            yield attached
        finally:
            ended.set()


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


def test_frames_of_a_node_before_the_recording_are_discarded() -> None:
    """Stages prepare for seconds. The positions of frames that waited meanwhile would come late."""
    discarded = threading.Event()

    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        def sent() -> Iterator[Frame | None]:
            yield from map(frame, (0, 1, 4, 5))
            discarded.set()
            while not attached._taken.is_set():
                yield None
            yield from map(frame, (6, 2, 7, 3, 9, 8))  # after a gap, a node sends older frames again

        def frame(number: int) -> Frame:
            return Frame(b"%d" % number, "jpeg", clock.now_ns(), session="first", number=number)

        yield sent()

    attached = LiveCameras([RigCamera("red", source="zenoh:red")], opened, Clock())
    with attached:
        assert discarded.wait(LIMIT_S)
        found = [message for message in attached if message is not None]
    assert data_of(found, "red") == [b"6", b"7", b"9", b"8"]
    assert not events(found)


def test_log_times_are_utc() -> None:
    before_ns = time.time_ns()
    (first, *_) = messages(LiveCameras(cameras("red"), playing(FRAMES, 1000.0), Clock()))
    assert before_ns - 50_000_000 < first.log_time_ns < time.time_ns() + 50_000_000


def test_frames_lost_before_arrival_are_counted_and_named() -> None:
    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        yield iter([Frame(b"x", "jpeg", clock.now_ns(), missed) for missed in (0, 0, 2, 0, 3, 1, 0)])

    said: list[str] = []
    attached = LiveCameras(cameras("red"), opened, Standing(), said.append)
    found = messages(attached)
    assert (attached.states["red"].missed, attached.states["red"].dropped) == (6, 0)
    assert len(data_of(found, "red")) == 7
    # The first event comes at once, later ones within a second come together.
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


def test_silent_camera_is_named_without_its_password(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ipsys_log.capture.camera_thread._FIRST_FRAME_S", 0.2)

    @contextmanager
    def silent(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        yield iter(partial(time.sleep, 0.05), "the end")  # None twice

    camera = RigCamera("red", source="rtsp://admin:secret@10.0.0.7/live")
    with pytest.raises(SourceError, match=r"admin:\*+@10\.0\.0\.7/live sends no frames") as raised:
        messages(LiveCameras([camera], silent, Clock()))
    assert "secret" not in str(raised.value)


def test_lost_camera_is_retried_while_others_continue(monkeypatch: pytest.MonkeyPatch) -> None:
    tries: list[str] = []
    pauses_s: list[float] = []

    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        def sent() -> Iterator[Frame | None]:
            for n in range(5):
                time.sleep(0.02)
                yield Frame(b"%d" % n, "jpeg", clock.now_ns())
            if camera.name == "red" and len(tries) < 3:
                raise SourceError("camera red: /dev/video0 has gone")
            for _ in range(40 if camera.name == "white" else 0):
                time.sleep(0.05)
                yield Frame(b"w", "jpeg", clock.now_ns())

        if camera.name == "red":
            tries.append(camera.name)
            if len(tries) == 2:
                raise SourceError("camera red: there is no /dev/video0")
        yield sent()

    attached = LiveCameras(cameras("red", "white"), opened, Clock())
    wait = attached._stopped.wait

    def pause(seconds: float) -> bool:
        pauses_s.append(seconds)
        return wait(seconds)

    monkeypatch.setattr(attached._stopped, "wait", pause)
    found = messages(attached)
    said = [event for event in events(found) if event.camera == "red"]
    # The camera was open at the first loss, and closed when the second attempt failed.
    assert [event.kind for event in said] == ["camera_lost", "camera_back"]
    assert "has gone; ipsys tries again" in said[0].text
    assert len(data_of(found, "red")) == 10
    assert len(data_of(found, "white")) == 45
    first_s, second_s = pauses_s
    assert second_s > first_s > 0


def test_refused_node_of_a_lost_camera_is_reported_once() -> None:
    """The node ends, and is started again with another version: the first error does not name it."""
    silence, refusal = "camera red: its node does not answer", "camera red: its node has ipsys 0.2.0 now"
    errors = [SourceError(silence), NodeRefusedError(refusal), NodeRefusedError(refusal)]

    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        def sent() -> Iterator[Frame | None]:
            if len(errors) in (0, 3):
                yield Frame(b"x", "jpeg", clock.now_ns())
            if errors:
                raise errors.pop(0)

        yield sent()

    found = events(messages(LiveCameras(cameras("red"), opened, Clock())))
    assert [(event.kind, event.text) for event in found[:2]] == [
        ("camera_lost", f"{silence}; ipsys tries again"),
        ("node_refused", refusal),
    ]
    assert [event.kind for event in found[2:]] == ["camera_back"]


def changing(*visits: list[Frame]) -> Open:
    """A camera that sends some frames per connection and is then lost; after the last it ends."""
    left = list(visits)

    @contextmanager
    def opened(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
        def sent() -> Iterator[Frame | None]:
            yield from left.pop(0)
            if left:
                raise SourceError(f"camera {camera.name}: has gone")

        yield sent()

    return opened


def test_camera_with_a_changed_codec_is_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ipsys_log.capture.camera_thread._RETRY_S", 0.02)
    jpeg, video = Frame(b"a", "jpeg", None), Frame(b"b", "h264", None)
    opened = changing([jpeg], [video], [video], [jpeg, video], [jpeg])
    found = messages(LiveCameras(cameras("red"), opened, Clock()))
    said = [event.text for event in events(found)]
    assert [m.payload.data for m in found if m.camera] == [b"a"] * 3
    kinds = [event.kind for event in events(found)]
    assert kinds == ["camera_lost", "camera_lost", "camera_back", "camera_lost", "camera_back"]
    assert "its format changed from jpeg to h264" in said[1]
    assert said[1] == said[3]
    assert said[1].endswith("set the camera to jpeg, or start a new recording; ipsys tries again")


def test_frame_size_change_is_reported_once() -> None:
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


def test_slow_disk_drops_named_frames_and_bounds_memory() -> None:
    # There is room for the last frames: they come after eight others have been written.
    frames = {"red": [bytes([n]) * 1000 for n in range(30)]}
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
    assert len(kept) + dropped == 30
    assert 5 < dropped < 25
    (event,) = events(found)
    assert (event.kind, event.camera) == ("frames_dropped", "red")
    assert event.text == f"{dropped} frames of camera red dropped: the disk is too slow"
    # In order, without the missing frames.
    assert kept == [data for data in frames["red"] if data in kept]


def test_log_times_increase_when_the_clock_stands_still() -> None:
    found = messages(LiveCameras(cameras(*FRAMES), playing(FRAMES, 500.0), Standing()))
    assert all(one.log_time_ns < other.log_time_ns for one, other in pairwise(found))


def test_no_frame_is_accepted_without_a_writer() -> None:
    attached = LiveCameras(cameras("red"), playing(FRAMES, 500.0), Clock())
    with attached:
        attached.add("/note", Event(5, "note", "written"))
        found = [message for message in attached if message is not None]
        with pytest.raises(SourceError, match="has ended"):
            attached.add("/note", Event(6, "note", "lost"))
    assert [message.payload.text for message in found if message.topic == "/note"] == ["written"]


def test_failed_write_is_not_saved_and_gives_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attached_module, "_SAVED_S", LIMIT_S)
    with silent_camera() as attached, ThreadPoolExecutor(1) as page:
        messages = iter(attached)
        next(messages)
        saved = page.submit(lambda: attached.save("/note", Event(5, "note", "lost")))
        for message in messages:
            if message is not None and message.topic == "/note":
                attached.stop("the disk is full")
                messages.close()  # writing failed
        with pytest.raises(SourceError, match="not saved: the disk is full"):
            saved.result(LIMIT_S)
        with pytest.raises(SourceError, match="not saved: the disk is full"):
            attached.save("/note", Event(6, "note", "late"))


def test_timed_out_save_is_not_written_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attached_module, "_SAVED_S", 0.1)
    attached = LiveCameras(cameras("red"), playing(FRAMES, 500.0), Clock())
    with attached:
        with pytest.raises(SourceError, match="not saved: the disk is too slow"):
            attached.save("/note", Event(5, "note", "late"))
        assert not [one for one in attached if one is not None and one.topic == "/note"]


@pytest.mark.parametrize("format", ["jpeg", "h264"])
def test_frames_without_stamps_get_times_without_waiting(format: str) -> None:
    """A stream cannot pause: unread data wait in the socket and arrive late."""
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
    # Frames before the other camera's start are discarded; a video continues at a keyframe.
    assert numbers == [0, *range(20 if format == "h264" else 15, 40)]
    # Each frame has its arrival time, before the request for the next one.
    for message, n in zip(found, numbers, strict=True):
        assert asked_ns[n] <= message.publish_time_ns <= asked_ns[n + 1]


def test_video_without_keyframes_is_reported_once_and_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ipsys_log.capture.camera_thread.MAX_FRAMES_WITHOUT_KEYFRAME", 10)
    key, other = (Frame(data, "h264", 1) for data in (b"\0\0\1\x67\0\0\1\x65", b"\0\0\1\x41"))
    for frames, count in (([key, *[other] * 9] * 3, 0), ([key, *[other] * 10, key, *[other] * 15], 1)):
        found = messages(LiveCameras(cameras("red"), changing(frames), Clock()))
        assert [event.kind for event in events(found)] == ["no_keyframes"] * count
        assert sum(message.camera is not None for message in found) == len(frames)


def test_frames_before_an_error_are_delivered() -> None:
    def broken(camera: str, number: int) -> None:
        if camera == "red" and number == 5:
            raise ZeroDivisionError("a bug")
        if camera == "white" and number == 10:
            wait_until(lambda: said, "the end of red is reported")

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
    # The event does not wait for the end: the other camera might continue for hours.
    ((number, event),) = [(n, m.payload) for n, m in enumerate(found) if isinstance(m.payload, Event)]
    assert (event.kind, event.camera, event.text) == ("camera_failed", "red", said[0])
    assert "camera red: internal error (ZeroDivisionError('a bug'))" in event.text
    assert number < len(found) - 5


def test_stop_delivers_received_frames() -> None:
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


def test_silent_camera_does_not_stop_the_others() -> None:
    """The iterator returns regularly, so a recorder can check its clock and signals."""
    with silent_camera() as attached:
        found = list(islice(attached, 4))
        assert [message is None for message in found] == [False, True, True, True]


def test_markers_of_some_cameras_are_an_imported_run() -> None:
    states = {"red": CameraState(format="markers"), "white": CameraState(format="markers")}
    assert imported_run(states) == "nodes"
    states["black"] = CameraState(format="jpeg")
    assert imported_run(states) == "nodes"
    assert imported_run({"black": states["black"]}) is None
