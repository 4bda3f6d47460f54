"""Signals that end a command: the time of their effect, and their exit code.

Until the command is known, a signal is only noted (`hold_signals`). Then it interrupts (`allow_interrupt`),
or it stops the cameras and the command ends in order (`stop_on_signal`). The next Ctrl-C ends the process at
once. The first signal of a command that runs until it is stopped gives exit code 0; every other one gives 128
plus its number, as shells do. A signal that the process inherited as ignored stays ignored (``nohup``).
"""

import functools
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_KEPT = "complete results are kept; nothing else is changed"
# The normal end of a command that appends measured points.
SAVED = "stopped; every saved point is in the log"
_NOTHING_WRITTEN = "no file was changed"
_AT_ONCE = "ended at once; if a log was being recorded, complete it with: ipsys repair LOG"
# An interrupt within an import waits for this time, and tries again.
_AFTER_IMPORT_S = 0.02
_SHOW_CURSOR = "\x1b[?25h"


class Interrupted(KeyboardInterrupt):
    """A signal that interrupts the main thread, with its exit code and its message."""

    def __init__(self, exit_code: int, text: str) -> None:
        super().__init__(text)
        self.exit_code, self.text = exit_code, text


class InterruptError(Exception):
    """The end of an interrupted command: the argument parser would replace a KeyboardInterrupt."""

    def __init__(self, exit_code: int, text: str) -> None:
        super().__init__(text)
        self.exit_code, self.text = exit_code, text


@dataclass(slots=True)
class _State:
    """The state of the signals.

    It has the signal of this command so far, the text of a normal end (None: an interrupt is a failure), the
    text on the results after a failure, and the results that the command has kept so far.
    """

    noted: int | None = None
    normal_text: str | None = None
    kept_text: str = _KEPT
    kept: list[str] = field(default_factory=list)


_state = _State()


def hold_signals() -> None:
    """Note a signal without any effect, until the command sets its effect."""
    signal.setitimer(signal.ITIMER_REAL, 0)
    _state.noted, _state.normal_text = None, None
    _handle(_note)


def allow_interrupt(normal_text: str | None = None) -> None:
    """Let a signal interrupt the main thread from now on; a signal that was noted interrupts at once.

    Parameters
    ----------
    normal_text : the message of a command that runs until it is stopped. Its first signal gives exit code 0.

    Raises
    ------
    Interrupted
        Now or later, in the main thread.
    """
    _state.normal_text = normal_text
    _handle(_interrupt)
    if _state.noted is not None:
        _interrupt(_state.noted)


def stop_on_signal(stop: Callable[[], None]) -> None:
    """Call ``stop`` on the first signal, which may have come before.

    ``stop`` takes no lock: the interrupted thread may hold it.
    """

    def end(*_: object) -> None:
        _handle(_end_at_once)
        stop()

    _handle(end)
    if _state.noted is not None:
        end()


def note_kept(result: str) -> None:
    """Note a result that remains after an interrupt, such as a written file."""
    _state.kept.append(result)


@contextmanager
def say_kept(text: Callable[[Sequence[str]], str]) -> Iterator[None]:
    """Report the kept results on an interrupt within the block, or within a decorated function.

    ``text`` is called after an interrupt with the results that `note_kept` noted in the block.
    """
    _state.kept.clear()
    try:
        yield
    except Interrupted as interrupt:
        if interrupt.exit_code == 0:
            raise
        words = f"interrupted; {text(tuple(_state.kept))}"
        raise Interrupted(interrupt.exit_code, words) from None


def runs_until_stopped(command: Callable[..., None]) -> Callable[..., None]:
    """Mark a command that calls `allow_interrupt` itself, as it may end normally on a signal."""
    command.runs_until_stopped = True  # type: ignore[attr-defined]
    return command


def writes_nothing(command: Callable[..., None]) -> Callable[..., None]:
    """Mark a command that writes no file: after an interrupt, there are no results to keep."""
    command.writes_nothing = True  # type: ignore[attr-defined]
    return command


def interruptible(command: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a command: signals interrupt it, and their exceptions pass the argument parser."""

    @functools.wraps(command)
    def run(*arguments: Any, **options: Any) -> Any:
        _state.kept_text = _NOTHING_WRITTEN if hasattr(command, "writes_nothing") else _KEPT
        try:
            if not hasattr(command, "runs_until_stopped"):
                allow_interrupt()
            result = command(*arguments, **options)
            if _state.noted is not None and not hasattr(command, "runs_until_stopped"):
                _interrupt(_state.noted)  # it waited for an import, or a library suppressed it
            return result
        except Interrupted as interrupt:
            raise InterruptError(interrupt.exit_code, interrupt.text) from None
        finally:
            hold_signals()  # the command has ended: a late signal has no effect on it

    return run


def _note(number: int, _: FrameType | None = None) -> None:
    _state.noted = number
    _handle(_end_at_once)


def _interrupt(number: int, frame: FrameType | None = None) -> None:
    _state.noted = number
    _handle(_end_at_once)
    if _is_importing(frame):  # the import of an extension module may suppress the exception
        signal.signal(signal.SIGALRM, lambda _, later: _interrupt(number, later))
        signal.setitimer(signal.ITIMER_REAL, _AFTER_IMPORT_S)
        return
    text, _state.normal_text = _state.normal_text, None
    if text is not None:
        raise Interrupted(0, text)
    raise Interrupted(128 + number, f"interrupted; {_state.kept_text}")


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _end_at_once(number: int, _: FrameType | None = None) -> None:
    """End the process on Ctrl-C. Processes that it started end with their pipes."""
    if number != signal.SIGINT:
        return  # ``timeout`` and closed terminals send their signal twice
    shown = f"{_SHOW_CURSOR if os.isatty(2) else ''}\nipsys: {_AT_ONCE}\n"
    with suppress(OSError):
        os.write(2, shown.encode())  # the interrupted thread may hold the lock of sys.stderr
    os._exit(128 + number)


def _handle(handler: Callable[[int, FrameType | None], None]) -> None:
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
