"""Payloads of the lab: the rig, and the camera calibrations."""

from __future__ import annotations

from dataclasses import dataclass

from ipsys_log.messages.message import Floats, Mat33, Mat34, TimeNs

__all__ = ["CameraCalibration", "Floor", "ReferencePoint", "Rig", "RigCamera", "RigMarker"]


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
