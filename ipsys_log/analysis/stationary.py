"""Stationary intervals of markers: over a whole log, and over the last second."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.pairs import Sightings
from ipsys_log.messages import CameraPoint, CameraPoints, Measurement
from ipsys_log.units import NS_PER_S

__all__ = ["FEWEST_FRAMES", "Lying", "find_lying", "lies_at", "lies_still", "still_stretches"]

Array = NDArray[np.float64]

# A marker lies still while it stays this near to where it was: above the noise of plain corners.
_STILL_ACROSS_M, _STILL_ALONG_M, _STILL_ALONG = 0.01, 0.04, 0.02
# So long a silence may hide that it was carried elsewhere.
_GAP_NS = 2 * NS_PER_S
# What stays put for less, and was elsewhere just before or after, is only passing.
_LEAST_NS = NS_PER_S // 2


@dataclass(frozen=True, slots=True, eq=False)
class Lying:
    """A marker that lay still.

    Attributes
    ----------
    point_m : (3,), its centre in the frame of the camera.
    covariance_m2 : (3, 3), of this point by the noise of the corners; zeros where that is not known.
    height_m : above the floor, where it was measured; else 0.
    frames : how many show it there.
    start_ns, end_ns : of the first and the last of them.
    """

    marker_id: int
    point_m: Array
    covariance_m2: Array
    height_m: float = 0.0
    frames: int = 1
    start_ns: int = 0
    end_ns: int = 0


def find_lying(frames: Iterable[CameraPoints], measurements: Sequence[Measurement] = ()) -> list[Lying]:
    """All places at which markers lay still, by marker and time.

    A marker that is carried about and laid down gives a place each time: where it stays within a
    centimetre for half a second, or where a camera has seen it only there for two seconds around.

    Parameters
    ----------
    frames : the camera points of one camera.
    measurements : those that count; a marker has the height that was measured while it lay there.

    Examples
    --------
    >>> frames = [CameraPoints(n * 10**8, (CameraPoint(4, 0.1, 0.2, 2.0),)) for n in range(20)]
    >>> [(one.marker_id, one.frames) for one in find_lying(frames)]
    [(4, 20)]
    """
    seen: dict[int, list[tuple[int, CameraPoint]]] = {}
    for frame in frames:
        for point in frame.points:
            seen.setdefault(point.id, []).append((frame.timestamp + (point.time_offset_ns or 0), point))
    found = []
    for marker_id in sorted(seen):
        sightings = sorted(seen[marker_id], key=lambda sighting: sighting[0])
        for first, last in _stretches(sightings):
            here = sightings[first : last + 1]
            found.append(_lying(here, _height(marker_id, here[0][0], here[-1][0], measurements)))
    return found


def _stretches(sightings: Sequence[tuple[int, CameraPoint]]) -> Iterator[tuple[int, int]]:
    """First and last index of each stretch in which a marker did not move."""
    times_ns = np.array([time_ns for time_ns, _ in sightings], dtype=np.int64)
    points_m = np.array([(p.x_m, p.y_m, p.z_m) for _, p in sightings])
    joined = np.diff(times_ns) <= _GAP_NS
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
    return bool(np.hypot(x_m, y_m) <= _STILL_ACROSS_M and z_m <= max(_STILL_ALONG_M, _STILL_ALONG * one_m[2]))


def _lying(sightings: Sequence[tuple[int, CameraPoint]], height_m: float) -> Lying:
    points = [point for _, point in sightings]
    known_m2 = [point.covariance_m2 for point in points if point.covariance_m2 is not None]
    covariance_m2 = np.mean(known_m2, axis=0) / len(points) if known_m2 else np.zeros((3, 3))
    point_m = np.median([(p.x_m, p.y_m, p.z_m) for p in points], axis=0)
    times_ns = sightings[0][0], sightings[-1][0]
    return Lying(points[0].id, point_m, covariance_m2, height_m, len(points), *times_ns)


def _height(marker_id: int, start_ns: int, end_ns: int, measurements: Sequence[Measurement]) -> float:
    for measurement in measurements:
        still = measurement.still
        from_ns = still.start if still is not None else measurement.timestamp - _GAP_NS
        to_ns = still.end if still is not None else measurement.timestamp + _GAP_NS
        if measurement.marker_id == marker_id and from_ns <= end_ns and start_ns <= to_ns:
            point = measurement.point
            return (point.z_m if point is not None else measurement.height_m) or 0.0
    return 0.0


# Those of a fit (offline/pairs.py), above the noise of plain sub-pixel corners.
_ACROSS_M = 0.01
_ALONG_M = 0.04
# What creeps past stays within these bounds for a while, but its later half lies beside its earlier one.
# Halves of few sightings are less well known.
_DRIFT_M, _DRIFT_OF_ONE_M = 0.002, 0.004
# Slow motion looks still for shorter than this; but not if the marker was not seen before and after.
_SHORTEST_NS = NS_PER_S
# A frame in which something passes by does not end a stretch.
_SHARE_NEAR = 0.95
# Of one sighting nobody can tell.
FEWEST_FRAMES = 2


def lies_still(points_m: Array) -> bool:
    """Whether camera points (n, 3) of a marker, in order of time, are all of one place.

    Examples
    --------
    >>> lies_still(np.array([[0.1, 0.2, 2.0], [0.101, 0.2, 2.01], [0.1, 0.2, 2.0]]))
    True
    >>> lies_still(np.array([[0.1, 0.2, 2.0], [0.106, 0.2, 2.0]]))
    False
    """
    if len(points_m) < FEWEST_FRAMES:
        return False
    near = lies_at(points_m, np.median(points_m, axis=0))
    if near.mean() < _SHARE_NEAR:
        return False
    points_m = points_m[near]
    # Across the view: the noise of a depth moves a point along its ray, sideways too where that is slanted.
    rays = points_m[:, :2] / points_m[:, 2:]
    half = len(rays) // 2
    drift_m = (rays[-half:].mean(axis=0) - rays[:half].mean(axis=0)) * points_m[:, 2].mean()
    return float(np.hypot(*drift_m)) <= _DRIFT_M + _DRIFT_OF_ONE_M / math.sqrt(len(rays))


def lies_at(points_m: Array, place_m: Array) -> NDArray[np.bool_]:
    """Which camera points (n, 3) are, within their noise, at a place (3,)."""
    across_m = (points_m[:, :2] / points_m[:, 2:] - place_m[:2] / place_m[2]) * place_m[2]
    along_m = np.abs(points_m[:, 2] - place_m[2])
    near: NDArray[np.bool_] = (np.hypot(across_m[:, 0], across_m[:, 1]) <= _ACROSS_M) & (along_m <= _ALONG_M)
    return near


def still_stretches(cameras: Mapping[str, Sightings]) -> list[tuple[int, int, tuple[str, ...]]]:
    """The stretches in which one marker lies still, from what each camera saw of it, in order of time.

    Parameters
    ----------
    cameras : sightings by camera.

    Returns
    -------
    First and last time in ns, both included, and the cameras that saw it then. Stretches of several
    cameras that overlap are one: all of it, or what they have in common where one saw it move meanwhile.
    """
    found = sorted(stretch for seen in cameras.values() for stretch in _joined(seen))
    joined: list[list[tuple[int, int]]] = []
    for start_ns, end_ns in found:
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


def _seen_still(cameras: Mapping[str, Sightings], start_ns: int, end_ns: int) -> tuple[str, ...]:
    """The cameras that saw it in a stretch; none where one of them saw it move."""
    seen = []
    for camera, sightings in sorted(cameras.items()):
        points_m = _between(sightings, start_ns, end_ns)
        if len(points_m) >= FEWEST_FRAMES:
            if not lies_still(points_m):
                return ()
            seen.append(camera)
    return tuple(seen)


def _between(sightings: Sightings, start_ns: int, end_ns: int) -> Array:
    within = (sightings.times_ns >= start_ns) & (sightings.times_ns <= end_ns)
    return sightings.points_m[within]


def _joined(sightings: Sightings) -> list[tuple[int, int]]:
    """The stretches of one camera; two of one place that follow one another are one."""
    found: list[tuple[int, int]] = []
    for start_ns, end_ns in _camera_stretches(sightings):
        both = (found[-1][0], end_ns) if found else (start_ns, end_ns)
        if found and start_ns - found[-1][1] <= _GAP_NS and lies_still(_between(sightings, *both)):
            found[-1] = both
        else:
            found.append((start_ns, end_ns))
    return found


def _camera_stretches(sightings: Sightings) -> Iterator[tuple[int, int]]:
    """The stretches in which one camera sees a marker lie still."""
    times_ns, points_m = sightings.times_ns, sightings.points_m
    ends = np.append(np.flatnonzero(np.diff(times_ns) > _GAP_NS), len(times_ns) - 1) + 1
    rays = (points_m[:, :2] / points_m[:, 2:]).tolist()
    depths_m = points_m[:, 2].tolist()
    first = 0
    while first < len(times_ns):
        end = int(ends[np.searchsorted(ends, first, "right")])
        stop = _first_away(rays, depths_m, first, end)
        if stop - first < FEWEST_FRAMES or not lies_still(points_m[first:stop]):
            # A stretch that is met in its middle is followed back to its beginning.
            first += max((stop - first) // 4, 1)
            continue
        # About its middle: at the beginning the hand may still be at it.
        near = lies_at(points_m[first:end], np.median(points_m[first:stop], axis=0))
        middle = (stop - first) // 2
        begin = first + int(np.flatnonzero(np.append(True, ~near[:middle]))[-1])
        done = first + middle + int(np.flatnonzero(np.append(~near[middle:], True))[0])
        if not lies_still(points_m[begin:done]):
            begin, done = first, stop
        start_ns, end_ns = int(times_ns[begin]), int(times_ns[done - 1])
        alone = done == end and (begin == 0 or begin in ends)
        if alone or end_ns - start_ns >= _SHORTEST_NS:
            yield start_ns, end_ns
        first = max(done, stop)


def _first_away(rays: Sequence[Sequence[float]], depths_m: Sequence[float], first: int, end: int) -> int:
    """The first sighting after ``first``, before ``end``, that is not near it; ``end`` where all are."""
    (u, v), depth_m = rays[first], depths_m[first]
    for n in range(first + 1, end):
        across = (rays[n][0] - u) ** 2 + (rays[n][1] - v) ** 2
        if across * depth_m**2 > _ACROSS_M**2 or abs(depths_m[n] - depth_m) > _ALONG_M:
            return n
    return end
