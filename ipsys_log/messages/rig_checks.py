"""Checks of a rig file: values in a wrong unit, and marker ids that do not exist."""

import re
from collections.abc import Iterator
from typing import NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Rig


class _Kind(NamedTuple):
    """The unit and the plausible range of a value, and the units that users confuse with it, as factors."""

    unit: str
    low: float
    high: float
    others: tuple[tuple[str, float], ...] = ()


_LENGTHS = (("cm", 0.01), ("mm", 0.001))
# By the key in the rig file. A value outside the range has another unit. A row time of 0 is also valid.
_KINDS = {
    "marker_length_m": _Kind("m", 0.002, 2.0, _LENGTHS),
    "length_m": _Kind("m", 0.002, 2.0, _LENGTHS),
    "tape_sigma_m": _Kind("m", 0.0, 0.1, _LENGTHS),
    "ab_sigma_m": _Kind("m", 0.0, 0.1, _LENGTHS),
    "marker_height_sigma_m": _Kind("m", 0.0, 0.1, _LENGTHS),
    "height_sigma_m": _Kind("m", 0.0, 0.1, _LENGTHS),
    "width_m": _Kind("m", 0.0, 100.0, _LENGTHS),
    "depth_m": _Kind("m", 0.0, 100.0, _LENGTHS),
    "x_m": _Kind("m", -100.0, 100.0, _LENGTHS),
    "y_m": _Kind("m", -100.0, 100.0, _LENGTHS),
    "rate_hz": _Kind("Hz", 0.0, 1000.0),
    "exposure_s": _Kind("s", 0.0, 1.0, (("ms", 1e-3), ("us", 1e-6))),
    "row_time_ns": _Kind("ns", 1000, 1_000_000, (("us", 1e3),)),
    "edge_offset_px": _Kind("px", -5.0, 5.0),
}

# Number of markers of each dictionary whose name does not contain this number.
_SIZES = {
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_16H5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_25H9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36H10": 2320,
    "DICT_APRILTAG_36h11": 587,
    "DICT_APRILTAG_36H11": 587,
    "DICT_ARUCO_MIP_36h12": 250,
    "DICT_ARUCO_MIP_36H12": 250,
}


def check_units(rig: Rig, where: str) -> None:
    """Check that no value of a rig file is in a wrong unit, and that its markers exist.

    Raises
    ------
    IpsysError
        A value is impossible in a lab (the text contains the value in the probable unit), or the dictionary
        does not contain a marker id.
    """
    for item, key, value in _given(rig):
        kind = _KINDS[key]
        if kind.low <= value <= kind.high:
            continue
        meant = [(unit, value * factor) for unit, factor in kind.others]
        likely = [
            f"{number:g} if it is in {unit}" for unit, number in meant if kind.low <= number <= kind.high
        ]
        then = " or ".join(likely) or f"{kind.low:g} to {kind.high:g}"
        raise IpsysError(f"{where}: {item}{key} = {value:g} is too {_far(value, kind)}; write {then}")
    size = dictionary_size(rig.dictionary)
    for marker in rig.all_markers:
        if size is not None and marker.id >= size:
            raise IpsysError(
                f"{where}: marker id {marker.id}: {rig.dictionary} has only the ids 0 to {size - 1}; correct "
                "the id, or the dictionary of the print"
            )


def _far(value: float, kind: _Kind) -> str:
    """Return the text that a value is too large or too small for its unit."""
    return f"large for {kind.unit}" if value > kind.high else f"small for {kind.unit}"


def dictionary_size(dictionary: str) -> int | None:
    """Return the number of markers of an OpenCV dictionary; None for an unknown dictionary.

    Examples
    --------
    >>> dictionary_size("DICT_4X4_100"), dictionary_size("DICT_APRILTAG_16h5")
    (100, 30)
    """
    named = re.fullmatch(r"DICT_\dX\d_(\d+)", dictionary)
    return int(named[1]) if named else _SIZES.get(dictionary)


def _given(rig: Rig) -> Iterator[tuple[str, str, float]]:
    """Yield the values with a plausible range: the item of the rig, the key, and the value."""
    items: list[tuple[str, object]] = [
        ("", rig),
        *((f"marker {marker.id}: ", marker) for marker in rig.all_markers),
    ]
    items += [("[floor] ", rig.floor)]
    items += [(f"reference point {point.name}: ", point) for point in rig.reference_points]
    items += [(f"camera {camera.name}: ", camera) for camera in rig.cameras]
    for name, item in items:
        for key in _KINDS:
            value = getattr(item, key, None)
            if value is not None and not (key == "row_time_ns" and value == 0):
                yield name, key, value
