"""AprilTag detections in bags become markers with the order and the pixels of ipsys.

The corners below are what the AprilTag library returns for :func:`picture`: release 3.4.5 for tag36h11,
and commit 1c21707 for tagAruco4x4_50, with quad_decimate 2 and refine_edges. Release 3.1.7 is within 0.06 px.
"""

import shutil
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores

from ipsys_log import IpsysError
from ipsys_log.exchange.import_tables import DetectionOptions, import_detections
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array, CameraCalibration, Markers, Rig, RigCamera, RigMarker
from ipsys_log.messages.channels import CAMERA_POINTS
from ipsys_log.stages.detect.search import detect_markers
from tests.conftest import Ipsys
from tests.exchange.ros_rows import NS, STEP, Row, open_store, write_ros1, write_ros2

APRILTAG = "apriltag_msgs/msg/AprilTagDetection"
ISAAC = "isaac_ros_apriltag_interfaces/msg/AprilTagDetection"
POSES = "apriltag_ros/msg/AprilTagDetection"
ARRAY = "std_msgs/Header header\nAprilTagDetection[] detections"
# The fields of apriltag_msgs 2.0.1, isaac_ros_common 4.4 and apriltag_ros 3.2 (ROS 1).
DEFINITIONS = {
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y",
    APRILTAG: "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
    "Point centre\nPoint[4] corners\nfloat64[9] homography",
    ISAAC: "string family\nint32 id\ngeometry_msgs/Point center\ngeometry_msgs/Point[4] corners\n"
    "geometry_msgs/PoseWithCovarianceStamped pose",
    POSES: "int32[] id\nfloat64[] size\ngeometry_msgs/PoseWithCovarianceStamped pose",
    **{f"{name}Array": ARRAY for name in (APRILTAG, ISAAC, POSES)},
}
QUAD_PX = np.array([[101.3, 60.7], [219.8, 81.2], [204.1, 197.6], [88.4, 176.9]])
TAG_PX = [[220.309433, 81.698608], [101.796188, 61.205059], [88.902428, 177.401566], [204.587662, 198.100052]]
ARUCO_PX = [
    [88.903236, 177.401733],
    [204.588379, 198.101425],
    [220.308273, 81.698402],
    [101.796577, 61.203575],
]
DICTIONARY = "DICT_APRILTAG_36h11"
RIG = Rig("lab", DICTIONARY, 0.1, (RigMarker(5), RigMarker(23)), (RigCamera("left"), RigCamera("right")))
LENS = CameraCalibration(
    0, "left", 320, 240, "plumb_bob", np.zeros(5), np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
)
LENSES = {name: replace(LENS, frame_id=name) for name in ("left", "right", "robot_front")}
OPTIONS = DetectionOptions(RIG, LENSES)


def picture(dictionary: str, marker_id: int) -> Any:
    """Return a marker printed by OpenCV whose black has the corners QUAD_PX, with antialiased edges."""
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    side = (known.markerSize + 2) * 40
    marker = np.pad(cv2.aruco.generateImageMarker(known, marker_id, side), 40, constant_values=255)
    edge = np.array([[0, 0], [side, 0], [side, side], [0, side]]) + 39.5
    fine = (8 * (QUAD_PX + 0.5) - 0.5).astype(np.float32)
    warp = cv2.getPerspectiveTransform(edge.astype(np.float32), fine)
    image = cv2.warpPerspective(marker, warp, (8 * 320, 8 * 240), borderValue=255)
    return cv2.GaussianBlur(cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA), (0, 0), 0.7)


def tag(corners_px: Sequence[Sequence[float]] = TAG_PX, marker_id: int = 23, family: str = "tag36h11") -> Any:
    def build(types: Any) -> Any:
        points = [types["apriltag_msgs/msg/Point"](x, y) for x, y in corners_px]
        return types[APRILTAG](family, marker_id, 0, 0.0, 90.0, points[0], points, np.eye(3).ravel())

    return build


def detections(number: int, *tags: Callable[[Any], Any], topic: str = "/left/detections", **head: Any) -> Row:
    stamp_ns = head.pop("stamp_ns", NS + number * STEP)
    fields = {"detections": lambda types: [one(types) for one in tags], **head}
    return topic, stamp_ns, f"{APRILTAG}Array", fields


