"""Marker centres in camera coordinates, by both methods."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    CameraCalibration,
    CameraPoint,
    CameraPoints,
    Event,
    Marker,
    Markers,
    Message,
    Rig,
    RigMarker,
)
from ipsys_log.messages.channels import CAMERA_POINTS
from ipsys_log.stages.camera_frame import METHODS, CameraFrame
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.markers import camera_point, heading
from tests.conftest import ROOT, Ipsys
from tests.geometry.squares import CENTRE, EDGE, FISHEYE, LENSES, MIDWAY, Array, corners_px, turned
from tests.stages.real_board import RIG as BOARD_RIG
from tests.stages.real_board import read_lens, read_markers

RIG = Rig("lab", "DICT_4X4_100", 0.2, (RigMarker(3), RigMarker(4, length_m=0.1), RigMarker(5)))
SIGMA_PX = 0.03


def points(
    method: str, *markers: Marker, lens: CameraCalibration = FISHEYE, rig: Rig = RIG
) -> tuple[tuple[CameraPoint, ...], list[Event]]:
    """Return the camera points of one frame with these markers."""
    stage = CameraFrame(method)
    for payload, camera in ((rig, None), (lens, "red")):
        assert list(stage(Message("t", 0, 0, payload, camera))) == []
    *events, found = stage(Message("t", 8, 7, Markers(7, markers, lens.width, lens.height), "red"))
    assert isinstance(found, CameraPoints)
    assert found.timestamp == 7
    return found.points, events


def marker(
    marker_id: int = 3,
    place_m: tuple[float, float, float] = MIDWAY,
    axes: Array | None = None,
    lens: CameraCalibration = FISHEYE,
    **given: Any,
) -> Marker:
    axes = turned(0.4) if axes is None else axes
    seen_px = corners_px(lens, axes, np.array(place_m), RIG.length_of(marker_id))
    return Marker(marker_id, seen_px, **given)


def where(point: CameraPoint) -> tuple[float, float, float]:
    return point.x_m, point.y_m, point.z_m


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("method", METHODS)
def test_a_parallel_marker_is_where_it_is(method: str, model: str) -> None:
    lens = LENSES[model]
    places_m = {3: CENTRE, 4: (-0.6, 0.3, 1.8), 5: MIDWAY}
    seen = [marker(n, place_m, turned(2.0 - n), lens) for n, place_m in places_m.items()]
    found, events = points(method, *seen, lens=lens)
    assert events == []
    for point in found:
        np.testing.assert_allclose(where(point), places_m[point.id], atol=2e-6)
        assert point.heading_rad == pytest.approx(2.0 - point.id, abs=1e-4)


def test_a_tilted_marker_is_where_it_is_by_its_pose() -> None:
    axes = turned(0.4, 5.0, 1.0)
    (by_pose,), _ = points("pose", marker(3, EDGE, axes))
    (by_perimeter,), _ = points("perimeter", marker(3, EDGE, axes))
    np.testing.assert_allclose(where(by_pose), EDGE, atol=1e-6)
    assert np.linalg.norm(np.subtract(where(by_perimeter), EDGE)) > 0.05
    # Both poses are stored, the chosen one first, with the direction of its y axis as heading.
    taken, other = by_pose.poses
    assert (taken.x_m, taken.y_m, taken.z_m) == where(by_pose)
    assert taken.reprojection_px < 1e-6 < other.reprojection_px
    np.testing.assert_allclose(turned_back(taken.rotation_rad), axes, atol=1e-6)
    assert by_pose.heading_rad == pytest.approx(np.arctan2(-axes[1, 1], axes[0, 1]))
    assert by_perimeter.poses == ()


def turned_back(vector_rad: Array) -> Array:
    angle = np.linalg.norm(vector_rad)
    x, y, z = vector_rad / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


@pytest.mark.parametrize("method", METHODS)
def test_the_time_offset_is_handed_on(method: str) -> None:
    found, _ = points(method, marker(3, time_offset_ns=-5), marker(5, CENTRE))
    assert [point.time_offset_ns for point in found] == [-5, None]


@pytest.mark.parametrize("place_m", [CENTRE, MIDWAY, EDGE])
@pytest.mark.parametrize("method", METHODS)
def test_the_covariance_is_that_of_the_scatter(method: str, place_m: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(0, SIGMA_PX / 3, (8, 8))
    exact = marker(3, place_m, turned(0.4, 3.0, 1.0))
    noise_px = (rng.normal(size=(500, 8)) @ root.T).reshape(-1, 4, 2)
    if method == "pose":  # this covariance has the errors of the lens
        noise_px += rng.normal(0, 0.18, (500, 1, 2))
    noisy = [Marker(3, exact.corners_px + off, root @ root.T) for off in noise_px]
    found, _ = points(method, *noisy)
    places_m = np.array([where(point) for point in found])
    if method == "pose":  # and of the print
        places_m *= rng.normal(1, 0.002, (500, 1))
    scatter = np.linalg.inv(np.linalg.cholesky(np.cov(places_m.T)))
    said = [point.covariance_m2 for point in found if point.covariance_m2 is not None]
    assert len(said) == len(found)
    ratios = np.linalg.eigvalsh(scatter @ np.mean(said, axis=0) @ scatter.T)
    assert 0.8 < ratios.min() < ratios.max() < 1.25


def test_pose_covariance_holds_on_a_real_board(data: Path) -> None:
    """Compare each marker of a hand-held board with its place on the board, whose pose has other corners."""
    folder, scores = data / "charuco_videos", []
    lens = read_lens(folder, "2")
    for markers, centres_m in read_markers(folder, "2", every=3):
        found, _ = points("pose", *markers, lens=lens, rig=BOARD_RIG)
        for point in found:
            off_m = np.subtract(where(point), centres_m[point.id])
            assert point.covariance_m2 is not None
            scores.append(off_m @ np.linalg.solve(point.covariance_m2, off_m) / 3)
    assert len(scores) > 100
    assert 0.5 < np.mean(scores) < 3


def tilt_events(method: str, tilts_deg: list[float], seed: int = 0) -> list[Event]:
    """Return the events of a level marker 3, and of a turning marker 4 with these tilts."""
    rng, stage, events = np.random.default_rng(seed), CameraFrame(method), []
    for payload, camera in ((RIG, None), (FISHEYE, "red")):
        assert list(stage(Message("t", 0, 0, payload, camera))) == []
    for number, tilt_deg in enumerate(tilts_deg):
        time_ns = number * 100_000_000
        axes = {3: turned(0.4), 4: turned(0.1 * number, tilt_deg, 1.0 + 0.1 * number)}
        centres_m = {3: (-0.5, 0.3, 2.1), 4: (0.8, 0.1 + 0.0002 * number, 2.1)}
        seen = [
            Marker(
                n,
                corners_px(FISHEYE, axes[n], np.array(centres_m[n]), RIG.length_of(n))
                + rng.normal(0, SIGMA_PX, (4, 2)),
                SIGMA_PX**2 * np.eye(8),
            )
            for n in axes
        ]
        payloads = stage(Message("t", time_ns, time_ns, Markers(time_ns, tuple(seen), 1920, 1080), "red"))
        events += [payload for payload in payloads if isinstance(payload, Event)]
    return events


@pytest.mark.parametrize("tilt_deg", [12.0, 30.0])
def test_tilted_marker_is_named_once_with_the_other_method(tilt_deg: float) -> None:
    (event,) = tilt_events("perimeter", [tilt_deg] * 60)
    assert (event.kind, event.camera, event.marker_id) == ("tilted_marker", "red", 4)
    assert re.search(r"camera red: marker 4 is tilted by \d+ degrees", event.text)
    assert "--method pose" in event.text
    assert tilt_events("pose", [tilt_deg] * 60) == []


@pytest.mark.parametrize("seed", range(8))
def test_tops_of_2_degrees_are_not_named(seed: int) -> None:
    assert tilt_events("perimeter", [2.0] * 200, seed) == []


def test_tilt_that_begins_later_is_named_then() -> None:
    (event,) = tilt_events("perimeter", [0.0] * 60 + [20.0] * 80)
    assert event.timestamp >= 60 * 100_000_000


def test_tilted_real_board_is_named(data: Path) -> None:
    folder, stage, events = data / "charuco_videos", CameraFrame(), []
    lens = read_lens(folder, "1")
    for payload, camera in ((BOARD_RIG, None), (lens, "red")):
        assert list(stage(Message("t", 0, 0, payload, camera))) == []
    for number, (markers, _) in enumerate(read_markers(folder, "1", every=6)):
        time_ns = number * 300_000_000
        payloads = stage(Message("t", time_ns, time_ns, Markers(time_ns, markers, 1280, 720), "red"))
        events += [payload.text for payload in payloads if isinstance(payload, Event)]
    assert len(events) == 1
    assert "use --method pose" in events[0]


@pytest.mark.parametrize("method", METHODS)
def test_missing_input_covariance_gives_no_covariance(method: str) -> None:
    found, _ = points(method, marker(3), marker(5, CENTRE, covariance_px2=SIGMA_PX**2 * np.eye(8)))
    assert [point.covariance_m2 is None for point in found] == [True, False]


@pytest.mark.parametrize("method", METHODS)
def test_a_marker_does_not_depend_on_those_beside_it(method: str) -> None:
    seen = [marker(3), marker(4, CENTRE), marker(5, EDGE)]
    together, _ = points(method, *seen)
    for alone, point in zip(seen, together, strict=True):
        np.testing.assert_allclose(where(points(method, alone)[0][0]), where(point), atol=1e-8)


def test_the_perimeter_is_to_the_last_digit_that_of_each_marker() -> None:
    """Logs of earlier releases have separately computed points."""
    rng = np.random.default_rng(1)
    for lens in LENSES.values():
        places_m = rng.uniform((-0.9, -0.6, 1.9), (0.9, 0.6, 2.1), (6, 3))
        seen = [marker(3, tuple(place_m), turned(rng.uniform(-3, 3), 4.0), lens) for place_m in places_m]
        found, _ = points("perimeter", *seen, lens=lens)
        for one, point in zip(seen, found, strict=True):
            uv = undistort(one.corners_px, lens)
            assert where(point) == tuple(camera_point(uv, 0.2).tolist())
            assert point.heading_rad == heading(uv)


@pytest.mark.parametrize("method", METHODS)
def test_a_marker_without_a_ray_is_an_event(method: str) -> None:
    beyond = Marker(9, np.array([[-9e4, 0.0], [0, 0], [9, 9], [0, 9]]))
    found, events = points(method, marker(3), beyond)
    assert [point.id for point in found] == [3]
    assert [(event.kind, event.marker_id, event.camera, event.timestamp) for event in events] == [
        ("outside_lens", 9, "red", 7)
    ]


@pytest.mark.parametrize("method", METHODS)
def test_corners_of_no_square_are_an_event(method: str) -> None:
    found, events = points(method, marker(3), Marker(9, np.full((4, 2), 500.0)))
    assert [point.id for point in found] == [3]
    assert [(event.kind, event.marker_id) for event in events] == [("no_square", 9)]


@pytest.mark.parametrize("method", METHODS)
def test_invalid_corner_covariance_is_reported(method: str) -> None:
    with pytest.raises(IpsysError, match="marker 3 of camera red: covariance_px2"):
        points(method, marker(3, covariance_px2=np.full((8, 8), np.nan)))


def test_an_unknown_method_is_refused_before_anything_is_made(ipsys: Ipsys, tmp_path: Path) -> None:
    for make in (CameraFrame, lambda method: Request(method=method)):
        with pytest.raises(IpsysError, match=r"ippe.{1,2}is not known; use one of perimeter, pose"):
            make("ippe")
    log = shutil.copy(ROOT / "sample_logs" / "paper_lab.mcap", tmp_path)
    done = ipsys("replay", log, "--method", "ippe")
    assert (done.code, done.err.count("\n")) == (1, 1)
    assert "use one of perimeter, pose" in done.err


def test_another_method_is_another_run(ipsys: Ipsys, tmp_path: Path) -> None:
    log = Path(shutil.copy(ROOT / "sample_logs" / "paper_lab.mcap", tmp_path))

    def run(*arguments: object) -> tuple[str, bool]:
        done = ipsys("camera-frame", log, *arguments, "--json")
        assert done.code == 0, done.err
        stage = json.loads(done.out)["stages"][-1]
        return stage["run"], stage["new"]

    assert run() == ("edges", True)
    assert run("--method", "pose") == ("edges_pose", True)
    assert run("--method", "pose") == ("edges_pose", False)
    assert run("--method", "perimeter") == ("edges", False)
    with Session([log]) as session:
        parameters = {r.run: r.parameters for r in session.runs() if r.stage == "camera-frame"}
        assert parameters == {"edges": {"perimeter": "2"}, "edges_pose": {"method": "pose", "pose": "2"}}
        by_pose = session.payloads(session.topics(CAMERA_POINTS, "edges_pose"))
        assert all(len(point.poses) == 2 for frame in by_pose for point in frame.points)


def test_a_method_needs_markers(ipsys: Ipsys, tmp_path: Path) -> None:
    log, less = Path(shutil.copy(ROOT / "sample_logs" / "paper_lab.mcap", tmp_path)), tmp_path / "less.mcap"
    assert ipsys("camera-frame", log).code == 0
    with Session([log]) as session:
        topics = [t for reader in session.readers for t in reader.channels if not t.endswith("/markers")]
        write_log(less, session.messages(topics))
    done = ipsys("replay", less, "--method", "pose")
    assert done.code == 1
    assert "--method pose: has no effect, because the log has no markers" in done.err
