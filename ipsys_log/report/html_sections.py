"""Sections of the HTML page: text and numbers for its templates, and their caveats."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from ipsys_log.analysis.accuracy import POOLED
from ipsys_log.analysis.disagreement import PairDisagreement
from ipsys_log.analysis.tape import RiggedMeasurement, find_weak_points
from ipsys_log.messages import CameraEvaluation, ErrorStatistics
from ipsys_log.report.accuracy import Accuracy, gather_outliers
from ipsys_log.report.advice import GROUPS, Choice, label, uses_height
from ipsys_log.report.figures import has_legend
from ipsys_log.report.findings import Findings, overall_row, overall_row_with_excluded
from ipsys_log.report.points_figure import hull_m
from ipsys_log.units import CM_PER_M, MM_PER_M

_TRUTH = "truth"
# The page shows so many pairs of cameras, those that differ most; a folded table has all pairs.
_MOST_PAIRS = 10


def format_cm(value_m: float | None, digits: int = 2) -> str:
    """Format a length in cm, or return a dash if it is not known."""
    return "–" if value_m is None else f"{value_m * CM_PER_M:.{digits}f}"


def _interval(errors: ErrorStatistics) -> str:
    if errors.mean_low_m is None or errors.mean_high_m is None:
        return ""
    return f"{format_cm(errors.mean_low_m)} to {format_cm(errors.mean_high_m)}"


def headline(findings: Findings) -> dict[str, Any]:
    """Return the best model, its errors, and the data behind this result."""
    ranked = findings.ranked()
    best = ranked[0]
    row = overall_row(best, True) or overall_row(best, False)
    assert row is not None  # a model without any row was not evaluated
    whole = overall_row_with_excluded(best, bool(best.rows(True)))
    errors, truth = findings.errors(row), overall_row(best, bool(best.rows(True)), _TRUTH)
    height_models = [accuracy for accuracy in ranked if uses_height(accuracy.model) and accuracy is not best]
    return {
        "model": label(best.model),
        "mean": format_cm(errors.mean_m, 1),
        "interval": [
            format_cm(end_m, 1) for end_m in (errors.mean_low_m, errors.mean_high_m) if end_m is not None
        ],
        "remaining": _remaining(errors),
        "in_space": findings.in_space,
        "crossed": bool(best.rows(True)),
        "count": errors.count,
        "counts": _counts(best),
        "floor": format_cm(row.error_2d.mean_m, 1),
        "excluded": [s.measurement for s in best.evaluation.excluded] if best.evaluation else [],
        "with_excluded": format_cm(findings.errors(whole).mean_m, 1) if whole else None,
        "p95": format_cm(errors.p95_m, 1),
        "truth": format_cm(findings.errors(truth).mean_m, 2) if truth else None,
        "told": [
            (label(accuracy.model), _overall_mean(findings, accuracy)) for accuracy in height_models[:1]
        ],
        "fitted": _fitted(findings),
        "cameras": findings.cameras,
    }


def _remaining(errors: ErrorStatistics) -> list[str]:
    """Return the mean error after the error of the tape and the ends of its interval; empty if unknown."""
    values_m = errors.remaining_m, errors.remaining_low_m, errors.remaining_high_m
    return [] if None in values_m else [format_cm(value_m) for value_m in values_m]


def _fitted(findings: Findings) -> dict[str, str] | None:
    """Return the numbers of fitted points of the cameras, or their range for many cameras."""
    points = in_order(findings, findings.training_m())
    counts = [len(points_m) for _, points_m in points]
    if not points:
        return None
    if has_legend(len(points)):
        return {
            "counts": ", ".join(map(str, counts)),
            "cameras": ": " + ", ".join(camera for camera, _ in points),
        }
    counted = f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else str(counts[0])
    return {"counts": counted, "cameras": f", per camera, with {len(points)} cameras"}


def _counts(accuracy: Accuracy) -> list[str]:
    """Return the numbers of points behind the errors, as texts."""
    schemes = {"cross-validated": overall_row(accuracy, True), "held out": overall_row(accuracy, False)}
    return [f"{row.error_2d.count} {name}" for name, row in schemes.items() if row]


def _overall_mean(findings: Findings, accuracy: Accuracy) -> str:
    row = overall_row(accuracy, True) or overall_row(accuracy, False)
    return format_cm(findings.errors(row).mean_m if row else None, 1)


def in_order(findings: Findings, by_camera: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return pairs of camera and value, in the order of the rig."""
    rest = sorted(set(by_camera) - {*findings.cameras})
    return [(name, by_camera[name]) for name in (*findings.cameras, *rest) if name in by_camera]


