"""Pictures with their markers as a data set in the COCO format, for the training of detectors.

References
----------
Lin et al., "Microsoft COCO: Common Objects in Context", ECCV 2014; https://cocodataset.org/#format-data.
"""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, NamedTuple

import cv2
import numpy as np

from ipsys_log.engine.request import Progress
from ipsys_log.errors import FrameError, IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, CompressedVideo, Marker, Markers, Message, RawImage
from ipsys_log.messages.channels import MARKERS
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.decode import decode_grey
from ipsys_log.vision.video import Video

ANNOTATIONS = "annotations.json"
_STEP = "pictures"
_CATEGORY = {
    "id": 1,
    "name": "marker",
    "supercategory": "fiducial",
    "keypoints": ["top_left", "top_right", "bottom_right", "bottom_left"],
    "skeleton": [[1, 2], [2, 3], [3, 4], [4, 1]],
}
_VISIBLE = 2
# COCO counts outlines from the corner of the first pixel, and keypoints from its centre, as a log does.
_CORNER_FROM_CENTRE_PX = 0.5
_SUFFIXES = {b"\xff\xd8": ".jpg", b"\x89P": ".png", b"RI": ".webp"}

_Image = CompressedImage | RawImage


class CocoCounts(NamedTuple):
    """The numbers of pictures and markers in a data set."""

    pictures: int
    markers: int


