"""Periodic sync of a recording to the disk, in a separate thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType

__all__ = ["SYNC_EVERY_S", "Confirm", "Syncer"]

# Data lost in a power cut, plus the second that waits to be written and the duration of a sync.
SYNC_EVERY_S = 2.0
# After an interrupt, a hanging disk delays the end by at most this time.
_LAST_S = 1.0

# Called when the data written before are on the disk, or with the error of the disk.
Confirm = Callable[[OSError | None], None]


class Syncer:
    """A thread that syncs a file every few seconds, and at once on request. A context manager.

    The writing thread never waits for it: a long sync only delays the next one.

    Parameters
    ----------
    sync : syncs the data written before the call.
    every_s : time from the end of a sync to the begin of the next.

    Attributes
    ----------
    fault : the error of the first failed sync: data written before it may be lost.
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
        """Sync at once, or after the running sync, and ``confirm`` it from the thread."""
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
