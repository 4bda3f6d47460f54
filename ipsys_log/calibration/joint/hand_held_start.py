"""Start of the fit of a hand-held body: its poses in single frames, the cameras to each other, its path."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ipsys_log.calibration.joint.observations import Observations, Sightings
from ipsys_log.calibration.joint.path_start import PAD_S, cover_times, smooth_knots
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.calibration.joint.trajectories import Paths, Trajectories
from ipsys_log.errors import FitError
from ipsys_log.messages import Array, Indices
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.poses import make_pose, rotation

# Views of two cameras within this time show nearly the same pose of the body.
SAME_TIME_S = 0.05
_POSE_M, _POSE_RAD = 0.01, 0.02
# Sightings of a camera within this time are those of one frame, by the rows of a rolling shutter.
_ONE_FRAME_S = 0.015
# The smallest number of points that have a pose, and the share of their extent up to which they are a plane.
_LEAST_POINTS, _FLAT = 4, 1e-3
# A longer time without sightings divides a path. The parts of a path that turns far are not shorter.
_GAP_S, _SHORTEST_PART_S = 1.0, 0.5
# A part with fewer instants, or of less than two intervals of knots, has no path.
_LEAST_SIGHTINGS = 6
_FAR_RAD = 2.0
_FEW = 200


def view_body(observations: Observations, camera: int) -> Array:
    """Return ``camera_from_body`` (n, 4, 4) of each sighting, from all sightings of its frame."""
    sightings, lens = observations.sightings[camera], observations.cameras[camera].lens
    poses = np.full((len(sightings), 4, 4), np.nan)
    for rows in frames_of(sightings):
        visible = np.isfinite(sightings.pixels[rows, :, 0])
        bodies = [observations.bodies[body].points_m for body in sightings.body[rows].tolist()]
        points_m, pixels = np.stack(bodies)[visible], sightings.pixels[rows][visible]
        pose = _pose_of(points_m, undistort(pixels, lens))
        if pose is not None:
            poses[rows] = pose
    return poses


def frames_of(sightings: Sightings) -> list[list[int]]:
    """Return the rows of each frame, whose sightings have nearly the same time."""
    order = np.argsort(sightings.times_s, kind="stable")
    apart = np.diff(sightings.times_s[order]) > _ONE_FRAME_S
    apart |= np.diff(sightings.point[order]) != 0
    return [rows.tolist() for rows in np.split(order, np.flatnonzero(apart) + 1) if len(rows)]


def _pose_of(points_m: Array, uv: Array) -> Array | None:
    """Return ``camera_from_body`` (4, 4) from points (n, 3) and their undistorted places (n, 2), or None."""
    usable = np.isfinite(uv).all(axis=1)
    points_m, uv = points_m[usable], uv[usable]
    if len(points_m) < _LEAST_POINTS:
        return None
    spread_m = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    flat = spread_m[2] < _FLAT * spread_m[0]
    method = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_EPNP
    good, turn, shift_m = cv2.solvePnP(points_m, uv, np.eye(3), np.zeros(5), flags=method)
    return make_pose(rotation(np.ravel(turn)), np.ravel(shift_m)) if good else None


def chain_cameras(observations: Observations, views: list[Array]) -> list[Array]:
    """Return ``camera_from_world`` (4, 4) of each camera; the first camera is the origin."""
    cameras: dict[int, Array] = {0: np.eye(4)}
    while len(cameras) < len(views):
        pairs = {
            (known, new): _relative_poses(observations, views, known, new)
            for known in cameras
            for new in range(len(views))
            if new not in cameras
        }
        known, new = max(pairs, key=lambda pair: len(pairs[pair]))
        if not len(pairs[known, new]):
            names = ", ".join(
                camera.name for n, camera in enumerate(observations.cameras) if n not in cameras
            )
            raise FitError(
                f"camera {names}: it never sees the body at the same time as the other cameras; show the "
                "body to both"
            )
        cameras[new] = _central_pose(pairs[known, new]) @ cameras[known]
    return [cameras[camera] for camera in range(len(views))]


def _relative_poses(observations: Observations, views: list[Array], known: int, new: int) -> Array:
    """Return ``new_from_known`` (n, 4, 4) from views at the same point or the same time."""
    first, second = observations.sightings[known], observations.sightings[new]
    together = np.abs(first.times_s[:, None] - second.times_s) < SAME_TIME_S
    same = np.where(first.point[:, None] >= 0, first.point[:, None] == second.point, together)
    rows, columns = np.nonzero(same & (first.body[:, None] == second.body))
    relative = views[new][columns] @ np.linalg.inv(views[known][rows])
    return np.asarray(relative[np.isfinite(relative).all(axis=(1, 2))])


def _central_pose(poses: Array) -> Array:
    """Return the pose with the smallest median distance from the others."""
    turns = Rotation.from_matrix(poses[:, :3, :3])
    distances = np.stack(
        [
            np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
            + (turns * Rotation.from_matrix(pose[:3, :3]).inv()).magnitude()
            for pose in poses
        ]
    )
    return np.asarray(poses[np.median(distances, axis=1).argmin()])


def start_points(observations: Observations, world: list[Array]) -> Array:
    """Return ``world_from_body`` (t, 4, 4) of each point, from the camera that comes first."""
    poses = np.tile(np.eye(4), (len(observations.points), 1, 1))
    for sightings, own in reversed(list(zip(observations.sightings, world, strict=True))):
        rows = (sightings.point >= 0) & np.isfinite(own).all(axis=(1, 2))
        poses[sightings.point[rows]] = own[rows]
    return poses


def start_path(
    observations: Observations, world: list[Array], settings: JointSettings, step_s: float
) -> tuple[Paths, Array, Array]:
    """Return paths through all moving sightings, their mean orientations (i, 3, 3), and knots (k, 6)."""
    times_s, poses = _moving_poses(observations, world)
    if not len(times_s):
        return Trajectories(0).free_paths, np.zeros((0, 3, 3)), np.zeros((0, 6))
    parts = [
        rows
        for rows in _divide(times_s, Rotation.from_matrix(poses[:, :3, :3]), np.arange(len(times_s)))
        if len(np.unique(times_s[rows])) >= _LEAST_SIGHTINGS and np.ptp(times_s[rows]) > 2 * step_s
    ]
    if not parts:
        raise FitError("the body moves in too few frames; carry it for 20 s where two cameras see it")
    columns, first = [], 0
    for rows in parts:
        own = cover_times(times_s[rows], step_s)
        columns.append((float(own.starts_s[0]), step_s, first, int(own.counts[0])))
        first += int(own.counts[0])
    starts_s, steps_s, firsts, counts = (np.array(column) for column in zip(*columns, strict=True))
    paths = Paths(starts_s, steps_s, firsts, counts, np.zeros(len(parts), dtype=np.intp))
    middles = [_middle(Rotation.from_matrix(poses[rows, :3, :3])) for rows in parts]
    near = covers(paths, times_s)
    times_s, poses = times_s[near], poses[near]
    numbers = path_at(paths, times_s)
    turned = [
        (Rotation.from_matrix(pose[:3, :3]) * middles[number].inv()).as_rotvec()
        for pose, number in zip(poses, numbers.tolist(), strict=True)
    ]
    trajectories = Trajectories(
        0, free_paths=paths, jerk_density=settings.jerk_density, turn_jerk_density=settings.turn_jerk_density
    )
    sigmas = np.repeat([_POSE_M, _POSE_RAD], 3)
    places = np.concatenate([poses[:, :3, 3], np.array(turned)], axis=1)
    knots = smooth_knots(paths, numbers, times_s, places, sigmas, trajectories)
    return paths, np.stack([middle.as_matrix() for middle in middles]), knots


def _moving_poses(observations: Observations, world: list[Array]) -> tuple[Array, Array]:
    """Return the times (n,) of the moving sightings, in order, and their poses in the world (n, 4, 4)."""
    rows = [
        (sightings.point < 0) & np.isfinite(own).all(axis=(1, 2))
        for sightings, own in zip(observations.sightings, world, strict=True)
    ]
    parts = list(zip(observations.sightings, world, rows, strict=True))
    times_s = np.concatenate([one.times_s[mask] for one, _, mask in parts])
    poses = np.concatenate([own[mask] for _, own, mask in parts])
    order = np.argsort(times_s, kind="stable")
    return times_s[order], poses[order]


def _divide(times_s: Array, turns: Rotation, rows: Indices) -> list[Indices]:
    """Divide the rows of a motion in halves until each part stays near one orientation.

    Rotation vectors are smooth up to half a turn from the orientation in the middle of a part.
    """
    cuts = np.flatnonzero(np.diff(times_s[rows]) > _GAP_S) + 1
    if len(cuts):
        return [part for own in np.split(rows, cuts) for part in _divide(times_s, turns, own)]
    own = turns[rows]
    angles = (own * _middle(own).inv()).magnitude()
    half_s = (times_s[rows[0]] + times_s[rows[-1]]) / 2
    if np.percentile(angles, 95) < _FAR_RAD or half_s - times_s[rows[0]] < _SHORTEST_PART_S:
        return [rows]
    early = times_s[rows] <= half_s
    return [*_divide(times_s, turns, rows[early]), *_divide(times_s, turns, rows[~early])]


def _middle(turns: Rotation) -> Rotation:
    """Return the orientation that is nearest to all others."""
    some = turns[:: max(1, len(turns) // _FEW)]
    return some[int(np.abs(some.as_quat() @ turns.as_quat().T).sum(axis=1).argmax())]


def covers(paths: Paths, times_s: Array) -> NDArray[np.bool_]:
    """Return a mask of the times at which a path has sightings."""
    ends_s = paths.starts_s + (paths.counts - 2) * paths.steps_s - PAD_S
    inside = (times_s[:, None] >= paths.starts_s + PAD_S) & (times_s[:, None] <= ends_s)
    return np.asarray(inside.any(axis=1))


def path_at(paths: Paths, times_s: Array) -> Indices:
    """Return the path of each time: the last one that has begun."""
    begun = np.searchsorted(paths.starts_s + PAD_S, times_s, side="right") - 1
    return np.asarray(np.clip(begun, 0, len(paths) - 1))
