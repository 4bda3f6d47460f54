"""Figures of calibration points and of learning curves: figures 9, 10 and 11 of the paper, and others."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation
from scipy.spatial import ConvexHull, QhullError

from ipsys_log.app.report import advice, figures
from ipsys_log.app.report.findings import Findings
from ipsys_log.app.report.floor_figure import draw_ground
from ipsys_log.app.report.styles import NOTE, REST, TEST, ModelStyle, camera_styles, model_styles, shorten
from ipsys_log.messages import Array
from ipsys_log.units import CM_PER_M


def places_figure(findings: Findings) -> Figure:
    """Return a figure of training points in black and test points in red, in space and from above."""
    figure = Figure(figsize=(11.5, 5.6), layout="constrained")
    training_m, test_m = (
        np.vstack([np.empty((0, 3)), *points_m.values()])
        for points_m in (findings.training_m(), findings.test_m())
    )
    space: Any = figure.add_subplot(1, 2, 1, projection="3d")
    above = figure.add_subplot(1, 2, 2)
    _draw_space(space, findings, training_m, test_m)
    draw_ground(above, findings.rig, [points_m[:, :2] for points_m in (training_m, test_m) if len(points_m)])
    for points_m, look in zip((training_m, test_m), _LOOKS, strict=True):
        above.plot(*points_m[:, :2].T, ls="none", **look)
    above.set_title("top view", fontsize=10, loc="left")
    handles, labels = above.get_legend_handles_labels()
    counted = [f"{len(training_m)} {labels[0]}", f"{len(test_m)} {labels[1]}"]
    figure.legend(handles, counted, loc="outside lower center", ncols=2, frameon=False)
    return figure


_LOOKS: tuple[dict[str, Any], ...] = (
    {
        "marker": "o",
        "color": "black",
        "ms": 4.5,
        "label": "training pairs (a calibration point in one camera)",
    },
    {"marker": "^", "color": TEST, "ms": 6, "label": "test pairs"},
)


def _draw_space(axes: Any, findings: Findings, training_m: Array, test_m: Array) -> None:
    for points_m, look in zip((training_m, test_m), _LOOKS, strict=True):
        axes.plot(*points_m.T, ls="none", **look)
        # A vertical line to the floor shows the depth of a point in the 3D view.
        for x, y, z in points_m.tolist():
            axes.plot([x, x], [y, y], [0, z], color=look["color"], lw=0.6, alpha=0.35)
    floor = findings.rig.floor if findings.rig else None
    if floor is not None:
        corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]) * (floor.width_m, floor.depth_m)
        axes.plot(*corners.T, np.zeros(5), color="black", lw=1.2)
    high_m = max(
        (float(points_m[:, 2].max()) for points_m in (training_m, test_m) if len(points_m)), default=1
    )
    axes.set(xlabel="x in m", ylabel="y in m", zlabel="z in m", zlim=(0, 1.05 * high_m))
    axes.zaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    axes.zaxis.labelpad = 8
    axes.set_box_aspect((1, 1, 0.5), zoom=1.08)
    axes.view_init(elev=26, azim=-60)
    axes.set_title("3D view", fontsize=10, loc="left")


def hull_m(points_m: Array) -> Array | None:
    """Return the corners (k, 2) of the convex hull of points (n, 2 or 3) on the floor, or None."""
    try:
        return points_m[:, :2][ConvexHull(points_m[:, :2]).vertices]
    except (QhullError, ValueError):
        return None  # fewer than three points, or all points on one line


def draw_hulls(axes: Axes, findings: Findings, fill: bool = False) -> None:
    """Draw the convex hull of the fitted points of each camera on the floor."""
    training_m = findings.training_m()
    styles = _styles(findings)
    middles_m, colours = {}, {}
    for camera, points_m in training_m.items():
        corners_m = hull_m(points_m)
        if corners_m is not None:
            middles_m[camera], colours[camera] = corners_m.mean(axis=0), styles[camera].name
            if fill:
                axes.add_patch(Polygon(corners_m, fc="white", ec="none", zorder=1.5))
            text = figures.legend_label(f"camera {shorten(camera)}", len(training_m))
            edge = styles[camera].edge
            axes.add_patch(Polygon(corners_m, fill=False, zorder=2.2, label=text, **edge))
    figures.name_cameras(axes, middles_m, colours)


class _Style(NamedTuple):
    """The colour of a camera's name, the look of its hull, and the look of its points."""

    name: str
    edge: dict[str, Any]
    points: dict[str, Any]