def write_coco(
    session: Session, run: str, folder: Path, progress: Progress = lambda step, done, total: None
) -> CocoCounts:
    """Write the pictures that a run of detect has searched, and their markers; memory is constant.

    A picture is ``images/<camera>/<time in ns>.jpg`` with the bytes of the log. Raw images and frames of
    videos become PNG, in grey. ``annotations.json`` has an image for each picture, also without markers, and
    an annotation for each marker: ``keypoints`` are the corners with all stored digits, clockwise from the
    top left of the marker; ``marker_id``; ``bbox``, ``segmentation`` and ``area`` in px.

    Raises
    ------
    IpsysError
        The folder exists, the log has no images of the run, or an image is damaged.
    """
    marked = session.topics(MARKERS, run)
    topics = [*session.images.values(), *marked]
    if not session.images:
        raise IpsysError(f"{session}: has no images; export a log with images, such as the recording")
    total = sum(map(session.count, topics))
    with (
        _new_folder(folder) as partial,
        tempfile.TemporaryFile("w+", encoding="utf-8") as rows,
        (partial / ANNOTATIONS).open("w", encoding="utf-8") as file,
    ):
        data, pairs = _DataSet(partial, file, rows), _Pairs()
        for done, message in enumerate(session.messages(topics)):
            progress(_STEP, done, total)
            for camera, image, markers in pairs.add(message):
                data.add(camera, image, markers)
        if not data.pictures:
            raise IpsysError(
                f"{session}: has no images of the markers of run {run}; give the log with the images, too"
            )
        data.close(run)
    progress(_STEP, total, total)
    return CocoCounts(data.pictures, data.markers)


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """Yield a new folder that gets its name at the end of the block; after an error, it is removed."""
    if folder.exists() or folder.is_symlink():
        raise IpsysError(f"{folder}: exists already; choose another name")
    if not folder.parent.is_dir():
        raise IpsysError(f"{folder}: there is no folder {folder.parent}; make it first")
    partial = folder.with_name(f"{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir()
        yield partial
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


class _Pairs:
    """The newest image and the newest markers of each camera, until both have the same time."""

    def __init__(self) -> None:
        self._images: dict[str, CompressedImage | RawImage | None] = {}
        self._markers: dict[str, Markers] = {}
        self._videos: dict[str, Video] = {}

    def add(self, message: Message) -> Iterator[tuple[str, _Image, Markers]]:
        """Yield the camera, its image and the markers in it, if the message completes them."""
        camera = str(message.camera)
        if isinstance(message.payload, Markers):
            self._markers[camera] = message.payload
        elif isinstance(message.payload, CompressedVideo):
            self._images[camera] = self._decode(camera, message.payload)
        else:
            self._images[camera] = message.payload
        image, markers = self._images.get(camera), self._markers.get(camera)
        if image is not None and markers is not None and image.timestamp == markers.timestamp:
            self._images[camera] = None
            yield camera, image, markers

    def _decode(self, camera: str, frame: CompressedVideo) -> RawImage | None:
        if camera not in self._videos:
            self._videos[camera] = Video(frame.format)
        try:
            return self._videos[camera](frame)
        except FrameError:
            return None  # detect has no markers of such a frame either


class _DataSet:
    """A data set that is written: pictures as files, the images of COCO, and its annotations for later.

    Parameters
    ----------
    file : gets the text of the annotation file.
    rows : holds the annotations until all images are written, which come first in the file.
    """

    def __init__(self, folder: Path, file: IO[str], rows: IO[str]) -> None:
        self._folder, self._file, self._rows = folder, file, rows
        self.pictures = self.markers = 0
        file.write('{"images": [')

    def add(self, camera: str, image: _Image, markers: Markers) -> None:
        """Write a picture with its markers."""
        data, suffix = _picture(image)
        name = f"images/{camera}/{image.timestamp}{suffix}"
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        self.pictures += 1
        row = {
            "id": self.pictures,
            "file_name": name,
            "width": markers.width,
            "height": markers.height,
            "date_captured": _iso(image.timestamp),
            "camera": camera,
            "time_ns": image.timestamp,
        }
        self._write(self._file, self.pictures, row)
        for marker in markers.markers:
            if not np.isfinite(marker.corners_px).all():
                continue  # a log of another program may hold such corners, and JSON has no NaN
            self.markers += 1
            self._write(self._rows, self.markers, _annotation(marker, self.markers, self.pictures))

    def close(self, run: str) -> None:
        """Write the annotations and the rest of the file."""
        self._file.write('\n],\n"annotations": [')
        self._rows.seek(0)
        shutil.copyfileobj(self._rows, self._file)
        rest = {
            "categories": [_CATEGORY],
            "info": {"description": f"ArUco markers, run {run}", "version": "1.0"},
            "licenses": [],
        }
        self._file.write(f"\n],\n{json.dumps(rest)[1:]}\n")

    @staticmethod
    def _write(file: IO[str], number: int, row: dict[str, Any]) -> None:
        file.write(f"{'' if number == 1 else ','}\n{json.dumps(row, allow_nan=False)}")


def _annotation(marker: Marker, number: int, picture: int) -> dict[str, Any]:
    outline = np.asarray(marker.corners_px, dtype=np.float64) + _CORNER_FROM_CENTRE_PX
    low, high = outline.min(axis=0), outline.max(axis=0)
    x, y = outline.T
    area = abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
    points = [value for corner in marker.corners_px.tolist() for value in (*corner, _VISIBLE)]
    return {
        "id": number,
        "image_id": picture,
        "category_id": _CATEGORY["id"],
        "marker_id": marker.id,
        "keypoints": points,
        "num_keypoints": len(outline),
        "bbox": [*low.tolist(), *(high - low).tolist()],
        "area": area,
        "segmentation": [outline.ravel().tolist()],
        "iscrowd": 0,
    }


def _picture(image: _Image) -> tuple[bytes, str]:
    """Return the bytes of a picture file and the suffix of its name."""
    if isinstance(image, CompressedImage):
        suffix = _SUFFIXES.get(bytes(image.data[:2]))
        if suffix is not None:
            return image.data, suffix
    return cv2.imencode(".png", decode_grey(image))[1].tobytes(), ".png"


def _iso(time_ns: int) -> str:
    whole = datetime.fromtimestamp(time_ns // NS_PER_S, UTC)
    return f"{whole:%Y-%m-%dT%H:%M:%S}.{time_ns % NS_PER_S:09d}Z"
