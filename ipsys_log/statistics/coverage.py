"""Coverage of the floor by the fields of view, and areas where no image contains a whole marker."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from ipsys_log.messages import Array, Floor, Mask
from ipsys_log.statistics.floor_cameras import FloorGrid
from ipsys_log.vision.lenses import in_image
from ipsys_log.vision.poses import PosedCamera

# Distance between tested points of the floor; larger on a large floor,
_STEP_M = 0.01
# which has at most so many along a side.
_MOST = 800
# Tangent of the largest angle of a field of view: 79 degrees from the optical axis.
_GRAZED = 5.0
# Margin of the tested area around the foot points of cameras, without a known floor.
_AROUND_M = 2.0
# Smaller areas (less than a hand) are not reported: camera positions by tape are not accurate enough.
_LEAST_M2 = 0.01


class Overlap(NamedTuple):
    """The least width of the overlap of two neighbouring cameras, at ``at_m`` (2,).

    The direction of the width is from one camera to the other. A negative width is a gap.
    """

    cameras: tuple[str, str]
    width_m: float
    at_m: Array


class Patch(NamedTuple):
    """A connected part of the floor, from ``low_m`` to ``high_m``, (2,) each; its cells are included."""

    area_m2: float
    low_m: Array
    high_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class FloorCoverage:
    """The coverage of the floor by the cameras.

    Attributes
    ----------
    floor, height_m, diagonal_m : the floor, the height of markers above it, and the diagonal of the black
        square, which is the width that a marker needs for any heading.
    xs_m, ys_m : (a,), (b,), coordinates of the tested points of the floor.
    whole : by camera, (b, a): True if the image contains the whole marker, for any heading.
    fits : (b, a), True if the whole marker is on the floor.
    unseen : parts of the floor itself that no image contains, the largest first.
    gaps : parts of ``fits`` where no image contains the whole marker, the largest first.
    overlaps : overlaps of neighbouring cameras.
    """

    floor: Floor
    height_m: float
    diagonal_m: float
    xs_m: Array
    ys_m: Array
    whole: Mapping[str, Mask]
    fits: Mask
    unseen: tuple[Patch, ...]
    gaps: tuple[Patch, ...]
    overlaps: tuple[Overlap, ...]


def cover_floor(
    floor: Floor, cameras: Sequence[PosedCamera], marker_length_m: float, height_m: float
) -> FloorCoverage:
    """Compute the coverage of the floor at points about every centimetre.

    Parameters
    ----------
    floor : the floor, from (0, 0) to its width and depth.
    cameras : one or more cameras.
    marker_length_m : side of the black square; its corners must be in the image for any heading.
    height_m : height of the marker above the floor.

    References
    ----------
    Ou et al., Robotica 2023, sect. 3: neighbours must overlap by more than a marker.
    """
    step_m = max(_STEP_M, max(floor.width_m, floor.depth_m) / _MOST)
    diagonal_m = marker_length_m * math.sqrt(2)
    # The grid reaches beyond the edges of the floor, because a marker at an edge also needs the area there.
    rim = math.ceil(diagonal_m / 2 / step_m) + 1
    xs_m, ys_m = (_middles(size_m, step_m, rim) for size_m in _size(floor))
    inside = (slice(rim, -rim), slice(rim, -rim))
    seen = {camera.name: _seen(camera, xs_m, ys_m, height_m) for camera in cameras}
    whole = {name: _erode(mask, diagonal_m / 2 / step_m)[inside] for name, mask in seen.items()}
    ground = [_seen(camera, xs_m[rim:-rim], ys_m[rim:-rim], 0.0) for camera in cameras]
    grid = FloorGrid(xs_m[rim:-rim], ys_m[rim:-rim], step_m)
    fits = _from_edge(grid, floor) >= marker_length_m / 2
    return FloorCoverage(
        floor, height_m, diagonal_m, grid.xs_m, grid.ys_m, whole, fits,
        _patches(grid, ~np.any(ground, axis=0)),
        _patches(grid, fits & ~np.any([*whole.values()], axis=0)),
        tuple(_overlaps(grid, {name: mask[inside] for name, mask in seen.items()}, cameras)),
    )  # fmt: skip


def find_overlaps(cameras: Sequence[PosedCamera], height_m: float) -> tuple[Overlap, ...]:
    """Return the overlaps of neighbouring cameras on an unlimited floor.

    Parameters
    ----------
    cameras : cameras with extrinsics in any coordinates with the floor at z = 0.
    height_m : height of markers above the floor.
    """
    feet_m = np.array([camera.foot_m for camera in cameras])
    low_m, high_m = feet_m.min(axis=0) - _AROUND_M, feet_m.max(axis=0) + _AROUND_M
    step_m = max(_STEP_M, float((high_m - low_m).max()) / _MOST)
    xs_m, ys_m = (np.arange(a, b, step_m) for a, b in zip(low_m, high_m, strict=True))
    seen = {camera.name: _seen(camera, xs_m, ys_m, height_m) for camera in cameras}
    return tuple(_overlaps(FloorGrid(xs_m, ys_m, step_m), seen, cameras))


def _size(floor: Floor) -> tuple[float, float]:
    return floor.width_m, floor.depth_m


def _middles(size_m: float, step_m: float, rim: int) -> Array:
    """Return points along a side of the floor, with ``rim`` additional points beyond both ends."""
    return np.asarray(step_m * (np.arange(-rim, round(size_m / step_m) + rim) + 0.5), dtype=np.float64)


def _seen(camera: PosedCamera, xs_m: Array, ys_m: Array, height_m: float) -> Mask:
    """Return a mask (b, a) of the points of a grid at a height that are in the image."""
    points_m = np.stack(np.meshgrid(xs_m, ys_m, [height_m]), axis=-1).reshape(-1, 3)
    inside_m = camera.transform(points_m)
    ahead = np.hypot(inside_m[:, 0], inside_m[:, 1]) < _GRAZED * inside_m[:, 2]
    ahead[ahead] = in_image(inside_m[ahead], camera.lens)
    return np.asarray(ahead.reshape(len(ys_m), len(xs_m)))


def _erode(seen: Mask, radius: float) -> Mask:
    """Return a mask of the centres of completely visible discs; the radius is in steps."""
    if seen.all():
        return seen
    # The limit is the edge between two points, not the first invisible point.
    return np.asarray(distance_transform_edt(seen) - 0.5 >= radius)


def _from_edge(grid: FloorGrid, floor: Floor) -> Array:
    """Return the distance of each point from the edge of the floor, (b, a) in m."""
    x_m, y_m = (np.minimum(v, size - v) for v, size in zip((grid.xs_m, grid.ys_m), _size(floor), strict=True))
    return np.asarray(np.minimum(x_m, y_m[:, None]))


def _patches(grid: FloorGrid, mask: Mask) -> tuple[Patch, ...]:
    half_m = grid.step_m / 2
    parts = grid.patches(mask, _LEAST_M2)
    return tuple(Patch(part.area_m2, part.low_m - half_m, part.high_m + half_m) for part in parts)


def _values_at(grid: FloorGrid, mask: Mask, points_m: Array) -> Mask:
    """Return the values of a mask at points (..., 2); False for points outside the grid."""
    low_m = np.array([grid.xs_m[0], grid.ys_m[0]]) - grid.step_m / 2
    columns, rows = np.moveaxis(np.floor((points_m - low_m) / grid.step_m).astype(int), -1, 0)
    inside = (columns >= 0) & (columns < len(grid.xs_m)) & (rows >= 0) & (rows < len(grid.ys_m))
    return np.asarray(inside & mask[np.where(inside, rows, 0), np.where(inside, columns, 0)])


def _overlaps(grid: FloorGrid, seen: Mapping[str, Mask], cameras: Sequence[PosedCamera]) -> Iterator[Overlap]:
    feet_m = {camera.name: camera.foot_m for camera in cameras}
    for first, second in combinations(feet_m, 2):
        middle_m = (feet_m[first] + feet_m[second]) / 2
        half_m = float(np.linalg.norm(feet_m[second] - middle_m))
        others = [foot_m for name, foot_m in feet_m.items() if name not in (first, second)]
        # Two cameras are neighbours if no other camera is in the circle between them.
        if half_m > 0 and all(np.linalg.norm(foot_m - middle_m) >= half_m for foot_m in others):
            narrowest = _narrowest(grid, (seen[first], seen[second]), (feet_m[first], feet_m[second]))
            if narrowest is not None:
                yield Overlap((first, second), *narrowest)


def _narrowest(
    grid: FloorGrid, seen: tuple[Mask, Mask], feet_m: tuple[Array, Array]
) -> tuple[float, Array] | None:
    """Return the least width of the area that two cameras both see, and the point with this width.

    The widths are along lines parallel to that between the foot points of the cameras. Lines that start
    outside the field of view of a camera do not count.
    """
    apart_m = float(np.linalg.norm(feet_m[1] - feet_m[0]))
    along = (feet_m[1] - feet_m[0]) / apart_m
    reach_m = float(np.hypot(np.ptp(grid.xs_m), np.ptp(grid.ys_m)))
    aside_m = np.arange(-reach_m, reach_m, grid.step_m)
    ahead_m = np.arange(0, apart_m + reach_m, grid.step_m)
    offsets_m = aside_m[:, None, None] * np.array([-along[1], along[0]])
    ours = _values_at(grid, seen[0], feet_m[0] + offsets_m + ahead_m[None, :, None] * along)
    theirs = _values_at(grid, seen[1], feet_m[1] + offsets_m - ahead_m[None, :, None] * along)
    lines = np.flatnonzero(ours[:, 0] & theirs[:, 0])
    if not len(lines):
        return None
    # Length of the visible part of each line, from one camera towards the other, without a break.
    far, near = ((~np.pad(v[lines], ((0, 0), (0, 1)))).argmax(axis=1) * grid.step_m for v in (ours, theirs))
    widths_m = far + near - apart_m
    line = int(widths_m.argmin())
    return float(widths_m[line]), feet_m[0] + offsets_m[lines[line], 0] + (far - widths_m / 2)[line] * along
