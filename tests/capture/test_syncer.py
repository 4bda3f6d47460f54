"""Recorded data reaches the disk every few seconds. Only a measured point waits for that."""

import errno
import threading
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from pathlib import Path
from typing import Any, cast

import pytest

from ipsys_log.capture import multiplexer
from ipsys_log.capture.disk import SYNC_EVERY_S, Syncer
from ipsys_log.capture.frames import Clock, SourceError
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.capture.recorder import _QUIET_TICKS, Recording, open_recording, write_each
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.journal import DISK, Storage
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import MEASUREMENTS_TOPIC, Measurement, Message, image_topic
from tests.capture.test_recorder import Sent, frame
from tests.playing import cameras, playing

LIMIT_S = 240.0


@pytest.fixture(autouse=True)
def _patient_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a page wait for the disk as long as the test does."""
    monkeypatch.setattr(multiplexer, "_SAVED_S", LIMIT_S)


class Slow:
    """A disk whose sync blocks until it is released, and fails if an error is set."""

    def __init__(self, error: int | None = None) -> None:
        self.syncing, self.let_through = threading.Event(), threading.Event()
        self.error = error
        if error is not None:
            self.let_through.set()

    def __getattr__(self, name: str) -> Any:
        return getattr(DISK, name)

    def fsync(self, fd: int) -> None:
        self.syncing.set()
        assert self.let_through.wait(LIMIT_S)
        if self.error is not None:
            raise OSError(self.error, "Input/output error")
        DISK.fsync(fd)


def on(disk: Slow, path: Path) -> LogWriter:
    return LogWriter.create(path, storage=cast(Storage, disk))


def place(number: int) -> Message:
    return Message(MEASUREMENTS_TOPIC, 1000 + number, number, Measurement(number, f"p{number}"))


def test_slow_sync_holds_up_no_frame_and_no_order(tmp_path: Path) -> None:
    disk, path = Slow(), tmp_path / "a.mcap"

    def source() -> Generator[Message | None, None, None]:
        yield place(0)
        assert disk.syncing.wait(LIMIT_S)
        for number in range(1, 301):
            yield frame(number)
        yield from repeat(None, _QUIET_TICKS)  # no message comes: all data are flushed
        size = path.stat().st_size
        yield frame(301)
        assert size > 300 * 60, "frames wait for the disk"
        assert sent.confirmed == []
        disk.let_through.set()

    sent = Sent(source())
    with on(disk, path) as writer:
        log = Recording(writer, lambda: None)
        with log.syncer:
            for _ in write_each(sent, log):
                pass
    assert [(message.payload.id, fault) for message, fault in sent.confirmed] == [("p0", None)]
    with Session([path]) as session:
        frames = session.payloads([image_topic("red")])
    assert [int(one.data) for one in frames] == list(range(1, 302))


def test_recording_is_synced_without_being_asked() -> None:
    assert SYNC_EVERY_S <= 5
    synced = threading.Semaphore(0)
    with Syncer(synced.release, every_s=0.001):
        for _ in range(5):
            assert synced.acquire(timeout=LIMIT_S)


def test_recording_syncs_while_it_is_open(tmp_path: Path) -> None:
    synced = threading.Event()
    with open_recording(tmp_path / "a.mcap") as log:
        log.syncer.soon(lambda fault: synced.set() if fault is None else None)
        assert synced.wait(LIMIT_S)


def test_point_is_saved_when_it_is_on_the_disk(tmp_path: Path) -> None:
    disk = Slow()
    attached = LiveCameras(cameras("red"), playing({"red": [b"a"] * 100_000}, 100.0), Clock())
    with on(disk, tmp_path / "a.mcap") as writer, ThreadPoolExecutor(1) as page:
        log = Recording(writer, lambda: None)
        with attached, log.syncer:
            saved = page.submit(attached.save, MEASUREMENTS_TOPIC, Measurement(5, "p001"))
            after = 0
            for message in write_each(attached, log):
                after += disk.syncing.is_set() and message is not None
                if after == 10:
                    assert not saved.done(), "written, but not on the disk"
                    disk.let_through.set()
                    saved.result(LIMIT_S)
                    attached.stop()
    assert after >= 10


def test_point_that_comes_last_is_confirmed_at_the_end(tmp_path: Path) -> None:
    attached = LiveCameras(cameras("red"), playing({"red": [b"a"] * 100_000}, 100.0), Clock())
    disk = Slow()
    with on(disk, tmp_path / "a.mcap") as writer, ThreadPoolExecutor(1) as page:
        log = Recording(writer, lambda: None)
        with attached, log.syncer:
            saved = page.submit(attached.save, MEASUREMENTS_TOPIC, Measurement(5, "p001"))
            for message in write_each(attached, log):
                if message is not None and message.topic == MEASUREMENTS_TOPIC:
                    attached.stop()
            assert not saved.done()
            disk.let_through.set()
        saved.result(LIMIT_S)


def test_sync_error_is_reported_once_and_at_the_end(tmp_path: Path) -> None:
    disk, path = Slow(errno.EIO), tmp_path / "a.mcap"

    def source() -> Generator[Message | None, None, None]:
        yield place(0)
        assert confirmed.wait(LIMIT_S)
        for number in range(1, 20):
            yield place(number)

    class Confirmed(Sent):
        def confirm(self, message: Message, fault: OSError | None) -> None:
            super().confirm(message, fault)
            confirmed.set()

    confirmed = threading.Event()
    sent = Confirmed(source())
    with on(disk, path) as writer:
        log = Recording(writer, lambda: None)
        with log.syncer:
            for _ in write_each(sent, log):
                pass
        disk.error = None
    assert [kind for kind, *_ in sent.warned] == ["disk_fault"]
    assert "the disk has failed (Input/output error)" in sent.warned[0][1]
    assert sent.confirmed[0][1] is not None
    with pytest.raises(IpsysError, match=r"Input/output error.*may be missing.*ipsys repair") as caught:
        log.check_disk()
    assert "space" not in str(caught.value)


def test_point_on_a_failing_disk_is_not_called_saved(tmp_path: Path) -> None:
    disk = Slow(errno.EIO)
    attached = LiveCameras(cameras("red"), playing({"red": [b"a"] * 100_000}, 100.0), Clock())
    with on(disk, tmp_path / "a.mcap") as writer, ThreadPoolExecutor(1) as page:
        log = Recording(writer, lambda: None)
        with attached, log.syncer:
            saved = page.submit(attached.save, MEASUREMENTS_TOPIC, Measurement(5, "p001"))
            saved.add_done_callback(lambda _: attached.stop())
            for _ in write_each(attached, log):
                pass
        disk.error = None
        with pytest.raises(
            SourceError, match=r"perhaps not saved: the disk has failed \(Input/output error\)"
        ):
            saved.result(LIMIT_S)


def test_deleted_log_ends_the_recording(tmp_path: Path) -> None:
    """Without this check, a recorder fills a deleted file for hours, and its end loses all."""
    path, checked = tmp_path / "a.mcap", threading.Event()

    def source() -> Generator[Message | None, None, None]:
        yield frame(0)
        path.unlink()
        log.syncer.soon(lambda _: checked.set())
        assert checked.wait(LIMIT_S)
        yield frame(1)

    sent = Sent(source())
    with open_recording(path) as log:
        for _ in write_each(sent, log):
            pass
    assert sent.whys == ["another program has deleted the log"]
    with pytest.raises(IpsysError, match=r"a\.mcap: another program has deleted the log"):
        log.check_disk()
    assert not path.exists()
