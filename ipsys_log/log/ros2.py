"""Conversion of ROS 2 messages (CDR) into payloads: images and camera intrinsics."""

import re
import struct
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import PartCounter
from ipsys_log.messages import CameraCalibration, CompressedImage, RawImage
from ipsys_log.units import NS_PER_S

ROS2_PAYLOADS: dict[str, type] = {
    "sensor_msgs/msg/CameraInfo": CameraCalibration,
    "sensor_msgs/msg/CompressedImage": CompressedImage,
    "sensor_msgs/msg/Image": RawImage,
}
# The definitions of ROS 2, the same from Foxy to Kilted.
_FIELDS = {
    "CameraInfo": "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n"
    "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n"
    "sensor_msgs/RegionOfInterest roi\n",
    "CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "Image": "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
    "uint32 step\nuint8[] data\n",
    "Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "RegionOfInterest": "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
}
_NESTED = {"Header": "std_msgs", "RegionOfInterest": "sensor_msgs"}
_PACKAGES = dict.fromkeys(_FIELDS, "sensor_msgs") | _NESTED
_LONGEST_DEFINITION = 64 << 10  # bytes
_BYTES_PER_NUMBER = 8
# Names of lens distortion models of Foxglove that ROS names differently.
ROS2_MODELS = {"kannala_brandt": "equidistant"}
_MODELS = {"fisheye": "kannala_brandt"} | {ros: foxglove for foxglove, ros in ROS2_MODELS.items()}


def read_ros2(name: str, data: bytes, definition: bytes, items: PartCounter | None = None) -> Any:
    """Decode the payload in a message of ROS 2.

    Parameters
    ----------
    name : the name of the schema, such as ``sensor_msgs/msg/CompressedImage``.
    data : the message.
    definition : the schema in the log (``ros2msg``); empty if it has another form.
    items : how many numbers outside of images may still be read.

    Raises
    ------
    BoundError
        The message has more numbers than `items` allows.
    LogError
        The definition is not a valid ``ros2msg``, or the bytes are not a valid message of the schema.
    """
    if not definition:
        raise LogError(f"its schema {name!r} is not given as .msg; convert the log: ros2 bag convert")
    _check_definition(name, definition)
    decoder = _decoder(name)
    if items is not None and ROS2_PAYLOADS[name] is CameraCalibration:
        items.take(len(data) // _BYTES_PER_NUMBER)
    try:
        return convert_ros(name, decoder(data))
    # The decoder checks nothing. Invalid bytes raise one of these errors, such as struct.error.
    except (struct.error, ValueError, TypeError, IndexError, AttributeError) as error:
        raise LogError(f"a message is not a valid {name}: {error}") from error


def convert_ros(name: str, message: Any) -> Any:
    """Return the payload of a decoded message with the field names of ROS 2."""
    return _READ[name](message, _time_ns(message.header.stamp))


@cache
def _decoder(name: str) -> Callable[[bytes], Any]:
    """Return the decoder of a message as ROS 2 defines it.

    It never uses the definition in a log: such a definition can require endless arrays of empty elements.
    """
    parts = [name.removeprefix("sensor_msgs/msg/"), *_NESTED]
    text = "\n".join(f"{'=' * 80}\nMSG: {_PACKAGES[part]}/{part}\n{_FIELDS[part]}" for part in parts)
    data = text.partition("\n")[2].partition("\n")[2].encode()
    decoder = DecoderFactory().decoder_for("cdr", Schema(id=1, name=name, encoding="ros2msg", data=data))
    assert decoder is not None
    return decoder


@cache
def _check_definition(name: str, definition: bytes) -> None:
    """Refuse a definition whose fields differ from the fields of ROS 2."""
    if len(definition) > _LONGEST_DEFINITION:
        raise LogError(f"its schema {name!r} is not a .msg file of ROS 2: it has {len(definition)} bytes")
    main, *others = re.split(r"^=+\s*^MSG:", definition.decode(errors="replace"), flags=re.MULTILINE)
    fields = {name.rsplit("/", maxsplit=1)[-1]: _fields(main)}
    for other in others:
        title, _, text = other.partition("\n")
        fields[title.strip().split("/")[-1]] = _fields(text)
    for part in (name.rsplit("/", maxsplit=1)[-1], *_NESTED):
        if fields.get(part, _fields(_FIELDS[part])) != _fields(_FIELDS[part]):
            raise LogError(
                f"its schema {name!r} is not a .msg file of ROS 2, or {part} differs in it; "
                "convert the log: ros2 bag convert"
            )


def _fields(text: str) -> list[tuple[str, str]]:
    """Return the types (without packages) and names of the fields of a message."""
    lines = (line.partition("#")[0].split() for line in text.splitlines())
    rows = [(line[0].split("/")[-1], line[-1]) for line in lines if line]
    return [("Time" if kind == "time" else kind, field) for kind, field in rows]


def _time_ns(stamp: Any) -> int:
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def _read_compressed(message: Any, time_ns: int) -> CompressedImage:
    # ROS also writes "bgr8; jpeg compressed bgr8" as format. The first bytes show the real format.
    heads = {b"\xff\xd8": "jpeg", b"\x89P": "png"}
    kind = heads.get(bytes(message.data[:2]), message.format)
    return CompressedImage(time_ns, message.header.frame_id, bytes(message.data), kind)


def _read_raw(message: Any, time_ns: int) -> RawImage:
    return RawImage(
        time_ns,
        message.header.frame_id,
        message.width,
        message.height,
        message.encoding,
        message.step,
        bytes(message.data),
    )


def _read_intrinsics(message: Any, time_ns: int) -> CameraCalibration:
    return CameraCalibration(
        time_ns,
        message.header.frame_id,
        message.width,
        message.height,
        _MODELS.get(message.distortion_model, message.distortion_model),
        np.array(message.d, dtype=np.float64),
        np.array(message.k, dtype=np.float64).reshape(3, 3),
        np.array(message.r, dtype=np.float64).reshape(3, 3),
        np.array(message.p, dtype=np.float64).reshape(3, 4),
    )


_READ: dict[str, Callable[[Any, int], Any]] = {
    "sensor_msgs/msg/CameraInfo": _read_intrinsics,
    "sensor_msgs/msg/CompressedImage": _read_compressed,
    "sensor_msgs/msg/Image": _read_raw,
}
