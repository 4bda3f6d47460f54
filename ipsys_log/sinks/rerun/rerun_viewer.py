"""The Rerun viewer as a process of its own, fed through a pipe."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from typing import IO

from ipsys_log.errors import IpsysError

__all__ = ["check_screen", "show_in_viewer", "viewer_command"]

_INSTEAD = "write a recording with 'ipsys view --save session.rrd' and open that where there is a screen"


def viewer_command() -> list[str]:
    """The command that shows what comes through its standard input.

    The viewer also listens for others to connect, by default on all interfaces; here only this
    machine can. A port of its own, or a viewer that is open already would be used, however bound.
    """
    return [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", "auto", "-"]


def check_screen(environment: Mapping[str, str]) -> None:
    """See to it that a window can be opened.

    Raises
    ------
    IpsysError
        Where there is no display.
    """
    displays = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
    if sys.platform.startswith("linux") and not any(environment.get(name) for name in displays):
        raise IpsysError(f"there is no screen to open the viewer on; {_INSTEAD}")


def show_in_viewer(feed: Callable[[Callable[[bytes], object]], None]) -> None:
    """Open a viewer, feed it, and wait until its window is closed.

    Parameters
    ----------
    feed : called with a function that takes the bytes of a recording, piece by piece.

    Raises
    ------
    IpsysError
        Where no window can be opened.
    """
    check_screen(os.environ)
    environment = {"RUST_LOG": "error", **os.environ}
    with (
        tempfile.TemporaryFile() as complaints,
        subprocess.Popen(
            viewer_command(), stdin=subprocess.PIPE, stderr=complaints, env=environment
        ) as viewer,
    ):
        assert viewer.stdin is not None
        try:
            feed(viewer.stdin.write)
            viewer.stdin.close()
        except BrokenPipeError:
            # The window was closed before all was read, or never opened: the exit code says which.
            _abandon(viewer.stdin)
        except BaseException:
            _stop(viewer)
            _abandon(viewer.stdin)
            raise
        if viewer.wait() != 0:
            raise IpsysError(f"the viewer could not be shown ({_last_line(complaints)}); {_INSTEAD}")


def _stop(viewer: subprocess.Popen[bytes]) -> None:
    """End the viewer; what was started is Python, which hands on an interrupt but not a termination."""
    if sys.platform == "win32":
        viewer.terminate()
    else:
        viewer.send_signal(signal.SIGINT)


def _abandon(pipe: IO[bytes]) -> None:
    """Close a pipe that nobody reads, with what is left in it."""
    try:
        pipe.close()
    except BrokenPipeError:
        return


def _last_line(complaints: IO[bytes]) -> str:
    complaints.seek(0)
    text = re.sub(r"\x1b\[[0-9;]*m", "", complaints.read().decode(errors="replace"))
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "it gave no reason"
