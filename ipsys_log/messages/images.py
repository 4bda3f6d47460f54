"""Payloads of images: images, video frames, drawings, detected markers and their camera points."""

from dataclasses import dataclass

from ipsys_log.messages.message import Corners, Mat33, Mat88, TimeNs, Vec3


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


@dataclass(frozen=True, slots=True, eq=False)
class Marker:
    """A marker in a frame.

    ``corners_px`` are in px of the raw image, clockwise from the marker's top left; (0, 0) is the centre of
    the first pixel. ``covariance_px2`` is that of x0 y0 .. x3 y3, in single precision. The marker was exposed
    ``time_offset_ns`` after the time of the frame. Its edges of black lie ``edge_offset_px`` too far inside
    the black. ``contradicted`` is True from the frame on in which the markers of this camera contradict its
    intrinsics.
    """

    id: int
    corners_px: Corners
    covariance_px2: Mat88 | None = None
    time_offset_ns: int | None = None
    edge_offset_px: float | None = None
    contradicted: bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Markers:
    """All markers in a frame of ``width`` x ``height`` px, sorted by id.

    If a node has detected them, the log of the centre has the session of the node, and the number of the
    frame in it.
    """

    timestamp: TimeNs
    markers: tuple[Marker, ...]
    width: int
    height: int
    node_session: str | None = None
    node_frame: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MarkerPose:
    """The pose of a marker in camera coordinates.

    It has the centre, the rotation vector from the marker's axes to the camera's axes, and the reprojection
    error (RMS) of the corners.
    """

    x_m: float
    y_m: float
    z_m: float
    rotation_rad: Vec3
    reprojection_px: float


@dataclass(frozen=True, slots=True, eq=False)
class CameraPoint:
    """The centre of a marker in camera coordinates: x right, y down, z forward.

    ``poses`` are the solutions for a planar square, the selected one first; empty for eq. (3).
    ``contradicted`` is that of the marker.
    """

    id: int
    x_m: float
    y_m: float
    z_m: float
    heading_rad: float | None = None
    time_offset_ns: int | None = None
    covariance_m2: Mat33 | None = None
    poses: tuple[MarkerPose, ...] = ()
    contradicted: bool | None = None


@dataclass(frozen=True, slots=True)
class CameraPoints:
    timestamp: TimeNs
    points: tuple[CameraPoint, ...]
