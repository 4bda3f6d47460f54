"""The simulated lab with robots that other programs control: their motion, ground truth and images."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.capture.simulation.calibration_points import SimulatedPose, cameras_seeing, place_marker
from ipsys_log.capture.simulation.cameras import mount_cameras
from ipsys_log.capture.simulation.differential_drive import DifferentialDrive, Pose2d
from ipsys_log.capture.simulation.floor import FloorView, prepare_view
from ipsys_log.capture.simulation.lab import build_rig
from ipsys_log.capture.simulation.render import add_static_prints, encode_jpeg, render
from ipsys_log.capture.simulation.settings import LabSettings, Purpose, random_stream
from ipsys_log.messages import Rig, RigCamera, Track, Tracks, Waypoint
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.markers import MovingMarker, PlacedBoard
from ipsys_log.vision.poses import pose_facing_up

# Labels on the floor: a black cross of 9 cm with a white margin of 3 cm.
_CROSS = np.pad(np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=bool), 1)
_CROSS_CELL_M = 0.03


@dataclass(frozen=True, slots=True)
class RobotStart:
    """A robot at the start: its name, the id of its marker, and its pose."""

    name: str
    marker_id: int
    pose: Pose2d


def robot_rig(settings: LabSettings) -> Rig:
    """Return the rig of the lab: as many robots as markers, and the simulated cameras."""
    rig = build_rig(settings)
    cameras = (
        RigCamera(name, None, None, f"sim:{name}", settings.width, settings.height, settings.rate_hz)
        for name in settings.cameras
    )
    markers = (replace(marker, height_m=settings.drive_height_m) for marker in rig.markers)
    return replace(rig, cameras=tuple(cameras), markers=tuple(markers))


class RobotLab:
    """Robots on the floor of the simulated lab, and the images of its cameras. Any thread may use it.

    Parameters
    ----------
    settings : settings of the lab; ``drive_height_m`` is the height of the markers.
    robots : the robots at the start.
    labels : places on the floor with a cross, as the waypoints of the paper (sect. 4.3).
    start_ns : time of the start.
    seed : seed of the wheels and of the noise of the images; the seed of the settings is that of the lab.
    """

    def __init__(
        self,
        settings: LabSettings,
        robots: Sequence[RobotStart],
        labels: Sequence[Waypoint],
        start_ns: int,
        seed: int = 0,
    ) -> None:
        self.settings, self._seed = settings, seed
        self.cameras = mount_cameras(settings, start_ns)
        self._ids = {robot.name: robot.marker_id for robot in robots}
        self._drives = {
            robot.name: DifferentialDrive(
                robot.pose, start_ns, random_stream(seed, Purpose.WHEELS, robot.marker_id)
            )
            for robot in robots
        }
        self._lock = threading.Lock()
        crosses = [_cross(place) for place in dict.fromkeys(labels)]

        def view(number: int) -> FloorView:
            return add_static_prints(prepare_view(self.cameras[number], settings), crosses, settings)

        with ThreadPoolExecutor(len(self.cameras)) as pool:
            self._views = tuple(pool.map(view, range(len(self.cameras))))

    def advance(self, time_ns: int) -> None:
        """Move all robots up to a time."""
        with self._lock:
            for drive in self._drives.values():
                drive.advance(time_ns)

    def command(self, robot: str, left_m_s: float, right_m_s: float) -> None:
        """Set the speeds of the wheels of a robot, from the present time of its motion on."""
        with self._lock:
            self._drives[robot].command(left_m_s, right_m_s)

    def poses_at(self, time_ns: int) -> tuple[SimulatedPose, ...]:
        """Return the true poses of all markers at a time up to the present one."""
        return tuple(self._pose_at(name, time_ns) for name in self._drives)

    def truth_at(self, time_ns: int) -> Tracks:
        """Return the ground truth at a time."""
        names = {marker_id: name for name, marker_id in self._ids.items()}
        return Tracks(
            time_ns,
            tuple(
                Track(
                    names[pose.marker_id],
                    pose.marker_id,
                    pose.x_m,
                    pose.y_m,
                    pose.z_m,
                    pose.heading_rad,
                    cameras=cameras_seeing(pose, self.cameras, self.settings),
                )
                for pose in self.poses_at(time_ns)
            ),
        )

    def draw(self, number: int, frame: int, time_ns: int) -> bytes:
        """Return the JPEG of a camera for a frame; the robots must have moved to the end of its exposure."""
        rng = random_stream(self._seed, Purpose.FRAME, number, frame)
        prints = [self._print_of(name, time_ns) for name in self._drives]
        return encode_jpeg(render(self._views[number], prints, self.settings, rng), self.settings)

    def _print_of(self, name: str, time_ns: int) -> MovingMarker:
        return lambda since_s: place_marker(
            self._pose_at(name, time_ns + round(since_s * NS_PER_S)), self.settings
        )

    def _pose_at(self, name: str, time_ns: int) -> SimulatedPose:
        with self._lock:
            pose = self._drives[name].pose_at(time_ns)
        height_m = self.settings.drive_height_m
        return SimulatedPose(self._ids[name], pose.x_m, pose.y_m, height_m, pose.heading_rad)


def _cross(place: Waypoint) -> PlacedBoard:
    return PlacedBoard(_CROSS, _CROSS_CELL_M, pose_facing_up(place.x_m, place.y_m, 0.0, 0.0))
