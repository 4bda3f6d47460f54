"""Readers and writers of camera calibration files of OpenCV, ROS and Kalibr."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.calibrate import CalibrationResult
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.kalibr_files import find_cameras, read_camchain
from ipsys_log.geometry.lenses import check_calibration
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.log.ros2 import ROS2_MODELS
from ipsys_log.messages import CameraCalibration

__all__ = [
    "FORMATS",
    "calibration_text",
    "check_format",
    "kalibr_yaml",
    "opencv_yaml",
    "read_intrinsics",
    "read_opencv_calibration",
    "ros_yaml",
]

# Names that programs use in these files for the camera matrix, the coefficients and the image size.
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

    The file names the distortion model. Without a name, four coefficients belong to the fisheye model
    (k1..k4). Five or eight coefficients belong to the pinhole model.

    Raises
    ------
    IpsysError
        The file cannot be read, or lacks the matrix, the coefficients or the image size.
    """
    if not path.is_file():
        raise IpsysError(f"{path}: does not exist; 'ipsys calibrate' writes a calibration file")
    try:
        storage = cv2.FileStorage(_as_file_storage(path), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        k, d = _read_matrix(storage, _K), _read_matrix(storage, _D)
        width, height = _number(storage, _WIDTH), _number(storage, _HEIGHT)
        model_name = _text(storage, "distortion_model")
    except OSError as error:
        raise IpsysError(f"{path}: cannot be read: {error.strerror}") from error
    except (cv2.error, SystemError, ValueError) as error:
        raise IpsysError(f"{path}: is not a calibration in OpenCV's YAML format") from error
    if k is None or d is None or k.size != 9 or not width or not height:
        raise IpsysError(
            f"{path}: the camera matrix, the distortion coefficients or the image size is missing"
        )
    if width < 0 or height < 0:
        raise IpsysError(f"{path}: the image width and height must be 1 to {_WIDEST_PX} pixels")
    model = _MODEL_OF_NAME.get(model_name, model_name) or _MODEL_OF_COUNT.get(
        d.size, f"with {d.size} coefficients"
    )
    if model == "plumb_bob" and d.size == 4:
        d = np.append(d, 0.0)  # many files leave out k3
    lens = CameraCalibration(time_ns, camera, width, height, model, d.reshape(-1), k.reshape(3, 3))
    return check_calibration(lens, str(path))


def _as_file_storage(path: Path) -> str:
    """Add the first line that OpenCV requires in YAML; ROS does not write it."""
    if path.stat().st_size > _LARGEST_FILE:
        raise ValueError("too large")
    text = path.read_text(encoding="utf-8")
    # OpenCV's reader makes one recursive call per level, without a limit.
    if sum(map(text.count, "[{<")) > _MOST_BRACKETS or "\0" in text:
        raise ValueError("too many levels")
    is_yaml = path.suffix.lower() in (".yaml", ".yml")
    return text if not is_yaml or text.startswith("%YAML") else f"%YAML:1.0\n---\n{text}"


def _read_matrix(storage: cv2.FileStorage, names: tuple[str, ...]) -> NDArray[np.float64] | None:
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


def opencv_yaml(lens: CameraCalibration, sigmas: Mapping[str, float], comment: str) -> str:
    """Return a FileStorage YAML: matrix, coefficients, image size, and the standard deviations by name.

    Parameters
    ----------
    lens : camera intrinsics to write.
    sigmas : standard deviations by name of the parameter, fx to the last coefficient.
    comment : text of the first lines.
    """
    deviations = [f"   {name}: {value!r}" for name, value in sigmas.items()]
    lines = [
        "%YAML:1.0",
        "---",
        *(f"# {line}" for line in comment.splitlines()),
        f"image_width: {lens.width}",
        f"image_height: {lens.height}",
        f"camera_name: {lens.frame_id}",
        *_matrix("camera_matrix", 3, 3, lens.K.ravel(), tag=True),
        f"distortion_model: {lens.distortion_model}",
        *_matrix("distortion_coefficients", lens.D.size, 1, lens.D, tag=True),
        "# One standard deviation of each; 0 was not fitted.",
        "standard_deviations:",
        *deviations,
    ]
    return "\n".join(lines) + "\n"


def ros_yaml(lens: CameraCalibration, sigmas: Mapping[str, float], comment: str) -> str:  # noqa: ARG001
    """Return a ``camera_info`` YAML; ROS calls the fisheye model ``equidistant``."""
    model = ROS2_MODELS.get(lens.distortion_model, lens.distortion_model)
    projection = np.column_stack([lens.K, np.zeros(3)])
    lines = [
        *(f"# {line}" for line in comment.splitlines()),
        f"image_width: {lens.width}",
        f"image_height: {lens.height}",
        f"camera_name: {lens.frame_id}",
        *_matrix("camera_matrix", 3, 3, lens.K.ravel()),
        f"distortion_model: {model}",
        *_matrix("distortion_coefficients", 1, lens.D.size, lens.D),
        *_matrix("rectification_matrix", 3, 3, np.eye(3).ravel()),
        *_matrix("projection_matrix", 3, 4, projection.ravel()),
    ]
    return "\n".join(lines) + "\n"


def kalibr_yaml(lens: CameraCalibration, sigmas: Mapping[str, float], comment: str) -> str:  # noqa: ARG001
    """Return a ``camchain`` YAML of one camera; :func:`check_format` rejects models that Kalibr lacks."""
    fisheye = lens.distortion_model == "kannala_brandt"
    intrinsics = [lens.K[0, 0], lens.K[1, 1], lens.K[0, 2], lens.K[1, 2]]
    lines = [
        *(f"# {line}" for line in comment.splitlines()),
        "cam0:",
        "  camera_model: pinhole",
        f"  intrinsics: {_row(intrinsics)}",
        f"  distortion_model: {'equidistant' if fisheye else 'radtan'}",
        f"  distortion_coeffs: {_row(lens.D[:4])}",
        f"  resolution: [{lens.width}, {lens.height}]",
        f"  rostopic: /cameras/{lens.frame_id}/image",
        "  cam_overlaps: []",
    ]
    return "\n".join(lines) + "\n"


# For each format name: the function that writes it, and the suffix after the camera name in the file name.
FORMATS: dict[str, tuple[Callable[[CameraCalibration, Mapping[str, float], str], str], str]] = {
    "opencv": (opencv_yaml, ""),
    "ros": (ros_yaml, "_ros"),
    "kalibr": (kalibr_yaml, "_kalibr"),
}


def check_format(name: str, lens_model: str) -> None:
    """Check that a format exists and supports the lens model (``fisheye``, ``pinhole4`` ...).

    Raises
    ------
    IpsysError
        The format does not exist, or does not support the lens model.
    """
    if name not in FORMATS:
        raise IpsysError(f"--format {name}: is not known; use one of {', '.join(FORMATS)}")
    if name == "kalibr" and lens_model not in ("fisheye", "pinhole4"):
        raise IpsysError(
            f"--format kalibr: Kalibr has four coefficients, but --lens {lens_model} has more; "
            "use --lens fisheye or --lens pinhole4"
        )


def _matrix(name: str, rows: int, columns: int, values: Iterable[float], tag: bool = False) -> list[str]:
    first = [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d"]
    plain = [f"{name}:", f"   rows: {rows}", f"   cols: {columns}"]
    return [*(first if tag else plain), f"   data: {_row(values)}"]


def _row(values: Iterable[float]) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def read_intrinsics(path: LogLocation, camera: str) -> CameraCalibration:
    """Read the intrinsics of a camera from a YAML file of OpenCV, ROS or Kalibr, or from a log (``.mcap``).

    The log can be at a URL.

    From a log, the newest calibration of the camera is read. If the log holds the calibration of a single
    camera, this camera may have another name.

    Raises
    ------
    IpsysError
        The file does not exist, cannot be read, or holds no calibration of this camera.
    """
    if path.suffix != ".mcap":
        if not isinstance(path, Path):
            raise IpsysError(f"{path}: is at a URL, where only a log (.mcap) can be read; download the file")
        read = read_camchain if find_cameras(path) else read_opencv_calibration
        return read(path, camera)
    with Session([path]) as log:
        topics = log.calibrations
        name = next(iter(topics)) if len(topics) == 1 else camera
        if name not in topics:
            names = ", ".join(topics) or "none"
            raise IpsysError(f"{path}: has no calibration of camera {camera}, only of {names}")
        lens: CameraCalibration = log.payloads([topics[name]])[-1]
    return replace(lens, frame_id=camera)


def calibration_text(result: CalibrationResult, name: str = "opencv") -> str:
    """Return the file of a result of an intrinsic calibration, in a format of ``FORMATS``."""
    comment = (
        f"ipsys calibrate: RMS {result.rms_px:.3f} px, median {result.median_px:.3f} px over "
        f"{len(result.pixels)} corners of {len(result.used)} pictures"
    )
    sigmas = dict(zip(result.names, result.sigmas.tolist(), strict=True))
    return FORMATS[name][0](result.lens, sigmas, comment)
