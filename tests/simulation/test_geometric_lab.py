"""A session without images agrees with OpenCV's projection of the ground truth."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.capture.simulation.cameras import Camera
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Marker, Markers, Message, Rig, Tracks
from ipsys_log.messages.channels import MODEL
from ipsys_log.units import NS_PER_S
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import simulate_session

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
