"""Positions of markers by a joint model: exactness, covariance, storage, and speed of use."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from ipsys_log.calibration.joint.fit import JointFit, fit_jointly
from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.locate_bodies import BodySightings, locate_bodies
from ipsys_log.calibration.joint.locate_poses import locate_poses
from ipsys_log.calibration.joint.model import JointModel, build_models
from ipsys_log.calibration.joint.parameters import State
from ipsys_log.calibration.joint.payload import joint_payload
from ipsys_log.messages import (
    Event,
    Marker,
    Markers,
    Message,
    Model,
    Pair,
    Position,
    Positions,
    ReferenceMarker,
    Rig,
    RigBody,
    RigMarker,
)
from ipsys_log.models.locate_corners import LocateCorners
from ipsys_log.vision.bodies import body_shapes
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import make_pose, pose_facing_up, rotation, rotation_vector, transform
from tests.joint.small_lab import LENGTH_M, Array, make_lab

POSES = [(1.6, 1.2, 0.1, 0.3), (2.4, 2.2, 0.0, -2.0), (3.1, 1.9, 0.2, 1.5)]
HEIGHTS_M, LENGTHS_M = np.array([pose[2] for pose in POSES]), np.full(3, LENGTH_M)


@pytest.fixture(scope="module")
def fit() -> JointFit:
    return fit_jointly(make_lab(4, points=20)[0])


@pytest.fixture(scope="module")
def model(fit: JointFit) -> JointModel:
    return build_models(fit)["c0"]


def see(model: JointModel, poses: list[Array]) -> Array:
    """Return exact corners of markers with poses in the world, by OpenCV's projection."""
    camera = make_pose(model.camera_from_world, np.zeros(3))
    camera[:3, 3] = -model.camera_from_world @ model.origin_m
    corners_m = [transform(camera @ pose, marker_corners(model.scale * LENGTH_M)) for pose in poses]
    pixels = np.stack([project(one, model.calibration) for one in corners_m])
    after, before = (np.roll(pixels, shift, axis=1) - pixels for shift in (-1, 1))
    units = [side / np.linalg.norm(side, axis=2, keepdims=True) for side in (after, before)]
    # Edges of black lie too far inside the black.
    return np.asarray(pixels + model.edge_offset_px * (units[0] + units[1]))


def level_poses(model: JointModel) -> list[Array]:
    """Return poses on the estimated floor."""
    flat = np.array(POSES)[:, :2]
    floor_m, _ = model.floor.heights(flat, model.amplitudes)
    return [pose_facing_up(x, y, z + f, h) for (x, y, z, h), f in zip(POSES, floor_m.tolist(), strict=True)]


def noise(sigma_px: float = 0.02) -> Array:
    return np.tile(sigma_px**2 * np.eye(8), (3, 1, 1))


def test_locate_of_exact_corners_is_exact(model: JointModel) -> None:
    corners_px = see(model, level_poses(model))
    found = locate_markers(model, corners_px, noise(), HEIGHTS_M, LENGTHS_M)
    assert np.abs(found.points_m[:, :2] - np.array(POSES)[:, :2]).max() < 2e-5
    assert np.abs(found.headings_rad - np.array(POSES)[:, 3]).max() < 1e-4
    assert found.chi2.max() < 0.1


