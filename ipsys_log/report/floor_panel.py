"""The floor to scale: measured places with their errors, and the ways of the robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from ipsys_log.messages import CameraEvaluation, Evaluation, Rig
from ipsys_log.offline.errors import CROSS_VALIDATION
from ipsys_log.offline.places import Place
from ipsys_log.report.palette import REST, robot_colour

__all__ = ["Scene", "draw_floor"]

_GRID_M = 0.5
# Arrows are drawn so much longer that most of them span less than this part of the floor.
_ARROW_SHARE = 0.1
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500)
_MOST_ROBOTS = 6

Lines = Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What is drawn of a session; tracks and truth as (n, 2) in m by robot, with NaN where a line breaks."""

    rig: Rig | None
    places: Sequence[Place]
    run: str | None
    evaluation: Evaluation | None
    tracks: Lines
    truth: Lines

    def rows(self) -> list[CameraEvaluation]:
        """Residuals to draw as arrows: against the tape, which every lab has."""
        rows = self.evaluation.cameras if self.evaluation else ()
        return [
            row for row in rows if row.against == "tape" and row.residuals and row.scheme != CROSS_VALIDATION
        ]


def draw_floor(axes: Axes, scene: Scene, styles: Mapping[str, tuple[str, str]]) -> None:
    """Draw all of a scene.

    Parameters
    ----------
    styles : colour and marker shape by camera.
    """
    _draw_ground(axes, scene)
    _draw_tracks(axes, scene)
    _draw_places(axes, scene)
    title = _draw_errors(axes, scene, styles)
    axes.set_title(title, loc="left", fontsize=10)


def _draw_ground(axes: Axes, scene: Scene) -> None:
    floor = scene.rig.floor if scene.rig else None
    points_m = [place.point_m[:2] for place in scene.places]
    if floor is not None:
        axes.add_patch(
            Rectangle((0, 0), floor.width_m, floor.depth_m, fill=False, ec="black", lw=1.5, zorder=1)
        )
        points_m += [np.zeros(2), np.array([floor.width_m, floor.depth_m])]
    if not points_m:
        points_m = [
            line[~np.isnan(line).any(axis=1)] for line in (*scene.tracks.values(), *scene.truth.values())
        ]
    around_m = np.vstack(points_m)
    low, high = around_m.min(axis=0), around_m.max(axis=0)
    # A square part of the world in square axes keeps the scale the same both ways.
    middle, half = (low + high) / 2, max(0.54 * (high - low).max(), 0.25)
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
    axes.set(aspect="equal", xlabel="x in m", ylabel="y in m")
    axes.xaxis.set_major_locator(_steps(half))
    axes.yaxis.set_major_locator(_steps(half))
    axes.grid(color="#E6E6E6", lw=0.7)
    axes.set_axisbelow(True)
    for point in scene.rig.reference_points if scene.rig else ():
        axes.plot(point.x_m, point.y_m, "+", color="black", ms=11, mew=1.6, zorder=5)
        axes.annotate(point.name, (point.x_m, point.y_m), (5, 5), textcoords="offset points", weight="bold")


def _steps(half_m: float) -> MultipleLocator:
    step_m = _GRID_M
    while half_m / step_m > 8:
        step_m *= 2
    return MultipleLocator(step_m)


def _draw_tracks(axes: Axes, scene: Scene) -> None:
    names = sorted({*scene.tracks, *scene.truth})
    colours = {name: robot_colour(number) for number, name in enumerate(names)}
    for name, line in scene.truth.items():
        axes.plot(*line.T, "--", color="black", lw=0.8, zorder=2.5, label="_" + name)
    for name, line in scene.tracks.items():
        axes.plot(*line.T, "-", color=colours[name], lw=1.6, zorder=2)
        # Where a robot only stood, there is no line to see.
        axes.plot(*line.T, ".", color=colours[name], ms=2.2, zorder=2)
    for name in islice(scene.tracks, _MOST_ROBOTS):
        axes.plot([], [], "-", color=colours[name], lw=1.6, label=name)
    if len(scene.tracks) > _MOST_ROBOTS:
        axes.plot([], [], "-", color=REST, label=f"{len(scene.tracks) - _MOST_ROBOTS} more robots")
    if scene.truth:
        axes.plot([], [], "--", color="black", lw=0.8, label="truth")


def _draw_places(axes: Axes, scene: Scene) -> None:
    tested = {residual.measurement for row in scene.rows() for residual in row.residuals}
    rest = [place for place in scene.places if place.id not in tested]
    for kind, colour in (("training", REST), ("measured", REST), ("test", "#6A6A6A")):
        points_m = np.array([place.point_m[:2] for place in rest if place.kind == kind])
        if len(points_m):
            name = "held out, not seen" if kind == "test" and scene.evaluation else f"{kind} place"
            fill = "none" if kind == "test" else colour
            axes.plot(*points_m.T, "o", color=colour, mfc=fill, ms=3.5, zorder=3, label=name)


def _draw_errors(axes: Axes, scene: Scene, styles: Mapping[str, tuple[str, str]]) -> str:
    """The arrows; returns the title that says what they are."""
    rows = scene.rows()
    if not rows or scene.evaluation is None:
        return f"The floor, tracks of run {scene.run}" if scene.tracks else "The floor"
    factor = _factor(rows, axes.get_xlim()[1] - axes.get_xlim()[0])
    for row in rows:
        colour, shape = styles[row.camera]
        start_m = np.array([residual.world_m[:2] for residual in row.residuals])
        error_m = np.array([residual.predicted_m[:2] for residual in row.residuals]) - start_m
        axes.plot(*start_m.T, shape, color=colour, ms=4.5, zorder=4, label=f"held out, {row.camera}")
        arrows = axes.quiver(
            *start_m.T, *error_m.T, color=colour, angles="xy", scale_units="xy", scale=1 / factor,
            width=0.0035, headwidth=4, headlength=5, headaxislength=4.5, minlength=0, zorder=4,
        )  # fmt: skip
    axes.quiverkey(arrows, 0.93, 1.028, 0.01, "1 cm", labelpos="W", coordinates="axes", color="black")
    times = f", drawn {factor} times as long" if factor > 1 else ""
    return f"Errors of {scene.evaluation.model} on held-out places{times}"


def _factor(rows: Sequence[CameraEvaluation], span_m: float) -> int:
    lengths_m = [np.linalg.norm((r.predicted_m - r.world_m)[:2]) for row in rows for r in row.residuals]
    usual_m = float(np.quantile(lengths_m, 0.9))
    fitting = [factor for factor in _FACTORS if factor * usual_m <= _ARROW_SHARE * span_m]
    return fitting[-1] if fitting else 1
