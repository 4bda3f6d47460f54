"""Folders of pictures as a source of frames."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from ipsys_log.errors import IpsysError
from ipsys_log.messages import (
    RIG_TOPIC,
    CameraCalibration,
    CompressedImage,
    Message,
    Rig,
    calibration_topic,
    image_topic,
)
from ipsys_log.rig import check_name
from ipsys_log.units import NS_PER_S

__all__ = ["FORMATS", "find_pictures", "read_images"]

# By file name; the bytes go into the log as they are.
FORMATS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png", ".webp": "webp"}
OTHER_FORMATS = (".bmp", ".tif", ".tiff", ".gif", ".heic", ".pgm", ".ppm", ".raw", ".dng")

# Pictures that tell no time start here, so that the same folder gives the same log.
START_NS = 1_577_836_800 * NS_PER_S  # 2020-01-01


def find_pictures(folder: Path) -> dict[str, list[Path]]:
    """The pictures of a folder with one sub-folder per camera, by camera.

    In the order of their names, numbers in them by their value: img2 before img10.

    Raises
    ------
    IpsysError
        Where there are none, or a picture is in a format that cannot be read.
    """
    if not folder.is_dir():
        raise IpsysError(f"{folder}: there is no such folder")
    pictures = {}
    for sub in sorted(path for path in folder.iterdir() if path.is_dir()):
        files = [path for path in sub.iterdir() if path.is_file() and not path.name.startswith(".")]
        other = sorted(path for path in files if path.suffix.lower() in OTHER_FORMATS)
        if other:
            known = ", ".join(FORMATS)
            raise IpsysError(f"{other[0]}: only {known} are read; convert the picture, or take it out")
        found = [path for path in files if path.suffix.lower() in FORMATS]
        if found:
            name = check_name(sub.name, f"{sub}: rename the folder; camera name")
            pictures[name] = sorted(found, key=_by_number)
    if not pictures:
        raise IpsysError(f"{folder}: has no sub-folders with pictures (.jpg, .png); make one for each camera")
    return pictures


def _by_number(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", path.name.lower())
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def read_images(
    pictures: Mapping[str, list[Path]],
    rig: Rig | None,
    lenses: Mapping[str, CameraCalibration],
    rate_hz: float,
) -> Iterator[Message]:
    """Pictures as frames, in log order; the n-th of all cameras are of one instant.

    Parameters
    ----------
    pictures : by camera, from :func:`find_pictures`.
    rig, lenses : written first, where given; lenses by camera.
    rate_hz : pictures per second.

    Raises
    ------
    IpsysError
        Where a lens is of a camera without pictures, or the rate is none.
    """
    if not 1e-6 <= rate_hz <= 1e6:
        raise IpsysError(f"--rate {rate_hz:g}: give pictures per second, above 0")
    strange = sorted(set(lenses) - set(pictures))
    if strange:
        known = ", ".join(pictures)
        raise IpsysError(f"--calibration {strange[0]}: there are no pictures of such a camera (only {known})")
    # One instant takes the time of its number; what is written at one instant follows by 1 ns.
    time_ns = START_NS
    if rig is not None:
        yield Message(RIG_TOPIC, time_ns, time_ns, rig)
    for camera, lens in sorted(lenses.items()):
        time_ns += 1
        yield Message(calibration_topic(camera), time_ns, time_ns, lens, camera)
    for number in range(max(len(paths) for paths in pictures.values())):
        instant_ns = START_NS + round((number + 1) * NS_PER_S / rate_hz)
        for order, (camera, paths) in enumerate(pictures.items()):
            if number < len(paths):
                path = paths[number]
                image = CompressedImage(instant_ns, camera, path.read_bytes(), FORMATS[path.suffix.lower()])
                yield Message(image_topic(camera), instant_ns + order, instant_ns, image, camera)
