"""Single stages with direct input."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ipsys_log.messages import (
    CameraPoint,
    CameraPoints,
    CompressedImage,
    Message,
    Pair,
    Position,
    Positions,
    Rig,
    RigMarker,
)
from ipsys_log.models.locate_points import LocatePoints
from ipsys_log.stages.detect import Detect
from ipsys_log.stages.fuse import Fuse
from ipsys_log.statistics.camera_models import fit_model
from ipsys_log.vision.decode import decode_grey

RIG = Message("/rig", 0, 0, Rig("lab", "DICT_4X4_100", 0.2, (RigMarker(3, robot="ada"),)))


def frame(payload: Any, time_ns: int = 1, camera: str = "red") -> Message:
    return Message(f"/cameras/{camera}/image", time_ns, time_ns, payload, camera)


def test_detected_corners_are_where_they_were_drawn() -> None:
    """Draw a marker 8 times too large and reduce it: its corners are known to a fraction of a pixel."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    large = np.full((480 * 8, 640 * 8), 200, np.uint8)
    large[1003:1803, 2005:2805] = cv2.aruco.generateImageMarker(dictionary, 3, 800)
    small = cv2.resize(large, (640, 480), interpolation=cv2.INTER_AREA)
    data = cv2.imencode(".png", cv2.GaussianBlur(small, (0, 0), 0.7))[1].tobytes()
    detect = Detect("stock")
    list(detect(RIG))
    found = list(detect(frame(CompressedImage(1, "red", data, "png"))))
    (marker,) = found[0].markers
    left, top, right, bottom = (v / 8 - 0.5 for v in (2005, 1003, 2805, 1803))
    # The authors' refinement moves a blurred corner inwards by about a quarter of a pixel.
    np.testing.assert_allclose(
        marker.corners_px, [[left, top], [right, top], [right, bottom], [left, bottom]], atol=0.3
    )
    assert (found[0].width, found[0].height) == (640, 480)
    # Viewers count from the corner of the first pixel.
    drawn = found[1].points[0].points[0]
    np.testing.assert_allclose([drawn.x, drawn.y], marker.corners_px[0] + 0.5)


def test_a_jpeg_is_decoded_as_opencv_decodes_it() -> None:
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.integers(0, 255, (120, 160, 3), np.uint8), (0, 0), 2)
    data = cv2.imencode(".jpg", picture)[1]
    expected = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(decode_grey(CompressedImage(0, "a", data.tobytes(), "jpeg")), expected)


def test_the_world_heading_follows_the_model() -> None:
    turn = Rotation.from_euler("xyz", (np.pi, 0.0, 0.4))
    points = np.random.default_rng(0).uniform((-1, -1, 1.9), (1, 1, 2.1), (20, 3))
    world = turn.apply(points) + 2.0
    pairs = [Pair(str(n), 0, p, w, 1) for n, (p, w) in enumerate(zip(points, world, strict=True))]
    locate = LocatePoints(fit_model("rigid", {"red": pairs}, 0))
    angle = -0.7  # in the image; the heading is minus this angle
    seen = CameraPoints(1, (CameraPoint(3, 0.1, 0.2, 2.0, -angle), CameraPoint(4, 0.1, 0.2, 2.0)))
    (positions,) = locate(Message("t", 1, 1, seen, "red"))
    along = turn.apply([np.cos(angle), np.sin(angle), 0])
    assert positions.positions[0].heading_rad == pytest.approx(np.arctan2(along[1], along[0]))
    assert positions.positions[1].heading_rad is None
    assert positions.positions[0].x_m == pytest.approx(turn.apply([0.1, 0.2, 2.0])[0] + 2)
    assert list(locate(Message("t", 1, 1, seen, "unknown"))) == []


def at(x_m: float, variance: float | None, heading_rad: float | None = None) -> Position:
    covariance = None if variance is None else variance * np.eye(3)
    return Position(3, x_m, 0.0, 0.0, heading_rad, covariance)


def fused(*sent: tuple[str, float, Position]) -> list[Any]:
    """Return the payloads of fuse for positions of cameras at times in ms."""
    fuse = Fuse("poly")
    list(fuse(RIG))
    made: list[Any] = []
    for camera, time_ms, position in sent:
        time_ns = round(time_ms * 1_000_000)
        made += fuse(Message("t", time_ns, time_ns, Positions(time_ns, (position,)), camera))
    return made


