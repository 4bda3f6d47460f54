"""The settings of a robot run, its ports on loopback, and the checks of both before any work."""

import re
import socket
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import pairwise
from math import atan2
from pathlib import Path

import numpy as np

from ipsys_log.capture.simulation.calibration_points import SimulatedPose, cameras_seeing
from ipsys_log.capture.simulation.cameras import mount_cameras
from ipsys_log.capture.simulation.robot_lab import Pose2d, RobotStart
from ipsys_log.capture.simulation.settings import FLOOR_M, LabSettings, Purpose, random_stream
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import CameraCalibration, Waypoint
from ipsys_log.sinks.streams import StreamSettings

_LOOPBACK = "127.0.0.1"
# Attempts to find any free port.
_ATTEMPTS = 100


@dataclass(frozen=True, slots=True)
class Ports:
    """The ports of a robot run.

    Attributes
    ----------
    wheels : the simulated wheels; 0: they bind any free port themselves.
    server : the server of VRPN or ROS 2; None with UDP.
    positions : by number of the robot, the port that its program gets.
    relays : by number of the robot, the port of its relay; empty without relays.
    """

    wheels: int
    server: int | None
    positions: tuple[int, ...]
    relays: tuple[int, ...]


def find_ports(first: int, robots: int, has_server: bool, has_relay: bool) -> Ports:
    """Return ports that are free now.

    Parameters
    ----------
    first : the first port, the others follow; 0: any free ports.
    robots : number of robots.
    has_server : all robots connect to one server, or to their relay.
    has_relay : each robot has a relay.
    """
    own = 0 if has_server and not has_relay else robots
    count = has_server + own + (robots if has_relay else 0)
    # A port that is bound later may be taken before, so the wheels choose their own.
    wheels, *free = _bindable(first, 1 + count) if first else (0, *_bindable(0, count))
    server = free.pop(0) if has_server else None
    shared = () if server is None else (server,) * robots
    return Ports(wheels, server, tuple(free[:own]) or shared, tuple(free[own:]))


def _bindable(first: int, count: int) -> Sequence[int]:
    with ExitStack() as stack:
        return [_probe(first + number if first else 0, first, stack) for number in range(count)]


def _probe(wanted: int, first: int, stack: ExitStack) -> int:
    """Return a port that is free for UDP and TCP; it stays in use until the stack is closed."""
    for _ in range(1 if wanted else _ATTEMPTS):
        port = wanted
        with ExitStack() as probes:
            try:
                for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
                    probe = probes.enter_context(socket.socket(socket.AF_INET, kind))
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, kind is socket.SOCK_STREAM)
                    probe.bind((_LOOPBACK, port))
                    port = port or int(probe.getsockname()[1])
            except OSError:  # a port that is free for UDP may be in use for TCP
                continue
            stack.push(probes.pop_all())
            return port
    raise IpsysError(
        f"--port {first}: port {port} is in use, perhaps by another run; end it, or give another port"
    )


PORT = 9870
PROGRAM = Path(__file__).parent / "example_robot" / "robot.py"
# The first path is that of the paper (sect. 4.3). The paths of the other robots cross it at other times.
PATHS: tuple[tuple[Waypoint, ...], ...] = (
    (Waypoint(0.5, 0.5), Waypoint(0.5, 2.5), Waypoint(2.5, 2.5), Waypoint(4.5, 4.5)),
    (Waypoint(4.5, 3.0), Waypoint(1.5, 3.4), Waypoint(1.5, 1.0), Waypoint(3.5, 0.8)),
    (Waypoint(3.0, 4.3), Waypoint(0.6, 4.3), Waypoint(0.8, 1.4), Waypoint(4.2, 1.6)),
)
# Standard deviations of the pose at the start: about the first waypoint.
_START_SIGMA_M, _START_SIGMA_RAD = 0.03, 0.2


@dataclass(frozen=True, slots=True)
class CameraFailure:
    """A camera that sends no frames from a time after the start on, in s."""

    camera: str
    start_s: float
    duration_s: float

    def includes(self, time_s: float) -> bool:
        return self.start_s <= time_s < self.start_s + self.duration_s


