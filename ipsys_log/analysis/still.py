"""Where markers lay still while a camera looked on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import CameraPoint, CameraPoints, Measurement
from ipsys_log.units import NS_PER_S

__all__ = ["Lying", "find_lying"]

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
