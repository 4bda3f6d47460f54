"""Wrong inputs of a joint calibration are named, others are not, and more data never prevent a fit."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.joint.diagnosis import find_faults
from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.hypotheses import fit_hypotheses
from ipsys_log.calibration.joint.model import build_models
from ipsys_log.calibration.joint.observations import Observations, seeing_cameras, without_points
from ipsys_log.calibration.joint.payload import joint_payload, restore_joint
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import Marker, Markers, Message, Rig, RigMarker
from ipsys_log.models.locate_corners import LocateCorners
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import make_pose, rotation
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import simulate_session
from tests.joint.small_lab import REFERENCES_M, Array, make_lab
from tests.joint.test_drives import COARSE, gather, observe

ROW_NS = 31_000


def make_drive(points: int, seed: int = 3) -> GeometricLab:
    lab = LabSettings(
        seed=seed, rate_hz=10.0, drive_s=30.0, markers=1, cameras=("red", "white"), row_time_ns=ROW_NS
    )
    return build_lab(GeometricSettings(lab=lab, points=points))


def flip(observations: Observations, number: int) -> Observations:
    """Return the observations with a point on the other side of AB."""
    point = observations.points[number]
    assert point.start_m is not None
    line_y_m = point.references_m[0, 1]
    assert point.references_m[1, 1] == line_y_m
    mirrored = np.array([point.start_m[0], 2 * line_y_m - point.start_m[1]])
    points = list(observations.points)
    points[number] = replace(point, start_m=mirrored)
    return replace(observations, points=tuple(points))


def kinds(fit: JointFit) -> list[tuple[str, str]]:
    return [(fault.kind, fault.subject) for fault in find_faults(fit) if not fault.moving]


def origin_errors_m(fit: JointFit, lab: GeometricLab) -> list[float]:
    errors_m = []
    for name, model in build_models(fit).items():
        pose = lab.camera(name).camera_from_world
        errors_m.append(float(np.linalg.norm(model.origin_m + pose[:3, :3].T @ pose[:3, 3])))
    return errors_m


def test_wrong_side_of_one_of_four_points_is_named_and_left_out() -> None:
    lab = make_drive(4)
    observations = observe(lab)
    far = max(range(4), key=lambda n: abs(observations.points[n].start_m[1] - 2.4384))  # type: ignore[index]
    fit = fit_hypotheses(flip(observations, far), COARSE)
    name = observations.points[far].name
    assert kinds(fit) == [("side", name)]
    assert f"point {name}: it fits on the other side of AB" in find_faults(fit)[0].text
    assert name not in {point.name for point in fit.observations.points}
    assert fit.is_certain
    assert max(origin_errors_m(fit, lab)) < 0.02


def test_two_possible_sides_leave_no_certainty() -> None:
    observations = observe(make_drive(2))
    fit = fit_hypotheses(flip(observations, 0), COARSE)
    assert kinds(fit)[0][0] == "doubt"
    assert not fit.is_certain
    payload = joint_payload(fit, {}, 0)
    assert not restore_joint(payload)["red"].is_certain
    locate = LocateCorners(payload)
    rig = Rig("lab", "DICT_4X4_100", 0.2, markers=(RigMarker(0, height_m=0.1),))
    list(locate(Message("/rig", 0, 0, rig)))
    sightings = fit.observations.sightings[0]
    marker = Marker(0, sightings.pixels[-1], sightings.covariances_px2[-1])
    message = Message("/m", 1, 1, Markers(1, (marker,), 1920, 1080), "red")
    (positions,) = locate(message)
    assert positions.positions[0].inside is False


def test_certain_models_store_no_doubt() -> None:
    fit = fit_hypotheses(observe(make_drive(4)), COARSE)
    assert kinds(fit) == []
    assert all("uncertain" not in model.to_arrays() for model in build_models(fit).values())


def test_wrong_row_time_is_estimated_and_no_camera_accused() -> None:
    lab = make_drive(6)
    observations = observe(lab)
    wrong_s = 15e-6
    sightings = tuple(
        replace(one, times_s=one.times_s - one.pixels[:, :, 1].mean(axis=1) * (1e-9 * ROW_NS - wrong_s))
        for one in observations.sightings
    )
    cameras = tuple(replace(camera, known_row_s=wrong_s) for camera in observations.cameras)
    fit = fit_hypotheses(replace(observations, cameras=cameras, sightings=sightings), COARSE)
    assert [kind for kind, _ in kinds(fit)] == ["row_time"]
    assert "camera red, white: by the drives, the time between two rows is 3" in find_faults(fit)[0].text
    assert max(origin_errors_m(fit, lab)) < 0.02


def turn_midway(lab: GeometricLab, name: str, turn_rad: Array, after_s: float) -> Observations:
    """Return the observations of a session in which a camera turns after some seconds."""
    turned = make_pose(rotation(turn_rad), np.zeros(3)) @ lab.camera(name).camera_from_world
    cameras = tuple(
        replace(camera, camera_from_world=turned) if camera.name == name else camera for camera in lab.cameras
    )
    before, after = (list(simulate_session(one)) for one in (lab, replace(lab, cameras=cameras)))
    time_ns = before[0].log_time_ns + round(after_s * NS_PER_S)
    return gather(
        one if one.log_time_ns < time_ns or one.camera != name else two
        for one, two in zip(before, after, strict=True)
    )


@pytest.mark.parametrize(
    ("seed", "name", "turn_deg", "after_s"),
    [
        pytest.param(200, "red", (-0.31, -0.07, -0.02), 15.1, id="only its points are before"),
        pytest.param(202, "white", (-0.3, -0.08, 0.35), 42.1, id="during the drive"),
        pytest.param(211, "red", (-0.49, 0.05, 0.0), 29.7, id="another camera explains more in one step"),
    ],
)
def test_turned_camera_alone_is_accused(
    seed: int, name: str, turn_deg: tuple[float, ...], after_s: float
) -> None:
    fit = fit_hypotheses(turn_midway(drive_of(seed), name, np.radians(turn_deg), after_s), COARSE)
    assert kinds(fit) == [("camera", name)]
    stated_deg = float(find_faults(fit)[0].text.split(" degrees")[0].split()[-1])
    assert 0.6 < stated_deg / np.linalg.norm(turn_deg) < 1.4


def test_turn_that_spoils_the_shape_of_the_points_is_found() -> None:
    """The tape readings would contradict this shape, and a fit without them does not converge."""
    settings = replace(
        drive_of(600).settings, floor_rms_m=0.0005, wobble_deg=0.2, robot_height_sigma_m=0.0005
    )
    observations = turn_midway(build_lab(settings), "white", np.radians((0.14, 0.19, -0.34)), 40.7)
    assert kinds(fit_hypotheses(observations)) == [("camera", "white")]


@pytest.mark.parametrize("seed", [538, 539])
def test_wobble_beyond_its_sigma_accuses_no_camera(seed: int) -> None:
    lab = LabSettings(seed=seed, rate_hz=10.0, drive_s=60.0, markers=2)
    errors = GeometricSettings(
        lab=lab, points=8, wobble_deg=0.6, marker_scale_sigma=0.002, robot_height_sigma_m=0.001
    )
    assert kinds(fit_hypotheses(observe(build_lab(errors)))) == []


@pytest.mark.parametrize("share", [0.1, 0.95])
def test_outliers_at_one_instant_accuse_no_camera(share: float) -> None:
    """A robot that turns back at once is not where its path is."""
    observations = observe(drive_of(221))
    times_s = np.unique(np.concatenate([one.times_s[one.point < 0] for one in observations.sightings]))
    instant_s = times_s[int(share * len(times_s))]
    moved = []
    for one in observations.sightings:
        is_away = (one.point < 0) & (np.abs(one.times_s - instant_s) < 0.06)
        moved.append(replace(one, pixels=one.pixels + 30.0 * is_away[:, None, None]))
    assert kinds(fit_hypotheses(replace(observations, sightings=tuple(moved)))) == []


def drive_of(seed: int) -> GeometricLab:
    settings = LabSettings(seed=seed, rate_hz=10.0, drive_s=45.0, markers=1, row_time_ns=ROW_NS)
    return build_lab(GeometricSettings(lab=settings, points=6, marker_scale_sigma=0.001))


def test_motion_or_wrong_readings_leave_no_certainty() -> None:
    """Only two points are before the turn: it explains no more than two wrong heights."""
    observations = turn_midway(drive_of(211), "black", np.radians((-0.49, 0.05, 0.0)), 29.7)
    fit = fit_hypotheses(observations, COARSE)
    assert kinds(fit) == [("doubt", "black"), ("height", "s005"), ("height", "s002")]
    assert not fit.is_certain


@pytest.mark.parametrize(("point", "error_m"), [(1, 0.02), (4, 0.05), (2, 0.2)])
def test_wrong_height_accuses_no_camera(point: int, error_m: float) -> None:
    observations = observe(drive_of(221))
    points = list(observations.points)
    points[point] = replace(points[point], height_m=(points[point].height_m or 0.0) + error_m)
    fit = fit_hypotheses(replace(observations, points=tuple(points)))
    assert kinds(fit) == [("height", points[point].name)]
    assert fit.is_certain


def test_camera_that_nothing_connects_is_left_out() -> None:
    """A few sightings of one more camera do not remove the calibration of the others."""
    observations, _ = make_lab(1, points=16)
    first, second = (set(one.point.tolist()) for one in observations.sightings)
    alone = [number for number in observations.sightings[1].point.tolist() if number not in first][:1]
    own = observations.sightings[1].select(np.isin(observations.sightings[1].point, alone))
    assert second - first
    fit = fit_hypotheses(replace(observations, sightings=(observations.sightings[0], own)))
    assert kinds(fit) == [("left_out", "c1")]
    assert list(build_models(fit)) == ["c0"]


def add_places(kind: str, rng: np.random.Generator) -> Array:
    """Return places (6, 4) of points in a bad geometry: x, y, z, heading."""
    x, y = rng.uniform(0.6, 4.2), rng.uniform(0.6, 4.2)
    places_m = np.zeros((6, 4))
    places_m[:, 3] = rng.uniform(-3, 3, 6)
    if kind == "line":
        places_m[:, 0], places_m[:, 1] = np.linspace(0.6, 4.2, 6), y
    elif kind == "line across":
        places_m[:, 0], places_m[:, 1] = x, np.linspace(0.6, 4.2, 6)
    elif kind == "one place":
        places_m[:, 0], places_m[:, 1] = x + rng.normal(0, 0.005, 6), y + rng.normal(0, 0.005, 6)
    else:
        places_m[:, 0], places_m[:, 1] = rng.uniform(0.6, 4.2, 6), REFERENCES_M[0, 1] + rng.normal(0, 0.01, 6)
    return places_m


def first_points(observations: Observations, count: int) -> Observations:
    names: Collection[str] = {point.name for point in observations.points[count:]}
    return seeing_cameras(without_points(observations, names))


@pytest.mark.parametrize("kind", ["line", "line across", "one place", "near AB"])
@pytest.mark.parametrize("seed", range(2))
def test_added_points_in_bad_geometry_never_prevent_a_fit(kind: str, seed: int) -> None:
    """Five spread points determine the cameras that see two of them; all others have their own markers."""
    rng = np.random.default_rng([seed, 5])
    spread = np.column_stack([rng.uniform(0.8, 4.0, (5, 2)), np.zeros(5), rng.uniform(-3, 3, 5)])
    places_m = np.concatenate([spread, add_places(kind, rng)])
    observations, _ = make_lab(seed, points=len(places_m), cameras=2, places_m=places_m)
    before: set[str] = set()
    for count in range(5, len(places_m) + 1, 2):
        models = set(build_models(fit_hypotheses(first_points(observations, count), COARSE)))
        assert models >= before
        before = models
