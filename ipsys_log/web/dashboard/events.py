"""The last events of a recording for a page: newest first, equal ones joined, with their severity."""

from __future__ import annotations

from collections import Counter, deque
from typing import Any

from ipsys_log.messages import CAMERA_MOVED, FRAME_SKIPPED, STAMP_UNRELIABLE, Event
from ipsys_log.messages.events import OPERATOR_KINDS
from ipsys_log.plain_text import plain_text

_NS_PER_MS = 1_000_000
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
        *(CAMERA_MOVED, FRAME_SKIPPED, STAMP_UNRELIABLE, "ambiguous_marker", "camera_size"),
        *("corrupt_frame", "frames_missed", "mirrored_camera", "no_keyframe", "no_keyframes"),
        *("other_prints", "sink_dropped", "wrong_size"),
    )
)


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
