"""Where on the floor a model is off, and by how much."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from numpy.typing import NDArray

from ipsys_log.report.accuracy import Accuracy
from ipsys_log.report.advice import label
from ipsys_log.report.findings import Findings, Missed
from ipsys_log.report.floor_panel import (
    Square,
    draw_arrows,
    draw_ground,
    draw_key,
    exaggeration,
    show_square,
    square_around,
)
from ipsys_log.report.points_figure import draw_hulls
from ipsys_log.units import CM_PER_M

Array = NDArray[np.float64]

__all__ = ["ResidualScale", "draw_residuals", "residual_scale", "residuals_figure", "shown_models"]

# From pale for a small error to dark for a large one, which any colour vision sees.
_COLOURS = ListedColormap(colormaps["magma_r"](np.linspace(0.2, 0.95, 256)))
# So much wider at most the picture may be than the floor for the sake of an arrow.
_WIDER = 1.12


class ResidualScale(NamedTuple):
    """Scales of floor maps: the error in cm that has the last colour, the arrows' factor, the floor shown."""

    most_cm: float
    factor: int
    square: Square


def shown_models(findings: Findings) -> list[Accuracy]:
    """``poly``, which everybody knows, and the best of all that need no height; with residuals."""
    ranked = [accuracy for accuracy in findings.ranked() if findings.missed(accuracy)]
    named = [accuracy for accuracy in ranked if accuracy.model == "poly"]
    return list(dict.fromkeys([*named, *ranked[:1]]))


def residual_scale(findings: Findings, accuracies: Sequence[Accuracy]) -> ResidualScale:
    """Return the scale that shows all these models alike: maps side by side are compared by eye."""
    missed = [missed for accuracy in accuracies for missed in findings.missed(accuracy)]
    places_m = np.vstack([each.world_m[:, :2] for each in missed])
    errors_m = np.vstack([each.offsets_m[:, :2] for each in missed])
    lengths_cm = np.concatenate([_lengths_cm(findings, each) for each in missed])
    square = square_around(findings.rig, [places_m])
    factor = exaggeration(list(errors_m), 2 * square.half)
    # Make room for the arrows, while the floor stays large.
    reach_m = 1.01 * np.abs(places_m + factor * errors_m - square.middle).max()
    half_m = float(np.clip(reach_m, square.half, _WIDER * square.half))
    return ResidualScale(float(np.quantile(lengths_cm, 0.95)), factor, Square(square.middle, half_m))


def residuals_figure(findings: Findings) -> Figure:
    """A floor for each model that is shown, with one scale of colours."""
    accuracies = shown_models(findings)
    figure = Figure(figsize=(5.6 * len(accuracies) + 0.9, 6.6), layout="constrained")
    scale = residual_scale(findings, accuracies)
    panels = figure.subplots(1, len(accuracies), squeeze=False)[0]
    for axes, accuracy in zip(panels, accuracies, strict=True):
        arrows = draw_residuals(axes, findings, accuracy, scale)
    bar = figure.colorbar(arrows, ax=list(panels), shrink=0.8, pad=0.02, extend="max")
    bar.set_label(f"error {'in space' if findings.in_space else 'on the floor'} in cm")
    handles, labels = panels[0].get_legend_handles_labels()
    if handles:
        figure.legend(
            handles, labels, loc="outside lower center", ncols=3 * len(panels), frameon=False, fontsize=9,
            title="the floor that a camera's places lie around", title_fontsize=9,
        )  # fmt: skip
    return figure


def draw_residuals(axes: Axes, findings: Findings, accuracy: Accuracy, scale: ResidualScale) -> Quiver:
    """Draw one model's mean error at each place as an arrow on the floor, coloured by its length in space."""
    missed = findings.missed(accuracy)
    places_m = np.vstack([found.world_m[:, :2] for found in missed])
    errors_m = np.vstack([found.offsets_m[:, :2] for found in missed])
    lengths_cm = np.concatenate([_lengths_cm(findings, found) for found in missed])
    draw_ground(axes, findings.rig, [places_m])
    draw_hulls(axes, findings)
    show_square(axes, scale.square)
    factor = scale.factor
    # The largest last, on top of the others.
    order = np.argsort(lengths_cm, kind="stable")
    places_m, errors_m, lengths_cm = places_m[order], errors_m[order], lengths_cm[order]
    look = {"cmap": _COLOURS, "norm": Normalize(0, scale.most_cm)}
    arrows = draw_arrows(axes, places_m, errors_m, factor, lengths_cm, **look)
    x_m, y_m = places_m.T
    axes.scatter(x_m, y_m, c=lengths_cm, s=14, zorder=3.5, lw=0, **look)  # type: ignore[arg-type]
    draw_key(axes, arrows, factor)
    scheme = "by cross-validation" if accuracy.rows(True) else "on held-out places"
    times = f"drawn {factor} times as long" if factor > 1 else ""
    axes.set_title(f"{label(accuracy.model)}: errors {scheme}\n{times}", loc="left", fontsize=10)
    return arrows


def _lengths_cm(findings: Findings, missed: Missed) -> Array:
    return missed.lengths_m[:, 0 if findings.in_space else 1] * CM_PER_M
