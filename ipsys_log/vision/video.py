"""Decoding of video frames, one message after the other, and detection of missing frames.

FFmpeg replaces a lost frame by the previous frame, without a warning.

References
----------
ITU-T H.264, 7.3.2.1 (sequence parameter set), 7.3.3 (slice header), 7.4.3 (frame_num).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

from ipsys_log.errors import FrameError
from ipsys_log.extras import check_installed
from ipsys_log.messages import CompressedImage, CompressedVideo, Grey, RawImage
from ipsys_log.vision.decode import MAX_PIXELS, decode_grey

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext
    from av.video.frame import VideoFrame

# The header of a unit of Annex B, with as many bytes of the unit as this module reads.
_UNIT_WITH_HEAD = re.compile(rb"\x00\x00\x01(.)(?=(.{0,96}))", re.DOTALL)
_PARAMETERS, _SLICE, _KEY_SLICE = 7, 1, 5
# Profiles whose parameter sets contain more fields about colour.
_HIGH = (44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244)


class _Counting(NamedTuple):
    """The numbering of frames: ``bits`` per number; ``planes`` is True if each colour has separate slices."""

    bits: int
    planes: bool


class FrameGapDetector:
    """A detector of missing frames of one camera. The caller calls it with the data of each frame."""

    def __init__(self) -> None:
        self._counting: _Counting | None = None
        self._last: int | None = None

    def __call__(self, data: bytes) -> bool:
        """Return whether a frame is missing directly before this one; False if that is unknown."""
        for match in _UNIT_WITH_HEAD.finditer(data):
            head = match[1][0]
            if head & 31 == _PARAMETERS:
                self._counting = _read_counting(_Bits(match[2]))
            elif head & 31 in (_SLICE, _KEY_SLICE):
                return self._counting is not None and self._follow(head, _Bits(match[2]), self._counting)
        return False

    def _follow(self, head: int, bits: _Bits, counting: _Counting) -> bool:
        bits.golomb(), bits.golomb(), bits.golomb()  # first macroblock, slice type, parameter set
        if counting.planes:
            bits.take(2)
        number, last = bits.take(counting.bits), self._last
        if head >> 5 & 3:  # a reference frame: other frames need it
            self._last = number
        # Two fields of a frame have the same number.
        return head & 31 == _SLICE and last is not None and (number - last) % (1 << counting.bits) > 1


class _Bits:
    """The bits of a unit, from its second byte on. After its end, all bits are zero."""

    def __init__(self, data: bytes) -> None:
        plain = data.replace(b"\x00\x00\x03", b"\x00\x00")
        self._text = "".join(f"{byte:08b}" for byte in plain)
        self._at = 0

    def take(self, count: int) -> int:
        self._at += count
        return int(self._text[self._at - count : self._at].ljust(count, "0") or "0", 2)

    def golomb(self) -> int:
        """Read an Exp-Golomb number of 2 n + 1 bits, of which the first n are zeros (9.1)."""
        zeros = 0
        while zeros < 32 and not self.take(1):
            zeros += 1
        return (1 << zeros) - 1 + self.take(zeros)


def _read_counting(bits: _Bits) -> _Counting | None:
    """Read the frame numbering from a sequence parameter set.

    Return None if gaps in the numbers are allowed, or if a scaling matrix precedes the fields of the numbers.
    """
    profile, planes = bits.take(8), False
    bits.take(16), bits.golomb()
    if profile in _HIGH:
        planes = bits.golomb() == 3 and bool(bits.take(1))
        bits.golomb(), bits.golomb(), bits.take(1)
        if bits.take(1):
            return None
    number_bits = bits.golomb() + 4
    order = bits.golomb()
    if order == 0:
        bits.golomb()
    elif order == 1:
        bits.take(1), bits.golomb(), bits.golomb()
        for _ in range(min(bits.golomb(), 255)):
            bits.golomb()
    bits.golomb()
    return None if bits.take(1) or number_bits > 16 else _Counting(number_bits, planes)


# Names of the formats in a log, and in FFmpeg.
VIDEO_FORMATS = {"h264": "h264", "h265": "hevc"}
# The header of a unit of Annex B: the start code, and the byte that contains its type.
_UNIT = re.compile(rb"\x00\x00\x01(.)", re.DOTALL)


class Video:
    """A decoder for the video of one camera, message by message.

    Each image needs the frames since the last keyframe. Earlier frames, also damaged ones, have no effect.

    Parameters
    ----------
    format : ``h264`` or ``h265``.
    with_colours : return images in colour (``bgr8``) instead of grey (``mono8``).

    Raises
    ------
    FrameError
        The format is another one.
    """

    def __init__(self, format: str, with_colours: bool = False) -> None:
        if format not in VIDEO_FORMATS:
            raise FrameError(f"video format {format!r} is not read (only {', '.join(VIDEO_FORMATS)})")
        self._decoder = _open(VIDEO_FORMATS[format])
        self._begun = self._keyed = False
        self._fault: str | None = None
        # The name of the pixels in FFmpeg, and in a raw image.
        self._pixels = ("bgr24", "bgr8") if with_colours else ("gray", "mono8")
        self._misses = FrameGapDetector() if format == "h264" else lambda data: False

    def __call__(self, frame: CompressedVideo) -> RawImage | None:
        """Return the image of a message; None before the first keyframe.

        Raises
        ------
        FrameError
            The data of this frame, or of an earlier frame since the last keyframe, is damaged; or the decoder
            returns the image only after later messages.
        """
        image = self._decode(frame)
        if image is None:
            return None
        plane = image.reformat(format=self._pixels[0]).planes[0]
        size = image.width, image.height
        return RawImage(
            frame.timestamp, frame.frame_id, *size, self._pixels[1], plane.line_size, bytes(plane)
        )

    def skip(self, frame: CompressedVideo) -> None:
        """Decode a message only because later messages need it; ignore damage."""
        with suppress(FrameError):
            self._decode(frame)

    def _decode(self, frame: CompressedVideo) -> VideoFrame | None:
        missing = self._misses(frame.data)
        if is_keyframe(frame):
            # After skipped frames, a keyframe of H.265 may repeat the picture order count of the last frame;
            # FFmpeg takes it for damage.
            self._decoder.flush_buffers()
            self._begun = self._keyed = True
            self._fault = None
        elif self._keyed and self._fault is not None:
            # A decoder fills missing areas with arbitrary data: two runs would give different results.
            raise FrameError(f"needs a frame before it that gave no picture ({self._fault})")
        try:
            if missing:
                raise FrameError("a frame before it is missing")
            return self._next(frame)
        except FrameError as error:
            self._fault = str(error)
            raise

    def _next(self, frame: CompressedVideo) -> VideoFrame | None:
        import av

        try:
            images = self._decoder.decode(av.Packet(frame.data))
        except av.error.FFmpegError as error:
            if not self._begun:
                return None
            raise FrameError(
                f"{len(frame.data)} bytes that are no {frame.format} ({error.strerror})"
            ) from error
        if not images and self._decoder.has_b_frames:
            raise FrameError("its picture needs a later one; turn off B-frames in the camera")
        if not images and not self._begun:
            return None
        if not images or images[-1].is_corrupt:
            raise FrameError(f"{len(frame.data)} bytes of {frame.format} that are no whole picture")
        self._begun = True
        return images[-1]


def is_keyframe(frame: CompressedVideo) -> bool:
    """Return whether a frame needs no earlier frame.

    Examples
    --------
    >>> is_keyframe(CompressedVideo(0, "red", bytes.fromhex("00000001 65 88"), "h264"))
    True
    """
    wide = frame.format == "h265"
    for match in _UNIT.finditer(frame.data):
        kind = match[1][0] >> 1 & 0x3F if wide else match[1][0] & 0x1F
        # Units with parts of images: types 1 to 5 in H.264, 0 to 31 in H.265. A reader of H.265 can begin at
        # types 16 to 23.
        if kind < 32 if wide else 1 <= kind <= 5:
            return 16 <= kind <= 23 if wide else kind == 5
    return False


def decode_keyframe(frame: CompressedVideo) -> RawImage:
    """Return the grey image of a keyframe."""
    image = Video(frame.format)(frame)
    if image is None:
        raise FrameError(f"{len(frame.data)} bytes of {frame.format} that are no keyframe")
    return image


def decode_alone(frame: CompressedImage | CompressedVideo | RawImage) -> Grey:
    """Return the grey levels of an image or a keyframe, without other frames."""
    return decode_grey(decode_keyframe(frame) if isinstance(frame, CompressedVideo) else frame)


def decode_last(backwards: Iterable[CompressedVideo]) -> RawImage | None:
    """Return the grey image of a frame with all necessary earlier frames; None without a keyframe before it.

    Parameters
    ----------
    backwards : this frame, the previous frame, and so on. They are read up to the first keyframe.
    """
    needed: list[CompressedVideo] = []
    for frame in backwards:
        needed.append(frame)
        if is_keyframe(frame):
            break
    last, *before = needed
    video = Video(last.format)
    for frame in reversed(before):
        video.skip(frame)
    return video(last)


def _open(codec: str) -> VideoCodecContext:
    check_installed(f"{codec} video needs", "av")
    import av

    decoder = av.VideoCodecContext.create(codec, "r")
    assert isinstance(decoder, av.VideoCodecContext)
    # The decoder must return an image for each packet immediately. Several threads would delay images.
    decoder.thread_count = 1
    decoder.flags |= av.codec.context.Flags.low_delay
    # An image with guessed areas counts as damaged.
    decoder.options = {"err_detect": "explode", "max_pixels": str(MAX_PIXELS)}
    return decoder
