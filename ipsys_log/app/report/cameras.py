"""Live cameras, robots and the recording as tables for a terminal."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from math import degrees
from pathlib import Path

from rich.console import Group
from rich.text import Text

from ipsys_log.app.report.rows import Rows, cm, ms, percent
from ipsys_log.capture.disk import DiskRoom
from ipsys_log.capture.frames import CameraState
from ipsys_log.capture.live_check import CameraMonitor, FrameCheck
from ipsys_log.messages import CompressedImage, CompressedVideo, Markers, Message, RigCamera, Track, Tracks
from ipsys_log.statistics.disagreement import OverlapSummary
from ipsys_log.statistics.latency import PositionMonitor
from ipsys_log.units import NS_PER_S, format_bytes, format_duration
from ipsys_log.vision.bodies import track_tilt_rad

# After this time, the measured growth of a log is better than the estimate.
_SETTLED_S = 5.0
# A camera below this share of its frames is named, after a recording of this time at least.
_DELIVERED, _SHORTEST_S = 0.9, 2.0
# More robots than these do not fit into a window of 24 lines; as many ids of markers fit into a line.
_MOST_ROBOTS, _MOST_IDS = 10, 8


class LiveStatus:
    """The display on the terminal during a recording.

    Parameters
    ----------
    states, monitor : states and live check of the cameras.
    target : the log that is written.
    now_s : clock for the rates.
    expected_bytes_per_s : growth of the log, until it can be measured; None if it does not grow with time.
    say : called once, with the path of the log, when the first frame is in the file.
    cameras : the requested rates.
    positions : the state of the positions.
    begun : called with the first frame that the stages have processed.
    """

    def __init__(
        self,
        states: Mapping[str, CameraState],
        monitor: CameraMonitor,
        target: Path,
        now_s: Callable[[], float],
        expected_bytes_per_s: float | None = None,
        say: Callable[[str], None] | None = None,
        *,
        cameras: Sequence[RigCamera] = (),
        positions: PositionMonitor | None = None,
        begun: Callable[[], None] | None = None,
    ) -> None:
        self._cameras, self._positions, self._begun = cameras, positions, begun
        self._frames_ns: tuple[int, int] | None = None
        self._states, self._monitor, self.log, self._now_s = states, monitor, target, now_s
        self._begin_s = now_s()
        self._say, self._size_with_frame = say, 0
        self._span_ns: tuple[int, int] | None = None
        self._expected_bytes_per_s = expected_bytes_per_s
        self._before: dict[str, tuple[float, int, int]] = {}
        self._rates: dict[str, tuple[float, float]] = {}
        self._tracks: dict[str, Track] = {}
        self._overlap = OverlapSummary()

    @property
    def checks(self) -> Mapping[str, FrameCheck]:
        """The last check of each camera."""
        return self._monitor.checks

    def __call__(self, message: Message) -> None:
        """Handle one recorded message."""
        self._announce(message)
        self._monitor(message)
        if isinstance(message.payload, (CompressedImage, CompressedVideo, Markers)):
            time_ns = message.log_time_ns
            if self._frames_ns is None and self._begun is not None:
                self._begun()
            self._frames_ns = (self._frames_ns or (time_ns, time_ns))[0], time_ns
        begin_ns, end_ns = self._span_ns or (message.log_time_ns, message.log_time_ns)
        self._span_ns = min(begin_ns, message.log_time_ns), max(end_ns, message.log_time_ns)
        self._overlap(message)
        if isinstance(message.payload, Tracks):
            self._tracks.update({track.robot: track for track in message.payload.tracks})

    def _announce(self, message: Message) -> None:
        """Report the recording as soon as the file has grown by the first frame."""
        if self._say is None:
            return
        size = self._size()
        if self._size_with_frame and size >= self._size_with_frame:
            self._say(f"recording into {self.log}; Ctrl-C to end")
            self._say = None
        elif not self._size_with_frame:
            frame = message.payload
            if isinstance(frame, (CompressedImage, CompressedVideo)):
                self._size_with_frame = size + len(frame.data)
            elif isinstance(frame, Markers):
                self._size_with_frame = size + 1

    def show(self) -> Group:
        """Return the display: cameras, robots, warnings on cameras, and the disk."""
        now_s = self._now_s()
        for name, state in self._states.items():
            self._rates[name] = self._rate(name, state, now_s)
        parts: list[Rows | Text] = [cameras_table(self._states, self._monitor.checks, self._rates)]
        if self._tracks:
            parts.append(robots_table(self._tracks))
        positions = None if self._positions is None else self._positions.state
        if positions is not None and (self._tracks or positions.remedy):
            parts.append(Text(f"positions are {positions}", style="bold red" if positions.remedy else ""))
        parts += [Text(line) for line in self._overlap.lines()]
        # As Text: rich would read brackets in a plain string as its markup.
        parts += [Text(line, style="yellow") for line in self._warnings()]
        parts.append(self._disk(now_s - self._begin_s))
        return Group(*parts)

    def _disk(self, took_s: float) -> Text:
        """Return the size of the log, and how long the disk lasts at its measured growth."""
        size = self._size()
        folder = self.log.absolute().parent
        free = shutil.disk_usage(folder).free
        line = f"{took_s:.0f} s, {format_bytes(size)}; {format_bytes(free)} left on the disk"
        if self._expected_bytes_per_s is None:
            return Text(line)
        room = DiskRoom(folder, free, size / took_s if took_s >= _SETTLED_S else self._expected_bytes_per_s)
        if room.remaining_s is None:
            return Text(line)
        return Text(
            f"{line}, enough for {format_duration(room.remaining_s)}",
            style="bold red" if room.is_short() else "",
        )

    def _size(self) -> int:
        """Return the size of the log in bytes; 0 before it exists."""
        try:
            return self.log.stat().st_size
        except OSError:
            return 0

    def summary(self) -> list[str]:
        """Return the lines that describe a finished recording."""
        begin_ns, end_ns = self._span_ns or (0, 0)
        span_s = (end_ns - begin_ns) / NS_PER_S
        lines = [f"{self.log} written: {span_s:.1f} s, {format_bytes(self._size())}"]
        for name, state in self._states.items():
            dropped = f", {state.dropped} dropped: the disk is too slow" if state.dropped else ""
            missed = f", {state.missed} lost before arrival" if state.missed else ""
            lines.append(f"camera {name}: {state.frames} frames{dropped}{missed}")
        return lines + self._slow_cameras() + self._overlap.lines() + self._warnings()

    def _slow_cameras(self) -> list[str]:
        """Return a line for each camera that has delivered fewer frames than the rig asks for."""
        begin_ns, end_ns = self._frames_ns or (0, 0)
        span_s = (end_ns - begin_ns) / NS_PER_S
        lines = []
        for camera in self._cameras:
            source, asked_hz, state = str(camera.source), camera.rate_hz, self._states[camera.name]
            arrived = state.frames + state.dropped
            # A file may end before the recording.
            if asked_hz is None or source.startswith("file:") or span_s < _SHORTEST_S:
                continue
            if arrived < _DELIVERED * asked_hz * span_s:
                cause = "check its exposure_s, its cable and the load of this computer, or"
                if source.startswith("sim:"):
                    cause = "this computer draws its images too slowly;"
                rates = f"{arrived / span_s:.1f} of {asked_hz:g} frames/s"
                lines.append(f"camera {camera.name} delivers {rates}: {cause} lower rate_hz in the rig")
        return lines

    def _rate(self, name: str, state: CameraState, now_s: float) -> tuple[float, float]:
        before_s, frames, size = self._before.get(name, (self._begin_s, 0, 0))
        self._before[name] = now_s, state.frames, state.bytes
        took_s = max(now_s - before_s, 1e-9)
        return (state.frames - frames) / took_s, (state.bytes - size) / took_s / 1e6

    def _warnings(self) -> list[str]:
        return [
            f"camera {name}: {text}"
            for name, check in sorted(self._monitor.checks.items())
            for text in check.warnings
        ]


def robots_table(tracks: Mapping[str, Track]) -> Rows:
    """Return a table of the robots' positions: named robots first, and only as many as fit into a window."""
    order = sorted(tracks.items(), key=lambda item: (item[0] == f"marker_{item[1].id}", item[1].id))
    cells = []
    for name, track in order[:_MOST_ROBOTS]:
        heading = "-" if track.heading_rad is None else f"{degrees(track.heading_rad):.0f} deg"
        if track.rotation_rad is not None:
            heading += f", tilt {degrees(track_tilt_rad(track)):.0f}"
        position = (cm(value_m, 1) for value_m in (track.x_m, track.y_m, track.z_m))
        cells.append([name, *position, heading, ", ".join(track.cameras)])
    if len(order) > _MOST_ROBOTS:
        cells.append([f"and {len(order) - _MOST_ROBOTS} more"])
    return Rows("", ("robot", ">x cm", ">y cm", ">z cm", ">heading", "cameras"), cells)


