"""The scene of a Rerun recording: floor, calibration points, layout, and trails of robots that fade."""

import heapq
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ipsys_log.messages import Floor, Message, Rig
from ipsys_log.sinks.colours import KIND_COLOURS
from ipsys_log.statistics.calibration_points import KINDS, Place

# The viewer shows the first timeline; the times in the payloads belong to it.
TIMELINES = ("publish_time", "log_time")

LEGEND = "legend"
_LEGEND = """\
| sign | meaning |
|---|---|
| large point, arrow, line | track of a robot, its heading, its last 15 s |
| short second arrow | upward direction of a robot that can tilt |
| small point | position from one camera, in the colour of the camera |
| grey point, thin grey line | ground truth |
| grey points | calibration points; yellow: test points |
| white points | reference points of the tape |
| red and green arrows | x and y axes of the floor |
| green outline in an image | corners of a detected marker, with its id |
"""

# Columns of tiles per row of a large grid of cameras, which is as wide as two fifths of the window.
_TILES_ACROSS = 0.7
# Symbols have their usual size up to a floor of this width or depth.
_LAB_M = 5.0
# The vertical angle of view of the viewer is 55 degrees: the eye is at nearly the height of what it sees. The
# view of the floor is wider than high.
_EYE_HEIGHT = 1.15
_VIEW_ASPECT = 1.3
# A longer legend hides its plot.
_MOST_IN_LEGEND = 8
_GRID_M = 0.5
_MOST_LINES = 100
_TRAIL_S = 15.0
_GREY = (60, 60, 60)
_LIGHT = (150, 150, 150)


class Plot(NamedTuple):
    """The title of a plot of time series, and the number of its series."""

    title: str
    series: int


@contextmanager
def open_recording(name: str) -> Iterator[rr.RecordingStream]:
    """Open a separate stream, without the clock and the counter that Rerun adds to each message."""
    recording = rr.RecordingStream("ipsys", send_properties=False)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    recording.send_recording_name(name)
    try:
        yield recording
    finally:
        recording.disconnect()


def symbol_scale(rig: Rig | None) -> float:
    """Return the factor of the size of points and arrows: in a hall, those of a lab are too small to see."""
    size_m = 0.0 if rig is None or rig.floor is None else max(rig.floor.width_m, rig.floor.depth_m)
    return max(1.0, size_m / _LAB_M) if math.isfinite(size_m) else 1.0


def draw_rig(recording: rr.RecordingStream, rig: Rig | None) -> None:
    """Draw the floor with its grid, the axes and the reference points, as far as the rig has them."""
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if rig is None:
        return
    if rig.floor is not None and math.isfinite(rig.floor.width_m + rig.floor.depth_m):
        _draw_floor(recording, rig.floor)
    if rig.reference_points:
        points = rr.Points3D(
            [(p.x_m, p.y_m, 0.0) for p in rig.reference_points],
            labels=[p.name for p in rig.reference_points],
            colors=[(255, 255, 255)],
            radii=[0.03 * symbol_scale(rig)],
            show_labels=True,
        )
        recording.log("world/reference_points", points, static=True)


def _draw_floor(recording: rr.RecordingStream, floor: Floor) -> None:
    width_m, depth_m = floor.width_m, floor.depth_m
    outline = [(0, 0, 0), (width_m, 0, 0), (width_m, depth_m, 0), (0, depth_m, 0), (0, 0, 0)]
    thin, thick = rr.Radius.ui_points(0.5), rr.Radius.ui_points(1.5)
    recording.log("world/floor", rr.LineStrips3D([outline], colors=[_LIGHT], radii=thick), static=True)
    step_m = _GRID_M
    while max(width_m, depth_m) / step_m > _MOST_LINES:
        step_m *= 2
    across = [[(x, 0, 0), (x, depth_m, 0)] for x in np.arange(step_m, width_m, step_m)]
    along = [[(0, y, 0), (width_m, y, 0)] for y in np.arange(step_m, depth_m, step_m)]
    if across or along:
        lines = rr.LineStrips3D([*across, *along], colors=[_GREY], radii=thin)
        recording.log("world/floor/grid", lines, static=True)
    axes = rr.Arrows3D(
        origins=[(0, 0, 0), (0, 0, 0)],
        vectors=[(step_m, 0, 0), (0, step_m, 0)],
        colors=[(235, 95, 60), (0, 180, 130)],
        radii=[0.012],
        labels=["x", "y"],
        show_labels=True,
    )
    recording.log("world/floor/axes", axes, static=True)


