"""Frames as Rerun takes them: encoded ones as they are, raw ones without the padding of their rows."""

from __future__ import annotations

import numpy as np
import rerun as rr

from ipsys_log.messages import CompressedImage, CompressedVideo, RawImage

__all__ = ["rerun_image"]

# Colour model and channels by pixel encoding, all with 8 bits.
_RAW = {
    "mono8": (rr.ColorModel.L, 1),
    "8UC1": (rr.ColorModel.L, 1),
    "rgb8": (rr.ColorModel.RGB, 3),
    "bgr8": (rr.ColorModel.BGR, 3),
    "8UC3": (rr.ColorModel.BGR, 3),
    "rgba8": (rr.ColorModel.RGBA, 4),
    "bgra8": (rr.ColorModel.BGRA, 4),
}
_CODECS = {"h264": rr.VideoCodec.H264, "h265": rr.VideoCodec.H265}


def rerun_image(
    frame: CompressedImage | CompressedVideo | RawImage,
) -> rr.EncodedImage | rr.VideoStream | rr.Image:
    """A frame for Rerun; JPEG, PNG and video are neither decoded nor copied into another format.

    Raises
    ------
    ValueError
        Where it is no picture that can be drawn, saying why.
    """
    if isinstance(frame, RawImage):
        return _raw_image(frame)
    if isinstance(frame, CompressedVideo):
        if frame.format not in _CODECS:
            raise ValueError(f"video format {frame.format!r} is not drawn (only {', '.join(_CODECS)})")
        return rr.VideoStream(_CODECS[frame.format], sample=frame.data)
    if frame.data[:3] == b"\xff\xd8\xff":
        return rr.EncodedImage(contents=frame.data, media_type="image/jpeg")
    if frame.data[:8] == b"\x89PNG\r\n\x1a\n":
        return rr.EncodedImage(contents=frame.data, media_type="image/png")
    raise ValueError(
        f"{len(frame.data)} bytes that are neither JPEG nor PNG ({frame.format or 'no format given'})"
    )


def _raw_image(frame: RawImage) -> rr.Image:
    if frame.encoding not in _RAW:
        raise ValueError(f"pixel encoding {frame.encoding!r} is not drawn (only {', '.join(_RAW)})")
    model, channels = _RAW[frame.encoding]
    used = frame.width * channels
    if min(frame.width, frame.height) < 1 or frame.step < used or len(frame.data) < frame.step * frame.height:
        raise ValueError(f"{len(frame.data)} bytes are too few for {frame.width} x {frame.height}")
    rows = np.frombuffer(frame.data, np.uint8, frame.step * frame.height).reshape(frame.height, frame.step)
    pixels = np.ascontiguousarray(rows[:, :used]).reshape(frame.height, frame.width, channels)
    return rr.Image(pixels[..., 0] if channels == 1 else pixels, color_model=model)
