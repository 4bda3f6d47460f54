"""Rendered images of printed markers on a floor, with edges exact to a few thousandths of a pixel.

A print is piecewise constant. The module draws it with four by four samples per pixel. The exact inverse of
the lens distortion projects each sample onto the plane of the marker. The value of a sample is the mean of
the pattern over the footprint of the sample, so edges along pixel rows are exact too. The blur of the optics
acts on the samples. A pixel is the mean of its sixteen samples.

A moving print is drawn like this at many instants of the exposure. Each row of pixels is its own weighted
mean of these instants.

The time of a frame is the middle of the exposure of its first row, row 0. The exposure of row r has the
length ``exposure_s``, and its middle is ``r * row_time_ns`` later. Between two drawn instants, the image of a
moving print changes linearly.

The blurred coverage of each print is the weight of its light against the light of the floor. Gamma, noise
and rounding follow.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.capture.simulation.cameras import FIELD_PX, FloorView, Plane, to_light
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import Array
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import MovingMarker, PlacedBoard, PlacedMarker, print_outline, printed_cells
from ipsys_log.vision.poses import transform

# Largest motion of a print between two instants without motion blur.
_STEP_PX = 0.125
# An exposure without motion.
_SHORTEST_S = 1e-9


def exposure_interval(first_row: int, last_row: int, settings: LabSettings) -> tuple[float, float]:
    """Return start and end of the exposure of rows, in s after the time of the frame."""
    row_s, half_s = settings.row_time_ns / NS_PER_S, settings.exposure_s / 2
    return first_row * row_s - half_s, last_row * row_s + half_s


def sample_times(start_s: float, end_s: float, speed_px_s: float, settings: LabSettings) -> Array:
    """Return evenly spaced times (n,) in s from start to end, with small steps of a motion.

    Without motion, return one time.

    Parameters
    ----------
    start_s, end_s : start and end of the exposure, in s after the time of the frame.
    speed_px_s : speed of the fastest point.
    settings : the length of an exposure.
    """
    # A motion in steps has errors only at the start and the end of its blur. As a share of the light, they
    # grow with the square of the step and fall with the length of the blur.
    step_px = _STEP_PX * np.sqrt(1 + speed_px_s * settings.exposure_s)
    steps = int(np.ceil((end_s - start_s) * speed_px_s / step_px))
    return np.linspace(start_s, end_s, steps + 1) if steps else np.array([(start_s + end_s) / 2])


def row_shares(times_s: Array, rows: NDArray[np.int_], settings: LabSettings) -> Array:
    """Return the weight of each instant in the mean over the exposure of each row.

    Parameters
    ----------
    times_s : (n,) from :func:`sample_times`.
    rows : (m,), row numbers; 0 is the first row of the frame.
    settings : row time and length of an exposure.

    Returns
    -------
    (n, m). The weights of a row add up to 1 if its exposure is between the first and the last instant.

    Examples
    --------
    >>> lab = LabSettings(row_time_ns=500_000)
    >>> row_shares(np.array([0.0, 0.002]), np.array([0, 1, 4]), lab).round(6)
    array([[1.  , 0.75, 0.  ],
           [0.  , 0.25, 1.  ]])
    """
    if len(times_s) == 1:
        return np.ones((1, len(rows)))
    step_s = times_s[1] - times_s[0]
    exposure_s = max(settings.exposure_s, _SHORTEST_S)
    middles_s = rows * (settings.row_time_ns / NS_PER_S) - times_s[:, None]
    # The weight of an instant decreases linearly to 0 at its neighbours: integrate this hat function, in
    # units of steps.
    start, end = (np.clip((middles_s + side * exposure_s / 2) / step_s, -1, 1) for side in (-1, 1))
    shares: Array = (end - end * np.abs(end) / 2 - start + start * np.abs(start) / 2) * step_s / exposure_s
    return shares


Box = tuple[slice, slice]

_SAMPLES = 4
# With this number of instants in the time of a frame, the motion between two instants is nearly straight.
_PATH_INSTANTS = 9


@dataclass(frozen=True, slots=True, eq=False)
class Shares:
    """Shares of light in a box of ``FloorView.rays``: ``cover`` of a print, ``dark`` of its black, (h, w)."""

    box: Box
    cover: Plane
    dark: Plane


def find_shares(
    view: FloorView, placed: PlacedMarker | PlacedBoard | MovingMarker, settings: LabSettings
) -> Shares | None:
    """Return the shares of a print; None if the print is not in the image."""
    if isinstance(placed, (PlacedMarker, PlacedBoard)):
        return _still(view, placed, settings)
    if not (settings.row_time_ns or settings.exposure_s):
        return _still(view, placed(0.0), settings)
    return _moving(view, placed, settings)


def _still(view: FloorView, placed: PlacedMarker | PlacedBoard, settings: LabSettings) -> Shares | None:
    box = _box_of(view, placed, settings)
    return None if box is None else Shares(box, *_print_shares(view, placed, box, settings))


def _moving(view: FloorView, moving: MovingMarker, settings: LabSettings) -> Shares | None:
    """Return the shares of a moving print: in each row, the mean over the exposure of the row."""
    path = _path(view, moving, settings)
    if path is None:
        return None
    whole, speed_px_s = path
    rows = np.arange(whole[0].start, whole[0].stop) - view.border_px
    seen = np.clip(rows[[0, -1]], 0, view.camera.lens.height - 1).tolist()
    times_s = sample_times(*exposure_interval(seen[0], seen[1], settings), speed_px_s, settings)
    cover, dark = np.zeros((2, len(rows), whole[1].stop - whole[1].start), dtype=np.float32)
    for time_s, weights in zip(times_s.tolist(), row_shares(times_s, rows, settings), strict=True):
        placed = moving(time_s)
        box = _part(_box_of(view, placed, settings), whole, weights, settings)
        if box is None:
            continue
        inside = tuple(slice(s.start - w.start, s.stop - w.start) for s, w in zip(box, whole, strict=True))
        weight = weights[inside[0], None].astype(np.float32)
        for total, share in zip((cover, dark), _print_shares(view, placed, box, settings), strict=True):
            total[inside] += weight * share
    return Shares(whole, cover, dark)


def _path(view: FloorView, moving: MovingMarker, settings: LabSettings) -> tuple[Box, float] | None:
    """Return the box of a moving print during a frame, and the speed of its fastest point in px/s."""
    start_s, end_s = exposure_interval(0, view.camera.lens.height - 1, settings)
    outlines_px = []
    for time_s in np.linspace(start_s, end_s, _PATH_INSTANTS).tolist():
        outline_px = _outline_px(view, moving(time_s), settings)
        if outline_px is None:
            return None
        outlines_px.append(outline_px)
    box = _box(view, np.concatenate(outlines_px), settings)
    steps_px = np.linalg.norm(np.diff(outlines_px, axis=0), axis=-1)
    return None if box is None else (box, float(steps_px.max()) * (_PATH_INSTANTS - 1) / (end_s - start_s))


def _part(box: Box | None, whole: Box, weights: Array, settings: LabSettings) -> Box | None:
    """Return the part of a box with rows of nonzero weight and the rows that blur into them, or None.

    ``weights`` (h,) are the weights of the rows of ``whole``.
    """
    counted = whole[0].start + np.flatnonzero(weights)
    if box is None or not len(counted) or counted[-1] < box[0].start or counted[0] >= box[0].stop:
        return None
    around = _around_px(settings)
    first, last = int(counted[0]) - around, int(counted[-1]) + around
    return (
        slice(max(box[0].start, whole[0].start, first), min(box[0].stop, whole[0].stop, last + 1)),
        slice(max(box[1].start, whole[1].start), min(box[1].stop, whole[1].stop)),
    )


def _box_of(view: FloorView, placed: PlacedMarker | PlacedBoard, settings: LabSettings) -> Box | None:
    outline_px = _outline_px(view, placed, settings)
    return None if outline_px is None else _box(view, outline_px, settings)


def _outline_px(view: FloorView, placed: PlacedMarker | PlacedBoard, settings: LabSettings) -> Array | None:
    """Return points around a print, (n, 2) in px; None if some of them are not in front of the camera."""
    outline_m = print_outline(placed, settings.dictionary)
    outline_m = transform(view.camera.camera_from_world, outline_m)
    return None if (outline_m[:, 2] <= 0).any() else project(outline_m, view.camera.lens)


def _around_px(settings: LabSettings) -> int:
    """Return the reach of the blur in px."""
    return int(np.ceil(4 * settings.psf_sigma_px)) + 2


def _box(view: FloorView, px: Array, settings: LabSettings) -> Box | None:
    """Return rows and columns of ``view.rays`` around points (n, 2), with blur; None outside the image."""
    around = _around_px(settings)
    low = np.floor(px.min(axis=0)).astype(int) - around + view.border_px
    high = np.ceil(px.max(axis=0)).astype(int) + around + 1 + view.border_px
    height, width = view.rays.shape[:2]
    rows = slice(max(int(low[1]), 0), min(int(high[1]), height))
    cols = slice(max(int(low[0]), 0), min(int(high[0]), width))
    border = view.border_px
    if rows.stop <= border or cols.stop <= border or rows.start >= height - border:
        return None
    return None if cols.start >= width - border else (rows, cols)


def _print_shares(
    view: FloorView, placed: PlacedMarker | PlacedBoard, box: Box, settings: LabSettings
) -> tuple[Plane, Plane]:
    """Return the shares of each pixel's light from the print and from its black cells, (h, w) each."""
    black, cells_per_m = printed_cells(placed, settings.dictionary)
    columns, rows, pixel_cells = _cells_of(view, placed.world_from_marker, box, black.shape, cells_per_m)
    fine = (rows.shape[1] * _SAMPLES, rows.shape[0] * _SAMPLES)
    # The width of a texel is that of a sample: the ramp between two texels is the mean over a sample's
    # footprint.
    texels = [int(np.clip(round(_SAMPLES / size), 4, 512)) for size in pixel_cells]
    x = cv2.resize(columns * texels[0] - 0.5, fine, interpolation=cv2.INTER_LINEAR).astype(np.float32)
    y = cv2.resize(rows * texels[1] - 0.5, fine, interpolation=cv2.INTER_LINEAR).astype(np.float32)
    shares = []
    for pattern in (np.ones_like(black), black):
        texture = pattern.astype(np.float32).repeat(texels[1], axis=0).repeat(texels[0], axis=1)
        share = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        if settings.psf_sigma_px:
            share = cv2.GaussianBlur(share, (0, 0), settings.psf_sigma_px * _SAMPLES)
        size = (columns.shape[1], columns.shape[0])
        shares.append(np.asarray(cv2.resize(share, size, interpolation=cv2.INTER_AREA), dtype=np.float32))
    return shares[0], shares[1]


