"""The floor map of the dashboard: everything on it that does not change during a recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from ipsys_log.analysis.floor_cameras import outline_view, read_floor_cameras
from ipsys_log.arrays import Array
from ipsys_log.messages import CameraCalibration, Model, Rig
from ipsys_log.report.styles import camera_styles, shorten

_DECIMALS = 3  # of m
# Margin of the map around its content, without a known floor.
_MARGIN_M = 0.5


def describe_floor(rig: Rig | None, model: Model | None, lenses: Mapping[str, CameraCalibration]) -> Any:
    """Return the constant content of the map as JSON.

    It has the size of the lab, its reference points, the field of view of each camera on the floor, and the
    hull of the calibration points, in m.

    Parameters
    ----------
    rig : None if the log has none.
    model : the fitted model; None without one. Its calibration points give the poses of the cameras.
    lenses : intrinsics by camera.

    Raises
    ------
    IpsysError
        The model or the intrinsics of a camera are not valid.
    """
    cameras = {} if model is None else read_floor_cameras(model, lenses)
    colours = camera_styles(lenses)
    outlines = {name: outline_view(camera) for name, camera in cameras.items()}
    measured = _hull(_measured_points(model))
    references = () if rig is None else rig.reference_points
    points_m = [np.array([[point.x_m, point.y_m] for point in references]).reshape(-1, 2), measured]
    return {
        "lab": "" if rig is None else shorten(rig.name),
        "bounds": _bounds(rig, points_m, [*outlines.values()]),
        "has_floor": rig is not None and rig.floor is not None,
        "references": [{"name": shorten(point.name), "x": point.x_m, "y": point.y_m} for point in references],
        "views": [
            {"camera": name, "colour": colours[name][0], "outline": _rounded(outline)}
            for name, outline in sorted(outlines.items())
            if len(outline)
        ],
        "measured": _rounded(measured),
    }


def _measured_points(model: Model | None) -> Array:
    cameras = () if model is None else model.cameras
    points_m = [pair.world_m[:2] for camera in cameras for pair in camera.pairs]
    return np.array([point for point in points_m if np.isfinite(point).all()]).reshape(-1, 2)


def _hull(points_m: Array) -> Array:
    """Return the convex hull (k, 2) of points (n, 2); empty for fewer than three."""
    if len(points_m) < 3:
        return np.zeros((0, 2))
    return np.asarray(cv2.convexHull(points_m.astype(np.float32)).reshape(-1, 2), dtype=np.float64)


def _bounds(rig: Rig | None, points_m: list[Array], outlines_m: list[Array]) -> list[float]:
    """Return the lower and the upper corner of the map: the floor, or all that is known."""
    if rig is not None and rig.floor is not None:
        return [0.0, 0.0, rig.floor.width_m, rig.floor.depth_m]
    known = np.concatenate([*points_m, *outlines_m])
    if not len(known):
        known = np.array([[0.0, 0.0], [4.0, 3.0]])
    low_m, high_m = known.min(axis=0) - _MARGIN_M, known.max(axis=0) + _MARGIN_M
    return [round(float(value), _DECIMALS) for value in (*low_m, *high_m)]


def _rounded(points_m: Array) -> Any:
    return points_m.round(_DECIMALS).tolist()
