"""The exchange with the robots at each tick: positions, the relay, commands, and the motion of the robots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from ipsys_log.capture.simulation.robot_lab import RobotLab
from ipsys_log.live_runs.robot_runs.programs import Programs
from ipsys_log.live_runs.robot_runs.settings import RobotRun
from ipsys_log.live_runs.robot_runs.wheels import Wheels
from ipsys_log.messages import FINISHED, HOLDING, STOPPED, WheelCommand
from ipsys_log.units import NS_PER_S


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

        Parameters
        ----------
        sent : by robot, the number of positions that were sent so far.
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
