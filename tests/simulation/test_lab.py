"""The contents of the simulated session."""

import hashlib
from collections import Counter
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from ipsys_log.capture.simulation.calibration_points import (
    SimulatedPose,
    cameras_seeing,
    measure,
    plan_points,
    split,
)
from ipsys_log.capture.simulation.cameras import mount_cameras, sees
from ipsys_log.capture.simulation.drive import plan_drive
from ipsys_log.capture.simulation.lab import simulate
from ipsys_log.capture.simulation.settings import FLOOR_M, LabSettings
from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import encode
from ipsys_log.messages import CameraCalibration, CompressedImage, Measurement, Message, Rig, Tracks
from ipsys_log.messages.rig_file import check_rig
from ipsys_log.vision.decode import decode_grey
from ipsys_log.vision.markers import PlacedMarker, project_corners
from ipsys_log.vision.trilateration import trilaterate

SMALL = LabSettings(width=640, height=360, stations=4, frames_per_station=2, drive_s=0.5, rate_hz=10.0)


@pytest.fixture(scope="module")
def session() -> list[Message]:
    return list(simulate(SMALL))


def digest(messages: list[Message]) -> str:
    found = hashlib.sha256()
    for m in messages:
        found.update(f"{m.topic} {m.log_time_ns} {m.publish_time_ns} {m.camera}".encode())
        found.update(encode(m.payload))
    return found.hexdigest()


def test_a_seed_gives_the_same_bytes_and_another_seed_others(session: list[Message]) -> None:
    assert digest(list(simulate(SMALL))) == digest(session)
    first = next(m for m in session if isinstance(m.payload, CompressedImage))
    other = LabSettings(seed=1, width=640, height=360, stations=4, frames_per_station=2)
    others = (m for m in simulate(other) if isinstance(m.payload, CompressedImage))
    assert next(others).payload.data != first.payload.data


def test_textured_floor_has_a_seed_and_moving_feet() -> None:
    lab = replace(SMALL, textured=True, stations=0, markers=1, cameras=("white",), rate_hz=2.0, drive_s=1.0)
    frames = [
        [m.payload for m in simulate(settings) if isinstance(m.payload, CompressedImage)]
        for settings in (lab, lab, replace(lab, seed=1))
    ]
    assert [frame.data for frame in frames[0]] == [frame.data for frame in frames[1]]
    first, later, other = map(decode_grey, (*frames[0], frames[2][0]))
    # Feet and the robot cover a small part of the image; another seed gives another floor.
    assert 0.002 < np.mean(cv2.absdiff(first, later) > 40) < 0.05
    assert np.mean(cv2.absdiff(first, other) > 40) > 0.05


def test_messages_come_in_log_order_with_their_own_times(session: list[Message]) -> None:
    times = [m.log_time_ns for m in session]
    assert all(earlier < later for earlier, later in pairwise(times))
    for m in session:
        assert m.log_time_ns > m.publish_time_ns
        assert getattr(m.payload, "timestamp", m.publish_time_ns) == m.publish_time_ns
    assert isinstance(session[0].payload, Rig)
    check_rig(session[0].payload, "simulator")
    assert [m.topic for m in session[1:4]] == [f"/cameras/{c}/calibration" for c in SMALL.cameras]


def test_images_and_calibrations_share_the_name_of_their_camera(session: list[Message]) -> None:
    for m in session:
        if isinstance(m.payload, CameraCalibration | CompressedImage):
            assert m.payload.frame_id == m.camera
            assert m.topic.split("/")[2] == m.camera
        else:
            assert m.camera is None


def test_all_cameras_take_their_frames_at_the_same_instants(session: list[Message]) -> None:
    instants = {
        camera: [
            m.publish_time_ns
            for m in session
            if m.camera == camera and isinstance(m.payload, CompressedImage)
        ]
        for camera in SMALL.cameras
    }
    truth = [m.publish_time_ns for m in session if isinstance(m.payload, Tracks)]
    assert all(times == truth for times in instants.values())


