"""A session without images agrees with OpenCV's projection of the ground truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.geometry.poses import pose_facing_up
from ipsys_log.log.codec import encode
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, Marker, Markers, Measurement, Message, Rig, Tracks
from ipsys_log.messages.channels import MODEL
from ipsys_log.pipeline import replay
from ipsys_log.rig.file import check_rig
from ipsys_log.runs.options import Request
from ipsys_log.runs.output import write_log
from ipsys_log.simulation.cameras import Camera
from ipsys_log.simulation.settings import LabSettings
from ipsys_log.units import NS_PER_S
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import simulate_session
from tests.geometric.sightings import simulate_sightings

Array = NDArray[np.float64]

DRIVE = LabSettings(rate_hz=10.0, drive_s=6.0, markers=2, drive_speed_m_s=1.0)
SMALL = GeometricSettings(lab=DRIVE, points=4, corner_noise=0.0)
SQUARE_M = 0.1 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])


def by_opencv(camera: Camera, points_m: Array) -> Array:
    """Return the pixels of world points by OpenCV's own rigid motion and projection."""
    turn, _ = cv2.Rodrigues(camera.camera_from_world[:3, :3])
    shift = camera.camera_from_world[:3, 3].copy()
    pixels, _ = cv2.fisheye.projectPoints(points_m[None], turn, shift, camera.lens.K, camera.lens.D)
    return np.asarray(pixels[0])


def square_at(x_m: float, y_m: float, z_m: float, heading_rad: float) -> Array:
    """Return the corners of a level marker: its heading is the direction from corner 3 to corner 0."""
    ahead = np.array([np.cos(heading_rad), np.sin(heading_rad), 0])
    right = np.array([np.sin(heading_rad), -np.cos(heading_rad), 0])
    corners_m: Array = np.array([x_m, y_m, z_m]) + SQUARE_M[:, :1] * right + SQUARE_M[:, 1:2] * ahead
    return corners_m


def sightings_of(messages: Iterable[Message]) -> dict[tuple[str, int, int], Marker]:
    """Return the markers of a session by camera, stamp and id."""
    return {
        (str(message.camera), message.publish_time_ns, marker.id): marker
        for message in messages
        if isinstance(message.payload, Markers)
        for marker in message.payload.markers
    }


def times_of(markers: Mapping[tuple[str, int, int], Marker], camera: str) -> list[int]:
    return sorted({time_ns for name, time_ns, _ in markers if name == camera})


def driven(lab: GeometricLab, marker_id: int, time_ns: int, start_ns: int) -> Array:
    """Return the corners of a robot's marker at a true time, from its path alone."""
    pose = lab.drive.pose_at(marker_id, (time_ns - start_ns) / NS_PER_S)
    return square_at(pose.x_m, pose.y_m, pose.z_m, pose.heading_rad)


def test_corners_without_noise_are_those_of_opencv() -> None:
    lab = build_lab(SMALL)
    messages = list(simulate_session(lab))
    truth = {m.publish_time_ns: m.payload for m in messages if isinstance(m.payload, Tracks)}
    markers = sightings_of(messages)
    assert len(markers) > 100
    for (camera, time_ns, marker_id), marker in markers.items():
        track = next(one for one in truth[time_ns].tracks if one.id == marker_id)
        assert track.heading_rad is not None
        corners_m = square_at(track.x_m, track.y_m, track.z_m, track.heading_rad)
        assert marker.corners_px == pytest.approx(by_opencv(lab.camera(camera), corners_m), abs=1e-6)


def test_every_whole_marker_is_seen_and_no_other() -> None:
    lab = build_lab(replace(SMALL, points=30, lab=replace(DRIVE, drive_s=0.0)))
    messages = list(simulate_session(lab))
    markers = sightings_of(messages)
    for truth in (m.payload for m in messages if isinstance(m.payload, Tracks)):
        for camera in lab.cameras:
            for track in truth.tracks:
                corners_m = square_at(track.x_m, track.y_m, track.z_m, track.heading_rad or 0.0)
                px = by_opencv(camera, corners_m)
                near = ((px >= -3) & (px <= [1922, 1082])).all()
                whole = ((px >= 3) & (px <= [1916, 1076])).all()
                seen = (camera.name, truth.timestamp, track.id) in markers
                assert whole <= seen <= near


