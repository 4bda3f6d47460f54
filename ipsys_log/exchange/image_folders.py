"""Reader of folders of images as messages, with the times from their names or from a table."""

import csv
import re
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
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
from ipsys_log.messages.rig_file import check_name
from ipsys_log.units import NS_PER_S

NAMES = "names"
_COLUMNS = ("file", "time")
# The number of digits of a time gives its unit: seconds since 1970 have 10 digits until 2286.
# The values are the factors to ns.
_DIGITS = {19: 1, 16: 1_000, 13: 1_000_000, 10: NS_PER_S}
# The names of files have no colons, so other separators are valid too.
_ISO = re.compile(r"(\d{4}-\d\d-\d\d)[T_ ](\d\d)[:.-](\d\d)[:.-](\d\d)([.,]\d{1,9})?(Z|[+-]\d\d:?\d\d)?")


def parse_time(text: str) -> int:
    """Return a time in ns since 1970: from ns, us, ms or s since then, or ISO 8601 (UTC by default).

    Raises
    ------
    ValueError
        The text is none of these.

    Examples
    --------
    >>> parse_time("1700000000.25") == parse_time("1700000000250") == parse_time("2023-11-14T22-13-20.25")
    True
    """
    if match := _ISO.fullmatch(text):
        date, hour, minute, second, rest, zone = match.groups()
        zone = "+00:00" if zone in (None, "Z") else zone
        whole = datetime.fromisoformat(f"{date}T{hour}:{minute}:{second}{zone}")
        nanoseconds = int(rest[1:].ljust(9, "0")) if rest else 0
        return round((whole - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds()) * NS_PER_S + nanoseconds
    try:
        number = Decimal(text)
    except InvalidOperation as error:
        raise ValueError(text) from error
    # The exponent of 1e999999999 must not be expanded.
    whole_digits = number.adjusted() + 1 if number.is_finite() else 0
    if whole_digits not in _DIGITS or number < 0:
        raise ValueError(text)
    return int(number * _DIGITS[whole_digits])


def find_times(images: Mapping[str, list[Path]], times: str) -> dict[Path, int]:
    """Return the capture times of images, in ns since 1970.

    Parameters
    ----------
    images : image files by camera, from :func:`~ipsys_log.exchange.image_folders.find_images`.
    times : ``names``, or a CSV file with the columns ``file`` (such as ``red/0001.jpg``) and ``time``.
    """
    if times == NAMES:
        times_ns = {path: _time(path.stem, str(path)) for paths in images.values() for path in paths}
    else:
        times_ns = _read_table(Path(times), images)
    for paths in images.values():
        seen: dict[int, Path] = {}
        for path in paths:
            if path not in times_ns:
                raise IpsysError(f"{times}: has no row for {path.parent.name}/{path.name}; add it")
            other = seen.setdefault(times_ns[path], path)
            if other is not path:
                raise IpsysError(f"{path}: has the same time as {other.name}; give each picture its own time")
    return times_ns


def parse_start(text: str) -> int:
    """Parse the time of the option ``--start``."""
    return _time(text, "--start")


def _time(text: str, where: str) -> int:
    try:
        return parse_time(text)
    except ValueError as error:
        raise IpsysError(
            f"{where}: {text!r} is not a time; write s, ms, us or ns since 1970, or 2024-05-31T12:30:00.25Z"
        ) from error


def _read_table(table: Path, images: Mapping[str, list[Path]]) -> dict[Path, int]:
    by_name = {f"{path.parent.name}/{path.name}": path for paths in images.values() for path in paths}
    times_ns = {}
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file)
            if not set(_COLUMNS) <= set(rows.fieldnames or ()):
                raise IpsysError(f"{table}: the first line must name the columns {' and '.join(_COLUMNS)}")
            for row in rows:
                label = f"{table}: line {rows.line_num}"
                path = by_name.get(row["file"] or "")
                if path is None:
                    raise IpsysError(
                        f"{label}: picture {row['file']!r} does not exist; write it like red/0001.jpg"
                    )
                times_ns[path] = _time(row["time"] or "", label)
    except OSError as error:
        raise IpsysError(f"{table}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise IpsysError(f"{table}: is not a CSV file: {error}") from error
    return times_ns


# The formats by suffix of the file name. The bytes are written to the log unchanged.
FORMATS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png", ".webp": "webp"}
OTHER_FORMATS = (".bmp", ".tif", ".tiff", ".gif", ".heic", ".pgm", ".ppm", ".raw", ".dng")

# Images without times start at this time, so that the same folder gives the same log.
START_NS = 1_577_836_800 * NS_PER_S  # 2020-01-01


def find_images(folder: Path) -> dict[str, list[Path]]:
    """Find the images of a folder with one sub-folder per camera; return them by camera.

    The images are in the order of their names. Numbers in the names count by their value: img2 before img10.
    """
    if not folder.is_dir():
        raise IpsysError(f"{folder}: does not exist; give a folder of pictures")
    pictures = {}
    for sub in sorted(path for path in folder.iterdir() if path.is_dir()):
        files = [path for path in sub.iterdir() if path.is_file() and not path.name.startswith(".")]
        unreadable = sorted(path for path in files if path.suffix.lower() in OTHER_FORMATS)
        if unreadable:
            suffixes = ", ".join(FORMATS)
            raise IpsysError(
                f"{unreadable[0]}: only {suffixes} can be read; convert the picture, or remove it"
            )
        images = [path for path in files if path.suffix.lower() in FORMATS]
        if images:
            name = check_name(sub.name, f"{sub}: rename the folder; camera name")
            pictures[name] = sorted(images, key=_by_number)
    if not pictures:
        raise IpsysError(f"{folder}: has no sub-folders with pictures (.jpg, .png); make one for each camera")
    return pictures


def _by_number(path: Path) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", path.name.lower())
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def read_images(
    images: Mapping[str, list[Path]],
    rig: Rig | None,
    lenses: Mapping[str, CameraCalibration],
    rate_hz: float,
    times_ns: Mapping[Path, int] | None = None,
) -> Iterator[Message]:
    """Yield images as messages of frames, in log order.

    Without times, the n-th images of all cameras have the same time.

    Parameters
    ----------
    images : image files by camera, from :func:`find_images`.
    rig, lenses : optional messages before the frames; ``lenses`` are the intrinsics by camera.
    rate_hz : images per second.
    times_ns : capture time of each image, from :func:`~ipsys_log.exchange.image_folders.find_times`. With
        times, the rate has no effect.

    Raises
    ------
    IpsysError
        A camera with intrinsics has no images, or the rate is invalid.
    """
    if not 1e-6 <= rate_hz <= 1e6:
        raise IpsysError(f"--rate {rate_hz:g}: is not a rate; give pictures per second, above 0")
    strange = sorted(set(lenses) - set(images))
    if strange:
        names = ", ".join(images)
        raise IpsysError(f"--calibration {strange[0]}: this camera has no pictures; the folder has {names}")
    taken_ns = times_ns if times_ns is not None else _even_times(images, rate_hz)
    # Messages of the same instant get log times 1 ns apart.
    log_ns = min(taken_ns.values()) - len(lenses) - 1 if times_ns is not None else START_NS
    if rig is not None:
        yield Message(RIG_TOPIC, log_ns, log_ns, rig)
    for camera, lens in sorted(lenses.items()):
        log_ns += 1
        yield Message(calibration_topic(camera), log_ns, log_ns, lens, camera)
    shots = [(taken_ns[path], camera, path) for camera, paths in images.items() for path in paths]
    for time_ns, camera, path in sorted(shots, key=lambda shot: shot[0]):
        log_ns = max(time_ns, log_ns + 1)
        image = CompressedImage(time_ns, camera, path.read_bytes(), FORMATS[path.suffix.lower()])
        yield Message(image_topic(camera), log_ns, time_ns, image, camera)


def _even_times(images: Mapping[str, list[Path]], rate_hz: float) -> dict[Path, int]:
    """Return times at a constant rate; images with the same number get the same time."""
    return {
        path: START_NS + round((number + 1) * NS_PER_S / rate_hz)
        for paths in images.values()
        for number, path in enumerate(paths)
    }
