"""Camera calibrations in OpenCV's FileStorage format, as the authors publish theirs, or in that of ROS."""

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
_LARGEST_FILE = 1 << 20  # bytes
_MOST_BRACKETS = 1_000
_MOST_NUMBERS = 100
_WIDEST_PX = 65_535
_MODEL_OF_NAME = {"equidistant": "kannala_brandt", "fisheye": "kannala_brandt", "": ""}
_MODEL_OF_COUNT = {4: "kannala_brandt", 5: "plumb_bob", 8: "rational_polynomial"}


def read_opencv_calibration(path: Path, camera: str, time_ns: int = 0) -> CameraCalibration:
    """Read intrinsics from a FileStorage YAML, XML or JSON file, or a ``camera_info`` YAML of ROS.

    The file names the distortion model. If it does not, four coefficients are those of the fisheye (k1..k4),
    five and eight those of the pinhole.

    Raises
    ------
    IpsysError
        The file cannot be read, or lacks the matrix, the coefficients or the image size.
    """
    if not path.is_file():
        raise IpsysError(f"{path}: there is no such calibration file; 'ipsys calibrate' writes one")
    try:
        storage = cv2.FileStorage(_as_file_storage(path), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        k, d = _matrix(storage, _K), _matrix(storage, _D)
        width, height = _number(storage, _WIDTH), _number(storage, _HEIGHT)
        named = _text(storage, "distortion_model")
    except OSError as error:
        raise IpsysError(f"{path}: cannot be read: {error.strerror}") from error
    except (cv2.error, SystemError, ValueError) as error:
        raise IpsysError(f"{path}: is not a calibration in OpenCV's YAML format") from error
    if k is None or d is None or k.size != 9 or not width or not height:
        raise IpsysError(f"{path}: lacks the camera matrix, the distortion coefficients or the image size")
    if width < 0 or height < 0:
        raise IpsysError(f"{path}: its image width or height must be 1 to {_WIDEST_PX} pixels")
    model = _MODEL_OF_NAME.get(named, named) or _MODEL_OF_COUNT.get(d.size, f"with {d.size} coefficients")
    if model == "plumb_bob" and d.size == 4:
        d = np.append(d, 0.0)  # k3 is often left out
    lens = CameraCalibration(time_ns, camera, width, height, model, d.reshape(-1), k.reshape(3, 3))
    return check_calibration(lens, str(path))


def _as_file_storage(path: Path) -> str:
    """Add the first line that OpenCV requires in YAML; ROS does not write it."""
    if path.stat().st_size > _LARGEST_FILE:
        raise ValueError("too large")
    text = path.read_text(encoding="utf-8")
    # OpenCV's reader is recursive for each level, without a limit.
    if sum(map(text.count, "[{<")) > _MOST_BRACKETS or "\0" in text:
        raise ValueError("too many levels")
    is_yaml = path.suffix.lower() in (".yaml", ".yml")
    return text if not is_yaml or text.startswith("%YAML") else f"%YAML:1.0\n---\n{text}"


def _matrix(storage: cv2.FileStorage, names: tuple[str, ...]) -> NDArray[np.float64] | None:
    for name in names:
        node = storage.getNode(name)
        data = node.getNode("data") if node.isMap() else node
        if data.isSeq() and data.size() <= _MOST_NUMBERS:
            return np.array([data.at(i).real() for i in range(data.size())])
        if node.isMap():
            # OpenCV allocates the size that the file states.
            rows, columns = (node.getNode(key).real() for key in ("rows", "cols"))
            if not (0 < rows <= _MOST_NUMBERS and 0 < columns <= _MOST_NUMBERS):
                raise ValueError("a matrix of another size")
            return np.asarray(node.mat(), dtype=np.float64)
    return None


def _number(storage: cv2.FileStorage, names: tuple[str, ...]) -> int:
    for name in names:
        node = storage.getNode(name)
        if not node.empty():
            size_px = node.real() if node.isInt() or node.isReal() else 0.0
            return int(size_px) if 0 < size_px <= _WIDEST_PX else -1
    return 0


def _text(storage: cv2.FileStorage, name: str) -> str:
    node = storage.getNode(name)
    return str(node.string()) if node.isString() else ""
