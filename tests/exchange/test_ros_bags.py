"""Bags of ROS 1 and ROS 2 become logs with the same images, stamps and intrinsics."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.convert import convert
from rosbags.typesys import Stores, get_typestore

from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, RawImage
from tests.conftest import Ipsys
from tests.exchange.pictured_lab import jpeg
from tests.exchange.ros_rows import NS, STEP, WRITERS, D, K, compressed, info, raw, write_ros1
from tests.test_foreign_logs import picture

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
    done = ipsys("import", "ros", bag, "-o", log)
    assert (done.code, "'16UC1' is not read" in done.err) == (1, True), done.err
    done = ipsys("import", "ros", bag, "-o", log, "--camera", "left=/a/image_raw")
    assert done.code == 0, done.err
    with Session([log]) as session:
        assert session.images == {"left": "/cameras/left/image"}
        assert session.calibrations == {"left": "/cameras/left/calibration"}
        assert [type(image) for image in session.payloads(["/cameras/left/image"])] == [RawImage]


def test_compressed_images_precede_raw_images_of_a_camera(tmp_path: Path, ipsys: Ipsys) -> None:
    rows = [raw(0, GREY, "mono8", "/red/image_raw"), compressed(1, jpeg(), "/red/image_raw/compressed")]
    assert ipsys("import", "ros", write_ros1(tmp_path, rows), "-o", tmp_path / "log.mcap").code == 0
    with Session([tmp_path / "log.mcap"]) as session:
        assert [type(image) for image in session.payloads([session.images["red"]])] == [CompressedImage]


def test_images_without_stamps_have_the_time_of_the_bag(tmp_path: Path, ipsys: Ipsys) -> None:
    bag = write_ros1(tmp_path, [compressed(0, jpeg(), stamp=False), compressed(1, jpeg(), stamp=False)])
    assert ipsys("import", "ros", bag, "-o", tmp_path / "log.mcap").code == 0
    with Session([tmp_path / "log.mcap"]) as session:
        messages = list(session.messages(session.images.values()))
    arrivals = [NS + 20_000_000, NS + STEP + 20_000_000]
    assert [m.publish_time_ns for m in messages] == [m.payload.timestamp for m in messages] == arrivals


def test_bag_of_a_clock_that_starts_at_0_is_read(tmp_path: Path, ipsys: Ipsys) -> None:
    bag = write_ros1(tmp_path, [compressed(n, jpeg(), stamp=False) for n in range(2)], start_ns=0)
    rig = tmp_path / "lab.toml"
    assert ipsys("init", rig).code == 0
    done = ipsys("import", "ros", bag, "-o", tmp_path / "log.mcap", "--rig", rig)
    assert done.code == 0, done.err
    with Session([tmp_path / "log.mcap"]) as session:
        # The rig is the first message, at 0.
        assert [m.log_time_ns for m in session.messages(session.images.values())] == [1, STEP]
        assert session.payloads(["/rig"])


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
        (tmp_path / "cut.bag", (), "is not a readable bag"),
        (tmp_path / "text.bag", (), "is not a readable bag"),
        (tmp_path / "text.db3", (), "is not a readable bag"),
        (tmp_path / "folder", (), "has no metadata.yaml"),
        (tmp_path / "yaml", (), "is not a readable bag"),
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
