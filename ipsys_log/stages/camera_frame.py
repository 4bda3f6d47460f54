"""Markers in pixels to points in the frame of the camera (eq. 3 to 5)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.geometry.lenses import check_calibration, undistort
from ipsys_log.geometry.markers import camera_point, heading
from ipsys_log.messages import (
    CameraCalibration,
    CameraPoint,
    CameraPoints,
    Event,
    Marker,
    Markers,
    Message,
    Rig,
)

__all__ = ["READS", "CameraFrame"]

READS = (Rig, CameraCalibration, Markers)


class CameraFrame:
    """The stage *camera-frame*: through the lens of each camera, with the marker's length."""

    def __init__(self) -> None:
        self._rig: Rig | None = None
        self._lenses: dict[str | None, CameraCalibration] = {}

    def __call__(self, message: Message) -> Iterator[Any]:
        payload = message.payload
        if isinstance(payload, Rig):
            self._rig = payload
        elif isinstance(payload, CameraCalibration):
            self._lenses[message.camera] = check_calibration(payload, f"calibration of {message.camera}")
        else:
            self._check_size(payload, message.camera)
            points = []
            for marker in payload.markers:
                point = self._point(marker, message.camera)
                if point is not None:
                    points.append(point)
                    continue
                text = f"marker {marker.id} lies where the calibration of {message.camera} has no ray"
                yield Event(message.publish_time_ns, "outside_lens", text, message.camera, marker.id)
            yield CameraPoints(message.publish_time_ns, tuple(points))

    def _check_size(self, seen: Markers, camera: str | None) -> None:
        lens = self._lenses.get(camera)
        if lens is not None and (lens.width, lens.height) != (seen.width, seen.height):
            raise IpsysError(
                f"camera {camera}: its frames are {seen.width} x {seen.height} px, its calibration is for "
                f"{lens.width} x {lens.height}; calibrate at the size that is recorded, and give that with "
                f"--calibration {camera}=calibration.yaml"
            )

    def _point(self, marker: Marker, camera: str | None) -> CameraPoint | None:
        """The marker's centre; None where a corner has no ray through the lens."""
        if self._rig is None:
            raise IpsysError("the log has no rig (marker length): give one with --rig lab.toml")
        if camera not in self._lenses:
            raise IpsysError(
                f"camera {camera} has no calibration in the log: give one with "
                f"--calibration {camera}=calibration.yaml"
            )
        uv = undistort(marker.corners_px, self._lenses[camera])
        if not np.isfinite(uv).all():
            return None
        x_m, y_m, z_m = camera_point(uv, self._rig.length_of(marker.id))
        return CameraPoint(marker.id, float(x_m), float(y_m), float(z_m), heading(uv))
