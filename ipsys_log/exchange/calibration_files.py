"""A lens out of whatever file a user has it in: a calibration of OpenCV or ROS, or a log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.opencv_yaml import read_opencv_calibration
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration

__all__ = ["read_lens"]


def read_lens(path: Path, camera: str) -> CameraCalibration:
    """The lens of a camera from a YAML file of OpenCV or ROS, or from a log (``.mcap``).

    A log has it as the camera's newest calibration; one that holds a single calibration may have it under
    another name.

    Raises
    ------
    IpsysError
        Where there is no such file, it cannot be read, or it holds no calibration of this camera.
    """
    if path.suffix != ".mcap":
        return read_opencv_calibration(path, camera)
    with Session([path]) as log:
        topics = log.calibrations
        name = next(iter(topics)) if len(topics) == 1 else camera
        if name not in topics:
            held = ", ".join(topics) or "none"
            raise IpsysError(f"{path}: holds no calibration of camera {camera}; it has those of: {held}")
        lens: CameraCalibration = log.payloads([topics[name]])[-1]
    return replace(lens, frame_id=camera)
