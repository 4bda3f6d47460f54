"""The state of cameras, recording and streams, the durations of the steps, and the last events, as JSON."""

import shutil
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ipsys_log.capture.disk import DiskRoom
from ipsys_log.capture.frames import CameraState
from ipsys_log.capture.live_check import FrameCheck
from ipsys_log.messages import FRAME_SKIPPED, STAMP_UNRELIABLE, Event, Latency
from ipsys_log.messages.events import OPERATOR_KINDS, WATCHED
from ipsys_log.plain_text import plain_text
from ipsys_log.sinks.streams.opening import Stream
from ipsys_log.statistics.latency import latency_percentiles, step_times_s
from ipsys_log.units import NS_PER_S

_NS_PER_MS = 1_000_000
_MS_PER_S = 1e3
# The rate of a camera is that of this time.
_RATE_NS = 3 * NS_PER_S
# After this time, the measured growth of a log is certain enough.
_SETTLED_S = 5.0
_MOST_EVENTS = 50
_LONGEST_TEXT = 300
# Equal events within this time are one entry.
_JOINED_MS = 60_000
# Data are lost, or a result is missing.
_ERRORS = frozenset(
    ("camera_failed", "camera_lost", "disk_fault", "frames_dropped", "sink_stopped", "stages_stopped")
)
# The recording is complete, but a part of it needs attention.
_WARNINGS = frozenset(
    (
        *(*WATCHED, FRAME_SKIPPED, STAMP_UNRELIABLE, "ambiguous_marker", "camera_size"),
        *("corrupt_frame", "frames_missed", "mirrored_camera", "no_keyframe", "no_keyframes"),
        *("model_contradicted", "other_prints", "sink_dropped", "wrong_size"),
    )
)


