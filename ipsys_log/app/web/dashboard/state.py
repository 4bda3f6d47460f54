"""The sink of the dashboard: it keeps the newest state of a recording, and gives it as JSON."""

import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

from ipsys_log.app.web.dashboard import status
from ipsys_log.app.web.dashboard.map import Robots, describe_floor
from ipsys_log.app.web.dashboard.operator import Operator
from ipsys_log.app.web.dashboard.pictures import EVERY_NS, Pictures
from ipsys_log.capture.frames import CameraState
from ipsys_log.capture.live_check import FrameCheck
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.player import Player
from ipsys_log.log.contents import run_of_topic
from ipsys_log.messages import (
    RIG_TOPIC,
    CameraCalibration,
    CompressedImage,
    CompressedVideo,
    Event,
    Latency,
    Markers,
    Message,
    Model,
    Positions,
    RawImage,
    Rig,
    Tracks,
)
from ipsys_log.sinks.selection import PlayedScene
from ipsys_log.sinks.streams.opening import Stream
from ipsys_log.sinks.streams.poses import NewSession
from ipsys_log.statistics.disagreement import OverlapSummary
from ipsys_log.statistics.latency import PositionMonitor
from ipsys_log.units import NS_PER_S

_NS_PER_MS = 1_000_000
# Number of the last positions whose latencies count.
_LATENCIES = 1000
# After a seek in a pause, the page shows what came in this time: an image of each camera of 4 Hz or more.
_LEAD_S = 0.5
# Events that end and begin the state `up` of a camera.
_UP_AFTER = {"camera_lost": False, "camera_back": True}


@dataclass(frozen=True, slots=True)
class DashboardSetting:
    """The parts of a live recording, or of a played log, that the dashboard shows.

    Attributes
    ----------
    rig, lenses, model : the lab, the intrinsics by camera, and the fitted model.
    run : the run of the shown tracks; None: ground truth.
    states, checks : states and last checks of the cameras, by name.
    log : the log that is written, or played.
    now_ns : the clock of the log times.
    streams : the streams of positions.
    played : the playback of the log; None for a recording.
    positions : the state of the positions of a recording.
    """

    rig: Rig | None
    lenses: Mapping[str, CameraCalibration]
    model: Model | None
    run: str | None
    states: Mapping[str, CameraState]
    checks: Mapping[str, FrameCheck]
    log: Path
    now_ns: Callable[[], int]
    streams: Sequence[Stream] = ()
    played: "PlayedLog | None" = None
    positions: PositionMonitor | None = None


