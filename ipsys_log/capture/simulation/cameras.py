"""Cameras of the simulated lab, like those of the paper, and their images of the empty floor."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.capture.simulation.settings import FLOOR_M, HALL_SPACING_M, LabSettings, Purpose, random_stream
from ipsys_log.capture.simulation.textured_floor import read_map
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, CameraCalibration
from ipsys_log.vision.lenses import project, undistort
from ipsys_log.vision.poses import look_down, transform

# Distance of the outermost cameras from the wall. With three cameras, the distance between two is 1.59 m.
_FROM_WALL_M = 0.85
# The fields of view of a hall overlap by twice this, beside the diagonal of a marker.
_BEYOND_M = 0.1
_TRIES = 5000
# Intrinsics for images of 1920 px width. The distortion is about that of the lenses in the paper.
_FOCAL_PX = (1150.0, 1165.0)
_OFF_CENTRE_PX = 60.0
_DISTORTION = np.array([-0.13, 0.01, -0.03, 0.02])
_DISTORTION_SPREAD = np.array([0.008, 0.006, 0.006, 0.004])
_WIDEST_RAD = 1.4


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A camera with intrinsics ``lens`` and extrinsics ``camera_from_world`` (4, 4)."""

    name: str
    lens: CameraCalibration
    camera_from_world: Array

    @property
    def origin_m(self) -> Array:
        """Return the position of the camera in the world, (3,)."""
        origin: Array = -self.camera_from_world[:3, :3].T @ self.camera_from_world[:3, 3]
        return origin


def mount_cameras(settings: LabSettings, time_ns: int = 0) -> tuple[Camera, ...]:
    """Return the cameras in a row above the middle of the floor, or in the grid of a hall.

    Raises
    ------
    IpsysError
        A camera cannot see its part of the floor with any intrinsics and tilt.
    """
    if settings.grid is not None:
        return tuple(
            _mount(settings, index, middle_m, _cell_of_floor(settings, middle_m), time_ns)
            for index, middle_m in enumerate(_grid_middles(*settings.grid))
        )
    ys_m, spacing_m = row_of_cameras(len(settings.cameras))
    return tuple(
        _mount(settings, index, (FLOOR_M / 2, y_m), _part_of_floor(settings, y_m, spacing_m), time_ns)
        for index, y_m in enumerate(ys_m.tolist())
    )


def row_of_cameras(count: int) -> tuple[Array, float]:
    """Return the y of cameras in a row above the floor, (count,), and the distance of two of them, in m."""
    spacing_m = (FLOOR_M - 2 * _FROM_WALL_M) / max(count - 1, 2)
    ys_m = np.asarray(FLOOR_M / 2 + spacing_m * (np.arange(count) - (count - 1) / 2), dtype=np.float64)
    return ys_m, spacing_m


def _grid_middles(columns: int, rows: int) -> list[tuple[float, float]]:
    """Return the middles of the parts of the floor, column after column, in m."""
    return [
        ((column + 0.5) * HALL_SPACING_M[0], (row + 0.5) * HALL_SPACING_M[1])
        for column in range(columns)
        for row in range(rows)
    ]


def sees(camera: Camera, points_m: Array) -> NDArray[np.bool_]:
    """Return a mask (n,) of the world points, (n, 3) in m, that are in the image."""
    points_c = transform(camera.camera_from_world, points_m)
    # Outside the widest angle, the polynomial of the lens distortion is not valid.
    in_front = np.hypot(points_c[:, 0], points_c[:, 1]) < np.tan(_WIDEST_RAD) * points_c[:, 2]
    px = project(np.where(in_front[:, None], points_c, [0.0, 0.0, 1.0]), camera.lens)
    last = np.array([camera.lens.width - 1, camera.lens.height - 1])
    inside: NDArray[np.bool_] = in_front & (px >= 0).all(axis=1) & (px <= last).all(axis=1)
    return inside


def _mount(
    settings: LabSettings, index: int, place_m: tuple[float, float], wanted_m: Array, time_ns: int
) -> Camera:
    """Draw intrinsics and poses of a camera until it sees all wanted points."""
    rng = random_stream(settings.seed, Purpose.CAMERA, index)
    name = settings.cameras[index]
    for _ in range(_TRIES):
        lens = draw_lens(rng, settings, name, time_ns)
        tilt = np.radians(rng.uniform(*settings.tilt_deg))
        towards = rng.uniform(0, 2 * np.pi)
        tilt_rad = tilt * np.array([np.cos(towards), np.sin(towards), 0.0])
        nudge_m = rng.uniform(-1, 1, 3) * [0.02, 0.02, 0.04]
        origin_m = np.array([*place_m, settings.mount_height_m]) + nudge_m
        camera = Camera(name, lens, look_down(origin_m, tilt_rad))
        if reaches(lens) and sees(camera, wanted_m).all():
            return camera
    raise IpsysError(
        f"simulator: camera {name!r} cannot see its part of the floor from {settings.mount_height_m:g} m "
        f"with a tilt of {settings.tilt_deg[0]:g} to {settings.tilt_deg[1]:g} degrees; "
        "tilt it less, hang it higher, or use a frame of 16:9 and lower markers"
    )


