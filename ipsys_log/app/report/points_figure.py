"""Figures of the training and test points: figure 9 of the paper, and the floor without nearby points."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator
from scipy.spatial import ConvexHull, QhullError

from ipsys_log.app.report.figures import has_legend, legend_label, name_cameras
from ipsys_log.app.report.findings import Findings
from ipsys_log.app.report.floor_figure import draw_ground
from ipsys_log.app.report.styles import NOTE, REST, TEST, camera_styles, shorten
from ipsys_log.messages import Array


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
            text = legend_label(f"camera {shorten(camera)}", len(training_m))
            edge = styles[camera].edge
            axes.add_patch(Polygon(corners_m, fill=False, zorder=2.2, label=text, **edge))
    name_cameras(axes, middles_m, colours)


class _Style(NamedTuple):
    """The colour of a camera's name, the look of its hull, and the look of its points."""

    name: str
    edge: dict[str, Any]
    points: dict[str, Any]


def _styles(findings: Findings) -> dict[str, _Style]:
    """Return the styles of the cameras; the hulls of many overlap, and 24 colours would hide the errors."""
    training_m, styles = findings.training_m(), camera_styles(findings.cameras)
    if not has_legend(len(training_m)):
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
    if has_legend(len(training_m)):
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, frameon=False, fontsize=9)
