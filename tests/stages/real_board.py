"""A real hand-held ChArUco board: markers of its frames, and their places on the board."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import find_board
from ipsys_log.calibration.images import find_sources
from ipsys_log.messages import CameraCalibration, CompressedImage, Marker, Markers, Message, Rig, RigMarker
from ipsys_log.stages.detect import FrameDetector
from ipsys_log.vision.lenses import undistort

Array = NDArray[np.float64]

BOARD = Board(4, 5, 0.054, 0.75, "DICT_4X4_1000", inverted=True)
RIG = Rig("board", BOARD.dictionary, 0.75 * 0.054, tuple(RigMarker(number) for number in range(10)))
_LEAST_CORNERS = 8
_STEP_NS = 50_000_000


def read_lens(folder: Path, camera: str) -> CameraCalibration:
    """Return the reference intrinsics of a camera."""
    row = tomllib.loads((folder / "camera_array.toml").read_text(encoding="utf-8"))["cameras"][camera]
    K = np.array(row["matrix"])
    P = np.hstack([K, np.zeros((3, 1))])
    width, height = row["size"]
    D = np.array(row["distortions"])
    return CameraCalibration(0, "red", width, height, "plumb_bob", D, K, np.eye(3), P)


def read_frames(folder: Path, camera: str, every: int = 1) -> Iterator[tuple[NDArray[np.uint8], int]]:
    """Yield every n-th frame of a video with its time in ns; its print is inverted, so the frame is too."""
    (source,) = find_sources([folder / f"cam_{camera}.mp4"], [])
    for number, (_, grey) in enumerate(source.read()):
        if grey is not None and number % every == 0:
            yield 255 - grey, number * _STEP_NS


def read_markers(
    folder: Path, camera: str, every: int = 1
) -> Iterator[tuple[tuple[Marker, ...], dict[int, Array]]]:
    """Yield the markers of the frames that show the board, and the centres by its pose in camera coordinates.

    The pose of the board is that of its inner corners, which are corners of no marker.
    """
    lens, detector = read_lens(folder, camera), FrameDetector()
    assert not [*detector(Message("/rig", 0, 0, RIG)), *detector(Message("/lens", 0, 0, lens, "red"))]
    for grey, time_ns in read_frames(folder, camera, every):
        board = find_board("frame", 255 - grey, BOARD, thorough=False)
        data = cv2.imencode(".png", grey)[1].tobytes()
        image = CompressedImage(time_ns, "red", data, "png")
        payloads = list(detector(Message("/image", time_ns, time_ns, image, "red")))
        (markers,) = [payload for payload in payloads if isinstance(payload, Markers)]
        if board is not None and len(board.ids) >= _LEAST_CORNERS:
            yield markers.markers, _centres(lens, BOARD.points_m(np.array(board.ids)), board.pixels)


def _centres(lens: CameraCalibration, points_m: Array, pixels: Array) -> dict[int, Array]:
    uv = undistort(np.asarray(pixels, dtype=np.float64), lens)
    _, turn, shift_m = cv2.solvePnP(points_m, uv, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    turn, shift_m = cv2.solvePnPRefineLM(points_m, uv, np.eye(3), None, turn, shift_m)
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, BOARD.dictionary))
    board = cv2.aruco.CharucoBoard((4, 5), 0.054, RIG.marker_length_m, known)
    middle_m = np.array([2 * 0.054, 2.5 * 0.054, 0])
    numbers, corners_m = np.ravel(board.getIds()), np.array(board.getObjPoints(), dtype=np.float64)
    centres_m = (corners_m.mean(axis=1) - middle_m) @ cv2.Rodrigues(turn)[0].T + np.ravel(shift_m)
    return dict(zip(numbers.tolist(), centres_m, strict=True))
