"""Raw images of cameras without JPEG: their layout in memory, and their encoding as JPEG."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import simplejpeg
from numpy.typing import NDArray

Plane = NDArray[np.uint8]

# The driver's names of raw formats, in order of preference. The colour format with the fewest bytes is first.
RAW_FORMATS = ("NV12", "YUYV", "UYVY", "GREY")
_QUALITY = 95


class ImageLayout(NamedTuple):
    """The layout of an image in memory; ``stride`` is the number of bytes from one row to the next."""

    format: str
    width: int
    height: int
    stride: int

    @property
    def size(self) -> int:
        """The size of an image, in bytes."""
        rows = self.height + self.height // 2 if self.format == "NV12" else self.height
        return self.stride * rows


def encode_raw(data: bytes, layout: ImageLayout) -> bytes | None:
    """Encode an image as JPEG, with the grey levels of the camera; return None if data is missing.

    Examples
    --------
    >>> encode_raw(bytes(64), ImageLayout("GREY", 8, 8, 8))[:2].hex()
    'ffd8'

    References
    ----------
    https://docs.kernel.org/userspace-api/media/v4l/pixfmt.html
    """
    if len(data) < layout.size:
        return None
    rows = np.frombuffer(data, np.uint8, layout.size).reshape(-1, layout.stride)
    grey, *colour = map(np.ascontiguousarray, _planes(rows, layout))
    encoded: bytes = simplejpeg.encode_jpeg_yuv_planes(grey, *(colour or (None, None)), quality=_QUALITY)
    return encoded


def _planes(rows: Plane, layout: ImageLayout) -> list[Plane]:
    """Return the brightness plane and, for colour formats, the two smaller colour planes."""
    width, height = layout.width, layout.height
    if layout.format == "GREY":
        return [rows[:, :width]]
    if layout.format == "NV12":
        colour = rows[height:, :width]
        return [rows[:height, :width], colour[:, 0::2], colour[:, 1::2]]
    pairs = rows[:, : 2 * width]
    if layout.format == "UYVY":
        return [pairs[:, 1::2], pairs[:, 0::4], pairs[:, 2::4]]
    return [pairs[:, 0::2], pairs[:, 1::4], pairs[:, 3::4]]