def test_locate_covariance_is_that_of_calibration_and_noise(fit: JointFit, model: JointModel) -> None:
    """Disturb the calibration by its covariance, and the corners by their noise: positions spread alike."""
    rng = np.random.default_rng(0)
    corners_px = see(model, level_poses(model))
    stated = locate_markers(model, corners_px, noise(), HEIGHTS_M, LENGTHS_M, 0.0, 0.0).covariances_m2
    layout, count = fit.problem.layout, 400
    root = np.linalg.cholesky(fit.covariance + 1e-18 * np.eye(len(fit.covariance)))
    local = np.zeros(fit.problem.trajectories.local_count)
    points = []
    for _ in range(count):
        state: State = fit.state.moved(layout, root @ rng.standard_normal(len(root)), local)
        block = layout.cameras[0]
        other = JointModel(
            model.lens_model,
            state.camera_turns[0],
            state.values[block.start + 3 : block.start + 6],
            state.values[block.lens],
            float(state.values[block.edge]),
            0.0,
            0.0,
            float(state.values[layout.scales].mean()),
            layout.floor,
            state.values[layout.modes],
            model.modes[:, :1],
            model.floor_modes[:, :1],
            0.0,
        )
        moved_px = corners_px + rng.normal(0.0, 0.02, corners_px.shape)
        points.append(locate_markers(other, moved_px, noise(), HEIGHTS_M, LENGTHS_M).points_m)
    spread = np.stack([np.cov(np.array(points)[:, n].T) for n in range(3)])
    ratio = np.sqrt(np.einsum("nii->ni", spread) / np.einsum("nii->ni", stated))
    assert np.abs(ratio - 1).max() < 0.15


def test_height_error_is_in_the_covariance(model: JointModel) -> None:
    corners_px = see(model, level_poses(model))
    low, high = (
        locate_markers(model, corners_px, noise(), HEIGHTS_M + step, LENGTHS_M).points_m
        for step in (-0.005, 0.005)
    )
    without, with_height = (
        locate_markers(model, corners_px, noise(), HEIGHTS_M, LENGTHS_M, sigma_m).covariances_m2
        for sigma_m in (0.0, 0.005)
    )
    half = (high - low) / 2
    assert np.abs(with_height - without - half[:, :, None] * half[:, None]).max() < 1e-8


def test_poses_of_tilted_markers_are_exact(model: JointModel) -> None:
    tilted = [
        pose @ make_pose(rotation(np.array([0.1, -0.05, 0.0])), np.zeros(3)) for pose in level_poses(model)
    ]
    found = locate_poses(model, see(model, tilted), noise(0.01), LENGTHS_M)
    assert np.abs(found.points_m - np.stack([pose[:3, 3] for pose in tilted])).max() < 1e-5
    assert np.abs(found.turns - np.stack([pose[:3, :3] for pose in tilted])).max() < 1e-4
    assert (np.linalg.eigvalsh(found.covariances_m2) > 0).all()


def test_pose_agrees_with_scipy(model: JointModel) -> None:
    rng = np.random.default_rng(2)
    corners_px = see(model, level_poses(model)) + rng.normal(0, 0.05, (3, 4, 2))
    found = locate_poses(model, corners_px, noise(0.05), LENGTHS_M)

    def misses(values: Array) -> Array:
        pose = make_pose(rotation(values[3:]) @ found.turns[1], values[:3])
        return np.asarray((see(model, [pose])[0] - corners_px[1]).ravel())

    start = np.r_[found.points_m[1] + 0.01, np.full(3, 0.01)]
    solved = least_squares(misses, start, xtol=1e-12, ftol=1e-12, x_scale=1e-3)
    assert np.abs(solved.x[:3] - found.points_m[1]).max() < 2e-5


def test_model_from_its_arrays_is_identical(model: JointModel) -> None:
    again = JointModel.from_arrays(model.to_arrays(), model.calibration)
    corners_px = see(model, level_poses(model))
    first, second = (locate_markers(one, corners_px, noise(), HEIGHTS_M, LENGTHS_M) for one in (model, again))
    assert first.points_m.tobytes() == second.points_m.tobytes()
    assert first.covariances_m2.tobytes() == second.covariances_m2.tobytes()


def test_modes_of_two_cameras_give_their_covariance(fit: JointFit) -> None:
    models = build_models(fit)
    layout = fit.problem.layout
    rows = [slice(block.start + 3, block.start + 6) for block in layout.cameras]
    product = models["c0"].modes[3:6] @ models["c1"].modes[3:6].T
    expected = fit.covariance[rows[0], rows[1]]
    assert np.abs(product - expected).max() < 1e-4 * np.abs(fit.covariance[rows[0], rows[0]]).max()


