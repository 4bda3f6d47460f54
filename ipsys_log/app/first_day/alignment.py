"""The alignment of a folder as data of a page: an arrow on the image of each camera, and advice."""

from dataclasses import dataclass

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from ipsys_log.app.report.alignment import read_alignment
from ipsys_log.app.report.camera_poses import advise, coverage_lines
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, CompressedImage, Rig
from ipsys_log.messages.channels import RIG
from ipsys_log.stages.detect.search import detect_markers
from ipsys_log.statistics.alignment import Alignment
from ipsys_log.vision.lenses import project


@dataclass(frozen=True, slots=True)
class AlignedCamera:
    """The alignment of a camera.

    Attributes
    ----------
    level : whether the camera looks straight down; None if the markers do not tell it.
    size_px : width and height of its image.
    centre_px, plumb_px : principal point, and the pixel straight below the camera; the camera is turned from
        the first to the second. ``plumb_px`` is None if the direction is unknown.
    markers_px : positions of the markers on the floor.
    picture : an image as JPEG; None if the log has none.
    """

    camera: str
    level: bool | None
    advice: str
    size_px: tuple[int, int]
    centre_px: tuple[float, float]
    plumb_px: tuple[float, float] | None
    markers_px: tuple[tuple[float, float], ...]
    picture: bytes | None


@dataclass(frozen=True, slots=True)
class AlignmentResult:
    """The alignment of all cameras; each line on the coverage of the floor says whether it is good."""

    cameras: tuple[AlignedCamera, ...]
    coverage: tuple[tuple[str, bool], ...]
    notes: tuple[str, ...]


def read_result(session: Session, run: str) -> AlignmentResult:
    """Read the alignment from a log of ``ipsys align``."""
    rigs = session.payloads(session.topics(RIG))
    if not rigs:
        raise IpsysError(f"{session.paths[-1]}: has no rig; measure the alignment again")
    rig = rigs[-1]
    lenses = {camera: session.payloads([topic])[-1] for camera, topic in session.calibrations.items()}
    lab = read_alignment(session, run, rig, lenses)
    cameras = tuple(
        _camera(one, lenses[one.camera], _picture(session, one.camera), rig)
        for one in lab.alignments
        if one.camera in lenses
    )
    # The markers and the floor of the simulated lab need no change.
    return AlignmentResult(cameras, tuple(coverage_lines(lab)), () if rig.is_simulated else lab.notes)


def _camera(one: Alignment, lens: CameraCalibration, picture: bytes | None, rig: Rig) -> AlignedCamera:
    plumb_px = None if one.down is None else _pixel(one.down, lens)
    markers_px = tuple(_pixel(marker.point_m, lens) for marker in one.floor_markers)
    centre_px = float(lens.K[0, 2]), float(lens.K[1, 2])
    size_px = lens.width, lens.height
    advice = advise(one)
    if not one.floor_markers and picture is not None:
        advice += _unlisted_text(picture, rig)
    return AlignedCamera(one.camera, one.level, advice, size_px, centre_px, plumb_px, markers_px, picture)


def _unlisted_text(picture: bytes, rig: Rig) -> str:
    """Return a remark on the markers in an image whose ids the rig does not list; "" without such markers."""
    listed = {marker.id for marker in rig.all_markers}
    grey = simplejpeg.decode_jpeg(picture, "GRAY")[..., 0]
    unlisted = sorted({marker.id for marker in detect_markers(grey, rig.dictionary)} - listed)
    if not listed or not unlisted:
        return ""
    ids = ", ".join(map(str, unlisted))
    return (
        f"; the image shows markers that lab.toml does not list ({ids}): add their ids in step 1, or leave "
        "the ids of the robots empty there to use all markers"
    )


def _pixel(point_m: NDArray[np.float64], lens: CameraCalibration) -> tuple[float, float]:
    x_px, y_px = project(point_m[None], lens)[0].tolist()
    return round(x_px, 1), round(y_px, 1)


def _picture(session: Session, camera: str) -> bytes | None:
    topic = session.images.get(camera)
    if topic is None:
        return None
    payload = next(iter(session.messages([topic]))).payload
    if isinstance(payload, CompressedImage) and payload.format == "jpeg":
        return payload.data
    return None
