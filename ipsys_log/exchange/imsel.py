"""Reader of the published measurements of the paper's authors, as messages of a log.

The folder holds the data alone, or a clone of the authors' repository
(https://github.com/iMSEL-USC/Indoor-Positioning-System-iMSEL).

SciPy's reader of MAT files is not used: wrong types or flags in a file crash its process.
Layout of the files: "MAT-File Format", The MathWorks, chapter 1.
"""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.exchange.calibration_formats import read_calibration
from ipsys_log.messages import (
    IMPORTED,
    MEASUREMENTS_TOPIC,
    RIG_TOPIC,
    CameraPoint,
    CameraPoints,
    Floor,
    Interval,
    Measurement,
    Message,
    ReferencePoint,
    Rig,
    RigCamera,
    RigMarker,
    Run,
    WorldPoint,
    calibration_topic,
)
from ipsys_log.units import CM_PER_M, NS_PER_S

_HEAD = 128  # bytes
_LITTLE_ENDIAN = b"\x00\x01IM"
_TAG = struct.Struct("<II")  # type, number of the following bytes
_MATRIX, _COMPRESSED, _FLAGS, _DIMENSIONS, _TEXT = 14, 15, 6, 5, 1
_NUMBERS = {
    1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8",
}  # fmt: skip
_CLASSES = range(6, 16)  # double to uint64; no cells, structures, objects or functions
_LARGEST = 16 << 20  # bytes of one table
_LARGEST_FILE = 64 << 20  # bytes of all tables of a file


def read_mat(path: Path) -> dict[str, NDArray[np.float64]]:
    """Read the tables of a MATLAB file by name, each of two dimensions.

    Raises
    ------
    IpsysError
        The file cannot be read, has another version, or holds other data than tables of real numbers.
    """
    try:
        data = path.read_bytes()
        if data[124:_HEAD] != _LITTLE_ENDIAN:
            raise ValueError("no header of version 5")
        return dict(map(_table, _matrices(data)))
    except OSError as error:
        raise IpsysError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, struct.error, zlib.error) as error:
        raise IpsysError(f"{path}: is not a MATLAB file that can be read: {error}") from error


def _matrices(data: bytes) -> Iterator[bytes]:
    offset, unpacked = _HEAD, 0
    while offset < len(data):
        kind, size = _TAG.unpack_from(data, offset)
        body = data[offset + _TAG.size : offset + _TAG.size + size]
        offset += _TAG.size + size
        if len(body) < size:
            raise ValueError("it is cut off")
        if kind == _COMPRESSED:
            whole = zlib.decompressobj().decompress(body, _LARGEST)
            kind, size = _TAG.unpack_from(whole)
            body = whole[_TAG.size :]
        unpacked += len(body)
        if unpacked > _LARGEST_FILE:
            raise ValueError("its tables are too large")
        if kind != _MATRIX or len(body) != size:
            raise ValueError("it has data other than tables")
        yield body


def _table(matrix: bytes) -> tuple[str, NDArray[np.float64]]:
    """Parse flags, dimensions, name and numbers: each has a tag and is padded to 8 bytes."""
    parts = list(_parts(matrix))
    if [kind for kind, _ in parts[:-1]] != [_FLAGS, _DIMENSIONS, _TEXT] or parts[-1][0] not in _NUMBERS:
        raise ValueError("parts of a table are missing")
    (_, flags), (_, sizes), (_, name), (kind, numbers) = parts
    if len(flags) != 8 or flags[0] not in _CLASSES or flags[1]:
        raise ValueError("it has data other than real numbers")
    rows, columns = struct.unpack("<ii", sizes)
    values = np.frombuffer(numbers, _NUMBERS[kind])
    if min(rows, columns) < 0 or rows * columns != len(values):
        raise ValueError("the size of a table does not match its numbers")
    return name.decode(), values.astype(np.float64).reshape((rows, columns), order="F")


