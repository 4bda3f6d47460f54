"""AprilTag detections in bags of ROS 1 and ROS 2: the markers of each frame, with the corners of ipsys.

The AprilTag library and OpenCV differ in the order of corners, the orientation of the print and the origin of
pixels. docs/export.md has the measurements.
"""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Reader1
from rosbags.typesys import Stores, get_types_from_msg

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.import_tables import DetectedFrame
from ipsys_log.exchange.ros_bags import BagReader, faults, message_types, open_bag, raw_messages, ros1_types
from ipsys_log.log.contents import clean_name
from ipsys_log.messages import Array, Marker, Rig
from ipsys_log.plain_text import join_names
from ipsys_log.units import NS_PER_S

_APRILTAG = "apriltag_msgs/msg/AprilTagDetection"
_ISAAC = "isaac_ros_apriltag_interfaces/msg/AprilTagDetection"
_WITHOUT_CORNERS = "apriltag_ros/msg/AprilTagDetectionArray"
_ARRAY = "std_msgs/Header header\nAprilTagDetection[] detections\n"
# Bags of SQLite have no definitions. The fields never changed since the first release of each package.
_FIELDS = {
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
    _APRILTAG: "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
    "Point centre\nPoint[4] corners\nfloat64[9] homography\n",
    _ISAAC: "string family\nint32 id\ngeometry_msgs/Point center\ngeometry_msgs/Point[4] corners\n"
    "geometry_msgs/PoseWithCovarianceStamped pose\n",
    f"{_APRILTAG}Array": _ARRAY,
    f"{_ISAAC}Array": _ARRAY,
}
# The places of top left, top right, bottom right and bottom left of the tag in a message.
_CLOCKWISE = {f"{_APRILTAG}Array": [3, 2, 1, 0], f"{_ISAAC}Array": [0, 1, 2, 3]}
# The AprilTag library counts pixels from the corner of the first pixel, OpenCV from its centre.
_FIRST_CENTRE_PX = 0.5
_FRAME_ENDS = re.compile(r"(_(optical|frame|link))+$")


def read_bag_detections(
    path: Path, topics: Mapping[str, str], cameras: Collection[str], rig: Rig
) -> list[DetectedFrame]:
    """Return the frames of a bag with detections, in the order of their stamps; a marker id can occur twice.

    Parameters
    ----------
    topics : topic by camera; empty: all topics with detections.
    cameras : the known cameras. The names of a topic and of its coordinate frame tell the camera.
    rig : its dictionary must be that of the tags.

    Raises
    ------
    IpsysError
        The bag is damaged or has no corners of tags, a camera is not clear, or a message is wrong.
    """
    by_source: dict[tuple[str, str], list[tuple[int, tuple[Marker, ...]]]] = {}
    with open_bag(path) as reader:
        connections = _select(path, reader.connections, topics)
        decode = {connection.id: _decoder(path, reader, connection) for connection in connections}
        for connection, _, data in raw_messages(path, reader, connections):
            with faults(path):
                message = decode[connection.id](data)
            stamp, frame_id = message.header.stamp, message.header.frame_id
            time_ns = int(stamp.sec) * NS_PER_S + int(stamp.nanosec)
            where = f"{path}: {connection.topic}"
            if time_ns <= 0:
                raise IpsysError(f"{where}: a message has no stamp; record the stamps of the images")
            where = f"{where} at {time_ns} ns"
            markers = [_marker(tag, connection.msgtype, rig, where) for tag in message.detections]
            row = time_ns, tuple(sorted(markers, key=lambda marker: marker.id))
            by_source.setdefault((connection.topic, frame_id), []).append(row)
    if not by_source:
        raise IpsysError(f"{path}: its topics of detections have no messages; record it again")
    frames: dict[tuple[int, str], DetectedFrame] = {}
    for (topic, _), camera in _find_cameras(path, by_source, topics, cameras).items():
        for time_ns, markers_in_frame in by_source[topic, _]:
            frame = DetectedFrame(time_ns, time_ns, camera, markers_in_frame, f"{path}: {topic}")
            if frames.setdefault((time_ns, camera), frame) is not frame:
                raise IpsysError(
                    f"{path}: {topic}: camera {camera} has two messages at {time_ns} ns; record it again"
                )
    return [frames[key] for key in sorted(frames)]


