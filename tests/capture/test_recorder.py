"""Frames are logged before their results, and waiting frames are bounded."""

import errno
import threading
from collections.abc import Generator, Iterator
from itertools import pairwise, repeat
from pathlib import Path

import pytest

from ipsys_log.capture.backlog import TICK, Backlog
from ipsys_log.capture.recorder import _QUIET_TICKS, Recording, open_recording, write_each
from ipsys_log.errors import IpsysError, LogError
from ipsys_log.log.dataset import Session
from ipsys_log.log.journal import Storage
from ipsys_log.log.reader import LogReader
from ipsys_log.log.recovery import repair
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import (
    EVENTS_TOPIC,
    FRAME_SKIPPED,
    MEASUREMENTS_TOPIC,
    RIG_TOPIC,
    STAMP_UNRELIABLE,
    CompressedImage,
    Event,
    Measurement,
    Message,
    Model,
    Rig,
    image_topic,
)
from ipsys_log.units import NS_PER_S
from tests.playing import WAIT_LIMIT_S


def frame(number: int, camera: str = "red") -> Message:
    image = CompressedImage(number, camera, b"%d" % number, "jpeg")
    return Message(image_topic(camera), 1000 + number, number, image, camera)


class Noted(Recording):
    """A sink that notes its messages."""

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


class Sent:
    """Frames of cameras from a generator. The class notes the reason of its end."""

    def __init__(self, messages: Generator[Message | None, None, None]) -> None:
        self._messages, self.whys = messages, list[str | None]()
        self.confirmed: list[tuple[Message, OSError | None]] = []
        self.warned: list[tuple[str, ...]] = []

    def __iter__(self) -> Generator[Message | None, None, None]:
        return self._messages

    def stop(self, reason: str | None = None) -> None:
        self.whys.append(reason)

    def confirm(self, message: Message, fault: OSError | None) -> None:
        self.confirmed.append((message, fault))

    def add_event(self, kind: str, text: str, camera: str | None = None) -> None:
        self.warned.append((kind, text) if camera is None else (kind, text, camera))


def backlog(source: Generator[Message | None, None, None], log: Recording) -> Backlog:
    return Backlog(Sent(source), log, lambda: 10_000)


def test_frame_is_logged_before_its_processing(log: Noted) -> None:
    processed = threading.Semaphore(1)

    def source() -> Generator[Message | None, None, None]:
        for number in range(3):
            assert processed.acquire(timeout=WAIT_LIMIT_S)
            yield frame(number)
            yield None

    seen = []
    with backlog(source(), log) as frames:
        for message in frames:
            assert message is TICK or message in log.noted
            seen.append(message)
            if message is TICK:
                processed.release()
    assert [message is TICK for message in seen] == [False, True] * 3


def test_events_pass_beside_the_frames_after_their_write(log: Noted) -> None:
    lost = Message(EVENTS_TOPIC, 5, 5, Event(5, "camera_lost", "camera red is lost", "red"))
    late = Message(EVENTS_TOPIC, 6, 6, Event(6, STAMP_UNRELIABLE, "late", "red", start=1))
    shown, processed = list[Message](), threading.Event()

    def source() -> Generator[Message | None, None, None]:
        yield lost
        assert processed.wait(WAIT_LIMIT_S)  # an event alone wakes the consumer
        yield late
        yield from (frame(number) for number in range(4))

    seen = []
    with backlog(source(), log) as frames:
        for message in frames:
            seen.append(message)
            shown += frames.take_events()
            assert all(event in log.noted for event in shown)
            if lost in shown:
                processed.set()
        shown += frames.take_events()
    # A stage reads the second event: it passes the stages, and a skipped frame is an event beside them.
    assert lost not in seen
    assert late in seen
    assert shown[0] is lost
    assert {event.payload.kind for event in shown[1:]} <= {FRAME_SKIPPED}
    assert len(shown) - 1 + sum(isinstance(m.payload, CompressedImage) for m in seen) == 4


def test_oldest_frames_are_skipped_with_an_event(log: Noted) -> None:
    recorded = threading.Event()

    def source() -> Generator[Message | None, None, None]:
        yield from (frame(number) for number in range(10))
        yield from (frame(number, "white") for number in range(10, 12))
        recorded.set()

    with backlog(source(), log) as frames:
        assert recorded.wait(WAIT_LIMIT_S)
        seen = [message for message in frames if message is not TICK]
    assert [message.payload.timestamp for message in seen] == [7, 8, 9, 10, 11]
    events = [m.payload for m in log.noted if isinstance(m.payload, Event)]
    assert {event.kind for event in events} == {FRAME_SKIPPED}
    assert [event.timestamp for event in events] == [1000 + n for n in range(7)]
    assert len([m for m in log.noted if isinstance(m.payload, CompressedImage)]) == 12


def test_recorder_error_is_raised_to_the_consumer(log: Noted) -> None:
    def source() -> Generator[Message | None, None, None]:
        yield frame(0)
        raise ZeroDivisionError("a bug")

    with pytest.raises(ZeroDivisionError), backlog(source(), log) as frames:
        assert [message for message in frames if message is not TICK] == [frame(0)]