def test_session_is_a_log_in_order_with_a_valid_rig() -> None:
    messages = list(simulate_session(build_lab(replace(SMALL, clock_offset_s=0.025))))
    assert all(one.log_time_ns < other.log_time_ns for one, other in pairwise(messages))
    rig = messages[0].payload
    assert isinstance(rig, Rig)
    check_rig(rig, "simulator")
    assert messages[-1].topic == "/runs/geometric/record"
    measured = [m.payload for m in messages if isinstance(m.payload, Measurement)]
    assert [m.splits for m in measured] == [("train",)] * 4
    # All five frames of a camera are in the stationary interval, by its own clock.
    seen = sightings_of(messages)
    for measurement in measured:
        assert measurement.still is not None
        frames = {camera: 0 for camera, _, _ in seen}
        for camera, time_ns, marker_id in seen:
            inside = measurement.still.start <= time_ns <= measurement.still.end
            frames[camera] += inside and marker_id == measurement.marker_id
        assert 5 in frames.values()
        assert set(frames.values()) <= {0, 5}


def test_equal_settings_give_equal_bytes_and_other_seeds_others() -> None:
    settings = replace(SMALL, corner_noise=1.0, floor_rms_m=0.002, wobble_deg=0.5, clock_offset_s=0.025)
    first, second = (
        [(m.topic, m.log_time_ns, encode(m.payload)) for m in simulate_session(build_lab(settings))]
        for _ in range(2)
    )
    assert first == second
    other = build_lab(replace(settings, lab=replace(DRIVE, seed=1)))
    assert first != [(m.topic, m.log_time_ns, encode(m.payload)) for m in simulate_session(other)]


def test_a_drive_does_not_change_the_measured_points() -> None:
    with_drive, without = build_lab(SMALL), build_lab(replace(SMALL, lab=replace(DRIVE, drive_s=0.0)))
    assert with_drive.points == without.points


def test_clock_offsets_shift_the_stamps_of_each_camera_only() -> None:
    exact, late = (build_lab(replace(SMALL, clock_offset_s=offset_s)) for offset_s in (0.0, 0.025))
    assert len(set(late.clock_offsets_ns.values())) == 3
    assert all(abs(offset_ns) <= 25_000_000 for offset_ns in late.clock_offsets_ns.values())
    shifted = sightings_of(simulate_session(late))
    for (camera, time_ns, marker_id), marker in sightings_of(simulate_session(exact)).items():
        same = shifted.pop((camera, time_ns + late.clock_offsets_ns[camera], marker_id))
        assert np.array_equal(same.corners_px, marker.corners_px)
    assert not shifted


def test_delayed_frames_show_robots_at_their_later_poses() -> None:
    lab = build_lab(replace(SMALL, points=0, frame_delays_s=(0.0, 0.011, 0.022)))
    start_ns = min(lab_time_ns for lab_time_ns in _instants(lab))
    seen = sightings_of(simulate_session(lab))
    phases = {
        camera.name: {(time_ns - start_ns) % 100_000_000 for time_ns in times_of(seen, camera.name)}
        for camera in lab.cameras
    }
    assert phases == {"red": {0}, "white": {11_000_000}, "black": {22_000_000}}
    for (camera, time_ns, marker_id), marker in seen.items():
        corners_m = driven(lab, marker_id, time_ns, start_ns)
        assert marker.corners_px == pytest.approx(by_opencv(lab.camera(camera), corners_m), abs=1e-4)


