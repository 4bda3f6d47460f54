"""The live cameras as one source of messages.

Threads of the cameras only put the arriving frames into one queue. A message gets its log time when it leaves
the queue.
"""

import threading
import time
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from ipsys_log.capture.camera_thread import Arrival, CameraReader, Pause, ReaderContext
from ipsys_log.capture.frames import Clock, Heartbeat, Open, Say, SourceError
from ipsys_log.capture.nodes.centre import is_of_node
from ipsys_log.capture.nodes.receiver import passing_period_s
from ipsys_log.messages import EVENTS_TOPIC, CompressedImage, CompressedVideo, Event, Message, RigCamera
from ipsys_log.statistics.latency import PositionMonitor
from ipsys_log.units import NS_PER_S

# Most bytes of frames that wait to be written: some seconds of three cameras.
_LIMIT_BYTES = 256 << 20
_TICK_S = 0.1
# Frames whose times are kept: more than those that wait for the stages, of 24 cameras too.
_REMEMBERED = 2_000
# Longest time that the user waits for the disk when a point is saved.
_SAVED_S = 10.0
# After an interrupt, a hanging camera delays the end by at most this time.
_LAST_S = 1.0


class LiveCameras:
    """The live cameras of a rig. A context manager; iterate over it once.

    The iteration yields messages in the order of their log times, which strictly increase. While no message
    arrives, it yields None ten times a second. It ends when all cameras have ended (files end), or after
    :meth:`stop`.

    Parameters
    ----------
    cameras : cameras, each with a source.
    open_source : function that opens any of the cameras.
    clock : clock of all stamps.
    say : called at once with the text of each event: settings refused, a camera lost or back, frames dropped.
    limit_bytes : most bytes of frames that wait in memory. Further frames are dropped and counted, and an
        event reports them.

    Attributes
    ----------
    states : states of the cameras, by camera name.
    received_ns : arrival times of the last frames, by log time.
    positions : the state of the positions, if stages compute some.

    Raises
    ------
    SourceError
        On entering: a camera cannot be opened, or sends nothing.
    """

    def __init__(
        self,
        cameras: Sequence[RigCamera],
        open_source: Open,
        clock: Clock,
        say: Say = lambda text: None,
        limit_bytes: int = _LIMIT_BYTES,
    ) -> None:
        self.clock, self.say = clock, say
        self.received_ns: dict[int, int] = {}
        self._last_ns = 0
        self._limit_bytes, self._waiting_bytes = limit_bytes, 0
        self._waiting: deque[Arrival] = deque()
        self._arrived = threading.Condition()
        self._saving: list[_Saving] = []
        self._closed = self._ending = False
        self._reason = "the recording has ended; to measure in its log: ipsys measure LOG"
        self._started, self._taken, self._stopped = (threading.Event() for _ in range(3))
        self._heartbeat = Heartbeat(clock)
        shared = ReaderContext(
            open_source, clock, self._put, say, self._started, self._taken, self._stopped, self._heartbeat
        )
        self._readers = [CameraReader(camera, shared) for camera in cameras]
        self._threads = _reader_threads(self._readers)
        self.states = {
            camera.name: reader.state for camera, reader in zip(cameras, self._readers, strict=True)
        }
        self.positions = PositionMonitor(clock.now_ns, self.states, say)

    def __enter__(self) -> "LiveCameras":
        try:
            self._heartbeat.start()
            for thread in self._threads:
                thread.start()
            for reader in self._readers:
                reader.wait_for_first_frame()
        except BaseException:
            self._end()
            raise
        self._started.set()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._end(_LAST_S if isinstance(error, KeyboardInterrupt) else None)

    def stop(self, reason: str | None = None) -> None:
        """Take no more frames; the iteration still yields the waiting messages.

        This method takes no lock, so a signal handler may call it.

        The error of a later call of :meth:`save` or :meth:`add` names the ``reason``.
        """
        self._reason = reason or self._reason
        self._ending = True

    @property
    def is_stopped(self) -> bool:
        """Return whether :meth:`stop` was called."""
        return self._ending

    def __iter__(self) -> Generator[Message | None, None, None]:
        """Yield messages; requesting the next message acknowledges the previous write.

        The end of the iteration closes the stream.
        """
        self._taken.set()
        try:
            while True:
                if self._ending:
                    self._stopped.set()
                arrival, ended = self._take()
                if ended:
                    break
                if arrival is None:
                    yield None
                    continue
                yield self._message(arrival)
                self._note_written(arrival)
        finally:
            with self._arrived:
                self._closed = True
                self._arrived.notify_all()
        for reader in self._readers:
            if reader.fault is not None:
                raise reader.fault

    def add(self, topic: str, payload: Any) -> None:
        """Append another message to the stream, such as an event; it gets its log time as a frame does.

        Raises
        ------
        SourceError
            The stream has ended, so no thread would write the message.
        """
        self._add(Arrival(self.clock.now_ns(), topic, payload.timestamp, payload))

    def save(self, topic: str, payload: Any) -> None:
        """Append a message to the stream, and wait until it is on the disk.

        The iterating thread must not call this method.

        Raises
        ------
        SourceError
            The message is not on the disk, or maybe not. The text gives the reason.
        """
        saving = _Saving(Arrival(self.clock.now_ns(), topic, payload.timestamp, payload))
        with self._arrived:
            self._add(saving.arrival)
            self._saving.append(saving)
            self._arrived.wait_for(
                lambda: saving.confirmed or (self._closed and not saving.written), _SAVED_S
            )
            self._saving.remove(saving)
            is_waiting = any(arrival is saving.arrival for arrival in self._waiting)
            self._waiting = deque(arrival for arrival in self._waiting if arrival is not saving.arrival)
            closed = self._closed
        if saving.fault is not None:
            raise SourceError(
                f"perhaps not saved: the disk has failed ({saving.fault.strerror}); record to another disk"
            )
        if saving.confirmed:
            return
        if closed and not saving.written:
            raise SourceError(f"not saved: {self._reason}")
        if is_waiting:
            raise SourceError("not saved: the disk is too slow; try again")
        raise SourceError("perhaps not saved: the disk does not answer; check the log")

    def confirm(self, message: Message, fault: OSError | None = None) -> None:
        """Report that a message is on the disk, or the error of the disk. Any thread may call it."""
        with self._arrived:
            for saving in self._saving:
                if saving.log_time_ns == message.log_time_ns:
                    saving.confirmed, saving.fault = True, fault
            self._arrived.notify_all()

    def add_event(self, kind: str, text: str, camera: str | None = None) -> None:
        """Append an event, and show its text at once; after the end, only show the text.

        ``camera`` is the camera that the event speaks of.
        """
        with suppress(SourceError):
            self.add(EVENTS_TOPIC, Event(self.clock.now_ns(), kind, text, camera))
        self.say(text)

    def now_ns(self) -> int:
        """Return a log time that is later than all earlier log times."""
        self._last_ns = max(self.clock.now_ns(), self._last_ns + 1)
        return self._last_ns

    def _put(self, arrival: Arrival) -> bool:
        """Append an arrival to the queue; return False if there is no room for a frame."""
        size = _bytes_of(arrival)
        with self._arrived:
            if size and self._waiting_bytes + size > self._limit_bytes:
                return False
            self._waiting_bytes += size
            self._waiting.append(arrival)
            self._arrived.notify_all()
        return True

    def _add(self, arrival: Arrival) -> None:
        with self._arrived:
            if self._closed:
                raise SourceError(f"not saved: {self._reason}")
            self._put(arrival)

    def _take(self) -> tuple[Arrival | None, bool]:
        """Take the oldest arrival from the queue; return it, and whether the stream has ended."""
        with self._arrived:
            if not self._waiting and not self._all_finished():
                self._arrived.wait(_TICK_S)
            arrival = self._waiting.popleft() if self._waiting else None
            self._waiting_bytes -= _bytes_of(arrival)
            self._closed = self._closed or (arrival is None and self._all_finished())
            return arrival, self._closed

    def _note_written(self, arrival: Arrival) -> None:
        for saving in self._saving_of(arrival):
            saving.written = True

    def _saving_of(self, arrival: Arrival) -> "list[_Saving]":
        if not self._saving:
            return []
        with self._arrived:
            return [saving for saving in self._saving if saving.arrival is arrival]

    def _message(self, arrival: Arrival) -> Message:
        log_time_ns = self.now_ns()
        for saving in self._saving_of(arrival):
            saving.log_time_ns = log_time_ns
        if arrival.camera is not None:
            self.received_ns[log_time_ns] = arrival.received_ns
            if len(self.received_ns) > _REMEMBERED:
                del self.received_ns[next(iter(self.received_ns))]
        _, topic, publish_time_ns, payload, camera = arrival
        return Message(topic, log_time_ns, publish_time_ns, payload, camera)

    def _all_finished(self) -> bool:
        return all(state.finished for state in self.states.values())

    def _end(self, seconds: float | None = None) -> None:
        self._stopped.set()
        self._heartbeat.stop()
        for thread in self._threads:
            if thread.ident is not None:  # after an early interrupt, some threads have not started
                thread.join(seconds)


