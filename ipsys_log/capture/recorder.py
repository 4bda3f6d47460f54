"""Recording of cameras into a log: frames are written first, processed later."""

import os
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Protocol

from ipsys_log.capture import disk
from ipsys_log.capture.frames import CameraState, Clock, Say
from ipsys_log.engine.output import serialize, write_message
from ipsys_log.errors import IpsysError, LogError, WriteError, is_full
from ipsys_log.log.journal import DISK, open_locked, roll_back
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import STAMP_UNRELIABLE, CompressedImage, CompressedVideo, Event, Measurement, Message
from ipsys_log.plain_text import shell_words
from ipsys_log.statistics.latency import PositionMonitor

# After an interrupt, the recorder waits no longer than this for a write.
_SETTLE_S = 1.0
# After this number of ticks without a message, the last ones go into the file. At each tick, every image of a
# camera of 10 Hz would be a chunk, with its index in memory.
_QUIET_TICKS = 5
_DELETED = "another program has deleted the log"


class Source(Protocol):
    """Messages, and None if nothing comes; after ``stop`` only those that arrived before.

    ``confirm`` is called from any thread when a measurement is on the disk, or with the error of the disk;
    ``add_event`` makes an event, and prints it.
    """

    def __iter__(self) -> Generator[Message | None, None, None]: ...

    def stop(self, reason: str | None = None) -> None: ...

    def confirm(self, message: Message, fault: OSError | None) -> None: ...

    def add_event(self, kind: str, text: str, camera: str | None = None) -> None: ...


class CameraSource(Source, Protocol):
    """The cameras of a live run.

    It has their states, their clock, the arrival times of frames by log time, and the state of positions.
    """

    @property
    def states(self) -> Mapping[str, CameraState]: ...

    @property
    def clock(self) -> Clock: ...

    @property
    def received_ns(self) -> Mapping[int, int]: ...

    @property
    def positions(self) -> PositionMonitor: ...

    @property
    def say(self) -> Say: ...

    def now_ns(self) -> int: ...


class Recording:
    """A log that several threads write; :func:`open_recording` creates it.

    Parameters
    ----------
    writer : of the log; None: nothing is written.
    free : releases the reserved disk space.

    Attributes
    ----------
    counts : number of messages so far, by topic.
    full : set when the disk is full; then the reserved space is in use.
    is_deleted : set soon after another program has deleted the file.
    is_renamed : set if the path does not lead to the file any more.
    syncer : syncs the log to the disk.
    """

    def __init__(self, writer: LogWriter | None, free: Callable[[], None] = lambda: None) -> None:
        self.counts: dict[str, int] = {}
        self.full: WriteError | None = None
        self.is_deleted = self.is_renamed = False
        self.path = Path(os.devnull) if writer is None else writer.path
        self.syncer = disk.Syncer(self._sync)
        self._writer, self._free = writer, free
        self._lock = threading.Lock()
        self._torn = False

    def put(self, message: Message) -> None:
        """Write a message. A chunk lasts at most a second: a killed recorder loses no more than that.

        Raises
        ------
        WriteError
            The disk is full, and the reserved space is used up too.
        """
        if (writer := self._writer) is not None:
            data = serialize(message)  # another thread may write meanwhile
            self._write(lambda: write_message(writer, message, self.counts, data))

    def flush(self) -> None:
        """Pass all messages to the disk."""
        if self._writer is not None:
            self._write(self._writer.flush)

    def look(self) -> None:
        """Note whether another program has deleted or renamed the log."""
        if self._writer is None:
            return
        try:
            own = os.fstat(self._writer.fd)
        except OSError:  # a fault of the disk is no proof
            return
        self.is_deleted = self.is_deleted or own.st_nlink == 0
        try:
            self.is_renamed = not os.path.samestat(own, self.path.stat())
        except OSError:
            self.is_renamed = True

    def check_file(self) -> None:
        """Check that the log is where it was created."""
        if self.is_deleted:
            raise IpsysError(
                f"{self.path}: {_DELETED}; the recording has stopped. If it was moved to another "
                "disk, repair it there: ipsys repair FILE"
            )
        if self.is_renamed:
            raise IpsysError(
                f"{self.path}: another program has renamed the log. It has all frames under its new name; to "
                "complete its runs: ipsys repair FILE"
            )

    def check_disk(self) -> None:
        """Check that all messages were written.

        Raises
        ------
        IpsysError
            The disk was full or failed, or :meth:`check_file` fails; the text describes the log.
        """
        self.check_file()
        if self.full is not None:
            raise IpsysError(disk.describe_disk_full(self.path, self.full)) from self.full
        if (fault := self.syncer.fault) is not None:
            raise IpsysError(disk.describe_disk_failure(self.path, fault)) from fault

    def settle(self) -> bool:
        """Prevent further writes from all threads; return False if a thread is still writing."""
        return self._lock.acquire(timeout=_SETTLE_S) and not self._torn

    def _sync(self) -> None:
        self.look()
        if self._writer is not None:
            self._writer.sync()

    def _write(self, write: Callable[[], None]) -> None:
        with self._lock:
            self._torn = True
            try:
                write()
            except WriteError as error:
                if self.full is not None:
                    raise
                self.full = error
                self._free()
                write()
            self._torn = False


