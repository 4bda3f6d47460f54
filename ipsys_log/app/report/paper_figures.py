"""The tables and figures of the paper, and some more, as files in a folder."""

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.quiver import Quiver

from ipsys_log.app.report import calibration_figures, floor_figure, points_figures
from ipsys_log.app.report.accuracy import Accuracy
from ipsys_log.app.report.advice import has_published, label
from ipsys_log.app.report.figures import ERROR_COLOURS, figure_bytes, scale_logarithmic, style_axes
from ipsys_log.app.report.files import write_files
from ipsys_log.app.report.findings import Findings, errors_in, overall_row
from ipsys_log.app.report.styles import NOTE, model_styles
from ipsys_log.app.report.tables import height_note
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, ErrorStatistics
from ipsys_log.units import CM_PER_M

# Largest factor by which the map is wider than the floor, to make room for arrows.
_WIDER = 1.12


class ResidualScale(NamedTuple):
    """The scales of floor maps.

    ``most_cm`` is the error in cm of the last colour, ``factor`` the factor of the arrows, and ``square`` the
    part of the floor.
    """

    most_cm: float
    factor: int
    square: floor_figure.Square


def shown_models(findings: Findings) -> list[Accuracy]:
    """Return the models whose errors are drawn: ``poly``, a well-known model, and the best model.

    Models without residuals are left out. Models with heights as input come last in the ranking.
    """
    ranked = [accuracy for accuracy in findings.ranked() if findings.point_errors(accuracy)]
    poly = [accuracy for accuracy in ranked if accuracy.model == "poly"]
    return list(dict.fromkeys([*poly, *ranked[:1]]))


def residual_scale(findings: Findings, accuracies: Sequence[Accuracy]) -> ResidualScale:
    """Return one scale for the maps of all these models, so that the maps can be compared by eye."""
    places_m, errors_m, lengths_cm = _point_errors(findings, accuracies)
    square = floor_figure.square_around(findings.rig, [places_m])
    factor = floor_figure.arrow_factor(list(errors_m), 2 * square.half)
    # Make room for the arrows, while the floor stays large.
    reach_m = 1.01 * np.abs(places_m + factor * errors_m - square.middle).max()
    half_m = float(np.clip(reach_m, square.half, _WIDER * square.half))
    return ResidualScale(
        float(np.quantile(lengths_cm, 0.95)), factor, floor_figure.Square(square.middle, half_m)
    )


def residuals_figure(findings: Findings) -> Figure:
    """Return a figure with one floor map per shown model, with the same scale of colours."""
    accuracies = shown_models(findings)
    figure = Figure(figsize=(5.6 * len(accuracies) + 0.9, 6.6), layout="constrained")
    scale = residual_scale(findings, accuracies)
    panels = figure.subplots(1, len(accuracies), squeeze=False)[0]
    for axes, accuracy in zip(panels, accuracies, strict=True):
        arrows = draw_residuals(axes, findings, accuracy, scale)
    bar = figure.colorbar(arrows, ax=list(panels), shrink=0.8, pad=0.02, extend="max")
    bar.set_label(f"{'3D' if findings.in_space else '2D'} error in cm")
    handles, labels = panels[0].get_legend_handles_labels()
    if handles:
        figure.legend(
            handles, labels, loc="outside lower center", ncols=3 * len(panels), frameon=False, fontsize=9,
            title="area of the calibration points", title_fontsize=9,
        )  # fmt: skip
    return figure


def draw_residuals(axes: Axes, findings: Findings, accuracy: Accuracy, scale: ResidualScale) -> Quiver:
    """Draw one model's mean error at each point as an arrow on the floor, coloured by its length in space."""
    places_m, errors_m, lengths_cm = _point_errors(findings, [accuracy])
    floor_figure.draw_ground(axes, findings.rig, [places_m])
    points_figures.draw_hulls(axes, findings)
    floor_figure.show_square(axes, scale.square)
    factor = scale.factor
    # The largest errors are drawn last, on top of the others.
    order = np.argsort(lengths_cm, kind="stable")
    places_m, errors_m, lengths_cm = places_m[order], errors_m[order], lengths_cm[order]
    look = {"cmap": ERROR_COLOURS, "norm": Normalize(0, scale.most_cm)}
    arrows = floor_figure.draw_arrows(axes, places_m, errors_m, factor, lengths_cm, **look)
    x_m, y_m = places_m.T
    axes.scatter(x_m, y_m, c=lengths_cm, s=14, zorder=3.5, lw=0, **look)  # type: ignore[arg-type]
    floor_figure.draw_key(axes, arrows, factor)
    scheme = "cross-validated errors" if accuracy.rows(True) else "errors at held-out points"
    times = f"arrows {factor} times true length" if factor > 1 else ""
    axes.set_title(f"{label(accuracy.model)}: {scheme}\n{times}", loc="left", fontsize=10)
    return arrows


