"""The figures of a session's page: narrow enough for a phone, each with its caption."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from ipsys_log.app.report import calibration_figures, points_figures
from ipsys_log.app.report.advice import has_published, label
from ipsys_log.app.report.drive_figures import draw_tracks, read_drawn_tracks
from ipsys_log.app.report.figures import PAGE_IN, add_bar, has_legend, new_figure, style_axes, svg_data_uri
from ipsys_log.app.report.findings import Findings
from ipsys_log.app.report.floor_figure import draw_ground
from ipsys_log.app.report.paper_figures import (
    HELD_OUT,
    draw_models,
    draw_residuals,
    residual_scale,
    shown_models,
)
from ipsys_log.app.report.styles import robot_colour, shorten
from ipsys_log.app.report.tables import height_note
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Rig
from ipsys_log.statistics.disagreement import PairDisagreement, divide_floor, divide_time
from ipsys_log.units import CM_PER_M, MM_PER_M, NS_PER_S

if TYPE_CHECKING:
    from ipsys_log.statistics.calibrated_cameras import CalibratedCamera

_SPACE = {True: "3D", False: "2D"}

Picture = dict[str, Any]
_CELL_M = 0.25
# Lines of more pairs cannot be told apart.
_MOST_PAIRS = 6


def picture(figure: Figure, caption: str) -> Picture:
    """Return a figure with its caption and its size on the page."""
    width_in, height_in = figure.get_size_inches()
    # The size in pixels reserves the space of a figure while the page loads.
    size = {"width": round(96 * width_in), "height": round(96 * height_in)}
    return {"uri": svg_data_uri(figure), "caption": caption, **size}


def _spaces(findings: Findings) -> tuple[bool, ...]:
    return (True, False) if findings.in_space else (False,)


def models_pictures(findings: Findings) -> list[Picture]:
    """Return figures that compare the models, in space and on the floor."""
    pictures = []
    ranked = findings.ranked()
    for in_space in _spaces(findings):
        figure, axes = new_figure(1.4 + 0.27 * len(ranked))
        draw_models(axes, ranked, in_space)
        handles = [Line2D([], [], color="black", marker="o", ms=5, lw=2), Line2D([], [], **HELD_OUT)]  # type: ignore[arg-type]
        figure.legend(
            handles, ["cross-validation, 95 % interval", "held-out points"],
            loc="outside lower center", ncols=2, frameon=False, fontsize=8,
        )  # fmt: skip
        note = height_note(accuracy.model for accuracy in ranked)
        caption = f"Mean {_SPACE[in_space]} error of each model" + (f" ({note})" if note else "")
        pictures.append(picture(figure, caption))
    return pictures


def residual_pictures(findings: Findings) -> list[Picture]:
    """Return floor maps of the errors of the shown models, all with the same scales."""
    accuracies = shown_models(findings)
    if not accuracies:
        return []
    pictures, scale = [], residual_scale(findings, accuracies)
    hull = "Dashed" if has_legend(len(findings.training_m())) else "Grey line"
    for accuracy in accuracies:
        figure, axes = new_figure(5.6)
        arrows = draw_residuals(axes, findings, accuracy, scale)
        add_bar(figure, arrows, axes, f"{_SPACE[findings.in_space]} error in cm")
        caption = (
            f"Errors of {label(accuracy.model)}, seen from above. An arrow points from the calibration "
            "point to the estimated position; arrows are enlarged. "
            f"{hull}: area of the calibration points of a camera"
        )
        pictures.append(picture(figure, caption))
    return pictures


def learning_pictures(findings: Findings) -> list[Picture]:
    """Return the learning curves over all cameras on random subsets, in space and on the floor."""
    text = "Mean {} error over all cameras, fitted on random subsets. Bars: one standard deviation"
    return _curves_pictures(
        {
            text.format(_SPACE[in_space]): points_figures.mean_curves(findings, in_space)
            for in_space in _spaces(findings)
        }
    )


def published_pictures(findings: Findings) -> list[Picture]:
    """Return the learning curves of each camera on the labelled subsets: figures 10 and 11 of the paper.

    The list is empty if the log has no labelled subsets.
    """
    text = "Mean {} error of camera {} at the held-out points, fitted on the labelled subsets"
    if not has_published(findings.evaluations):
        return []
    return _curves_pictures(
        {
            text.format(_SPACE[in_space], camera): points_figures.camera_curves(findings, camera, in_space)
            for in_space in _spaces(findings)
            for camera in findings.cameras
        }
    )


def _curves_pictures(panels: Mapping[str, points_figures.Curves]) -> list[Picture]:
    """Return one figure per caption, all with the same scale."""
    limits = points_figures.limits_cm(panels.values())
    return [
        picture(points_figures.curves_picture(curves, PAGE_IN, limits), caption)
        for caption, curves in panels.items()
        if curves
    ]


def joint_pictures(findings: Findings) -> list[Picture]:
    """Return the poses and the clocks of the cameras of the joint model, and the residuals in each image.

    With many cameras, only the images with the largest residuals are here.
    """
    cameras = findings.calibrated
    if not cameras:
        return []
    pictures = [
        picture(
            calibration_figures.poses_figure(cameras, findings.rig),
            "Poses of the cameras, with their fields of view on the floor. Arrow: optical axis, to the floor",
        )
    ]
    if calibration_figures.has_clocks(cameras):
        text = (
            "Clock offsets of the cameras. Bars: two standard deviations. A constant clock is the "
            "reference, or that of a camera that saw no drive"
        )
        text = ". ".join([text, *(f"Contradiction: {line}" for line in findings.clock_contradictions)])
        pictures.append(picture(calibration_figures.clocks_figure(cameras), text))
    return pictures + _residuals_pictures(cameras, calibration_figures.first_residuals(cameras))


def other_residual_pictures(findings: Findings) -> list[Picture]:
    """Return the residuals in the images that :func:`joint_pictures` leaves out."""
    first = calibration_figures.first_residuals(findings.calibrated)
    names = [one.camera for one in findings.calibrated if one.residuals is not None]
    return _residuals_pictures(findings.calibrated, [name for name in names if name not in first])


def _residuals_pictures(cameras: Sequence[CalibratedCamera], names: Sequence[str]) -> list[Picture]:
    pictures, most_px = [], calibration_figures.residual_limit_px(cameras)
    known = {one.camera: one for one in cameras}
    for name in names:
        residuals = known[name].residuals
        assert residuals is not None
        caption = (
            f"Corner residuals in the image of {name}, estimated minus measured, as means of cells; "
            f"arrows are enlarged{_left_out(residuals.outliers)}"
        )
        pictures.append(picture(calibration_figures.residuals_figure(known[name], most_px), caption))
    return pictures


def _left_out(outliers: int) -> str:
    if not outliers:
        return ""
    return (
        f". Without {'one sighting that does' if outliers == 1 else f'{outliers} sightings that do'} not fit"
    )


def coverage_picture(findings: Findings) -> Picture | None:
    """Return a map of the floor outside of the fitted points of all cameras; None without fitted points."""
    if not findings.training_m():
        return None
    figure, axes = new_figure(5.2)
    points_figures.draw_coverage(axes, findings)
    return picture(
        figure, "Calibration points of the models. Hatched: floor outside the area of these points"
    )


def tracks_picture(session: Session, run: str | None) -> Picture | None:
    """Return a map of the tracks of a run with their regions and hand-overs; None without tracks."""
    tracks = read_drawn_tracks(session, run) if run is not None else {}
    if not tracks:
        return None
    figure, axes = new_figure(5.4)
    enlarged = draw_tracks(axes, tracks)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return picture(
        figure,
        f"Tracks of run {run}, seen from above. Ellipses: regions that hold 95 % of the errors, "
        f"{enlarged} times as large. White dots: other cameras see the robot from there on",
    )


def overlap_pictures(pairs: Sequence[PairDisagreement], rig: Rig | None) -> list[dict[str, Any]]:
    """Return the floor map of the median disagreement, and its time course for each pair of cameras."""
    return [_floor_picture(pairs, rig), _time_picture(pairs)]


def _floor_picture(pairs: Sequence[PairDisagreement], rig: Rig | None) -> dict[str, Any]:
    figure, axes = new_figure(5.4)
    draw_ground(axes, rig, [pair.points_m for pair in pairs])
    cells = divide_floor(pairs, _CELL_M)
    values_mm = np.array([cell.median_m for cell in cells]) * MM_PER_M
    # A few large values would hide the differences of the others.
    top_mm = float(np.percentile(values_mm, 95)) if len(cells) else 1.0
    shades = axes.scatter([], [], c=[], cmap="viridis_r", vmin=0.0, vmax=top_mm)
    for cell, value_mm in zip(cells, values_mm.tolist(), strict=True):
        corner = cell.x_m - _CELL_M / 2, cell.y_m - _CELL_M / 2
        axes.add_patch(Rectangle(corner, _CELL_M, _CELL_M, fc=shades.to_rgba(value_mm), lw=0, zorder=2))
    add_bar(figure, shades, axes, "median difference of two cameras in mm")
    return picture(
        figure,
        f"Disagreement of the cameras over the floor, all pairs, in cells of {_CELL_M * CM_PER_M:g} cm",
    )


def _time_picture(pairs: Sequence[PairDisagreement]) -> dict[str, Any]:
    figure, axes = new_figure(2.8)
    start_ns = min(int(pair.times_ns[0]) for pair in pairs)
    worst = sorted(pairs, key=lambda pair: -pair.median_m)[:_MOST_PAIRS]
    shown = [pair for pair in pairs if any(pair is one for one in worst)]
    for number, pair in enumerate(shown):
        intervals = divide_time(pair)
        times_s = np.array([one.time_ns - start_ns for one in intervals]) / NS_PER_S
        medians_mm = np.array([one.median_m for one in intervals]) * MM_PER_M
        p95_mm = np.array([one.p95_m for one in intervals]) * MM_PER_M
        colour, name = robot_colour(number), shorten(" and ".join(pair.cameras))
        axes.plot(times_s, medians_mm, ".-", color=colour, lw=1.4, ms=4, label=name)
        axes.plot(times_s, p95_mm, "--", color=colour, lw=0.9)
    axes.set(xlabel="time in s", ylabel="difference in mm", ylim=(0, None))
    style_axes(axes)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    few = (
        f". Shown are the {len(shown)} of {len(pairs)} pairs with the largest medians"
        if len(shown) < len(pairs)
        else ""
    )
    text = "Disagreement of the cameras over time: median (line) and 95 % limit (dashed)"
    return picture(figure, text + few)
