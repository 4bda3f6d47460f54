"""Bags of ROS 1 and ROS 2: images and intrinsics of their cameras as messages, within limits of memory.

The library decompresses whole chunks, files and messages, without a limit. The limits here are those of logs.
"""

import bz2
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import lz4.frame
import zstandard
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError, LogError
from ipsys_log.log.byte_source import ReadLimits, chunk_excess
from ipsys_log.log.chunks import unpack
from ipsys_log.log.contents import parse_foreign_camera
from ipsys_log.log.reader import LogReader
from ipsys_log.log.records import parse_chunk_head
from ipsys_log.log.ros2 import ROS2_PAYLOADS, convert_ros, read_ros2
from ipsys_log.messages import (
    RIG_TOPIC,
    CameraCalibration,
    CompressedImage,
    Message,
    RawImage,
    Rig,
    calibration_topic,
    image_topic,
)
from ipsys_log.units import format_bytes
from ipsys_log.vision.decode import RAW_ENCODINGS
from ipsys_log.vision.lenses import check_calibration, same_intrinsics

_STEP = "bag"
BagReader = Reader1 | Reader2
_IMAGES = (CompressedImage, RawImage)
# These topics hold depths in a format of their own, though their type is that of images.
_DEPTHS = "/compressedDepth"
_HEADS = {b"\xff\xd8": "jpeg", b"\x89P": "png", b"RI": "webp"}


class BagCameras(NamedTuple):
    """The topics of a bag: that of the images by camera, and by camera that of the intrinsics."""

    images: dict[str, str]
    lenses: dict[str, str]


def find_bag_cameras(path: Path, named: Mapping[str, str]) -> BagCameras:
    """Return the cameras of a bag: a ``.bag`` of ROS 1, or a folder or a ``.db3`` of ROS 2.

    Parameters
    ----------
    named : topic of the images by camera; empty: all cameras, named after their topics. Compressed images
        precede raw ones.

    Raises
    ------
    IpsysError
        The file is not a bag or has no images; a topic does not exist; two cameras have one name.
    """
    with open_bag(path) as reader:
        types = {one.topic: ROS2_PAYLOADS.get(one.msgtype) for one in reader.connections}
    images = [topic for topic, kind in types.items() if kind in _IMAGES and not topic.endswith(_DEPTHS)]
    for camera, topic in named.items():
        if topic not in images:
            known = ", ".join(sorted(images)) or "none"
            raise IpsysError(f"{path}: topic {topic} of camera {camera} has no images (topics: {known})")
    chosen = dict(sorted((named or _name_cameras(path, images, types)).items()))
    infos = {parse_foreign_camera(topic): topic for topic, kind in types.items() if kind is CameraCalibration}
    lenses = {camera: infos.get(parse_foreign_camera(topic)) for camera, topic in chosen.items()}
    return BagCameras(chosen, {camera: topic for camera, topic in lenses.items() if topic is not None})


def _name_cameras(path: Path, images: list[str], types: Mapping[str, type | None]) -> dict[str, str]:
    cameras: dict[str, str] = {}
    for kind in reversed(_IMAGES):
        topic_of: dict[str, str] = {}
        for topic in sorted(topic for topic in images if types[topic] is kind):
            other = topic_of.setdefault(parse_foreign_camera(topic), topic)
            if other != topic:
                raise IpsysError(
                    f"{path}: {other} and {topic} have the same camera name; name them with "
                    f"--camera NAME={topic}"
                )
        cameras |= topic_of
    if not cameras:
        raise IpsysError(f"{path}: has no topics with images; for AprilTag detections, add --as detections")
    return cameras


def read_bag(
    path: Path,
    cameras: BagCameras,
    rig: Rig | None = None,
    lenses: Mapping[str, CameraCalibration] | None = None,
    progress: Progress = lambda step, done, total: None,
) -> Iterator[Message]:
    """Yield the images and intrinsics of a bag in log order; the bytes of images stay as they are.

    The log time is the time of the bag. The publish time is the stamp of the header; without a stamp, the
    time of the bag. Intrinsics are repeated only when they change.

    Parameters
    ----------
    cameras : from :func:`find_bag_cameras`.
    rig : optional message before the images.
    lenses : intrinsics by camera that replace those of the bag.

    Raises
    ------
    IpsysError
        The bag is damaged; an image or its intrinsics have a format that is not read.
    """
    given = dict(lenses or {})
    camera_of = {topic: camera for camera, topic in cameras.images.items()}
    camera_of |= {topic: camera for camera, topic in cameras.lenses.items() if camera not in given}
    with open_bag(path) as reader:
        connections = [connection for connection in reader.connections if connection.topic in camera_of]
        total = sum(connection.msgcount for connection in connections)
        log_ns = max(int(reader.start_time) - len(given) - 2, 0)  # a simulated clock starts at 0
        if rig is not None:
            yield Message(RIG_TOPIC, log_ns, log_ns, rig)
        for camera, lens in sorted(given.items()):
            log_ns += 1
            yield Message(calibration_topic(camera), log_ns, log_ns, lens, camera)
        known: dict[str, CameraCalibration] = {}
        rows = _rows(path, reader, connections)
        for done, (topic, time_ns, payload) in enumerate(rows):
            progress(_STEP, done, total)
            camera = camera_of[topic]
            if isinstance(payload, CameraCalibration):
                if not _is_new(payload, known.get(camera)):
                    continue
                known[camera] = check_calibration(payload, f"{path}: {topic}")
            # Messages of the same instant get log times 1 ns apart.
            log_ns = max(time_ns, log_ns + 1)
            yield _message(camera, log_ns, payload)
        progress(_STEP, total, total)