def test_markers_are_seen_in_the_images_where_the_truth_says(session: list[Message]) -> None:
    """At a third of the size, the stock detector misses some distant markers.

    The detected ones must be correct.
    """
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100))
    cameras = {camera.name: camera for camera in mount_cameras(SMALL)}
    truth: Tracks | None = None
    found, whole = 0, 0
    for m in session:
        if isinstance(m.payload, Tracks):
            truth = m.payload
        if not isinstance(m.payload, CompressedImage):
            continue
        assert truth is not None
        assert m.camera is not None
        image = np.asarray(cv2.imdecode(np.frombuffer(m.payload.data, np.uint8), cv2.IMREAD_GRAYSCALE))
        corners, ids, _ = detector.detectMarkers(image)
        tracks = {t.id: t for t in truth.tracks}
        whole += sum(m.camera in t.cameras for t in truth.tracks)
        for px, marker_id in zip(corners, [] if ids is None else np.ravel(ids).tolist(), strict=True):
            t = tracks[int(marker_id)]
            assert t.heading_rad is not None
            up, right = rotated(t.heading_rad)
            pose = np.eye(4)
            pose[:2, 0], pose[:2, 1], pose[:3, 3] = right, up, [t.x_m, t.y_m, t.z_m]
            camera = cameras[m.camera]
            wanted = project_corners(camera.lens, camera.camera_from_world, PlacedMarker(t.id, 0.2, pose))
            assert np.abs(np.reshape(px, (4, 2)) - wanted).max() < 2.0
            found += m.camera in t.cameras
    assert found >= 0.8 * whole


def rotated(heading_rad: float) -> tuple[list[float], list[float]]:
    c, s = float(np.cos(heading_rad)), float(np.sin(heading_rad))
    return [c, s], [s, -c]


def test_measurement_is_within_its_stationary_interval(session: list[Message]) -> None:
    truth = {
        (m.payload.timestamp, t.id): t
        for m in session
        if isinstance(m.payload, Tracks)
        for t in m.payload.tracks
    }
    rig = session[0].payload
    a, b = (np.array([p.x_m, p.y_m]) for p in rig.reference_points)
    measured = [m.payload for m in session if isinstance(m.payload, Measurement)]
    assert len({m.id for m in measured}) == len(measured)
    for m in measured:
        assert m.side is not None
        t = truth[(m.timestamp, m.marker_id or 0)]
        point = trilaterate(a, b, m.distances[0].distance_m, m.distances[1].distance_m, m.side)
        assert np.hypot(*(point - [t.x_m, t.y_m])) < 0.06
        if m.still is not None:
            assert m.still.start <= m.timestamp <= m.still.end
            for end in (m.still.start, m.still.end):
                assert truth[(end, t.id)].x_m == t.x_m
    assert {m.still is None for m in measured} == {True, False}


def test_tape_and_ruler_err_by_their_sigmas() -> None:
    settings = LabSettings(tape_sigma_m=0.004, ruler_sigma_m=0.002)
    where = SimulatedPose(0, 1.0, 4.0, 0.1, 0.0)
    truth = [np.hypot(1.0 - 1.2192, 4.0 - 2.4384), np.hypot(1.0 - 3.6576, 4.0 - 2.4384)]
    taken = [measure(where, settings, n, [0, 1, 2], ("train",)) for n in range(1500)]
    off = np.array([[d.distance_m for d in m.distances] for m in taken]) - truth
    assert off.std() == pytest.approx(0.004, rel=0.06)
    assert abs(off.mean()) < 0.0003
    assert np.corrcoef(off.T)[0, 1] == pytest.approx(0.0, abs=0.1)
    heights = np.array([m.height_m for m in taken], dtype=float)
    assert (heights - 0.1).std() == pytest.approx(0.002, rel=0.08)
    assert taken[0].distances[0].sigma_m == 0.004
    assert taken[0].height_sigma_m == 0.002