@pytest.mark.parametrize("known", [True, False])
def test_rolling_shutter_exposes_each_row_later(known: bool) -> None:
    rolling = replace(DRIVE, row_time_ns=31_000)
    lab = build_lab(replace(SMALL, lab=rolling, points=0, row_time_in_rig=known))
    messages = list(simulate_session(lab))
    rig, start_ns = messages[0].payload, min(_instants(lab))
    assert isinstance(rig, Rig)
    assert {camera.row_time_ns for camera in rig.cameras} == ({31_000} if known else {None})
    moved_px = []
    for (camera, time_ns, marker_id), marker in sightings_of(messages).items():
        rows = marker.corners_px[:, 1]
        late_ns = np.full(4, rows.mean() * 31_000) if known else rows * 31_000
        assert marker.time_offset_ns == (round(rows.mean() * 31_000) if known else None)
        for n in range(4):
            corners_m = driven(lab, marker_id, time_ns + late_ns[n], start_ns)
            wanted_px = by_opencv(lab.camera(camera), corners_m)[n]
            assert marker.corners_px[n] == pytest.approx(wanted_px, abs=1e-3)
        at_start_px = by_opencv(lab.camera(camera), driven(lab, marker_id, time_ns, start_ns))
        moved_px.append(np.abs(marker.corners_px - at_start_px).max())
    assert max(moved_px) > 5


def _instants(lab: GeometricLab) -> list[int]:
    return [m.publish_time_ns for m in simulate_session(lab) if isinstance(m.payload, Tracks)]


def test_markers_follow_height_and_slope_of_the_floor() -> None:
    lab = build_lab(replace(SMALL, floor_rms_m=0.01, floor_length_m=0.5))
    poses = np.array([[1.0, 2.0, 0.0, 0.4], [3.0, 1.0, 0.0, -1.0]])
    placed = lab.place(poses)
    assert placed.centres_m[:, 2] == pytest.approx(lab.floor.at(poses[:, :2]))
    # The corners of a small marker lie on the floor.
    corners_m = placed.corners_m(0.001).reshape(-1, 3)
    assert corners_m[:, 2] == pytest.approx(lab.floor.at(corners_m[:, :2]), abs=1e-7)
    assert np.ptp(corners_m.reshape(2, 4, 3)[..., 2], axis=1).min() > 1e-6


def test_wobble_tilts_robots_by_the_stated_angle() -> None:
    lab = build_lab(replace(SMALL, lab=replace(DRIVE, drive_s=300.0), wobble_deg=0.6))
    normals = lab.drive_poses(0, np.linspace(0, 300, 3000)).rotations[:, :, 2]
    tilts_deg = np.degrees(normals[:, :2])
    # There are about 300 independent values.
    assert tilts_deg.std(axis=0) == pytest.approx([0.6, 0.6], rel=0.15)
    still = build_lab(SMALL).drive_poses(0, np.linspace(0, 5, 50)).rotations[:, :, 2]
    assert still == pytest.approx(np.tile([0.0, 0.0, 1.0], (50, 1)), abs=1e-12)


def test_prints_and_robots_differ_from_the_rig_by_their_sigmas() -> None:
    varied = replace(SMALL, points=1, marker_scale_sigma=0.002, robot_height_sigma_m=0.001)
    labs = [build_lab(replace(varied, lab=LabSettings(seed=seed, drive_s=0.0))) for seed in range(40)]
    sides_m = np.array([[*lab.sides_m.values()] for lab in labs]).ravel()
    heights_m = np.array([[*lab.robot_heights_m.values()] for lab in labs]).ravel()
    assert (sides_m / 0.2 - 1).std() == pytest.approx(0.002, rel=0.3)
    assert (heights_m - 0.1).std() == pytest.approx(0.001, rel=0.3)
    assert abs(np.corrcoef(sides_m, heights_m)[0, 1]) < 0.4


def test_markers_of_another_size_and_height_are_seen_as_such() -> None:
    lab = build_lab(replace(SMALL, marker_scale_sigma=0.05, robot_height_sigma_m=0.02))
    messages = list(simulate_session(lab))
    truth = {m.publish_time_ns: m.payload for m in messages if isinstance(m.payload, Tracks)}
    for (camera, time_ns, marker_id), marker in sightings_of(messages).items():
        track = next(one for one in truth[time_ns].tracks if one.id == marker_id)
        centre_m = np.array([track.x_m, track.y_m, track.z_m])
        nominal_m = square_at(track.x_m, track.y_m, track.z_m, track.heading_rad or 0.0)
        corners_m = centre_m + lab.sides_m[marker_id] / 0.2 * (nominal_m - centre_m)
        assert marker.corners_px == pytest.approx(by_opencv(lab.camera(camera), corners_m), abs=1e-6)
    end = max(truth)
    driving_m = {track.id: track.z_m for track in truth[end].tracks}
    assert driving_m == pytest.approx(dict(lab.robot_heights_m))


