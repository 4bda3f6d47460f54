"""The geometry of a marker is for the exposure time of its rows, in all derived messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipsys_log.calibration.joint.fit import fit_jointly
from ipsys_log.calibration.joint.from_messages import gather_observations
from ipsys_log.calibration.joint.payload import joint_payload
from ipsys_log.capture.simulation.calibration_points import plan_points
from ipsys_log.capture.simulation.cameras import mount_cameras
from ipsys_log.capture.simulation.lab import simulate, start_of_set_ns
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.engine.stream import run, wire
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.codec import encode
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    EVENTS_TOPIC,
    RIG_TOPIC,
    STAMP_UNRELIABLE,
    TRUTH_TOPIC,
    CameraPoint,
    CameraPoints,
    Event,
    FrameTransform,
    FrameTransforms,
    ImageAnnotations,
    Markers,
    Measurement,
    Message,
    Pair,
    Position,
    Positions,
    Quaternion,
    Rig,
    RigMarker,
    Track,
    Tracks,
    Vector3,
)
from ipsys_log.messages.channels import POSITIONS, TRACKS
from ipsys_log.models.locate_corners import LocateCorners
from ipsys_log.models.locate_points import LocatePoints
from ipsys_log.stages import fuse
from ipsys_log.statistics.camera_models import fit_model
from ipsys_log.statistics.ground_truth import gather_tracks, track_errors
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import geometric_rig, simulate_session

MS = 1_000_000
RIG = Message(RIG_TOPIC, 0, 0, Rig("lab", "DICT_4X4_100", 0.2, tuple(RigMarker(n) for n in range(9))))


def test_locate_hands_the_offset_on() -> None:
    seen_m = np.random.default_rng(0).uniform((-1, -1, 1.9), (1, 1, 2.1), (20, 3))
    pairs = [Pair(str(n), 0, point_m, point_m + 1.0, 1) for n, point_m in enumerate(seen_m)]
    points = CameraPoints(1, (CameraPoint(3, 0.1, 0.2, 2.0, None, 17), CameraPoint(4, 0.1, 0.2, 2.0)))
    (found,) = LocatePoints(fit_model("rigid", {"red": pairs}, 0))(Message("t", 1, 1, points, "red"))
    assert [position.time_offset_ns for position in found.positions] == [17, None]


def frame(time_ns: int, camera: str, *offsets_ns: int | None) -> Message:
    """Return the positions of markers 0, 1, ... of a camera, at x = 0, or at x = 1 mm for white."""
    x_m = 0.001 if camera == "white" else 0.0
    seen = tuple(Position(n, x_m, 0.0, 0.0, time_offset_ns=each) for n, each in enumerate(offsets_ns))
    topic = POSITIONS.topic_of("poly", camera)
    return Message(topic, time_ns + 40 * MS, time_ns, Positions(time_ns, seen), camera)


def fused(*frames: Message) -> list[Message]:
    stage = wire(fuse.STAGE, "poly", {POSITIONS: "poly"}, fuse.Fuse("poly"))
    return [m for m in run([RIG, *frames], [stage]) if isinstance(m.payload, Tracks | FrameTransforms)]


def test_a_pose_goes_out_with_its_own_instant() -> None:
    made = fused(frame(100, "red", 30, None, 20, 0, 30))
    assert [(m.publish_time_ns, m.topic) for m in made] == [
        (time_ns, f"/runs/poly/{topic}") for time_ns in (100, 120, 130) for topic in ("tracks", "poses")
    ]
    assert {m.log_time_ns for m in made} == {100 + 40 * MS}
    tracks = [m.payload for m in made if isinstance(m.payload, Tracks)]
    assert [(t.timestamp, [one.id for one in t.tracks]) for t in tracks] == [
        (100, [1, 3]),
        (120, [2]),
        (130, [0, 4]),
    ]
    poses = [m.payload for m in made if isinstance(m.payload, FrameTransforms)]
    assert [[(one.timestamp, one.child_frame_id) for one in pose.transforms] for pose in poses] == [
        [(t.timestamp, f"poly/{one.robot}") for one in t.tracks] for t in tracks
    ]


def test_zero_time_offsets_do_not_change_the_result() -> None:
    made = fused(frame(100, "red", None, None))
    still_m_s = np.zeros(3)
    tracks = tuple(
        Track(f"marker_{n}", n, 0.0, 0.0, 0.0, cameras=("red",), velocity_m_s=still_m_s, age_ns=0)
        for n in range(2)
    )
    still = Quaternion(0.0, 0.0, 0.0, 1.0)
    transforms = tuple(
        FrameTransform(100, "world", f"poly/marker_{n}", Vector3(0.0, 0.0, 0.0), still) for n in range(2)
    )
    assert [(m.publish_time_ns, encode(m.payload)) for m in made] == [
        (100, encode(Tracks(100, tracks))),
        (100, encode(FrameTransforms(transforms))),
    ]


def test_earlier_row_of_a_later_frame_gets_its_own_pose() -> None:
    # The frames have one time, but the marker is in rows 20 ms apart.
    made = fused(frame(0, "red", 25 * MS), frame(0, "white", 5 * MS), frame(30 * MS, "red", 25 * MS))
    tracks = [m.payload for m in made if isinstance(m.payload, Tracks)]
    assert [t.timestamp for t in tracks] == [25 * MS, 5 * MS, 55 * MS]
    assert [t.tracks[0].cameras for t in tracks] == [("red",), ("white",), ("red", "white")]


# A frame takes 33 ms, in which a robot at 2 m/s moves by 6.6 cm. The tape is exact.
ROLLING = LabSettings(
    width=960,
    height=540,
    row_time_ns=61_000,
    markers=4,
    stations=12,
    frames_per_station=2,
    drive_s=1.2,
    drive_speed_m_s=2.0,
    tape_sigma_m=0.0,
    ruler_sigma_m=0.0,
)


@pytest.fixture(scope="module")
def rolling(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rolling") / "lab.mcap"
    write_log(path, simulate(ROLLING))
    return path


def drive_error_m(log: Path, rig: Rig | None) -> float:
    """Return the mean track error on the drive, with a model that reads no depths."""
    fused = replay([log], Request(models=("rayplane",), rig=rig))[-1]
    start_ns = start_of_set_ns(ROLLING, len(plan_points(ROLLING, mount_cameras(ROLLING))))
    with Session([log]) as session:
        made = list(session.messages(session.topics(TRACKS, fused.run)))
        tracks = gather_tracks(m for m in made if m.publish_time_ns >= start_ns)
        found = track_errors(tracks, gather_tracks(session.messages([TRUTH_TOPIC])))
    assert found is not None
    assert found[0].count > 50
    return found[0].mean_m


# Two replays of a rendered drive.
@pytest.mark.slow
def test_row_time_of_the_rig_corrects_a_moving_robot(rolling: Path) -> None:
    with Session([rolling]) as session:
        (rig,) = session.payloads([RIG_TOPIC])
    said_m = drive_error_m(rolling, None)
    unsaid_m = drive_error_m(rolling, replace(rig, cameras=()))
    assert said_m < 0.0008
    assert unsaid_m > 10 * said_m


def times_in(payload: Any) -> set[int]:
    if isinstance(payload, FrameTransforms):
        return {one.timestamp for one in payload.transforms}
    if isinstance(payload, ImageAnnotations):
        return {one.timestamp for one in payload.points} | {one.timestamp for one in payload.texts}
    return {payload.timestamp} if hasattr(payload, "timestamp") else set()


@pytest.mark.slow
def test_messages_have_the_times_of_their_payloads(rolling: Path) -> None:
    replay([rolling], Request(models=("rayplane",)))
    with Session([rolling]) as session:
        topics = [topic for reader in session.readers for topic in reader.channels]
        for message in session.messages(topics):
            assert times_in(message.payload) <= {message.publish_time_ns}, message.topic


def test_positions_have_the_time_of_the_reference_camera() -> None:
    own = LabSettings(seed=3, rate_hz=10.0, drive_s=40.0, markers=2)
    lab = build_lab(GeometricSettings(lab=own, points=16, clock_offset_s=0.02))
    messages = list(simulate_session(lab))
    measurements = [m.payload for m in messages if isinstance(m.payload, Measurement)]
    seen = [message for message in messages if isinstance(message.payload, Markers)]
    markers = {
        camera.name: [message.payload for message in seen if message.camera == camera.name]
        for camera in lab.cameras
    }
    fit = fit_jointly(gather_observations(geometric_rig(lab), lab.calibrations, markers, measurements))
    locate = LocateCorners(joint_payload(fit, {}, 0))
    list(locate(next(message for message in messages if message.topic == "/rig")))
    offsets_ns: dict[str, int] = {}
    for message in seen:
        for payload in (one for one in locate(message) if isinstance(one, Positions)):
            offsets_ns |= {str(message.camera): p.time_offset_ns or 0 for p in payload.positions}
    late_ns = lab.clock_offsets_ns
    reference = min(offsets_ns, key=lambda camera: abs(offsets_ns[camera]))
    assert max(late_ns.values()) - min(late_ns.values()) > 10_000_000
    for camera, offset_ns in offsets_ns.items():
        assert abs(offset_ns - (late_ns[reference] - late_ns[camera])) < 500_000


def place(time_ns: int, camera: str = "red") -> Message:
    positions = Positions(time_ns, (Position(1, 1.0, 2.0, 0.0),))
    return Message(f"/runs/poly/cameras/{camera}/positions", time_ns, time_ns, positions, camera)


def late(time_ns: int, start_ns: int, end_ns: int | None = None, kind: str = STAMP_UNRELIABLE) -> Message:
    event = Event(time_ns, kind, "", "red", None, start_ns, end_ns)
    return Message(EVENTS_TOPIC, time_ns, time_ns, event)


def times_of_tracks(messages: Sequence[Message]) -> list[int]:
    rig = Message(RIG_TOPIC, 0, 0, Rig("lab", "DICT_4X4_100", 0.2))
    made = run([rig, *messages], [wire(fuse.STAGE, "poly", {POSITIONS: "poly"}, fuse.Fuse("poly"))])
    return [message.payload.timestamp for message in made if isinstance(message.payload, Tracks)]


def test_late_frames_have_no_tracks() -> None:
    messages = [place(10), late(50, 20), place(60), place(80), late(90, 20, 80), place(100)]
    assert times_of_tracks(messages) == [10, 100]


def test_late_frames_without_an_end_have_no_tracks_to_the_end() -> None:
    assert times_of_tracks([place(10), late(50, 20), place(60), place(10**12)]) == [10]


def test_other_cameras_and_other_events_change_nothing() -> None:
    messages = [late(5, 0, kind="camera_lost"), place(10), late(50, 20), place(60), place(61, "white")]
    assert times_of_tracks(messages) == [10, 61]


def test_late_frame_is_not_averaged_into_another_camera() -> None:
    far = Positions(61, (Position(1, 9.0, 9.0, 0.0),))
    other = Message("/runs/poly/cameras/white/positions", 61, 61, far, "white")
    rig = Message(RIG_TOPIC, 0, 0, Rig("lab", "DICT_4X4_100", 0.2))
    stage = wire(fuse.STAGE, "poly", {POSITIONS: "poly"}, fuse.Fuse("poly"))
    made = run([rig, late(50, 20), place(60), other], [stage])
    (tracks,) = (message.payload for message in made if isinstance(message.payload, Tracks))
    assert (tracks.tracks[0].x_m, tracks.tracks[0].cameras) == (9.0, ("white",))
