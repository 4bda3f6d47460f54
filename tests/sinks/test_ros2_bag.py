"""A ROS 2 bag has the images, intrinsics, poses and covariances of the log, as other libraries read them."""

import tracemalloc
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

import ipsys_log as ipsys
from ipsys_log import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.ros2 import read_ros2
from ipsys_log.messages import CameraCalibration, CompressedImage, CompressedVideo, RawImage, Track
from ipsys_log.messages.channels import MARKERS, TRACKS
from ipsys_log.sinks.streams.ros2_messages import CAMERA_INFO, encode_camera_info, text_of
from tests.conftest import Ipsys
from tests.exchange.pictured_lab import RUN, START_NS, STEP_NS, PicturedLab, image, track

UNKNOWN = 1e6


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def read(bag: Path) -> dict[str, list[Any]]:
    """Return the messages of a bag by topic, with rosbags."""
    messages: dict[str, list[Any]] = defaultdict(list)
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            messages[connection.topic].append(reader.deserialize(data, connection.msgtype))
    return messages


def export(log: Path, bag: Path, **options: Any) -> dict[str, list[Any]]:
    with ipsys.open(log) as opened:
        opened.export(bag, format="ros2", **options)
    return read(bag)


@pytest.fixture(scope="module")
def bag(replayed_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "lab.mcap"
    with ipsys.open(replayed_log) as opened:
        opened.export(path)
    return path


def test_images_and_intrinsics_are_those_of_the_log(bag: Path, replayed_log: Path) -> None:
    messages = read(bag)
    with Session([replayed_log]) as session:
        stored = {camera: session.payloads([topic]) for camera, topic in session.images.items()}
        lenses = {camera: session.payloads([topic])[-1] for camera, topic in session.calibrations.items()}
    assert set(stored) == {"red", "white", "black"}
    for camera, images in stored.items():
        found, infos = messages[f"/{camera}/image_raw/compressed"], messages[f"/{camera}/camera_info"]
        assert [(m.data.tobytes(), stamp_ns(m)) for m in found] == [(i.data, i.timestamp) for i in images]
        assert [stamp_ns(info) for info in infos] == [i.timestamp for i in images]
        assert {m.header.frame_id for m in (*found, *infos)} == {f"{camera}_optical_frame"}
        assert {m.format for m in found} == {"jpeg"}
        for info in infos:
            known = lenses[camera]
            assert (info.width, info.height, info.distortion_model) == (960, 540, "equidistant")
            assert (info.d.tolist(), info.k.tolist()) == (known.D.tolist(), known.K.ravel().tolist())
            assert np.array_equal(info.p.reshape(3, 4)[:, :3], known.K)


def stored_tracks(log: Path) -> dict[tuple[str, int], Track]:
    """Return the tracks of a log by robot and time."""
    with Session([log]) as session:
        return {
            (track.robot, message.payload.timestamp): track
            for message in session.messages(session.topics(TRACKS, "poly"))
            for track in message.payload.tracks
        }


def test_poses_have_the_stored_digits(bag: Path, replayed_log: Path) -> None:
    messages = read(bag)
    tracks = stored_tracks(replayed_log)
    poses = [(topic[1:-5], m) for topic, rows in messages.items() if topic.endswith("/pose") for m in rows]
    assert len(poses) > 100
    for robot, message in poses:
        known = tracks[robot, stamp_ns(message)]
        at, turn = message.pose.pose.position, message.pose.pose.orientation
        assert (at.x, at.y, at.z) == (known.x_m, known.y_m, known.z_m)
        assert message.header.frame_id == "map"
        heading = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_euler("zyx")[0]
        assert heading == pytest.approx(known.heading_rad, abs=1e-12)
        covariance = message.pose.covariance.reshape(6, 6)
        assert known.covariance_m2 is not None
        assert np.array_equal(covariance[:3, :3], known.covariance_m2)
        expected = UNKNOWN if known.heading_sigma_rad is None else known.heading_sigma_rad**2
        assert covariance[5, 5] == expected
    transforms = {
        (row.child_frame_id, stamp_ns(row)): row.transform.translation
        for message in messages["/tf"]
        for row in message.transforms
    }
    assert {(robot, stamp_ns(m)): m.pose.pose.position.x for robot, m in poses} == {
        key: where.x for key, where in transforms.items()
    }


def test_odometry_is_along_the_axes_of_the_robot(bag: Path, replayed_log: Path) -> None:
    tracks = stored_tracks(replayed_log)
    rows = [(topic[1:-5], m) for topic, found in read(bag).items() if topic.endswith("/odom") for m in found]
    assert len(rows) > 100
    for robot, message in rows:
        known = tracks[robot, stamp_ns(message)]
        turn, twist = message.pose.pose.orientation, message.twist.twist
        map_from_robot = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        along = np.array([twist.linear.x, twist.linear.y, twist.linear.z])
        assert message.child_frame_id == robot
        assert map_from_robot @ along == pytest.approx(known.velocity_m_s, abs=1e-12)
        covariance = message.twist.covariance.reshape(6, 6)[:3, :3]
        in_map = map_from_robot @ covariance @ map_from_robot.T
        assert in_map == pytest.approx(known.velocity_covariance_m2_s2, abs=1e-12)
        assert twist.angular.z == known.turn_rate_rad_s


def test_bag_alone_leads_from_a_robot_to_its_pixel(bag: Path, replayed_log: Path) -> None:
    """The camera poses, the intrinsics and the poses of the robots agree with the detected markers."""
    messages = read(bag)
    (static,) = messages["/tf_static"]
    cameras = {
        row.child_frame_id.removesuffix("_optical_frame"): row
        for row in static.transforms
        if row.child_frame_id.endswith("_optical_frame")
    }
    assert {row.header.frame_id for row in cameras.values()} == {"map"}
    positions = {(topic[1:-5], stamp_ns(m)): m.pose.pose.position
                 for topic, rows in messages.items() if topic.endswith("/pose") for m in rows}  # fmt: skip
    offsets_px = []
    with Session([replayed_log]) as session:
        run = next(run for run in sorted(session.run_names()) if session.topics(MARKERS, run))
        for message in session.messages(session.topics(MARKERS, run)):
            info, row = messages[f"/{message.camera}/camera_info"][0], cameras[str(message.camera)]
            shift, turn = row.transform.translation, row.transform.rotation
            rotation = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
            for marker in message.payload.markers:
                at = positions.get((f"robot_{marker.id}", message.payload.timestamp))
                if at is not None:
                    seen = rotation.inv().apply([at.x - shift.x, at.y - shift.y, at.z - shift.z])
                    pixel = cv2.fisheye.projectPoints(
                        seen.reshape(1, 1, 3), np.zeros(3), np.zeros(3), info.k.reshape(3, 3), info.d
                    )[0]
                    offsets_px.append(np.linalg.norm(pixel.ravel() - marker.corners_px.mean(axis=0)))
    assert len(offsets_px) > 100
    # 1 px is about 5 mm on the floor; the lab has a tape with errors of 3 mm.
    assert np.median(offsets_px) < 5


def test_other_library_reads_the_same(bag: Path) -> None:
    expected = read(bag)
    found: dict[str, list[Any]] = defaultdict(list)
    with bag.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for _, channel, _, message in reader.iter_decoded_messages():
            found[channel.topic].append(message)
    assert {topic: len(rows) for topic, rows in found.items()} == {t: len(r) for t, r in expected.items()}
    for topic in ("/robot_0/pose", "/robot_0/odom"):
        for one, other in zip(found[topic], expected[topic], strict=True):
            assert list(one.pose.covariance) == other.pose.covariance.tolist()
            assert one.pose.pose.position.x == other.pose.pose.position.x


def test_static_transforms_reach_late_subscribers(bag: Path) -> None:
    with AnyReader([bag]) as reader:
        profiles = {c.topic: getattr(c.ext, "offered_qos_profiles", []) for c in reader.connections}
    (profile,) = profiles.pop("/tf_static")
    assert (profile.durability.name, profile.reliability.name) == ("TRANSIENT_LOCAL", "RELIABLE")
    assert not any(profiles.values())


FINITE = st.floats(-1e6, 1e6)
MODELS = st.sampled_from([("kannala_brandt", 4), ("plumb_bob", 5), ("rational_polynomial", 8)])


@given(data=st.data(), model=MODELS, time_ns=st.integers(0, 2**31 * 10**9 - 1))
def test_any_intrinsics_come_back_exactly(data: st.DataObject, model: tuple[str, int], time_ns: int) -> None:
    name, count = model
    K, D = (data.draw(arrays(np.float64, shape, elements=FINITE)) for shape in ((3, 3), (count,)))
    known = CameraCalibration(time_ns, "red", 640, 480, name, D, K)
    encoded = encode_camera_info("red", known, time_ns)
    found = read_ros2(CAMERA_INFO, encoded, text_of(CAMERA_INFO).encode())
    assert (found.timestamp, found.width, found.height) == (time_ns, 640, 480)
    assert (found.distortion_model, found.D.tolist(), found.K.tolist()) == (name, D.tolist(), K.tolist())


def test_poses_that_a_robot_must_not_use_are_left_out(tmp_path: Path) -> None:
    good = track(1.0, 1.0, heading_rad=0.5)
    rows = {
        0: (good,),
        1: (replace(good, inside=False),),
        2: (replace(good, heading_rad=None),),
        3: (replace(good, coasting_ns=600_000_000),),
        4: (replace(good, coasting_ns=100_000_000), track(2.0, 2.0, "bob", 0.0)),
    }
    log = PicturedLab({}, rows).write(tmp_path / "lab.mcap")
    messages = export(log, tmp_path / "bag.mcap", run=RUN)
    assert [(stamp_ns(m) - START_NS) // STEP_NS for m in messages["/ada/pose"]] == [0, 4]
    assert len(messages["/bob/pose"]) == 1
    assert len(messages["/red/camera_info"]) == 1
    (static,) = messages["/tf_static"]
    ((floor,), height_m) = static.transforms, static.transforms[0].transform.translation.z
    assert (floor.child_frame_id, floor.header.frame_id, height_m) == ("ada/floor", "ada", -0.1)
    with ipsys.open(log) as opened:
        exported = opened.export(tmp_path / "one.mcap", run=RUN, robot="bob")
    assert "poses: 1" in exported.content
    assert "/ada/pose" not in read(tmp_path / "one.mcap")


def test_raw_images_stay_raw(tmp_path: Path) -> None:
    pixels = np.arange(320 * 180 * 3, dtype=np.uint8)
    raw = RawImage(START_NS, "red", 320, 180, "rgb8", 960, pixels.tobytes())
    log = PicturedLab({0: raw}, {0: (track(1.0, 1.0),)}).write(tmp_path / "lab.mcap")
    (message,) = export(log, tmp_path / "bag.mcap", run=RUN)["/red/image_raw"]
    assert (message.height, message.width, message.step, message.encoding) == (180, 320, 960, "rgb8")
    assert np.array_equal(message.data, pixels)


def test_bag_without_images_has_the_rest(replayed_log: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    done = ipsys("export", replayed_log, "-o", tmp_path / "bag.mcap", "--without-images")
    assert done.code == 0, done.err
    messages = read(tmp_path / "bag.mcap")
    assert not [topic for topic in messages if "image" in topic]
    assert len(messages["/red/camera_info"]) == 1
    assert len(messages["/robot_0/pose"]) > 10
    assert f"{sum(map(len, messages.values()))} messages; images: 0" in done.out


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    megabyte = b"\xff\xd8" + bytes(1_000_000)

    def peak(count: int) -> int:
        images = {n: image(n, megabyte) for n in range(count)}
        log = PicturedLab(images, {0: (track(1.0, 1.0),)}).write(tmp_path / f"{count}.mcap")
        tracemalloc.start()
        with ipsys.open(log) as opened:
            opened.export(tmp_path / f"bag{count}.mcap", run=RUN)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    assert peak(40) < peak(10) + 5_000_000


def test_bad_requests_are_refused_in_one_line(tmp_path: Path, lab: Path, ipsys: Ipsys) -> None:
    frame = CompressedVideo(START_NS, "red", b"\0\0\1\x65", "h264")
    rows = {0: (track(1.0, 1.0, heading_rad=0.0),)}
    video = PicturedLab({0: frame}, rows).write(tmp_path / "video.mcap")
    (tmp_path / "old.mcap").write_bytes(b"a log of yesterday")
    run = ("--run", RUN)
    for log, name, options, text in (
        (lab, "new.mcap", (), f"no run has tracks (it is in: none); compute them: ipsys replay {lab}"),
        (video, "new.mcap", run, "camera red: its images are h264 video"),
        (video, "old.mcap", run, "exists already; choose another name"),
        (video, "new.mcap", (*run, "--without-images", "--robot", "eva"), "has no robot 'eva' (it has: ada)"),
        (video, "new.mcap", (*run, "--run", "other"), "a ROS 2 bag has one run"),
        (video, "new.mcap", ("--format", "ros1"), "--format ros1: is not known; use one of csv"),
        (video, "video.mcap", run, "this is the log itself"),
    ):
        before = {path: path.read_bytes() for path in tmp_path.iterdir()}
        done = ipsys("export", log, "-o", tmp_path / name, *options)
        assert done.code == 1
        assert text in done.err
        assert done.err.count("\n") == 1
        assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_late_stamp_is_refused(tmp_path: Path) -> None:
    late = CompressedImage(2**31 * 10**9, "red", b"\xff\xd8", "jpeg")
    log = PicturedLab({0: late}, {0: (track(1.0, 1.0),)}).write(tmp_path / "lab.mcap")
    with ipsys.open(log) as opened, pytest.raises(IpsysError, match="ends in 2038"):
        opened.export(tmp_path / "bag.mcap", run=RUN)
