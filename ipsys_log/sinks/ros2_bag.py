"""A ROS 2 bag in one MCAP file: images, intrinsics, and the poses that the ROS 2 stream would send.

References
----------
https://mcap.dev/spec/registry#ros2, and ``rosbag2_storage_mcap`` for the metadata of topics.
"""

from collections.abc import Collection
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.writer import CompressionType, Writer

from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError
from ipsys_log.log.atomic_files import replacement_of
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, Message, Tracks
from ipsys_log.messages.channels import MODEL, TRACKS
from ipsys_log.sinks.selection import rig_in_force
from ipsys_log.sinks.streams import ros2_messages
from ipsys_log.sinks.streams import ros2_messages as ros2
from ipsys_log.sinks.streams.poses import PoseSource
from ipsys_log.statistics.floor_cameras import read_floor_cameras
from ipsys_log.vision.poses import PosedCamera

_STEP = "bag"
_FOREVER = "{sec: 9223372036, nsec: 854775807}"
# Late subscribers get the last message of such a topic. The numbers are those of rmw/types.h.
_LATCHED = (
    "- {history: 1, depth: 1, reliability: 1, durability: 1, liveliness: 1, "
    f"deadline: {_FOREVER}, lifespan: {_FOREVER}, liveliness_lease_duration: {_FOREVER}, "
    "avoid_ros_namespace_conventions: false}"
)


class BagCounts(NamedTuple):
    """The content of a bag: numbers of messages, images, poses, and poses that were left out."""

    messages: int
    images: int
    poses: int
    left_out: int


def write_bag(
    session: Session,
    run: str,
    path: Path,
    robots: Collection[str] = (),
    with_images: bool = True,
    progress: Progress = lambda step, done, total: None,
) -> BagCounts:
    """Write a log as a bag; the memory does not grow with the log.

    An image has the topic ``/<camera>/image_raw/compressed`` (raw images: ``image_raw``) and comes with its
    intrinsics. Poses are those of :class:`~ipsys_log.sinks.streams.ros2.Ros2Stream`: poses outside the
    calibrated volume, of robots that are out of sight, and without heading are left out.

    Parameters
    ----------
    run : the run of the tracks.
    robots : the names of the robots; empty: all.
    """
    if path.exists():
        raise IpsysError(f"{path}: exists already; choose another name")
    tracks = session.topics(TRACKS, run)
    images = list(session.images.values()) if with_images else []
    topics = [*images, *session.calibrations.values(), *tracks]
    total = sum(map(session.count, topics))
    with replacement_of(path) as file:
        bag = _Bag(file, tracks, robots, bool(images))
        bag.add_static(session, run)
        for done, message in enumerate(session.messages(topics)):
            progress(_STEP, done, total)
            bag.add(message)
        bag.close()
        if robots and not bag.known.intersection(robots):
            raise IpsysError(
                f"{session}: tracks has no robot {' or '.join(map(repr, robots))} "
                f"(it has: {', '.join(sorted(bag.known)) or 'none'})"
            )
    progress(_STEP, total, total)
    return BagCounts(bag.messages, bag.images, bag.poses, bag.left_out)


