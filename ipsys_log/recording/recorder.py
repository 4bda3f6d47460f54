"""What cameras send now, into a log: written first, looked at after."""

from __future__ import annotations

import os
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Protocol

from ipsys_log.errors import IpsysError, WriteError
from ipsys_log.geometry.lenses import scale_lens
from ipsys_log.log import LogWriter
from ipsys_log.log.lock import open_locked
from ipsys_log.log.storage import DISK
from ipsys_log.messages import (
    EVENTS_TOPIC,
    FRAME_SKIPPED,
    RIG_TOPIC,
    CameraCalibration,
    Event,
    Message,
    Rig,
    calibration_topic,
)
from ipsys_log.recording.full_disk import reserve, what_fitted
from ipsys_log.recording.waiting import Waiting
from ipsys_log.runs.output import write_message

__all__ = [
    "TICK",
    "Backlog",
    "Recording",
    "Target",
    "first_messages",
    "fitting_lenses",
    "recording",
    "written",
]

# Between two messages of a source: nothing more has come so far. It is not in the log.
TICK = Message("", 0, 0, None)


class Target(Protocol):
    """Where messages go, in the order of their log times; ``full`` is set when the disk was."""

    @property
    def full(self) -> WriteError | None: ...

    def put(self, message: Message) -> None: ...

    def flush(self) -> None: ...


class Recording:
    """A log that is being written, by several threads. Made by :func:`recording`.

    Parameters
    ----------
    free : gives back what is set aside on the disk.

    Attributes
    ----------
    counts : messages so far, by topic.
    full : set when the disk was; what is set aside is in use then.
    """

    def __init__(self, writer: LogWriter, free: Callable[[], None]) -> None:
        self.counts: dict[str, int] = {}
        self.full: WriteError | None = None
        self._writer, self._free = writer, free
        self._lock = threading.Lock()

    def put(self, message: Message) -> None:
        """Write a message. No chunk spans more than a second: a recorder that is killed loses no more.

        Raises
        ------
        WriteError
            Where the disk is full, and what was set aside is used up too.
        """
        self._write(lambda: write_message(self._writer, message, self.counts))

    def flush(self) -> None:
        """Hand everything to the disk."""
        self._write(self._writer.flush)

    def check_disk(self) -> None:
        """See that all was written.

        Raises
        ------
        IpsysError
            Where the disk was full: it says how far the log goes.
        """
        if self.full is not None:
            raise IpsysError(what_fitted(self._writer.path, self.full)) from self.full

    def _write(self, write: Callable[[], None]) -> None:
        with self._lock:
            try:
                write()
            except WriteError as error:
                if self.full is not None:
                    raise
                self.full = error
                self._free()
                write()


def written(source: Iterable[Message | None], log: Target) -> Iterator[Message | None]:
    """What a source gives, each message after it was written, until the disk is full."""
    for message in source:
        if message is None:
            log.flush()
        else:
            log.put(message)
        yield message
        if log.full is not None:
            return


@contextmanager
def recording(path: Path, overwrite: bool = False) -> Iterator[Recording]:
    """A new log that keeps what it has, whatever ends the block.

    Parameters
    ----------
    overwrite : put it in place of one that is there, unless another process is writing that.

    Raises
    ------
    LogError
        Where there is such a file, or it cannot be made.
    IpsysError
        Where the disk is so full that the log could not be ended as it should.
    """
    if overwrite and path.exists():
        os.close(open_locked(DISK, path, os.O_RDWR))
        path.unlink()
    try:
        with LogWriter.create(path) as writer, reserve(path) as free:
            yield Recording(writer, free)
    except WriteError as error:
        raise IpsysError(what_fitted(path, error)) from error


def fitting_lenses(
    lenses: Mapping[str, CameraCalibration],
    sizes_px: Mapping[str, tuple[int, int] | None],
    say: Callable[[str], None],
) -> dict[str, CameraCalibration]:
    """Lenses for the frames that cameras send, scaled where these are of another size, which is said.

    Raises
    ------
    IpsysError
        Where frames have another shape.
    """
    fitting = {}
    for camera, lens in lenses.items():
        width, height = sizes_px.get(camera) or (lens.width, lens.height)
        fitting[camera] = scale_lens(lens, width, height, f"camera {camera}")
        if width != lens.width:
            say(f"camera {camera}: its calibration is scaled from {lens.width} to {width} px of width")
    return fitting


def first_messages(
    rig: Rig, lenses: Mapping[str, CameraCalibration], now_ns: Callable[[], int]
) -> list[Message]:
    """What a log begins with: the rig, and the lenses by camera."""
    time_ns = now_ns()
    found = [Message(RIG_TOPIC, time_ns, time_ns, rig)]
    for camera, lens in sorted(lenses.items()):
        time_ns = now_ns()
        stamped = replace(lens, timestamp=time_ns)
        found.append(Message(calibration_topic(camera), time_ns, time_ns, stamped, camera))
    return found


class Backlog:
    """Frames that are in the log and that the stages have not seen. A context manager; iterate once.

    A thread of its own writes what a source gives and hands the frames on. Where the stages are slower than
    the cameras, frames are skipped as :class:`~ipsys_log.recording.waiting.Waiting` does, never the recording
    of them, and an event names each. After everything that waits comes a :data:`TICK`.

    Parameters
    ----------
    source : messages, None where nothing comes.
    log : where all of them go.
    now_ns : a log time for an event, called by the thread that takes from the source.
    stop : makes the source end.
    """

    def __init__(
        self,
        source: Iterable[Message | None],
        log: Target,
        now_ns: Callable[[], int],
        stop: Callable[[], None],
    ) -> None:
        self.skipped: Counter[str] = Counter()
        self._source, self._log, self._now_ns, self._stop = source, log, now_ns, stop
        self._waiting = Waiting()
        self._ended = False
        self._fault: BaseException | None = None
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._record, name="recorder", daemon=True)

    def __enter__(self) -> Backlog:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()
        self._thread.join()

    def __iter__(self) -> Iterator[Message]:
        while True:
            with self._changed:
                while not self._waiting and not self._ended:
                    self._changed.wait()
                taken = self._waiting.take()
            if not taken:
                if self._fault is not None:
                    raise self._fault
                return
            yield from taken
            yield TICK

    def _record(self) -> None:
        try:
            for message in written(self._source, self._log):
                if message is not None and message.camera is not None:
                    self._hand_on(message)
        except BaseException as fault:  # raised again where the messages are taken
            self._fault = fault
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()

    def _hand_on(self, message: Message) -> None:
        with self._changed:
            skipped = self._waiting.put(message)
            self._changed.notify()
        for late in skipped:
            camera = str(late.camera)
            self.skipped[camera] += 1
            text = f"a frame of camera {camera} is recorded but was not looked at: the stages are too slow"
            event = Event(late.log_time_ns, FRAME_SKIPPED, text, camera)
            self._log.put(Message(EVENTS_TOPIC, self._now_ns(), event.timestamp, event))
