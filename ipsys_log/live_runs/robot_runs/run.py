"""A robot run: the paper's experiment with a mobile robot (sect. 4.3), in the simulated lab."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from ipsys_log.capture.frames import Clock
from ipsys_log.capture.lab import Lab, first_messages, open_lab
from ipsys_log.capture.live_plan import check_start, shown_run
from ipsys_log.capture.recorder import CameraSource
from ipsys_log.capture.simulation.robot_lab import RobotLab, robot_rig
from ipsys_log.engine.provenance import Outcome
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.live_runs.robot_runs import robot_cameras
from ipsys_log.live_runs.robot_runs.settings import RobotRun, start_poses
from ipsys_log.live_runs.robot_runs.steering import Programs, Steering, start_programs
from ipsys_log.live_runs.robot_runs.wheels import Wheels
from ipsys_log.messages import EVENTS_TOPIC, PATHS_TOPIC, CameraCalibration, Event, Message, Rig, RobotPath
from ipsys_log.messages.channels import TRACKS
from ipsys_log.sinks.sink import Sink
from ipsys_log.sinks.streams.opening import Stream, open_streams
from ipsys_log.sinks.streams.poses import StreamContext, first_session

# The kind of the event with the settings of the run.
ROBOT_RUN = "robot_run"
Say = Callable[[str], None]


def drive_robots(
    run: RobotRun,
    target: Path,
    request: Request,
    overwrite: bool = False,
    say: Say = lambda text: None,
    begin: Callable[[Callable[[], None]], None] = lambda stop: None,
) -> list[Outcome]:
    """Let robots drive through their waypoints in the simulated lab; write everything into one log.

    Images are drawn, encoded, recorded and processed as by `live` in ``pipeline.py``. The tracks of the first
    model go through a stream to the programs of the robots, and their commands to the wheels.

    Parameters
    ----------
    run : settings of the run.
    target : the log to write.
    request : models, and the log that they come from.
    overwrite : replace an existing log.
    say : called with lines about the robots and cameras.
    begin : called before the drive with a function that ends it in order.

    Raises
    ------
    IpsysError
        A setting is impossible, a port is in use, or the program of a robot has ended.
    """
    run.check()
    parts = _Parts(run, target, request, overwrite, say, begin)
    parts.check_start()
    say(f"{', '.join(run.paths)}: {run.describe()}")
    return _drive_lockstep(parts) if run.lockstep else _drive_live(parts)


@dataclass(frozen=True, slots=True)
class _Parts:
    """The arguments of a run, and the parts that both clocks share."""

    run: RobotRun
    target: Path
    request: Request
    overwrite: bool
    say: Say
    begin: Callable[[Callable[[], None]], None]

    @property
    def rig(self) -> Rig:
        return robot_rig(self.run.lab)

    @property
    def topic(self) -> str:
        """The topic of the tracks that the robots get: those of the first model."""
        return TRACKS.topic_of(shown_run(self.request))

    def check_start(self) -> None:
        lenses = _lenses(self.lab(0))
        for line in check_start(self.rig, [*lenses], lenses, self.request, None):
            self.say(line)

    def lab(self, start_ns: int) -> RobotLab:
        labels = [place for path in self.run.paths.values() for place in path]
        return RobotLab(self.run.lab, start_poses(self.run), labels, start_ns, self.run.seed)

    def settings(self, now_ns: Callable[[], int]) -> list[Message]:
        """Return the messages after the rig and the intrinsics: the paths, and the settings of the run."""
        messages = []
        for robot, path in self.run.paths.items():
            time_ns = now_ns()
            messages.append(Message(PATHS_TOPIC, time_ns, time_ns, RobotPath(time_ns, robot, path)))
        time_ns = now_ns()
        event = Event(time_ns, ROBOT_RUN, self.run.describe())
        return [*messages, Message(EVENTS_TOPIC, time_ns, time_ns, event)]

    @contextmanager
    def connect(self, cameras: CameraSource) -> Iterator[tuple[Sequence[Stream], Wheels, Programs]]:
        """Open the streams and the wheels, start the programs, and wait until they are connected."""
        run, ports = self.run, self.run.ports()
        with ExitStack() as stack:
            streams: list[Stream] = []
            for robots, settings in run.streams(ports):
                heights_m = {robot: self.rig.robot_heights_m().get(robot) for robot in robots}
                now_ns, warn = cameras.clock.now_ns, cameras.add_event
                session = first_session(now_ns())
                context = StreamContext(settings, [self.topic], now_ns, warn, session, heights_m)
                streams += stack.enter_context(open_streams(context))
            programs: list[Programs] = []

            def check() -> None:
                for started in programs:
                    started.check()

            wheels = Wheels(ports.wheels, run.paths, check, self.say)
            stack.enter_context(closing(wheels))
            programs.append(stack.enter_context(start_programs(run, wheels.address, ports)))
            wheels.wait_for_robots()
            yield streams, wheels, programs[0]

    def live(self, cameras: CameraSource, first: Sequence[Message], sinks: Sequence[Sink]) -> list[Outcome]:
        settings = [*first, *self.settings(cameras.now_ns)]
        self.begin(cameras.stop)
        return pipeline.live(cameras, settings, self.target, self.request, None, sinks, self.overwrite)


def _lenses(lab: RobotLab) -> dict[str, CameraCalibration]:
    return {camera.name: camera.lens for camera in lab.cameras}


def _drive_lockstep(parts: _Parts) -> list[Outcome]:
    """Drive in simulated time."""
    clock = robot_cameras.SimulatedClock()
    lab = parts.lab(clock.now_ns())
    sync = robot_cameras.SyncPoint(parts.topic, tuple(parts.run.paths), clock, parts.run.sends_good_only)
    cameras = robot_cameras.LockstepCameras(parts.run, lab, clock, sync, parts.say)
    with parts.connect(cameras) as (streams, wheels, programs):
        cameras.steering = Steering(parts.run, lab, wheels, programs, clock.now_ns(), parts.say)
        first = first_messages(parts.rig, _lenses(lab), cameras.now_ns)
        outcomes = parts.live(cameras, first, [*streams, sync])
        if cameras.fault is not None:
            raise cameras.fault
        return outcomes


def _drive_live(parts: _Parts) -> list[Outcome]:
    """Drive in real time."""
    clock = Clock()
    lab = parts.lab(clock.now_ns())
    opener = robot_cameras.RobotCameras(parts.run, lab)
    with (
        open_lab(Lab(parts.rig, parts.rig.cameras, _lenses(lab)), parts.say, clock, opener.open) as opened,
        parts.connect(opened.cameras) as (streams, wheels, programs),
    ):
        cameras = opened.cameras
        start_ns = clock.now_ns()
        opener.begin(cameras, start_ns)
        steering = Steering(parts.run, lab, wheels, programs, start_ns, parts.say)
        with robot_cameras.Driver(parts.run, cameras, steering) as driver:
            outcomes = parts.live(cameras, opened.settings, streams)
        if driver.fault is not None:
            raise driver.fault
        return outcomes
