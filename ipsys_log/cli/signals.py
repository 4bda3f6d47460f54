"""Signals that end a command: the time of their effect, and their exit code.

Until the command is known, a signal is only noted (`hold_signals`). Then it interrupts (`allow_interrupt`),
or it stops the cameras and the command ends in order (`stop_on_signal`). The first signal of a command that
runs until it is stopped gives exit code 0; every other one gives 128 plus its number, as shells do. A signal
that the process inherited as ignored stays ignored (``nohup``).

An interrupt is an exception, and other packages may suppress it: the import of an extension module does. So
the interrupt is raised again until the command receives it.
"""

from __future__ import annotations

import functools
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

from ipsys_log.interrupts import defer, is_undivided, undivided

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_AGAIN_S = 0.5
_WAKE_S = 0.05
_KEPT = "complete results are kept; nothing else is changed"
# The normal end of a command that appends measured points.
SAVED = "stopped; every saved point is in the log"
_NOTHING_WRITTEN = "no file was changed"


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

    It has the signal that was noted, the text of a normal end (None: an interrupt is a failure), the text on
    the results after a failure, the interrupt that has not arrived yet, and the results that the command has
    kept so far.
    """

    noted: int | None = None
    normal_text: str | None = None
    kept_text: str = _KEPT
    raised: Interrupted | None = None
    kept: list[str] = field(default_factory=list)


_state = _State()


def hold_signals() -> None:
    """Note signals without any effect, until the command sets their effect."""
    _settle()
    _state.noted, _state.normal_text = None, None
    _handle(_note)


def allow_interrupt(normal_text: str | None = None) -> None:
    """Let signals interrupt the main thread from now on; a signal that was noted interrupts at once.

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
    """Call ``stop`` on the first signal, and let the next ones interrupt.

    ``stop`` takes no lock: the interrupted thread may hold it.
    """

    def end(*_: object) -> None:
        _state.normal_text = None
        _handle(_interrupt)
        stop()

    _handle(end)


def note_kept(result: str) -> None:
    """Note a result that remains after an interrupt, such as a written file."""
    _state.kept.append(result)


@contextmanager
def say_kept(text: Callable[[Sequence[str]], str]) -> Iterator[None]:
    """Report the kept results on an interrupt within the block, or within a decorated function.

    Parameters
    ----------
    text : is called after an interrupt with the results that `note_kept` noted in the block.
    """
    _state.kept.clear()
    try:
        yield
    except Interrupted as interrupt:
        if interrupt.exit_code == 0:
            raise
        words = f"interrupted; {text(tuple(_state.kept))}"
        raise Interrupted(interrupt.exit_code, words) from None


@contextmanager
def suppress_interrupt() -> Iterator[None]:
    """End the block on an interrupt, and go on after it."""
    try:
        yield
    except KeyboardInterrupt:
        _settle()


@contextmanager
def wake_input() -> Iterator[None]:
    """Let a signal end `input` in the block whenever it comes; for the main thread only.

    With readline, `input` misses a signal between its check for signals and its wait for a key: the handler
    would run after the next key.
    """
    waker = None
    try:
        with undivided():
            waker = _Waker()
        yield
    finally:
        with undivided():
            if waker is not None:
                waker.stop()


class _Waker:
    """A thread that sends a signal again until its handler has run, in an `input` that has missed it."""

    def __init__(self) -> None:
        self._handled, self._ended = False, threading.Event()
        self._handlers = {number: signal.getsignal(number) for number in _SIGNALS}
        _handle(self._handle_once)
        self._receiver, self._sender = os.pipe()
        os.set_blocking(self._sender, False)
        self._previous = signal.set_wakeup_fd(self._sender, warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._work, name="wakes the input", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._ended.set()
        signal.set_wakeup_fd(self._previous)
        os.close(self._sender)
        self._thread.join()
        os.close(self._receiver)
        for number, handler in self._handlers.items():
            if signal.getsignal(number) == self._handle_once:
                signal.signal(number, handler)

    def _handle_once(self, number: int, frame: FrameType | None) -> None:
        """Call the usual handler once: a signal that is sent again is no second one of the user."""
        if self._handled:
            return
        self._handled = not is_undivided()
        handler = self._handlers[signal.Signals(number)]
        if callable(handler):
            handler(number, frame)

    def _work(self) -> None:
        main = threading.main_thread().ident
        assert main is not None
        while number := os.read(self._receiver, 1):
            while number[0] in _SIGNALS and not self._handled and not self._ended.wait(_WAKE_S):
                signal.pthread_kill(main, number[0])


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
            return command(*arguments, **options)
        except Interrupted as interrupt:
            _settle()
            raise InterruptError(interrupt.exit_code, interrupt.text) from None
        finally:
            hold_signals()  # the command has ended: a late signal has no effect on it

    return run


def _note(number: int, _: FrameType | None = None) -> None:
    if _state.noted is not None:  # on a second signal, the user does not want to wait
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)
    _state.noted = number


def _interrupt(number: int, _: FrameType | None = None) -> None:
    if defer(number):
        return
    _state.noted, text = None, _state.normal_text
    _state.normal_text = None
    if text is not None:
        _state.raised = Interrupted(0, text)
    else:
        _state.raised = Interrupted(128 + number, f"interrupted; {_state.kept_text}")
    signal.signal(signal.SIGALRM, _interrupt_again)
    signal.setitimer(signal.ITIMER_REAL, _AGAIN_S, _AGAIN_S)
    raise _state.raised


def _interrupt_again(*_: object) -> None:
    """Raise an interrupt again if it was suppressed; the timer calls this until it arrives."""
    error = sys.exception()
    while error is not None:
        if isinstance(error, (Interrupted, GeneratorExit)):
            return  # the interrupt has arrived: a block, or a generator that it has ended, cleans up
        error = error.__context__
    if _state.raised is not None and not is_undivided():
        raise Interrupted(_state.raised.exit_code, _state.raised.text)


def _settle() -> None:
    """Note that the interrupt has arrived."""
    if _state.raised is not None:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        _state.raised = None


def _handle(handler: Callable[[int, FrameType | None], None]) -> None:
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
