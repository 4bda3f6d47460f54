"""The live check of the cameras: a frame of each about once a second, and a warning of knocked cameras.

A reference marker that moves in the image shows it. The side of the marker gives the scale, so no model is
necessary. If another camera sees the same marker move, the marker has moved. Cameras that see no reference
marker are compared with other cameras in the overlap of their fields of view. There the errors of the models
differ from place to place, so that only a sudden change of some centimetres is certain.
"""

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import hypot
from typing import NamedTuple, Self

import cv2
import numpy as np

from ipsys_log.errors import FrameError
from ipsys_log.messages import CAMERA_MOVED, Array, CompressedImage, CompressedVideo, Markers, Message, Rig
from ipsys_log.messages.events import MODEL_CONTRADICTED
from ipsys_log.stages.detect.cells import count_wrong_cells
from ipsys_log.stages.detect.misprints import find_misprints
from ipsys_log.stages.detect.search import search_squares
from ipsys_log.statistics.disagreement import Difference, OverlapStream
from ipsys_log.units import CM_PER_M, MM_PER_M, NS_PER_S
from ipsys_log.vision.video import decode_alone, is_keyframe

# The state now is the median of the last sightings, at most so many and so old.
_RECENT = 5
_RECENT_NS = NS_PER_S // 2
# With fewer, one wrong sighting is the median.
_FEWEST_RECENT = 3
# The state before is the median of earlier sightings, at most so old and at least so many.
_BEFORE_NS = 3 * NS_PER_S
_FEWEST_BEFORE = 5
# Smallest motion of a marker that counts.
_LEAST_MARKER_M = 0.002
# Smallest change of the difference of two cameras that counts. It also changes with the place of the robot,
# at most so many m per m.
_LEAST_OVERLAP_M = 0.015
_OVERLAP_SLOPE = 0.02
# A smaller change in units of the usual spread is noise.
_SPREADS = 6.0
# Values within such an extent cannot have changed by _LEAST_OVERLAP_M, also with rounding.
_CALM_M = 0.99 * _LEAST_OVERLAP_M
# A motion must last so long. Meanwhile the other cameras send their frames.
_CONFIRMED_NS = NS_PER_S // 5
# A camera without a reference marker for so long counts as one without reference markers.
_UNWATCHED_NS = 2 * NS_PER_S
# In the overlap, the state before is that at nearly the same place: the robot moves on.
_OVERLAP_BEFORE_NS = 3 * NS_PER_S // 2
_FEWEST_OVERLAP = 4


# Two cameras differ by less, unless the model is of another lab. The first so many differences show it.
_MOST_OVERLAP_M, _FIRST_OVERLAP = 0.1, 10


class Knock(NamedTuple):
    """A warning that a camera has moved, as a text for the user; ``camera`` is None if two are possible.

    The ``kind`` is that of its event: the model can contradict the cameras from the start, too.
    """

    time_ns: int
    camera: str | None
    text: str
    kind: str = CAMERA_MOVED