def isaac(number: int, corners_px: Sequence[Sequence[float]], topic: str = "/right/tag_detections") -> Row:
    def build(types: Any) -> Any:
        points = [types["geometry_msgs/msg/Point"](x, y, 0.0) for x, y in corners_px]
        return [types[ISAAC]("tag36h11", 23, points[0], points, pose(types))]

    return topic, NS + number * STEP, f"{ISAAC}Array", {"detections": build}


def poses(number: int, topic: str = "/left/tag_detections") -> Row:
    def build(types: Any) -> Any:
        return [types[POSES](np.array([23], np.int32), np.array([0.1]), pose(types))]

    return topic, NS + number * STEP, f"{POSES}Array", {"detections": build}


def pose(types: Any) -> Any:
    place = types["geometry_msgs/msg/Point"](0.0, 0.0, 1.0)
    turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    inner = types["geometry_msgs/msg/Pose"](place, turn)
    outer = types["geometry_msgs/msg/PoseWithCovariance"](inner, np.zeros(36))
    sequence = [0] if "seq" in types["std_msgs/msg/Header"].__dataclass_fields__ else []
    head = types["std_msgs/msg/Header"](*sequence, types["builtin_interfaces/msg/Time"](0, 0), "")
    return types["geometry_msgs/msg/PoseWithCovarianceStamped"](head, outer)


def write_sqlite(folder: Path, rows: Sequence[Row]) -> Path:
    """Write a bag of ROS 2 without definitions, as the releases up to Humble do."""
    bag = write_ros2(folder, rows, StoragePlugin.SQLITE3, DEFINITIONS)
    (data,) = bag.glob("*.db3")
    with sqlite3.connect(data) as table:
        table.execute("DELETE FROM message_definitions")
    table.close()
    return bag


def write_mcap(folder: Path, rows: Sequence[Row]) -> Path:
    (data,) = write_ros2(folder, rows, StoragePlugin.MCAP, DEFINITIONS).glob("*.mcap")
    return Path(shutil.move(data, folder / "drive.mcap"))


WRITERS = {
    "ros1": lambda folder, rows: write_ros1(folder, rows, definitions=DEFINITIONS),
    "sqlite": write_sqlite,
    "mcap": write_mcap,
}


def read(path: Path, run: str = "imported") -> dict[str, list[Markers]]:
    with Session([path]) as session:
        topics = [t for r in session.readers for t in r.channels if t.startswith(f"/runs/{run}/cameras/")]
        return {topic.split("/")[4]: session.payloads([topic]) for topic in topics}


def corners(path: Path, camera: str) -> Array:
    (frame,) = read(path)[camera]
    return frame.markers[0].corners_px


@pytest.mark.parametrize("kind", WRITERS)
def test_corners_are_those_that_ipsys_detects(kind: str, tmp_path: Path) -> None:
    rows = [detections(0, tag()), isaac(1, TAG_PX[::-1])]
    import_detections(WRITERS[kind](tmp_path, rows), None, tmp_path / "log.mcap", OPTIONS)
    (marker,) = detect_markers(picture(DICTIONARY, 23), DICTIONARY)
    for camera in ("left", "right"):
        corners_px = corners(tmp_path / "log.mcap", camera)
        np.testing.assert_allclose(corners_px, QUAD_PX, atol=0.02)
        np.testing.assert_allclose(corners_px, marker.corners_px, atol=0.3)


def test_corners_of_aruco_families_are_not_turned(tmp_path: Path) -> None:
    bag = WRITERS["sqlite"](tmp_path, [detections(0, tag(ARUCO_PX, family="tagAruco4x4_50"))])
    options = replace(OPTIONS, rig=replace(RIG, dictionary="DICT_4X4_50"))
    import_detections(bag, None, tmp_path / "log.mcap", options)
    (marker,) = detect_markers(picture("DICT_4X4_50", 23), "DICT_4X4_50")
    np.testing.assert_allclose(corners(tmp_path / "log.mcap", "left"), QUAD_PX, atol=0.02)
    np.testing.assert_allclose(corners(tmp_path / "log.mcap", "left"), marker.corners_px, atol=0.3)


