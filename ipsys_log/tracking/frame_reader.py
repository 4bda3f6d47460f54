"""Sightings of robots from the positions of a frame: by robot, at their capture times, with their errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ipsys_log.messages import Model, Position, Rig
from ipsys_log.tracking.bias_modes import BiasModes
from ipsys_log.tracking.bodies import Bodies
from ipsys_log.tracking.filter import Sightings
from ipsys_log.tracking.position_sightings import is_usable, read_sightings
from ipsys_log.tracking.tracks import Robot


@dataclass(frozen=True, slots=True, eq=False)
class FrameSightings:
    """The sightings of one frame, (k,) of each: the arguments of ``RobotTracks.observe``."""

    camera: str
    robots: Sequence[Robot]
    times_ns: Sequence[int]
    sightings: Sightings
    inside: Sequence[bool | None]
    has_covariance: Sequence[bool]


class FrameReader:
    """The reader of positions, with the rig and the errors of the calibration.

    Parameters
    ----------
    model : the model of the positions; None for positions of another program.
    """

    def __init__(self, model: Model | None) -> None:
        self._model = model
        self._rig: Rig | None = None
        self._robots: dict[int, Robot] = {}
        self.modes = BiasModes.none()
        self._bodies, self._has_bodies = Bodies(), False

    def use_rig(self, rig: Rig) -> None:
        """Use a rig for the next frames."""
        names = [marker.robot for marker in rig.markers if marker.robot is not None]
        self._rig, self._has_bodies = rig, len(names) > len(set(names))
        self._robots = {}
        if self._model is not None:
            # Late: the modes of a joint model need scipy.
            from ipsys_log.tracking.calibration_modes import calibration_modes

            self.modes = calibration_modes(self._model, rig)

    def read(self, camera: str, time_ns: int, positions: Sequence[Position]) -> FrameSightings | None:
        """Return the sightings of a frame of a camera at a time; None if it shows no robot."""
        positions = [position for position in positions if is_usable(position)]
        if not positions:
            return None
        sightings, has_covariance = read_sightings(camera, positions, self.modes)
        robots = [self._robots.get(p.id) or self._robot_of(p.id) for p in positions]
        if self._has_bodies:
            self._bodies.learn(robots, sightings)
            rows = [row for row, robot in enumerate(robots) if self._bodies.knows(*robot)]
            positions, robots = [positions[row] for row in rows], [robots[row] for row in rows]
            sightings = self._bodies.move(robots, sightings.take(np.array(rows, dtype=np.intp)))
            has_covariance = has_covariance[rows]
            robots = [(name, self._bodies.reference(name, number)) for name, number in robots]
        return FrameSightings(
            camera,
            robots,
            [time_ns + (position.time_offset_ns or 0) for position in positions],
            sightings,
            [position.inside for position in positions],
            has_covariance.tolist(),
        )

    def _robot_of(self, marker_id: int) -> Robot:
        assert self._rig is not None
        robot = self._robots[marker_id] = (self._rig.robot_of(marker_id), marker_id)
        return robot
