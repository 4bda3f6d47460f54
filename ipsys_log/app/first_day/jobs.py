"""The one job of the page: work in its own thread, with its progress, its texts and its end."""

import threading
import traceback
from collections import deque
from collections.abc import Callable
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.plain_text import plain_text

_MOST_LINES = 40


class JobStoppedError(Exception):
    """The user has stopped a job: its work ends here."""


class Job:
    """A job that works, or has ended.

    Attributes
    ----------
    name : the name of its work, for people.
    action : the name of its action, for a page.
    ended : the work has returned or failed.
    error : the reason of a failure, in one line; "" otherwise.
    bug : the traceback of an unexpected exception; "" otherwise.
    """

    def __init__(self, name: str, action: str = "") -> None:
        self.name, self.action = name, action
        self.ended, self.error, self.bug = False, "", ""
        self._lines: deque[str] = deque(maxlen=_MOST_LINES)
        self._stage, self._done, self._total = "", 0, 0
        self._stops: list[Callable[[], object]] = []
        self._is_stopped = threading.Event()

    def say(self, text: str) -> None:
        """Show a line to the user."""
        self._lines.append(plain_text(text))

    def progress(self, stage: str, done: int, total: int | None) -> None:
        """Show the progress of a stage that a stop of the user may interrupt.

        Raises
        ------
        JobStoppedError
            The user has stopped the job.
        """
        self.note_progress(stage, done, total)
        if self.is_stopped():
            raise JobStoppedError(self.name)

    def note_progress(self, stage: str, done: int, total: int | None) -> None:
        """Show the progress of a stage that ends in order after a stop."""
        self._stage, self._done, self._total = stage, done, total or 0

    def on_stop(self, stop: Callable[[], object]) -> None:
        """Call a function when the user stops the job; at once if the user has stopped it."""
        self._stops.append(stop)
        if self._is_stopped.is_set():
            stop()

    def stop(self) -> None:
        """Ask the work to end in order."""
        self._is_stopped.set()
        for stop in list(self._stops):
            stop()

    def is_stopped(self) -> bool:
        """Return whether the user has stopped the job."""
        return self._is_stopped.is_set()

    def describe(self) -> dict[str, Any]:
        """Return the job as plain data."""
        return {
            "name": self.name,
            "action": self.action,
            "ended": self.ended,
            "stopping": self.is_stopped() and not self.ended,
            "error": self.error,
            "lines": list(self._lines),
            "stage": self._stage,
            "done": self._done,
            "total": self._total,
        }


class Jobs:
    """The jobs of a page: one at a time, because a camera can be open only once.

    ``present`` is the job that works, else the last one; None before the first job.
    """

    def __init__(self) -> None:
        self.present: Job | None = None
        self._earlier_bugs: list[str] = []
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    @property
    def bugs(self) -> list[str]:
        """The tracebacks of the unexpected exceptions in all jobs so far."""
        present = [self.present.bug] if self.present is not None and self.present.bug else []
        return [*self._earlier_bugs, *present]

    def start(self, name: str, work: Callable[[Job], None], action: str = "") -> None:
        """Start a job in its own thread."""
        with self._lock:
            if self.present is not None and not self.present.ended:
                raise IpsysError(f"{self.present.name} is not finished; wait for it, or stop it")
            self._earlier_bugs = self.bugs
            self.present = Job(name, action)
            self._thread = threading.Thread(target=_run, args=(self.present, work), name=name, daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Ask the present job to end in order."""
        if self.present is not None:
            self.present.stop()

    def close(self) -> None:
        """Stop the present job, and wait for its end."""
        self.stop()
        if self._thread is not None:
            self._thread.join()


def _run(job: Job, work: Callable[[Job], None]) -> None:
    """Do the work of a job; every exception becomes a text of the job."""
    try:
        work(job)
    except JobStoppedError:
        job.say("stopped; every finished step is kept")
    except IpsysError as error:
        job.error = plain_text(str(error))
    except Exception as error:
        job.bug = traceback.format_exc()
        job.error = (
            f"internal error of ipsys: {type(error).__name__}: {error}; the terminal shows it when the "
            "command ends"
        )
    finally:
        job.ended = True
