"""Cameras of the robots' lab in real time: each image is drawn when its frame is due."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from ipsys_log.capture.frames import Clock, Frame, Open, Say, SourceError
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.capture.simulated import FrameTiming
from ipsys_log.capture.simulation.robot_lab import RobotLab
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.robot_runs.settings import RobotRun
from ipsys_log.live_runs.robot_runs.steering import Steering
from ipsys_log.messages import COMMANDS_TOPIC, TRUTH_TOPIC, RigCamera, WheelCommand
from ipsys_log.units import NS_PER_S

_TURN_S = 0.4


class RobotCameras:
    """The cameras of a lab with robots; ``open`` is their :data:`~ipsys_log.capture.frames.Open`.

    A frame that cannot be drawn in time is skipped. A camera that fails is lost like a real camera, and sends
    again after the failure.

    Attributes
    ----------
    add_truth : set by the owner; called with the ground truth of each instant.
    start_ns : the start of the drive; None before it.
    """

    def __init__(self, run: RobotRun, lab: RobotLab) -> None:
        self.add_truth: Callable[[int], None] = lambda time_ns: None
        self.start_ns: int | None = None
        self._run, self._lab = run, lab
        self._timing = FrameTiming.of(run.lab, None)
        self._lock, self._newest = threading.Lock(), 0

    @property
    def open(self) -> Open:
        """The function that opens a camera."""
        return self._open

    @contextmanager
    def _open(self, camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:  # noqa: ARG002
        yield self._frames(camera.name, clock)

    def _frames(self, name: str, clock: Clock) -> Iterator[Frame | None]:
        number, timing, frame = self._run.lab.cameras.index(name), self._timing, 0
        was_lost = self._fails(name, clock.now_ns())
        while True:
            frame = max(frame + 1, timing.frame_at(clock.now_ns()))
            time_ns = round(frame * timing.period_ns)
            while (left_s := (time_ns + timing.behind_ns - clock.now_ns()) / NS_PER_S) > 0:
                time.sleep(min(left_s, _TURN_S))
                if left_s > _TURN_S:
                    yield None
            if self._fails(name, time_ns):
                if not was_lost:
                    raise SourceError(f"camera {name}: simulated failure")
                yield None
                continue
            was_lost = False
            self._note(frame, time_ns, clock.now_ns())
            yield Frame(self._lab.draw(number, frame, time_ns), "jpeg", time_ns)

    def _fails(self, name: str, time_ns: int) -> bool:
        if self.start_ns is None:
            return False
        time_s = (time_ns - self.start_ns) / NS_PER_S
        return any(failure.camera == name and failure.includes(time_s) for failure in self._run.failures)

    def _note(self, frame: int, time_ns: int, now_ns: int) -> None:
        """Move the robots; the first camera with a frame of an instant adds the ground truth."""
        self._lab.advance(now_ns)
        with self._lock:
            is_new = frame > self._newest
            self._newest = max(frame, self._newest)
        if is_new:
            self.add_truth(time_ns)


class Driver:
    """The thread that sends ticks to the robots in real time, and writes their commands. A context manager.

    Attributes
    ----------
    fault : the error that ended the run, such as a program that has ended.
    """

    def __init__(self, run: RobotRun, cameras: LiveCameras, steering: Steering) -> None:
        self.fault: IpsysError | None = None
        self._run, self._cameras, self._steering = run, cameras, steering
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._drive, name="driver", daemon=True)

    def __enter__(self) -> Driver:
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


def add_truth(cameras: LiveCameras, lab: RobotLab) -> Callable[[int], None]:
    """Return a function that adds the ground truth of an instant to the messages of cameras."""

    def add(time_ns: int) -> None:
        with suppress(SourceError):
            cameras.add(TRUTH_TOPIC, lab.truth_at(time_ns))

    return add
