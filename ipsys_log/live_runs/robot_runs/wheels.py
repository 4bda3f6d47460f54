"""The simulated wheels of robots: they tick by their own clock, and get commands, as datagrams on loopback.

They belong to the simulator, and are no stream: streams take no commands. docs/robot-run.md lists the fields.
"""

import json
import select
import socket
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from math import isfinite
from typing import Any, NamedTuple

from ipsys_log.capture.frames import Clock
from ipsys_log.errors import IpsysError
from ipsys_log.messages import WheelCommand
from ipsys_log.plain_text import plain_text
from ipsys_log.units import NS_PER_S

LOOPBACK = "127.0.0.1"
# A slow machine needs long for a program. After the first time it is named; the second is an error.
_SAID_S, _LONGEST_S = 10.0, 600.0
_TURN_S = 0.1
_LONGEST_BYTES = 2048
_LONGEST_STATE = 32


class Answer(NamedTuple):
    """The command of a robot, and the number of the tick that it answers; None without a number."""

    command: WheelCommand
    tick: int | None


class _Patience:
    """The wait for the programs of some robots. Time in which this program is suspended does not count."""

    def __init__(self, clock: Clock, check: Callable[[], None], say: Callable[[str], None]) -> None:
        self._clock, self._check, self._say = clock, check, say
        self._waited_s, self._last_ns = 0.0, clock.now_ns()
        self._is_said = False

    def take_turn(self, robot: str, lacks: str) -> None:
        """Check the programs after a turn in which a robot did not send what it lacks.

        Raises
        ------
        IpsysError
            A program has ended, or the robot has sent nothing for a long time.
        """
        self._check()
        now_ns = self._clock.now_ns()
        self._waited_s += min((now_ns - self._last_ns) / NS_PER_S, 2 * _TURN_S)
        self._last_ns = now_ns
        if self._waited_s > _LONGEST_S:
            raise IpsysError(f"{robot}: its program has not sent {lacks} for {_LONGEST_S:g} s; correct it")
        if self._waited_s > _SAID_S and not self._is_said:
            self._is_said = True
            self._say(f"{robot}: waits until its program sends {lacks}; Ctrl-C to end")


class Wheels:
    """The wheels of all robots, behind one socket.

    Parameters
    ----------
    port : port on loopback.
    robots : names of the robots; a program of another robot is refused.
    check : called while waiting; raises if a program has ended.
    say : called with the name of a robot that is refused, or whose program is slow.

    Raises
    ------
    IpsysError
        The port is in use.
    """

    def __init__(
        self, port: int, robots: Collection[str], check: Callable[[], None], say: Callable[[str], None]
    ) -> None:
        self._robots, self._check, self._say = tuple(robots), check, say
        self._addresses: dict[str, tuple[str, int]] = {}
        self._clock = Clock()
        self._is_stopped = False
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((LOOPBACK, port))
        except OSError as error:
            self._socket.close()
            raise IpsysError(
                f"--port {port}: is in use, perhaps by another ipsys; end that program, or give another port"
            ) from error

    @property
    def address(self) -> str:
        """The address for the programs, ``HOST:PORT``."""
        host, port = self._socket.getsockname()
        return f"{host}:{port}"

    def close(self) -> None:
        """Close the socket; the programs end."""
        for address in self._addresses.values():
            self._send({"end": True}, address)
        self._socket.close()

    def stop(self) -> None:
        """End the wait for answers; a signal handler may call this."""
        self._is_stopped = True

    def wait_for_robots(self) -> None:
        """Wait until the program of each robot has sent its name."""
        patience = _Patience(self._clock, self._check, self._say)
        while missing := [name for name in self._robots if name not in self._addresses]:
            patience.take_turn(missing[0], f'{{"robot": "{missing[0]}"}} to {self.address}')
            list(self.receive(_TURN_S))

    def tick(self, number: int, time_s: float, positions: Mapping[str, int] | None = None) -> None:
        """Send a tick to all robots.

        Parameters
        ----------
        number, time_s : number of the tick, and the time since the start by the clock of the wheels.
        positions : by robot, the number of positions that were sent to it; then it waits for all of them.
        """
        for robot, address in self._addresses.items():
            fields: dict[str, Any] = {"tick": number, "time_s": round(time_s, 6)}
            if positions is not None:
                fields["positions"] = positions[robot]
            self._send(fields, address)

    def answers(self, number: int) -> list[WheelCommand]:
        """Wait for the answers of all robots to a tick; return them in the order of the robots.

        After :meth:`stop`, none are returned.
        """
        commands: dict[str, WheelCommand] = {}
        patience = _Patience(self._clock, self._check, self._say)
        while missing := [name for name in self._robots if name not in commands]:
            if self._is_stopped:
                return []
            for answer in self.receive(_TURN_S):
                if answer.tick == number:
                    commands[answer.command.robot] = answer.command
            # Only now: a program can end right after its answer.
            if missing[0] not in commands:
                patience.take_turn(missing[0], "a command")
        return [commands[robot] for robot in self._robots]

    def receive(self, wait_s: float) -> Iterator[Answer]:
        """Yield the commands that have arrived; wait at most ``wait_s`` for the first datagram."""
        while select.select([self._socket], [], [], wait_s)[0]:
            wait_s = 0.0
            try:
                datagram, address = self._socket.recvfrom(_LONGEST_BYTES)
                fields = json.loads(datagram)
                robot = fields["robot"]
            except (OSError, LookupError, RecursionError, TypeError, ValueError):
                continue  # foreign, or a program that has ended
            if robot not in self._robots:
                self._refuse(robot, address)
            elif "tick" not in fields:
                self._addresses.setdefault(robot, address)
            elif self._addresses.get(robot) == address and (answer := _read(robot, fields)) is not None:
                yield answer

    def _refuse(self, robot: object, address: tuple[str, int]) -> None:
        known = ", ".join(self._robots)
        text = f"no robot {plain_text(str(robot))}; the robots are {known}"
        self._say(f"a program asks for {text}")
        self._send({"end": True, "error": text}, address)

    def _send(self, fields: Mapping[str, Any], address: tuple[str, int]) -> None:
        try:
            self._socket.sendto(json.dumps(fields).encode(), address)
        except OSError:  # the program has ended; the check reports it
            return


def _read(robot: str, fields: Mapping[str, Any]) -> Answer | None:
    """Return the command in a datagram; None if it is not valid."""
    try:
        left_m_s, right_m_s = float(fields["left_m_s"]), float(fields["right_m_s"])
        command = WheelCommand(0, robot, left_m_s, right_m_s)
        if not (isfinite(left_m_s) and isfinite(right_m_s)):
            return None
        if "state" in fields:
            command = replace(command, state=plain_text(str(fields["state"]))[:_LONGEST_STATE])
        if "waypoint" in fields:
            command = replace(command, waypoint=int(fields["waypoint"]) & 0xFFFFFFFF)
        if "time_ns" in fields:
            x_m, y_m, time_ns = float(fields["x_m"]), float(fields["y_m"]), int(fields["time_ns"])
            if isfinite(x_m) and isfinite(y_m) and 0 <= time_ns < 2**63:
                command = replace(command, x_m=x_m, y_m=y_m, position_time=time_ns)
        return Answer(command, int(fields["tick"]))
    except (ArithmeticError, LookupError, TypeError, ValueError):
        return None
