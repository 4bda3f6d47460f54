"""Markers on the floor below a camera, as a camera with other intrinsics sees them; without images."""

from dataclasses import replace

import cv2
import numpy as np

from ipsys_log.messages import CameraCalibration, Marker, Markers, Rig, RigMarker
from ipsys_log.statistics.marker_tests import find_contradicted_inputs
from ipsys_log.vision.lenses import in_image, project
from ipsys_log.vision.markers import marker_corners

FISHEYE = CameraCalibration(
    0,
    "red",
    1920,
    1080,
    "kannala_brandt",
    np.array([-0.02, 0.003, -0.001, 0.0002]),
    np.array([[1160.0, 0, 962], [0, 1158, 541], [0, 0, 1]]),
)
PINHOLE = CameraCalibration(
    0,
    "red",
    1280,
    720,
    "plumb_bob",
    np.array([-0.28, 0.09, 0.0005, -0.0003, -0.01]),
    np.array([[772.0, 0, 643], [0, 773, 358], [0, 0, 1]]),
)
RIG = Rig("lab", "DICT_4X4_50", 0.2, tuple(RigMarker(n, height_m=0.1) for n in range(3)))
NS = 1_000_000_000


def changed(lens: CameraCalibration, **entries: float) -> CameraCalibration:
    """Return intrinsics with factors ``f``, ``fy`` and offsets ``cx``, ``cy``."""
    K = lens.K.copy()
    K[0, 0] *= entries.get("f", 1.0)
    K[1, 1] *= entries.get("f", 1.0) * entries.get("fy", 1.0)
    K[:2, 2] += entries.get("cx", 0.0), entries.get("cy", 0.0)
    return replace(lens, K=K)


def calibrated_with_errors(lens: CameraCalibration, random: np.random.Generator) -> CameraCalibration:
    """Return intrinsics with usual errors: 0.3 % of the focal length, 0.2 % of the width."""
    f, fy = 1 + random.normal(0, [0.003, 0.0005])
    cx, cy = random.normal(0, 0.002 * lens.width, 2)
    # Errors of the coefficients cancel in part: as large as these two, they move corners by 1 px.
    sigmas = [0.002, 0.001] + [0.0] * (lens.D.size - 2)
    return replace(changed(lens, f=f, fy=fy, cx=cx, cy=cy), D=lens.D + random.normal(0, sigmas))


def sighted(
    lens: CameraCalibration,
    random: np.random.Generator,
    frames: int = 60,
    *,
    noise_px: float = 0.03,
    top_deg: float = 2.0,
    print_sigma: float = 0.002,
    camera_deg: float = 5.0,
    lengths_m: tuple[float, ...] = (0.2, 0.2, 0.2),
    wild_deg: float = 0.0,
) -> list[list[Marker]]:
    """Return the markers of three robots in frames; each has a tilted top and a print that is not exact."""
    camera = cv2.Rodrigues(np.array([np.pi, 0, 0]))[0]
    camera = cv2.Rodrigues(np.deg2rad(random.uniform(-camera_deg, camera_deg, 3)))[0] @ camera
    tops = [cv2.Rodrigues(np.deg2rad([*random.uniform(-1, 1, 2) * top_deg, 0]))[0] for _ in lengths_m]
    prints = [marker_corners(m) * [*random.normal(1, print_sigma, 2), 1] for m in lengths_m]
    seen: list[list[Marker]] = []
    while len(seen) < frames:
        frame = []
        for n, (top, corners_m) in enumerate(zip(tops, prints, strict=True)):
            x, y, heading = random.uniform([-2.2, -1.4, -np.pi], [2.2, 1.4, np.pi])
            wild = cv2.Rodrigues(np.deg2rad(random.normal(0, max(wild_deg, 0.2), 3) * [1, 1, 0]))[0]
            turned = cv2.Rodrigues(np.array([0, 0, heading]))[0] @ wild @ top
            points_m = (corners_m @ turned.T + [x, y, 0.1 - 2.4]) @ camera.T
            if in_image(points_m, lens).all():
                px = project(points_m, lens) + random.normal(0, noise_px, (4, 2))
                frame.append(Marker(n, px))
        seen.append(frame)
    return seen


def contradictions(frames: list[list[Marker]], lens: CameraCalibration, rig: Rig = RIG) -> list[str]:
    """Return the contradictions of a camera with these intrinsics and markers."""
    seen = [Markers(n * NS, tuple(markers), lens.width, lens.height) for n, markers in enumerate(frames)]
    return [*find_contradicted_inputs((("red", frame) for frame in seen), {"red": lens}, rig)]
