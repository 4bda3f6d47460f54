"""Pipelines from an MCAP log to the corners of its markers; each runs in a separate process."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from rounds import Turn

from ipsys_log.log.dataset import Session
from ipsys_log.messages import Markers, Message, Rig
from ipsys_log.messages.channels import CALIBRATIONS, RIG
from ipsys_log.messages.stage import Resets
from ipsys_log.stages import detect
from ipsys_log.stages.detect import Detect
from ipsys_log.units import NS_PER_S

__all__ = ["FINDERS", "OURS", "Found", "one_by_one", "threaded"]

Corners = NDArray[np.float64]
# Camera and publish time in ns of a frame, and the detected corners in px, (4, 2) each, with their ids.
Found = tuple[str, int, list[tuple[int, Corners]]]
Finder = Callable[[Message], list[tuple[int, Corners]]]

OURS = detect.EDGES

# Constants of glibc's malloc.h.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3

_REFINE = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 0.001)


def _fed(stage: Callable[[Message], Any], message: Message) -> list[tuple[int, Corners]]:
    """Return the corners that a stage makes from a message; none from a message that it does not read."""
    if not any(isinstance(message.payload, channel.payloads) for channel in detect.STAGE.reads):
        return []
    frames = [payload for payload in stage(message) if isinstance(payload, Markers)]
    return [(marker.id, marker.corners_px) for markers in frames for marker in markers.markers]


def plain(rig: Message, lenses: dict[str, Message]) -> Finder:
    """Return a finder like the authors' program, written with today's OpenCV and nothing else.

    It converts colour to grey. Then it uses OpenCV's detector with its default parameters, cornerSubPix with
    a window of 3, fisheye.undistortPoints, and the camera points of eq. (3) to (5).
    """
    detector = cv2.aruco.ArucoDetector(_dictionary(rig.payload))
    length_m = rig.payload.marker_length_m

    def find(message: Message) -> list[tuple[int, Corners]]:
        color = cv2.imdecode(np.frombuffer(message.payload.data, np.uint8), cv2.IMREAD_COLOR)
        assert color is not None
        grey = cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)
        corners, ids, _ = detector.detectMarkers(grey)
        if ids is None or len(ids) == 0:
            return []
        lens = lenses[str(message.camera)].payload
        markers = []
        for marker_id, square in zip(np.ravel(ids), corners, strict=True):
            px = cv2.cornerSubPix(grey, square.reshape(-1, 1, 2), (3, 3), (-1, -1), _REFINE)
            uv = cv2.fisheye.undistortPoints(px.astype(np.float64), lens.K, lens.D)
            _camera_point(np.asarray(uv, np.float64).reshape(-1, 2), length_m)
            markers.append((int(marker_id), px.reshape(4, 2).astype(np.float64)))
        return markers

    return find


def _camera_point(uv: Corners, length_m: float) -> Corners:
    perimeter = np.linalg.norm(np.roll(uv, -1, axis=0) - uv, axis=1).sum()
    z_m = 4 * length_m / perimeter
    return np.array([*(z_m * uv.mean(axis=0)), z_m])


def _dictionary(rig: Rig) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, rig.dictionary))


def stateless(
    rig: Message, lenses: dict[str, Message], corners: str = OURS, resets: Resets | None = None
) -> Finder:
    """Return the ipsys finder without memory: a new stage for every frame."""

    def find(message: Message) -> list[tuple[int, Corners]]:
        stage = Detect(corners, resets)
        _fed(stage, rig)
        _fed(stage, lenses[str(message.camera)])
        return _fed(stage, message)

    return find


def reset(rig: Message, lenses: dict[str, Message]) -> Finder:
    """Return the ipsys finder with each frame as the first one after a reset."""
    return stateless(rig, lenses, OURS, Resets(NS_PER_S))


def tracking(rig: Message, lenses: dict[str, Message]) -> Finder:
    """Return the ipsys finder as in a replay: one stage for each camera, tracking from frame to frame."""
    stages = {camera: Detect(OURS) for camera in lenses}
    for camera, stage in stages.items():
        _fed(stage, rig)
        _fed(stage, lenses[camera])
    return lambda message: _fed(stages[str(message.camera)], message)


def stock(rig: Message, lenses: dict[str, Message]) -> Finder:
    """Return the ipsys finder with OpenCV's detector on the full frame."""
    return stateless(rig, lenses, detect.STOCK)