def _cells_of(
    view: FloorView, world_from_marker: Array, box: Box, shape: tuple[int, ...], cells_per_m: float
) -> tuple[Array, Array, tuple[float, float]]:
    """Return the positions of the pixels of a box on a print, and the size of a pixel, in cells.

    The positions are columns and rows from the top left of the print, (h, w) each. The size is the largest
    step in columns, and in rows, between two neighbouring pixels.
    """
    camera_from_marker = view.camera.camera_from_world @ world_from_marker
    plane = np.linalg.inv(camera_from_marker[:3, [0, 1, 3]])
    uv = view.rays[box]
    x, y, w = (plane[i, 0] * uv[..., 0] + plane[i, 1] * uv[..., 1] + plane[i, 2] for i in range(3))
    # Rays that do not meet the plane, and prints with their back to the camera, show nothing.
    seen = w > 1e-6 if camera_from_marker[:3, 2] @ camera_from_marker[:3, 3] < 0 else np.zeros_like(w, bool)
    scale = cells_per_m / np.where(seen, w, 1.0)
    columns = np.where(seen, shape[1] / 2 + x * scale, -1e4)
    rows = np.where(seen, shape[0] / 2 - y * scale, -1e4)
    middle = (
        slice(uv.shape[0] // 2 - 1, uv.shape[0] // 2 + 1),
        slice(uv.shape[1] // 2 - 1, uv.shape[1] // 2 + 1),
    )
    step_column = max(float(np.abs(np.diff(columns[middle], axis=axis)).max()) for axis in (0, 1))
    step_row = max(float(np.abs(np.diff(rows[middle], axis=axis)).max()) for axis in (0, 1))
    return columns, rows, (max(step_column, 1e-6), max(step_row, 1e-6))


Image = NDArray[np.uint8]
# Objects in an image.
Print = PlacedMarker | PlacedBoard | MovingMarker

# Grey levels that a warm lamp subtracts from the blue of the floor and adds to its red.
_BLUE, _RED = 9, 6


def render(
    view: FloorView, placed: Sequence[Print], settings: LabSettings, rng: np.random.Generator | None
) -> Image:
    """Render an image with markers.

    Parameters
    ----------
    view : view of the camera, from :func:`~ipsys_log.capture.simulation.cameras.prepare_view`.
    placed : the markers. If two overlap, the later one is on top. A moving marker is a function of the time
        in s since the time of the frame. This is the middle of the exposure of its first row.
    settings : the grey levels, blur, gamma and dictionary of the scene; row time and exposure.
    rng : random generator for the part of the noise field; None for an image without noise.

    Returns
    -------
    (height, width, 3), BGR. Markers and their grey value are untinted.
    """
    grey, bare = _compose(view, placed, settings)
    if rng is not None and settings.noise_sigma:
        top, left = rng.integers(0, FIELD_PX, 2)
        piece = view.noise[top : top + grey.shape[0], left : left + grey.shape[1]]
        levels = cv2.add(grey, piece, dtype=cv2.CV_8U)
    else:
        levels = cv2.add(grey, np.zeros_like(grey), dtype=cv2.CV_8U)
    blue = cv2.subtract(levels, cv2.convertScaleAbs(bare, alpha=_BLUE))
    red = cv2.add(levels, cv2.convertScaleAbs(bare, alpha=_RED))
    return np.asarray(cv2.merge([blue, levels, red]), dtype=np.uint8)


def expose(view: FloorView, placed: Sequence[Print], settings: LabSettings) -> Plane:
    """Return the grey levels of an image before noise and rounding, (height, width).

    The arguments are those of :func:`render`.
    """
    return _compose(view, placed, settings)[0]


def add_static_prints(
    view: FloorView, placed: Sequence[PlacedMarker | PlacedBoard], settings: LabSettings
) -> FloorView:
    """Return a view whose floor contains stationary prints, so the renderer does not draw them again."""
    grey, bare = _compose(view, placed, settings)
    return replace(view, floor=to_light(grey, settings), bare=bare)


def encode_jpeg(image: Image, settings: LabSettings) -> bytes:
    """Encode an image as a camera does: JPEG with chroma at half the width (4:2:2)."""
    options = [
        *(cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality),
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422),
    ]
    return bytes(cv2.imencode(".jpg", image, options)[1])


def _compose(view: FloorView, placed: Sequence[Print], settings: LabSettings) -> tuple[Plane, Plane]:
    """Return the grey levels of an image and the share of the floor in each pixel, both (h, w)."""
    grey = _levels(view.floor, settings)
    bare = np.ones_like(grey) if view.bare is None else view.bare.copy()
    white, black = (to_light(np.float32(level), settings) for level in (settings.white, settings.black))
    for item in placed:
        shares = find_shares(view, item, settings)
        if shares is None:
            continue
        rows, cols, inner = _inside(view, shares.box)
        cover, dark = shares.cover[inner], shares.dark[inner]
        # If two prints overlap, the upper print covers the already drawn levels.
        met = (bare[rows, cols] < 1).any()
        below = to_light(grey[rows, cols], settings) if met else view.floor[rows, cols]
        patch = below * (1 - cover) + white * cover - (white - black) * dark
        grey[rows, cols] = _levels(patch, settings)
        bare[rows, cols] *= 1 - cover
    return grey, bare


def _inside(view: FloorView, box: Box) -> tuple[slice, slice, Box]:
    """Return the rows and columns of a box in the image, and the part of the box inside the image."""
    frame, kept = [], []
    for part, size in zip(box, view.floor.shape, strict=True):
        start, stop = part.start - view.border_px, part.stop - view.border_px
        first, last = max(start, 0), min(stop, size)
        frame.append(slice(first, last))
        kept.append(slice(first - start, last - start))
    return frame[0], frame[1], (kept[0], kept[1])


def _levels(light: Plane, settings: LabSettings) -> Plane:
    if settings.gamma == 1.0:
        return light.copy()
    return np.asarray(255.0 * (np.maximum(light, 0) / 255.0) ** (1 / settings.gamma), dtype=np.float32)
