"""Geometric labs for the benchmark of calibration: their scenes, and the calibrations that are compared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from rendered_labs import rendered_lab

from ipsys_log.calibration.joint.fit import JointFit, fit_jointly
from ipsys_log.calibration.joint.from_messages import gather_observations
from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.model import build_models
from ipsys_log.calibration.joint.observations import Observations
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import CameraCalibration, CameraPoints, Markers, Measurement, Message, Pair, Rig
from ipsys_log.stages.camera_frame import CameraFrame
from ipsys_log.statistics.calibration_points import build_pairs, gather_sightings, valid_measurements
from ipsys_log.statistics.camera_models import fit_model
from ipsys_log.vision.lenses import in_image, project
from ipsys_log.vision.poses import transform
from tests.geometric.corner_noise import WHITE_SHARE, corner_covariances, draw_corner_noise, edge_sigma_px
from tests.geometric.floor_error import (
    KnownSightings,
    Locator,
    compute_errors,
    grid_nodes,
    locate_with_model,
    summarize,
)
from tests.geometric.lab import (
    GeometricLab,
    GeometricSettings,
    PlacedMarkers,
    build_lab,
    camera_poses,
    poses_over,
)
from tests.geometric.session import simulate_session

__all__ = [
    "CONTENDERS",
    "SCENES",
    "USE_DRIVES",
    "Scene",
    "Session",
    "fit_session",
    "joint_locator",
    "make_session",
    "nodes_of",
    "observe_session",
    "shares_by_place",
    "standing_robots",
]

Array = NDArray[np.float64]

# Places of held-out points and of a driving robot, each seen by up to three cameras.
_HELD_OUT, _DRIVEN = 100, 200
# Standard deviation of a corner of detect, as a weight for corners without noise.
_USUAL_PX = 0.012


@dataclass(frozen=True, slots=True)
class Scene:
    """The settings of a lab by its name. Markers of ``rendered`` labs come from images, through detect."""

    name: str
    settings: GeometricSettings
    rendered: bool = False

    @property
    def drives(self) -> bool:
        return self.settings.lab.drive_s > 0

    def seeded(self, seed: int) -> GeometricSettings:
        """Return the settings of the scene's lab with a seed."""
        return replace(self.settings, lab=replace(self.settings.lab, seed=seed))


_STILL = LabSettings(rate_hz=10.0, drive_s=0.0)
_DRIVE = LabSettings(rate_hz=10.0, drive_s=120.0, markers=1)
_ROLLING = replace(_DRIVE, row_time_ns=31_000)
_CLOCKS, _DELAYS_S = 0.025, (0.0, 0.011, 0.022)

# ``points`` are taped points, ``drive`` is a robot that drives for 120 s at 10 Hz. ``exact`` and ``nominal``
# are kinds of intrinsics; the others have an error of calibration. ``1.5 mm`` is the unevenness of the floor,
# ``tilted`` means cameras with 20 to 30 degrees, ``clocks`` offsets of up to 25 ms, and ``all`` all of these
# faults but tilts.
SCENES = (
    Scene("75 points", GeometricSettings(lab=_STILL)),
    Scene("75 points, exact", GeometricSettings(lab=_STILL, intrinsics="true")),
    Scene("75 points, nominal", GeometricSettings(lab=_STILL, intrinsics="nominal")),
    Scene("16 points", GeometricSettings(lab=_STILL, points=16)),
    Scene("16 points, nominal", GeometricSettings(lab=_STILL, points=16, intrinsics="nominal")),
    Scene("drive and 4", GeometricSettings(lab=_DRIVE, points=4)),
    Scene("drive and 8", GeometricSettings(lab=_DRIVE, points=8)),
    Scene("drive and 16", GeometricSettings(lab=_DRIVE, points=16)),
    Scene("drive and 75", GeometricSettings(lab=_DRIVE, points=75)),
    Scene(
        "drive and 16, clocks",
        GeometricSettings(lab=_DRIVE, points=16, clock_offset_s=_CLOCKS, frame_delays_s=_DELAYS_S),
    ),
    Scene("75 points, 1.5 mm", GeometricSettings(lab=_STILL, floor_rms_m=0.0015)),
    Scene("75 points, 3 mm", GeometricSettings(lab=_STILL, floor_rms_m=0.003)),
    Scene("16 points, 3 mm", GeometricSettings(lab=_STILL, points=16, floor_rms_m=0.003)),
    Scene("75 points, tilted", GeometricSettings(lab=replace(_STILL, tilt_deg=(20.0, 30.0)))),
    Scene(
        "drive and 16, 1.5 mm",
        GeometricSettings(
            lab=_DRIVE,
            points=16,
            floor_rms_m=0.0015,
            wobble_deg=0.2,
            clock_offset_s=_CLOCKS,
            frame_delays_s=_DELAYS_S,
        ),
    ),
    Scene(
        "drive and 16, wobble",
        GeometricSettings(lab=_DRIVE, points=16, wobble_deg=0.6),
    ),
    Scene(
        "drive and 16, all",
        GeometricSettings(
            lab=_ROLLING,
            points=16,
            floor_rms_m=0.0015,
            wobble_deg=0.2,
            clock_offset_s=_CLOCKS,
            frame_delays_s=_DELAYS_S,
            marker_scale_sigma=0.002,
            robot_height_sigma_m=0.001,
        ),
    ),
    Scene("drive and 16, rolling", GeometricSettings(lab=_ROLLING, points=16)),
    Scene("rendered, 75 points", GeometricSettings(lab=_STILL), rendered=True),
    Scene("rendered, 16 points", GeometricSettings(lab=_STILL, points=16), rendered=True),
)


