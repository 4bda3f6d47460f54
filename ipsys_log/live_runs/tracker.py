"""Live tracking in a loop of the user: the newest tracks, while a thread records and processes."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import NamedTuple

from ipsys_log.engine.provenance import Outcome
from ipsys_log.log.contents import run_of_topic
from ipsys_log.messages import Message, Track, Tracks

# Tracks that wait for the loop of a user; a loop that pauses for long costs no memory.
_MOST_WAITING = 100


class LiveTracks(NamedTuple):
    """The tracks of one instant: the run of the model, the time in ns, and a track for each robot."""

    run: str
    time_ns: int
    tracks: tuple[Track, ...]


class Tracker:
    """Live tracking. Iterate over the newest tracks; the end of the block completes the recording.

    A context manager, made by :func:`ipsys_log.api.python_api.live`.

    Attributes
    ----------
    dropped : number of tracks that a slow loop missed.
    outcomes : one for each stage, after the end.
    """

    name = "the tracker"
    payloads: tuple[type, ...] = (Tracks,)

    def __init__(self, track: Callable[[Tracker], list[Outcome]]) -> None:
        self.dropped = 0
        self.outcomes: tuple[Outcome, ...] = ()
        self._stop_cameras: Callable[[], None] | None = None
        self._newest: queue.SimpleQueue[LiveTracks | None] = queue.SimpleQueue()
        self._fault: BaseException | None = None
        self._begun = threading.Event()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, args=(track,), name="tracker", daemon=True)

    def __enter__(self) -> Tracker:
        self._thread.start()
        self._begun.wait()
        if self._fault is not None:
            raise self._fault
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        self._thread.join()
        if self._fault is not None and error is None:
            raise self._fault

    def __iter__(self) -> Iterator[LiveTracks]:
        while (tracks := self._newest.get()) is not None:
            while (newer := self._take()) is not None:
                self.dropped += 1
                tracks = newer
            yield tracks

    def stop(self) -> None:
        """Take no more frames; the iteration ends after the last tracks."""
        self._stopped = True
        if self._stop_cameras is not None:
            self._stop_cameras()

    def begin(self, stop_cameras: Callable[[], None]) -> None:
        """Note that the cameras send; the pipeline calls this method."""
        self._stop_cameras = stop_cameras
        if self._stopped:
            stop_cameras()
        self._begun.set()

    def send(self, message: Message) -> None:
        """Take the tracks of the pipeline, as one of its inline sinks."""
        run = run_of_topic(message.topic) or ""
        self._newest.put(LiveTracks(run, message.payload.timestamp, message.payload.tracks))
        if self._newest.qsize() > _MOST_WAITING and self._take() is not None:
            self.dropped += 1

    def _take(self) -> LiveTracks | None:
        """Return tracks that already wait, if any. The end mark stays in the queue."""
        try:
            tracks = self._newest.get_nowait()
        except queue.Empty:
            return None
        if tracks is None:
            self._newest.put(None)
        return tracks

    def _run(self, track: Callable[[Tracker], list[Outcome]]) -> None:
        try:
            self.outcomes = tuple(track(self))
        except BaseException as fault:
            self._fault = fault
        finally:
            self._newest.put(None)
            self._begun.set()