def test_held_out_points_have_the_split_test() -> None:
    messages = simulate_session(build_lab(replace(SMALL, held_out_points=3)))
    splits = [m.payload.splits for m in messages if isinstance(m.payload, Measurement)]
    assert splits == [("train",)] * 4 + [("test",)] * 3


def test_intrinsics_of_the_user_have_the_stated_errors() -> None:
    def lenses(kind: str) -> list[tuple[CameraCalibration, CameraCalibration]]:
        lab = build_lab(replace(SMALL, intrinsics=kind))
        return [(lab.calibrations[camera.name], camera.lens) for camera in lab.cameras]

    for given, true in lenses("true"):
        assert np.array_equal(given.K, true.K)
        assert np.array_equal(given.D, true.D)
    for given, true in lenses("calibrated"):
        assert 0 < abs(given.K[0, 0] / true.K[0, 0] - 1) < 5 * 0.0005
        assert 0 < np.abs(given.K[:2, 2] - true.K[:2, 2]).max() < 5 * 0.5
        assert 0 < np.abs(given.D - true.D).max() < 5 * 0.0005
    for given, true in lenses("nominal"):
        assert abs(given.K[0, 0] / true.K[0, 0] - 1) == pytest.approx(0.05)
        assert given.K[:2, 2].tolist() == [959.5, 539.5]
        assert not given.D.any()


def test_tilted_cameras_still_see_their_part_of_the_floor() -> None:
    lab = build_lab(replace(SMALL, lab=replace(DRIVE, tilt_deg=(20.0, 30.0)), points=30))
    for camera in lab.cameras:
        down = camera.camera_from_world[2, :3] @ [0, 0, -1]
        assert 20 <= np.degrees(np.arccos(down)) <= 30
        sightings = simulate_sightings(lab, camera)
        assert len(np.unique(sightings.placements[sightings.placements < 30])) >= 8


def test_a_written_session_can_be_fitted_without_images(tmp_path: Path) -> None:
    path = tmp_path / "lab.mcap"
    write_log(path, simulate_session(build_lab(GeometricSettings(points=18))))
    outcomes = replay([path], Request(models=("rayplane",)), until="fit")
    assert [(one.stage, one.run) for one in outcomes] == [("camera-frame", "geometric"), ("fit", "rayplane")]
    with Session([path]) as session:
        (message,) = session.messages(session.topics(MODEL, "rayplane"))
    pairs = {camera.camera: len(camera.pairs) for camera in message.payload.cameras}
    assert set(pairs) == {"red", "white", "black"}
    assert min(pairs.values()) >= 6


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"intrinsics": "good"}, "use one of true, calibrated, nominal"),
        ({"floor_rms_m": -1.0}, "floor_rms_m is -1.0"),
        ({"clock_offset_s": float("nan")}, "clock_offset_s is nan"),
        ({"floor_length_m": 0.0}, "floor_length_m is 0.0"),
        ({"frame_delays_s": ()}, "frame_delays_s is empty"),
        ({"points": 0, "lab": LabSettings(drive_s=0.0)}, "nothing to see"),
    ],
)
def test_impossible_settings_are_refused(change: dict[str, object], text: str) -> None:
    with pytest.raises(IpsysError, match=text):
        replace(SMALL, **change)  # type: ignore[arg-type]


def test_pose_of_the_tests_agrees_with_that_of_the_package() -> None:
    placed = pose_facing_up(1.0, 2.0, 0.1, 0.7)
    corners_m = SQUARE_M @ placed[:3, :3].T + placed[:3, 3]
    assert square_at(1.0, 2.0, 0.1, 0.7) == pytest.approx(corners_m)