def _parts(matrix: bytes) -> Iterator[tuple[int, bytes]]:
    offset = 0
    while offset < len(matrix):
        kind, size = _TAG.unpack_from(matrix, offset)
        start, step = offset + _TAG.size, _TAG.size + -(-size // 8) * 8
        if kind >> 16:  # the tag itself holds up to four bytes
            kind, size, start, step = kind & 0xFFFF, kind >> 16, offset + 4, _TAG.size
        if start + size > len(matrix) or (step == _TAG.size and size > 4):
            raise ValueError("a part of a table is cut off")
        yield kind, matrix[start : start + size]
        offset += step


CAMERAS = {"red": "cam_gnt", "white": "cam_wht", "black": "cam_blk_new_2"}
SUBSETS = (10, 20, 30, 40)

# The points were measured before the paper was submitted. No time is published, so each point gets a second.
START_NS = 1_640_995_200 * NS_PER_S  # 2022-01-01

_RIG = Rig(
    name="imsel",
    dictionary="DICT_4X4_100",
    marker_length_m=0.20,
    markers=(RigMarker(0, robot="robot_0"),),
    cameras=tuple(RigCamera(name) for name in CAMERAS),
    reference_points=(ReferencePoint("A", 1.2192, 2.4384), ReferencePoint("B", 3.6576, 2.4384)),
    floor=Floor(4.8768, 4.8768),
)


def read_imsel(folder: Path) -> Iterator[Message]:
    """Yield the authors' rig, intrinsics, camera points and measured points, in log order.

    Each measurement is for one camera, and gets a separate second. Ten points of the floor were measured for
    two cameras each. Their measurements have different labels, so they stay separate; ``calibration_point``
    is the same. The 40 training points have the label
    ``train``, and the published subsets the labels ``train_10`` to ``train_40``. The others have ``test``.
    """
    mats = {name: read_mat(_find(folder, f"{name}.mat")) for name in ("testing", *map(_training, SUBSETS))}
    lenses = {camera: _find(folder, f"{stem}_calib.yaml") for camera, stem in CAMERAS.items()}
    yield Message(RIG_TOPIC, START_NS, START_NS, _RIG)
    for number, (camera, path) in enumerate(lenses.items(), 1):
        time_ns = START_NS + number
        # The files do not state the fisheye model; the paper does.
        lens = read_calibration(path, camera, time_ns).lens
        yield Message(calibration_topic(camera), time_ns, time_ns, lens, camera)
    time_ns = START_NS
    names: dict[bytes, str] = {}
    for camera in CAMERAS:
        for number, (point_m, world_m, splits) in enumerate(_places(mats, camera)):
            time_ns += NS_PER_S
            name = f"{camera}_{number:02d}"
            first = names.setdefault(world_m.tobytes(), name)
            yield from _place(camera, name, first, time_ns, point_m, world_m, splits)
    run = Run(timestamp=time_ns, run="imsel", stage=IMPORTED, parameters={"format": "imsel"})
    yield Message("/runs/imsel/record", time_ns + 2, time_ns, run)


def _training(count: int) -> str:
    return f"training_{count}"


def _find(folder: Path, name: str) -> Path:
    if not folder.is_dir():
        raise IpsysError(f"{folder}: does not exist; give the folder of the paper's .mat files")
    matches = sorted(folder.rglob(name), key=lambda path: (len(path.parts), path))
    if not matches:
        raise IpsysError(
            f"{folder}: has no {name}; give the folder of the paper's data, or of its repository"
        )
    return matches[0]


def _array(mats: dict[str, dict[str, Any]], mat: str, name: str) -> NDArray[np.float64]:
    array = mats[mat].get(name)
    if array is None or np.ndim(array) != 2 or np.shape(array)[1] != 3 or not np.isfinite(array).all():
        raise IpsysError(f"{mat}.mat: {name} is not a table of three columns of numbers")
    return np.asarray(array, dtype=np.float64) / CM_PER_M


def _places(
    mats: dict[str, dict[str, Any]], camera: str
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], tuple[str, ...]]]:
    """Yield camera point (m), world point (m) and labels of each calibration point; training points first."""
    largest = _training(SUBSETS[-1])
    subsets = {
        f"train_{n}": {tuple(row) for row in _array(mats, _training(n), f"Xc_{camera}").tolist()}
        for n in SUBSETS
    }
    points, worlds = _array(mats, largest, f"Xc_{camera}"), _array(mats, largest, f"Xw_{camera}")
    for point, world in zip(points, worlds, strict=True):
        labels = [label for label, rows in subsets.items() if tuple(point.tolist()) in rows]
        yield point, world, ("train", *labels)
    points, worlds = (_array(mats, "testing", f"X{kind}_{camera}_test") for kind in "cw")
    for point, world in zip(points, worlds, strict=True):
        yield point, world, ("test",)


def _place(
    camera: str,
    name: str,
    first: str,
    time_ns: int,
    point_m: NDArray[np.float64],
    world_m: NDArray[np.float64],
    splits: tuple[str, ...],
) -> Iterator[Message]:
    """Yield the camera point and the measurement; ``first`` names the first measurement of the point."""
    points = CameraPoints(time_ns, (CameraPoint(0, *point_m.tolist()),))
    yield Message(f"/runs/imsel/cameras/{camera}/camera_points", time_ns, time_ns, points, camera)
    measurement = Measurement(
        timestamp=time_ns,
        id=name,
        marker_id=0,
        height_m=float(world_m[2]),
        still=Interval(time_ns, time_ns),
        point=WorldPoint(*world_m.tolist()),
        splits=splits,
        calibration_point=None if first == name else first,
    )
    yield Message(MEASUREMENTS_TOPIC, time_ns + 1, time_ns, measurement)