def test_each_camera_gets_its_points_and_a_fifth_are_held_out() -> None:
    settings = LabSettings()
    cameras = mount_cameras(settings)
    sets = plan_points(settings, cameras)
    splits = iter(split(sets, settings.seed))
    seen: Counter[tuple[str, str]] = Counter()
    for stations in sets:
        for station in stations:
            label = next(splits)[0]
            for camera in cameras_seeing(station.pose, cameras, settings):
                seen[camera, label] += 1
    for camera in settings.cameras:
        train, test = seen[camera, "train"], seen[camera, "test"]
        assert 45 <= train + test <= 75
        assert train >= 30
        assert 6 <= test <= 0.35 * train


@pytest.mark.parametrize("seed", range(5))
def test_every_spot_of_the_floor_is_seen(seed: int) -> None:
    x, y = np.meshgrid(np.linspace(0, FLOOR_M, 60), np.linspace(0, FLOOR_M, 60))
    spots = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    seen = [sees(camera, spots) for camera in mount_cameras(LabSettings(seed=seed))]
    assert np.any(seen, axis=0).all()


@pytest.mark.parametrize("markers", [1, 3, 8])
def test_robots_stay_in_view_and_within_their_speed(markers: int) -> None:
    settings = LabSettings(markers=markers, drive_s=35.0)
    cameras = mount_cameras(settings)
    drive = plan_drive(settings, cameras)
    for time_s in np.arange(0, 35, 0.5).tolist():
        now, soon = drive.poses_at(time_s), drive.poses_at(time_s + 1e-3)
        assert len(now) == markers
        for before, after in zip(now, soon, strict=True):
            assert cameras_seeing(before, cameras, settings)
            dx, dy = after.x_m - before.x_m, after.y_m - before.y_m
            assert np.hypot(dx, dy) <= 0.501e-3
            if time_s:
                assert np.cos(np.arctan2(dy, dx) - before.heading_rad) > 0.999


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"markers": 101}, "has 100 markers, but markers = 101"),
        ({"dictionary": "DICT_9X9"}, "no marker dictionary 'DICT_9X9'"),
        ({"rate_hz": 0.0}, "rate_hz is 0.0; give a value between 1 and 240"),
        ({"row_time_ns": -1}, "row_time_ns is -1; give a value between 0 and 500000"),
        ({"exposure_s": 2.0}, "exposure_s is 2.0; give a value between 0 and 1"),
        ({"noise_sigma": float("nan")}, "noise_sigma is nan"),
        ({"black": 210.0}, r"black \(210\) must be below white"),
        ({"cameras": ("red", "red")}, "two cameras have the same name"),
        ({"cameras": ("Red",)}, "camera name 'Red'"),
        ({"cameras": ()}, "name at least one camera"),
        ({"heights_m": ()}, "heights_m is empty"),
        ({"tilt_deg": (2.0, 1.0)}, "tilt_deg"),
        ({"stations": 0, "drive_s": 0.0}, "nothing to show"),
    ],
)
def test_impossible_settings_give_one_line(change: dict[str, object], said: str) -> None:
    with pytest.raises(IpsysError, match=said) as error:
        LabSettings(**change)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)


def test_a_lab_that_cannot_be_built_says_why() -> None:
    with pytest.raises(IpsysError, match="'red' cannot see its part of the floor"):
        mount_cameras(LabSettings(mount_height_m=1.5))
    crowded = LabSettings(markers=60, marker_length_m=0.5)
    with pytest.raises(IpsysError, match="has no room beside"):
        plan_points(crowded, mount_cameras(LabSettings()))


@pytest.mark.slow
def test_default_lab_has_the_documented_contents() -> None:
    counts: Counter[str] = Counter(m.topic for m in simulate(LabSettings(drive_s=2.0)))
    assert counts["/cameras/red/image"] == counts["/truth/tracks"] > 200
    assert counts["/measurements"] > 100
