"""Messages of ROS 2 (CDR) as the payloads they correspond to: pictures and lenses."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from ipsys_log.errors import LogError
from ipsys_log.messages import CameraCalibration, CompressedImage, RawImage
from ipsys_log.units import NS_PER_S

__all__ = ["ROS2_PAYLOADS", "read_ros2"]

ROS2_PAYLOADS: dict[str, type] = {
    "sensor_msgs/msg/CameraInfo": CameraCalibration,
    "sensor_msgs/msg/CompressedImage": CompressedImage,
    "sensor_msgs/msg/Image": RawImage,
}
# Names of models of a lens, where they are others than Foxglove's.
_MODELS = {"equidistant": "kannala_brandt", "fisheye": "kannala_brandt"}


def read_ros2(name: str, data: bytes, definition: bytes) -> Any:
    """The payload in a message of ROS 2.

    Parameters
    ----------
    name : of the schema, such as ``sensor_msgs/msg/CompressedImage``.
    data : the message.
    definition : the schema as the log has it (``ros2msg``); empty where it has it in another form.

    Raises
    ------
    LogError
        Where the definition is none of that form, or the bytes are not a message of it.
    """
    if not definition:
        raise LogError(f"its schema {name!r} is not given as .msg; convert the log: ros2 bag convert")
    decoder = _decoder(name, definition)
    try:
        found = decoder(data)
        return _READ[name](found, _time_ns(found.header.stamp))
    # struct.error is one of those that the decoder, which checks nothing, ends with.
    except (struct.error, ValueError, TypeError, IndexError, AttributeError) as error:
        raise LogError(f"a message is not a valid {name}: {error}") from error


@cache
def _decoder(name: str, definition: bytes) -> Callable[[bytes], Any]:
    try:
        schema = Schema(id=1, name=name, encoding="ros2msg", data=definition)
        decoder = DecoderFactory().decoder_for("cdr", schema)
    # Its parser has exceptions of its own, which it does not export.
    except Exception as error:
        raise LogError(f"its schema {name!r} is not a .msg file of ROS 2: {error}") from error
    assert decoder is not None
    return decoder


def _time_ns(stamp: Any) -> int:
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def _read_compressed(found: Any, time_ns: int) -> CompressedImage:
    # ROS writes "bgr8; jpeg compressed bgr8" too; the bytes tell.
    heads = {b"\xff\xd8": "jpeg", b"\x89P": "png"}
    kind = heads.get(bytes(found.data[:2]), found.format)
    return CompressedImage(time_ns, found.header.frame_id, bytes(found.data), kind)


def _read_raw(found: Any, time_ns: int) -> RawImage:
    return RawImage(
        time_ns,
        found.header.frame_id,
        found.width,
        found.height,
        found.encoding,
        found.step,
        bytes(found.data),
    )


def _read_lens(found: Any, time_ns: int) -> CameraCalibration:
    return CameraCalibration(
        time_ns,
        found.header.frame_id,
        found.width,
        found.height,
        _MODELS.get(found.distortion_model, found.distortion_model),
        np.array(found.d, dtype=np.float64),
        np.array(found.k, dtype=np.float64).reshape(3, 3),
        np.array(found.r, dtype=np.float64).reshape(3, 3),
        np.array(found.p, dtype=np.float64).reshape(3, 4),
    )


_READ: dict[str, Callable[[Any, int], Any]] = {
    "sensor_msgs/msg/CameraInfo": _read_lens,
    "sensor_msgs/msg/CompressedImage": _read_compressed,
    "sensor_msgs/msg/Image": _read_raw,
}