def write_each(
    source: Source, log: Recording, put: Callable[[Message], None] | None = None
) -> Iterator[Message]:
    """Yield the messages of a source, each after it was written, or after ``put`` has taken it.

    A measurement is confirmed as soon as it is on the disk. When the disk is full, or another program has
    deleted the log, the source is stopped.
    Messages other than frames are still written, to the reserved space.
    """
    put = put or log.put
    warned, ticks = False, 0
    with closing(iter(source)) as messages:
        for message in messages:
            if (fault := log.syncer.fault) is not None and not warned:
                warned = True
                source.add_event(
                    "disk_fault", f"{disk.describe_disk_fault(fault)}; the last written messages may be lost"
                )
            ticks = 0 if message is not None else ticks + 1
            if message is None:
                if ticks % _QUIET_TICKS == 0:
                    log.flush()
            elif log.full is None or not isinstance(message.payload, (CompressedImage, CompressedVideo)):
                put(message)
                if isinstance(message.payload, Event) and message.payload.kind == STAMP_UNRELIABLE:
                    log.flush()  # the file never has the affected frames without this event
                if isinstance(message.payload, Measurement):
                    log.flush()
                    log.syncer.soon(partial(source.confirm, message))
                yield message
            else:
                continue
            if log.full is not None:
                source.stop(
                    "the disk is full"
                    if is_full(log.full.cause)
                    else disk.describe_disk_fault(log.full.cause)
                )
            elif log.is_deleted:
                source.stop(_DELETED)


@contextmanager
def open_recording(
    path: Path | None, settings: Iterable[Message] = (), overwrite: bool = False
) -> Iterator[Recording]:
    """Write a new log that keeps its messages even if an exception ends the block.

    Parameters
    ----------
    path : None: nothing is written.
    settings : rig, intrinsics and models of the recording. They are in the file before the block begins, even
        if the recorder is killed soon.
    overwrite : replace an existing log, unless another process is writing it. The old log is deleted only
        after the new one exists.

    Raises
    ------
    LogError
        The file exists, or cannot be created.
    IpsysError
        The disk has too little space to finish the log properly.
    """
    if path is None:
        yield Recording(None)
        return
    created = _create(path, overwrite)
    try:
        with ExitStack() as resources:
            log = Recording(resources.enter_context(created), resources.enter_context(disk.reserve(path)))
            try:
                for message in settings:
                    log.put(message)
                log.flush()
                resources.callback(log.look)
                resources.enter_context(log.syncer)
                yield log
            except KeyboardInterrupt as error:
                if log.settle():
                    raise
                resources.pop_all()  # a torn log cannot be ended, and a hanging write would block here
                text = (
                    f"{path}: interrupted during writing; to check the log: ipsys repair {shell_words(path)}"
                )
                raise IpsysError(text) from error
    except WriteError as error:
        raise IpsysError(disk.describe_disk_full(path, error)) from error


def _create(path: Path, overwrite: bool) -> LogWriter:
    if not (overwrite and path.exists()):
        return LogWriter.create(path)
    old = open_locked(DISK, path, os.O_RDWR)
    try:
        roll_back(DISK, path, old)  # an unfinished append to the old log does not belong to the new log
        partial = path.with_name(f"{path.name}.new")
        partial.unlink(missing_ok=True)  # its writer was killed: this process has the lock
        try:
            writer = LogWriter.create(partial)
            writer.move(path)
        except (OSError, WriteError) as error:
            partial.unlink(missing_ok=True)
            raise LogError(f"{path}: is unchanged, because the new log cannot be created: {error}") from error
        return writer
    finally:
        os.close(old)
