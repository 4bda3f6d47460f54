"""Races: contenders in separate processes take turns at the same work, round after round.

The time of any work on one machine changes with its load. So only ratios within one run are useful: A B C
A B C, and the ratio of each round. The contender's process takes the time, as wall time and as processor
time; processor time does not count while other programs have the core.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

__all__ = ["Contender", "Row", "Timing", "Turn", "race", "ratio_row"]

# The work of one turn, by its number; the result of the first round is kept.
Turn = Callable[[int], Any]

_STOP = -1


@dataclass(frozen=True, slots=True)
class Contender:
    """A contender of a race; ``make(*arguments)`` is called in a new process for every round, untimed."""

    name: str
    make: Callable[..., Turn]
    arguments: tuple[Any, ...] = ()


@dataclass(frozen=True, slots=True)
class Spent:
    """Wall time and processor time of all threads in s; number of minor page faults."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    faults: int = 0

    @staticmethod
    def so_far() -> Spent:
        faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        return Spent(time.perf_counter(), time.process_time(), faults)

    def minus(self, before: Spent) -> Spent:
        return Spent(self.wall_s - before.wall_s, self.cpu_s - before.cpu_s, self.faults - before.faults)


@dataclass(slots=True)
class Timing:
    """The times of each round, and the results of the turns of the first round."""

    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    faults: list[int] = field(default_factory=list)
    kept: list[Any] = field(default_factory=list)

    def begin_round(self) -> None:
        self.wall_s.append(0.0)
        self.cpu_s.append(0.0)
        self.faults.append(0)

    def add(self, spent: Spent) -> None:
        self.wall_s[-1] += spent.wall_s
        self.cpu_s[-1] += spent.cpu_s
        self.faults[-1] += spent.faults


@dataclass(frozen=True, slots=True)
class Row:
    """A result, one value for each round. A ratio has no ``unit``; ``wanted`` is such as (">=", 4.5)."""

    name: str
    values: tuple[float, ...]
    unit: str = ""
    wanted: tuple[str, float] | None = None

    @property
    def median(self) -> float:
        return statistics.median(self.values)

    @property
    def met(self) -> bool | None:
        """Return whether the median meets the wanted limit; None without a limit."""
        if self.wanted is None:
            return None
        sign, limit = self.wanted
        return self.median >= limit if sign == ">=" else self.median <= limit

    def as_json(self) -> dict[str, Any]:
        wanted = {"wanted": f"{self.wanted[0]} {self.wanted[1]:g}", "met": self.met} if self.wanted else {}
        unit = {"unit": self.unit} if self.unit else {}
        low, high = min(self.values), max(self.values)
        return {"median": self.median, "min": low, "max": high, "rounds": len(self.values)} | unit | wanted


def ratio_row(
    name: str,
    over: Timing,
    under: Timing,
    wanted: tuple[str, float] | None = None,
    wall: bool = False,
) -> Row:
    """Return the time of ``over`` divided by that of ``under``, as processor time or as wall time."""
    pairs = zip(over.wall_s, under.wall_s, strict=True) if wall else zip(over.cpu_s, under.cpu_s, strict=True)
    return Row(name, tuple(over_s / under_s for over_s, under_s in pairs), wanted=wanted)


def race(contenders: Sequence[Contender], turns: int, rounds: int) -> dict[str, Timing]:
    """Let all contenders take each turn one after the other; repeat this ``rounds`` times in new processes.

    The state of the heap can make a process a quarter slower, so an old process tells nothing about a new
    process. The allocator is not changed, unless the environment changes it.
    """
    timings = {contender.name: Timing() for contender in contenders}
    # For small work, threads of BLAS would only wait; the processes that start now inherit this setting.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for number in range(rounds):
        with ExitStack() as stack:
            lines = {contender.name: stack.enter_context(_Started(contender)) for contender in contenders}
            for timing in timings.values():
                timing.begin_round()
            for turn in range(turns):
                for name, line in lines.items():
                    spent, result = line.ask(turn)
                    timings[name].add(spent)
                    if number == 0:
                        timings[name].kept.append(result)
    return timings


class _Started:
    """The process of a contender, and the connection to it. A context manager."""

    def __init__(self, contender: Contender) -> None:
        self.name = contender.name
        context = multiprocessing.get_context("spawn")
        self._line, remote = context.Pipe()
        # Not a daemon, because some contenders start processes of their own; it ends with its connection.
        self._process = context.Process(target=_serve, args=(remote, contender))
        self._process.start()
        remote.close()
        self._hear()

    def __enter__(self) -> _Started:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.is_alive():
            self._line.send(_STOP)
        self._process.join()

    def ask(self, turn: int) -> tuple[Spent, Any]:
        self._line.send(turn)
        return self._hear()

    def _hear(self) -> tuple[Spent, Any]:
        try:
            answer: tuple[Spent, Any] = self._line.recv()
        except EOFError:
            raise SystemExit(f"{self.name}: its process has ended; its traceback stands above") from None
        return answer


def _serve(line: Connection, contender: Contender) -> None:
    work = contender.make(*contender.arguments)
    line.send((Spent(), None))
    while (turn := _next_turn(line)) != _STOP:
        before = Spent.so_far()
        result = work(turn)
        line.send((Spent.so_far().minus(before), result))


def _next_turn(line: Connection) -> int:
    try:
        turn: int = line.recv()
    except EOFError:  # the process of the race has ended
        return _STOP
    return turn
