"""A simulated session without images: exact geometry, and markers with the noise of ``detect``."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ipsys_log.capture.simulation.calibration_points import SimulatedPose
from ipsys_log.capture.simulation.cameras import Camera, mount_cameras
from ipsys_log.capture.simulation.drive import Drive, plan_drive
from ipsys_log.capture.simulation.settings import LabSettings, Purpose, random_stream
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, CameraCalibration
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import transform
from tests.geometric.points import choose_points
from tests.geometric.smooth_fields import SmoothField, SmoothSignal
from tests.geometric.tilted_cameras import aim_cameras

# Kinds of intrinsics that the user has.
INTRINSICS = ("true", "calibrated", "nominal")
# Tilts above this are for cameras that are aimed at the floor from the side.
_MOST_TILT_DEG = 5.0
_NOMINAL_FOCAL_ERROR = 0.05


@dataclass(frozen=True, slots=True)
class IntrinsicsSigma:
    """Standard deviations of an intrinsic calibration: like those of a few dozen chessboard images.

    ``focal`` is relative; ``principal_point_px`` is for 1920 px of width; ``distortion`` is that of k1..k4.
    """

    focal: float = 0.0005
    principal_point_px: float = 0.5
    distortion: tuple[float, float, float, float] = (0.0005, 0.0005, 0.0005, 0.0005)


@dataclass(frozen=True, slots=True, kw_only=True)
class GeometricSettings:
    """The settings of a session without images.

    Attributes
    ----------
    lab : settings of the lab. ``stations``, JPEG and grey levels of the floor have no effect.
    points, held_out_points : number of all taped points for the fit, and of further points with the split
        ``test``.
    intrinsics : the calibration that the user has: ``true``, ``calibrated`` (true plus errors of
        ``intrinsics_sigma``), or ``nominal``: focal length wrong by 5 %, principal point in the middle of the
        image, no distortion.
    floor_rms_m, floor_length_m : unevenness of the floor, and its correlation length. Markers follow the
        height and the slope of the floor.
    wobble_deg, wobble_s : tilt of a driving robot about each horizontal axis (RMS), and its correlation time.
    clock_offset_s : the stamps of each camera are late by a constant, uniform between minus and plus this.
    frame_delays_s : true delay of the frames of each camera after those of the first; repeated if short.
    marker_scale_sigma : relative standard deviation of the true side of each marker; the rig has the nominal
        one.
    robot_height_sigma_m : standard deviation of the true height of each robot's marker; the rig has
        ``drive_height_m`` for all.
    row_time_in_rig : whether the rig has the row time of the lab; otherwise markers have no time offset.
    corner_noise : factor of the corner noise; 0 gives exact corners with the usual covariances.
    """

    lab: LabSettings = field(default_factory=lambda: LabSettings(rate_hz=10.0, drive_s=0.0))
    points: int = 75
    held_out_points: int = 0
    intrinsics: str = "calibrated"
    intrinsics_sigma: IntrinsicsSigma = IntrinsicsSigma()
    floor_rms_m: float = 0.0
    floor_length_m: float = 0.5
    wobble_deg: float = 0.0
    wobble_s: float = 0.5
    clock_offset_s: float = 0.0
    frame_delays_s: tuple[float, ...] = (0.0,)
    marker_scale_sigma: float = 0.0
    robot_height_sigma_m: float = 0.0
    row_time_in_rig: bool = True
    corner_noise: float = 1.0

    def __post_init__(self) -> None:
        if self.intrinsics not in INTRINSICS:
            raise IpsysError(
                f"simulator: intrinsics {self.intrinsics!r} are not known; use one of {', '.join(INTRINSICS)}"
            )
        if not self.frame_delays_s:
            raise IpsysError("simulator: frame_delays_s is empty; give at least one delay in s")
        numbers = {
            "points": self.points,
            "held_out_points": self.held_out_points,
            "floor_rms_m": self.floor_rms_m,
            "wobble_deg": self.wobble_deg,
            "clock_offset_s": self.clock_offset_s,
            "marker_scale_sigma": self.marker_scale_sigma,
            "robot_height_sigma_m": self.robot_height_sigma_m,
            "corner_noise": self.corner_noise,
        }
        for name, value in numbers.items():
            if not (math.isfinite(value) and value >= 0):
                raise IpsysError(f"simulator setting {name} is {value!r}; give a number of at least 0")
        if not self.points + self.held_out_points and not self.lab.drive_s:
            raise IpsysError("simulator: nothing to see with points = 0 and drive_s = 0; set one of them")
        for name, value in {"floor_length_m": self.floor_length_m, "wobble_s": self.wobble_s}.items():
            if not (math.isfinite(value) and value >= 0.05):
                raise IpsysError(f"simulator setting {name} is {value!r}; give a number of at least 0.05")


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMarkers:
    """True poses of markers: ``centres_m`` (n, 3), ``rotations`` (n, 3, 3) from marker to world."""

    centres_m: Array
    rotations: Array

    def corners_m(self, length_m: float | Array) -> Array:
        """Return the corners of squares in OpenCV's order, (n, 4, 3) in world m; one side, or (n,) sides."""
        arms_m = marker_corners(1.0) * np.reshape(length_m, (-1, 1, 1))
        corners: Array = arms_m @ self.rotations.swapaxes(1, 2) + self.centres_m[:, None]
        return corners