def _part_of_floor(settings: LabSettings, y_m: float, spacing_m: float) -> Array:
    """Return the points that a camera must see: its strip of the floor, and the overlap above it.

    The overlap is at the greatest height. It reaches half the diagonal of a marker beyond the middle between
    two cameras.
    """
    across = np.linspace(0, FLOOR_M, 13)
    along = np.clip(y_m + _FROM_WALL_M * np.linspace(-1, 1, 5), 0, FLOOR_M)
    top_m = max(*settings.heights_m, settings.drive_height_m)
    reach_m = spacing_m / 2 + settings.marker_length_m / np.sqrt(2)
    # A raised marker near a wall may be outside the image. The selection of calibration points avoids such
    # markers.
    across_top = np.linspace(0.15 * FLOOR_M, 0.85 * FLOOR_M, 9)
    along_top = y_m + reach_m * np.linspace(-1, 1, 3)
    low = np.stack(np.meshgrid(across, along, [0.0]), axis=-1).reshape(-1, 3)
    high = np.stack(np.meshgrid(across_top, along_top, [top_m]), axis=-1).reshape(-1, 3)
    return np.vstack([low, high])


def _cell_of_floor(settings: LabSettings, middle_m: tuple[float, float]) -> Array:
    """Return the points that a camera of a hall must see: the edge of its part of the floor, with an overlap.

    The overlap is at the greatest height.
    """
    top_m = max(*settings.heights_m, settings.drive_height_m)
    beyond_m = settings.marker_length_m / np.sqrt(2) + _BEYOND_M
    reach_m = np.array(HALL_SPACING_M) / 2 + beyond_m
    share = np.linspace(-1, 1, 9)
    edge = np.array([(x, y) for x in share for y in share if max(abs(x), abs(y)) == 1])
    flat_m = np.clip(middle_m + edge * reach_m, 0.0, settings.floor_m)
    return np.column_stack([flat_m, np.full(len(flat_m), top_m)])


def draw_lens(rng: np.random.Generator, settings: LabSettings, name: str, time_ns: int) -> CameraCalibration:
    """Draw the intrinsics of a camera; their distortion is about that of the lenses in the paper."""
    scale = settings.width / 1920
    fx = scale * rng.uniform(*_FOCAL_PX)
    fy = fx * rng.uniform(0.998, 1.002)
    cx, cy = (np.array([settings.width, settings.height]) - 1) / 2 + scale * _OFF_CENTRE_PX * rng.uniform(
        -1, 1, 2
    )
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    D = _DISTORTION + _DISTORTION_SPREAD * rng.uniform(-1, 1, 4)
    P = np.hstack([K, np.zeros((3, 1))])
    return CameraCalibration(
        time_ns, name, settings.width, settings.height, "kannala_brandt", D, K, np.eye(3), P
    )


def reaches(lens: CameraCalibration) -> bool:
    """Return whether the lens distortion is monotone up to an angle outside the image."""
    theta = np.linspace(0, _WIDEST_RAD, 200)
    powers = theta[:, None] ** np.array([2, 4, 6, 8])
    slope = 1 + powers @ (np.array([3, 5, 7, 9]) * lens.D)
    widest = theta[-1] * (1 + powers[-1] @ lens.D)
    frame = np.array([[0, 0], [lens.width, 0], [0, lens.height], [lens.width, lens.height]])
    corner = np.linalg.norm((frame - lens.K[:2, 2]) / lens.K.diagonal()[:2], axis=1).max()
    return bool(slope.min() > 0.1 and widest > 1.05 * corner)


Plane = NDArray[np.float32]
# A callback between two steps of long work; its exceptions end the work.
Check = Callable[[], None]

# Rows in a step of the work. Small steps allow a fast interrupt, and their data stays in the caches.
_ROWS = 64

_BOARD_M = np.array([1.2192, 2.4384])
_BOARDS = (4, 2)
_SEAM_M = 0.003
_TILE = 1024
_TILE_M = 2.6


