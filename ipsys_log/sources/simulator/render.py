"""Frames of printed markers on a floor, with edges that are exact to a few thousandths of a pixel.

A print is piecewise constant. Each marker is drawn on four by four samples per pixel: a sample is
sent through the exact inverse of the lens onto the plane of the marker and takes the mean over its
own footprint of the pattern there, so that edges which run along pixel rows stay exact as well.
The optics' blur acts on the samples, the sixteen of a pixel are averaged, and what comes out is
laid over the floor by its blurred coverage. All this happens in light; gamma, noise and rounding
follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.geometry.lenses import project
from ipsys_log.geometry.poses import transform
from ipsys_log.sources.simulator.cameras import Camera
from ipsys_log.sources.simulator.floor import lay_floor, pixel_rays
from ipsys_log.sources.simulator.patterns import Placed, black_cells, print_outline
from ipsys_log.sources.simulator.seeds import Purpose, stream
from ipsys_log.sources.simulator.settings import LabSettings

__all__ = ["View", "encode_jpeg", "expose", "prepare_view", "render"]

Array = NDArray[np.float64]
Plane = NDArray[np.float32]
Image = NDArray[np.uint8]

_SAMPLES = 4
_FIELD_PX = 192
# Grey levels that a warm lamp takes from the blue of the floor and adds to its red.
_BLUE, _RED = 9, 6


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What stays the same between the frames of a camera.

    ``rays`` (h + 2 border, w + 2 border, 2) are normalized coordinates of pixels, ``floor`` (h, w) is
    the light from the empty floor behind the optics, ``noise`` a field that is larger than a frame by
    192 px each way and of which each frame shows another piece.
    """

    camera: Camera
    border_px: int
    rays: Array
    floor: Plane
    noise: Plane


def prepare_view(camera: Camera, settings: LabSettings) -> View:
    """Everything about a camera's frames that does not change with the markers."""
    border_px = int(np.ceil(4 * settings.psf_sigma_px)) + 2
    rays = pixel_rays(camera.lens, border_px)
    light = _light(lay_floor(settings, camera, rays), settings)
    if settings.psf_sigma_px:
        light = cv2.GaussianBlur(light, (0, 0), settings.psf_sigma_px).astype(np.float32)
    inner = slice(border_px, -border_px)
    index = settings.cameras.index(camera.name) if camera.name in settings.cameras else len(settings.cameras)
    rng = stream(settings.seed, Purpose.NOISE_FIELD, index)
    size = (camera.lens.height + _FIELD_PX, camera.lens.width + _FIELD_PX)
    noise = rng.standard_normal(size, dtype=np.float32) * np.float32(settings.noise_sigma)
    return View(camera, border_px, rays, np.ascontiguousarray(light[inner, inner]), noise)


def render(
    view: View, placed: Sequence[Placed], settings: LabSettings, rng: np.random.Generator | None
) -> Image:
    """A frame with markers in it.

    Parameters
    ----------
    view : of the camera, from :func:`prepare_view`.
    placed : the markers; where two overlap, the later one lies on top.
    settings : the grey levels, blur, gamma and dictionary of the scene.
    rng : draws the piece of sensor noise; None for a frame without noise.

    Returns
    -------
    (height, width, 3), BGR. Markers and their grey value are untinted.
    """
    grey, bare = _compose(view, placed, settings)
    if rng is not None and settings.noise_sigma:
        top, left = rng.integers(0, _FIELD_PX, 2)
        piece = view.noise[top : top + grey.shape[0], left : left + grey.shape[1]]
        levels = cv2.add(grey, piece, dtype=cv2.CV_8U)
    else:
        levels = cv2.add(grey, np.zeros_like(grey), dtype=cv2.CV_8U)
    blue = cv2.subtract(levels, cv2.convertScaleAbs(bare, alpha=_BLUE))
    red = cv2.add(levels, cv2.convertScaleAbs(bare, alpha=_RED))
    return np.asarray(cv2.merge([blue, levels, red]), dtype=np.uint8)


def expose(view: View, placed: Sequence[Placed], settings: LabSettings) -> Plane:
    """Grey levels of a frame before noise and rounding, (height, width).

    Parameters
    ----------
    view, placed, settings : as for :func:`render`.
    """
    return _compose(view, placed, settings)[0]


def encode_jpeg(image: Image, settings: LabSettings) -> bytes:
    """A frame as a camera sends it: JPEG with chroma at half the width (4:2:2)."""
    options = [
        *(cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality),
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422),
    ]
    return bytes(cv2.imencode(".jpg", image, options)[1])