def test_frames_have_stamps_and_known_markers(tmp_path: Path) -> None:
    """Unknown and doubled markers are left out and named; frames without markers stay."""
    rows = [
        detections(number, *tags)
        for number, tags in ((2, [tag(), tag(marker_id=5), tag(marker_id=7)]), (0, []))
    ]
    rows += [detections(number, tag(), tag()) for number in (1, 3)]
    bag = WRITERS["mcap"](tmp_path, rows)
    imported = import_detections(bag, None, tmp_path / "log.mcap", OPTIONS)
    frames = read(tmp_path / "log.mcap")["left"]
    assert [(f.timestamp, [m.id for m in f.markers]) for f in frames] == [
        (NS, []),
        (NS + STEP, []),
        (NS + 2 * STEP, [5, 23]),
        (NS + 3 * STEP, []),
    ]
    assert imported.markers == {"left": 2}
    with Session([tmp_path / "log.mcap"]) as session:
        assert session.runs()[0].parameters == {"format": "ros", "file": "drive.mcap"}
    assert [text.partition(": ")[2] for text in imported.remarks] == [
        "marker 23 is seen 2 times in one frame",
        "marker 7 is not in the rig",
    ]


@pytest.mark.parametrize(
    ("topic", "frame_id", "camera"),
    [
        ("/left/detections", "optical", "left"),
        ("/lab/cam_left/tag_detections", "optical", "left"),
        ("/robot/front/image_rect/tags", "", "robot_front"),
        ("/detections", "cam_left_optical_frame", "left"),
        ("/tag_detections", "/Left", "left"),
    ],
)
def test_topic_or_coordinate_frame_tells_camera(
    topic: str, frame_id: str, camera: str, tmp_path: Path
) -> None:
    bag = WRITERS["sqlite"](tmp_path, [detections(0, tag(), topic=topic, frame_id=frame_id)])
    assert import_detections(bag, None, tmp_path / "log.mcap", OPTIONS).markers == {camera: 1}


def test_coordinate_frames_part_a_topic_of_two_cameras(tmp_path: Path) -> None:
    heads = [{"topic": "/detections", "frame_id": name} for name in ("left_optical_frame", "right_link")]
    bag = WRITERS["mcap"](tmp_path, [detections(0, tag(), **head) for head in heads])
    assert import_detections(bag, None, tmp_path / "log.mcap", OPTIONS).markers == {"left": 1, "right": 1}


def test_named_topic_is_imported_alone(tmp_path: Path) -> None:
    rows = [
        detections(0, tag(family="tf36h11"), topic="/right/detections"),
        detections(0, topic="/other/tags"),
        poses(0),
    ]
    bag = WRITERS["ros1"](tmp_path, rows)
    options = replace(OPTIONS, topics={"left": "/right/detections"})
    assert import_detections(bag, None, tmp_path / "log.mcap", options).markers == {"left": 1}


