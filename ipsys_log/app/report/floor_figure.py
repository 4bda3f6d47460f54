"""The floor to scale: calibration points with their errors, and the tracks of robots."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.quiver import Quiver
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from ipsys_log.app.report.accuracy import Accuracy
from ipsys_log.app.report.errors_figure import count_rows, draw_errors
from ipsys_log.app.report.figures import add_panel, legend_label, name_cameras, save_figure
from ipsys_log.app.report.styles import GRID, REST, camera_styles, robot_colour, robot_line, shorten
from ipsys_log.engine.provenance import newest_run
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import TRUTH_TOPIC, CameraEvaluation, Evaluation, ReferencePoint, Rig
from ipsys_log.messages.channels import MEASUREMENTS, TRACKS, TRUTH
from ipsys_log.sinks.selection import rig_in_force
from ipsys_log.statistics.accuracy import CROSS_VALIDATION
from ipsys_log.statistics.calibration_points import Place, locate_measurements
from ipsys_log.statistics.ground_truth import gather_tracks
from ipsys_log.units import CM_PER_M

_GRID_M = 0.5
# The factor of the arrows is so large that most arrows are shorter than this part of the floor.
_ARROW_SHARE = 0.1
_KEY_SHARE = 0.03
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500)
_MOST_ROBOTS = 6

Lines = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True, slots=True, eq=False)
class FloorData:
    """The drawn data of a session.

    ``tracks`` and ``truth`` are (n, 2) in m by robot, with NaN at the breaks of a line.
    """

    rig: Rig | None
    places: Sequence[Place]
    run: str | None
    evaluation: Evaluation | None
    tracks: Lines
    truth: Lines

    def rows(self) -> list[CameraEvaluation]:
        """Return the rows with residuals to draw as arrows: errors against the tape, which every lab has."""
        rows = self.evaluation.cameras if self.evaluation else ()
        return [
            row for row in rows if row.against == "tape" and row.residuals and row.scheme != CROSS_VALIDATION
        ]


def draw_floor(axes: Axes, scene: FloorData, styles: Mapping[str, tuple[str, str]]) -> None:
    """Draw the floor, tracks, points and errors of a scene."""
    around_m = [place.point_m[:2] for place in scene.places]
    if not around_m and not (scene.rig and scene.rig.floor):
        lines = (*scene.tracks.values(), *scene.truth.values())
        around_m = [line[~np.isnan(line).any(axis=1)] for line in lines]
    draw_ground(axes, scene.rig, around_m)
    _draw_tracks(axes, scene)
    _draw_places(axes, scene)
    title = _draw_errors(axes, scene, styles)
    axes.set_title(title, loc="left", fontsize=10)


def draw_ground(axes: Axes, rig: Rig | None, around_m: Sequence[NDArray[np.float64]]) -> None:
    """Draw the floor to scale with its reference points.

    Parameters
    ----------
    rig : rig with the floor and the reference points; None: the map shows the area of ``around_m``.
    around_m : points (2,) or (n, 2) on the floor that must be visible.
    """
    floor = rig.floor if rig else None
    if floor is not None:
        axes.add_patch(
            Rectangle((0, 0), floor.width_m, floor.depth_m, fill=False, ec="black", lw=1.5, zorder=1)
        )
    square = square_around(rig, around_m)
    show_square(axes, square)
    axes.set(aspect="equal", xlabel="x in m", ylabel="y in m")
    axes.xaxis.set_major_locator(_steps(square.half))
    axes.yaxis.set_major_locator(_steps(square.half))
    axes.grid(color=GRID, lw=0.7)
    axes.set_axisbelow(True)
    draw_references(axes, rig.reference_points if rig else ())


class Square(NamedTuple):
    """The part of the floor on a map: its centre (2,) and half of its side, in m.

    With square axes, a square part has the same scale in both directions.
    """

    middle: NDArray[np.float64]
    half: float


def square_around(rig: Rig | None, around_m: Sequence[NDArray[np.float64]]) -> Square:
    """Return the square that has room for the rig's floor and for points (2,) or (n, 2)."""
    points_m = [*around_m]
    if rig is not None and rig.floor is not None:
        points_m += [np.zeros(2), np.array([rig.floor.width_m, rig.floor.depth_m])]
    together_m = np.vstack(points_m)
    low, high = together_m.min(axis=0), together_m.max(axis=0)
    return Square((low + high) / 2, max(0.54 * float((high - low).max()), 0.25))


def show_square(axes: Axes, square: Square) -> None:
    """Set the limits of a map."""
    (x, y), half = square
    axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half))


