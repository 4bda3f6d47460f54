"""Moves of cameras over several logs: which camera moved, and when, by mean corners of reference markers."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ipsys_log.errors import LogError
from ipsys_log.log.codec import schema_name
from ipsys_log.log.columns import read_columns
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array, Floor, Markers
from ipsys_log.messages.channels import MARKERS
from ipsys_log.statistics.drift import (
    LEAST_SHIFT_M,
    DriftBaseline,
    MeanCorners,
    Motion,
    build_baseline,
    estimate_motion,
)
from ipsys_log.statistics.floor_cameras import floor_grid
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.poses import PosedCamera

# A log has at most so many windows. A longer log is read in part: a camera that has moved stays there.
_MOST_WINDOWS = 60
# Windows follow each other at least this long,
_LEAST_NS = NS_PER_S
# and are at most this long: so much of a longer log is read.
_LONGEST_NS = 2 * NS_PER_S
# With fewer frames, one hand before a marker changes the median.
_FEWEST_FRAMES = 3
_FARTHEST_PX = 1e5


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The reference markers in a part of a log: mean corners by camera and marker id."""

    start_ns: int
    end_ns: int
    corners: Mapping[str, Mapping[int, MeanCorners]]


def read_windows(session: Session, run: str, ids: Collection[int]) -> list[Window]:
    """Return the windows of a log, in order of time; windows without a reference marker are left out.

    The mean of a corner is the median over the frames: a hand in front of the marker has no effect.

    Parameters
    ----------
    session : an open log.
    run : the run with the markers.
    ids : ids of the reference markers.
    """
    topics = session.topics(MARKERS, run)
    times = [r.times(topic) for r in session.readers for topic in topics if topic in r.channels]
    times = [one for one in times if len(one)]
    if not times:
        return []
    first_ns, last_ns = min(int(one[0]) for one in times), max(int(one[-1]) for one in times) + 1
    step_ns = max(_LEAST_NS, -(-(last_ns - first_ns) // _MOST_WINDOWS))
    windows = []
    for start_ns in range(first_ns, last_ns, step_ns):
        end_ns = min(start_ns + min(step_ns, _LONGEST_NS), last_ns)
        corners = _mean_corners(session, topics, ids, start_ns, end_ns)
        if corners:
            windows.append(Window(start_ns, end_ns, corners))
    return windows


def _mean_corners(
    session: Session, topics: Collection[str], ids: Collection[int], start_ns: int, end_ns: int
) -> dict[str, dict[int, MeanCorners]]:
    messages: dict[str, list[bytes]] = {}
    for topic, _, _, data in session.encoded(topics, start_ns, end_ns):
        messages.setdefault(topic, []).append(data)
    means: dict[str, dict[int, MeanCorners]] = {}
    parts = session.part_counter()
    for topic, encoded in messages.items():
        columns = read_columns(schema_name(Markers), encoded, ("id", "corners_px"), parts)
        seen, corners_px = columns.fields["id"].values, columns.fields["corners_px"].values
        if corners_px.shape[1] not in (0, 8):
            raise LogError(f"{session}: {topic} has markers with other than four corners")
        # A comparison with NaN is False.
        valid = ~columns.fields["corners_px"].missing & (np.abs(corners_px) < _FARTHEST_PX).all(axis=1)
        for marker_id in sorted(ids):
            rows = (seen == marker_id) & valid
            if rows.sum() >= _FEWEST_FRAMES:
                middle = np.median(corners_px[rows], axis=0).reshape(4, 2)
                own = means.setdefault(str(camera_of_topic(topic)), {})
                own[marker_id] = MeanCorners(middle, int(rows.sum()))
    return means


def average_windows(windows: Collection[Window], camera: str) -> dict[int, MeanCorners]:
    """Return the mean corners of a camera's reference markers over some windows, by marker id."""
    means = {}
    for marker_id in sorted({one for window in windows for one in window.corners.get(camera, {})}):
        own = [w.corners[camera][marker_id] for w in windows if marker_id in w.corners.get(camera, {})]
        counts = [mean.count for mean in own]
        corners_px = np.average([mean.corners_px for mean in own], axis=0, weights=counts)
        means[marker_id] = MeanCorners(np.asarray(corners_px), sum(counts))
    return means


def image_sizes(session: Session, run: str) -> dict[str, tuple[int, int]]:
    """Return the width and height of the images of each camera with markers, in px."""
    sizes = {}
    for topic in session.topics(MARKERS, run):
        frame: Markers = next(session.messages([topic])).payload
        sizes[str(camera_of_topic(topic))] = frame.width, frame.height
    return sizes


# Windows whose mean is a baseline, or the state after a move.
_AVERAGED = 5
# A marker that moves on the floor by less than this share of the least shift is not examined further.
_EXAMINED = 0.5
# Two cameras see the same motion of a marker within this distance,
_SAME_M = 0.0007
# or this share of the motion.
_SAME_SHARE = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class DriftLog:
    """A log with reference markers: its name, and its windows in order of time (at least one)."""

    name: str
    windows: Sequence[Window]


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A move of a camera between two times, with its motion.

    ``before`` and ``after`` are the names of the logs of these times. A ``gradual`` move has no step that
    alone is large enough: it took place between the two times in small steps.
    """

    camera: str
    before_ns: int
    after_ns: int
    before: str
    after: str
    motion: Motion
    gradual: bool = False


@dataclass(frozen=True, slots=True)
class MarkerMove:
    """A reference marker that was moved or replaced, at about a time."""

    marker_id: int
    time_ns: int
    log: str


@dataclass(frozen=True, slots=True, eq=False)
class CameraState:
    """The motion of a camera since the baseline, at the end of a log; None without a common marker."""

    camera: str
    log: str
    time_ns: int
    motion: Motion | None


@dataclass(slots=True, eq=False)
class LabDrift:
    """The result over all logs, in order of time."""

    baselines: dict[str, DriftBaseline] = field(default_factory=dict)
    moves: list[Move] = field(default_factory=list)
    marker_moves: list[MarkerMove] = field(default_factory=list)
    states: list[CameraState] = field(default_factory=list)

    def of_camera(self, camera: str) -> list[CameraState]:
        """Return the states of a camera, in order of time."""
        return [state for state in self.states if state.camera == camera]


def find_drift(
    logs: Sequence[DriftLog],
    cameras: Mapping[str, PosedCamera],
    lengths_m: Mapping[int, float],
    floor: Floor | None,
) -> LabDrift:
    """Find the moves of cameras since the first log.

    A camera has moved if two windows in succession show it. A marker that two cameras see moving in the same
    way, or that contradicts at least two others, has moved itself. It is used again from its new place.

    Parameters
    ----------
    logs : in order of time; the first is the baseline.
    cameras : calibrated cameras by name; others are left out.
    lengths_m : sides of the reference markers by id.
    floor : size of the floor.
    """
    search = _Search(cameras, lengths_m, floor)
    for log in logs:
        search.add(log)
    return search.drift


@dataclass(slots=True, eq=False)
class _Segment:
    """A time without a move of a camera: its baseline, the windows of the baseline, and the last window."""

    baseline: DriftBaseline
    windows: list[Window]
    start_ns: int
    last: tuple[Window, str]
    recent: list[Window]
    suspected: list[tuple[Window, str]] = field(default_factory=list)


class _Search:
    """The search for moves, log by log."""

    def __init__(
        self, cameras: Mapping[str, PosedCamera], lengths_m: Mapping[int, float], floor: Floor | None
    ) -> None:
        self.drift = LabDrift()
        self._cameras, self._lengths_m = cameras, lengths_m
        self._floor_m = {name: floor_grid(camera, floor) for name, camera in cameras.items()}
        self._segments: dict[str, _Segment] = {}
        self._suspected_markers: set[int] = set()

    def add(self, log: DriftLog) -> None:
        """Search the windows of the next log."""
        for window in log.windows:
            present = [camera for camera in sorted(window.corners) if len(self._floor_m.get(camera, ()))]
            motions = {camera: self._examine(camera, window) for camera in present}
            moved = self._moved_markers(window, motions)
            for marker_id in sorted(moved & self._suspected_markers):
                self.drift.marker_moves.append(MarkerMove(marker_id, window.start_ns, log.name))
                self._use_again(marker_id, window)
            self._suspected_markers = moved - self._suspected_markers
            for camera in present:
                self._continue(camera, window, log.name, motions[camera], moved)
        for camera in sorted(self._segments):
            self._note_state(camera, log)

    def _baseline(self, camera: str, windows: Sequence[Window]) -> DriftBaseline:
        return build_baseline(
            self._cameras[camera], self._floor_m[camera], average_windows(windows, camera), self._lengths_m
        )

    def _examine(self, camera: str, window: Window) -> Motion | None:
        """Return the motion of a camera since the start of its segment; None if no marker has moved."""
        if camera not in self._segments:
            return None
        baseline = self._segments[camera].baseline
        shifts = (_shift_m(baseline, window, camera, one) for one in baseline.corners)
        if not any(
            shift is not None and np.linalg.norm(shift) > _EXAMINED * LEAST_SHIFT_M for shift in shifts
        ):
            return None
        return estimate_motion(baseline, window.corners[camera])

    def _moved_markers(self, window: Window, motions: Mapping[str, Motion | None]) -> set[int]:
        """Return the markers that have moved themselves since the baselines."""
        moved = {one for motion in motions.values() if motion for one in motion.inconsistent}
        seen: dict[int, list[Array]] = {}
        for camera in (camera for camera, motion in motions.items() if motion):
            baseline = self._segments[camera].baseline
            for marker_id in baseline.corners:
                shift = _shift_m(baseline, window, camera, marker_id)
                if shift is not None and np.linalg.norm(shift) > LEAST_SHIFT_M:
                    seen.setdefault(marker_id, []).append(shift)
        return moved | {marker_id for marker_id, shifts in seen.items() if _agree(shifts)}

    def _use_again(self, marker_id: int, window: Window) -> None:
        """Use a marker from its new place on."""
        for camera, segment in self._segments.items():
            corners = dict(segment.baseline.corners)
            corners.pop(marker_id, None)
            if marker_id in window.corners.get(camera, {}):
                corners[marker_id] = window.corners[camera][marker_id]
            before, first = segment.baseline, self.drift.baselines[camera]
            segment.baseline = build_baseline(before.camera, before.floor_m, corners, self._lengths_m)
            segment.windows = segment.windows[:0]
            # A camera that has not moved so far sees the marker from where it was at the baseline.
            self.drift.baselines[camera] = segment.baseline if first is before else _without(first, marker_id)

    def _continue(
        self, camera: str, window: Window, log: str, motion: Motion | None, moved_markers: set[int]
    ) -> None:
        """Extend the segment of a camera by a window, or begin a new segment after a move."""
        segment = self._segments.get(camera)
        if segment is None:
            baseline = self._baseline(camera, [window])
            self.drift.baselines[camera] = baseline
            self._segments[camera] = _Segment(baseline, [window], window.start_ns, (window, log), [window])
            return
        if motion is not None and motion.is_moved:
            if not set(motion.markers) & moved_markers:
                segment.suspected.append((window, log))
            if len(segment.suspected) > 1:
                self._note_move(camera, segment)
            return
        segment.suspected.clear()
        segment.last = window, log
        segment.recent = [*segment.recent, window][-_AVERAGED:]
        if motion is None:
            self._extend_baseline(camera, window)

    def _extend_baseline(self, camera: str, window: Window) -> None:
        """Average the first windows of a segment, and add markers that are seen for the first time."""
        segment = self._segments[camera]
        before, seen = segment.baseline, window.corners[camera]
        if 0 < len(segment.windows) < _AVERAGED:
            segment.windows.append(window)
            segment.baseline = self._baseline(camera, segment.windows)
        elif not set(seen) <= set(before.corners):
            corners = {**seen, **before.corners}
            segment.baseline = build_baseline(before.camera, before.floor_m, corners, self._lengths_m)
        if self.drift.baselines[camera] is before:
            self.drift.baselines[camera] = segment.baseline

    def _note_move(self, camera: str, segment: _Segment) -> None:
        (first, log), *_ = segment.suspected
        windows = [window for window, _ in segment.suspected]
        after = average_windows(windows, camera)
        whole = estimate_motion(segment.baseline, after)
        step = estimate_motion(self._baseline(camera, segment.recent), after)
        last, before = segment.last
        gradual = step is None or not step.is_moved
        motion = whole if gradual else step
        assert motion is not None
        start_ns = segment.start_ns if gradual else last.end_ns
        self.drift.moves.append(Move(camera, start_ns, first.start_ns, before, log, motion, gradual))
        self._segments[camera] = _Segment(
            self._baseline(camera, windows), windows, first.start_ns, segment.suspected[-1], windows
        )

    def _note_state(self, camera: str, log: DriftLog) -> None:
        """Note the motion of a camera since the baseline, over the last windows of a log."""
        segment = self._segments[camera]
        own = [w for w in log.windows if camera in w.corners and w.start_ns >= segment.start_ns]
        if own:
            motion = estimate_motion(self.drift.baselines[camera], average_windows(own[-_AVERAGED:], camera))
            self.drift.states.append(CameraState(camera, log.name, own[-1].end_ns, motion))


def _without(baseline: DriftBaseline, marker_id: int) -> DriftBaseline:
    return DriftBaseline(
        baseline.camera,
        baseline.floor_m,
        {one: mean for one, mean in baseline.corners.items() if one != marker_id},
        {one: points for one, points in baseline.points_c.items() if one != marker_id},
    )


def _shift_m(baseline: DriftBaseline, window: Window, camera: str, marker_id: int) -> Array | None:
    """Return the motion (3,) of a marker in the world, in m, if the camera has not moved.

    The marker keeps its depth. None if the marker is not in the window, or outside of the lens model.
    """
    mean = window.corners.get(camera, {}).get(marker_id)
    if mean is None:
        return None
    lens, depth_m = baseline.camera.lens, float(baseline.points_c[marker_id][:, 2].mean())
    uv = [undistort(one.corners_px, lens).mean(axis=0) for one in (baseline.corners[marker_id], mean)]
    aside_m = np.append(depth_m * (uv[1] - uv[0]), 0.0) @ baseline.camera.camera_from_world
    return aside_m if np.isfinite(aside_m).all() else None


def _agree(shifts_m: Sequence[Array]) -> bool:
    """Return whether at least two cameras see the same motion (3,) of a marker."""
    pairs = [(a, b) for n, a in enumerate(shifts_m) for b in shifts_m[:n]]
    return any(
        np.linalg.norm((a - b)[:2]) < max(_SAME_M, _SAME_SHARE * float(np.linalg.norm(a))) for a, b in pairs
    )
