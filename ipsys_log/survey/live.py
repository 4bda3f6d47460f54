"""Measuring while cameras send: what they see now, and measurements on their way into the log."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from ipsys_log.capture.camera_thread import CameraState
from ipsys_log.errors import FrameError
from ipsys_log.images.video import decode_keyframe, is_keyframe
from ipsys_log.messages import (
    MEASUREMENTS_TOPIC,
    CameraPoints,
    CompressedImage,
    CompressedVideo,
    Markers,
    Measurement,
    Message,
    Model,
    Rig,
)
from ipsys_log.stages.detect import decode_grey
from ipsys_log.survey.entry import check_references
from ipsys_log.survey.scene import Stop, View
from ipsys_log.units import NS_PER_S

__all__ = ["LiveScene"]

_LAST_NS = NS_PER_S


class LiveScene:
    """A recording as a :class:`~ipsys_log.survey.scene.Scene`. Call it with what is recorded and made.

    Parameters
    ----------
    rig, model : those that hold; the model may be None.
    cameras : by name; of one that is lost nothing is seen.
    add : puts a payload on a topic into the log, through the one place that gives log times; it returns when
        that is written.

    Raises
    ------
    IpsysError
        Where the rig has no two reference points to lay a tape from.
    """

    def __init__(
        self,
        rig: Rig,
        model: Model | None,
        cameras: Mapping[str, CameraState],
        add: Callable[[str, Any], None],
    ) -> None:
        check_references(rig)
        self.rig, self.model = rig, model
        self.stops: Sequence[Stop] = ()
        self._cameras, self._add = cameras, add
        self._lock = threading.Lock()
        self._images: dict[str, deque[Message]] = {camera: deque(maxlen=60) for camera in cameras}
        # The last picture with its markers. Frames that were skipped have none.
        self._marked: dict[str, tuple[Message, Markers]] = {}
        self._decoded: dict[str, tuple[int, bytes | None]] = {}
        self._points: dict[str, deque[CameraPoints]] = {camera: deque() for camera in cameras}
        self._history: list[Measurement] = []
        # Where each camera saw the marker of a measurement: id, marker, mean camera point (3,).
        self._measured: dict[str, list[tuple[str, int, NDArray[np.float64]]]] = {c: [] for c in cameras}

    def __call__(self, message: Message | None) -> None:
        """Be shown a frame, or what a stage made of it."""
        if message is None or message.camera not in self._images:
            return
        payload, camera = message.payload, message.camera
        with self._lock:
            # Of a video keyframes are shown, which need no others.
            if isinstance(payload, CompressedImage) or (
                isinstance(payload, CompressedVideo) and is_keyframe(payload)
            ):
                self._images[camera].append(message)
            elif isinstance(payload, Markers):
                for image in self._images[camera]:
                    if image.publish_time_ns == message.publish_time_ns:
                        self._marked[camera] = image, payload
            elif isinstance(payload, CameraPoints):
                points = self._points[camera]
                points.append(payload)
                while points[0].timestamp < payload.timestamp - _LAST_NS:
                    points.popleft()

    def views(self, stop: int | None) -> list[View]:  # noqa: ARG002
        """The latest picture of every camera whose markers are known, and its last second."""
        with self._lock:
            newest_ns = max((points[-1].timestamp for points in self._points.values() if points), default=0)
            return [self._view(camera, newest_ns - _LAST_NS) for camera in sorted(self._images)]

    def history(self) -> list[Measurement]:
        return list(self._history)

    def add(self, measurements: Sequence[Measurement]) -> None:
        """Send measurements into the log.

        Raises
        ------
        IpsysError
            Where the recording has ended, or they could not be written: it says that they are not saved.
        """
        for measurement in measurements:
            self._add(MEASUREMENTS_TOPIC, measurement)
            self._history.append(measurement)
            self._remember(measurement)

    def _remember(self, measurement: Measurement) -> None:
        """Note where it was measured, to tell whether the marker has moved since."""
        still = measurement.still
        if still is None or measurement.marker_id is None:
            return
        with self._lock:
            for camera, seen in self._points.items():
                points_m = [
                    (point.x_m, point.y_m, point.z_m)
                    for one in seen
                    for point in one.points
                    if point.id == measurement.marker_id
                    and still.start <= one.timestamp + (point.time_offset_ns or 0) <= still.end
                ]
                if points_m:
                    place = measurement.id, measurement.marker_id, np.mean(points_m, axis=0)
                    self._measured[camera].append(place)

    def _view(self, camera: str, since_ns: int) -> View:
        if camera not in self._marked or not self._cameras[camera].up:
            return View(camera, 0)
        image, markers = self._marked[camera]
        # That of a camera which hangs, and is not known to be lost yet, is not the last second.
        points = tuple(one for one in self._points[camera] if one.timestamp >= since_ns)
        measured = tuple(self._measured[camera])
        return View(camera, image.publish_time_ns, self._jpeg(camera, image), markers, points, measured)

    def _jpeg(self, camera: str, image: Message) -> bytes | None:
        if isinstance(image.payload, CompressedImage):
            return image.payload.data
        if self._decoded.get(camera, (0, None))[0] != image.publish_time_ns:
            try:
                grey = decode_grey(decode_keyframe(image.payload))
                jpeg = simplejpeg.encode_jpeg(grey[..., None], colorspace="GRAY")
            except FrameError:
                jpeg = None
            self._decoded[camera] = image.publish_time_ns, jpeg
        return self._decoded[camera][1]
