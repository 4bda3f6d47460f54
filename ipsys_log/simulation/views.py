"""Constant data of the frames of a camera: its rays, the floor, the noise of its sensor."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.simulation.cameras import Camera
from ipsys_log.simulation.floor import Check, lay_floor, pixel_rays
from ipsys_log.simulation.seeds import Purpose, stream
from ipsys_log.simulation.settings import LabSettings

__all__ = ["FIELD_PX", "View", "prepare_view", "to_light"]

Array = NDArray[np.float64]
Plane = NDArray[np.float32]

# By how much the field of noise is larger than a frame.
FIELD_PX = 192


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The constant data of the frames of a camera.

    ``rays`` (h + 2 border, w + 2 border, 2) are normalized coordinates of pixels, ``floor`` (h, w) is
    the light from the empty floor behind the optics, ``noise`` a field that is larger than a frame by
    192 px each way and of which each frame shows another piece. ``bare`` (h, w) is the share of floor in each
    pixel, where prints lie on it for good.
    """

    camera: Camera
    border_px: int
    rays: Array
    floor: Plane
    noise: Plane
    bare: Plane | None = None


def prepare_view(camera: Camera, settings: LabSettings, check: Check = lambda: None) -> View:
    """Compute all data of a camera's frames that do not depend on the markers."""
    border_px = int(np.ceil(4 * settings.psf_sigma_px)) + 2
    rays = pixel_rays(camera.lens, border_px, check)
    behind = to_light(lay_floor(settings, camera, rays, check), settings)
    check()
    if settings.psf_sigma_px:
        behind = cv2.GaussianBlur(behind, (0, 0), settings.psf_sigma_px).astype(np.float32)
    inner = slice(border_px, -border_px)
    index = settings.cameras.index(camera.name) if camera.name in settings.cameras else len(settings.cameras)
    rng = stream(settings.seed, Purpose.NOISE_FIELD, index)
    size = (camera.lens.height + FIELD_PX, camera.lens.width + FIELD_PX)
    noise = rng.standard_normal(size, dtype=np.float32) * np.float32(settings.noise_sigma)
    return View(camera, border_px, rays, np.ascontiguousarray(behind[inner, inner]), noise)


def to_light(levels: Plane | np.float32, settings: LabSettings) -> Plane:
    """Light of grey levels, 0 to 255 both."""
    return np.asarray(255.0 * (levels / 255.0) ** settings.gamma, dtype=np.float32)