class _Bag:
    """A bag that is written: its channels, and the newest intrinsics of each camera."""

    def __init__(
        self, file: BinaryIO, tracks: Collection[str], robots: Collection[str], has_images: bool
    ) -> None:
        # Compressed images cannot be compressed further.
        compression = CompressionType.NONE if has_images else CompressionType.ZSTD
        self._writer = Writer(file, compression=compression)
        self._writer.start(profile="ros2", library="ipsys_log")
        self._now_ns = 0
        self._poses = PoseSource(tracks, lambda: self._now_ns, 0, robots)
        self._tracks, self._robots, self._has_images = frozenset(tracks), frozenset(robots), has_images
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._lenses: dict[str, CameraCalibration] = {}
        self.known: set[str] = set()
        self.messages = self.images = self.poses = self.left_out = 0

    def add_static(self, session: Session, run: str) -> None:
        """Write the transforms that do not change: cameras with a pose, and the floor below the robots."""
        rig = rig_in_force(session, [run])
        heights_m = {} if rig is None else rig.robot_heights_m()
        known_m = {
            robot: height_m
            for robot, height_m in heights_m.items()
            if height_m is not None and (not self._robots or robot in self._robots)
        }
        cameras = _cameras(session, run)
        if (known_m or cameras) and ros2_messages.is_stampable(session.start_ns):
            data = ros2.encode_static(known_m, session.start_ns, cameras)
            self._put("/tf_static", ros2.TF, session.start_ns, session.start_ns, data, is_latched=True)

    def add(self, message: Message) -> None:
        """Write what a message of the log becomes in the bag."""
        if message.topic in self._tracks:
            self._add_tracks(message)
        elif isinstance(message.payload, CameraCalibration):
            self._lenses[str(message.camera)] = message.payload
            if not self._has_images:
                self._add_lens(message, message.payload.timestamp)
        else:
            self._add_image(message)

    def close(self) -> None:
        # An empty text tells readers that the metadata of topics has the form of version 8.
        self._writer.add_metadata("rosbag2", {"serialized_metadata": ""})
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _add_image(self, message: Message) -> None:
        camera, time_ns = str(message.camera), message.payload.timestamp
        if not ros2_messages.is_stampable(time_ns):
            raise IpsysError(f"{message.topic}: a stamp of ROS 2 ends in 2038, but an image is later")
        ros_type, data = ros2_messages.encode_image(camera, message.payload)
        suffix = "/compressed" if "Compressed" in ros_type else ""
        self._put(f"/{camera}/image_raw{suffix}", ros_type, message.log_time_ns, time_ns, data)
        self.images += 1
        if camera in self._lenses:
            self._add_lens(message, time_ns)

    def _add_lens(self, message: Message, time_ns: int) -> None:
        camera = str(message.camera)
        data = ros2_messages.encode_camera_info(camera, self._lenses[camera], time_ns)
        self._put(f"/{camera}/camera_info", ros2_messages.CAMERA_INFO, message.log_time_ns, time_ns, data)

    def _add_tracks(self, message: Message) -> None:
        assert isinstance(message.payload, Tracks)
        self._now_ns = message.payload.timestamp
        self.known.update(track.robot for track in message.payload.tracks)
        poses = list(self._poses.read(message))
        sent = ros2.sendable(poses)
        self.poses += len(sent)
        self.left_out += len(poses) - len(sent)
        log_ns, time_ns = message.log_time_ns, message.payload.timestamp
        for topic, ros_type, data in ros2.encode_poses(sent):
            self._put(topic, ros_type, log_ns, time_ns, data)

    def _put(
        self, topic: str, ros_type: str, log_ns: int, time_ns: int, data: bytes, is_latched: bool = False
    ) -> None:
        if ros_type not in self._schemas:
            text = ros2_messages.text_of(ros_type).encode()
            self._schemas[ros_type] = self._writer.register_schema(ros_type, "ros2msg", text)
        if topic not in self._channels:
            metadata = {
                "offered_qos_profiles": _LATCHED if is_latched else "",
                "topic_type_hash": ros2_messages.type_hash(ros_type),
            }
            schema = self._schemas[ros_type]
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema, metadata)
        self._writer.add_message(self._channels[topic], log_ns, data, time_ns)
        self.messages += 1


def _cameras(session: Session, run: str) -> list[PosedCamera]:
    """Return the cameras whose pose the model of a run gives."""
    models = session.payloads(session.topics(MODEL, run)) if session.topics(MODEL, run) else []
    if not models:
        return []
    lenses = {camera: session.payloads([topic])[-1] for camera, topic in session.calibrations.items()}
    return list(read_floor_cameras(models[-1], lenses).values())
