"""Control of robots: their programs and relays, one process each, and the exchange with them at each tick."""

import json
import os
import select
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from ipsys_log.capture.simulation.robot_lab import RobotLab
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.robot_runs.settings import Ports, RobotRun
from ipsys_log.live_runs.robot_runs.wheels import Wheels
from ipsys_log.messages import FINISHED, HOLDING, STOPPED, Waypoint, WheelCommand
from ipsys_log.units import NS_PER_S

_END_S = 5.0
# A relay does little work: ten minutes are enough on any machine.
_TURN_S, _RELAY_TURNS = 0.1, 6000
_LOOPBACK = "127.0.0.1"


class Programs(NamedTuple):
    """The running programs of the robots."""

    path: Path
    processes: Mapping[str, subprocess.Popen[bytes]]
    relays: "Mapping[str, RelayLink]"

    def check(self) -> None:
        """Check that all programs still run."""
        for robot, process in self.processes.items():
            if process.poll() is not None:
                raise IpsysError(
                    f"{robot}: its program {self.path} has ended with exit code {process.returncode}; its "
                    "messages are above"
                )


class RelayLink:
    """The connection to a relay with the clock of the simulator."""

    def __init__(self, port: int, process: subprocess.Popen[bytes]) -> None:
        self._address, self._process = (_LOOPBACK, port), process
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((_LOOPBACK, 0))

    def close(self) -> None:
        self._socket.close()

    def tick(self, number: int, time_ns: int, positions: int) -> int:
        """Send the time, and the number of positions so far; return the number that the relay has sent on."""
        fields = {"relay_tick": number, "time_ns": time_ns, "positions": positions}
        self._socket.sendto(json.dumps(fields).encode(), self._address)
        # In turns: time in which this program is suspended does not count.
        for _ in range(_RELAY_TURNS):
            if self._process.poll() is not None:
                break
            if select.select([self._socket], [], [], _TURN_S)[0]:
                answer = json.loads(self._socket.recv(2048))
                if answer["relay_tick"] == number:
                    return int(answer["forwarded"])
        raise IpsysError("the relay of the datagrams does not answer; start the run again")


@contextmanager
def start_programs(run: RobotRun, wheels: str, ports: Ports) -> Iterator[Programs]:
    """Start a program for each robot, and a relay if the run has one; they end after the block."""
    with ExitStack() as stack:
        relays: dict[str, RelayLink] = {}
        processes: dict[str, subprocess.Popen[bytes]] = {}
        for number, (robot, path) in enumerate(run.paths.items()):
            if run.has_relay:
                relays[robot] = _start_relay(run, robot, number, ports, stack)
            address = f"{run.over}://{_LOOPBACK}:{ports.positions[number]}"
            processes[robot] = _start(_command(run.program, robot, address, wheels, path), stack)
        yield Programs(run.program, processes, relays)


def _command(
    program: Path, robot: str, positions: str, wheels: str, path: Sequence[Waypoint]
) -> Sequence[str]:
    runs = [sys.executable, str(program)] if program.suffix == ".py" else [str(program.absolute())]
    places = " ".join(f"{place.x_m:g},{place.y_m:g}" for place in path)
    return [*runs, "--robot", robot, "--positions", positions, "--wheels", wheels, "--path", places]


def _start_relay(run: RobotRun, robot: str, number: int, ports: Ports, stack: ExitStack) -> RelayLink:
    port, target = ports.relays[number], ports.positions[number]
    command = [
        sys.executable,
        "-m",
        "ipsys_log.live_runs.robot_runs.relay",
        "--port",
        str(port),
        "--to",
        str(target),
    ]
    command += ["--loss", str(run.loss), "--delay-s", str(run.delay_s)]
    command += ["--seed", str(run.seed + 1000 * number)]
    if run.over == "ros2":
        command += ["--ros2", str(ports.server), "--robot", robot]
    process = _start([*command, *["--lockstep"] * run.lockstep], stack, subprocess.PIPE)
    assert process.stdout is not None
    stack.callback(process.stdout.close)
    if process.stdout.readline().strip() != b"ready":
        raise IpsysError(f"--port {run.port}: the relay cannot use port {port}; give another port")
    link = RelayLink(port, process)
    stack.callback(link.close)
    return link


