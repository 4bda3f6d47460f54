"""Rolling shutter and motion blur, compared with static frames combined row by row."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from ipsys_log.capture.simulation.calibration_points import place_marker, plan_points
from ipsys_log.capture.simulation.cameras import Camera, mount_cameras, prepare_view
from ipsys_log.capture.simulation.drive import Drive, plan_drive
from ipsys_log.capture.simulation.lab import EPOCH_NS, simulate, start_of_set_ns
from ipsys_log.capture.simulation.render import expose
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import CameraCalibration, CompressedImage, Message, Rig, Tracks
from ipsys_log.vision.markers import MovingMarker, PlacedMarker, project_corners
from ipsys_log.vision.poses import look_down, pose_facing_up
from tests.tiers import first_fast

Array = NDArray[np.float64]

ROW_NS = 62_000
# Exposure in row times, about 1/60 s: it contains as many static frames.
FRAMES = 269
EXPOSURE_S = FRAMES * ROW_NS * 1e-9
SPEED_M_S = 2.0
STILL = LabSettings(noise_sigma=0.0)
SHUTTERS = {
    "rolling": replace(STILL, row_time_ns=ROW_NS),
    "blurred": replace(STILL, exposure_s=EXPOSURE_S),
    "both": replace(STILL, row_time_ns=ROW_NS, exposure_s=EXPOSURE_S),
}


@pytest.fixture(scope="module")
def camera() -> Camera:
    """A part of a frame, for speed: 260 x 240 px beside the axis of a lens 2.1 m above the floor."""
    K = np.array([[1150.0, 0.0, 49.7], [0.0, 1152.0, 150.2], [0.0, 0.0, 1.0]])
    D, P = np.array([-0.13, 0.01, -0.03, 0.02]), np.hstack([K, np.zeros((3, 1))])
    lens = CameraCalibration(0, "red", 260, 240, "kannala_brandt", D, K, np.eye(3), P)
    return Camera("red", lens, look_down(np.array([2.4, 2.4, 2.1]), np.array([0.03, -0.02, 0.0])))


# Positions of a marker at the exposure of row 120: at the centre of the part; half outside, at its corner;
# below the last row, but entering during the exposure of the frame.
MIDDLE, CORNER, BELOW = (2.580, 2.393), (2.806, 2.189), (2.582, 2.095)


def drive_past(where_m: tuple[float, float], towards_rad: float, turn_rad_s: float) -> MovingMarker:
    """Return a moving marker with a given position at the exposure of row 120."""
    velocity = SPEED_M_S * np.array([np.cos(towards_rad), np.sin(towards_rad)])

    def moving(time_s: float) -> PlacedMarker:
        since_s = time_s - 120 * ROW_NS * 1e-9
        x_m, y_m = where_m + velocity * since_s
        return PlacedMarker(3, 0.1, pose_facing_up(float(x_m), float(y_m), 0.1, 0.4 + turn_rad_s * since_s))

    return moving


def by_brute_force(camera: Camera, moving: MovingMarker, settings: LabSettings) -> Array:
    """Return for each row the mean light of the static frames within its exposure."""
    frozen = replace(settings, row_time_ns=0, exposure_s=0.0)
    view = prepare_view(camera, frozen)
    height = camera.lens.height
    before = FRAMES // 2 if settings.exposure_s else 0
    opens = np.arange(height) * bool(settings.row_time_ns) - before
    light, counted = np.zeros((height, camera.lens.width)), np.zeros(height)
    for number in range(opens[0], opens[-1] + 2 * before + 1):
        frame = expose(view, [moving(number * ROW_NS * 1e-9)], frozen).astype(np.float64)
        rows = (number >= opens) & (number <= opens + 2 * before)
        light[rows] += (frame[rows] / 255) ** settings.gamma
        counted[rows] += 1
    assert (counted == 2 * before + 1).all()
    return 255 * (light / counted[:, None]) ** (1 / settings.gamma)


def edge_shift_px(found: Array, wanted: Array) -> float:
    """Return the largest possible edge error in px, from the excess light within nine pixels."""
    off = (found - wanted) / (STILL.white - STILL.black)
    return max(float(np.abs(uniform_filter1d(off, 9, axis=axis)).max()) * 9 for axis in (0, 1))


@pytest.mark.parametrize(
    ("shutter", "gamma", "where_m", "towards_rad"),
    first_fast(
        3,
        [
            ("rolling", 1.0, MIDDLE, 1.9),
            ("blurred", 1.0, MIDDLE, 1.9),
            ("both", 1.0, MIDDLE, 1.9),
            ("both", 2.2, MIDDLE, -0.6),
            ("rolling", 1.0, CORNER, 1.9),
            ("rolling", 1.0, BELOW, np.pi / 2),
        ],
    ),
)
def test_a_moving_marker_equals_one_drawn_by_brute_force(
    camera: Camera, shutter: str, gamma: float, where_m: tuple[float, float], towards_rad: float
) -> None:
    settings = replace(SHUTTERS[shutter], gamma=gamma)
    moving = drive_past(where_m, towards_rad, turn_rad_s=-2.5)
    view = prepare_view(camera, settings)
    found = expose(view, [moving], settings).astype(np.float64)
    wanted = by_brute_force(camera, moving, settings)
    assert np.abs(wanted - expose(view, [moving(0.0)], settings)).max() > 40
    assert edge_shift_px(found, wanted) < (0.01 if gamma == 1 else 0.02)
    assert np.abs(found - wanted).max() < (0.3 if gamma == 1 else 0.8)


def test_the_marker_below_the_frame_comes_in_while_it_is_taken(camera: Camera) -> None:
    """Otherwise the comparison would use empty floors."""
    settings = SHUTTERS["rolling"]
    view, moving = prepare_view(camera, settings), drive_past(BELOW, np.pi / 2, -2.5)
    bare = expose(view, [], settings)
    np.testing.assert_array_equal(expose(view, [moving(0.0)], settings), bare)
    assert (expose(view, [moving], settings) != bare).any()


@pytest.mark.parametrize("shutter", SHUTTERS)
def test_stationary_marker_is_drawn_without_motion_blur(camera: Camera, shutter: str) -> None:
    placed = drive_past(MIDDLE, 0.0, 0.0)(0.0)
    before = expose(prepare_view(camera, STILL), [placed], STILL)
    view = prepare_view(camera, SHUTTERS[shutter])
    for one in (placed, lambda time_s: placed):
        np.testing.assert_array_equal(expose(view, [one], SHUTTERS[shutter]), before)


def test_global_shutter_shows_a_marker_at_the_frame_time(camera: Camera) -> None:
    moving = drive_past(MIDDLE, 0.3, 1.0)
    view = prepare_view(camera, STILL)
    np.testing.assert_array_equal(expose(view, [moving], STILL), expose(view, [moving(0.0)], STILL))


LAB = LabSettings(
    width=640,
    height=360,
    stations=1,
    frames_per_station=2,
    drive_s=2.0,
    drive_speed_m_s=SPEED_M_S,
    rate_hz=10.0,
    row_time_ns=3 * ROW_NS,
)


@pytest.fixture(scope="module")
def session() -> list[Message]:
    return list(simulate(LAB))


def drive_of(settings: LabSettings) -> tuple[Drive, int, dict[str, Camera]]:
    cameras = mount_cameras(settings, EPOCH_NS)
    named = {camera.name: camera for camera in cameras}
    return (
        plan_drive(settings, cameras),
        start_of_set_ns(settings, len(plan_points(settings, cameras))),
        named,
    )


def test_ground_truth_has_the_time_of_the_frame(session: list[Message]) -> None:
    drive, start_ns, _ = drive_of(LAB)
    truth = [m.payload for m in session if isinstance(m.payload, Tracks)]
    driving = [tracks for tracks in truth if tracks.timestamp >= start_ns]
    assert len(driving) == 20
    assert driving[0].timestamp == start_ns
    for tracks in driving:
        places = drive.poses_at((tracks.timestamp - start_ns) / 1e9)
        assert [(t.id, t.x_m, t.y_m, t.heading_rad) for t in tracks.tracks] == [
            (p.marker_id, p.x_m, p.y_m, p.heading_rad) for p in places
        ]


def test_robots_are_stationary_before_their_start() -> None:
    drive = drive_of(LAB)[0]
    assert drive.poses_at(-1.0) == drive.poses_at(0.0)
    assert drive.poses_at(1e-2) != drive.poses_at(0.0)


def test_corners_follow_the_exposure_time_of_their_row(session: list[Message]) -> None:
    drive, start_ns, cameras = drive_of(LAB)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100))
    off_px: dict[str, list[Array]] = {"own row": [], "frame": []}
    for m in session:
        if not isinstance(m.payload, CompressedImage) or m.publish_time_ns < start_ns:
            continue
        camera = cameras[m.payload.frame_id]
        image = np.asarray(cv2.imdecode(np.frombuffer(m.payload.data, np.uint8), cv2.IMREAD_GRAYSCALE))
        corners, ids, _ = detector.detectMarkers(image)
        for found, marker_id in zip(corners, [] if ids is None else np.ravel(ids).tolist(), strict=True):
            start = np.ascontiguousarray(found, np.float32).reshape(-1, 1, 2)
            fine = cv2.cornerSubPix(image, start, (2, 2), (-1, -1), (3, 40, 0.001)).reshape(4, 2)
            for number, px in enumerate(fine):
                for name, row in (("own row", float(px[1])), ("frame", 0.0)):
                    time_s = (m.publish_time_ns - start_ns + row * LAB.row_time_ns) / 1e9
                    placed = place_marker(drive.poses_at(time_s)[int(marker_id)], LAB)
                    truth = project_corners(camera.lens, camera.camera_from_world, placed)[number]
                    off_px[name].append(px - truth)
    assert len(off_px["frame"]) > 200
    rms = {name: float(np.sqrt(np.mean(np.sum(np.square(off), axis=-1)))) for name, off in off_px.items()}
    # The accuracy is that of a global shutter.
    assert rms["own row"] < 0.4
    assert rms["frame"] > 2


def test_rig_has_the_row_time_or_no_entry() -> None:
    for settings, row_time_ns in ((LAB, 3 * ROW_NS), (replace(LAB, row_time_ns=0), None)):
        rig = next(simulate(settings)).payload
        assert isinstance(rig, Rig)
        assert [camera.row_time_ns for camera in rig.cameras] == [row_time_ns] * 3


def test_a_frame_arrives_after_its_last_row_was_exposed() -> None:
    settings = replace(LAB, exposure_s=0.05, drive_s=0.0)
    frame = next(m for m in simulate(settings) if isinstance(m.payload, CompressedImage))
    assert frame.log_time_ns > frame.publish_time_ns + 359 * LAB.row_time_ns + 25_000_000
