"""Video files as frames."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import simplejpeg

from ipsys_log.capture.frames import Say, SourceError
from ipsys_log.capture.video_packets import find_video, name_format, pass_through
from ipsys_log.images.picture_size import MOST_PIXELS
from ipsys_log.messages import (
    RIG_TOPIC,
    CameraCalibration,
    CompressedImage,
    CompressedVideo,
    Message,
    Rig,
    calibration_topic,
    image_topic,
)
from ipsys_log.units import NS_PER_S

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.stream import VideoStream

__all__ = ["Timed", "frame_payload", "open_video", "read_videos"]

_QUALITY = 95
_RATE_HZ = 30


class Timed(NamedTuple):
    """A frame of a video, ``since_ns`` after its start."""

    since_ns: int
    data: bytes
    format: str


@contextmanager
def open_video(path: Path, say: Say) -> Iterator[Iterator[Timed]]:
    """The frames of a video file, its packets as they are.

    No log holds frames that need later ones (B-frames), or other codecs than MJPEG, H.264 and H.265: of
    such a file the pictures are decoded, and each encoded as JPEG.

    Parameters
    ----------
    path : of the file.
    say : told where pictures are encoded anew.

    Raises
    ------
    SourceError
        Where it cannot be read, or is no video.
    """
    import av

    with ExitStack() as stack:
        with _faults(path):
            container = stack.enter_context(av.open(str(path)))
        stream = find_video(container, str(path))
        name = name_format(stream)
        if name and not stream.codec_context.has_b_frames:
            frames = _passed(container, stream, name)
        else:
            why = "frames that need later ones" if name else f"{stream.codec_context.name} video"
            say(f"{path}: has {why}, which no log holds; its pictures are encoded anew, as JPEG")
            frames = _encoded(container, stream)
        yield _guarded(path, frames)


def _guarded(path: Path, frames: Iterator[Timed]) -> Iterator[Timed]:
    with _faults(path):
        yield from frames


@contextmanager
def _faults(path: Path) -> Iterator[None]:
    import av

    try:
        yield
    except (av.error.FFmpegError, OSError) as error:
        raise SourceError(f"{path}: cannot be read as a video: {error.strerror}") from error


def _passed(container: InputContainer, stream: VideoStream, name: str) -> Iterator[Timed]:
    start: int | None = None
    for index, packet in enumerate(pass_through(container.demux(stream), stream)):
        if packet.pts is None or packet.time_base is None:
            # Streams without a container have no times, only a rate.
            yield Timed(round(index * NS_PER_S / (stream.guessed_rate or _RATE_HZ)), bytes(packet), name)
            continue
        start = packet.pts if start is None else start
        yield Timed(round((packet.pts - start) * packet.time_base * NS_PER_S), bytes(packet), name)


def _encoded(container: InputContainer, stream: VideoStream) -> Iterator[Timed]:
    start: int | None = None
    stream.codec_context.options = {"max_pixels": str(MOST_PIXELS)}
    for picture in container.decode(stream):
        if picture.pts is None or picture.time_base is None:
            continue
        start = picture.pts if start is None else start
        pixels = np.ascontiguousarray(picture.to_ndarray(format="rgb24"))
        data = simplejpeg.encode_jpeg(pixels, quality=_QUALITY, colorsubsampling="422")
        yield Timed(round((picture.pts - start) * picture.time_base * NS_PER_S), data, "jpeg")


def frame_payload(time_ns: int, camera: str, data: bytes, format: str) -> CompressedImage | CompressedVideo:
    """A frame as a log holds it.

    Examples
    --------
    >>> type(frame_payload(0, "red", b"...", "h264")).__name__
    'CompressedVideo'
    """
    kind = CompressedVideo if format in ("h264", "h265") else CompressedImage
    return kind(time_ns, camera, data, format)


def read_videos(
    videos: Mapping[str, Path],
    rig: Rig | None,
    lenses: Mapping[str, CameraCalibration],
    start_ns: int,
    say: Say,
) -> Iterator[Message]:
    """Videos as frames, in log order; all begin at one instant.

    Parameters
    ----------
    videos : by camera.
    rig, lenses : written first, where given; lenses by camera.
    start_ns : of their first frames.
    say : told where pictures are encoded anew.

    Raises
    ------
    SourceError
        Where a file cannot be read, or is no video.
    """
    log_ns = start_ns - len(lenses) - 1
    if rig is not None:
        yield Message(RIG_TOPIC, log_ns, log_ns, rig)
    for camera, lens in sorted(lenses.items()):
        log_ns += 1
        yield Message(calibration_topic(camera), log_ns, log_ns, lens, camera)
    with ExitStack() as stack:
        streams = [
            zip(repeat(camera), stack.enter_context(open_video(path, say)), strict=False)
            for camera, path in videos.items()
        ]
        for camera, frame in heapq.merge(*streams, key=lambda item: item[1].since_ns):
            time_ns = start_ns + frame.since_ns
            # What is of one instant follows by 1 ns.
            log_ns = max(time_ns, log_ns + 1)
            payload = frame_payload(time_ns, camera, frame.data, frame.format)
            yield Message(image_topic(camera), log_ns, time_ns, payload, camera)
