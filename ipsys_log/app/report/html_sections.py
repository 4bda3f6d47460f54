"""Sections of the HTML page: text and numbers for its templates, and their caveats."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from ipsys_log.app.report.accuracy import Accuracy
from ipsys_log.app.report.advice import label, uses_height
from ipsys_log.app.report.figures import has_legend
from ipsys_log.app.report.findings import Findings, overall_row, overall_row_with_excluded
from ipsys_log.app.report.points_figures import hull_m
from ipsys_log.app.report.rows import Rows, cm, mm, percent
from ipsys_log.messages import CameraEvaluation, ErrorStatistics
from ipsys_log.statistics.accuracy import POOLED
from ipsys_log.statistics.disagreement import PairDisagreement
from ipsys_log.statistics.tape import RiggedMeasurement, find_weak_points

_TRUTH = "truth"
# The page shows so many pairs of cameras, those that differ most; a folded table has all pairs.
_MOST_PAIRS = 10


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
        "mean": cm(errors.mean_m, 1),
        "interval": [cm(end_m, 1) for end_m in (errors.mean_low_m, errors.mean_high_m) if end_m is not None],
        "remaining": _remaining(errors),
        "in_space": findings.in_space,
        "crossed": bool(best.rows(True)),
        "count": errors.count,
        "counts": _counts(best),
        "floor": cm(row.error_2d.mean_m, 1),
        "excluded": [s.measurement for s in best.evaluation.excluded] if best.evaluation else [],
        "with_excluded": cm(findings.errors(whole).mean_m, 1) if whole else None,
        "p95": cm(errors.p95_m, 1),
        "truth": cm(findings.errors(truth).mean_m) if truth else None,
        "told": [
            (label(accuracy.model), _overall_mean(findings, accuracy)) for accuracy in height_models[:1]
        ],
        "fitted": _fitted(findings),
        "cameras": findings.cameras,
    }


def _remaining(errors: ErrorStatistics) -> list[str]:
    """Return the mean error after the error of the tape and the ends of its interval; empty if unknown."""
    values_m = errors.remaining_m, errors.remaining_low_m, errors.remaining_high_m
    return [] if None in values_m else [cm(value_m) for value_m in values_m]


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
    return cm(findings.errors(row).mean_m if row else None, 1)


def in_order(findings: Findings, by_camera: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return pairs of camera and value, in the order of the rig."""
    rest = sorted(set(by_camera) - {*findings.cameras})
    return [(name, by_camera[name]) for name in (*findings.cameras, *rest) if name in by_camera]


# The columns of errors of each scheme: over all cameras, and of one camera.
_COLUMNS: dict[bool, dict[str, tuple[str, ...]]] = {
    True: {
        "cross-validation": ("3D mean (95 % CI)", "3D RMSE", "3D p95", "2D mean"),
        "held-out points": ("3D mean (95 % CI)", "3D RMSE", "3D max", "2D mean"),
    },
    False: {
        "cross-validation": ("3D mean (95 % CI)", "3D p95", "2D mean (95 % CI)"),
        "held-out points": ("n", "3D mean", "3D min", "3D max", "3D std", "2D mean"),
    },
}


def models_table(findings: Findings, camera: str = POOLED) -> Rows:
    """Return one row per model and reference (tape or truth), for one camera or for all; the best first."""
    against = [a for a in ("tape", _TRUTH) if any(_rows(f, camera, a) for f in findings.accuracies)]
    has_excluded = camera == POOLED and any(evaluation.with_excluded for evaluation in findings.evaluations)
    columns = _COLUMNS[camera == POOLED]
    names = ["model", *(["against"] if len(against) > 1 else [])]
    cells = []
    for accuracy in findings.ranked():
        for side in against:
            if not (rows := _rows(accuracy, camera, side)):
                continue
            row = [label(accuracy.model), side][: len(names)]
            for scheme, heads in columns.items():
                errors = accuracy.errors_of(rows[scheme]) if scheme in rows else None
                row += [errors.text(head) if errors else cm(None) for head in heads]
            cells.append([*row, *([_mean_with_excluded(accuracy, camera, side)] if has_excluded else [])])
    last = [">with gross outliers, mean"] if has_excluded else []
    return Rows(
        "",
        [*names, *(_head(name) for heads in columns.values() for name in heads), *last],
        cells,
        groups=[
            ("", len(names)),
            *((scheme, len(heads)) for scheme, heads in columns.items()),
            ("", len(last)),
        ],
    )


def _head(column: str) -> str:
    """Return the head of a column of errors; means line up at the left, beside their intervals."""
    return column if "CI" in column else f">{column}"


def _mean_with_excluded(accuracy: Accuracy, camera: str, against: str) -> str:
    """Return the mean error with the gross outliers, by cross-validation or else on held-out points."""
    rows = accuracy.rows_with_excluded(True) or accuracy.rows_with_excluded(False)
    rows = [row for row in rows if row.against == against]
    same = [row for row in rows if row.camera == camera] or (rows[:1] if camera == POOLED else [])
    return cm((same[0].error_3d or same[0].error_2d).mean_m if same else None)


