"""Messages of the stages that track robots: their inputs, late frames, and the rows of tracks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import STAMP_UNRELIABLE, Event, Message, Model, Rig, Track
from ipsys_log.messages.arrays import Array
from ipsys_log.messages.channels import EVENTS, MODEL, POSITIONS, RIG, Channel
from ipsys_log.messages.stage import StageView
from ipsys_log.models.tracking.interpolation import TrackRows
from ipsys_log.models.tracking.tracks import Pose
from ipsys_log.units import NS_PER_S

TRACK_READS = (RIG, POSITIONS, MODEL, EVENTS)
# A heading that was never measured has a larger standard deviation.
_UNKNOWN_HEADING_RAD = 2.0
# Rows of tracks without an age belong to one track if they are not further apart.
_LONGEST_GAP_NS = NS_PER_S


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


def make_track(pose: Pose) -> Track:
    """Return the row of a pose; its robot is a pair of the name and the marker id."""
    mean, covariance = pose.states.means[pose.state], pose.states.covariances[pose.state]
    robot, marker_id = pose.robot
    x_m, y_m, z_m, heading_rad, _, _, _, turn_rate, _, _ = mean.tolist()
    heading_sigma_rad, turn_sigma_rad_s = sqrt(covariance.item(3, 3)), sqrt(covariance.item(7, 7))
    has_heading = heading_sigma_rad < _UNKNOWN_HEADING_RAD
    return Track(
        robot,
        marker_id,
        x_m,
        y_m,
        z_m,
        (heading_rad + pi) % (2 * pi) - pi if has_heading else None,
        covariance[:3, :3] if pose.has_covariance else None,
        pose.cameras,
        pose.inside,
        mean[4:7],
        covariance[4:7, 4:7] if pose.has_covariance else None,
        heading_sigma_rad if has_heading and pose.has_covariance else None,
        turn_rate if has_heading else None,
        turn_sigma_rad_s if has_heading and pose.has_covariance else None,
        pose.coasting_ns,
        pose.age_ns,
    )


def gather_rows(messages: Iterable[Message], robot: str) -> tuple[TrackRows, set[str]]:
    """Return the rows of a robot, and the names of all robots.

    Parameters
    ----------
    messages : of one channel and run with tracks, in any order. The last row of an instant counts.
    robot : its name.
    """
    by_time: dict[int, Track] = {}
    names: set[str] = set()
    for message in messages:
        for track in message.payload.tracks:
            names.add(track.robot)
            if track.robot == robot:
                by_time[message.payload.timestamp] = track
    times = sorted(by_time)
    return _rows(np.array(times, dtype=np.int64), [by_time[time_ns] for time_ns in times]), names


def _rows(times_ns: NDArray[np.int64], tracks: Sequence[Track]) -> TrackRows:
    return TrackRows(
        times_ns,
        _numbers(times_ns, tracks),
        np.array([(t.x_m, t.y_m, t.z_m) for t in tracks]).reshape(-1, 3),
        _arrays([t.covariance_m2 for t in tracks], (3, 3)),
        _arrays([t.velocity_m_s for t in tracks], (3,)),
        _arrays([t.velocity_covariance_m2_s2 for t in tracks], (3, 3)),
        _arrays([t.heading_rad for t in tracks], ()),
        _arrays([t.heading_sigma_rad for t in tracks], ()),
        _arrays([t.turn_rate_rad_s for t in tracks], ()),
        _arrays([t.turn_rate_sigma_rad_s for t in tracks], ()),
    )


def _arrays(values: Sequence[Array | float | None], shape: tuple[int, ...]) -> Array:
    """Return values as one array (n, *shape), NaN for missing ones."""
    joined = np.full((len(values), *shape), np.nan)
    for row, value in enumerate(values):
        if value is not None:
            joined[row] = value
    return joined


def _numbers(times_ns: NDArray[np.int64], tracks: Sequence[Track]) -> NDArray[np.int64]:
    """Return the number (n,) of the track of each row: a track began after the row before its first row."""
    numbers = np.zeros(len(tracks), dtype=np.int64)
    for row in range(1, len(tracks)):
        age_ns, gap_ns = tracks[row].age_ns, int(times_ns[row] - times_ns[row - 1])
        begins = gap_ns > _LONGEST_GAP_NS if age_ns is None else age_ns < gap_ns
        numbers[row] = numbers[row - 1] + begins
    return numbers
