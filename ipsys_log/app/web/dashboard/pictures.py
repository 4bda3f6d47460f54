"""The newest picture of each camera: scaled down once for all pages, with its markers."""

from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import cv2
import numpy as np
import simplejpeg

from ipsys_log.errors import FrameError
from ipsys_log.messages import CompressedImage, CompressedVideo, Markers, Message, RawImage
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.decode import check_encoded
from ipsys_log.vision.video import decode_alone, is_keyframe

# At most five pictures of a camera per second.
EVERY_NS = NS_PER_S // 5
# A frame without results of the stages is shown after this time.
_UNMARKED_NS = 3 * NS_PER_S
# Frames that wait for their markers, and pictures that a page may still ask for.
_WAITING, _KEPT = 60, 10
_WIDTH_PX, _QUALITY = 480, 60


def shrink(frame: CompressedImage | CompressedVideo | RawImage) -> bytes:
    """Return a frame as a JPEG of about 480 px in width; a smaller frame keeps its size.

    Raises
    ------
    FrameError
        The frame is damaged, or it is not a keyframe of a video.
    """
    if isinstance(frame, CompressedImage) and frame.data[:2] == b"\xff\xd8":
        check_encoded(frame.data)
        try:
            # The decoder scales by eighths, which saves most of its time.
            image = simplejpeg.decode_jpeg(frame.data, "RGB", fastdct=True, min_width=_WIDTH_PX, strict=False)
        except ValueError as error:
            raise FrameError(str(error)) from error
        return bytes(simplejpeg.encode_jpeg(image, quality=_QUALITY, colorspace="RGB", fastdct=True))
    grey = decode_alone(frame)
    height, width = grey.shape
    if width > _WIDTH_PX:
        size = _WIDTH_PX, max(round(height * _WIDTH_PX / width), 1)
        grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return bytes(simplejpeg.encode_jpeg(grey[..., None], quality=_QUALITY, colorspace="GRAY"))


class _Tile:
    """The pictures of one camera."""

    def __init__(self) -> None:
        self.waiting: deque[Message] = deque(maxlen=_WAITING)
        self.offered: dict[int, Message] = {}
        self.markers: Markers | None = None
        self.last_ns: int | None = None


class Pictures:
    """The newest frames of the cameras, by default at most five per second of each.

    A frame is encoded when the first page asks for it. Without pages, nothing is encoded. A video shows
    its keyframes only.

    Parameters
    ----------
    cameras : names of the cameras.
    every_ns : returns the shortest time between two pictures of a camera, in log time.

    Attributes
    ----------
    version : increases with each new picture.
    last_ns : log time of the last frame, by camera.
    """

    def __init__(self, cameras: Iterable[str], every_ns: Callable[[], int] = lambda: EVERY_NS) -> None:
        self.version = 0
        self._every_ns = every_ns
        self.last_ns: dict[str, int] = {}
        self._tiles = {camera: _Tile() for camera in sorted(cameras)}

    def add(self, message: Message) -> None:
        """Handle a frame, or the markers in it."""
        tile = self._tiles.get(str(message.camera))
        if tile is None:
            return
        payload = message.payload
        if isinstance(payload, Markers):
            image = next((one for one in tile.waiting if one.log_time_ns == message.log_time_ns), None)
            if image is not None and _is_due(tile, image, self._every_ns()):
                self._offer(tile, image, payload)
            return
        self.last_ns[str(message.camera)] = message.log_time_ns
        if isinstance(payload, CompressedVideo) and not is_keyframe(payload):
            return
        tile.waiting.append(message)
        if tile.last_ns is None:
            tile.last_ns = message.log_time_ns  # the first markers may still come
        elif _is_due(tile, message, _UNMARKED_NS):
            self._offer(tile, message, None)

    def forget(self) -> None:
        """Forget all frames: a playback begins again."""
        self._tiles = {camera: _Tile() for camera in self._tiles}
        self.last_ns.clear()
        self.version += 1

    def rows(self) -> list[dict[str, Any]]:
        """Return the newest picture of each camera as JSON; ``picture`` is its address."""
        return [self._row(camera, tile) for camera, tile in self._tiles.items()]

    def frame(self, camera: str, time_ns: int) -> CompressedImage | CompressedVideo | RawImage | None:
        """Return an offered frame; None if it is too old, or never existed."""
        message = self._tiles[camera].offered.get(time_ns) if camera in self._tiles else None
        return None if message is None else message.payload

    def _offer(self, tile: _Tile, image: Message, markers: Markers | None) -> None:
        tile.offered[image.log_time_ns] = image
        while len(tile.offered) > _KEPT:
            del tile.offered[next(iter(tile.offered))]
        tile.markers, tile.last_ns = markers, image.log_time_ns
        self.version += 1

    def _row(self, camera: str, tile: _Tile) -> dict[str, Any]:
        row: dict[str, Any] = {"name": camera, "markers": []}
        if tile.offered:
            row["picture"] = f"picture/{camera}/{next(reversed(tile.offered))}"
        if tile.markers is not None:
            row["size_px"] = [tile.markers.width, tile.markers.height]
            row["markers"] = [
                {"id": marker.id, "corners_px": np.round(marker.corners_px, 1).tolist()}
                for marker in tile.markers.markers
            ]
        return row


def _is_due(tile: _Tile, image: Message, after_ns: int) -> bool:
    return tile.last_ns is None or image.log_time_ns - tile.last_ns >= after_ns
