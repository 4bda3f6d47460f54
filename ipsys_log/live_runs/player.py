"""Tracks in a loop of the user: of live cameras, and of a player, which plays logs in a thread to streams."""

from __future__ import annotations

import heapq
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

from ipsys_log.capture.frames import Clock
from ipsys_log.engine.provenance import Outcome
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import Message, Rig, Track, Tracks
from ipsys_log.messages.rig_file import check_robots
from ipsys_log.plain_text import join_names
from ipsys_log.sinks.playback import Playback, PlaybackOptions, in_capture_order
from ipsys_log.sinks.selection import (
    PlayedScene,
    PlayedTopics,
    choose_topics,
    dashboard_topics,
    read_first,
    read_scene,
    rig_in_force,
    viewed_topics,
)
from ipsys_log.sinks.sink import FanOut, Sink
from ipsys_log.sinks.streams import StreamSettings
from ipsys_log.sinks.streams.opening import Stream, open_streams
from ipsys_log.sinks.streams.poses import StreamContext
from ipsys_log.statistics.latency import PositionMonitor, PositionState

if TYPE_CHECKING:
    from ipsys_log.sinks.rerun.viewer import ViewerPage


# Tracks that wait for the loop of a user; a loop that pauses for long costs no memory.
_MOST_WAITING = 100


class LiveTracks(NamedTuple):
    """The tracks of one instant: the run of the model, the time in ns, and a track for each robot."""

    run: str
    time_ns: int
    tracks: tuple[Track, ...]

    def __repr__(self) -> str:
        robots = join_names([f"{t.robot} ({t.x_m:.3f}, {t.y_m:.3f}, {t.z_m:.3f}) m" for t in self.tracks])
        return f"<LiveTracks of run {self.run} at {self.time_ns} ns: {robots or 'no robots'}>"


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
        self._positions: PositionMonitor | None = None
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

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
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

    @property
    def state(self) -> PositionState | None:
        """The state of the positions now: live, late or stale; None before the first processed frame."""
        return None if self._positions is None else self._positions.state

    def stop(self) -> None:
        """Take no more frames; the iteration ends after the last tracks."""
        self._stopped = True
        if self._stop_cameras is not None:
            self._stop_cameras()

    def begin(self, stop_cameras: Callable[[], None], positions: PositionMonitor | None = None) -> None:
        """Note that the cameras send; the pipeline calls this method."""
        self._stop_cameras, self._positions = stop_cameras, positions
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


_TURN_S = 0.1