@pytest.mark.parametrize(
    ("rows", "topics", "reason"),
    [
        (
            [poses(0)],
            {},
            "/left/tag_detections has poses without corners .* record the images, or a topic of",
        ),
        ([poses(0), detections(0)], {"left": "/left/tag_detections"}, "has poses without corners"),
        (
            [("/left", NS, "sensor_msgs/msg/Temperature", {"temperature": 0.0, "variance": 0.0})],
            {},
            "has no topics with",
        ),
        ([detections(0)], {"left": "/gone"}, r"topic /gone of camera left has no .* \(topics: /left/det"),
        ([detections(0, stamp_ns=0)], {}, "/left/detections: a message has no stamp"),
        ([detections(0), detections(0)], {}, f"camera left has two messages at {NS} ns"),
        (
            [detections(0, topic="/up/tags")],
            {},
            r"/up/tags .* fits no camera; .* \(topics: /up/tags; cameras: left, r",
        ),
        ([detections(0, frame_id="right")], {}, "'right'.* fits left, right; add --camera NAME=TOPIC"),
        (
            [detections(0), detections(0, topic="/left/tags")],
            {},
            "/left/tags .* and /left/detections both fit left",
        ),
        ([detections(0, tag(family="tag25h9"))], {}, "family 'tag25h9' .* the rig has DICT_APRILTAG_36h11"),
        ([detections(0, tag(TAG_PX[::-1]))], {}, f"at {NS} ns: the corners of tag 23 are not"),
        ([detections(0, tag([[np.nan, 0.0], *TAG_PX[1:]]))], {}, "the corners of tag 23 are not"),
        ([detections(0, tag(marker_id=-1))], {}, "tag -1"),
    ],
)
def test_faulty_bags_are_one_line(
    rows: list[Row], topics: dict[str, str], reason: str, tmp_path: Path
) -> None:
    bag = WRITERS["ros1"](tmp_path, rows)
    with pytest.raises(IpsysError, match=reason) as error:
        import_detections(bag, None, tmp_path / "log.mcap", replace(OPTIONS, topics=topics))
    assert "\n" not in str(error.value)
    assert [path.name for path in tmp_path.iterdir()] == ["drive.bag"]


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_other_fields_of_a_type_are_refused(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(DEFINITIONS, f"{APRILTAG}Array", f"{ARRAY}\nfloat64 more")
    (topic, stamp_ns, name, fields) = detections(0, tag())
    bag = WRITERS[kind](tmp_path, [(topic, stamp_ns, name, {**fields, "more": 0.0})])
    with pytest.raises(IpsysError, match="its type apriltag_msgs/msg/AprilTagDetectionArray"):
        import_detections(bag, None, tmp_path / "log.mcap", OPTIONS)


def test_topic_without_messages_is_refused(tmp_path: Path) -> None:
    store = open_store(Stores.ROS2_HUMBLE, DEFINITIONS)
    with Writer2(tmp_path / "drive", version=8) as writer:
        writer.add_connection("/left/detections", f"{APRILTAG}Array", typestore=store)
    with pytest.raises(IpsysError, match="have no messages"):
        import_detections(tmp_path / "drive", None, tmp_path / "log.mcap", OPTIONS)


def test_topics_of_a_table_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time", encoding="utf-8")
    options = replace(OPTIONS, topics={"left": "/left/detections"})
    with pytest.raises(IpsysError, match="--camera: has no effect for a table"):
        import_detections(tmp_path / "a.csv", None, tmp_path / "log.mcap", options)


def test_distorted_intrinsics_get_a_remark(tmp_path: Path) -> None:
    bag = WRITERS["sqlite"](tmp_path, [detections(0, tag())])
    lens = replace(LENS, D=np.array([-0.1, 0, 0, 0, 0]))
    options = replace(OPTIONS, lenses={"left": lens})
    imported = import_detections(bag, None, tmp_path / "log.mcap", options)
    assert [text.partition(";")[0] for text in imported.remarks] == ["camera left has lens distortion"]


def test_command_imports_a_bag_and_finds_positions(tmp_path: Path, ipsys: Ipsys) -> None:
    rows = [detections(number, tag()) for number in range(3)]
    bag = WRITERS["mcap"](tmp_path, rows)
    (tmp_path / "lab.toml").write_text(
        f'name = "lab"\ndictionary = "{DICTIONARY}"\nmarker_length_m = 0.1\n[[cameras]]\nname = "left"\n'
    )
    (tmp_path / "left.yaml").write_text(
        "image_width: 320\nimage_height: 240\ncamera_name: left\n"
        "camera_matrix: {rows: 3, cols: 3, data: [300, 0, 160, 0, 300, 120, 0, 0, 1]}\n"
        "distortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
    )
    log = tmp_path / "log.mcap"
    done = ipsys("import", "--as", "ros", WRITERS["ros1"](tmp_path, rows), "-o", log)
    assert (done.code, "add --as detections" in done.err) == (1, True), done.err
    lab = ("--rig", tmp_path / "lab.toml", "--calibration", f"left={tmp_path / 'left.yaml'}")
    done = ipsys("import", "--as", "detections", bag, "-o", log, *lab)
    assert done.code == 0, done.err
    assert "run imported: markers: 3 of left" in done.out
    done = ipsys("camera-frame", log)
    assert done.code == 0, done.err
    with Session([log]) as session:
        points = session.payloads(session.topics(CAMERA_POINTS, "imported"))
    assert [(frame.timestamp, frame.points[0].id) for frame in points] == [
        (NS + number * STEP, 23) for number in range(3)
    ]
    done = ipsys("import", "--as", "detections", bag, "--into", log, "--run", "again")
    assert (done.code, "run again: markers: 3 of left" in done.out) == (0, True), done.err
    done = ipsys("import", "--as", "detections", log, "-o", tmp_path / "b.mcap", *lab)
    assert (done.code, "is already a log" in done.err) == (1, True), done.err
