"""The Rerun viewer: its process, in a window or on a page, and the thread that sends messages to it live."""

import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import IO

import rerun as rr

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Event, Markers, Message, Positions, Rig, Tracks, image_topic
from ipsys_log.messages.channels import IMAGES
from ipsys_log.sinks.rerun.messages import RerunSink, trail_entity
from ipsys_log.sinks.rerun.scene import draw_legend, draw_rig, layout, open_recording, symbol_scale
from ipsys_log.sinks.streams.poses import NewSession
from ipsys_log.units import NS_PER_S

_INSTEAD = "write a recording with 'ipsys view --save session.rrd' and open it on a machine with a screen"
_LOOPBACK = "127.0.0.1"
_TURN_S, _TURNS = 0.1, 600
_END_S = 5.0


def viewer_command(port: int | None = None) -> list[str]:
    """Return the command of the viewer; it shows the recording from its standard input.

    The viewer also accepts connections, by default on all interfaces; this command limits it to this machine.
    With a fixed port, an open viewer would get the recording, even if it listens on all interfaces. So the
    command selects a free port, unless a port is given.
    """
    return [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", str(port or "auto"), "-"]


def check_screen(environment: Mapping[str, str]) -> None:
    """Check that a window can be opened."""
    displays = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
    if sys.platform.startswith("linux") and not any(environment.get(name) for name in displays):
        raise IpsysError(f"the viewer needs a screen, but this machine has none; {_INSTEAD}")


def show_in_viewer(feed: Callable[[Callable[[bytes], object]], None]) -> None:
    """Open a viewer, feed it, and wait until its window is closed.

    ``feed`` is called with a function that takes the bytes of a recording, piece by piece.
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
            # The window was closed before the end, or it never opened: the exit code shows the case.
            _abandon(viewer.stdin)
        except BaseException:
            stop_viewer(viewer)
            _abandon(viewer.stdin)
            raise
        if viewer.wait() != 0:
            raise IpsysError(f"the viewer cannot be shown ({last_line(complaints)}); {_INSTEAD}")


def stop_viewer(viewer: subprocess.Popen[bytes]) -> None:
    """End the viewer; its process is Python, which passes on an interrupt but not a termination."""
    if sys.platform == "win32":
        viewer.terminate()
    else:
        viewer.send_signal(signal.SIGINT)


def _abandon(pipe: IO[bytes]) -> None:
    """Close a pipe without a reader, with the data left in it."""
    try:
        pipe.close()
    except BrokenPipeError:
        return


def last_line(complaints: IO[bytes]) -> str:
    """Return the last line of an error output, without colours."""
    complaints.seek(0)
    text = re.sub(r"\x1b\[[0-9;]*m", "", complaints.read().decode(errors="replace"))
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "no reason given"


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
        """Feed the viewer; `feed` is called with a function that takes the bytes of a recording."""
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
        """Wait until the viewer takes data and serves its page; it opens the page after the data."""
        for _ in range(_TURNS):
            if self._process.poll() is not None:
                raise IpsysError(f"--rerun: the viewer cannot be served ({last_line(self._complaints)})")
            if _is_open(self._data_port) and _is_open(self._page_port):
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


def _is_open(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((_LOOPBACK, port)) == 0


def _free_ports() -> tuple[int, int]:
    """Return two ports of this machine that are not in use."""
    with socket.create_server((_LOOPBACK, 0)) as one, socket.create_server((_LOOPBACK, 0)) as other:
        return one.getsockname()[1], other.getsockname()[1]


Write = Callable[[bytes], object]

_FADE_NS = NS_PER_S


class LiveView:
    """A :class:`~ipsys_log.sinks.sink.QueuedSink` that shows a recording in a Rerun viewer.

    Parameters
    ----------
    rig, cameras, run : content of the display; ``run`` is the run of the tracks, None without tracks.
        Without cameras, no images are shown.
    say : called with the reason if the viewer could not be shown.
    show : opens the viewer and feeds it; a test replaces the real viewer.
    name : the name of the sink in events.

    Raises
    ------
    IpsysError
        There is no screen.
    """

    def __init__(
        self,
        rig: Rig | None,
        cameras: Iterable[str],
        run: str | None,
        say: Callable[[str], object],
        show: Callable[[Callable[[Write], None]], None] = show_in_viewer,
        name: str = "the viewer",
    ) -> None:
        self.name = name
        self._rig, self._cameras, self._run = rig, sorted(cameras), run
        self._say, self._show = say, show
        pictures = (*IMAGES.payloads, Markers) if self._cameras else ()
        self.payloads: tuple[type, ...] = (Tracks, Positions, Event, NewSession, *pictures)
        if show is show_in_viewer:
            check_screen(os.environ)

    def consume(self, messages: Iterator[Message | None]) -> None:
        """Show the messages until they end."""
        try:
            self._show(lambda write: self._feed(write, messages))
        except IpsysError as error:  # a missing viewer is not an error of the recording
            self._say(str(error))

    def _fades_ns(self) -> dict[str, int]:
        """Return by topic the time in ns after which its last entity is cleared."""
        topics = [image_topic(camera) for camera in self._cameras]
        if self._run is not None:
            topics += [f"/runs/{self._run}/cameras/{camera}/positions" for camera in self._cameras]
            topics.append(f"/runs/{self._run}/tracks")
        return dict.fromkeys(topics, _FADE_NS)

    def _feed(self, write: Write, messages: Iterator[Message | None]) -> None:
        """Draw the messages; each session of a playback is a recording of its own, because times go back."""
        begun: Message | None = None
        while True:
            name = "live" if begun is None else f"session {begun.payload.number}"
            begun = self._draw(name, write, messages)
            if begun is None:
                return

    def _draw(self, name: str, write: Write, messages: Iterator[Message | None]) -> Message | None:
        """Draw one recording; return the message that begins the next one, None at the end."""
        with open_recording(name) as recording:
            stream = rr.binary_stream(recording)
            sink = self._begin(recording)
            is_empty, begun = True, None
            for message in messages:
                if message is not None and isinstance(message.payload, NewSession):
                    if is_empty:
                        continue
                    begun = message
                    break
                if message is not None:
                    sink(message)
                    is_empty = False
                if message is None or isinstance(message.payload, Tracks):
                    sink.flush()
                    write(stream.read() or b"")
            sink.close()
            write(stream.read() or b"")
            return begun

    def _begin(self, recording: rr.RecordingStream) -> RerunSink:
        trails = [] if self._run is None else [trail_entity(self._run)]
        recording.send_blueprint(layout(self._cameras, trails, self._rig, events=True))
        draw_rig(recording, self._rig)
        draw_legend(recording)
        runs = () if self._run is None else (self._run,)
        return RerunSink(recording, self._cameras, self._fades_ns(), runs, symbol_scale(self._rig))