def cameras_table(
    states: Mapping[str, CameraState],
    checks: Mapping[str, FrameCheck],
    rates: Mapping[str, tuple[float, float]],
) -> Rows:
    """Return a table with one row per camera, at most 80 columns wide.

    Parameters
    ----------
    states, checks : states and last checks of the cameras, by name.
    rates : frames and MB per second, by name.
    """
    cells: list[list[str | Text]] = []
    for name, state in states.items():
        check = checks.get(name)
        rate_hz, mb_s = rates.get(name, (0.0, 0.0))
        delay = "-" if state.delay_s is None else f"{ms(state.delay_s, 0)} ms"
        drops = state.dropped + state.missed
        row: list[str | Text] = [
            name if state.up or state.finished else Text(f"{name} (lost)", style="red"),
            *(str(state.frames), f"{rate_hz:.1f}", f"{mb_s:.1f}"),
            Text(str(drops), style="red" if drops else ""),
            delay,
        ]
        if check:
            row += [f"{check.brightness:.0f}", percent(check.sharpness), _markers(check)]
        cells.append(row if check else [*row, "-", "-", "-"])
    columns = ("camera", ">frames", ">Hz", ">MB/s", ">drops", ">delay", ">light", ">sharp", "markers")
    return Rows("", columns, cells)


def _markers(check: FrameCheck) -> Text:
    """Return the ids of the markers in an image; ids that are not in the rig get a question mark."""
    ids = [Text(str(n)) for n in check.markers] + [
        Text(f"{n}?", style="yellow") for n in check.unknown_markers
    ]
    more = [Text(f"and {len(ids) - _MOST_IDS} more")] if len(ids) > _MOST_IDS else []
    return Text(", ").join([*ids[:_MOST_IDS], *more]) if ids else Text("none")