def _point_errors(findings: Findings, accuracies: Sequence[Accuracy]) -> tuple[Array, Array, Array]:
    """Return points and errors on the floor (n, 2) in m, and lengths (n,) in cm, of models in all cameras."""
    errors = [one for accuracy in accuracies for one in findings.point_errors(accuracy)]
    places_m = np.vstack([one.world_m[:, :2] for one in errors])
    offsets_m = np.vstack([one.offsets_m[:, :2] for one in errors])
    lengths_m = np.concatenate([one.lengths_m[:, 0 if findings.in_space else 1] for one in errors])
    return places_m, offsets_m, lengths_m * CM_PER_M


_LOG_RATIO = 10.0
_ROW_IN = 0.34
HELD_OUT = {"marker": "D", "mfc": "white", "mec": NOTE, "ms": 5.5, "mew": 1.2, "ls": "none"}


def models_figure(findings: Findings) -> Figure:
    """Return a figure with a row per model, the best on top: mean and interval, in space and on the floor."""
    spaces = (True, False) if findings.in_space else (False,)
    ranked = findings.ranked()
    figure = Figure(figsize=(1.8 + 4.2 * len(spaces), 1.7 + _ROW_IN * len(ranked)), layout="constrained")
    panels = figure.subplots(1, len(spaces), sharex=True, sharey=True, squeeze=False)[0]
    for axes, in_space in zip(panels, spaces, strict=True):
        draw_models(axes, ranked, in_space)
        axes.set_title("3D" if in_space else "2D (on the floor)", fontsize=10, loc="left")
    dot = Line2D([], [], color="black", marker="o", ms=6, lw=2)
    held_out = Line2D([], [], **HELD_OUT)  # type: ignore[arg-type]
    figure.legend(
        [dot, held_out], ["cross-validation, with the 95 % interval", "held-out points"],
        loc="outside lower center", ncols=2, frameon=False, fontsize=9,
    )  # fmt: skip
    if note := height_note(accuracy.model for accuracy in ranked):
        figure.suptitle(note, x=0.01, ha="left", fontsize=9, color=NOTE)
    return figure


def draw_models(axes: Axes, ranked: Sequence[Accuracy], in_space: bool) -> None:
    """Draw one row per model, the first on top; the scale fits the errors in space and on the floor."""
    styles = model_styles(accuracy.model for accuracy in ranked)
    for y, accuracy in enumerate(ranked):
        crossed = errors_in(overall_row(accuracy, True), in_space)
        held_out = errors_in(overall_row(accuracy, False), in_space)
        if crossed is not None:
            colour = styles[accuracy.model].colour
            axes.plot(_ends_cm(crossed), [y, y], color=colour, lw=2.4, solid_capstyle="butt", zorder=3)
            axes.plot(crossed.mean_m * CM_PER_M, y, "o", color=colour, ms=6.5, zorder=3.5)
        if held_out is not None:
            axes.plot(held_out.mean_m * CM_PER_M, y, zorder=4, **HELD_OUT)  # type: ignore[arg-type]
    rows = [overall_row(accuracy, scheme) for accuracy in ranked for scheme in (True, False)]
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
    style_axes(axes, "x")
    axes.spines["left"].set_visible(False)


def _ends_cm(errors: ErrorStatistics) -> list[float]:
    """Return the ends of the confidence interval of the mean, or the mean itself, in cm."""
    ends_m = (errors.mean_low_m, errors.mean_high_m)
    return [(errors.mean_m if end_m is None else end_m) * CM_PER_M for end_m in ends_m]


# Names of the methods in Tables I and II of the paper.
_PAPER_NAMES = {
    "rigid": "RT",
    "poly": "PR",
    "rigid+poly": "RT + PR",
    "ann": "ANN",
    "rigid+ann": "RT + ANN",
    "kriging": "KI",
    "rigid+kriging": "RT + KI",
    "kriging-regression": "KR",
    "rigid+kriging-regression": "RT + KR",
}
_FIGURES = ("mean", "min", "max", "std")


def paper_csv(findings: Findings, in_space: bool) -> bytes:
    """Return Table I of the paper (errors in space) or Table II (errors on the floor), one row per model.

    The columns are those of the paper: the means of the cameras, then their minima, maxima and standard
    deviations. The errors are on held-out points, against the tape. Unknown values are empty.
    """
    header = ["method", "paper"] + [f"{figure}_cm_{c}" for figure in _FIGURES for c in findings.cameras]
    rows = []
    for accuracy in findings.accuracies:
        by_camera = {row.camera: row for row in accuracy.rows(False) if row.against == "tape"}
        errors = [errors_in(by_camera.get(camera), in_space) for camera in findings.cameras]
        cells = [_cm(getattr(e, f"{name}_m") if e else None) for name in _FIGURES for e in errors]
        rows.append([accuracy.model, _PAPER_NAMES.get(accuracy.model, ""), *cells])
    return _csv(header, rows)