@dataclass(frozen=True, eq=False)
class Session:
    """A session of a lab: its ground truth, its messages, and its rig."""

    lab: GeometricLab
    messages: Sequence[Message]
    rig: Rig

    @property
    def measured_m(self) -> Array:
        """The true positions of the calibration points, (p, 2)."""
        return np.array([(pose.x_m, pose.y_m) for poses in self.lab.points for pose in poses])

    @cached_property
    def pairs(self) -> dict[str, list[Pair]]:
        """Pairs of camera points and calibration points by camera, for the models of the table."""
        stage = CameraFrame()
        points: list[Message] = []
        for message in self.messages:
            if isinstance(message.payload, (Rig, CameraCalibration, Markers)):
                payloads = [one for one in stage(message) if isinstance(one, CameraPoints)]
                points.extend(replace(message, payload=payload) for payload in payloads)
        return build_pairs(gather_sightings(points), valid_measurements(self.messages, None))


def make_session(scene: Scene, seed: int) -> Session:
    """Simulate a session of a lab."""
    if scene.rendered:
        lab, messages = rendered_lab(scene.seeded(seed))
    else:
        lab = build_lab(scene.seeded(seed))
        messages = list(simulate_session(lab))
    rig = next(message.payload for message in messages if isinstance(message.payload, Rig))
    return Session(lab, messages, rig)


def nodes_of(lab: GeometricLab) -> list[KnownSightings]:
    """Return the nodes of the floor that each camera sees, at the height of the robots' markers."""
    settings = lab.settings.lab

    def place(poses: Array, side_m: float) -> Array:
        return lab.place(poses).corners_m(side_m)

    size_m, height_m, length_m = settings.floor_m, settings.drive_height_m, settings.marker_length_m
    return [
        grid_nodes(camera.lens, camera.camera_from_world, place, size_m, height_m, length_m)
        for camera in lab.cameras
    ]


def sight(
    lab: GeometricLab, poses: Array, rng: np.random.Generator, tilted: bool = True
) -> list[KnownSightings]:
    """Return sightings by each camera of markers at poses (n, 4), with the noise of one frame.

    Poses are x, y, height above the floor and heading. ``tilted`` markers wobble like a driving robot.
    """
    settings = lab.settings.lab
    tilts_rad = rng.normal(0.0, np.radians(lab.settings.wobble_deg) * tilted, (len(poses), 2))
    placed, sightings = lab.place(poses, tilts_rad), []
    corners_m = placed.corners_m(settings.marker_length_m).reshape(-1, 3)
    for camera in lab.cameras:
        points_c = transform(camera.camera_from_world, corners_m)
        seen = in_image(points_c, camera.lens).reshape(-1, 4).all(axis=1)
        rotations, centres_m = camera_poses(
            camera, PlacedMarkers(placed.centres_m[seen], placed.rotations[seen])
        )
        covariances = corner_covariances(
            camera.lens, rotations, centres_m, settings.marker_length_m, edge_sigma_px(settings)
        )
        noise_px = draw_corner_noise(covariances, np.arange(len(covariances)), rng)
        corners_px = project(points_c.reshape(-1, 4, 3)[seen].reshape(-1, 3), camera.lens).reshape(-1, 4, 2)
        sightings.append(
            KnownSightings(
                camera.name, placed.centres_m[seen, :2], corners_px + noise_px, poses[seen, 2], covariances
            )
        )
    return sightings


def held_out_points(lab: GeometricLab, count: int) -> list[KnownSightings]:
    """Return sightings of markers at random places, with the heights of the calibration points."""
    rng = np.random.default_rng([lab.settings.lab.seed, 1])
    poses = np.column_stack(
        [
            rng.uniform(0.3, np.subtract(lab.settings.lab.floor_m, 0.3), (count, 2)),
            rng.choice(lab.settings.lab.heights_m, count),
            rng.uniform(-np.pi, np.pi, count),
        ]
    )
    return sight(lab, poses, rng, tilted=False)


