"""Cameras of a robot run in either time: real, or simulated, which waits for the stages and all robots.

In simulated time, messages and their order do not depend on the speed of the machine: equal settings give
equal logs.
"""

import threading
from collections import Counter, deque
from collections.abc import Collection, Generator, Iterator
from contextlib import contextmanager, suppress
from types import NoneType

from ipsys_log.capture.frames import CameraState, Clock, Frame, Say, SourceError, sleep_until
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.capture.simulated import FrameTiming
from ipsys_log.capture.simulation.lab import EPOCH_NS
from ipsys_log.capture.simulation.robot_lab import RobotLab
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.robot_runs.settings import RobotRun
from ipsys_log.live_runs.robot_runs.steering import Steering
from ipsys_log.messages import (
    COMMANDS_TOPIC,
    EVENTS_TOPIC,
    TRUTH_TOPIC,
    CompressedImage,
    Event,
    Message,
    RigCamera,
    Tracks,
    WheelCommand,
    image_topic,
)
from ipsys_log.sinks.streams.poses import PoseSource
from ipsys_log.statistics.latency import PositionMonitor
from ipsys_log.units import NS_PER_S


class RobotCameras:
    """The cameras of a lab with robots; ``open`` is their :data:`~ipsys_log.capture.frames.Open`.

    A frame that cannot be drawn in time is skipped. A camera that fails is lost like a real camera, and sends
    again after the failure.

    From the start of the drive on, they add the ground truth of each instant to the recording.
    """

    def __init__(self, run: RobotRun, lab: RobotLab) -> None:
        self._recording: LiveCameras | None = None
        self._start_ns = 0
        self._run, self._lab = run, lab
        self._timing = FrameTiming.of(run.lab, None)
        self._lock, self._newest = threading.Lock(), 0

    def begin(self, recording: LiveCameras, start_ns: int) -> None:
        """Begin the drive."""
        self._recording, self._start_ns = recording, start_ns

    @contextmanager
    def open(self, camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:  # noqa: ARG002
        yield self._frames(camera.name, clock)

    def _frames(self, name: str, clock: Clock) -> Iterator[Frame | None]:
        number, timing, frame = self._run.lab.cameras.index(name), self._timing, 0
        was_lost = self._fails(name, clock.now_ns())
        while True:
            frame = max(frame + 1, timing.frame_at(clock.now_ns()))
            time_ns = round(frame * timing.period_ns)
            yield from sleep_until(time_ns + timing.behind_ns, clock)
            if self._fails(name, time_ns):
                if not was_lost:
                    raise SourceError(f"camera {name}: simulated failure")
                yield None
                continue
            was_lost = False
            self._note(frame, time_ns, clock.now_ns())
            yield Frame(self._lab.draw(number, frame, time_ns), "jpeg", time_ns)

    def _fails(self, name: str, time_ns: int) -> bool:
        if self._recording is None:
            return False
        time_s = (time_ns - self._start_ns) / NS_PER_S
        return any(failure.camera == name and failure.includes(time_s) for failure in self._run.failures)

    def _note(self, frame: int, time_ns: int, now_ns: int) -> None:
        """Move the robots; the first camera with a frame of an instant adds the ground truth."""
        self._lab.advance(now_ns)
        with self._lock:
            is_new = frame > self._newest
            self._newest = max(frame, self._newest)
        if is_new and self._recording is not None:
            with suppress(SourceError):  # the recording has ended
                self._recording.add(TRUTH_TOPIC, self._lab.truth_at(time_ns))


class Driver:
    """The thread that sends ticks to the robots in real time, and writes their commands. A context manager.

    ``fault`` is the error that ended the run, such as a program that has ended.
    """

    def __init__(self, run: RobotRun, cameras: LiveCameras, steering: Steering) -> None:
        self.fault: IpsysError | None = None
        self._run, self._cameras, self._steering = run, cameras, steering
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._drive, name="driver", daemon=True)

    def __enter__(self) -> "Driver":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _drive(self) -> None:
        now_ns = self._cameras.clock.now_ns
        try:
            while not (self._ended.is_set() or self._is_over()):
                left_s = (self._steering.next_ns - now_ns()) / NS_PER_S
                for command in self._steering.receive(max(left_s, 0.0), now_ns):
                    self._add(command)
                if now_ns() >= self._steering.next_ns:
                    self._steering.tick()
        except IpsysError as fault:
            self.fault = fault
        finally:
            self._cameras.stop()

    def _is_over(self) -> bool:
        time_s = self._steering.time_s(self._cameras.clock.now_ns())
        return self._steering.is_finished() or time_s > self._run.longest_s

    def _add(self, command: WheelCommand) -> None:
        with suppress(SourceError):  # the recording has ended
            self._cameras.add(COMMANDS_TOPIC, command)


