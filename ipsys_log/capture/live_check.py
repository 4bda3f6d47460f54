"""The live check of the cameras: a frame of each about once a second, and events for knocked cameras."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass
from types import TracebackType

import cv2
import numpy as np

from ipsys_log.capture.knocks import KnockMonitor
from ipsys_log.capture.recorder import Source
from ipsys_log.errors import FrameError
from ipsys_log.messages import CAMERA_MOVED, CompressedImage, CompressedVideo, Message, Rig
from ipsys_log.stages.detect.misprints import find_misprints
from ipsys_log.stages.detect.search import count_wrong_cells, search_squares
from ipsys_log.vision.decode import decode_grey
from ipsys_log.vision.video import decode_keyframe, is_keyframe

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

    def __enter__(self) -> CameraMonitor:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
            grey = decode_grey(decode_keyframe(image) if isinstance(image, CompressedVideo) else image)
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


class KnockEvents:
    """A sink of live results that adds an event, and prints its text, when a camera has moved.

    The event is recorded and never derived: a replay does not repeat it, and no stage reads it.

    Parameters
    ----------
    cameras : the source of the recording; it gets the events.
    """

    def __init__(self, cameras: Source) -> None:
        self._cameras = cameras
        self._monitor: KnockMonitor | None = None

    def __call__(self, message: Message) -> None:
        """Handle one message; the rig comes first."""
        if isinstance(message.payload, Rig):
            self._monitor = KnockMonitor(message.payload)
        elif self._monitor is not None:
            for knock in self._monitor(message):
                self._cameras.add_event(CAMERA_MOVED, knock.text, knock.camera)


def _unknown(ids: tuple[int, ...]) -> str:
    """Return advice about markers that are in the image but not in the rig."""
    names = ", ".join(map(str, ids))
    if len(ids) == 1:
        subject, todo = f"marker {names} is", "to track it"
    else:
        subject, todo = f"markers {names} are", "to track them"
    return f"{subject} seen, but not in the rig; {todo}, add [[markers]] with id = {ids[0]} to lab.toml"
