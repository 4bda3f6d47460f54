"""Figures of the learning curves: figures 10 and 11 of the paper, and random subsets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation

from ipsys_log.app.report.advice import (
    HEIGHT_NOTE,
    Curve,
    CurvePoint,
    camera_curve,
    label,
    mean_curve,
    uses_height,
)
from ipsys_log.app.report.figures import has_legend, scale_logarithmic, set_ticks, style_axes
from ipsys_log.app.report.findings import Findings
from ipsys_log.app.report.styles import NOTE, ModelStyle, model_styles, shorten
from ipsys_log.units import CM_PER_M

Curves = Mapping[str, Curve]

# Above this ratio of the largest mean to the smallest, the scale is logarithmic to show small values.
_LOG_RATIO = 8.0
# Distance of the error bars of several models at one number of points. The marks are not shifted.
_APART_PT = 0.9
# Panels of many cameras are in rows of so many.
_MOST_COLUMNS = 4
_SPACE = {True: "Mean 3D error in cm", False: "Mean 2D error in cm"}


def camera_curves(findings: Findings, camera: str, in_space: bool) -> Curves:
    """Return the curves of one camera on the labelled subsets, by model."""
    return _some({e.model: camera_curve(e, camera, True, in_space) for e in findings.evaluations})


def mean_curves(findings: Findings, in_space: bool) -> Curves:
    """Return the curves over all cameras on random subsets, by model."""
    return _some({e.model: mean_curve(e, False, in_space) for e in findings.evaluations})


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
    columns = len(panels) if has_legend(len(panels)) else _MOST_COLUMNS
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
    return f"{order}\n{HEIGHT_NOTE}" if any(map(uses_height, models)) else order


def _by_end(panels: Sequence[Curves]) -> list[str]:
    """Return the models in the order of the right ends of their curves, from the top."""
    ends: dict[str, list[float]] = {}
    for curves in panels:
        for model, curve in curves.items():
            ends.setdefault(model, []).append(curve[-1].mean_m)
    return sorted(ends, key=lambda model: -float(np.mean(ends[model])))


def _handle(model: str, style: ModelStyle) -> Line2D:
    return Line2D([], [], color=style.colour, ls=style.line, lw=1.4, label=label(model), **style.marker)


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


def _bar(point: CurvePoint) -> tuple[float, float]:
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
        scale_logarithmic(axes, "x", places[0] / 1.2, places[-1] * 1.2)
        set_ticks(axes, "x", places)
    if high_cm > _LOG_RATIO * low_cm:
        scale_logarithmic(axes, "y", low_cm / 1.35, high_cm * 1.2)
    else:
        axes.set_ylim(0, high_cm * 1.08)
    axes.set_xlabel("points per camera")
    axes.tick_params(labelsize=9)
    style_axes(axes)
    if not curves:
        axes.text(0.5, 0.5, "no data", transform=axes.transAxes, ha="center", color=NOTE)


def _draw_curve(axes: Axes, curve: Curve, style: ModelStyle, shift_pt: float) -> None:
    x = [point.places for point in curve]
    y = [point.mean_m * CM_PER_M for point in curve]
    axes.plot(x, y, style.line, color=style.colour, lw=1.4, zorder=3, **style.marker)
    assert axes.figure is not None
    aside = axes.transData + ScaledTranslation(shift_pt / 72, 0, axes.figure.dpi_scale_trans)
    for point in curve:
        if point.std_m:
            ends_cm = [end_m * CM_PER_M for end_m in _bar(point)]
            axes.plot([point.places] * 2, ends_cm, color=style.colour, lw=0.9, alpha=0.6, transform=aside)