def _rows(
    path: Path, reader: BagReader, connections: list[Connection]
) -> Iterator[tuple[str, int, CompressedImage | RawImage | CameraCalibration]]:
    """Yield topic, time and payload of the messages of some connections."""
    decode = {connection.id: _decoder(path, reader, connection) for connection in connections}
    for connection, time_ns, data in raw_messages(path, reader, connections):
        try:
            payload = decode[connection.id](data)
        except LogError as error:
            raise IpsysError(f"{path}: {connection.topic} at {time_ns} ns: {error}") from error
        _check_image(payload, f"{path}: {connection.topic}")
        yield connection.topic, time_ns, payload


def raw_messages(
    path: Path, reader: BagReader, connections: Sequence[Connection]
) -> Iterator[tuple[Connection, int, bytes]]:
    """Yield connection, time of the bag and bytes of the messages of some connections."""
    is_packed = bound_reader(path, reader)
    messages = reader.messages(connections) if connections else iter(())
    while True:
        with faults(path):
            row = next(messages, None)
            if row is None:
                return
            connection, time_ns, data = row
            data = unpack_message(path, data) if is_packed else bytes(data)
        yield connection, time_ns, data


def _is_new(lens: CameraCalibration, known: CameraCalibration | None) -> bool:
    """Return whether intrinsics are new; without a calibration, ROS sends a focal length of 0."""
    return lens.K[0, 0] != 0 and (known is None or not same_intrinsics(lens, known))


def _message(camera: str, log_ns: int, payload: CompressedImage | RawImage | CameraCalibration) -> Message:
    time_ns = payload.timestamp or log_ns
    named = replace(payload, timestamp=time_ns, frame_id=camera)
    topic = calibration_topic(camera) if isinstance(payload, CameraCalibration) else image_topic(camera)
    return Message(topic, log_ns, time_ns, named, camera)


def _check_image(payload: object, where: str) -> None:
    if isinstance(payload, RawImage) and payload.encoding not in RAW_ENCODINGS:
        raise IpsysError(
            f"{where}: pixel encoding {payload.encoding!r} is not read (only {', '.join(RAW_ENCODINGS)}); "
            "leave the topic out with --camera NAME=TOPIC of the others"
        )
    if isinstance(payload, CompressedImage) and bytes(payload.data[:2]) not in _HEADS:
        raise IpsysError(
            f"{where}: image format {payload.format!r} is not read (only JPEG, PNG and WebP); leave the "
            "topic out with --camera NAME=TOPIC of the others"
        )


@contextmanager
def open_bag(path: Path) -> Iterator[BagReader]:
    if not path.exists():
        raise IpsysError(f"{path}: does not exist; give a bag of ROS 1 (.bag), or a folder of ROS 2")
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise IpsysError(
            f"{path}: is not a bag of ROS 2: it has no metadata.yaml; run: ros2 bag reindex {path}"
        )
    with faults(path):
        if is_ros2 := path.suffix != ".bag":
            check_files(path)
        reader = Reader2(path) if is_ros2 else Reader1(path)
        reader.open()
    try:
        yield reader
    finally:
        with faults(path):
            reader.close()


@contextmanager
def faults(path: Path) -> Iterator[None]:
    """Give the errors of the readers of rosbags one line. The block has only calls of these."""
    try:
        yield
    except IpsysError:
        raise
    except OSError as error:
        raise IpsysError(f"{path}: cannot be read: {error.strerror or error}") from error
    # The readers and their libraries raise about twenty types of errors, without a common class.
    except Exception as error:
        raise IpsysError(
            f"{path}: is not a readable bag ({type(error).__name__}: {' '.join(str(error).split())}); "
            "repair it with the tools of ROS"
        ) from error


def _decoder(path: Path, reader: BagReader, connection: Connection) -> Callable[[bytes], Any]:
    """Return the function that decodes the messages of a connection, by the definitions of ROS itself."""
    name = connection.msgtype
    if isinstance(reader, Reader1):
        store = ros1_types(path, connection)
        return lambda data: convert_ros(name, _read_ros1(path, store, name, data))
    # Old bags have no definitions; those of their time are the same.
    text = message_types(Stores.ROS2_JAZZY).generate_msgdef(name, ros_version=2)[0]
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        text = connection.msgdef.data
    return lambda data: read_ros2(name, data, text.encode())