def test_settings_are_in_the_file_before_the_first_frame(tmp_path: Path) -> None:
    """The messages of a recorder that is killed at once: rig, intrinsics and the model of a live run."""
    path, killed = tmp_path / "a.mcap", tmp_path / "killed.mcap"
    rig = Rig("lab", "DICT_4X4_100", 0.2)
    settings = [Message(RIG_TOPIC, 1, 1, rig), Message("/runs/poly/model", 2, 2, Model(2, "poly", ()))]
    with open_recording(path, settings) as log:
        killed.write_bytes(path.read_bytes())
        log.put(frame(0))
    repair(killed)
    with Session([killed]) as session:
        assert session.payloads([RIG_TOPIC]) == [rig]
        assert session.count("/runs/poly/model") == 1


def test_killed_recorder_has_lost_at_most_a_second(tmp_path: Path) -> None:
    """The file is copied at any message; that is the file of a recorder that is killed then."""
    path, killed = tmp_path / "a.mcap", tmp_path / "killed.mcap"
    topics = [image_topic(camera) for camera in ("red", "white")]

    def source() -> Generator[Message | None, None, None]:
        for number in range(45):
            for camera in ("red", "white"):
                image = CompressedImage(number, camera, bytes(5_000), "jpeg")
                yield Message(image_topic(camera), number * NS_PER_S // 10, number, image, camera)
        yield from repeat(None, _QUIET_TICKS)

    def last_kept_ns() -> int:
        killed.write_bytes(path.read_bytes())
        repair(killed)
        with LogReader(killed) as reader:
            return max((m.log_time_ns for m in reader.messages(topics)), default=0)

    with open_recording(path) as log:
        for number, message in enumerate(write_each(Sent(source()), log)):
            if number % 9 == 8:
                assert message.log_time_ns - last_kept_ns() <= NS_PER_S
        assert last_kept_ns() == message.log_time_ns  # no message comes: everything is written


class FullDisk(Storage):
    """A disk with room for 100 kB, and for more when space is freed."""

    freed = threading.Event()

    def pwrite(self, fd: int, data: bytes | memoryview, offset: int) -> int:
        if offset + len(data) > 100_000 and not self.freed.is_set():
            raise OSError(errno.ENOSPC, "No space left on device")
        return Storage.pwrite(self, fd, data, offset)


def test_full_disk_drops_frames_and_writes_other_messages(tmp_path: Path) -> None:
    disk, path = FullDisk(), tmp_path / "a.mcap"

    def source() -> Generator[Message | None, None, None]:
        for number in range(200):
            big = CompressedImage(number, "red", bytes(30_000), "jpeg")
            yield Message(image_topic("red"), number * 10**8, number, big, "red")
            place = Measurement(number, f"p{number}")
            yield Message(MEASUREMENTS_TOPIC, number * 10**8 + 1, number, place)

    sent = Sent(source())
    with LogWriter.create(path, storage=disk) as writer:
        log, sizes = Recording(writer, disk.freed.set), [0]
        for message in write_each(sent, log):
            if message is not None and isinstance(message.payload, Measurement):
                sizes.append(path.stat().st_size)
    with Session([path]) as session:
        assert len(session.payloads([MEASUREMENTS_TOPIC])) == 200
        assert 2 <= session.count(image_topic("red")) <= 4
    assert all(one < other for one, other in pairwise(sizes)), "a measurement is not on the disk at once"
    assert set(sent.whys) == {"the disk is full"}


def test_a_log_that_is_being_written_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with open_recording(path) as first:
        first.put(frame(0))
        with pytest.raises(LogError), open_recording(path, overwrite=True):
            pass
        first.put(frame(1))
    with open_recording(path, overwrite=True) as second:
        second.put(frame(2))
    assert second.counts == {image_topic("red"): 1}


def test_old_log_exists_until_the_new_one_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    with open_recording(path) as first:
        first.put(frame(0))
    old = path.read_bytes()

    def broken(self: LogWriter, path: Path) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    with monkeypatch.context() as patch:
        patch.setattr(LogWriter, "move", broken)
        with pytest.raises(IpsysError, match="Operation not permitted"), open_recording(path, overwrite=True):
            pass
    assert (path.read_bytes(), list(tmp_path.iterdir())) == (old, [path])
    (tmp_path / "a.mcap.new").write_bytes(b"left by one that was killed")
    with open_recording(path, overwrite=True) as second:
        second.put(frame(1))
        # No other process creates a log there, and the log exists at every instant.
        with pytest.raises(LogError, match="another process"), open_recording(path, overwrite=True):
            pass
    with Session([path]) as session:
        assert [one.timestamp for one in session.payloads([image_topic("red")])] == [1]
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("whole", [True, False])
def test_old_journal_is_removed_with_its_log(tmp_path: Path, whole: bool) -> None:
    path, journal = tmp_path / "a.mcap", tmp_path / "a.mcap.journal"
    with open_recording(path) as first:
        first.put(frame(0))
    if whole:
        writer = LogWriter.append(path, storage=Killed())
        writer.add_channel("/a", None, "json")
        writer.write("/a", 1, 1, b"{}")
        with pytest.raises(KeyboardInterrupt):
            writer.close()
        assert journal.stat().st_size > 100
    else:
        journal.write_bytes(b"torn")
    with open_recording(path, overwrite=True) as second:
        second.put(frame(1))
    with Session([path]) as session:
        assert [one.timestamp for one in session.payloads([image_topic("red")])] == [1]
    assert not journal.exists()


class Killed(Storage):
    """A process that is killed while a journal exists."""

    def truncate(self, fd: int, size: int) -> None:  # noqa: ARG002
        raise KeyboardInterrupt
