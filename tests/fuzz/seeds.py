"""Small valid inputs for the fuzz job, created anew in each run."""

import struct
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import scipy.io
from mcap.opcode import Opcode

from ipsys_log.exchange.calibration_files import kalibr_yaml, opencv_yaml, ros_yaml
from ipsys_log.log.codec import encode, schema_data, schema_name
from ipsys_log.log.contents import Schema
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import (
    CameraCalibration,
    CameraPoint,
    CameraPoints,
    CompressedImage,
    Distance,
    Event,
    Floor,
    Marker,
    Markers,
    Measurement,
    Position,
    Positions,
    RawImage,
    ReferencePoint,
    Rig,
    RigCamera,
    RigMarker,
    Run,
    Track,
    Tracks,
)
from ipsys_log.messages.rig_file import rig_toml
from tests.exchange.ros_rows import WRITERS, compressed, info, raw
from tests.log.bombs import Attack, message

RIG = Rig(
    "lab",
    "DICT_4X4_100",
    0.2,
    (RigMarker(1, robot="ada"), RigMarker(2, length_m=0.1, height_m=0.3)),
    (RigCamera("red", row_time_ns=20_000, rate_hz=30.0), RigCamera("white")),
    (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0)),
    Floor(4.0, 5.0),
    0.1,
    0.003,
)
_K = np.array([[500.0, 0.0, 32.0], [0.0, 500.0, 24.0], [0.0, 0.0, 1.0]])
_LENS = CameraCalibration(5, "red", 64, 48, "kannala_brandt", np.array([0.1, 0.01, 0.0, 0.0]), _K)
_CORNERS = np.array([[1.0, 2.0], [9.0, 2.0], [9.0, 9.0], [1.0, 9.0]])


@cache
def pictures() -> tuple[bytes, ...]:
    """Return JPEGs of several kinds, also with restart markers, and a PNG."""
    pixels = np.random.default_rng(1).integers(0, 255, (48, 64, 3), np.uint8)
    kinds: list[tuple[str, list[int]]] = [
        (".jpg", []),
        (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".jpg", [cv2.IMWRITE_JPEG_RST_INTERVAL, 4]),
        (".png", []),
    ]
    return tuple(cv2.imencode(kind, pixels, options)[1].tobytes() for kind, options in kinds)


@cache
def payloads() -> tuple[tuple[str, object], ...]:
    """Return one payload for each topic of a small log."""
    camera, run = "/cameras/red", "/runs/edges/cameras/red"
    return (
        ("/rig", RIG),
        (f"{camera}/calibration", _LENS),
        (f"{camera}/image", CompressedImage(7, "red", pictures()[0], "jpeg")),
        ("/cameras/white/image", RawImage(7, "white", 8, 4, "mono8", 8, bytes(32))),
        (f"{run}/markers", Markers(7, (Marker(1, _CORNERS),), 64, 48)),
        (f"{run}/camera_points", CameraPoints(7, (CameraPoint(1, 0.1, 0.2, 2.0),))),
        (f"{run}/positions", Positions(7, (Position(1, 0.1, 0.2, 0.0),))),
        ("/runs/edges/tracks", Tracks(7, (Track("ada", 1, 0.1, 0.2, 0.0),))),
        (
            "/measurements",
            Measurement(7, "p001", None, 1, (Distance("A", 1.5), Distance("B", 1.5)), "left", 0.1),
        ),
        ("/events", Event(8, "camera_lost", "unplugged", "red")),
        ("/runs/edges/record", Run(9, "edges", "detect", {"corners": "edges"})),
    )