def test_marker_beside_the_lens_has_no_position(model: JointModel) -> None:
    corners_px = see(model, level_poses(model))
    corners_px[1] += 1e6
    with np.errstate(all="ignore"):
        found = locate_markers(model, corners_px, noise(), HEIGHTS_M, LENGTHS_M)
    assert np.isnan(found.points_m[1]).all()
    assert np.isfinite(found.points_m[[0, 2]]).all()


def test_reference_marker_has_no_position(fit: JointFit, model: JointModel) -> None:
    rig = Rig(
        name="lab",
        dictionary="DICT_4X4_100",
        marker_length_m=LENGTH_M,
        marker_height_m=0.1,
        markers=(RigMarker(0, robot="ada"),),
        reference_markers=(ReferenceMarker(2),),
    )
    step = LocateCorners(joint_payload(fit, {}, 0))
    assert not list(step(Message("/rig", 0, 0, rig)))
    markers = [Marker(number, corners) for number, corners in enumerate(see(model, level_poses(model)))]
    (found,) = step(Message("/markers", 1, 1, Markers(1, tuple(markers), 1920, 1080), "c0"))
    assert [position.id for position in found.positions] == [0, 1]


def test_marker_that_contradicts_the_intrinsics_is_not_inside(fit: JointFit, model: JointModel) -> None:
    step = LocateCorners(joint_payload(fit, {}, 0))
    assert not list(step(Message("/rig", 0, 0, Rig("lab", "DICT_4X4_100", LENGTH_M, marker_height_m=0.1))))
    corners_px = see(model, level_poses(model))
    for contradicted in (None, True):
        markers = [Marker(n, one, contradicted=contradicted) for n, one in enumerate(corners_px)]
        (found,) = step(Message("/markers", 1, 1, Markers(1, tuple(markers), 1920, 1080), "c0"))
        assert {position.inside for position in found.positions} == {not contradicted}


def drive(model: Model, sighted: list[Array], height_m: float | None) -> tuple[list[Event], list[Position]]:
    """Return the events and positions of a marker that drives past a camera, by the step of its model."""
    step = LocateCorners(model)
    rig = Rig("lab", "DICT_4X4_100", LENGTH_M, (RigMarker(0, height_m=height_m, height_sigma_m=0.001),))
    assert not list(step(Message("/rig", 0, 0, rig)))
    events: list[Event] = []
    positions: list[Position] = []
    for number, corners_px in enumerate(sighted):
        time_ns = number * 100_000_000
        frame = Markers(time_ns, (Marker(0, corners_px, noise()[0]),), 1920, 1080)
        for payload in step(Message("/markers", time_ns, time_ns, frame, "c0")):
            events += [payload] if isinstance(payload, Event) else []
            positions += payload.positions if isinstance(payload, Positions) else []
    return events, positions


def path(model: JointModel, height_m: float, tilt_rad: float = 0.0) -> tuple[Array, list[Array]]:
    """Return places (n, 3) of a driving robot on the estimated floor, and its corners with noise."""
    rng = np.random.default_rng(5)
    flat_m = np.column_stack([np.linspace(1.2, 3.4, 30), np.linspace(1.0, 2.4, 30)])
    floor_m, _ = model.floor.heights(flat_m, model.amplitudes)
    places_m = np.column_stack([flat_m, floor_m + height_m])
    tilt = make_pose(rotation(np.array([tilt_rad, 0.0, 0.0])), np.zeros(3))
    poses = [pose_facing_up(x, y, z, 0.5) @ tilt for x, y, z in places_m.tolist()]
    return places_m, [see(model, [pose])[0] + rng.normal(0, 0.02, (4, 2)) for pose in poses]


