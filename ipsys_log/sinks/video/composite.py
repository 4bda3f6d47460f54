"""The pictures of a video: the cameras on the left, and the map of the floor with the time on the right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from math import ceil

import numpy as np

from ipsys_log.messages import Markers, Message, Rig, Tracks
from ipsys_log.sinks.colours import camera_colours
from ipsys_log.sinks.video.camera_panel import CameraPanel
from ipsys_log.sinks.video.canvas import RGB, Canvas, Picture, text_size
from ipsys_log.sinks.video.floor_map import FloorMap, MapLook, MapPart
from ipsys_log.units import NS_PER_S

_GROUND: RGB = (24, 24, 28)
_TEXT: RGB = (235, 235, 238)
_NOTE: RGB = (165, 165, 172)
# Share of the width that cameras may have; the usual shape of their pictures.
_MOST_LEFT = 0.5
_SHAPE = 16 / 9
_FONT_SHARE = 1 / 52
# Numbers of columns of many cameras; the one with the largest pictures is used.
_MANY_COLUMNS = range(3, 9)


@dataclass(frozen=True, slots=True)
class Scene:
    """The constant part of a video.

    Attributes
    ----------
    cameras : the names of the cameras.
    colours : by robot.
    rig : the rig of the tracks, or None.
    part : the visible part of the floor.
    enlarged : factor on the ellipses.
    fade_ns : a robot without a newer pose disappears after this time.
    run : the run of the tracks.
    """

    cameras: tuple[str, ...]
    colours: Mapping[str, RGB]
    rig: Rig | None
    part: MapPart
    enlarged: int
    fade_ns: int
    run: str


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
        look = MapLook(size, self._font_px, scene.colours, scene.enlarged, scene.fade_ns)
        self.floor = FloorMap(scene.rig, scene.part, look)

    @property
    def floor_corner_px(self) -> tuple[int, int]:
        """The place (x, y) of the map of the floor in the picture."""
        return self._left, self._head

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
