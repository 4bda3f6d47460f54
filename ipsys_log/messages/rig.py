"""Payloads of the lab: the rig, and the camera calibrations."""

from dataclasses import dataclass

from ipsys_log.messages.message import Floats, Mat33, Mat34, TimeNs


@dataclass(frozen=True, slots=True)
class RigMarker:
    """A marker. ``xyz_m`` and ``rpy_rad`` are its pose on its body, see ``schemas/ipsys/v1/rig.proto``."""

    id: int
    length_m: float | None = None
    robot: str | None = None
    height_m: float | None = None
    height_sigma_m: float | None = None
    xyz_m: tuple[float, ...] = ()
    rpy_rad: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class RigBody:
    """A robot as a rigid body: with several markers, with a pivot, or with a tilt.

    A body that is ``level`` stays so, at the heights of its markers. ``pivot_m`` and ``pivot_rpy_rad`` are
    the origin and the axes of ``base_link`` in the coordinates of the body. ``scale_sigma`` is the relative
    standard deviation of its size.
    """

    robot: str
    level: bool
    pivot_m: tuple[float, ...] = ()
    pivot_rpy_rad: tuple[float, ...] = ()
    scale_sigma: float | None = None


@dataclass(frozen=True, slots=True)
class RigCamera:
    """A camera of the rig.

    ``row_time_ns`` lies between the exposures of two rows. ``edge_offset_px`` is the distance by which edges
    of black lie too far inside the black. ``source`` is the source of the frames; ``width`` to ``gain`` are
    the requested camera settings. ``stamp`` is the meaning of the driver's time: ``start`` of the exposure of
    the first row or ``end`` of the frame. ``latency_ns`` is the delay of the stamp after that instant.
    ``calibration`` names the file of its intrinsics.
    """

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
class ReferenceMarker:
    """A marker that is fixed to the floor or to a wall: it shows that a camera has moved."""

    id: int
    length_m: float | None = None


@dataclass(frozen=True, slots=True)
class Floor:
    width_m: float
    depth_m: float


@dataclass(frozen=True, slots=True)
class RigStream:
    """The streams of positions to robots and other programs.

    ``host`` is the address of this machine that other computers can reach; None: only this machine. ``udp``
    are destinations, as ``HOST:PORT``. ``key`` names the file with the key of their signature. ``vrpn`` is
    the port of the VRPN server. ``mavlink`` are autopilots, as ``ROBOT=HOST:PORT``; ``north_rad`` is the
    direction of north, from the x axis of the lab to its y axis. ``robots`` are the streamed robots; empty:
    all. A position that is older than ``stale_s`` is marked or withheld. ``ros2`` is the port of the Zenoh
    router of ROS 2, ``ros2_domain`` the domain ID; ``foxglove`` is the port of the Foxglove server.
    """

    host: str | None = None
    udp: tuple[str, ...] = ()
    key: str | None = None
    vrpn: int | None = None
    robots: tuple[str, ...] = ()
    stale_s: float | None = None
    mavlink: tuple[str, ...] = ()
    north_rad: float | None = None
    ros2: int | None = None
    ros2_domain: int | None = None
    foxglove: int | None = None


@dataclass(frozen=True, slots=True)
class RigNodes:
    """The connection of nodes, which are hosts with cameras, to the centre, which records.

    ``centre`` is the address of the centre, as ``HOST:PORT``; None: only this machine. ``certificates`` names
    the folder of the certificates.
    """

    centre: str | None = None
    certificates: str | None = None