@dataclass(slots=True, eq=False)
class _History:
    """Values over the last seconds, and the time since when they have changed."""

    kept_ns: int
    fewest: int
    rows: deque[tuple[int, Array]] = field(default_factory=deque)
    changed_ns: int | None = None
    # Bounds of x and y of all rows: low x, high x, low y, high y. They can be too wide.
    bounds: tuple[float, float, float, float] | None = None

    def add(self, time_ns: int, value: Array) -> None:
        if self.rows and time_ns <= self.rows[-1][0]:
            return
        self.rows.append((time_ns, value))
        while self.rows[0][0] < time_ns - self.kept_ns:
            self.rows.popleft()

    def change(self) -> tuple[Array, Array] | None:
        """Return the change from before to now, and the usual spread of a value; None if unknown."""
        newest_ns = self.rows[-1][0]
        split = max(len(self.rows) - _RECENT, 0)
        recent = [value for time_ns, value in list(self.rows)[split:] if newest_ns - time_ns <= _RECENT_NS]
        before = np.array([value for _, value in list(self.rows)[:split]])
        if len(recent) < _FEWEST_RECENT or len(before) < self.fewest:
            return None
        middle = np.median(before, axis=0)
        spread = 1.5 * np.median(np.abs(before - middle), axis=0)
        return np.median(recent, axis=0) - middle, spread

    def is_within(self, extent: float) -> bool:
        """Return whether the first two values of all rows lie within an extent.

        Medians take ten times as long, and a hall has thousands of differences per second.
        """
        x, y = self.rows[-1][1][:2].tolist()
        low_x, high_x, low_y, high_y = self.bounds or (x, x, y, y)
        self.bounds = min(low_x, x), max(high_x, x), min(low_y, y), max(high_y, y)
        if not _is_short(self.bounds, extent):
            xs, ys = zip(*(value[:2].tolist() for _, value in self.rows), strict=True)
            self.bounds = min(xs), max(xs), min(ys), max(ys)
        return _is_short(self.bounds, extent)

    def note(self, is_changed: bool) -> bool:
        """Note whether the value is changed now; return whether it has been for long enough."""
        newest_ns = self.rows[-1][0]
        if not is_changed:
            self.changed_ns = None
        elif self.changed_ns is None:
            self.changed_ns = newest_ns
        return self.changed_ns is not None and newest_ns - self.changed_ns >= _CONFIRMED_NS

    def restart(self) -> None:
        self.rows.clear()
        self.changed_ns = None


def _is_short(bounds: tuple[float, float, float, float], extent: float) -> bool:
    low_x, high_x, low_y, high_y = bounds
    return hypot(high_x - low_x, high_y - low_y) <= extent