def draw_places(recording: rr.RecordingStream, places: Iterable[Place], scale: float = 1.0) -> None:
    """Draw the calibration points, one entity for each kind; their ids are labels that show on demand."""
    places = list(places)
    for kind in KINDS:
        places_of_kind = [place for place in places if place.kind == kind]
        if places_of_kind:
            points = rr.Points3D(
                [place.point_m for place in places_of_kind],
                labels=[place.id for place in places_of_kind],
                colors=[KIND_COLOURS[kind]],
                radii=[0.025 * scale],
                show_labels=False,
            )
            recording.log(["world", "places", kind], points, static=True)


def layout(
    cameras: Sequence[str],
    trails: Sequence[str],
    rig: Rig | None,
    events: bool,
    plots: Mapping[str, Plot] | None = None,
    sizes_px: Mapping[str, tuple[int, int]] | None = None,
) -> rrb.Blueprint:
    """Return the layout: cameras on the left, the floor from above on the right, the rest below the floor.

    Parameters
    ----------
    cameras : the cameras with frames or markers.
    trails : paths of the entities whose last seconds are shown together.
    plots : the plots of time series, by the entity above the series.
    sizes_px : width and height of the frames by camera, as far as they are known.
    """
    right: list[rrb.View | rrb.Container] = [_floor_view(trails, rig)]
    right += [_plot(entity, plot) for entity, plot in (plots or {}).items()]
    below = [rrb.TextDocumentView(origin=f"/{LEGEND}", name="Legend")]
    lists = [rrb.TextLogView(origin="/events", name="Events"), *below] if events else below
    right.append(rrb.Tabs(*lists))
    floor = rrb.Vertical(*right, row_shares=[5, *[1.2] * len(plots or {}), 1.2])
    views = [_camera_view(camera, (sizes_px or {}).get(camera)) for camera in cameras]
    # Frames are wide: up to three of them fit best in one column, beside a square floor. The tiles of a hall
    # keep the shape of a frame: there are more rows than columns.
    columns = 1 if len(views) <= 3 else max(2, math.floor(math.sqrt(len(views) * _TILES_ACROSS)))
    whole = (
        rrb.Horizontal(rrb.Grid(*views, grid_columns=columns), floor, column_shares=[2, 3])
        if views
        else floor
    )
    return rrb.Blueprint(
        whole,
        rrb.TimePanel(state="collapsed", timeline=TIMELINES[0]),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )


def _camera_view(camera: str, size_px: tuple[int, int] | None) -> rrb.Spatial2DView:
    """Return the view of a camera; without bounds, labels below the frame make its image smaller."""
    bounds = None if size_px is None else rrb.VisualBounds2D(x_range=(0, size_px[0]), y_range=(0, size_px[1]))
    return rrb.Spatial2DView(origin=f"/cameras/{camera}", name=camera, visual_bounds=bounds)


def _plot(entity: str, plot: Plot) -> rrb.TimeSeriesView:
    legend = rrb.PlotLegend(visible=plot.series <= _MOST_IN_LEGEND)
    return rrb.TimeSeriesView(origin=f"/{entity}", name=plot.title, plot_legend=legend)


def draw_legend(recording: rr.RecordingStream) -> None:
    """Describe the signs of the floor view."""
    text = rr.TextDocument(_LEGEND, media_type="text/markdown")
    recording.log(LEGEND, text, static=True)


