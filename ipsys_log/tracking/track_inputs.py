"""Inputs of the stages that track robots: their channels, the part of the rig, and the late frames."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from ipsys_log.messages import STAMP_UNRELIABLE, Event, Message, Model, Rig
from ipsys_log.messages.channels import EVENTS, MODEL, POSITIONS, RIG, Channel
from ipsys_log.messages.stage import StageView

TRACK_READS = (RIG, POSITIONS, MODEL, EVENTS)


def model_of(view: StageView) -> Model | None:
    """Return the model of the positions; None for positions of another program."""
    models = view.payloads(MODEL) if view.run(MODEL) else []
    return models[-1] if models else None


def track_reads(view: StageView) -> tuple[Channel, ...]:
    """Return the channels of ``TRACK_READS`` on which the tracks of a log depend.

    A log without late frames keeps its runs when events are added.
    """
    has_late_frames = any(event.kind == STAMP_UNRELIABLE for event in view.payloads(EVENTS))
    has_model = model_of(view) is not None
    return (RIG, POSITIONS, *([MODEL] if has_model else []), *([EVENTS] if has_late_frames else []))


def tracked_part(rig: Rig, _method: str) -> object:
    """Return the part of the rig on which tracks depend: robots, and heights of their markers."""
    return (
        {(m.id, m.robot, m.height_m, m.height_sigma_m) for m in rig.markers},
        rig.marker_height_m,
        rig.marker_height_sigma_m,
    )


class LateFrames:
    """The intervals with late frames, by camera. Late frames have wrong times, so tracks leave them out."""

    def __init__(self, events: Iterable[Event] = ()) -> None:
        # By camera and start of an interval, its end; None if there is no end yet.
        self._ends_ns: dict[str, dict[int, int | None]] = defaultdict(dict)
        for event in events:
            self.note(event)

    def note(self, event: Event) -> None:
        """Note the interval of an event; the last event of an interval has its end."""
        if event.kind == STAMP_UNRELIABLE and event.camera is not None and event.start is not None:
            self._ends_ns[event.camera][event.start] = event.end

    def has(self, message: Message) -> bool:
        """Return whether a message comes from a late frame."""
        time_ns = message.publish_time_ns
        return any(
            start_ns <= time_ns and (end_ns is None or time_ns <= end_ns)
            for start_ns, end_ns in self._ends_ns.get(str(message.camera), {}).items()
        )
