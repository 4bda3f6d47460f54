"""What travels through the pipeline: frozen payloads, each a mirror of one schema of the log.

A field here has the name of the field in the schema; :mod:`ipsys_log.log.codec` turns one into the
other by these names and types. Lengths are metres, angles radians, times nanoseconds since 1970
(UTC). What is missing is ``None`` or empty, never 0 and never NaN.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

TimeNs = Annotated[int, "google.protobuf.Timestamp"]

Floats = Annotated[NDArray[np.float64], (-1,)]
Vec3 = Annotated[NDArray[np.float64], (3,)]
Mat33 = Annotated[NDArray[np.float64], (3, 3)]
Mat34 = Annotated[NDArray[np.float64], (3, 4)]
Corners = Annotated[NDArray[np.float64], (4, 2)]
Mat88 = Annotated[NDArray[np.float64], (8, 8)]


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """A payload on a topic, with the two times of the log.

    ``camera`` is the camera it belongs to, or None: the rig, a measurement, a track.
    """

    topic: str
    log_time_ns: int
    publish_time_ns: int
    payload: Any
    camera: str | None = None


# --- topics -------------------------------------------------------------------------------------

RIG_TOPIC = "/rig"
MEASUREMENTS_TOPIC = "/measurements"
EVENTS_TOPIC = "/events"
LATENCY_TOPIC = "/latency"
TRUTH_TOPIC = "/truth/tracks"

# The kind of an event whose timestamp is the log time of a frame that no stage has seen when it was recorded.
FRAME_SKIPPED = "frame_skipped"
# The kind of an event for late frames of a camera that have their time of arrival.
STAMP_UNRELIABLE = "stamp_unreliable"


def image_topic(camera: str) -> str:
    return f"/cameras/{camera}/image"


def calibration_topic(camera: str) -> str:
    return f"/cameras/{camera}/calibration"


# --- the lab ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RigMarker:
    id: int
    length_m: float | None = None
    robot: str | None = None
    height_m: float | None = None


@dataclass(frozen=True, slots=True)
class RigCamera:
    """A camera: ``row_time_ns`` lies between the exposures of two rows, ``edge_offset_px`` is by how much
    edges of black lie too far inside the black.

    ``source`` says where frames come from, ``width`` to ``gain`` what the camera is asked for. ``stamp`` is
    what the driver's time means, ``start`` of the exposure of the first row or ``end`` of the frame, and
    ``latency_ns`` how long after that the stamp is taken. ``calibration`` names the file of its lens."""

    name: str
    row_time_ns: int | None = None
    edge_offset_px: float | None = None
    source: str | None = None
    width: int | None = None
    height: int | None = None
    rate_hz: float | None = None
    exposure_s: float | None = None
    focus: float | None = None
    gain: float | None = None
    stamp: str | None = None
    latency_ns: int | None = None
    calibration: str | None = None


@dataclass(frozen=True, slots=True)
class ReferencePoint:
    name: str
    x_m: float
    y_m: float


@dataclass(frozen=True, slots=True)
class Floor:
    width_m: float
    depth_m: float


@dataclass(frozen=True, slots=True)
class Rig:
    """The lab, as ``lab.toml`` and the channel ``/rig`` hold it (see :mod:`ipsys_log.rig.file`)."""

    name: str
    dictionary: str
    marker_length_m: float
    markers: tuple[RigMarker, ...] = ()
    cameras: tuple[RigCamera, ...] = ()
    reference_points: tuple[ReferencePoint, ...] = ()
    floor: Floor | None = None
    marker_height_m: float | None = None
    tape_sigma_m: float | None = None

    def camera(self, name: str) -> RigCamera:
        """What is said of a camera."""
        return next((camera for camera in self.cameras if camera.name == name), RigCamera(name))

    def length_of(self, marker_id: int) -> float:
        """Side of a marker's black square, in m."""
        for marker in self.markers:
            if marker.id == marker_id and marker.length_m is not None:
                return marker.length_m
        return self.marker_length_m

    def height_of(self, marker_id: int) -> float | None:
        """Height above the floor at which a marker is carried, in m, where it is known."""
        for marker in self.markers:
            if marker.id == marker_id and marker.height_m is not None:
                return marker.height_m
        return self.marker_height_m

    def robot_of(self, marker_id: int) -> str:
        """Name of the robot that carries a marker."""
        for marker in self.markers:
            if marker.id == marker_id and marker.robot is not None:
                return marker.robot
        return f"marker_{marker_id}"

    def knows(self, marker_id: int) -> bool:
        """Return whether an id is in use here: listed, or nothing is listed."""
        return not self.markers or any(marker.id == marker_id for marker in self.markers)


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """``foxglove.CameraCalibration``: the lens. ``distortion_model`` is ``kannala_brandt``
    (OpenCV's fisheye, k1..k4), ``plumb_bob`` (5) or ``rational_polynomial`` (8)."""

    timestamp: TimeNs
    frame_id: str
    width: int
    height: int
    distortion_model: str
    D: Floats
    K: Mat33
    R: Mat33 | None = None
    P: Mat34 | None = None


