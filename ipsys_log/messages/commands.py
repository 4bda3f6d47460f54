"""Payloads of a robot run: the waypoints of each robot, and the commands to its wheels."""

from __future__ import annotations

from dataclasses import dataclass

from ipsys_log.messages.message import TimeNs

# The states of a controller: it stands at a waypoint while it is holding, and after the last one when it is
# finished. It is stopped while it gets no positions.
DRIVING, HOLDING, STOPPED, FINISHED = "driving", "holding", "stopped", "finished"


@dataclass(frozen=True, slots=True)
class Waypoint:
    x_m: float
    y_m: float


@dataclass(frozen=True, slots=True)
class RobotPath:
    """The waypoints of a robot, in the order of the drive."""

    timestamp: TimeNs
    robot: str
    waypoints: tuple[Waypoint, ...]


@dataclass(frozen=True, slots=True)
class WheelCommand:
    """The command of a controller to the wheels of its robot, at the time when the wheels got it.

    The speeds are those of the wheels on the floor. ``waypoint`` is the number of the waypoint that the robot
    drives to or stands at, from 1. ``x_m``, ``y_m`` and ``position_time`` are the received position that the
    command follows from, and its capture time.
    """

    timestamp: TimeNs
    robot: str
    left_m_s: float
    right_m_s: float
    state: str | None = None
    waypoint: int | None = None
    x_m: float | None = None
    y_m: float | None = None
    position_time: TimeNs | None = None
