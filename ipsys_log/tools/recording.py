"""The recording in a log: the frames of each camera, their gaps, and the events by kind."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Event
from ipsys_log.messages.channels import EVENTS, RUN_EVENTS
from ipsys_log.units import NS_PER_S

# A gap is this many times longer than the usual interval between frames.
_GAP_FACTOR = 3
# Frames that have waited, as in a stalled recorder, come at intervals below this share of the usual one.
_WAITED_SHARE = 0.5


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
    gaps: "FrameGaps"


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


class FrameGaps(NamedTuple):
    """The rate in Hz without the gaps (None: unknown), the usual interval in s, and the gaps.

    ``starts_ns`` are the times of the last frames before the gaps, ``lengths_s`` their lengths.
    """

    rate_hz: float | None = None
    usual_s: float = 0.0
    starts_ns: tuple[int, ...] = ()
    lengths_s: tuple[float, ...] = ()


def find_gaps(times_ns: NDArray[np.int64], longest_s: float | None = None) -> FrameGaps:
    """Return the rate and the gaps of ascending times.

    Frames that have waited while no frame came follow at short intervals. They are late and not missing, so
    their time is no part of a gap.

    Parameters
    ----------
    times_ns : times of the frames in ns, shape (N,), ascending.
    longest_s : the longest interval that is no gap; None: three times the median interval.

    Examples
    --------
    >>> gaps = find_gaps(np.array([0, 1, 2, 3, 9, 10]) * NS_PER_S)
    >>> gaps.rate_hz, gaps.lengths_s
    (1.0, (6.0,))
    >>> find_gaps(np.array([0, 1, 2, 3, 4, 8, 8.1, 8.2, 8.3, 9, 10, 11]) * NS_PER_S).rate_hz
    1.0
    """
    if len(times_ns) < 2:
        return FrameGaps()
    steps_s = np.diff(times_ns) / NS_PER_S
    usual_s = float(np.median(steps_s))
    limit_s = _GAP_FACTOR * usual_s if longest_s is None else longest_s
    missing_s = {
        place: steps_s[place] - _waited_s(steps_s[place + 1 :], usual_s)
        for place in np.flatnonzero(steps_s > limit_s).tolist()
    }
    gaps_s = {place: float(length_s) for place, length_s in missing_s.items() if length_s > limit_s}
    steady_s = float(np.delete(steps_s, [*gaps_s]).sum())
    steady_s += sum(float(steps_s[place]) - length_s for place, length_s in gaps_s.items())
    count = len(steps_s) - len(gaps_s)
    return FrameGaps(
        count / steady_s if steady_s > 0 else None,
        usual_s,
        tuple(times_ns[[*gaps_s]].tolist()),
        tuple(gaps_s.values()),
    )


def _waited_s(steps_s: NDArray[np.float64], usual_s: float) -> float:
    """Return the time in s for which the first frames have waited, by their intervals (N,) in s."""
    usual_again = np.flatnonzero(steps_s >= _WAITED_SHARE * usual_s)
    short_s = steps_s[: usual_again[0]] if len(usual_again) else steps_s
    return float(np.sum(usual_s - short_s))
