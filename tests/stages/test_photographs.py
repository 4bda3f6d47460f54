"""Detection in real photographs: a marker on a hand-held board, which is no perfect square."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np

from ipsys_log.messages import CameraCalibration, CompressedImage, Markers, Message
from ipsys_log.stages.detect import Detect
from tests.stages.drawing import calibrated, rig

SECOND_NS = 1_000_000_000


def count_markers(corners: str, lens: CameraCalibration, photographs: list[Path]) -> int:
    step = Detect(corners)
    messages = [rig(dictionary="DICT_4X4_1000"), calibrated(lens)]
    for n, path in enumerate(photographs):
        time_ns = (n + 1) * SECOND_NS
        picture = CompressedImage(time_ns, "red", path.read_bytes(), "jpeg")
        messages.append(Message("/cameras/red/image", time_ns, time_ns, picture, "red"))
    payloads = [payload for message in messages for payload in step(message)]
    found = [marker.id for one in payloads if isinstance(one, Markers) for marker in one.markers]
    assert set(found) <= {0}
    return len(found)


def test_edges_find_as_many_photographs_as_stock(data: Path) -> None:
    """The intrinsics of the same cameras are from a video of a board, and fit only approximately."""
    cameras = tomllib.loads((data / "charuco_videos" / "camera_array.toml").read_text())["cameras"]
    counts = {"edges": 0, "stock": 0}
    for name, camera in cameras.items():
        matrix, distortion = np.array(camera["matrix"]), np.array(camera["distortions"])
        lens = CameraCalibration(0, "red", 1280, 720, "plumb_bob", distortion, matrix)
        photographs = sorted((data / "aruco_photos").glob(f"cam_{name}_*.jpg"))
        for corners in counts:
            counts[corners] += count_markers(corners, lens, photographs)
    assert counts["stock"] >= 33
    assert counts["edges"] >= counts["stock"]
