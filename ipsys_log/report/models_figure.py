"""Models side by side: how far off they are, and how certain that is."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ipsys_log.messages import CameraEvaluation, ErrorStatistics
from ipsys_log.report.accuracy import Accuracy
from ipsys_log.report.advice import TOLD_NOTE, label, told_height
from ipsys_log.report.figures import scale_logarithmic, strip
from ipsys_log.report.findings import Findings, overall
from ipsys_log.report.palette import NOTE, model_styles
from ipsys_log.units import CM_PER_M

__all__ = ["HELD_OUT", "draw_models", "models_figure", "models_note"]

_LOG_RATIO = 10.0
_ROW_IN = 0.34
HELD_OUT = {"marker": "D", "mfc": "white", "mec": NOTE, "ms": 5.5, "mew": 1.2, "ls": "none"}


def models_figure(findings: Findings) -> Figure:
    """A row for each model, the best on top: the mean with its interval, in space and on the floor."""
    spaces = (True, False) if findings.in_space else (False,)
    ranked = findings.ranked()
    figure = Figure(figsize=(1.8 + 4.2 * len(spaces), 1.7 + _ROW_IN * len(ranked)), layout="constrained")
    panels = figure.subplots(1, len(spaces), sharex=True, sharey=True, squeeze=False)[0]
    for axes, in_space in zip(panels, spaces, strict=True):
        draw_models(axes, ranked, in_space)
        axes.set_title("in space" if in_space else "on the floor", fontsize=10, loc="left")
    dot = Line2D([], [], color="black", marker="o", ms=6, lw=2)
    held_out = Line2D([], [], **HELD_OUT)  # type: ignore[arg-type]
    figure.legend(
        [dot, held_out], ["by cross-validation, with the 95 % interval", "on held-out places"],
        loc="outside lower center", ncols=2, frameon=False, fontsize=9,
    )  # fmt: skip
    if note := models_note(ranked):
        figure.suptitle(note, x=0.01, ha="left", fontsize=9, color=NOTE)
    return figure


def models_note(accuracies: Sequence[Accuracy]) -> str:
    """What the mark at the names of some models means; empty where there are none."""
    return TOLD_NOTE if any(told_height(accuracy.model) for accuracy in accuracies) else ""


def draw_models(axes: Axes, ranked: Sequence[Accuracy], in_space: bool) -> None:
    """Draw a row for each model, the first on top; the scale is that of errors in space and on the floor."""
    styles = model_styles(accuracy.model for accuracy in ranked)
    for y, accuracy in enumerate(ranked):
        crossed = _errors(overall(accuracy, True), in_space)
        held_out = _errors(overall(accuracy, False), in_space)
        if crossed is not None:
            colour = styles[accuracy.model].colour
            axes.plot(_ends_cm(crossed), [y, y], color=colour, lw=2.4, solid_capstyle="butt", zorder=3)
            axes.plot(crossed.mean_m * CM_PER_M, y, "o", color=colour, ms=6.5, zorder=3.5)
        if held_out is not None:
            axes.plot(held_out.mean_m * CM_PER_M, y, zorder=4, **HELD_OUT)  # type: ignore[arg-type]
    rows = [overall(accuracy, scheme) for accuracy in ranked for scheme in (True, False)]
    shown = [errors for row in rows if row for errors in (row.error_3d, row.error_2d) if errors]
    ends_cm = [end for errors in shown for end in _ends_cm(errors)]
    if ends_cm and max(ends_cm) > _LOG_RATIO * min(ends_cm):
        scale_logarithmic(axes, "x", min(ends_cm) / 1.3, max(ends_cm) * 1.3)
    else:
        axes.set_xlim(0, 1.08 * max(ends_cm, default=1.0))
    axes.set_yticks(range(len(ranked)), [label(accuracy.model) for accuracy in ranked])
    axes.set_ylim(len(ranked) - 0.4, -0.6)
    axes.set_xlabel("mean error in cm")
    axes.tick_params(axis="y", length=0)
    strip(axes, "x")
    axes.spines["left"].set_visible(False)


def _errors(row: CameraEvaluation | None, in_space: bool) -> ErrorStatistics | None:
    return None if row is None else row.error_3d if in_space else row.error_2d


def _ends_cm(errors: ErrorStatistics) -> list[float]:
    """Of the confidence interval of the mean, or the mean itself."""
    ends_m = (errors.mean_low_m, errors.mean_high_m)
    return [(errors.mean_m if end_m is None else end_m) * CM_PER_M for end_m in ends_m]
