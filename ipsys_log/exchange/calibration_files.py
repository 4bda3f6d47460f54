"""Camera intrinsics of files and logs, and writers of calibration files for OpenCV, ROS and Kalibr."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ipsys_log.calibration.calibrate import CalibrationResult
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_formats import read_calibration
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.log.ros2 import ROS2_MODELS
from ipsys_log.messages import ASSUMED_MODEL, EVENTS_TOPIC, CameraCalibration, Event, Message
from ipsys_log.vision.lenses import check_calibration


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
    """Check that a format exists and supports the lens model (``fisheye``, ``pinhole4`` ...)."""
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


def read_intrinsics(
    path: LogLocation, camera: str, report: Callable[[str, str], None] = lambda camera, text: None
) -> CameraCalibration:
    """Read the intrinsics of a camera from a calibration file of any program, or from a log (``.mcap``).

    The log can be at a URL.

    From a log, the newest calibration of the camera is read. If the log holds the calibration of a single
    camera, this camera may have another name.

    ``report`` is called with the camera and a remark if the lens model is assumed, because the file states
    none.
    """
    if path.suffix != ".mcap":
        if not isinstance(path, Path):
            raise IpsysError(f"{path}: is at a URL, where only a log (.mcap) can be read; download the file")
        lens, remark = read_calibration(path, camera)
        if remark:
            report(camera, remark)
        return lens
    with Session([path]) as log:
        topics = log.calibrations
        name = next(iter(topics)) if len(topics) == 1 else camera
        if name not in topics:
            names = ", ".join(topics) or "none"
            raise IpsysError(f"{path}: has no calibration of camera {camera}, only of {names}")
        recorded: CameraCalibration = log.payloads([topics[name]])[-1]
        assumed = log.assumed_models().get(name)
        if assumed is not None:
            report(camera, assumed)
    return check_calibration(replace(recorded, frame_id=camera), str(path))


def announce_assumed(messages: Iterable[Message], assumed: Mapping[str, str]) -> Iterator[Message]:
    """Yield an event for each camera with an assumed lens model, and then the messages of a new log."""
    rest = iter(messages)
    first = next(rest, None)
    if first is not None:
        start_ns = first.log_time_ns - len(assumed)
        for number, (camera, text) in enumerate(sorted(assumed.items())):
            time_ns = start_ns + number
            yield Message(EVENTS_TOPIC, time_ns, time_ns, Event(time_ns, ASSUMED_MODEL, text, camera))
        yield first
    yield from rest


def calibration_text(result: CalibrationResult, name: str = "opencv") -> str:
    """Return the file of a result of an intrinsic calibration, in a format of ``FORMATS``."""
    comment = (
        f"ipsys calibrate: RMS {result.rms_px:.3f} px, median {result.median_px:.3f} px over "
        f"{len(result.pixels)} corners of {len(result.used)} pictures"
    )
    sigmas = dict(zip(result.names, result.sigmas.tolist(), strict=True))
    return FORMATS[name][0](result.lens, sigmas, comment)