def driving_robots(lab: GeometricLab, count: int) -> list[KnownSightings]:
    """Return sightings of a robot at random times of a long drive."""
    rng, (marker_id, *_) = np.random.default_rng([lab.settings.lab.seed, 2]), lab.drive.ahead_s
    path = poses_over(lab.drive, marker_id, rng.uniform(0, lab.drive.times_s[-1], count))
    sightings = sight(lab, np.insert(path, 2, lab.robot_heights_m[marker_id], axis=1), rng)
    # The rig has the nominal height of the robots.
    return [replace(seen, heights_m=np.full_like(seen.heights_m, lab.drive.height_m)) for seen in sightings]


def shares_by_place(session: Session, locator: Locator) -> dict[str, dict[str, float]]:
    """Return the shares inside the regions of the covariances: on the grid, at points, and in a drive."""
    sightings = {
        "grid": nodes_of(session.lab),
        "points": held_out_points(session.lab, _HELD_OUT),
        "drive": driving_robots(session.lab, _DRIVEN),
    }
    shares = {}
    for name, seen in sightings.items():
        own = summarize(compute_errors(seen, locator), session.measured_m).shares
        if own is not None:
            shares[name] = asdict(own)
    return shares


def standing_robots(
    lab: GeometricLab, nodes: Sequence[KnownSightings], frames: int, every: int
) -> list[KnownSightings]:
    """Return noisy sightings of robots that stand at every n-th node: all frames of one, then the next.

    A robot that stands still has the part of the noise that is new in each frame.
    """
    rng, settings = np.random.default_rng([lab.settings.lab.seed, 3]), lab.settings.lab
    standing = []
    for camera, seen in zip(lab.cameras, nodes, strict=True):
        truth_m, heights_m = seen.truth_m[::every], seen.heights_m[::every]
        poses = np.column_stack([truth_m, heights_m, np.zeros(len(truth_m))])
        rotations, centres_m = camera_poses(camera, lab.place(poses))
        covariances = corner_covariances(
            camera.lens, rotations, centres_m, settings.marker_length_m, edge_sigma_px(settings)
        )
        variances, axes = np.linalg.eigh(covariances)
        roots = axes * np.sqrt(WHITE_SHARE * np.maximum(variances, 0.0))[:, None, :]
        noise_px = np.einsum("nij,nfj->nfi", roots, rng.standard_normal((len(roots), frames, 8)))
        corners_px = seen.corners_px[::every, None] + noise_px.reshape(-1, frames, 4, 2)
        standing.append(
            KnownSightings(
                camera.name,
                np.repeat(truth_m, frames, axis=0),
                corners_px.reshape(-1, 4, 2),
                np.repeat(heights_m, frames),
                np.repeat(covariances, frames, axis=0),
            )
        )
    return standing


def _by_table(name: str) -> Callable[[Session], Locator]:
    def calibrate(session: Session) -> Locator:
        model = fit_model(name, session.pairs, 0)
        return locate_with_model(model, session.lab.calibrations, session.rig.marker_length_m)

    return calibrate


def observe_session(session: Session) -> Observations:
    """Return the observations of a session for the joint calibration."""
    lab, lenses = session.lab, session.lab.calibrations
    payloads = [message.payload for message in session.messages]
    markers = {
        name: [m.payload for m in session.messages if isinstance(m.payload, Markers) and m.camera == name]
        for name in lenses
    }
    measured = [one for one in payloads if isinstance(one, Measurement) and "train" in one.splits]
    nominal = list(lenses) if lab.settings.intrinsics == "nominal" else []
    return gather_observations(session.rig, lenses, markers, measured, nominal)


def fit_session(session: Session) -> JointFit:
    """Return the joint calibration of a session."""
    return fit_jointly(observe_session(session))


def joint_locator(fit: JointFit, session: Session) -> Locator:
    """Return the locator of a joint calibration."""
    models, sigma_m = build_models(fit), session.lab.settings.robot_height_sigma_m

    def locator(
        camera: str, corners_px: Array, heights_m: Array, covariances_px2: Array | None = None
    ) -> tuple[Array, Array | None]:
        if covariances_px2 is None:
            covariances_px2 = np.broadcast_to(_USUAL_PX**2 * np.eye(8), (len(corners_px), 8, 8))
        lengths_m = np.full(len(corners_px), session.rig.marker_length_m)
        found = locate_markers(models[camera], corners_px, covariances_px2, heights_m, lengths_m, sigma_m)
        return found.points_m, found.covariances_m2

    return locator


def _joint(session: Session) -> Locator:
    return joint_locator(fit_session(session), session)


# Calibrations by name, from a session to a locator. They raise FitError if there are too few points.
CONTENDERS: dict[str, Callable[[Session], Locator]] = {
    **{name: _by_table(name) for name in ("rayplane", "best", "poly")},
    "joint": _joint,
}
# These calibrations use the sightings of a drive; the others get no scene that differs only by its drive.
USE_DRIVES = frozenset({"joint"})
