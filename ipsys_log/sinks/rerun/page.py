"""The Rerun viewer of the installed package on a page, for browsers of this machine."""

from __future__ import annotations

import os
import socket
import subprocess
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress

import rerun as rr

from ipsys_log.errors import IpsysError
from ipsys_log.sinks.rerun.recording import last_line, stop_viewer, viewer_command

_LOOPBACK = "127.0.0.1"
_TURN_S, _TURNS = 0.1, 600
_END_S = 5.0


class ViewerPage:
    """A process that serves the viewer. Only this machine reaches it, on two free ports.

    The page keeps what it has received. Browsers let pages of this machine and of rerun.io read the data.

    Raises
    ------
    IpsysError
        The viewer cannot be served.
    """

    name = "Rerun"

    def __init__(self) -> None:
        self._page_port, self._data_port = _free_ports()
        command = viewer_command(self._data_port)[:-1]
        command += ["--serve-web", "--web-viewer-port", str(self._page_port), "-"]
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the process
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._complaints,
            env={"RUST_LOG": "error", **os.environ},
            start_new_session=True,  # Ctrl-C ends this program first
        )
        try:
            # The viewer opens its ports only after the first bytes.
            assert self._process.stdin is not None
            with suppress(BrokenPipeError):  # the process has ended; the next line gives the reason
                self._process.stdin.write(_header())
                self._process.stdin.flush()
            self._wait()
        except BaseException:
            self.close()
            raise

    def describe(self) -> str:
        """Return one line with the address of the page."""
        source = f"rerun%2Bhttp%3A%2F%2F{_LOOPBACK}%3A{self._data_port}%2Fproxy"
        return f"Rerun: only this machine; open http://{_LOOPBACK}:{self._page_port}/?url={source}"

    def show(self, feed: Callable[[Callable[[bytes], object]], object]) -> None:
        """Feed the viewer; `feed` is called with a function that takes the bytes of a recording.

        Raises
        ------
        IpsysError
            The viewer has ended.
        """
        assert self._process.stdin is not None
        try:
            feed(self._process.stdin.write)
            self._process.stdin.flush()
        except (BrokenPipeError, ValueError) as error:  # the process has ended, or the pipe is closed
            raise IpsysError("the Rerun viewer has ended; start the command again") from error

    def close(self) -> None:
        """End the process; a pipe that it does not read is no obstacle."""
        stop_viewer(self._process)
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._complaints.close()

    def _wait(self) -> None:
        """Wait until the viewer takes data."""
        for _ in range(_TURNS):
            if self._process.poll() is not None:
                raise IpsysError(f"--rerun: the viewer cannot be served ({last_line(self._complaints)})")
            with socket.socket() as probe:
                if probe.connect_ex((_LOOPBACK, self._data_port)) == 0:
                    return
            threading.Event().wait(_TURN_S)
        raise IpsysError("--rerun: the viewer does not start; try again when the machine is less busy")


def _header() -> bytes:
    """Return the first bytes of a recording."""
    recording = rr.RecordingStream("ipsys", send_properties=False)
    try:
        return rr.binary_stream(recording).read() or b""
    finally:
        recording.disconnect()


def _free_ports() -> tuple[int, int]:
    """Return two ports of this machine that are not in use."""
    with socket.create_server((_LOOPBACK, 0)) as one, socket.create_server((_LOOPBACK, 0)) as other:
        return one.getsockname()[1], other.getsockname()[1]