@cache
def logs() -> tuple[bytes, ...]:
    """Return logs with and without checksums, indexes and compression.

    Damage has more effect without these.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        with LogWriter.create(path) as log:
            for number, (topic, payload) in enumerate(payloads()):
                name = schema_name(type(payload))
                log.add_channel(topic, Schema(name, "protobuf", schema_data(name)))
                log.write(topic, number + 10, number + 10, encode(payload))
        ours = path.read_bytes()
    return ours, _bare("", True), _bare("", False), _bare("zstd", True), _bare("lz4", False), _foreign()


def _bare(compression: str, summary: bool) -> bytes:
    attack = Attack()
    content = b""
    for number, (topic, payload) in enumerate(payloads()):
        channel = attack.channel(type(payload), topic)
        content += message(encode(payload), number + 10, channel)
        attack.contents.counts[channel] = 1
    attack.chunk(content, name=compression, span=(10, 40), count=0)
    attack.contents.cover(10, 40)
    return _without_checksum(attack.finish(summary))


def _foreign() -> bytes:
    """Return JSON of Foxglove and CDR of ROS 2."""
    attack = Attack()
    lens = b'{"timestamp":{"sec":1,"nsec":2},"frame_id":"red","width":64,"height":48,"K":[1,2,3]}'
    attack.channel("foxglove.CameraCalibration", "/red/info", "json")
    definition = b"std_msgs/Header header\nstring format\nuint8[] data\n"
    attack.channel("sensor_msgs/msg/CompressedImage", "/blue/image", "cdr", definition)
    cdr = b"\0\1\0\0" + struct.pack("<IiI4sI4sI", 1, 2, 4, b"red\0", 5, b"jpeg", 0) + bytes(20)
    content = message(lens, 10, 1) + message(cdr, 11, 2)
    attack.chunk(content, name="", span=(10, 11), count=0)
    attack.contents.counts = {1: 1, 2: 1}
    attack.contents.cover(10, 11)
    return _without_checksum(attack.finish())


def _without_checksum(log: bytes) -> bytes:
    assert log[-37] == Opcode.FOOTER
    return log[:-12] + bytes(4) + log[-8:]


@cache
def rig_files() -> tuple[bytes, ...]:
    return (rig_toml(RIG).encode(),)


@cache
def lens_files() -> tuple[tuple[str, bytes], ...]:
    """Return calibration files by suffix."""
    sigmas = {"fx": 0.1}
    texts = [(".yaml", make(_LENS, sigmas, "made by hand")) for make in (opencv_yaml, ros_yaml, kalibr_yaml)]
    storage = cv2.FileStorage(".json", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("camera_matrix", _K)
    storage.write("image_width", 64)
    texts.append((".json", storage.releaseAndGetString()))
    return tuple((kind, text.encode()) for kind, text in texts)


@cache
def bags() -> tuple[tuple[str, bytes], ...]:
    """Return bags of ROS 1 and ROS 2 with an image and intrinsics, by suffix."""
    k = [500.0, 0, 32, 0, 500, 24, 0, 0, 1]
    rows = [info(0, k), compressed(1, b"\xff\xd8 a picture"), raw(2, np.zeros((4, 6), np.uint8), "mono8")]
    with TemporaryDirectory() as folder:
        paths = [WRITERS["ros1"](Path(folder), rows), *WRITERS["sqlite3"](Path(folder), rows).glob("*.db3")]
        return tuple((path.suffix, path.read_bytes()) for path in paths)


@cache
def sheets() -> tuple[bytes, ...]:
    head = "id,marker,d_A_cm,d_B_cm,side,height_cm,place,time,split,note\n"
    rows = "p001,1,150.5,160,left,10,1,,train,\n,2,1.5,212.7,right,0,,2026-05-04 10:15:30,,x\n"
    return (head + rows).encode(), (head + rows).replace(",", ";").encode()


@cache
def mat() -> tuple[bytes, ...]:
    """Return MATLAB files in the format of the paper's authors, packed and unpacked."""
    tables = {f"X{kind}_red": np.arange(12.0).reshape(4, 3) for kind in "cw"}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.mat"
        wholes = []
        for packed in (False, True):
            scipy.io.savemat(path, tables, do_compression=packed)
            wholes.append(path.read_bytes())
    return tuple(wholes)
