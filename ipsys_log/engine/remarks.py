"""Remarks on a stage, and decisions that a user must make before the stage is written."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterable, Iterator
from statistics import median

from ipsys_log.engine.graph import Task
from ipsys_log.engine.select import LEAST_OFFSET_PX, MIN_OFFSETS
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.messages import Event, Markers, Message, Positions, kind_of
from ipsys_log.messages.channels import MARKERS, POSITIONS
from ipsys_log.messages.events import CONTRADICTIONS
from ipsys_log.units import format_time


class Remarks:
    """Collector of remarks; it sees all messages of a stage on their way into the log."""

    def __init__(self, task: Task, skip_ambiguous: bool) -> None:
        self._task = task
        self._skip_ambiguous = skip_ambiguous
        # For each kind of event: the number of events, and the first event.
        self._events: Counter[str] = Counter()
        self._first: dict[str, Message] = {}
        self._unknown: set[str] = set()
        self._contradictions: list[Message] = []
        self._frames = self._markers = 0
        self._located: set[str | None] = set()
        # An array takes eight bytes for each offset: a long log has millions of offsets.
        self._offsets_px: dict[str, array[float]] = {}

    def watch(self, messages: Iterable[Message]) -> Iterator[Message]:
        """Yield the messages, unchanged.

        Raises
        ------
        IpsysError
            A marker is ambiguous, no frame can be decoded, or no frame shows a marker of the rig that can be
            measured.
        """
        for message in messages:
            self._note(message)
            yield message
        if MARKERS in self._task.stage.writes:
            self._check_detection()

    def _note(self, message: Message) -> None:
        payload = message.payload
        if isinstance(payload, Event) and payload.kind in CONTRADICTIONS:
            self._contradictions.append(message)
        elif isinstance(payload, Event):
            self._events[payload.kind] += 1
            self._first.setdefault(payload.kind, message)
            if payload.kind == "unknown_marker":
                self._unknown.add(str(payload.marker_id))
            if payload.kind == "ambiguous_marker" and not self._skip_ambiguous:
                raise IpsysError(
                    f"{_said(message)}: give each marker its own id, or exclude the marker from such frames "
                    "with --skip-ambiguous"
                )
        elif isinstance(payload, Markers):
            self._frames += 1
            self._markers += len(payload.markers)
            offsets = self._offsets_px.setdefault(str(message.camera), array("d"))
            offsets.extend(m.edge_offset_px for m in payload.markers if m.edge_offset_px is not None)
        elif kind_of(payload) is Positions:
            self._located.add(message.camera)

    def _check_detection(self) -> None:
        corrupt = self._events["corrupt_frame"]
        if corrupt and not self._frames:
            first = _said(self._first["corrupt_frame"])
            raise IpsysError(f"none of {corrupt} frames can be decoded, first: {first}")
        if self._contradictions and not self._markers:
            first = _said(self._contradictions[0])
            raise IpsysError(f"no marker could be measured in {self._frames} frames: {first}")
        if self._unknown and not self._markers:
            raise IpsysError(
                "no frame has a marker of the rig, but the frames have ids "
                f"{', '.join(sorted(self._unknown))}: add them as [[markers]] to lab.toml, and give the "
                "file with --rig"
            )
        rejected = self._events["rejected_marker"]
        if rejected and not self._markers:
            raise IpsysError(
                f"no marker could be measured in {self._frames} frames, first: "
                f"{_said(self._first['rejected_marker'])}: change the light, move the marker, or print it on "
                "matt paper"
            )
        if self._frames and not self._markers:
            raise IpsysError(
                f"no marker was found in {self._frames} frames: check that the markers are printed from the "
                "dictionary of the rig (or give another rig with --rig), completely visible, in focus and "
                "without glare"
            )

    def lines(self) -> tuple[str, ...]:
        """Return one line for each remark."""
        lines = [
            f"{count} x {kind.replace('_', ' ')}, first: {_said(self._first[kind])}"
            for kind, count in sorted(self._events.items())
        ]
        lines = [*map(_said, self._contradictions), *lines]
        if MARKERS in self._task.stage.writes:
            lines.insert(0, f"{self._markers} markers in {self._frames} frames")
            lines += self._about_offsets()
        if POSITIONS in self._task.stage.writes:
            cameras = {camera_of_topic(topic) for topic in self._task.topics} - {None}
            lines += [f"camera {name} has no model" for name in sorted(map(str, cameras - self._located))]
        return (*lines, *self._task.notes)

    def _about_offsets(self) -> list[str]:
        medians = {
            c: median(offsets_px)
            for c, offsets_px in self._offsets_px.items()
            if len(offsets_px) >= MIN_OFFSETS
        }
        return [
            f"camera {camera}: black edges are {offset_px:.2f} px inside the black (gamma); corrected"
            for camera, offset_px in sorted(medians.items())
            if abs(offset_px) >= LEAST_OFFSET_PX
        ]


def _said(message: Message) -> str:
    return f"{message.payload.text}, at {format_time(message.log_time_ns)} ({message.log_time_ns} ns)"
