"""Folders of pictures as a source of frames."""

from __future__ import annotations

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

__all__ = ["FORMATS", "read_images"]

# By file name; the bytes go into the log as they are.
FORMATS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png", ".webp": "webp"}

# Pictures that tell no time start here, so that the same folder gives the same log.
START_NS = 1_577_836_800 * NS_PER_S  # 2020-01-01


def read_images(
    folder: Path, rig: Rig | None, lenses: Mapping[str, CameraCalibration], rate_hz: float
) -> Iterator[Message]:
    """The pictures of a folder with one sub-folder per camera, in log order.

    The n-th pictures of all cameras, in the order of their names, are of one instant.

    Parameters
    ----------
    folder : its sub-folders are named after the cameras.
    rig, lenses : written first, where given; lenses by camera.
    rate_hz : pictures per second.

    Raises
    ------
    IpsysError
        Where there are no pictures, or a lens is of a camera without pictures.
    """
    if rate_hz <= 0:
        raise IpsysError(f"--rate {rate_hz:g}: pictures per second must be above 0")
    pictures = _pictures(folder)
    strange = sorted(set(lenses) - set(pictures))
    if strange:
        known = ", ".join(pictures)
        raise IpsysError(f"--calibration {strange[0]}: {folder} has no such camera (it has {known})")
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


def _pictures(folder: Path) -> dict[str, list[Path]]:
    if not folder.is_dir():
        raise IpsysError(f"{folder}: there is no such folder")
    pictures = {}
    for sub in sorted(path for path in folder.iterdir() if path.is_dir()):
        found = sorted(path for path in sub.iterdir() if path.suffix.lower() in FORMATS)
        if found:
            pictures[check_name(sub.name, f"{folder}: camera name")] = found
    if not pictures:
        raise IpsysError(f"{folder}: has no sub-folders with pictures (.jpg, .png); make one for each camera")
    return pictures