@pytest.mark.parametrize("wrong_m", [0.03, -0.012])
def test_contradicted_height_gives_full_pose_and_one_event(
    fit: JointFit, model: JointModel, wrong_m: float
) -> None:
    places_m, sighted = path(model, 0.1 + wrong_m)
    events, positions = drive(joint_payload(fit, {}, 0), sighted, 0.1)
    (event,) = events
    assert (event.kind, event.marker_id) == ("contradicted_height", 0)
    assert re.match(r"marker 0 is at 0\.\d{3} m, not at 0\.100 m", event.text)
    assert abs(float(event.text.split()[4]) - 0.1 - wrong_m) < 0.002
    away_m = np.array([(p.x_m, p.y_m, p.z_m) for p in positions]) - places_m
    assert np.median(np.linalg.norm(away_m[:, :2], axis=1)) < 0.001
    covariances_m2 = np.array([position.covariance_m2 for position in positions])
    chi2 = (away_m * np.linalg.solve(covariances_m2, away_m[:, :, None])[:, :, 0]).sum(axis=1)
    assert (chi2 < 7.81).mean() > 0.9
    assert all(position.inside for position in positions)


def test_height_that_changes_is_named_when_it_changes(fit: JointFit, model: JointModel) -> None:
    _, before = path(model, 0.1)
    _, after = path(model, 0.16)
    (event,), _ = drive(joint_payload(fit, {}, 0), before[:15] + after[15:], 0.1)
    assert event.timestamp > 15 * 100_000_000
    assert event.text.startswith("marker 0 is at 0.1")


@pytest.mark.parametrize("tilt_deg", [2.0, 8.0])
def test_tilted_top_at_its_height_keeps_its_flag(fit: JointFit, model: JointModel, tilt_deg: float) -> None:
    places_m, sighted = path(model, 0.1, np.radians(tilt_deg))
    events, positions = drive(joint_payload(fit, {}, 0), sighted, 0.1)
    assert events == []
    away_m = np.array([(p.x_m, p.y_m) for p in positions]) - places_m[:, :2]
    assert np.linalg.norm(away_m, axis=1).max() < 0.001
    assert all(position.inside for position in positions)


def test_print_within_its_error_is_no_wrong_height(fit: JointFit, model: JointModel) -> None:
    """A side that is 0.2 % too long looks like a marker that is 4 mm higher."""
    _, sighted = path(replace(model, scale=1.002 * model.scale), 0.1)
    events, positions = drive(joint_payload(fit, {}, 0), sighted, 0.1)
    assert events == []
    assert all(position.inside for position in positions)


def test_calibration_points_are_no_wrong_heights(fit: JointFit, model: JointModel) -> None:
    """A marker on the floor, at calibration points and at one further point, is on no robot."""
    places_m, sighted = path(model, 0.0)
    pairs = [Pair(str(n), 0, np.zeros(3), place_m, 10) for n, place_m in enumerate(places_m[:20:10])]
    still = [sighted[n] for n in (0, 10, 25) for _ in range(20)]
    events, _ = drive(joint_payload(fit, {"c0": pairs}, 0), still, 0.1)
    assert events == []


# A drone: two markers on a plate, and one on a slanted side.
DRONE = Rig(
    "lab",
    "DICT_4X4_100",
    LENGTH_M,
    (
        RigMarker(0, 0.1, "drone"),
        RigMarker(1, 0.1, "drone", xyz_m=(0.2, 0.05, 0.0), rpy_rad=(0.0, 0.0, 0.4)),
        RigMarker(2, 0.1, "drone", xyz_m=(0.0, 0.2, -0.05), rpy_rad=(-0.5, 0.0, 0.0)),
    ),
    bodies=(RigBody("drone", level=False),),
)
DRONE_M = np.array(list(body_shapes(DRONE)[0].corners_m.values()))


def see_corners(model: JointModel, corners_m: Array) -> Array:
    """Return the exact pixels of corners (..., 4, 3) in the world."""
    camera = model.camera_from_world
    points_c = (corners_m.reshape(-1, 3) - model.origin_m) @ camera.T
    pixels = project(points_c, model.calibration).reshape(-1, 4, 2)
    after, before = (np.roll(pixels, shift, axis=1) - pixels for shift in (-1, 1))
    units = [side / np.linalg.norm(side, axis=2, keepdims=True) for side in (after, before)]
    return np.asarray(pixels + model.edge_offset_px * (units[0] + units[1]))


