"""Ground truth: true positions of markers, and errors against them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, ErrorStatistics, Indices, Message, Tracks
from ipsys_log.statistics.accuracy import error_statistics
from ipsys_log.statistics.calibration_points import TimedPoints, still_interval
from ipsys_log.statistics.tape import RiggedMeasurement
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.time_brackets import bracket_times

_SAME_HEIGHT_M = 0.005
# Longest gap for linear interpolation. For a robot with 2 m/s and 2.5 rad/s, its error is 0.7 mm over 1/30 s,
# and 6 mm over 0.1 s.
LONGEST_GAP_NS = NS_PER_S // 10


class TrackErrors(NamedTuple):
    """The 3D errors and the floor errors of tracks at the instants that count, and at the others.

    Attributes
    ----------
    space, floor : errors at the instants that count; over all instants if none counts.
    counted, instants : number of instants that count, and of all instants with a ground truth.
    others : the errors in space and on the floor at the instants that do not count; None if all count.
    whole : the errors in space and on the floor over all instants.
    """

    space: ErrorStatistics
    floor: ErrorStatistics
    counted: int
    instants: int
    others: tuple[ErrorStatistics, ErrorStatistics] | None
    whole: tuple[ErrorStatistics, ErrorStatistics]


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPath:
    """The positions of a robot in order of time, and its headings (n,) in rad, NaN where there is none."""

    robot: str
    positions: TimedPoints
    headings_rad: Array


def gather_tracks(messages: Iterable[Message]) -> dict[int, TimedPoints]:
    """Return positions of tracks by marker, in order of time; those of equal time in log order.

    Predicted positions of unseen robots are left out.
    """
    return {marker_id: path.positions for marker_id, path in gather_paths(messages).items()}


def gather_paths(messages: Iterable[Message]) -> dict[int, TrackedPath]:
    """Return the positions of :func:`gather_tracks` with headings and the names of the robots, by marker."""
    rows: dict[int, list[tuple[int, float, float, float, float]]] = {}
    robots: dict[int, str] = {}
    for message in messages:
        if isinstance(message.payload, Tracks):
            for track in (one for one in message.payload.tracks if one.coasting_ns is None):
                heading_rad = math.nan if track.heading_rad is None else track.heading_rad
                row = (message.publish_time_ns, track.x_m, track.y_m, track.z_m, heading_rad)
                rows.setdefault(track.id, []).append(row)
                robots.setdefault(track.id, track.robot)
    for values in rows.values():
        values.sort(key=lambda row: row[0])
    return {
        marker_id: TrackedPath(
            robots[marker_id],
            TimedPoints(
                np.array([row[0] for row in values], dtype=np.int64),
                np.array([row[1:4] for row in values], dtype=np.float64),
            ),
            np.array([row[4] for row in values], dtype=np.float64),
        )
        for marker_id, values in rows.items()
    }


def true_points(
    places: Iterable[RiggedMeasurement], ground_truth: Mapping[int, TimedPoints]
) -> dict[str, NDArray[np.float64]]:
    """Return the true position of each measured marker, (3,) in m by id, if the ground truth is known."""
    points = {}
    for place in places:
        measurement = place.measurement
        known = ground_truth.get(measurement.marker_id if measurement.marker_id is not None else -1)
        if known is not None and (interval := still_interval(known, measurement.timestamp)) is not None:
            within = (known.times_ns >= interval[0]) & (known.times_ns <= interval[1])
            points[measurement.id] = known.points_m[within].mean(axis=0)
    return points


def track_errors(
    tracks: Mapping[int, TimedPoints], ground_truth: Mapping[int, TimedPoints], at_track_height: bool = False
) -> TrackErrors | None:
    """Return the 3D errors and the floor errors of tracks against the ground truth at the same instants.

    A rolling shutter exposes a marker some time after the frame's instant. The true position between two
    instants of the ground truth, up to 0.1 s apart, is therefore interpolated linearly.

    Parameters
    ----------
    at_track_height : True if only the instants count at which a marker has the height of its track. Models
        with a known marker height are not valid while a user lifts the marker for a measurement. The errors
        at the other instants stand beside.

    Returns
    -------
    The error statistics; None if no instant of a track has a ground truth.
    """
    offsets = []
    for marker_id, track in tracks.items():
        known = ground_truth.get(marker_id)
        if known is None:
            continue
        rows = last_poses(track)
        truth = bracket_times(known.times_ns, track.times_ns[rows], LONGEST_GAP_NS)
        offsets_m = track.points_m[rows] - truth.mix(known.points_m)
        offsets.append(offsets_m[truth.is_known])
    rows_m = np.vstack([np.zeros((0, 3)), *offsets])
    if not len(rows_m):
        return None
    counts = np.abs(rows_m[:, 2]) < _SAME_HEIGHT_M if at_track_height else np.ones(len(rows_m), dtype=bool)
    whole = _statistics(rows_m)
    space, floor = _statistics(rows_m[counts]) if counts.any() else whole
    others = None if counts.all() else _statistics(rows_m[~counts])
    return TrackErrors(space, floor, int(counts.sum()), len(rows_m), others, whole)


def last_poses(track: TimedPoints) -> Indices:
    """Return the rows of a track with the last pose of each instant, in order of time.

    Tracks of earlier versions have a pose of each camera at an instant; the last one uses all cameras.
    """
    return len(track.times_ns) - 1 - np.unique(track.times_ns[::-1], return_index=True)[1]


def _statistics(offsets_m: Array) -> tuple[ErrorStatistics, ErrorStatistics]:
    return (
        error_statistics(np.linalg.norm(offsets_m, axis=1), independent=False),
        error_statistics(np.linalg.norm(offsets_m[:, :2], axis=1), independent=False),
    )