class Dashboard:
    """A :class:`~ipsys_log.sinks.sink.QueuedSink` that keeps the newest state of a recording or a playback.

    The thread of the sink changes the state, and the thread of the page reads it.

    Parameters
    ----------
    setting : the recording or the playback.
    operator : its segment and its number are a part of the state; None: the page cannot operate.

    Attributes
    ----------
    end : None as long as messages come, then ``ended``, or ``failed`` after an error of this sink.
    """

    name = "the dashboard"
    payloads: tuple[type, ...] = (
        *(CompressedImage, CompressedVideo, RawImage, Markers, Positions, Tracks),
        *(Event, Latency, Rig, NewSession),
    )

    def __init__(self, setting: DashboardSetting, operator: Operator | None = None) -> None:
        self.end: str | None = None
        self.operator = operator
        self._setting, self._begin_ns = setting, setting.now_ns()
        self._floor = describe_floor(setting.rig, setting.model, setting.lenses)
        self._robots = Robots(setting.rig, self._begin_ns)
        self._events = status.RecentEvents()
        played = setting.played
        every_ns = () if played is None else (played.picture_every_ns,)
        self._pictures = Pictures(setting.states, *every_ns)
        self._cameras = status.CameraStatus(setting.states, setting.checks, setting.now_ns, played is None)
        self._latencies: deque[Latency] = deque(maxlen=_LATENCIES)
        self._overlap = OverlapSummary()
        self._computed: tuple[int, dict[str, Any]] | None = None
        self._session = 0
        self._lock = threading.Lock()

    def consume(self, messages: Iterator[Message | None]) -> None:
        """Keep the state of the messages until they end."""
        try:
            for message in messages:
                if message is not None:
                    with self._lock:
                        self._add(message)
            self.end = "ended"
        finally:
            self.end = self.end or "failed"

    def scene(self, may_operate: bool) -> dict[str, Any]:
        """Return the constant content of a page, and the trails so far."""
        with self._lock:
            return {
                "floor": self._floor,
                "trails": self._robots.trails(),
                "may_operate": may_operate and self.operator is not None,
                "played": self._setting.played is not None,
                "may_play": may_operate and self._setting.played is not None,
            }

    def control(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Change the playback of the log as :meth:`PlayedLog.control`; a recording has none."""
        if self._setting.played is None:
            raise IpsysError("this page shows a recording; only the playback of a log can pause or move")
        return self._setting.played.control(body)

    def robots(self) -> dict[str, Any]:
        """Return the newest poses; ``now`` is the time of the page in ms. A new session has new trails."""
        now_ns = self._setting.now_ns()
        with self._lock:
            return {
                "now": (now_ns - self._begin_ns) // _NS_PER_MS,
                "session": self._session,
                "robots": self._robots.rows(now_ns),
            }

    def tiles(self) -> dict[str, Any]:
        """Return the newest picture of each camera, with its markers."""
        with self._lock:
            return {"cameras": self._pictures.rows()}

    def status(self) -> dict[str, Any]:
        """Return the state of cameras, log, streams and operator, the latencies and the events."""
        now_ns = self._setting.now_ns()
        with self._lock:
            events, skipped = self._events.newest_first(), dict(self._events.skipped)
            last_ns, session = dict(self._pictures.last_ns), self._session
        return {
            "now": (now_ns - self._begin_ns) // _NS_PER_MS,
            "end": self.end,
            "cameras": self._cameras.rows(last_ns, skipped, session),
            **self._describe_log(now_ns),
            "streams": status.describe_streams(self._setting.streams),
            **self._statistics(now_ns),
            "events": events,
            **self._describe_positions(),
            **self._operation(now_ns),
        }

    def versions(self) -> tuple[int, int, tuple[int, int, str | None]]:
        """Return the versions of robots, tiles, and of the urgent part of the status."""
        operated = 0 if self.operator is None else self.operator.version
        return self._robots.version, self._pictures.version, (self._events.version, operated, self.end)

    def frame(self, camera: str, time_ns: int) -> CompressedImage | CompressedVideo | RawImage | None:
        """Return the frame of a tile; None if it is too old, or never existed."""
        with self._lock:
            return self._pictures.frame(camera, time_ns)

    def _add(self, message: Message) -> None:
        payload = message.payload
        if self._setting.played is not None:
            self._setting.played.count(message)
        if isinstance(payload, NewSession):
            self._forget()
        elif isinstance(payload, Tracks):
            if run_of_topic(message.topic) == self._setting.run:
                self._robots.add(payload)
        elif isinstance(payload, Event):
            self._events.add(payload, message.log_time_ns)
        elif isinstance(payload, Latency):
            self._latencies.append(payload)
        elif isinstance(payload, (Positions, Rig)):
            self._overlap(message)
        else:
            self._pictures.add(message)

    def _forget(self) -> None:
        """Forget all messages: a playback begins, and its times may be earlier than before."""
        self._session += 1
        for part in (self._robots, self._events, self._pictures):
            part.forget()
        self._latencies.clear()
        self._overlap, self._computed = OverlapSummary(), None
        if self._setting.rig is not None:
            self._overlap(Message(RIG_TOPIC, 0, 0, self._setting.rig))

    def _describe_log(self, now_ns: int) -> dict[str, Any]:
        """Return the state of the recording, or of the playback."""
        played = self._setting.played
        if played is not None:
            return {"playback": played.describe()}
        return {"recording": status.describe_recording(self._setting.log, now_ns - self._begin_ns)}

    def _describe_positions(self) -> dict[str, Any]:
        """Return whether the positions are live, late or stale; nothing before the first frame."""
        state = self._setting.positions and self._setting.positions.state
        return {"positions": {**state._asdict(), "summary": state.summary}} if state else {}

    def _statistics(self, now_ns: int) -> dict[str, Any]:
        """Return latencies and disagreement of cameras, computed at most once per second."""
        before_ns = None if self._computed is None else self._computed[0]
        # In a pause of a playback, the clock stands still.
        if before_ns is None or now_ns == before_ns or now_ns - before_ns >= NS_PER_S:
            with self._lock:
                latencies, overlap = list(self._latencies), self._overlap.lines()
            self._computed = now_ns, {"latency": status.describe_latencies(latencies), "overlap": overlap}
        assert self._computed is not None
        return self._computed[1]

    def _operation(self, now_ns: int) -> dict[str, Any]:
        if self.operator is None:
            return {}
        operation: dict[str, Any] = {"operator": self.operator.seat.number}
        segment = self.operator.segment
        if segment is not None:
            seconds = (now_ns - segment.start_ns) // NS_PER_S
            operation["segment"] = {"name": segment.name, "seconds": seconds}
        return operation


class PlayedLog:
    """The playback of a log.

    ``states`` are those of the cameras, by name. A log does not tell the number of dropped frames.
    """

    def __init__(self, player: Player, scene: PlayedScene) -> None:
        self.states = {name: CameraState(up=True) for name in scene.cameras}
        self._player, self._name = player, scene.name

    def count(self, message: Message) -> None:
        """Update the state of a camera by a message: its frames, its delay, and its losses."""
        payload = message.payload
        if isinstance(payload, NewSession):
            for begun in self.states.values():
                begun.up, begun.delay_s = True, None
        name = payload.camera if isinstance(payload, (Event, Latency)) else message.camera
        state = self.states.get(str(name))
        if state is None:
            return
        if isinstance(payload, (CompressedImage, CompressedVideo, RawImage)):
            state.frames += 1
        elif isinstance(payload, Latency):
            state.delay_s = (payload.received - payload.timestamp) / NS_PER_S
        elif isinstance(payload, Event):
            state.up = _UP_AFTER.get(payload.kind, state.up)

    def describe(self) -> dict[str, Any]:
        """Return the state of the playback: its position in the log, its rate, and its pause."""
        player = self._player
        return {
            "file": self._name,
            "seconds": round(max(player.position_s, 0.0), 1),
            "of_seconds": round(player.duration_s, 1),
            "rate": player.rate,
            "is_paused": player.is_paused,
            "loops": player.loop,
        }

    def control(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Pause or continue, move to a time, or change the rate; return the new state of the playback."""
        player, numbers = self._player, {}
        for name in body.keys() & {"seconds", "rate"}:
            if type(body[name]) not in (int, float) or not isfinite(body[name]):
                raise IpsysError(f"{name}: give a number")
            numbers[name] = float(body[name])
        if "rate" in numbers:
            player.rate = numbers["rate"]
        if "is_paused" in body:
            (player.pause if body["is_paused"] is True else player.resume)()
        if "seconds" in numbers:
            player.seek(numbers["seconds"], _LEAD_S)
        return self.describe()

    def picture_every_ns(self) -> int:
        """Return the shortest time between two pictures: each one in a pause, else five in a real second."""
        return 0 if self._player.is_paused else round(EVERY_NS * self._player.rate)
