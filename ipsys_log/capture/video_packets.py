"""Packets of a video container, converted so that each packet can be one message of a log."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING

import simplejpeg

from ipsys_log.capture.frames import Frame, SourceError
from ipsys_log.extras import check_installed
from ipsys_log.vision.decode import MAX_PIXELS

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.stream import VideoStream

# FFmpeg's name of a codec, and the name in the log.
_FORMATS = {"mjpeg": "jpeg", "h264": "h264", "hevc": "h265"}
# The head of a unit of Annex B: the start code, and the byte that holds its type.
_UNIT = re.compile(rb"\x00\x00\x01(.)", re.DOTALL)
# Containers of a single image, as from the snapshot address of a camera.
_SINGLE = ("image2", "jpeg_pipe", "png_pipe")


def find_video(container: InputContainer, label: str) -> VideoStream:
    """Return the video stream of a container.

    Parameters
    ----------
    container : container that PyAV opened.
    label : first words of the error text.

    Raises
    ------
    SourceError
        The container has no video, or only a single image.
    """
    if not container.streams.video:
        raise SourceError(f"{label}: is not video; give the address of the camera's stream")
    stream = container.streams.video[0]
    if container.format.name in _SINGLE:
        raise SourceError(f"{label}: is a single image; give the address of the camera's stream")
    return stream


def name_format(stream: VideoStream) -> str | None:
    """Return the format of a stream: ``jpeg``, ``h264`` or ``h265``; None if a log cannot hold its codec."""
    return _FORMATS.get(stream.codec_context.name)


def pass_through(
    packets: Iterable[Packet[VideoStream]], stream: VideoStream
) -> Iterator[Packet[VideoStream]]:
    """Yield the packets of a stream from the first keyframe on; H.264 and H.265 as Annex B.

    The parameter sets come before each keyframe, so that a reader can begin at any keyframe.

    Parameters
    ----------
    packets : packets from the container.
    stream : stream of the packets.
    """
    from av.bitstream import BitStreamFilterContext

    name = stream.codec_context.name
    if name == "mjpeg":
        # The last packet from PyAV is empty.
        yield from (packet for packet in packets if packet.size)
        return
    packed = (stream.codec_context.extradata or b"")[:1] == b"\x01"  # avcC and hvcC; Annex B begins with 0
    unpack = BitStreamFilterContext(f"{name}_mp4toannexb", stream) if packed else None
    repeat = BitStreamFilterContext("dump_extra=freq=keyframe", stream)
    begun = False
    for packet in packets:
        begun = begun or packet.is_keyframe
        if not begun or not packet.size:
            continue
        if unpack:
            yield from unpack.filter(packet)
        elif packet.is_keyframe and not _has_parameters(memoryview(packet), name == "hevc"):
            yield from repeat.filter(packet)
        else:
            yield packet


def find_size(frame: Frame) -> tuple[int, int] | None:
    """Return width and height of a frame, in px; None if the frame does not hold them.

    In a video, only keyframes hold them.
    """
    if frame.format == "jpeg":
        with suppress(ValueError, KeyError):  # a damaged frame gives no size
            height, width, *_ = simplejpeg.decode_jpeg_header(frame.data, strict=False)
            return width, height
    return _find_video_size(frame) if frame.format in ("h264", "h265") else None


def _find_video_size(frame: Frame) -> tuple[int, int] | None:
    check_installed(f"{frame.format} video needs", "av")
    import av

    codec = next(codec for codec, name in _FORMATS.items() if name == frame.format)
    decoder = av.VideoCodecContext.create(codec, "r")
    assert isinstance(decoder, av.VideoCodecContext)
    decoder.thread_count = 1
    decoder.options = {"max_pixels": str(MAX_PIXELS)}
    with suppress(av.error.FFmpegError):
        decoder.decode(av.Packet(frame.data))
    return (decoder.width, decoder.height) if decoder.width else None


def is_decodable_start(frame: Frame) -> bool:
    """Return whether a frame from :func:`pass_through` can be decoded without earlier frames."""
    return frame.format not in ("h264", "h265") or _has_parameters(frame.data, frame.format == "h265")


def _has_parameters(data: bytes | memoryview, is_h265: bool) -> bool:
    """Return whether a frame in Annex B (H.265 if ``is_h265``) has the parameter sets before its image."""
    for match in _UNIT.finditer(data):
        kind = match[1][0] >> 1 & 0x3F if is_h265 else match[1][0] & 0x1F
        if kind == (33 if is_h265 else 7):  # the sequence parameter set
            return True
        if kind < 32 if is_h265 else kind <= 5:  # a slice of the image
            return False
    return False
