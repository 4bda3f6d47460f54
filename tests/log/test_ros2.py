"""Logs of ROS 2, written by another library."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from ipsys_log.errors import LogError
from ipsys_log.log.dataset import Session
from ipsys_log.log.ros2 import read_ros2
from ipsys_log.messages import CameraCalibration, CompressedImage, RawImage
from tests.conftest import Ipsys
from tests.test_foreign_logs import RIG, picture

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES: dict[str, Any] = STORE.types
NS = 1_700_000_000_123_456_789


def header(frame_id: str, time_ns: int) -> Any:
    stamp = TYPES["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
    return TYPES["std_msgs/msg/Header"](stamp, frame_id)


def compressed(data: bytes, time_ns: int, kind: str = "bgr8; jpeg compressed bgr8") -> Any:
    pixels = np.frombuffer(data, np.uint8)
    return TYPES["sensor_msgs/msg/CompressedImage"](header("red_optical", time_ns), kind, pixels)


def camera_info(model: str, d: list[float]) -> Any:
    k = np.array([500.0, 0, 320, 0, 510, 180, 0, 0, 1])
    p = np.array([500.0, 0, 320, 0, 0, 510, 180, 0, 0, 0, 1, 0])
    part = TYPES["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    made = TYPES["sensor_msgs/msg/CameraInfo"]
    return made(header("red_optical", NS), 360, 640, model, np.array(d), k, np.eye(3).ravel(), p, 0, 0, part)


def raw(grey: Any) -> Any:
    made = TYPES["sensor_msgs/msg/Image"]
    height, width = grey.shape
    return made(header("white_optical", NS), height, width, "mono8", 0, width, grey.ravel())


def write(folder: Path, messages: list[tuple[str, int, Any]]) -> Path:
    """Write a bag whose messages are recorded 20 ms after their stamps."""
    connections: dict[str, Any] = {}
    with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, time_ns, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            data = STORE.serialize_cdr(message, kind)
            writer.write(connections[topic], time_ns + 20_000_000, data)
    return folder / "bag" / "bag.mcap"


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    image = simplejpeg.encode_jpeg(picture(6)[..., None], colorspace="GRAY", colorsubsampling="Gray")
    messages = [("/red/camera_info", NS, camera_info("equidistant", [0.01, 0.02, 0.03, 0.04]))]
    messages += [
        ("/red/image_raw/compressed", NS + n * 10**8, compressed(image, NS + n * 10**8)) for n in (1, 2)
    ]
    return write(tmp_path, [*messages, ("/white/image_raw", NS + 3 * 10**8, raw(picture(9)))])


def test_pictures_and_lenses_are_read_as_they_are(bag: Path) -> None:
    with Session([bag]) as session:
        assert session.images == {"red": "/red/image_raw/compressed", "white": "/white/image_raw"}
        assert session.calibrations == {"red": "/red/camera_info"}
        messages = list(session.messages([*session.images.values(), *session.calibrations.values()]))
    lens, first, _, white = messages
    assert isinstance(lens.payload, CameraCalibration)
    assert (lens.payload.distortion_model, lens.payload.width, lens.payload.height) == (
        "kannala_brandt",
        640,
        360,
    )
    assert lens.payload.D.tolist() == [0.01, 0.02, 0.03, 0.04]
    assert lens.payload.K.tolist() == [[500, 0, 320], [0, 510, 180], [0, 0, 1]]
    assert isinstance(first.payload, CompressedImage)
    assert first.payload.format == "jpeg"
    # The publish time is the exposure, the log time the arrival.
    assert first.publish_time_ns == first.payload.timestamp == NS + 10**8
    assert first.log_time_ns == NS + 10**8 + 20_000_000
    assert isinstance(white.payload, RawImage)
    assert np.array_equal(np.frombuffer(white.payload.data, np.uint8).reshape(360, 640), picture(9))


def test_a_bag_is_detected_in_place(bag: Path, tmp_path: Path, ipsys: Ipsys) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    done = ipsys("detect", bag, "--rig", rig, "--corners", "stock")
    assert done.code == 0, done.err
    with Session([bag]) as session:
        seen = {c: session.payloads([f"/runs/stock/cameras/{c}/markers"]) for c in ("red", "white")}
    assert {c: [m.id for frame in frames for m in frame.markers] for c, frames in seen.items()} == {
        "red": [6, 6],
        "white": [9],
    }


def test_invalid_messages_are_reported(bag: Path) -> None:
    with bag.open("rb") as file:
        schema, _, message = next(iter(make_reader(file).iter_messages("/red/camera_info")))
    assert schema is not None
    for cut in (0, 3, 20, 100):
        with pytest.raises(LogError, match="not a valid sensor_msgs/msg/CameraInfo"):
            read_ros2(schema.name, message.data[:cut], schema.data)
    with pytest.raises(LogError, match=r"is not a \.msg file"):
        read_ros2(schema.name, message.data, b"module sensor_msgs {};")


def test_a_definition_in_another_form_is_named(tmp_path: Path) -> None:
    log = tmp_path / "odd.mcap"
    with log.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        odd = writer.register_schema("sensor_msgs/msg/CompressedImage", "ros2idl", b"module sensor_msgs {};")
        writer.add_message(writer.register_channel("/red/image", "cdr", odd), 1, b"....", 1)
        writer.finish()  # type: ignore[no-untyped-call]
    with Session([log]) as session, pytest.raises(LogError, match=r"/red/image at 1 ns: .* ros2 bag convert"):
        list(session.messages(["/red/image"]))