@dataclass(frozen=True, slots=True)
class RobotRun:
    """The settings of a robot run.

    Attributes
    ----------
    lab : the simulated lab that the model is fitted to; its rate is that of the cameras.
    paths : the waypoints of each robot.
    program : the program of the robots.
    over : the stream of the positions: ``udp``, ``vrpn`` or ``ros2``.
    loss, delay_s : share of lost datagrams (ROS 2: messages), and added delay.
    failures : cameras that send nothing for some time.
    lockstep : simulated time, which advances from frame to frame; otherwise real time.
    seed : seed of the wheels, the start and the lost datagrams.
    port : first of the ports; 0: free ports.
    tick_hz : commands of each robot per second.
    longest_s : the run ends after this time.
    """

    lab: LabSettings
    paths: Mapping[str, tuple[Waypoint, ...]]
    program: Path = PROGRAM
    over: str = "udp"
    loss: float = 0.0
    delay_s: float = 0.0
    failures: tuple[CameraFailure, ...] = ()
    lockstep: bool = False
    seed: int = 0
    port: int = PORT
    tick_hz: float = 20.0
    longest_s: float = 300.0

    @property
    def has_relay(self) -> bool:
        return bool(self.loss or self.delay_s)

    @property
    def sends_good_only(self) -> bool:
        """True if the stream withholds stale and extrapolated positions."""
        return self.over != "udp"

    def check(self) -> None:
        """Check all settings."""
        if not self.program.is_file():
            raise IpsysError(
                f"--program {self.program}: does not exist; name the program of the robots, or leave "
                "--program out for the example of ipsys"
            )
        self._check_stream()
        if not 0 <= self.loss < 1:
            raise IpsysError(f"--loss {self.loss:g}: give a share from 0 to below 1, such as 0.05")
        if not 0 <= self.delay_s <= 10:
            raise IpsysError(f"--delay-ms {1000 * self.delay_s:g}: give a delay from 0 to 10000 ms")
        for failure in self.failures:
            if failure.camera not in self.lab.cameras:
                raise IpsysError(
                    f"--fail {failure.camera}: the lab has no camera of this name; it has "
                    f"{', '.join(self.lab.cameras)}"
                )
        self._check_waypoints()
        self.ports()

    def _check_stream(self) -> None:
        if self.over not in ("udp", "vrpn", "ros2"):
            raise IpsysError(f"--over {self.over}: is no stream of robots; use udp, vrpn or ros2")
        if self.over == "ros2":
            check_installed("--over ros2 needs", "zenoh", "rosbags", "xxhash")
        if self.has_relay and self.over == "vrpn":
            raise IpsysError("--loss and --delay-ms need --over udp or --over ros2: VRPN has no relay")

    def _check_waypoints(self) -> None:
        cameras = mount_cameras(self.lab)
        for robot, path in self.paths.items():
            for place in path:
                where = f"--path {robot}: waypoint {place.x_m:g},{place.y_m:g}"
                if not (0 <= place.x_m <= FLOOR_M and 0 <= place.y_m <= FLOOR_M):
                    raise IpsysError(f"{where} is outside the lab; x and y are from 0 to {FLOOR_M:g} m")
                pose = SimulatedPose(0, place.x_m, place.y_m, self.lab.drive_height_m, np.pi / 4)
                if not cameras_seeing(pose, cameras, self.lab):
                    raise IpsysError(f"{where} is in no image; choose a place farther from the walls")

    def describe(self) -> str:
        """Return the settings as a line of text."""
        parts = [f"seed {self.seed}", "simulated time" if self.lockstep else "real time"]
        parts += [f"{self.lab.rate_hz:g} frames/s", f"positions over {self.over}"]
        unit = "datagrams" if self.over == "udp" else "messages"
        parts += [f"{100 * self.loss:g} % of the {unit} lost"] if self.loss else []
        parts += [f"{1000 * self.delay_s:g} ms of delay"] if self.delay_s else []
        parts += [f"camera {f.camera} fails at {f.start_s:g} s for {f.duration_s:g} s" for f in self.failures]
        return ", ".join(parts)

    def streams(self, ports: Ports) -> list[tuple[tuple[str, ...], StreamSettings]]:
        """Return the robots and the settings of each stream: with UDP, each robot gets its own positions."""
        robots = tuple(self.paths)
        if self.over == "vrpn":
            return [(robots, StreamSettings(vrpn=ports.server, robots=robots))]
        if self.over == "ros2":
            return [(robots, StreamSettings(ros2=ports.server, robots=robots))]
        return [
            ((robot,), StreamSettings(udp=(f"127.0.0.1:{port}",), robots=(robot,)))
            for robot, port in zip(robots, ports.relays or ports.positions, strict=True)
        ]

    def ports(self) -> Ports:
        """Return ports of loopback that are free now."""
        return find_ports(self.port, len(self.paths), self.over != "udp", self.has_relay)


