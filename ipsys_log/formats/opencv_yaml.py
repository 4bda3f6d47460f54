"""Camera calibrations in OpenCV's FileStorage format, such as the authors of the paper publish."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.geometry.lenses import check_calibration
from ipsys_log.messages import CameraCalibration

__all__ = ["read_opencv_calibration"]

# Names under which programs write the camera matrix, the coefficients and the size.
_K = ("mtx", "camera_matrix", "K", "cameraMatrix", "Camera_Matrix")
_D = ("dist", "distortion_coefficients", "D", "distCoeffs", "dist_coeff", "Distortion_Coefficients")
_WIDTH, _HEIGHT = ("img_width", "image_width", "width"), ("img_height", "image_height", "height")
_MODEL_OF_COUNT = {4: "kannala_brandt", 5: "plumb_bob", 8: "rational_polynomial"}


def read_opencv_calibration(path: Path, camera: str, time_ns: int = 0) -> CameraCalibration:
    """A lens from a FileStorage YAML, XML or JSON file.

    Four coefficients are those of the fisheye model (k1..k4), five and eight those of the pinhole.

    Raises
    ------
    IpsysError
        Where the file cannot be read or lacks the matrix, the coefficients or the image size.
    """
    if not path.is_file():
        raise IpsysError(f"{path}: there is no such calibration file")
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise IpsysError(f"{path}: is not a calibration in OpenCV's YAML format") from error
    try:
        k, d = _matrix(storage, _K), _matrix(storage, _D)
        width, height = _number(storage, _WIDTH), _number(storage, _HEIGHT)
    finally:
        storage.release()
    if k is None or d is None or k.size != 9 or not width or not height:
        raise IpsysError(f"{path}: lacks the camera matrix, the distortion coefficients or the image size")
    model = _MODEL_OF_COUNT.get(d.size, f"with {d.size} coefficients")
    k = k.reshape(3, 3)
    p = np.hstack([k, np.zeros((3, 1))])
    lens = CameraCalibration(time_ns, camera, width, height, model, d.reshape(-1), k, np.eye(3), p)
    return check_calibration(lens, str(path))


def _matrix(storage: cv2.FileStorage, names: tuple[str, ...]) -> NDArray[np.float64] | None:
    for name in names:
        found = storage.getNode(name).mat()
        if found is not None:
            return np.asarray(found, dtype=np.float64)
    return None


def _number(storage: cv2.FileStorage, names: tuple[str, ...]) -> int:
    for name in names:
        node = storage.getNode(name)
        if not node.empty():
            return int(node.real())
    return 0
