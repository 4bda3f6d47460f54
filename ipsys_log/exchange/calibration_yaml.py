"""Lenses as the files that OpenCV, ROS and Kalibr read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraCalibration

__all__ = ["FORMATS", "check_format", "kalibr_yaml", "opencv_yaml", "ros_yaml"]


def opencv_yaml(lens: CameraCalibration, sigmas: Mapping[str, float], comment: str) -> str:
    """A FileStorage YAML: matrix, coefficients, image size, and the standard deviations by name.

    Parameters
    ----------
    lens : what is written.
    sigmas : by name of the parameter, fx to the last coefficient.
    comment : for the first lines.
    """
    known = [f"   {name}: {value!r}" for name, value in sigmas.items()]
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
        *known,
    ]
    return "\n".join(lines) + "\n"


def ros_yaml(lens: CameraCalibration, sigmas: Mapping[str, float], comment: str) -> str:  # noqa: ARG001
    """A ``camera_info`` YAML; ROS calls the fisheye ``equidistant``."""
    model = "equidistant" if lens.distortion_model == "kannala_brandt" else lens.distortion_model
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
    """A ``camchain`` YAML of one camera; :func:`check_format` says which lenses Kalibr has."""
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


# By the name a user gives: what writes it, and what is added to the name of the camera.
FORMATS: dict[str, tuple[Callable[[CameraCalibration, Mapping[str, float], str], str], str]] = {
    "opencv": (opencv_yaml, ""),
    "ros": (ros_yaml, "_ros"),
    "kalibr": (kalibr_yaml, "_kalibr"),
}


def check_format(name: str, lens_name: str) -> None:
    """See that there is such a format and that it has the kind of lens, ``fisheye``, ``pinhole4`` ...

    Raises
    ------
    IpsysError
        Otherwise.
    """
    if name not in FORMATS:
        raise IpsysError(f"--format {name}: there is no such format; use one of {', '.join(FORMATS)}")
    if name == "kalibr" and lens_name not in ("fisheye", "pinhole4"):
        raise IpsysError(
            f"--format kalibr: Kalibr has four coefficients, --lens {lens_name} has more; "
            "use --lens fisheye or --lens pinhole4"
        )


def _matrix(name: str, rows: int, columns: int, values: Iterable[float], tag: bool = False) -> list[str]:
    first = [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d"]
    plain = [f"{name}:", f"   rows: {rows}", f"   cols: {columns}"]
    return [*(first if tag else plain), f"   data: {_row(values)}"]


def _row(values: Iterable[float]) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"