def draw_references(axes: Axes, points: Sequence[ReferencePoint]) -> None:
    """Draw the reference points with their names."""
    for point in points:
        axes.plot(point.x_m, point.y_m, "+", color="black", ms=11, mew=1.6, zorder=5)
        axes.annotate(
            shorten(point.name), (point.x_m, point.y_m), (5, 5), textcoords="offset points", weight="bold",
            parse_math=False, clip_on=True, in_layout=False,
        )  # fmt: skip


def _steps(half_m: float) -> MultipleLocator:
    step_m = _GRID_M
    while half_m / step_m > 8:
        step_m *= 2
    return MultipleLocator(step_m)


def _draw_tracks(axes: Axes, scene: FloorData) -> None:
    numbers = {name: number for number, name in enumerate(sorted({*scene.tracks, *scene.truth}))}
    for name, line in scene.truth.items():
        axes.plot(*line.T, "--", color="black", lw=0.8, zorder=2.5, label="_" + name)
    for name, line in scene.tracks.items():
        colour, style = robot_colour(numbers[name]), robot_line(numbers[name])
        axes.plot(*line.T, style, color=colour, lw=1.6, zorder=2, label="_" + name)
        # The dots show a stationary robot, which has no visible line.
        axes.plot(*line.T, ".", color=colour, ms=2.2, zorder=2)
    for name in islice(scene.tracks, _MOST_ROBOTS):
        axes.plot([], [], robot_line(numbers[name]), color=robot_colour(numbers[name]), lw=1.6, label=name)
    if len(scene.tracks) > _MOST_ROBOTS:
        axes.plot([], [], "-", color=REST, label=f"{len(scene.tracks) - _MOST_ROBOTS} more robots")
    if scene.truth:
        axes.plot([], [], "--", color="black", lw=0.8, label="ground truth")


def _draw_places(axes: Axes, scene: FloorData) -> None:
    tested = {residual.measurement for row in scene.rows() for residual in row.residuals}
    rest = [place for place in scene.places if place.id not in tested]
    for kind, colour in (("training", REST), ("measured", REST), ("test", "#6A6A6A")):
        points_m = np.array([place.point_m[:2] for place in rest if place.kind == kind])
        if len(points_m):
            name = "held out, not detected" if kind == "test" and scene.evaluation else f"{kind} point"
            fill = "none" if kind == "test" else colour
            axes.plot(*points_m.T, "o", color=colour, mfc=fill, ms=3.5, zorder=3, label=name)


def _draw_errors(axes: Axes, scene: FloorData, styles: Mapping[str, tuple[str, str]]) -> str:
    """Draw the arrows of the errors; return the title that describes them."""
    rows = scene.rows()
    if not rows or scene.evaluation is None:
        return f"Floor and tracks of run {scene.run}" if scene.tracks else "Floor"
    residuals = [residual for row in rows for residual in row.residuals]
    span_m = axes.get_xlim()[1] - axes.get_xlim()[0]
    factor = arrow_factor([r.predicted_m - r.world_m for r in residuals], span_m)
    middles_m: dict[str, NDArray[np.float64]] = {}
    for row in rows:
        colour, shape = styles[row.camera]
        start_m = np.array([residual.world_m[:2] for residual in row.residuals])
        error_m = np.array([residual.predicted_m[:2] for residual in row.residuals]) - start_m
        axes.plot(
            *start_m.T,
            shape,
            color=colour,
            ms=4.5,
            zorder=4,
            label=legend_label(f"held out, {row.camera}", len(rows)),
        )
        arrows = draw_arrows(axes, start_m, error_m, factor, color=colour)
        middles_m[row.camera] = start_m.mean(axis=0)
    name_cameras(axes, middles_m, {camera: colour for camera, (colour, _) in styles.items()})
    draw_key(axes, arrows, factor)
    times = f", arrows {factor} times true length" if factor > 1 else ""
    return f"Errors of {scene.evaluation.model} at held-out points{times}"


def arrow_factor(errors_m: Sequence[NDArray[np.float64]], span_m: float) -> int:
    """Return the factor of error arrows (n, 2 or 3) on a map: most are visible, and none is too long."""
    usual_m = float(np.quantile(np.linalg.norm(np.array(errors_m)[:, :2], axis=1), 0.9))
    fitting = [factor for factor in _FACTORS if factor * usual_m <= _ARROW_SHARE * span_m]
    return fitting[-1] if fitting else 1


def draw_arrows(
    axes: Axes,
    start_m: NDArray[np.float64],
    error_m: NDArray[np.float64],
    factor: int,
    *values: Any,
    **look: Any,
) -> Quiver:
    """Draw errors (n, 2) at points (n, 2), longer by a factor; optional ``values`` (n,) give the colours."""
    return axes.quiver(
        *start_m.T, *error_m.T, *values, angles="xy", scale_units="xy", scale=1 / factor, width=0.0035,
        headwidth=4, headlength=5, headaxislength=4.5, minlength=0, zorder=4, **look,
    )  # fmt: skip