@dataclass(frozen=True, slots=True, eq=False)
class GeometricLab:
    """A simulated lab with its ground truth.

    Attributes
    ----------
    settings : of the session.
    cameras : the true cameras.
    calibrations : the intrinsics that the user has, by camera.
    floor : the unevenness, in m.
    clock_offsets_ns : by camera; a stamp is the true time plus this.
    frame_delays_ns : by camera; true time of a frame after the instant of all cameras.
    points : calibration points, in sets of simultaneous ones; z_m is the height above the uneven floor.
    drive : the robots' path; its height is that of the rig.
    sides_m, robot_heights_m : true side of each marker, and its true height above the floor on its robot.
    wobble : by marker, the tilts of a robot in rad about world x and y.
    """

    settings: GeometricSettings
    cameras: tuple[Camera, ...]
    calibrations: Mapping[str, CameraCalibration]
    floor: SmoothField
    clock_offsets_ns: Mapping[str, int]
    frame_delays_ns: Mapping[str, int]
    points: tuple[tuple[SimulatedPose, ...], ...]
    drive: Drive
    sides_m: Mapping[int, float]
    robot_heights_m: Mapping[int, float]
    wobble: Mapping[int, SmoothSignal]

    def camera(self, name: str) -> Camera:
        """Return a true camera by its name."""
        return next(camera for camera in self.cameras if camera.name == name)

    def place(self, poses: Array, tilts_rad: Array | None = None) -> PlacedMarkers:
        """Return markers that lie on the uneven floor, or on robots that stand on it.

        Parameters
        ----------
        poses : (n, 4): x, y, height above the floor in m, and heading in rad.
        tilts_rad : (n, 2), rotations about world x and y in addition to the slope of the floor.
        """
        from scipy.spatial.transform import Rotation

        slopes = self.floor.gradient(poses[:, :2])
        turns = np.zeros((len(poses), 3))
        turns[:, 0], turns[:, 1] = slopes[:, 1], -slopes[:, 0]
        if tilts_rad is not None:
            turns[:, :2] += tilts_rad
        upright = np.zeros((len(poses), 3))
        upright[:, 2] = poses[:, 3] - np.pi / 2
        rotations = (Rotation.from_rotvec(turns) * Rotation.from_rotvec(upright)).as_matrix()
        centres_m = poses[:, :3].copy()
        centres_m[:, 2] += self.floor.at(poses[:, :2])
        return PlacedMarkers(centres_m, rotations)

    def drive_poses(self, marker_id: int, times_s: Array) -> PlacedMarkers:
        """Return the true poses of a robot's marker at times (n,) in s after the start of the drive."""
        path = poses_over(self.drive, marker_id, times_s)
        poses = np.insert(path, 2, self.robot_heights_m[marker_id], axis=1)
        return self.place(poses, self.wobble[marker_id].at(times_s))


def poses_over(drive: Drive, marker_id: int, times_s: Array) -> Array:
    """Return x, y and heading of one marker at times (n,) after the start: (n, 3), in m and rad."""
    (x_m, y_m), (dx, dy) = drive.follow(marker_id, np.maximum(times_s, 0.0))
    return np.stack([x_m, y_m, np.arctan2(dy, dx)], axis=1)