def choose_paths(count: int, given: Sequence[str] = ()) -> dict[str, tuple[Waypoint, ...]]:
    """Return the paths of ``count`` robots, with those of the user: ``robot_0=0.5,0.5 0.5,2.5``.

    Examples
    --------
    >>> choose_paths(1, ["robot_0=1,1 2,1"])
    {'robot_0': (Waypoint(x_m=1.0, y_m=1.0), Waypoint(x_m=2.0, y_m=1.0))}
    """
    if not 1 <= count <= len(PATHS):
        raise IpsysError(f"--robots {count}: give 1 to {len(PATHS)}")
    paths = {f"robot_{number}": PATHS[number] for number in range(count)}
    for text in given:
        robot, _, places = text.partition("=")
        if robot not in paths:
            raise IpsysError(
                f"--path {text}: no robot {robot}; write ROBOT=X,Y X,Y ... with one of {', '.join(paths)}"
            )
        try:
            paths[robot] = tuple(_waypoint(place) for place in places.split())
        except ValueError as error:
            raise IpsysError(f'--path {text}: write ROBOT=X,Y X,Y in m, as "robot_0=0.5,0.5 2,1"') from error
        if len(paths[robot]) < 2:
            raise IpsysError(f"--path {text}: a path has at least two waypoints")
    return paths


def _waypoint(text: str) -> Waypoint:
    x_m, y_m = map(float, text.split(","))
    if not np.isfinite([x_m, y_m]).all():
        raise ValueError(text)
    return Waypoint(x_m, y_m)


def parse_failure(text: str) -> CameraFailure:
    """Return the failure of a camera: ``white=20:5`` fails at 20 s, for 5 s."""
    match = re.fullmatch(r"([a-z][a-z0-9_]*)=(\d+(?:\.\d+)?):(\d+(?:\.\d+)?)", text)
    if match is None:
        raise IpsysError(f"--fail {text}: write CAMERA=START:SECONDS, such as white=20:5")
    failure = CameraFailure(match[1], float(match[2]), float(match[3]))
    if failure.start_s < 1:
        raise IpsysError(f"--fail {text}: a camera must send for 1 s first; give a later start")
    return failure


def read_lab(log: LogLocation, lab: LabSettings) -> LabSettings:
    """Return the settings of the simulated lab of a calibrated log, with its image size."""
    with Session([log]) as session:
        lenses: dict[str, CameraCalibration] = {
            name: session.payloads([topic])[-1] for name, topic in session.calibrations.items()
        }
    if not lenses:
        raise IpsysError(
            f"--model-from {log}: has no camera intrinsics; give the log of the simulated lab, with its "
            "model in it: ipsys replay LOG, without -o"
        )
    first = next(iter(lenses.values()))
    lab = replace(lab, width=first.width, height=first.height)
    if all(
        camera.name in lenses
        and np.array_equal(lenses[camera.name].K, camera.lens.K)
        and np.array_equal(lenses[camera.name].D, camera.lens.D)
        for camera in mount_cameras(lab)
    ):
        return lab
    raise IpsysError(
        f"--model-from {log}: is not a log of the simulated lab with seed {lab.seed}; give the seed of its "
        f"'ipsys simulate' with --lab-seed, or make one: ipsys simulate -o cal.mcap "
        f"--seed {lab.seed}; ipsys replay cal.mcap"
    )


def start_poses(run: RobotRun) -> list[RobotStart]:
    """Return the robots at the start, around their first waypoints, and with their heads to the second."""
    starts = []
    for number, (robot, path) in enumerate(run.paths.items()):
        rng = random_stream(run.seed, Purpose.WHEELS, number, 1)
        first, second = next(pairwise(path))
        x_m, y_m = (
            np.array([first.x_m, first.y_m]) + _START_SIGMA_M * rng.standard_normal(2).clip(-2, 2)
        ).tolist()
        heading_rad = atan2(second.y_m - y_m, second.x_m - x_m)
        heading_rad += _START_SIGMA_RAD * float(rng.standard_normal())
        starts.append(RobotStart(robot, number, Pose2d(x_m, y_m, heading_rad)))
    return starts
