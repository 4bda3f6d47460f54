"""The panel of a camera: its newest picture with the detected markers and their ids."""

from __future__ import annotations

import cv2
import numpy as np

from ipsys_log.errors import FrameError
from ipsys_log.messages import CompressedImage, CompressedVideo, Markers, RawImage
from ipsys_log.sinks.colours import MARKER_COLOUR
from ipsys_log.sinks.video.canvas import RGB, Canvas, Picture, text_size
from ipsys_log.vision.decode import decode_colour
from ipsys_log.vision.video import Video

_GROUND: RGB = (16, 16, 19)
_TITLE: RGB = (44, 44, 50)
_TEXT: RGB = (225, 225, 228)
_NOTE: RGB = (165, 165, 172)
_DARK: RGB = (0, 0, 0)


class CameraPanel:
    """The panel of a camera: a title, and below it the picture.

    Parameters
    ----------
    camera, colour : its name and its colour.
    size_px : width and height of the panel.
    font_px : size of the text.
    """

    def __init__(self, camera: str, colour: RGB, size_px: tuple[int, int], font_px: int) -> None:
        self._camera, self._colour, self._font_px = camera, colour, font_px
        self._width, height = size_px
        self._title_px = 2 * font_px
        self._room = self._width, height - self._title_px
        self._image: CompressedImage | RawImage | None = None
        self._video: Video | None = None
        self._markers: Markers | None = None
        self._note: str | None = "no image yet"
        self._panel = np.empty((height, self._width, 3), dtype=np.uint8)
        self._is_drawn = False

    def add_image(self, image: CompressedImage | RawImage | CompressedVideo) -> None:
        """Show an image from now on."""
        self._is_drawn = False
        if not isinstance(image, CompressedVideo):
            self._image = image
            return
        # Later frames need this one: it is decoded, even if it is not shown.
        try:
            self._video = self._video or Video(image.format, with_colours=True)
            decoded = self._video(image)
        except FrameError:
            decoded = None
        self._image = decoded or self._image

    def add_markers(self, markers: Markers) -> None:
        """Show markers on the image of the same time."""
        self._markers, self._is_drawn = markers, False

    def draw(self) -> Picture:
        """Return the panel (height, width, 3) as it is now."""
        if not self._is_drawn:
            self._draw()
            self._is_drawn = True
        return self._panel

    def _draw(self) -> None:
        canvas = Canvas(self._panel)
        self._panel[:] = _GROUND[::-1]
        markers = self._markers
        if self._image is not None and markers is not None and markers.timestamp != self._image.timestamp:
            markers = None
        self._draw_picture(canvas, markers)
        canvas.box(0, 0, self._width, self._title_px, _TITLE)
        middle, base = self._title_px / 2, round(self._title_px / 2 + 0.36 * self._font_px)
        canvas.disc((self._font_px, middle), 0.36 * self._font_px, self._colour)
        canvas.text((1.8 * self._font_px, base), self._camera, self._font_px, _TEXT)
        count = len(markers.markers) if markers is not None else None
        text = self._note or ("" if count is None else "1 marker" if count == 1 else f"{count} markers")
        width = text_size(text, self._font_px)[0]
        canvas.text((self._width - width - 0.7 * self._font_px, base), text, self._font_px, _NOTE)

    def _draw_picture(self, canvas: Canvas, markers: Markers | None) -> None:
        if self._image is None:
            return
        try:
            picture = decode_colour(self._image, self._room)
        except FrameError:
            self._note = "damaged image"
            return
        self._note = None
        height, width = picture.shape[:2]
        scale = min(self._room[0] / width, self._room[1] / height)
        shown = max(round(width * scale), 1), max(round(height * scale), 1)
        left = (self._room[0] - shown[0]) // 2
        top = self._title_px + (self._room[1] - shown[1]) // 2
        scaled = cv2.resize(picture, shown, interpolation=cv2.INTER_AREA)
        self._panel[top : top + shown[1], left : left + shown[0]] = scaled
        if markers is not None and markers.width > 0 and markers.height > 0:
            self._draw_markers(canvas, markers, (left, top), shown)

    def _draw_markers(
        self, canvas: Canvas, markers: Markers, corner: tuple[int, int], shown: tuple[int, int]
    ) -> None:
        scale = np.array(shown) / [markers.width, markers.height]
        for marker in markers.markers:
            # Points of a log count from the centre of the first pixel, scales from its corner.
            outline = (np.asarray(marker.corners_px) + 0.5) * scale - 0.5 + corner
            if not np.isfinite(outline).all():
                continue
            canvas.line(outline, MARKER_COLOUR, max(self._font_px // 7, 1), is_closed=True)
            label, size = str(marker.id), self._font_px - 1
            width = text_size(label, size)[0]
            # A label on the marker would hide it.
            below = outline[:, 1].max() + 1.2 * size
            y = below if below < self._panel.shape[0] - 3 else outline[:, 1].min() - 0.4 * size
            canvas.text((outline[:, 0].mean() - width / 2, y), label, size, MARKER_COLOUR, halo=_DARK)