def pixel_rays(lens: CameraCalibration, border_px: int, check: Check = lambda: None) -> Array:
    """Return the normalized image coordinates of all pixels and of a border around them.

    Parameters
    ----------
    lens, border_px : intrinsics of the camera; width of the border.
    check : called between the steps; its exceptions end the work.

    Returns
    -------
    (height + 2 border, width + 2 border, 2), without unit; (0, 0) px is at [border, border].
    """
    x = np.arange(-border_px, lens.width + border_px, dtype=np.float64)
    y = np.arange(-border_px, lens.height + border_px, dtype=np.float64)
    rays = np.empty((len(y), len(x), 2))
    for first in range(0, len(y), _ROWS):
        check()
        pixels = np.stack(np.meshgrid(x, y[first : first + _ROWS]), axis=-1)
        rays[first : first + _ROWS] = undistort(pixels.reshape(-1, 2), lens).reshape(pixels.shape)
    return rays


def lay_floor(settings: LabSettings, camera: Camera, rays: Array, check: Check = lambda: None) -> Plane:
    """Return the grey levels of the empty floor, (h, w), for the rays of a camera (h, w, 2).

    ``check`` is called between the steps; its exceptions end the work.
    """
    floor = np.empty(rays.shape[:2], dtype=np.float32)
    for first in range(0, len(rays), _ROWS):
        check()
        # The rows before and after are necessary: the width of a pixel on the floor is a difference between
        # rows.
        start = max(first - 1, 0)
        rows = _lay_rows(settings, camera, rays[start : first + _ROWS + 1])
        floor[first : first + _ROWS] = rows[first - start :][:_ROWS]
    return floor


def _lay_rows(settings: LabSettings, camera: Camera, rays: Array) -> Plane:
    axes = camera.camera_from_world[:3, :3]
    x, y, z = (rays[..., 0] * axes[0, i] + rays[..., 1] * axes[1, i] + axes[2, i] for i in range(3))
    origin_m = camera.origin_m
    reach = origin_m[2] / np.maximum(-z, 1e-3)
    x_m, y_m = origin_m[0] + x * reach, origin_m[1] + y * reach
    # Width of a pixel on the floor: finer details have less contrast.
    pixel_m = np.maximum(np.abs(np.gradient(x_m, axis=1)), np.abs(np.gradient(y_m, axis=0)))
    across, along = x_m / _BOARD_M[0], y_m / _BOARD_M[1]
    columns, rows = _count_boards(settings)
    on_boards = (across >= 0) & (across <= columns) & (along >= 0) & (along <= rows)
    boards = _boards(settings, x_m, y_m) * _seams(across, along, pixel_m)
    concrete = 0.62 * settings.floor + 4.0 * _noise_at(settings, 1, x_m, y_m, 1.0)
    if settings.textured:
        boards = concrete = read_map(settings, x_m, y_m) + boards - settings.floor
    # The lamps are above the middle of the floor; a hall has more of them.
    shares = np.array(settings.floor_m) / FLOOR_M
    bright_m, fading = (2.2, 2.8) * shares, 0.012 / shares.max() ** 2
    fade = 1.0 - fading * ((x_m - bright_m[0]) ** 2 + (y_m - bright_m[1]) ** 2)
    level = np.where(on_boards, boards, concrete) * np.clip(fade, 0.5, 1.0)
    return np.asarray(np.clip(level, 1.0, 255.0), dtype=np.float32)


def _count_boards(settings: LabSettings) -> tuple[int, int]:
    if settings.grid is None:
        return _BOARDS
    columns, rows = np.ceil(settings.floor_m / _BOARD_M).astype(int).tolist()
    return columns, rows


def _boards(settings: LabSettings, x_m: Array, y_m: Array) -> Array:
    """Return grey levels of wood with its grain along y; each board has its own shade and grain."""
    rng = random_stream(settings.seed, Purpose.FLOOR, 0)
    boards = _count_boards(settings)
    shades, shifts_m = rng.uniform(-5, 5, boards), rng.uniform(0, _TILE_M, boards)
    column = np.clip((x_m / _BOARD_M[0]).astype(int), 0, boards[0] - 1)
    row = np.clip((y_m / _BOARD_M[1]).astype(int), 0, boards[1] - 1)
    shift_m = shifts_m[column, row]
    # A slow oscillation bends the grain.
    bent_m = x_m + 0.012 * np.sin(2.3 * y_m + 5 * shift_m) + shift_m
    grain = _noise_at(settings, 2, bent_m, y_m + shift_m, 18.0)
    fine = _noise_at(settings, 3, 3 * bent_m, y_m - shift_m, 30.0)
    level: Array = settings.floor + shades[column, row] + 3.5 * grain + 2.0 * fine
    return level


