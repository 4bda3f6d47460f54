"""The wait of a test for an event."""

import subprocess
import time
from collections.abc import Callable, Sequence
from typing import Any

# A limit far above any duration on a busy machine.
PATIENCE_S = 600.0
_TURN_S = 0.02


def wait_until(
    condition: Callable[[], object],
    name: str,
    state: Callable[[], object] | None = None,
    programs: Sequence[subprocess.Popen[Any]] = (),
) -> None:
    """Wait until a condition holds.

    Parameters
    ----------
    name : the condition in words, such as "the log exists", for the error.
    state : returns what is there instead, for the error.
    programs : the wait fails at once if one of them ends before.

    Raises
    ------
    AssertionError
        The condition does not hold after some minutes, or a program has ended.
    """
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        for program in programs:
            assert program.poll() is None, f"a program has ended before {name!r}: {program.communicate()}"
        assert time.monotonic() < end_s, (
            f"not within {PATIENCE_S:.0f} s: {name}{'' if state is None else f'; instead: {state()}'}"
        )
        time.sleep(_TURN_S)
