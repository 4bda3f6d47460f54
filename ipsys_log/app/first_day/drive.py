"""The parts of the images that a robot has crossed during a drive, for a page."""

import threading
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import FrameError
from ipsys_log.messages import CompressedImage, CompressedVideo, Grey, Message, Rig
from ipsys_log.stages.detect.search import detect_markers
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.video import decode_alone, is_keyframe

# Cells of an image, along its height and width.
_CELLS = 5, 8
# The picture on the page is smaller than that of the camera.
_SHOWN_WIDTH_PX = 640


class DriveCoverage:
    """A sink of a recording that looks for robots in some of its frames, in its own thread.

    The log gets no detection: the calibration detects all frames of all logs in the same way.

    Parameters
    ----------
    rig : its robots count; without robots, all markers do.
    cameras : names of the cameras.

    Attributes
    ----------
    seconds : time of the recording so far.
    """

    def __init__(self, rig: Rig, cameras: list[str]) -> None:
        self.seconds, self._begin_ns = 0.0, 0
        self._dictionary = rig.dictionary
        self._robots = {marker.id for marker in rig.markers if marker.robot}
        self._cells: dict[str, NDArray[np.bool_]] = {name: np.zeros(_CELLS, np.bool_) for name in cameras}
        self._pictures: dict[str, tuple[int, bytes]] = {}
        self._waiting: dict[str, CompressedImage | CompressedVideo] = {}
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(1, "drive")
        self._looking: Future[None] | None = None

    def __call__(self, message: Message) -> None:
        """Take a frame; older frames that still wait are left out."""
        payload = message.payload
        self._begin_ns = self._begin_ns or message.log_time_ns
        self.seconds = (message.log_time_ns - self._begin_ns) / NS_PER_S
        if message.camera not in self._cells or not isinstance(payload, CompressedImage | CompressedVideo):
            return
        if isinstance(payload, CompressedVideo) and not is_keyframe(payload):
            return
        with self._lock:
            self._waiting[message.camera] = payload
        if self._looking is None or self._looking.done():
            if self._looking is not None:
                self._looking.result()  # raises a bug of the search
            self._looking = self._pool.submit(self._look)

    def describe(self) -> list[dict[str, Any]]:
        """Return the last picture of each camera, and its covered cells, row by row."""
        with self._lock:
            return [
                {
                    "camera": camera,
                    "picture": f"picture/drive/{camera}?{self._pictures[camera][0]}"
                    if camera in self._pictures
                    else None,
                    "cells": cells.astype(int).tolist(),
                    "share": float(cells.mean()),
                }
                for camera, cells in self._cells.items()
            ]

    def picture(self, camera: str) -> bytes | None:
        """Return the last picture of a camera as JPEG."""
        with self._lock:
            return self._pictures[camera][1] if camera in self._pictures else None

    def close(self) -> None:
        """Wait for the search that works."""
        self._pool.shutdown(cancel_futures=True)

    def _look(self) -> None:
        with self._lock:
            waiting, self._waiting = self._waiting, {}
        for camera, image in waiting.items():
            try:
                grey = decode_alone(image)
            except FrameError:
                continue
            self._note(camera, image.timestamp, grey)

    def _note(self, camera: str, time_ns: int, grey: Grey) -> None:
        """Mark the cells of the robots in an image, and keep it, with the ids of all markers drawn."""
        height, width = grey.shape
        scale = min(1.0, _SHOWN_WIDTH_PX / width)
        shown = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        shown = cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR)
        found = detect_markers(grey, self._dictionary)
        for marker in found:
            x, y = marker.corners_px.mean(axis=0)
            place = int(scale * x), int(scale * y)
            cv2.putText(shown, str(marker.id), place, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 176, 255), 2)
        jpeg = cv2.imencode(".jpg", shown)[1].tobytes()
        with self._lock:
            self._pictures[camera] = time_ns, jpeg
            for marker in found:
                if not self._robots or marker.id in self._robots:
                    x, y = marker.corners_px.mean(axis=0) / [width, height]
                    row, column = int(y * _CELLS[0]), int(x * _CELLS[1])
                    self._cells[camera][min(row, _CELLS[0] - 1), min(column, _CELLS[1] - 1)] = True