def _compose(view: View, placed: Sequence[Placed], settings: LabSettings) -> tuple[Plane, Plane]:
    """Grey levels of a frame, and the share of floor in each pixel, both (h, w)."""
    grey = _levels(view.floor, settings)
    bare = np.ones_like(grey)
    light = view.floor
    white, black = (_light(np.float32(level), settings) for level in (settings.white, settings.black))
    for one in placed:
        box = _box(view, one, settings)
        if box is None:
            continue
        cover, dark = _print_shares(view, one, box, settings)
        rows, cols, inner = _inside(view, box)
        cover, dark = cover[inner], dark[inner]
        # Where two prints meet, the upper one lies on what is there already.
        below = light[rows, cols] if not (bare[rows, cols] < 1).any() else _light(grey[rows, cols], settings)
        patch = below * (1 - cover) + white * cover - (white - black) * dark
        grey[rows, cols] = _levels(patch, settings)
        bare[rows, cols] *= 1 - cover
    return grey, bare


def _box(view: View, placed: Placed, settings: LabSettings) -> tuple[slice, slice] | None:
    """Rows and columns of ``view.rays`` that a print touches, blur included."""
    outline_m = print_outline(placed, settings.dictionary)
    outline_m = transform(view.camera.camera_from_world, outline_m)
    if (outline_m[:, 2] <= 0).any():
        return None
    px = project(outline_m, view.camera.lens)
    around = int(np.ceil(4 * settings.psf_sigma_px)) + 2
    low = np.floor(px.min(axis=0)).astype(int) - around + view.border_px
    high = np.ceil(px.max(axis=0)).astype(int) + around + 1 + view.border_px
    height, width = view.rays.shape[:2]
    rows = slice(max(int(low[1]), 0), min(int(high[1]), height))
    cols = slice(max(int(low[0]), 0), min(int(high[0]), width))
    border = view.border_px
    if rows.stop <= border or cols.stop <= border or rows.start >= height - border:
        return None
    return None if cols.start >= width - border else (rows, cols)


def _inside(view: View, box: tuple[slice, slice]) -> tuple[slice, slice, tuple[slice, slice]]:
    """A box without the border: where it lies in the frame, and which part of it is kept."""
    frame, kept = [], []
    for part, size in zip(box, view.floor.shape, strict=True):
        start, stop = part.start - view.border_px, part.stop - view.border_px
        first, last = max(start, 0), min(stop, size)
        frame.append(slice(first, last))
        kept.append(slice(first - start, last - start))
    return frame[0], frame[1], (kept[0], kept[1])


def _print_shares(
    view: View, placed: Placed, box: tuple[slice, slice], settings: LabSettings
) -> tuple[Plane, Plane]:
    """Shares of a pixel's light that come from the print, and from its black cells: (h, w) each."""
    black = black_cells(settings.dictionary, placed.id)
    columns, rows, pixel_cells = _cells_of(view, placed, box, len(black))
    fine = (rows.shape[1] * _SAMPLES, rows.shape[0] * _SAMPLES)
    # One texel is one sample wide: the ramp between two texels is the mean over a sample's footprint.
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
    view: View, placed: Placed, box: tuple[slice, slice], cells: int
) -> tuple[Array, Array, tuple[float, float]]:
    """Where the pixels of a box lie on a print, in cells from its top left: column and row, (h, w).

    Also by how many columns and rows a step of one pixel takes one further, at most.
    """
    camera_from_marker = view.camera.camera_from_world @ placed.world_from_marker
    plane = np.linalg.inv(camera_from_marker[:3, [0, 1, 3]])
    uv = view.rays[box]
    x, y, w = (plane[i, 0] * uv[..., 0] + plane[i, 1] * uv[..., 1] + plane[i, 2] for i in range(3))
    # Rays that pass the plane, and prints seen from behind, show nothing.
    seen = w > 1e-6 if camera_from_marker[:3, 2] @ camera_from_marker[:3, 3] < 0 else np.zeros_like(w, bool)
    scale = (cells - 2) / placed.length_m / np.where(seen, w, 1.0)
    columns = np.where(seen, cells / 2 + x * scale, -1e4)
    rows = np.where(seen, cells / 2 - y * scale, -1e4)
    middle = (
        slice(uv.shape[0] // 2 - 1, uv.shape[0] // 2 + 1),
        slice(uv.shape[1] // 2 - 1, uv.shape[1] // 2 + 1),
    )
    step_column = max(float(np.abs(np.diff(columns[middle], axis=axis)).max()) for axis in (0, 1))
    step_row = max(float(np.abs(np.diff(rows[middle], axis=axis)).max()) for axis in (0, 1))
    return columns, rows, (max(step_column, 1e-6), max(step_row, 1e-6))


def _light(levels: Plane | np.float32, settings: LabSettings) -> Plane:
    return np.asarray(255.0 * (levels / 255.0) ** settings.gamma, dtype=np.float32)


def _levels(light: Plane, settings: LabSettings) -> Plane:
    if settings.gamma == 1.0:
        return light.copy()
    return np.asarray(255.0 * (np.maximum(light, 0) / 255.0) ** (1 / settings.gamma), dtype=np.float32)
