"""Positions of rigid bodies that are not level, from their markers in one frame, by the joint model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ipsys_log.calibration.joint.locate import corner_covariances
from ipsys_log.calibration.joint.locate_bodies import BodyPoses, BodySightings, locate_bodies, strongest_modes
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.messages import Array, Event, Marker, Position, Rig
from ipsys_log.messages.events import LOOSE_MARKER
from ipsys_log.models.tracking.frame_reader import FREE_MODES
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import BodyShape, body_shapes
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.poses import rotate, rotation_vector, rotation_vectors
from ipsys_log.vision.square_pose import is_convex

# The number of modes of the calibration that positions keep. The errors by the others, 0.07 mm after 75
# calibration points, count as noise.
MODES = FREE_MODES - 1
# The quantile of one in a million of a normal distribution, for chi2 (Wilson and Hilferty, PNAS 1931).
_RARE = 4.75
# A marker is named after this number of successive frames in which it contradicts all others of its body.
_LOOSE_FRAMES = 10


@dataclass(slots=True, eq=False)
class _Seen:
    """A body in a frame: its markers, their exposures, and the instant of its pose."""

    shape: BodyShape
    markers: list[Marker]
    times_ns: list[int]

    @property
    def time_ns(self) -> int:
        return sum(self.times_ns) // len(self.times_ns)

    def of(self, markers: Sequence[Marker]) -> _Seen:
        """Return the body with some of its markers."""
        times_ns = [at for marker, at in zip(self.markers, self.times_ns, strict=True) if marker in markers]
        return _Seen(self.shape, list(markers), times_ns)


@dataclass(slots=True, eq=False)
class BodyLocator:
    """The poses of bodies in the frames of all cameras; it remembers which markers came loose."""

    cameras: Mapping[str, JointModel]
    rig: Rig | None = None
    shapes: dict[int, BodyShape] = field(default_factory=dict)
    axes: Array = field(default_factory=lambda: np.zeros((0, 0)))
    loose: dict[int, int] = field(default_factory=dict)

    def use_rig(self, rig: Rig) -> None:
        """Use the bodies of a rig for the next frames."""
        self.rig, free = rig, [shape for shape in body_shapes(rig) if not shape.is_level]
        ids = {shape.robot: shape for shape in free}
        self.shapes = {m.id: ids[m.robot] for m in rig.markers if m.robot in ids}
        if free:
            corners_m = np.array(list(free[0].corners_m.values()))
            self.axes = strongest_modes(self.cameras.values(), corners_m, MODES)

    def locate(
        self, camera: str, time_ns: int, markers: Sequence[Marker], times_ns: Sequence[int]
    ) -> Iterator[Position | Event]:
        """Yield the positions of the bodies in a frame, and an event for a marker that came loose.

        Parameters
        ----------
        camera : its name.
        time_ns : the stamp of the frame.
        markers, times_ns : markers of bodies, and the instants of their exposures.
        """
        bodies: dict[str, _Seen] = {}
        for marker, exposed_ns in zip(markers, times_ns, strict=True):
            shape = self.shapes[marker.id]
            if marker.id in shape.corners_m and self._is_square(camera, marker):
                seen = bodies.setdefault(shape.robot, _Seen(shape, [], []))
                seen.markers.append(marker)
                seen.times_ns.append(exposed_ns)
        by_count: dict[int, list[_Seen]] = {}
        for seen in bodies.values():
            # Beside fewer than two others, nothing tells whether a loose marker is at its place again.
            firm = [marker for marker in seen.markers if self.loose.get(marker.id, 0) < _LOOSE_FRAMES]
            kept = seen if len(seen.markers) > 2 else seen.of(firm)
            if kept.markers:
                by_count.setdefault(len(kept.markers), []).append(kept)
        for together in by_count.values():
            poses = self._solve(camera, together)
            for row, seen in enumerate(together):
                yield from self._results(camera, time_ns, seen, poses, row)

    def _is_square(self, camera: str, marker: Marker) -> bool:
        """Return whether the camera can see these corners of a square; a log may hold others."""
        corners_px = np.asarray(marker.corners_px, dtype=np.float64)
        return is_convex(undistort(corners_px, self.cameras[camera].calibration))

    def _results(
        self, camera: str, time_ns: int, seen: _Seen, poses: BodyPoses, row: int
    ) -> Iterator[Position | Event]:
        excess = _excess(poses, row, len(seen.markers))
        if excess > 1 and len(seen.markers) > 1:
            parts = [seen.of([one for one in seen.markers if one is not odd]) for odd in seen.markers]
            others = self._solve(camera, parts)
            best = int(others.chi2.argmin())
            if len(seen.markers) > 2 and _excess(others, best, len(seen.markers) - 1) == 1:
                yield from self._note(camera, time_ns, seen, seen.markers[best].id)
                seen, poses, row, excess = parts[best], others, best, 1.0
            else:
                excess = max(excess, _disagreement(poses, row, others))
        for marker in seen.markers if excess == 1 else ():
            self.loose.pop(marker.id, None)
        yield self._position(camera, time_ns, seen, poses, row, excess)

    def _note(self, camera: str, time_ns: int, seen: _Seen, marker_id: int) -> Iterator[Event]:
        frames = self.loose[marker_id] = self.loose.get(marker_id, 0) + 1
        if frames == _LOOSE_FRAMES:
            text = (
                f"marker {marker_id} of {seen.shape.robot} is not where the rig places it on the body; poses "
                "leave it out. Fix it, then run: ipsys calibrate-body"
            )
            yield Event(time_ns, LOOSE_MARKER, text, camera, marker_id)

    def _solve(self, camera: str, bodies: Sequence[_Seen]) -> BodyPoses:
        """Return the poses of bodies with the same number of markers."""
        model = self.cameras[camera]
        count, markers = len(bodies), [marker for seen in bodies for marker in seen.markers]
        scales = [1.0 if seen.shape.is_measured else model.scale for seen in bodies]
        corners_m = [
            [seen.shape.corners_m[m.id] * s for m in seen.markers]
            for s, seen in zip(scales, bodies, strict=True)
        ]
        times_s = np.array([[(t - seen.time_ns) / NS_PER_S for t in seen.times_ns] for seen in bodies])
        pixels = np.array([marker.corners_px for marker in markers], dtype=np.float64)
        rows = pixels[..., 1].reshape(count, -1, 4)
        known_s = (self.rig.camera(camera).row_time_ns or 0) / NS_PER_S if self.rig else 0.0
        rows_s = (rows - rows.mean(axis=2, keepdims=True)) * (known_s + model.row_time_s)
        covariances_px2 = corner_covariances([marker.covariance_px2 for marker in markers])
        sightings = BodySightings(
            pixels.reshape(count, -1, 4, 2),
            covariances_px2.reshape(count, -1, 8, 8),
            np.array(corners_m),
            times_s[:, :, None] + rows_s,
            at_one_instant=known_s > 0,
        )
        return locate_bodies(model, sightings)

    def _position(
        self, camera: str, time_ns: int, seen: _Seen, poses: BodyPoses, row: int, excess: float
    ) -> Position:
        """Return the position with its noise, and its errors by modes, by the size and by the clock.

        The variances of the noise grow by a factor ``excess`` if the corners contradict the body.
        """
        model, shape = self.cameras[camera], seen.shape
        all_modes, turn = poses.modes[row], poses.turns[row]
        kept = all_modes @ self.axes
        others = all_modes @ all_modes.T - kept @ kept.T
        noise, spread = excess * poses.noise[row] + others, excess * poses.spread[row] + others
        by_scale = poses.by_scale[row][:, None] * shape.scale_sigma
        clock_s = np.append(model.modes[len(model.lens) + 7] @ self.axes, 0.0)
        modes = np.vstack([np.hstack([kept, by_scale]), clock_s])
        x_m, y_m, z_m = poses.points_m[row].tolist()
        # A turn about the vertical changes the direction of the x axis by as much.
        heading_rad = float(np.arctan2(turn[1, 0], turn[0, 0]))
        return Position(
            shape.id,
            x_m,
            y_m,
            z_m,
            heading_rad,
            spread[:3, :3] + modes[:3] @ modes[:3].T,
            excess == 1 and model.is_certain and not any(marker.contradicted for marker in seen.markers),
            seen.time_ns - time_ns or None,
            spread[:3, :3],
            float(np.sqrt(spread[5, 5])),
            rotation_vector(turn),
            poses.to_still[row],
            (noise + noise.T) / 2,
            poses.by_twist[row],
            modes.ravel(),
        )


def _excess(poses: BodyPoses, row: int, markers: int) -> float:
    """Return the factor by which the corners contradict their noise; 1 for usual residuals."""
    degrees = 8 * markers - 6
    share = 2 / (9 * degrees)
    if poses.chi2[row] < degrees * (1 - share + _RARE * np.sqrt(share)) ** 3:
        return 1.0
    return float(max(1.0 + _RARE * np.sqrt(share), poses.still_chi2[row] / degrees))


def _disagreement(poses: BodyPoses, row: int, others: BodyPoses) -> float:
    """Return the largest squared difference from poses without one marker, by degree of freedom.

    If the markers contradict each other, and nothing tells which one is wrong, each of these may be right.
    """
    turns = rotate(np.concatenate([poses.to_still[row][None], others.to_still])[:, 3:])
    turns = turns @ np.concatenate([poses.turns[row][None], others.turns])
    apart = np.concatenate(
        [
            others.points_m + others.to_still[:, :3] - poses.points_m[row] - poses.to_still[row, :3],
            rotation_vectors(turns[1:] @ turns[0].T),
        ],
        axis=1,
    )
    solved = np.linalg.solve(poses.noise[row], apart.T).T
    return float((apart * solved).sum(axis=1).max()) / 6