def _styles(findings: Findings) -> dict[str, _Style]:
    """Return the styles of the cameras; the hulls of many overlap, and 24 colours would hide the errors."""
    training_m, styles = findings.training_m(), camera_styles(findings.cameras)
    if not figures.has_legend(len(training_m)):
        quiet = _Style(NOTE, {"ec": REST, "lw": 0.7}, {"marker": "o", "color": NOTE, "ms": 2.5})
        return dict.fromkeys(training_m, quiet)
    found = {camera: styles.get(camera, (NOTE, "o")) for camera in training_m}
    return {
        camera: _Style(
            colour,
            {"ec": colour, "lw": 1.3, "ls": "--"},
            {"marker": shape, "color": colour, "ms": 4, "alpha": 0.8},
        )
        for camera, (colour, shape) in found.items()
    }


def draw_coverage(axes: Axes, findings: Findings) -> None:
    """Draw the fitted points; hatch the floor outside of the convex hulls of all cameras."""
    training_m = findings.training_m()
    draw_ground(axes, findings.rig, [points_m[:, :2] for points_m in training_m.values()])
    floor = findings.rig.floor if findings.rig else None
    if floor is not None:
        corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * (floor.width_m, floor.depth_m)
        axes.add_patch(Polygon(corners, fc="#F1F1F1", ec="#9A9A9A", hatch="///", lw=0, zorder=1.2))
    draw_hulls(axes, findings, fill=True)
    styles = _styles(findings)
    for camera, points_m in training_m.items():
        axes.plot(*points_m[:, :2].T, ls="none", zorder=3, **styles[camera].points)
    if figures.has_legend(len(training_m)):
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, frameon=False, fontsize=9)


Curves = Mapping[str, advice.Curve]

# Above this ratio of the largest mean to the smallest, the scale is logarithmic to show small values.
_LOG_RATIO = 8.0
# Distance of the error bars of several models at one number of points. The marks are not shifted.
_APART_PT = 0.9
# Panels of many cameras are in rows of so many.
_MOST_COLUMNS = 4
_SPACE = {True: "Mean 3D error in cm", False: "Mean 2D error in cm"}


def camera_curves(findings: Findings, camera: str, in_space: bool) -> Curves:
    """Return the curves of one camera on the labelled subsets, by model."""
    return _some({e.model: advice.camera_curve(e, camera, True, in_space) for e in findings.evaluations})


def mean_curves(findings: Findings, in_space: bool) -> Curves:
    """Return the curves over all cameras on random subsets, by model."""
    return _some({e.model: advice.mean_curve(e, False, in_space) for e in findings.evaluations})


def _some(curves: Curves) -> Curves:
    return {model: curve for model, curve in curves.items() if curve}


def published_figure(findings: Findings, in_space: bool) -> Figure:
    """Return a figure with one panel per camera: figure 10 of the paper in space, figure 11 on the floor."""
    panels = {f"camera {shorten(name)}": camera_curves(findings, name, in_space) for name in findings.cameras}
    title = f"{_SPACE[in_space]} at the held-out points, fitted on the labelled subsets"
    return _figure(panels, title, _SPACE[in_space])


def learning_figure(findings: Findings) -> Figure:
    """Return a figure of the mean over the cameras on random subsets, in space and on the floor."""
    spaces = {"3D": True, "2D": False} if findings.in_space else {"2D": False}
    panels = {title: mean_curves(findings, in_space) for title, in_space in spaces.items()}
    title = (
        "Fitted on random subsets, evaluated at the other points; bars: one standard deviation over subsets"
    )
    return _figure(panels, title, "Mean error over all cameras in cm")


def _figure(panels: Mapping[str, Curves], title: str, ylabel: str) -> Figure:
    columns = len(panels) if figures.has_legend(len(panels)) else _MOST_COLUMNS
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.0 * columns + 2.6, 0.6 + 4.0 * rows), layout="constrained")
    styles = model_styles(dict.fromkeys(model for curves in panels.values() for model in curves))
    axes = figure.subplots(rows, columns, sharey=True, squeeze=False)
    limits = limits_cm(panels.values())
    for panel, (name, curves) in zip(axes.flat, panels.items(), strict=False):
        draw_curves(panel, curves, styles, limits)
        panel.set_title(name, fontsize=10, loc="left")
    for panel in axes.flat[len(panels) :]:
        panel.set_visible(False)
    for panel in axes[:, 0]:
        panel.set_ylabel(ylabel)
    figure.legend(
        handles=[_handle(model, styles[model]) for model in _by_end([*panels.values()])],
        loc="outside right upper", frameon=False, fontsize=9, title=_note(styles), title_fontsize=8,
        alignment="left",
    )  # fmt: skip
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    return figure


