"""Calibration boards in images, by independent formulas: noisy corners and rendered images."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from ipsys_log.calibration.bundle_adjustment import Corners

Array = NDArray[np.float64]

# Parameters are fx, fy, cx, cy and the coefficients: a fisheye of 190 degrees, and pinholes, at 640 x 480 px.
SIZE_PX = (640, 480)
TRUTH = {
    "fisheye": (185.0, 185.0, 322.0, 236.0, -0.02, 0.01, -0.004, 0.0005),
    "pinhole": (600.0, 600.0, 330.0, 230.0, -0.2, 0.05, 0.001, -0.001, 0.02),
    "pinhole4": (600.0, 600.0, 330.0, 230.0, -0.2, 0.05, 0.001, -0.001, 0.0),
    "pinhole8": (450.0, 450.0, 330.0, 230.0, 0.2, 0.05, 0.001, -0.001, 0.02, 0.5, 0.1, 0.01),
}


def pixels_of(name: str, lens: tuple[float, ...], points_m: Array) -> Array:
    """Project points with the formulas of OpenCV's documentation."""
    pixels = []
    fx, fy, cx, cy, *k = lens
    for x, y, z in points_m:
        if name == "fisheye":
            theta = np.arctan2(np.hypot(x, y), z)
            bent = theta * (1 + sum(c * theta ** (2 * n) for n, c in enumerate(k, 1)))
            a, b = bent * np.array([x, y]) / np.hypot(x, y)
        else:
            k1, k2, p1, p2, k3, k4, k5, k6 = [*k, 0, 0, 0][:8]
            u, v, r2 = x / z, y / z, (x * x + y * y) / z**2
            radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
            a = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
            b = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
        pixels.append((fx * a + cx, fy * b + cy))
    return np.array(pixels)


def grid_m(columns: int = 6, rows: int = 4, square_m: float = 0.03) -> Array:
    """Return the corners of a board around its centre, row by row."""
    return np.array(
        [((i - (columns - 1) / 2) * square_m, (j - (rows - 1) / 2) * square_m, 0.0)
         for j in range(rows) for i in range(columns)]
    )  # fmt: skip


def random_pose(rng: np.random.Generator, name: str) -> tuple[Array, Array]:
    """Return the pose of a board that faces the camera, tilted by about 25 degrees."""
    tilt = Rotation.from_rotvec(np.append(rng.normal(0, 0.33, 2), rng.uniform(-0.5, 0.5)))
    if name != "fisheye":
        z = rng.uniform(0.17, 0.6)
        return tilt.as_matrix(), np.array([rng.uniform(-0.45, 0.45) * z, rng.uniform(-0.35, 0.35) * z, z])
    # The board is in any direction up to 85 degrees from the axis, and turned towards the camera.
    polar, azimuth = rng.uniform(0, np.radians(85)), rng.uniform(-np.pi, np.pi)
    aim = Rotation.from_rotvec([0, 0, azimuth]) * Rotation.from_rotvec([0, polar, 0])
    return (aim * tilt).as_matrix(), aim.apply([0, 0, rng.uniform(0.1, 0.3)])


def seen(
    name: str,
    rng: np.random.Generator,
    pictures: int = 20,
    noise_px: float = 0.1,
    shared_px: float = 0.0,
    lens: tuple[float, ...] | None = None,
    bending_m: float = 0.0,
) -> Corners:
    """Return board corners in images all over the field of view. Each corner has noise.

    The corners of an image also share an error: a smooth warp. The board is bent along its rows: its ends are
    behind its middle by ``bending_m``.
    """
    truth, flat_m = lens or TRUTH[name], grid_m()
    board_m = flat_m + np.outer((flat_m[:, 0] / flat_m[:, 0].max()) ** 2, (0, 0, bending_m))
    places = flat_m[:, :2] / flat_m[:, :2].max()
    warp = np.column_stack([places[:, 0] ** 2, places[:, 1] ** 2, places[:, 0] * places[:, 1]])
    found: list[Array] = []
    while len(found) < pictures:
        turn, place_m = random_pose(rng, name)
        pixels = pixels_of(name, truth, board_m @ turn.T + place_m)
        if (pixels < 3).any() or (pixels > np.array(SIZE_PX) - 4).any():
            continue
        shared = warp @ rng.normal(0, shared_px, (3, 2)) if shared_px else 0.0
        found.append(pixels + rng.normal(0, noise_px, pixels.shape) + shared)
    numbers = np.repeat(np.arange(pictures), len(board_m))
    return Corners(np.tile(flat_m, (pictures, 1)), np.concatenate(found), numbers, pictures)


def fisheye_rays(lens: tuple[float, ...], pixels: Array) -> Array:
    """Return unit rays of pixels, from a table of the inverted formula."""
    fx, fy, cx, cy, *k = lens
    theta = np.linspace(0, 1.9, 4000)
    bent = theta * (1 + sum(c * theta ** (2 * n) for n, c in enumerate(k, 1)))
    planar = (pixels - (cx, cy)) / (fx, fy)
    radius = np.hypot(*planar.T)
    angle = PchipInterpolator(bent, theta)(np.minimum(radius, bent[-1]))
    ring = planar / np.maximum(radius, 1e-12)[:, None]
    return np.column_stack([ring * np.sin(angle)[:, None], np.cos(angle)])


