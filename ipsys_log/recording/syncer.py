"""Bringing what is recorded onto the disk every few seconds, beside the thread that writes it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType

__all__ = ["SYNC_EVERY_S", "Confirm", "Syncer"]

# What a power cut costs, beside the second that waits to be written and the time that a sync takes.
SYNC_EVERY_S = 2.0
# A user who interrupts does not wait longer for a disk that hangs.
_LAST_S = 1.0

# Is told that what was written before is on the disk, or what the disk said instead.
Confirm = Callable[[OSError | None], None]


class Syncer:
    """A thread that syncs a file every few seconds, and at once when it is asked. A context manager.

    The thread that writes never waits for it: a sync that takes long only makes the next one late.

    Parameters
    ----------
    sync : brings onto the disk what was written before it is called.
    every_s : time from the end of a sync to the begin of the next.

    Attributes
    ----------
    fault : what the disk said when a sync failed first: what was written before may be lost.
    """

    def __init__(self, sync: Callable[[], None], every_s: float = SYNC_EVERY_S) -> None:
        self.fault: OSError | None = None
        self._sync, self._every_s = sync, every_s
        self._asked: list[Confirm] = []
        self._ended = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="syncer", daemon=True)

    def __enter__(self) -> Syncer:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join(_LAST_S if isinstance(error, KeyboardInterrupt) else None)

    def soon(self, confirm: Confirm) -> None:
        """Sync at once, or when the sync that goes on has ended, and ``confirm`` it from the thread."""
        with self._changed:
            self._asked.append(confirm)
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._asked or self._ended, self._every_s)
                asked, self._asked = self._asked, []
                if self._ended and not asked:
                    return
            fault: OSError | None = None
            try:
                self._sync()
            except OSError as error:
                fault = error
                self.fault = self.fault or error
            for confirm in asked:
                confirm(fault)