def sight_body(corners_px: Array, sigma_px: float) -> BodySightings:
    """Return the sighting of one body that stands still, whose rotation is unknown."""
    count = len(corners_px)
    covariances = np.tile(sigma_px**2 * np.eye(8), (1, count, 1, 1))
    return BodySightings(corners_px[None], covariances, DRONE_M[None, :count], np.zeros((1, count, 4)), True)


def test_pose_of_a_body_and_its_noise_agree_with_scipy(model: JointModel) -> None:
    rng = np.random.default_rng(3)
    pose = make_pose(rotation(np.array([0.3, -0.2, 1.0])), np.array([2.2, 1.9, 0.7]))
    corners_px = see_corners(model, transform(pose, DRONE_M.reshape(-1, 3)).reshape(-1, 4, 3))
    corners_px = corners_px + rng.normal(0, 0.05, corners_px.shape)
    own = replace(model, corner_floor_px=0.0)
    found = locate_bodies(own, sight_body(corners_px, 0.05))

    def misses(values: Array) -> Array:
        turned = make_pose(rotation(values[3:]) @ found.turns[0], values[:3])
        again_px = see_corners(model, transform(turned, DRONE_M.reshape(-1, 3)).reshape(-1, 4, 3))
        return np.asarray((again_px - corners_px).ravel() / 0.05)

    solved = least_squares(misses, np.r_[found.points_m[0], np.full(3, 0.01)], xtol=1e-14, x_scale=1e-3)
    assert np.abs(solved.x - np.r_[found.points_m[0], np.zeros(3)]).max() < 2e-6
    slopes: Array = np.array(solved.jac, dtype=np.float64)
    sigmas = np.sqrt(np.linalg.inv(slopes.T @ slopes).diagonal())
    assert np.abs(np.sqrt(found.noise[0].diagonal()) / sigmas - 1).max() < 0.02
    assert abs(found.chi2[0] / (2 * solved.cost) - 1) < 0.01


def fly(
    model: JointModel,
    payload: Model,
    ids: tuple[int, ...],
    sigma_px: float,
    loose_m: float = 0.0,
    later: tuple[int, ...] | None = None,
) -> tuple[list[Event], list[Position], list[Array]]:
    """Fly a tumbling drone past a camera with a rolling shutter, for 60 frames.

    Marker 2 is ``loose_m`` away from its place. In the second half, the camera sees ``later``. The
    results are the events, the positions, and their errors (6,) beside those by the velocity.
    """
    rng, step, row_s, count = np.random.default_rng(4), LocateCorners(payload), 31e-6, 60
    assert not list(step(Message("/rig", 0, 0, DRONE)))
    events: list[Event] = []
    found: list[Position] = []
    errors: list[Array] = []
    corners_m = DRONE_M + np.array([0.0, 0.0, loose_m]) * (np.arange(3) == 2)[:, None, None]

    def pose_at(time_s: float) -> Array:
        tilts = 0.5 * np.sin([3 * time_s, 2 * time_s + 1])
        turn = rotation(np.array([0.0, 0.0, time_s])) @ rotation(np.array([*tilts, 0.0]))
        return make_pose(turn, np.array([1.5 + 0.5 * time_s, 1.4 + 0.3 * time_s, 0.4 + 0.2 * np.sin(time_s)]))

    def twist_at(time_s: float) -> Array:
        before, after = (pose_at(time_s + step_s) for step_s in (-0.001, 0.001))
        turned_rad = rotation_vector(after[:3, :3] @ before[:3, :3].T)
        return np.concatenate([after[:3, 3] - before[:3, 3], turned_rad]) / 0.002

    for number in range(count):
        stamp_ns, markers = number * 33_000_000, []
        for n in ids if later is None or number < count // 2 else later:
            offset_s = 0.0
            for _ in range(3):
                world_m = transform(pose_at(stamp_ns / 1e9 + offset_s), corners_m[n])
                corners_px = see_corners(model, world_m)[0]
                offset_s = corners_px[:, 1].mean() * row_s
            moved_px = corners_px + rng.normal(0, sigma_px, (4, 2))
            markers.append(Marker(n, moved_px, sigma_px**2 * np.eye(8), round(offset_s * 1e9)))
        frame = Markers(stamp_ns, tuple(markers), 1920, 1080)
        for payload_ in step(Message("/markers", stamp_ns, stamp_ns, frame, "c0")):
            if isinstance(payload_, Event):
                events.append(payload_)
                continue
            found += payload_.positions
            for position in payload_.positions:
                time_s = (stamp_ns + position.time_offset_ns) / 1e9
                true = pose_at(time_s)
                point_m = np.array([position.x_m, position.y_m, position.z_m])
                turn = rotation(position.to_still[3:]) @ rotation(position.rotation_rad)
                turned_rad = rotation_vector(turn @ true[:3, :3].T)
                away_m = point_m + position.to_still[:3] - true[:3, 3]
                errors.append(np.r_[away_m, turned_rad] - position.still_by_motion @ twist_at(time_s))
    return events, found, errors


