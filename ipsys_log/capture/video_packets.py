"""Packets of a video as they are in its container, made fit to stand in a log each by itself."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING

import simplejpeg

from ipsys_log.capture.frames import Frame, SourceError
from ipsys_log.images.decode import MOST_PIXELS

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.stream import VideoStream

__all__ = ["can_begin", "find_size", "find_video", "name_format", "pass_through"]

# FFmpeg's name of a codec, and that in the log.
_FORMATS = {"mjpeg": "jpeg", "h264": "h264", "hevc": "h265"}
# The head of a unit of Annex B: the start code, and the byte that holds its type.
_UNIT = re.compile(rb"\x00\x00\x01(.)", re.DOTALL)
# Containers of one picture, as a camera's snapshot address gives it.
_SINGLE = ("image2", "jpeg_pipe", "png_pipe")


def find_video(container: InputContainer, where: str) -> VideoStream:
    """The video in a container.

    Parameters
    ----------
    container : as PyAV opened it.
    where : what the error begins with.

    Raises
    ------
    SourceError
        Where there is none, or only a single picture.
    """
    if not container.streams.video:
        raise SourceError(f"{where}: is not video; give the address of the camera's picture stream")
    stream = container.streams.video[0]
    if container.format.name in _SINGLE:
        raise SourceError(f"{where}: is a single picture; give the address of the camera's stream")
    return stream


def name_format(stream: VideoStream) -> str | None:
    """``jpeg``, ``h264`` or ``h265``; None for a codec that no log holds."""
    return _FORMATS.get(stream.codec_context.name)


def pass_through(
    packets: Iterable[Packet[VideoStream]], stream: VideoStream
) -> Iterator[Packet[VideoStream]]:
    """Packets of a stream from the first keyframe on; H.264 and H.265 as Annex B.

    Each keyframe has the parameter sets before it, so that a reader can begin there.

    Parameters
    ----------
    packets : as the container gives them.
    stream : what they are of.
    """
    from av.bitstream import BitStreamFilterContext

    name = stream.codec_context.name
    if name == "mjpeg":
        # The last packet of PyAV's is an empty one.
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
    """Width and height of a frame, in px; None where it does not tell: of a video, a keyframe does."""
    if frame.format == "jpeg":
        with suppress(ValueError, KeyError):  # a damaged frame says nothing
            height, width, *_ = simplejpeg.decode_jpeg_header(frame.data, strict=False)
            return width, height
    return _find_video_size(frame) if frame.format in ("h264", "h265") else None


def _find_video_size(frame: Frame) -> tuple[int, int] | None:
    import av

    codec = next(codec for codec, name in _FORMATS.items() if name == frame.format)
    decoder = av.VideoCodecContext.create(codec, "r")
    assert isinstance(decoder, av.VideoCodecContext)
    decoder.thread_count = 1
    decoder.options = {"max_pixels": str(MOST_PIXELS)}
    with suppress(av.error.FFmpegError):
        decoder.decode(av.Packet(frame.data))
    return (decoder.width, decoder.height) if decoder.width else None


def can_begin(frame: Frame) -> bool:
    """Whether a frame, as :func:`pass_through` gives it, needs none before it."""
    return frame.format not in ("h264", "h265") or _has_parameters(frame.data, frame.format == "h265")


def _has_parameters(data: bytes | memoryview, wide: bool) -> bool:
    """Whether a frame in Annex B, of H.265 if ``wide``, has the parameter sets before its picture."""
    for match in _UNIT.finditer(data):
        kind = match[1][0] >> 1 & 0x3F if wide else match[1][0] & 0x1F
        if kind == (33 if wide else 7):  # the sequence's parameters
            return True
        if kind < 32 if wide else kind <= 5:  # a piece of the picture
            return False
    return False
