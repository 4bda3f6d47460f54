"""Pictures of cameras that give no JPEG: encoded once, as Video for Linux lays them out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import simplejpeg
from numpy.typing import NDArray

__all__ = ["RAW_FORMATS", "Layout", "encode_raw"]

Plane = NDArray[np.uint8]

# The driver's names, the one that is taken first in front: of those with colour that of the fewest bytes.
RAW_FORMATS = ("NV12", "YUYV", "UYVY", "GREY")
_QUALITY = 95


class Layout(NamedTuple):
    """Of a picture in memory: ``stride`` is how many bytes lie between the beginnings of two rows."""

    format: str
    width: int
    height: int
    stride: int

    @property
    def size(self) -> int:
        """How many bytes a picture takes."""
        rows = self.height + self.height // 2 if self.format == "NV12" else self.height
        return self.stride * rows


def encode_raw(data: bytes, layout: Layout) -> bytes | None:
    """A picture as JPEG, its levels as the camera gave them; None where data is missing.

    Examples
    --------
    >>> encode_raw(bytes(64), Layout("GREY", 8, 8, 8))[:2].hex()
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


def _planes(rows: Plane, layout: Layout) -> list[Plane]:
    """Brightness and, of colour, the two planes of it, which are smaller."""
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