class CameraStatus:
    """The state of each camera as JSON.

    Parameters
    ----------
    states, checks : states and last checks of the cameras, by name; the recorder changes them.
    now_ns : the clock of the log times.
    has_drops : the states have the numbers of dropped frames; those of a played log do not.
    """

    def __init__(
        self,
        states: Mapping[str, CameraState],
        checks: Mapping[str, FrameCheck],
        now_ns: Callable[[], int],
        has_drops: bool = True,
    ) -> None:
        self._states, self._checks, self._now_ns = states, checks, now_ns
        self._has_drops = has_drops
        self._counts: dict[str, deque[tuple[int, int]]] = {name: deque() for name in states}
        self._session = 0

    def rows(
        self, last_ns: Mapping[str, int], skipped: Mapping[str, int], session: int = 0
    ) -> list[dict[str, Any]]:
        """Return a row for each camera; a missing value is a missing key.

        Parameters
        ----------
        last_ns : log time of the last frame, by camera.
        skipped : number of skipped frames, by camera.
        session : rates begin again with a new session of a playback.
        """
        if session != self._session:
            self._session, self._counts = session, {name: deque() for name in self._states}
        now_ns = self._now_ns()
        return [
            self._row(name, state, now_ns, last_ns.get(name), skipped.get(name, 0))
            for name, state in sorted(self._states.items())
        ]

    def _row(
        self, name: str, state: CameraState, now_ns: int, last_ns: int | None, skipped: int
    ) -> dict[str, Any]:
        row: dict[str, Any] = {
            "name": name,
            "state": "ended" if state.finished else "up" if state.up else "lost",
            "frames": state.frames,
            "skipped": skipped,
            "warnings": list(self._checks[name].warnings) if name in self._checks else [],
        }
        if self._has_drops:
            row["dropped"] = state.dropped + state.missed
        rate_hz = self._rate_hz(name, state.frames, now_ns)
        if rate_hz is not None:
            row["rate_hz"] = round(rate_hz, 1)
        if state.delay_s is not None:
            row["delay_ms"] = round(_MS_PER_S * state.delay_s, 1)
        if last_ns is not None:
            row["age_ms"] = max((now_ns - last_ns) // _NS_PER_MS, 0)
        return row

    def _rate_hz(self, name: str, frames: int, now_ns: int) -> float | None:
        counts = self._counts[name]
        counts.append((now_ns, frames))
        while now_ns - counts[0][0] > _RATE_NS and len(counts) > 2:
            counts.popleft()
        took_ns = now_ns - counts[0][0]
        return None if took_ns <= 0 else (frames - counts[0][1]) * NS_PER_S / took_ns


def describe_recording(log: Path, took_ns: int) -> dict[str, Any]:
    """Return the state of a log that is written since ``took_ns``: its name, its size, and the disk.

    Only the name of the file is given, without its folder.
    """
    took_s = took_ns / NS_PER_S
    recording: dict[str, Any] = {"file": log.name, "seconds": round(took_s, 1)}
    try:
        size, free = log.stat().st_size, shutil.disk_usage(log.absolute().parent).free
    except OSError:
        return recording  # the file does not exist yet, or the disk has failed, which an event reports
    recording |= {"bytes": size, "free_bytes": free}
    room = DiskRoom(log.parent, free, size / took_s if took_s >= _SETTLED_S else 0.0)
    if room.remaining_s is not None:
        recording |= {"left_s": round(room.remaining_s), "is_short": room.is_short()}
    return recording


def describe_streams(streams: Iterable[Stream]) -> list[dict[str, Any]]:
    """Return a row for each stream: its clients if it knows them, and its dropped messages."""
    rows = []
    for stream in streams:
        clients = getattr(stream, "client_count", None)
        known = {} if clients is None else {"clients": clients}
        rows.append({"name": stream.name, **known, "dropped": stream.drops.count})
    return rows


def describe_latencies(entries: Sequence[Latency]) -> list[dict[str, Any]]:
    """Return median and 99th percentile of the duration of each step, in ms."""
    percentiles = latency_percentiles(step_times_s(entries)) if entries else {}
    return [
        {
            "step": step,
            "median_ms": round(_MS_PER_S * one.median_s, 1),
            "p99_ms": round(_MS_PER_S * one.p99_s, 1),
        }
        for step, one in percentiles.items()
    ]


def severity_of(kind: str) -> str:
    """Return the severity of events of a kind: error, warning, mark (of the operator) or note.

    Examples
    --------
    >>> severity_of("camera_lost"), severity_of("camera_back"), severity_of("mark")
    ('error', 'note', 'mark')
    """
    if kind in _ERRORS:
        return "error"
    if kind in _WARNINGS:
        return "warning"
    return "mark" if kind in OPERATOR_KINDS else "note"


class RecentEvents:
    """The last events. Events of one kind and camera within a minute are one entry with a count.

    Attributes
    ----------
    version : increases with each event.
    skipped : number of skipped frames by camera.
    """

    def __init__(self) -> None:
        self.version = 0
        self.skipped: Counter[str] = Counter()
        self._entries: deque[dict[str, Any]] = deque(maxlen=_MOST_EVENTS)

    def add(self, event: Event, time_ns: int) -> None:
        """Handle an event that was logged at ``time_ns``."""
        self.version += 1
        if event.kind == FRAME_SKIPPED and event.camera is not None:
            self.skipped[event.camera] += 1
        entry = {
            "time": time_ns // _NS_PER_MS,
            "kind": plain_text(event.kind),
            "severity": severity_of(event.kind),
            "text": plain_text(event.text, longest=_LONGEST_TEXT),
            "camera": event.camera,
            "count": 1,
        }
        earlier = None if event.kind in OPERATOR_KINDS else self._earlier(entry)
        if earlier is not None:
            self._entries.remove(earlier)
            entry["count"] = earlier["count"] + 1
        self._entries.append(entry)

    def forget(self) -> None:
        """Forget all events: a playback begins again."""
        self.version += 1
        self.skipped.clear()
        self._entries.clear()

    def newest_first(self) -> list[dict[str, Any]]:
        """Return the entries, the newest first; their times are in ms since 1970."""
        return list(reversed(self._entries))

    def _earlier(self, entry: dict[str, Any]) -> dict[str, Any] | None:
        """Return the entry that a new one continues."""
        alike = (
            other
            for other in self._entries
            if (other["kind"], other["camera"]) == (entry["kind"], entry["camera"])
            and entry["time"] - other["time"] <= _JOINED_MS
        )
        return next(alike, None)