def render(
    rays: Callable[[Array], Array],
    turn: Array,
    place_m: Array,
    pattern: Callable[[Array], Array],
    size_px: tuple[int, int],
    rng: np.random.Generator,
    times: int = 3,
) -> NDArray[np.uint8]:
    """Render a plane: the mean of ``times`` x ``times`` rays in each pixel, and noise."""
    width, height = size_px
    middles = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    levels = _met(rays, turn, place_m, pattern, middles.astype(float)).reshape(height, width)
    # The position of a ray within a pixel matters only at an edge.
    edge = maximum_filter(levels, 3) != minimum_filter(levels, 3)
    y, x = np.nonzero(edge)
    offsets = (np.arange(times) + 0.5) / times - 0.5
    shifts = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    pixels = np.column_stack([x, y])[:, None] + shifts
    levels[edge] = _met(rays, turn, place_m, pattern, pixels.reshape(-1, 2)).reshape(len(x), -1).mean(axis=1)
    noisy = np.round(levels + rng.normal(0, 1.5, levels.shape))
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


def _met(
    rays: Callable[[Array], Array],
    turn: Array,
    place_m: Array,
    pattern: Callable[[Array], Array],
    pixels: Array,
) -> Array:
    """Return the grey level at the ray of each pixel (n, 2)."""
    directions = rays(pixels) @ turn  # in board coordinates
    origin = -place_m @ turn
    depth = -origin[2] / directions[:, 2]
    met = depth > 0
    levels = np.full(len(pixels), 120.0)
    levels[met] = pattern(origin[:2] + depth[met, None] * directions[met, :2])
    return levels


def chessboard_pattern(columns: int, rows: int, square_m: float) -> Callable[[Array], Array]:
    """Return grey levels at points of a chessboard with given inner corners and a white margin."""

    def levels(places_m: Array) -> Array:
        squares = places_m / square_m + np.array([columns + 1, rows + 1]) / 2
        dark = np.floor(squares).sum(axis=1) % 2 == 0
        inside = ((squares >= 0) & (squares < (columns + 1, rows + 1))).all(axis=1)
        margin = ((squares >= -0.7) & (squares < (columns + 1.7, rows + 1.7))).all(axis=1)
        return np.where(inside & dark, 40.0, np.where(margin, 200.0, 120.0))

    return levels


def striped_pattern(
    columns: int, rows: int, square_m: float, margin: float, stripe: float = 1.0, phase: float = 0.0
) -> Callable[[Array], Array]:
    """Return grey levels of a chessboard on paper over stripes along its rows. The margin is in squares.

    The stripes have the grey levels of the squares, are ``stripe`` squares wide, and are shifted by
    ``phase``.
    """
    board = chessboard_pattern(columns, rows, square_m)

    def levels(places_m: Array) -> Array:
        squares = places_m / square_m + np.array([columns + 1, rows + 1]) / 2
        paper = ((squares >= -margin) & (squares < (columns + 1 + margin, rows + 1 + margin))).all(axis=1)
        dark = np.floor((squares[:, 1] - phase) / stripe) % 2 == 0
        return np.where(paper, board(places_m), np.where(dark, 40.0, 200.0))

    return levels


def pinhole_rays(lens: tuple[float, ...], pixels: Array) -> Array:
    """Return unit rays of pixels of a pinhole camera, by OpenCV."""
    fx, fy, cx, cy, *k = lens
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    planar = cv2.undistortPoints(pixels.reshape(-1, 1, 2), matrix, np.array(k)).reshape(-1, 2)
    rays = np.column_stack([planar, np.ones(len(planar))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def photograph(
    pattern: Callable[[Array], Array],
    half_m: tuple[float, float],
    lens: tuple[float, ...],
    size_px: tuple[int, int],
    count: int,
    seed: int,
    z_m: tuple[float, float],
) -> list[NDArray[np.uint8]]:
    """Render images of a plane up to ``half_m`` from its centre, at distances between ``z_m``."""
    rng = np.random.default_rng(seed)
    pictures: list[NDArray[np.uint8]] = []
    ends = np.array([[x, y, 0.0] for x in (-half_m[0], half_m[0]) for y in (-half_m[1], half_m[1])])
    while len(pictures) < count:
        turn, _ = random_pose(rng, "pinhole")
        z = rng.uniform(*z_m)
        reach = np.array(size_px) / lens[0] / 2
        place_m = np.array([*(rng.uniform(-0.8, 0.8, 2) * reach * z), z])
        outline = pixels_of("pinhole", lens, ends @ turn.T + place_m)
        if (outline < 4).any() or (outline > np.array(size_px) - 5).any():
            continue
        picture = render(lambda at: pinhole_rays(lens, at), turn, place_m, pattern, size_px, rng)
        pictures.append(np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.6), dtype=np.uint8))
    return pictures