def advice_rows(findings: Findings) -> dict[str, Any] | None:
    """Return the model to use by number of points; columns are the groups with different choices."""
    advice = findings.advice
    if advice is None:
        return None
    return {
        "published": advice.published,
        "in_space": advice.in_space,
        "groups": [GROUPS[group] for group in advice.groups],
        "rows": [
            (places, [_choice(choices.get(group)) for group in advice.groups])
            for places, choices in advice.choices.items()
        ],
        "sentences": advice.sentences,
    }


def _choice(choice: Choice | None) -> dict[str, str] | None:
    if choice is None:
        return None
    other = choice.lowest if choice.lowest != choice.model else ""
    return {
        "model": choice.model,
        "mean": format_cm(choice.mean_m),
        "lowest": other,
        "lowest_mean": format_cm(choice.lowest_mean_m),
    }


def model_rows(findings: Findings, camera: str = POOLED) -> list[dict[str, Any]]:
    """Return one row per model and reference (tape or truth), for one camera or for all; the best first."""
    against = [a for a in ("tape", _TRUTH) if any(_rows(f, camera, a) for f in findings.accuracies)]
    excluded = any(evaluation.with_excluded for evaluation in findings.evaluations)
    return [
        {
            "model": label(accuracy.model),
            "against": side,
            "several": len(against) > 1,
            "held_out": _errors(accuracy, rows.get(False)),
            "crossed": _errors(accuracy, rows.get(True)),
            "whole": _whole(accuracy, camera, side) if excluded else "",
        }
        for accuracy in findings.ranked()
        for side in against
        if (rows := _rows(accuracy, camera, side))
    ]


def _whole(accuracy: Accuracy, camera: str, against: str) -> str:
    """Return the mean error with the gross outliers, by cross-validation or else on held-out points."""
    rows = accuracy.rows_with_excluded(True) or accuracy.rows_with_excluded(False)
    rows = [row for row in rows if row.against == against]
    same = [row for row in rows if row.camera == camera] or (rows[:1] if camera == POOLED else [])
    return format_cm((same[0].error_3d or same[0].error_2d).mean_m) if same else "–"


def _rows(accuracy: Accuracy, camera: str, against: str) -> dict[bool, CameraEvaluation]:
    """Return the rows of a model; the key is True for cross-validation, False for held-out points."""
    if camera == POOLED:
        rows = {crossed: overall_row(accuracy, crossed, against) for crossed in (False, True)}
    else:
        rows = {
            crossed: next(
                (r for r in accuracy.rows(crossed) if (r.camera, r.against) == (camera, against)), None
            )
            for crossed in (False, True)
        }
    return {crossed: row for crossed, row in rows.items() if row is not None}


def _errors(accuracy: Accuracy, row: CameraEvaluation | None) -> dict[str, str] | None:
    if row is None:
        return None
    names = ("mean", "min", "max", "std", "median", "p95")
    space, floor = row.error_3d, row.error_2d
    return {
        "n": str(floor.count),
        **{name: format_cm(getattr(space, f"{name}_m") if space else None) for name in names},
        "rmse": format_cm(accuracy.rmse_m(row, space)),
        "interval": _interval(space) if space else "",
        "floor": format_cm(floor.mean_m),
        "floor_interval": _interval(floor),
        "floor_max": format_cm(floor.max_m),
    }


# A share contradicts the covariance if it differs from the expected share by more standard deviations.
_SURE = 1.96
# Neighbouring differences have the same error, so a share somewhat below 95 % is no contradiction.
_EXPLAINED = 0.90
# Number of sample points on each side of the floor.
_GRID = 200


def suspects(findings: Findings) -> list[dict[str, Any]]:
    """Return each outlier with the correction that would explain it, the worst first."""
    return [
        {
            "name": suspect.measurement,
            "cameras": ", ".join(suspect.cameras),
            "off": format_cm(float(np.linalg.norm(suspect.residual_m)), 1),
            "offset": ", ".join(f"{value * CM_PER_M:+.1f}" for value in suspect.residual_m.tolist()),
            "score": f"{suspect.score:.1f}",
            "text": suspect.text,
            "corrected": _point(suspect.corrected_m),
            "models": ", ".join(models),
        }
        for suspect, models in gather_outliers(findings.accuracies)
    ]


def _point(point_m: Iterable[float] | None) -> str:
    return "" if point_m is None else ", ".join(f"{value * CM_PER_M:.1f}" for value in point_m)