def ros1_types(path: Path, connection: Connection) -> Typestore:
    """Return the types of ROS 1; refuse a bag with another definition of the type of a connection."""
    store, name = message_types(Stores.ROS1_NOETIC), connection.msgtype
    if connection.digest != store.generate_msgdef(name)[1]:
        raise IpsysError(f"{path}: {connection.topic}: its type {name} is not the one of ROS 1")
    return store


@cache
def message_types(version: Stores) -> Typestore:
    """Return the types of a version of ROS, with the transforms that the library lacks for ROS 1."""
    store = get_typestore(version)
    for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage") if version is Stores.ROS1_NOETIC else ():
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    return store


def _read_ros1(path: Path, store: Typestore, name: str, data: bytes) -> SimpleNamespace:
    """Return a message with the names of ROS 2: ROS 1 writes the matrices of intrinsics in capitals."""
    with faults(path):
        message = store.deserialize_ros1(data, name)
    return SimpleNamespace(**{name.lower(): getattr(message, name) for name in message.__dataclass_fields__})  # type: ignore[attr-defined]


_PIECE = 1 << 20  # bytes
_MCAP = ".mcap"


def bound_reader(path: Path, reader: Reader1 | Reader2) -> bool:
    """Bound the decompression of an open bag; return whether its messages are to be unpacked one by one."""
    if isinstance(reader, Reader1):
        limits = ReadLimits(path.stat().st_size)
        for position, chunk in reader.chunks.items():
            if chunk.decompressor in _STREAMS:
                unpacked = partial(_unpack, path, limits, position, _STREAMS[chunk.decompressor])
                reader.chunks[position] = chunk._replace(decompressor=unpacked)
        return False
    storage = reader.storage
    if storage.metadata.compression_mode != "message":
        return False
    storage.metadata = storage.metadata._replace(compression_mode=None)  # the library must not unpack them
    return True


def check_files(path: Path) -> None:
    """Check the size of the files of a ROS 2 bag after their decompression, before the library opens them.

    Raises
    ------
    IpsysError
        A file holds more than its limit, or is compressed twice.
    LogError
        A file of MCAP is damaged.
    """
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    for file in files:
        if file.suffix == ".zstd":
            if file.stem.endswith(_MCAP):
                raise IpsysError(
                    f"{file}: is compressed as a whole; unpack it with zstd -d, and remove the compression "
                    "from metadata.yaml"
                )
            _count(file)
        elif file.suffix == _MCAP:
            with LogReader(file) as log:
                for chunk in log.contents.chunks:
                    if chunk.compression:
                        unpack(log.view, chunk.offset, parse_chunk_head(log.view, chunk.offset)[1])


def unpack_message(path: Path, data: bytes) -> bytes:
    """Return a message of a bag whose messages are compressed one by one."""
    return _unpack(path, ReadLimits(path.stat().st_size + len(data)), 0, _zstd_pieces, data)


def _count(file: Path) -> None:
    """Refuse a file that unpacks to more than a log of its size may hold."""
    most, size = ReadLimits(file.stat().st_size).max_unpacked, 0
    with file.open("rb") as packed, zstandard.ZstdDecompressor().stream_reader(packed) as reader:
        while piece := reader.read(_PIECE):
            size += len(piece)
            if size > most:
                raise IpsysError(f"{file}: is refused: it unpacks to more than {format_bytes(most)}")


def _unpack(
    path: Path, limits: ReadLimits, position: int, pieces_of: Callable[[bytes], Iterator[bytes]], data: bytes
) -> bytes:
    pieces: list[bytes] = []
    size = 0
    for piece in pieces_of(data):
        pieces.append(piece)
        size += len(piece)
        if excess := chunk_excess(len(data), size) or limits.unpack(position, size):
            raise IpsysError(f"{path}: is refused: {excess.replace('claims to hold', 'holds')}")
    return b"".join(pieces)


def _stream_pieces(
    decompressor: Callable[[], bz2.BZ2Decompressor | lz4.frame.LZ4FrameDecompressor], data: bytes
) -> Iterator[bytes]:
    stream = decompressor()
    yield stream.decompress(data, _PIECE)
    while not stream.eof and not stream.needs_input:
        yield stream.decompress(b"", _PIECE)
    if not stream.eof:
        raise EOFError("a compressed chunk is cut off")


def _zstd_pieces(data: bytes) -> Iterator[bytes]:
    with zstandard.ZstdDecompressor().stream_reader(data) as reader:
        while piece := reader.read(_PIECE):
            yield piece


# The functions by which the library unpacks chunks of ROS 1, each with one that can stop.
_STREAMS = {
    bz2.decompress: partial(_stream_pieces, bz2.BZ2Decompressor),
    lz4.frame.decompress: partial(_stream_pieces, lz4.frame.LZ4FrameDecompressor),
}
