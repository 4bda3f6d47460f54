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
from ipsys_log.rig.file import check_name
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
    times_ns: Mapping[Path, int] | None = None,
) -> Iterator[Message]:
    """Pictures as frames, in log order; the n-th of all cameras are of one instant, unless times are given.

    Parameters
    ----------
    pictures : by camera, from :func:`find_pictures`.
    rig, lenses : written first, where given; lenses by camera.
    rate_hz : pictures per second.
    times_ns : when each was taken, from :func:`~ipsys_log.exchange.picture_times.find_times`; then there is
        no rate.

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
    taken_ns = times_ns if times_ns is not None else _even_times(pictures, rate_hz)
    # What is written at one instant follows by 1 ns.
    log_ns = min(taken_ns.values()) - len(lenses) - 1 if times_ns is not None else START_NS
    if rig is not None:
        yield Message(RIG_TOPIC, log_ns, log_ns, rig)
    for camera, lens in sorted(lenses.items()):
        log_ns += 1
        yield Message(calibration_topic(camera), log_ns, log_ns, lens, camera)
    shots = [(taken_ns[path], camera, path) for camera, paths in pictures.items() for path in paths]
    for time_ns, camera, path in sorted(shots, key=lambda shot: shot[0]):
        log_ns = max(time_ns, log_ns + 1)
        image = CompressedImage(time_ns, camera, path.read_bytes(), FORMATS[path.suffix.lower()])
        yield Message(image_topic(camera), log_ns, time_ns, image, camera)


def _even_times(pictures: Mapping[str, list[Path]], rate_hz: float) -> dict[Path, int]:
    """One instant takes the time of its number."""
    return {
        path: START_NS + round((number + 1) * NS_PER_S / rate_hz)
        for paths in pictures.values()
        for number, path in enumerate(paths)
    }