def curves_picture(curves: Curves, width_in: float, limits: tuple[float, float]) -> Figure:
    """Return a figure with one panel and its legend below, for a narrow page."""
    lines = -(-len(curves) // 2)
    figure = Figure(figsize=(width_in, 3.7 + 0.19 * lines), layout="constrained")
    axes, styles = figure.add_subplot(), model_styles(curves)
    draw_curves(axes, curves, styles, limits)
    axes.set_ylabel("mean error in cm")
    handles = [_handle(model, styles[model]) for model in _by_end([curves])]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    return figure


def _note(models: Iterable[str]) -> str:
    """Return the title of the legend."""
    order = "sorted by the right ends"
    return f"{order}\n{advice.HEIGHT_NOTE}" if any(map(advice.uses_height, models)) else order


def _by_end(panels: Sequence[Curves]) -> list[str]:
    """Return the models in the order of the right ends of their curves, from the top."""
    ends: dict[str, list[float]] = {}
    for curves in panels:
        for model, curve in curves.items():
            ends.setdefault(model, []).append(curve[-1].mean_m)
    return sorted(ends, key=lambda model: -float(np.mean(ends[model])))


def _handle(model: str, style: ModelStyle) -> Line2D:
    return Line2D(
        [], [], color=style.colour, ls=style.line, lw=1.4, label=advice.label(model), **style.marker
    )


def limits_cm(panels: Iterable[Curves]) -> tuple[float, float]:
    """Return the smallest mean and the highest end of a bar, in cm.

    The highest end is limited to twice the largest mean.
    """
    points = [point for curves in panels for curve in curves.values() for point in curve]
    if not points:
        return 1.0, 1.0
    highest_m = 2 * max(point.mean_m for point in points)
    high_m = max(min(_bar(point)[1], highest_m) for point in points)
    return min(point.mean_m for point in points) * CM_PER_M, high_m * CM_PER_M


def _bar(point: advice.CurvePoint) -> tuple[float, float]:
    """Return the lower and upper end of the bar of a point, in m.

    If the spread is nearly as large as the mean or larger, the lower end is the mean.
    """
    spread_m = point.std_m or 0.0
    return point.mean_m - spread_m if spread_m < 0.9 * point.mean_m else point.mean_m, point.mean_m + spread_m


def draw_curves(
    axes: Axes, curves: Curves, styles: Mapping[str, ModelStyle], limits: tuple[float, float]
) -> None:
    """Draw the curves of some models.

    Parameters
    ----------
    styles : styles by model.
    limits : limits of all panels with the same scale, from :func:`limits_cm`.
    """
    low_cm, high_cm = limits
    for number, (model, curve) in enumerate(curves.items()):
        _draw_curve(axes, curve, styles[model], _APART_PT * (number - (len(curves) - 1) / 2))
    places = sorted({point.places for curve in curves.values() for point in curve})
    if places:
        figures.scale_logarithmic(axes, "x", places[0] / 1.2, places[-1] * 1.2)
        figures.set_ticks(axes, "x", places)
    if high_cm > _LOG_RATIO * low_cm:
        figures.scale_logarithmic(axes, "y", low_cm / 1.35, high_cm * 1.2)
    else:
        axes.set_ylim(0, high_cm * 1.08)
    axes.set_xlabel("points per camera")
    axes.tick_params(labelsize=9)
    figures.style_axes(axes)
    if not curves:
        axes.text(0.5, 0.5, "no data", transform=axes.transAxes, ha="center", color=NOTE)


def _draw_curve(axes: Axes, curve: advice.Curve, style: ModelStyle, shift_pt: float) -> None:
    x = [point.places for point in curve]
    y = [point.mean_m * CM_PER_M for point in curve]
    axes.plot(x, y, style.line, color=style.colour, lw=1.4, zorder=3, **style.marker)
    assert axes.figure is not None
    aside = axes.transData + ScaledTranslation(shift_pt / 72, 0, axes.figure.dpi_scale_trans)
    for point in curve:
        if point.std_m:
            ends_cm = [end_m * CM_PER_M for end_m in _bar(point)]
            axes.plot([point.places] * 2, ends_cm, color=style.colour, lw=0.9, alpha=0.6, transform=aside)
