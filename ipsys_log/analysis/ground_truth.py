"""What a simulated lab knows of where its markers truly were."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.accuracy import error_statistics
from ipsys_log.analysis.pairs import Measured, Sightings, still_interval
from ipsys_log.messages import ErrorStatistics, Message, Tracks
from ipsys_log.units import NS_PER_S

__all__ = ["gather_tracks", "track_errors", "true_points"]

_SAME_HEIGHT_M = 0.005
# Over 1/30 s a straight line is off by 0.7 mm where a robot at 2 m/s turns by 2.5 rad/s, over 0.1 s by 6 mm.
_GAP_NS = NS_PER_S // 10


def gather_tracks(messages: Iterable[Message]) -> dict[int, Sightings]:
    """Positions of tracks by marker, in the order of time and, at one time, of the log."""
    rows: dict[int, list[tuple[int, float, float, float]]] = {}
    for message in messages:
        if isinstance(message.payload, Tracks):
            for track in message.payload.tracks:
                row = (message.publish_time_ns, track.x_m, track.y_m, track.z_m)
                rows.setdefault(track.id, []).append(row)
    for values in rows.values():
        values.sort(key=lambda row: row[0])
    return {
        marker_id: Sightings(
            np.array([row[0] for row in values], dtype=np.int64),
            np.array([row[1:] for row in values], dtype=np.float64),
        )
        for marker_id, values in rows.items()
    }


def true_points(places: Iterable[Measured], truth: Mapping[int, Sightings]) -> dict[str, NDArray[np.float64]]:
    """Where each measured marker truly was, (3,) in m by id; only where the truth of that time is known."""
    points = {}
    for place in places:
        measurement = place.measurement
        known = truth.get(measurement.marker_id if measurement.marker_id is not None else -1)
        if known is not None and (interval := still_interval(known, measurement.timestamp)) is not None:
            within = (known.times_ns >= interval[0]) & (known.times_ns <= interval[1])
            points[measurement.id] = known.points_m[within].mean(axis=0)
    return points


def track_errors(
    tracks: Mapping[int, Sightings], truth: Mapping[int, Sightings], carried: bool = False
) -> tuple[ErrorStatistics, ErrorStatistics] | None:
    """Errors of tracks against the truth at the same instants, in space and on the floor.

    Between two instants of the truth, up to 0.1 s apart, it lies on the line from one to the other: a rolling
    shutter exposes a marker some time after the frame's instant.

    Parameters
    ----------
    carried : only instants at which a marker has the height of its track: for a model that is told at which
        height the robot carries it, and not when somebody lifts it to measure a place.

    Returns
    -------
    None where no instant of a track has a truth.
    """
    offsets = []
    for marker_id, track in tracks.items():
        known = truth.get(marker_id)
        if known is None:
            continue
        # The last of the poses of one instant rests on all cameras. Cameras that expose a marker at
        # different times have no instant in common: the pose of each counts.
        times_ns, last = np.unique(track.times_ns[::-1], return_index=True)
        true_m, told = _between(known, times_ns)
        offset = (track.points_m[::-1][last] - true_m)[told]
        if carried:
            offset = offset[np.abs(offset[:, 2]) < _SAME_HEIGHT_M]
        if len(offset):
            offsets.append(offset)
    if not offsets:
        return None
    rows = np.vstack(offsets)
    return (
        error_statistics(np.linalg.norm(rows, axis=1), independent=False),
        error_statistics(np.linalg.norm(rows[:, :2], axis=1), independent=False),
    )


def _between(known: Sightings, times_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Points (n, 3) at times (n,), and whether they are told: not beyond the ends, nor in a gap.

    At an instant of its own the truth is as it stands, the first one where it is there twice.
    """
    after = np.searchsorted(known.times_ns, times_ns).clip(max=len(known.times_ns) - 1)
    end_ns = known.times_ns[after]
    before = np.where(end_ns > times_ns, after - 1, after).clip(min=0)
    start_ns = known.times_ns[before]
    told = (start_ns <= times_ns) & (times_ns <= end_ns) & (end_ns - start_ns <= _GAP_NS)
    share = (times_ns - start_ns) / np.maximum(end_ns - start_ns, 1)
    start_m = known.points_m[before]
    return start_m + share[:, None] * (known.points_m[after] - start_m), told
