"""Payloads of the detection: markers in images, and their points in camera coordinates."""

from __future__ import annotations

from dataclasses import dataclass

from ipsys_log.messages.message import Corners, Mat33, Mat88, TimeNs, Vec3

__all__ = ["CameraPoint", "CameraPoints", "Marker", "MarkerPose", "Markers"]


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