@dataclass(eq=False, slots=True)
class _Saving:
    """The progress of one ``save``: the iterating thread writes the message, then it is on the disk."""

    arrival: Arrival
    log_time_ns: int | None = None
    written: bool = False
    confirmed: bool = False
    fault: OSError | None = None


def _bytes_of(arrival: Arrival | None) -> int:
    """Return the size of a frame, in bytes; 0 for any other message."""
    frame = None if arrival is None else arrival.payload
    return len(frame.data) if isinstance(frame, (CompressedImage, CompressedVideo)) else 0


def _reader_threads(readers: Sequence[CameraReader]) -> list[threading.Thread]:
    """Return the threads that read some cameras, not started: one for each device, and one for all nodes.

    Each switch between threads of Python takes time of the thread that computes positions: with a thread for
    each of 24 nodes, more time than the positions.
    """
    nodes = [reader for reader in readers if is_of_node(reader.camera)]
    # The thread of a device is a daemon, because a driver can block for ever.
    threads = [
        threading.Thread(target=_read_device, args=(reader,), name=reader.camera.name, daemon=True)
        for reader in readers
        if reader not in nodes
    ]
    if nodes:
        # Zenoh's threads are daemons if their caller is one. Python ends a daemon within a call of Zenoh, and
        # the program aborts.
        threads.append(threading.Thread(target=_read_nodes, args=(nodes,), name="nodes", daemon=False))
    return threads


def _read_device(reader: CameraReader) -> None:
    for pause in reader.read():
        if pause is not None:
            pause.until.wait(pause.seconds)


def _read_nodes(readers: Sequence[CameraReader]) -> None:
    """Read nodes in turn. A node whose reader pauses misses its turns."""
    period_s, clock = passing_period_s(len(readers)), Clock()
    turns = [_Turn(reader) for reader in readers]
    while turns:
        now_s = clock.now_ns() / NS_PER_S
        turns = [turn for turn in turns if turn.take(now_s)]
        time.sleep(period_s)


class _Turn:
    """The turns of one node."""

    def __init__(self, reader: CameraReader) -> None:
        self._steps: Iterator[Pause | None] = reader.read()
        self._pause: Pause | None = None
        self._paused_s = 0.0

    def take(self, now_s: float) -> bool:
        """Read all that has arrived, unless the reader pauses; return False after the end."""
        pause = self._pause
        if pause is not None and now_s - self._paused_s < pause.seconds and not pause.until.is_set():
            return True
        try:
            self._pause, self._paused_s = next(self._steps), now_s
        except StopIteration:
            return False
        return True