def decode(_rig: Message, _lenses: dict[str, Message]) -> Finder:
    """Return a finder that only decodes the JPEG to a grey image."""

    def find(message: Message) -> list[tuple[int, Corners]]:
        simplejpeg.decode_jpeg(message.payload.data, colorspace="GRAY")
        return []

    return find


def read(_rig: Message, _lenses: dict[str, Message]) -> Finder:
    """Return a finder that only reads the JPEG from the log, without decoding."""
    return lambda _message: []


def apriltags(_rig: Message, _lenses: dict[str, Message]) -> Finder:
    """Return a finder of the AprilTag library through pupil-apriltags with default settings, on one thread.

    The defaults are quad_decimate 2, quad_sigma 0, refine_edges 1, decode_sharpening 0.25. Its corners have
    the opposite order, start at another corner, and count from the edge of the first pixel, not its centre.
    """
    from pupil_apriltags import Detector  # type: ignore[import-untyped]

    detector = Detector("tag36h11", nthreads=1)

    def find(message: Message) -> list[tuple[int, Corners]]:
        grey = simplejpeg.decode_jpeg(message.payload.data, colorspace="GRAY")[..., 0]
        return [(int(tag.tag_id), tag.corners[_APRILTAG_ORDER] - 0.5) for tag in detector.detect(grey)]

    return find


_APRILTAG_ORDER = [1, 0, 3, 2]

FINDERS: dict[str, Callable[[Message, dict[str, Message]], Finder]] = {
    "plain": plain,
    "stock": stock,
    "stateless": stateless,
    "reset": reset,
    "tracking": tracking,
    "decode": decode,
    "read": read,
    "apriltags": apriltags,
}


def _opened(path: Path) -> tuple[Session, Message, dict[str, Message]]:
    session = Session([path])
    (rig,) = session.messages(session.topics(RIG))
    lenses = {str(message.camera): message for message in session.messages(session.topics(CALIBRATIONS))}
    return session, rig, lenses


def keep_heap() -> None:
    """Let glibc keep freed memory for the next frame, instead of returning it and faulting it in again."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_TRIM_THRESHOLD, 1 << 28)
        mallopt(_MMAP_THRESHOLD, 1 << 25)


def one_by_one(
    path: Path, ranges: Sequence[tuple[int, int]], finder: str, threads: int = 1, kept_heap: bool = False
) -> Turn:
    """Return a turn that takes frame after frame in one Python thread; OpenCV may use ``threads``.

    The value -1 means the default of OpenCV.
    """
    if kept_heap:
        keep_heap()
    cv2.setNumThreads(threads)
    session, rig, lenses = _opened(path)
    find = FINDERS[finder](rig, lenses)

    def turn(number: int) -> list[Found]:
        frames = session.messages(session.images.values(), *ranges[number])
        return [(str(frame.camera), frame.publish_time_ns, find(frame)) for frame in frames]

    return turn


def threaded(path: Path, ranges: Sequence[tuple[int, int]]) -> Turn:
    """Return the ipsys turn as in :func:`ipsys_log.live_runs.pipeline.replay`: a thread for each camera."""
    # Imported late: it imports the whole package, and the other contenders start without the package.
    from ipsys_log.engine.stream import in_threads, run, wire

    cv2.setNumThreads(1)
    session, rig, lenses = _opened(path)
    stage = wire(detect.STAGE, "bench", {}, Detect(OURS))
    for _ in run([rig, *lenses.values()], [stage]):
        pass

    def turn(number: int) -> list[Found]:
        frames = session.messages(session.images.values(), *ranges[number])
        return [
            (str(made.camera), made.publish_time_ns, [(m.id, m.corners_px) for m in made.payload.markers])
            for made in run(frames, [stage], in_threads)
            if isinstance(made.payload, Markers)
        ]

    return turn
