"""The recording in a log: the frames of each camera, their gaps, and the events by kind."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ipsys_log.analysis.frame_gaps import FrameGaps, find_gaps
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Event
from ipsys_log.messages.channels import EVENTS, RUN_EVENTS


@dataclass(frozen=True, slots=True)
class CameraRecording:
    """The frames of a camera.

    Attributes
    ----------
    frames : number of recorded frames.
    start_ns, end_ns : log times of the first and the last frame.
    gaps : the rate, and the intervals of more than three usual intervals.
    """

    camera: str
    frames: int
    start_ns: int
    end_ns: int
    gaps: FrameGaps


@dataclass(frozen=True, slots=True)
class EventGroup:
    """The events of one kind, of one camera and of one run.

    Attributes
    ----------
    run : the run whose stage wrote them; None for events of the recording.
    times_ns : log times, in order.
    text : the text of the last one.
    """

    kind: str
    camera: str | None
    run: str | None
    times_ns: tuple[int, ...]
    text: str


def read_cameras(session: Session) -> list[CameraRecording]:
    """Return the recordings of the cameras with frames, by name; from the indexes of the logs alone."""
    return list(_cameras(session))


def _cameras(session: Session) -> Iterator[CameraRecording]:
    for camera, topic in sorted(session.images.items()):
        parts = [reader.times(topic) for reader in session.readers if topic in reader.channels]
        times_ns = np.sort(np.concatenate(parts))
        if len(times_ns):
            yield CameraRecording(
                camera, len(times_ns), int(times_ns[0]), int(times_ns[-1]), find_gaps(times_ns)
            )


def group_events(session: Session) -> list[EventGroup]:
    """Return the events of the recording and of all runs, the most frequent kind first."""
    times_ns: dict[tuple[str | None, str, str | None], list[int]] = {}
    texts: dict[tuple[str | None, str, str | None], str] = {}
    runs = sorted(session.run_names())
    topics = [*session.topics(EVENTS), *(t for run in runs for t in session.topics(RUN_EVENTS, run))]
    for message in session.messages(topics):
        event: Event = message.payload
        key = run_of_topic(message.topic), event.kind, event.camera
        times_ns.setdefault(key, []).append(message.log_time_ns)
        texts[key] = event.text
    groups = [
        EventGroup(kind, camera, run, tuple(times), texts[run, kind, camera])
        for (run, kind, camera), times in times_ns.items()
    ]
    return sorted(groups, key=lambda group: (group.run or "", -len(group.times_ns), group.kind))
