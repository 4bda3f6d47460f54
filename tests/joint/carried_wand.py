"""A body that is carried in front of cameras on walls, as the markers of their frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ipsys_log.calibration.joint.carried_observations import gather_carried
from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.hand_held import fit_hand_held, fit_motion
from ipsys_log.calibration.joint.lab_frame import LabFrame, apply_frame, find_frame
from ipsys_log.messages import (
    IMPORTED,
    CameraCalibration,
    ChannelWritten,
    Distance,
    Interval,
    Marker,
    Markers,
    Measurement,
    Message,
    ReferencePoint,
    Rig,
    RigBody,
    RigCamera,
    RigMarker,
    Run,
)
from ipsys_log.messages.channels import MARKERS
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import body_shapes
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import make_pose, rotation, rotation_vector, transform
from tests.joint.small_lab import Array

SIZE_PX = (1920, 1080)
CLOCKS_S = (0.0, 0.011, -0.007, 0.004)
ROW_S = 25e-6
# Somebody stands before all cameras, then the body lies on the floor.
HIDDEN_S, REST_S = 1.5, 3.0
START_NS = 1_700_000_000 * NS_PER_S
BODY = "wand"
FLOOR_ID = 20


@dataclass(frozen=True, slots=True, eq=False)
class CarriedWand:
    """A rig, the intrinsics before the fit, the markers of each camera, taped points, and the true cameras.

    ``camera_from_world`` and ``true_lenses`` have one entry for each camera.
    """

    rig: Rig
    lenses: dict[str, CameraCalibration]
    markers: dict[str, list[Markers]]
    measurements: list[Measurement]
    camera_from_world: dict[str, Array]
    true_lenses: dict[str, CameraCalibration]


def wand_rig(count: int) -> Rig:
    """Return a rig with a body of five markers: one on the top of a box, four on its sides."""
    sides = [
        RigMarker(n, 0.12, BODY, xyz_m=(0.09 * c, 0.09 * s, -0.09), rpy_rad=(0.0, np.pi / 2, yaw))
        for n, (c, s, yaw) in enumerate(
            ((1, 0, 0.0), (0, 1, np.pi / 2), (-1, 0, np.pi), (0, -1, -np.pi / 2)), start=1
        )
    ]
    return Rig(
        "lab",
        "DICT_4X4_50",
        0.12,
        reference_points=(ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 4.0, 0.0)),
        markers=(RigMarker(0, 0.12, BODY, xyz_m=(0.0, 0.0, 0.0)), *sides, RigMarker(FLOOR_ID, 0.12)),
        bodies=(RigBody(BODY, False, scale_sigma=0.0005),),
        cameras=tuple(RigCamera(f"c{n}") for n in range(count)),
    )


def aim(place_m: Array, at_m: Array) -> Array:
    """Return ``camera_from_world`` (4, 4) of a camera that looks at a place, with its rows level."""
    z = (at_m - place_m) / np.linalg.norm(at_m - place_m)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x)
    turn = np.stack([x, np.cross(z, x), z])
    return make_pose(turn, -turn @ place_m)


class Wave:
    """Smooth random motion: sums of waves with random phases."""

    def __init__(self, rng: np.random.Generator, amplitudes: Array, frequencies_hz: Array) -> None:
        self.amplitudes, self.frequencies_hz = amplitudes, frequencies_hz
        self.phases = rng.uniform(0, 2 * np.pi, (len(frequencies_hz), len(amplitudes)))

    def __call__(self, time_s: float) -> Array:
        angles = 2 * np.pi * self.frequencies_hz[:, None] * time_s + self.phases
        return np.asarray(self.amplitudes * np.sin(angles).mean(axis=0))


def carry_wand(
    seed: int = 1,
    count: int = 4,
    duration_s: float = 20.0,
    rate_hz: float = 15.0,
    sigma_px: float = 0.05,
    jitter_s: float = 0.0,
    lens_errors: bool = True,
    taped: bool = False,
) -> CarriedWand:
    """Carry a box in a room of 5 m with cameras in its corners, which see it out of step."""
    rng = np.random.default_rng(seed)
    rig = wand_rig(count)
    corners_m = body_shapes(rig)[0].corners_m
    walls_m = np.array([[0.0, 0.0, 2.3], [5.0, 5.0, 2.4], [5.0, 0.0, 2.2], [0.0, 5.0, 2.35]])[:count]
    walls_m = walls_m + rng.uniform(-0.1, 0.1, walls_m.shape)
    cameras, truth, before = {}, {}, {}
    for n, place_m in enumerate(walls_m):
        cameras[f"c{n}"] = aim(place_m, np.array([2.5, 2.5, 0.7]) + rng.uniform(-0.2, 0.2, 3))
        K = np.array([[1000.0, 0, 970], [0, 1003.0, 530], [0, 0, 1]])
        lens = CameraCalibration(
            0, f"c{n}", *SIZE_PX, "kannala_brandt", np.array([0.01, -0.004, 0.0, 0.0]), K
        )
        truth[f"c{n}"] = lens
        errors = rng.normal(0, 1, 4) * lens_errors
        wrong = K.copy()
        wrong[[0, 1], [0, 1]] *= 1 + 0.001 * errors[:2]
        wrong[:2, 2] += errors[2:]
        before[f"c{n}"] = replace(lens, K=wrong)
    place = Wave(rng, np.array([1.3, 1.3, 0.5]), np.array([0.13, 0.31]))
    tilt = Wave(rng, np.array([0.8, 0.8, 0.0]), np.array([0.2, 0.41]))

    def pose_at(time_s: float) -> Array:
        if time_s >= duration_s:
            is_hidden = taped or time_s < duration_s + HIDDEN_S
            return make_pose(np.eye(3), np.array([0.0, 0.0, 50.0 * is_hidden]))
        heading = rotation(np.array([0.0, 0.0, 0.5 * time_s + place(0.3 * time_s)[0]]))
        return make_pose(heading @ rotation(tilt(time_s)), np.array([2.5, 2.5, 0.9]) + place(time_s))

    points = [] if not taped else [(n, rng.uniform(1.2, 3.8, 2), rng.uniform(-3, 3)) for n in range(6)]
    first_s = duration_s + HIDDEN_S + REST_S
    markers: dict[str, list[Markers]] = {}
    for (name, camera), clock_s in zip(cameras.items(), CLOCKS_S, strict=False):
        frames = []
        start_s = rng.uniform(0, 1 / rate_hz)
        for number in range(int((first_s + len(points) * 2) * rate_hz)):
            time_s = start_s + number / rate_hz
            own = dict(corners_m)
            pose = pose_at
            for point, flat_m, heading_rad in points:
                if first_s + 2 * point + 0.5 <= time_s < first_s + 2 * point + 1.5:
                    turn = rotation(np.array([0.0, 0.0, heading_rad]))
                    own = {FLOOR_ID: marker_corners(0.12)}
                    pose = partial(_stay, make_pose(turn, np.array([*flat_m, 0.0])))
            seen = []
            for marker_id, points_m in own.items():
                pixels = _see(camera, truth[name], pose, points_m, time_s)
                if pixels is not None:
                    noisy = pixels + rng.normal(0, sigma_px, (4, 2))
                    seen.append(Marker(marker_id, noisy, max(sigma_px, 0.01) ** 2 * np.eye(8)))
            stamp_ns = START_NS + round((time_s - clock_s + rng.normal(0, jitter_s)) * NS_PER_S)
            frames.append(Markers(stamp_ns, tuple(seen), *SIZE_PX))
        markers[name] = frames
    measured = [_measure(point, flat_m, first_s, rng) for point, flat_m, _ in points]
    return CarriedWand(rig, before, markers, measured, cameras, truth)


def _stay(pose: Array, _time_s: float) -> Array:
    return pose


def _see(
    camera: Array,
    lens: CameraCalibration,
    pose_at: Callable[[float], Array],
    points_m: Array,
    time_s: float,
) -> Array | None:
    """Return the corners (4, 2) of a marker with the times of their rows; None if it is not visible."""
    rows_px = np.full(4, SIZE_PX[1] / 2)
    for _ in range(4):
        seen_m = np.stack(
            [
                transform(camera @ pose_at(time_s + row * ROW_S), point[None])[0]
                for row, point in zip(rows_px, points_m, strict=True)
            ]
        )
        normal = np.cross(seen_m[1] - seen_m[0], seen_m[3] - seen_m[0])
        middle_m = seen_m.mean(axis=0)
        facing = normal @ middle_m / np.linalg.norm(normal) / np.linalg.norm(middle_m)
        if middle_m[2] < 0.3 or facing < 0.3:
            return None
        pixels = project(seen_m, lens)
        if not ((pixels > 0) & (pixels < SIZE_PX)).all():
            return None
        rows_px = pixels[:, 1]
    return pixels


def _measure(point: int, flat_m: Array, first_s: float, rng: np.random.Generator) -> Measurement:
    distances = tuple(
        Distance(name, float(np.linalg.norm(flat_m - at) + rng.normal(0, 0.001)), 0.001)
        for name, at in (("A", np.zeros(2)), ("B", np.array([4.0, 0.0])))
    )
    start_s, end_s = first_s + 2 * point + 0.55, first_s + 2 * point + 1.45
    still = Interval(*(START_NS + round(one * NS_PER_S) for one in (start_s, end_s)))
    return Measurement(
        still.start, f"p{point}", marker_id=FLOOR_ID, distances=distances, side="left", height_m=0.0,
        still=still,
    )  # fmt: skip


def wand_messages(wand: CarriedWand) -> list[Message]:
    """Return the messages of a log with the markers as an imported run."""
    frames = sorted(
        (
            _at(MARKERS.topic_of("tags", camera), frame, camera)
            for camera, own in wand.markers.items()
            for frame in own
        ),
        key=lambda message: message.log_time_ns,
    )
    frames = [replace(one, log_time_ns=one.log_time_ns + n) for n, one in enumerate(frames)]
    last_ns = frames[-1].log_time_ns
    outputs = tuple(
        ChannelWritten(MARKERS.topic_of("tags", camera), len(own)) for camera, own in wand.markers.items()
    )
    run = Run(0, "tags", IMPORTED, {"format": "csv"}, outputs=outputs)
    lenses = [
        Message(f"/cameras/{camera}/calibration", 1, 1, one, camera) for camera, one in wand.lenses.items()
    ]
    measured = [Message("/measurements", last_ns + 1, one.timestamp, one) for one in wand.measurements]
    return [
        Message("/rig", 1, 1, wand.rig), *lenses, *frames, *measured,
        Message("/runs/tags/record", last_ns + 2, last_ns, run),
    ]  # fmt: skip


def _at(topic: str, frame: Markers, camera: str) -> Message:
    return Message(topic, frame.timestamp, frame.timestamp, frame, camera)


def calibrate(wand: CarriedWand) -> tuple[JointFit, LabFrame, JointFit]:
    """Return the fit, the coordinates of the lab, and the fit in these coordinates."""
    observations, targets, _ = gather_carried(
        wand.rig, wand.lenses, (), wand.markers, BODY, wand.measurements
    )
    fit = fit_motion(fit_hand_held(observations))
    frame = find_frame(fit, targets)
    return fit, frame, apply_frame(fit, frame, 0.0, 0.0, np.zeros(3))


def pose_errors(lab: JointFit, wand: CarriedWand) -> tuple[Array, Array]:
    """Return errors (c, 6) of turns in rad and positions in m, and their NEES (c,)."""
    errors, scores = [], []
    for number, true in enumerate(wand.camera_from_world.values()):
        block, turn = lab.problem.layout.cameras[number], lab.state.camera_turns[number]
        origin_m = lab.state.values[block.start + 3 : block.start + 6]
        error = np.r_[rotation_vector(turn @ true[:3, :3].T), origin_m + true[:3, :3].T @ true[:3, 3]]
        covariance = lab.covariance[block.start : block.start + 6, block.start : block.start + 6]
        errors.append(error)
        scores.append(float(error @ np.linalg.solve(covariance, error)) / 6)
    return np.array(errors), np.array(scores)
