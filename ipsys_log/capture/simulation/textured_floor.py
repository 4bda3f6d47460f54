"""The floor of a laboratory in use: tiles, planks, tape, cables, clutter, shadows, and the feet of people."""

from collections.abc import Callable
from functools import lru_cache
from threading import Lock
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.capture.simulation.settings import LabSettings, Purpose, random_stream
from ipsys_log.messages import Array
from ipsys_log.vision.markers import PlacedBoard
from ipsys_log.vision.poses import pose_facing_up

# Width of a texel, about that of a pixel, and of the map beyond the floor.
_TEXEL_M = 0.002
_BEYOND_M = 1.6
_SHIFT = 4
# Sides of the areas with one material, and the number of objects of each kind per m2.
_AREA_M = (1.22, 1.83)
_CABLES, _STRIPS, _SHEETS, _BOXES, _SHADOWS = 0.25, 0.35, 0.7, 1.6, 0.2
_DARKEST = 0.55
# People walk on circles around the middle of the floor. The pattern of a shoe is in cells of 2 cm.
_PEOPLE, _SPEED_M_S, _STEP_M, _ASIDE_M, _SHOE_M = 2, 1.0, 0.7, 0.11, 0.02
_SHOE = np.ones((14, 5), dtype=bool)
_SHOE[2:9:2, 1:4] = False
_INSTEP_M = 0.07

_drawing = Lock()


