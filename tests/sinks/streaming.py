"""Logs with tracks for tests of streams, and a clock that advances only while a playback waits."""

import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ipsys_log.capture.frames import Clock
from ipsys_log.engine.output import write_log
from ipsys_log.messages import Message, Rig, RigBody, RigMarker, Run, Track, Tracks
from ipsys_log.sinks.sink import InlineSink
from ipsys_log.statistics.latency import PositionState
from ipsys_log.units import NS_PER_S

START_NS = 1_700_000_000 * NS_PER_S
STEP_NS = NS_PER_S // 25
TOPIC = "/runs/poly/tracks"
TILT_RAD = np.array([0.5, -0.3, 2.0])
RIG = Rig("lab", "DICT_4X4_100", 0.2, (RigMarker(0, robot="ada"), RigMarker(1, robot="bob")))


def track(robot: str, x_m: float, heading_rad: float | None = 0.0, inside: bool | None = True) -> Track:
    number = {"ada": 0, "bob": 1}[robot]
    return Track(robot, number, x_m, 2.0, 0.1, heading_rad, np.eye(3) * 1e-4, ("red",), inside)


def moving_track(robot: str, heading_rad: float) -> Track:
    """Return a track with a velocity along x, and different uncertainties in all axes."""
    return replace(
        track(robot, 1.0, heading_rad),
        velocity_m_s=np.array([0.5, 0.0, 0.0]),
        velocity_covariance_m2_s2=np.diag([1e-4, 4e-4, 9e-4]),
        heading_sigma_rad=0.02,
        turn_rate_rad_s=0.1,
        turn_rate_sigma_rad_s=0.03,
    )


def tilted_track(robot: str) -> Track:
    """Return the track of a body that is not level, with correlated uncertainties."""
    errors = np.random.default_rng(5).normal(size=(6, 6)) * 0.01
    pose = errors @ errors.T
    x_m, y_m, _ = Rotation.from_rotvec(TILT_RAD).apply([1.0, 0.0, 0.0])
    return replace(
        moving_track(robot, float(np.arctan2(y_m, x_m))),
        covariance_m2=pose[:3, :3],
        velocity_m_s=np.array([0.5, -0.2, 0.3]),
        rotation_rad=TILT_RAD,
        pose_covariance=pose,
        angular_velocity_rad_s=np.array([0.3, -0.4, 0.1]),
        angular_velocity_covariance_rad2_s2=2 * pose[3:, 3:],
    )


def judged(state: str) -> Any:
    """A monitor whose positions have this state, of 0.4 s."""
    return SimpleNamespace(state=PositionState(state, 0.4, "The cause", "The remedy"))


def tracks(number: int, *rows: Track, late_ns: int = 30_000_000) -> Message:
    """Return the tracks of one instant; ada moves with 0.25 m/s."""
    time_ns = START_NS + number * STEP_NS
    rows = rows or (track("ada", 1 + 0.01 * number), track("bob", 3.0))
    return Message(TOPIC, time_ns + late_ns, time_ns, Tracks(time_ns, rows))


def write_tracks(path: Path, count: int = 50, first: int = 0, rig: Rig = RIG) -> Path:
    """Write a log with tracks at 25 Hz."""

    def messages() -> Iterator[Message]:
        yield Message("/rig", START_NS, START_NS, rig)
        yield from (tracks(first + number) for number in range(count))

    write_log(path, messages())
    return path


def write_tilted(path: Path, is_level: bool = False) -> Path:
    """Write a log with the tracks of ada, which can tilt, and of bob, which is level."""
    bodies = (RigBody("ada", level=is_level),)
    messages = [tracks(number, tilted_track("ada"), track("bob", 3.0, 0.4)) for number in range(2)]
    rig = Message("/rig", START_NS, START_NS, replace(RIG, bodies=bodies))
    end_ns = messages[-1].log_time_ns
    record = Message("/runs/poly/record", end_ns, end_ns, Run(end_ns, "poly", "fuse", number=1))
    write_log(path, [rig, *messages, record])
    return path


def send_all(stream: InlineSink, messages: Iterable[Message]) -> None:
    for message in messages:
        stream.send(message)


def in_order(recorded: Sequence[Tracks]) -> list[Track]:
    """Return the poses that are not older than an earlier one of their robot: streams send no others."""
    newest_ns: dict[str, int] = {}
    poses = []
    for row in recorded:
        for one in row.tracks:
            if row.timestamp >= newest_ns.get(one.robot, 0):
                newest_ns[one.robot] = row.timestamp
                poses.append(one)
    return poses


class WaitingClock(Clock):
    """A clock that advances only by waiting, without delay: each message has its exact time."""

    def __init__(self) -> None:
        super().__init__()
        self.time_ns = 5_000 * NS_PER_S
        self.waits = 0

    def now_ns(self) -> int:
        return self.time_ns

    def wait(self, _: threading.Condition, seconds: float | None) -> None:
        self.waits += 1
        self.time_ns += round((seconds or 0.0) * NS_PER_S)