class KnockMonitor:
    """The monitor of all cameras; it gets the results of the stages in the order of the log.

    Parameters
    ----------
    rig : names the reference markers and their sides.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig, self._overlap = rig, OverlapStream(rig)
        self._markers: dict[tuple[str, int], _History] = {}
        self._shifts_m: dict[tuple[str, int], float] = {}
        self._watched_ns: dict[str, int] = {}
        self._pairs: dict[tuple[tuple[str, str], int], _History] = {}
        self._first_m: dict[tuple[str, str], list[float]] = {}

    def __call__(self, message: Message) -> Iterator[Knock]:
        """Yield the warnings that a message causes."""
        if isinstance(message.payload, Markers):
            yield from self._see_markers(str(message.camera), message.payload)
        for difference in self._overlap(message):
            key = difference.cameras, difference.marker_id
            history = self._pairs.setdefault(key, _History(_OVERLAP_BEFORE_NS, _FEWEST_OVERLAP))
            history.add(difference.time_ns, np.array(difference[3:]))
            yield from self._compare_first(difference)
            yield from self._see_difference(difference.cameras, history)

    def _see_markers(self, camera: str, frame: Markers) -> Iterator[Knock]:
        confirmed, present = [], []
        for marker in frame.markers:
            if not self._rig.is_reference(marker.id):
                continue
            key = camera, marker.id
            history = self._markers.setdefault(key, _History(_BEFORE_NS, _FEWEST_BEFORE))
            history.add(frame.timestamp, marker.corners_px.reshape(8))
            self._watched_ns[camera] = frame.timestamp
            present.append(marker.id)
            self._shifts_m[key] = shift_m = self._shift_m(marker.id, history)
            if history.note(shift_m > _LEAST_MARKER_M):
                confirmed.append(marker.id)
        if confirmed and 2 * len(confirmed) >= len(present):
            own = [marker_id for marker_id in confirmed if not self._is_seen_moving(camera, marker_id)]
            if own:
                yield self._warn(camera, frame.timestamp, own, len(present))
            for marker_id in confirmed if own else ():
                self._markers[camera, marker_id].restart()

    def _shift_m(self, marker_id: int, history: _History) -> float:
        """Return the motion of a marker in the image in m at its distance; 0 if it is not certain."""
        newest, oldest = (history.rows[n][1].reshape(4, 2) for n in (-1, 0))
        sides_px = np.hypot(*(newest[[1, 2, 3, 0]] - newest).T)
        scale = self._rig.length_of(marker_id) / float(sides_px.max())
        # Medians take ten times as long, and nearly all frames show a still marker.
        if scale * float(np.hypot(*(newest - oldest).mean(axis=0))) < _LEAST_MARKER_M / 2:
            return 0.0
        change = history.change()
        if change is None:
            return 0.0
        shift_px, spread_px = change[0].reshape(4, 2).mean(axis=0), float(change[1].max())
        length_px = float(np.linalg.norm(shift_px))
        return scale * length_px if length_px > _SPREADS * spread_px / np.sqrt(_RECENT) else 0.0

    def _is_seen_moving(self, camera: str, marker_id: int) -> bool:
        """Return whether another camera sees the marker move."""
        return any(
            shift_m > _LEAST_MARKER_M / 2
            for (other, own_id), shift_m in self._shifts_m.items()
            if own_id == marker_id and other != camera
        )

    def _warn(self, camera: str, time_ns: int, markers: list[int], present: int) -> Knock:
        shift_mm = float(np.median([self._shifts_m[camera, marker_id] for marker_id in markers])) * MM_PER_M
        names = ", ".join(map(str, markers))
        several = len(markers) > 1
        doubt = "" if several else f", or reference marker {names} has moved"
        return Knock(
            time_ns,
            camera,
            f"camera {camera} has moved{doubt}: {len(markers)} of {present} reference markers in its image "
            f"shifted by {shift_mm:.1f} mm; to measure it: ipsys drift",
        )

    def _compare_first(self, difference: Difference) -> Iterator[Knock]:
        """Warn if the first differences of two cameras contradict the model."""
        first_m = self._first_m.setdefault(difference.cameras, [])
        if len(first_m) == _FIRST_OVERLAP:
            return
        first_m.append(hypot(difference.x_m, difference.y_m))
        middle_m = float(np.median(first_m))
        if len(first_m) == _FIRST_OVERLAP and middle_m > _MOST_OVERLAP_M:
            yield Knock(
                difference.time_ns,
                None,
                f"cameras {' and '.join(difference.cameras)} place marker {difference.marker_id} "
                f"{middle_m * CM_PER_M:.0f} cm apart: the model is of another lab, a camera has moved, or "
                "marker_height_m is wrong; calibrate again",
                MODEL_CONTRADICTED,
            )

    def _see_difference(self, pair: tuple[str, str], history: _History) -> Iterator[Knock]:
        now_ns = history.rows[-1][0]
        suspects = [
            camera
            for camera in pair
            if now_ns - self._watched_ns.get(camera, -_UNWATCHED_NS) >= _UNWATCHED_NS
        ]
        change = history.change() if suspects and not history.is_within(_CALM_M) else None
        size_m = 0.0 if change is None else float(np.linalg.norm(change[0][:2]))
        if not history.note(change is not None and size_m > _overlap_limit_m(*change)):
            return
        others = {own for (own, _), one in self._pairs.items() if own != pair and one.changed_ns is not None}
        common = [camera for camera in suspects if any(camera in own for own in others)] or suspects
        for (own, _), one in self._pairs.items():
            if set(own) & set(common):
                one.restart()
        yield Knock(
            now_ns,
            common[0] if len(common) == 1 else None,
            f"camera {' or '.join(common)} has moved: the positions of cameras {pair[0]} and {pair[1]} "
            f"suddenly differ by {size_m * MM_PER_M:.0f} mm more; check the mounts",
        )


def _overlap_limit_m(change: Array, spread: Array) -> float:
    """Return the change of a difference that is possible without a motion of a camera, in m."""
    travel_m = float(np.linalg.norm(change[2:]))
    return max(_LEAST_OVERLAP_M + _OVERLAP_SLOPE * travel_m, _SPREADS * float(spread[:2].max()))


_EVERY_S = 1.0
# Mean grey level of a dark image, and standard deviation of the grey levels behind a lens cap.
_DARK, _FLAT = 20.0, 4.0
# Sharpness relative to the best sharpness of the camera. Below it, there is motion or too long an exposure.
_BLURRED = 0.4
_SHRINK = 3


@dataclass(frozen=True, slots=True)
class FrameCheck:
    """The result of the check of one frame.

    ``markers`` are the ids of the rig's markers in the image, and ``unknown_markers`` the other ids.
    ``brightness`` is the mean grey level, 0 to 255. ``sharpness`` is relative to the best sharpness so far.
    ``warnings`` describe the faults of the image.
    """

    markers: tuple[int, ...]
    unknown_markers: tuple[int, ...]
    brightness: float
    sharpness: float
    warnings: tuple[str, ...]


class CameraMonitor:
    """The live check of all cameras, in a separate thread. A context manager.

    The thread analyses one frame of each camera about once a second. In a video, it analyses only keyframes,
    which can be decoded without other frames.

    Parameters
    ----------
    rig : rig with the ids of the known markers.

    Attributes
    ----------
    checks : the last result of each camera.
    """

    def __init__(self, rig: Rig) -> None:
        self.checks: dict[str, FrameCheck] = {}
        self._rig = rig
        self._newest: dict[str, CompressedImage | CompressedVideo] = {}
        self._best: dict[str, float] = {}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="monitor", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def __call__(self, message: Message) -> None:
        """Handle one recorded message."""
        if not isinstance(message.payload, (CompressedImage, CompressedVideo)):
            return
        if isinstance(message.payload, CompressedImage) or is_keyframe(message.payload):
            self._newest[str(message.camera)] = message.payload

    def _watch(self) -> None:
        while not self._ended.wait(_EVERY_S):
            for camera, image in list(self._newest.items()):
                self.checks[camera] = self._check(camera, image)

    def _check(self, camera: str, image: CompressedImage | CompressedVideo) -> FrameCheck:
        try:
            grey = decode_alone(image)
        except FrameError as error:
            return FrameCheck((), (), 0.0, 0.0, (f"a frame cannot be decoded: {error}",))
        dictionary = self._rig.dictionary
        candidates, squares_px = search_squares(grey, dictionary)
        seen = Counter(n for n, px in candidates if not count_wrong_cells(grey, n, px, dictionary))
        counts = {n: count for n, count in seen.items() if self._rig.knows(n)}
        unknown = tuple(sorted(set(seen) - set(counts)))
        small = grey[::_SHRINK, ::_SHRINK]
        brightness, spread = float(small.mean()), float(small.std())
        fine = float(cv2.Laplacian(np.ascontiguousarray(small), cv2.CV_32F).std()) / max(spread, 1.0)
        best = self._best[camera] = max(self._best.get(camera, 0.0), fine)
        sharpness = fine / max(best, 1e-9)
        warnings = [f"marker {n} is seen {count} times" for n, count in sorted(counts.items()) if count > 1]
        if brightness < _DARK or spread < _FLAT:
            warnings.append("the image is dark or empty: check that the lens is not covered")
        elif sharpness < _BLURRED:
            warnings.append("the image is blurred: add light, or set a fixed exposure_s in lab.toml")
        misprints = find_misprints(grey, dictionary, squares_px, has_markers=bool(seen))
        # Some other prints resemble markers of the rig, and a lab can have some beside its markers.
        if misprints is not None and 2 * len(misprints.ids) > len(counts):
            warnings.append(misprints.advice)
        elif unknown:
            warnings.append(_unknown(unknown))
        return FrameCheck(tuple(sorted(counts)), unknown, brightness, sharpness, tuple(warnings))


def knock_events(rig: Rig, add_event: Callable[[str, str, str | None], object]) -> Callable[[Message], None]:
    """Return a sink of live results that adds an event, and prints its text, when a camera has moved.

    The event is recorded and never derived: a replay does not repeat it, and no stage reads it.
    """
    monitor = KnockMonitor(rig)

    def watch(message: Message) -> None:
        for knock in monitor(message):
            add_event(knock.kind, knock.text, knock.camera)

    return watch


def _unknown(ids: tuple[int, ...]) -> str:
    """Return advice about markers that are in the image but not in the rig."""
    names = ", ".join(map(str, ids))
    if len(ids) == 1:
        subject, todo = f"marker {names} is", "to track it"
    else:
        subject, todo = f"markers {names} are", "to track them"
    return f"{subject} seen, but not in the rig; {todo}, add [[markers]] with id = {ids[0]} to lab.toml"