def build_lab(settings: GeometricSettings, cameras: tuple[Camera, ...] = ()) -> GeometricLab:
    """Draw a lab: cameras, their calibrations, the floor, the clocks, the points and the drive.

    Equal settings give equal labs. Given ``cameras`` have the names of the settings.

    Raises
    ------
    IpsysError
        The field of view of a camera has no room for a point.
    """
    lab = settings.lab
    cameras = cameras or (aim_cameras if lab.tilt_deg[1] > _MOST_TILT_DEG else mount_cameras)(lab)
    clock_offsets_ns, frame_delays_ns = _clocks(settings)
    rng = random_stream(lab.seed, Purpose.UNEVENNESS)
    floor = SmoothField.draw(settings.floor_rms_m, settings.floor_length_m, max(lab.floor_m), rng)
    prints = random_stream(lab.seed, Purpose.PRINTS).standard_normal((lab.markers, 2))
    scales = 1 + settings.marker_scale_sigma * prints[:, 0]
    heights_m = lab.drive_height_m + settings.robot_height_sigma_m * prints[:, 1]
    drive = plan_drive(lab, cameras)
    return GeometricLab(
        settings,
        cameras,
        _calibrations(settings, cameras),
        floor,
        clock_offsets_ns,
        frame_delays_ns,
        choose_points(lab, cameras, settings.points + settings.held_out_points),
        drive,
        dict(enumerate((lab.marker_length_m * scales).tolist())),
        dict(enumerate(heights_m.tolist())),
        {marker_id: _wobble(settings, marker_id) for marker_id in drive.ahead_s},
    )


def _clocks(settings: GeometricSettings) -> tuple[dict[str, int], dict[str, int]]:
    """Return the clock offset and the delay of the frames of each camera, in ns."""
    names, delays_s = settings.lab.cameras, settings.frame_delays_s
    drawn = random_stream(settings.lab.seed, Purpose.CLOCK).uniform(-1, 1, len(names))
    offsets_s = (drawn * settings.clock_offset_s).tolist()
    offsets_ns = {name: round(offset_s * NS_PER_S) for name, offset_s in zip(names, offsets_s, strict=True)}
    return offsets_ns, {name: round(delays_s[n % len(delays_s)] * NS_PER_S) for n, name in enumerate(names)}


def _wobble(settings: GeometricSettings, marker_id: int) -> SmoothSignal:
    rng = random_stream(settings.lab.seed, Purpose.WOBBLE, marker_id)
    rms_rad = float(np.radians(settings.wobble_deg))
    return SmoothSignal.draw(rms_rad, settings.wobble_s, settings.lab.drive_s, 2, rng)


def _calibrations(settings: GeometricSettings, cameras: tuple[Camera, ...]) -> dict[str, CameraCalibration]:
    rng = random_stream(settings.lab.seed, Purpose.INTRINSICS)
    # All cameras of a lab are of the same make, so their nominal focal length has the same error.
    nominal = 1 + _NOMINAL_FOCAL_ERROR * rng.choice([-1.0, 1.0])
    calibrations = {}
    for camera in cameras:
        drawn = rng.standard_normal(7)
        calibrations[camera.name] = _calibration(camera.lens, settings, nominal, drawn)
    return calibrations


def _calibration(
    lens: CameraCalibration, settings: GeometricSettings, nominal: float, drawn: Array
) -> CameraCalibration:
    if settings.intrinsics == "true":
        return lens
    K, D = lens.K.copy(), lens.D.copy()
    if settings.intrinsics == "nominal":
        K[0, 0] = K[1, 1] = nominal * lens.K[0, 0]
        K[:2, 2] = (lens.width - 1) / 2, (lens.height - 1) / 2
        D = np.zeros(4)
    else:
        sigma = settings.intrinsics_sigma
        K[0, 0] *= 1 + sigma.focal * drawn[0]
        K[1, 1] *= 1 + sigma.focal * drawn[0]
        K[:2, 2] += sigma.principal_point_px * lens.width / 1920 * drawn[1:3]
        D[:4] += np.array(sigma.distortion) * drawn[3:]
    return replace(lens, K=K, D=D, P=np.hstack([K, np.zeros((3, 1))]))


def camera_poses(camera: Camera, placed: PlacedMarkers) -> tuple[Array, Array]:
    """Return rotations (n, 3, 3) and centres (n, 3) from marker coordinates to camera coordinates."""
    rotations: Array = camera.camera_from_world[:3, :3] @ placed.rotations
    return rotations, transform(camera.camera_from_world, placed.centres_m)