# --- frames -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class CompressedImage:
    """``foxglove.CompressedImage``: the frame as the camera sent it."""

    timestamp: TimeNs
    frame_id: str
    data: bytes
    format: str


@dataclass(frozen=True, slots=True, eq=False)
class CompressedVideo:
    """``foxglove.CompressedVideo``: one frame of a video, H.264 or H.265 in Annex B; each keyframe has its
    parameter sets before it, and no frame needs a later one."""

    timestamp: TimeNs
    frame_id: str
    data: bytes
    format: str


@dataclass(frozen=True, slots=True, eq=False)
class SkippedVideo:
    """A frame of a video that is decoded, since those after it need it, and not searched. It is in no log:
    there the frame is itself, and an event names it."""

    frame: CompressedVideo


@dataclass(frozen=True, slots=True, eq=False)
class RawImage:
    """``foxglove.RawImage``, in the logs of others."""

    timestamp: TimeNs
    frame_id: str
    width: int
    height: int
    encoding: str
    step: int
    data: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Marker:
    """A marker in a frame: corners in px of the raw image, clockwise from the marker's top left,
    (0, 0) the centre of the first pixel; ``covariance_px2`` of x0 y0 .. x3 y3, in single precision;
    exposed ``time_offset_ns`` after the time of the frame; edges of black lie ``edge_offset_px`` too far
    inside the black."""

    id: int
    corners_px: Corners
    covariance_px2: Mat88 | None = None
    time_offset_ns: int | None = None
    edge_offset_px: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Markers:
    """All markers in a frame of ``width`` x ``height`` px, sorted by id."""

    timestamp: TimeNs
    markers: tuple[Marker, ...]
    width: int
    height: int


@dataclass(frozen=True, slots=True, eq=False)
class MarkerPose:
    """A marker in the frame of the camera: its centre, the rotation vector that takes the marker's axes to
    the camera's, and by how much (RMS) the corners that follow from it miss those that were seen."""

    x_m: float
    y_m: float
    z_m: float
    rotation_rad: Vec3
    reprojection_px: float


@dataclass(frozen=True, slots=True, eq=False)
class CameraPoint:
    """Centre of a marker in the frame of the camera: x right, y down, z forward; ``poses`` are the solutions
    for a planar square, the one that was taken first, or none for eq. (3)."""

    id: int
    x_m: float
    y_m: float
    z_m: float
    heading_rad: float | None = None
    time_offset_ns: int | None = None
    covariance_m2: Mat33 | None = None
    poses: tuple[MarkerPose, ...] = ()