_TURN_S = 0.5


class SimulatedClock(Clock):
    """A clock that stands until its time is set."""

    def __init__(self) -> None:
        super().__init__()
        self.time_ns = EPOCH_NS

    def now_ns(self) -> int:
        return self.time_ns


class SyncPoint:
    """An inline sink that knows when the stages have processed a frame, and how many positions were sent.

    Parameters
    ----------
    topic : topic of the tracks that the stream sends.
    robots : names of the robots.
    good_only : the stream withholds stale and extrapolated positions.

    Attributes
    ----------
    sent : number of positions of each robot that the stream has sent.
    """

    name = "the simulated time"
    payloads: tuple[type, ...] = (NoneType, CompressedImage, Tracks)

    def __init__(self, topic: str, robots: Collection[str], clock: Clock, good_only: bool) -> None:
        self.sent: Counter[str] = Counter()
        self._poses = PoseSource([topic], clock.now_ns, 1, robots)
        self._good_only = good_only
        self._shown = self._done = 0
        self._stopped = False
        self._changed = threading.Condition()

    def send(self, message: Message) -> None:
        """Count the frames and positions of a message; with a tick, all work on the frames is done."""
        if message.payload is None:
            with self._changed:
                self._done = self._shown
                self._changed.notify()
            return
        self._shown += isinstance(message.payload, CompressedImage)
        for pose in self._poses.read(message):
            # VRPN and ROS 2 have no poses without a heading.
            if not self._good_only or pose.is_sendable:
                self.sent[pose.track.robot] += 1

    def wait_for(self, frames: int) -> None:
        """Wait until this number of frames has been processed, or until :meth:`stop`."""
        with self._changed:
            while self._done < frames and not self._stopped:
                self._changed.wait(_TURN_S)

    def stop(self) -> None:
        """End all waiting."""
        with self._changed:
            self._stopped = True
            self._changed.notify()


