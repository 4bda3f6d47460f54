"""Positions of markers by the joint model: the step of a frame, and the fitted model of the Python API."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ipsys_log.calibration.joint.locate import (
    LevelPositions,
    corner_covariances,
    exposure_offset_ns,
    locate_markers,
)
from ipsys_log.calibration.joint.locate_poses import Poses, hold_heights, locate_poses
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.joint.payload import add_pose_modes, restore_joint
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.errors import IpsysError
from ipsys_log.messages import (
    Array,
    CameraPose,
    CameraPoses,
    Marker,
    Markers,
    Message,
    Model,
    Position,
    Positions,
    Rig,
)
from ipsys_log.messages.models import MOVED, PARTLY, SUSPECTED
from ipsys_log.models.body_positions import BodyLocator
from ipsys_log.models.locate_points import ContradictedHeights, HeightSighting

_HEIGHT_SIGMA_M = JointSettings().robot_height_sigma_m
# A marker that is not where its corners say that it is has larger residuals. One in a million is larger by
# chance: with five degrees of freedom at a known height, and with two for a full pose.
MOST_CHI2 = 37.0
MOST_CHI2_OF_POSE = 27.6
# A height by the corners that differs by more than this multiple of its uncertainty contradicts the rig.
_MOST_SIGMAS = 4.0


class _Located(NamedTuple):
    """A located marker.

    ``fits`` is True if its residuals are usual. ``noise_m2`` (3, 3) and ``heading_noise_rad`` are the part of
    the uncertainty that changes from frame to frame. ``height`` is a height that contradicts the rig.
    """

    point_m: Array
    heading_rad: float
    covariance_m2: Array
    fits: bool
    noise_m2: Array
    heading_noise_rad: float
    height: HeightSighting | None = None


class LocateCorners:
    """The step from markers to positions. A camera that is not in the model has no positions.

    A marker whose height is in the rig is level, at this height. If its corners contradict this, it gets its
    full pose: at this height if only its tilt is unusual, otherwise at the height by its corners, which an
    event names. Markers without a height get their full pose. Bodies that are not level have one position
    for all their markers. Reference markers are no robots: they have no positions.

    The poses of cameras that have moved since the calibration replace those of the model. A camera whose pose
    is not known has a larger covariance, and none of its positions is inside.
    """

    def __init__(self, model: Model) -> None:
        self._name = model.name
        self._fitted = restore_joint(model)
        self._cameras = dict(self._fitted)
        self._poses: dict[str, CameraPose] = {}
        self._rig: Rig | None = None
        self._heights = ContradictedHeights(model)
        self._bodies = BodyLocator(self._cameras)

    def __call__(self, message: Message) -> Iterator[Any]:
        if isinstance(message.payload, Rig):
            self._rig = message.payload
            self._bodies.use_rig(self._rig)
            return
        if isinstance(message.payload, CameraPoses):
            self._use_poses(message.payload)
        if not isinstance(message.payload, Markers):
            return
        camera = self._cameras.get(str(message.camera))
        if camera is not None:
            rig, time_ns = self._rig, message.publish_time_ns
            markers = [m for m in message.payload.markers if rig is None or not rig.is_reference(m.id)]
            on_bodies = [marker for marker in markers if marker.id in self._bodies.shapes]
            markers = [marker for marker in markers if marker.id not in self._bodies.shapes]
            located = self._locate(camera, markers)
            heights = [row.height for row in located if row.height is not None]
            yield from self._heights(time_ns, message.camera, heights)
            rows = zip(markers, located, strict=True)
            positions = [_position(camera, *row) for row in rows if np.isfinite(row[1].point_m).all()]
            exposed_ns = [time_ns + (_time_offset_ns(camera, marker) or 0) for marker in on_bodies]
            for result in self._bodies.locate(str(message.camera), time_ns, on_bodies, exposed_ns):
                if isinstance(result, Position):
                    positions.append(result)
                else:
                    yield result
            if self._is_unknown(str(message.camera)):
                # The filter must not average this error over frames: it counts as noise.
                positions = [replace(p, inside=False, noise_m2=p.covariance_m2) for p in positions]
            positions.sort(key=lambda position: position.id)
            yield Positions(time_ns, tuple(positions))

    def _is_unknown(self, camera: str) -> bool:
        """Return whether the camera has moved, or may have, and its new pose is not known."""
        return camera in self._poses and self._poses[camera].state in (MOVED, SUSPECTED, PARTLY)

    def _use_poses(self, message: CameraPoses) -> None:
        """Use the poses of cameras that have moved, with their uncertainty, from now on."""
        self._poses.update({pose.camera: pose for pose in message.poses if pose.camera in self._fitted})
        moved = {
            name: replace(joint, origin_m=pose.position_m, camera_from_world=pose.camera_from_world)
            if (pose := self._poses.get(name)) is not None
            else joint
            for name, joint in self._fitted.items()
        }
        spreads = {name: pose.covariance for name, pose in self._poses.items() if pose.covariance.any()}
        for name, pose in self._poses.items():
            values = np.concatenate([pose.position_m, *pose.camera_from_world, *pose.covariance])
            is_spread = name not in spreads or np.linalg.eigvalsh(pose.covariance)[0] > 0
            if not (np.isfinite(values).all() and is_spread):
                raise IpsysError(f"camera {name}: its pose in the log is not valid; replay the log again")
        self._cameras.update(add_pose_modes(moved, spreads))
        if self._rig is not None:
            self._bodies.use_rig(self._rig)

    def _locate(self, camera: JointModel, markers: Sequence[Marker]) -> list[_Located]:
        if markers and self._rig is None:
            raise IpsysError(f"{self._name} needs the size of the markers; give a rig with --rig lab.toml")
        located: dict[int, _Located] = {}
        for by_height in (True, False):
            rows = [n for n, marker in enumerate(markers) if self._has_height(marker) is by_height]
            own = [markers[row] for row in rows]
            if own:
                locate = self._locate_at_height if by_height else self._locate_poses
                located.update(zip(rows, locate(camera, own), strict=True))
        return [located[n] for n in range(len(markers))]

    def _has_height(self, marker: Marker) -> bool:
        return self._rig is not None and self._rig.height_of(marker.id) is not None

    def _locate_at_height(self, camera: JointModel, markers: Sequence[Marker]) -> list[_Located]:
        assert self._rig is not None
        sigmas_m = [self._rig.height_sigma_of(marker.id) for marker in markers]
        heights_m = np.array([self._rig.height_of(marker.id) for marker in markers], dtype=np.float64)
        known_m = np.array([_HEIGHT_SIGMA_M if sigma_m is None else sigma_m for sigma_m in sigmas_m])
        lengths_m = np.array([self._rig.length_of(marker.id) for marker in markers])
        found = locate_markers(camera, *_corners(markers), heights_m, lengths_m, known_m)
        rows = _rows(found, MOST_CHI2)
        odd = [n for n, row in enumerate(rows) if not row.fits]
        if odd:
            poses = locate_poses(camera, *_corners([markers[n] for n in odd]), lengths_m[odd])
            own = [markers[n] for n in odd]
            for n, row in zip(
                odd, _contradictions(camera, own, poses, heights_m[odd], known_m[odd]), strict=True
            ):
                rows[n] = rows[n] if row is None else row
        return rows

    def _locate_poses(self, camera: JointModel, markers: Sequence[Marker]) -> list[_Located]:
        assert self._rig is not None
        lengths_m = np.array([self._rig.length_of(marker.id) for marker in markers])
        return _rows(locate_poses(camera, *_corners(markers), lengths_m), MOST_CHI2_OF_POSE)


def _rows(located: LevelPositions | Poses, most_chi2: float) -> list[_Located]:
    """Return the rows of located markers; residuals above ``most_chi2`` are unusual."""
    columns = (
        located.points_m,
        located.headings_rad.tolist(),
        located.covariances_m2,
        (located.chi2 < most_chi2).tolist(),
        located.noise_m2,
        located.heading_noise_rad.tolist(),
    )
    return [_Located(*row) for row in zip(*columns, strict=True)]


def _contradictions(
    camera: JointModel, markers: Sequence[Marker], poses: Poses, heights_m: Array, sigmas_m: Array
) -> list[_Located | None]:
    """Return the rows of markers that are not level at their heights; None for corners of no pose."""
    held, above_m, apart_m = hold_heights(camera, poses, heights_m, sigmas_m)
    free, tilted = _rows(poses, MOST_CHI2_OF_POSE), _rows(held, MOST_CHI2_OF_POSE)
    rows: list[_Located | None] = []
    for n, marker in enumerate(markers):
        if not free[n].fits:
            rows.append(None)
        elif abs(above_m[n] - heights_m[n]) <= _MOST_SIGMAS * apart_m[n]:
            rows.append(tilted[n])
        else:
            numbers = heights_m[n], free[n].point_m, above_m[n], apart_m[n]
            rows.append(free[n]._replace(height=HeightSighting(marker.id, *numbers)))
    return rows


def _position(camera: JointModel, marker: Marker, located: _Located) -> Position:
    x_m, y_m, z_m = located.point_m.tolist()
    time_offset_ns = _time_offset_ns(camera, marker)
    inside = located.fits and camera.is_certain and not marker.contradicted
    own = located.heading_rad, located.covariance_m2, inside
    noise = located.noise_m2, located.heading_noise_rad
    return Position(marker.id, x_m, y_m, z_m, *own, time_offset_ns, *noise)


def _corners(markers: Sequence[Marker]) -> tuple[Array, Array]:
    """Return the corners (n, 4, 2) of markers, and their covariances (n, 8, 8)."""
    corners_px = np.array([marker.corners_px for marker in markers], dtype=np.float64)
    return corners_px, corner_covariances([marker.covariance_px2 for marker in markers])


def _time_offset_ns(camera: JointModel, marker: Marker) -> int | None:
    """Return the time from the stamp of the frame to the exposure of the marker; None for both at once."""
    offset_ns = exposure_offset_ns(camera, marker)
    return offset_ns if offset_ns or marker.time_offset_ns is not None else None


class LocatedMarkers(NamedTuple):
    """Located markers.

    ``points_m`` (n, 3) are world points, NaN for a marker that the camera cannot see by its model.
    ``headings_rad`` (n,) and ``covariances_m2`` (n, 3, 3) belong to them. ``chi2`` (n,) are squared residuals
    of the corners in units of their noise, with five degrees of freedom at a known height, or two.
    """

    points_m: Array
    headings_rad: Array
    covariances_m2: Array
    chi2: Array


class FittedCornerModel:
    """A fitted model of a log that is applied to the corners of markers.

    Attributes
    ----------
    name : the name in the table of models, such as ``joint``.
    cameras : names of the cameras of the model.
    """

    def __init__(self, model: Model) -> None:
        self.name = model.name
        self.cameras = tuple(camera.camera for camera in model.cameras)
        self._cameras = restore_joint(model)

    def __repr__(self) -> str:
        return f"<FittedCornerModel {self.name} of {', '.join(self.cameras)}>"

    def predict(
        self, camera: str, corners_px: ArrayLike, length_m: ArrayLike, heights_m: ArrayLike | None = None
    ) -> Array:
        """Return world points (n, 3) in m; the parameters are those of :meth:`locate`."""
        return self.locate(camera, corners_px, length_m, heights_m).points_m

    def locate(
        self,
        camera: str,
        corners_px: ArrayLike,
        length_m: ArrayLike,
        heights_m: ArrayLike | None = None,
        covariances_px2: ArrayLike | None = None,
    ) -> LocatedMarkers:
        """Return the positions of markers, with their headings and covariances.

        Parameters
        ----------
        camera : the camera that saw the markers.
        corners_px : corners (n, 4, 2) in px of the raw image, in the order of OpenCV.
        length_m : side of the black squares in m, a number or (n,).
        heights_m : heights of the level markers above the floor in m, a number or (n,). None: the heights are
            unknown, and each marker gets its full pose.
        covariances_px2 : covariances (n, 8, 8) of the corners; None: the usual one of 0.25 px.

        Raises
        ------
        IpsysError
            The model does not know the camera, or an array has another shape.
        """
        corners = np.asarray(corners_px, dtype=np.float64)
        if corners.ndim != 3 or corners.shape[1:] != (4, 2):
            raise IpsysError(f"corners_px has the shape {corners.shape}; give corners (n, 4, 2) in px")
        if camera not in self._cameras:
            raise IpsysError(
                f"the model {self.name} has no camera {camera!r} (it has {', '.join(self.cameras)})"
            )
        count, model = len(corners), self._cameras[camera]
        covariances = (
            corner_covariances([None] * count)
            if covariances_px2 is None
            else _shaped("covariances_px2", covariances_px2, (count, 8, 8))
        )
        lengths = _shaped("length_m", length_m, (count,))
        if heights_m is None:
            poses = locate_poses(model, corners, covariances, lengths)
            return LocatedMarkers(poses.points_m, poses.headings_rad, poses.covariances_m2, poses.chi2)
        heights = _shaped("heights_m", heights_m, (count,))
        found = locate_markers(model, corners, covariances, heights, lengths)
        return LocatedMarkers(found.points_m, found.headings_rad, found.covariances_m2, found.chi2)


def _shaped(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return an array of a shape; a single value or covariance is that of all markers."""
    array = np.asarray(values, dtype=np.float64)
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        raise IpsysError(f"{name} has the shape {array.shape}; give {shape}") from None
