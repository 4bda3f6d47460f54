"""Video files: their packets as messages of a log, their frames, and live cameras in real time."""

from __future__ import annotations

import heapq
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from itertools import repeat
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import simplejpeg

from ipsys_log.capture.frames import Clock, Frame, Say, SourceError, sleep_until
from ipsys_log.extras import check_installed
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    RIG_TOPIC,
    CameraCalibration,
    CompressedImage,
    CompressedVideo,
    Message,
    Rig,
    RigCamera,
    calibration_topic,
    image_topic,
)
from ipsys_log.units import NS_PER_S
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


_QUALITY = 95
_RATE_HZ = 30


class TimedFrame(NamedTuple):
    """A frame of a video, ``since_ns`` after the start of the video."""

    since_ns: int
    data: bytes
    format: str


@contextmanager
def open_video(path: Path, say: Say) -> Iterator[Iterator[TimedFrame]]:
    """Open a video file, and yield its frames; the packets are unchanged.

    A log cannot hold frames that need later frames (B-frames), or other codecs than MJPEG, H.264 and H.265.
    The images of such a file are decoded, and each is encoded as JPEG.

    Parameters
    ----------
    path : path of the file.
    say : called if the images are encoded again.
    """
    check_installed(f"{path}: a video needs", "av")
    import av

    with ExitStack() as stack:
        with _faults(path):
            container = stack.enter_context(av.open(str(path)))
        stream = find_video(container, str(path))
        name = name_format(stream)
        if name and not stream.codec_context.has_b_frames:
            frames = _passed(container, stream, name)
        else:
            reason = "frames that need later ones" if name else f"{stream.codec_context.name} video"
            say(f"{path}: has {reason}, which a log cannot hold; ipsys encodes its frames again, as JPEG")
            frames = _encoded(container, stream)
        yield _guarded(path, frames)


def _guarded(path: Path, frames: Iterator[TimedFrame]) -> Iterator[TimedFrame]:
    with _faults(path):
        yield from frames


@contextmanager
def _faults(path: Path) -> Iterator[None]:
    import av

    try:
        yield
    except (av.error.FFmpegError, OSError) as error:
        raise SourceError(f"{path}: cannot be read as a video: {error.strerror}") from error


def _passed(container: InputContainer, stream: VideoStream, name: str) -> Iterator[TimedFrame]:
    start: int | None = None
    for index, packet in enumerate(pass_through(container.demux(stream), stream)):
        if packet.pts is None or packet.time_base is None:
            # A stream without a container has no times, only a rate.
            yield TimedFrame(round(index * NS_PER_S / (stream.guessed_rate or _RATE_HZ)), bytes(packet), name)
            continue
        start = packet.pts if start is None else start
        yield TimedFrame(round((packet.pts - start) * packet.time_base * NS_PER_S), bytes(packet), name)


def _encoded(container: InputContainer, stream: VideoStream) -> Iterator[TimedFrame]:
    start: int | None = None
    stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
    for image in container.decode(stream):
        if image.pts is None or image.time_base is None:
            continue
        start = image.pts if start is None else start
        pixels = np.ascontiguousarray(image.to_ndarray(format="rgb24"))
        data = simplejpeg.encode_jpeg(pixels, quality=_QUALITY, colorsubsampling="422")
        yield TimedFrame(round((image.pts - start) * image.time_base * NS_PER_S), data, "jpeg")


def frame_payload(time_ns: int, camera: str, data: bytes, format: str) -> CompressedImage | CompressedVideo:
    """Return a frame as the payload of a message of a log.

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
    """Yield the frames of videos as messages, in log order; all videos begin at the same instant.

    Parameters
    ----------
    videos : video files, by camera.
    rig, lenses : optional messages before the frames; ``lenses`` are the intrinsics by camera.
    start_ns : time of the first frames.
    say : called if the images are encoded again.
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
            # Frames of the same instant get log times 1 ns apart.
            log_ns = max(time_ns, log_ns + 1)
            payload = frame_payload(time_ns, camera, frame.data, frame.format)
            yield Message(image_topic(camera), log_ns, time_ns, payload, camera)


@contextmanager
def open_playback(camera: RigCamera, clock: Clock, say: Say) -> Iterator[Iterator[Frame | None]]:
    """Open a file as a live camera; an :data:`~ipsys_log.capture.frames.Open`.

    Each frame arrives at its time since the first frame of the file. The cameras of a log begin together.

    Parameters
    ----------
    camera : its ``source`` is ``file:`` and a video or a log. From a log, the camera with the same name is
        played, or the camera in the source: ``file:session.mcap?red``.
    clock : gives the stamps, as if the frames were taken now.
    say : called if the images are encoded again.
    """
    path, camera_name = check_playback_source(camera)
    if path.suffix != ".mcap":
        with open_video(path, say) as frames:
            yield _play(frames, clock, clock.now_ns())
        return
    with Session([path]) as session:
        topic = session.images.get(camera_name or camera.name)
        if topic is None:
            names = ", ".join(f"{path}?{other}" for other in session.images) or "none"
            raise SourceError(f"camera {camera.name}: {path}: does not have this camera; it has {names}")
        yield _play(_recorded(session, topic), clock, _start_together(path, clock))


def check_playback_source(camera: RigCamera) -> tuple[Path, str]:
    """Check that the file of a source exists; return both (see :func:`split_source`)."""
    path, camera_name = split_source(camera.source or "")
    if not path.is_file():
        raise SourceError(f"camera {camera.name}: {path}: does not exist")
    return path, camera_name


def split_source(source: str) -> tuple[Path, str]:
    """Split a source into its file and the requested camera of this file (an empty string if none).

    Examples
    --------
    >>> path, camera = split_source("file:session.mcap?red")
    >>> path.name, camera
    ('session.mcap', 'red')
    """
    name, _, camera_name = source.partition(":")[2].partition("?")
    return Path(name), camera_name


# Cameras of a log that open within this time begin together.
_OPENING_NS = NS_PER_S
_starts_ns: dict[Path, int] = {}
_starting = Lock()


def _start_together(path: Path, clock: Clock) -> int:
    """Return the instant at which the playback of a log begins, the same for all of its cameras."""
    with _starting:
        now_ns = clock.now_ns()
        if not 0 <= now_ns - _starts_ns.get(path, now_ns + 1) < _OPENING_NS:
            _starts_ns[path] = now_ns
        return _starts_ns[path]


def _recorded(session: Session, topic: str) -> Iterator[TimedFrame]:
    firsts = [next(iter(session.messages([one])), None) for one in session.images.values()]
    start_ns = min((first.publish_time_ns for first in firsts if first is not None), default=0)
    for message in session.messages([topic]):
        if not isinstance(message.payload, (CompressedImage, CompressedVideo)):
            raise SourceError(
                f"{session}: {topic}: its images are not compressed; only compressed images can be played"
            )
        since_ns = message.publish_time_ns - start_ns
        yield TimedFrame(since_ns, message.payload.data, message.payload.format)


def _play(frames: Iterator[TimedFrame], clock: Clock, start_ns: int) -> Iterator[Frame | None]:
    for since_ns, data, format in frames:
        yield from sleep_until(start_ns + since_ns, clock)
        yield Frame(data, format, start_ns + since_ns)
