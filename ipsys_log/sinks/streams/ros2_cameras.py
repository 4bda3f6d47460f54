"""Images and camera intrinsics as serialised messages of ROS 2."""

from __future__ import annotations

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.log.ros2 import ROS2_MODELS
from ipsys_log.messages import CameraCalibration, CompressedImage, CompressedVideo, RawImage
from ipsys_log.sinks.streams.ros2_messages import optical_frame
from ipsys_log.sinks.streams.ros2_types import encode, make, make_header

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_COMPRESSED, _RAW = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"


def encode_image(camera: str, image: CompressedImage | RawImage | CompressedVideo) -> tuple[str, bytes]:
    """Return the type and the bytes of the message of an image; its data stay as they are.

    Raises
    ------
    IpsysError
        The image is a frame of a video: ``sensor_msgs`` has no message for it.
    """
    if isinstance(image, CompressedVideo):
        raise IpsysError(
            f"camera {camera}: its images are {image.format} video, for which ROS 2 has no standard message; "
            "leave the images out (--without-images)"
        )
    header, data = make_header(image.timestamp, optical_frame(camera)), np.frombuffer(image.data, np.uint8)
    if isinstance(image, CompressedImage):
        return _COMPRESSED, encode(
            make("sensor_msgs/CompressedImage", header, image.format, data), _COMPRESSED
        )
    size = image.height, image.width
    message = make("sensor_msgs/Image", header, *size, image.encoding, 0, image.step, data)
    return _RAW, encode(message, _RAW)


def encode_camera_info(camera: str, lens: CameraCalibration, time_ns: int) -> bytes:
    """Return the message CameraInfo of camera intrinsics, with the stamp of an image."""
    rectification = np.eye(3) if lens.R is None else lens.R
    projection = np.column_stack([lens.K, np.zeros(3)]) if lens.P is None else lens.P
    message = make(
        "sensor_msgs/CameraInfo",
        make_header(time_ns, optical_frame(camera)),
        lens.height,
        lens.width,
        ROS2_MODELS.get(lens.distortion_model, lens.distortion_model),
        np.asarray(lens.D, dtype=np.float64).ravel(),
        *(matrix.astype(np.float64).ravel() for matrix in (lens.K, rectification, projection)),
        0,
        0,
        make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False),
    )
    return encode(message, CAMERA_INFO)
