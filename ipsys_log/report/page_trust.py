"""What the page of a session says of what to be careful with: places, regions, and the model's own word."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from ipsys_log.analysis.tape import Measured, flat_places
from ipsys_log.messages import CameraEvaluation
from ipsys_log.report.accuracy import gather_suspects
from ipsys_log.report.advice import label
from ipsys_log.report.findings import Findings, overall
from ipsys_log.report.html_sections import format_cm, in_order
from ipsys_log.report.points_figure import hull_m
from ipsys_log.units import CM_PER_M

__all__ = ["calibration", "coverage", "flat_rows", "suspects"]

# Beyond so many standard deviations a share is not the one that was said.
_SURE = 1.96
# Points each way that the floor is sampled at.
_GRID = 200


def suspects(findings: Findings) -> list[dict[str, Any]]:
    """Each suspect measurement with the correction that would explain it, the worst first."""
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
        for suspect, models in gather_suspects(findings.accuracies)
    ]


def _point(point_m: Iterable[float] | None) -> str:
    return "" if point_m is None else ", ".join(f"{value:.3f}" for value in point_m)


def flat_rows(places: Sequence[Measured]) -> list[dict[str, str]] | None:
    """Places whose tape circles cross flatly, the worst first; None where none was measured by tape."""
    if not any(len(place.measurement.distances) > 1 for place in places):
        return None
    return [
        {"name": flat.id, "angle": f"{flat.angle_deg:.0f}", "sigma": format_cm(flat.sigma_m, 1)}
        for flat in flat_places(places)
    ]


def coverage(findings: Findings) -> dict[str, Any]:
    """The volume of the measured places of each camera, and the share of the floor that lies outside all."""
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
    """Whether errors are as large as the covariance of a position says, for each model that has one."""
    rows = []
    for accuracy in findings.ranked():
        schemes = {
            name: overall(accuracy, crossed) for name, crossed in (("crossed", True), ("held_out", False))
        }
        known = {name: row for name, row in schemes.items() if row is not None and row.within_68 is not None}
        if known:
            rows.append(
                {
                    "model": label(accuracy.model),
                    **{
                        name: (_percent(row.within_68), _percent(row.within_95))
                        for name, row in known.items()
                    },
                    "verdict": _verdict(next(iter(known.values()))),
                }
            )
    return rows


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.0f} %"


def _verdict(row: CameraEvaluation) -> str:
    def beyond(share: float | None, said: float) -> float:
        """How many standard deviations of a share of so many places it is above what was said."""
        return (
            0.0 if share is None else float((share - said) / np.sqrt(said * (1 - said) / row.error_2d.count))
        )

    most, nearly_all = beyond(row.within_68, 0.68), beyond(row.within_95, 0.95)
    if most < -_SURE:
        return "errors are larger than it says"
    if nearly_all < -_SURE:
        return "more large errors than it says"
    return "errors are smaller than it says" if most > _SURE else "errors are as it says"
