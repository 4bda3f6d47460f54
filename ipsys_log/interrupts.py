"""Steps that an interrupt does not divide, such as the creation of a file and the entry of its block.

A signal handler of Python runs between any two operations of the main thread. An interrupt right after the
creation of a file would leave the file behind.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass(slots=True)
class _State:
    """The number of entered blocks, and the signal that waits for their end."""

    depth: int = 0
    deferred: int | None = None


_state = _State()


@contextmanager
def undivided() -> Iterator[None]:
    """Defer the interrupts of the command line to the end of the block; for the main thread only.

    Blocks may be nested.
    """
    _state.depth += 1
    try:
        yield
    finally:
        _state.depth -= 1
        number = _state.deferred
        if number is not None and _state.depth == 0:
            _state.deferred = None
            signal.raise_signal(number)


def is_undivided() -> bool:
    """Return whether a block is entered."""
    return _state.depth > 0


def defer(number: int) -> bool:
    """Note a signal for the end of the block; return False if no block is entered. For signal handlers."""
    if not is_undivided():
        return False
    _state.deferred = number
    return True