class LockstepCameras:
    """The cameras of a :class:`~ipsys_log.capture.simulation.robot_lab.RobotLab` as one source of messages.

    Parameters
    ----------
    sync : sink of the run, which knows the processed frames.
    say : called with the text of each event.

    Attributes
    ----------
    steering : set before the iteration.
    states : states of the cameras, by name.
    received_ns : arrival times of the frames, by log time.
    positions : the state of the positions.
    fault : the error of a robot that ended the run.
    """

    def __init__(
        self, run: RobotRun, lab: RobotLab, clock: SimulatedClock, sync: SyncPoint, say: Say
    ) -> None:
        self.clock, self.say = clock, say
        self.states = {name: CameraState(format="jpeg", up=True) for name in run.lab.cameras}
        self.received_ns: dict[int, int] = {}
        self.positions = PositionMonitor(clock.now_ns, self.states, say)
        self.steering: Steering
        self.fault: IpsysError | None = None
        self._run, self._lab, self._sync, self._clock = run, lab, sync, clock
        self._events: deque[Event] = deque()
        self._lost_ns: dict[str, int] = {}
        self._last_ns = 0
        self._ending = False

    def stop(self, reason: str | None = None) -> None:  # noqa: ARG002
        """End the iteration."""
        self._ending = True
        self._sync.stop()
        self.steering.stop()

    def confirm(self, message: Message, fault: OSError | None) -> None:
        """Do nothing: nobody waits for the disk."""

    def add_event(self, kind: str, text: str, camera: str | None = None) -> None:
        """Add an event, of a camera if there is one, to the messages, and show its text."""
        self._events.append(Event(self.clock.now_ns(), kind, text, camera))
        self.say(text)

    def now_ns(self) -> int:
        """Return a log time that is later than all earlier log times."""
        self._last_ns = max(self.clock.now_ns(), self._last_ns + 1)
        return self._last_ns

    def __iter__(self) -> Generator[Message | None, None, None]:
        """Yield the frames, commands and events in the order of simulated time."""
        timing = FrameTiming.of(self._run.lab, None)
        frame, frames = timing.frame_at(self.clock.now_ns()), 0
        while not self._ending:
            frame += 1
            time_ns = round(frame * timing.period_ns)
            yield from self._ticks_until(time_ns + timing.behind_ns)
            if self._ending or self._is_over(time_ns):
                return
            self._clock.time_ns = time_ns + timing.behind_ns
            self._lab.advance(self._clock.time_ns)
            yield self._message(TRUTH_TOPIC, self._lab.truth_at(time_ns), time_ns)
            for number, name in enumerate(self._run.lab.cameras):
                yield from self._camera_events(name, time_ns)
                if name not in self._lost_ns:
                    frames += 1
                    yield self._frame(number, frame, time_ns)
                    self._sync.wait_for(frames)

    def _ticks_until(self, time_ns: int) -> Iterator[Message]:
        while self.steering.next_ns <= time_ns and not self._ending:
            self._clock.time_ns = self.steering.next_ns
            for command in self._commands():
                yield self._message(COMMANDS_TOPIC, command, command.timestamp)
            while self._events:
                event = self._events.popleft()
                yield self._message(EVENTS_TOPIC, event, event.timestamp)

    def _commands(self) -> list[WheelCommand]:
        """Return the commands of the next tick; end the run if a robot has a fault."""
        try:
            return self.steering.tick_and_wait(self._sync.sent)
        except IpsysError as fault:  # the log is complete up to here
            self.fault, self._ending = fault, True
            return []

    def _is_over(self, time_ns: int) -> bool:
        return self.steering.is_finished() or self.steering.time_s(time_ns) > self._run.longest_s

    def _camera_events(self, name: str, time_ns: int) -> Iterator[Message]:
        """Yield an event if a camera fails now, or is back; the texts are those of real cameras."""
        time_s = self.steering.time_s(time_ns)
        fails = any(f.camera == name and f.includes(time_s) for f in self._run.failures)
        state = self.states[name]
        if fails and name not in self._lost_ns:
            self._lost_ns[name], state.up = time_ns, False
            yield self._camera_event(
                "camera_lost", f"camera {name}: simulated failure; ipsys tries again", name
            )
        elif not fails and name in self._lost_ns:
            gone_s = (time_ns - self._lost_ns.pop(name)) / NS_PER_S
            state.up = True
            yield self._camera_event("camera_back", f"camera {name} is back after {gone_s:.1f} s", name)

    def _camera_event(self, kind: str, text: str, camera: str) -> Message:
        event = Event(self.clock.now_ns(), kind, text, camera)
        self.say(text)
        return self._message(EVENTS_TOPIC, event, event.timestamp)

    def _frame(self, number: int, frame: int, time_ns: int) -> Message:
        name = self._run.lab.cameras[number]
        data, state = self._lab.draw(number, frame, time_ns), self.states[name]
        state.frames, state.bytes = state.frames + 1, state.bytes + len(data)
        state.size_px = self._run.lab.width, self._run.lab.height
        image = CompressedImage(time_ns, name, data, "jpeg")
        message = self._message(image_topic(name), image, time_ns, name)
        self.received_ns[message.log_time_ns] = self.clock.now_ns()
        return message

    def _message(self, topic: str, payload: object, time_ns: int, camera: str | None = None) -> Message:
        return Message(topic, self.now_ns(), time_ns, payload, camera)