def test_moving_body_under_a_rolling_shutter_has_one_exact_pose(fit: JointFit, model: JointModel) -> None:
    """Between its markers lie 6 ms, in which it moves by 4 mm."""
    _, _, errors = fly(model, joint_payload(fit, {}, 0), (0, 1, 2), 0.001)
    assert len(errors) == 60
    assert np.abs(np.array(errors)[:, :3]).max() < 2e-4
    assert np.abs(np.array(errors)[:, 3:]).max() < 5e-4


def test_single_tilting_marker_never_has_its_mirrored_pose(fit: JointFit, model: JointModel) -> None:
    _, _, errors = fly(model, joint_payload(fit, {}, 0), (0,), 0.1)
    assert len(errors) == 60
    assert np.degrees(np.linalg.norm(np.array(errors)[:, 3:], axis=1).max()) < 5.0


def test_loose_marker_is_named_once_and_left_out(fit: JointFit, model: JointModel) -> None:
    payload = joint_payload(fit, {}, 0)
    for later, frames in (((0, 1, 2), 60), ((1, 2), 60), ((2,), 30)):
        (event,), _, errors = fly(model, payload, (0, 1, 2), 0.02, loose_m=0.01, later=later)
        assert (event.kind, event.marker_id) == ("loose_marker", 2)
        assert len(errors) == frames
        assert np.linalg.norm(np.array(errors)[:, :3], axis=1).max() < 5e-3


def test_contradiction_between_two_markers_is_in_the_covariance(fit: JointFit, model: JointModel) -> None:
    """Nothing tells which of them is at a wrong place."""
    events, found, errors = fly(model, joint_payload(fit, {}, 0), (0, 2), 0.02, loose_m=0.03)
    assert events == []
    assert not any(position.inside for position in found)
    noises = np.array([position.still_noise for position in found], dtype=np.float64)
    solved = np.linalg.solve(noises, np.array(errors)[:, :, None])[:, :, 0]
    squares = (np.array(errors) * solved).sum(axis=1) / 6
    assert 0.05 < np.median(squares) < 4


@pytest.mark.parametrize("kind", ["one point", "a line", "in the wrong order", "beside the lens"])
def test_body_whose_corners_are_no_square_has_no_position(
    fit: JointFit, model: JointModel, kind: str
) -> None:
    pose = make_pose(np.eye(3), np.array([2.2, 1.9, 0.7]))
    first, second = see_corners(model, transform(pose, DRONE_M[:2].reshape(-1, 3)).reshape(-1, 4, 3))
    wrong = {
        "one point": np.full((4, 2), 500.0),
        "a line": np.linspace([500.0, 500.0], [530.0, 500.0], 4),
        "in the wrong order": first[::-1],
        "beside the lens": first + 1e6,
    }[kind]
    for others, count in (((), 0), ((second,), 1)):
        step = LocateCorners(joint_payload(fit, {}, 0))
        assert not list(step(Message("/rig", 0, 0, DRONE)))
        markers = tuple(Marker(n, corners_px, noise()[0]) for n, corners_px in enumerate((wrong, *others)))
        (found,) = step(Message("/markers", 1, 1, Markers(1, markers, 1920, 1080), "c0"))
        assert len(found.positions) == count
