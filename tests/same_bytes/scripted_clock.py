"""A clock that stops while anything runs, so that a recording is the same each time.

The driver loads this file into a command that records, before that command imports its own modules. The
file imports nothing of the code under test, so it fits any layout. It relies on three habits of that code:

- The log's clock and the played cameras (``file:lab.mcap`` as a source) use the module ``time``.
- A played camera waits for its next frame with ``time.sleep``.
- Threads wait for each other with ``threading``, not with a loop of sleeps.

If a rebuild breaks one of them, adapt :func:`install`, and keep the old way beside the new.

The functions behave as follows.

- ``time.time``, ``time_ns``, ``monotonic_ns`` and ``clock_gettime_ns`` return one scripted time.
- ``time.sleep`` waits for the scripted time. That time advances only when every thread waits. It advances to
  the sleeper that is due first, and only that sleeper wakes. So one frame arrives at a time, and all results
  of a frame are written before the next frame arrives.
- ``Thread.start`` returns when the new thread waits for something, so threads start one after the other.

``time.monotonic`` and the timeouts of ``threading`` stay real: they only decide how often a thread looks for
work. The states of the threads come from ``/proc``: this needs Linux.
"""

import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

_START_NS, _SINCE_BOOT_NS = 1_700_000_000_000_000_000, 1_000_000_000_000
_LOOKS, _LOOK_S = 3, 0.003
_LONGEST_S = 60.0

_real_sleep, _real_start = time.sleep, threading.Thread.start
_real_clock_ns = time.clock_gettime_ns
_looking = threading.Lock()
_conductors: set[int] = set()


class _Script:
    """The scripted time, and the threads that sleep until a later time."""

    def __init__(self) -> None:
        self.since_ns = 0
        self.sleepers: list[tuple[int, int, threading.Event]] = []
        self.numbers: dict[int, int] = {}
        self._lock = threading.Lock()

    def sleep(self, seconds: float) -> None:
        me = threading.get_ident()
        woken = threading.Event()
        with self._lock:
            due_ns = self.since_ns + max(1, round(seconds * 1e9))
            self.sleepers.append((due_ns, self.numbers.setdefault(me, len(self.numbers)), woken))
        woken.wait()

    def wake_next(self) -> None:
        """Wake the sleeper that is due first; among several, the one whose thread started first."""
        with self._lock:
            if not self.sleepers:
                return
            sleeper = min(self.sleepers, key=lambda one: one[:2])
            self.sleepers.remove(sleeper)
            self.since_ns = max(self.since_ns, sleeper[0])
            sleeper[2].set()


def install() -> None:
    """Replace the clock of this process, in the main thread, before other threads start."""
    script = _Script()
    script.numbers[threading.get_ident()] = 0

    starting: list[threading.Thread] = []

    def start(thread: threading.Thread) -> None:
        starting.append(thread)
        _real_start(thread)
        script.numbers.setdefault(thread.ident or 0, len(script.numbers))
        _wait_until_quiet()
        starting.remove(thread)

    def conduct() -> None:
        _conductors.add(threading.get_native_id())
        while True:
            _real_sleep(_LOOK_S)
            if script.sleepers:
                _wait_until_quiet()
                if not starting:  # a thread that starts another one also waits, but continues by itself
                    script.wake_next()

    conductor = threading.Thread(target=conduct, name="conductor", daemon=True)
    _real_start(conductor)
    replace: dict[str, Callable[..., object]] = {
        "time": lambda: (_START_NS + script.since_ns) / 1e9,
        "time_ns": lambda: _START_NS + script.since_ns,
        "monotonic_ns": lambda: _SINCE_BOOT_NS + script.since_ns,
        "clock_gettime_ns": lambda clock: _SINCE_BOOT_NS + script.since_ns,
        "sleep": script.sleep,
    }
    for name, function in replace.items():
        setattr(time, name, function)
    setattr(threading.Thread, "start", start)  # noqa: B010


def _wait_until_quiet() -> None:
    """Wait until no other thread of this process runs or could run."""
    with _looking:
        me, quiet, looked = threading.get_native_id(), 0, 0
        before = _threads(me)
        while quiet < _LOOKS:
            _real_sleep(_LOOK_S)
            now = _threads(me)
            quiet = quiet + 1 if now == before and {state for state, _ in now.values()} <= {"S"} else 0
            before = now
            looked += 1
            if looked * _LOOK_S > _LONGEST_S:
                print("same-bytes: the threads of a recording do not come to rest", file=sys.stderr)  # noqa: T201
                os._exit(75)


def _threads(but: int) -> dict[int, tuple[str, int]]:
    """Return the state of each other thread (S: waiting) and its processor time in ns.

    The state alone is not enough: a thread that waits for the interpreter's lock, because this thread has it,
    is in the state S too. But it runs while this thread sleeps, and that shows in its time.
    """
    found = {}
    for task in Path("/proc/self/task").iterdir():
        number = int(task.name)
        if number == but or number in _conductors:
            continue
        try:
            state = (task / "stat").read_text().rpartition(")")[2].split()[0]
            # the clock of a thread by its number: CPUCLOCK_PERTHREAD and CPUCLOCK_SCHED of Linux
            found[number] = state, _real_clock_ns((~number << 3) | 6)
        except OSError:  # the thread has ended
            continue
    return found