def draw_key(axes: Axes, arrows: Quiver, factor: int) -> None:
    """Draw the key of the arrows at the top right of the axes: the length of 1 cm, or of some cm."""
    span_m = axes.get_xlim()[1] - axes.get_xlim()[0]
    size_cm = next((cm for cm in (1, 2, 5, 10, 20) if factor * cm / CM_PER_M > _KEY_SHARE * span_m), 50)
    length_m = size_cm / CM_PER_M
    axes.quiverkey(
        arrows, 0.99 - factor * length_m / span_m / 2, 1.028, length_m, f"{size_cm} cm", labelpos="W",
        coordinates="axes", color="black",
    )  # fmt: skip


_DPI = 100
# The axes of the floor: distance to the top of the figure, and length of a side.
_TOP_IN = 0.65
_SIDE_IN = 6.3
# A line joins two positions of a track only if a robot can have moved from one to the other.
_STEP_M = 0.5
_GAP_NS = 500_000_000


def draw_session(session: Session, accuracies: Sequence[Accuracy], path: Path) -> None:
    """Draw a session into a figure of about 1400 x 800 pixels; without accuracies, the left side alone.

    The left side shows the floor to scale: measured points, tracks and, if known, the ground truth. An arrow
    shows the error of the first model at each held-out point. The title states the factor of the arrows. The
    right side shows every error of every model and camera, in cm; it exists only with accuracies.
    """
    scene = read_floor(session, accuracies)
    rows = count_rows(accuracies)
    # Rows of text need some height. With more than about 28 rows, the figure grows.
    figure = Figure(figsize=(14 if rows else 7.3, max(8.0, 1.6 + 0.23 * rows)), dpi=_DPI)
    width, height = figure.get_size_inches()
    low_in = height - _TOP_IN - _SIDE_IN
    axes = add_panel(figure, 0.65, low_in, _SIDE_IN, _SIDE_IN)
    styles = camera_styles(row.camera for a in accuracies if a.evaluation for row in a.evaluation.cameras)
    draw_floor(axes, scene, styles)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="upper left", ncols=6, fontsize=8, frameon=False,
        bbox_to_anchor=(0.4 / width, (low_in - 0.5) / height),
    )  # fmt: skip
    if rows:
        draw_errors(figure, accuracies, styles, left_in=7.3, top_in=_TOP_IN)
    save_figure(figure, path)


def read_floor(session: Session, accuracies: Sequence[Accuracy]) -> FloorData:
    """Return the data of a session to draw; raise IpsysError if there are none."""
    evaluated = [accuracy for accuracy in accuracies if accuracy.evaluation is not None]
    runs = [accuracy.run for accuracy in (evaluated or accuracies)]
    run = runs[0] if runs else newest_run(session, TRACKS)
    rig = rig_in_force(session, [run] if run else [])
    places, _ = locate_measurements(session.payloads(session.topics(MEASUREMENTS)), rig)
    topics = session.topics(TRACKS, run) if run else []
    truth = [TRUTH_TOPIC] if TRUTH_TOPIC in session.topics(TRUTH) else []
    scene = FloorData(
        rig,
        places,
        run,
        evaluated[0].evaluation if evaluated else None,
        _lines(session, topics, rig),
        _lines(session, truth, rig),
    )
    if not (places or scene.tracks or scene.truth or (rig and rig.floor)):
        raise IpsysError(f"{session}: nothing to draw: there is no floor, calibration point or track")
    return scene


def _lines(session: Session, topics: Sequence[str], rig: Rig | None) -> dict[str, NDArray[np.float64]]:
    """Return the tracks on the floor by robot, (n, 2) in m, one point per instant, NaN at a break."""
    lines: dict[str, list[NDArray[np.float64]]] = defaultdict(list)
    for marker_id, track in sorted(gather_tracks(session.messages(topics)).items() if topics else ()):
        # A track may have several poses with the same time. The last of them uses all cameras.
        times_ns, last = np.unique(track.times_ns[::-1], return_index=True)
        points_m = track.points_m[::-1][last][:, :2]
        broken = (np.linalg.norm(np.diff(points_m, axis=0), axis=1) > _STEP_M) | (np.diff(times_ns) > _GAP_NS)
        name = rig.robot_of(marker_id) if rig else f"marker_{marker_id}"
        # A robot may have several markers: the lines of all are one line with breaks.
        breaks = (*np.flatnonzero(broken) + 1, len(points_m))
        lines[name].append(np.insert(points_m, breaks, np.nan, axis=0))
    return {name: np.concatenate(parts)[:-1] for name, parts in lines.items()}
