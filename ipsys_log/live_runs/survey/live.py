"""Measuring with live cameras: their present views, and measurements that go into the running log."""

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from ipsys_log.capture.frames import CameraState
from ipsys_log.errors import FrameError
from ipsys_log.live_runs.survey.entry import check_references
from ipsys_log.live_runs.survey.scene import CameraView, StationaryInterval
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
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.decode import decode_grey
from ipsys_log.vision.video import decode_keyframe, is_keyframe

_LAST_NS = NS_PER_S


class LiveScene:
    """A running recording as a scene for measuring (``scene.py``); call it with every message.

    The messages are the recorded frames and the results of the stages.

    Parameters
    ----------
    rig, model : the present rig and model; the model may be None.
    cameras : camera states by name; a lost camera has an empty view.
    add : function that writes a payload with a topic to the log. It goes through the queue that gives log
        times, and returns after the write.

    Raises
    ------
    IpsysError
        The rig has fewer than two reference points for a tape.
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
        self.intervals: Sequence[StationaryInterval] = ()
        self._cameras, self._add = cameras, add
        self._lock = threading.Lock()
        self._images: dict[str, deque[Message]] = {camera: deque(maxlen=60) for camera in cameras}
        # The last image with its markers. Skipped frames have no markers.
        self._marked: dict[str, tuple[Message, Markers]] = {}
        self._decoded: dict[str, tuple[int, bytes | None]] = {}
        self._points: dict[str, deque[CameraPoints]] = {camera: deque() for camera in cameras}
        self._history: list[Measurement] = []
        # For each camera and measurement: the id, the marker, and its mean camera point (3,).
        self._measured: dict[str, list[tuple[str, int, NDArray[np.float64]]]] = {c: [] for c in cameras}

    def __call__(self, message: Message) -> None:
        """Handle one frame, or one result of a stage."""
        if message.camera not in self._images:
            return
        payload, camera = message.payload, message.camera
        with self._lock:
            # In a video, only keyframes are shown: they can be decoded without other frames.
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

    def views(self, interval: int | None) -> list[CameraView]:  # noqa: ARG002
        """Return the view of each camera: the latest image with known markers, and the points of a second."""
        with self._lock:
            newest_ns = max((points[-1].timestamp for points in self._points.values() if points), default=0)
            return [self._view(camera, newest_ns - _LAST_NS) for camera in sorted(self._images)]

    def history(self) -> list[Measurement]:
        return list(self._history)

    def add(self, measurements: Sequence[Measurement]) -> None:
        """Write measurements to the log.

        Raises
        ------
        IpsysError
            The recording has ended, or the write failed. The text says that the measurements are not saved.
        """
        for measurement in measurements:
            self._add(MEASUREMENTS_TOPIC, measurement)
            self._history.append(measurement)
            self._remember(measurement)

    def _remember(self, measurement: Measurement) -> None:
        """Store the camera points of a measurement, to detect later whether the marker has moved."""
        still = measurement.still
        if still is None or measurement.marker_id is None:
            return
        with self._lock:
            for camera, seen in self._points.items():
                points_m = [
                    (point.x_m, point.y_m, point.z_m)
                    for camera_points in seen
                    for point in camera_points.points
                    if point.id == measurement.marker_id
                    and still.start <= camera_points.timestamp + (point.time_offset_ns or 0) <= still.end
                ]
                if points_m:
                    measured_point = measurement.id, measurement.marker_id, np.mean(points_m, axis=0)
                    self._measured[camera].append(measured_point)

    def _view(self, camera: str, since_ns: int) -> CameraView:
        if camera not in self._marked or not self._cameras[camera].up:
            return CameraView(camera, 0)
        image, markers = self._marked[camera]
        # A camera that hangs, but is not known to be lost, has only older points. They are left out.
        points = tuple(
            camera_points for camera_points in self._points[camera] if camera_points.timestamp >= since_ns
        )
        measured = tuple(self._measured[camera])
        return CameraView(camera, image.publish_time_ns, self._jpeg(camera, image), markers, points, measured)

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
