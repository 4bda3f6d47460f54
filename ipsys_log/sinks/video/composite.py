"""The pictures of a video: a panel for each camera on the left, and the map with the time on the right."""

from datetime import UTC, datetime
from math import ceil

import cv2
import numpy as np

from ipsys_log.errors import FrameError
from ipsys_log.messages import CompressedImage, CompressedVideo, Markers, Message, RawImage, Tracks
from ipsys_log.sinks.colours import MARKER_COLOUR, camera_colours
from ipsys_log.sinks.video.canvas import RGB, Canvas, Picture, text_size
from ipsys_log.sinks.video.floor_map import FloorMap, Scene
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.decode import decode_colour
from ipsys_log.vision.video import Video

_PANEL_GROUND: RGB = (16, 16, 19)
_TITLE: RGB = (44, 44, 50)
_PANEL_TEXT: RGB = (225, 225, 228)
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
        self._panel[:] = _PANEL_GROUND[::-1]
        markers = self._markers
        if self._image is not None and markers is not None and markers.timestamp != self._image.timestamp:
            markers = None
        self._draw_picture(canvas, markers)
        canvas.box(0, 0, self._width, self._title_px, _TITLE)
        middle, base = self._title_px / 2, round(self._title_px / 2 + 0.36 * self._font_px)
        canvas.disc((self._font_px, middle), 0.36 * self._font_px, self._colour)
        canvas.text((1.8 * self._font_px, base), self._camera, self._font_px, _PANEL_TEXT)
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


_GROUND: RGB = (24, 24, 28)
_TEXT: RGB = (235, 235, 238)
_NOTE: RGB = (165, 165, 172)
# Share of the width that cameras may have; the usual shape of their pictures.
_MOST_LEFT = 0.5
_SHAPE = 16 / 9
_FONT_SHARE = 1 / 52
# Numbers of columns of many cameras; the one with the largest pictures is used.
_MANY_COLUMNS = range(3, 9)


class Composite:
    """The picture of a video at one time: the newest content of each channel.

    Parameters
    ----------
    size_px : width and height.
    start_ns : the log time at which the video begins.
    """

    def __init__(self, scene: Scene, size_px: tuple[int, int], start_ns: int) -> None:
        width, height = size_px
        self._scene, self._start_ns = scene, start_ns
        self._font_px = max(round(height * _FONT_SHARE), 8)
        self._picture = np.full((height, width, 3), _GROUND[::-1], dtype=np.uint8)
        self._left, places = _arrange(len(scene.cameras), size_px)
        colours = camera_colours(scene.cameras)
        self._panels: dict[str, tuple[CameraPanel, tuple[int, int]]] = {}
        for camera, (x, y, *panel_px) in zip(scene.cameras, places, strict=True):
            panel = CameraPanel(camera, colours[camera], (panel_px[0], panel_px[1]), self._font_px)
            self._panels[camera] = panel, (x, y)
        self._head = round(2.6 * self._font_px)
        size = width - self._left, height - self._head
        self.floor = FloorMap(scene, size, self._font_px)

    def add(self, message: Message) -> None:
        """Show a message from now on."""
        payload = message.payload
        if isinstance(payload, Tracks):
            self.floor.add(payload, message.log_time_ns)
        elif message.camera in self._panels:
            panel, _ = self._panels[message.camera]
            if isinstance(payload, Markers):
                panel.add_markers(payload)
            else:
                panel.add_image(payload)

    def draw(self, time_ns: int) -> Picture:
        """Return the picture (height, width, 3) at a log time; it is valid until the next one."""
        for panel, (x, y) in self._panels.values():
            drawn = panel.draw()
            self._picture[y : y + drawn.shape[0], x : x + drawn.shape[1]] = drawn
        self._picture[self._head :, self._left :] = self.floor.draw(time_ns)
        self._draw_head(time_ns)
        return self._picture

    def _draw_head(self, time_ns: int) -> None:
        canvas, font_px = Canvas(self._picture), self._font_px
        width = self._picture.shape[1]
        canvas.box(self._left, 0, width, self._head, _GROUND)
        base = round(1.65 * font_px)
        clock = datetime.fromtimestamp(time_ns // NS_PER_S, UTC)
        text = f"{clock:%Y-%m-%d %H:%M:%S}.{time_ns % NS_PER_S // 100_000_000} UTC"
        canvas.text((self._left + font_px, base), text, font_px, _TEXT)
        text = f"{(time_ns - self._start_ns) / NS_PER_S:.1f} s"
        at = self._left + font_px + round(16.5 * font_px)
        canvas.text((at, base), text, font_px, _NOTE)
        times = f", {self._scene.enlarged} times as large" if self._scene.enlarged > 1 else ""
        text = f"run {self._scene.run}; regions of 95 %{times}"
        canvas.text((width - text_size(text, font_px)[0] - font_px, base), text, font_px, _NOTE)


def _left(columns: int, rows: int, size_px: tuple[int, int]) -> int:
    width, height = size_px
    return round(min(columns * height / rows * _SHAPE * 0.94, _MOST_LEFT * width))


def _picture_width(columns: int, count: int, size_px: tuple[int, int]) -> float:
    """Return the width of each picture of ``count`` cameras below the titles."""
    rows, height = ceil(count / columns), size_px[1]
    room = height / rows - 2 * height * _FONT_SHARE
    return min(_left(columns, rows, size_px) / columns, room * _SHAPE)


def _arrange(count: int, size_px: tuple[int, int]) -> tuple[int, list[tuple[int, int, int, int]]]:
    """Return the width of the cameras, and the place and size (x, y, width, height) of each panel."""
    height = size_px[1]
    columns = 1 if count <= 3 else 2
    if count > 8:
        columns = max(_MANY_COLUMNS, key=lambda one: _picture_width(one, count, size_px))
    rows = ceil(count / columns)
    left = _left(columns, rows, size_px)
    xs = [left * n // columns for n in range(columns + 1)]
    ys = [height * n // rows for n in range(rows + 1)]
    gap = max(height // 240, 1)
    places = []
    for n in range(count):
        row, column = divmod(n, columns)
        x, y = xs[column], ys[row]
        places.append((x, y, xs[column + 1] - x - gap, ys[row + 1] - y - gap * (row + 1 < rows)))
    return left, places