def flat_rows(places: Sequence[RiggedMeasurement]) -> list[dict[str, str]] | None:
    """Return points whose tape circles cross at a flat angle, the worst first; None without tape points."""
    if not any(len(place.measurement.distances) > 1 for place in places):
        return None
    return [
        {"name": flat.id, "angle": f"{flat.angle_deg:.0f}", "sigma": format_cm(flat.sigma_m, 1)}
        for flat in find_weak_points(places)
    ]


def coverage(findings: Findings) -> dict[str, Any]:
    """Return the extent of the fitted points of each camera, and the share of the floor outside of all."""
    training = in_order(findings, findings.training_m())
    hulls = [corners_m for _, points_m in training if (corners_m := hull_m(points_m)) is not None]
    rows = []
    for camera, points_m in training:
        corners_m = hull_m(points_m)
        spans = [
            f"{low:.2f} to {high:.2f}" for low, high in zip(points_m.min(0), points_m.max(0), strict=True)
        ]
        area = "–" if corners_m is None else f"{_area_m2(corners_m):.1f}"
        rows.append({"camera": camera, "count": len(points_m), "spans": spans, "area": area})
    floor = findings.rig.floor if findings.rig else None
    outside = None
    if floor is not None and hulls:
        steps = (np.arange(_GRID) + 0.5) / _GRID
        grid_m = np.stack(np.meshgrid(steps * floor.width_m, steps * floor.depth_m), axis=-1).reshape(-1, 2)
        inside = np.any([Outline(corners_m).contains_points(grid_m) for corners_m in hulls], axis=0)
        outside = f"{100 * (1 - inside.mean()):.0f}"
    return {"rows": rows, "outside": outside}


def _area_m2(corners_m: NDArray[np.float64]) -> float:
    x, y = corners_m.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)


def calibration(findings: Findings) -> list[dict[str, Any]]:
    """Return a row on the consistency of the covariance, for each model with a covariance."""
    rows = []
    for accuracy in findings.ranked():
        schemes = {
            name: overall_row(accuracy, crossed) for name, crossed in (("crossed", True), ("held_out", False))
        }
        known_rows = {
            name: row for name, row in schemes.items() if row is not None and row.within_68 is not None
        }
        if known_rows:
            rows.append(
                {
                    "model": label(accuracy.model),
                    **{
                        name: (_percent(row.within_68), _percent(row.within_95))
                        for name, row in known_rows.items()
                    },
                    "verdict": _verdict(next(iter(known_rows.values()))),
                }
            )
    return rows


def overlap_tables(pairs: Sequence[PairDisagreement]) -> dict[str, list[dict[str, str]]]:
    """Return the ``rows`` that the page shows, and ``all`` rows if these are only the largest ones."""
    if len(pairs) <= _MOST_PAIRS:
        return {"rows": overlap_rows(pairs), "all": []}
    largest = sorted(pairs, key=lambda pair: -pair.median_m)[:_MOST_PAIRS]
    return {"rows": overlap_rows(largest), "all": overlap_rows(pairs)}


def overlap_rows(pairs: Sequence[PairDisagreement]) -> list[dict[str, str]]:
    """Return a row for each pair of cameras: their disagreement in the overlap, in mm."""
    return [
        {
            "cameras": " and ".join(pair.cameras),
            "count": str(len(pair.times_ns)),
            "median": f"{pair.median_m * MM_PER_M:.1f}",
            "p95": f"{pair.p95_m * MM_PER_M:.1f}",
            "within": _percent(pair.within_95),
            "verdict": _overlap_verdict(pair.within_95),
        }
        for pair in pairs
    ]


def _overlap_verdict(within_95: float | None) -> str:
    if within_95 is None:
        return "–"
    return "consistent" if within_95 >= _EXPLAINED else "larger than the covariances explain"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.0f} %"


def _verdict(row: CameraEvaluation) -> str:
    def beyond(share: float | None, said: float) -> float:
        """Return the excess of a share over the expected share, in standard deviations of the share."""
        return (
            0.0 if share is None else float((share - said) / np.sqrt(said * (1 - said) / row.error_2d.count))
        )

    most, nearly_all = beyond(row.within_68, 0.68), beyond(row.within_95, 0.95)
    if most < -_SURE:
        return "overconfident: errors are larger than expected"
    if nearly_all < -_SURE:
        return "overconfident: more large errors than expected"
    return "underconfident: errors are smaller than expected" if most > _SURE else "consistent"
