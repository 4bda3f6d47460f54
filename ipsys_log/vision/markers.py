"""Square markers: prints, camera points and headings (sect. 2.1 of the paper), and the corner noise."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, CameraCalibration
from ipsys_log.vision.lenses import project
from ipsys_log.vision.poses import transform

# About 0.1 px: the error by the third derivative of a lens distortion is below 1e-7 of the slope.
_STEP = 1e-4
_STEPS = _STEP * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
# A covariance of lower rank is stored in single precision. In directions without variance, it has values of
# about 1e-7 of the largest variance, of either sign.
_NO_VARIANCE = 1e-4


def check_covariance(covariance_px2: Array, where: str) -> None:
    """Check that a covariance, of any rank, is usable in computations."""
    if not (np.isfinite(covariance_px2).all() and covariance_px2.trace() > 0):
        raise IpsysError(f"{where}: covariance_px2 has no variance; detect the markers again")


def pixel_slopes(uv: Array, lens: CameraCalibration) -> Array:
    """Return the derivatives of raw pixels with respect to normalized image coordinates.

    Parameters
    ----------
    uv : (n, 2), normalized image coordinates.
    lens : the camera's calibration.

    Returns
    -------
    (n, 2, 2): rows x and y in px, columns u and v.

    Examples
    --------
    >>> K = np.array([[1150.0, 0, 960], [0, 1140, 540], [0, 0, 1]])
    >>> lens = CameraCalibration(0, "red", 1920, 1080, "plumb_bob", np.zeros(5), K)
    >>> pixel_slopes(np.array([[0.3, 0.1]]), lens).round(3).tolist()
    [[[1150.0, 0.0], [0.0, 1140.0]]]
    """
    around = np.ones((len(uv), 4, 3))
    around[..., :2] = uv[:, None] + _STEPS
    seen_px = project(around.reshape(-1, 3), lens).reshape(-1, 4, 2)
    slopes: Array = (seen_px[:, ::2] - seen_px[:, 1::2]).swapaxes(1, 2)
    return slopes / (2 * _STEP)


def whiten(covariances_px2: Array) -> Array:
    """Return matrices that turn a marker's corners into eight independent numbers of variance 1.

    A pose that is fitted to an image gives corners with a covariance of rank 6. The fit removes the noise in
    the other two of their eight directions. These two directions distinguish one pose from another. Their
    weight must therefore not be zero, and not that of a measurement without noise. Before the fit, they had
    the same noise as the others. They get the mean variance of the others.

    Parameters
    ----------
    covariances_px2 : (n, 8, 8), of x0 y0 .. x3 y3, in px^2 (see :func:`check_covariance`).

    Returns
    -------
    (n, 8, 8), in 1 / px.

    Examples
    --------
    >>> np.abs(whiten(np.diag([0.04] * 6 + [0.0, 0.0])[None])).sum(axis=1).round(9).tolist()
    [[5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0, 5.0]]
    """
    variances, axes = np.linalg.eigh(covariances_px2)
    has = variances > _NO_VARIANCE * variances[:, -1:]
    means = (variances * has).sum(axis=1) / has.sum(axis=1)
    filled = np.where(has, variances, means[:, None])
    whitening: Array = axes.swapaxes(1, 2) / np.sqrt(filled)[..., None]
    return whitening


# Next and previous corner, in the order around the marker.
_NEXT, _BEFORE = np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2])


def camera_point(corners_uv: Array, length_m: float | Array) -> Array:
    """Return the centres, in camera coordinates, of markers that are parallel to the image plane.

    Parameters
    ----------
    corners_uv : (..., 4, 2), normalized image coordinates, in order around the marker.
    length_m : side of the marker's black square, or one for each (...), in m.

    Returns
    -------
    (..., 3): Xc right, Yc down, Zc forward, in m.

    Raises
    ------
    ValueError
        The four corners of a marker are the same point.

    References
    ----------
    Ou et al., Robotica 2023, eq. (3), (4) and (5). In the printed (4) and (5), a factor 1/4 is
    missing in the middle of the equation: Xc0 is the mean of the corners' Xc.

    Examples
    --------
    >>> uv = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]])
    >>> camera_point(uv, 0.2).round(9).tolist()
    [0.1, 0.1, 2.0]
    """
    _, lengths = _sides(corners_uv)
    perimeter = lengths.sum(axis=-1)
    if (perimeter == 0.0).any():
        raise ValueError("the four corners are at one point")
    z_m = 4.0 * length_m / perimeter  # eq. (3)
    points_m: Array = np.ones((*perimeter.shape, 3))
    points_m[..., :2] = _centre(corners_uv)
    points_m *= z_m[..., None]  # eq. (4), (5)
    return points_m


def camera_point_slopes(corners_uv: Array, length_m: float | Array) -> Array:
    """Return the derivatives of :func:`camera_point` with respect to the corners.

    Parameters
    ----------
    corners_uv : (..., 4, 2), normalized image coordinates; not all four corners of a marker the same.
    length_m : side of the marker's black square, or one for each (...), in m.

    Returns
    -------
    (..., 4, 3, 2): for each corner rows Xc, Yc, Zc in m, columns u and v.
    """
    sides, lengths = _sides(corners_uv)
    # A side without length also has no direction.
    along = sides / np.maximum(lengths, np.finfo(np.float64).tiny)[..., None]
    perimeter = lengths.sum(axis=-1)
    z_m = 4.0 * length_m / perimeter
    by_side, by_centre = (z_m / perimeter)[..., None, None], (z_m / 4)[..., None, None, None]
    slopes = np.empty((*lengths.shape, 3, 2))
    slopes[..., 2, :] = by_side * (along - along.take(_BEFORE, axis=-2))
    centre = _centre(corners_uv)[..., None, :, None]
    slopes[..., :2, :] = centre * slopes[..., 2:, :] + by_centre * np.eye(2)
    return slopes


def _sides(corners_uv: Array) -> tuple[Array, Array]:
    """Return vectors (..., 4, 2) from each corner to the next, and their lengths (..., 4)."""
    sides = corners_uv.take(_NEXT, axis=-2) - corners_uv
    return sides, np.sqrt((sides * sides).sum(axis=-1))


def _centre(corners_uv: Array) -> Array:
    # numpy's mean takes three times as long for four numbers.
    centre: Array = corners_uv.sum(axis=-2) / 4
    return centre


def heading(corners_uv: Array) -> Array:
    """Return the heading: minus the angle from corner 3 to corner 0 in the image, (...) in rad in (-pi, pi].

    Parameters
    ----------
    corners_uv : (..., 4, 2), normalized image coordinates.

    References
    ----------
    The authors' program; the paper does not define the heading.
    """
    side = corners_uv[..., 0, :] - corners_uv[..., 3, :]
    angle: Array = np.arctan2(-side[..., 1], side[..., 0])
    return angle


def marker_corners(length_m: float) -> Array:
    """Return the corners of a marker in marker coordinates, (4, 3) in m.

    In marker coordinates, x is to the right, y up and z towards the viewer. The corners have OpenCV's order:
    clockwise in the front view, from the top left.
    """
    half = length_m / 2
    return np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])


@cache
def white_cells(dictionary: str, marker_id: int) -> NDArray[np.bool_]:
    """Return a mask of the white cells of a marker, (n, n) with its black border, the top row first.

    The dictionary has OpenCV's name, such as DICT_4X4_100.
    """
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    image = cv2.aruco.generateImageMarker(known, marker_id, known.markerSize + 2, borderBits=1)
    white: NDArray[np.bool_] = np.asarray(image) > 0
    white.flags.writeable = False
    return white


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMarker:
    """A printed marker in the world.

    ``length_m`` is the side of its black square; a white margin of one cell is printed around it.
    ``world_from_marker`` is (4, 4), with the marker coordinates of
    :func:`ipsys_log.vision.markers.marker_corners`. The marker may have any orientation.
    """

    id: int
    length_m: float
    world_from_marker: Array


@dataclass(frozen=True, slots=True, eq=False)
class PlacedBoard:
    """A printed calibration board in the world.

    ``cells`` (rows, columns) is True for black cells, with the white margin, top row first. ``cell_m`` is the
    side of a cell. ``world_from_marker`` is (4, 4). The board coordinates have their origin in the centre of
    the print, x to the right, y up and z towards the viewer.
    """

    cells: NDArray[np.bool_]
    cell_m: float
    world_from_marker: Array


# A function from the time in s since the time of the frame to the print at that time.
MovingMarker = Callable[[float], PlacedMarker | PlacedBoard]


@cache
def black_cells(dictionary: str, marker_id: int) -> NDArray[np.bool_]:
    """Return a mask of the black cells of a print, (n + 2, n + 2) with the white margin, top row first."""
    black: NDArray[np.bool_] = np.pad(~white_cells(dictionary, marker_id), 1)
    black.flags.writeable = False
    return black


def printed_cells(placed: PlacedMarker | PlacedBoard, dictionary: str) -> tuple[NDArray[np.bool_], float]:
    """Return a mask of the black cells of a print, (rows, columns) with margin, and the cells per m."""
    if isinstance(placed, PlacedBoard):
        return placed.cells, 1 / placed.cell_m
    cells = black_cells(dictionary, placed.id)
    return cells, (len(cells) - 2) / placed.length_m


def print_outline(placed: PlacedMarker | PlacedBoard, dictionary: str) -> Array:
    """Return points around the edge of a print, white margin included, (32, 3) in world m."""
    cells, cells_per_m = printed_cells(placed, dictionary)
    corners = marker_corners(1 / cells_per_m) * [cells.shape[1], cells.shape[0], 1]
    step = np.linspace(0, 1, 8, endpoint=False)[None, :, None]
    sides = corners[:, None] + step * (np.roll(corners, -1, axis=0) - corners)[:, None]
    return transform(placed.world_from_marker, sides.reshape(-1, 3))


def project_corners(lens: CameraCalibration, camera_from_world: Array, placed: PlacedMarker) -> Array:
    """Return the exact pixels of the corners of the black square, without noise, in OpenCV's order.

    Returns
    -------
    (4, 2), in px, clockwise from the marker's own top left; (0, 0) is the centre of the first pixel.
    """
    camera_from_marker = camera_from_world @ placed.world_from_marker
    return project(transform(camera_from_marker, marker_corners(placed.length_m)), lens)


Point = tuple[int, int]

# Sides of a black cell in image coordinates (x right, y down), in the direction with black on the right:
# start, end, and offset of the neighbouring cell.
_SIDES = (
    ((0, 0), (1, 0), (0, -1)),
    ((1, 0), (1, 1), (1, 0)),
    ((1, 1), (0, 1), (0, 1)),
    ((0, 1), (0, 0), (-1, 0)),
)


def cell_outlines(black: NDArray[np.bool_]) -> list[NDArray[np.float64]]:
    """Trace the edges between black and white cells into closed polygons.

    Neighbouring black cells share one polygon, to avoid light seams between them in a renderer. The outlines
    of holes have the opposite direction, so the nonzero rule fills exactly the black cells.

    Parameters
    ----------
    black : (rows, columns), the top row first.

    Returns
    -------
    Polygons (n, 2): x to the right and y down, in cells from the top left; the last point is not repeated.

    Examples
    --------
    >>> [polygon.tolist() for polygon in cell_outlines(np.array([[True, True], [False, True]]))]
    [[[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [1.0, 2.0], [1.0, 1.0], [0.0, 1.0]]]
    """
    ends = _directed_edges(black)
    polygons = []
    while ends:
        start = min(ends)
        polygons.append(_corners(_walk(ends, start)))
    return polygons


def _directed_edges(black: NDArray[np.bool_]) -> dict[Point, list[Point]]:
    """Return the ends of the edges that start at each point."""
    padded = np.pad(black, 1)
    ends: dict[Point, list[Point]] = {}
    for row, column in np.argwhere(black).tolist():
        for (x1, y1), (x2, y2), (right, down) in _SIDES:
            if not padded[row + 1 + down, column + 1 + right]:
                ends.setdefault((column + x1, row + y1), []).append((column + x2, row + y2))
    return ends


def _walk(ends: dict[Point, list[Point]], start: Point) -> list[Point]:
    """Remove the edges of one polygon from ``ends``; return its points in order."""
    points, point = [start], _take(ends, start)
    while point != start:
        points.append(point)
        point = _take(ends, point)
    return points


def _take(ends: dict[Point, list[Point]], point: Point) -> Point:
    end = ends[point].pop()
    if not ends[point]:
        del ends[point]
    return end


def _corners(points: list[Point]) -> NDArray[np.float64]:
    """Return the points at which a polygon turns."""
    outline = np.array(points, dtype=np.float64)
    before, after = outline - np.roll(outline, 1, axis=0), np.roll(outline, -1, axis=0) - outline
    turns = before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]
    corners: NDArray[np.float64] = outline[turns]
    return corners
