"""Stationary intervals of markers: in a whole log, and in the last second."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, CameraPoint, CameraPoints, Measurement
from ipsys_log.statistics.calibration_points import LONGEST_GAP_NS, STILL_ACROSS_M, STILL_ALONG_M, TimedPoints
from ipsys_log.units import NS_PER_S

# A marker is stationary if its motion is within the limits of calibration pairs; in a high lab, the noise
# along the view is this share of the depth.
_STILL_ALONG = 0.02
# Least duration of a stationary interval directly before or after a motion.
_LEAST_NS = NS_PER_S // 2


@dataclass(frozen=True, slots=True, eq=False)
class StationaryMarker:
    """A stationary interval of a marker.

    Attributes
    ----------
    point_m : (3,), centre of the marker in camera coordinates.
    covariance_m2 : (3, 3), covariance of this point from the noise of the corners; zeros if it is unknown.
    height_m : measured height above the floor; 0 without a measurement.
    frames : number of frames that show the marker in this interval.
    start_ns, end_ns : times of the first and of the last of these frames.
    """

    marker_id: int
    point_m: Array
    covariance_m2: Array
    height_m: float = 0.0
    frames: int = 1
    start_ns: int = 0
    end_ns: int = 0


def find_stationary(
    frames: Iterable[CameraPoints], measurements: Sequence[Measurement] = ()
) -> list[StationaryMarker]:
    """Return all stationary intervals of markers, ordered by marker and time.

    A marker that is moved several times has several intervals. In an interval, it stays within 1 cm for at
    least 0.5 s. The duration may be shorter if the camera does not see the marker for 2 s before and after.

    Parameters
    ----------
    frames : the camera points of one camera.
    measurements : the valid measurements; a marker has the height of a measurement in its interval.

    Examples
    --------
    >>> frames = [CameraPoints(n * 10**8, (CameraPoint(4, 0.1, 0.2, 2.0),)) for n in range(20)]
    >>> [(one.marker_id, one.frames) for one in find_stationary(frames)]
    [(4, 20)]
    """
    seen: dict[int, list[tuple[int, CameraPoint]]] = {}
    for frame in frames:
        for point in frame.points:
            seen.setdefault(point.id, []).append((frame.timestamp + (point.time_offset_ns or 0), point))
    intervals = []
    for marker_id in sorted(seen):
        sightings = sorted(seen[marker_id], key=lambda sighting: sighting[0])
        for first, last in _stretches(sightings):
            interval = sightings[first : last + 1]
            intervals.append(
                _lying(interval, _height(marker_id, interval[0][0], interval[-1][0], measurements))
            )
    return intervals


def _stretches(sightings: Sequence[tuple[int, CameraPoint]]) -> Iterator[tuple[int, int]]:
    """Yield the first and last index of each stationary interval."""
    times_ns = np.array([time_ns for time_ns, _ in sightings], dtype=np.int64)
    points_m = np.array([(p.x_m, p.y_m, p.z_m) for _, p in sightings])
    joined = np.diff(times_ns) <= LONGEST_GAP_NS
    first = 0
    while first < len(points_m):
        last = first
        while last + 1 < len(points_m) and joined[last] and _together(points_m[first], points_m[last + 1]):
            last += 1
        apart = (first == 0 or not joined[first - 1]) and (last + 1 == len(points_m) or not joined[last])
        if apart or times_ns[last] - times_ns[first] >= _LEAST_NS:
            yield first, last
        first = last + 1


def _together(one_m: Array, other_m: Array) -> bool:
    x_m, y_m, z_m = np.abs(other_m - one_m).tolist()
    return bool(np.hypot(x_m, y_m) <= STILL_ACROSS_M and z_m <= max(STILL_ALONG_M, _STILL_ALONG * one_m[2]))


def _lying(sightings: Sequence[tuple[int, CameraPoint]], height_m: float) -> StationaryMarker:
    points = [point for _, point in sightings]
    known_m2 = [point.covariance_m2 for point in points if point.covariance_m2 is not None]
    covariance_m2 = np.mean(known_m2, axis=0) / len(points) if known_m2 else np.zeros((3, 3))
    point_m = np.median([(p.x_m, p.y_m, p.z_m) for p in points], axis=0)
    times_ns = sightings[0][0], sightings[-1][0]
    return StationaryMarker(points[0].id, point_m, covariance_m2, height_m, len(points), *times_ns)


def _height(marker_id: int, start_ns: int, end_ns: int, measurements: Sequence[Measurement]) -> float:
    for measurement in measurements:
        still = measurement.still
        from_ns = still.start if still is not None else measurement.timestamp - LONGEST_GAP_NS
        to_ns = still.end if still is not None else measurement.timestamp + LONGEST_GAP_NS
        if measurement.marker_id == marker_id and from_ns <= end_ns and start_ns <= to_ns:
            point = measurement.point
            return (point.z_m if point is not None else measurement.height_m) or 0.0
    return 0.0


# A very slow marker stays within these limits for some time, but the means of the earlier and the later half
# differ. The means of few sightings are less accurate.
_DRIFT_M = 0.002
_DRIFT_OF_ONE_M = 0.004
# A slow motion can look stationary for a shorter time. A shorter interval is valid only if the marker is not
# visible before and after.
_SHORTEST_NS = NS_PER_S
# Least share of sightings near the median: single frames with a passing object do not end an interval.
_SHARE_NEAR = 0.95
# One sighting does not show if a marker is stationary.
FEWEST_FRAMES = 2


def is_stationary(points_m: Array) -> bool:
    """Return whether a marker is stationary, from its camera points (n, 3) in order of time.

    Examples
    --------
    >>> is_stationary(np.array([[0.1, 0.2, 2.0], [0.101, 0.2, 2.01], [0.1, 0.2, 2.0]]))
    True
    >>> is_stationary(np.array([[0.1, 0.2, 2.0], [0.106, 0.2, 2.0]]))
    False
    """
    if len(points_m) < FEWEST_FRAMES:
        return False
    near = is_near(points_m, np.median(points_m, axis=0))
    if near.mean() < _SHARE_NEAR:
        return False
    points_m = points_m[near]
    # The drift is measured across the view. The noise of a depth moves a point along its ray, and so also
    # sideways if the ray is slanted.
    rays = points_m[:, :2] / points_m[:, 2:]
    half = len(rays) // 2
    drift_m = (rays[-half:].mean(axis=0) - rays[:half].mean(axis=0)) * points_m[:, 2].mean()
    return float(np.hypot(*drift_m)) <= _DRIFT_M + _DRIFT_OF_ONE_M / math.sqrt(len(rays))


def is_near(points_m: Array, place_m: Array) -> NDArray[np.bool_]:
    """Return a mask (n,) of the camera points (n, 3) that are at a position (3,), within their noise."""
    across_m = (points_m[:, :2] / points_m[:, 2:] - place_m[:2] / place_m[2]) * place_m[2]
    along_m = np.abs(points_m[:, 2] - place_m[2])
    near: NDArray[np.bool_] = (np.hypot(across_m[:, 0], across_m[:, 1]) <= STILL_ACROSS_M) & (
        along_m <= STILL_ALONG_M
    )
    return near


def stationary_intervals(cameras: Mapping[str, TimedPoints]) -> list[tuple[int, int, tuple[str, ...]]]:
    """Return the stationary intervals of one marker, from the sightings of all cameras, in order of time.

    Parameters
    ----------
    cameras : sightings by camera.

    Returns
    -------
    First and last time in ns, both included, and the cameras that saw the marker in the interval. Overlapping
    intervals of several cameras become one interval: their union, or their intersection if a camera saw the
    marker move in the union.
    """
    intervals = sorted(interval for seen in cameras.values() for interval in _joined(seen))
    joined: list[list[tuple[int, int]]] = []
    for start_ns, end_ns in intervals:
        if joined and start_ns <= max(end for _, end in joined[-1]):
            joined[-1].append((start_ns, end_ns))
        else:
            joined.append([(start_ns, end_ns)])
    rows = []
    for group in joined:
        whole = group[0][0], max(end for _, end in group)
        common = group[-1][0], min(end for _, end in group)
        for start_ns, end_ns in (whole, common):
            seen = _seen_still(cameras, start_ns, end_ns)
            if seen:
                rows.append((start_ns, end_ns, seen))
                break
    return rows


def _seen_still(cameras: Mapping[str, TimedPoints], start_ns: int, end_ns: int) -> tuple[str, ...]:
    """Return the cameras that saw the marker in an interval; none if one of them saw it move."""
    seen = []
    for camera, sightings in sorted(cameras.items()):
        points_m = _between(sightings, start_ns, end_ns)
        if len(points_m) >= FEWEST_FRAMES:
            if not is_stationary(points_m):
                return ()
            seen.append(camera)
    return tuple(seen)


def _between(sightings: TimedPoints, start_ns: int, end_ns: int) -> Array:
    within = (sightings.times_ns >= start_ns) & (sightings.times_ns <= end_ns)
    return sightings.points_m[within]


def _joined(sightings: TimedPoints) -> list[tuple[int, int]]:
    """Return the stationary intervals of one camera; join consecutive intervals at the same position."""
    intervals: list[tuple[int, int]] = []
    for start_ns, end_ns in _camera_stretches(sightings):
        both = (intervals[-1][0], end_ns) if intervals else (start_ns, end_ns)
        if (
            intervals
            and start_ns - intervals[-1][1] <= LONGEST_GAP_NS
            and is_stationary(_between(sightings, *both))
        ):
            intervals[-1] = both
        else:
            intervals.append((start_ns, end_ns))
    return intervals


def _camera_stretches(sightings: TimedPoints) -> Iterator[tuple[int, int]]:
    """Yield the intervals in which one camera sees a marker stationary."""
    times_ns, points_m = sightings.times_ns, sightings.points_m
    ends = np.append(np.flatnonzero(np.diff(times_ns) > LONGEST_GAP_NS), len(times_ns) - 1) + 1
    rays = (points_m[:, :2] / points_m[:, 2:]).tolist()
    depths_m = points_m[:, 2].tolist()
    first = 0
    while first < len(times_ns):
        end = int(ends[np.searchsorted(ends, first, "right")])
        stop = _first_away(rays, depths_m, first, end)
        if stop - first < FEWEST_FRAMES or not is_stationary(points_m[first:stop]):
            # An interval that is detected in its middle is extended back to its start.
            first += max((stop - first) // 4, 1)
            continue
        # The reference is the middle of the interval, because a hand may still move the marker at the start.
        near = is_near(points_m[first:end], np.median(points_m[first:stop], axis=0))
        middle = (stop - first) // 2
        begin = first + int(np.flatnonzero(np.append(True, ~near[:middle]))[-1])
        done = first + middle + int(np.flatnonzero(np.append(~near[middle:], True))[0])
        if not is_stationary(points_m[begin:done]):
            begin, done = first, stop
        start_ns, end_ns = int(times_ns[begin]), int(times_ns[done - 1])
        alone = done == end and (begin == 0 or begin in ends)
        if alone or end_ns - start_ns >= _SHORTEST_NS:
            yield start_ns, end_ns
        first = max(done, stop)


def _first_away(rays: Sequence[Sequence[float]], depths_m: Sequence[float], first: int, end: int) -> int:
    """Return the first sighting between ``first`` and ``end`` that is not near ``first``, or ``end``."""
    (u, v), depth_m = rays[first], depths_m[first]
    for n in range(first + 1, end):
        across = (rays[n][0] - u) ** 2 + (rays[n][1] - v) ** 2
        if across * depth_m**2 > STILL_ACROSS_M**2 or abs(depths_m[n] - depth_m) > STILL_ALONG_M:
            return n
    return end