def _floor_view(trails: Sequence[str], rig: Rig | None) -> rrb.Spatial3DView:
    now = rrb.TimeRangeBoundary.cursor_relative()
    since = rrb.TimeRangeBoundary.cursor_relative(seconds=-_TRAIL_S)
    ranges = rrb.VisibleTimeRanges(
        [rrb.VisibleTimeRange(timeline=timeline, start=since, end=now) for timeline in TIMELINES]
    )
    eye = None
    if rig is not None and rig.floor is not None:
        width_m, depth_m = rig.floor.width_m, rig.floor.depth_m
        middle = (width_m / 2, depth_m / 2, 0.0)
        # The view is straight down, with y upward in the image, as on the plan of the tape measurements.
        above = (width_m / 2, depth_m / 2, _EYE_HEIGHT * max(width_m / _VIEW_ASPECT, depth_m))
        eye = rrb.EyeControls3D(position=above, look_target=middle, eye_up=(0.0, 1.0, 0.0))
    return rrb.Spatial3DView(
        origin="/world",
        name="Floor",
        overrides=dict.fromkeys(trails, ranges),
        line_grid=False,
        eye_controls=eye,
    )


Entity = tuple[str, ...]


class Fading:
    """The times of the last sightings of entities; ``clear`` is called when an entity is overdue.

    The arguments of ``clear`` are the entity and this instant, in publish time and in log time (ns).
    """

    def __init__(self, clear: Callable[[Entity, int, int], None]) -> None:
        self._clear = clear
        self._seen: dict[Entity, tuple[int, int]] = {}  # expiry time, in publish and in log time
        # One entry for each entity, not later than its expiry; the entity may have a newer drawing by then.
        self._checks: list[tuple[int, Entity]] = []

    def seen(self, entity: Entity, message: Message, fade_ns: int) -> None:
        """Note that an entity is drawn; with 0 it stays until the next drawing."""
        if fade_ns <= 0:
            return
        overdue_ns = message.log_time_ns + fade_ns
        if entity not in self._seen:
            heapq.heappush(self._checks, (overdue_ns, entity))
        self._seen[entity] = (message.publish_time_ns + fade_ns, overdue_ns)

    def advance(self, log_time_ns: int) -> None:
        """Clear the expired entities."""
        while self._checks and self._checks[0][0] < log_time_ns:
            _, entity = self._checks[0]
            publish_ns, overdue_ns = self._seen[entity]
            if overdue_ns < log_time_ns:
                heapq.heappop(self._checks)
                del self._seen[entity]
                self._clear(entity, publish_ns, overdue_ns)
            else:
                heapq.heapreplace(self._checks, (overdue_ns, entity))


Point = tuple[float, float, float]
Key = tuple[str | None, str]


@dataclass(frozen=True, slots=True)
class Segment:
    """A path from one pose to the next, in m, and the time of the second pose in ns."""

    start_m: Point
    end_m: Point
    publish_time_ns: int
    log_time_ns: int


@dataclass(frozen=True, slots=True)
class _Pose:
    publish_time_ns: int
    log_time_ns: int
    point_m: Point


class Trails:
    """The trails of robots: it joins the poses of each robot, and passes each segment to ``draw``.

    Several poses of one instant count as the last of them: tracks of earlier versions have one from each
    camera. So a pose waits until the next instant. There is no line over a gap.
    """

    def __init__(self, draw: Callable[[Key, Segment], None]) -> None:
        self._draw = draw
        self._before: dict[Key, _Pose] = {}
        self._waiting: dict[Key, _Pose] = {}
        self._gap_ns: dict[Key, int] = {}

    def add(self, key: Key, message: Message, point_m: Point, gap_ns: int) -> None:
        """Add a pose; poses with more than ``gap_ns`` of silence between them are not joined."""
        pose = _Pose(message.publish_time_ns, message.log_time_ns, point_m)
        waiting = self._waiting.get(key)
        if waiting is not None and pose.publish_time_ns < waiting.publish_time_ns:
            return
        self._gap_ns[key] = gap_ns
        if waiting is not None and pose.publish_time_ns > waiting.publish_time_ns:
            self._finish(key, waiting)
        self._waiting[key] = pose

    def close(self) -> None:
        """Draw the last segment of each robot."""
        for key, pose in self._waiting.items():
            self._finish(key, pose)
        self._waiting.clear()

    def _finish(self, key: Key, pose: _Pose) -> None:
        before = self._before.get(key)
        self._before[key] = pose
        if before is not None and pose.publish_time_ns - before.publish_time_ns <= self._gap_ns[key]:
            segment = Segment(before.point_m, pose.point_m, pose.publish_time_ns, pose.log_time_ns)
            self._draw(key, segment)
