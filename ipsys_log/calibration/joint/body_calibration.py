"""Calibration of a rigid body: the poses and sides of its markers, from frames that show several of them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ipsys_log.calibration.joint.body_frames import (
    BodyFrame,
    determined_markers,
    links_cameras,
    read_frames,
    spread_frames,
)
from ipsys_log.calibration.joint.body_problem import MARKER, PRINT_SIGMA, SIDE_SIGMA, BodyProblem, BodyState
from ipsys_log.calibration.joint.locate_bodies import angles_between
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Message, Rig
from ipsys_log.vision.bodies import pose_from_rpy, rpy_from_rotation
from ipsys_log.vision.poses import make_pose

# Poses that are measured by hand differ from the true ones by less.
_BY_HAND_M, _BY_HAND_RAD = 0.005, np.radians(5.0)
_CONTRADICTED = 4.0  # standard deviations
# A marker with a larger share of sightings that contradict the others came loose.
_LOOSE_SHARE = 0.2


class CalibratedMarker(NamedTuple):
    """The pose of a marker on its body, and its side.

    ``xyz_sigmas_m`` and ``turn_sigmas_rad`` (in the axes of the first marker) and ``length_sigma_m`` are
    standard deviations at the estimated size of the body, without :attr:`BodyCalibration.scale_sigma`.
    """

    id: int
    xyz_m: tuple[float, ...]
    rpy_rad: tuple[float, ...]
    length_m: float
    xyz_sigmas_m: tuple[float, ...]
    turn_sigmas_rad: tuple[float, ...]
    length_sigma_m: float
    frames: int


@dataclass(frozen=True, slots=True, eq=False)
class BodyCalibration:
    """A calibrated body.

    Attributes
    ----------
    robot : its name.
    markers : those whose poses are determined, in the order of the rig.
    scale_sigma : relative standard deviation of its size.
    frames, linked_frames : the number of frames, and of those shortly after a frame of another camera.
    remarks : what is not determined, and what contradicts the rig.
    covariance : (7 k, 7 k), of the turn, the centre and the logarithm of the side of each marker, in the axes
        of the first marker, with the scale. The pose of the first marker has none.
    """

    robot: str
    markers: tuple[CalibratedMarker, ...]
    scale_sigma: float
    frames: int
    linked_frames: int
    remarks: tuple[str, ...]
    covariance: Array

    def apply(self, rig: Rig) -> Rig:
        """Return a rig with the poses and sides of the markers, and with the uncertainty of the size."""
        found = {marker.id: marker for marker in self.markers}
        markers = tuple(
            replace(m, xyz_m=_short(own.xyz_m), rpy_rad=_short(own.rpy_rad), length_m=round(own.length_m, 6))
            if (own := found.get(m.id)) is not None
            else m
            for m in rig.markers
        )
        bodies = tuple(
            replace(body, scale_sigma=float(f"{self.scale_sigma:.2g}")) if body.robot == self.robot else body
            for body in rig.bodies
        )
        return replace(rig, markers=markers, bodies=bodies)


def calibrate_body(
    cameras: Mapping[str, JointModel], rig: Rig, robot: str, messages: Iterable[Message]
) -> BodyCalibration:
    """Estimate the poses of the markers of a body, and their printed sides.

    The unknowns are those of the markers, and a pose and a twist of the body in each frame. The size of the
    body comes from the prints, and from frames of two cameras shortly after each other.

    Parameters
    ----------
    cameras : the calibrated cameras.
    rig : names the markers of the body; the first one has the axes of the body, or its pose in the rig.
    robot : the body.
    messages : the markers in the frames of the cameras.

    Raises
    ------
    IpsysError
        The body is not in the rig or has one marker, or no frames show two of its markers.
    """
    ids = [marker.id for marker in rig.markers if marker.robot == robot]
    if all(body.robot != robot for body in rig.bodies):
        known = ", ".join(body.robot for body in rig.bodies) or "none"
        raise IpsysError(f"{robot}: is no body of the rig, which has {known}; add it to [[bodies]]")
    if len(ids) < 2:
        raise IpsysError(f"{robot}: has one marker, whose pose is that of the body; nothing to calibrate")
    frames = [frame for frame in read_frames(cameras, ids, messages) if frame.markers]
    if not frames:
        numbers = ", ".join(map(str, ids))
        raise IpsysError(f"{robot}: no frame shows its markers {numbers}; carry it below the cameras")
    frames = [frame for frame in frames if len(frame.markers) > 1]
    ids, remarks = determined_markers(robot, ids, frames)
    frames = [kept for frame in frames if len((kept := frame.of(ids)).markers) > 1]
    problem = BodyProblem(cameras, rig, robot, ids, spread_frames(frames))
    return _describe(problem, remarks, frames)


def _describe(problem: BodyProblem, remarks: list[str], frames: Sequence[BodyFrame]) -> BodyCalibration:
    """Solve the problem, and return the markers with their uncertainties and all remarks."""
    now = problem.solve()
    covariance = problem.covariance(now)
    scale = np.zeros(len(covariance))
    scale[6::MARKER] = 1 / len(problem.ids)
    by_scale = covariance @ scale
    scale_sigma = float(np.sqrt(scale @ by_scale))
    own = np.sqrt(np.maximum((covariance - np.outer(by_scale, by_scale) / scale_sigma**2).diagonal(), 0))
    base = _pose_in(problem.rig, problem.ids[0])
    markers = []
    for n, i in enumerate(problem.ids):
        pose = base @ make_pose(now.marker_turns[n], now.centres_m[n])
        side_m, sigmas = float(np.exp(now.log_sides[n])), own[MARKER * n :].tolist()
        count = sum(marker.id == i for frame in frames for marker in frame.markers)
        place = tuple(pose[:3, 3].tolist()), rpy_from_rotation(pose[:3, :3]), side_m
        spread = tuple(sigmas[3:6]), tuple(sigmas[:3]), side_m * sigmas[6]
        markers.append(CalibratedMarker(i, *place, *spread, count))
    linked = sum(map(links_cameras, problem.frames, problem.frames[1:]))
    remarks = [*remarks, *_loose(problem, now), *_odd_sides(problem, now, own), *_odd_poses(problem, markers)]
    return BodyCalibration(
        problem.robot, tuple(markers), scale_sigma, len(problem.frames), linked, tuple(remarks), covariance
    )


def _loose(problem: BodyProblem, now: BodyState) -> Iterator[str]:
    sightings = problem.sightings(now)
    odd = sightings.chi2 > 2 * sightings.limit
    for n, i in enumerate(problem.ids):
        own = odd[problem.marker == n]
        if own.mean() > _LOOSE_SHARE:
            times_s = problem.frame_s[problem.frame[(problem.marker == n) & odd]]
            yield (
                f"marker {i} of {problem.robot} contradicts the others in {own.sum()} of {len(own)} frames, "
                f"from {times_s[0]:.1f} s to {times_s[-1]:.1f} s: it came loose. Fix it and carry the "
                "body again"
            )


def _odd_sides(problem: BodyProblem, now: BodyState, own: Array) -> Iterator[str]:
    ratios = now.log_sides - np.log(problem.lengths_m)
    common = float(np.median(ratios))
    if abs(common) > _CONTRADICTED * PRINT_SIGMA:
        size = f"{abs(100 * np.expm1(common)):.1f} % {'larger' if common > 0 else 'smaller'}"
        yield f"the markers of {problem.robot} are printed {size} than length_m in the rig; measure them"
    for n, i in enumerate(problem.ids):
        if abs(ratios[n] - common) > _CONTRADICTED * np.hypot(SIDE_SIGMA, own[MARKER * n + 6]):
            side_mm = 1000 * np.exp(now.log_sides[n] - common)
            yield (
                f"marker {i} of {problem.robot} has a side of {side_mm:.1f} mm beside the others, but "
                f"{1000 * problem.lengths_m[n]:.1f} mm in the rig; measure its black square"
            )


def _odd_poses(problem: BodyProblem, markers: Sequence[CalibratedMarker]) -> Iterator[str]:
    """Yield a line on the poses of the rig that contradict the estimate."""
    found = {m.id: m for m in markers if any(r.id == m.id and r.xyz_m for r in problem.rig.markers)}
    poses = {i: _pose_in(problem.rig, i) for i in found}
    apart_m = np.array([poses[i][:3, 3] - m.xyz_m for i, m in found.items()]).reshape(-1, 3)
    most_m = np.array([_BY_HAND_M + _CONTRADICTED * np.max(m.xyz_sigmas_m) for m in found.values()])
    turns = np.array([poses[i][:3, :3].T @ pose_from_rpy((), m.rpy_rad)[:3, :3] for i, m in found.items()])
    angles = angles_between(turns.reshape(-1, 3, 3), np.eye(3))
    far = (np.abs(apart_m) > most_m[:, None]).any(axis=1)
    advice = "correct the rig, or write the estimate into it with --write"
    for axis, name in enumerate("xyz"):
        mirrored = apart_m.copy()
        mirrored[:, axis] += [2 * m.xyz_m[axis] for m in found.values()]
        if far.any() and (np.abs(mirrored) <= most_m[:, None]).all():
            text = f"the markers of {problem.robot} in the rig are a mirror image"
            yield f"{text}: {name} has the other sign; {advice}"
            return
    for n, i in enumerate(found):
        if far[n] or angles[n] > _BY_HAND_RAD:
            yield (
                f"marker {i} of {problem.robot} is {1000 * np.linalg.norm(apart_m[n]):.0f} mm and "
                f"{np.degrees(angles[n]):.0f} degrees away from its pose in the rig; {advice}"
            )


def _short(values: tuple[float, ...]) -> tuple[float, ...]:
    """Return values rounded to 1 um or 1 urad, without -0."""
    return tuple(round(value, 6) + 0.0 for value in values)


def _pose_in(rig: Rig, marker_id: int) -> Array:
    marker = next(marker for marker in rig.markers if marker.id == marker_id)
    return pose_from_rpy(marker.xyz_m, marker.rpy_rad)
