"""Decoding of images to grey pixels, after a check of the stated size."""

import struct
import threading
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from ipsys_log.errors import FrameError
from ipsys_log.messages import CompressedImage, Grey, RawImage
from ipsys_log.vision.jpeg import cut_rows, decode_flawed, read_layout, remove_stray_bytes, whole_rows

# An embedded thumbnail may come before the size of a JPEG.
_FIRST_BYTES = 1 << 18
_PNG = b"\x89PNG\r\n\x1a\n"


def read_image_size(path: Path) -> tuple[int, int] | None:
    """Return width and height in px from the header of a JPEG or PNG file.

    Return None for another kind of file, or for an unreadable header.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_FIRST_BYTES)
    except OSError:
        return None
    if data.startswith(_PNG) and data[12:16] == b"IHDR" and len(data) >= 24:
        width, height = struct.unpack(">II", data[16:24])
        return int(width), int(height)
    if not data.startswith(b"\xff\xd8"):
        return None
    try:
        height, width, _, _ = simplejpeg.decode_jpeg_header(data, strict=False)
    except (ValueError, KeyError):  # KeyError: the header has no known colour space
        return None
    return int(width), int(height)


MAX_PIXELS = 1 << 27  # 134 million
# A JPEG has at least one bit for each block of 8 x 8 px.
_JPEG_PIXELS_PER_BYTE = 512
# SOF0 to SOF15, except the tables and the extension between them.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_SCAN = 0xDA


def check_encoded(data: bytes) -> None:
    """Check that the header of a JPEG or PNG does not state too many pixels.

    Raises
    ------
    FrameError
        The header states more than ``MAX_PIXELS``, or more than its bytes can encode.
    """
    if data[:2] == b"\xff\xd8":
        width, height = _jpeg_size(data)
        check_pixel_count(width, height, len(data))
    elif data[:8] == _PNG and len(data) >= 24:
        check_pixel_count(int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"))


def check_pixel_count(width: int, height: int, jpeg_bytes: int | None = None) -> None:
    """Check that a size in px is not too large, also for the number of bytes of a JPEG."""
    if width * height > MAX_PIXELS:
        raise FrameError(f"a picture of {width} x {height} px, more than {MAX_PIXELS} in all")
    if jpeg_bytes is not None and width * height > _JPEG_PIXELS_PER_BYTE * jpeg_bytes:
        raise FrameError(f"{jpeg_bytes} bytes are too few for a JPEG of {width} x {height} px")


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Return width and height in the first frame header; (0, 0) if there is none before the pixels."""
    offset = 2
    while offset + 9 <= len(data) and data[offset] == 0xFF and data[offset + 1] != _JPEG_SCAN:
        if data[offset + 1] == 0xFF:  # a fill byte
            offset += 1
            continue
        if data[offset + 1] in _JPEG_FRAMES:
            return int.from_bytes(data[offset + 7 : offset + 9], "big"), int.from_bytes(
                data[offset + 5 : offset + 7], "big"
            )
        offset += 2 + int.from_bytes(data[offset + 2 : offset + 4], "big")
    return 0, 0


# The channels of a raw image, and its conversions to grey and to BGR.
_RAW = {
    "mono8": (1, None, cv2.COLOR_GRAY2BGR),
    "8UC1": (1, None, cv2.COLOR_GRAY2BGR),
    "rgb8": (3, cv2.COLOR_RGB2GRAY, cv2.COLOR_RGB2BGR),
    "bgr8": (3, cv2.COLOR_BGR2GRAY, None),
    "8UC3": (3, cv2.COLOR_BGR2GRAY, None),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY, cv2.COLOR_RGBA2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY, cv2.COLOR_BGRA2BGR),
}
RAW_ENCODINGS = tuple(_RAW)


class _Memory:
    """The reused buffers of a thread for decoding: allocation of new memory takes longer than filling it."""

    def __init__(self) -> None:
        self.pixels = np.zeros((0, 0), dtype=np.uint8)
        self._bytes = bytearray()

    def reserve(self, size: int) -> bytearray:
        """Return the buffer for a JPEG, of at least ``size`` bytes.

        A larger buffer is a new one. The old one cannot be resized if another thread, such as a profiler,
        looks at the frames of this thread.
        """
        if len(self._bytes) < size:
            self._bytes = bytearray(size)
        return self._bytes


_THREAD = threading.local()


def decode_rows(
    frame: CompressedImage | RawImage, rows: Sequence[slice] | None = None
) -> tuple[Grey, list[slice]]:
    """Decode the grey image of a frame, or at least some rows of it.

    Parameters
    ----------
    frame : as recorded.
    rows : the rows to decode; None for all. With fewer rows, the check of a JPEG is less strict.

    Returns
    -------
    The image (height, width), valid until this thread decodes the next image, and its decoded rows. All other
    rows are black.
    """
    layout = read_layout(frame.data) if isinstance(frame, CompressedImage) else None
    if layout is None:
        grey = decode_grey(frame)
        return grey, [slice(0, len(grey))]
    check_pixel_count(layout.width, layout.height, len(frame.data))
    memory: _Memory = _THREAD.__dict__.setdefault("memory", _Memory())
    if memory.pixels.shape != (layout.height, layout.width):
        memory.pixels = np.zeros((layout.height, layout.width), dtype=np.uint8)
    grey = memory.pixels
    if rows is None:
        _decode_jpeg(frame.data, grey)
        return grey, [slice(0, layout.height)]
    shown = whole_rows(layout, rows)
    # The other rows must not show an earlier image, which may be from another camera.
    starts, stops = [part.start for part in shown], [part.stop for part in shown]
    for low, high in zip([0, *stops], [*starts, layout.height], strict=True):
        grey[low:high] = 0
    try:
        pieces = cut_rows(frame.data, layout, shown, memory.reserve(len(frame.data)))
        for piece, part in zip(pieces, shown, strict=True):
            # Without restart markers, the data after the last requested row looks like damage.
            _decode_jpeg(piece, grey[part], strict=layout.interval > 0)
    except FrameError:  # the whole image shows whether the camera always sends surplus bytes
        _decode_jpeg(frame.data, grey)
        return grey, [slice(0, layout.height)]
    return grey, shown