@dataclass(frozen=True, slots=True)
class CameraPoints:
    timestamp: TimeNs
    points: tuple[CameraPoint, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Position:
    """A marker in the world, as one camera has it; ``inside`` the volume of the measured places or not."""

    id: int
    x_m: float
    y_m: float
    z_m: float
    heading_rad: float | None = None
    covariance_m2: Mat33 | None = None
    inside: bool | None = None
    time_offset_ns: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    timestamp: TimeNs
    positions: tuple[Position, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A robot in the world, from all the cameras that saw it."""

    robot: str
    id: int
    x_m: float
    y_m: float
    z_m: float
    heading_rad: float | None = None
    covariance_m2: Mat33 | None = None
    cameras: tuple[str, ...] = ()
    inside: bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    timestamp: TimeNs
    tracks: tuple[Track, ...]


@dataclass(frozen=True, slots=True)
class Event:
    """An event that a reader of the log must know, such as a corrupt frame.

    ``start`` and ``end`` are the first and the last time of the frames that an event of kind
    ``stamp_unreliable`` affects; without ``end``, the last time is not known yet.
    """

    timestamp: TimeNs
    kind: str
    text: str
    camera: str | None = None
    marker_id: int | None = None
    start: TimeNs | None = None
    end: TimeNs | None = None


@dataclass(frozen=True, slots=True)
class Latency:
    """When the steps from a frame to its positions were done, by the wall clock. Telemetry: no stage reads
    it."""

    timestamp: TimeNs
    camera: str
    received: TimeNs
    detected: TimeNs
    located: TimeNs
    fused: TimeNs
    published: TimeNs


# --- measurements -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Distance:
    reference: str
    distance_m: float
    sigma_m: float | None = None


@dataclass(frozen=True, slots=True)
class Interval:
    start: TimeNs
    end: TimeNs


@dataclass(frozen=True, slots=True)
class WorldPoint:
    x_m: float
    y_m: float
    z_m: float


@dataclass(frozen=True, slots=True)
class Measurement:
    """One place of one marker, measured by hand; or, with ``withdraws``, the end of one."""

    timestamp: TimeNs
    id: str
    withdraws: str | None = None
    marker_id: int | None = None
    distances: tuple[Distance, ...] = ()
    side: str | None = None
    height_m: float | None = None
    height_sigma_m: float | None = None
    still: Interval | None = None
    point: WorldPoint | None = None
    splits: tuple[str, ...] = ()


# --- models and their errors --------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Parameter:
    """A named array of a model: ``values`` in C order of ``shape``."""

    name: str
    shape: tuple[int, ...]
    values: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """A measured place: mean camera point of the still marker, and its world point."""

    measurement: str
    marker_id: int
    camera_m: Vec3
    world_m: Vec3
    frames: int
    world_covariance_m2: Mat33 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """What a position's covariance is made of, see :mod:`ipsys_log.models.uncertainty`.

    ``along`` is the relative error of a depth, ``across`` that of (u, v), ``growth`` the power by which
    they grow; ``fit`` the covariance of (u, v, ln Zc) that has the effect of the uncertainty of the fit.
    """

    along: float
    across: float
    growth: float
    fit: Mat33


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    camera: str
    parameters: tuple[Parameter, ...]
    covariance_m2: Mat33 | None = None
    pairs: tuple[Pair, ...] = ()
    noise: Noise | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    timestamp: TimeNs
    name: str
    cameras: tuple[CameraModel, ...]


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Of a set of distances; ``std_m`` with count - 1, as in Tables I and II. ``mean_low_m`` and
    ``mean_high_m`` are the 95 % confidence interval of the mean."""

    count: int
    mean_m: float
    min_m: float
    max_m: float
    std_m: float | None = None
    median_m: float | None = None
    p95_m: float | None = None
    mean_low_m: float | None = None
    mean_high_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    measurement: str
    world_m: Vec3
    predicted_m: Vec3


@dataclass(frozen=True, slots=True, eq=False)
class CameraEvaluation:
    """Errors of one camera (``""``: of all) against the ``tape`` or, in a simulated lab, the ``truth``.

    ``scheme`` is ``held_out`` (also where absent) or ``cross_validation``; the latter has a residual
    for each place and repeat, repeat by repeat. ``within_68`` and ``within_95`` are the shares of them
    within these regions of their covariance.
    """

    camera: str
    against: str
    error_3d: ErrorStatistics | None
    error_2d: ErrorStatistics
    residuals: tuple[Residual, ...] = ()
    scheme: str | None = None
    bias_m: Vec3 | None = None
    within_68: float | None = None
    within_95: float | None = None


@dataclass(frozen=True, slots=True)
class LearningPoint:
    """Mean errors of models fitted on ``pairs`` places: of the subset called ``label``, or of random ones."""

    camera: str
    pairs: int
    mean_3d_m: float
    mean_2d_m: float
    subsets: int
    label: str | None = None
    std_3d_m: float | None = None
    std_2d_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Suspect:
    """A measurement that disagrees with the model fitted without it, and what would explain it.

    ``residual_m`` is predicted minus measured, the mean over ``cameras``; ``score`` its length in units
    of the usual one; ``kind`` one of ``side``, ``swapped``, ``distance``, ``height``, or None.
    """

    measurement: str
    cameras: tuple[str, ...]
    residual_m: Vec3
    score: float
    kind: str | None = None
    text: str | None = None
    corrected_m: Vec3 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    timestamp: TimeNs
    model: str
    cameras: tuple[CameraEvaluation, ...]
    learning: tuple[LearningPoint, ...] = ()
    suspects: tuple[Suspect, ...] = ()


# --- where a run comes from ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """A calibration in force in a run, without its time."""

    camera: str
    width: int
    height: int
    distortion_model: str
    d: Floats
    k: Mat33


@dataclass(frozen=True, slots=True)
class ChannelRead:
    topic: str
    messages: int
    hash: str


@dataclass(frozen=True, slots=True)
class ChannelWritten:
    topic: str
    messages: int


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    timestamp: TimeNs
    run: str
    stage: str
    parameters: dict[str, str] = field(default_factory=dict)
    fingerprint: dict[str, str] = field(default_factory=dict)
    rig: Rig | None = None
    lenses: tuple[Lens, ...] = ()
    input_runs: tuple[str, ...] = ()
    inputs: tuple[ChannelRead, ...] = ()
    outputs: tuple[ChannelWritten, ...] = ()
    number: int = 0


# --- for viewers --------------------------------------------------------------------------------


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
    """``type`` 2 is a closed line. Pixels from the corner of the first pixel, not its centre."""

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


@dataclass(frozen=True, slots=True)
class Vector3:
    x: float
    y: float
    z: float


@dataclass(frozen=True, slots=True)
class Quaternion:
    x: float
    y: float
    z: float
    w: float


@dataclass(frozen=True, slots=True)
class FrameTransform:
    timestamp: TimeNs
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


@dataclass(frozen=True, slots=True)
class FrameTransforms:
    transforms: tuple[FrameTransform, ...]