def _seams(across: Array, along: Array, pixel_m: Array) -> Array:
    """Return the share of the light that remains in the gaps between boards, (h, w)."""
    to_x_m = np.abs(across - np.round(across)) * _BOARD_M[0]
    to_y_m = np.abs(along - np.round(along)) * _BOARD_M[1]
    width_m = np.maximum(_SEAM_M, pixel_m)
    gap = np.exp(-0.5 * (np.minimum(to_x_m, to_y_m) / (width_m / 2)) ** 2)
    share: Array = 1.0 - 0.45 * _SEAM_M / width_m * gap
    return share


def _noise_at(settings: LabSettings, which: int, x_m: Array, y_m: Array, stretch: float) -> Array:
    """Return smooth noise of unit variance, repeated without a seam, ``stretch`` times as long in y."""
    map_x = (x_m * (_TILE / _TILE_M) % _TILE).astype(np.float32)
    map_y = (y_m * (_TILE / _TILE_M / stretch) % _TILE).astype(np.float32)
    tile = _noise_tile(settings.seed, which)
    return np.asarray(cv2.remap(tile, map_x, map_y, cv2.INTER_LINEAR), dtype=np.float64)


@lru_cache(maxsize=4)
def _noise_tile(seed: int, which: int) -> Plane:
    """Return the tile that :func:`_noise_at` repeats; all cameras of a lab share it."""
    white = random_stream(seed, Purpose.FLOOR, which).standard_normal((_TILE, _TILE))
    # The filter is a convolution on the torus, so the tile repeats without a seam.
    fy, fx = np.fft.fftfreq(_TILE)[:, None], np.fft.rfftfreq(_TILE)[None, :]
    soft = np.exp(-2 * (np.pi * 1.2) ** 2 * ((fx) ** 2 + (fy) ** 2)) / (1 + 60 * np.hypot(fx, fy))
    tile = np.fft.irfft2(np.fft.rfft2(white) * soft, s=white.shape)
    tile = ((tile - tile.mean()) / tile.std()).astype(np.float32)
    # Additional wrapped columns and rows keep the interpolation away from the edge of the tile.
    wrapped = np.pad(tile, ((0, 2), (0, 2)), mode="wrap")
    wrapped.flags.writeable = False
    return wrapped


# Difference in size between the noise field and an image.
FIELD_PX = 192


@dataclass(frozen=True, slots=True, eq=False)
class FloorView:
    """The constant data of the frames of a camera.

    ``rays`` (h + 2 border, w + 2 border, 2) are normalized coordinates of pixels. ``floor`` (h, w) is the
    light from the empty floor behind the optics. ``noise`` is a noise field that is 192 px larger than an
    image in both directions; each frame uses another part of it. ``bare`` (h, w) is the share of the floor in
    each pixel, if stationary prints cover a part of the floor.
    """

    camera: Camera
    border_px: int
    rays: Array
    floor: Plane
    noise: Plane
    bare: Plane | None = None


def prepare_view(camera: Camera, settings: LabSettings, check: Check = lambda: None) -> FloorView:
    """Compute all data of a camera's frames that do not depend on the markers."""
    border_px = int(np.ceil(4 * settings.psf_sigma_px)) + 2
    rays = pixel_rays(camera.lens, border_px, check)
    behind = to_light(lay_floor(settings, camera, rays, check), settings)
    check()
    if settings.psf_sigma_px:
        behind = cv2.GaussianBlur(behind, (0, 0), settings.psf_sigma_px).astype(np.float32)
    inner = slice(border_px, -border_px)
    index = settings.cameras.index(camera.name) if camera.name in settings.cameras else len(settings.cameras)
    rng = random_stream(settings.seed, Purpose.NOISE_FIELD, index)
    size = (camera.lens.height + FIELD_PX, camera.lens.width + FIELD_PX)
    noise = rng.standard_normal(size, dtype=np.float32) * np.float32(settings.noise_sigma)
    return FloorView(camera, border_px, rays, np.ascontiguousarray(behind[inner, inner]), noise)


def to_light(levels: Plane | np.float32, settings: LabSettings) -> Plane:
    """Return the light of grey levels, both from 0 to 255."""
    return np.asarray(255.0 * (levels / 255.0) ** settings.gamma, dtype=np.float32)
