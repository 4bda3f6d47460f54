"""Logs of other software: images and calibrations with any names, identified by their schemas."""

import base64
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import CAMERA_POINTS, MARKERS
from tests.conftest import Ipsys, data_section

RIG = 'name = "other"\ndictionary = "DICT_4X4_100"\nmarker_length_m = 0.2\n'


def picture(marker_id: int, x: int = 100) -> np.ndarray[Any, np.dtype[np.uint8]]:
    grey = np.full((360, 640), 220, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    grey[120:220, x : x + 100] = cv2.aruco.generateImageMarker(dictionary, marker_id, 100)
    return grey


def stamped(message: Any, frame_id: str, time_ns: int) -> Any:
    message.frame_id = frame_id
    message.timestamp.FromNanoseconds(time_ns)
    return message


def jpeg(marker_id: int, frame_id: str, time_ns: int) -> Any:
    data = cv2.imencode(".jpg", cv2.merge([picture(marker_id)] * 3))[1].tobytes()
    return stamped(CompressedImage(data=data, format="jpeg"), frame_id, time_ns)


def raw(marker_id: int, frame_id: str, time_ns: int) -> Any:
    colour = cv2.cvtColor(picture(marker_id), cv2.COLOR_GRAY2RGB)
    padded = np.zeros((360, 2048), np.uint8)  # rows may be longer than their contents
    padded[:, : 640 * 3] = colour.reshape(360, -1)
    image = RawImage(width=640, height=360, encoding="rgb8", step=2048, data=padded.tobytes())
    return stamped(image, frame_id, time_ns)


def lens(frame_id: str, time_ns: int) -> Any:
    calibration = CameraCalibration(
        width=640,
        height=360,
        distortion_model="plumb_bob",
        D=[0.0] * 5,
        K=[500, 0, 320, 0, 500, 180, 0, 0, 1],
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[500, 0, 320, 0, 0, 500, 180, 0, 0, 0, 1, 0],
    )
    return stamped(calibration, frame_id, time_ns)


def write(path: Path, messages: Iterable[tuple[str, int, Any]], compression: CompressionType) -> None:
    """Write a log with the stock writer: everything interleaved, one schema per message type."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start()
        channels: dict[str, int] = {}
        for topic, time_ns, message in messages:
            if topic not in channels:
                descriptor = message.DESCRIPTOR
                files = FileDescriptorSet()
                for dependency in (*descriptor.file.dependencies, descriptor.file):
                    dependency.CopyToProto(files.file.add())
                schema = writer.register_schema(descriptor.full_name, "protobuf", files.SerializeToString())
                channels[topic] = writer.register_channel(topic, "protobuf", schema)
            writer.add_message(channels[topic], time_ns, message.SerializeToString(), time_ns)
        writer.finish()  # type: ignore[no-untyped-call]


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "lab.toml"
    path.write_text(RIG)
    return path


@pytest.mark.parametrize("compression", list(CompressionType))
def test_detect_and_camera_frame(
    ipsys: Ipsys, tmp_path: Path, rig: Path, compression: CompressionType
) -> None:
    log = tmp_path / "foreign.mcap"
    messages = []
    for n in range(1, 6):
        t = n * 1_000_000
        messages += [
            ("/Left-Cam/image_raw/compressed", t, jpeg(3, "left_optical", t)),
            ("/robot/front", t, raw(4, "front_optical", t)),
            ("/front_info", t + 10, lens("front_optical", t)),
            ("/Left-Cam/camera_info", t + 20, lens("left_optical", t)),
        ]
    write(log, messages, compression)
    recorded = data_section(log)
    done = ipsys("camera-frame", log, "--rig", rig)
    assert done.code == 0, done.err
    assert log.read_bytes().startswith(recorded)
    with Session([log]) as session:
        assert session.images == {"left_cam": "/Left-Cam/image_raw/compressed", "robot_front": "/robot/front"}
        # one by its topic, the other by the common frame
        assert session.calibrations == {"left_cam": "/Left-Cam/camera_info", "robot_front": "/front_info"}
        for camera, marker_id in (("left_cam", 3), ("robot_front", 4)):
            seen = session.payloads([f"/runs/edges/cameras/{camera}/markers"])
            assert [[m.id for m in frame.markers] for frame in seen] == [[marker_id]] * 5
            # The first frames precede their calibration: the first known calibration is valid for them.
            points = session.payloads([f"/runs/edges/cameras/{camera}/camera_points"])
            assert len(points) == 5
            assert points[0].points[0].z_m == pytest.approx(0.2 * 500 / 100, rel=0.02)
        assert session.topics(MARKERS, "edges")
        assert session.topics(CAMERA_POINTS, "edges")
    with log.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages()) > len(messages)


def test_a_second_detect_finds_the_first(ipsys: Ipsys, tmp_path: Path, rig: Path) -> None:
    log = tmp_path / "foreign.mcap"
    write(log, [("/cam", t, jpeg(1, "cam", t)) for t in (1, 2, 3)], CompressionType.ZSTD)
    done = ipsys("detect", log, "--rig", rig)
    assert done.code == 0
    # Edge fits need intrinsics: without them, corners are OpenCV's, and a message says so.
    assert "camera cam has no calibration, so its corners are from --corners stock" in done.err
    before = log.read_bytes()
    assert "up to date" in ipsys("detect", log, "--rig", rig).err
    assert log.read_bytes() == before


def test_edges_option_needs_intrinsics(ipsys: Ipsys, tmp_path: Path, rig: Path) -> None:
    log = tmp_path / "foreign.mcap"
    write(log, [("/cam", 1, jpeg(1, "cam", 1))], CompressionType.ZSTD)
    before = log.read_bytes()
    done = ipsys("detect", log, "--corners", "edges", "--rig", rig)
    assert (done.code, done.err.count("\n")) == (1, 1)
    assert "camera cam has no calibration in the log" in done.err
    assert log.read_bytes() == before
    done = ipsys("detect", log, "--corners", "round", "--rig", rig)
    assert (done.code, done.err.count("\n")) == (1, 1)
    assert "use one of edges, stock" in done.err


def test_the_same_camera_raw_and_compressed_is_one_camera(ipsys: Ipsys, tmp_path: Path, rig: Path) -> None:
    log = tmp_path / "foreign.mcap"
    both = [("/cam/image_raw", 1, raw(1, "cam", 1)), ("/cam/image_raw/compressed", 2, jpeg(1, "cam", 1))]
    write(log, both, CompressionType.NONE)
    assert ipsys("detect", log, "--rig", rig).code == 0
    with Session([log]) as session:
        assert session.images == {"cam": "/cam/image_raw/compressed"}


def test_topics_that_differ_only_in_a_generic_word_stay_apart(tmp_path: Path) -> None:
    log = tmp_path / "foreign.mcap"
    both = [("/cam/color", 1, jpeg(1, "cam", 1)), ("/cam/mono", 2, jpeg(1, "cam", 1))]
    write(log, both, CompressionType.NONE)
    with Session([log]) as session:
        assert sorted(session.images) == ["cam_color", "cam_mono"]


def write_raw(path: Path, encoding: str, schema_encoding: str, data: bytes) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedImage", schema_encoding, b"{}")
        writer.add_message(writer.register_channel("/cam", encoding, schema), 1, data, 1)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_json_is_read_too(ipsys: Ipsys, tmp_path: Path, rig: Path) -> None:
    message = jpeg(6, "cam", 1)
    text = {
        "timestamp": {"sec": 0, "nsec": 1},
        "frame_id": "cam",
        "data": base64.b64encode(message.data).decode(),
        "format": "jpeg",
    }
    log = write_raw(tmp_path / "json.mcap", "json", "jsonschema", json.dumps(text).encode())
    done = ipsys("detect", log, "--rig", rig)
    assert done.code == 0, done.err
    with Session([log]) as session:
        assert session.payloads(["/cam"])[0].timestamp == 1
        seen = session.payloads(["/runs/stock/cameras/cam/markers"])
    assert [marker.id for marker in seen[0].markers] == [6]


@pytest.mark.parametrize(
    ("encoding", "data", "said"),
    [
        ("flatbuffer", b"...", "messages encoded as 'flatbuffer' cannot be read, only protobuf and json"),
        ("json", b"{]", "not a valid foxglove.CompressedImage"),
        ("protobuf", b"\xff\xff", "not a valid foxglove.CompressedImage"),
    ],
)
def test_undecodable_frames_are_reported(
    ipsys: Ipsys, tmp_path: Path, rig: Path, encoding: str, data: bytes, said: str
) -> None:
    log = write_raw(tmp_path / "odd.mcap", encoding, "", data)
    done = ipsys("detect", log, "--rig", rig)
    assert done.code == 1
    assert f"{log}: /cam at 1 ns" in done.err
    assert said in done.err
    assert done.err.count("\n") == 1