def _select(path: Path, connections: Sequence[Connection], topics: Mapping[str, str]) -> list[Connection]:
    readable = [connection for connection in connections if connection.msgtype in _CLOCKWISE]
    names = {connection.topic for connection in readable}
    poses = [connection.topic for connection in connections if connection.msgtype == _WITHOUT_CORNERS]
    for camera, topic in topics.items():
        if topic not in names and topic not in poses:
            raise IpsysError(
                f"{path}: topic {topic} of camera {camera} has no detections (topics: "
                f"{join_names(sorted(names), 12) or 'none'})"
            )
    if poses and (not names or set(poses) & {*topics.values()}):
        raise IpsysError(
            f"{path}: {poses[0]} has poses without corners (apriltag_ros/AprilTagDetectionArray); record "
            "the images, or a topic of apriltag_msgs/msg/AprilTagDetectionArray"
        )
    if not names:
        raise IpsysError(f"{path}: has no topics with detections (types: {', '.join(_CLOCKWISE)})")
    return [connection for connection in readable if not topics or connection.topic in topics.values()]


def _decoder(path: Path, reader: BagReader, connection: Connection) -> Callable[[bytes], Any]:
    """Return the function that decodes the messages of a connection.

    The library makes code of definitions, so it gets only those above; a bag with other ones is refused.
    """
    name, is_ros1 = connection.msgtype, isinstance(reader, Reader1)
    store = message_types(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)
    for kind, fields in _FIELDS.items():
        store.register(get_types_from_msg(fields, kind))
    if is_ros1:
        ros1_types(path, connection)
        return lambda data: store.deserialize_ros1(data, name)
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        with faults(path):
            types = get_types_from_msg(connection.msgdef.data, name)
        if others := [kind for kind in types if types[kind] != store.fielddefs.get(kind)]:
            raise IpsysError(
                f"{path}: {connection.topic}: its type {others[0]} has other fields; record it with the "
                "released package"
            )
    return lambda data: store.deserialize_cdr(data, name)


def _marker(detection: Any, kind: str, rig: Rig, where: str) -> Marker:
    dictionary = _dictionary(detection.family)
    if dictionary.lower() != rig.dictionary.lower():
        raise IpsysError(
            f"{where}: tags of the family {detection.family[:40]!r} ({dictionary[:40]}), but the rig has "
            f"{rig.dictionary}; correct dictionary in the rig"
        )
    corners_px = np.array([(corner.x, corner.y) for corner in detection.corners])[_CLOCKWISE[kind]]
    corners_px -= _FIRST_CENTRE_PX
    if "APRILTAG" in dictionary:
        # OpenCV prints these tags turned by 180 degrees; the corners of ipsys belong to its prints.
        corners_px = np.roll(corners_px, 2, axis=0)
    if not _is_clockwise(corners_px) or detection.id < 0:
        raise IpsysError(
            f"{where}: the corners of tag {detection.id} are not those of a tag in the order of {kind}; "
            "correct the node that publishes them"
        )
    return Marker(int(detection.id), corners_px)


def _dictionary(family: str) -> str:
    """Return the dictionary of OpenCV for a family such as ``tag36h11``, ``tf36h11`` or ``36h11``."""
    name = re.sub(r"^(tag|tf)", "", family)
    return f"DICT_{name[5:].upper()}" if name.startswith("Aruco") else f"DICT_APRILTAG_{name}"


def _is_clockwise(corners_px: Array) -> bool:
    """Return whether finite corners surround an area clockwise, with y down."""
    x, y = corners_px.T
    return bool(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0)


def _find_cameras(
    path: Path, sources: Collection[tuple[str, str]], topics: Mapping[str, str], cameras: Collection[str]
) -> dict[tuple[str, str], str]:
    """Return the camera of each topic and coordinate frame."""
    named = {topic: camera for camera, topic in topics.items()}
    camera_of: dict[tuple[str, str], str] = {}
    topic_of: dict[str, str] = {}
    for topic, frame_id in sorted(sources):
        fitting = {named[topic]} if topic in named else _possible_names(topic, frame_id) & {*cameras}
        fault = "" if len(fitting) == 1 else f"fits {join_names(sorted(fitting), 12) or 'no camera'}"
        camera = min(fitting, default="")
        if not fault and topic_of.setdefault(camera, topic) != topic:
            fault = f"and {topic_of[camera]} both fit {camera}"
        if fault:
            all_topics = join_names(sorted({topic for topic, _ in sources}), 12)
            raise IpsysError(
                f"{path}: {topic} (coordinate frame {frame_id[:40]!r}) {fault}; add --camera NAME=TOPIC for "
                f"each camera (topics: {all_topics}; cameras: {join_names(sorted(cameras), 12) or 'none'})"
            )
        camera_of[topic, frame_id] = camera
    return camera_of


def _possible_names(topic: str, frame_id: str) -> set[str]:
    """Return the names that a camera can have, by its topic such as ``/lab/cam_left/detections``."""
    parts = [part for part in topic.split("/") if part]
    ends = range(1, len(parts) + 1)
    texts = ["/".join(parts[start:end]) for end in ends for start in range(end)]
    names = {clean_name(text) for text in (*texts, frame_id, _FRAME_ENDS.sub("", frame_id)) if text}
    return names | {re.sub(r"^(cam|camera)_", "", name) for name in names}
