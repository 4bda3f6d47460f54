"""The threads that read cameras: one for each device, and one for all nodes.

Each switch between threads of Python takes time of the thread that computes positions: with a thread for each
of 24 nodes, more time than the positions.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from threading import Thread

from ipsys_log.capture.camera_thread import CameraReader, Pause
from ipsys_log.capture.frames import Clock
from ipsys_log.capture.nodes.centre import is_of_node
from ipsys_log.capture.nodes.receiver import passing_period_s
from ipsys_log.units import NS_PER_S


def reader_threads(readers: Sequence[CameraReader]) -> list[Thread]:
    """Return the threads of some cameras; they are not started."""
    nodes = [reader for reader in readers if is_of_node(reader.camera)]
    # The thread of a device is a daemon, because a driver can block for ever.
    threads = [
        Thread(target=_read_device, args=(reader,), name=reader.camera.name, daemon=True)
        for reader in readers
        if reader not in nodes
    ]
    if nodes:
        # Zenoh's threads are daemons if their caller is one. Python ends a daemon within a call of Zenoh, and
        # the program aborts.
        threads.append(Thread(target=_read_nodes, args=(nodes,), name="nodes", daemon=False))
    return threads


def _read_device(reader: CameraReader) -> None:
    for pause in reader.read():
        if pause is not None:
            pause.until.wait(pause.seconds)


def _read_nodes(readers: Sequence[CameraReader]) -> None:
    """Read nodes in turn. A node whose reader pauses misses its turns."""
    period_s, clock = passing_period_s(len(readers)), Clock()
    turns = [_Turn(reader) for reader in readers]
    while turns:
        now_s = clock.now_ns() / NS_PER_S
        turns = [turn for turn in turns if turn.take(now_s)]
        time.sleep(period_s)


class _Turn:
    """The turns of one node."""

    def __init__(self, reader: CameraReader) -> None:
        self._steps: Iterator[Pause | None] = reader.read()
        self._pause: Pause | None = None
        self._paused_s = 0.0

    def take(self, now_s: float) -> bool:
        """Read all that has arrived, unless the reader pauses; return False after the end."""
        pause = self._pause
        if pause is not None and now_s - self._paused_s < pause.seconds and not pause.until.is_set():
            return True
        try:
            self._pause, self._paused_s = next(self._steps), now_s
        except StopIteration:
            return False
        return True
