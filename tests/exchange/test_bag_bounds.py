"""Small bags that unpack to much data are refused before they fill the memory or the disk."""

import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.convert import convert
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_typestore

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.imsel import read_mat
from ipsys_log.log.dataset import Session
from tests.conftest import Ipsys
from tests.exchange.pictured_lab import jpeg
from tests.exchange.ros_rows import NS, STEP, compressed, make, write_ros2

BOMB = b"\xff\xd8" + bytes(40 << 20)
MOST_BYTES = 60 << 20


def write_ros1(path: Path, data: bytes, kind: str) -> Path:
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer1(path)
    writer.set_compression(Writer1.CompressionFormat[kind])
    with writer:
        for number in range(2):
            topic, stamp_ns, name, values = compressed(number, data)
            connection: Any = None
            if not writer.connections:
                connection = writer.add_connection(topic, name, typestore=store)
            connection = connection or writer.connections[0]
            encoded = store.serialize_ros1(make(store, name, stamp_ns, values, True), name)
            writer.write(connection, NS + number * STEP, encoded)
    return path


def write_compressed_ros2(folder: Path, data: bytes, mode: str) -> Path:
    bag = write_ros2(folder, [compressed(0, data), compressed(1, data)], StoragePlugin.SQLITE3)
    convert(
        [bag], folder / "packed",
        dst_storage="sqlite3", dst_version=8, compress="zstd", compress_mode=mode,
        default_typestore=None, typestore=get_typestore(Stores.ROS2_HUMBLE),
        exclude_topics=[], include_topics=[], exclude_msgtypes=[], include_msgtypes=[],
    )  # fmt: skip
    return folder / "packed"


def write_bag(folder: Path, data: bytes, kind: str) -> Path:
    if kind in ("BZ2", "LZ4"):
        return write_ros1(folder / "drive.bag", data, kind)
    return write_compressed_ros2(folder, data, kind)


KINDS = ["BZ2", "LZ4", "message", "file"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_compressed_bag_has_the_images_of_its_topics(kind: str, tmp_path: Path, ipsys: Ipsys) -> None:
    done = ipsys("import", "ros", write_bag(tmp_path, jpeg(), kind), "-o", tmp_path / "log.mcap")
    assert done.code == 0, done.err
    with Session([tmp_path / "log.mcap"]) as session:
        images = session.payloads([session.images["red"]])
    assert [image.data for image in images] == [jpeg(), jpeg()]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_bomb_in_a_bag_is_refused_with_one_line(kind: str, tmp_path: Path, ipsys: Ipsys) -> None:
    data = BOMB if kind != "file" else b"\xff\xd8" + bytes(100 << 20)
    bag = write_bag(tmp_path, data, kind)
    tracemalloc.start()
    done = ipsys("import", "ros", bag, "-o", tmp_path / "log.mcap")
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert done.code == 1
    assert "is refused:" in done.err
    assert done.err.count("\n") == 1
    assert most < MOST_BYTES
    assert not (tmp_path / "log.mcap").exists()


@pytest.mark.slow
def test_tables_of_a_mat_file_are_bounded_together(tmp_path: Path) -> None:
    """Each table has 16 MB of zeros in 16 kB."""
    size = (16 << 20) - 128
    head = np.array([6, 8, 6, 0, 5, 8, 1, size // 8, 1, 1], "<u4").tobytes()
    body = head + b"a" + bytes(7) + np.array([9, size], "<u4").tobytes() + bytes(size)
    table = zlib.compress(np.array([14, len(body)], "<u4").tobytes() + body)
    element = np.array([15, len(table)], "<u4").tobytes() + table
    path = tmp_path / "a.mat"
    path.write_bytes(bytes(124) + b"\x00\x01IM" + 3 * element)
    assert read_mat(path)["a"].shape == (1, size // 8)
    path.write_bytes(bytes(124) + b"\x00\x01IM" + 6 * element)
    with pytest.raises(IpsysError, match="its tables are too large"):
        read_mat(path)