class Player(Playback):
    """A playback of logs in a thread. A context manager, made by :func:`ipsys_log.api.python_api.play`.

    Iterate over the newest tracks, each at its time. The end of the block ends the playback.

    Attributes
    ----------
    runs : the runs of the played tracks; none: ground truth.
    streams : the open streams.
    lines : a line for each stream about its receivers, and one if the rig names no robots.
    scene : the constant parts of the first log; None without a dashboard.
    """

    def __init__(
        self,
        paths: Sequence[LogLocation],
        run: str | None = None,
        topics: Sequence[str] = (),
        options: PlaybackOptions | None = None,
        settings: StreamSettings | None = None,
        clock: Clock | None = None,
        say: Callable[[str], None] = lambda text: None,
        has_dashboard: bool = False,
    ) -> None:
        if not paths:
            raise IpsysError("no log is given; name at least one")
        self._say, self._ended, self._stack = say, threading.Event(), ExitStack()
        self._first: list[Message] = []
        self.scene: PlayedScene | None = None
        try:
            # Each log by itself: two logs may have runs of one name.
            sessions = [self._stack.enter_context(Session([path])) for path in paths]
            logs = [(session, choose_topics(session, run, topics)) for session in sessions]
            settings, options = settings or StreamSettings(), options or PlaybackOptions()
            rigs = [_rig_of(session, chosen, settings) for session, chosen in logs]
            robots = {name: m for rig in rigs if rig for name, m in rig.robot_heights_m().items()}
            if settings.has_viewer:
                logs = [
                    (session, viewed_topics(session, chosen, settings.images)) for session, chosen in logs
                ]
                self._first = [
                    row
                    for (session, _), rig in zip(logs, rigs, strict=True)
                    for row in read_first(session, rig)
                ]
            page = self._stack.enter_context(closing(_open_page())) if settings.rerun else None
            viewed = logs[0]
            if has_dashboard:
                self.scene = read_scene(*logs[0], rigs[0])
                logs = [(session, dashboard_topics(session, chosen)) for session, chosen in logs]
            self._open(logs, options, clock)
            tracks = {chosen.tracks for _, chosen in logs}
            number, is_replayed, now_ns = self.session, not options.restamp, self.now_ns
            context = StreamContext(settings, tracks, now_ns, self._warn, number, robots, is_replayed)
            self.streams: Sequence[Stream] = self._stack.enter_context(open_streams(context))
        except BaseException:
            self._stack.close()
            raise
        self.runs = tuple(dict.fromkeys(chosen.run for _, chosen in logs if chosen.run is not None))
        self._viewers: list[Sink] = [] if page is None else [_viewer(*viewed, rigs[0], page, say)]
        lines = [stream.describe() for stream in self.streams]
        lines += [] if page is None else [page.describe()]
        if settings and not robots:
            lines.append("the rig names no robots; the streams name them marker_<id>")
        self.lines = tuple(lines)
        self._tracker = Tracker(self._play)

    def __enter__(self) -> Player:
        self._tracker.__enter__()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with self._stack:
            self._tracker.__exit__(kind, error, trace)

    def __iter__(self) -> Iterator[LiveTracks]:
        return iter(self._tracker)

    def show_on(self, sink: Sink) -> None:
        """Send the messages to a further sink; call this before the start."""
        self._viewers.append(sink)

    def wait(self) -> None:
        """Wait until the log has ended, or until :meth:`stop`."""
        while not self._ended.wait(_TURN_S):
            pass

    def _open(
        self, logs: Sequence[tuple[Session, PlayedTopics]], options: PlaybackOptions, clock: Clock | None
    ) -> None:
        def read(start_ns: int | None = None) -> Iterator[Message]:
            streams = (session.messages(chosen.topics, start_ns) for session, chosen in logs)
            return heapq.merge(*streams, key=lambda message: message.log_time_ns)

        first_ns = next(in_capture_order(read())).publish_time_ns
        last_ns = max(session.last(chosen.topics)[1] for session, chosen in logs)
        super().__init__(read, first_ns, last_ns, options, clock)

    def _play(self, tracker: Tracker) -> list[Outcome]:
        try:
            tracker.begin(self.stop)
            with FanOut([*self.streams, *self._viewers, tracker], self._warn) as show:
                for message in chain(self._first, self.messages()):
                    show(message)
            show.check()
        finally:
            self._ended.set()
        return []

    def _warn(self, _: str, text: str) -> None:
        self._say(text)


def _rig_of(session: Session, chosen: PlayedTopics, settings: StreamSettings) -> Rig | None:
    """Return the rig of a log; check that it has the robots of the settings."""
    rig = rig_in_force(session, [] if chosen.run is None else [chosen.run])
    if rig is not None:
        check_robots(rig, settings.named_robots, str(session))
    return rig


def _open_page() -> ViewerPage:
    """Open the viewer in a browser; its library is optional, and loaded only here."""
    check_installed("--rerun needs", "rerun")
    from ipsys_log.sinks.rerun.viewer import ViewerPage

    return ViewerPage()


def _viewer(
    session: Session, chosen: PlayedTopics, rig: Rig | None, page: ViewerPage, say: Callable[[str], None]
) -> Sink:
    from ipsys_log.sinks.rerun.viewer import LiveView

    cameras = [name for name, topic in session.images.items() if topic in chosen.topics]
    return LiveView(rig, cameras, chosen.run, say, page.show, page.name)
