"""The simulated lab with robots of two driven wheels: motion by commands of other programs, and images."""

import threading
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import atan2, cos, exp, sin, sqrt

import numpy as np

from ipsys_log.capture.simulation.calibration_points import SimulatedPose, place_marker
from ipsys_log.capture.simulation.cameras import FloorView, mount_cameras, prepare_view
from ipsys_log.capture.simulation.lab import build_rig, live_cameras, true_tracks
from ipsys_log.capture.simulation.render import add_static_prints, encode_jpeg, render
from ipsys_log.capture.simulation.settings import LabSettings, Purpose, random_stream
from ipsys_log.capture.simulation.textured_floor import feet
from ipsys_log.messages import Rig, Tracks, Waypoint
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.markers import MovingMarker, PlacedBoard
from ipsys_log.vision.poses import pose_facing_up

# Time between two steps of the motion.
STEP_NS = NS_PER_S // 200
# Duration of the remembered poses: a camera asks for poses of the past.
_REMEMBERED_S = 10


@dataclass(frozen=True, slots=True)
class Chassis:
    """The properties of a robot; speeds and sizes are those of a TurtleBot3 Waffle.

    Attributes
    ----------
    fastest_m_s : largest speed of a wheel on the floor.
    track_m : distance between the wheels.
    lag_s : time constant of the motors.
    slip, slip_sigma, slip_time_s : mean share of the speed that a wheel loses, its standard deviation, and
        the time in which it changes.
    noise : standard deviation of the speed in each step, as a share of the speed.
    watchdog_s : the wheels stop if there is no command for this time.
    """

    fastest_m_s: float = 0.26
    track_m: float = 0.287
    lag_s: float = 0.1
    slip: float = 0.02
    slip_sigma: float = 0.02
    slip_time_s: float = 1.0
    noise: float = 0.05
    watchdog_s: float = 1.0


@dataclass(frozen=True, slots=True)
class Pose2d:
    """A position on the floor in m, and a heading in rad."""

    x_m: float
    y_m: float
    heading_rad: float


class DifferentialDrive:
    """The motion of one robot, in steps of :data:`STEP_NS`. It stands until its first command.

    Parameters
    ----------
    start, start_ns : the pose at a time.
    rng : random generator of slip and noise.

    Examples
    --------
    >>> quiet = Chassis(slip=0.0, slip_sigma=0.0, noise=0.0, lag_s=1e-9)
    >>> robot = DifferentialDrive(Pose2d(1.0, 2.0, 0.0), 0, np.random.default_rng(0), quiet)
    >>> robot.command(0.2, 0.2)
    >>> robot.advance(NS_PER_S // 2)
    >>> round(robot.pose_at(NS_PER_S // 2).x_m, 6)
    1.1
    """

    def __init__(
        self, start: Pose2d, start_ns: int, rng: np.random.Generator, chassis: Chassis | None = None
    ) -> None:
        self._chassis, self._rng = chassis or Chassis(), rng
        self._time_ns, self._command_ns = start_ns, start_ns
        self._wanted_m_s, self._speed_m_s = np.zeros(2), np.zeros(2)
        self._slip = self._chassis.slip + self._chassis.slip_sigma * rng.standard_normal(2)
        self._poses: deque[tuple[int, Pose2d]] = deque(
            [(start_ns, start)], maxlen=_REMEMBERED_S * NS_PER_S // STEP_NS
        )

    def command(self, left_m_s: float, right_m_s: float) -> None:
        """Set the wanted speeds of the wheels, from now on; each is limited to the fastest speed."""
        limit_m_s = self._chassis.fastest_m_s
        self._wanted_m_s = np.clip([left_m_s, right_m_s], -limit_m_s, limit_m_s)
        self._command_ns = self._time_ns

    def advance(self, time_ns: int) -> None:
        """Move up to a time; do nothing if the motion is there already."""
        while self._time_ns + STEP_NS <= time_ns:
            self._step()

    def pose_at(self, time_ns: int) -> Pose2d:
        """Return the pose at a time up to the present one of the motion, interpolated between its steps."""
        index = len(self._poses) - 1 - max(0, -((time_ns - self._time_ns) // STEP_NS))
        (before_ns, before), (_, after) = (
            self._poses[max(0, min(index + more, len(self._poses) - 1))] for more in (0, 1)
        )
        share = min(max((time_ns - before_ns) / STEP_NS, 0.0), 1.0)
        turn_rad = atan2(
            sin(after.heading_rad - before.heading_rad), cos(after.heading_rad - before.heading_rad)
        )
        return Pose2d(
            before.x_m + share * (after.x_m - before.x_m),
            before.y_m + share * (after.y_m - before.y_m),
            before.heading_rad + share * turn_rad,
        )

    def _step(self) -> None:
        seconds, chassis = STEP_NS / NS_PER_S, self._chassis
        self._time_ns += STEP_NS
        if (self._time_ns - self._command_ns) / NS_PER_S > chassis.watchdog_s:
            self._wanted_m_s = np.zeros(2)
        self._speed_m_s += (self._wanted_m_s - self._speed_m_s) * (1 - exp(-seconds / chassis.lag_s))
        kept = exp(-seconds / chassis.slip_time_s)
        drawn = self._rng.standard_normal((2, 2))
        self._slip = chassis.slip + (self._slip - chassis.slip) * kept
        self._slip += chassis.slip_sigma * sqrt(1 - kept**2) * drawn[0]
        share = 1 - self._slip.clip(0, 1) + chassis.noise * drawn[1]
        left_m, right_m = (self._speed_m_s * share * seconds).tolist()
        self._poses.append((self._time_ns, _moved(self._poses[-1][1], left_m, right_m, chassis.track_m)))


def _moved(pose: Pose2d, left_m: float, right_m: float, track_m: float) -> Pose2d:
    """Return the pose after the wheels have rolled; the path is an arc, here its chord."""
    turn_rad, forward_m = (right_m - left_m) / track_m, (left_m + right_m) / 2
    middle_rad = pose.heading_rad + turn_rad / 2
    heading_rad = pose.heading_rad + turn_rad
    return Pose2d(
        pose.x_m + forward_m * cos(middle_rad),
        pose.y_m + forward_m * sin(middle_rad),
        atan2(sin(heading_rad), cos(heading_rad)),
    )


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
    markers = (replace(marker, height_m=settings.drive_height_m) for marker in rig.markers)
    return replace(rig, cameras=live_cameras(settings), markers=tuple(markers))


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
        return true_tracks(time_ns, self.poses_at(time_ns), names.__getitem__, self.cameras, self.settings)

    def draw(self, number: int, frame: int, time_ns: int) -> bytes:
        """Return the JPEG of a camera for a frame; the robots must have moved to the end of its exposure."""
        rng = random_stream(self._seed, Purpose.FRAME, number, frame)
        markers = [self._print_of(name, time_ns) for name in self._drives]
        prints = [*feet(self.settings, time_ns / NS_PER_S), *markers]
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
