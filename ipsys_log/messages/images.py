"""Payloads of the cameras: images, video frames, and drawings on images."""

from __future__ import annotations

from dataclasses import dataclass

from ipsys_log.messages.message import TimeNs


@dataclass(frozen=True, slots=True, eq=False)
class CompressedImage:
    """``foxglove.CompressedImage``: the frame, as the camera sent it."""

    timestamp: TimeNs
    frame_id: str
    data: bytes
    format: str


@dataclass(frozen=True, slots=True, eq=False)
class CompressedVideo:
    """``foxglove.CompressedVideo``: one frame of a video, H.264 or H.265 in Annex B.

    Each keyframe has its parameter sets before it, and no frame needs a later one.
    """

    timestamp: TimeNs
    frame_id: str
    data: bytes
    format: str


@dataclass(frozen=True, slots=True, eq=False)
class SkippedVideo:
    """A frame of a video that is decoded because later frames need it, and that is not searched.

    No log contains it: the log has the frame itself, and an event names it.
    """

    frame: CompressedVideo


@dataclass(frozen=True, slots=True, eq=False)
class RawImage:
    """``foxglove.RawImage``, in logs of other recorders."""

    timestamp: TimeNs
    frame_id: str
    width: int
    height: int
    encoding: str
    step: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Point2:
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class Color:
    r: float
    g: float
    b: float
    a: float


@dataclass(frozen=True, slots=True)
class PointsAnnotation:
    """Points of a drawing; ``type`` 2 is a closed line.

    Pixels count from the corner of the first pixel, not its centre.
    """

    timestamp: TimeNs
    type: int
    points: tuple[Point2, ...]
    outline_color: Color
    thickness: float


@dataclass(frozen=True, slots=True)
class TextAnnotation:
    timestamp: TimeNs
    position: Point2
    text: str
    font_size: float
    text_color: Color


@dataclass(frozen=True, slots=True)
class ImageAnnotations:
    points: tuple[PointsAnnotation, ...]
    texts: tuple[TextAnnotation, ...]