def _start(command: Sequence[str], stack: ExitStack, output: int | None = None) -> subprocess.Popen[bytes]:
    try:
        # Python shows its prints at once.
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", "OPENBLAS_NUM_THREADS": "1"}
        # A group of its own: Ctrl-C in the terminal ends the simulator, and this ends its programs.
        process = subprocess.Popen(command, stdout=output, process_group=0, env=environment)
    except OSError as error:
        raise IpsysError(f"{command[0]}: cannot be started: {error.strerror}; make it executable") from error
    stack.callback(_end, process)
    return process


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


class Steering:
    """The commands of the robots, in real time or in lockstep.

    Parameters
    ----------
    start_ns : the time of the first tick.
    say : called with a line if a robot stops, goes on, or reaches a waypoint.

    Attributes
    ----------
    next_ns : the time of the next tick.
    """

    def __init__(
        self,
        run: RobotRun,
        lab: RobotLab,
        wheels: Wheels,
        programs: Programs,
        start_ns: int,
        say: Callable[[str], None],
    ) -> None:
        self._run, self._lab, self._wheels, self._programs, self._say = run, lab, wheels, programs, say
        self._start_ns, self._number = start_ns, 0
        self._period_ns = round(NS_PER_S / run.tick_hz)
        self._states: dict[str, tuple[str | None, int | None]] = {}
        self._begun: set[str] = set()

    @property
    def next_ns(self) -> int:
        return self._start_ns + (self._number + 1) * self._period_ns

    def time_s(self, time_ns: int) -> float:
        """Return a time in s since the start."""
        return (time_ns - self._start_ns) / NS_PER_S

    def is_finished(self) -> bool:
        """Return whether all robots stand at their last waypoints."""
        return all(self._states.get(robot, ("", 0))[0] == FINISHED for robot in self._run.paths)

    def stop(self) -> None:
        """End the wait for the commands of a tick."""
        self._wheels.stop()

    def tick(self) -> None:
        """Send the next tick to all robots; their commands come later."""
        self._number += 1
        self._wheels.tick(self._number, self._number / self._run.tick_hz)
        self._programs.check()

    def receive(self, wait_s: float, now_ns: Callable[[], int]) -> list[WheelCommand]:
        """Carry out the commands that arrive; wait at most ``wait_s`` for them."""
        return [self._carry_out(answer.command, now_ns()) for answer in self._wheels.receive(wait_s)]

    def tick_and_wait(self, sent: Counter[str]) -> list[WheelCommand]:
        """Send the next tick, wait for the commands of all robots, and carry them out.

        ``sent`` has, by robot, the number of positions that were sent so far.
        """
        time_ns = self.next_ns
        self._number += 1
        arriving = dict(sent)
        for robot, relay in self._programs.relays.items():
            arriving[robot] = relay.tick(self._number, time_ns, sent[robot])
        positions = {robot: arriving.get(robot, 0) for robot in self._run.paths}
        self._wheels.tick(self._number, self._number / self._run.tick_hz, positions)
        return [self._carry_out(command, time_ns) for command in self._wheels.answers(self._number)]

    def _carry_out(self, command: WheelCommand, time_ns: int) -> WheelCommand:
        self._lab.advance(time_ns)
        self._lab.command(command.robot, command.left_m_s, command.right_m_s)
        self._report(command, time_ns)
        return replace(command, timestamp=time_ns)

    def _report(self, command: WheelCommand, time_ns: int) -> None:
        robot, state = command.robot, (command.state, command.waypoint)
        before = self._states.get(robot)
        self._states[robot] = state
        if before == state:
            return
        at = f"{self.time_s(time_ns):5.1f} s  {robot}"
        if command.state == STOPPED:
            # Before its first position, a robot is stopped too.
            if robot in self._begun:
                self._say(f"{at}: stopped, it gets no positions")
            return
        if before is not None and before[0] == STOPPED and robot in self._begun:
            self._say(f"{at}: goes on")
        self._begun.add(robot)
        if command.state == HOLDING:
            self._say(f"{at}: at waypoint {command.waypoint}")
        elif command.state == FINISHED:
            self._say(f"{at}: finished")
