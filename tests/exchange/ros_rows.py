"""Bags of ROS 1 and ROS 2, written by rosbags from rows of topic, stamp, type and fields."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

NS = 1_700_000_000_123_456_789
STEP = 100_000_000
K = [500.5, 0, 320.25, 0, 510.125, 180, 0, 0, 1]
D = [0.01, -0.02, 0.003, 1 / 3]
Row = tuple[str, int, str, dict[str, Any]]
Write = Callable[[Path, Sequence[Row]], Path]
# Definitions of types that rosbags does not know, by name.
Definitions = Mapping[str, str]


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
    fields = {name: value(types) if callable(value) else value for name, value in values.items()}
    frame_id = fields.pop("frame_id", "optical")
    head = types["std_msgs/msg/Header"](*([7] if is_ros1 else []), stamp, frame_id)
    if kind.endswith("CameraInfo"):
        fields["roi"] = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        if is_ros1:
            fields |= {name.upper(): fields.pop(name) for name in "dkrp"}
    return types[kind](header=head, **fields)


def open_store(version: Stores, definitions: Definitions) -> Any:
    store = get_typestore(version)
    for name, text in definitions.items():
        store.register(get_types_from_msg(text, name))
    return store


def write_ros1(
    folder: Path, rows: Sequence[Row], start_ns: int = NS + 20_000_000, definitions: Definitions | None = None
) -> Path:
    store, path = open_store(Stores.ROS1_NOETIC, definitions or {}), folder / "drive.bag"
    with Writer1(path) as writer:
        known: dict[str, Any] = {}
        for number, (topic, stamp_ns, kind, values) in enumerate(rows):
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_ros1(make(store, kind, stamp_ns, values, True), kind)
            writer.write(known[topic], start_ns + number * STEP, data)
    return path


def write_ros2(
    folder: Path, rows: Sequence[Row], plugin: StoragePlugin, definitions: Definitions | None = None
) -> Path:
    store, path = open_store(Stores.ROS2_HUMBLE, definitions or {}), folder / "drive"
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