def read_map(settings: LabSettings, x_m: Array, y_m: Array) -> Array:
    """Return the grey levels of the floor at world points (h, w), without the noise of the materials."""
    with _drawing:  # the cameras of a lab start at the same time, and share one map
        levels = _draw(settings.seed, settings.floor_m, settings.floor)
    x, y = (((axis_m + _BEYOND_M) / _TEXEL_M - 0.5).astype(np.float32) for axis_m in (x_m, y_m))
    read = cv2.remap(levels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(read, dtype=np.float64)


@lru_cache(maxsize=1)
def _draw(seed: int, floor_m: tuple[float, float], level: float) -> NDArray[np.uint8]:
    """Return the map; row and column are along y and x."""
    width, height = (round((side_m + 2 * _BEYOND_M) / _TEXEL_M) for side_m in floor_m)
    drawing = _Drawing(np.empty((height, width), dtype=np.uint8), random_stream(seed, Purpose.CLUTTER), level)
    drawing.materials()
    drawing.repeat(_STRIPS, drawing.strip)
    drawing.repeat(_CABLES, drawing.cable)
    drawing.repeat(_SHEETS, drawing.sheet)
    drawing.repeat(_BOXES, drawing.box)
    drawing.repeat(_SHADOWS, drawing.shadow)
    drawing.levels.flags.writeable = False
    return drawing.levels


class _Drawing(NamedTuple):
    levels: NDArray[np.uint8]
    rng: np.random.Generator
    level: float

    def repeat(self, per_m2: float, draw: Callable[[], None]) -> None:
        for _ in range(round(self.levels.size * _TEXEL_M**2 * per_m2)):
            draw()

    def materials(self) -> None:
        """Cover the floor with areas of tiles or planks."""
        height, width = self.levels.shape
        across, along = (round(side_m / _TEXEL_M) for side_m in _AREA_M)
        for top in range(0, height, along):
            for left in range(0, width, across):
                area = self.levels[top : top + along, left : left + across]
                sides_m = [(0.1, 0.1), (0.3, 0.3), (0.07, 0.6)][int(self.rng.integers(3))]
                self._tile(area, *(round(side_m / _TEXEL_M) for side_m in sides_m))

    def _tile(self, area: NDArray[np.uint8], across: int, along: int) -> None:
        contrast = self.rng.uniform(4, 30)
        joint = self.level * self.rng.uniform(0.5, 0.85)
        for top in range(0, len(area), along):
            for left in range(0, area.shape[1], across):
                # Every second tile is darker, as on many floors.
                darker = contrast * ((top // along + left // across) % 2)
                shade = self.level - darker + self.rng.uniform(-8, 8)
                part = area[top : top + along, left : left + across]
                part[:] = joint
                part[2:, 2:] = np.clip(shade, 0, 255)

    def _somewhere(self) -> Array:
        return self.rng.uniform(0, self.levels.shape[::-1])

    def _fill(self, points: Array, level: float) -> None:
        fixed = np.rint(points * (1 << _SHIFT)).astype(np.int32)
        cv2.fillPoly(self.levels, [fixed], level, cv2.LINE_AA, _SHIFT)

    def _rectangle(self, middle: Array, sides_m: tuple[float, float], turn_rad: float) -> Array:
        """Return the corners of a rectangle, (4, 2)."""
        ahead = np.array([np.cos(turn_rad), np.sin(turn_rad)]) * sides_m[0] / 2 / _TEXEL_M
        aside = np.array([-np.sin(turn_rad), np.cos(turn_rad)]) * sides_m[1] / 2 / _TEXEL_M
        corners: Array = middle + np.array([-ahead - aside, ahead - aside, ahead + aside, aside - ahead])
        return corners

    def strip(self) -> None:
        """Draw adhesive tape: white, black, or with warning stripes."""
        turn = float(self.rng.choice([0, np.pi / 2, self.rng.uniform(0, np.pi)]))
        length_m, middle = self.rng.uniform(0.2, 1.5), self._somewhere()
        light, dark = self.rng.uniform(190, 230), self.rng.uniform(25, 50)
        kind = int(self.rng.integers(3))
        self._fill(self._rectangle(middle, (length_m, 0.05), turn), dark if kind == 1 else light)
        for along_m in np.arange(0.05, length_m - 0.05, 0.1) if kind == 2 else ():
            shift = (along_m - length_m / 2) / _TEXEL_M
            start = middle + shift * np.array([np.cos(turn), np.sin(turn)])
            self._fill(self._rectangle(start, (0.05, 0.05), turn), dark)

    def cable(self) -> None:
        """Draw a cable in bends."""
        headings = np.cumsum(self.rng.normal(0, 0.25, 60)) + self.rng.uniform(0, 2 * np.pi)
        steps = 0.05 / _TEXEL_M * np.column_stack([np.cos(headings), np.sin(headings)])
        points = np.rint((self._somewhere() + np.cumsum(steps, axis=0)) * (1 << _SHIFT)).astype(np.int32)
        level, width = self.rng.uniform(20, 220), int(self.rng.integers(3, 7))
        cv2.polylines(self.levels, [points], False, level, width, cv2.LINE_AA, _SHIFT)

    def sheet(self) -> None:
        """Draw a sheet of paper with black squares or lines, such as a plan, a keyboard or a text."""
        turn, middle = self.rng.uniform(0, np.pi), self._somewhere()
        self._fill(self._rectangle(middle, (0.3, 0.21), turn), self.rng.uniform(190, 230))
        size_m = float(self.rng.choice([0.012, 0.025, 0.05]))
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        for x_m in np.arange(-0.12, 0.12, size_m):
            for y_m in np.arange(-0.075, 0.08, size_m):
                if self.rng.random() < 0.5:
                    at = middle + np.array([x_m, y_m]) / _TEXEL_M @ axes
                    self._fill(self._rectangle(at, (size_m, 0.8 * size_m), turn), self.rng.uniform(20, 80))

    def box(self) -> None:
        """Draw a box, a tool or a part, with a label."""
        turn, middle = self.rng.uniform(0, np.pi), self._somewhere()
        sides_m = self.rng.uniform(0.03, 0.35, 2)
        self._fill(self._rectangle(middle, (sides_m[0], sides_m[1]), turn), self.rng.uniform(20, 120))
        aside = self.rng.uniform(-0.2, 0.2, 2) * sides_m.min() / _TEXEL_M
        label_m = sides_m * self.rng.uniform(0.15, 0.6, 2)
        self._fill(
            self._rectangle(middle + aside, (label_m[0], label_m[1]), turn), self.rng.uniform(100, 220)
        )

    def shadow(self) -> None:
        """Darken an area with a soft edge, as that of a table."""
        reach = self.rng.uniform(0.4, 1.2, 2) / _TEXEL_M
        middle, turn = self._somewhere(), self.rng.uniform(0, np.pi)
        low = np.maximum(middle - reach.sum(), 0).astype(int)
        high = np.minimum(middle + reach.sum(), self.levels.shape[::-1]).astype(int)
        part = self.levels[low[1] : high[1], low[0] : high[0]]
        share = np.ones(part.shape, dtype=np.float32)
        sides_m = (reach[0] * _TEXEL_M, reach[1] * _TEXEL_M)
        corners = np.rint(self._rectangle(middle - low, sides_m, turn)).astype(np.int32)
        cv2.fillPoly(share, [corners], self.rng.uniform(_DARKEST, 0.8))
        share = np.asarray(cv2.GaussianBlur(share, (0, 0), self.rng.uniform(2, 15)), dtype=np.float32)
        part[:] = cv2.multiply(part, share, dtype=cv2.CV_8U)


def feet(settings: LabSettings, time_s: float) -> list[Callable[[float], PlacedBoard]]:
    """Return the shoes of people, as functions of the time since ``time_s``; none on the plain floor."""
    if not settings.textured:
        return []
    rng = random_stream(settings.seed, Purpose.FEET)
    starts_m = rng.uniform(0, 10, _PEOPLE)
    radii_m = min(settings.floor_m) / 2 * rng.uniform(0.35, 0.75, _PEOPLE)
    return [
        lambda since_s, start_m=start_m, radius_m=radius_m, side=side: _place(  # type: ignore[misc]
            settings, start_m + _SPEED_M_S * (time_s + since_s), radius_m, side
        )
        for start_m, radius_m in zip(starts_m.tolist(), radii_m.tolist(), strict=True)
        for side in (-1, 1)
    ]


def _place(settings: LabSettings, way_m: float, radius_m: float, side: int) -> PlacedBoard:
    """Return a shoe of a person on a circle: it rests for half of each step and moves in the other half."""
    steps, phase = divmod(way_m / (2 * _STEP_M) + (side > 0) / 2, 1.0)
    moved = np.clip(2 * phase - 1, 0, 1)
    angle = (steps + moved * moved * (3 - 2 * moved)) * 2 * _STEP_M / radius_m
    reach_m = radius_m + side * _ASIDE_M
    x_m, y_m = (side_m / 2 for side_m in settings.floor_m)
    x_m, y_m = x_m + reach_m * np.cos(angle), y_m + reach_m * np.sin(angle)
    return PlacedBoard(_SHOE, _SHOE_M, pose_facing_up(x_m, y_m, _INSTEP_M, angle + np.pi / 2))