_STATISTICS = ("mean", "mean_low", "mean_high", "min", "median", "p95", "max", "std")


def cross_validation_csv(findings: Findings) -> bytes:
    """Return a table with one row per model, camera (``all``: all together) and reference (tape or truth)."""
    header = ["method", "camera", "against", "places"]
    header += [f"{name}_{space}_cm" for space in ("3d", "2d") for name in (*_STATISTICS, "rmse")]
    header += [f"bias_{axis}_cm" for axis in "xyz"] + ["within_68", "within_95"]
    rows = []
    for accuracy in findings.accuracies:
        for row in accuracy.rows(True):
            cells = [accuracy.model, row.camera or "all", row.against, str(row.error_2d.count)]
            for errors in (row.error_3d, row.error_2d):
                cells += [_cm(getattr(errors, f"{name}_m") if errors else None) for name in _STATISTICS]
                cells.append(_cm(accuracy.errors_of(row).rmse_m(errors)))
            cells += map(_cm, [None] * 3 if row.bias_m is None else row.bias_m.tolist())
            cells += ["" if v is None else f"{v:.4f}" for v in (row.within_68, row.within_95)]
            rows.append(cells)
    return _csv(header, rows)


def _cm(value_m: float | None) -> str:
    return "" if value_m is None else f"{value_m * CM_PER_M:.3f}"


def _csv(header: Sequence[str], rows: Iterable[Sequence[str]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    return text.getvalue().encode()


# For each table: the condition to write it, and the function that returns its bytes.
_TABLES: dict[str, tuple[Callable[[Findings], bool], Callable[[Findings], bytes]]] = {
    "table_1": (lambda f: bool(f.accuracies), lambda f: paper_csv(f, in_space=True)),
    "table_2": (lambda f: bool(f.accuracies), lambda f: paper_csv(f, in_space=False)),
    "cross_validation": (lambda f: any(a.rows(True) for a in f.accuracies), cross_validation_csv),
}
# The same for each figure.
_DRAWN: dict[str, tuple[Callable[[Findings], bool], Callable[[Findings], Figure]]] = {
    "figure_9": (lambda f: bool(f.training_m() or f.test_m()), points_figures.places_figure),
    "figure_10": (
        lambda f: has_published(f.evaluations) and f.in_space,
        lambda f: points_figures.published_figure(f, in_space=True),
    ),
    "figure_11": (
        lambda f: has_published(f.evaluations),
        lambda f: points_figures.published_figure(f, False),
    ),
    "learning_curve": (lambda f: bool(points_figures.mean_curves(f, False)), points_figures.learning_figure),
    "errors_floor": (lambda f: bool(shown_models(f)), residuals_figure),
    "models": (lambda f: bool(f.accuracies), models_figure),
    "camera_poses": (
        lambda f: bool(f.calibrated),
        lambda f: calibration_figures.poses_figure(f.calibrated, f.rig),
    ),
    "clock_offsets": (
        lambda f: calibration_figures.has_clocks(f.calibrated),
        lambda f: calibration_figures.clocks_figure(f.calibrated),
    ),
}


def _image_residuals(findings: Findings) -> dict[str, Figure]:
    """Return a map of the corner residuals in the image of each camera of the joint model."""
    most_px = calibration_figures.residual_limit_px(findings.calibrated)
    return {
        f"image_residuals_{camera.camera}": calibration_figures.residuals_figure(camera, most_px)
        for camera in findings.calibrated
        if camera.residuals is not None
    }


def write_plots(findings: Findings, folder: Path, suffix: str = ".png") -> list[str]:
    """Write all tables and figures that have data into a folder: all files, or none.

    ``suffix`` gives the format of the figures.
    """
    files = {
        f"{name}.csv": make(findings) for name, (has_data, make) in _TABLES.items() if has_data(findings)
    }
    figures = {name: draw(findings) for name, (has_data, draw) in _DRAWN.items() if has_data(findings)}
    figures |= _image_residuals(findings)
    named = {f"{name}{suffix}": figure for name, figure in figures.items()}
    files |= {name: figure_bytes(figure, Path(name)) for name, figure in named.items()}
    if not files:
        raise IpsysError(
            f"{folder}: nothing to draw: no model was evaluated, because no calibration point is held out; "
            "measure more points"
        )
    write_files(folder, files)
    return list(files)