def _rows(accuracy: Accuracy, camera: str, against: str) -> dict[str, CameraEvaluation]:
    """Return the rows of a model by the scheme of its errors."""
    rows: dict[str, CameraEvaluation | None] = {}
    for scheme, crossed in (("cross-validation", True), ("held-out points", False)):
        if camera == POOLED:
            rows[scheme] = overall_row(accuracy, crossed, against)
        else:
            of_camera = [r for r in accuracy.rows(crossed) if (r.camera, r.against) == (camera, against)]
            rows[scheme] = of_camera[0] if of_camera else None
    return {scheme: row for scheme, row in rows.items() if row is not None}


# A share contradicts the covariance if it differs from the expected share by more standard deviations.
_SURE = 1.96
# Neighbouring differences have the same error, so a share somewhat below 95 % is no contradiction.
_EXPLAINED = 0.90
# Number of sample points on each side of the floor.
_GRID = 200


def weak_points_table(places: Sequence[RiggedMeasurement]) -> Rows | None:
    """Return points whose tape circles cross at a flat angle, the worst first; None without tape points."""
    if not any(len(place.measurement.distances) > 1 for place in places):
        return None
    columns = ("point", ">crossing angle", ">standard deviation in cm")
    flat = find_weak_points(places)
    return Rows("", columns, [(one.id, f"{one.angle_deg:.0f}°", cm(one.sigma_m, 1)) for one in flat])


def coverage(findings: Findings) -> dict[str, Any]:
    """Return the extent of the fitted points of each camera, and the share of the floor outside of all."""
    training = in_order(findings, findings.training_m())
    hulls, cells = [], []
    for camera, points_m in training:
        corners_m = hull_m(points_m)
        hulls += [] if corners_m is None else [corners_m]
        area = "-" if corners_m is None else f"{_area_m2(corners_m):.1f}"
        spans = zip(points_m.min(0), points_m.max(0), strict=True)
        cells.append([camera, str(len(points_m)), area, *(f"{low:.2f} to {high:.2f}" for low, high in spans)])
    floor = findings.rig.floor if findings.rig else None
    outside = None
    if floor is not None and hulls:
        steps = (np.arange(_GRID) + 0.5) / _GRID
        grid_m = np.stack(np.meshgrid(steps * floor.width_m, steps * floor.depth_m), axis=-1).reshape(-1, 2)
        inside = np.any([Outline(corners_m).contains_points(grid_m) for corners_m in hulls], axis=0)
        outside = f"{100 * (1 - inside.mean()):.0f}"
    columns = ("camera", ">points", ">area in m²", "x in m", "y in m", "height in m")
    return {"table": Rows("", columns, cells), "outside": outside}


def _area_m2(corners_m: NDArray[np.float64]) -> float:
    x, y = corners_m.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)


def calibration_table(findings: Findings) -> Rows:
    """Return a row on the consistency of the covariance, for each model with a covariance."""
    cells = []
    for accuracy in findings.ranked():
        rows = [overall_row(accuracy, crossed) for crossed in (True, False)]
        rows = [row if row is not None and row.within_68 is not None else None for row in rows]
        if any(rows):
            shares = [(row.within_68, row.within_95) if row else (None, None) for row in rows]
            verdict = _verdict(next(row for row in rows if row))
            cells.append([label(accuracy.model), *(percent(one) for pair in shares for one in pair), verdict])
    columns = ("model", ">68 %", ">95 %", ">68 %", ">95 %", "result")
    groups = (("", 1), ("cross-validation", 2), ("held-out points", 2), ("", 1))
    return Rows("", columns, cells, groups=groups)


def overlap_tables(pairs: Sequence[PairDisagreement]) -> dict[str, Rows | None]:
    """Return the table that the page shows, and one of ``all`` pairs if these are only the largest ones."""
    if len(pairs) <= _MOST_PAIRS:
        return {"table": _overlap_table(pairs), "all": None}
    largest = sorted(pairs, key=lambda pair: -pair.median_m)[:_MOST_PAIRS]
    return {"table": _overlap_table(largest), "all": _overlap_table(pairs)}


def _overlap_table(pairs: Sequence[PairDisagreement]) -> Rows:
    """Return a row for each pair of cameras: their disagreement in the overlap, in mm."""
    cells = [
        [
            " and ".join(pair.cameras), str(len(pair.times_ns)), mm(pair.median_m), mm(pair.p95_m),
            percent(pair.within_95), _overlap_verdict(pair.within_95),
        ]
        for pair in pairs
    ]  # fmt: skip
    columns = ("cameras", ">count", ">median in mm", ">95 % below", ">in 95 % region", "result")
    return Rows("", columns, cells)


def _overlap_verdict(within_95: float | None) -> str:
    if within_95 is None:
        return "-"
    return "consistent" if within_95 >= _EXPLAINED else "larger than the covariances explain"


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
