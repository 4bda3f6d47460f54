"""Bags of ROS 1 and ROS 2 become logs with the same images, stamps and intrinsics."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.convert import convert
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.ros_bags import find_bag_cameras, read_bag
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, RawImage
from tests.conftest import Ipsys
from tests.exchange.pictured_lab import jpeg
from tests.test_foreign_logs import picture

NS = 1_700_000_000_123_456_789
STEP = 100_000_000
K = [500.5, 0, 320.25, 0, 510.125, 180, 0, 0, 1]
D = [0.01, -0.02, 0.003, 1 / 3]
Row = tuple[str, int, str, dict[str, Any]]
Write = Callable[[Path, Sequence[Row]], Path]


def compressed(number: int, data: bytes, topic: str = "/red/image_raw/compressed", stamp: bool = True) -> Row:
    values = {"format": "bgr8; jpeg compressed bgr8", "data": np.frombuffer(data, np.uint8)}
    return topic, (NS + number * STEP) * stamp, "sensor_msgs/msg/CompressedImage", values


def raw(number: int, pixels: Any, encoding: str, topic: str = "/white/image_raw") -> Row:
    height, width, *rest = pixels.shape
    size = {"height": height, "width": width, "step": width * (rest[0] if rest else 1)}
    values = {**size, "encoding": encoding, "is_bigendian": 0, "data": pixels.ravel()}
    return topic, NS + number * STEP, "sensor_msgs/msg/Image", values


def info(number: int, k: Sequence[float] = K, topic: str = "/red/camera_info") -> Row:
    values = {
        **{"height": 360, "width": 640, "distortion_model": "equidistant"},
        **{"d": np.array(D), "k": np.array(k, dtype=float), "r": np.eye(3).ravel()},
        **{"p": np.eye(3, 4).ravel(), "binning_x": 0, "binning_y": 0},
    }
    return topic, NS + number * STEP, "sensor_msgs/msg/CameraInfo", values


def make(store: Any, kind: str, stamp_ns: int, values: dict[str, Any], is_ros1: bool) -> Any:
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    head = types["std_msgs/msg/Header"](*([7] if is_ros1 else []), stamp, "optical")
    fields = dict(values)
    if kind.endswith("CameraInfo"):
        fields["roi"] = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        if is_ros1:
            fields |= {name.upper(): fields.pop(name) for name in "dkrp"}
    return types[kind](header=head, **fields)


def write_ros1(folder: Path, rows: Sequence[Row]) -> Path:
    store, path = get_typestore(Stores.ROS1_NOETIC), folder / "drive.bag"
    with Writer1(path) as writer:
        known: dict[str, Any] = {}
        for number, (topic, stamp_ns, kind, values) in enumerate(rows):
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_ros1(make(store, kind, stamp_ns, values, True), kind)
            writer.write(known[topic], NS + number * STEP + 20_000_000, data)
    return path


def write_ros2(folder: Path, rows: Sequence[Row], plugin: StoragePlugin) -> Path:
    store, path = get_typestore(Stores.ROS2_HUMBLE), folder / "drive"
    with Writer2(path, version=8, storage_plugin=plugin) as writer:
        known: dict[str, Any] = {}
        for number, (topic, stamp_ns, kind, values) in enumerate(rows):
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_cdr(make(store, kind, stamp_ns, values, False), kind)
            writer.write(known[topic], NS + number * STEP + 20_000_000, data)
    return path


WRITERS: dict[str, Write] = {
    "ros1": write_ros1,
    "sqlite3": lambda folder, rows: write_ros2(folder, rows, StoragePlugin.SQLITE3),
    "mcap": lambda folder, rows: write_ros2(folder, rows, StoragePlugin.MCAP),
}
GREY = np.arange(36 * 64, dtype=np.uint8).reshape(36, 64)
COLOURS = np.arange(36 * 64 * 3, dtype=np.uint8).reshape(36, 64, 3)


@pytest.mark.parametrize("kind", WRITERS)
def test_images_and_intrinsics_are_those_of_the_bag(kind: str, tmp_path: Path, ipsys: Ipsys) -> None:
    moved = [*K[:2], 321.0, *K[3:]]
    rows = [info(0), compressed(0, jpeg()), info(1), compressed(1, b"\xff\xd8 not decoded"), info(2, moved)]
    rows += [raw(5, GREY, "mono8"), raw(6, COLOURS, "bgr8"), raw(7, COLOURS, "rgb8")]
    bag = WRITERS[kind](tmp_path, rows)
    done = ipsys("import", "ros", bag, "-o", tmp_path / "log.mcap")
    assert done.code == 0, done.err
    assert "images: 2 of red, 3 of white" in " ".join(done.out.split())
    with Session([tmp_path / "log.mcap"]) as session:
        red, white = (list(session.messages([session.images[name]])) for name in ("red", "white"))
        lenses = session.payloads([session.calibrations["red"]])
    assert [message.payload.data for message in red] == [jpeg(), b"\xff\xd8 not decoded"]
    assert [message.publish_time_ns for message in red] == [NS, NS + STEP]
    # The bag has arrival times, 20 ms later; its second message is the first image.
    assert red[0].log_time_ns == NS + STEP + 20_000_000
    assert isinstance(red[0].payload, CompressedImage)
    assert (red[0].payload.format, red[0].payload.frame_id) == ("jpeg", "red")
    for message, pixels, encoding in zip(
        white, (GREY, COLOURS, COLOURS), ("mono8", "bgr8", "rgb8"), strict=True
    ):
        assert isinstance(message.payload, RawImage)
        assert (message.payload.encoding, message.payload.data) == (encoding, pixels.tobytes())
    assert [lens.K.ravel().tolist() for lens in lenses] == [K, moved]
    assert (lenses[0].D.tolist(), lenses[0].distortion_model) == (D, "kannala_brandt")
    assert (lenses[0].width, lenses[0].height) == (640, 360)


def test_exported_bag_comes_back_as_the_same_log(replayed_log: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    """The bag passes through the copy of another program, which gives it a folder."""
    done = ipsys("export", replayed_log, "-o", tmp_path / "bag.mcap")
    assert done.code == 0, done.err
    convert(
        [tmp_path / "bag.mcap"],
        tmp_path / "copy",
        dst_storage="sqlite3",
        dst_version=8,
        compress=None,
        compress_mode="file",
        default_typestore=None,
        typestore=get_typestore(Stores.ROS2_JAZZY),
        exclude_topics=[],
        include_topics=[],
        exclude_msgtypes=[],
        include_msgtypes=[],
    )
    assert ipsys("import", "ros", tmp_path / "copy", "-o", tmp_path / "log.mcap").code == 0
    with Session([replayed_log]) as known, Session([tmp_path / "log.mcap"]) as found:
        for camera, topic in known.images.items():
            pairs = zip(known.messages([topic]), found.messages([found.images[camera]]), strict=True)
            for one, other in pairs:
                assert one.payload.data == other.payload.data
                assert one.publish_time_ns == other.publish_time_ns
                # The intrinsics of an image have a log time of their own.
                assert 0 <= other.log_time_ns - one.log_time_ns < 10
            lens, back = (s.payloads([s.calibrations[camera]]) for s in (known, found))
            assert len(back) == 1
            assert (lens[0].K.tolist(), lens[0].D.tolist()) == (back[0].K.tolist(), back[0].D.tolist())


def test_imported_bag_is_detected(tmp_path: Path, ipsys: Ipsys) -> None:
    data = cv2.imencode(".png", picture(6))[1].tobytes()
    bag = write_ros1(tmp_path, [compressed(0, data), raw(1, picture(9), "mono8")])
    (tmp_path / "lab.toml").write_text('name = "lab"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n')
    log = tmp_path / "log.mcap"
    assert ipsys("import", "ros", bag, "-o", log, "--rig", tmp_path / "lab.toml").code == 0
    assert ipsys("detect", log, "--corners", "stock").code == 0
    with Session([log]) as session:
        found = {
            c: session.payloads([f"/runs/stock/cameras/{c}/markers"])[0].markers for c in ("red", "white")
        }
    assert {camera: [marker.id for marker in markers] for camera, markers in found.items()} == {
        "red": [6],
        "white": [9],
    }


def test_cameras_are_chosen_and_named(tmp_path: Path, ipsys: Ipsys) -> None:
    rows = [compressed(0, jpeg(), "/a/image_raw/compressed"), raw(1, GREY, "mono8", "/a/image_raw")]
    rows += [info(2, topic="/a/camera_info"), raw(3, GREY, "16UC1", "/b/depth/image_raw")]
    rows += [compressed(4, b"depth", "/b/depth/image_raw/compressedDepth")]
    bag = write_ros1(tmp_path, rows)
    log = tmp_path / "log.mcap"
    # Without names, the compressed images of a camera precede its raw ones.
    done = ipsys("import", "ros", bag, "-o", log)
    assert (done.code, "'16UC1' is not read" in done.err) == (1, True), done.err
    done = ipsys("import", "ros", bag, "-o", log, "--camera", "left=/a/image_raw")
    assert done.code == 0, done.err
    with Session([log]) as session:
        assert session.images == {"left": "/cameras/left/image"}
        assert session.calibrations == {"left": "/cameras/left/calibration"}
        assert [type(image) for image in session.payloads(["/cameras/left/image"])] == [RawImage]


def test_images_without_stamps_have_the_time_of_the_bag(tmp_path: Path, ipsys: Ipsys) -> None:
    bag = write_ros1(tmp_path, [compressed(0, jpeg(), stamp=False), compressed(1, jpeg(), stamp=False)])
    assert ipsys("import", "ros", bag, "-o", tmp_path / "log.mcap").code == 0
    with Session([tmp_path / "log.mcap"]) as session:
        messages = list(session.messages(session.images.values()))
    arrivals = [NS + 20_000_000, NS + STEP + 20_000_000]
    assert [m.publish_time_ns for m in messages] == [m.payload.timestamp for m in messages] == arrivals


def test_uncalibrated_camera_has_no_intrinsics(tmp_path: Path, ipsys: Ipsys) -> None:
    bag = write_ros1(tmp_path, [info(0, [0.0] * 9), compressed(1, jpeg())])
    assert ipsys("import", "ros", bag, "-o", tmp_path / "log.mcap").code == 0
    with Session([tmp_path / "log.mcap"]) as session:
        assert session.calibrations == {}


def test_bad_bags_are_refused_in_one_line(tmp_path: Path, ipsys: Ipsys) -> None:
    good = write_ros1(tmp_path, [compressed(0, jpeg()), raw(1, GREY, "mono8")])
    data = good.read_bytes()
    (tmp_path / "cut.bag").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.bag").write_text("no bag")
    (tmp_path / "text.db3").write_text("no bag")
    (tmp_path / "folder").mkdir()
    (tmp_path / "yaml").mkdir()
    (tmp_path / "yaml" / "metadata.yaml").write_text("rosbag2_bagfile_information: 5")
    theora = tmp_path / "theora"
    theora.mkdir()
    other = write_ros1(theora, [compressed(0, b"OggS")])
    for bag, options, text in (
        (tmp_path / "gone.bag", (), "does not exist; give a bag of ROS 1"),
        (tmp_path / "cut.bag", (), "is no bag that can be read"),
        (tmp_path / "text.bag", (), "is no bag that can be read"),
        (tmp_path / "text.db3", (), "is no bag that can be read"),
        (tmp_path / "folder", (), "has no metadata.yaml"),
        (tmp_path / "yaml", (), "is no bag that can be read"),
        (other, (), "is not read (only JPEG, PNG and WebP)"),
        (good, ("--camera", "red"), "red: has no camera name; write --camera red=/red/image_raw"),
        (good, ("--camera", "red=/gone"), "topic /gone of camera red has no images (topics: /red/"),
    ):
        done = ipsys("import", "ros", bag, "-o", tmp_path / "log.mcap", *options)
        assert done.code == 1, bag
        assert text in done.err
        assert done.err.count("\n") == 1
        assert not (tmp_path / "log.mcap").exists()


def test_log_is_refused(lab: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    done = ipsys("import", "ros", shutil.copy(lab, tmp_path / "bag.mcap"), "-o", tmp_path / "log.mcap")
    assert (done.code, "is already a log and needs no import" in done.err) == (1, True)


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
def test_damaged_bag_is_read_or_refused(kind: str, tmp_path: Path) -> None:
    bag = WRITERS[kind](tmp_path, [info(0), compressed(0, jpeg()), raw(1, GREY, "mono8")])
    file = bag if bag.is_file() else next(bag.glob("*.db3"))
    data, rng = file.read_bytes(), np.random.default_rng(1)
    refused = []
    for _ in range(25):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), 3):
            damaged[at] = rng.integers(0, 256)
        file.write_bytes(damaged)
        try:
            list(read_bag(bag, find_bag_cameras(bag, {})))
        except IpsysError as error:
            refused.append(str(error))
    assert len(refused) > 5
    assert not [text for text in refused if "\n" in text]
