"""Pictures of a video, one message after the other."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ipsys_log.errors import FrameError
from ipsys_log.messages import CompressedVideo, RawImage

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

__all__ = ["VIDEO_FORMATS", "Video"]

# As the log names them, and FFmpeg.
VIDEO_FORMATS = {"h264": "h264", "h265": "hevc"}


class Video:
    """Decodes the video of one camera, message by message: each picture needs those before it.

    Parameters
    ----------
    format : ``h264`` or ``h265``.

    Raises
    ------
    FrameError
        For any other format.
    """

    def __init__(self, format: str) -> None:
        if format not in VIDEO_FORMATS:
            raise FrameError(f"video format {format!r} is not read (only {', '.join(VIDEO_FORMATS)})")
        self._decoder = _open(VIDEO_FORMATS[format])
        self._begun = False

    def __call__(self, frame: CompressedVideo) -> RawImage | None:
        """The picture of a message, in grey; None before the first keyframe.

        Raises
        ------
        FrameError
            Where the data is damaged, or the picture comes only with later messages.
        """
        import av

        try:
            pictures = self._decoder.decode(av.Packet(frame.data))
        except av.error.FFmpegError as error:
            if not self._begun:
                return None
            raise FrameError(
                f"{len(frame.data)} bytes that are no {frame.format} ({error.strerror})"
            ) from error
        if not pictures and self._decoder.has_b_frames:
            raise FrameError("its picture needs a later one; turn off B-frames in the camera")
        if not pictures and not self._begun:
            return None
        if not pictures or pictures[-1].is_corrupt:
            raise FrameError(f"{len(frame.data)} bytes of {frame.format} that are no whole picture")
        self._begun = True
        plane = pictures[-1].reformat(format="gray").planes[0]
        size = pictures[-1].width, pictures[-1].height
        return RawImage(frame.timestamp, frame.frame_id, *size, "mono8", plane.line_size, bytes(plane))


def _open(codec: str) -> VideoCodecContext:
    import av

    decoder = av.VideoCodecContext.create(codec, "r")
    assert isinstance(decoder, av.VideoCodecContext)
    # A picture for each packet, at once: several threads would hold some back.
    decoder.thread_count = 1
    decoder.flags |= av.codec.context.Flags.low_delay
    # A picture with guessed pieces is none.
    decoder.options = {"err_detect": "explode"}
    return decoder
