"""Reader of the ``camchain`` files of Kalibr: the intrinsics of one camera.

References
----------
https://github.com/ethz-asl/kalibr/wiki/yaml-formats
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.geometry.lenses import check_calibration
from ipsys_log.log.contents import parse_foreign_camera
from ipsys_log.messages import CameraCalibration

__all__ = ["find_cameras", "read_camchain"]

_LARGEST_FILE = 1 << 20  # bytes
_CAMERA = re.compile(r"^(cam\d+):[ \t]*$", re.MULTILINE)
# A list in brackets, or with a line for each number. The limits bound the time for a hostile file.
_LIST = (
    r"^[ \t]{{1,40}}{0}:\s{{0,40}}"
    r"(?:\[([^\]]{{0,1000}})\]|((?:\s{{0,40}}-[ \t][^\s\[]{{1,40}}[ \t]{{0,9}}$){{1,20}}))"
)
_TEXT = r"^[ \t]{{1,40}}{0}:[ \t]{{0,9}}['\"]?([^'\"\n]{{0,200}}?)['\"]?[ \t]{{0,9}}$"
# Lens models of Kalibr, with the name in a log and the number of coefficients.
_MODELS = {"equidistant": ("kannala_brandt", 4), "radtan": ("plumb_bob", 4)}


def find_cameras(path: Path) -> dict[str, str]:
    """Return the text of each camera in a ``camchain`` file by its name, ``cam0``; empty for another file."""
    try:
        if not path.is_file() or path.stat().st_size > _LARGEST_FILE:
            return {}
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return {}  # the reader of the other formats reports it
    parts = _CAMERA.split(text)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def read_camchain(path: Path, camera: str) -> CameraCalibration:
    """Read the intrinsics of a camera from a ``camchain`` file.

    The camera is the one whose ``rostopic`` names it, such as ``/red/image_raw``, or that has its name, such
    as ``cam1``. A file with one camera may have another name.

    Raises
    ------
    IpsysError
        The file does not have the camera, or Kalibr's model is none of ``pinhole-equi`` and
        ``pinhole-radtan``.
    """
    cameras = find_cameras(path)
    topics = {name: parse_foreign_camera(_text(text, "rostopic") or name) for name, text in cameras.items()}
    matches = [name for name in cameras if camera in (name, topics[name])] or list(cameras)
    if len(matches) != 1:
        known = ", ".join(f"{name} ({topic})" for name, topic in topics.items())
        raise IpsysError(
            f"{path}: has the cameras {known}, but not one {camera}; name the camera like one of them, or "
            "keep only its part of the file"
        )
    name = matches[0]
    return _read(cameras[name], camera, f"{path}: {name}")


def _read(text: str, camera: str, where: str) -> CameraCalibration:
    model = _text(text, "distortion_model")
    if _text(text, "camera_model") != "pinhole" or model not in _MODELS:
        raise IpsysError(
            f"{where}: the model {_text(text, 'camera_model')}-{model} is not read; calibrate with "
            "pinhole-equi or pinhole-radtan"
        )
    intrinsics, size = _numbers(text, "intrinsics", where), _numbers(text, "resolution", where)
    coefficients, (lens_model, count) = _numbers(text, "distortion_coeffs", where), _MODELS[model]
    if (len(intrinsics), len(size), len(coefficients)) != (4, 2, count):
        raise IpsysError(f"{where}: needs 4 intrinsics, 2 numbers as resolution and {count} coefficients")
    if not all(1 <= side <= 65_535 and side == int(side) for side in size):
        raise IpsysError(f"{where}: the resolution must be two numbers of pixels")
    fx, fy, cx, cy = intrinsics
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    # The log has k3 of this model, which Kalibr does not estimate.
    D = np.array([*coefficients, 0.0] if lens_model == "plumb_bob" else coefficients)
    return check_calibration(
        CameraCalibration(0, camera, int(size[0]), int(size[1]), lens_model, D, K), where
    )


def _text(text: str, key: str) -> str:
    match = re.search(_TEXT.format(key), text, re.MULTILINE)
    return match[1] if match else ""


def _numbers(text: str, key: str, where: str) -> list[float]:
    match = re.search(_LIST.format(key), text, re.MULTILINE)
    words = re.split(r"[\s,]+", match[1]) if match and match[1] is not None else []
    if match and match[2] is not None:
        words = match[2].replace("- ", " ").split()
    try:
        return [float(word) for word in words if word]
    except ValueError as error:
        raise IpsysError(f"{where}: {key} is not a list of numbers; write it like [1.0, 2.0]") from error
