"""Positions of rigid bodies that are not level, from their markers in one frame, by the joint model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ipsys_log.calibration.joint.locate import corner_covariances
from ipsys_log.calibration.joint.locate_bodies import (
    BodyPoses,
    BodySightings,
    locate_bodies,
    strongest_modes,
)
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.messages import Array, Event, Marker, Position, Rig
from ipsys_log.messages.events import LOOSE_MARKER
from ipsys_log.models.tracking.frame_reader import FREE_MODES
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import BodyShape, body_shapes
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.poses import rotate, rotation_vector

# The number of modes of the calibration that positions keep. The errors by the others, 0.07 mm after 75
# calibration points, count as noise.
MODES = FREE_MODES - 1
# Bodies that are carried or fly: accelerations, and the largest usual speeds.
_ACCELERATION = np.repeat([3.0, 10.0], 3)  # m/s^2, rad/s^2
_SPEED = np.repeat([0.5, 1.5], 3)  # m/s, rad/s
_TURN_SIGMA_RAD = 0.05
# An older pose tells nothing of the velocity.
_MEMORY_NS = NS_PER_S // 5
# The quantile of one in a million of a normal distribution, for chi2 (Wilson and Hilferty, PNAS 1931).
_RARE = 4.75
# A marker is named after this number of successive frames in which it contradicts all others of its body.
_LOOSE_FRAMES = 10


@dataclass(slots=True, eq=False)
class _Memory:
    """The last pose of a body by a camera: the instant, the point, the rotation, and perhaps the twist."""

    time_ns: int
    point_m: Array
    turn: Array
    twist: Array | None = None


@dataclass(slots=True, eq=False)
class _Seen:
    """A body in a frame: its markers, their exposures, and the instant of its pose."""

    shape: BodyShape
    markers: list[Marker]
    times_ns: list[int]

    @property
    def time_ns(self) -> int:
        return sum(self.times_ns) // len(self.times_ns)

    def without(self, number: int) -> _Seen:
        """Return the body without one of its markers."""
        rest = [n for n in range(len(self.markers)) if n != number]
        return _Seen(self.shape, [self.markers[n] for n in rest], [self.times_ns[n] for n in rest])


@dataclass(slots=True, eq=False)
class BodyLocator:
    """The poses of bodies in the frames of all cameras.

    It remembers the last pose of a body by each camera: its rotation tells mirrored poses apart, and its
    velocity moves the markers of a rolling shutter to one instant.
    """

    cameras: Mapping[str, JointModel]
    shapes: dict[int, BodyShape] = field(default_factory=dict)
    axes: Array = field(default_factory=lambda: np.zeros((0, 0)))
    memory: dict[tuple[str, str], _Memory] = field(default_factory=dict)
    loose: dict[int, int] = field(default_factory=dict)

    def use_rig(self, rig: Rig) -> None:
        """Use the bodies of a rig for the next frames."""
        free = [shape for shape in body_shapes(rig) if not shape.is_level]
        ids = {shape.robot: shape for shape in free}
        self.shapes = {m.id: ids[m.robot] for m in rig.markers if m.robot in ids}
        self.memory.clear()
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
            if marker.id in shape.corners_m and self._is_in_view(camera, marker):
                seen = bodies.setdefault(shape.robot, _Seen(shape, [], []))
                seen.markers.append(marker)
                seen.times_ns.append(exposed_ns)
        by_count: dict[int, list[_Seen]] = {}
        for seen in bodies.values():
            by_count.setdefault(len(seen.markers), []).append(seen)
        for together in by_count.values():
            poses = self._solve(camera, together)
            for row, seen in enumerate(together):
                yield from self._results(camera, time_ns, seen, poses, row)

    def _is_in_view(self, camera: str, marker: Marker) -> bool:
        uv = undistort(np.asarray(marker.corners_px, dtype=np.float64), self.cameras[camera].calibration)
        return bool(np.isfinite(uv).all())

    def _results(
        self, camera: str, time_ns: int, seen: _Seen, poses: BodyPoses, row: int
    ) -> Iterator[Position | Event]:
        fits = poses.chi2[row] < _most_chi2(8 * len(seen.markers) - 6)
        if not fits and len(seen.markers) > 2:
            parts = [seen.without(number) for number in range(len(seen.markers))]
            others = self._solve(camera, parts)
            best = int(others.chi2.argmin())
            if others.chi2[best] < _most_chi2(8 * len(seen.markers) - 14):
                yield from self._note(camera, time_ns, seen, seen.markers[best].id)
                seen, poses, row, fits = parts[best], others, best, True
        for marker in seen.markers if fits else ():
            self.loose.pop(marker.id, None)
        self._remember(camera, seen, poses, row)
        yield self._position(camera, time_ns, seen, poses, row, fits=bool(fits))

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
        twists, sigmas = np.zeros((count, 6)), np.tile(_SPEED, (count, 1))
        turns, turn_sigmas_rad = np.tile(np.eye(3), (count, 1, 1)), np.full(count, np.inf)
        for row, seen in enumerate(bodies):
            last = self.memory.get((camera, seen.shape.robot))
            since_s = (seen.time_ns - last.time_ns) / NS_PER_S if last else np.inf
            if last is None or not 0 < since_s * NS_PER_S <= _MEMORY_NS:
                continue
            turns[row], turn_sigmas_rad[row] = last.turn, _TURN_SIGMA_RAD + _SPEED[3] * since_s
            if last.twist is not None:
                # The twist is that in the middle of the last step.
                twists[row], sigmas[row] = last.twist, np.minimum(_ACCELERATION * 1.5 * since_s, _SPEED)
                turns[row] = rotate(last.twist[None, 3:] * since_s)[0] @ last.turn
        scales = [1.0 if seen.shape.is_measured else model.scale for seen in bodies]
        corners_m = [
            [seen.shape.corners_m[m.id] * s for m in seen.markers]
            for s, seen in zip(scales, bodies, strict=True)
        ]
        times_s = [[(t - seen.time_ns) / NS_PER_S for t in seen.times_ns] for seen in bodies]
        pixels = np.array([marker.corners_px for marker in markers], dtype=np.float64)
        covariances_px2 = corner_covariances([marker.covariance_px2 for marker in markers])
        sightings = BodySightings(
            pixels.reshape(count, -1, 4, 2),
            covariances_px2.reshape(count, -1, 8, 8),
            np.array(corners_m),
            np.array(times_s),
            twists,
            sigmas,
            turns,
            turn_sigmas_rad,
        )
        return locate_bodies(model, sightings)

    def _remember(self, camera: str, seen: _Seen, poses: BodyPoses, row: int) -> None:
        key = camera, seen.shape.robot
        last, now = self.memory.get(key), _Memory(seen.time_ns, poses.points_m[row], poses.turns[row])
        if last is not None and 0 < now.time_ns - last.time_ns <= _MEMORY_NS:
            turned_rad = rotation_vector(now.turn @ last.turn.T)
            since_s = (now.time_ns - last.time_ns) / NS_PER_S
            now.twist = np.concatenate([now.point_m - last.point_m, turned_rad]) / since_s
        self.memory[key] = now

    def _position(
        self, camera: str, time_ns: int, seen: _Seen, poses: BodyPoses, row: int, *, fits: bool
    ) -> Position:
        """Return the position with its noise, and its errors by modes, by the size and by the clock."""
        model, shape = self.cameras[camera], seen.shape
        all_modes, turn = poses.modes[row], poses.turns[row]
        kept = all_modes @ self.axes
        others = all_modes @ all_modes.T - kept @ kept.T
        noise = poses.noise[row] + others
        by_scale = poses.by_scale[row][:, None] * shape.scale_sigma
        clock_s = np.append(model.modes[len(model.lens) + 7] @ self.axes, 0.0)
        modes = np.vstack([np.hstack([kept, by_scale]), clock_s])
        covariance = noise + modes[:6] @ modes[:6].T
        x_m, y_m, z_m = poses.points_m[row].tolist()
        # A turn about the vertical changes the direction of the x axis by as much.
        heading_rad = float(np.arctan2(turn[1, 0], turn[0, 0]))
        return Position(
            shape.id,
            x_m,
            y_m,
            z_m,
            heading_rad,
            covariance[:3, :3],
            fits and model.is_certain and not any(marker.contradicted for marker in seen.markers),
            seen.time_ns - time_ns or None,
            noise[:3, :3],
            float(np.sqrt(noise[5, 5])),
            rotation_vector(turn),
            (noise + noise.T) / 2,
            modes.ravel(),
        )


def _most_chi2(degrees: int) -> float:
    share = 2 / (9 * degrees)
    return float(degrees * (1 - share + _RARE * np.sqrt(share)) ** 3)
