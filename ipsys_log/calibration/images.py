"""Images of a board from logs, folders, image files and videos, for each camera."""

import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from ipsys_log.errors import FrameError, IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, CompressedVideo, Grey, RawImage
from ipsys_log.messages.rig_file import check_name
from ipsys_log.vision.decode import check_encoded, read_image_size
from ipsys_log.vision.video import Video

# Largest number of images to examine in a long recording, evenly spread.
MAX_EXAMINED_IMAGES = 400

_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".pgm", ".ppm")
_VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".mjpeg", ".mjpg")
_GREY_OF_RAW = {
    "mono8": (1, None), "8UC1": (1, None),
    "rgb8": (3, cv2.COLOR_RGB2GRAY), "bgr8": (3, cv2.COLOR_BGR2GRAY), "8UC3": (3, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY), "bgra8": (4, cv2.COLOR_BGRA2GRAY),
}  # fmt: skip


def _no_sizes() -> list[tuple[str, tuple[int, int]]]:
    return []


class ImageSource(NamedTuple):
    """The images of one camera.

    Attributes
    ----------
    camera, source : name of the camera, and the source of the images.
    total : approximate number of images; 0 if it is not known.
    read : returns each image with its name; None for an unreadable image.
    sizes : returns names and sizes in px, if they are known before decoding.
    requested : whether the user named this camera or its images, and not only a log with several cameras.
    """

    camera: str
    source: str
    total: int
    read: Callable[[], Iterator[tuple[str, Grey | None]]]
    sizes: Callable[[], list[tuple[str, tuple[int, int]]]] = _no_sizes
    requested: bool = True

    @property
    def examined_count(self) -> int:
        """The number of images to read; 0 if it is not known."""
        return -(-self.total // _stride(self.total))


def find_sources(paths: Sequence[Path], cameras: Sequence[str]) -> list[ImageSource]:
    """Return the images in logs (``.mcap``), folders, image files and videos, by camera.

    Parameters
    ----------
    paths : the sources that the user named. Several sources of one camera are read as one source.
    cameras : for a log, the cameras to read; for another source, the one name of its camera.

    Raises
    ------
    IpsysError
        A source cannot be read, a requested camera has no images, or a camera has no valid name.
    """
    sources = [images for path in paths for images in _sources_of(path, cameras)]
    by_camera: dict[str, list[ImageSource]] = {}
    for images in sources:
        by_camera.setdefault(images.camera, []).append(images)
    missing = [camera for camera in cameras if camera not in by_camera]
    if missing:
        known = ", ".join(by_camera)
        raise IpsysError(f"--camera {missing[0]}: this camera has no frames; the cameras are {known}")
    wanted = {c: parts for c, parts in by_camera.items() if not cameras or c in cameras}
    return [_joined(camera, parts) for camera, parts in wanted.items()]


def _joined(camera: str, parts: list[ImageSource]) -> ImageSource:
    if len(parts) == 1:
        return parts[0]
    source = f"{parts[0].source} and {len(parts) - 1} more"
    total = sum(part.total for part in parts)
    return ImageSource(
        camera,
        source,
        total,
        lambda: chain.from_iterable(part.read() for part in parts),
        lambda: [sized for part in parts for sized in part.sizes()],
        any(part.requested for part in parts),
    )


def _sources_of(path: Path, cameras: Sequence[str]) -> list[ImageSource]:
    if path.is_dir():
        return _folder(path, cameras)
    if not path.is_file():
        raise IpsysError(f"{path}: does not exist; give a log, folder, picture or video")
    if path.suffix.lower() == ".mcap":
        return _log(path, requested=bool(cameras))
    if path.suffix.lower() in _IMAGE_SUFFIXES:
        name = _camera_name(path.absolute().parent.name, path, cameras)
        return [_of_files(name, path, [path])]
    if path.suffix.lower() in _VIDEOS:
        return [_video(path, cameras)]
    image, video = _IMAGE_SUFFIXES[0], _VIDEOS[0]
    raise IpsysError(f"{path}: is not a log (.mcap), a picture ({image} ...) or a video ({video} ...)")


def _camera_name(text: str, path: Path, cameras: Sequence[str]) -> str:
    if len(cameras) > 1:
        raise IpsysError(f"{path}: is of one camera, but several are given; give one --camera")
    if cameras:
        return check_name(cameras[0], "--camera")
    name = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    return name if name[:1].isalpha() else f"camera_{name}".rstrip("_")


def _folder(folder: Path, cameras: Sequence[str]) -> list[ImageSource]:
    """Return the images in a folder as one camera, or without images, each sub-folder as one camera."""
    folder_files = _files(folder)
    if folder_files:
        name = _camera_name(folder.absolute().name, folder, cameras)
        return [_of_files(name, folder, folder_files)]
    subs = {sub: files for sub in sorted(folder.iterdir()) if sub.is_dir() and (files := _files(sub))}
    if not subs:
        raise IpsysError(f"{folder}: has no pictures ({', '.join(_IMAGE_SUFFIXES[:3])} ...)")
    return [_of_files(_camera_name(sub.name, sub, []), sub, files) for sub, files in subs.items()]


def _of_files(camera: str, source: Path, files: list[Path]) -> ImageSource:
    return ImageSource(
        camera, str(source), len(files), partial(_read_files, files), partial(_read_sizes, files)
    )


def _files(folder: Path) -> list[Path]:
    files = [path for path in folder.iterdir() if path.is_file() and path.suffix.lower() in _IMAGE_SUFFIXES]
    return sorted((path for path in files if not path.name.startswith(".")), key=_by_number)


def _by_number(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", path.name.lower())
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _read_files(files: Sequence[Path]) -> Iterator[tuple[str, Grey | None]]:
    for path in _spread(files):
        yield path.name, _decode(path.read_bytes())


def _read_sizes(files: Sequence[Path]) -> list[tuple[str, tuple[int, int]]]:
    sizes = [(path.name, read_image_size(path)) for path in _spread(files)]
    return [(name, size) for name, size in sizes if size is not None]


def _spread(files: Sequence[Path]) -> Sequence[Path]:
    return files[:: _stride(len(files))]


def _stride(total: int) -> int:
    return max(1, -(-total // MAX_EXAMINED_IMAGES))


def _decode(data: bytes) -> Grey | None:
    try:
        check_encoded(data)
        # Keep the orientation of the sensor: the lens does not turn with the orientation tag of an image.
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        # OpenCV refuses a JPEG without the end marker, which some cameras leave out.
        ended = data + b"\xff\xd9" if data.startswith(b"\xff\xd8") else data
        grey = cv2.imdecode(np.frombuffer(ended, np.uint8), flags)
    except (FrameError, cv2.error):  # OpenCV asserts on empty data
        return None
    return None if grey is None else np.asarray(grey, dtype=np.uint8)


def _video(path: Path, cameras: Sequence[str]) -> ImageSource:
    video = cv2.VideoCapture(str(path))
    total, opened = int(video.get(cv2.CAP_PROP_FRAME_COUNT)), video.isOpened()
    video.release()
    if not opened:
        raise IpsysError(f"{path}: cannot be read as a video; convert it to H.264 in an .mp4")
    name = _camera_name(path.stem, path, cameras)
    return ImageSource(name, str(path), max(total, 0), partial(_read_video, path, _stride(total)))


def _read_video(path: Path, stride: int) -> Iterator[tuple[str, Grey | None]]:
    video = cv2.VideoCapture(str(path))
    # Keep the orientation of the sensor; ignore the orientation tag of the video.
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    try:
        number = 0
        while video.grab():
            if number % stride == 0:
                is_decoded, frame = video.retrieve()
                yield f"frame {number}", _grey(np.asarray(frame, dtype=np.uint8)) if is_decoded else None
            number += 1
    finally:
        video.release()


def _grey(frame: Grey) -> Grey:
    if frame.ndim == 2:
        return frame
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def _log(path: Path, requested: bool) -> list[ImageSource]:
    with Session([path]) as session:
        topics = dict(session.images)
        counts = {camera: session.count(topic) for camera, topic in topics.items()}
        if not session.images:
            raise IpsysError(f"{path}: has no frames of any camera")
    return [
        ImageSource(
            c, f"{path}: camera {c}", counts[c], partial(_read_log, path, t, _stride(counts[c])),
            requested=requested,
        )
        for c, t in topics.items()
    ]  # fmt: skip


def _read_log(path: Path, topic: str, stride: int) -> Iterator[tuple[str, Grey | None]]:
    with Session([path]) as session:
        for time_ns, grey in read_frames(session, topic, stride):
            yield f"at {(time_ns - session.start_ns) * 1e-9:.2f} s", grey


def read_frames(session: Session, topic: str, stride: int = 1) -> Iterator[tuple[int, Grey | None]]:
    """Yield the time of each frame of a camera in ns, and its image; None for an unreadable image."""
    video: Video | None = None
    for number, message in enumerate(session.messages([topic])):
        frame, wanted = message.payload, number % stride == 0
        if isinstance(frame, CompressedVideo):
            video = video or Video(frame.format)
            if wanted:
                frame = _of_video(video, frame)
            else:
                video.skip(frame)
        if wanted:
            yield message.publish_time_ns, None if frame is None else _frame(frame)


def _of_video(video: Video, frame: CompressedVideo) -> RawImage | None:
    try:
        return video(frame)
    except FrameError:
        return None


def _frame(frame: CompressedImage | RawImage) -> Grey | None:
    if isinstance(frame, CompressedImage):
        return _decode(frame.data)
    channels, conversion = _GREY_OF_RAW.get(frame.encoding, (0, None))
    step = frame.step or frame.width * channels
    rows = np.frombuffer(frame.data, np.uint8)
    if not channels or step < frame.width * channels or rows.size < step * frame.height:
        return None
    if min(frame.width, frame.height) < 1:
        return None
    rows = rows[: step * frame.height].reshape(frame.height, step)[:, : frame.width * channels]
    pixels = np.ascontiguousarray(rows.reshape(frame.height, frame.width, channels))
    if conversion is None:
        return pixels[..., 0]
    return np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)
