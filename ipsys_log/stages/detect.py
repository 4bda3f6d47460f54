"""Frames to markers: ArUco detection with sub-pixel corners."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.messages import (
    Color,
    CompressedImage,
    Event,
    ImageAnnotations,
    Marker,
    Markers,
    Message,
    Point2,
    PointsAnnotation,
    RawImage,
    Rig,
    TextAnnotation,
)

__all__ = ["READS", "Detect", "decode_grey", "detect_markers", "marker_detector"]

READS = (Rig, CompressedImage, RawImage)

Grey = NDArray[np.uint8]

_GREEN = Color(0.1, 0.9, 0.3, 1.0)
_REFINE = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 0.001)
_RAW_TO_GREY = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "8UC3": (3, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
}


class Detect:
    """The stage *detect*, ``stock`` corners: OpenCV's detector, refined as the authors do.

    Yields, for a frame, its :class:`Markers` and their drawing for viewers; or an :class:`Event`
    for a frame that cannot be decoded. A marker id that is seen twice in a frame, or is not in the
    rig, is left out and named by an event.
    """

    def __init__(self) -> None:
        self._rig: Rig | None = None
        self._said: dict[str | None, set[int | None]] = {}

    def __call__(self, message: Message) -> Iterator[Any]:
        if isinstance(message.payload, Rig):
            self._rig = message.payload
            # Each dictionary is looked up once, here, so that a bad name is said before any frame.
            marker_detector(self._rig.dictionary)
            return
        if self._rig is None:
            raise IpsysError(
                "the log has no rig (marker dictionary and length): give one with --rig lab.toml"
            )
        try:
            grey = decode_grey(message.payload)
        except ValueError as error:
            text = f"{message.topic}: corrupt frame: {error}"
            yield Event(message.publish_time_ns, "corrupt_frame", text, message.camera)
            return
        found = detect_markers(grey, self._rig.dictionary)
        markers, events = _sift(found, self._rig, message)
        yield from self._unsaid(events)
        height, width = grey.shape
        yield Markers(message.publish_time_ns, markers, width, height)
        yield _drawing(message.publish_time_ns, markers)

    def _unsaid(self, events: list[Event]) -> Iterator[Event]:
        """A camera names an id that is not in the rig once, and whatever else every time."""
        for event in events:
            said = self._said.setdefault(event.camera, set())
            if event.kind != "unknown_marker" or event.marker_id not in said:
                yield event
            if event.kind == "unknown_marker":
                said.add(event.marker_id)


def decode_grey(frame: CompressedImage | RawImage) -> Grey:
    """The grey picture in a frame, (height, width).

    Raises
    ------
    ValueError
        Where the data is damaged: a JPEG is decoded strictly, so that half a picture is no picture.
    """
    if isinstance(frame, RawImage):
        return _raw_grey(frame)
    if frame.data[:2] == b"\xff\xd8":
        grey: Grey = simplejpeg.decode_jpeg(frame.data, colorspace="GRAY")[..., 0]
        return grey
    try:
        decoded = cv2.imdecode(np.frombuffer(frame.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:  # OpenCV asserts on empty data
        decoded = None
    if decoded is None:
        raise ValueError(f"{len(frame.data)} bytes that are no picture ({frame.format or 'no format given'})")
    return np.asarray(decoded, dtype=np.uint8)


def _raw_grey(frame: RawImage) -> Grey:
    if frame.encoding not in _RAW_TO_GREY:
        known = ", ".join(_RAW_TO_GREY)
        raise ValueError(f"pixel encoding {frame.encoding!r} is not read (only {known})")
    channels, conversion = _RAW_TO_GREY[frame.encoding]
    rows = np.frombuffer(frame.data, np.uint8)
    step = frame.step or frame.width * channels  # some writers leave it out
    if step < frame.width * channels or rows.size < step * frame.height or not rows.size:
        raise ValueError(f"{rows.size} bytes are too few for {frame.width} x {frame.height}")
    rows = rows[: step * frame.height].reshape(frame.height, step)
    pixels = rows[:, : frame.width * channels].reshape(frame.height, frame.width, channels)
    if conversion is None:
        return np.ascontiguousarray(pixels[..., 0])
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), conversion), dtype=np.uint8)


def marker_detector(dictionary: str) -> cv2.aruco.ArucoDetector:
    """OpenCV's detector for a dictionary such as DICT_4X4_100.

    Raises
    ------
    IpsysError
        Where OpenCV has no dictionary of that name.
    """
    index = getattr(cv2.aruco, dictionary, None) if dictionary.startswith("DICT_") else None
    if not isinstance(index, int):
        raise IpsysError(
            f"the rig's marker dictionary {dictionary!r} is none of OpenCV's, such as DICT_4X4_100"
        )
    parameters = cv2.aruco.DetectorParameters()
    # Bits are read from 8 px a cell instead of 4: finds more small and tilted markers.
    parameters.perspectiveRemovePixelPerCell = 8
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(index), parameters)


def detect_markers(grey: Grey, dictionary: str) -> list[Marker]:
    """All markers of a dictionary in a picture, sorted by id; an id can occur twice.

    Parameters
    ----------
    grey : (height, width)
    dictionary : OpenCV's name, such as DICT_4X4_100.

    Returns
    -------
    list of :class:`Marker`, corners refined to sub-pixels with a window of 3 (the authors' setting).
    """
    corners, ids, _ = marker_detector(dictionary).detectMarkers(grey)
    if ids is None or len(ids) == 0:
        return []
    flat = np.concatenate(corners, axis=1).reshape(-1, 1, 2).astype(np.float32)
    refined = cv2.cornerSubPix(grey, flat, (3, 3), (-1, -1), _REFINE).reshape(-1, 4, 2)
    # OpenCV 5 gives ids of shape (n,), OpenCV 4 of shape (n, 1).
    order = np.argsort(np.ravel(ids), kind="stable")
    return [Marker(int(np.ravel(ids)[i]), np.asarray(refined[i], dtype=np.float64)) for i in order]


def _sift(found: list[Marker], rig: Rig, message: Message) -> tuple[tuple[Marker, ...], list[Event]]:
    """Leave out what cannot be told apart or does not belong here, and say so."""
    counts = Counter(marker.id for marker in found)
    events = []
    for marker_id, count in sorted(counts.items()):
        if not rig.knows(marker_id):
            kind, text = "unknown_marker", f"marker {marker_id} is not in the rig"
        elif count > 1:
            kind, text = "ambiguous_marker", f"marker {marker_id} is seen {count} times in one frame"
        else:
            continue
        events.append(
            Event(message.publish_time_ns, kind, f"{message.topic}: {text}", message.camera, marker_id)
        )
    left_out = {event.marker_id for event in events}
    return tuple(marker for marker in found if marker.id not in left_out), events


def _drawing(time_ns: int, markers: tuple[Marker, ...]) -> ImageAnnotations:
    """Outlines and ids; Foxglove counts pixels from the first pixel's corner, OpenCV from its centre."""
    shifted = [(marker.id, marker.corners_px + 0.5) for marker in markers]
    return ImageAnnotations(
        points=tuple(
            PointsAnnotation(time_ns, 2, tuple(Point2(float(x), float(y)) for x, y in corners), _GREEN, 2.0)
            for _, corners in shifted
        ),
        texts=tuple(
            TextAnnotation(time_ns, Point2(float(corners[0, 0]), float(corners[0, 1])), str(n), 16.0, _GREEN)
            for n, corners in shifted
        ),
    )