def decode_grey(frame: CompressedImage | RawImage) -> Grey:
    """Decode the grey image of a frame, (height, width).

    Raises
    ------
    FrameError
        The data is damaged. The decoding of a JPEG is strict: an incomplete image is an error.
    """
    if isinstance(frame, RawImage):
        return _raw_grey(frame)
    check_encoded(frame.data)
    if frame.data[:2] == b"\xff\xd8":
        return _decode_jpeg(frame.data)
    return _decode_other(frame, cv2.IMREAD_GRAYSCALE)


def _decode_other(frame: CompressedImage, mode: int) -> NDArray[np.uint8]:
    """Decode an image that is no JPEG."""
    try:
        decoded = cv2.imdecode(np.frombuffer(frame.data, np.uint8), mode)
    except cv2.error:  # OpenCV asserts on empty data
        decoded = None
    if decoded is None:
        raise FrameError(f"{len(frame.data)} bytes that are no picture ({frame.format or 'no format given'})")
    return np.asarray(decoded, dtype=np.uint8)


def frame_size(frame: CompressedImage | RawImage) -> tuple[int, int]:
    """Return width and height of a frame in px; only the header of a whole baseline JPEG is read.

    Raises
    ------
    FrameError
        The data is damaged. A damage after the header of a JPEG is not noticed.
    """
    layout = read_layout(frame.data) if isinstance(frame, CompressedImage) else None
    if layout is None:
        height, width = decode_grey(frame).shape
        return width, height
    check_pixel_count(layout.width, layout.height, len(frame.data))
    return layout.width, layout.height


def _decode_jpeg(
    data: bytes | bytearray | memoryview, pixels: Grey | None = None, strict: bool = True
) -> Grey:
    """Decode a JPEG, into ``pixels`` if it is given."""
    try:
        grey: Grey = simplejpeg.decode_jpeg(data, colorspace="GRAY", buffer=pixels, strict=strict)[..., 0]
    except ValueError as error:
        clean = remove_stray_bytes(bytes(data))
        check_encoded(clean)
        flawed = decode_flawed(clean)
        if flawed is None:
            raise FrameError(str(error)) from error
        if pixels is None:
            return flawed
        pixels[:] = flawed
        return pixels
    return grey


def levels_at(grey: Grey, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return grey levels at pixels x and y, contiguous and (..., n), by linear interpolation."""
    rows = (-1, x.shape[-1])
    levels = cv2.remap(
        grey, x.reshape(rows), y.reshape(rows), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(levels, dtype=np.float64).reshape(x.shape)


def _raw_grey(frame: RawImage) -> Grey:
    pixels = _raw_pixels(frame)
    conversion = _RAW[frame.encoding][1]
    if conversion is None:
        return np.ascontiguousarray(pixels[..., 0])
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), conversion), dtype=np.uint8)


def _raw_pixels(frame: RawImage) -> NDArray[np.uint8]:
    """Return the pixels (height, width, channels) of a raw image."""
    if frame.encoding not in _RAW:
        known = ", ".join(_RAW)
        raise FrameError(f"pixel encoding {frame.encoding!r} is not read (only {known})")
    channels = _RAW[frame.encoding][0]
    rows = np.frombuffer(frame.data, np.uint8)
    step = frame.step or frame.width * channels  # some writers omit the step
    too_few = step < frame.width * channels or rows.size < step * frame.height
    if too_few or min(frame.width, frame.height) < 1:
        raise FrameError(f"{rows.size} bytes are too few for {frame.width} x {frame.height}")
    rows = rows[: step * frame.height].reshape(frame.height, step)
    return rows[:, : frame.width * channels].reshape(frame.height, frame.width, channels)


def decode_colour(frame: CompressedImage | RawImage, least_px: tuple[int, int] = (0, 0)) -> NDArray[np.uint8]:
    """Decode the colours of a frame for a drawing, (height, width, 3), in the order BGR.

    ``least_px`` is a size that suffices; a JPEG may then be decoded at a part of its size.
    """
    if isinstance(frame, RawImage):
        pixels, conversion = np.ascontiguousarray(_raw_pixels(frame)), _RAW[frame.encoding][2]
        return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)
    check_encoded(frame.data)
    if frame.data[:2] == b"\xff\xd8":
        width, height = least_px
        try:
            return np.asarray(
                simplejpeg.decode_jpeg(
                    frame.data, colorspace="BGR", min_width=width, min_height=height, strict=False
                )
            )
        except ValueError as error:
            raise FrameError(str(error)) from error
    return np.asarray(_decode_other(frame, cv2.IMREAD_COLOR), dtype=np.uint8)
