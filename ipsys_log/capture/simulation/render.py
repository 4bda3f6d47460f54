"""Rendered images of printed markers on a floor, with edges that are exact to a few thousandths of a pixel.

The blurred coverage of each print (:mod:`ipsys_log.capture.simulation.pixel_shares`) is the weight of its
light against the light of the floor. Gamma, noise and rounding follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.capture.simulation.floor import FIELD_PX, FloorView, to_light
from ipsys_log.capture.simulation.pixel_shares import Box, find_shares
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.vision.markers import MovingMarker, PlacedBoard, PlacedMarker

Plane = NDArray[np.float32]
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
    view : view of the camera, from :func:`~ipsys_log.capture.simulation.floor.prepare_view`.
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

    Parameters
    ----------
    view, placed, settings : as for :func:`render`.
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
