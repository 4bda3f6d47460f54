"""Cameras joined without a tape, compared with their true poses."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import CameraCalibration
from ipsys_log.statistics.alignment import align_camera, join_cameras
from ipsys_log.statistics.stationary import StationaryMarker
from ipsys_log.vision.poses import PosedCamera, invert_pose, look_down, make_pose, rotation, transform

Array = NDArray[np.float64]

NONE = np.zeros((3, 3))
LENS = CameraCalibration(0, "any", 1201, 801, "plumb_bob", np.zeros(5), np.diag([1000.0, 1000, 1]))
# The cameras are tilted, at two heights, and the second is also turned about the plumb line.
RED = look_down(np.array([0.0, 0.0, 2.0]), np.array([0.03, -0.02, 0.0]))
WHITE = make_pose(rotation(np.array([0.0, 0.0, 2.5])), np.zeros(3)) @ look_down(
    np.array([0.3, 1.4, 2.3]), np.array([-0.01, 0.04, 0.0])
)
FLOOR_M = {
    "red": [(-1, -0.6), (1, -0.6), (-1, 0.7), (0.9, 0.7)],
    "white": [(-1, 0.7), (0.9, 0.7), (-0.8, 2), (1, 2)],
}


def lying(camera: str, pose: Array) -> list[StationaryMarker]:
    places_m = np.array([(*xy, 0.0) for xy in FLOOR_M[camera]])
    ids = [0, 1, 2, 3] if camera == "red" else [2, 3, 4, 5]
    return [StationaryMarker(n, p, NONE) for n, p in zip(ids, transform(pose, places_m), strict=True)]


def joined(red: list[StationaryMarker], white: list[StationaryMarker]) -> list[PosedCamera]:
    alignments = [align_camera("red", red), align_camera("white", white)]
    return join_cameras(alignments, {"red": LENS, "white": LENS})


def test_two_common_markers_join_two_cameras() -> None:
    red, white = joined(lying("red", RED), lying("white", WHITE))
    expected = RED @ invert_pose(WHITE)
    assert np.abs(red.camera_from_world @ white.camera_from_world.T - expected[:3, :3]).max() < 1e-6
    assert np.abs(red.transform(white.origin_m) - expected[:3, 3]).max() < 1e-6
    assert abs(red.origin_m[2] - invert_pose(RED)[2, 3]) < 1e-6


def test_different_markers_do_not_join_cameras() -> None:
    red, white = lying("red", RED), lying("white", WHITE)
    assert joined(red, white[1:]) == []
    later = [replace(one, start_ns=10, end_ns=20) for one in white]
    assert joined(red, later) == []
    moved = [
        replace(one, point_m=one.point_m + np.array([0.2, 0, 0])) if one.marker_id == 2 else one
        for one in white
    ]
    assert joined(red, moved) == []
