"""The summary of an evaluation in sentences: the best model, its error and the outliers."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from rich.console import Group
from rich.text import Text

from ipsys_log.app.report.accuracy import Accuracy, gather_outliers
from ipsys_log.app.report.advice import advise, uses_height
from ipsys_log.app.report.findings import (
    in_space,
    overall_row,
    overall_row_with_excluded,
    rank,
    ranking_errors,
)
from ipsys_log.app.report.json_format import plain
from ipsys_log.app.report.rows import cm, counted, name_cell, wrap_text
from ipsys_log.messages import CameraEvaluation, ErrorStatistics
from ipsys_log.models.table import reads_corners
from ipsys_log.plain_text import join_names
from ipsys_log.statistics.accuracy import CROSS_VALIDATION, POOLED, root_mean_square_m
from ipsys_log.statistics.consistency import FEWEST_POINTS
from ipsys_log.statistics.ground_truth import pool_trajectories
from ipsys_log.statistics.model_kinds import SCREENING

# Number of outliers with an explanation in the answer; the other outliers are only named.
_EXPLAINED = 3
_TRUTH = "truth"
# Number of gross outliers that the summary names.
_NAMED = 3


def answer_text(accuracies: Sequence[Accuracy]) -> Group | None:
    """Return the answer in sentences; None without an evaluated model."""
    if not accuracies:
        return None
    best = rank(accuracies)[0]
    lines: list[str | Text] = [*_best_lines(accuracies, best)]
    shown = [best, *([] if (told := _height_model(accuracies, best)) is None else [told])]
    for accuracy in shown:
        if accuracy.tracks is not None:
            lines += _track_lines(accuracy, in_space(accuracies), len(shown) > 1)
            lines += _trajectory_lines(accuracy)
    if any(accuracy.evaluation and accuracy.evaluation.cameras for accuracy in accuracies):
        lines += _outlier_lines(accuracies)
    advice = advise([accuracy.evaluation for accuracy in accuracies if accuracy.evaluation])
    lines += advice.sentences if advice else ()
    return Group(*(Text(wrap_text(line)) if isinstance(line, str) else line for line in lines))


def _height_model(accuracies: Sequence[Accuracy], best: Accuracy) -> Accuracy | None:
    """Return the best model that gets heights as input, if it is not the best model of all."""
    models = [accuracy for accuracy in rank(accuracies) if uses_height(accuracy.model)]
    return models[0] if models and models[0] is not best else None


def _track_lines(accuracy: Accuracy, space: bool, several: bool) -> Iterator[str]:
    """Yield the errors of the tracks at the instants that count, and at the others."""
    tracks = accuracy.tracks
    assert tracks is not None
    # A known height is no result of the model: its error is that of the input.
    space = space and not uses_height(accuracy.model)
    own, whole = (tracks.space, tracks.whole[0]) if space else (tracks.floor, tracks.whole[1])
    of_model = f" of {name_cell(accuracy.model).plain}" if several else ""
    text = f"Tracks{of_model}, against the ground truth: {_figures(own, root_mean_square_m(own))}."
    if tracks.others is None:
        yield text
    elif not tracks.counted:
        yield f"{text} The marker has the height in the rig at none of these {tracks.instants} instants."
    else:
        others = tracks.others[0] if space else tracks.others[1]
        yield (
            f"{text} This is at the {tracks.counted} of {tracks.instants} instants at which the marker has "
            f"the height in the rig. At the other {others.count}, the mean error is "
            f"{cm(others.mean_m, 1)} cm; over all, it is {cm(whole.mean_m, 1)} cm."
        )


def _trajectory_lines(accuracy: Accuracy) -> Iterator[str]:
    """Yield the RMSE of the absolute trajectory error and of the relative pose errors of all robots."""
    if not accuracy.trajectories:
        return
    pooled = pool_trajectories(accuracy.trajectories)
    space_cm, floor_cm = (
        cm(root_mean_square_m(pooled.absolute_3d)),
        cm(root_mean_square_m(pooled.absolute_2d)),
    )
    text = f"Absolute trajectory error (ATE): RMSE {space_cm} cm in 3D, {floor_cm} cm on the floor"
    relative = [
        f"{cm(root_mean_square_m(errors.summary))} cm over {errors.delta:g} {errors.unit}"
        for errors in pooled.relative
    ]
    yield f"{text}; relative pose error (RPE): RMSE {', '.join(relative)}." if relative else f"{text}."


def _excluded_line(best: Accuracy, row: CameraEvaluation, space: bool) -> str:
    """Return the gross outliers without which the figures are computed, and the error with them."""
    assert best.evaluation is not None
    names = [name_cell(suspect.measurement).plain for suspect in best.evaluation.excluded]
    one, listed = len(names) == 1, join_names(names, _NAMED)
    of = f"the gross outlier {listed}" if one else f"{len(names)} gross outliers: {listed}"
    text = f"The errors and the advice are without {of}."
    whole = overall_row_with_excluded(best, row.scheme == CROSS_VALIDATION)
    if whole is None:
        return text
    mean_cm = cm(ranking_errors(whole, space).mean_m, 1)
    return f"{text} With {'it' if one else 'them'}, the mean error is {mean_cm} cm."


def _best_lines(accuracies: Sequence[Accuracy], best: Accuracy) -> Iterator[str | Text]:
    row = overall_row(best, True) or overall_row(best, False)
    if row is None:
        return
    space = in_space(accuracies)
    several = len(accuracies) > 1
    knows = ", with known marker heights" if uses_height(best.model) else ""
    yield Text(f"{'Best model' if several else 'Model'}: {name_cell(best.model)}{knows}", style="bold")
    errors = ranking_errors(row, space)
    yield f"Mean distance to the tape points: {_figures(errors, best.errors_of(row).rmse_m(errors))}"
    cameras = {camera_row.camera for camera_row in (best.evaluation.cameras if best.evaluation else ())} - {
        POOLED
    }
    scheme = "cross-validated" if row.scheme == CROSS_VALIDATION else "held out"
    yield (
        f"({'3D' if space and not uses_height(best.model) else '2D'}, {scheme}: "
        f"{counted(row.error_2d.count, 'point')} of {counted(len(cameras), 'camera')}; each pair of "
        "a camera and a point counts as one)."
    )
    yield from _remaining_lines(errors)
    if best.evaluation and best.evaluation.excluded:
        yield _excluded_line(best, row, space)
    truth = overall_row(best, row.scheme == CROSS_VALIDATION, _TRUTH)
    if truth is not None:
        errors = ranking_errors(truth, space)
        yield f"Against the ground truth: {_figures(errors, best.errors_of(truth).rmse_m(errors))}."
    told = _height_model(accuracies, best)
    if told and (told_row := overall_row(told, True) or overall_row(told, False)):
        errors = ranking_errors(told_row, space)
        figures = _figures(errors, told.errors_of(told_row).rmse_m(errors))
        yield f"With known marker heights: {told.model}, {figures} (2D)."


def _remaining_lines(errors: ErrorStatistics) -> Iterator[str]:
    """Yield the mean position error without the error of the tape, if the tape has a sigma."""
    if errors.remaining_m is not None:
        low, high = cm(errors.remaining_low_m), cm(errors.remaining_high_m)
        yield (
            f"Mean position error, after the stated error of the tape: {cm(errors.remaining_m)} cm "
            f"(95 % CI {low} to {high})."
        )


def _figures(errors: ErrorStatistics, rmse_m: float | None) -> str:
    """Return the statistics of errors as text."""
    parts = [f"{cm(errors.mean_m, 1)} cm"]
    if errors.mean_low_m is not None and errors.mean_high_m is not None:
        parts[0] += f" (95 % CI {cm(errors.mean_low_m, 1)} to {cm(errors.mean_high_m, 1)})"
    if rmse_m is not None:
        parts.append(f"RMSE {cm(rmse_m, 1)} cm")
    if errors.p95_m is not None:
        parts.append(f"95 % below {cm(errors.p95_m, 1)} cm")
    return ", ".join(parts)


def _outlier_lines(accuracies: Sequence[Accuracy]) -> Iterator[str | Text]:
    """Yield the outliers, the worst first; the first outliers have a possible explanation."""
    suspects = gather_outliers(accuracies)
    if not suspects:
        searched = "none" if any(map(_screened, accuracies)) else f"not searched. {_needed()}"
        yield f"Outliers: {searched}."
        return
    yield f"Outliers: measure {counted(len(suspects), 'point')} again, the worst first:"
    for suspect, _ in suspects[:_EXPLAINED]:
        text = suspect.text or "no simple mistake explains it"
        name = name_cell(suspect.measurement).plain
        yield Text(wrap_text(f"{name}, error {_length(suspect.residual_m)} cm: {text}.", indent="  "))
    if rest := suspects[_EXPLAINED:]:
        texts = (f"{name_cell(s.measurement).plain} ({_length(s.residual_m)} cm)" for s, _ in rest)
        yield Text(wrap_text(f"{', '.join(texts)}.", indent="  "))


def _length(residual_m: Any) -> str:
    return cm(float(np.linalg.norm(residual_m)), 1)


def _screened(accuracy: Accuracy) -> bool:
    """Return whether a model was used to search for outliers; some models are, if they have enough points."""
    rows = [row for row in accuracy.rows(True) if row.camera != POOLED]
    if accuracy.model not in SCREENING:
        return False
    # A model of corners compares each reading with its own covariance, which needs no number of points.
    return reads_corners(accuracy.model) or any(row.error_2d.count >= FEWEST_POINTS for row in rows)


def _needed() -> str:
    usual = ", ".join(model for model in SCREENING if not reads_corners(model))
    corners = ", ".join(model for model in SCREENING if reads_corners(model))
    return (
        f"The search needs {FEWEST_POINTS} points of a camera, and one of the models {usual}; or the model "
        f"{corners}"
    )


def answer_json(accuracies: Sequence[Accuracy]) -> dict[str, Any]:
    """Return the answer as plain data, in m; empty without an evaluated model."""
    best = rank(accuracies)[0] if accuracies else None
    row = None if best is None else overall_row(best, True) or overall_row(best, False)
    if best is None or row is None:
        return {}
    errors = ranking_errors(row, in_space(accuracies))
    answer: dict[str, Any] = {"model": best.model, "scheme": row.scheme} | plain(errors)
    answer |= plain({"rmse_m": best.errors_of(row).rmse_m(errors)})
    if best.evaluation and best.evaluation.excluded:
        answer["excluded"] = [suspect.measurement for suspect in best.evaluation.excluded]
        whole = overall_row_with_excluded(best, row.scheme == CROSS_VALIDATION)
        if whole is not None:
            answer["mean_with_excluded_m"] = ranking_errors(whole, in_space(accuracies)).mean_m
    outliers = [suspect.measurement for suspect, _ in gather_outliers(accuracies)]
    return {"answer": answer | {"outliers": outliers}}
