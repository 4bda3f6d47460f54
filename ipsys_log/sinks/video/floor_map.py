"""The map of the floor to scale: its grid, reference points, robots with trails, covariance ellipses."""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import cos, sin
from typing import NamedTuple

import numpy as np

from ipsys_log.messages import Array, Rig, Track, Tracks
from ipsys_log.plain_text import plain_text
from ipsys_log.sinks.video.canvas import RGB, Canvas, Picture, text_size
from ipsys_log.units import NS_PER_S

# The region of 95 % of a normal distribution in two dimensions ends at so many standard deviations.
SIGMAS_95 = float(np.sqrt(-2 * np.log(0.05)))
_FACTORS = (1, 2, 5, 10, 20, 50, 100)


class FloorEllipse(NamedTuple):
    """The half axes of an ellipse in m, the longer one first, and the angle of the longer one in rad."""

    major_m: float
    minor_m: float
    angle_rad: float


def covariance_ellipse(covariance_m2: Array) -> FloorEllipse:
    """Return the region of 95 % of a covariance (2, 2).

    Examples
    --------
    >>> major_m, minor_m, angle_rad = covariance_ellipse(np.diag([1.0, 4.0]))
    >>> round(major_m / minor_m, 9), round(abs(angle_rad), 6)
    (2.0, 1.570796)
    """
    variances, directions = np.linalg.eigh(covariance_m2)
    minor_m, major_m = (SIGMAS_95 * np.sqrt(np.maximum(variances, 0.0))).tolist()
    return FloorEllipse(major_m, minor_m, float(np.arctan2(directions[1, 1], directions[0, 1])))


def enlargement(covariances_m2: Sequence[Array] | Array, radius_m: float) -> int:
    """Return the factor, at least 1, that gives usual ellipses of covariances (n, 2, 2) about a radius."""
    covariances_m2 = np.asarray(covariances_m2, dtype=np.float64).reshape(-1, 2, 2)
    if not len(covariances_m2):
        return 1
    usual_m = SIGMAS_95 * np.sqrt(np.median(covariances_m2[:, [0, 1], [0, 1]]))
    fitting = [factor for factor in _FACTORS if factor * usual_m <= radius_m]
    return fitting[-1] if fitting else 1