@dataclass(frozen=True, slots=True)
class Rig:
    """The lab, as in ``lab.toml`` and in the channel ``/rig`` (see :mod:`ipsys_log.messages.rig_file`)."""

    name: str
    dictionary: str
    marker_length_m: float
    markers: tuple[RigMarker, ...] = ()
    cameras: tuple[RigCamera, ...] = ()
    reference_points: tuple[ReferencePoint, ...] = ()
    floor: Floor | None = None
    marker_height_m: float | None = None
    tape_sigma_m: float | None = None
    marker_height_sigma_m: float | None = None
    stream: RigStream | None = None
    reference_markers: tuple[ReferenceMarker, ...] = ()
    nodes: RigNodes | None = None
    tape_scale_sigma: float | None = None
    ab_sigma_m: float | None = None
    bodies: tuple[RigBody, ...] = ()

    @property
    def all_markers(self) -> tuple[RigMarker | ReferenceMarker, ...]:
        """The markers of the robots, and the reference markers."""
        return (*self.markers, *self.reference_markers)

    @property
    def is_simulated(self) -> bool:
        """True if all cameras are those of the simulated lab."""
        return bool(self.cameras) and all(str(one.source).startswith("sim:") for one in self.cameras)

    def camera(self, name: str) -> RigCamera:
        """Return the entry of a camera; an empty entry for a camera that is not in the rig."""
        return next((camera for camera in self.cameras if camera.name == name), RigCamera(name))

    def length_of(self, marker_id: int) -> float:
        """Return the side of a marker's black square, in m."""
        for marker in self.all_markers:
            if marker.id == marker_id and marker.length_m is not None:
                return marker.length_m
        return self.marker_length_m

    def height_of(self, marker_id: int) -> float | None:
        """Return the height above the floor at which a robot carries a marker, in m; None if unknown.

        No robot carries a reference marker: its height is 0. A body that is not level has no height.
        """
        if self.is_reference(marker_id):
            return 0.0
        if self.is_free(marker_id):
            return None
        for marker in self.markers:
            if marker.id == marker_id and marker.height_m is not None:
                return marker.height_m
        return self.marker_height_m

    def height_sigma_of(self, marker_id: int) -> float | None:
        """Return the standard deviation of the height of a marker on its robot, in m; None if unknown."""
        for marker in self.markers:
            if marker.id == marker_id and marker.height_sigma_m is not None:
                return marker.height_sigma_m
        return self.marker_height_sigma_m

    def robot_of(self, marker_id: int) -> str:
        """Return the name of the robot that carries a marker."""
        for marker in self.markers:
            if marker.id == marker_id and marker.robot is not None:
                return marker.robot
        return f"marker_{marker_id}"

    def body_of(self, marker_id: int) -> RigBody | None:
        """Return the body that a marker is on; None for a robot that is no body of the rig."""
        if not self.bodies:
            return None
        robot = self.robot_of(marker_id)
        return next((body for body in self.bodies if body.robot == robot), None)

    def is_free(self, marker_id: int) -> bool:
        """Return whether a marker is on a body that is not level: it has no height."""
        body = self.body_of(marker_id)
        return body is not None and not body.level

    def without_height(self) -> list[int]:
        """Return the ids of the markers of level robots whose heights are unknown."""
        return [m.id for m in self.markers if self.height_of(m.id) is None and not self.is_free(m.id)]

    def robot_heights_m(self) -> dict[str, float | None]:
        """Return the robots that the rig names, with the heights of their pivots above the floor in m.

        None: the height is unknown, or the robot is not level.
        """
        heights_m = {marker.robot: self.height_of(marker.id) for marker in self.markers if marker.robot}
        first = {marker.robot: marker for marker in reversed(self.markers)}
        for body in self.bodies:
            marker = first.get(body.robot)
            if marker is not None and (height_m := self.height_of(marker.id)) is not None:
                heights_m[body.robot] = height_m + sum(body.pivot_m[2:]) - sum(marker.xyz_m[2:])
        return heights_m

    def knows(self, marker_id: int) -> bool:
        """Return whether an id is in use: it is listed, or the rig lists no markers of robots."""
        return not self.markers or any(marker.id == marker_id for marker in self.all_markers)

    def is_reference(self, marker_id: int) -> bool:
        """Return whether a marker is fixed to the floor or to a wall."""
        return any(marker.id == marker_id for marker in self.reference_markers)


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """``foxglove.CameraCalibration``: the camera intrinsics.

    ``distortion_model`` is ``kannala_brandt`` (OpenCV's fisheye, k1..k4), ``plumb_bob`` (5) or
    ``rational_polynomial`` (8).
    """

    timestamp: TimeNs
    frame_id: str
    width: int
    height: int
    distortion_model: str
    D: Floats
    K: Mat33
    R: Mat33 | None = None
    P: Mat34 | None = None