def test_track_lies_between_positions_by_their_weights() -> None:
    made = fused(("red", 0, at(0.0, 1e-6)), ("white", 0, at(0.001, 3e-6)), ("red", 0.001, at(0.0, 1.0)))
    track = made[2].tracks[0]
    assert track.x_m == pytest.approx(0.00025, abs=2e-5)
    assert track.covariance_m2[0, 0] == pytest.approx(0.75e-6, rel=0.1)
    assert track.cameras == ("red", "white")
    assert made[3].transforms[0].child_frame_id == "poly/ada"


def test_headings_are_averaged_around_the_circle() -> None:
    made = fused(("red", 0, at(0, 1e-6, np.pi - 0.001)), ("white", 0, at(0, 1e-6, -np.pi + 0.001)))
    made += fused(("red", 0, at(0, 1e-6, np.pi - 0.001)), ("white", 1, at(0, 1e-6, -np.pi + 0.001)))
    assert abs(made[-2].tracks[0].heading_rad) == pytest.approx(np.pi, abs=1e-3)


def test_positions_without_covariance_give_no_covariance() -> None:
    (tracks, _) = fused(("red", 0, at(0.0, None, 0.1)))
    (track,) = tracks.tracks
    assert (track.covariance_m2, track.velocity_covariance_m2_s2, track.heading_sigma_rad) == (None,) * 3
    assert (track.x_m, track.heading_rad, track.robot) == (0.0, pytest.approx(0.1), "ada")


def test_one_instant_of_two_cameras_has_one_pose() -> None:
    made = fused(*((camera, 33 * n, at(0.0, 1e-6)) for n in range(5) for camera in ("red", "white")))
    times_ns = [payload.timestamp for payload in made[::2]]
    assert times_ns == [33 * n * 1_000_000 for n in range(5)]


def test_unseen_robot_coasts_at_the_instants_of_other_frames() -> None:
    sent = [("red", 33 * n, at(0.01 * n, 1e-6)) for n in range(10)]
    other = Position(4, 1.0, 1.0, 0.0, None, 1e-6 * np.eye(3))
    made = fused(*sent, *(("white", 33 * n, other) for n in range(10, 50)))
    rows = [(p.timestamp, track) for p in made[::2] for track in p.tracks if track.robot == "ada"]
    coasting = [(t, track) for t, track in rows if track.coasting_ns is not None]
    assert [t - track.coasting_ns for t, track in coasting] == [297_000_000] * len(coasting)
    assert 1.2e9 < coasting[-1][0] < 1.3e9
    assert coasting[-1][1].x_m > 0.15
    assert coasting[-1][1].cameras == ()


@pytest.mark.parametrize(
    "wrong",
    [
        Position(3, float("nan"), 0.0, 0.0),
        Position(3, 1e300, 0.0, 0.0),
        Position(3, 0.0, 0.0, 0.0, float("inf"), -np.eye(3)),
        Position(3, 0.0, 0.0, 0.0, 0.1, np.full((3, 3), np.nan), noise_m2=np.full((3, 3), np.inf)),
        Position(3, 0.0, 0.0, 0.0, 0.1, 1e-6 * np.eye(3), heading_noise_rad=float("nan")),
    ],
)
def test_impossible_numbers_of_a_log_do_not_spread(wrong: Position) -> None:
    good = at(0.0, 1e-6, 0.1)
    made = fused(("red", 0, wrong), ("red", 33, good), ("red", 66, wrong), ("red", 99, good))
    track = made[-2].tracks[0]
    assert made[-2].timestamp == 99_000_000
    assert abs(track.x_m) < 1e-3
    assert track.heading_rad == pytest.approx(0.1, abs=1e-3)
    assert np.linalg.eigvalsh(track.covariance_m2)[0] > 0


def test_no_marker_no_track() -> None:
    fuse = Fuse("poly")
    list(fuse(RIG))
    assert list(fuse(Message("t", 1, 1, Positions(1, ()), "red"))) == []
