"""A picture to draw on: text, lines, discs and ellipses at fractions of pixels, with smooth edges."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.plain_text import plain_text

Picture = NDArray[np.uint8]
RGB = tuple[int, int, int]
Point = Sequence[float] | NDArray[np.float64]

# OpenCV takes coordinates in these parts of a pixel.
_SHIFT = 4
_PARTS = 1 << _SHIFT
_LONGEST = 100
_FAR_PX = 30_000


@cache
def _text_mask(text: str, size_px: int) -> tuple[Picture, int]:
    """Return the coverage of a line of text (h, w), and the part of its height above the base line."""
    import matplotlib as mpl
    from matplotlib.ft2font import FT2Font

    font = FT2Font(str(Path(mpl.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")))
    font.set_size(size_px, 72)
    font.set_text(plain_text(text, longest=_LONGEST) or " ")
    font.draw_glyphs_to_bitmap(antialiased=True)
    mask = np.array(font.get_image(), dtype=np.uint8)
    return mask, mask.shape[0] - font.get_descent() // 64


def text_size(text: str, size_px: int) -> tuple[int, int]:
    """Return width and height of a line of text in px."""
    height, width = _text_mask(text, size_px)[0].shape
    return width, height


def _in_parts(points: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return points in parts of pixels. Points far away move nearer: their integers would be too large."""
    return np.round(np.clip(points, -_FAR_PX, _FAR_PX) * _PARTS).astype(np.int32)


class Canvas:
    """A picture (height, width, 3) in the order BGR. Points count from the centre of the first pixel."""

    def __init__(self, picture: Picture) -> None:
        self.picture = picture

    def text(self, at: Point, text: str, size_px: int, colour: RGB, halo: RGB | None = None) -> None:
        """Draw a line of text; its base line begins at a point. A halo separates it from the ground."""
        mask, above = _text_mask(text, size_px)
        left, top = round(float(at[0])), round(float(at[1])) - above
        if halo is not None:
            rim = max(size_px // 6, 1)
            wide = cv2.copyMakeBorder(mask, rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=0)
            wide = cv2.dilate(wide, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * rim + 1,) * 2))
            self._blend(np.asarray(wide, dtype=np.uint8), left - rim, top - rim, halo)
        self._blend(mask, left, top, colour)

    def line(self, points: NDArray[np.float64], colour: RGB, width: int = 1, is_closed: bool = False) -> None:
        """Draw a line through points (n, 2)."""
        cv2.polylines(self.picture, [_in_parts(points)], is_closed, colour[::-1], width, cv2.LINE_AA, _SHIFT)

    def fill(self, points: NDArray[np.float64], colour: RGB) -> None:
        """Fill a polygon (n, 2)."""
        cv2.fillPoly(self.picture, [_in_parts(points)], colour[::-1], cv2.LINE_AA, _SHIFT)

    def disc(self, at: Point, radius_px: float, colour: RGB, width: int = -1) -> None:
        """Draw a disc; with a width, only its edge."""
        x, y = _in_parts(np.asarray(at, dtype=np.float64)).tolist()
        radius = max(round(radius_px * _PARTS), 1)
        cv2.circle(self.picture, (x, y), radius, colour[::-1], width, cv2.LINE_AA, _SHIFT)

    def box(self, left: int, top: int, right: int, bottom: int, colour: RGB) -> None:
        """Fill a rectangle; right and bottom are not included."""
        self.picture[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = colour[::-1]

    def _blend(self, mask: Picture, left: int, top: int, colour: RGB) -> None:
        """Paint a colour with the coverage ``mask``; parts outside of the picture are left out."""
        height, width = self.picture.shape[:2]
        rows = slice(max(top, 0), min(top + mask.shape[0], height))
        columns = slice(max(left, 0), min(left + mask.shape[1], width))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return
        part = mask[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
        cover = part[..., None].astype(np.float32) / 255
        ground = self.picture[rows, columns].astype(np.float32)
        painted = ground + cover * (np.array(colour[::-1], dtype=np.float32) - ground)
        self.picture[rows, columns] = np.round(painted).astype(np.uint8)
