"""Which part of the floor the cameras see, and where a marker is whole in none of their pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, find_objects, label

from ipsys_log.geometry.lenses import in_picture
from ipsys_log.geometry.poses import invert_pose, transform
from ipsys_log.messages import CameraCalibration, Floor

__all__ = ["Coverage", "Hung", "Overlap", "Patch", "cover_floor", "find_overlaps"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Between the points of the floor that are looked at, and the most of them along a side.
_STEP_M, _MOST = 0.01, 800
# No picture reaches further: 79 degrees from its axis.
_GRAZED = 5.0
# So far around the feet of cameras neighbours are looked for, where no floor is known.
_AROUND_M = 2.0
# What is smaller than a hand is not spoken of: no tape places a camera that well.
_LEAST_M2 = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Hung:
    """A camera in its place: ``camera_from_world`` is (4, 4)."""

    camera: str
    lens: CameraCalibration
    camera_from_world: Array

    @property
    def foot_m(self) -> Array:
        """The point of the floor beneath it, (2,)."""
        return np.asarray(invert_pose(self.camera_from_world)[:2, 3])


class Overlap(NamedTuple):
    """How wide two neighbours overlap where they do so least, at ``at_m`` (2,), from the one towards the
    other; below 0 where they leave a gap."""

    cameras: tuple[str, str]
    width_m: float
    at_m: Array


class Patch(NamedTuple):
    """A connected part of the floor, from ``low_m`` to ``high_m``, (2,) each."""

    area_m2: float
    low_m: Array
    high_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """The floor as the cameras see it.

    Attributes
    ----------
    floor, height_m, diagonal_m : what was looked at: the floor, the height of markers above it, and the
        width that a marker needs whatever its heading, the diagonal of its black square.
    xs_m, ys_m : (a,), (b,), the points of the floor that were looked at.
    whole : by camera, (b, a): where a marker of any heading is whole in its picture.
    fits : (b, a), where a marker lies on the floor with all of it.
    unseen : parts of the floor itself that are in no picture, the largest first.
    broken : parts of ``fits`` where a marker is whole in no picture, the largest first.
    overlaps : of neighbours.
    """

    floor: Floor
    height_m: float
    diagonal_m: float
    xs_m: Array
    ys_m: Array
    whole: Mapping[str, Mask]
    fits: Mask
    unseen: tuple[Patch, ...]
    broken: tuple[Patch, ...]
    overlaps: tuple[Overlap, ...]


def cover_floor(floor: Floor, cameras: Sequence[Hung], marker_length_m: float, height_m: float) -> Coverage:
    """Look at the floor point by point, about every centimetre.

    Parameters
    ----------
    floor : from (0, 0) to its width and depth.
    cameras : one or more.
    marker_length_m : side of the black square; its corners must lie in the picture at any heading.
    height_m : of the marker above the floor.

    References
    ----------
    Ou et al., Robotica 2023, sect. 3: neighbours must overlap by more than a marker.
    """
    step_m = max(_STEP_M, max(floor.width_m, floor.depth_m) / _MOST)
    diagonal_m = marker_length_m * math.sqrt(2)
    # Beyond the edges too: a marker at an edge is whole only if what lies there is in the picture.
    rim = math.ceil(diagonal_m / 2 / step_m) + 1
    xs_m, ys_m = (_middles(size_m, step_m, rim) for size_m in _size(floor))
    inside = (slice(rim, -rim), slice(rim, -rim))
    seen = {one.camera: _seen(one, xs_m, ys_m, height_m) for one in cameras}
    whole = {name: _erode(mask, diagonal_m / 2 / step_m)[inside] for name, mask in seen.items()}
    ground = [_seen(one, xs_m[rim:-rim], ys_m[rim:-rim], 0.0) for one in cameras]
    grid = _Grid(xs_m[rim:-rim], ys_m[rim:-rim], step_m)
    fits = grid.from_edge(floor) >= marker_length_m / 2
    return Coverage(
        floor, height_m, diagonal_m, grid.xs_m, grid.ys_m, whole, fits,
        grid.patches(~np.any(ground, axis=0)),
        grid.patches(fits & ~np.any([*whole.values()], axis=0)),
        tuple(_overlaps(grid, {name: mask[inside] for name, mask in seen.items()}, cameras)),
    )  # fmt: skip


def find_overlaps(cameras: Sequence[Hung], height_m: float) -> tuple[Overlap, ...]:
    """How wide neighbours overlap, wherever the floor may end.

    Parameters
    ----------
    cameras : their places in any frame with the floor at z = 0.
    height_m : of markers above the floor.
    """
    feet_m = np.array([one.foot_m for one in cameras])
    low_m, high_m = feet_m.min(axis=0) - _AROUND_M, feet_m.max(axis=0) + _AROUND_M
    step_m = max(_STEP_M, float((high_m - low_m).max()) / _MOST)
    xs_m, ys_m = (np.arange(a, b, step_m) for a, b in zip(low_m, high_m, strict=True))
    seen = {one.camera: _seen(one, xs_m, ys_m, height_m) for one in cameras}
    return tuple(_overlaps(_Grid(xs_m, ys_m, step_m), seen, cameras))


def _size(floor: Floor) -> tuple[float, float]:
    return floor.width_m, floor.depth_m


def _middles(size_m: float, step_m: float, rim: int) -> Array:
    """Points along a side of the floor, and so many beyond both its ends."""
    return np.asarray(step_m * (np.arange(-rim, round(size_m / step_m) + rim) + 0.5), dtype=np.float64)


def _seen(camera: Hung, xs_m: Array, ys_m: Array, height_m: float) -> Mask:
    """Which points of a grid at a height are in the picture, (b, a)."""
    points_m = np.stack(np.meshgrid(xs_m, ys_m, [height_m]), axis=-1).reshape(-1, 3)
    inside_m = transform(camera.camera_from_world, points_m)
    ahead = np.hypot(inside_m[:, 0], inside_m[:, 1]) < _GRAZED * inside_m[:, 2]
    ahead[ahead] = in_picture(inside_m[ahead], camera.lens)
    return np.asarray(ahead.reshape(len(ys_m), len(xs_m)))


def _erode(seen: Mask, radius: float) -> Mask:
    """Where a disc, its radius in steps, is seen whole."""
    if seen.all():
        return seen
    # To the edge between two points, not to the first one that is not seen.
    return np.asarray(distance_transform_edt(seen) - 0.5 >= radius)


class _Grid(NamedTuple):
    xs_m: Array
    ys_m: Array
    step_m: float

    def from_edge(self, floor: Floor) -> Array:
        """How far each point is from the edge of the floor, (b, a)."""
        x_m, y_m = (
            np.minimum(v, size - v) for v, size in zip((self.xs_m, self.ys_m), _size(floor), strict=True)
        )
        return np.asarray(np.minimum(x_m, y_m[:, None]))

    def patches(self, mask: Mask) -> tuple[Patch, ...]:
        labels, _ = label(mask, np.ones((3, 3)))
        found, half_m = [], self.step_m / 2
        for number, (rows, columns) in enumerate(find_objects(labels), 1):
            area_m2 = float((labels[rows, columns] == number).sum()) * self.step_m**2
            x_m, y_m = self.xs_m[columns], self.ys_m[rows]
            low_m, high_m = np.array([x_m[0], y_m[0]]) - half_m, np.array([x_m[-1], y_m[-1]]) + half_m
            found.append(Patch(area_m2, low_m, high_m))
        return tuple(sorted((p for p in found if p.area_m2 >= _LEAST_M2), key=lambda p: -p.area_m2))

    def at(self, mask: Mask, points_m: Array) -> Mask:
        """A mask at points (..., 2); what lies beyond the floor is not in it."""
        low_m = np.array([self.xs_m[0], self.ys_m[0]]) - self.step_m / 2
        columns, rows = np.moveaxis(np.floor((points_m - low_m) / self.step_m).astype(int), -1, 0)
        there = (columns >= 0) & (columns < len(self.xs_m)) & (rows >= 0) & (rows < len(self.ys_m))
        return np.asarray(there & mask[np.where(there, rows, 0), np.where(there, columns, 0)])


def _overlaps(grid: _Grid, seen: Mapping[str, Mask], cameras: Sequence[Hung]) -> Iterator[Overlap]:
    feet_m = {one.camera: one.foot_m for one in cameras}
    for first, second in combinations(feet_m, 2):
        middle_m = (feet_m[first] + feet_m[second]) / 2
        half_m = float(np.linalg.norm(feet_m[second] - middle_m))
        others = [foot_m for name, foot_m in feet_m.items() if name not in (first, second)]
        # Neighbours: no other camera in the circle between them.
        if half_m > 0 and all(np.linalg.norm(foot_m - middle_m) >= half_m for foot_m in others):
            found = _narrowest(grid, (seen[first], seen[second]), (feet_m[first], feet_m[second]))
            if found is not None:
                yield Overlap((first, second), *found)


def _narrowest(
    grid: _Grid, seen: tuple[Mask, Mask], feet_m: tuple[Array, Array]
) -> tuple[float, Array] | None:
    """The least width that two cameras both see between them, along lines from foot to foot, and where.

    Lines that lie beyond what a camera sees abreast of itself say nothing of the overlap.
    """
    apart_m = float(np.linalg.norm(feet_m[1] - feet_m[0]))
    along = (feet_m[1] - feet_m[0]) / apart_m
    reach_m = float(np.hypot(np.ptp(grid.xs_m), np.ptp(grid.ys_m)))
    aside_m = np.arange(-reach_m, reach_m, grid.step_m)
    ahead_m = np.arange(0, apart_m + reach_m, grid.step_m)
    offsets_m = aside_m[:, None, None] * np.array([-along[1], along[0]])
    one = grid.at(seen[0], feet_m[0] + offsets_m + ahead_m[None, :, None] * along)
    other = grid.at(seen[1], feet_m[1] + offsets_m - ahead_m[None, :, None] * along)
    lines = np.flatnonzero(one[:, 0] & other[:, 0])
    if not len(lines):
        return None
    # How far each sees towards the other without a break.
    far, near = ((~np.pad(v[lines], ((0, 0), (0, 1)))).argmax(axis=1) * grid.step_m for v in (one, other))
    widths_m = far + near - apart_m
    line = int(widths_m.argmin())
    return float(widths_m[line]), feet_m[0] + offsets_m[lines[line], 0] + (far - widths_m / 2)[line] * along
