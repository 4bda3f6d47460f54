"""Calibration points of a session without images, chosen as in the rendered lab, many candidates at once."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.capture.simulation.calibration_points import SimulatedPose, overlap, reference_points
from ipsys_log.capture.simulation.cameras import Camera, sees
from ipsys_log.capture.simulation.settings import LabSettings, Purpose, random_stream
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array
from ipsys_log.vision.markers import black_cells, marker_corners

# Candidates of a point: the one farthest from the earlier points of its camera is selected. Poses are drawn
# in batches.
_CANDIDATES, _BATCH, _BATCHES = 4, 64, 60


def choose_points(
    lab: LabSettings, cameras: Sequence[Camera], count: int
) -> tuple[tuple[SimulatedPose, ...], ...]:
    """Choose sets of simultaneous calibration points; each next point is for the camera with the fewest.

    Parameters
    ----------
    lab : the heights, the number of markers in a set, and the least angle between the tapes.
    cameras : the true cameras.
    count : of all points.

    Raises
    ------
    IpsysError
        The field of view of a camera has no room for a point.
    """
    rng = random_stream(lab.seed, Purpose.PLACES)
    seen: list[list[Array]] = [[] for _ in cameras]
    sets: list[tuple[SimulatedPose, ...]] = []
    while (left := count - sum(map(len, sets))) > 0:
        taken: list[Array] = []
        for marker_id in range(min(lab.markers, left)):
            index = min(range(len(cameras)), key=lambda n: len(seen[n]))
            pose = _choose_point(rng, lab, cameras, index, np.array(taken).reshape(-1, 4), seen[index])
            if pose is None:
                raise IpsysError(
                    f"simulator: marker {marker_id} has no room beside {len(taken)} others in the view of "
                    f"{cameras[index].name!r}; set fewer or smaller markers"
                )
            taken.append(pose)
            for number, camera in enumerate(cameras):
                if _whole(camera, pose[None], lab)[0]:
                    seen[number].append(pose)
        sets.append(tuple(SimulatedPose(n, *map(float, pose)) for n, pose in enumerate(taken)))
    return tuple(sets)


def _choose_point(
    rng: np.random.Generator,
    lab: LabSettings,
    cameras: Sequence[Camera],
    index: int,
    taken: Array,
    before: list[Array],
) -> Array | None:
    """Return x, y, height and heading of the candidate farthest from the points of a camera."""
    fitting = np.empty((0, 4))
    for _ in range(_BATCHES):
        poses = np.empty((_BATCH, 4))
        poses[:, :2] = rng.uniform(0, lab.floor_m, (_BATCH, 2))
        poses[:, 2] = rng.choice(lab.heights_m, _BATCH)
        poses[:, 3] = rng.uniform(-np.pi, np.pi, _BATCH)
        fits = (_tape_sine(poses, lab) >= np.sin(np.radians(lab.tape_angle_deg))) & _whole(
            cameras[index], poses, lab
        )
        for other in taken:
            fits &= ~overlap(poses[:, :3], other[:3], cameras, lab)
        fitting = np.vstack([fitting, poses[fits]])[:_CANDIDATES]
        if len(fitting) == _CANDIDATES:
            break
    if not len(fitting):
        return None
    if not before:
        return np.asarray(fitting[0])
    apart_m = np.linalg.norm(fitting[:, None, :2] - np.array(before)[None, :, :2], axis=2).min(axis=1)
    return np.asarray(fitting[apart_m.argmax()])


def _tape_sine(poses: Array, lab: LabSettings) -> Array:
    to_a, to_b = (poses[:, :2] - [point.x_m, point.y_m] for point in reference_points(lab))
    cross = np.abs(to_a[:, 0] * to_b[:, 1] - to_a[:, 1] * to_b[:, 0])
    sine: Array = cross / (np.linalg.norm(to_a, axis=1) * np.linalg.norm(to_b, axis=1))
    return sine


def _whole(camera: Camera, poses: Array, lab: LabSettings) -> NDArray[np.bool_]:
    """Return the poses (n, 4) whose print, with its white margin, is wholly in the image."""
    side_m = _print_m(lab)
    turn = poses[:, 3] - np.pi / 2
    flat = marker_corners(side_m)[:, :2]
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    corners_m = np.empty((len(poses), 4, 3))
    corners_m[..., 0] = poses[:, :1] + cos * flat[:, 0] - sin * flat[:, 1]
    corners_m[..., 1] = poses[:, 1:2] + sin * flat[:, 0] + cos * flat[:, 1]
    corners_m[..., 2] = poses[:, 2:3]
    return np.asarray(sees(camera, corners_m.reshape(-1, 3)).reshape(-1, 4).all(axis=1))


def _print_m(lab: LabSettings) -> float:
    """Return the side of a print, with its white margin of one cell."""
    cells = len(black_cells(lab.dictionary, 0))
    return lab.marker_length_m * cells / (cells - 2)