_GROUND: RGB = (24, 24, 28)
_FLOOR: RGB = (36, 36, 42)
_GRID: RGB = (52, 52, 59)
_EDGE: RGB = (130, 130, 138)
_TEXT: RGB = (190, 190, 196)
_REFERENCE: RGB = (240, 240, 240)
_TRAIL_NS = 15 * NS_PER_S
_HEADING_M = 0.3
_STEPS_M = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
_MOST_LINES = 12
_FILL = 0.32
_LONGEST_NAME = 24
# Trails fade to this share of their colour.
_OLDEST = 0.18
_CIRCLE = np.linspace(0.0, 2 * np.pi, 49)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The constant part of a video.

    Attributes
    ----------
    cameras : the names of the cameras.
    colours : by robot; other robots are not drawn.
    rig : the rig of the tracks, with the floor and its reference points; None: the map has only the grid.
    low_m, high_m : (2,), the lowest and the highest x and y of the visible part of the floor.
    enlarged : factor on the ellipses.
    fade_ns : a robot without a newer pose disappears after this time.
    run : the run of the tracks.
    """

    cameras: tuple[str, ...]
    colours: Mapping[str, RGB]
    rig: Rig | None
    low_m: Array
    high_m: Array
    enlarged: int
    fade_ns: int
    run: str


@dataclass(slots=True)
class _Robot:
    """The newest pose of a robot, the log time of that pose, and its recent points with their log times."""

    track: Track
    time_ns: int
    points: deque[tuple[int, float, float]] = field(default_factory=deque)


class FloorMap:
    """The map of the floor with x to the right and y upward, and the robots that were seen last.

    Parameters
    ----------
    size_px : width and height.
    font_px : size of the text.
    """

    def __init__(self, scene: Scene, size_px: tuple[int, int], font_px: int) -> None:
        self._scene, self._size_px, self._font_px = scene, size_px, font_px
        self._robots: dict[str, _Robot] = {}
        width, height = size_px
        self._line_px = max(font_px // 7, 1)
        # Room for the numbers of the axes.
        room = np.array([width - 4.6 * font_px, height - 3.2 * font_px])
        low, high = scene.low_m, scene.high_m
        self._scale = float((room / (high - low)).min())
        self._low_m = low
        drawn = (high - low) * self._scale
        self._start_px = np.array([3.2 * font_px, 0.8 * font_px]) + (room - drawn) / 2
        self._top_px = self._start_px[1] + drawn[1]
        self._ground = self._draw_ground(scene.rig, low, high)

    def to_px(self, points_m: Array) -> Array:
        """Return the places (n, 2) on the map, from the centre of its first pixel, of floor points (n, 2)."""
        offsets = (points_m - self._low_m) * self._scale
        return np.asarray(np.stack([self._start_px[0] + offsets[:, 0], self._top_px - offsets[:, 1]], axis=1))

    def add(self, tracks: Tracks, time_ns: int) -> None:
        """Show poses of a log time from now on."""
        for track in tracks.tracks:
            numbers = [track.x_m, track.y_m, track.heading_rad or 0.0]
            if track.robot not in self._scene.colours or not np.isfinite(numbers).all():
                continue
            robot = self._robots.setdefault(track.robot, _Robot(track, time_ns))
            robot.track, robot.time_ns = track, time_ns
            # A trail shows the sightings, not predictions.
            if track.coasting_ns is None:
                robot.points.append((time_ns, track.x_m, track.y_m))

    def draw(self, time_ns: int) -> Picture:
        """Return the map (height, width, 3) at a log time."""
        for name, robot in list(self._robots.items()):
            while robot.points and time_ns - robot.points[0][0] > _TRAIL_NS:
                robot.points.popleft()
            if not robot.points and time_ns - robot.time_ns > self._scene.fade_ns:
                del self._robots[name]
        canvas = Canvas(self._ground.copy())
        seen = {
            name: robot
            for name, robot in sorted(self._robots.items())
            if time_ns - robot.time_ns <= self._scene.fade_ns
        }
        for name, robot in sorted(self._robots.items()):
            self._draw_trail(canvas, robot, self._scene.colours[name], time_ns)
        self._draw_ellipses(canvas, seen)
        for name, robot in seen.items():
            self._draw_robot(canvas, robot.track, self._scene.colours[name])
        for name, robot in seen.items():
            self._draw_name(canvas, name, robot.track)
        return canvas.picture

    def _draw_ground(self, rig: Rig | None, low: Array, high: Array) -> Picture:
        width, height = self._size_px
        canvas = Canvas(np.full((height, width, 3), _GROUND[::-1], dtype=np.uint8))
        corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
        floor = rig.floor if rig is not None else None
        if floor is not None:
            edge = np.array([[0, 0], [floor.width_m, 0], [floor.width_m, floor.depth_m], [0, floor.depth_m]])
            canvas.fill(self.to_px(edge), _FLOOR)
        else:
            canvas.fill(self.to_px(corners), _FLOOR)
        self._draw_grid(canvas, low, high)
        if floor is not None:
            canvas.line(self.to_px(edge), _EDGE, 1, is_closed=True)
        for point in rig.reference_points if rig is not None else ():
            self._draw_reference(canvas, point.name, np.array([[point.x_m, point.y_m]]))
        return canvas.picture

    def _draw_grid(self, canvas: Canvas, low: Array, high: Array) -> None:
        span = float((high - low).max())
        step = next((m for m in _STEPS_M if span / m <= _MOST_LINES), span)
        size = self._font_px - 1
        bottom = self.to_px(low[None])[0]
        for axis in (0, 1):
            first, last = int(np.ceil(low[axis] / step - 1e-9)), int(np.floor(high[axis] / step + 1e-9))
            for value in np.arange(first, last + 1) * step:
                ends = np.array([low, high])
                ends[:, axis] = value
                line = self.to_px(ends)
                canvas.line(line, _GRID)
                text = f"{value:g}"
                if (unit := value + step > high[axis] + 1e-9) and axis == 0:
                    text += " m"
                width, height = text_size(text, size)
                if axis == 0:
                    canvas.text((line[0, 0] - width / 2, bottom[1] + 1.6 * size), text, size, _TEXT)
                else:
                    text = f"{text} m" if unit else text
                    width = text_size(text, size)[0]
                    canvas.text((bottom[0] - width - 0.5 * size, line[0, 1] + height / 2), text, size, _TEXT)

    def _draw_reference(self, canvas: Canvas, name: str, point_m: Array) -> None:
        at, arm, size = self.to_px(point_m)[0], 0.45 * self._font_px, self._font_px
        for direction in ([arm, 0.0], [0.0, arm]):
            canvas.line(np.array([at - direction, at + direction]), _REFERENCE)
        canvas.text(
            at + np.array([0.45 * size, -0.45 * size]),
            plain_text(name, longest=_LONGEST_NAME),
            size,
            _REFERENCE,
            halo=_FLOOR,
        )

    def _draw_trail(self, canvas: Canvas, robot: _Robot, colour: RGB, time_ns: int) -> None:
        if len(robot.points) < 2:
            return
        times_ns = np.array([point[0] for point in robot.points])
        line = self.to_px(np.array([point[1:] for point in robot.points]))
        ages = (time_ns - times_ns) / _TRAIL_NS
        for n in range(1, len(line)):
            if times_ns[n] - times_ns[n - 1] <= self._scene.fade_ns:
                share = _OLDEST + (1 - _OLDEST) * max(1 - float(ages[n]), 0.0)
                canvas.line(line[n - 1 : n + 1], _mix(colour, share), self._line_px)

    def _draw_ellipses(self, canvas: Canvas, robots: Mapping[str, _Robot]) -> None:
        outlines = []
        for name, robot in robots.items():
            track = robot.track
            if track.covariance_m2 is None or not np.isfinite(track.covariance_m2).all():
                continue
            major_m, minor_m, angle = covariance_ellipse(track.covariance_m2[:2, :2])
            round_m = self._scene.enlarged * np.stack([major_m * np.cos(_CIRCLE), minor_m * np.sin(_CIRCLE)])
            turn = np.array([[cos(angle), -sin(angle)], [sin(angle), cos(angle)]])
            outline = self.to_px((turn @ round_m).T + np.array([track.x_m, track.y_m]))
            outlines.append((outline, self._scene.colours[name]))
        filled = Canvas(canvas.picture.copy())
        for outline, colour in outlines:
            filled.fill(outline, colour)
        if outlines:
            mixed = canvas.picture + _FILL * (filled.picture.astype(np.float32) - canvas.picture)
            canvas.picture[:] = np.round(mixed).astype(np.uint8)
        for outline, colour in outlines:
            canvas.line(outline, colour)

    def _draw_robot(self, canvas: Canvas, track: Track, colour: RGB) -> None:
        radius = 0.5 * self._font_px
        at = self.to_px(np.array([[track.x_m, track.y_m]]))[0]
        if track.heading_rad is not None:
            ahead = np.array([cos(track.heading_rad), -sin(track.heading_rad)])
            aside = np.array([ahead[1], -ahead[0]])
            length = max(_HEADING_M * self._scale, 2.4 * radius)
            tip = at + length * ahead
            canvas.line(np.array([at, tip - radius * ahead]), colour, self._line_px)
            back = tip - 1.3 * radius * ahead
            canvas.fill(np.array([tip, back + 0.6 * radius * aside, back - 0.6 * radius * aside]), colour)
        if track.coasting_ns is None:
            canvas.disc(at, radius, colour)
        else:
            canvas.disc(at, radius, _FLOOR)
            canvas.disc(at, radius, colour, self._line_px)

    def _draw_name(self, canvas: Canvas, name: str, track: Track) -> None:
        size = self._font_px
        at = self.to_px(np.array([[track.x_m, track.y_m]]))[0]
        text = plain_text(name, longest=_LONGEST_NAME)
        width = text_size(text, size)[0]
        x = at[0] + 0.8 * size
        # A name ends inside of the map.
        if x + width > self._size_px[0] - 0.3 * size:
            x = at[0] - 0.8 * size - width
        canvas.text((x, at[1] - 0.6 * size), text, size, self._scene.colours[name], halo=_FLOOR)


def _mix(colour: RGB, share: float) -> RGB:
    """Return a colour in front of the floor with a share of cover."""
    red, green, blue = (
        round(back + share * (front - back)) for front, back in zip(colour, _FLOOR, strict=True)
    )
    return red, green, blue
