"""Robots with several markers: the place of each marker on its robot, from frames that show two of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ipsys_log.arrays import Array
from ipsys_log.tracking.filter import UNKNOWN_RAD2, Sightings

# An offset is used after this number of frames that agree within the gates.
_FEWEST_FRAMES = 10
_AGREES_M, _AGREES_RAD = 0.01, 0.05


@dataclass(slots=True, eq=False)
class _Offset:
    """The mean pose of a marker relative to the reference marker of its robot: x, y, z and heading, (4,)."""

    mean: Array
    frames: int = 1

    def add(self, offset: Array) -> None:
        """Add the offset in one frame; start again if it disagrees."""
        change = offset - self.mean
        change[3] = (change[3] + np.pi) % (2 * np.pi) - np.pi
        if np.abs(change[:3]).max() > _AGREES_M or abs(change[3]) > _AGREES_RAD:
            # A single wrong frame does not end a long agreement.
            self.frames -= 1
            if self.frames < 1:
                self.mean, self.frames = offset, 1
            return
        self.frames = min(self.frames + 1, 100 * _FEWEST_FRAMES)
        self.mean = self.mean + change / self.frames


@dataclass(slots=True, eq=False)
class Bodies:
    """The robots with several markers.

    The first marker that is seen of a robot is its reference: the track of the robot is that of this marker.
    The rig does not tell where the others are. Frames that show two markers of a robot do.
    """

    references: dict[str, int] = field(default_factory=dict)
    offsets: dict[int, _Offset] = field(default_factory=dict)

    def reference(self, robot: str, marker_id: int) -> int:
        """Return the reference marker of a robot."""
        return self.references.setdefault(robot, marker_id)

    def learn(self, markers: Sequence[tuple[str, int]], sightings: Sightings) -> None:
        """Learn from the sightings of one frame: of k markers, each with the name of its robot and its id."""
        poses, known_headings = sightings.poses, sightings.noise[:, 3, 3] < UNKNOWN_RAD2
        rows = {marker_id: row for row, (_, marker_id) in enumerate(markers) if known_headings[row]}
        for marker_id, row in rows.items():
            robot = markers[row][0]
            reference = rows.get(self.reference(robot, marker_id))
            if reference is None or reference == row:
                continue
            offset = poses[row] - poses[reference]
            offset[:2] = _turn(-poses[reference, 3]) @ offset[:2]
            known = self.offsets.get(marker_id)
            if known is None:
                self.offsets[marker_id] = _Offset(offset)
            else:
                known.add(offset)

    def knows(self, robot: str, marker_id: int) -> bool:
        """Return whether the sighting of a marker is one of its robot's reference."""
        known = self.offsets.get(marker_id)
        return self.reference(robot, marker_id) == marker_id or (
            known is not None and known.frames >= _FEWEST_FRAMES
        )

    def move(self, markers: Sequence[tuple[str, int]], sightings: Sightings) -> Sightings:
        """Return the sightings of the reference markers that follow from those of known markers.

        A sighting without a heading does not tell where the reference is: its noise becomes as large as the
        distance of the markers.
        """
        poses, noise = sightings.poses.copy(), sightings.noise.copy()
        sensitivities = sightings.sensitivities.copy()
        for row, (robot, marker_id) in enumerate(markers):
            if self.reference(robot, marker_id) == marker_id:
                continue
            offset = self.offsets[marker_id].mean
            if noise[row, 3, 3] >= UNKNOWN_RAD2:
                noise[row, :2, :2] += (offset[:2] @ offset[:2]) * np.eye(2)
                continue
            heading_rad = poses[row, 3] - offset[3]
            arm_m = _turn(heading_rad) @ offset[:2]
            poses[row] -= [*arm_m, offset[2], offset[3]]
            # A turn of the marker moves the reference around it.
            by_pose = np.eye(4)
            by_pose[:2, 3] = arm_m[1], -arm_m[0]
            noise[row] = by_pose @ noise[row] @ by_pose.T
            sensitivities[row] = by_pose @ sensitivities[row]
        return Sightings(poses, noise, sensitivities, sightings.clock_s)


def _turn(angle_rad: float) -> Array:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])
