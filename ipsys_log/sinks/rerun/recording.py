"""The Rerun recording of a log: images with markers, floor, positions and tracks; and its viewer."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

import rerun as rr

from ipsys_log.analysis.pairs import locate_measurements
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import MEASUREMENTS_TOPIC, TRUTH_TOPIC, Message
from ipsys_log.messages.channels import MEASUREMENTS
from ipsys_log.sinks.player import play
from ipsys_log.sinks.rerun.messages import RerunSink, trail_entity
from ipsys_log.sinks.rerun.scene import Plot, draw_legend, draw_places, draw_rig, layout, symbol_scale
from ipsys_log.sinks.rerun.series import DISAGREEMENT, LATENCY_MS, Series, draw_series, read_series
from ipsys_log.sinks.selection import Shown, choose_runs, fade_ns, rig_in_force

_INSTEAD = "write a recording with 'ipsys view --save session.rrd' and open it on a machine with a screen"


def viewer_command(port: int | None = None) -> list[str]:
    """Return the command of the viewer; it shows the recording from its standard input.

    The viewer also accepts connections, by default on all interfaces; this command limits it to this machine.
    With a fixed port, an open viewer would get the recording, even if it listens on all interfaces. So the
    command selects a free port, unless a port is given.
    """
    return [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", str(port or "auto"), "-"]


def check_screen(environment: Mapping[str, str]) -> None:
    """Check that a window can be opened.

    Raises
    ------
    IpsysError
        There is no display.
    """
    displays = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
    if sys.platform.startswith("linux") and not any(environment.get(name) for name in displays):
        raise IpsysError(f"the viewer needs a screen, but this machine has none; {_INSTEAD}")


def show_in_viewer(feed: Callable[[Callable[[bytes], object]], None]) -> None:
    """Open a viewer, feed it, and wait until its window is closed.

    Parameters
    ----------
    feed : called with a function that takes the bytes of a recording, piece by piece.

    Raises
    ------
    IpsysError
        No window can be opened.
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


# Frames stay longer than positions: between two calibration points the log may have a gap.
_FRAME_FACTOR = 10
# Titles of the plots, with their units.
_PLOTS = {DISAGREEMENT: "Disagreement of cameras, mm", LATENCY_MS: "Latency, ms"}
# Number of messages between two writes to the viewer: enough for its speed, small in memory.
_BATCH = 1024


def write_recording(session: Session, runs: Sequence[str] = (), save: Path | None = None) -> Shown:
    """Show a session in the Rerun viewer until its window is closed, or save it for the viewer.

    Parameters
    ----------
    session : open logs.
    runs : names of the runs to show; if empty, the newest complete runs.
    save : an ``.rrd`` file to write instead of opening a window; it has its name only when complete.

    Returns
    -------
    The content that is shown.

    Raises
    ------
    IpsysError
        The logs have nothing to show, a run is unknown, or, without ``save``, there is no screen.
    """
    shown = choose_runs(session, runs)
    if not (shown.frames or shown.moving or session.count(MEASUREMENTS_TOPIC)):
        raise IpsysError(
            f"{session}: has nothing to show: no frames, markers, positions or calibration points; "
            "to list its contents: ipsys info"
        )
    if save is None:
        show_in_viewer(lambda write: _stream(session, shown, write))
        return shown
    partial = save.with_name(save.name + ".partial")
    try:
        partial.touch()  # errors of the path are raised by this call, not by Rerun
        _save(session, shown, partial)
        partial.replace(save)
    finally:
        partial.unlink(missing_ok=True)
    return shown


def _recording(session: Session) -> rr.RecordingStream:
    """Return a separate stream, without the clock and the counter that Rerun adds to each message."""
    recording = rr.RecordingStream("ipsys", send_properties=False)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    recording.send_recording_name(", ".join(path.stem for path in session.paths))
    return recording


def _save(session: Session, shown: Shown, path: Path) -> None:
    recording = _recording(session)
    try:
        try:
            recording.save(path)
        except RuntimeError as error:
            raise IpsysError(f"{path}: cannot be written: {error}") from error
        _draw(session, shown, recording, lambda: None)
    finally:
        recording.disconnect()


def _stream(session: Session, shown: Shown, write: Callable[[bytes], object]) -> None:
    recording = _recording(session)
    try:
        stream = rr.binary_stream(recording)
        _draw(session, shown, recording, lambda: write(stream.read() or b""))
    finally:
        recording.disconnect()


def _draw(session: Session, shown: Shown, recording: rr.RecordingStream, sent: Callable[[], object]) -> None:
    """Draw a whole session; ``sent`` is called repeatedly, and at the end."""
    rig = rig_in_force(session, [run for run in (shown.markers, *shown.runs) if run])
    measurements = session.payloads(session.topics(MEASUREMENTS))
    places, faults = locate_measurements(measurements, rig)
    trails = [trail_entity(run) for run in (*shown.runs, *([None] if TRUTH_TOPIC in shown.moving else []))]
    series = read_series(session, shown.runs)
    sizes_px = _sizes_px(session, shown.cameras)
    has_events = bool(shown.events or faults)
    recording.send_blueprint(layout(shown.cameras, trails, rig, has_events, _plots(series), sizes_px))
    draw_rig(recording, rig)
    draw_places(recording, places, symbol_scale(rig))
    draw_legend(recording)
    draw_series(recording, series)
    for fault in faults:
        recording.log("events/measurements", rr.TextLog(fault, level="WARN"))
    fades = fade_ns(session, shown.frames, _FRAME_FACTOR) | fade_ns(session, shown.moving)
    sink = RerunSink(recording, (*shown.cameras, *shown.others), fades, shown.runs, symbol_scale(rig))
    play(session.messages([*shown.frames, *shown.moving, *shown.events]), [_Batches(sink, sent)])
    sink.close()
    sent()


def _plots(series: Sequence[Series]) -> dict[str, Plot]:
    counts = {entity: sum(one.is_below(entity) for one in series) for entity in _PLOTS}
    return {entity: Plot(title, counts[entity]) for entity, title in _PLOTS.items() if counts[entity]}


def _sizes_px(session: Session, cameras: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Return the width and height of the frames of the cameras that have intrinsics."""
    topics = {camera: session.calibrations[camera] for camera in cameras if camera in session.calibrations}
    lenses = {camera: next(iter(session.payloads([topic])), None) for camera, topic in topics.items()}
    return {camera: (lens.width, lens.height) for camera, lens in lenses.items() if lens is not None}


class _Batches:
    """A :class:`~ipsys_log.sinks.sink.Sink` that draws messages and sends them in batches."""

    name = "the recording"

    def __init__(self, sink: RerunSink, sent: Callable[[], object]) -> None:
        self._sink, self._sent = sink, sent

    def consume(self, messages: Iterator[Message | None]) -> None:
        """Draw the messages until they end."""
        for number, message in enumerate(messages):
            if message is not None:
                self._sink(message)
            if number % _BATCH == 0:
                self._sink.flush()
                self._sent()
